"""The command that shows what a telescope does to stars."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import FileArgument, FolderArgument, input_option, main, out_option, overrides
from psfdae.cli.figures import figure

OWN_DATASET = "_telescope"
"""The dataset that a telescope of one's own is put into."""


@main.command()
@click.option("--out", type=FolderArgument, help="Folder.  [default: name of the telescope]")
@click.option("--fits", is_flag=True, help="Also write the PSFs as FITS cube, psfs.fits.")
@click.option(
    "--image-snr",
    type=click.FloatRange(min=0, min_open=True, max=1e6),
    help="Also write an image with a noisy star per field, image.fits, and stars.csv.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, help="Of the image's noise.")
@click.option(
    "--least-energy",
    type=click.FloatRange(0, 1),
    default=0.1,
    show_default=True,
    help="Refuse stamps that hold less of the light.",
)
@overrides
def simulate(
    out: Path | None,
    fits: bool,
    image_snr: float | None,
    seed: int,
    least_energy: float,
    overrides: tuple[str, ...],
) -> None:
    """Draw the PSFs of a telescope over its field: psfdae simulate telescope=NAME.

    Writes templates.h5, psfs.png and fields.csv.
    """
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import simulate as stage

    if not any(word.startswith(("dataset=", "scene=", "stars=")) for word in overrides):
        overrides = (f"dataset={OWN_DATASET}", *overrides)
    config = load_stage("templates", overrides)
    folder = out or Path(config.telescope.name)
    fields, warnings = stage.run(config, folder, least_energy)
    written = ["templates.h5", "psfs.png", "fields.csv"]
    if fits or image_snr:
        from psfdae.stages import simulate_fits

        if fits:
            simulate_fits.write_psfs(config, fields, folder / "psfs.fits")
            written.append("psfs.fits")
        if image_snr:
            image, catalogue = folder / "image.fits", folder / "stars.csv"
            simulate_fits.write_image(config, fields, image_snr, seed, image, catalogue)
            written += ["image.fits", "stars.csv"]
    for line in warnings:
        click.echo(f"psfdae: {line}", err=True)
    telescope = config.telescope
    click.echo(
        f"{telescope.name}: {len(fields.psf)} fields, pixels of {telescope.pixel:.3g} λ/D, "
        f"light inside the stamp {fields.energy.min():.3f} … {fields.energy.max():.3f}, "
        f"FWHM {fields.fwhm_arcsec.min():.3g} … {fields.fwhm_arcsec.max():.3g} arcsec"
    )
    click.echo(f"{folder}: {', '.join(written)}")


@figure.command("telescope")
@input_option("templates", "Product of the stage templates.")
@click.option("--table", type=FileArgument, required=True, help="CSV, a row per field point.")
@out_option("PNG.")
def figure_telescope(templates: Path, table: Path, out: Path) -> None:
    """Draw the static PSFs of a telescope with their light and their width."""
    from psfdae.stages import simulate as stage

    stage.draw(templates, out, table)
