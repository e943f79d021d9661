"""Commands that measure the prediction: its speed, and its quality on POPPY's stars."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import input_option, main, out_option, overrides


@main.command()
@input_option("stars", "Product of the stage stars.")
@input_option("bundle", "Model bundle of the same scene.")
@out_option("CSV with stamps per second and memory.")
@overrides
def benchmark_prediction(stars: Path, bundle: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Time predict from FITS to FITS beside the bare network, on a quiet machine."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import prediction as stage

    stage.throughput(load_stage("prediction", overrides), stars, bundle, out)


@main.command()
@input_option("bundle", "Model bundle of the dataset.")
@input_option("evaluation", "CSV of the stage evaluate for the same network.")
@click.option(
    "--count",
    type=click.IntRange(min=2),
    default=500,
    show_default=True,
    help="Stars that POPPY simulates.",
)
@out_option("CSV with the errors at each noise level.")
@overrides
def predict_poppy(
    bundle: Path, evaluation: Path, count: int, out: Path, overrides: tuple[str, ...]
) -> None:
    """Predict stars that POPPY has simulated and compare with the workflow's table."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import prediction as stage

    stage.poppy(load_stage("prediction", overrides), bundle, evaluation, count, out)
