"""Figures from tiny synthetic inputs and from the tables of the record."""

from __future__ import annotations

from itertools import product

import numpy as np
import pandas as pd
import pytest

import figures
from costs import load_points
from psfdae.base.figures import apply_style
from psfdae_paper.alignment.telescope import DEGREES_OF_FREEDOM
from psfdae_paper.evaluation.alignment_figures import draw_costs, draw_twins
from psfdae_paper.evaluation.curves import draw_errors, draw_training_curves
from psfdae_paper.evaluation.figures import draw_templates
from psfdae_paper.evaluation.paper import read_published
from psfdae_paper.source import SOURCES
from psfdae_paper.stars.fields import square_grid


@pytest.fixture
def record_table():
    """Function that reads a table of the run of record by its name."""
    return lambda name: pd.read_csv(SOURCES.parent / f"results/reference/tables/{name}.csv")


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


def test_template_map_shows_the_bright_pixel_where_it_belongs():
    row, column = 3, 0
    index, field = small_field()
    bright = int(np.flatnonzero((index == [2, 0]).all(axis=1))[0])
    figure = draw_templates(one_bright_pixel(9, bright, row, column), index, field, "templates")
    axes = figure.axes[0]
    x, y = np.rad2deg(field[bright])
    pixel = 1.1 / 5  # four pixels and a gap per field
    at = (x + (column - 1.5) * pixel, y + (row - 1.5) * pixel)
    opposite = (x - (column - 1.5) * pixel, y - (row - 1.5) * pixel)
    assert rgb_at(figure, axes, *at).min() > 0.7
    assert rgb_at(figure, axes, *opposite).max() < 0.1


def line_points(axes):
    """Coordinates of all lines of a panel, and whether each joins its points."""
    return [(line.get_xydata(), line.get_linestyle() != "None") for line in axes.get_lines()]


def test_dissimilarity_is_drawn_on_a_logarithmic_axis(record_table):
    metrics, paper = record_table("psf_metrics"), read_published("psf")
    figure = draw_errors(metrics, paper, "dataset3", "ssim", "a note")
    axes = figure.axes[0]
    rows = metrics[(metrics.dataset == "dataset3") & (metrics.metric == "ssim")]
    row = rows[(rows.reference == "realisation") & (rows.method == "dae")].iloc[0]
    points = np.concatenate([points for points, _ in line_points(axes)])
    nearest = points[np.abs(points[:, 0] - row.noise_level) < 1e-9, 1]
    assert np.abs(nearest - (1.0 - row.value)).min() == pytest.approx(0.0, abs=1e-12)
    assert axes.get_yscale() == "log"
    title = figure.get_suptitle()
    assert title.endswith("\na note") and str(row.n) in title


def test_training_on_the_middle_of_stamps_is_not_joined_with_the_validation():
    history = pd.DataFrame(
        {
            "step": [10, 20, 30, 40],
            "train_mse": [9e-5, 8e-5, 3e-5, 2e-5],
            "side_px": [8, 12, 16, 16],
            "validation_mse": [np.nan, 4e-5, np.nan, 2.5e-5],
        }
    )
    axes = draw_training_curves({"network": history}, "title").axes[0]
    dashed = [line for line in axes.get_lines() if line.get_linestyle() == "--"]
    assert [line.get_xdata().tolist() for line in dashed] == [[30, 40]]


def test_distance_of_a_twin_is_written_in_standard_deviations():
    curves = pd.DataFrame(
        [(0.002, 0.0, -1.0, 243.36), (0.002, 0.0, 1.0, 0.0), (0.002, 0.1, -1.0, 400.0)],
        columns=["noise_level", "defocus_mm", "position", "chi2"],
    )
    stamps = np.ones((3, 8, 8))
    figure = draw_twins(curves, [("in focus", stamps, 0.1 * stamps)], np.zeros(4))
    assert "15.6 σ" in [text.get_text() for text in figure.axes[0].texts]
    by_defocus = [points for points, _ in line_points(figure.axes[1])]
    assert by_defocus[0] == pytest.approx(np.array([(0.0, 15.6), (0.1, 20.0)]))


def test_refused_stress_has_no_error_and_cases_are_not_joined(record_table):
    table = record_table("stability_graded")
    axes = apply_style(figures.graded)(table).axes[0]
    refused = table[(table.case == "aberrations") & table.error.isna()].stress.tolist()
    upright = [points for points, joined in line_points(axes) if joined]
    assert refused and refused[0] in [points[0, 0] for points in upright]
    # Upright lines alone: they go through the whole panel at one stress.
    assert all(np.ptp(points[:, 0]) == 0 for points in upright if len(points))


