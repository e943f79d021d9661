"""Commands that pack trained networks and say what is in a pack."""

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
)

bundle_argument = click.argument("bundle", type=FileArgument, required=False)


@main.command()
@input_option("stars", "Product of the stage stars that the network was trained on.")
@input_option("dae", "Folder of a trained network.", FolderArgument)
@click.option(
    "--split",
    type=click.Choice(["random", "held_out"]),
    help="Refuse a network of another split.  [default: that of the training]",
)
@click.option("--name", help="Name of the model.  [default: the file's]")
@click.option("--licence", default="not stated", show_default=True, help="Of the model.")
@out_option("Bundle, a file NAME.psf.safetensors.")
@overrides
def bundle(
    stars: Path,
    dae: Path,
    split: str | None,
    name: str | None,
    licence: str,
    out: Path,
    overrides: tuple[str, ...],
) -> None:
    """Pack a trained network with its errors and all that it takes to apply it."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import bundle as stage

    named = name or out.name.removesuffix(".psf.safetensors")
    stage.run(load_stage("bundle", overrides), stars, dae, split, named, licence, out)


@main.command()
@bundle_argument
@out_option("ONNX file.")
def export(bundle: Path | None, out: Path) -> None:
    """Export the network of BUNDLE (default: the shipped one) to ONNX and check it."""
    from psfdae.stages import bundle_use as stage

    stage.export(bundle, out)


@main.command()
@bundle_argument
def describe(bundle: Path | None) -> None:
    """Say what BUNDLE (default: the shipped one) was trained for and how well it does."""
    from psfdae.stages import bundle_use as stage

    click.echo(stage.describe(bundle))


@main.command()
@click.argument("bundle", type=FileArgument)
@out_option("Folder of the package's bundles.", FolderArgument)
def ship(bundle: Path, out: Path) -> None:
    """Make BUNDLE the one that comes with the package."""
    from psfdae.stages import bundle_use as stage

    click.echo(stage.ship(bundle, out))
