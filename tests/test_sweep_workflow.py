"""Sweeps on the real DAG: killed, resumed, grown, and repeated by the main workflow."""

from __future__ import annotations

import shlex
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
    command,
    environment,
    job_counts,
    locked,
    planned,
    snakemake,
    wait_until,
)

pytestmark = pytest.mark.workflow

GRID = {
    **{"kind": "grid", "model": "dae", "dataset": "dataset3"},
    **{"metric": "validation_mse", "direction": "minimize", "overrides": {"train.epochs": 2}},
    "space": {
        "width": {"keys": ["dae.widths"], "values": [4, 5, 6], "repeat": 9},
        "train.lr": [0.002, 0.004, 0.008, 0.016],
    },
}
SUMMARY = "results/sweeps/tried/summary.csv"


@pytest.fixture(scope="module")
def configuration(tmp_path_factory):
    """A copy of the configuration with a sweep of its own, used by every command below."""
    folder = tmp_path_factory.mktemp("sweeps") / "config"
    shutil.copytree(config_dir(), folder)
    patch = pytest.MonkeyPatch()
    patch.setenv("PSFDAE_CONFIG", str(folder))

    def write(tree):
        (folder / "sweep/tried.yaml").write_text(yaml.safe_dump(tree, sort_keys=False))

    write(GRID)
    yield write
    patch.undo()


def finished(folder):
    """Points with a result, and when their training ended."""
    points = Path(folder, "results/sweeps/tried/points").glob("*/result.json")
    return {path.parent.name: path.with_name("cost.json").stat().st_mtime_ns for path in points}


@pytest.fixture(scope="module")
def killed(configuration, tmp_path_factory):
    """A sweep of 12 points, killed in the middle and started again: folder, points before."""
    folder = tmp_path_factory.mktemp("killed")
    run = subprocess.Popen(**locked(folder, SUMMARY), **QUIET)
    wait_until(lambda: len(finished(folder)) >= 4 or run.poll() is not None, 300, "too slow")
    assert run.poll() is None, "the sweep ended too early"
    run.kill()
    run.wait()
    before = finished(folder)
    assert 4 <= len(before) < 12
    assert not (folder / SUMMARY).exists()
    subprocess.run(**locked(folder, SUMMARY), check=True, capture_output=True)
    return folder, before


@pytest.mark.slow
def test_killed_sweep_is_finished_and_repeats_no_finished_point(killed):
    folder, before = killed
    after = finished(folder)
    assert len(after) == 12
    assert {name: after[name] for name in before} == before
    table = pd.read_csv(folder / SUMMARY)
    assert set(table.point) == set(after)
    assert (table.status == "finished").all()
    assert table.notna().drop(columns="reason").all().all()
    chosen = table[table.best == "yes"].iloc[0]
    assert chosen.validation_mse == table.validation_mse.min()
    assert planned(folder, SUMMARY) == {}


@pytest.mark.slow
def test_main_workflow_repeats_the_best_point_to_the_last_digit(killed):
    folder, _ = killed
    overrides = " ".join(best_overrides(folder / "results", "tried"))
    best = yaml.safe_load((folder / "results/sweeps/tried/best.yaml").read_text())
    point = folder / "results/sweeps/tried/points" / best["point"]
    name = "results/evaluation/dataset3/random-realisation.csv"
    snakemake(folder, name, overrides=overrides)
    rows = [line for line in (folder / name).read_text().splitlines() if ",dae," in line]
    assert rows == (point / "evaluation.csv").read_text().splitlines()[1:]
    weights = folder / "results/dae/dataset3/random-realisation/dae.safetensors"
    assert weights.read_bytes() == (point / "dae.safetensors").read_bytes()
    assert shlex.split(overrides)[0].startswith("dae.widths=[")


@pytest.mark.slow
def test_new_value_runs_its_own_points_only(killed, configuration):
    folder, _ = killed
    wider = {**GRID["space"], "train.lr": [0.001, *GRID["space"]["train.lr"]]}
    try:
        configuration({**GRID, "space": wider})
        assert planned(folder, SUMMARY) == {"sweep_point": 3, "sweep_summary": 1}
        reordered = dict(reversed(GRID["space"].items()))
        configuration({**GRID, "space": reordered})
        assert "sweep_point" not in planned(folder, SUMMARY)
        configuration({**GRID, "metric": "validation_ssim", "direction": "maximize"})
        assert planned(folder, SUMMARY) == {"sweep_summary": 1}
    finally:
        configuration(GRID)


@pytest.mark.slow
def test_adaptive_sweep_goes_on_where_it_was(killed, configuration, tmp_path):
    source, _ = killed
    shutil.copytree(source / "results/data", tmp_path / "results/data")
    tree = {**GRID, "kind": "adaptive", "trials": 3, "startup": 2, "seed": 1}
    try:
        configuration(tree)
        snakemake(tmp_path, SUMMARY)
        before = finished(tmp_path)
        assert len(before) == 3
        configuration({**tree, "trials": 4})
        assert planned(tmp_path, SUMMARY) == {"sweep_point": 1, "sweep_summary": 1}
        snakemake(tmp_path, SUMMARY)
    finally:
        configuration(GRID)
    after = finished(tmp_path)
    assert len(after) == 4
    assert {name: after[name] for name in before} == before


@pytest.mark.slow
def test_sweep_lists_its_points_figures_and_import(tmp_path, monkeypatch):
    monkeypatch.delenv("PSFDAE_CONFIG", raising=False)
    for name, points in (("dae_width", 12), ("som", 12)):
        line = [*command(tmp_path, "--dry-run", "sweep"), f"sweep={name}"]
        run = subprocess.run(line, env=environment(), capture_output=True, text=True, check=True)
        jobs = job_counts(run.stdout)
        assert jobs["sweep_point"] == points
        assert (jobs["figure_sweep"], jobs["track_sweep"]) == (2, 1)
        assert not {"train", "baseline", "evaluate"} & set(jobs)


@pytest.mark.parametrize(
    ("chosen", "message"),
    [([], "which sweep? --config sweep=NAME, one of"), (["sweep=none"], "sweep = 'none': must be")],
)
def test_wrong_choice_of_a_sweep_is_named(tmp_path, chosen, message):
    run = subprocess.run(
        [*command(tmp_path, "sweep"), *chosen],
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode != 0
    assert message in run.stdout + run.stderr
    assert not (tmp_path / "results").exists()
