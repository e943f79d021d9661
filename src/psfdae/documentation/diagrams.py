"""Drawings of layered graphs: the workflow's rules and the package's modules."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.documentation.layout import layered
from psfdae.evaluation.figure_style import styled

if TYPE_CHECKING:
    import networkx as nx
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = (
    *("#cfe2f3", "#fce5cd", "#d9ead3", "#ead1dc", "#fff2cc", "#d9d2e9", "#d0e0e3", "#f4cccc"),
    *("#e6e0c8", "#c9daf8", "#eeeeee", "#d5f0e6", "#f6dfc0", "#e2d3c4", "#cfd8dc", "#f0f4c3"),
)
"""Fills that black text stays readable on."""

LINE = "#666666"
NAME_PT = 9.0
SMALL_PT = 7.0
LETTER_IN = 0.0085
"""Width of an average letter per point of its size, generously; inches."""

LINE_IN = 0.0185
"""Height of a line of text per point of its size; inches."""

PAD_IN = 0.09
NAME_LETTERS = 16
"""Letters of a rule's name in a line."""

BOX_LETTERS = 34
"""Letters after which the modules in a box go on in the next line."""


@styled
def rules_figure(graph: nx.DiGraph, topics: Mapping[str, str]) -> Figure:
    """Rules from left to right, data flowing along the lines.

    Parameters
    ----------
    graph : networkx.DiGraph
        From `graphs.rule_graph`.
    topics : mapping
        File that a rule is written in; it chooses the colour.
    """
    text = {n: _wrapped(n) for n in graph}
    height = {n: len(text[n]) * NAME_PT * LINE_IN + PAD_IN for n in graph}
    width = {n: max(map(len, text[n])) * NAME_PT * LETTER_IN + 2 * PAD_IN for n in graph}
    layout = layered(graph, height, gap=0.13)
    layers = 1 + max(layout.layer.values())
    columns = [max(width[n] for n in graph if layout.layer[n] == i) for i in range(layers)]
    left = np.concatenate([[0.0], np.cumsum(np.array(columns[:-1]) + 0.45)])
    tall = layout.size(height)
    names = sorted({topics.get(rule, "targets") for rule in graph})
    color = dict(zip(names, np.resize(COLORS, len(names)).tolist(), strict=True))
    figure, axes = _canvas(float(left[-1]) + columns[-1], tall, legend_in=0.55)
    boxes = {
        n: (
            float(left[layout.layer[n]]),
            tall - layout.across[n] - 0.5 * height[n],
            width[n],
            height[n],
        )
        for n in graph
    }
    for (u, v), route in layout.routes.items():
        end = boxes[v][0]
        start, edge = layout.layer[u], tall - route[0][1]
        points = [(boxes[u][0] + boxes[u][2], edge), (float(left[start]) + columns[start], edge)]
        for at, y in route[1:-1]:
            points += [(float(left[at]), tall - y), (float(left[at]) + columns[at], tall - y)]
        _line(axes, [*points, (end, tall - route[-1][1])], horizontal=True)
    for rule, box in boxes.items():
        _box(axes, box, color[topics.get(rule, "targets")], "\n".join(text[rule]))
    _legend(axes, color)
    return figure


@styled
def modules_figure(
    graph: nx.DiGraph, against: Sequence[tuple[str, str]], members: Mapping[str, Sequence[str]]
) -> Figure:
    """Sub-packages from top to bottom, each above all that it imports.

    Parameters
    ----------
    graph, against : from `graphs.package_graph`
    members : mapping
        Modules of every sub-package, from `graphs.package_modules`.
    """
    text = {n: textwrap.wrap(", ".join(members[n]), BOX_LETTERS) for n in graph}
    width = {n: _box_width(n, text[n]) for n in graph}
    layout = layered(graph, width, gap=0.25)
    layers = 1 + max(layout.layer.values())
    height = {n: (NAME_PT + len(text[n]) * SMALL_PT) * LINE_IN + 2 * PAD_IN for n in graph}
    rows = [max(height[n] for n in graph if layout.layer[n] == i) for i in range(layers)]
    drop = np.concatenate([[0.0], np.cumsum(np.array(rows[:-1]) + 0.42)])
    tall = float(drop[-1]) + rows[-1]
    figure, axes = _canvas(layout.size(width), tall, legend_in=0.0)
    top = {n: tall - float(drop[layout.layer[n]]) for n in graph}
    for (u, v), route in layout.routes.items():
        lowest = tall - float(drop[route[0][0]]) - rows[route[0][0]]
        points = [(layout.across[u], top[u] - height[u]), (layout.across[u], lowest)]
        for at, x in route[1:-1]:
            points += [(x, tall - float(drop[at])), (x, tall - float(drop[at]) - rows[at])]
        _line(axes, [*points, (layout.across[v], top[v])], horizontal=False)
    for u, v in against:
        start = (layout.across[u] + 0.3 * width[u], top[u])
        end = (layout.across[v] + 0.3 * width[v], top[v] - height[v])
        _line(axes, [start, end], horizontal=False, ls=(0, (3, 2)))
    for n in graph:
        box = (layout.across[n] - 0.5 * width[n], top[n] - height[n], width[n], height[n])
        _box(axes, box, COLORS[layout.layer[n] % len(COLORS)], n, text[n])
    return figure


