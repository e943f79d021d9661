"""Figures made of curves: how a training went, how the error grows with the noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.estimators import Method, method, oracles_last
from psfdae.evaluation.figure_style import REFERENCES, SERIES_COLORS, new_figure, styled

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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


@styled
def training_curves(histories: Mapping[str, pd.DataFrame], title: str) -> Figure:
    """Training and validation error of each network of a dataset.

    Parameters
    ----------
    histories : mapping of label to DataFrame
        Columns step, train_mse, validation_mse (NaN where there was none).
    title : str
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
        kept = checked.loc[checked["validation_mse"].idxmin()]
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

    Parameters
    ----------
    metrics : DataFrame
        Rows of the stage `evaluate`; those of other datasets are left out.
    paper : DataFrame
        `psfdae.evaluation.paper.published("psf")`; drawn where it has the dataset.
    dataset, metric : str
        For example `dataset3`, `mse`.
    """
    from psfdae.evaluation.paper import paper_rows

    ours = metrics[(metrics.dataset == dataset) & (metrics.metric == metric)]
    theirs = paper[(paper.dataset == dataset) & (paper.metric == metric)]
    theirs = theirs.assign(method=theirs["method"].map(paper_rows()))
    references = [name for name in REFERENCES if name in set(ours["reference"])]
    figure = new_figure(4.9, layout="constrained")
    panels = figure.subplots(1, len(references), sharey=True, squeeze=False)[0]
    levels = np.unique(ours["noise_level"])
    for axes, reference in zip(panels, references, strict=True):
        for (name, split), rows in ours[ours.reference == reference].groupby(["method", "split"]):
            _method_line(axes, method(name), split, rows)
        for name, rows in theirs.groupby("method"):
            axes.plot(rows["noise_level"], rows["value"], **_paper_marker(method(name)))
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
        handles += _split_handles()
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def _method_line(axes: Axes, kind: type[Method], split: str, rows: pd.DataFrame) -> None:
    rows = rows.sort_values("noise_level")
    axes.errorbar(
        rows["noise_level"],
        rows["value"],
        yerr=rows["stderr"],
        color=kind.color,
        marker=kind.marker,
        ls=SPLIT_LINES[split],
        lw=1.4,
        ms=4.5,
        capsize=3,
    )


def _paper_marker(kind: type[Method]) -> dict[str, Any]:
    own = {"color": kind.color, "marker": kind.marker}
    return {**own, "mfc": "none", "mew": 1.4, "ms": 9, "ls": ""}


def _method_handles(methods: set[str], published: set[str]) -> list[Any]:
    """Legend entries of our methods, each with the paper's open marker below it."""
    from matplotlib.lines import Line2D

    handles = []
    for kind in oracles_last(methods | published):
        if kind.name in methods:
            own = {"color": kind.color, "marker": kind.marker, "ms": 4.5, "lw": 1.4}
            handles.append(Line2D([], [], **own, label=kind.label))
        if kind.name in published:
            handles.append(Line2D([], [], **_paper_marker(kind), label=f"{kind.label}, paper"))
    return handles


def _split_handles() -> list[Any]:
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], color="black", ls=line, lw=1.4, label=SPLIT_LABELS[split])
        for split, line in SPLIT_LINES.items()
    ]


def noise_axis(axes: Axes, levels: np.ndarray) -> None:
    """Logarithmic axis with a tick at each noise level and the common power of ten outside."""
    from matplotlib.ticker import NullLocator

    power = int(np.floor(np.log10(levels.min()) + 1e-9))
    axes.set_xscale("log")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xticks(levels, labels=[f"{level / 10.0**power:g}" for level in levels])
    axes.set_xlabel(rf"noise level λ ($\times 10^{{{power}}}$)")


def readable_log_axis(axes: Axes) -> None:
    """Numbers also between the decades, as these axes often span only one or two."""
    from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

    axes.yaxis.set_major_locator(LogLocator(base=10, subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(LogFormatterSciNotation(minor_thresholds=(10, 10)))
    axes.yaxis.set_minor_formatter(NullFormatter())
