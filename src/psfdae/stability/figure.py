"""Figure of the graded stress tests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from psfdae.evaluation.figure_style import SERIES_COLORS, new_figure, styled

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Panel:
    """One panel: its series with their legends, its axes, and whose bounds it shows."""

    title: str
    xlabel: str
    ylabel: str
    series: dict[str, str]
    bounded: tuple[str, ...]
    legend: str = "upper left"


MSE = "MSE of normalised stamps"
PANELS = (
    Panel(
        "Stronger wavefronts",
        "factor on the aberrations, or on 1/r0",
        MSE,
        {
            "aberrations": "aberrations",
            "aberrations, guard ignored": "aberrations, guard ignored",
            "turbulence": "turbulence",
        },
        ("aberrations", "turbulence"),
        "center right",
    ),
    Panel(
        "Other pixel scales (scene 1)",
        "pixel scale (arcsec)",
        MSE,
        {
            "pixel scale, configured nodes": "configured nodes",
            "pixel scale, nodes it needs": "as many nodes as it needs",
        },
        ("pixel scale, configured nodes",),
    ),
    Panel(
        "Flux of noisy stars",
        "noise level λ",
        "relative error of the flux, RMS",
        {
            "seidel, noisy sum": "scene 1, sum (eq. 8)",
            "seidel, robust flux": "scene 1, robust",
            "turbulence, noisy sum": "scene 2, sum (eq. 8)",
            "turbulence, robust flux": "scene 2, robust",
        },
        ("seidel, noisy sum", "turbulence, noisy sum"),
    ),
    Panel(
        "Flux of stars with a hot pixel (scene 1)",
        "excess of the pixel over the star's flux",
        "relative error of the flux, RMS",
        {"hot pixel, noisy sum": "sum (eq. 8)", "hot pixel, robust flux": "robust"},
        ("hot pixel, robust flux",),
    ),
)
"""What the figure shows, in reading order."""

REFUSED_AT, HEADROOM = 0.96, 0.2
"""Height of the marks of refused inputs in units of the axes, and the room made for them."""


@styled
def graded_stress(table: pd.DataFrame) -> Figure:
    """Error against stress, with the bound of every series and what was refused.

    Parameters
    ----------
    table : DataFrame
        Columns case, stress, error (NaN where the input was refused), bound.
    """
    figure = new_figure(7.4, layout="constrained")
    for axes, panel in zip(figure.subplots(2, 2).flat, PANELS, strict=True):
        _draw(axes, panel, table)
    figure.suptitle("Error under growing stress, its bound, and what is refused")
    return figure


def _draw(axes: Axes, panel: Panel, table: pd.DataFrame) -> None:
    refused = False
    for i, (case, label) in enumerate(panel.series.items()):
        rows = table[table["case"] == case].sort_values("stress")
        if rows.empty:
            continue
        color = SERIES_COLORS[i]
        measured = rows[rows["error"].notna()]
        axes.plot(measured["stress"], measured["error"], "o-", ms=4, lw=1.3, c=color, label=label)
        if case in panel.bounded:
            axes.plot(rows["stress"], rows["bound"], "--", lw=1.0, c=color)
        gone = rows.loc[rows["error"].isna(), "stress"]
        refused |= not gone.empty
        axes.plot(
            gone,
            np.full(len(gone), REFUSED_AT - 0.04 * i),
            "x",
            ms=6,
            mew=1.6,
            c=color,
            transform=axes.get_xaxis_transform(),
        )
    axes.plot([], [], "--", lw=1.0, c="0.4", label="bound")
    if refused:
        axes.plot([], [], "x", ms=6, mew=1.6, c="0.4", label="refused")
    axes.set(
        xscale="log", yscale="log", title=panel.title, xlabel=panel.xlabel, ylabel=panel.ylabel
    )
    if refused:
        low, high = np.log10(axes.get_ylim())
        axes.set_ylim(10**low, 10 ** (high + HEADROOM * (high - low)))
    axes.grid(True, which="major")
    shift = (0.0, 0.13, 1.0, 1.0) if panel.legend == "center right" else None
    axes.legend(fontsize=7, loc=panel.legend, bbox_to_anchor=shift)
