"""Benchmarks of the network, the baseline, the trainings, the prediction and of growing sizes."""

from __future__ import annotations

import os
import shutil

import numpy as np
import pandas as pd
import pytest

import commits
import figures
import measure
import prediction
import speed
import trainings
from psfdae.method import TrainingSet
from psfdae.model.bundle import shipped_path
from psfdae.optics.wavefronts import seidel_wavefronts
from psfdae_paper.configuration.compose import load, load_stage
from psfdae_paper.methods.pca_som import Baseline
from psfdae_paper.stars.framing import Propagation, normalise_flux
from workflow_runs import ROOT, planned, snakemake

RECORD = ROOT / "results/reference/tables"
SMALL = ("preset=smoke", "grid.points=3", "optics.threads=1", "benchmark.threads=1")


def columns(name):
    return list(pd.read_csv(RECORD / f"{name}.csv").columns)


# Measuring


def test_rounds_take_turns():
    events = []

    def builder(name):
        return lambda: events.append(f"build {name}") or (lambda: events.append(name))

    assert measure.time_in_rounds([builder("a"), builder("b")], repeats=2).shape == (2, 2)
    assert events == ["build a", "a", "build b", "b"] * 2


def test_two_commits_are_compared_target_by_target():
    """The order of the rows does not count, and a ratio has the scatter of the targets."""
    costs = {"wall_s": [4.0, 2.0, 3.0, 2.0], "cpu_s": [4.0, 2.0, 8.0, 4.0], "job_s": 1.0}
    names = {"commit": ["a", "b", "b", "a"], "target": ["x", "x", "y", "y"]}
    table = pd.DataFrame({**names, **costs, "peak_mb": [1.0, 2.0, 3.0, 4.0]})
    table.loc[2:, "cpu_s"] = [4.0, 8.0]
    said = commits.said(table, "a", "b")
    assert "b over a, targets: x, y" in said
    assert "CPU time 12 -> 6 s: 0.500 ± 0.000" in said
    assert "wall time 6 -> 5 s: 0.833 ± 0.4" in said
    assert "largest job 4 -> 3 MB" in said
    assert "wall time 4 -> 2 s: 0.500\n" in commits.said(table[table.target == "x"], "a", "b")


