"""Figures of scene 3: stamps, estimates, errors and times, the twin ambiguity, correlations.

Functions take arrays of stamps and states and return matplotlib figures. A state is decentre x, y
and tilt x, y of the secondary mirror, in units of their range.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill

import numpy as np
import pandas as pd

from psfdae.base.figures import SERIES_COLORS, apply_style, new_figure
from psfdae.base.types import Axes, AxesImage, Figure, FigureBase
from psfdae_paper.alignment.telescope import DEGREES_OF_FREEDOM
from psfdae_paper.configuration.estimators import ESTIMATORS
from psfdae_paper.evaluation import drawing
from psfdae_paper.evaluation.drawing import Style


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
    images: list[AxesImage] = []
    parts = figure.subfigures(len(titles), 1, squeeze=False)[:, 0]
    for group, (part, title) in enumerate(zip(parts, titles, strict=True)):
        # Rows are treatments, columns are fields.
        panels = part.subplots(len(rows), fields, squeeze=False)
        # The peak of the first treatment is white in all rows of a group.
        peak = rows[0][1][group].max()
        for row_panels, (label, stamps) in zip(panels, rows, strict=True):
            for axes, stamp in zip(row_panels, stamps[group], strict=True):
                images.append(_draw_stamp(axes, stamp, peak))
            row_panels[0].set_ylabel(label, rotation=0, ha="right", va="center")
        _add_flux_bar(part, images[-1], panels, "flux / maximum of the noise-free stamps")
        _name_fields(panels[0])
        part.suptitle(title, fontsize=10)
    return figure


def _name_fields(panels: np.ndarray, **style: float) -> None:
    """Write the positions of fields above a row of panels: the centre, then angles on a circle."""
    for field, axes in enumerate(panels):
        angle_deg = 360 * (field - 1) // (len(panels) - 1) if field else 0
        axes.set_title(f"{angle_deg}°" if field else "centre", **style)


def _draw_stamp(axes: Axes, stamp: np.ndarray, peak: float) -> AxesImage:
    """Draw a stamp in grey; the square root of the flux makes wings visible."""
    # Rows run along +y: the first one is at the bottom.
    grey = np.clip(stamp / peak, 0.0, 1.0) ** 0.5
    axes.set(xticks=[], yticks=[])
    return axes.imshow(
        grey, origin="lower", cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest"
    )


def _add_flux_bar(figure: FigureBase, image: AxesImage, panels: np.ndarray, label: str) -> None:
    """Add the colour bar of stamps, whose grey is the square root of the flux."""
    bar = figure.colorbar(image, ax=panels, shrink=0.8, aspect=15, pad=0.01, label=label)
    # Ticks at fractions of the maximum, whose square roots are drawn.
    shares = np.array([0.0, 0.05, 0.2, 0.5, 1.0])
    bar.set_ticks(np.sqrt(shares), labels=[f"{share:g}" for share in shares])


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
        prefix = f"{len(truth)} states, λ = "
        styles = [(level, {"color": c, "label": f"{prefix}{level:g}"}) for level, c in levels]
        for index, axes in enumerate(row_panels):
            for level, style in styles:
                axes.plot(truth[:, index], by_level[level][:, index], ".", ms=2.2, **style)
            # Perfect estimates lie on the diagonal; others may leave the range.
            axes.plot([-1, 1], [-1, 1], color="black", lw=0.7)
            axes.set(xlim=(-1.1, 1.1), ylim=(-1.6, 1.6))
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


@apply_style
def draw_errors_by_size(
    truth: np.ndarray, curves: Mapping[float, Mapping[str, np.ndarray]]
) -> Figure:
    """Draw the mean absolute error against the size of the misalignment.

    There is one panel per noise level; states are averaged in bins of size, the RMS of their four
    numbers.

    Parameters
    ----------
    truth : ndarray, shape (n, 4)
        States in units of the range.
    curves : by noise level and method, error (n,) of every state
        The error is averaged over the four parameters.
    """
    # √⟨t²⟩ over decentre x, y and tilt x, y.
    size = np.sqrt((truth**2).mean(axis=1))
    figure = new_figure(3.9, layout="constrained")
    panels = figure.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    for axes, (level, methods) in zip(panels, curves.items(), strict=True):
        # Bounds are dashed lines, estimates have standard errors.
        for method, error in methods.items():
            mean_size, mean_error, stderr = bin_errors(size, error)
            look = ESTIMATORS[method].look
            style: Style = {"color": look.color, "label": look.label, "lw": 1.4}
            if method == "cramer_rao":
                axes.plot(mean_size, mean_error, ls="--", **style)
            else:
                style |= {"marker": "o", "ms": 3.5, "capsize": 2}
                axes.errorbar(mean_size, mean_error, stderr, **style)
        label = "RMS of the state's four numbers / range"
        axes.set(title=f"λ = {level:g}", xlabel=label, yscale="log")
        axes.grid(True, which="both")
    # All panels have the same methods: one legend serves them.
    drawing.label_log_axis(panels[0])
    panels[0].set_ylabel("mean absolute error / range")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    figure.suptitle(f"Errors against misalignment, {len(truth)} uniform states")
    return figure


def bin_errors(size: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return mean size, mean error and its standard error in six bins of equally many states."""
    # States by size, cut into groups of equally many; a group of n has the error σ/√n of its mean.
    bins = [b for b in np.array_split(np.argsort(size, kind="stable"), 6) if b.size]
    rows = [(size[b].mean(), error[b].mean(), error[b].std() / np.sqrt(b.size)) for b in bins]
    return np.array(rows).T