def test_memory_is_not_extrapolated(record_table):
    table = record_table("benchmark_scaling")
    time, memory = apply_style(figures.scaling)(table).axes[:2]
    largest = table.stars[table.measured == "yes"].max()
    assert max(points[:, 0].max() for points, _ in line_points(memory)) == largest
    assert max(points[:, 0].max() for points, _ in line_points(time)) > largest


def test_costs_say_on_which_noise_levels_they_rest(record_table):
    table = record_table("benchmark_costs").assign(tight="yes", over_least_stderr=0.1)
    axes = apply_style(figures.costs)(table).axes
    titles = [each.get_title(loc="left") for each in axes]
    for dataset, rows in table.groupby("dataset"):
        levels = str(rows.noise_levels.iloc[0]).replace(" ", ", ")
        assert f"{dataset}: {rows.stars.iloc[0]} stars, λ = {levels}" in titles


def test_costs_of_datasets_with_other_methods_have_all_points_but_trials(record_table):
    table = record_table("posterior_network")
    panels = apply_style(figures.costs)(table).axes[::2]
    trials = load_points().trials
    is_trial = np.array([r.point in trials.get(r.method, {}) for r in table.itertuples()])
    assert table.dataset.nunique() == len(panels) == 3 and is_trial.any()
    for axes, (dataset, rows) in zip(panels, table.groupby("dataset"), strict=True):
        drawn_s = np.concatenate([points[:, 0] for points, _ in line_points(axes)])
        is_drawn = np.isin(rows.fit_cpu_s, drawn_s)
        np.testing.assert_array_equal(is_drawn, ~is_trial[rows.index], err_msg=dataset)


@pytest.mark.parametrize(("tight", "expected"), [("yes", 0), ("no", 1)])
def test_methods_whose_bound_is_not_tight_have_open_markers(record_table, tight, expected):
    table = record_table("benchmark_costs").assign(tight="yes", over_least_stderr=0.1)
    table.loc[table.method == "gmm_position", "tight"] = tight
    figure = apply_style(figures.costs)(table)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels.count("over an upper limit of it") == expected
    # Its markers in the panel of the stars, one for each dataset, and no others.
    panels = figure.axes[1::2]
    is_open = [line.get_mfc() == "white" for axes in panels for line in axes.lines]
    assert sum(is_open) == expected * len(panels)


def test_alignment_errors_are_divided_by_the_bound_of_the_same_unknowns():
    """Twice the bound with flux given, three times the one with unknown flux; grid states apart."""
    mean_errors = {"noise_trained": 0.02, "cramer_rao": 0.01}
    mean_errors |= {"max_likelihood_free": 0.06, "cramer_rao_free": 0.02}
    keys = product(
        ("uniform", "grid"), (0.0, 0.002), mean_errors, DEGREES_OF_FREEDOM, ("range", "m")
    )
    names = ["test_set", "noise_level", "method", "parameter", "unit"]
    errors = pd.DataFrame(keys, columns=names)
    factor = np.where(errors.test_set == "uniform", 1.0, 7.0) * np.where(
        errors.unit == "m", 9.0, 1.0
    )
    errors["mean_abs_error"] = factor * errors.method.map(mean_errors)
    # 10 % of the error, over √25 states.
    errors = errors.assign(variance_abs=(0.1 * errors.mean_abs_error) ** 2, n=25)
    times = pd.DataFrame(
        {
            "method": ["noise_trained", "max_likelihood_free"],
            "seconds_per_state": [1e-3, 4e-2],
            "training_seconds": [50.0, 60.0],
        }
    )
    training, estimate = draw_costs(errors, times).axes
    for axes, costs in ((training, [50.0, 60.0]), (estimate, [1.0, 40.0])):
        points = [bars.lines[0].get_xydata()[0] for bars in axes.containers]
        np.testing.assert_allclose(points, list(zip(costs, [2.0, 3.0], strict=True)), rtol=1e-12)
        bars = [np.ptp(b.lines[2][0].get_segments()[0][:, 1]) for b in axes.containers]
        np.testing.assert_allclose(bars, [2 * 0.02 * 2.0, 2 * 0.02 * 3.0], rtol=1e-9)
