"""References and drawings that are made from the code."""

from __future__ import annotations

import re

import click
import networkx as nx
import numpy as np
import pytest
import yaml
from click.testing import CliRunner

import psfdae
from docs_pages import ROOT
from psfdae.cli import main
from psfdae.configuration.alignment import AlignmentConfig
from psfdae.configuration.compose import compose, config_dir
from psfdae.configuration.schema import Config
from psfdae.documentation.commands import command_names, command_reference
from psfdae.documentation.graphs import (
    RulegraphError,
    package_graph,
    package_modules,
    rule_graph,
    rule_topics,
)
from psfdae.documentation.keys import key_reference, undescribed
from psfdae.documentation.layout import layered, layers_of
from workflow_runs import snakemake

DOT = """digraph snakemake_dag {
    0[label = "all", color = "0.1 0.6 0.85", style="rounded"];
    1[label = "train", color = "0.1 0.6 0.85", style="rounded"];
    2[label = "stars", color = "0.1 0.6 0.85", style="rounded"];
    3[label = "evaluate", color = "0.1 0.6 0.85", style="rounded"];
    1 -> 0
    2 -> 1
    1 -> 3
    2 -> 3
}
"""


@pytest.fixture(scope="module")
def diamond():
    """Two ways from a to d, a short cut, and a part of its own."""
    edges = [("a", "b"), ("a", "c"), ("b", "d"), ("c", "d"), ("a", "d"), ("d", "e"), ("x", "y")]
    return nx.DiGraph(edges)


def test_edges_lead_to_later_layers(diamond):
    layer = layers_of(diamond)
    assert all(layer[u] < layer[v] for u, v in diamond.edges)
    assert layer["a"] == layer["d"] - 2


def test_boxes_of_a_layer_keep_their_distance(diamond):
    extent = {node: 1.0 + 0.3 * i for i, node in enumerate(sorted(diamond))}
    layout = layered(diamond, extent, gap=0.25)
    for u in diamond:
        for v in diamond:
            if u < v and layout.layer[u] == layout.layer[v]:
                apart = abs(layout.across[u] - layout.across[v])
                assert apart >= 0.5 * (extent[u] + extent[v]) + 0.25 - 1e-9
    ends = [layout.across[n] - 0.5 * extent[n] for n in diamond]
    assert min(ends) >= -1e-9
    assert layout.size(extent) >= max(layout.across[n] + 0.5 * extent[n] for n in diamond) - 1e-9


def test_an_edge_across_layers_is_led_around_the_boxes(diamond):
    extent = dict.fromkeys(diamond, 1.0)
    layout = layered(diamond, extent, gap=0.2)
    (at, place) = layout.routes["a", "d"][1]
    boxes = [layout.across[n] for n in diamond if layout.layer[n] == at]
    assert min(np.abs(np.subtract(boxes, place))) > 0.5


def test_untangled_where_no_crossing_is_needed():
    graph = nx.DiGraph([("a", "q"), ("b", "p"), ("c", "r"), ("a", "r2")])
    layout = layered(graph, dict.fromkeys(graph, 1.0), gap=0.2)
    order = sorted(("a", "b", "c"), key=layout.across.get)
    targets = {"a": ("q", "r2"), "b": ("p",), "c": ("r",)}
    across = [
        layout.across[t] for node in order for t in sorted(targets[node], key=layout.across.get)
    ]
    assert across == sorted(across)


def test_rules_without_what_gathers_and_what_is_implied():
    graph = rule_graph(DOT)
    assert set(graph) == {"train", "stars", "evaluate"}
    assert set(graph.edges) == {("stars", "train"), ("train", "evaluate")}


def test_no_rulegraph_is_one_message():
    with pytest.raises(RulegraphError, match="no rule"):
        rule_graph("Error: no such target")
    result = CliRunner().invoke(main, ["draw", "rules", "--out", "x.svg"], input="")
    assert result.exit_code == 2
    assert result.output.startswith("psfdae: rulegraph: ")


