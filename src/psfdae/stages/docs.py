"""Stage `docs`: pages whose numbers come from the run of record, and their drawings."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psfdae.files import atomic_path, write_text
from psfdae.reading import read_table

if TYPE_CHECKING:
    from click import Group
    from matplotlib.figure import Figure


def run(reference: Path, templates: Path, root: Path, commands: Group) -> list[Path]:
    """Render every `*.j2` template below a folder.

    Templates see `csv(name)`, a table of the run of record as a list of rows;
    `table(name)`, one of its Markdown files; `provenance`; `config(*overrides)` and
    `alignment_config(*overrides)`, composed configurations; the references of
    configuration, command line and packages; and `pages`, the names of all pages.
    Numbers are formatted in the template, never typed.

    Parameters
    ----------
    reference : folder of the run of record
    templates : folder of the templates; their relative path names the page
    root : folder below which the pages are written
    commands : click group of the command line

    Returns
    -------
    list of Path
        The pages.
    """
    pages = render(reference, templates, commands)
    for name, text in pages.items():
        write_text(root / name, text)
    return [root / name for name in pages]


def render(reference: Path, templates: Path, commands: Group) -> dict[str, str]:
    """Pages by name, as `run` writes them."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(templates),
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=False,
    )
    environment.filters["sci"] = lambda value, digits=2: f"{float(value):.{digits}e}"
    environment.filters["fixed"] = lambda value, digits=2: f"{float(value):.{digits}f}"
    environment.filters["median"] = statistics.median
    context = {
        "csv": lambda name: _rows(reference / name),
        "table": lambda name: (reference / name).read_text(encoding="utf-8").strip(),
        "provenance": json.loads((reference / "provenance.json").read_text()),
        **_from_the_code(commands),
    }
    names = environment.list_templates(extensions=["j2"])
    context["pages"] = [name.removesuffix(".j2") for name in names]
    return {
        page: environment.get_template(name).render(context)
        for page, name in zip(context["pages"], names, strict=True)
    }


def _from_the_code(commands: Group) -> dict[str, Callable[..., Any]]:
    """What templates see of configuration, command line and packages."""
    from psfdae.configuration.alignment import AlignmentConfig
    from psfdae.configuration.compose import compose, config_dir
    from psfdae.configuration.schema import Config
    from psfdae.documentation.commands import command_reference
    from psfdae.documentation.graphs import package_summaries
    from psfdae.documentation.keys import choices, key_reference

    def reference_of(root: str) -> str:
        if root == "alignment":
            listed = set(Config.model_fields)
            return key_reference(AlignmentConfig, [compose((), root)], config_dir(), listed)
        return key_reference(Config, [compose(), compose(("scene=turbulence",))], config_dir())

    return {
        "config": lambda *overrides: compose(overrides),
        "alignment_config": lambda *overrides: compose(overrides, "alignment"),
        "key_reference": reference_of,
        "choices": lambda *groups: choices(config_dir(), groups),
        "command_reference": lambda: command_reference(commands, "psfdae"),
        "package_summaries": package_summaries,
    }


def _rows(path: Path) -> list[dict[str, Any]]:

    return read_table(path).to_dict("records")


def draw_rules(rulegraph: str, rules: Path, out: Path) -> None:
    """Draw the workflow's rules as SVG.

    Parameters
    ----------
    rulegraph : output of `snakemake --rulegraph`
    rules : folder with the workflow's rule files
    out : path of the SVG
    """
    from psfdae.documentation.diagrams import rules_figure
    from psfdae.documentation.graphs import rule_graph, rule_topics

    _write_svg(rules_figure(rule_graph(rulegraph), rule_topics(rules)), out)


def draw_modules(out: Path) -> None:
    """Draw the package's modules and what they import as SVG."""
    from psfdae.documentation.diagrams import modules_figure
    from psfdae.documentation.graphs import package_graph, package_modules

    _write_svg(modules_figure(*package_graph(), package_modules()), out)


def _write_svg(figure: Figure, out: Path) -> None:
    """Write text as text, and the same bytes for the same drawing."""
    import matplotlib as mpl

    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "psfdae"}), atomic_path(out) as p:
        figure.savefig(p, format="svg", metadata={"Date": None, "Creator": None})
