"""Figures of scenes 1 and 2 from tiny synthetic inputs."""

from __future__ import annotations

import matplotlib
import numpy as np
import pandas as pd
import pytest

from psfdae.files import Column, ProductError, write_product
from psfdae_paper.evaluation.figures import template_map
from psfdae_paper.stages import figures as stage
from psfdae_paper.stars.fields import square_grid

METHODS = ("noisy", "pca_som", "dae", "lmmse")
LEVELS = (0.001, 0.002, 0.003, 0.005)


def small_field():
    index, angle_deg = square_grid(3, 1.1)
    return index, np.deg2rad(angle_deg)


def one_bright_pixel(fields, bright, row, column, side=4):
    psf = np.full((fields, side, side), 1e-6)
    psf[:, 0, 0] = 1e-3
    psf[bright] = 0.0
    psf[bright, row, column] = 1.0
    return psf


def rgb_at(figure, axes, x, y):
    """Colour that the drawn figure shows at data coordinates."""
    figure.canvas.draw()
    picture = np.asarray(figure.canvas.buffer_rgba())
    column, row = axes.transData.transform((x, y))
    return picture[picture.shape[0] - 1 - int(row), int(column), :3] / 255.0


def metrics_table():
    rows = [
        ("dataset3", "random", reference, method, level, metric, 10.0 * level + 0.01 * i, 1e-3, 7)
        for reference in ("realisation", "template")
        for i, method in enumerate(METHODS)
        for level in LEVELS
        for metric in ("mse", "ssim")
    ]
    names = "dataset split reference method noise_level metric value stderr n"
    return pd.DataFrame(rows, columns=names.split())


def test_template_map_shows_the_bright_pixel_where_it_belongs():
    row, column = 3, 0
    index, field = small_field()
    bright = int(np.flatnonzero((index == [2, 0]).all(axis=1))[0])
    figure = template_map(one_bright_pixel(9, bright, row, column), index, field, "templates")
    axes = figure.axes[0]
    x, y = np.rad2deg(field[bright])
    pixel = 1.1 / 5  # four pixels and a gap per field
    at = (x + (column - 1.5) * pixel, y + (row - 1.5) * pixel)
    opposite = (x - (column - 1.5) * pixel, y - (row - 1.5) * pixel)
    assert rgb_at(figure, axes, *at).min() > 0.7
    assert rgb_at(figure, axes, *opposite).max() < 0.1


def test_stages_write_the_same_bytes_twice(tmp_path):
    index, field = small_field()
    columns = {
        "psf": Column(one_bright_pixel(9, 0, 2, 2, side=6), "1", "stamps"),
        "energy": Column(np.linspace(0.1, 0.9, 9), "1", "light"),
        "grid": Column(index, "1", "grid"),
        "field": Column(field, "rad", "field"),
    }
    config = {"framing": {"jitter_px": 1, "stamp_px": 4}, "scene": {"name": "seidel"}}
    write_product(tmp_path / "t.h5", "templates", columns, config)
    metrics_table().to_csv(tmp_path / "m.csv", index=False)
    history = pd.DataFrame({"step": [1, 2], "train_mse": [2e-5, 1e-5], "validation_mse": 1e-5})
    history.to_csv(tmp_path / "h.csv", index=False)
    draws = {
        "templates": lambda out: stage.figure_templates(tmp_path / "t.h5", out),
        "energy": lambda out: stage.figure_energy(tmp_path / "t.h5", out),
        "curves": lambda out: stage.figure_curves(["one"], [tmp_path / "h.csv"], out),
        "errors": lambda out: stage.figure_errors("dataset3", [tmp_path / "m.csv"], [("mse", out)]),
    }
    # A user's matplotlibrc changes nothing of a figure.
    rc = {"font.size": 20, "axes.facecolor": "red", "lines.linewidth": 9}
    rc |= {"savefig.facecolor": "red", "savefig.bbox": "tight", "image.interpolation": "bilinear"}
    for name, draw in draws.items():
        one, two = tmp_path / f"{name}_1.png", tmp_path / f"{name}_2.png"
        draw(one)
        with matplotlib.rc_context(rc):
            draw(two)
        assert one.read_bytes() == two.read_bytes()
        assert one.read_bytes().startswith(b"\x89PNG")
    assert not list(tmp_path.glob(".*.tmp"))
    # Refusals leave no figure.
    with pytest.raises(ProductError, match="dataset5, mse"):
        stage.figure_errors("dataset5", [tmp_path / "m.csv"], [("mse", tmp_path / "e.png")])
    (tmp_path / "h.csv").write_text("step,train_mse\n1,2\n")
    with pytest.raises(ProductError, match="validation_mse"):
        stage.figure_curves(["one"], [tmp_path / "h.csv"], tmp_path / "e.png")
    assert not (tmp_path / "e.png").exists()
