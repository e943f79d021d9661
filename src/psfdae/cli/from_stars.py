"""Commands that train on one's own stars, and that simulate an image to try them on."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import (
    FileArgument,
    FolderArgument,
    main,
    name_or_number,
    out_option,
    overrides,
)

Positive = click.FloatRange(min=0, min_open=True)


@main.command("from-stars")
@click.argument("image", type=FileArgument)
@click.option("--catalogue", type=FileArgument, help="Star list of an image, FITS or CSV.")
@click.option("--pixel-scale", type=Positive, help="Arcseconds per pixel.  [default: the WCS's]")
@click.option("--origin", type=click.IntRange(0, 1), help="Index of the first pixel's centre.")
@click.option("--extension", help="Name or number of the extension with the stars.")
@click.option("--mask", help="Extension or FITS file; pixels other than 0 are bad.")
@click.option("--gain", type=Positive, help="Electrons per count.  [default: the header's]")
@click.option("--saturate", type=Positive, help="Counts of a saturated pixel.")
@click.option("--name", help="Name of the model.  [default: the image's]")
@click.option("--licence", default="not stated", show_default=True, help="Of the model.")
@out_option("Folder for the model, its report and what they are made of.", FolderArgument)
@click.option("--overwrite", is_flag=True, help="Replace a model that the folder holds.")
@overrides
def from_stars(
    image: Path,
    catalogue: Path | None,
    pixel_scale: float | None,
    origin: int | None,
    extension: str | None,
    mask: str | None,
    gain: float | None,
    saturate: float | None,
    name: str | None,
    licence: str,
    out: Path,
    overwrite: bool,
    overrides: tuple[str, ...],
) -> None:
    """Train a model on the bright stars of IMAGE.

    IMAGE is a FITS image with --catalogue, or a FITS cube of stamps. Some stars are
    held out and made faint to test the model.
    """
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import from_stars as stage

    exposure = stage.Source(
        path=image,
        catalogue=catalogue,
        extension=name_or_number(extension),
        origin=origin,
        mask=name_or_number(mask),
        pixel_scale_arcsec=pixel_scale,
        gain=gain,
        saturate=saturate,
    )
    config = load_stage("from_stars", ("dataset=from_stars", *overrides))
    named = name or image.name.split(".")[0]
    stage.run(
        config, exposure, out, name=named, licence=licence, overwrite=overwrite, say=click.echo
    )


@main.command("example-field")
@click.option("--catalogue", type=FileArgument, required=True, help="CSV file for the star list.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True)
@click.option("--side", type=click.IntRange(min=100), help="Pixels along a side.  [default: 1500]")
@click.option("--bright", type=click.IntRange(min=1), help="Bright stars.  [default: 300]")
@click.option("--faint", type=click.IntRange(min=0), help="Faint stars.  [default: 700]")
@out_option("FITS image.")
def example_field(
    catalogue: Path,
    seed: int,
    side: int | None,
    bright: int | None,
    faint: int | None,
    out: Path,
) -> None:
    """Simulate an image of a star field with its star list, to try things on."""
    from psfdae.stages import example_field as stage
    from psfdae.stages.common import check_outputs

    check_outputs((out,), (catalogue,))
    asked = {"side_px": side, "bright": bright, "faint": faint}
    stage.run(out, catalogue, seed, **{k: v for k, v in asked.items() if v is not None})
