"""The figure that says it in one look: restored stars, and errors above what is possible."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from psfdae.evaluation.bound_figures import BAYES, FLOOR
from psfdae.evaluation.curves import METRIC_LABELS, noise_axis, readable_log_axis
from psfdae.evaluation.figure_style import new_figure, styled
from psfdae.evaluation.figures import StripRow, draw_stamp

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from psfdae.estimators import Method

NAMED_POINT = 1
"""The noise level at which lines have their names: there they lie apart."""


@styled
def headline(
    rows: Sequence[StripRow],
    methods: Sequence[Method],
    efficiency: pd.DataFrame,
    bounds: pd.DataFrame,
    titles: Sequence[str],
) -> Figure:
    """Stars in rows at the left, MSE against the noise level at the right.

    Parameters
    ----------
    rows : sequence of StripRow
        Stamps on the colour scale of the last row, the truth, unless `own_scale`.
    methods : sequence of Method
        Those of the lines.
    efficiency, bounds : DataFrame
        Rows of the stages `efficiency` and `bounds`, of one dataset and reference.
    titles : (left, right)
    """
    figure = new_figure(3.7)
    left, bottom, top = 0.115, 0.13, 0.86
    columns = len(rows[0].images)
    step, tall = 0.395 / columns, (top - bottom) / len(rows)
    peak = rows[-1].images.max(axis=(1, 2))
    for number, row in enumerate(rows):
        scale = row.images.max(axis=(1, 2)) if row.own_scale else peak
        for i, image in enumerate(row.images):
            lower = top - (number + 1) * tall
            axes = figure.add_axes((left + i * step, lower, 0.96 * step, 0.96 * tall))
            axes.set(xticks=[], yticks=[])
            draw_stamp(axes, image, scale[i])
            if i == 0:
                axes.set_ylabel(row.label, rotation=0, ha="right", va="center", labelpad=5)
    figure.text(left + 0.5 * columns * step, 0.92, titles[0], ha="center", fontsize=10)
    panel = figure.add_axes((0.66, bottom, 0.325, top - bottom))
    _errors(panel, methods, efficiency, bounds)
    figure.text(0.66 + 0.5 * 0.325, 0.92, titles[1], ha="center", fontsize=10)
    return figure


def _errors(
    axes: Axes, methods: Sequence[Method], efficiency: pd.DataFrame, bounds: pd.DataFrame
) -> None:
    """Errors of the methods and both bounds, each line with its name."""
    for method in methods:
        line = efficiency[efficiency.method == method.name].drop_duplicates("noise_level")
        line = line.sort_values("noise_level")
        style = {"color": method.color, "marker": method.marker, "lw": 1.6, "ms": 5}
        axes.plot(line["noise_level"], line["mse"], **style)
        _name(axes, line["noise_level"], line["mse"], method.label, method.color)
    best = bounds[bounds.method == "bayes"].sort_values("noise_level")
    tight = best[best.tight == "yes"]
    axes.plot(best["noise_level"], best["value"], color=BAYES["color"], ls="--", lw=1.2)
    axes.plot(tight["noise_level"], tight["value"], color=BAYES["color"], marker="o", ls="", ms=5)
    _name(axes, best["noise_level"], best["value"], "least possible", BAYES["color"], below=True)
    floor = bounds[bounds.method == "floor"].sort_values("noise_level")
    axes.set_yscale("log")
    if not floor.empty:
        bottom = 0.6 * float(floor["value"].min())
        level, value = floor["noise_level"], floor["value"]
        axes.fill_between(level, bottom, value, color=FLOOR["color"], alpha=0.25, lw=0)
        axes.set_ylim(bottom=bottom)
        _name(axes, level, 0.7 * value, "local floor", "#555555", below=True)
    noise_axis(axes, np.unique(best["noise_level"]))
    readable_log_axis(axes)
    axes.grid(True, which="major")
    axes.set_ylabel(METRIC_LABELS["mse"], fontsize=8)


def _name(
    axes: Axes, level: pd.Series, value: pd.Series, name: str, color: str, *, below: bool = False
) -> None:
    point = min(NAMED_POINT, len(level) - 1)
    place = (float(level.iloc[point]), float(value.iloc[point]))
    style = {"ha": "left", "va": "top"} if below else {"ha": "right", "va": "bottom"}
    offset = (6, -3) if below else (-2, 5)
    axes.annotate(name, place, offset, textcoords="offset points", color=color, **style)
