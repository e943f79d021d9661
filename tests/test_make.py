"""make as a user types it: nothing is expanded, nothing is left outside, a kill costs nothing."""

from __future__ import annotations

import os
import shutil
import signal

import pytest

from workflow_runs import QUIET, ROOT, VARYING, clone, shell, wait_until

TARGETS = "dataset7 results/smoke/alignment/dae_retrained/network.safetensors"
REPRODUCE = f"make reproduce PRESET=smoke TARGETS='{TARGETS}'"


@pytest.fixture
def pretended(tmp_path):
    """Makefile and wrapper with programs that only write down their words."""
    shutil.copytree(ROOT / "workflow", tmp_path / "workflow")
    for name in ("Makefile", "requirements.lock", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / ".venv/bin").mkdir(parents=True)
    for name in ("snakemake", "mlflow", "psfdae"):
        program = tmp_path / ".venv/bin" / name
        program.write_text('#!/bin/sh\nprintf "%s\\n" "$@" >> "$HOME/words"\n')
        program.chmod(0o755)
    (tmp_path / ".venv/.complete").touch()
    (tmp_path / "results").mkdir()
    (tmp_path / "results/mlflow.db").touch()
    return tmp_path


@pytest.mark.parametrize("variable", ["SET", "TARGETS", "CORES", "PRESET", "PORT"])
def test_a_variable_of_make_stays_a_text(pretended, variable):
    """It may come from a colleague's file; neither a shell nor make itself expands it."""
    text = '`touch pwned` $(touch pwned) "; touch pwned; " $(shell touch pwned) $HOME/*'
    (pretended / "text").write_text(text)
    for target in ("reproduce", "report", "stability", "mlflow"):
        shell(pretended, f'make {target} {variable}="$(cat text)"', **QUIET).wait()
    words = (pretended / "words").read_text().splitlines()
    if variable == "TARGETS":
        # They are words apart.
        assert set(text.split()) <= set(words)
    else:
        assert text in [word.removeprefix(f"{variable.lower()}=") for word in words]
    assert not list(pretended.rglob("pwned"))


def snapshot(results):
    """Bytes of the products of a run: no times, no logs, no views of other products."""
    # MLflow draws the names of its runs, which its receipts and their notes hold.
    left_out = {"logs", "benchmarks", "mlartifacts", "mlflow", "mlflow.db"}
    varying = (*VARYING, "curves.png", "report.html")
    return {
        str(path.relative_to(results)): path.read_bytes()
        for path in results.rglob("*")
        if path.is_file()
        and not left_out & set(path.relative_to(results).parts)
        and not path.name.removesuffix(".sha256").endswith(varying)
    }


@pytest.mark.slow
@pytest.mark.workflow
def test_a_killed_run_ends_in_the_bytes_of_another_run_and_leaves_its_home_alone(smoke, tmp_path):
    """Killed with all its children after 8 jobs, in a folder with a blank in its name."""
    folder, home, log = clone(tmp_path / "my house"), tmp_path / "home", tmp_path / "log"
    home.mkdir()
    with log.open("w") as out:
        run = shell(folder, REPRODUCE, home, stdout=out, stderr=out, start_new_session=True)
        wait_until(lambda: run.poll() or log.read_text().count("\nFinished") >= 8, 600, "too slow")
        assert run.poll() is None, log.read_text()
        os.killpg(run.pid, signal.SIGKILL)
        assert run.wait() != 0
    with log.open("w") as out:
        assert shell(folder, REPRODUCE, home, stdout=out, stderr=out).wait() == 0, log.read_text()
    products = snapshot(folder / "results/smoke")
    assert len(products) > 50
    assert products.items() <= snapshot(smoke / "results").items()
    assert (folder / "results/smoke/report.html").stat().st_size > 1e6
    assert not list((folder / "results").rglob("*.tmp"))
    assert list(home.rglob("*")) == []
