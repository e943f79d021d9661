"""Figures made of curves: a training, errors and bounds against the noise, the headline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.figures import (
    REFERENCES,
    SERIES_COLORS,
    WIDTH_IN,
    StripRow,
    draw_row,
    in_inches,
    new_figure,
    styled,
)
from psfdae.method import Method
from psfdae.methods import method
from psfdae_paper.configuration.methods import oracles_last, registered

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from psfdae.method import Method


METRIC_LABELS = {
    "mse": "MSE per pixel (stamp sum = 1)",
    "ssim": "SSIM, data range fitted to the paper",
    "ssim_unit": "SSIM, data range 1",
    "ssim_peak": "SSIM, data range of each reference",
}
"""Labels of axes by metric."""

Style = dict[str, Any]
"""Keyword arguments of a line."""

BAYES: Style = {"color": "black", "marker": "o", "label": "posterior mean (Bayes)"}
"""Look of the posterior mean; its marker is open where the bank has too few similar stars."""

MEANS: dict[str, Style] = {
    "bayes": BAYES,
    "bayes_position": {
        "color": "#8c510a",
        "marker": "v",
        "label": "posterior mean, given the field",
    },
}
"""Looks of both posterior means."""

FLOOR = {"color": "#7f7f7f", "label": "local floor: field and centring known"}
"""Look of the floor."""


@styled
def training_curves(histories: Mapping[str, pd.DataFrame], title: str) -> Figure:
    """Draw training and validation error of each network of a dataset.

    Parameters
    ----------
    histories : mapping
        Table by label, with the columns step, train_mse and validation_mse (NaN where it was not
        measured).
    title : str
    """
    from matplotlib.lines import Line2D

    figure = new_figure(4.6, layout="constrained")
    axes = figure.add_subplot()
    entries = []
    # Dotted training error, solid validation error with markers, in one colour per network.
    for i, (label, history) in enumerate(histories.items()):
        color = SERIES_COLORS[i % len(SERIES_COLORS)]
        axes.plot(history["step"], history["train_mse"], color=color, lw=1.0, ls=":")
        validated = history.dropna(subset=["validation_mse"])
        step, mse = validated["step"], validated["validation_mse"]
        axes.plot(step, mse, color=color, lw=1.6, marker="o", ms=3.5)
        # The network of the smallest validation error is the result of the training.
        lowest = mse.argmin()
        star: Style = {"marker": "*", "ms": 13, "mfc": color, "mec": "black", "ls": ""}
        axes.plot(step.iloc[lowest], mse.iloc[lowest], **star)
        entries.append(Line2D([], [], color=color, lw=1.6, label=label))
    entries += [
        Line2D([], [], color="black", lw=1.0, ls=":", label="training stars"),
        Line2D([], [], color="black", lw=1.6, marker="o", ms=3.5, label="validation stars"),
        Line2D([], [], color="black", marker="*", ms=11, ls="", label="kept network"),
    ]
    axes.set_yscale("log")
    readable_log_axis(axes)
    axes.set_xlabel("optimiser step")
    axes.set_ylabel(METRIC_LABELS["mse"])
    axes.set_title(title)
    axes.grid(True, which="major")
    axes.legend(handles=entries, ncols=2)
    return figure


@styled
def error_against_noise(
    metrics: pd.DataFrame, paper: pd.DataFrame, dataset: str, metric: str
) -> Figure:
    """Draw a metric of every method against the noise level, one panel per reference.

    Parameters
    ----------
    metrics : DataFrame
        Rows of the stage `evaluate`; those of other datasets are not drawn.
    paper : DataFrame
        `psfdae_paper.evaluation.paper.published("psf")`, drawn where it has the dataset.
    dataset, metric : str
    """
    from matplotlib.lines import Line2D

    from psfdae_paper.evaluation.paper import paper_rows

    measured = metrics[(metrics.dataset == dataset) & (metrics.metric == metric)]
    published = paper[(paper.dataset == dataset) & (paper.metric == metric)]
    published = published.assign(method=published["method"].map(paper_rows()))
    split_lines = {"random": "-", "held_out": "--"}
    figure, panels = _panels(measured)
    levels = np.unique(measured["noise_level"])
    for axes, (reference, reference_rows) in zip(panels, _by_reference(measured), strict=True):
        # Lines with standard errors, dashed for held-out fields; the paper's values as markers.
        for method_class, rows in _by_method(reference_rows):
            for split, part in rows.groupby("split"):
                line = part.sort_values("noise_level")
                style = {**_line(method_class), "ls": split_lines[str(split)], "capsize": 3}
                axes.errorbar(line["noise_level"], line["value"], yerr=line["stderr"], **style)
        for method_class, rows in _by_method(published):
            axes.plot(rows["noise_level"], rows["value"], **_paper_marker(method_class))
        axes.set_title(REFERENCES[reference].replace(" (", "\n("))
        noise_axis(axes, levels)
        axes.grid(True, which="major")
    if metric == "mse":
        panels[0].set_yscale("log")
        readable_log_axis(panels[0])
    panels[0].set_ylabel(METRIC_LABELS.get(metric, metric))
    figure.suptitle(f"{metric.upper().replace('_', ' ')} of {dataset} against the noise level")
    handles = _method_handles(set(measured["method"]), set(published["method"]))
    if "held_out" in set(measured["split"]):
        split_labels = {"random": "random test stars", "held_out": "stars of held-out fields"}
        handles += [
            Line2D([], [], color="black", ls=line, lw=1.4, label=split_labels[split])
            for split, line in split_lines.items()
        ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def _paper_marker(method_class: type[Method]) -> Style:
    """Return the style of the paper's published values: an open marker without a line."""
    return {**_line(method_class), "mfc": "none", "mew": 1.4, "ms": 9, "ls": ""}


