"""Commands that time baseline, inference and the growth of costs."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import (
    figure,
    input_option,
    main,
    out_option,
    overrides,
)


@main.command()
@input_option("stars", "Product of the stage stars.")
@out_option("CSV with time and error of PCA+SOM over its sizes.")
@overrides
def benchmark_baseline(stars: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Time PCA+SOM over components, map and epochs, on a quiet machine."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import timing as stage

    stage.baseline(load_stage("timing", overrides), stars, out)


@main.command()
@out_option("CSV with stars per second.")
@overrides
def benchmark_inference(out: Path, overrides: tuple[str, ...]) -> None:
    """Time the network in torch and in onnxruntime, on a quiet machine."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import timing as stage

    stage.inference(load_stage("timing", overrides), out)


@main.command()
@out_option("CSV with time, memory and disk over stars and stamp side.")
@overrides
def benchmark_scaling(out: Path, overrides: tuple[str, ...]) -> None:
    """Measure how simulation and inference grow, on a quiet machine."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import timing as stage

    stage.scaling(load_stage("timing", overrides), out)


@figure.command("benchmark")
@click.option("--kind", type=click.Choice(["baseline", "inference", "scaling"]), required=True)
@input_option("table", "CSV of the benchmark of that kind.")
@out_option("PNG.")
def figure_benchmark(kind: str, table: Path, out: Path) -> None:
    """Draw what a benchmark of baseline, inference or scaling has measured."""
    from psfdae.stages import timing as stage

    stage.figure(kind, table, out)
