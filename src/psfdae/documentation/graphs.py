"""What the drawings show: the workflow's rules and the package's modules, as graphs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from psfdae import source

if TYPE_CHECKING:
    import networkx as nx

EVERYTHING = ("all", "runtime")
"""Rules that only gather what the others make; they would hide the shape of the graph."""


class RulegraphError(ValueError):
    """The text is not a graph that `snakemake --rulegraph` prints."""


def rule_graph(dot: str) -> nx.DiGraph:
    """Graph of rules, an edge from each rule to those that read its outputs.

    Parameters
    ----------
    dot : str
        Output of `snakemake --rulegraph`.

    Raises
    ------
    RulegraphError
        If it names no rule.
    """
    import networkx as nx

    names = dict(re.findall(r'^\s*(\d+)\[\s*label = "([^"\\]+)', dot, re.M))
    edges = re.findall(r"^\s*(\d+) -> (\d+)", dot, re.M)
    if not names:
        raise RulegraphError("rulegraph: no rule in it; `snakemake --rulegraph` prints one")
    graph = nx.DiGraph()
    graph.add_nodes_from(names.values())
    graph.add_edges_from((names[first], names[second]) for first, second in edges)
    graph.remove_nodes_from([rule for rule in EVERYTHING if rule in graph])
    return _reduced(graph)


def rule_topics(rules: Path) -> dict[str, str]:
    """The file, without suffix, in which each rule of a folder is written."""
    return {
        rule: path.stem
        for path in sorted(rules.glob("*.smk"))
        for rule in re.findall(r"^rule (\w+):", path.read_text(encoding="utf-8"), re.M)
    }


def package_modules() -> dict[str, list[str]]:
    """Modules of every sub-package by name; a module at the top stands alone, with none."""
    root = source.ROOT
    packages: dict[str, list[str]] = {}
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        if parts[-1].startswith("__") and len(parts) == 1:
            continue
        members = packages.setdefault(parts[0], [])
        if len(parts) > 1 and not parts[-1].startswith("__"):
            members.append(".".join(parts[1:]))
    return packages


def package_summaries() -> list[tuple[str, str]]:
    """Name and first sentence of every sub-package and of every module at the top."""
    import ast

    summaries = []
    for name in package_modules():
        path = source.ROOT / name / "__init__.py"
        path = path if path.is_file() else source.ROOT / f"{name}.py"
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        summaries.append((name, " ".join(text.split("\n\n", maxsplit=1)[0].split())))
    return summaries


def package_graph() -> tuple[nx.DiGraph, list[tuple[str, str]]]:
    """Which sub-package imports which, imports inside functions included.

    Returns
    -------
    graph : networkx.DiGraph
        Acyclic, an edge from the importer; edges that others imply are left out.
    against : list of (importer, imported)
        Imports against the layers: of two packages that import each other, the
        direction with fewer imports.
    """
    import networkx as nx

    graph = nx.DiGraph()
    graph.add_nodes_from(package_modules())
    for path in sorted(source.ROOT.rglob("*.py")):
        parts = path.relative_to(source.ROOT).with_suffix("").parts
        if len(parts) == 1 and parts[0].startswith("__"):
            continue
        module = ".".join([source.PACKAGE, *(p for p in parts if p != "__init__")])
        for name in source.imports(module):
            imported = name.split(".")[1]
            if imported != parts[0]:
                graph.add_edge(parts[0], imported)
                number = graph[parts[0]][imported].get("imports", 0)
                graph[parts[0]][imported]["imports"] = number + 1
    against: list[tuple[str, str]] = []
    while not nx.is_directed_acyclic_graph(graph):
        cycle = nx.find_cycle(graph)
        weakest = min(cycle, key=lambda edge: (graph.edges[edge]["imports"], edge))
        against.append(weakest)
        graph.remove_edge(*weakest)
    return _reduced(graph), sorted(against)


def _reduced(graph: nx.DiGraph) -> nx.DiGraph:
    """Only the edges that no longer path implies."""
    import networkx as nx

    return nx.transitive_reduction(graph)