def _method_handles(methods: set[str], published: Set[str] = frozenset()) -> list[Artist]:
    """Make legend entries of measured methods, each followed by the paper's open marker."""
    from matplotlib.lines import Line2D

    handles: list[Artist] = []
    for method_class in oracles_last(methods | published):
        label = method_class.look.label
        if method_class.name in methods:
            handles.append(Line2D([], [], **_line(method_class), label=label))
        if method_class.name in published:
            handles.append(Line2D([], [], **_paper_marker(method_class), label=f"{label}, paper"))
    return handles


def noise_axis(axes: Axes, levels: np.ndarray) -> None:
    """Make the x axis logarithmic, with a tick at each noise level.

    The common power of ten is in the label of the axis.
    """
    # Rounding must not make log10(1e-3) less than −3.
    power = int(np.floor(np.log10(levels.min()) + 1e-9))
    _log_axis(axes, levels, [f"{level / 10.0**power:g}" for level in levels])
    axes.set_xlabel(rf"noise level λ ($\times 10^{{{power}}}$)")


def _log_axis(axes: Axes, ticks: np.ndarray, labels: list[str]) -> None:
    """Make the x axis logarithmic with these ticks and no others."""
    from matplotlib.ticker import NullLocator

    axes.set_xscale("log")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xticks(ticks, labels=labels)


