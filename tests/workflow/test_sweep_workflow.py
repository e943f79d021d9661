"""Sweeps on the real DAG: killed, resumed, grown, and repeated by the main workflow."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pandas as pd
import pytest
import yaml

from psfdae_paper.configuration.compose import config_dir
from psfdae_paper.stages.sweep_summary import best_overrides
from workflow_runs import (
    QUIET,
    locked,
    planned,
    snakemake,
    wait_until,
)

pytestmark = [pytest.mark.workflow, pytest.mark.slow]

GRID = {
    **{"kind": "grid", "model": "dae", "dataset": "dataset3"},
    **{"metric": "validation_mse", "direction": "minimize", "overrides": {"train.epochs": 2}},
    "space": {
        "width": {"keys": ["dae.widths"], "values": [4, 5], "repeat": 9},
        "train.lr": [0.002, 0.008],
    },
}
SUMMARY = "results/sweeps/tried/summary.csv"


@pytest.fixture(scope="module")
def configure(tmp_path_factory):
    """A copy of the configuration with a sweep, used by every command below."""
    folder = tmp_path_factory.mktemp("sweeps") / "config"
    shutil.copytree(config_dir(), folder)

    def write(**changes):
        text = yaml.safe_dump({"tried": GRID | changes}, sort_keys=False)
        (folder / "sweep/tried.yaml").write_text(text)

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PSFDAE_CONFIG", str(folder))
        yield write


def finished(folder):
    """Points with a result, and the times when their training ended."""
    points = Path(folder, "results/sweeps/tried/points").glob("*/result.json")
    return {path.parent.name: path.with_name("cost.json").stat().st_mtime_ns for path in points}


def has_noted_a_point(folder):
    """Snakemake has written that a point is finished, and will not repeat it."""
    logs = Path(folder, ".snakemake/log").glob("*.log")
    return any(re.search(r"^Finished jobid.*sweep_point", log.read_text(), re.M) for log in logs)


@pytest.fixture(scope="module")
def killed(smoke, configure, tmp_path_factory):
    """A sweep of four points, killed after the first and started again: folder, points before."""
    folder = shutil.copytree(smoke, tmp_path_factory.mktemp("killed") / "run", symlinks=True)
    configure()
    run = subprocess.Popen(**locked(folder, SUMMARY), **QUIET)
    wait_until(lambda: has_noted_a_point(folder) or run.poll() is not None, 300, "no point is done")
    assert run.poll() is None, "the sweep ended too early"
    run.kill()
    run.wait()
    first = finished(folder)
    assert not (folder / SUMMARY).exists()
    subprocess.run(**locked(folder, SUMMARY), check=True, capture_output=True)
    return folder, first


def test_killed_sweep_is_finished_and_keeps_finished_points(killed):
    folder, first = killed
    final = finished(folder)
    assert len(final) == 4
    # Points in whose last moments Snakemake was killed may be repeated.
    assert any(final[point] == ended for point, ended in first.items())
    table = pd.read_csv(folder / SUMMARY)
    assert set(table.point) == set(final)
    assert (table.status == "finished").all()
    best_row = table[table.best == "yes"].iloc[0]
    assert best_row.validation_mse == table.validation_mse.min()


def test_main_workflow_repeats_the_best_point_to_the_last_digit(killed):
    folder, _ = killed
    overrides = " ".join(best_overrides(folder / "results", "tried"))
    best_point = yaml.safe_load((folder / "results/sweeps/tried/best.yaml").read_text())
    point = folder / "results/sweeps/tried/points" / best_point["point"]
    name = "results/evaluation/dataset3/random-realisation.csv"
    snakemake(folder, name, overrides=overrides)
    rows = [line for line in (folder / name).read_text().splitlines() if ",dae," in line]
    assert rows == (point / "evaluation.csv").read_text().splitlines()[1:]
    weights = folder / "results/dae/dataset3/random-realisation/dae.safetensors"
    assert weights.read_bytes() == (point / "dae.safetensors").read_bytes()


def test_new_value_runs_its_points_only(killed, configure):
    folder, _ = killed
    rates = [0.001, *GRID["space"]["train.lr"]]
    configure(space={"train.lr": rates, "width": GRID["space"]["width"]})
    assert planned(folder, SUMMARY) == {"sweep_point": 2, "sweep_summary": 1}
    configure(metric="validation_ssim", direction="maximize")
    assert planned(folder, SUMMARY) == {"sweep_summary": 1}
