"""Commands that calibrate, tabulate and record."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import FileArgument, main, out_option


@main.command()
@out_option("Tidy CSV.")
@click.argument("evaluations", nargs=-1, type=FileArgument, required=True)
def collect(out: Path, evaluations: tuple[Path, ...]) -> None:
    """Join evaluations into one tidy table."""
    from psfdae.stages.tables import collect as stage

    stage(evaluations, out)


@main.command()
@click.option("--dataset", required=True)
@click.option("--metric", type=click.Choice(["mse", "ssim"]), required=True)
@out_option("CSV; the Markdown goes beside it.")
@click.argument("evaluations", nargs=-1, type=FileArgument, required=True)
def paper_tables(dataset: str, metric: str, out: Path, evaluations: tuple[Path, ...]) -> None:
    """Write one of the paper's tables, ours beside the paper's."""
    from psfdae.stages.tables import paper_tables as stage

    stage(evaluations, dataset, metric, out)
