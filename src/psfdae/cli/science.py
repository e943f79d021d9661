"""Commands that simulate, train and evaluate."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import (
    FileArgument,
    FolderArgument,
    input_option,
    main,
    out_option,
    overrides,
    reference_option,
    split_option,
)


@main.command()
@input_option("templates", "Product of the stage templates.")
@out_option("HDF5 product with noise-free stars.")
@overrides
def stars(templates: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Simulate noise-free stars with random aberrations."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import stars as stage

    stage.run(load_stage("stars", overrides), templates, out)


@main.command()
@input_option("stars", "Product of the stage stars.")
@split_option
@out_option("HDF5 product with the fitted PCA+SOM.")
@overrides
def baseline(stars: Path, split: str, out: Path, overrides: tuple[str, ...]) -> None:
    """Fit the PCA+SOM baseline."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import baseline as stage

    stage.run(load_stage("baseline", overrides), stars, split, out)


@main.command()
@input_option("stars", "Product of the stage stars.")
@split_option
@reference_option
@click.option(
    "--checkpoint",
    type=FileArgument,
    help="State of an interrupted training.  [default: OUT/checkpoint.pt]",
)
@out_option("Folder for weights, resolved config and history.", FolderArgument)
@overrides
def train(
    stars: Path,
    split: str,
    reference: str,
    checkpoint: Path | None,
    out: Path,
    overrides: tuple[str, ...],
) -> None:
    """Train a denoising autoencoder; resumes from its checkpoint."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import train as stage

    checked = load_stage("train", overrides)
    stage.run(checked, stars, split, reference, out, checkpoint or out / "checkpoint.pt")


@main.command()
@click.option("--dataset", required=True, help="Name that goes into the table.")
@input_option("stars", "Product of the stage stars.")
@input_option("pca-som", "Product of the stage baseline.")
@input_option("dae", "Folder of a trained network.", FolderArgument)
@split_option
@reference_option
@click.option("--per-star", type=FileArgument, required=True, help="Parquet with every star.")
@out_option("CSV with means and standard errors.")
@overrides
def evaluate(
    dataset: str,
    stars: Path,
    pca_som: Path,
    dae: Path,
    split: str,
    reference: str,
    per_star: Path,
    out: Path,
    overrides: tuple[str, ...],
) -> None:
    """Measure every method on the test stars at each noise level."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import evaluate as stage

    checked = load_stage("evaluate", overrides)
    stage.run(checked, dataset, stars, pca_som, dae, split, reference, out, per_star)
