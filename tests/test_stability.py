"""Stress tests: the bookkeeping, and that a broken piece gives a failing row."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from scipy.stats import pearsonr

import psfdae.cli.stability  # noqa: F401 - registers the commands
from psfdae.cli.base import main
from psfdae.configuration.compose import load
from psfdae.evaluation.correlation import error_correlation
from psfdae.files import ProductError
from psfdae.optics.propagation import StampPropagator
from psfdae.stability import bench as bench_module
from psfdae.stability import (
    flux,
    metric_cases,
    network_cases,
    optics_cases,
    photometry_cases,
    precision_cases,
    repeat_cases,
    rows,
)
from psfdae.stability.bench import Bench, Scene, fresh_stars
from psfdae.stability.rows import Point, Row, StabilityError

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Few stars of scene 1 and of scene 2, as the stage would hand them over."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench_module, "MODEL_STARS", 300)
        seidel = load(["dataset=dataset3", "seed=5"])
        turbulence = load(["dataset=dataset8", "grid.points=3"])
        images = fresh_stars(load(["dataset=dataset3"]), 160).astype(np.float32)
        other = np.random.default_rng(0).random((40, 24, 24)).astype(np.float32)
        other /= other.sum(axis=(1, 2), keepdims=True)
        bench = Bench(
            seidel,
            Scene(seidel, images, 3e-5),
            Scene(turbulence, other, 3e-4),
            tmp_path_factory.mktemp("bench"),
        )
        assert bench.flux_models
        yield bench


def failing(case, bench):
    """Quantities of the failing rows of one case."""
    table, _ = rows.run_cases([case], bench)
    assert table
    return [f"{row.case}: {row.quantity}" for row in rows.failures(table)]


def test_bounds_hold_at_their_ends_and_never_for_nan():
    assert rows.at_most("c", "q", 1.0, 1.0).verdict == "pass"
    assert rows.at_most("c", "q", 1.0001, 1.0).verdict == "fail"
    assert rows.at_most("c", "q", np.nan, 1.0).verdict == "fail"
    assert rows.within("c", "q", 0.5, 0.5, 1.0).verdict == "pass"
    assert rows.within("c", "q", 0.4, 0.5, 1.0).verdict == "fail"
    assert rows.within("c", "q", np.nan, 0.5, 1.0).verdict == "fail"
    assert rows.equal("c", "q", 3, 4).verdict == "fail"
    assert rows.one_of("c", "q", "a dead network", ("TrainingError",)).verdict == "fail"


def raising(error):
    def action():
        raise error

    return action


def test_refusal_names_what_was_raised():
    assert rows.refused("c", raising(KeyError("k")), KeyError).measured == "KeyError"
    other = rows.refused("c", raising(TypeError("no\nway")), KeyError)
    assert (other.verdict, other.measured) == ("fail", "TypeError: no")
    none = rows.refused("c", lambda: 1, KeyError)
    assert (none.verdict, none.measured) == ("fail", "no error")


def test_agreement_or_refusal():
    def outcome(action):
        row, measured = rows.agrees_or_refused("c", "q", action, 1.0, (KeyError,))
        return row.verdict, row.measured, measured

    assert outcome(lambda: 0.5) == ("pass", "0.5", 0.5)
    assert outcome(lambda: 2.0) == ("fail", "2", 2.0)
    assert outcome(raising(KeyError("k"))) == ("pass", "KeyError", None)
    assert outcome(raising(TypeError("t"))) == ("fail", "TypeError: t", None)
    assert outcome(lambda: float("nan"))[0] == "fail"


def test_case_that_breaks_is_a_failing_row_and_stops_no_other():
    def first_case(bench):
        yield rows.at_most("first", "q", 0.0, 1.0)
        raise ZeroDivisionError("oh")

    def second_case(bench):
        yield rows.at_most("second", "q", 0.0, 1.0)
        yield Point("second", 1.0, None, 2.0)

    seen = []
    table, points = rows.run_cases([first_case, second_case], None, seen.append)
    assert [row.verdict for row in table] == ["pass", "fail", "pass"]
    assert table[1].measured == "ZeroDivisionError: oh"
    assert points == [Point("second", 1.0, None, 2.0)]
    assert seen == ["first case", "second case"]


def test_tables_survive_a_round_trip(tmp_path):
    table = [rows.at_most("a, with comma", "|x − 1|", 0.5, 1.0), rows.equal("b", "q", 1, 2)]
    rows.write_table(tmp_path / "t.csv", table, Row)
    assert rows.read_rows(tmp_path / "t.csv") == table
    points = [Point("a", 1.0, None, 2.0), Point("a", 2.0, 1e-12, 2.0)]
    rows.write_table(tmp_path / "g.csv", points, Point)
    read = pd.read_csv(tmp_path / "g.csv")
    assert list(read.columns) == ["case", "stress", "error", "bound"]
    assert np.isnan(read.error[0])
    assert read.error[1] == 1e-12


def test_table_of_other_columns_is_named(tmp_path):
    (tmp_path / "t.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ProductError, match=r"t\.csv: columns \['a', 'b'\]"):
        rows.read_rows(tmp_path / "t.csv")
    with pytest.raises(ProductError, match="no such file"):
        rows.read_rows(tmp_path / "none.csv")


def test_verdict_names_every_failing_row():
    table = [rows.equal("good", "q", 1, 1), rows.equal("bad", "count", 1, 2)]
    with pytest.raises(StabilityError, match=r"1 of 2 .*\n  bad: count: expected 2, got 1"):
        rows.check(table)
    with pytest.raises(StabilityError, match="empty"):
        rows.check([])
    rows.check(table[:1])


def test_verdict_command(tmp_path):
    path = tmp_path / "t.csv"
    rows.write_table(path, [rows.equal("good", "q", 1, 1)], Row)
    result = CliRunner().invoke(main, ["stability-verdict", str(path)])
    assert (result.exit_code, result.output) == (0, "all 1 rows pass\n")
    rows.write_table(path, [rows.equal("bad", "q", 1, 2)], Row)
    result = CliRunner().invoke(main, ["stability-verdict", str(path)])
    assert result.exit_code == 2
    assert "bad: q: expected 2, got 1" in result.output


@pytest.mark.parametrize(("flags", "code"), [([], 2), (["--table-only"], 0)])
def test_command_writes_the_table_before_it_fails(tmp_path, monkeypatch, flags, code):
    from psfdae.stages import stability as stage

    def run(config, stars, turbulence, out, graded):
        table = [rows.equal("bad", "q", 1, 2)]
        rows.write_table(out, table, Row)
        return table

    monkeypatch.setattr(stage, "run", run)
    out = tmp_path / "t.csv"
    names = ["--stars", "s.h5", "--turbulence", "t.h5", "--out", str(out), "--graded", "g.csv"]
    result = CliRunner().invoke(main, ["stability", *names, *flags])
    assert result.exit_code == code
    assert len(rows.read_rows(out)) == 1


def test_stage_refuses_the_stars_of_the_other_scene(tmp_path):
    from psfdae.files import Column, write_product
    from psfdae.stages import stability as stage

    config = load(["dataset=dataset8"])
    path = tmp_path / "stars.h5"
    keys = ("seed", "scene", "telescope", "grid", "wavefront", "stars", "framing", "optics")
    tree = {key: config.model_dump()[key] for key in keys}
    write_product(path, "stars", {"realisation": Column(np.ones((2, 8, 8)), "1", "stars")}, tree)
    with pytest.raises(ProductError, match=r"turbulence, but .* has seidel"):
        stage.run(load(["dataset=dataset3"]), path, path, tmp_path / "t.csv", tmp_path / "g.csv")


def test_stage_imports_no_torch():
    code = (
        "import sys, psfdae.stages.stability, psfdae.stages.stability_report;"
        "print([m for m in ('torch','pandas','matplotlib','sklearn','skimage','hydra') "
        "if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "case",
    [
        photometry_cases.broken_stars,
        photometry_cases.plain_normalisation,
        photometry_cases.units,
        photometry_cases.hot_pixels,
        precision_cases.metrics,
        metric_cases.correlations,
        repeat_cases.streams,
    ],
)
def test_cases_of_new_pieces_pass(bench, case):
    assert failing(case, bench) == []


def test_broken_flux_gives_failing_rows(bench, monkeypatch):
    monkeypatch.setattr("psfdae.own_stars.photometry.MARGIN", 1e12)
    assert any("hot pixel of 1e+06" in row for row in failing(photometry_cases.hot_pixels, bench))


def test_flux_that_lets_nan_through_gives_failing_rows(bench, monkeypatch):
    def careless(images, model):
        total = images.sum(axis=(1, 2))
        _, estimate = flux.normalise_robustly(images, model)
        return (images / total[:, None, None]).astype(np.float32), estimate

    monkeypatch.setattr(photometry_cases, "normalise_robustly", careless)
    bad = failing(photometry_cases.broken_stars, bench)
    assert "star with a NaN: finite image" in bad
    assert "star with flux 0: image is zero" in bad


def test_leaky_normalisation_gives_failing_rows(bench, monkeypatch):
    def leaky(images, model):
        normal, estimate = flux.normalise_robustly(images, model)
        return normal - normal.mean(), estimate

    monkeypatch.setattr(photometry_cases, "normalise_robustly", leaky)
    bad = failing(photometry_cases.broken_stars, bench)
    assert any("neighbours unchanged" in row for row in bad)


def test_kernel_that_loses_light_gives_failing_rows(bench, monkeypatch):
    class Dim(StampPropagator):
        def __call__(self, opd, offset_px=None):
            return 0.999 * super().__call__(opd, offset_px)

    monkeypatch.setattr(optics_cases, "StampPropagator", Dim)
    bad = failing(optics_cases.energy, bench)
    assert any(row.startswith("Parseval") for row in bad)


def test_search_without_a_guard_gives_a_failing_row(bench, monkeypatch):
    import psfdae.stars.scene as scene

    monkeypatch.setattr(
        scene, "choose_samples", lambda needed, ladder: np.full(len(needed), ladder[0])
    )
    monkeypatch.setattr(optics_cases, "FACTORS", (10,))
    bad = failing(optics_cases.stronger_aberrations, bench)
    assert "aberrations × 10: MSE of normalised stamps, configured grids" in bad


def test_streams_that_repeat_each_other_give_a_failing_row(bench, monkeypatch):
    def forgetful(seed, *names):
        return np.random.default_rng([seed, len(names)])

    monkeypatch.setattr(repeat_cases, "stream", forgetful)
    assert any("pairs that start alike" in row for row in failing(repeat_cases.streams, bench))


def test_network_without_a_look_for_death_gives_failing_rows(bench, monkeypatch):
    class Blind(network_cases.DaeTraining):
        def _step(self, batch, step):
            return 0.0

        def validate(self, epoch):
            return 1.0

    monkeypatch.setattr(network_cases, "DaeTraining", Blind)
    bad = failing(network_cases.dead_networks, bench)
    assert "dead at the first step: error raised" in bad


def test_correlation_is_pearson_s_with_fisher_s_interval():
    rng = np.random.default_rng(0)
    errors = rng.standard_normal((40, 4)) @ rng.standard_normal((4, 4))
    matrix, low, high = error_correlation(errors)
    assert matrix == pytest.approx(np.corrcoef(errors.T), abs=1e-12)
    expected = pearsonr(errors[:, 0], errors[:, 2]).confidence_interval(0.95)
    assert (low[0, 2], high[0, 2]) == pytest.approx((expected.low, expected.high), rel=1e-6)
    assert (low <= matrix).all()
    assert (matrix <= high).all()


def test_correlation_without_variance_is_nan_and_silent():
    errors = np.random.default_rng(0).standard_normal((20, 3))
    errors[:, 1] = 0.1
    matrix, low, high = error_correlation(errors)
    for array in (matrix, low, high):
        assert np.isnan(array[1]).all()
        assert np.isnan(array[:, 1]).all()
        assert np.isfinite(array[np.ix_([0, 2], [0, 2])]).all()


def test_correlation_of_few_samples_has_no_interval():
    errors = np.random.default_rng(0).standard_normal((3, 2))
    matrix, low, high = error_correlation(errors)
    assert np.isfinite(matrix).all()
    assert np.isnan([low[0, 1], high[0, 1]]).all()
    with pytest.raises(ValueError, match="finite"):
        error_correlation(errors * np.nan)
    with pytest.raises(ValueError, match="at least one"):
        error_correlation(errors[:0])


def graded_table():
    series = [name for panel in figure_panels() for name in panel.series]
    return pd.DataFrame(
        [(s, x, None if x > 5 else 1e-9 * x, 1e-8) for s in series for x in (1, 3, 10)],
        columns=["case", "stress", "error", "bound"],
    )


def figure_panels():
    from psfdae.stability.figure import PANELS

    return PANELS


def test_figure_shows_errors_bounds_and_refusals(tmp_path):
    path, png = tmp_path / "g.csv", tmp_path / "g.png"
    graded_table().to_csv(path, index=False)
    result = CliRunner().invoke(
        main, ["figure", "stability", "--graded", str(path), "--out", str(png)]
    )
    assert result.exit_code == 0, result.output
    assert png.read_bytes().startswith(b"\x89PNG")
    path.write_text("a,b\n1,2\n")
    result = CliRunner().invoke(
        main, ["figure", "stability", "--graded", str(path), "--out", str(png)]
    )
    assert result.exit_code == 2
    assert "not a table of graded stress tests" in result.output
