"""Commands of the target bounds."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import FileArgument, input_option, main, out_option, overrides
from psfdae.cli.figures import figure

files_argument = click.argument("parts", nargs=-1, type=FileArgument, required=True)
dataset_option = click.option("--dataset", required=True, help="Name in the tables.")


@main.command()
@out_option("HDF5 product with fresh stars, framed so that they can be mirrored.")
@overrides
def bank(out: Path, overrides: tuple[str, ...]) -> None:
    """Simulate the bank of fresh stars behind the posterior mean."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import bank as stage

    stage.run(load_stage("bank", overrides), out)


@main.command()
@dataset_option
@input_option("stars", "Product of the stage stars.")
@input_option("templates", "Product of the stage templates.")
@click.option(
    "--bank",
    "bank_h5",
    type=FileArgument,
    help="Product of the stage bank; needed where stars have random aberrations.",
)
@click.option("--growth", type=FileArgument, required=True, help="CSV: error by size of the bank.")
@click.option("--per-star", type=FileArgument, required=True, help="Parquet with every star.")
@out_option("CSV with the bounds.")
@overrides
def bounds(
    dataset: str,
    stars: Path,
    templates: Path,
    bank_h5: Path | None,
    growth: Path,
    per_star: Path,
    out: Path,
    overrides: tuple[str, ...],
) -> None:
    """Bound the error that any estimator can reach on the test stars."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import bounds as stage

    checked = load_stage("bounds", overrides)
    stage.run(checked, dataset, stars, templates, bank_h5, out, growth, per_star)


@main.command()
@out_option("CSV.")
@files_argument
def collect_bounds(out: Path, parts: tuple[Path, ...]) -> None:
    """Join the tables of several datasets' bounds."""
    from psfdae.stages.bounds import collect as stage

    stage(parts, out)


@main.command()
@click.option("--bounds", "bounds_csv", type=FileArgument, multiple=True, required=True)
@click.option(
    "--bounds-per-star",
    type=FileArgument,
    multiple=True,
    required=True,
    help="Parquet of the stage bounds; repeat for more datasets.",
)
@out_option("CSV: every method beside every bound.")
@files_argument
def efficiency(
    bounds_csv: tuple[Path, ...], bounds_per_star: tuple[Path, ...], out: Path, parts: tuple[Path]
) -> None:
    """Compare methods with the bounds; PARTS are the evaluations' Parquet files."""
    from psfdae.stages.efficiency import run as stage

    stage(bounds_csv, bounds_per_star, parts, out)


@figure.command("bounds")
@dataset_option
@input_option("bounds", "CSV of the stage bounds.")
@input_option("efficiency", "CSV of the stage efficiency.")
@out_option("PNG.")
def figure_bounds(dataset: str, bounds: Path, efficiency: Path, out: Path) -> None:
    """Draw the methods' errors above the bounds."""
    from psfdae.stages import bound_figures as stage

    stage.errors(bounds, efficiency, dataset, out)


@figure.command("efficiency")
@dataset_option
@input_option("efficiency", "CSV of the stage efficiency.")
@out_option("PNG.")
def figure_efficiency(dataset: str, efficiency: Path, out: Path) -> None:
    """Draw the methods' efficiency against the noise level."""
    from psfdae.stages import bound_figures as stage

    stage.efficiency(efficiency, dataset, out)


@figure.command("bank-growth")
@dataset_option
@input_option("growth", "CSV of the stage bounds: error by size of the bank.")
@out_option("PNG.")
def figure_bank_growth(dataset: str, growth: Path, out: Path) -> None:
    """Draw the posterior mean's error against the size of the bank."""
    from psfdae.stages import bound_figures as stage

    stage.growth(growth, dataset, out)
