"""Figures of scene 3: stamps, estimates, errors, the twin ambiguity, correlations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from psfdae.figures import SERIES_COLORS, new_figure, styled
from psfdae_paper.configuration.aligners import ALIGNERS
from psfdae_paper.evaluation.alignment_tables import PARAMETERS
from psfdae_paper.evaluation.curves import readable_log_axis

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

NAMES = dict(zip(PARAMETERS, ("decentre x", "decentre y", "tilt x", "tilt y"), strict=True))
SHORT = ("dx", "dy", "tx", "ty")
"""Parameters on the axes of small panels."""

BINS = 6
GAMMA = 0.5
"""Exponent of the grey scale of stamps: wings show, too."""


@styled
def stamp_rows(rows: Sequence[tuple[str, np.ndarray]], titles: Sequence[str]) -> Figure:
    """Stamps at all fields, one row per treatment, in groups with a title.

    Parameters
    ----------
    rows : sequence of (label, stamps of shape (G, F, d, d))
        The same treatments for each of G groups.
    titles : sequence of str
        One per group; a group has a common grey scale from 0 to its first row's peak.
    """
    fields = rows[0][1].shape[1]
    figure = new_figure(0.9 * len(rows) * len(titles) + 0.5 * len(titles), layout="constrained")
    parts = figure.subfigures(len(titles), 1, squeeze=False)[:, 0]
    for group, (part, title) in enumerate(zip(parts, titles, strict=True)):
        axes = part.subplots(len(rows), fields, squeeze=False)
        peak = rows[0][1][group].max()
        for line, (label, stamps) in zip(axes, rows, strict=True):
            for cell, stamp in zip(line, stamps[group], strict=True):
                _show(cell, stamp, peak)
            line[0].set_ylabel(label, rotation=0, ha="right", va="center")
        for field, cell in enumerate(axes[0]):
            cell.set_title("centre" if field == 0 else f"{360 * (field - 1) // (fields - 1)}°")
        part.suptitle(title, fontsize=10)
    return figure


def _show(axes: Axes, stamp: np.ndarray, peak: float) -> None:
    scaled = np.clip(stamp / peak, 0.0, 1.0) ** GAMMA
    axes.imshow(scaled, origin="lower", cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])


@styled
def predicted_against_true(
    truth: np.ndarray, estimates: Mapping[str, Mapping[float, np.ndarray]]
) -> Figure:
    """Estimate against truth, one row per method and one column per parameter.

    Parameters
    ----------
    truth : ndarray, shape (n, 4)
        In units of the range.
    estimates : by method and noise level, arrays (n, 4)
    """
    figure = new_figure(1.75 * len(estimates) + 0.7, layout="constrained")
    axes = figure.subplots(len(estimates), 4, sharex=True, sharey=True, squeeze=False)
    for line, (method, levels) in zip(axes, estimates.items(), strict=True):
        for index, cell in enumerate(line):
            for level, color in zip(
                sorted(levels, reverse=True), ("#e69f00", "#0072b2"), strict=False
            ):
                cell.plot(
                    truth[:, index],
                    levels[level][:, index],
                    ".",
                    ms=2.2,
                    color=color,
                    label=f"λ = {level:g}",
                )
            cell.plot([-1, 1], [-1, 1], color="black", lw=0.7)
            cell.set_xlim(-1.1, 1.1)
            cell.set_ylim(-1.6, 1.6)
            cell.grid(True)
        line[0].set_ylabel(
            ALIGNERS[method].look.label.replace(" on ", "\non ").replace(", ", ",\n")
        )
    for parameter, top, bottom in zip(PARAMETERS, axes[0], axes[-1], strict=True):
        top.set_title(NAMES[parameter])
        bottom.set_xlabel("true / range")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, markerscale=5)
    figure.supylabel("estimate / range", fontsize=9)
    return figure


def size_of(states: np.ndarray) -> np.ndarray:
    """Size of a misalignment: RMS of its four numbers, in units of the range, shape (n,)."""
    size: np.ndarray = np.sqrt((states**2).mean(axis=1))
    return size


@styled
def errors_against_size(
    curves: Mapping[float, Mapping[str, tuple[np.ndarray, np.ndarray]]], title: str
) -> Figure:
    """Mean absolute error of bins of the misalignment's size, one panel per noise level.

    Parameters
    ----------
    curves : by noise level and method, size (n,) and error (n,) of every state
        The error is averaged over the four parameters.
    title : str
    """
    figure = new_figure(3.9, layout="constrained")
    panels = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    for axes, (level, methods) in zip(panels, curves.items(), strict=True):
        for method, (size, error) in methods.items():
            x, y, half = binned(size, error)
            style = {
                "color": ALIGNERS[method].look.color,
                "label": ALIGNERS[method].look.label,
                "lw": 1.4,
            }
            if method == "cramer_rao":
                axes.plot(x, y, ls="--", **style)
            else:
                axes.errorbar(x, y, half, marker="o", ms=3.5, capsize=2, **style)
        axes.set_title(f"λ = {level:g}")
        axes.set_xlabel("RMS of the state's four numbers / range")
        axes.set_yscale("log")
        axes.grid(True, which="both")
    readable_log_axis(panels[0])
    panels[0].set_ylabel("mean absolute error / range")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    figure.suptitle(title)
    return figure


def binned(size: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean size, mean error and its standard error in bins of equally many states."""
    order = np.argsort(size, kind="stable")
    parts = [part for part in np.array_split(order, BINS) if part.size]
    x, y = (np.array([values[part].mean() for part in parts]) for values in (size, error))
    spread = np.array([error[part].std() / np.sqrt(part.size) for part in parts])
    return x, y, spread


