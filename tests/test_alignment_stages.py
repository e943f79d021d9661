"""Stages of scene 3 by the command line, on tiny sizes: states, networks, tables, figures."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from command_line import psfdae, refused
from psfdae.files import read_product
from psfdae_paper.configuration.aligners import (
    ALIGNERS,
    ESTIMATORS,
    FITTED,
    LEARNED,
    TRAINED,
    of_set,
)
from psfdae_paper.configuration.alignment import CHOICE
from psfdae_paper.configuration.compose import load, load_stage, overrides_for
from psfdae_paper.evaluation import alignment_tables
from psfdae_paper.stages.alignment import states
from psfdae_paper.stages.alignment_results import read_bounds

PRESET = ("preset=smoke", "alignment.grid_levels=2")
TRAINING = ("--states=x.h5", "--checkpoint=c", "--out=o")


COVARIANCE = np.array([[4, 0, 0, -3], [0, 4, 3, 0], [0, 3, 4, 0], [-3, 0, 0, 4]]) * 1e-4
ERRORS = np.random.default_rng(0).multivariate_normal(np.zeros(4), COVARIANCE, 4000)
CELL = {"test_set": "uniform", "noise_level": 0.002}


def test_rows_of_errors_and_bounds_agree_on_normal_errors():
    key, unit = {**CELL, "method": "dae"}, np.array([1e-3, 1e-3, 2e-3, 2e-3])
    table = pd.DataFrame(alignment_tables.error_rows(key, ERRORS, unit))
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
    bound = pd.DataFrame(alignment_tables.bound_rows(key, covariances, unit))
    expected = bound[bound.unit == "range"].set_index("parameter")
    # Of normal errors, whose absolute values have the mean σ √(2/π) and 1 − 2/π of the variance.
    assert expected.mean_abs_error.to_numpy() == pytest.approx(0.02 * np.sqrt(2 / np.pi))
    assert expected.variance_abs.to_numpy() == pytest.approx(4e-4 * (1 - 2 / np.pi))
    assert ranges.mean_abs_error.to_numpy() == pytest.approx(expected.mean_abs_error, rel=0.05)
    assert ranges.variance_abs.to_numpy() == pytest.approx(expected.variance_abs, rel=0.1)


def test_measured_correlations_are_those_predicted():
    errors, covariances = ERRORS[:600], np.broadcast_to(COVARIANCE, (600, 4, 4))
    measured = pd.DataFrame(alignment_tables.measured_correlations(CELL, errors))
    predicted = pd.DataFrame(alignment_tables.predicted_correlations(CELL, covariances))
    assert len(measured) == 16
    pooled = predicted[predicted.method == "cramer_rao_pooled"].reset_index(drop=True)
    assert pooled.correlation[[3, 6]].tolist() == pytest.approx([-0.75, 0.75])
    off = measured.parameter_a != measured.parameter_b
    assert (measured.ci_low[off] < pooled.correlation[off]).mean() > 0.8
    assert (measured.ci_high[off] > pooled.correlation[off]).mean() > 0.8
    assert pooled.ci_low[3] < -0.75 < pooled.ci_high[3]


def _run(*arguments):
    result = psfdae("alignment", *arguments)
    assert result.exit_code == 0, result.output


@pytest.fixture(scope="module")
def products(tmp_path_factory):
    """Model, states and key figures."""
    at = tmp_path_factory.mktemp("scene3")
    model = ("--model", at / "model.h5")
    _run("model", "--out", at / "model.h5", *PRESET)
    for kind in ("grid", "uniform", "train"):
        given = model if kind == "train" else ()
        _run("states", "--set", kind, "--out", at / f"{kind}.h5", *given, *PRESET)
    sets = ("--grid", at / "grid.h5", "--uniform", at / "uniform.h5")
    _run("telescope", *model, *sets, "--out", at / "telescope.csv", *PRESET)
    return at


@pytest.fixture(scope="module")
def tables(products):
    """Networks, estimates, fits and bounds of the uniform states, and their tables."""
    at = products
    data = ("--grid", at / "grid.h5", "--train", at / "train.h5", "--checkpoint", at / "c")
    _run("train-dae", *data, "--out", at / "dae", *PRESET)
    for name in TRAINED:
        given = ("--kind", name, "--states", at / f"{ALIGNERS[name].states}.h5")
        given += ("--dae", at / "dae") if ALIGNERS[name].denoised else ()
        _run("train-network", *given, "--checkpoint", at / "c", "--out", at / name, *PRESET)
    networks = [w for n in ("dae", *TRAINED) for w in (f"--{n.replace('_', '-')}", at / n)]
    test = ("--set", "uniform", "--states", at / "uniform.h5")
    model = ("--model", at / "model.h5")
    times = ("--times", at / "estimates.csv")
    _run("estimate", *test, *networks, "--out", at / "estimates.h5", *times, *PRESET)
    _run("bound", *test, *model, "--out", at / "bound.h5", *PRESET)
    given = ["--estimates", at / "estimates.h5", "--bound", at / "bound.h5"]
    fit = ("fit", *test, *model, "--train", at / "train.h5", "--network", at / "noise_trained")
    for level in ("0.002", "0.005"):
        out = at / f"fit_{level}.h5"
        outputs = ("--out", out, "--times", out.with_suffix(".csv"))
        _run(*fit, "--level", level, *outputs, *PRESET, "fit.iterations=1")
        given += ["--fit", out]
    out = ("--errors", at / "errors.csv", "--correlation", at / "correlation.csv")
    _run("tables", "--states", at / "uniform.h5", *given, *out)
    return at


def test_sets_of_states(products):
    grid, uniform, train = (
        read_product(products / f"{name}.h5", "alignment_states")
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
        assert product.config["seed"] == 20200611


def _states_config(*overrides):
    return load_stage(states.stage.settings.reads, (*CHOICE, *PRESET, *overrides))


def test_model_and_rays_give_the_same_training_stamps(products, tmp_path):
    states(_states_config(), "train", tmp_path / "traced.h5")
    traced, modelled = (
        read_product(path, "alignment_states")
        for path in (tmp_path / "traced.h5", products / "train.h5")
    )
    assert (traced["states"] == modelled["states"]).all()
    assert np.abs(traced["zernikes"] - modelled["zernikes"]).max() < 5e-4
    assert modelled["stamps"] == pytest.approx(traced["stamps"], abs=1e-3)


def test_key_figures(products):
    table = pd.read_csv(products / "telescope.csv").set_index("quantity")
    assert list(table.columns) == ["value", "unit"]
    value = table["value"]
    assert value["pixel"] == pytest.approx(7.27, abs=0.01)
    assert value["lambda_over_d"] == pytest.approx(0.0825, abs=1e-4)
    assert value["sensitivity_condition"] == pytest.approx(3.05, abs=0.02)
    assert value["defocus_centre"] == pytest.approx(0.32, abs=0.01)
    assert value["defocus_edge"] == pytest.approx(0.36, abs=0.01)
    assert value["model_rms_greatest"] < 5e-4
    assert value["energy_least_uniform"] > 0.99


def test_same_configuration_gives_the_same_bytes(products, tmp_path):
    states(_states_config("optics.threads=1"), "uniform", tmp_path / "again.h5")
    one, two = (
        read_product(path, "alignment_states")
        for path in (tmp_path / "again.h5", products / "uniform.h5")
    )
    assert all((one[name] == two[name]).all() for name in one.arrays)
    states(_states_config("seed=1"), "uniform", tmp_path / "other.h5")
    other = read_product(tmp_path / "other.h5", "alignment_states")
    assert not np.isin(other["states"], one["states"]).any()


@pytest.mark.parametrize(
    ("preset", "states", "schedule"),
    [("fast", 625, "onecycle"), ("paper", 625, "constant"), ("smoke", 12, "onecycle")],
)
def test_presets_reach_scene_3(preset, states, schedule):
    config = load((*CHOICE, f"preset={preset}"))
    assert (config.alignment.test_states, config.dae_train.schedule) == (states, schedule)
    assert "backend" not in config.model_dump()["optics"]


def test_scene_3_keeps_its_telescope_where_a_whole_run_gets_another():
    given = ["preset=smoke", "noise.kappa=5", "train.lr=1e-3", "stars.count=9"]
    given += ["telescope=wfsat_literal", "network_train@train_original=denoised", "trian.lr=1"]
    kept = [word for word in given if word.split("=")[0] != "telescope"]
    assert overrides_for([*given, "wavefront.coma=3"], CHOICE) == tuple(kept)
    assert overrides_for(given) == tuple(given)
    assert overrides_for(["optics.backend=torch"], list(CHOICE)) == ()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["alignment", "config", "dataset=dataset3"], "dataset=alignment"),
        (["config", "--stage", "alignment_bound", "dataset=dataset3"], "dataset=alignment"),
        (["config", "--stage", "templates", "dataset=alignment"], "no simulated stars"),
        (["config", "--stage", "no-such"], "'no-such'"),
        (["alignment", "config", "trian.lr=1"], "trian.lr"),
        (["alignment", "config", "telescope=example_zernike"], "example_zernike: brings its own"),
        (["alignment", "config", "prescription=newtonian"], "secondary: missing"),
        (["alignment", "model", "--out=x.h5", "alignment.field_radius_deg=0.8"], "field (0.8, 0)°"),
        (["alignment", "train-network", "--kind=dae_retrained", *TRAINING], "--dae"),
    ],
)
def test_words_that_do_not_fit_scene_3_are_refused(words, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in refused(*words)
    assert not list(tmp_path.glob("*.h5"))


@pytest.mark.parametrize("stage", ["from-stars", "train", "alignment_estimate"])
def test_groups_of_any_command_are_shown(stage):
    result = psfdae("config", "--stage", stage)
    assert result.exit_code == 0
    assert "noise:" in result.output


def test_tables_hold_every_method(tables):
    errors = pd.read_csv(tables / "errors.csv")
    noisy = errors[errors.noise_level > 0]
    cells = noisy.groupby(["noise_level", "method"]).size()
    assert (cells == 8).all()
    assert set(noisy.method) == set(ALIGNERS) - {"cramer_rao_pooled"}
    assert set(noisy.noise_level) == {0.002, 0.005}
    clean = set(errors[errors.noise_level == 0].method)
    assert clean == {"constant", *(method.name for method in LEARNED)}
    correlation = pd.read_csv(tables / "correlation.csv")
    assert len(correlation) == 16 * (2 * 8 + 4)
    diagonal = correlation[correlation.parameter_a == correlation.parameter_b]
    assert diagonal.correlation.to_numpy() == pytest.approx(1)


def test_flux_and_place_are_free_for_uniform_states_only(products, tmp_path):
    given = ("--set", "grid", "--states", products / "grid.h5", "--model", products / "model.h5")
    _run("bound", *given, "--out", tmp_path / "bound.h5", *PRESET)
    assert read_product(tmp_path / "bound.h5", "alignment_bound")["covariances"].shape[0] == 1
    assert [key["method"] for key, _, _ in read_bounds([tmp_path / "bound.h5"])] == 2 * [
        "cramer_rao"
    ]
    assert of_set(FITTED, "uniform") == FITTED
    assert of_set(FITTED, "grid") == [ALIGNERS["max_likelihood"]]


def test_paper_s_rows_stand_beside_ours(tables):
    given = ("--errors", tables / "errors.csv", "--correlation", tables / "correlation.csv")
    _run("paper-tables", *given, "--out", tables / "paper")
    table = pd.read_csv(tables / "paper" / "alignment_paper_0.005.csv")
    paper = table[(table.source == "paper") & (table.quantity == "mean")].set_index("method")
    assert paper.decenter_y.to_dict() == {"original": 0.802, "dae": 0.0262}
    ours = table[(table.source == "psfdae") & (table.quantity == "variance")].set_index("method")
    errors = pd.read_csv(tables / "errors.csv").query("noise_level == 0.005 and unit == 'range'")
    variance = errors.query("method == 'dae' and parameter == 'tilt_x'").variance_abs.item()
    assert ours.tilt_x["dae"] == pytest.approx(variance, rel=1e-4)
    text = (tables / "paper" / "alignment_paper_correlation.md").read_text()
    assert "| 0.379 " in text


def test_time_table(tables):
    given = [f"--history={n}={tables / n}/history.csv" for n in ("dae", *TRAINED)]
    given += [f"--times={tables / name}" for name in ("estimates.csv", "fit_0.002.csv")]
    _run("time-table", *given, "--out", tables / "time.csv")
    table = pd.read_csv(tables / "time.csv").set_index("method")
    assert list(table.index) == [method.name for method in ESTIMATORS]
    assert table.training_seconds["dae"] >= table.training_seconds["original"]
    assert table.states["max_likelihood"] == table.states["max_likelihood_free"] == 12


@pytest.mark.parametrize("kind", ["predicted", "errors", "correlation", "stamps"])
def test_figures_are_drawn(tables, kind):
    fits = [f"--fit={tables / f'fit_{level}.h5'}" for level in ("0.002", "0.005")]
    estimates = f"--estimates={tables / 'estimates.h5'}"
    given = {
        "predicted": [estimates, *fits],
        "errors": [estimates, *fits, f"--bound={tables / 'bound.h5'}"],
        "correlation": [f"--correlation={tables / 'correlation.csv'}"],
        "stamps": [f"--states={tables / 'uniform.h5'}", f"--dae={tables / 'dae'}", *PRESET],
    }[kind]
    _run("figure", kind, *given, "--out", tables / f"{kind}.png")
    assert (tables / f"{kind}.png").stat().st_size > 10_000


def test_twin_is_closer_in_focus(tmp_path):
    _run("figure", "twin", "--table", tmp_path / "twin.csv", "--out", tmp_path / "twin.png")
    table = pd.read_csv(tmp_path / "twin.csv")
    near = table[np.isclose(table.position, -1) & np.isclose(table.noise_level, 0.002)]
    chi2 = near.set_index("defocus_mm").chi2
    assert chi2[0.2] > 10 * chi2[0.0]
    at_the_state = table[np.isclose(table.position, 1)]
    assert at_the_state.chi2.to_numpy() == pytest.approx(0, abs=1e-6)
