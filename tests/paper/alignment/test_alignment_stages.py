"""Scene 3 by its workflow, on tiny sizes: states, networks, tables, runs, and refusals."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from command_line import psfdae
from psfdae.base.files import ProductError, read_product
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.configuration.estimators import ESTIMATORS, list_estimators, list_trained_networks
from psfdae_paper.evaluation import alignment_tables
from psfdae_paper.stages.alignment import states
from psfdae_paper.tracking import read_alignment_runs

pytestmark = pytest.mark.workflow

TRAINING = ("--states=x.h5", "--checkpoint=c", "--out=o")


COVARIANCE = np.array([[4, 0, 0, -3], [0, 4, 3, 0], [0, 3, 4, 0], [-3, 0, 0, 4]]) * 1e-4
ERRORS = np.random.default_rng(0).multivariate_normal(np.zeros(4), COVARIANCE, 4000)
CELL = {"test_set": "uniform", "noise_level": 0.002}


def test_rows_of_errors_and_bounds_agree_on_normal_errors():
    key, unit = {**CELL, "method": "dae"}, np.array([1e-3, 1e-3, 2e-3, 2e-3])
    table = pd.DataFrame(alignment_tables.tabulate_errors(key, ERRORS, unit))
    assert list(table.columns) == [
        *("test_set", "noise_level", "method", "parameter", "mean_abs_error", "bias"),
        *("variance", "variance_abs", "unit", "n"),
    ]
    assert len(table) == 8
    ranges = table[table.unit == "range"].set_index("parameter")
    metres = table[table.unit == "m"].set_index("parameter")
    assert metres.mean_abs_error["decenter_x"] == pytest.approx(
        1e-3 * ranges.mean_abs_error["decenter_x"]
    )
    assert metres.variance["decenter_y"] == pytest.approx(1e-6 * ranges.variance["decenter_y"])
    covariances = np.broadcast_to(COVARIANCE, (5, 4, 4))
    bound = pd.DataFrame(alignment_tables.tabulate_bounds(key, covariances, unit))
    expected = bound[bound.unit == "range"].set_index("parameter")
    # Of normal errors, whose absolute values have the mean σ √(2/π) and 1 − 2/π of the variance.
    assert expected.mean_abs_error.to_numpy() == pytest.approx(0.02 * np.sqrt(2 / np.pi))
    assert expected.variance_abs.to_numpy() == pytest.approx(4e-4 * (1 - 2 / np.pi))
    assert ranges.mean_abs_error.to_numpy() == pytest.approx(expected.mean_abs_error, rel=0.05)
    assert ranges.variance_abs.to_numpy() == pytest.approx(expected.variance_abs, rel=0.1)


def test_measured_correlations_are_those_predicted():
    errors, covariances = ERRORS[:600], np.broadcast_to(COVARIANCE, (600, 4, 4))
    correlations = alignment_tables.correlate_errors(errors)
    measured = pd.DataFrame(alignment_tables.tabulate_correlations(CELL, *correlations))
    predicted = pd.DataFrame(alignment_tables.tabulate_bound_correlations(CELL, covariances))
    assert len(measured) == 16
    pooled = predicted[predicted.method == "cramer_rao_pooled"].reset_index(drop=True)
    assert pooled.correlation[[3, 6]].tolist() == pytest.approx([-0.75, 0.75])
    off = measured.parameter_a != measured.parameter_b
    assert (measured.ci_low[off] < pooled.correlation[off]).mean() > 0.8
    assert (measured.ci_high[off] > pooled.correlation[off]).mean() > 0.8
    assert pooled.ci_low[3] < -0.75 < pooled.ci_high[3]


@pytest.fixture(scope="module")
def results(smoke):
    return smoke / "results"


def alignment_table(results, name):
    return pd.read_csv(results / f"tables/alignment_{name}.csv")


def test_sets_of_states(results):
    grid, uniform, train = (
        read_product(results / f"data/alignment/{name}.h5", "alignment_states")
        for name in ("grid", "uniform", "train")
    )
    assert sorted(set(grid["states"].ravel())) == [-1, 1]
    assert train["zernikes"].shape == (40, 9, 19)
    assert np.abs(train["states"]).max() <= 1
    assert not np.isin(uniform["states"], train["states"]).any()
    for product, count in ((grid, 16), (uniform, 12), (train, 40)):
        assert product["stamps"].shape == (count, 9, 16, 16)
        assert product["stamps"].dtype == np.float32
        assert product["stamps"].sum(axis=(2, 3)) == pytest.approx(1, abs=1e-5)
        assert product["unit"] == pytest.approx([1e-3, 1e-3, *np.deg2rad([0.1, 0.1])])
        assert product["noll"].tolist() == list(range(4, 23))


def test_key_figures(results):
    value = alignment_table(results, "telescope").set_index("quantity").value
    assert value["pixel"] == pytest.approx(7.27, abs=0.01)
    assert value["lambda_over_d"] == pytest.approx(0.0825, abs=1e-4)
    assert value["sensitivity_condition"] == pytest.approx(3.05, abs=0.02)
    assert value["defocus_centre"] == pytest.approx(0.32, abs=0.01)
    assert value["defocus_edge"] == pytest.approx(0.36, abs=0.01)
    assert value["model_rms_greatest"] < 5e-4
    assert value["energy_least_uniform"] > 0.99


def test_same_configuration_gives_the_same_bytes(results, tmp_path):
    for name, override in (("again", "optics.threads=1"), ("other", "seed=1")):
        words = (*Alignment.choice, "preset=smoke", override)
        config = load_stage(states.stage.settings.reads, words)
        states(config, "uniform", tmp_path / f"{name}.h5")
    first, repeated, with_other_seed = (
        read_product(path, "alignment_states")
        for path in (
            results / "data/alignment/uniform.h5",
            tmp_path / "again.h5",
            tmp_path / "other.h5",
        )
    )
    assert all((first[name] == repeated[name]).all() for name in first.arrays)
    assert not np.isin(with_other_seed["states"], first["states"]).any()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["alignment", "model", "--out=x.h5", "dataset=dataset3"], "dataset=alignment"),
        (["config", "--stage", "templates", "dataset=alignment"], "no simulated stars"),
        (
            ["config", "dataset=alignment", "telescope=example_zernike"],
            "zernike: brings its own",
        ),
        (["config", "dataset=alignment", "~prescription.secondary"], "behind a secondary"),
        (["alignment", "model", "--out=x.h5", "alignment.field_radius_deg=0.8"], "field (0.8, 0)°"),
        (["alignment", "train-network", "--kind=dae_retrained", *TRAINING], "--dae"),
    ],
)
def test_words_that_do_not_fit_scene_3_are_refused(words, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = psfdae(*words)
    assert result.exit_code == 2
    assert message in result.output.splitlines()[-1]
    assert not list(tmp_path.glob("*.h5"))


def test_tables_hold_every_method(results):
    """Flux and place are free for uniform states only."""
    errors = alignment_table(results, "errors")
    everyone = set(ESTIMATORS) - {"cramer_rao_pooled"}
    with_free_flux = {name for name in everyone if name.endswith("_free")}
    for (kind, level), rows in errors.groupby(["test_set", "noise_level"]):
        assert (rows.groupby("method").size() == 8).all()
        noisy = everyone if kind == "uniform" else everyone - with_free_flux
        clean = {"constant", *(method.name for method in list_estimators("estimates"))}
        assert set(rows.method) == (noisy if level else clean)
    assert set(errors.noise_level) == {0, 0.002, 0.005}


def test_paper_s_rows_stand_beside_ours(results):
    table = alignment_table(results, "paper_0.005")
    paper = table[(table.source == "paper") & (table.quantity == "mean")].set_index("method")
    assert paper.decenter_y.to_dict() == {"original": 0.802, "dae": 0.0262}
    text = (results / "tables/alignment_paper_correlation.md").read_text()
    assert "| 0.379 " in text


def test_twin_is_closer_in_focus(results):
    table = alignment_table(results, "twin")
    at_twin = table[np.isclose(table.position, -1) & np.isclose(table.noise_level, 0.002)]
    chi2 = at_twin.set_index("defocus_mm").chi2
    assert chi2[0.2] > 10 * chi2[0.0]
    at_the_state = table[np.isclose(table.position, 1)]
    assert at_the_state.chi2.to_numpy() == pytest.approx(0, abs=1e-6)


def test_networks_are_runs_with_their_curves_and_errors(results, tmp_path):
    runs = {run.key[0]: run for run in read_alignment_runs(results)}
    assert set(runs) == {"dae", *list_trained_networks()}
    for kind, run in runs.items():
        history = pd.read_csv(results / "alignment" / kind / "history.csv")
        curve = "train_mse" if kind == "dae" else "loss"
        assert float(run.epochs[1][curve]) == history[curve][1]
        assert "uniform_tilt_x_bias_0.002" in run.metrics
    with pytest.raises(ProductError, match=r"alignment_errors\.csv: no such file"):
        read_alignment_runs(tmp_path)
