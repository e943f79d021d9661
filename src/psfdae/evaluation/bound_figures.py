"""Figures of bounds: errors above them, efficiencies, and how they depend on the bank."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.estimators import Method, method, oracles_last, registered
from psfdae.evaluation.curves import METRIC_LABELS, noise_axis, readable_log_axis
from psfdae.evaluation.figure_style import (
    REFERENCES,
    SERIES_COLORS,
    new_figure,
    styled,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BAYES = {"color": "black", "marker": "o", "label": "posterior mean (Bayes)"}
"""Look of the posterior mean; its marker is open where the bank is too thin."""

FLOOR = {"color": "#7f7f7f", "label": "local floor: field and centring known"}
"""Look of the floor."""


@styled
def errors_above_bounds(efficiency: pd.DataFrame, bounds: pd.DataFrame, dataset: str) -> Figure:
    """MSE of every method against the noise level, with both bounds, one panel per reference.

    Parameters
    ----------
    efficiency : DataFrame
        Rows of the stage `efficiency`; those of other datasets are left out.
    bounds : DataFrame
        Rows of the stage `bounds`.
    dataset : str
    """
    ours = efficiency[efficiency.dataset == dataset]
    limits = bounds[(bounds.dataset == dataset) & (bounds.metric == "mse")]
    figure, panels = _panels(limits, sharey=True)
    for axes, (reference, rows) in zip(panels, _by_reference(limits), strict=True):
        methods = ours[(ours.reference == reference) & (ours.bound == "bayes")]
        for name, errors in methods.sort_values("noise_level").groupby("method"):
            axes.plot(errors["noise_level"], errors["mse"], **_line(method(name)))
        _bayes_line(axes, rows[rows.method == "bayes"].sort_values("noise_level"))
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
    _bounds_legend(figure, set(ours["method"]), limits)
    return figure


@styled
def efficiency_against_noise(efficiency: pd.DataFrame, dataset: str) -> Figure:
    """Bound over MSE of every method against the noise level, one panel per reference.

    Parameters
    ----------
    efficiency : DataFrame
        Rows of the stage `efficiency`; those of other datasets are left out.
    dataset : str
    """
    ours = efficiency[efficiency.dataset == dataset]
    figure, panels = _panels(ours, sharey=True)
    for axes, (reference, rows) in zip(panels, _by_reference(ours), strict=True):
        shown = _of_methods(rows).sort_values("noise_level")
        for (name, bound), values in shown.groupby(["method", "bound"]):
            style = _line(method(name))
            style |= {"ls": "-", "lw": 1.6} if bound == "bayes" else {"ls": ":", "mfc": "none"}
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
    _efficiency_legend(figure, ours)
    return figure


@styled
def bank_growth(growth: pd.DataFrame, dataset: str) -> Figure:
    """Error of the posterior mean against the size of the bank, one panel per reference.

    Parameters
    ----------
    growth : DataFrame
        Growth table of the stage `bounds`; rows of other datasets are left out.
    dataset : str
    """
    from matplotlib.lines import Line2D

    ours = growth[growth.dataset == dataset]
    figure, panels = _panels(ours, sharey=True)
    levels = np.unique(ours["noise_level"])
    colors = dict(zip(levels, np.resize(SERIES_COLORS, levels.size), strict=True))
    for axes, (reference, rows) in zip(panels, _by_reference(ours), strict=True):
        for level, sizes in rows.sort_values("draws").groupby("noise_level"):
            color = colors[level]
            axes.plot(sizes["draws"], sizes["mse"], color=color, marker="o", ms=4.5, lw=1.4)
            axes.axhline(sizes["limit"].iloc[0], color=color, ls="--", lw=1.0)
        _size_axis(axes, np.unique(rows["draws"]))
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
    handles.append(Line2D([], [], color="black", ls="--", lw=1.0, label="limit of the fit"))
    figure.legend(handles=handles, loc="outside lower center", ncols=5)
    return figure


def _panels(table: pd.DataFrame, **kwargs: Any) -> tuple[Figure, np.ndarray]:
    """A figure with one panel per reference of a table."""
    figure = new_figure(4.9, layout="constrained")
    count = len(_by_reference(table))
    return figure, figure.subplots(1, count, squeeze=False, **kwargs)[0]


def _by_reference(table: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    present = set(table["reference"])
    return [(name, table[table.reference == name]) for name in REFERENCES if name in present]


def _of_methods(table: pd.DataFrame) -> pd.DataFrame:
    """Rows but for those of the posterior mean."""
    return table[table.method.isin([kind.name for kind in registered()])]


def _line(kind: type[Method]) -> dict[str, Any]:
    return {"color": kind.color, "marker": kind.marker, "lw": 1.4, "ms": 4.5}


def _finish_panel(axes: Axes, reference: str, levels: np.ndarray) -> None:
    axes.set_title(REFERENCES[reference].replace(" (", "\n("))
    noise_axis(axes, levels)
    # Levels without a value belong on the axis, too.
    room = max(levels.max() / levels.min(), 2.0) ** 0.05
    axes.set_xlim(levels.min() / room, levels.max() * room)
    axes.grid(True, which="major")


def _size_axis(axes: Axes, draws: np.ndarray) -> None:
    """Logarithmic axis with a tick at every size of the bank."""
    from matplotlib.ticker import NullLocator

    axes.set_xscale("log")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xticks(draws, labels=[f"{count:d}" for count in draws])
    axes.set_xlabel("draws of the simulator in the bank")


def _bayes_line(axes: Axes, rows: pd.DataFrame) -> None:
    """Posterior mean with its confidence intervals; errors of 0 as a remark at the bottom."""
    for level in rows["noise_level"][rows.value == 0]:
        axes.text(
            level, 0.02, "0", transform=axes.get_xaxis_transform(), ha="center", weight="bold"
        )
    rows = rows[rows.value > 0]
    level, value = rows["noise_level"].to_numpy(), rows["value"].to_numpy()
    reach = np.maximum([value - rows["ci_low"], rows["ci_high"] - value], 0.0)
    color = BAYES["color"]
    axes.errorbar(level, value, yerr=reach, color=color, ls="--", lw=1.2, capsize=3)
    tight = (rows["tight"] == "yes").to_numpy()
    for chosen, fill in ((tight, color), (~tight, "white")):
        style = {"color": color, "marker": BAYES["marker"], "mfc": fill, "ms": 6, "ls": ""}
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


def _method_entries(methods: set[str]) -> list[Any]:
    from matplotlib.lines import Line2D

    return [Line2D([], [], **_line(kind), label=kind.label) for kind in oracles_last(methods)]


def _bounds_legend(figure: Figure, methods: set[str], limits: pd.DataFrame) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = _method_entries(methods)
    best = limits[limits.method == "bayes"]
    for tight, fill, label in (
        ("yes", BAYES["color"], BAYES["label"]),
        ("no", "white", "posterior mean, bank too thin: upper limit"),
    ):
        if tight in set(best["tight"]):
            style = {"color": BAYES["color"], "marker": BAYES["marker"], "mfc": fill, "ms": 6}
            handles.append(Line2D([], [], ls="--", lw=1.2, label=label, **style))
    if "floor" in set(limits["method"]):
        handles.append(Patch(facecolor=FLOOR["color"], alpha=0.35, label=FLOOR["label"]))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)


def _efficiency_legend(figure: Figure, table: pd.DataFrame) -> None:
    from matplotlib.lines import Line2D

    handles = _method_entries(set(table["method"]))
    shown = _of_methods(table).dropna(subset=["efficiency"])
    for bound, line, label in (
        ("bayes", "-", "against the posterior mean, where tight"),
        ("floor", ":", "against the local floor"),
    ):
        if bound in set(shown["bound"]):
            handles.append(Line2D([], [], color="black", ls=line, lw=1.6, label=label))
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
