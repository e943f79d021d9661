"""Tables, figures and commands of scene 3, on tiny sizes."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

import psfdae.cli.alignment_methods  # noqa: F401  registers the commands
from psfdae.cli import main
from psfdae.evaluation import alignment_tables


def test_rows_of_the_tables():
    rng = np.random.default_rng(0)
    covariance = np.array([[4, 0, 0, -3], [0, 4, 3, 0], [0, 3, 4, 0], [-3, 0, 0, 4]]) * 1e-4
    errors = rng.multivariate_normal(np.zeros(4), covariance, 4000)
    key = {"test_set": "uniform", "noise_level": 0.002, "method": "dae"}
    unit = np.array([1e-3, 1e-3, 2e-3, 2e-3])
    table = pd.DataFrame(alignment_tables.error_rows(key, errors, unit))
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
    # Normal errors: the absolute error has 1 − 2/π of the variance.
    ratio = ranges.variance_abs / ranges.variance
    assert ratio.to_numpy() == pytest.approx(1 - 2 / np.pi, abs=0.03)
    bound = pd.DataFrame(
        alignment_tables.bound_rows(key, np.broadcast_to(covariance, (5, 4, 4)), unit)
    )
    same = bound[bound.unit == "range"].set_index("parameter")
    assert ranges.mean_abs_error.to_numpy() == pytest.approx(same.mean_abs_error, rel=0.05)
    assert ranges.variance_abs.to_numpy() == pytest.approx(same.variance_abs, rel=0.1)


def test_measured_correlations_are_those_predicted():
    rng = np.random.default_rng(0)
    covariance = np.array([[4, 0, 0, -3], [0, 4, 3, 0], [0, 3, 4, 0], [-3, 0, 0, 4]]) * 1e-4
    errors = rng.multivariate_normal(np.zeros(4), covariance, 600)
    key = {"test_set": "uniform", "noise_level": 0.002}
    measured = pd.DataFrame(alignment_tables.measured_correlations(key, errors))
    predicted = pd.DataFrame(
        alignment_tables.predicted_correlations(key, np.broadcast_to(covariance, (600, 4, 4)))
    )
    assert len(measured) == 16
    pooled = predicted[predicted.method == "cramer_rao_pooled"].reset_index(drop=True)
    assert pooled.correlation[3] == pytest.approx(-0.75)
    assert pooled.correlation[6] == pytest.approx(0.75)
    off = measured.parameter_a != measured.parameter_b
    assert (measured.ci_low[off] < pooled.correlation[off]).mean() > 0.8
    assert (measured.ci_high[off] > pooled.correlation[off]).mean() > 0.8
    assert (pooled.ci_low[3] < -0.75) and (pooled.ci_high[3] > -0.75)


def _run(*arguments):
    result = CliRunner().invoke(main, ["alignment", *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == 0, result.output


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """The whole scene on tiny sizes, by the command line."""
    at = tmp_path_factory.mktemp("scene3")
    preset = ("alignment_preset=smoke", "alignment.grid_levels=2")
    _run("model", "--out", at / "model.h5", *preset)
    for kind in ("grid", "uniform", "train"):
        model = ("--model", at / "model.h5") if kind == "train" else ()
        _run("states", "--set", kind, "--out", at / f"{kind}.h5", *model, *preset)
    data = ("--grid", at / "grid.h5", "--train", at / "train.h5", "--checkpoint", at / "c")
    _run("train-dae", *data, "--out", at / "dae", *preset)
    for kind, states in (("original", "grid"), ("noise_trained", "train")):
        chosen = ("--kind", kind, "--states", at / f"{states}.h5", "--checkpoint", at / "c")
        _run("train-cnn", *chosen, "--out", at / kind, *preset)
    retrained = ("--kind", "dae_retrained", "--states", at / "train.h5", "--dae", at / "dae")
    _run("train-cnn", *retrained, "--checkpoint", at / "c", "--out", at / "dae_retrained", *preset)
    return at, preset


def _estimate(at, preset, test_set):
    networks = [
        word
        for name in ("dae", "original", "noise-trained", "dae-retrained")
        for word in (f"--{name}", at / name.replace("-", "_"))
    ]
    states = ("--set", test_set, "--states", at / f"{test_set}.h5")
    model = ("--model", at / "model.h5")
    outs = [at / f"est_{test_set}.h5", at / f"bound_{test_set}.h5"]
    times = ("--times", at / f"est_{test_set}.csv")
    _run("estimate", *states, *networks, "--out", outs[0], *times, *preset)
    _run("bound", *states, *model, "--out", outs[1], *preset)
    for level in ("0.002", "0.005"):
        out = at / f"fit_{test_set}_{level}.h5"
        chosen = ("--level", level, "--cnn", at / "noise_trained", "--out", out)
        times = ("--times", out.with_suffix(".csv"))
        _run("fit", *states, *model, *chosen, *times, *preset, "fit.iterations=1")


@pytest.fixture(scope="module")
def tables(smoke):
    at, preset = smoke
    _estimate(at, preset, "uniform")
    given = ["--estimates", at / "est_uniform.h5", "--bound", at / "bound_uniform.h5"]
    for level in ("0.002", "0.005"):
        given += ["--fit", at / f"fit_uniform_{level}.h5"]
    out = ("--errors", at / "errors.csv", "--correlation", at / "correlation.csv")
    _run("tables", "--states", at / "uniform.h5", *given, *out)
    return at


def test_tables_hold_every_method(tables):
    errors = pd.read_csv(tables / "errors.csv")
    noisy = errors[errors.noise_level > 0]
    cells = noisy.groupby(["noise_level", "method"]).size()
    assert (cells == 8).all()
    assert set(noisy.method) == set(alignment_tables.METHOD_LABELS)
    assert set(noisy.noise_level) == {0.002, 0.005}
    assert set(errors[errors.noise_level == 0].method) == {
        *("constant", "original", "dae", "noise_trained", "dae_retrained"),
    }
    correlation = pd.read_csv(tables / "correlation.csv")
    assert len(correlation) == 16 * (2 * 7 + 4)
    diagonal = correlation[correlation.parameter_a == correlation.parameter_b]
    assert diagonal.correlation.to_numpy() == pytest.approx(1)


def test_paper_s_rows_stand_beside_ours(tables):
    given = ("--errors", tables / "errors.csv", "--correlation", tables / "correlation.csv")
    _run("paper-tables", *given, "--out", tables / "paper")
    table = pd.read_csv(tables / "paper" / "alignment_paper_0.005.csv")
    paper = table[(table.source == "paper") & (table.quantity == "mean")].set_index("method")
    assert paper.decenter_y.to_dict() == {"original": 0.802, "dae": 0.0262}
    ours = table[(table.source == "psfdae") & (table.quantity == "variance")].set_index("method")
    errors = pd.read_csv(tables / "errors.csv").query("noise_level == 0.005 and unit == 'range'")
    own = errors.query("method == 'dae' and parameter == 'tilt_x'").variance_abs.item()
    assert ours.tilt_x["dae"] == pytest.approx(own, rel=1e-4)
    text = (tables / "paper" / "alignment_paper_correlation.md").read_text()
    assert "| 0.379 " in text


def test_time_table(tables):
    given = [
        f"--history={n}={tables / n}/history.csv"
        for n in ("dae", "original", "noise_trained", "dae_retrained")
    ]
    given += [
        f"--times={tables / 'est_uniform.csv'}",
        f"--times={tables / 'fit_uniform_0.002.csv'}",
    ]
    _run("time-table", *given, "--out", tables / "time.csv")
    table = pd.read_csv(tables / "time.csv").set_index("method")
    assert list(table.index) == list(alignment_tables.METHOD_LABELS)[1:-1]
    assert table.training_seconds["dae"] >= table.training_seconds["original"]
    assert table.states["max_likelihood"] == 12


@pytest.mark.parametrize("kind", ["predicted", "errors", "correlation", "stamps"])
def test_figures(tables, kind, smoke):
    fits = [f"--fit={tables / f'fit_uniform_{level}.h5'}" for level in ("0.002", "0.005")]
    estimates = f"--estimates={tables / 'est_uniform.h5'}"
    given = {
        "predicted": [estimates, *fits],
        "errors": [estimates, *fits, f"--bound={tables / 'bound_uniform.h5'}"],
        "correlation": [f"--correlation={tables / 'correlation.csv'}"],
        "stamps": [f"--states={tables / 'uniform.h5'}", f"--dae={tables / 'dae'}", *smoke[1]],
    }[kind]
    _run("figure", kind, *given, "--out", tables / f"{kind}.png")
    assert (tables / f"{kind}.png").stat().st_size > 10_000


def test_twin_is_closer_in_focus(tmp_path):
    arguments = ["figure", "twin", "--table", tmp_path / "twin.csv", "--out", tmp_path / "twin.png"]
    _run(*arguments)
    table = pd.read_csv(tmp_path / "twin.csv")
    near = table[np.isclose(table.position, -1) & np.isclose(table.noise_level, 0.002)]
    chi2 = near.set_index("defocus_mm").chi2
    assert chi2[0.2] > 10 * chi2[0.0]
    own = table[np.isclose(table.position, 1)]
    assert own.chi2.to_numpy() == pytest.approx(0, abs=1e-6)


def test_dae_option_goes_with_its_kind(tmp_path):
    arguments = ["alignment", "train-cnn", "--kind", "dae_retrained", "--states", "x.h5"]
    result = CliRunner().invoke(
        main, [*arguments, "--checkpoint", str(tmp_path / "c"), "--out", str(tmp_path / "o")]
    )
    assert result.exit_code == 2
    assert "--dae goes with --kind dae_retrained" in result.output