def test_a_process_of_its_own_has_its_own_threads(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert measure.alone(3, os.getpid) != os.getpid()
    assert measure.alone(3, os.getenv, "OMP_NUM_THREADS") == "3"
    assert os.environ["OMP_NUM_THREADS"] == "1"


def test_what_is_timed_is_the_command_that_users_run(tmp_path):
    """Its product is left behind and its size is that of the files; a refusal is an error."""
    tree, out = load_stage(speed.growth.stage.settings.reads, SMALL).model_dump(), tmp_path / "t.h5"
    cost = measure.cost_of_command(["templates"], out, tree)
    assert cost["disk_b"] == out.stat().st_size
    assert 0 < cost["resting_b"] <= cost["peak_b"]
    with pytest.raises(RuntimeError, match="psfdae stars: ends with 2"):
        measure.cost_of_command(["stars", "--templates", tmp_path / "none.h5"], out, tree)


# Network and baseline


@pytest.mark.slow
def test_engines_run_apart_and_fill_the_table(tmp_path):
    small = ("benchmark.repeats=1", "benchmark.stamp_sizes=[8,10]", "benchmark.stamps=1")
    config = load_stage(speed.inference.stage.settings.reads, [*small, "benchmark.threads=1"])
    config.dae.widths[:] = [2] * len(config.dae.widths)
    speed.inference(config, tmp_path / "t.csv")
    table = pd.read_csv(tmp_path / "t.csv")
    assert list(table.columns) == columns("benchmark_inference")
    assert len(table) == 2 * 3 * 2 * 2  # engines, widths, sides, batches
    assert (table.stars_per_s_low <= table.stars_per_s).all()


def test_grid_has_the_point_in_use_first_and_respects_the_limit():
    grid = trainings.grid_around((20, 11, 11, 10), 256)
    assert grid[0] == (20, 11, 11, 10)
    assert len(set(grid)) == len(grid)
    assert {(40, 11, 11, 10), (20, 15, 15, 10), (20, 11, 11, 50)} <= set(grid)
    assert max(k for k, *_ in trainings.grid_around((8, 4, 4, 2), 10)) == 10


def test_baseline_point_reports_the_error_of_its_predictions(gaussian_stars, noise):
    settings = {"components": 4, "rows": 3, "columns": 3, "epochs": 2, "threads": 1}
    settings |= {"sigma": 1.0, "learning_rate": 0.5, "per_level": True}
    truths = {"realisation": gaussian_stars, "template": 0 * gaussian_stars}
    stars = np.arange(len(gaussian_stars))
    data = TrainingSet(gaussian_stars, gaussian_stars, stars, stars[:0], np.array([1e-5]), noise)
    point = trainings.time_point(data, Baseline(**settings), {1e-5: gaussian_stars}, truths, 2)
    assert 0 < point["mse_realisation"] < (gaussian_stars**2).mean() < 2 * point["mse_template"]


# Growth


def test_a_million_stars_are_extrapolated():
    x = np.array([1e3, 1e4, 1e5])
    rows = {"what": "simulation", "stars": x, "stamp_px": 16, "time_s": 5e-4 * x}
    rows |= {"peak_mb": 80 + 1e-4 * x, "disk_mb": 2e-3 * x}
    table = speed.with_exponents(pd.DataFrame(rows), "stars")
    assert [*table.columns, "threads"] == columns("benchmark_scaling")
    *measured, last = table.itertuples()
    assert {row.measured for row in measured} == {"yes"}
    assert (last.stars, last.measured) == (1_000_000, "extrapolated")
    assert (last.time_s, last.peak_mb, last.disk_mb) == pytest.approx((500, 180, 2000))
    assert (last.exponent, last.exponent_stderr) == pytest.approx((1, 0), abs=1e-9)


def test_both_pages_extrapolate_alike():
    """A start-up of 0.15 s bends the law of powers: from it, a million stars took 56 s once."""
    rows = [
        {"stage": "predict", "what": "inference", "stars": n, "stamp_px": 16, "peak_mb": 9.0}
        | {"disk_mb": 1e-3 * n, "time_s": 0.15 + 8.7e-5 * n, "cpu_s": 0.15 + 8.7e-5 * n}
        for n in (1e3, 1e4, 1e5)
    ]
    few = speed.with_exponents(pd.DataFrame(rows), "stars").iloc[-1]
    (many,) = speed.planned(rows)
    assert few.time_s == pytest.approx(0.15 + 8.7e-5 * 1e6, rel=1e-3)
    assert many["time_s"] / many["stars"] == pytest.approx(few.time_s / few.stars, rel=1e-2)


def test_costs_of_the_plan_have_a_fixed_part_and_one_per_star_that_are_not_negative():
    rows = [
        {"stage": stage, "stars": n, "time_s": 3 + 2e-3 * n, "cpu_s": n**2, "peak_mb": 9 - n**0.1}
        | {"disk_mb": 1e-3 * n}
        for stage in ("simulate", "train")
        for n in (1e2, 1e3, 1e4)
    ]
    first, second = speed.planned(rows)
    assert (first["stage"], second["stage"], first["stars"]) == ("simulate", "train", 1e9)
    assert (first["time_s"], first["disk_mb"]) == pytest.approx((2e6 + 3, 1e6))
    assert first["cpu_s"] > 1e9  # no fixed part below zero
    assert 0 < first["peak_mb"] < 9  # nor a part per star


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="CPUs cannot be chosen here")
def test_the_plan_is_measured_on_one_cpu():
    before = os.sched_getaffinity(0)
    with speed.one_cpu():
        assert len(os.sched_getaffinity(0)) == 1
    assert os.sched_getaffinity(0) == before


