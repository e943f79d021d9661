"""Command `residual`: an image without its sky and stars."""

from __future__ import annotations

from typing import Annotated

from psfdae.base.files import write_fits
from psfdae.base.options import File
from psfdae.commands.cli import command
from psfdae.commands.predict import check_targets
from psfdae.denoise.field_models import load_field
from psfdae.image.image_input import ImageInput, ImageOptions
from psfdae.photometry.image_photometry import measure_all_stars


@command("residual")
def residual_command(
    image: Annotated[File, {"argument": True}],
    options: ImageOptions,
    overwrite: bool = False,
    *,
    model: File,
    out: File,
) -> None:
    """Subtract the sky and all stars of IMAGE, which are measured as by photometry.

    Parameters
    ----------
    image : Path
        FITS image.
    options : ImageOptions
        Options of the image, and its star list.
    overwrite : bool
        Replace a file that exists.
    model : Path
        Model of train --method field, .psf of PSFEx, or grid of STDPSF or STPSF.
    out : Path
        FITS image.
    """
    source = ImageInput(image, **vars(options))
    check_targets((*source.files(), model), out, overwrite=overwrite)
    photometry = measure_all_stars(load_field(model), source)
    write_fits(out, photometry.residual.to_hdu()[0])
    print(f"{out}: {len(photometry.table)} stars subtracted", *photometry.notes, sep="\n")
