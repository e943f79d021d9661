"""Runs that are killed end, once repeated, in the same files.

Every case kills a `make reproduce` of one dataset's network, baseline and evaluation, then
types the same again. What comes out is compared byte by byte with an undisturbed run.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time

import pandas as pd
import psutil
import pytest

from psfdae.base.files import write_text
from workflow_runs import (
    KERNELS,
    NO_CLUSTER,
    PATH,
    QUIET,
    captured,
    clone,
    copy_of_sources,
    wait_until,
)

pytestmark = [pytest.mark.workflow, pytest.mark.slow]

RESULTS = "results/smoke"
TARGET = f"{RESULTS}/evaluation/dataset3/random-realisation.csv"
CHECKPOINT = f"{RESULTS}/checkpoints/dae/dataset3/random-realisation.pt"
# Long enough for a signal to arrive in mid-training, which then resumes.
SLOW = "train.epochs=20 train.checkpoint_seconds=0 train.batch=8"


def reproduce(folder):
    """Arguments of `subprocess` for what a user types in the active environment."""
    environment = {"HOME": str(folder), "PATH": PATH, "PYTHONPATH": str(folder / "src")}
    environment |= NO_CLUSTER | KERNELS
    line = ["make", "reproduce", "PRESET=smoke", f"TARGETS={TARGET}", f"SET={SLOW}"]
    return {"args": line, "cwd": folder, "env": environment}


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The run that nothing happens to."""
    folder = clone(tmp_path_factory.mktemp("undisturbed") / "house")
    run = captured(**reproduce(folder))
    assert run.returncode == 0, run.stdout + run.stderr
    return folder


@pytest.fixture
def half_done(undisturbed, tmp_path):
    """A house with the stars, but without network and evaluation."""
    folder = clone(tmp_path / "house")
    shutil.copytree(undisturbed / RESULTS / "data", folder / RESULTS / "data")
    return folder


def products(folder):
    """Content of all results that do not tell times, by name."""
    return {
        path.relative_to(folder): path.read_bytes()
        for path in sorted((folder / RESULTS).rglob("*"))
        if path.suffix in (".h5", ".safetensors", ".csv", ".parquet") and path.name != "history.csv"
    }


def recovered(folder, undisturbed):
    """Output of the repeated run, whose files are those of the undisturbed one."""
    run = captured(**reproduce(folder))
    assert run.returncode == 0, run.stdout + run.stderr
    expected = products(undisturbed)
    assert len(expected) >= 6
    assert products(folder) == expected
    assert not (folder / CHECKPOINT).exists()
    return run.stdout + run.stderr


@pytest.mark.parametrize("victim", ["fit", "snakemake"])
def test_a_killed_process(half_done, undisturbed, victim):
    """A worker resumes after its last epoch; jobs of a killed Snakemake run on and are awaited."""
    run = subprocess.Popen(**reproduce(half_done), **QUIET)
    for _ in range(3000):
        if (half_done / CHECKPOINT).exists() or run.poll() is not None:
            break
        time.sleep(0.1)
    assert run.poll() is None, "the training left no checkpoint"
    for child in psutil.Process(run.pid).children(recursive=True):
        try:
            words = child.cmdline()
        except (psutil.NoSuchProcess, psutil.ZombieProcess):  # it has ended since
            continue
        worker = "fit" in words and "--checkpoint" in words
        if worker if victim == "fit" else any("bin/snakemake" in word for word in words[:2]):
            child.kill()
    assert run.wait(60) != 0
    assert not (half_done / TARGET).exists()
    output = recovered(half_done, undisturbed)
    if victim == "fit":
        log = half_done / RESULTS / "logs/train/dataset3/random-realisation.log"
        assert "resuming after epoch" in log.read_text()
    else:
        assert "waiting for it to end" in output


# An experiment

EXPERIMENT = """
preset: smoke
datasets: [dataset3, dataset7]
overrides:
  dataset.splits: [random]
  dataset.references: [realisation]
  methods: [noisy, lmmse, dae]
settings:
  paper: {}
  read_noise: {noise.law: gaussian}
  small: {framing.stamp_px: 14}
seeds: [1, 2, 3]
"""


def run_experiment(folder, *words):
    """Arguments of `subprocess` for the target experiment."""
    environment = {"HOME": str(folder), "PATH": PATH, "PYTHONPATH": str(folder / "src")}
    line = ["snakemake", "experiment", *words, "--config", "name=mine"]
    return {"args": line, "cwd": folder, "env": environment | NO_CLUSTER | KERNELS}


def experiment_results(folder):
    """Content of the table, its Markdown, the figure and all products, by name.

    MLflow's ids of runs are random, and copies of files have them in their paths.
    """
    endings = (".md", ".png", ".csv", ".h5", ".safetensors", ".parquet")
    return {
        path.relative_to(folder): path.read_bytes()
        for path in sorted((folder / RESULTS).rglob("*"))
        if path.suffix in endings
        and path.name != "history.csv"
        and path.relative_to(folder / RESULTS).parts[0] not in ("mlflow", "mlartifacts")
    }


def test_a_killed_experiment_ends_in_the_same_files(tmp_path):
    """Three settings, three seeds and two datasets; all processes are killed at once."""
    folders = [copy_of_sources(tmp_path / name) for name in ("undisturbed", "killed")]
    for folder in folders:
        write_text(folder / "config/experiment/mine.yaml", EXPERIMENT)
    run = captured(**run_experiment(folders[0], "--cores", "1"))
    assert run.returncode == 0, run.stdout + run.stderr
    table = pd.read_csv(folders[0] / RESULTS / "experiments/mine/errors.csv")
    # 4 metrics of 3 methods at 4 levels, by 3 settings of 2 datasets.
    assert len(table) == 4 * 3 * 4 * 3 * 2
    assert (table.seeds == 3).all()
    assert table[["value", "stderr", "ratio", "ratio_stderr"]].notna().all().all()
    second = subprocess.Popen(
        **run_experiment(folders[1], "--cores", "1"), **QUIET, start_new_session=True
    )
    evaluations = folders[1] / RESULTS / "evaluation"
    wait_until(lambda: len([*evaluations.rglob("*.csv")]) >= 4, 600, "no evaluation")
    os.killpg(second.pid, signal.SIGKILL)
    second.wait()
    assert len([*evaluations.rglob("*.csv")]) < 18
    for words in (["--unlock"], []):
        again = captured(**run_experiment(folders[1], "--cores", "1", *words))
        assert again.returncode == 0, again.stdout + again.stderr
    expected = experiment_results(folders[0])
    assert len(expected) > 18 * 4
    # In MLflow, a parent and a run for each method of each variant, none twice.
    for folder in folders:
        runs = pd.read_csv(folder / RESULTS / "mlflow/experiment_mine.csv")
        assert runs.action.tolist() == ["created"] * (1 + 3 * 18)
    assert experiment_results(folders[1]) == expected
