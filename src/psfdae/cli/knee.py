"""Commands of the target training_knee."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import FileArgument, figure, input_option, main, out_option, overrides


@main.command()
@input_option("stars", "Product of the stage stars.")
@click.option(
    "--point", "points", multiple=True, required=True, metavar="NAME=FOLDER", help="A training."
)
@out_option("CSV with time and test error of every training.")
@click.option("--stopping", type=FileArgument, required=True, help="CSV: what stopping saves.")
@overrides
def training_knee(
    stars: Path, points: tuple[str, ...], out: Path, stopping: Path, overrides: tuple[str, ...]
) -> None:
    """Compare trainings of one dataset by test error and time."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import knee as stage

    folders = {name: Path(folder) for name, _, folder in (p.partition("=") for p in points)}
    stage.run(load_stage("knee", overrides), stars, folders, out, stopping)


@figure.command("knee")
@input_option("table", "CSV of the command training-knee.")
@out_option("PNG.")
def figure_knee(table: Path, out: Path) -> None:
    """Draw test error against training time."""
    from psfdae.stages import knee as stage

    stage.figure(table, out)
