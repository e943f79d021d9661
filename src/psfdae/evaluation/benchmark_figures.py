"""Figures of the benchmark of the optics: error against time, time with and without work."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.evaluation.figure_style import new_figure, styled

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WAYS: dict[str, dict[str, Any]] = {
    "kernel numpy": {"label": "our kernel, numpy", "color": "#0072b2", "marker": "o", "ms": 4},
    "kernel torch": {"label": "our kernel, torch", "color": "#56b4e9", "marker": "D", "ms": 3.5},
    "hcipy numpy": {"label": "HCIPy, matrix DFT", "color": "#009e73", "marker": "^", "ms": 6},
    "fft_pruned numpy": {"label": "FFT, pruned", "color": "#e69f00", "marker": "v", "ms": 6},
    "fft numpy": {"label": "FFT, zero-padded", "color": "#d55e00", "marker": "s", "ms": 5},
    "poppy_mft numpy": {"label": "POPPY, matrix DFT", "color": "#cc79a7", "marker": "P", "ms": 6},
    "poppy_fresnel numpy": {"label": "POPPY, Fresnel", "color": "#4d4d4d", "marker": "X", "ms": 6},
}
"""Label, colour and marker of every method and backend."""

PANELS = {"mild": "mild aberration", "strong": "strong aberration"}

SCENES = {"seidel": "scene 1", "turbulence": "scene 2", "all": ""}


@styled
def propagation_front(table: pd.DataFrame, scene: str) -> Figure:
    """Numerical MSE of a stamp against its time, one panel per aberration.

    Parameters
    ----------
    table : DataFrame
        Rows of one scene of `psfdae.benchmark.propagation`.
    scene : str
        For the title.
    """
    from matplotlib.lines import Line2D

    figure = new_figure(5.2, layout="constrained")
    aberrations = [name for name in PANELS if name in set(table["aberration"])]
    panels = figure.subplots(1, len(aberrations), sharex=True, sharey=True, squeeze=False)[0]
    for axes, aberration in zip(panels, aberrations, strict=True):
        _panel(axes, table[table["aberration"] == aberration])
        axes.set_title(PANELS[aberration])
        axes.set_xlabel("time per stamp (ms)")
    panels[0].set_ylabel("numerical MSE of the stamp (sum 1)")
    ways = set(table["method"] + " " + table["backend"])
    handles = [Line2D([], [], ls="", **WAYS[way]) for way in WAYS if way in ways]
    handles += [
        Line2D([], [], color="black", lw=1.0, label="Pareto front"),
        Line2D([], [], color="black", lw=1.2, ls="--", label="budget"),
        Line2D([], [], ls="", **_used_marker(), label="setting in use"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    threads = "–".join(str(n) for n in sorted({table["threads"].min(), table["threads"].max()}))
    figure.suptitle(f"{_named(scene)}: error of a stamp against its time, threads: {threads}")
    return figure


def _panel(axes: Axes, rows: pd.DataFrame) -> None:
    for way, style in WAYS.items():
        method, backend = way.split(" ")
        mine = rows[(rows["method"] == method) & (rows["backend"] == backend)]
        dots = {key: value for key, value in style.items() if key != "label"}
        axes.plot(mine["time_ms"], mine["mse"], ls="", alpha=0.75, mew=0, **dots)
    front = rows[rows["pareto"] == "yes"].sort_values("time_ms")
    axes.plot(front["time_ms"], front["mse"], color="black", lw=1.0)
    used = rows[rows["used"] == "yes"]
    axes.plot(used["time_ms"], used["mse"], ls="", zorder=5, **_used_marker())
    axes.axhline(rows["budget"].iloc[0], color="black", lw=1.2, ls="--")
    axes.set(xscale="log", yscale="log")
    axes.grid(True, which="major")


def _used_marker() -> dict[str, Any]:
    return {"marker": "*", "ms": 15, "mfc": "#f0e442", "mec": "black", "mew": 1.0}


def _named(scene: str) -> str:
    return SCENES.get(scene, scene).capitalize()


@styled
def savings(table: pd.DataFrame) -> Figure:
    """Time with and without superfluous work, one pair of bars per item, by saving.

    Parameters
    ----------
    table : DataFrame
        Rows of `psfdae.benchmark.skipping`.
    """
    rows = table.sort_values("saving", ignore_index=True)
    figure = new_figure(1.4 + 0.32 * len(rows), layout="constrained")
    axes = figure.add_subplot()
    place = np.arange(len(rows))
    for shift, column, color, label in (
        (0.2, "with_s", "#d55e00", "with it"),
        (-0.2, "without_s", "#0072b2", "without it"),
    ):
        axes.barh(place + shift, rows[column], height=0.38, color=color, label=label)
    longest = rows[["with_s", "without_s"]].max(axis=1)
    for i, row in rows.iterrows():
        axes.annotate(
            _factor(row["saving"]) + ("" if row["skipped"] == "yes" else ", kept"),
            (longest[i], i),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=7,
        )
    axes.set_yticks(place, labels=[_item(row) for _, row in rows.iterrows()])
    axes.set(xscale="log", xlabel="time (s) per star, set or process")
    axes.set_ylim(-0.7, len(rows) - 0.3)
    axes.margins(x=0.12)
    axes.grid(True, axis="x", which="major")
    axes.set_axisbelow(True)
    axes.set_title("What is not computed: time with and without it")
    axes.legend(loc="lower right")
    return figure


def _factor(saving: float) -> str:
    return f"{saving:.0f}×" if saving >= 10 else f"{saving:.2f}×"


def _item(row: pd.Series) -> str:
    where = SCENES.get(row["scene"], row["scene"])
    return f"{row['item']} ({where + ', ' if where else ''}per {row['per']})"
