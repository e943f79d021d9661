"""Figures of the bounds: how far the errors of methods are above the minimum error.

Functions take the tables of the stages `bounds` and `efficiency` and return matplotlib figures.
Rows of other datasets in these tables are not drawn.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from psfdae.base.figures import (
    SERIES_COLORS,
    WIDTH_IN,
    StripRow,
    add_axes_in,
    apply_style,
    draw_row,
    new_figure,
)
from psfdae.base.types import Artist, Axes, Figure
from psfdae.methods import method
from psfdae.methods.interface import Method
from psfdae_paper.configuration.methods import list_methods
from psfdae_paper.evaluation import drawing
from psfdae_paper.evaluation.drawing import Panel, Style

MEANS: dict[str, Style] = {
    "bayes": {"color": "black", "marker": "o", "label": "posterior mean (Bayes)"},
    "bayes_position": {
        "color": "#8c510a",
        "marker": "v",
        "label": "posterior mean, given the field",
    },
}
"""Looks of both posterior means; a marker is open where the bank has too few similar stars."""


@apply_style
def draw_bounds(efficiency: pd.DataFrame, bounds: pd.DataFrame, dataset: str) -> Figure:
    """Draw the MSE of every method against the noise level, with both bounds.

    Parameters
    ----------
    efficiency, bounds : DataFrame
        Rows of the dataset in the tables of the stages of these names.
    dataset : str
        Name in the title.
    """
    limits = bounds[bounds.metric == "mse"]
    figure, panels = drawing.make_panels(limits)
    for axes, reference, rows in panels:
        # The rows of each method are repeated for the floor, together with posterior means.
        methods = efficiency[(efficiency.reference == reference) & (efficiency.bound != "floor")]
        for method_class, errors in drawing.group_by_method(methods.sort_values("noise_level")):
            style = {**drawing.method_line(method_class), "capsize": 3}
            axes.errorbar(errors["noise_level"], errors["mse"], yerr=errors["stderr"], **style)
        for name, look in MEANS.items():
            _draw_posterior_mean(axes, rows[rows.method == name].sort_values("noise_level"), look)
        _set_whole_axis(axes, rows)
    # One logarithmic axis for all panels, down to the floor, with room for the zeros below it.
    first = panels[0][0]
    first.set_yscale("log")
    floor = limits[limits.method == "floor"].sort_values("noise_level")
    floor_entries = [] if floor.empty else [_draw_floor(panels, floor)]
    if (limits["value"] == 0).any():
        first.set_ylim(bottom=0.5 * first.get_ylim()[0])
    # Legend; an open marker is explained if a posterior mean is not tight at some level.
    handles = drawing.make_method_entries(set(efficiency["method"]))
    for name, look in MEANS.items():
        tightness = set(limits["tight"][limits.method == name])
        if tightness:
            handles.append(drawing.make_entry(**look, ls="--", lw=1.2, ms=6))
        if "no" in tightness:
            open_marker = {**look, "mfc": "white", "label": "its draws too few: upper limit"}
            handles.append(drawing.make_entry(**open_marker, ls="--", lw=1.2, ms=6))
    # Stars without a posterior mean are missing from its n: the largest n counts all.
    title = f"{dataset}: errors and bounds, n = {limits['n'].max()} test stars"
    drawing.finish_panels(figure, panels, title, [*handles, *floor_entries], 3)
    return figure


@apply_style
def draw_efficiency(efficiency: pd.DataFrame, dataset: str) -> Figure:
    """Draw bound over MSE of every method against the noise level, one panel per reference.

    `efficiency` has the rows of the dataset in the table of the stage of this name.
    """
    # The table also has posterior means, which are not methods.
    names = [method_class.name for method_class in list_methods()]
    figure, panels = drawing.make_panels(efficiency)
    for axes, _, rows in panels:
        # Solid lines relative to the posterior mean, dotted lines relative to the floor.
        method_rows = rows[rows.method.isin(names)].sort_values("noise_level")
        for method_class, errors in drawing.group_by_method(method_rows):
            for bound, values in errors.groupby("bound"):
                style = drawing.method_line(method_class)
                style |= {"ls": ":", "mfc": "none"} if bound == "floor" else {"ls": "-", "lw": 1.6}
                # The standard error of the difference to a given bound, in units of the MSE.
                error = values["efficiency"] * values["stderr"] / values["mse"]
                style["capsize"] = 3
                axes.errorbar(values["noise_level"], values["efficiency"], yerr=error, **style)
        axes.axhline(1.0, color="black", lw=1.0)
        # An efficiency needs a tight bound.
        if method_rows["efficiency"].isna().all():
            axes.text(0.5, 0.5, "no tight bound above 0", transform=axes.transAxes, ha="center")
        _set_whole_axis(axes, rows)
    # An efficiency above 1 is noise, or the floor is too rough an approximation.
    panels[0][0].set(yscale="log", ylim=(None, 2.0))
    # Line styles of both bounds, as far as they are drawn.
    handles = drawing.make_method_entries(set(efficiency["method"]))
    drawn_rows = efficiency[efficiency.method.isin(names)].dropna(subset=["efficiency"])
    is_floor = drawn_rows["bound"] == "floor"
    if (~is_floor).any():
        label = "against the posterior mean, where tight"
        handles.append(drawing.make_entry(label, ls="-", lw=1.6))
    if is_floor.any():
        handles.append(drawing.make_entry("against the local floor", ls=":", lw=1.6))
    count = efficiency["n"].max()
    title = f"{dataset}: efficiency, 1 = no better is possible, n = {count} test stars"
    drawing.finish_panels(figure, panels, title, handles, 3, "efficiency: bound / MSE")
    return figure


@apply_style
def draw_bank_growth(growth: pd.DataFrame, dataset: str) -> Figure:
    """Draw the error of the posterior mean against the size of the bank.

    `growth` has the rows of the dataset in the growth table of the stage `bounds`; there is one
    panel per reference.
    """
    figure, panels = drawing.make_panels(growth)
    # One colour for each noise level, the same in both panels.
    levels = np.unique(growth["noise_level"])
    colors = dict(zip(levels, np.resize(SERIES_COLORS, levels.size), strict=True))
    for axes, _, rows in panels:
        # Measured errors as lines with markers, the limit of the fit as a dashed line.
        for (level, name), sizes in rows.sort_values("draws").groupby(["noise_level", "method"]):
            # Both posterior means of a level have its colour, and a marker of their own.
            color, marker = colors[level], MEANS[str(name)]["marker"]
            style = {"color": color, "marker": marker, "ms": 4.5, "lw": 1.4, "capsize": 3}
            axes.errorbar(sizes["draws"], sizes["mse"], yerr=sizes["stderr"], **style)
            axes.axhline(sizes["limit"].iloc[0], color=color, ls="--", lw=1.0)
        # A tick at each size of the bank.
        draws = np.unique(rows["draws"])
        drawing.set_log_axis(axes, draws, [f"{count:d}" for count in draws])
        axes.set_xlabel("draws of the simulator in the bank")
    # Colours are noise levels; markers are the posterior mean with and without the field.
    handles = [
        drawing.make_entry(f"λ = {level:g}", color=color, marker="o", ms=4.5, lw=1.4)
        for level, color in colors.items()
    ]
    handles += [
        drawing.make_entry(**look | {"color": "black"}, ls="", ms=4.5) for look in MEANS.values()
    ]
    handles.append(drawing.make_entry("limit of the fit", ls="--", lw=1.0))
    count = growth["n"].max()
    title = f"{dataset}: the posterior mean over banks of growing size, n = {count} test stars"
    drawing.finish_panels(figure, panels, title, handles, 4)
    return figure


def _set_whole_axis(axes: Axes, rows: pd.DataFrame) -> None:
    """Show all noise levels of a table, with 5 % of the axis' length beyond either end."""
    # Points at the ends stay clear of the frame.
    levels = np.unique(rows["noise_level"])
    drawing.set_noise_axis(axes, levels)
    margin_factor = max(levels.max() / levels.min(), 2.0) ** 0.05
    axes.set_xlim(levels.min() / margin_factor, levels.max() * margin_factor)


