"""The command that predicts the PSFs of observed stars."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from psfdae.cli.base import FileArgument, main, name_or_number, out_option

Positive = click.FloatRange(min=0, min_open=True)


@main.command()
@click.argument("stars", metavar="INPUT", type=FileArgument)
@out_option("FITS file for PSFs, residuals, uncertainties and a table of stars.")
@click.option("--model", type=FileArgument, help="Model bundle.  [default: the shipped one]")
@click.option("--catalogue", type=FileArgument, help="Star list of an image, FITS or CSV.")
@click.option("--pixel-scale", type=Positive, help="Arcseconds per pixel.  [default: the WCS's]")
@click.option("--origin", type=click.IntRange(0, 1), help="Index of the first pixel's centre.")
@click.option("--flux-column", help="Fluxes inside the stamp; estimated where not given.")
@click.option("--background-column", help="Sky levels per pixel; estimated where not given.")
@click.option("--extension", help="Name or number of the extension with the stars.")
@click.option("--mask", help="Extension or FITS file; pixels other than 0 are bad.")
@click.option("--gain", type=Positive, help="Electrons per count.  [default: the header's]")
@click.option("--saturate", type=Positive, help="Counts of a saturated pixel.")
@click.option("--plot", type=FileArgument, help="PNG with a map of the PSF over the field.")
@click.option("--overwrite", is_flag=True, help="Replace files that exist.")
@click.option("--threads", type=click.IntRange(min=1), help="[default: all cores]")
@click.option("--quiet", is_flag=True, help="Neither progress nor summary.")
def predict(
    stars: Path,
    out: Path,
    model: Path | None,
    catalogue: Path | None,
    pixel_scale: float | None,
    origin: int | None,
    flux_column: str | None,
    background_column: str | None,
    extension: str | None,
    mask: str | None,
    gain: float | None,
    saturate: float | None,
    plot: Path | None,
    overwrite: bool,
    threads: int | None,
    quiet: bool,
) -> None:
    """Predict the PSFs of the stars in INPUT.

    INPUT is a FITS cube of stamps, or a FITS image with --catalogue. Stars are
    flagged, never dropped. Files that cannot be used end with one line and exit
    code 2.
    """
    from tqdm import tqdm

    from psfdae.stages import predict as stage

    source = stage.Source(
        path=stars,
        catalogue=catalogue,
        extension=name_or_number(extension),
        origin=origin,
        mask=name_or_number(mask),
        pixel_scale_arcsec=pixel_scale,
        gain=gain,
        saturate=saturate,
        flux_column=flux_column,
        background_column=background_column,
    )
    with tqdm(unit="star", unit_scale=True, desc="predict", disable=quiet or None) as bar:
        summary = stage.run(
            source,
            out,
            model=model,
            plot=plot,
            overwrite=overwrite,
            threads=threads,
            history=_command(),
            started=bar.reset,
            tick=bar.update,
        )
    if not quiet:
        flags = "".join(f"\n  {name}: {count}" for name, count in summary.flagged.items())
        click.echo(f"{out}: {summary.stars} stars, {summary.without} without a flag{flags}")


def _command() -> str:
    """The command line, without the folder of the program."""
    return " ".join(["psfdae", *sys.argv[1:]])
