"""Figures of scenes 1 and 2 from tiny synthetic inputs."""

from __future__ import annotations

import matplotlib
import numpy as np
import pandas as pd
import pytest

from psfdae.figures import StripRow, restoration_strip, spread_stars
from psfdae.files import Column, ProductError, write_product
from psfdae_paper.evaluation.curves import error_against_noise, training_curves
from psfdae_paper.evaluation.figures import mosaic, stamp_energy_map, template_map
from psfdae_paper.evaluation.paper import published
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


def metrics_table(splits=("random",), references=("realisation", "template"), dataset="dataset3"):
    rows = [
        (dataset, split, reference, method, level, metric, 10.0 * level + 0.01 * i, 1e-3, 7)
        for split in splits
        for reference in references
        for i, method in enumerate(METHODS)
        for level in LEVELS
        for metric in ("mse", "ssim")
    ]
    names = "dataset split reference method noise_level metric value stderr n"
    return pd.DataFrame(rows, columns=names.split())


def legend_texts(legend):
    return [text.get_text() for text in legend.get_texts()]


def test_mosaic_places_stamps_unflipped():
    index, _ = square_grid(3, 1.0)
    stamps = np.arange(9 * 4.0).reshape(9, 2, 2)
    canvas = mosaic(stamps, index, gap=1)
    assert canvas.shape == (10, 10)
    assert np.isnan(canvas[0]).all()
    assert np.isnan(canvas[:, 3]).all()
    field = 5  # ix = 2, iy = 1
    assert (canvas[4:6, 7:9] == stamps[field]).all()


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


def test_energy_map_has_numbers_at_their_fields():
    index, field = small_field()
    energy = np.linspace(0.1, 0.9, 9)
    axes = stamp_energy_map(energy, index, field, 16).axes[0]
    assert [text.get_text() for text in axes.texts] == [f"{value:.2f}" for value in energy]
    assert axes.texts[2].get_position() == pytest.approx((1.1, -1.1))
    assert (axes.images[0].get_array()[0] == energy[:3]).all()


def test_spread_stars_are_distinct_and_even():
    index, _ = square_grid(11, 1.0)
    position = np.repeat(index, 3, axis=0).astype(float)
    picks = spread_stars(position, 8)
    assert len(set(picks)) == 8
    for quadrant in ((0, 0), (0, 1), (1, 0), (1, 1)):
        assert ((position[picks] > 5) == quadrant).all(axis=1).any()
    assert sorted(spread_stars(position[:2], 8)) == [0, 1]


def test_strip_has_a_stamp_per_star_and_row(gaussian_stars):
    truth = gaussian_stars[:3]
    rows = [
        StripRow("reference", truth),
        StripRow("noisy\nλ = 0.001", 0.5 * truth, np.array([1e-6, 2.5e-5, 6.174e-4]), True),
        StripRow("DAE\nλ = 0.001", 0.5 * truth, np.array([1e-6, 2e-6, 3e-6])),
    ]
    figure = restoration_strip(rows, ["a", "b", "c"], "stars")
    (axes,) = figure.axes
    shown = [image.get_array() for image in axes.images]
    assert len(shown) == 9
    assert shown[0].max() == pytest.approx(1.0)
    assert shown[3].max() == pytest.approx(1.0)  # noisy: by its own maximum
    assert shown[6].max() == pytest.approx(np.sqrt(0.5))
    # Errors are in units of 1e-6.
    texts = {text.get_text() for text in axes.texts}
    assert {"a", "b", "c", "1.00", "25.0", "617", *(row.label for row in rows)} <= texts


def test_training_curves_draw_both_errors_and_the_kept_network():
    history = pd.DataFrame(
        {
            "step": [10, 20, 30, 40],
            "train_mse": [8e-5, 4e-5, 2e-5, 1e-5],
            "validation_mse": [np.nan, 3e-5, np.nan, 5e-5],
        }
    )
    axes = training_curves({"one": history, "two": 2 * history}, "training").axes[0]
    assert len(axes.lines) == 6
    assert list(axes.lines[1].get_xdata()) == [20, 40]
    assert list(axes.lines[2].get_xdata()) == [20]
    assert {"one", "two", "kept network"} <= set(legend_texts(axes.get_legend()))


def test_errors_of_both_references_with_the_papers_points():
    figure = error_against_noise(metrics_table(), published("psf"), "dataset3", "ssim")
    assert len(figure.axes) == 2
    for axes in figure.axes:
        assert len(axes.containers) == len(METHODS)
        papers = [line for line in axes.lines if line.get_markerfacecolor() == "none"]
        assert len(papers) == 3
        assert [tick.get_text() for tick in axes.get_xticklabels()] == ["1", "2", "3", "5"]
    assert "DAE, paper" in legend_texts(figure.legends[0])


def test_held_out_is_dashed_and_unpublished_datasets_have_no_paper():
    table = metrics_table(("random", "held_out"), ("realisation",), "dataset1")
    figure = error_against_noise(table, published("psf"), "dataset1", "mse")
    (axes,) = figure.axes
    styles = [container.lines[0].get_linestyle() for container in axes.containers]
    assert styles.count("-") == styles.count("--") == len(METHODS)
    assert not any("paper" in text for text in legend_texts(figure.legends[0]))


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
    # A user's matplotlibrc changes nothing of the figure of errors.
    rc = {"errors": {"font.size": 20, "axes.facecolor": "red", "lines.linewidth": 9}}
    for name, draw in draws.items():
        one, two = tmp_path / f"{name}_1.png", tmp_path / f"{name}_2.png"
        draw(one)
        with matplotlib.rc_context(rc.get(name, {})):
            draw(two)
        assert one.read_bytes() == two.read_bytes()
        assert one.read_bytes().startswith(b"\x89PNG")
    assert not list(tmp_path.glob(".*.tmp"))
    # Refusals leave no figure.
    with pytest.raises(ProductError, match="dataset5, mse"):
        stage.figure_errors("dataset5", [tmp_path / "m.csv"], [("mse", tmp_path / "e.png")])
    with pytest.raises(ProductError, match="1 histories, but 2 labels"):
        stage.figure_curves(["one", "two"], [tmp_path / "h.csv"], tmp_path / "e.png")
    (tmp_path / "h.csv").write_text("step,train_mse\n1,2\n")
    with pytest.raises(ProductError, match="validation_mse"):
        stage.figure_curves(["one"], [tmp_path / "h.csv"], tmp_path / "e.png")
    assert not (tmp_path / "e.png").exists()
