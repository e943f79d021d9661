"""Figures of a sweep: all points at once, and the metric against each axis.

Functions take the summary of a sweep and its definition and return matplotlib figures. Numbers of
an axis are drawn at their distances, options one after the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from psfdae.base.figures import SERIES_COLORS, apply_style, new_figure
from psfdae.base.types import Axes, Figure
from psfdae_paper.evaluation.drawing import Style, make_entry


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
        # An axis of one value lies in the middle.
        low, high = np.nanmin(self.coordinate), np.nanmax(self.coordinate)
        constant = np.full(np.shape(coordinate), 0.5)
        return (coordinate - low) / (high - low) if high > low else constant

    def draw_upright(self, panel: Axes, x: float) -> None:
        """Draw an upright line at `x`, with the ticks of this axis and their labels."""
        # The line from the smallest to the largest value, then a stroke and a label at each tick.
        panel.plot([x, x], [0, 1], color="black", lw=0.9, zorder=3)
        for height, label in zip(self.to_unit(self.ticks), self.labels, strict=True):
            panel.plot([x - 0.012, x + 0.012], [height, height], color="black", lw=0.9, zorder=3)
            # Labels are above the lines of the points, on white that lets them shine through.
            box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8}
            style: Style = {"va": "center", "fontsize": 8, "zorder": 4, "bbox": box}
            panel.annotate(label, (x, height), (5, 0), textcoords="offset points", **style)


def to_scale(texts: Sequence[str], logarithmic: bool = False) -> Scale:
    """Make the scale of an axis from the texts in its column.

    Parameters
    ----------
    texts : sequence of str
        Numbers, which keep their distances, or options, which follow each other.
    logarithmic : bool
        The scale of numbers is logarithmic; otherwise their range decides.
    """
    try:
        # Texts other than numbers are options: they follow each other at equal distances.
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


@dataclass(frozen=True)
class SweepPoints:
    """Points of a sweep, and the metric by which they are compared.

    Attributes
    ----------
    table : DataFrame
        Summary of the sweep, a row for each point, the columns of the axes as text.
    definition : mapping
        Definition of the sweep: sweep (its name), kind, metric, direction, space.
    """

    table: pd.DataFrame
    definition: Mapping[str, Any]

    @property
    def metric(self) -> str:
        """Column of the metric that chooses the best point."""
        return str(self.definition["metric"])

    @property
    def is_logarithmic(self) -> bool:
        """True if the metric is drawn on a logarithmic scale: all but the SSIM."""
        return self.metric != "validation_ssim"

    @property
    def label(self) -> str:
        """Label of the axis of the metric."""
        return {
            "validation_mse": "MSE, geometric mean over λ",
            "validation_ssim": "SSIM, mean over λ",
            "validation_mae": "mean absolute error / range",
        }[self.metric]

    @property
    def is_best(self) -> np.ndarray:
        """True for the best point, shape (n,)."""
        return (self.table["best"] == "yes").to_numpy()

    def errors(self, column: str) -> tuple[np.ndarray, np.ndarray]:
        """Return a validation metric and the same of the test part, (n,); NaN where points failed.

        `column` is the metric, or METRIC_LEVEL for one noise level.
        """
        # Columns of the test part differ by this word alone.
        names = (column, column.replace("validation", "test"))
        validation, test = (self.table[name].to_numpy(dtype=float) for name in names)
        return validation, test

    def scale(self, name: str) -> Scale:
        """Return the scale of an axis; it is logarithmic if its range is."""
        return to_scale(self.table[name].tolist(), bool(self.definition["space"][name].get("log")))

    def draw(self, panel: Axes, scale: Scale, name: str, line: Style) -> str:
        """Draw all points, and lines through the best; return the axis that the lines stand for."""
        table, definition = self.table, self.definition
        # Points that failed lack the metric.
        validation, test = self.errors(self.metric)
        has_metric = np.isfinite(validation)
        # In a grid of two axes each value of the second axis has a line, if there are at most six.
        second_axes = [axis for axis in definition["space"] if axis != name]
        line_axis = second_axes[0] if definition["kind"] == "grid" and len(second_axes) == 1 else ""
        if line_axis and table[line_axis].nunique() > 6:
            line_axis = ""
        for number, value in enumerate(dict.fromkeys(table[line_axis]) if line_axis else [""]):
            color = SERIES_COLORS[number % len(SERIES_COLORS)]
            members = has_metric & ((table[line_axis] == value).to_numpy() if line_axis else True)
            coordinate = scale.coordinate[members]
            # The line joins the best validation value at each coordinate.
            positions = np.unique(coordinate)
            best_of = np.min if definition["direction"] == "minimize" else np.max
            heights = [best_of(validation[members][coordinate == x]) for x in positions]
            panel.plot(positions, heights, marker="o", ms=4, color=color, **line, label=value)
            panel.plot(coordinate, validation[members], ls="", marker="o", ms=4, color=color)
            panel.plot(coordinate, test[members], **_open_marker(color))
        # The best point has a star around its marker.
        star: Style = {"ls": "", "marker": "*", "ms": 14, "mfc": "none", "mec": "black"}
        panel.plot(scale.coordinate[self.is_best], validation[self.is_best], **star)
        # Failed points are crosses at the upper edge of the panel.
        cross: Style = {"ls": "", "marker": "x", "ms": 6, "color": "0.4"}
        top = np.full((~has_metric).sum(), 0.97)
        transform = panel.get_xaxis_transform()
        panel.plot(scale.coordinate[~has_metric], top, transform=transform, **cross)
        return line_axis

    def draw_noise_levels(self, panel: Axes, scale: Scale, name: str, line: Style) -> str:
        """Draw the metric at every noise level; return the quantity that the lines stand for."""
        # The table has a column METRIC_LEVEL for each noise level.
        prefix = f"{self.metric}_"
        columns = [column for column in self.table.columns if column.startswith(prefix)]
        # Validation as a line with filled markers, test as open ones, one colour for each level.
        order = np.argsort(scale.coordinate)
        for number, column in enumerate(columns):
            style = {**line, "color": SERIES_COLORS[number % len(SERIES_COLORS)]}
            validation, test = self.errors(column)
            style["label"] = column.removeprefix(prefix)
            panel.plot(scale.coordinate[order], validation[order], marker="o", ms=4, **style)
            panel.plot(scale.coordinate, test, **_open_marker(style["color"]))
        return "noise level λ"


@apply_style
def draw_parallel_coordinates(points: SweepPoints) -> Figure:
    """Draw every point as a line over the axes of the sweep, coloured by its validation metric."""
    from matplotlib import colormaps

    # Heights of every line on every axis, from 0 to 1; the last axis is the metric.
    names, table = list(points.definition["space"]), points.table
    metric_values, _ = points.errors(points.metric)
    # Points that failed lack a metric, and so a rank.
    has_metric = np.isfinite(metric_values)
    values = metric_values[has_metric]
    scales = [points.scale(name) for name in names]
    # Rank of every point, from 0, the best, to 1: it decides the colour of its line.
    direction = points.definition["direction"]
    order = np.argsort(values if direction == "minimize" else -values, kind="stable")
    rank = np.argsort(order, kind="stable") / max(values.size - 1, 1)
    # Lines of failed points end below the scale of the metric.
    failed_height = -0.09
    heights = np.full((len(table), len(names) + 1), failed_height)
    # Lines of a grid would lie on each other: they leave an axis at slightly different heights.
    offset = np.zeros(len(table))
    offset[has_metric] = 0.025 * (2.0 * rank - 1.0)
    for i, scale in enumerate(scales):
        heights[:, i] = scale.to_unit(scale.coordinate) + offset
    # The scale of the metric has five evenly spaced ticks instead of one per point.
    metric_scale = to_scale([f"{value:.3g}" for value in values], points.is_logarithmic)
    coordinate = np.log10(values) if points.is_logarithmic else values
    heights[has_metric, -1] = metric_scale.to_unit(coordinate)
    low, high = np.nanmin(metric_scale.coordinate), np.nanmax(metric_scale.coordinate)
    ticks = np.linspace(low, high, 5) if high > low else np.array([low])
    digits = ".2e" if points.metric.endswith("mse") else ".3g"
    tick_values = 10.0**ticks if points.is_logarithmic else ticks
    scales.append(
        replace(metric_scale, ticks=ticks, labels=[format(v, digits) for v in tick_values])
    )
    figure = new_figure(4.4, layout="constrained")
    panel = figure.add_subplot()
    # Lines from the largest to the smallest value of the metric; failed ones are grey and dotted.
    colors = np.full((len(table), 4), (0.6, 0.6, 0.6, 1.0))
    colors[has_metric] = colormaps["viridis"](0.92 * rank)
    for i in np.argsort(np.where(has_metric, -metric_values, -np.inf), kind="stable"):
        style = "-" if has_metric[i] else ":"
        panel.plot(heights[i], color=colors[i], ls=style, lw=3.2 if points.is_best[i] else 1.1)
    for i, scale in enumerate(scales):
        scale.draw_upright(panel, i)
    # Names of the axes below them; the frame of the panel would look like another axis.
    panel.set_xticks(range(len(names) + 1), [*names, f"validation\n{points.label}"])
    bottom = -0.06 if has_metric.all() else failed_height - 0.06
    panel.set(ylim=(bottom, 1.06), xlim=(-0.25, len(names) + 0.35), yticks=[])
    panel.set_title(f"Sweep {points.definition['sweep']}: {len(table)} points")
    panel.spines[:].set_visible(False)
    panel.tick_params(axis="x", length=0)
    # Colours run from the best point to the worst, by rank.
    handles = [make_entry("best point", color=colormaps["viridis"](0.0), lw=3.2)]
    handles += [make_entry("worst point", color=colormaps["viridis"](0.92), lw=1.1)]
    if not has_metric.all():
        handles += [make_entry(f"failed: {(~has_metric).sum()}", color="0.6", ls=":")]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


@apply_style
def draw_response_curves(points: SweepPoints) -> Figure:
    """Draw validation and test metric against each axis of the sweep.

    The line of a panel joins the best validation values of listed numbers; in a grid of
    two axes there is one line for every value of the other axis. A sweep of one axis has a
    second panel with the metric at every noise level.
    """
    # Name of the axis of each panel, and the function that draws it.
    names = list(points.definition["space"])
    contents = [(name, points.draw) for name in names]
    if len(names) == 1:
        contents.append((names[0], points.draw_noise_levels))
    # Two panels side by side; panels of a row share the axis of the metric.
    columns = min(len(contents), 2)
    rows = -(-len(contents) // columns)
    figure = new_figure(0.9 + 3.3 * rows, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey="row").ravel()
    for panel, (name, draw) in zip(panels, contents, strict=False):
        scale = points.scale(name)
        # Only listed numbers are joined; draws from a range are scattered.
        is_joined = scale.numeric and points.definition["space"][name].get("low") is None
        # The legend's title is the quantity that the lines stand for.
        title = draw(panel, scale, name, {"ls": "-" if is_joined else "", "lw": 1.3})
        if points.is_logarithmic:
            panel.set_yscale("log")
        panel.set_xticks(scale.ticks, scale.labels)
        panel.set_xlabel(name)
        panel.grid(True, which="major")
        if title:
            panel.legend(title=title, title_fontsize=8)
    for panel in panels[len(contents) :]:
        panel.set_visible(False)
    for row in range(rows):
        panels[row * columns].set_ylabel(points.label)
    # Crosses are explained if a point has failed.
    cross_text = ", × failed" if (points.table["status"] == "failed").any() else ""
    name = points.definition["sweep"]
    figure.suptitle(f"Sweep {name}: filled validation, open test, star the best{cross_text}")
    return figure


def _open_marker(color: str) -> Style:
    """Return the style of test metrics: open markers without a line."""
    return {"ls": "", "marker": "o", "ms": 7, "mfc": "none", "mec": color}