def readable_log_axis(axes: Axes) -> None:
    """Write numbers on the y axis between decades, too: it often spans only one or two."""
    from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

    axes.yaxis.set_major_locator(LogLocator(base=10, subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(LogFormatterSciNotation(minor_thresholds=(10, 10)))
    axes.yaxis.set_minor_formatter(NullFormatter())


@styled
def errors_above_bounds(efficiency: pd.DataFrame, bounds: pd.DataFrame, dataset: str) -> Figure:
    """Draw the MSE of every method against the noise level, with both bounds.

    There is one panel per reference. Tables are those of the stages `efficiency` and `bounds`; rows
    of other datasets are not drawn.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    measured = efficiency[efficiency.dataset == dataset]
    limits = bounds[(bounds.dataset == dataset) & (bounds.metric == "mse")]
    figure, panels = _panels(limits)
    for axes, (reference, rows) in zip(panels, _by_reference(limits), strict=True):
        # The rows of each method are repeated for the floor, together with posterior means.
        methods = measured[(measured.reference == reference) & (measured.bound != "floor")]
        for method_class, errors in _by_method(methods.sort_values("noise_level")):
            axes.plot(errors["noise_level"], errors["mse"], **_line(method_class))
        for name, look in MEANS.items():
            _draw_posterior_mean(axes, rows[rows.method == name].sort_values("noise_level"), look)
        _finish_panel(axes, reference, np.unique(rows["noise_level"]))
    # One logarithmic axis for all panels, down to the floor.
    panels[0].set_yscale("log")
    bottom = _draw_floor(panels, limits)
    if bottom is not None:
        panels[0].set_ylim(bottom=bottom)
    if (limits["value"] == 0).any():
        # Room for the zeros, which are written at the bottom.
        panels[0].set_ylim(bottom=0.5 * panels[0].get_ylim()[0])
    readable_log_axis(panels[0])
    panels[0].set_ylabel(METRIC_LABELS["mse"])
    figure.suptitle(f"{dataset}: errors and bounds, n = {limits['n'].max()} test stars")
    # Legend; an open marker is explained if a posterior mean is not tight at some level.
    handles = _method_handles(set(measured["method"]))
    for name, look in MEANS.items():
        tightness = set(limits["tight"][limits.method == name])
        if tightness:
            handles.append(Line2D([], [], ls="--", lw=1.2, ms=6, **look))
        if "no" in tightness:
            style = {**look, "mfc": "white", "label": "its draws too few: upper limit"}
            handles.append(Line2D([], [], ls="--", lw=1.2, ms=6, **style))
    if "floor" in set(limits["method"]):
        handles.append(Patch(facecolor=FLOOR["color"], alpha=0.35, label=FLOOR["label"]))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


@styled
def efficiency_against_noise(efficiency: pd.DataFrame, dataset: str) -> Figure:
    """Draw bound over MSE of every method against the noise level, one panel per reference.

    The table is that of the stage `efficiency`; rows of other datasets are not drawn.
    """
    from matplotlib.lines import Line2D

    measured = efficiency[efficiency.dataset == dataset]
    figure, panels = _panels(measured)
    for axes, (reference, rows) in zip(panels, _by_reference(measured), strict=True):
        # Solid lines relative to the posterior mean, dotted lines relative to the floor.
        method_rows = _without_posterior_means(rows).sort_values("noise_level")
        for method_class, errors in _by_method(method_rows):
            for bound, values in errors.groupby("bound"):
                style = _line(method_class)
                style |= {"ls": ":", "mfc": "none"} if bound == "floor" else {"ls": "-", "lw": 1.6}
                axes.plot(values["noise_level"], values["efficiency"], **style)
        axes.axhline(1.0, color="black", lw=1.0)
        if method_rows["efficiency"].isna().all():
            axes.text(0.5, 0.5, "no tight bound above 0", transform=axes.transAxes, ha="center")
        _finish_panel(axes, reference, np.unique(rows["noise_level"]))
    panels[0].set_yscale("log")
    panels[0].set_ylim(top=2.0)
    readable_log_axis(panels[0])
    panels[0].set_ylabel("efficiency: bound / MSE")
    figure.suptitle(f"{dataset}: efficiency against the noise level, 1 = no better is possible")
    handles = _method_handles(set(measured["method"]))
    # Line styles of both bounds, as far as they are drawn.
    drawn_rows = _without_posterior_means(measured).dropna(subset=["efficiency"])
    is_floor = drawn_rows["bound"] == "floor"
    if (~is_floor).any():
        label = "against the posterior mean, where tight"
        handles.append(Line2D([], [], color="black", ls="-", lw=1.6, label=label))
    if is_floor.any():
        label = "against the local floor"
        handles.append(Line2D([], [], color="black", ls=":", lw=1.6, label=label))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


@styled
def bank_growth(growth: pd.DataFrame, dataset: str) -> Figure:
    """Draw the error of the posterior mean against the size of the bank.

    There is one panel per reference. The table is the growth table of the stage `bounds`; rows of
    other datasets are not drawn.
    """
    from matplotlib.lines import Line2D

    dataset_rows = growth[growth.dataset == dataset]
    figure, panels = _panels(dataset_rows)
    levels = np.unique(dataset_rows["noise_level"])
    colors = dict(zip(levels, np.resize(SERIES_COLORS, levels.size), strict=True))
    for axes, (reference, rows) in zip(panels, _by_reference(dataset_rows), strict=True):
        # Measured errors as lines with markers, the limit of the fit as a dashed line.
        for (level, name), sizes in rows.sort_values("draws").groupby(["noise_level", "method"]):
            color, marker = colors[level], MEANS[str(name)]["marker"]
            axes.plot(sizes["draws"], sizes["mse"], color=color, marker=marker, ms=4.5, lw=1.4)
            axes.axhline(sizes["limit"].iloc[0], color=color, ls="--", lw=1.0)
        draws = np.unique(rows["draws"])
        _log_axis(axes, draws, [f"{count:d}" for count in draws])
        axes.set_xlabel("draws of the simulator in the bank")
        axes.set_title(REFERENCES[reference].replace(" (", "\n("))
        axes.grid(True, which="major")
    panels[0].set_yscale("log")
    readable_log_axis(panels[0])
    panels[0].set_ylabel(METRIC_LABELS["mse"])
    figure.suptitle(f"{dataset}: the posterior mean over banks of growing size")
    # Colours are noise levels; markers are the posterior mean with and without the field.
    handles = [
        Line2D([], [], color=color, marker="o", ms=4.5, lw=1.4, label=f"λ = {level:g}")
        for level, color in colors.items()
    ]
    handles += [
        Line2D([], [], ls="", ms=4.5, **look | {"color": "black"}) for look in MEANS.values()
    ]
    handles.append(Line2D([], [], color="black", ls="--", lw=1.0, label="limit of the fit"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def _panels(table: pd.DataFrame) -> tuple[Figure, np.ndarray]:
    """Make a figure with one panel per reference of a table."""
    figure = new_figure(4.9, layout="constrained")
    count = len(_by_reference(table))
    return figure, figure.subplots(1, count, squeeze=False, sharey=True)[0]


def _by_reference(table: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Return the references of a table in their fixed order, and the rows of each."""
    present = set(table["reference"])
    return [(name, table[table.reference == name]) for name in REFERENCES if name in present]


def _by_method(table: pd.DataFrame) -> list[tuple[type[Method], pd.DataFrame]]:
    """Return the methods of a table by name, and the rows of each."""
    return [(method(str(name)), rows) for name, rows in table.groupby("method")]


def _without_posterior_means(table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of methods, without those of the posterior mean."""
    return table[table.method.isin([method_class.name for method_class in registered()])]


def _line(method_class: type[Method]) -> Style:
    """Return the style of a method's line."""
    look = method_class.look
    return {"color": look.color, "marker": look.marker, "lw": 1.4, "ms": 4.5}


def _finish_panel(axes: Axes, reference: str, levels: np.ndarray) -> None:
    """Add the title, the axis of noise levels and the grid to a panel."""
    axes.set_title(REFERENCES[reference].replace(" (", "\n("))
    noise_axis(axes, levels)
    # The axis includes levels without a value, and 5 % of its length at either end.
    margin_factor = max(levels.max() / levels.min(), 2.0) ** 0.05
    axes.set_xlim(levels.min() / margin_factor, levels.max() * margin_factor)
    axes.grid(True, which="major")


def _draw_posterior_mean(axes: Axes, rows: pd.DataFrame, look: Style) -> None:
    """Draw a posterior mean with its confidence intervals, and "0" below errors that are 0."""
    color = look["color"]
    side: Style = {"ha": "right" if look is BAYES else "left", "weight": "bold", "color": color}
    for level in rows["noise_level"][rows.value == 0]:
        axes.text(level, 0.02, "0", transform=axes.get_xaxis_transform(), **side)
    rows = rows[rows.value > 0]
    level, value = rows["noise_level"].to_numpy(), rows["value"].to_numpy()
    half_widths = np.maximum([value - rows["ci_low"], rows["ci_high"] - value], 0.0)
    axes.errorbar(level, value, yerr=half_widths, color=color, ls="--", lw=1.2, capsize=3)
    # Filled markers where the bound is tight, open ones elsewhere.
    tight = (rows["tight"] == "yes").to_numpy()
    for selected, fill in ((tight, color), (~tight, "white")):
        style: Style = {"color": color, "marker": look["marker"], "mfc": fill, "ms": 6, "ls": ""}
        axes.plot(level[selected], value[selected], zorder=3, **style)


def _draw_floor(panels: np.ndarray, limits: pd.DataFrame) -> float | None:
    """Shade the area below the floor; return the lower end of the axis, None without a floor."""
    floor = limits[limits.method == "floor"].sort_values("noise_level")
    if floor.empty:
        return None
    # The axis ends a factor of two below the lowest value.
    bottom = 0.5 * float(floor["value"].min())
    for axes, (reference, _) in zip(panels, _by_reference(limits), strict=True):
        rows = floor[floor.reference == reference]
        if rows.empty:
            continue
        level, value = rows["noise_level"], rows["value"]
        axes.fill_between(level, bottom, value, color=FLOOR["color"], alpha=0.25, lw=0)
        axes.plot(level, value, color=FLOOR["color"], lw=1.6)
    return bottom


@styled
def headline(
    rows: Sequence[StripRow],
    methods: Sequence[Method],
    efficiency: pd.DataFrame,
    bounds: pd.DataFrame,
    titles: Sequence[str],
) -> Figure:
    """Draw stars in rows at the left, and MSE against the noise level at the right.

    Parameters
    ----------
    rows : sequence of StripRow
        Stamps are on the colour scale of the last row, the truth, unless a row has `own_scale`.
    methods : sequence of Method
        Methods whose errors are drawn, by descending error.
    efficiency, bounds : DataFrame
        Tables of the stages of these names, for one dataset and reference.
    titles : sequence of str
        Title of the left and of the right part.
    """
    figure = new_figure(3.7)
    # Stamps: left edge and sizes of the cells in fractions of the figure, then in inches.
    left, bottom, top = 0.115, 0.13, 0.86
    columns = len(rows[0].images)
    cell_width, cell_height = 0.395 / columns, (top - bottom) / len(rows)
    cell = (cell_width * WIDTH_IN, cell_height * figure.get_figheight())
    peak, stamps = rows[-1].images.max(axis=(1, 2)), in_inches(figure)
    for number, row in enumerate(rows, 1):
        row_bottom = top * figure.get_figheight() - number * cell[1]
        draw_row(stamps, row, (left * WIDTH_IN, row_bottom), cell, peak)
    figure.text(left + 0.5 * columns * cell_width, 0.92, titles[0], ha="center", fontsize=10)
    panel = figure.add_axes((0.66, bottom, 0.325, top - bottom))
    _draw_errors(panel, methods, efficiency, bounds)
    figure.text(0.66 + 0.5 * 0.325, 0.92, titles[1], ha="center", fontsize=10)
    return figure


def _draw_errors(
    axes: Axes, methods: Sequence[Method], efficiency: pd.DataFrame, bounds: pd.DataFrame
) -> None:
    """Draw errors of the methods and both bounds, each line with its name."""
    for estimator in methods:
        line = efficiency[efficiency.method == estimator.name].drop_duplicates("noise_level")
        line = line.sort_values("noise_level")
        style = {**_line(type(estimator)), "lw": 1.6, "ms": 5}
        axes.plot(line["noise_level"], line["mse"], **style)
        # The name of the lowest line is below its first point, because the next line is near.
        is_lowest = estimator is methods[-1]
        named = line[:1] if is_lowest else line
        # The label in brackets, what the method is given, is beside its stars.
        name = estimator.look.label.partition(" (")[0]
        color = estimator.look.color
        _write_name(axes, named["noise_level"], named["mse"], name, color, below=is_lowest)
    # Errors if the optics of the telescope are known.
    optics = method("wavefront")
    line = efficiency[efficiency.method == optics.name].drop_duplicates("noise_level")
    if len(line):
        line = line.sort_values("noise_level")
        axes.plot(line["noise_level"], line["mse"], **{**_line(optics), "lw": 1.6, "ms": 8})
        # The line nearly coincides with the posterior mean: its name is below that one's name.
        color = optics.look.color
        label_height = 0.6 * line["mse"]
        _write_name(axes, line["noise_level"], label_height, "telescope known", color, below=True)
    # Posterior mean, with markers where it is tight, and the area below the local floor.
    bayes = bounds[bounds.method == "bayes"].sort_values("noise_level")
    tight = bayes[bayes.tight == "yes"]
    color = BAYES["color"]
    axes.plot(bayes["noise_level"], bayes["value"], color=color, ls="--", lw=1.2)
    axes.plot(tight["noise_level"], tight["value"], color=color, marker="o", ls="", ms=5)
    _write_name(axes, bayes["noise_level"], bayes["value"], "least possible", color, below=True)
    floor = bounds[bounds.method == "floor"].sort_values("noise_level")
    axes.set_yscale("log")
    if not floor.empty:
        bottom = 0.6 * float(floor["value"].min())
        level, value = floor["noise_level"], floor["value"]
        axes.fill_between(level, bottom, value, color=FLOOR["color"], alpha=0.25, lw=0)
        axes.set_ylim(bottom=bottom)
        _write_name(axes, level, 0.7 * value, "local floor", "#555555", below=True)
    noise_axis(axes, np.unique(bayes["noise_level"]))
    readable_log_axis(axes)
    axes.grid(True, which="major")
    axes.set_ylabel(METRIC_LABELS["mse"], fontsize=8)


def _write_name(
    axes: Axes, level: pd.Series, value: pd.Series, name: str, color: str, *, below: bool = False
) -> None:
    """Write the name of a line beside its second point, where lines are separate."""
    point = min(1, len(level) - 1)
    position = (float(level.iloc[point]), float(value.iloc[point]))
    offset, ha, va = ((6, -3), "left", "top") if below else ((-2, 5), "right", "bottom")
    axes.annotate(name, position, offset, textcoords="offset points", color=color, ha=ha, va=va)