def _draw_posterior_mean(axes: Axes, rows: pd.DataFrame, look: Style) -> None:
    """Draw a posterior mean with its confidence intervals, and "0" below errors that are 0."""
    color = look["color"]
    # Zeros of both posterior means stand on either side of their level.
    side: Style = {"ha": "right" if look is MEANS["bayes"] else "left", "weight": "bold"}
    for level in rows["noise_level"][rows.value == 0]:
        axes.text(level, 0.02, "0", transform=axes.get_xaxis_transform(), color=color, **side)
    # The confidence interval of the mean of each level.
    rows = rows[rows.value > 0]
    level, value = rows["noise_level"].to_numpy(), rows["value"].to_numpy()
    half_widths = np.maximum([value - rows["ci_low"], rows["ci_high"] - value], 0.0)
    axes.errorbar(level, value, yerr=half_widths, color=color, ls="--", lw=1.2, capsize=3)
    # Filled markers where the bound is tight, open ones elsewhere.
    tight = (rows["tight"] == "yes").to_numpy()
    for mask, fill in ((tight, color), (~tight, "white")):
        style: Style = {"color": color, "marker": look["marker"], "mfc": fill, "ms": 6, "ls": ""}
        axes.plot(level[mask], value[mask], zorder=3, **style)


def _draw_floor(panels: Sequence[Panel], floor: pd.DataFrame) -> Artist:
    """Draw the local floor, down to which the axis reaches; return its entry in the legend."""
    from matplotlib.patches import Patch

    # The axis ends a factor of two below the lowest value. Not all references have a floor.
    bottom = 0.5 * float(floor["value"].min())
    for axes, reference, _ in panels:
        rows = floor[floor.reference == reference]
        if len(rows):
            color = _shade_below(axes, rows, bottom)
            axes.plot(rows["noise_level"], rows["value"], color=color, lw=1.6)
    panels[0][0].set_ylim(bottom=bottom)
    return Patch(facecolor=color, alpha=0.35, label="local floor: field and centring known")


