"""Figures of scene 3: stamps, estimates, errors, the twin ambiguity, correlations.

Functions take arrays of stamps and states and return matplotlib figures. A state is decentre x, y
and tilt x, y of the secondary mirror, in units of their range.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from psfdae.base.figures import SERIES_COLORS, apply_style, new_figure
from psfdae_paper.alignment.telescope import DEGREES_OF_FREEDOM
from psfdae_paper.configuration.estimators import ESTIMATORS
from psfdae_paper.evaluation import drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage


def parameter_label(parameter: str) -> str:
    """Return the name of a parameter of a state in titles, such as "decentre x"."""
    return parameter.replace("decenter", "decentre").replace("_", " ")


@apply_style
def draw_stamp_rows(rows: Sequence[tuple[str, np.ndarray]], titles: Sequence[str]) -> Figure:
    """Draw stamps at all fields, one row per treatment, in groups with a title.

    Parameters
    ----------
    rows : sequence of (label, stamps of shape (G, F, d, d))
        The same treatments for each of G groups.
    titles : sequence of str
        One per group; a group has a common grey scale from 0 to its first row's peak.
    """
    # A part of the figure for each group, with a common grey scale.
    fields = rows[0][1].shape[1]
    figure = new_figure(0.9 * len(rows) * len(titles) + 0.5 * len(titles), layout="constrained")
    parts = figure.subfigures(len(titles), 1, squeeze=False)[:, 0]
    for group, (part, title) in enumerate(zip(parts, titles, strict=True)):
        # Rows are treatments, columns are fields.
        panels = part.subplots(len(rows), fields, squeeze=False)
        # The peak of the first treatment is white in all rows of a group.
        peak = rows[0][1][group].max()
        for row_panels, (label, stamps) in zip(panels, rows, strict=True):
            for axes, stamp in zip(row_panels, stamps[group], strict=True):
                _draw_stamp(axes, stamp, peak)
            row_panels[0].set_ylabel(label, rotation=0, ha="right", va="center")
        # The first field is the centre, the others are on a circle around it.
        for field, axes in enumerate(panels[0]):
            axes.set_title("centre" if field == 0 else f"{360 * (field - 1) // (fields - 1)}°")
        part.suptitle(title, fontsize=10)
    return figure


def _draw_stamp(axes: Axes, stamp: np.ndarray, peak: float) -> None:
    """Draw a stamp in grey; the square root of the flux makes wings visible."""
    # Rows run along +y: the first one is at the bottom.
    grey = np.clip(stamp / peak, 0.0, 1.0) ** 0.5
    axes.imshow(grey, origin="lower", cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])


@apply_style
def draw_predictions(
    truth: np.ndarray, estimates: Mapping[str, Mapping[float, np.ndarray]]
) -> Figure:
    """Draw estimate against truth, one row per method and one column per parameter.

    Parameters
    ----------
    truth : ndarray, shape (n, 4)
        States in units of the range.
    estimates : by method and noise level, arrays (n, 4)
        Estimates in units of the range, at up to two noise levels.
    """
    # Panels share both axes, so that methods are compared by eye.
    figure = new_figure(1.75 * len(estimates) + 0.7, layout="constrained")
    panels = figure.subplots(len(estimates), 4, sharex=True, sharey=True, squeeze=False)
    for row_panels, (method, by_level) in zip(panels, estimates.items(), strict=True):
        # The highest noise level first, so that the points of lower noise are above its points.
        levels = zip(sorted(by_level, reverse=True), ("#e69f00", "#0072b2"), strict=False)
        styles = [(level, {"color": color, "label": f"λ = {level:g}"}) for level, color in levels]
        for index, axes in enumerate(row_panels):
            for level, style in styles:
                axes.plot(truth[:, index], by_level[level][:, index], ".", ms=2.2, **style)
            # Perfect estimates lie on the diagonal; others may leave the range.
            axes.plot([-1, 1], [-1, 1], color="black", lw=0.7)
            axes.set_xlim(-1.1, 1.1)
            axes.set_ylim(-1.6, 1.6)
            axes.grid(True)
        # Long labels are broken where a comma or the training data begin.
        label = ESTIMATORS[method].look.label.replace(" on ", "\non ").replace(", ", ",\n")
        row_panels[0].set_ylabel(label)
    for parameter, top, bottom in zip(DEGREES_OF_FREEDOM, panels[0], panels[-1], strict=True):
        top.set_title(parameter_label(parameter))
        bottom.set_xlabel("true / range")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=2, markerscale=5)
    figure.supylabel("estimate / range", fontsize=9)
    return figure


def compute_size(states: np.ndarray) -> np.ndarray:
    """Return the size of misalignments: RMS of their four numbers, in units of the range, (n,)."""
    # √⟨t²⟩ over decentre x, y and tilt x, y.
    size: np.ndarray = np.sqrt((states**2).mean(axis=1))
    return size


@apply_style
def draw_errors_by_size(
    curves: Mapping[float, Mapping[str, tuple[np.ndarray, np.ndarray]]], title: str
) -> Figure:
    """Draw the mean absolute error against the size of the misalignment.

    There is one panel per noise level; states are averaged in bins of size.

    Parameters
    ----------
    curves : by noise level and method, size (n,) and error (n,) of every state
        The error is averaged over the four parameters.
    title : str
        Title of the figure.
    """
    figure = new_figure(3.9, layout="constrained")
    panels = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    for axes, (level, methods) in zip(panels, curves.items(), strict=True):
        # Bounds are dashed lines, estimates have standard errors.
        for method, (size, error) in methods.items():
            mean_size, mean_error, stderr = bin_errors(size, error)
            style = {
                "color": ESTIMATORS[method].look.color,
                "label": ESTIMATORS[method].look.label,
                "lw": 1.4,
            }
            if method == "cramer_rao":
                axes.plot(mean_size, mean_error, ls="--", **style)
            else:
                marker = {"marker": "o", "ms": 3.5, "capsize": 2}
                axes.errorbar(mean_size, mean_error, stderr, **marker, **style)
        axes.set_title(f"λ = {level:g}")
        axes.set_xlabel("RMS of the state's four numbers / range")
        axes.set_yscale("log")
        axes.grid(True, which="both")
    # All panels have the same methods: one legend serves them.
    drawing.label_log_axis(panels[0])
    panels[0].set_ylabel("mean absolute error / range")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    figure.suptitle(title)
    return figure


def bin_errors(size: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean size, mean error and its standard error in six bins of equally many states."""
    # States by size, cut into groups of equally many; a group of n has the error σ/√n of its mean.
    order = np.argsort(size, kind="stable")
    bins = [states for states in np.array_split(order, 6) if states.size]
    mean_size, mean_error = (
        np.array([values[states].mean() for states in bins]) for values in (size, error)
    )
    stderr = np.array([error[states].std() / np.sqrt(states.size) for states in bins])
    return mean_size, mean_error, stderr


