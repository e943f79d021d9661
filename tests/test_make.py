"""make as a user types it: nothing is expanded, nothing is left outside, a kill costs nothing."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess

import pytest

from workflow_runs import ROOT, VARYING, clone, shell, wait_until

REPRODUCE = "make reproduce PRESET=smoke"
JOBS = 80
"""Such a run has a few more; a kill comes after a number of jobs below this."""


@pytest.fixture
def pretended(tmp_path):
    """Makefile and wrapper with programs that only write down what they are told."""
    shutil.copytree(ROOT / "workflow", tmp_path / "workflow")
    for name in ("Makefile", "requirements.lock", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    for name in ("snakemake", "mlflow", "psfdae"):
        program = tmp_path / ".venv/bin" / name
        program.parent.mkdir(parents=True, exist_ok=True)
        program.write_text('#!/bin/sh\nprintf "%s\\n" "$@" >> "$HOME/said"\n')
        program.chmod(0o755)
    (tmp_path / ".venv/.complete").touch()
    (tmp_path / "results").mkdir()
    (tmp_path / "results/mlflow.db").touch()
    return tmp_path


@pytest.mark.parametrize("variable", ["SET", "TARGETS", "CORES", "PRESET", "PORT"])
@pytest.mark.parametrize(
    "text",
    ["`touch pwned`", "$(touch pwned)", '"; touch pwned; "', "$(shell touch pwned)", "$HOME/*"],
)
def test_what_make_is_given_stays_a_text(pretended, variable, text):
    """It may come from a colleague's file; neither a shell nor make itself expands it."""
    (pretended / "text").write_text(text)
    for target in ("reproduce", "report", "stability", "mlflow"):
        line = f'make {target} {variable}="$(cat text)"'
        shell(pretended, line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).wait()
    said = (pretended / "said").read_text().splitlines()
    if variable == "TARGETS":
        # Words apart, as targets are.
        assert set(text.split()) <= set(said)
    elif variable == "PORT":
        assert text in said
    else:
        assert [word for word in said if word.removeprefix(f"{variable.lower()}=") == text]
    assert not list(pretended.rglob("pwned"))


@pytest.mark.parametrize(("preset", "finished"), [("fast", True), ("fast", False), ("smoke", True)])
def test_reproduce_ends_with_what_the_record_says(pretended, preset, finished):
    """Only where there is something to compare, and never by failing."""
    results = pretended / ("results" if preset == "fast" else f"results/{preset}")
    (results / "evaluation").mkdir(parents=True)
    (results / ".report.html").touch()
    if not finished:
        (results / "evaluation").rmdir()
    with (pretended / ".venv/bin/psfdae").open("a") as program:
        program.write('[ "$1" != compare ] || exit 2\n')
    run = shell(pretended, f"make reproduce PRESET={preset}", stdout=subprocess.DEVNULL)
    assert run.wait() == 0
    said = (pretended / "said").read_text().splitlines()
    compared = ["compare", "results", "results/reference"]
    assert (said[-3:] == compared) == (finished and preset == "fast")
    assert said.count("compare") == (finished and preset == "fast")


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


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """A whole run of make that nothing happens to, in a folder with a blank in its name."""
    folder = clone(tmp_path_factory.mktemp("undisturbed") / "my house")
    home = tmp_path_factory.mktemp("home")
    run = shell(folder, REPRODUCE, home, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    assert run.wait() == 0
    return folder, home


@pytest.mark.slow
@pytest.mark.workflow
def test_make_writes_nothing_outside_its_folder(undisturbed):
    assert list(undisturbed[1].rglob("*")) == []
    assert (undisturbed[0] / "results/smoke/report.html").stat().st_size > 1e6


@pytest.mark.slow
@pytest.mark.workflow
@pytest.mark.parametrize("jobs", sorted(random.Random(13).sample(range(JOBS), 3)))
def test_the_same_command_ends_what_was_killed(undisturbed, tmp_path, jobs):
    """Killed with all its children once so many jobs are done: no other step is needed."""
    folder, log = clone(tmp_path / "house"), tmp_path / "log"
    with log.open("w") as said:
        run = shell(folder, REPRODUCE, stdout=said, stderr=said, start_new_session=True)
        wait_until(lambda: log.read_text().count("\nFinished jobid") >= jobs, 600, "no progress")
        os.killpg(run.pid, signal.SIGKILL)
        assert run.wait() != 0
    again = shell(folder, REPRODUCE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    out, _ = again.communicate()
    assert again.returncode == 0, out
    assert snapshot(folder / "results/smoke") == snapshot(undisturbed[0] / "results/smoke")
    assert not list((folder / "results").rglob("*.tmp"))