def _shade_below(axes: Axes, floor: pd.DataFrame, bottom: float) -> str:
    """Shade the area from `bottom` to the local floor; return the colour."""
    color = "#7f7f7f"
    axes.fill_between(floor["noise_level"], bottom, floor["value"], color=color, alpha=0.25, lw=0)
    return color


@apply_style
def draw_headline(
    rows: Sequence[StripRow],
    methods: Sequence[type[Method]],
    efficiency: pd.DataFrame,
    bounds: pd.DataFrame,
    titles: Sequence[str],
) -> Figure:
    """Draw stars in rows at the left, and MSE against the noise level at the right.

    Parameters
    ----------
    rows : sequence of StripRow
        Stamps are on the colour scale of the last row, the truth, unless a row has `own_scale`.
    methods : sequence of type
        Classes of the methods whose errors are drawn, by descending error.
    efficiency, bounds : DataFrame
        Tables of the stages of these names, for one dataset and reference.
    titles : sequence of str
        Title of the left and of the right part.
    """
    figure = new_figure(3.7)
    # Stamps: left edge and sizes of the cells in fractions of the figure, then in inches.
    left_edge, bottom, top = 0.115, 0.13, 0.86
    columns = len(rows[0].images)
    cell_width, cell_height = 0.395 / columns, (top - bottom) / len(rows)
    # Rows of stamps from the top; each is on the colour scale of the truth below it.
    cell = (cell_width * WIDTH_IN, cell_height * figure.get_figheight())
    peak, stamps = rows[-1].images.max(axis=(1, 2)), add_axes_in(figure)
    for number, row in enumerate(rows, 1):
        row_bottom = top * figure.get_figheight() - number * cell[1]
        draw_row(stamps, row, (left_edge * WIDTH_IN, row_bottom), cell, peak)
    # The scale of the colours is below the stamps, each title above the middle of its part.
    scale = "Colour: √flux from 0 to the maximum of the truth; noisy stars to their own"
    figure.text(left_edge + 0.5 * columns * cell_width, 0.05, scale, ha="center", fontsize=7)
    figure.text(left_edge + 0.5 * columns * cell_width, 0.92, titles[0], ha="center", fontsize=10)
    panel = figure.add_axes((0.66, bottom, 0.325, top - bottom))
    _draw_errors(panel, methods, efficiency, bounds)
    figure.text(0.66 + 0.5 * 0.325, 0.92, titles[1], ha="center", fontsize=10)
    return figure


