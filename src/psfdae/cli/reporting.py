"""Commands that calibrate, tabulate and record."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import FileArgument, FolderArgument, input_option, main, out_option


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


@main.command()
@input_option("results", "Folder that the workflow writes to.", FolderArgument)
@click.option("--preset", required=True, help="Goes into the tags.")
@input_option("database", "SQLite file; mlartifacts/ lies beside it.")
@click.option(
    "--stars",
    type=(str, FileArgument),
    multiple=True,
    help="Dataset and its product of the stage stars.",
)
@click.option("--alignment", is_flag=True, help="The networks of scene 3.")
@click.option("--sweep", "sweeps", multiple=True, help="The points of a sweep.")
@out_option("CSV with the MLflow id of every run and what was done.")
def track(
    results: Path,
    preset: str,
    database: Path,
    stars: tuple[tuple[str, Path], ...],
    alignment: bool,
    sweeps: tuple[str, ...],
    out: Path,
) -> None:
    """Import finished runs into MLflow; MLFLOW_TRACKING_URI names a server instead."""
    from psfdae.alignment_runs import discover_alignment
    from psfdae.runs import discover
    from psfdae.stages import track as stage
    from psfdae.sweep_runs import discover_sweep

    entries = [*discover(results, dict(stars)), *(discover_alignment(results) if alignment else [])]
    entries += [entry for sweep in sweeps for entry in discover_sweep(results, sweep)]
    stage.run(entries, preset, database, database.parent / "mlartifacts", out)