def test_every_module_is_in_the_drawing():
    graph, against = package_graph()
    assert set(graph) == set(package_modules())
    assert nx.is_directed_acyclic_graph(graph)
    reachable = {(u, v) for u in graph for v in nx.descendants(graph, u)}
    assert {("cli", "stages"), ("stages", "optics"), ("stars", "rng")} <= reachable
    assert all((v, u) in reachable for u, v in against)


def words_of(svg):
    return " ".join(re.findall(r"<(?:text|tspan)\b[^>]*>([^<]+)", svg.read_text(encoding="utf-8")))


def test_drawing_of_modules_is_that_of_the_code(tmp_path):
    out = tmp_path / "modules.svg"
    CliRunner().invoke(main, ["draw", "modules", "--out", str(out)], catch_exceptions=False)
    drawn = words_of(out).split()
    assert drawn == words_of(ROOT / "docs/figures/modules.svg").split()
    assert {"cli", "optics", "rng"} <= set(drawn)


@pytest.mark.workflow
def test_drawing_of_rules_is_that_of_the_workflow(tmp_path):
    rules = set(rule_graph(snakemake(tmp_path, "all", "--rulegraph")))
    drawn = re.sub(r"_\s+", "_", words_of(ROOT / "docs/figures/rules.svg")).split()
    topics = rule_topics(ROOT / "workflow/rules")
    assert set(drawn) - set(["file", "in", "workflow/rules"]) - set(topics.values()) == rules


@pytest.fixture(scope="module")
def keys():
    return key_reference(Config, [compose(), compose(("scene=turbulence",))], config_dir())


def rows(text):
    return {
        line.split("|")[1].strip(): line for line in text.splitlines() if line.startswith("| `")
    }


def test_every_key_is_in_the_reference(keys):
    for group, field in Config.model_fields.items():
        if hasattr(field.annotation, "model_fields"):
            section = keys.split(f"### `{group}`\n")[1].split("\n### ")[0]
            assert set(rows(section)) == {f"`{key}`" for key in field.annotation.model_fields}


def test_a_key_has_unit_range_and_default(keys):
    found = rows(keys)
    assert "number (m)" in found["`diameter_m`"]
    assert "> 0, ≤ 1" in found["`lr`"]
    default = compose()["train"]["batch"]
    assert f"| `{default}` |" in keys.split("### `train`")[1].split("`batch`")[1].splitlines()[0]
    assert "`onecycle`, `constant`" in found["`schedule`"]
    assert "letters, digits, _" in found["`experiment`"]
    assert "| `25` |" in found["`outer_scale_m`"]


def test_options_say_what_they_set(keys):
    assert "- `width8`: As width16 with 8 channels. Takes `dae=width16`. Sets `widths: [8" in keys


def test_every_key_has_a_meaning():
    assert undescribed(Config) == []
    assert undescribed(AlignmentConfig) == []


def test_every_command_is_in_the_reference():
    text = command_reference(main, "psfdae")
    names = command_names(main, "psfdae")
    assert len(names) > 40
    for name in names:
        assert re.search(rf"^#+ `{re.escape(name)}`$", text, re.M), name


def test_versions_agree():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["version"] == psfdae.__version__
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(r"^## (\S+)", changes, re.M)[1] == psfdae.__version__
    assert cited["license"] == "MIT"
    assert (ROOT / "LICENSE").read_text(encoding="utf-8").startswith("MIT License")


def test_example_of_a_wrong_value_is_what_is_printed():
    page = (ROOT / "docs/configuration.md").read_text(encoding="utf-8")
    printed = CliRunner().invoke(main, ["config", "train.lr=2.0"])
    assert printed.exit_code == 2
    assert printed.output in page


def test_options_of_a_command():
    @click.group()
    def tool():
        """What it is."""

    @tool.command()
    @click.option("--size", type=click.IntRange(min=1), default=3, show_default=True, help="Of it.")
    @click.argument("files", nargs=-1)
    def make(size, files):
        """Make a < b.

        \b
        kept
        lines
        """

    text = command_reference(tool, "tool")
    assert "## `tool make`" in text
    assert "```text\ntool make [OPTIONS] [FILES]...\n```" in text
    assert "| `--size INTEGER RANGE` | Of it. *(default: 3; x>=1)* |" in text
    assert "Make a &lt; b." in text
    assert "```text\nkept\nlines\n```" in text
