"""Timing of baseline, inference and growth, and the ONNX export."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import torch
from click.testing import CliRunner

import psfdae.cli.benchmark_timing  # noqa: F401
from psfdae.benchmark import baseline, throughput
from psfdae.benchmark.isolated import run_isolated
from psfdae.benchmark.scaling import fit_power_law
from psfdae.cli import main
from psfdae.models import export
from psfdae.models.dae import build_dae, image_scale, predict, predict_stream
from psfdae.stages import timing

KERNELS = (9, 3, 1, 5)


@pytest.fixture(scope="module")
def model():
    return build_dae(KERNELS, (4, 4, 4), "he", torch.Generator().manual_seed(1))


def test_exported_network_is_the_network(model, tmp_path):
    path = tmp_path / "dae.onnx"
    export.export_onnx(model, image_scale("mean", 16), 16, path)
    assert list(tmp_path.iterdir()) == [path]
    images = export.random_stars(33, 16)
    expected = predict(model, images, 256.0)
    found = export.session(path, threads=1).run(None, {"images": images})[0]
    assert found.dtype == np.float32
    assert np.abs(found - expected).max() <= 1e-5 * expected.max()


def test_export_that_differs_is_refused_and_removed(model, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "predict", lambda *a: 1.001 * predict(*a))
    with pytest.raises(export.ExportError, match="batch of 1 differs from torch"):
        export.export_onnx(model, 256.0, 16, tmp_path / "dae.onnx")
    assert list(tmp_path.iterdir()) == []


def test_random_stars_are_normalised():
    stars = export.random_stars(50, 24)
    # 576 pixels of noise 0.005 add up to 0.12.
    assert stars.sum(axis=(1, 2)) == pytest.approx(np.ones(50), abs=0.6)
    assert stars.sum(axis=(1, 2)).mean() == pytest.approx(1, abs=0.1)


def test_prediction_in_pieces_is_the_prediction(model):
    images = export.random_stars(21, 16)
    pieces = list(predict_stream(model, images, 256.0, rows=8, batch=4))
    assert [len(psf) for _, psf in pieces] == [8, 8, 5]
    assert [part.start for part, _ in pieces] == [0, 8, 16]
    joined = np.concatenate([psf for _, psf in pieces])
    assert joined == pytest.approx(predict(model, images, 256.0), rel=1e-4, abs=1e-7)


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
def test_power_law_is_found_with_its_error(exponent):
    x = np.array([1e3, 3e3, 1e4, 1e5])
    exact = fit_power_law(x, 3.0 * x**exponent)
    assert exact.exponent == pytest.approx(exponent, rel=1e-9)
    assert exact.scale == pytest.approx(3.0, rel=1e-9)
    assert exact(1e6) == pytest.approx(3.0 * 1e6**exponent, rel=1e-9)
    rng = np.random.default_rng(0)
    noisy = [fit_power_law(x, x**exponent * np.exp(0.1 * rng.normal(size=4))) for _ in range(400)]
    spread = np.std([law.exponent for law in noisy])
    assert np.sqrt(np.mean([law.stderr**2 for law in noisy])) == pytest.approx(spread, rel=0.15)


def test_two_points_leave_the_error_open():
    assert np.isnan(fit_power_law(np.array([1, 2]), np.array([1, 2])).stderr)
    with pytest.raises(ValueError, match="no power law"):
        fit_power_law(np.array([1, 1]), np.array([1, 2]))


def test_grid_marks_the_point_in_use_once_and_respects_the_limit():
    grid = baseline.grid_around(20, 11, 11, 10, 256)
    assert [p["components"] for p in grid if p["used"]] == [20]
    sizes = [tuple(p.values())[:4] for p in grid]
    assert len(set(sizes)) == len(sizes)
    assert {(40, 11, 11, 10), (20, 15, 15, 10), (20, 11, 11, 50)} <= set(sizes)
    assert max(p["components"] for p in baseline.grid_around(8, 4, 4, 2, 10)) == 10


def test_baseline_point_reports_the_error_of_its_predictions(gaussian_stars):
    fit = {"components": 4, "rows": 3, "columns": 3, "epochs": 2}
    fit |= {"sigma": 1.0, "learning_rate": 0.5, "seed": 1}
    truths = {"realisation": gaussian_stars, "template": 0 * gaussian_stars}
    point = baseline.time_point(gaussian_stars, [gaussian_stars], truths, fit, 2)
    assert 0 < point["mse_realisation"] < (gaussian_stars**2).mean() < 2 * point["mse_template"]
    assert point["repeats"] == 2
    assert point["fit_s"] > 0


def test_rates_are_ordered_and_honest():
    done = []
    found = throughput.rates(lambda: done.append(1), 10, 3)
    assert found["stars_per_s_low"] <= found["stars_per_s"] <= found["stars_per_s_high"]
    assert found["repeats"] == 3
    assert len(done) > 3


def test_engines_run_apart_and_see_their_threads(tmp_path):
    network = {"kernels": [3, 3], "scale": "mean"}
    grid = {"widths": [2], "stamps": [8]}
    timed = {**grid, "batches": [1, 3], "repeats": 1}
    run_isolated(throughput.export_networks, 1, **network, **grid, folder=str(tmp_path))
    for table in (
        run_isolated(throughput.time_torch, 1, **network, **timed),
        run_isolated(throughput.time_onnxruntime, 1, folder=str(tmp_path), **timed),
    ):
        assert [(row["batch"], row["threads"]) for row in table] == [(1, 1), (3, 1)]
        assert all(row["stars_per_s"] > 0 for row in table)


def fake_scaling():
    frames = []
    for what, per_star in (("simulation", 5e-4), ("inference", 2e-4)):
        for against, points in (("stars", [1000, 10_000, 100_000]), ("stamp_px", [16, 24, 32])):
            rows = [
                {
                    "what": what,
                    "stars": x if against == "stars" else 1000,
                    "stamp_px": 16 if against == "stars" else x,
                    "time_s": per_star * x,
                    "peak_mb": 80 + 1e-4 * x,
                    "disk_mb": 2e-3 * x,
                }
                for x in points
            ]
            frames.append(timing._with_exponents(pd.DataFrame(rows), against))
    return pd.concat(frames).assign(threads=2)


def test_million_stars_are_extrapolated():
    table = fake_scaling()
    last = table[(table.measured == "extrapolated") & (table.what == "simulation")].iloc[0]
    assert last.stars == 1_000_000
    assert last.time_s == pytest.approx(500)
    assert last.peak_mb == pytest.approx(180)
    assert last.disk_mb == pytest.approx(2000)
    assert last.exponent == pytest.approx(1)


def fake_table(kind):
    if kind == "scaling":
        return fake_scaling()
    if kind == "baseline":
        grid = baseline.grid_around(20, 11, 11, 10, 256)
        return pd.DataFrame(
            [
                {**p, "used": "yes" if p["used"] else "no", "fit_s": 0.1 * p["epochs"],
                 "predict_stars_per_s": 1e6, "n": 100, "threads": 1, "repeats": 1,
                 "mse_realisation": 1e-4 / p["rows"], "mse_template": 2e-4 / p["components"]}
                for p in grid
            ]
        )  # fmt: skip
    return pd.DataFrame(
        [
            {"engine": e, "width": w, "stamp_px": s, "threads": t, "batch": b, "repeats": 1,
             "stars_per_s": 1e5 / w, "stars_per_s_low": 9e4 / w, "stars_per_s_high": 2e5 / w}
            for e in ("torch", "onnxruntime") for w in (8, 16) for s in (16, 24)
            for t in (1, 2) for b in (1, 16)
        ]
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["baseline", "inference", "scaling"])
def test_figures_are_drawn_from_their_tables(kind, tmp_path):
    table, out = tmp_path / "t.csv", tmp_path / "f.png"
    fake_table(kind).to_csv(table, index=False)
    arguments = ["figure", "benchmark", "--kind", kind, "--table", str(table), "--out", str(out)]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    assert out.stat().st_size > 10_000