def _wrapped(name: str) -> list[str]:
    """A rule's name in lines that break after underscores."""
    lines = [""]
    for part in name.replace("_", "_ ").split(" "):
        if lines[-1] and len(lines[-1]) + len(part) > NAME_LETTERS:
            lines.append("")
        lines[-1] += part
    return lines


def _box_width(name: str, lines: Sequence[str]) -> float:
    small = max((len(line) for line in lines), default=0) * SMALL_PT
    # Bold letters are wider.
    return max(1.15 * len(name) * NAME_PT, small) * LETTER_IN + 2 * PAD_IN


def _canvas(width: float, height: float, legend_in: float) -> tuple[Figure, Axes]:
    """A figure whose data unit is the inch, (0, 0) at the lower left of the drawing."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    margin = 0.1
    size = (width + 2 * margin, height + legend_in + 2 * margin)
    figure = Figure(figsize=size)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(-margin, width + margin)
    axes.set_ylim(-margin - legend_in, height + margin)
    axes.set_axis_off()
    return figure, axes


def _box(
    axes: Axes,
    box: tuple[float, float, float, float],
    color: str,
    name: str,
    lines: Sequence[str] = (),
) -> None:
    from matplotlib.patches import FancyBboxPatch

    x, y, width, height = box
    style = "round,pad=0,rounding_size=0.06"
    axes.add_patch(
        FancyBboxPatch((x, y), width, height, boxstyle=style, fc=color, ec="#444444", lw=0.8)
    )
    middle = x + 0.5 * width
    if not lines:
        axes.text(middle, y + 0.5 * height, name, fontsize=NAME_PT, ha="center", va="center")
        return
    axes.text(
        middle, y + height - PAD_IN, name, fontsize=NAME_PT, weight="bold", ha="center", va="top"
    )
    for i, line in enumerate(lines):
        below = y + height - PAD_IN - (NAME_PT + i * SMALL_PT) * LINE_IN
        axes.text(middle, below, line, fontsize=SMALL_PT, ha="center", va="top")


def _line(
    axes: Axes, points: Sequence[tuple[float, float]], *, horizontal: bool, **style: Any
) -> None:
    """A smooth line through points with an arrow; straight between points on one level."""
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.path import Path

    vertices, codes = [points[0]], [Path.MOVETO]
    for start, end in itertools.pairwise(points):
        half = 0.5 * (end[0] - start[0]) if horizontal else 0.5 * (end[1] - start[1])
        bend = (half, 0.0) if horizontal else (0.0, half)
        vertices += [
            (start[0] + bend[0], start[1] + bend[1]),
            (end[0] - bend[0], end[1] - bend[1]),
            end,
        ]
        codes += [Path.CURVE4] * 3
    arrow = FancyArrowPatch(
        path=Path(vertices, codes),
        arrowstyle="-|>",
        mutation_scale=8,
        color=LINE,
        lw=0.9,
        **style,
    )
    arrow.set_joinstyle("round")
    axes.add_patch(arrow)


def _legend(axes: Axes, color: Mapping[str, str]) -> None:
    from matplotlib.patches import Patch

    handles = [Patch(fc=fill, ec="#444444", lw=0.8, label=name) for name, fill in color.items()]
    axes.legend(
        handles=handles,
        loc="lower center",
        ncols=8,
        frameon=False,
        fontsize=SMALL_PT + 1,
        title="file in workflow/rules",
        title_fontsize=SMALL_PT + 1,
    )