# Trainings


def test_front_holds_what_nothing_beats():
    time, error = np.array([4.0, 1.0, 2.0, 3.0, 4.0]), np.array([0.5, 1.0, 0.6, 0.7, 0.4])
    assert measure.pareto(time, error).tolist() == [1, 2, 4]


@pytest.mark.parametrize(
    ("gains", "chosen"),
    [
        ([0.5, 0.5, 0.5], 3),  # every doubling pays
        ([0.5, 0.95, 0.95], 1),  # only the first
        ([0.95, 0.6, 0.95], 2),  # a flat stretch may be crossed for a later gain
        ([0.99, 0.99, 0.99], 0),
    ],
)
def test_knee_is_where_doublings_stop_paying(gains, chosen):
    time, error = 2.0 ** np.arange(4), np.r_[1.0, np.cumprod(gains)]
    shuffled = np.array([2, 0, 3, 1])
    assert shuffled[trainings.knee(time[shuffled], error[shuffled])] == chosen


@pytest.mark.parametrize(
    ("scores", "patience", "stop"),
    [([5, 4, 3, 3.5, 3.2, 3.1, 2], 2, 4), ([5, 4, 3, 2], 2, 3), ([5, 5, 5], 2, 2)],
)
def test_patience_on_a_history(scores, patience, stop):
    assert trainings.stopping_point(np.array(scores, float), patience) == stop


# Prediction


def test_poppy_simulates_the_same_stars():
    """The recipe given to POPPY is ours: independent optics, the same image."""
    config = load_stage(prediction.READS, ["dataset=dataset3"])
    telescope, framing = config.telescope, config.framing
    seidel, field = config.wavefront.coefficients * 1.1, np.array([0.6, -0.4])
    image = prediction.poppy_telescope(telescope, 66)(seidel, field)
    stamp = prediction.framed(image, np.array([1, -1]), framing, 24)
    source = seidel_wavefronts(seidel[None], field[None])
    ours = Propagation(source, telescope, config.optics, framing, 24)
    expected = normalise_flux(ours.framed(16, np.array([[1, -1]]))[0])[0]
    assert np.mean((normalise_flux(stamp[None])[0] - expected) ** 2) < 1e-8


def test_poppy_table(tmp_path, monkeypatch, field_psfs):
    monkeypatch.setattr(prediction, "poppy_stars", lambda config, count: field_psfs[:count])
    config = load_stage(prediction.READS, ["dataset=field"])
    prediction.poppy(config, (shipped_path(),), tmp_path / "out.csv", 300)
    found = pd.read_csv(tmp_path / "out.csv")
    assert found["noise_level"].tolist() == config.noise.levels
    middle = found[found["snr"].between(10, 200)]
    assert len(middle) >= 3 and (middle["met"] == "yes").all()
    assert (middle["ratio_estimated"] > middle["ratio_given"]).all()
    assert middle["coverage_given"].between(0.63, 0.73).all()
    assert middle["coverage95_given"].between(0.92, 0.97).all()


def test_strange_stars_are_made_of_usual_ones(field_psfs):
    """Each kind has flux 1; a companion adds light to the stars and a turn moves it."""
    kinds = prediction.unlike(field_psfs, np.random.default_rng(1))
    assert next(iter(kinds)) == "usual" and kinds["usual"] is not field_psfs
    for images in kinds.values():
        np.testing.assert_allclose(images.sum(axis=(1, 2)), 1.0, rtol=1e-5)
    np.testing.assert_allclose(kinds["turned"], np.rot90(kinds["usual"], axes=(1, 2)), rtol=1e-5)
    light = kinds["companion"] * (1 + prediction.COMPANION_FLUX) - kinds["usual"]
    assert light.min() > -1e-6
    struck = kinds["cosmic ray"] * (1 + prediction.RAY_PX * prediction.RAY_FLUX)
    bright = (struck - kinds["usual"] > 0.5 * prediction.RAY_FLUX).sum(axis=(1, 2))
    assert (bright == prediction.RAY_PX).all()