@styled
def twin_ambiguity(
    curves: pd.DataFrame, stamps: Sequence[tuple[str, np.ndarray]], state: np.ndarray
) -> Figure:
    """Misfit of multiples of a state, and the stamps of the state and its twin.

    Parameters
    ----------
    curves : DataFrame
        Columns noise_level, defocus_mm, position (1 the state, −1 its twin), chi2.
    stamps : sequence of (label, stamps of shape (F, d, d))
        Their middle is drawn.
    state : ndarray, shape (4,)
    """
    figure = new_figure(7.2, layout="constrained")
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.0, 1.15])[:, 0]
    panels = top.subplots(1, curves.noise_level.nunique(), sharey=True, squeeze=False)[0]
    for axes, (level, rows) in zip(panels, curves.groupby("noise_level"), strict=True):
        for color, (defocus, line) in zip(SERIES_COLORS, rows.groupby("defocus_mm"), strict=False):
            label = "in focus" if defocus == 0 else f"CCD {defocus:g} mm beyond focus"
            axes.plot(line.position, np.maximum(line.chi2, 1e-2), color=color, label=label)
        axes.axhline(9.0, color="black", ls=":", lw=1.0, label="3 σ")
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.3)
        axes.set_title(f"λ = {level:g}")
        axes.set_xlabel("multiple of the state; −1 is its twin")
        axes.grid(True)
    panels[0].set_ylabel("χ² from the state's stamps")
    panels[0].legend(loc="lower left")
    text = ", ".join(f"{name} {x:+.2f}" for name, x in zip(NAMES.values(), state, strict=True))
    top.suptitle(f"State: {text} (range)", fontsize=10)
    axes = bottom.subplots(len(stamps), stamps[0][1].shape[0])
    peak = max(images.max() for _, images in stamps)
    for line, (label, images) in zip(axes, stamps, strict=True):
        for cell, stamp in zip(line, images, strict=True):
            edge = stamp.shape[0] // 4
            _show(cell, stamp[edge:-edge, edge:-edge], peak)
        line[0].set_ylabel(label, rotation=0, ha="right", va="center")
    return figure


@styled
def correlation_matrices(panels: Sequence[Sequence[tuple[str, np.ndarray]]]) -> Figure:
    """Matrices of correlations; cells that are NaN stay empty.

    Parameters
    ----------
    panels : rows of (title, matrix of shape (4, 4)); the longest fills the width
    """
    figure = new_figure(2.15 * len(panels), layout="constrained")
    axes = figure.subplots(len(panels), max(map(len, panels)), squeeze=False)
    images: list[AxesImage] = []
    for line, row in zip(axes, panels, strict=True):
        for cell in line[len(row) :]:
            cell.set_axis_off()
        for cell, (title, matrix) in zip(line, row, strict=False):
            images.append(cell.imshow(matrix, cmap="RdBu_r", vmin=-1.0, vmax=1.0))
            cell.set_title(title, fontsize=8)
            cell.set_xticks(range(4), SHORT)
            cell.set_yticks(range(4), SHORT)
            for (a, b), value in np.ndenumerate(matrix):
                if np.isfinite(value):
                    color = "white" if abs(value) > 0.6 else "black"
                    cell.text(b, a, f"{value:.2f}", ha="center", va="center", size=6.5, color=color)
    figure.colorbar(images[-1], ax=axes, shrink=0.5, label="correlation of signed errors")
    return figure