@apply_style
def draw_costs(errors: pd.DataFrame, times: pd.DataFrame) -> Figure:
    """Draw errors over the Cramér–Rao bound against the time of training and of an estimate.

    The ratio is a geometric mean over the four parameters, for uniform states with noise.

    Parameters
    ----------
    errors : DataFrame
        Rows of `alignment_tables.tabulate_errors` and `tabulate_bounds`.
    times : DataFrame
        Columns method, seconds_per_state, training_seconds.
    """
    is_shown = (errors.test_set == "uniform") & (errors.noise_level > 0) & (errors.unit == "range")
    by_level = dict([*errors[is_shown].groupby("noise_level")])
    figure = new_figure(1.2 + 2.7 * len(by_level), layout="constrained")
    panels = figure.subplots(len(by_level), 2, sharex="col", sharey=True, squeeze=False)
    for row_panels, (level, rows) in zip(panels, by_level.items(), strict=True):
        by_method = {name: part.set_index("parameter") for name, part in rows.groupby("method")}
        for method, training_s, state_s in zip(
            times.method, times.training_seconds, times.seconds_per_state, strict=True
        ):
            estimator, part = ESTIMATORS[method], by_method[method]
            # A method with unknown flux is compared with the bound with unknown flux.
            bound = by_method["cramer_rao_free" if estimator.unknown_flux else "cramer_rao"]
            ratio = np.exp(np.log(part.mean_abs_error / bound.mean_abs_error).mean())
            # Errors of the four parameters come from the same stamps: their mean scatters as each.
            stderr = ratio * (np.sqrt(part.variance_abs / part.n) / part.mean_abs_error).mean()
            look = estimator.look
            style: Style = {"color": look.color, "label": look.label, "marker": "o", "capsize": 2}
            style["mfc"] = "white" if estimator.unknown_flux else look.color
            for axes, cost in zip(row_panels, (training_s, 1e3 * state_s), strict=True):
                axes.errorbar(cost, ratio, stderr, ls="", ms=7, **style)
        row_panels[0].set_title(f"λ = {level:g}", loc="left")
        for axes in row_panels:
            axes.axhline(1.0, color="black", ls="--", lw=1.0)
            axes.set_yscale("log")
            axes.set_yticks([1, 2, 5, 10], ["1", "2", "5", "10"])
            axes.tick_params(axis="y", which="minor", labelleft=False)
            axes.margins(0.1)
            axes.grid(True, which="both")
        # Trainings take about the same time, estimates do not.
        row_panels[1].set_xscale("log")
        row_panels[0].set_ylabel("mean absolute error / bound")
    panels[-1, 0].set_xlabel("time of all trainings (s)")
    panels[-1, 1].set_xlabel("time of an estimate (ms)")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    figure.suptitle("Errors of uniform states over the Cramér–Rao bound, against time")
    return figure


@apply_style
def draw_twins(
    curves: pd.DataFrame, pairs: Sequence[tuple[str, np.ndarray, np.ndarray]], state: np.ndarray
) -> Figure:
    """Draw the distance of a state from its multiples, and the difference from its twin.

    The twin is the opposite misalignment. Distances are √χ², the number of standard deviations by
    which all pixels together differ.

    Parameters
    ----------
    curves : DataFrame
        Columns noise_level, defocus_mm, position (1 the state, −1 its twin), chi2. A defocus with
        the twin alone is drawn in the last panel only.
    pairs : sequence of (label, stamps, differences), both of shape (F, d, d)
        Stamps of the state, and stamps of the twin less these in standard deviations of the noise.
        Only the middle of each stamp is drawn.
    state : ndarray, shape (4,)
        In units of the range.
    """
    figure = new_figure(7.6, layout="constrained")
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.0, 1.3])[:, 0]
    _draw_twin_distances(top, curves, state)
    _draw_twin_stamps(bottom, pairs, float(curves.noise_level.min()))
    return figure


