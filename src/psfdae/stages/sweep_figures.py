"""Stage `sweep figure`: the summary of a sweep as figures."""

from __future__ import annotations

from pathlib import Path

from psfdae.files import atomic_path
from psfdae.reading import read_table, read_yaml


def run(kind: str, definition: Path, table: Path, out: Path) -> None:
    """Draw the summary of a sweep.

    Parameters
    ----------
    kind : "parallel" or "response"
    definition : `sweep.yaml`
    table : `summary.csv`
    out : PNG
    """

    from psfdae.configuration.compose import validate
    from psfdae.configuration.sweep import Axis
    from psfdae.evaluation import sweep_figures

    described = read_yaml(definition)
    logarithmic = [n for n, axis in described["space"].items() if validate(Axis, axis).log]
    draw = {
        "parallel": sweep_figures.parallel_coordinates,
        "response": sweep_figures.response_curves,
    }[kind]
    axes = list(described["space"])
    text = dict.fromkeys(axes, str)
    drawn = draw(read_table(table, dtype=text), described, axes, logarithmic)
    with atomic_path(out) as temporary:
        drawn.savefig(temporary, format="png")
