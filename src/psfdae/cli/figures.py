"""Commands that draw figures."""

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
)


@main.group()
def figure() -> None:
    """Draw a figure as PNG from finished products."""


@figure.command("templates")
@input_option("templates", "Product of the stage templates.")
@out_option("PNG.")
def figure_templates(templates: Path, out: Path) -> None:
    """Draw the static PSFs at their field positions."""
    from psfdae.stages import figures as stage

    stage.templates(templates, out)


@figure.command("energy")
@input_option("templates", "Product of the stage templates.")
@out_option("PNG.")
def figure_energy(templates: Path, out: Path) -> None:
    """Draw the light inside the stamp over the field."""
    from psfdae.stages import figures as stage

    stage.energy(templates, out)


@figure.command("strip")
@click.option("--dataset", required=True, help="Name that goes into the title.")
@input_option("stars", "Product of the stage stars.")
@input_option("pca-som", "Product of the stage baseline, split random.")
@input_option("dae", "Folder of a network trained on the split random.", FolderArgument)
@reference_option
@click.option(
    "--level",
    "levels",
    type=click.FloatRange(min=0, min_open=True),
    multiple=True,
    required=True,
    help="Noise level λ; repeat for more rows.",
)
@out_option("PNG.")
@overrides
def figure_strip(
    dataset: str,
    stars: Path,
    pca_som: Path,
    dae: Path,
    reference: str,
    levels: tuple[float, ...],
    out: Path,
    overrides: tuple[str, ...],
) -> None:
    """Draw test stars before and after restoration."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import figures as stage

    checked = load_stage("evaluate", overrides)
    stage.strip(checked, dataset, stars, pca_som, dae, reference, levels, out)


@figure.command("headline")
@click.option("--dataset", required=True)
@input_option("stars", "Product of the stage stars.")
@input_option("pca-som", "Product of the stage baseline, split random.")
@input_option("dae", "Folder of a network trained on the split random.", FolderArgument)
@click.option(
    "--level", type=click.FloatRange(min=0, min_open=True), required=True, help="Noise level λ."
)
@input_option("bounds", "CSV of the stage bounds.")
@input_option("efficiency", "CSV of the stage efficiency.")
@out_option("PNG.")
@overrides
def figure_headline(
    dataset: str,
    stars: Path,
    pca_som: Path,
    dae: Path,
    level: float,
    bounds: Path,
    efficiency: Path,
    out: Path,
    overrides: tuple[str, ...],
) -> None:
    """Draw restored stars beside the errors and their bounds."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import headline as stage

    checked = load_stage("evaluate", overrides)
    stage.run(checked, dataset, stars, pca_som, dae, level, bounds, efficiency, out)


@figure.command("curves")
@click.option("--label", "labels", multiple=True, required=True, help="One per history, in order.")
@out_option("PNG.")
@click.argument("histories", nargs=-1, type=FileArgument, required=True)
def figure_curves(labels: tuple[str, ...], out: Path, histories: tuple[Path, ...]) -> None:
    """Draw training and validation error of networks."""
    from psfdae.stages import figures as stage

    stage.curves(histories, labels, out)


@figure.command("errors")
@click.option("--dataset", required=True)
@click.option("--metric", type=click.Choice(["mse", "ssim"]), required=True)
@out_option("PNG.")
@click.argument("evaluations", nargs=-1, type=FileArgument, required=True)
def figure_errors(dataset: str, metric: str, out: Path, evaluations: tuple[Path, ...]) -> None:
    """Draw a metric against the noise level, with the paper's points."""
    from psfdae.stages import figures as stage

    stage.errors(evaluations, dataset, metric, out)
