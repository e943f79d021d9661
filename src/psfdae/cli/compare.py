"""The command that sets runs side by side."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import FileArgument, FolderArgument, main


@main.command()
@click.argument("runs", nargs=-1, type=FolderArgument, required=True)
@click.option("--out", type=FileArgument, help="Write the Markdown to this file, too.")
def compare(runs: tuple[Path, ...], out: Path | None) -> None:
    """Compare the first of some RUNS with each of the others.

    A run is the folder of a trained network, such as results/dae/dataset3/random-realisation
    or a point of a sweep; two folders of results compare all networks that both hold. Shown
    are settings that differ, the trainings, and errors with their significance.
    """
    from psfdae.files import write_text
    from psfdae.stages import compare as stage

    text = stage.run(runs)
    if out is not None:
        write_text(out, text)
    click.echo(text, nl=False)
