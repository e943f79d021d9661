"""Figures of a sweep: all points at once, and the metric against each axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from psfdae.figures import SERIES_COLORS, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

METRIC_LABELS = {
    "mse": "MSE, geometric mean over λ",
    "ssim": "SSIM, mean over λ",
    "mae": "mean absolute error / range",
}
"""Labels of axes by metric."""

Style = dict[str, Any]
"""Keyword arguments of a line."""

FAILED_HEIGHT = -0.09
"""Height on the axis of the metric where lines of failed points end, below its scale 0 … 1."""


@dataclass(frozen=True)
class Scale:
    """Coordinates of the values of an axis, and its ticks.

    Attributes
    ----------
    coordinate : ndarray, shape (n,)
        Coordinate of every point: its number, that number's logarithm, or the number
        of its option.
    ticks : ndarray
        Coordinates of the ticks.
    labels : list of str
        Labels of the ticks.
    numeric : bool
        Values are numbers.
    """

    coordinate: np.ndarray
    ticks: np.ndarray
    labels: list[str]
    numeric: bool = True

    def to_unit(self, coordinate: np.ndarray) -> np.ndarray:
        """Scale coordinates so that the smallest and largest of this axis become 0 and 1."""
        low, high = np.nanmin(self.coordinate), np.nanmax(self.coordinate)
        constant = np.full(np.shape(coordinate), 0.5)
        return (coordinate - low) / (high - low) if high > low else constant


def scale_of(texts: Sequence[str], logarithmic: bool = False) -> Scale:
    """Make the scale of an axis from the texts in its column.

    Parameters
    ----------
    texts : sequence of str
        Numbers, which keep their distances, or options, which follow each other.
    logarithmic : bool
        The scale of numbers is logarithmic; otherwise their range decides.
    """
    try:
        numbers = np.array([float(text) for text in texts])
    except ValueError:
        options = list(dict.fromkeys(texts))
        return Scale(
            np.array([options.index(text) for text in texts], dtype=float),
            np.arange(len(options), dtype=float),
            [option if len(option) <= 18 else option[:17] + "…" for option in options],
            numeric=False,
        )
    # Positive numbers whose largest is 5 times the smallest or more are on a logarithmic scale.
    has_wide_range = numbers.min() > 0 and numbers.max() >= 5.0 * numbers.min()
    is_log = (logarithmic or has_wide_range) and numbers.min() > 0
    values = np.unique(numbers)
    # A tick at each value, or five ticks if there are many.
    if values.size > 9:
        ends = np.log10(values[[0, -1]]) if is_log else values[[0, -1]]
        ticks = np.linspace(ends[0], ends[1], 5)
        labels = [f"{value:.2g}" for value in (10.0**ticks if is_log else ticks)]
    else:
        ticks = np.log10(values) if is_log else values
        labels = [f"{value:g}" for value in values]
    return Scale(np.log10(numbers) if is_log else numbers, ticks, labels)


@styled
def parallel_coordinates(
    table: pd.DataFrame, described: Mapping[str, Any], axes: Sequence[str], logs: Sequence[str]
) -> Figure:
    """Draw every point as a line over the axes of the sweep, coloured by its validation metric.

    Parameters
    ----------
    table : DataFrame
        Summary of the sweep, the columns of the axes as text.
    described : mapping
        sweep, metric and direction.
    axes : sequence of str
        Columns of the settings that the sweep varies.
    logs : sequence of str
        Axes that are logarithmic.
    """
    from matplotlib import colormaps
    from matplotlib.lines import Line2D

    # Height of every line on every axis, from 0 to 1; the last axis is the metric.
    metric = described["metric"]
    metric_values = _column(table, metric)
    succeeded = np.isfinite(metric_values)
    values = metric_values[succeeded]
    scales = {name: scale_of(table[name].tolist(), name in logs) for name in axes}
    metric_scale = scale_of([f"{value:.3g}" for value in values], metric != "validation_ssim")
    # Rank of every point, from 0, the best, to 1: it decides the colour of its line.
    order = np.argsort(values if described["direction"] == "minimize" else -values, kind="stable")
    rank = np.argsort(order, kind="stable") / max(values.size - 1, 1)
    heights = np.full((len(table), len(axes) + 1), FAILED_HEIGHT)
    # Lines of a grid would lie on each other: they leave an axis at slightly different heights.
    offset = np.zeros(len(table))
    offset[succeeded] = 0.025 * (2.0 * rank - 1.0)
    for i, scale in enumerate(scales.values()):
        heights[:, i] = scale.to_unit(scale.coordinate) + offset
    coordinate = np.log10(values) if _is_log(metric) else values
    heights[succeeded, -1] = metric_scale.to_unit(coordinate)
    figure = new_figure(4.4, layout="constrained")
    panel = figure.add_subplot()
    # Lines from the largest to the smallest value of the metric; failed ones are grey and dotted.
    colors = np.full((len(table), 4), (0.6, 0.6, 0.6, 1.0))
    colors[succeeded] = colormaps["viridis"](0.92 * rank)
    is_best = (table["best"] == "yes").to_numpy()
    for i in np.argsort(np.where(succeeded, -metric_values, -np.inf), kind="stable"):
        style = "-" if succeeded[i] else ":"
        panel.plot(heights[i], color=colors[i], ls=style, lw=3.2 if is_best[i] else 1.1)
    _draw_vertical_scales(panel, [*scales.values(), _with_metric_ticks(metric_scale, metric)])
    panel.set_xticks(range(len(axes) + 1), [*axes, f"validation\n{_label(metric)}"])
    bottom = -0.06 if succeeded.all() else FAILED_HEIGHT - 0.06
    panel.set(ylim=(bottom, 1.06), xlim=(-0.25, len(axes) + 0.35), yticks=[])
    panel.set_title(f"Sweep {described['sweep']}: {len(table)} points")
    handles = [Line2D([], [], color=colormaps["viridis"](0.0), lw=3.2, label="best point")]
    handles += [Line2D([], [], color=colormaps["viridis"](0.92), lw=1.1, label="worst point")]
    if not succeeded.all():
        handles += [Line2D([], [], color="0.6", ls=":", label=f"failed: {(~succeeded).sum()}")]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    for side in ("top", "right", "left", "bottom"):
        panel.spines[side].set_visible(False)
    panel.tick_params(axis="x", length=0)
    return figure


@styled
def response_curves(
    table: pd.DataFrame, described: Mapping[str, Any], axes: Sequence[str], logs: Sequence[str]
) -> Figure:
    """Draw validation and test metric against each axis of the sweep.

    The line of a panel joins the best validation values of listed numbers; in a grid of
    two axes there is one line for every value of the other axis. A sweep of one axis has a
    second panel with the metric at every noise level. Parameters are those of
    `parallel_coordinates`.
    """
    # Name of the axis of each panel, and True for the panel of noise levels.
    contents = [(name, False) for name in axes] + ([(axes[0], True)] if len(axes) == 1 else [])
    columns = min(len(contents), 2)
    rows = -(-len(contents) // columns)
    figure = new_figure(0.9 + 3.3 * rows, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey="row").ravel()
    for panel, (name, by_level) in zip(panels, contents, strict=False):
        scale = scale_of(table[name].tolist(), name in logs)
        # Only listed numbers are joined; draws from a range are scattered.
        joined = scale.numeric and described["space"][name].get("low") is None
        draw = _draw_noise_levels if by_level else _draw_points
        title = draw(panel, table, scale, described, name, joined)
        if _is_log(described["metric"]):
            panel.set_yscale("log")
        panel.set_xticks(scale.ticks, scale.labels)
        panel.set_xlabel(name)
        panel.grid(True, which="major")
        if title:
            panel.legend(title=title, title_fontsize=8)
    for panel in panels[len(contents) :]:
        panel.set_visible(False)
    for row in range(rows):
        panels[row * columns].set_ylabel(_label(described["metric"]))
    failed = ", × failed" if (table["status"] == "failed").any() else ""
    figure.suptitle(
        f"Sweep {described['sweep']}: filled validation, open test, star the best{failed}"
    )
    return figure


def _draw_points(
    panel: Axes,
    table: pd.DataFrame,
    scale: Scale,
    described: Mapping[str, Any],
    name: str,
    joined: bool,
) -> str:
    """Draw every point, and lines through the best; return the axis that the lines stand for."""
    metric = described["metric"]
    validation = _column(table, metric)
    test = _column(table, metric.replace("validation", "test"))
    succeeded = np.isfinite(validation)
    # In a grid of two axes each value of the second axis has a line, if there are at most six.
    further_axes = [axis for axis in described["space"] if axis != name]
    line_axis = further_axes[0] if described["kind"] == "grid" and len(further_axes) == 1 else ""
    if line_axis and table[line_axis].nunique() > 6:
        line_axis = ""
    for number, value in enumerate(dict.fromkeys(table[line_axis]) if line_axis else [""]):
        color = SERIES_COLORS[number % len(SERIES_COLORS)]
        members = succeeded & ((table[line_axis] == value).to_numpy() if line_axis else True)
        coordinate = scale.coordinate[members]
        # The line joins the best validation value at each coordinate.
        positions = np.unique(coordinate)
        best_of = np.min if described["direction"] == "minimize" else np.max
        heights = [best_of(validation[members][coordinate == x]) for x in positions]
        style: Style = {"ls": "-" if joined else "", "lw": 1.3, "label": value}
        panel.plot(positions, heights, marker="o", ms=4, color=color, **style)
        panel.plot(coordinate, validation[members], ls="", marker="o", ms=4, color=color)
        panel.plot(coordinate, test[members], ls="", marker="o", ms=7, mfc="none", mec=color)
    is_best = (table["best"] == "yes").to_numpy()
    star: Style = {"ls": "", "marker": "*", "ms": 14, "mfc": "none", "mec": "black"}
    panel.plot(scale.coordinate[is_best], validation[is_best], **star)
    # Failed points are crosses at the upper edge of the panel.
    cross: Style = {"ls": "", "marker": "x", "ms": 6, "color": "0.4"}
    top = np.full((~succeeded).sum(), 0.97)
    transform = panel.get_xaxis_transform()
    panel.plot(scale.coordinate[~succeeded], top, transform=transform, **cross)
    return line_axis


def _draw_noise_levels(
    panel: Axes,
    table: pd.DataFrame,
    scale: Scale,
    described: Mapping[str, Any],
    name: str,
    joined: bool,
) -> str:
    """Draw the metric at every noise level; return the quantity that the lines stand for."""
    # The table has a column METRIC_LEVEL for each noise level.
    prefix = f"{described['metric']}_"
    columns = [column for column in table.columns if column.startswith(prefix)]
    order = np.argsort(scale.coordinate)
    for number, column in enumerate(columns):
        color = SERIES_COLORS[number % len(SERIES_COLORS)]
        style: Style = {
            "ls": "-" if joined else "",
            "lw": 1.3,
            "label": column.removeprefix(prefix),
        }
        validation = _column(table, column)[order]
        panel.plot(scale.coordinate[order], validation, marker="o", ms=4, color=color, **style)
        test = _column(table, column.replace("validation", "test"))
        panel.plot(scale.coordinate, test, ls="", marker="o", ms=7, mfc="none", mec=color)
    return "noise level λ"


def _draw_vertical_scales(panel: Axes, scales: Sequence[Scale]) -> None:
    """Draw an upright line for each axis, with its ticks and their labels."""
    for i, scale in enumerate(scales):
        panel.plot([i, i], [0, 1], color="black", lw=0.9, zorder=3)
        for height, label in zip(scale.to_unit(scale.ticks), scale.labels, strict=True):
            panel.plot([i - 0.012, i + 0.012], [height, height], color="black", lw=0.9, zorder=3)
            panel.annotate(
                label,
                (i, height),
                xytext=(5, 0),
                textcoords="offset points",
                va="center",
                fontsize=8,
                zorder=4,
                bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8},
            )


def _with_metric_ticks(scale: Scale, metric: str) -> Scale:
    """Return the scale of a metric with five evenly spaced ticks instead of one per point."""
    low, high = np.nanmin(scale.coordinate), np.nanmax(scale.coordinate)
    ticks = np.linspace(low, high, 5) if high > low else np.array([low])
    values = 10.0**ticks if _is_log(metric) else ticks
    digits = ".2e" if metric.endswith("mse") else ".3g"
    return Scale(scale.coordinate, ticks, [format(value, digits) for value in values])


def _column(table: pd.DataFrame, name: str) -> np.ndarray:
    """Return a column of numbers; NaN where a point failed."""
    return table[name].to_numpy(dtype=float)


def _is_log(metric: str) -> bool:
    """Return True if a metric is drawn on a logarithmic scale: all but the SSIM."""
    return not metric.endswith("ssim")


def _label(metric: str) -> str:
    """Return the label of the axis of a validation metric."""
    return METRIC_LABELS[metric.removeprefix("validation_")]
