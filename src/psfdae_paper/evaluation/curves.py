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


SPLIT_LINES = {"random": "-", "held_out": "--"}
SPLIT_LABELS = {
    "random": "random test stars",
    "held_out": "stars of held-out fields",
}
METRIC_LABELS = {
    "mse": "MSE per pixel (stamp sum = 1)",
    "ssim": "SSIM, data range fitted to the paper",
    "ssim_unit": "SSIM, data range 1",
    "ssim_peak": "SSIM, data range of each reference",
}

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

NAMED_POINT = 1
"""The noise level at which lines have their names: there they lie apart."""


@styled
def training_curves(histories: Mapping[str, pd.DataFrame], title: str) -> Figure:
    """Training and validation error of each network of a dataset.

    Histories by label: columns step, train_mse, validation_mse (NaN where there was none).
    """
    from matplotlib.lines import Line2D

    figure = new_figure(4.6, layout="constrained")
    axes = figure.add_subplot()
    entries = []
    for i, (label, history) in enumerate(histories.items()):
        color = SERIES_COLORS[i % len(SERIES_COLORS)]
        checked = history.dropna(subset=["validation_mse"])
        axes.plot(history["step"], history["train_mse"], color=color, lw=1.0, ls=":")
        axes.plot(
            checked["step"], checked["validation_mse"], color=color, lw=1.6, marker="o", ms=3.5
        )
        kept = checked.iloc[checked["validation_mse"].argmin()]
        axes.plot(
            kept["step"], kept["validation_mse"], marker="*", ms=13, mfc=color, mec="black", ls=""
        )
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
    """A metric of every method against the noise level, one panel per reference.

    `metrics` are rows of the stage `evaluate`, those of other datasets are left out; `paper` is
    `psfdae_paper.evaluation.paper.published("psf")`, drawn where it has the dataset.
    """
    from matplotlib.lines import Line2D

    from psfdae_paper.evaluation.paper import paper_rows

    ours = metrics[(metrics.dataset == dataset) & (metrics.metric == metric)]
    theirs = paper[(paper.dataset == dataset) & (paper.metric == metric)]
    theirs = theirs.assign(method=theirs["method"].map(paper_rows()))
    figure, panels = _panels(ours)
    levels = np.unique(ours["noise_level"])
    for axes, (reference, measured) in zip(panels, _by_reference(ours), strict=True):
        for kind, rows in _by_method(measured):
            for split, part in rows.groupby("split"):
                line = part.sort_values("noise_level")
                style = {**_line(kind), "ls": SPLIT_LINES[str(split)], "capsize": 3}
                axes.errorbar(line["noise_level"], line["value"], yerr=line["stderr"], **style)
        for kind, rows in _by_method(theirs):
            axes.plot(rows["noise_level"], rows["value"], **_paper_marker(kind))
        axes.set_title(REFERENCES[reference].replace(" (", "\n("))
        noise_axis(axes, levels)
        axes.grid(True, which="major")
    if metric == "mse":
        panels[0].set_yscale("log")
        readable_log_axis(panels[0])
    panels[0].set_ylabel(METRIC_LABELS.get(metric, metric))
    figure.suptitle(f"{metric.upper().replace('_', ' ')} of {dataset} against the noise level")
    handles = _method_handles(set(ours["method"]), set(theirs["method"]))
    if "held_out" in set(ours["split"]):
        handles += [
            Line2D([], [], color="black", ls=line, lw=1.4, label=SPLIT_LABELS[split])
            for split, line in SPLIT_LINES.items()
        ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def _paper_marker(kind: type[Method]) -> Style:
    return {**_line(kind), "mfc": "none", "mew": 1.4, "ms": 9, "ls": ""}


def _method_handles(methods: set[str], published: Set[str] = frozenset()) -> list[Artist]:
    """Legend entries of our methods, each with the paper's open marker below it."""
    from matplotlib.lines import Line2D

    handles: list[Artist] = []
    for kind in oracles_last(methods | published):
        if kind.name in methods:
            handles.append(Line2D([], [], **_line(kind), label=kind.look.label))
        if kind.name in published:
            handles.append(Line2D([], [], **_paper_marker(kind), label=f"{kind.look.label}, paper"))
    return handles


def noise_axis(axes: Axes, levels: np.ndarray) -> None:
    """Logarithmic axis with a tick at each noise level and the common power of ten outside."""
    power = int(np.floor(np.log10(levels.min()) + 1e-9))
    _log_axis(axes, levels, [f"{level / 10.0**power:g}" for level in levels])
    axes.set_xlabel(rf"noise level λ ($\times 10^{{{power}}}$)")


def _log_axis(axes: Axes, ticks: np.ndarray, labels: list[str]) -> None:
    from matplotlib.ticker import NullLocator

    axes.set_xscale("log")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xticks(ticks, labels=labels)


def readable_log_axis(axes: Axes) -> None:
    """Numbers also between the decades, as these axes often span only one or two."""
    from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

    axes.yaxis.set_major_locator(LogLocator(base=10, subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(LogFormatterSciNotation(minor_thresholds=(10, 10)))
    axes.yaxis.set_minor_formatter(NullFormatter())


@styled
def errors_above_bounds(efficiency: pd.DataFrame, bounds: pd.DataFrame, dataset: str) -> Figure:
    """MSE of every method against the noise level, with both bounds, one panel per reference.

    Tables of the stages `efficiency` and `bounds`; rows of other datasets are left out.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    ours = efficiency[efficiency.dataset == dataset]
    limits = bounds[(bounds.dataset == dataset) & (bounds.metric == "mse")]
    figure, panels = _panels(limits)
    for axes, (reference, rows) in zip(panels, _by_reference(limits), strict=True):
        # Beside the floor, rows come again, and posterior means are among them.
        methods = ours[(ours.reference == reference) & (ours.bound != "floor")]
        for kind, errors in _by_method(methods.sort_values("noise_level")):
            axes.plot(errors["noise_level"], errors["mse"], **_line(kind))
        for name, look in MEANS.items():
            _bayes_line(axes, rows[rows.method == name].sort_values("noise_level"), look)
        _finish_panel(axes, reference, np.unique(rows["noise_level"]))
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
    handles = _method_handles(set(ours["method"]))
    for name, look in MEANS.items():
        found = set(limits["tight"][limits.method == name])
        if found:
            handles.append(Line2D([], [], ls="--", lw=1.2, ms=6, **look))
        if "no" in found:
            style = {**look, "mfc": "white", "label": "its draws too few: upper limit"}
            handles.append(Line2D([], [], ls="--", lw=1.2, ms=6, **style))
    if "floor" in set(limits["method"]):
        handles.append(Patch(facecolor=FLOOR["color"], alpha=0.35, label=FLOOR["label"]))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


@styled
def efficiency_against_noise(efficiency: pd.DataFrame, dataset: str) -> Figure:
    """Bound over MSE of every method against the noise level, one panel per reference.

    A table of the stage `efficiency`; rows of other datasets are left out.
    """
    from matplotlib.lines import Line2D

    ours = efficiency[efficiency.dataset == dataset]
    figure, panels = _panels(ours)
    for axes, (reference, rows) in zip(panels, _by_reference(ours), strict=True):
        shown = _of_methods(rows).sort_values("noise_level")
        for kind, compared in _by_method(shown):
            for bound, values in compared.groupby("bound"):
                style = _line(kind)
                style |= {"ls": ":", "mfc": "none"} if bound == "floor" else {"ls": "-", "lw": 1.6}
                axes.plot(values["noise_level"], values["efficiency"], **style)
        axes.axhline(1.0, color="black", lw=1.0)
        if shown["efficiency"].isna().all():
            axes.text(0.5, 0.5, "no tight bound above 0", transform=axes.transAxes, ha="center")
        _finish_panel(axes, reference, np.unique(rows["noise_level"]))
    panels[0].set_yscale("log")
    panels[0].set_ylim(top=2.0)
    readable_log_axis(panels[0])
    panels[0].set_ylabel("efficiency: bound / MSE")
    figure.suptitle(f"{dataset}: efficiency against the noise level, 1 = no better is possible")
    handles = _method_handles(set(ours["method"]))
    to_floor = _of_methods(ours).dropna(subset=["efficiency"])["bound"] == "floor"
    for found, line, label in (
        (~to_floor, "-", "against the posterior mean, where tight"),
        (to_floor, ":", "against the local floor"),
    ):
        if found.any():
            handles.append(Line2D([], [], color="black", ls=line, lw=1.6, label=label))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


@styled
def bank_growth(growth: pd.DataFrame, dataset: str) -> Figure:
    """Error of the posterior mean against the size of the bank, one panel per reference.

    The growth table of the stage `bounds`; rows of other datasets are left out.
    """
    from matplotlib.lines import Line2D

    ours = growth[growth.dataset == dataset]
    figure, panels = _panels(ours)
    levels = np.unique(ours["noise_level"])
    colors = dict(zip(levels, np.resize(SERIES_COLORS, levels.size), strict=True))
    for axes, (reference, rows) in zip(panels, _by_reference(ours), strict=True):
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
    """A figure with one panel per reference of a table."""
    figure = new_figure(4.9, layout="constrained")
    count = len(_by_reference(table))
    return figure, figure.subplots(1, count, squeeze=False, sharey=True)[0]


def _by_reference(table: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    present = set(table["reference"])
    return [(name, table[table.reference == name]) for name in REFERENCES if name in present]


def _by_method(table: pd.DataFrame) -> list[tuple[type[Method], pd.DataFrame]]:
    """Methods of a table by name, and the rows of each."""
    return [(method(str(name)), rows) for name, rows in table.groupby("method")]


def _of_methods(table: pd.DataFrame) -> pd.DataFrame:
    """Rows but for those of the posterior mean."""
    return table[table.method.isin([kind.name for kind in registered()])]


def _line(kind: type[Method]) -> Style:
    return {"color": kind.look.color, "marker": kind.look.marker, "lw": 1.4, "ms": 4.5}


def _finish_panel(axes: Axes, reference: str, levels: np.ndarray) -> None:
    axes.set_title(REFERENCES[reference].replace(" (", "\n("))
    noise_axis(axes, levels)
    # Levels without a value belong on the axis, too.
    room = max(levels.max() / levels.min(), 2.0) ** 0.05
    axes.set_xlim(levels.min() / room, levels.max() * room)
    axes.grid(True, which="major")


def _bayes_line(axes: Axes, rows: pd.DataFrame, look: Style) -> None:
    """Posterior mean with its confidence intervals; errors of 0 as a remark at the bottom."""
    color = look["color"]
    side: Style = {"ha": "right" if look is BAYES else "left", "weight": "bold", "color": color}
    for level in rows["noise_level"][rows.value == 0]:
        axes.text(level, 0.02, "0", transform=axes.get_xaxis_transform(), **side)
    rows = rows[rows.value > 0]
    level, value = rows["noise_level"].to_numpy(), rows["value"].to_numpy()
    reach = np.maximum([value - rows["ci_low"], rows["ci_high"] - value], 0.0)
    axes.errorbar(level, value, yerr=reach, color=color, ls="--", lw=1.2, capsize=3)
    tight = (rows["tight"] == "yes").to_numpy()
    for chosen, fill in ((tight, color), (~tight, "white")):
        style: Style = {"color": color, "marker": look["marker"], "mfc": fill, "ms": 6, "ls": ""}
        axes.plot(level[chosen], value[chosen], zorder=3, **style)


def _draw_floor(panels: np.ndarray, limits: pd.DataFrame) -> float | None:
    """Shade what lies below the floor; returns where the axis should end."""
    floor = limits[limits.method == "floor"].sort_values("noise_level")
    if floor.empty:
        return None
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
    """Stars in rows at the left, MSE of methods against the noise level at the right.

    Stamps are on the colour scale of the last row, the truth, unless `own_scale`. Tables of the
    stages `efficiency` and `bounds` are of one dataset and reference; `titles` (left, right).
    """
    figure = new_figure(3.7)
    left, bottom, top = 0.115, 0.13, 0.86
    columns = len(rows[0].images)
    step, tall = 0.395 / columns, (top - bottom) / len(rows)
    cell = (step * WIDTH_IN, tall * figure.get_figheight())
    peak, stamps = rows[-1].images.max(axis=(1, 2)), in_inches(figure)
    for number, row in enumerate(rows, 1):
        lower = top * figure.get_figheight() - number * cell[1]
        draw_row(stamps, row, (left * WIDTH_IN, lower), cell, peak)
    figure.text(left + 0.5 * columns * step, 0.92, titles[0], ha="center", fontsize=10)
    panel = figure.add_axes((0.66, bottom, 0.325, top - bottom))
    _errors(panel, methods, efficiency, bounds)
    figure.text(0.66 + 0.5 * 0.325, 0.92, titles[1], ha="center", fontsize=10)
    return figure


def _errors(
    axes: Axes, methods: Sequence[Method], efficiency: pd.DataFrame, bounds: pd.DataFrame
) -> None:
    """Errors of the methods and both bounds, each line with its name."""
    for kind in methods:
        line = efficiency[efficiency.method == kind.name].drop_duplicates("noise_level")
        line = line.sort_values("noise_level")
        style = {**_line(type(kind)), "lw": 1.6, "ms": 5}
        axes.plot(line["noise_level"], line["mse"], **style)
        # The lowest line is near the one above, and has room below where noise is least.
        last = kind is methods[-1]
        named = line[:1] if last else line
        name = kind.look.label.partition(" (")[0]  # what it is given stands beside its stars
        _name(axes, named["noise_level"], named["mse"], name, kind.look.color, below=last)
    optics = method("wavefront")
    known = efficiency[efficiency.method == optics.name].drop_duplicates("noise_level")
    if len(known):
        known = known.sort_values("noise_level")
        axes.plot(known["noise_level"], known["mse"], **{**_line(optics), "lw": 1.6, "ms": 8})
        # It hides under the least possible, whose name it stands below.
        low = 0.6 * known["mse"]
        _name(axes, known["noise_level"], low, "telescope known", optics.look.color, below=True)
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
    offset, ha, va = ((6, -3), "left", "top") if below else ((-2, 5), "right", "bottom")
    axes.annotate(name, place, offset, textcoords="offset points", color=color, ha=ha, va=va)