@apply_style
def draw_twins(
    curves: pd.DataFrame, stamps: Sequence[tuple[str, np.ndarray]], state: np.ndarray
) -> Figure:
    """Draw the misfit of multiples of a state, and the stamps of the state and its twin.

    The twin is the opposite misalignment, whose stamps in focus are nearly the same.

    Parameters
    ----------
    curves : DataFrame
        Columns noise_level, defocus_mm, position (1 the state, −1 its twin), chi2.
    stamps : sequence of (label, stamps of shape (F, d, d))
        Only the middle of each stamp is drawn.
    state : ndarray, shape (4,)
        In units of the range.
    """
    # χ² along the line through the state and its twin, one panel per noise level.
    figure = new_figure(7.2, layout="constrained")
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.0, 1.15])[:, 0]
    panels = top.subplots(1, curves.noise_level.nunique(), sharey=True, squeeze=False)[0]
    for axes, (level, rows) in zip(panels, curves.groupby("noise_level"), strict=True):
        for color, (defocus, line) in zip(SERIES_COLORS, rows.groupby("defocus_mm"), strict=False):
            # In focus the stamps of a state and its twin nearly agree, beyond focus they differ.
            label = "in focus" if defocus == 0 else f"CCD {defocus:g} mm beyond focus"
            axes.plot(line.position, np.maximum(line.chi2, 1e-2), color=color, label=label)
        # χ² = 9 is a difference of three standard deviations.
        axes.axhline(9.0, color="black", ls=":", lw=1.0, label="3 σ")
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.3)
        axes.set_title(f"λ = {level:g}")
        axes.set_xlabel("multiple of the state; −1 is its twin")
        axes.grid(True)
    panels[0].set_ylabel("χ² from the state's stamps")
    panels[0].legend(loc="lower left")
    named_values = zip(map(parameter_label, DEGREES_OF_FREEDOM), state, strict=True)
    text = ", ".join(f"{name} {value:+.2f}" for name, value in named_values)
    top.suptitle(f"State: {text} (range)", fontsize=10)
    # Stamps on a common grey scale, without a quarter of their side at each edge.
    stamp_panels = bottom.subplots(len(stamps), stamps[0][1].shape[0])
    peak = max(images.max() for _, images in stamps)
    for row_panels, (label, images) in zip(stamp_panels, stamps, strict=True):
        for axes, stamp in zip(row_panels, images, strict=True):
            edge = stamp.shape[0] // 4
            _draw_stamp(axes, stamp[edge:-edge, edge:-edge], peak)
        row_panels[0].set_ylabel(label, rotation=0, ha="right", va="center")
    return figure


@apply_style
def draw_correlations(panels: Sequence[Sequence[tuple[str, np.ndarray]]]) -> Figure:
    """Draw matrices of correlations; cells that are NaN stay empty.

    Parameters
    ----------
    panels : sequence of rows of (title, matrix of shape (4, 4))
        The longest row fills the width of the figure.
    """
    short_labels = ("dx", "dy", "tx", "ty")
    # Rows of panels; those that a row does not fill stay empty.
    figure = new_figure(2.15 * len(panels), layout="constrained")
    all_axes = figure.subplots(len(panels), max(map(len, panels)), squeeze=False)
    images: list[AxesImage] = []
    for row_axes, row in zip(all_axes, panels, strict=True):
        for axes in row_axes[len(row) :]:
            axes.set_axis_off()
        for axes, (title, matrix) in zip(row_axes, row, strict=False):
            images.append(axes.imshow(matrix, cmap="RdBu_r", vmin=-1.0, vmax=1.0))
            axes.set_title(title, fontsize=8)
            axes.set_xticks(range(4), short_labels)
            axes.set_yticks(range(4), short_labels)
            # The number in each cell, white on dark colours.
            for (a, b), value in np.ndenumerate(matrix):
                if np.isfinite(value):
                    color = "white" if abs(value) > 0.6 else "black"
                    axes.text(b, a, f"{value:.2f}", ha="center", va="center", size=6.5, color=color)
    # One colour bar: all matrices have the range −1 … 1.
    figure.colorbar(images[-1], ax=all_axes, shrink=0.5, label="correlation of signed errors")
    return figure
