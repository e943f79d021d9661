"""Figures of a sweep: all points at once, and the metric against each axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.figures import SERIES_COLORS, new_figure, styled

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

METRIC_LABELS = {
    "mse": "MSE, geometric mean over λ",
    "ssim": "SSIM, mean over λ",
    "mae": "mean absolute error / range",
}
LOGARITHMIC_FROM = 5.0
"""Numbers whose largest is this many times the smallest go on a logarithmic scale."""

MOST_LINES = 6
"""Lines of one panel that can still be distinguished."""

FAILED_AT = -0.09
"""Where failed points end on the axis of the metric, below its scale."""


@dataclass(frozen=True)
class Scale:
    """Where the values of an axis are drawn, and its ticks.

    Attributes
    ----------
    at : ndarray, shape (n,)
        Coordinate of every point: its number, that number's logarithm, or the number
        of its option.
    ticks : ndarray
    labels : list of str
    numeric : bool
        Values are numbers.
    """

    at: np.ndarray
    ticks: np.ndarray
    labels: list[str]
    numeric: bool = True

    @property
    def unit(self) -> np.ndarray:
        """Coordinates with 0 and 1 at the ends."""
        return self.to_unit(self.at)

    def to_unit(self, at: np.ndarray) -> np.ndarray:
        """Coordinates as `unit` has them."""
        low, high = np.nanmin(self.at), np.nanmax(self.at)
        return (at - low) / (high - low) if high > low else np.full(np.shape(at), 0.5)


def scale_of(texts: Sequence[str], logarithmic: bool = False) -> Scale:
    """Scale of an axis from the texts in its column.

    Parameters
    ----------
    texts : sequence of str
        Numbers, which keep their distances, or options, which follow each other.
    logarithmic : bool
        Numbers drawn evenly in the logarithm; decided from their range otherwise.
    """
    try:
        numbers = np.array([float(text) for text in texts])
    except ValueError:
        options = list(dict.fromkeys(texts))
        return Scale(
            np.array([options.index(text) for text in texts], dtype=float),
            np.arange(len(options), dtype=float),
            [_short(option) for option in options],
            numeric=False,
        )
    wide = numbers.min() > 0 and numbers.max() >= LOGARITHMIC_FROM * numbers.min()
    logs = (logarithmic or wide) and numbers.min() > 0
    different = np.unique(numbers)
    if different.size > 9:
        ends = np.log10(different[[0, -1]]) if logs else different[[0, -1]]
        ticks = np.linspace(ends[0], ends[1], 5)
        labels = [f"{value:.2g}" for value in (10.0**ticks if logs else ticks)]
    else:
        ticks = np.log10(different) if logs else different
        labels = [f"{value:g}" for value in different]
    return Scale(np.log10(numbers) if logs else numbers, ticks, labels)


@styled
def parallel_coordinates(
    table: pd.DataFrame, described: Mapping[str, Any], axes: Sequence[str], logs: Sequence[str]
) -> Figure:
    """Every point as a line over the axes of the sweep, coloured by its validation metric.

    Parameters
    ----------
    table : DataFrame
        Summary of the sweep, the columns of the axes as text.
    described : mapping
        sweep, metric and direction.
    axes : sequence of str
    logs : sequence of str
        Axes that are logarithmic.
    """
    from matplotlib import colormaps
    from matplotlib.lines import Line2D

    metric = described["metric"]
    found = _metric(table, metric)
    good = np.isfinite(found)
    scales = {name: scale_of(table[name].tolist(), name in logs) for name in axes}
    outcome = scale_of([f"{v:.3g}" for v in found[good]], metric != "validation_ssim")
    order = _ranks(found[good] if described["direction"] == "minimize" else -found[good])
    columns = np.full((len(table), len(axes) + 1), FAILED_AT)
    # Lines of a grid would lie on each other: they leave an axis at slightly different heights.
    spread = np.zeros(len(table))
    spread[good] = 0.025 * (2.0 * order - 1.0)
    for i, scale in enumerate(scales.values()):
        columns[:, i] = scale.unit + spread
    columns[good, -1] = outcome.to_unit(np.log10(found[good]) if _is_log(metric) else found[good])
    figure = new_figure(4.4, layout="constrained")
    panel = figure.add_subplot()
    colors = np.full((len(table), 4), (0.6, 0.6, 0.6, 1.0))
    colors[good] = colormaps["viridis"](0.92 * order)
    best = (table["best"] == "yes").to_numpy()
    for i in np.argsort(np.where(good, -found, -np.inf), kind="stable"):
        style = "-" if good[i] else ":"
        panel.plot(columns[i], color=colors[i], ls=style, lw=3.2 if best[i] else 1.1)
    _vertical_scales(panel, [*scales.values(), _metric_scale(outcome, metric)])
    panel.set_xticks(range(len(axes) + 1), [*axes, f"validation\n{_label(metric)}"])
    bottom = -0.06 if good.all() else FAILED_AT - 0.06
    panel.set(ylim=(bottom, 1.06), xlim=(-0.25, len(axes) + 0.35), yticks=[])
    panel.set_title(f"Sweep {described['sweep']}: {len(table)} points")
    handles = [Line2D([], [], color=colormaps["viridis"](0.0), lw=3.2, label="best point")]
    handles += [Line2D([], [], color=colormaps["viridis"](0.92), lw=1.1, label="worst point")]
    if not good.all():
        handles += [Line2D([], [], color="0.6", ls=":", label=f"failed: {(~good).sum()}")]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    for side in ("top", "right", "left", "bottom"):
        panel.spines[side].set_visible(False)
    panel.tick_params(axis="x", length=0)
    return figure


@styled
def response_curves(
    table: pd.DataFrame, described: Mapping[str, Any], axes: Sequence[str], logs: Sequence[str]
) -> Figure:
    """Validation and test metric against each axis of the sweep.

    The line of a panel joins the best validation values of listed numbers; in a grid of
    two axes there is one line for every value of the other axis. A sweep of one axis has a
    second panel with the metric at every noise level. Parameters are those of
    `parallel_coordinates`.
    """
    shown = [(name, False) for name in axes] + ([(axes[0], True)] if len(axes) == 1 else [])
    columns = min(len(shown), 2)
    rows = -(-len(shown) // columns)
    figure = new_figure(0.9 + 3.3 * rows, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey="row").ravel()
    for panel, (name, by_level) in zip(panels, shown, strict=False):
        scale = scale_of(table[name].tolist(), name in logs)
        joined = scale.numeric and described["space"][name].get("low") is None
        title = (_level_lines if by_level else _point_lines)(
            panel, table, scale, described, name, joined
        )
        if _is_log(described["metric"]):
            panel.set_yscale("log")
        panel.set_xticks(scale.ticks, scale.labels)
        panel.set_xlabel(name)
        panel.grid(True, which="major")
        if title:
            panel.legend(title=title, title_fontsize=8)
    for panel in panels[len(shown) :]:
        panel.set_visible(False)
    for row in range(rows):
        panels[row * columns].set_ylabel(_label(described["metric"]))
    failed = ", × failed" if (table["status"] == "failed").any() else ""
    figure.suptitle(
        f"Sweep {described['sweep']}: filled validation, open test, star the best{failed}"
    )
    return figure


def _point_lines(
    panel: Axes,
    table: pd.DataFrame,
    scale: Scale,
    described: Mapping[str, Any],
    name: str,
    joined: bool,
) -> str:
    """Every point, and lines through the best; returns what the lines stand for."""
    metric = described["metric"]
    found, tested = (_metric(table, m) for m in (metric, metric.replace("validation", "test")))
    others = [other for other in described["space"] if other != name]
    lines = others[0] if described["kind"] == "grid" and len(others) == 1 else ""
    if lines and table[lines].nunique() > MOST_LINES:
        lines = ""
    for number, value in enumerate(dict.fromkeys(table[lines]) if lines else [""]):
        color = SERIES_COLORS[number % len(SERIES_COLORS)]
        own = np.isfinite(found) & ((table[lines] == value).to_numpy() if lines else True)
        places = np.unique(scale.at[own])
        pick = np.min if described["direction"] == "minimize" else np.max
        heights = [pick(found[own & (scale.at == place)]) for place in places]
        style = "-" if joined else ""
        panel.plot(places, heights, ls=style, marker="o", ms=4, color=color, lw=1.3, label=value)
        panel.plot(scale.at[own], found[own], ls="", marker="o", ms=4, color=color)
        panel.plot(scale.at[own], tested[own], ls="", marker="o", ms=7, mfc="none", mec=color)
    best = (table["best"] == "yes").to_numpy()
    panel.plot(scale.at[best], found[best], ls="", marker="*", ms=14, mfc="none", mec="black")
    failed = ~np.isfinite(found)
    panel.plot(
        scale.at[failed],
        np.full(failed.sum(), 0.97),
        transform=panel.get_xaxis_transform(),
        ls="",
        marker="x",
        ms=6,
        color="0.4",
    )
    return lines


def _level_lines(
    panel: Axes,
    table: pd.DataFrame,
    scale: Scale,
    described: Mapping[str, Any],
    name: str,
    joined: bool,
) -> str:
    """The metric at every noise level; returns what the lines stand for."""
    prefix = f"{described['metric']}_"
    columns = [column for column in table.columns if column.startswith(prefix)]
    order = np.argsort(scale.at)
    for number, column in enumerate(columns):
        color = SERIES_COLORS[number % len(SERIES_COLORS)]
        tested = _metric(table, column.replace("validation", "test"))
        panel.plot(
            scale.at[order],
            _metric(table, column)[order],
            label=column.removeprefix(prefix),
            ls="-" if joined else "",
            marker="o",
            ms=4,
            lw=1.3,
            color=color,
        )
        panel.plot(scale.at, tested, ls="", marker="o", ms=7, mfc="none", mec=color)
    return "noise level λ"


def _vertical_scales(panel: Axes, scales: Sequence[Scale]) -> None:
    """An upright line for each axis with its ticks' labels beside."""
    for i, scale in enumerate(scales):
        panel.plot([i, i], [0, 1], color="black", lw=0.9, zorder=3)
        for at, label in zip(scale.to_unit(scale.ticks), scale.labels, strict=True):
            panel.plot([i - 0.012, i + 0.012], [at, at], color="black", lw=0.9, zorder=3)
            panel.annotate(
                label,
                (i, at),
                xytext=(5, 0),
                textcoords="offset points",
                va="center",
                fontsize=8,
                zorder=4,
                bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8},
            )


def _metric_scale(outcome: Scale, metric: str) -> Scale:
    """Five ticks along the metric, whatever values the points have."""
    ends = np.array([np.nanmin(outcome.at), np.nanmax(outcome.at)])
    ticks = np.linspace(ends[0], ends[1], 5) if ends[1] > ends[0] else ends[:1]
    values = 10.0**ticks if _is_log(metric) else ticks
    style = ".2e" if metric.endswith("mse") else ".3g"
    return Scale(outcome.at, ticks, [format(value, style) for value in values])


def _metric(table: pd.DataFrame, column: str) -> np.ndarray:
    return table[column].to_numpy(dtype=float)


def _ranks(values: np.ndarray) -> np.ndarray:
    """Ranks from 0, the smallest, to 1."""
    ranks = np.argsort(np.argsort(values, kind="stable"), kind="stable")
    return ranks / max(values.size - 1, 1)


def _is_log(metric: str) -> bool:
    return not metric.endswith("ssim")


def _label(metric: str) -> str:
    return METRIC_LABELS[metric.removeprefix("validation_")]


def _short(text: str, longest: int = 18) -> str:
    return text if len(text) <= longest else text[: longest - 1] + "…"