def _draw_errors(
    axes: Axes, methods: Sequence[type[Method]], efficiency: pd.DataFrame, bounds: pd.DataFrame
) -> None:
    """Draw errors of the methods and both bounds, each line with its name."""

    def draw_line(method_class: type[Method], marker_size: int) -> pd.DataFrame:
        """Draw the errors of a method; return its rows, one for each noise level."""
        # Every bound that the method is compared with has a row with the same error.
        rows = efficiency[efficiency.method == method_class.name].drop_duplicates("noise_level")
        rows = rows.sort_values("noise_level")
        style = {**drawing.method_line(method_class), "lw": 1.6, "ms": marker_size, "capsize": 2}
        axes.errorbar(rows["noise_level"], rows["mse"], yerr=rows["stderr"], **style)
        return rows

    for method_class in methods:
        line = draw_line(method_class, 5)
        # The name of the lowest line is below its first point, because the next line is near.
        is_lowest = method_class is methods[-1]
        points = line[:1] if is_lowest else line
        # Inputs of the method, in brackets in its label, are shown with its stars.
        name = method_class.look.label.partition(" (")[0]
        color = method_class.look.color
        _write_name(axes, points["noise_level"], points["mse"], name, color, below=is_lowest)
    # Errors if the optics of the telescope are known. The line nearly coincides with the posterior
    # mean: its name is below that one's name.
    optics = method("wavefront")
    if (efficiency.method == optics.name).any():
        line = draw_line(optics, 8)
        height, color = 0.6 * line["mse"], optics.look.color
        _write_name(axes, line["noise_level"], height, "telescope known", color, below=True)
    # Posterior mean, with markers where it is tight, and the area below the local floor.
    bayes = bounds[bounds.method == "bayes"].sort_values("noise_level")
    tight = bayes[bayes.tight == "yes"]
    color = MEANS["bayes"]["color"]
    error_bars: Style = {"color": color, "ls": "--", "lw": 1.2, "capsize": 2}
    axes.errorbar(bayes["noise_level"], bayes["value"], yerr=bayes["stderr"], **error_bars)
    axes.plot(tight["noise_level"], tight["value"], color=color, marker="o", ls="", ms=5)
    _write_name(axes, bayes["noise_level"], bayes["value"], "least possible", color, below=True)
    floor = bounds[bounds.method == "floor"].sort_values("noise_level")
    # One logarithmic axis of errors, shaded below the local floor.
    axes.set_yscale("log")
    if not floor.empty:
        bottom = 0.6 * float(floor["value"].min())
        _shade_below(axes, floor, bottom)
        axes.set_ylim(bottom=bottom)
        height = 0.7 * floor["value"]
        _write_name(axes, floor["noise_level"], height, "local floor", "#555555", below=True)
    drawing.set_noise_axis(axes, np.unique(bayes["noise_level"]))
    drawing.label_log_axis(axes)
    axes.grid(True, which="major")
    axes.set_ylabel(drawing.METRIC_LABELS["mse"], fontsize=8)


def _write_name(
    axes: Axes, level: pd.Series, value: pd.Series, name: str, color: str, *, below: bool = False
) -> None:
    """Write the name of a line next to its second point, where lines are separate."""
    # Names stand right of and below a point, or left of and above it.
    point = min(1, len(level) - 1)
    position = (float(level.iloc[point]), float(value.iloc[point]))
    offset, ha, va = ((6, -3), "left", "top") if below else ((-2, 5), "right", "bottom")
    axes.annotate(name, position, offset, textcoords="offset points", color=color, ha=ha, va=va)
