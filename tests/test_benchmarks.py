"""Benchmarks: optics beside other programs, error budgets in use, and the tables on request."""

from __future__ import annotations

import shutil

import numpy as np
import pandas as pd
import pytest

import figures
import prediction
import propagators
import scenes
import speed
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.wavefronts import seidel_wavefronts
from psfdae_paper.configuration.compose import load, load_stage
from psfdae_paper.stars.framing import Propagation, normalise_flux
from workflow_runs import ROOT, planned, snakemake

RECORD = ROOT / "results/reference/tables"
COMATIC, FIELD = np.array([0.3, 0.8, 0.6, 0.4, -0.1]), np.array([0.6, -0.4])


# Optics


@pytest.fixture(scope="module")
def case():
    """A comatic star well off the chief ray, with its exact stamp."""
    source, fine = seidel_wavefronts(COMATIC[None], FIELD[None]), annular_pupil(512, 0.3)
    offset = np.array([[3, -5]])
    exact = StampPropagator(fine, 10, 0.88, extra=16)
    opd = source.opd(np.zeros(1, int), fine, np.dtype(float))
    truth = normalise_flux(exact(opd, offset))[0][0]
    return scenes.Case("seidel", "mild", source, offset, 160, 10, 0.88, 0.3, 1e-9, truth)


@pytest.mark.parametrize("method", ["fft", "fft_pruned", "poppy_mft", "poppy_fresnel", "hcipy"])
def test_peers_converge_to_our_stamp_with_their_subsamples(case, method):
    """Same orientation, same place, and an error that falls as 1/subsamples²."""

    def error(subsamples):
        setting = propagators.Setting(method, case.samples, subsamples)
        _, propagate = propagators.build(case, setting)
        return scenes.relative_to_peak(propagate(), case.truth)

    coarse, fine = error(4), error(8)
    assert fine < 2.5e-3
    assert coarse / fine == pytest.approx(4.0, rel=0.2)


def test_poppy_simulates_the_same_stars():
    """The recipe given to POPPY is ours: independent optics, the same image."""
    config = load_stage(prediction.READS, ["dataset=dataset3"])
    telescope, framing = config.telescope, config.framing
    seidel = config.wavefront.coefficients * 1.1
    image = prediction.poppy_telescope(telescope, 66)(seidel, FIELD)
    stamp = prediction.framed(image, np.array([1, -1]), framing, 24)
    source = seidel_wavefronts(seidel[None], FIELD[None])
    ours = Propagation(source, telescope, config.optics, framing, 24)
    expected = normalise_flux(ours.framed(16, np.array([[1, -1]]))[0])[0]
    assert np.mean((normalise_flux(stamp[None])[0] - expected) ** 2) < 1e-8


@pytest.mark.parametrize(
    ("dataset", "worst_stars"),
    [("dataset4", [7144, 642, 6364, 3655]), ("dataset7", [286, 365, 157])],
)
def test_configured_optics_stay_within_the_error_budget(dataset, worst_stars):
    """Datasets whose stars must fit the least noise; `screen` finds their worst stars."""
    scene = scenes.Scene.of(load_stage(scenes.READS, [f"dataset={dataset}"]))
    selection = scenes.Selection(scene.stars, np.array(worst_stars))
    stamps, offset = scene.propagation(selection, scene.search_px).framed(scene.framing.stamp_px)
    exact = scenes.stamps_at(scene, selection, offset, *scenes.REFERENCES[-1])
    assert scenes.stamp_mse(normalise_flux(stamps)[0], exact).max() <= scene.budget


# Tables


def test_pages_extrapolate_alike():
    """A start-up of 0.15 s bends the law of powers: from it, a million stars took 56 s once."""
    rows = [
        {"stage": "predict", "what": "inference", "stars": n, "stamp_px": 16, "peak_mb": 9.0}
        | {"disk_mb": 1e-3 * n, "time_s": 0.15 + 8.7e-5 * n, "cpu_s": 0.15 + 8.7e-5 * n}
        for n in (1e3, 1e4, 1e5)
    ]
    million = speed.with_exponents(pd.DataFrame(rows), "stars").iloc[-1]
    (billion,) = speed.planned(rows)
    assert million.time_s == pytest.approx(0.15 + 8.7e-5 * 1e6, rel=1e-3)
    assert billion["time_s"] / billion["stars"] == pytest.approx(million.time_s / 1e6, rel=1e-2)


def test_training_figure_is_drawn_from_the_table_of_the_record(tmp_path):
    figures.draw("training", RECORD / "benchmark_training.csv", tmp_path / "drawn.png")
    assert (tmp_path / "drawn.png").stat().st_size > 10_000


@pytest.fixture(scope="module")
def on_request(smoke, tmp_path_factory):
    """A copy of the smoke run, which other tests want as the default target leaves it."""
    folder = shutil.copytree(smoke, tmp_path_factory.mktemp("request") / "run", symlinks=True)
    # It knows where the results lay; the next import makes another.
    (folder / "results/mlflow.db").unlink()
    return folder


@pytest.mark.slow
@pytest.mark.workflow
@pytest.mark.parametrize("target", ["benchmark", "stability", "bounds", "prediction", "scaling"])
def test_target_on_request_writes_the_tables_of_the_record(on_request, target):
    tables = on_request / "results/tables"
    before = {path.name for path in tables.iterdir()}
    snakemake(on_request, target)
    made = {path.name for path in tables.glob("*.csv")} - before
    assert made
    for name in made:
        assert list(pd.read_csv(tables / name)) == list(pd.read_csv(RECORD / name)), name
    if target == "stability":
        assert (pd.read_csv(tables / "stability.csv").verdict == "pass").all()
    if target == "prediction":
        coverage = pd.read_csv(tables / "predict_coverage.csv").query("bundle == 'example'")
        assert coverage.coverage68.between(0.6, 0.76).all()
        assert coverage.coverage95.between(0.9, 0.98).all()
    assert planned(on_request, target) == {}


@pytest.mark.slow
@pytest.mark.workflow
def test_scatter_of_seeds_is_that_of_networks_and_repeats_the_table(on_request):
    snakemake(on_request, "seeds")
    tables = on_request / "results/tables"
    seeds = pd.read_csv(tables / "seed_scatter.csv").set_index(["dataset", "reference", "method"])
    assert set(seeds.seeds) == {5}
    assert len(seeds) == 3 * len(load(["dataset=dataset3"]).methods)
    drawn = ~seeds.index.get_level_values("method").isin(["noisy", "lmmse"])
    assert ((seeds.scatter > 0) == drawn).all()
    errors = pd.read_csv(on_request / "results/seeds/dataset3/dae.csv").query("seed == seed.min()")
    metrics = pd.read_csv(tables / "psf_metrics.csv").query("metric == 'mse' and split == 'random'")
    both = errors.merge(metrics, on=["dataset", "reference", "method", "noise_level"])
    assert both.mse.to_numpy() == pytest.approx(both.value.to_numpy(), rel=1e-5)
