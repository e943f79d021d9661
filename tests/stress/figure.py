"""Error against stress, its bounds and what was refused: python figure.py GRADED.csv OUT.png."""

import sys
from pathlib import Path

import numpy as np

from psfdae.evaluation.figure_style import SERIES_COLORS, new_figure, styled
from psfdae.reading import read_table
from psfdae.stages.figures import write_png

MSE, FLUX = "MSE of normalised stamps", "relative error of the flux, RMS"
HOT = "excess of the pixel over the star's flux"
# Title, x and y axes, place of the legend.
PANELS = (
    ("Stronger wavefronts", "factor on the aberrations, or on 1/r0", MSE, "center right"),
    ("Other pixel scales (scene 1)", "pixel scale (arcsec)", MSE, "upper left"),
    ("Flux of noisy stars", "noise level λ", FLUX, "upper left"),
    ("Flux of stars with a hot pixel (scene 1)", HOT, FLUX, "upper left"),
)
# By panel: case, label, whether its bound is shown.
SERIES = (
    (0, "aberrations", "aberrations", True),
    (0, "aberrations, guard ignored", "aberrations, guard ignored", False),
    (0, "turbulence", "turbulence", True),
    (1, "pixel scale, configured nodes", "configured nodes", True),
    (1, "pixel scale, nodes it needs", "as many nodes as it needs", False),
    (2, "seidel, noisy sum", "scene 1, sum (eq. 8)", True),
    (2, "seidel, robust flux", "scene 1, robust", False),
    (2, "turbulence, noisy sum", "scene 2, sum (eq. 8)", True),
    (2, "turbulence, robust flux", "scene 2, robust", False),
    (3, "hot pixel, noisy sum", "sum (eq. 8)", False),
    (3, "hot pixel, robust flux", "robust", True),
)


@styled
def graded_stress(table):
    """Figure of a table with columns case, stress, error (NaN where refused), bound."""
    figure = new_figure(7.4, layout="constrained")
    for number, axes in enumerate(figure.subplots(2, 2).flat):
        draw(axes, table, *PANELS[number], [series[1:] for series in SERIES if series[0] == number])
    figure.suptitle("Error under growing stress, its bound, and what is refused")
    return figure


def draw(axes, table, title, xlabel, ylabel, place, series):
    refused = False
    for (case, label, bounded), color in zip(series, SERIES_COLORS, strict=False):
        rows = table[table["case"] == case].sort_values("stress")
        gone = rows["error"].isna()
        measured, lost = rows[~gone], rows.loc[gone, "stress"]
        axes.plot(measured["stress"], measured["error"], "o-", ms=4, lw=1.3, c=color, label=label)
        if bounded:
            axes.plot(rows["stress"], rows["bound"], "--", lw=1.0, c=color)
        # Marks of what is refused are near the upper edge, in room made for them.
        height = np.full(len(lost), 0.96 - 0.04 * SERIES_COLORS.index(color))
        transform = axes.get_xaxis_transform()
        axes.plot(lost, height, "x", ms=6, mew=1.6, c=color, transform=transform)
        refused |= gone.any()
    axes.plot([], [], "--", lw=1.0, c="0.4", label="bound")
    axes.set(xscale="log", yscale="log", title=title, xlabel=xlabel, ylabel=ylabel)
    if refused:
        axes.plot([], [], "x", ms=6, mew=1.6, c="0.4", label="refused")
        low, high = np.log10(axes.get_ylim())
        axes.set_ylim(10**low, 10 ** (high + 0.2 * (high - low)))
    axes.grid(True, which="major")
    shift = (0.0, 0.13, 1.0, 1.0) if place == "center right" else None
    axes.legend(fontsize=7, loc=place, bbox_to_anchor=shift)


if __name__ == "__main__":
    write_png(graded_stress(read_table(Path(sys.argv[1]))), Path(sys.argv[2]))
