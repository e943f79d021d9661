"""Axes, line styles and legends that figures of tables share.

Panels have an axis of noise levels, a readable logarithmic axis of errors, one line style for each
method, and a legend below all of them.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from typing import Any

import numpy as np
import pandas as pd

from psfdae.base.figures import new_figure
from psfdae.base.types import Artist, Axes, Figure
from psfdae.methods import method
from psfdae.methods.interface import Method
from psfdae_paper.configuration.methods import sort_oracles_last

METRIC_LABELS = {
    "mse": "MSE per pixel (stamp sum = 1)",
    "ssim": "1 − SSIM, data range fitted to the paper",
}
"""Labels of axes by metric."""

Style = dict[str, Any]
"""Keyword arguments of a line."""

Panel = tuple["Axes", str, pd.DataFrame]
"""Axes of a reference, its name, and its rows of a table."""


def reference_title(reference: str) -> str:
    """Return the name of a reference in titles."""
    return {
        "realisation": "against the star's own noise-free image (realisation)",
        "template": "against the static PSF of the field (template)",
    }[reference]


def make_panels(table: pd.DataFrame) -> tuple[Figure, list[Panel]]:
    """Make a figure with one titled panel for each reference of a table.

    The panels stand side by side, realisations first, and share the axis of errors.

    Parameters
    ----------
    table : DataFrame
        Rows with a column `reference`.

    Returns
    -------
    figure : Figure
    panels : list of (Axes, str, DataFrame)
        Axes, name of the reference and its rows.
    """
    # A panel for each reference that the table has; sorted by name, realisations are first.
    figure = new_figure(4.9, layout="constrained")
    references = sorted(set(table["reference"]))
    all_axes = figure.subplots(1, len(references), squeeze=False, sharey=True)[0]
    for axes, name in zip(all_axes, references, strict=True):
        # Words in brackets are on a second line: two panels share the width of the figure.
        axes.set_title(reference_title(name).replace(" (", "\n("))
        axes.grid(True, which="major")
    rows = [table[table.reference == name] for name in references]
    return figure, list(zip(all_axes, references, rows, strict=True))


def finish_panels(
    figure: Figure,
    panels: Sequence[Panel],
    title: str,
    handles: Sequence[Artist],
    columns: int,
    label: str = METRIC_LABELS["mse"],
) -> None:
    """Label the common axis of errors; add the title, and the legend below the panels."""
    # The panels share one axis of errors: the first one's scale and label hold for all.
    first = panels[0][0]
    first.set_yscale("log")
    label_log_axis(first)
    first.set_ylabel(label)
    figure.suptitle(title)
    figure.legend(handles=list(handles), loc="outside lower center", ncols=columns)


def group_by_method(table: pd.DataFrame) -> list[tuple[type[Method], pd.DataFrame]]:
    """Return the methods in a table in the order of their names, with the rows of each."""
    return [(method(str(name)), rows) for name, rows in table.groupby("method")]


def method_line(method_class: type[Method]) -> Style:
    """Return the style of a method's line."""
    # Colour and marker of a method are the same in all figures.
    look = method_class.look
    return {"color": look.color, "marker": look.marker, "lw": 1.4, "ms": 4.5}


def paper_marker(method_class: type[Method]) -> Style:
    """Return the style of the paper's published values: an open marker without a line."""
    # The paper gives no standard errors: its markers are larger and open.
    return {**method_line(method_class), "mfc": "none", "mew": 1.4, "ms": 9, "ls": ""}


def make_entry(label: str, **style: Any) -> Artist:
    """Return an entry of a legend with the style of a line, black unless it has a colour."""
    from matplotlib.lines import Line2D

    return Line2D([], [], **{"color": "black", **style}, label=label)


def make_method_entries(methods: set[str], paper_methods: Set[str] = frozenset()) -> list[Artist]:
    """Return legend entries of measured methods, each followed by the paper's open marker."""
    # Methods that are given the noise level stand last.
    entries: list[Artist] = []
    for method_class in sort_oracles_last(methods | paper_methods):
        label = method_class.look.label
        if method_class.name in methods:
            entries.append(make_entry(label, **method_line(method_class)))
        if method_class.name in paper_methods:
            entries.append(make_entry(f"{label}, paper", **paper_marker(method_class)))
    return entries


def set_noise_axis(axes: Axes, levels: np.ndarray) -> None:
    """Make the x axis logarithmic, with a tick at each noise level λ.

    The common power of ten is in the label of the axis.
    """
    # Rounding must not make log10(1e-3) less than −3.
    power = int(np.floor(np.log10(levels.min()) + 1e-9))
    set_log_axis(axes, levels, [f"{level / 10.0**power:g}" for level in levels])
    exponent = str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    axes.set_xlabel(f"noise level λ (× 10{exponent})")


def set_log_axis(axes: Axes, ticks: np.ndarray, labels: list[str]) -> None:
    """Make the x axis logarithmic with these ticks and no others."""
    from matplotlib.ticker import NullLocator

    # A logarithmic axis would add minor ticks of its own.
    axes.set_xscale("log")
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xticks(ticks, labels=labels)


def label_log_axis(axes: Axes) -> None:
    """Write numbers on the y axis between decades, too: it often spans only one or two."""
    from matplotlib.ticker import LogFormatterSciNotation, LogLocator, NullFormatter

    # Labels at 1, 2 and 5 times each power of ten.
    axes.yaxis.set_major_locator(LogLocator(base=10, subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(LogFormatterSciNotation(minor_thresholds=(10, 10)))
    axes.yaxis.set_minor_formatter(NullFormatter())