# Figures and targets


@pytest.mark.parametrize("kind", ["training", "baseline", "inference", "scaling", "graded"])
def test_figures_are_drawn_from_the_tables_of_the_record(kind, tmp_path):
    table = "stability_graded" if kind == "graded" else f"benchmark_{kind}"
    figures.draw(kind, RECORD / f"{table}.csv", tmp_path / "drawn.png")
    assert (tmp_path / "drawn.png").stat().st_size > 10_000


@pytest.mark.workflow
def test_all_methods_are_timed_and_drawn(smoke, tmp_path):
    config = load(["preset=smoke", "dataset=dataset3", "train.epochs=1"])
    stars = smoke / "results/data/seidel/seidel_10pct.h5"
    rows = pd.DataFrame(trainings.time_methods(config.model_dump(), stars))
    assert set(rows.method) == {*config.methods} - {"noisy"}
    assert (rows[["fit_cpu_s", "stars_per_s", "mse"]] > 0).all().all()
    rows.to_csv(tmp_path / "table.csv", index=False)
    figures.draw("methods", tmp_path / "table.csv", tmp_path / "drawn.png")
    assert (tmp_path / "drawn.png").stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.workflow
def test_targets_on_request(smoke, tmp_path):
    # Other tests want the folder as the default target leaves it.
    folder = shutil.copytree(smoke, tmp_path / "run", symlinks=True)
    snakemake(folder, "prediction", "scaling", "seeds")
    tables = {p.stem: pd.read_csv(p) for p in (folder / "results/tables").glob("*.csv")}
    for name in ("predict_throughput", "scaling_stages"):
        assert list(tables[name].columns) == columns(name)
    poppy = tables["predict_poppy"]
    assert set(poppy.method) == {"dae", "gmm"}
    assert poppy.bundle.nunique() == 2
    assert poppy.coverage95_given.notna().all()
    cover = tables["predict_coverage"]
    assert set(cover.bundle) == {*poppy.bundle, "example"}
    assert (cover.groupby(["bundle", "noise_level"]).pixels.nunique() == 2).all()
    field = cover.query("bundle == 'example'")
    assert field.coverage68.between(0.6, 0.76).all()
    assert field.coverage95.between(0.9, 0.98).all()
    usual = tables["predict_strange"].query("kind == 'usual'")
    assert (usual.found - usual.false_alarms).abs().max() < 0.02
    (row,) = tables["predict_throughput"].to_dict("records")
    assert row["stamps"] == 64
    assert row["share"] == pytest.approx(row["predict_per_s"] / row["bare_per_s"], rel=1e-4)
    stages = tables["scaling_stages"]
    fits = {"baseline", "train", "fit_gmm", "fit_gmm_position"}
    assert set(stages.stage) == {"simulate", *fits, "evaluate", "predict"}
    assert (stages[["time_s", "cpu_s", "peak_mb", "disk_mb"]] > 0).all().all()
    seeds = tables["seed_scatter"].set_index(["dataset", "reference", "method"])
    assert set(seeds.seeds) == {5}
    assert len(seeds) == 3 * len(load(["dataset=dataset3"]).methods)
    draws = ~seeds.index.get_level_values("method").isin(["noisy", "lmmse"])
    assert ((seeds.scatter > 0) == draws).all()
    errors = pd.read_csv(folder / "results/seeds/dataset3/dae.csv").query("seed == seed.min()")
    known = tables["psf_metrics"].query("metric == 'mse' and split == 'random'")
    both = errors.merge(known, on=["dataset", "reference", "method", "noise_level"])
    assert both.mse.to_numpy() == pytest.approx(both.value.to_numpy(), rel=1e-5)
    renewed = pd.read_csv(folder / "src/psfdae_paper/evaluation/seed_scatter.csv")
    assert renewed.equals(tables["seed_scatter"])
    assert planned(folder, "prediction", "scaling", "seeds") == {}
