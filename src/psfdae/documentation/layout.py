"""Layered layout of a directed graph, after Sugiyama, Tagawa & Toda (1981).

Nodes stand in layers, every edge leads to a later layer. An edge that crosses
layers gets a stand-in in each of them, so that it is led around the nodes there.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import networkx as nx

Node = Any
STAND_IN = 0.15
"""Extent of an edge across a layer, in the unit of the nodes' extents."""

SWEEPS = 24


@dataclass(frozen=True)
class Layout:
    """Where nodes and edges are.

    Attributes
    ----------
    layer : dict
        Number of every node's layer, from 0.
    across : dict
        Centre of every node within its layer, in the unit of the extents.
    routes : dict
        (layer, across) of every edge at each layer from its first to its last node.
    """

    layer: dict[Node, int]
    across: dict[Node, float]
    routes: dict[tuple[Node, Node], list[tuple[int, float]]]

    def size(self, extent: Mapping[Node, float]) -> float:
        """Right edge of nodes and edges; the left one is at 0."""
        ends = [self.across[n] + 0.5 * extent[n] for n in self.across]
        return max(ends + [y for route in self.routes.values() for _, y in route], default=0.0)


def layered(graph: nx.DiGraph, extent: Mapping[Node, float], gap: float) -> Layout:
    """Place the nodes of an acyclic graph; unconnected parts lie side by side.

    Parameters
    ----------
    graph : networkx.DiGraph
        Acyclic.
    extent : mapping
        Size of every node across its layer.
    gap : float
        Least distance between neighbours.
    """
    import networkx as nx

    parts = [sorted(part, key=str) for part in nx.weakly_connected_components(graph)]
    whole = Layout({}, {}, {})
    start = 0.0
    for part in sorted(parts, key=lambda nodes: (-len(nodes), str(nodes[0]))):
        placed = _connected(graph.subgraph(part), extent, gap)
        low = [placed.across[n] - 0.5 * extent[n] for n in part]
        shift = start - min(low + [y for route in placed.routes.values() for _, y in route])
        whole.layer.update(placed.layer)
        whole.across.update({n: y + shift for n, y in placed.across.items()})
        for edge, route in placed.routes.items():
            whole.routes[edge] = [(at, y + shift) for at, y in route]
        start = whole.size(extent) + gap
    return whole


def layers_of(graph: nx.DiGraph) -> dict[Node, int]:
    """Layer of every node: after all it comes from, and as near as possible to what follows."""
    import networkx as nx

    order = list(nx.lexicographical_topological_sort(graph, key=str))
    layer: dict[Node, int] = {}
    for node in order:
        layer[node] = 1 + max((layer[n] for n in graph.predecessors(node)), default=-1)
    for node in reversed(order):
        following = [layer[n] for n in graph.successors(node)]
        if following:
            layer[node] = min(following) - 1
    return layer


def _connected(graph: nx.DiGraph, extent: Mapping[Node, float], gap: float) -> Layout:
    layer = layers_of(graph)
    chains = {
        (u, v): [u, *((u, v, at) for at in range(layer[u] + 1, layer[v])), v]
        for u, v in sorted(graph.edges, key=str)
    }
    rows: list[list[Node]] = [[] for _ in range(1 + max(layer.values()))]
    for node in sorted(graph, key=str):
        rows[layer[node]].append(node)
    before: dict[Node, list[Node]] = {}
    after: dict[Node, list[Node]] = {}
    for (u, _), chain in chains.items():
        for step, (first, second) in enumerate(itertools.pairwise(chain)):
            if step > 0:
                rows[layer[u] + step].append(first)
            after.setdefault(first, []).append(second)
            before.setdefault(second, []).append(first)
    rows = _fewest_crossings(rows, before, after)
    size = {node: extent.get(node, STAND_IN) for row in rows for node in row}
    across = _straightened(rows, before, after, size, gap)
    routes = {
        edge: [(layer[edge[0]] + i, across[node]) for i, node in enumerate(chain)]
        for edge, chain in chains.items()
    }
    return Layout(layer, {n: across[n] for n in graph}, routes)


def _fewest_crossings(
    rows: list[list[Node]], before: Mapping[Node, list[Node]], after: Mapping[Node, list[Node]]
) -> list[list[Node]]:
    """Order within the layers by the barycentre rule, the best of all sweeps."""
    rows = [list(row) for row in rows]
    best, least = [list(row) for row in rows], _crossings(rows, after)
    for sweep in range(SWEEPS):
        down = sweep % 2 == 0
        for i in range(1, len(rows)) if down else range(len(rows) - 2, -1, -1):
            fixed = rows[i - 1 if down else i + 1]
            place = {node: float(k) for k, node in enumerate(fixed)}
            beside = before if down else after
            own = {node: float(k) for k, node in enumerate(rows[i])}

            def barycentre(
                node: Node,
                beside: Mapping[Node, list[Node]] = beside,
                place: Mapping[Node, float] = place,
                own: Mapping[Node, float] = own,
            ) -> float:
                values = [place[n] for n in beside.get(node, [])]
                return float(np.mean(values)) if values else own[node]

            rows[i].sort(key=barycentre)
        count = _crossings(rows, after)
        if count < least:
            best, least = [list(row) for row in rows], count
    return best


def _crossings(rows: list[list[Node]], after: Mapping[Node, list[Node]]) -> int:
    total = 0
    for row, following in itertools.pairwise(rows):
        place = {node: k for k, node in enumerate(following)}
        ends = [(k, place[n]) for k, node in enumerate(row) for n in after.get(node, [])]
        total += sum(
            (a[0] - b[0]) * (a[1] - b[1]) < 0 for i, a in enumerate(ends) for b in ends[:i]
        )
    return total


def _straightened(
    rows: list[list[Node]],
    before: Mapping[Node, list[Node]],
    after: Mapping[Node, list[Node]],
    size: Mapping[Node, float],
    gap: float,
) -> dict[Node, float]:
    """Centres that keep the order and the gaps, each as near as can be to its neighbours'."""
    from scipy.optimize import isotonic_regression

    offsets = []
    for row in rows:
        half = np.array([0.5 * size[node] for node in row])
        steps = half[1:] + half[:-1] + gap
        offsets.append(np.concatenate([[0.0], np.cumsum(steps)]))
    across: dict[Node, float] = {}
    for row, offset in zip(rows, offsets, strict=True):
        across.update(zip(row, offset.tolist(), strict=True))
    for sweep in range(SWEEPS):
        order = range(len(rows)) if sweep % 2 == 0 else range(len(rows) - 1, -1, -1)
        for i in order:
            wanted = []
            for node in rows[i]:
                beside = [across[n] for n in (*before.get(node, []), *after.get(node, []))]
                wanted.append(np.mean(beside) if beside else across[node])
            # With the gaps taken out, keeping them is keeping the order.
            placed = isotonic_regression(np.array(wanted) - offsets[i]).x + offsets[i]
            across.update(zip(rows[i], placed.tolist(), strict=True))
    return across
