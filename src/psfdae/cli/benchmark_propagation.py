"""Commands of the benchmark of the optics."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import (
    FileArgument,
    FolderArgument,
    figure,
    input_option,
    main,
    out_option,
    overrides,
)


@main.command()
@click.option(
    "--datasets",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Datasets that share the stars.",
)
@out_option("Folder for the tables of the scene.", FolderArgument)
@overrides
def propagation(datasets: int, out: Path, overrides: tuple[str, ...]) -> None:
    """Time the optics of a scene against its error; needs a quiet machine."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import propagation as stage

    stage.run(load_stage("propagation", overrides), datasets, out)


@main.command()
@out_option("CSV with the time that imports would take.")
@overrides
def import_times(out: Path, overrides: tuple[str, ...]) -> None:
    """Time the packages that the stages do not import; needs a quiet machine."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import propagation as stage

    stage.imports(load_stage("propagation", overrides), out)


@main.command()
@click.option(
    "--extra", type=FileArgument, multiple=True, help="CSV with more rows of the table of savings."
)
@out_option("Folder for the joined tables.", FolderArgument)
@click.argument("scenes", nargs=-1, type=FolderArgument, required=True)
def propagation_tables(extra: tuple[Path, ...], out: Path, scenes: tuple[Path, ...]) -> None:
    """Join the tables of the scenes and compare with other packages."""
    from psfdae.stages import propagation as stage

    stage.tables(scenes, extra, out)


@figure.command("propagation")
@click.option("--scene", required=True, help="Scene whose rows are drawn.")
@input_option("table", "CSV of the command propagation-tables.")
@out_option("PNG.")
def figure_propagation(scene: str, table: Path, out: Path) -> None:
    """Draw the error of every way to propagate against its time."""
    from psfdae.stages import propagation as stage

    stage.figure_propagation(table, scene, out)


@figure.command("skipping")
@input_option("table", "CSV of the command propagation-tables.")
@out_option("PNG.")
def figure_skipping(table: Path, out: Path) -> None:
    """Draw what leaving out superfluous work saves."""
    from psfdae.stages import propagation as stage

    stage.figure_skipping(table, out)