def _draw_twin_distances(figure: FigureBase, curves: pd.DataFrame, state: np.ndarray) -> None:
    """Draw √χ² of multiples of a state, a panel per noise level, and of its twin by defocus."""
    levels = np.unique(curves.noise_level)
    panels = figure.subplots(1, levels.size + 1, sharey=True, squeeze=False)[0]
    curves = curves.assign(sigmas=np.sqrt(curves.chi2))
    twins = curves[np.isclose(curves.position, -1.0)]
    for axes, level in zip(panels, levels, strict=False):
        rows = curves[curves.noise_level == level].groupby("defocus_mm")
        lines = [(float(defocus), line) for defocus, line in rows if len(line) > 1]
        for color, (defocus, line) in zip(SERIES_COLORS, lines, strict=False):
            label = "in focus" if defocus == 0 else f"{defocus:g} mm beyond focus"
            axes.plot(line.position, np.maximum(line.sigmas, 1e-2), color=color, label=label)
            # The twin, with its distance as a number.
            twin = line[np.isclose(line.position, -1.0)]
            axes.plot(twin.position, twin.sigmas, color=color, marker="o", ms=5)
            for x, y in zip(twin.position, twin.sigmas, strict=True):
                offset = {"xytext": (3, -11), "textcoords": "offset points", "fontsize": 8}
                axes.annotate(f"{y:.3g} σ", (x, y), color=color, **offset)
        axes.set(title=f"λ = {level:g}", xlabel="multiple of the state; −1 is its twin")
        axes.legend(loc="lower left", fontsize=7)
    # Distance of the twin against the defocus, for the choice of the detector's position.
    for marker, level in zip("osv^D", levels, strict=False):
        line = twins[twins.noise_level == level]
        style = {"color": "black", "marker": marker, "ms": 4, "lw": 1.0}
        panels[-1].plot(line.defocus_mm, line.sigmas, label=f"λ = {level:g}", **style)
    panels[-1].set(title="twin against defocus", xlabel="CCD beyond focus (mm)")
    panels[-1].legend(loc="lower right", fontsize=7)
    for axes in panels:
        # Three standard deviations can be told from noise.
        axes.axhline(3.0, color="black", ls=":", lw=1.0)
        axes.grid(True)
    panels[0].set(yscale="log", ylim=(1.0, None))
    drawing.label_log_axis(panels[0])
    panels[0].set_ylabel("√χ² from the state's stamps (σ); dotted: 3 σ", fontsize=8)
    named_values = zip(map(parameter_label, DEGREES_OF_FREEDOM), state, strict=True)
    text = ", ".join(f"{name} {value:+.2f}" for name, value in named_values)
    figure.suptitle(f"State: {text} (range)", fontsize=10)


def _draw_twin_stamps(
    figure: FigureBase, pairs: Sequence[tuple[str, np.ndarray, np.ndarray]], level: float
) -> None:
    """Draw rows of stamps, each followed by a row of differences in units of the noise at λ."""
    # Stamps on a common grey scale and differences on a common colour scale, without a quarter of
    # their side at each edge.
    stamp_panels = figure.subplots(2 * len(pairs), pairs[0][1].shape[0])
    peak = max(images.max() for _, images, _ in pairs)
    limit = max(np.abs(differences).max() for _, _, differences in pairs)
    for number, (label, images, differences) in enumerate(pairs):
        upper, lower = stamp_panels[2 * number : 2 * number + 2]
        edge = images.shape[1] // 4
        middle = np.s_[edge:-edge, edge:-edge]
        for axes, stamp in zip(upper, images, strict=True):
            grey = _draw_stamp(axes, stamp[middle], peak)
        for axes, difference in zip(lower, differences, strict=True):
            scale = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
            color = axes.imshow(difference[middle], origin="lower", **scale)
            axes.set(xticks=[], yticks=[])
        upper[0].set_ylabel(f"state\n{label}", rotation=0, ha="right", va="center")
        lower[0].set_ylabel("twin −\nstate", rotation=0, ha="right", va="center")
    _name_fields(stamp_panels[0], fontsize=8)
    # Each colour bar is beside half of the rows, but belongs to every second one.
    upper_half, lower_half = np.split(stamp_panels, 2)
    _add_flux_bar(figure, grey, upper_half, "states: flux / maximum")
    label = f"twin − state (σ at λ = {level:g})"
    figure.colorbar(color, ax=lower_half, shrink=0.8, aspect=15, pad=0.01, label=label)


@apply_style
def draw_correlations(
    panels: Sequence[Sequence[tuple[str, np.ndarray]]], half_width: float, note: str = ""
) -> Figure:
    """Draw matrices of correlations; cells that are NaN stay empty.

    Parameters
    ----------
    panels : sequence of rows of (title, matrix of shape (4, 4))
        The longest row fills the width of the figure.
    half_width : float
        Largest half of a 95 % interval of the measured correlations.
    note : str
        Below the title: how the run differs from the paper's.
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
    title = f"Measured correlations have 95 % intervals of at most ± {half_width:.2f}"
    figure.suptitle(f"{title}\n{fill(note, 100)}".strip())
    return figure
