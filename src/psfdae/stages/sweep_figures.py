"""Stage `sweep figure`: the summary of a sweep as figures."""

from __future__ import annotations

from typing import Annotated, Literal

from psfdae.cli import File, command
from psfdae.files import atomic_path
from psfdae.reading import read_table, read_yaml


@command("sweep figure")
def sweep_figure(
    kind: Annotated[Literal["parallel", "response"], {"argument": True}],
    definition: Annotated[File, "sweep.yaml of the command `sweep summary`."],
    table: Annotated[File, "summary.csv of the same."],
    out: Annotated[File, "PNG."],
) -> None:
    """Draw all points at once, or the metric against each axis."""
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
