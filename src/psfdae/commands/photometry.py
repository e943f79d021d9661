"""Commands `photometry` and `residual`: stars of an image, measured with the PSF of its field."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from psfdae.base.files import rename_together, write_fits
from psfdae.base.options import File
from psfdae.commands.cli import command
from psfdae.commands.predict import check_targets
from psfdae.denoise.field_models import load_field
from psfdae.image.image_input import ImageInput, ImageOptions
from psfdae.image.tables import SUFFIXES, write_table
from psfdae.photometry.image_photometry import PhotometryError, measure_all_stars


@command("photometry")
def photometry_command(
    image: Annotated[File, {"argument": True}],
    options: ImageOptions,
    zero_point: float | None = None,
    reference: File | None = None,
    magnitude_column: str = "mag",
    residual: File | None = None,
    overwrite: bool = False,
    *,
    model: File,
    out: File,
) -> None:
    """Measure the fluxes of all stars of IMAGE, overlapping ones together.

    --detect finds the stars, and with the PSF also faint and hidden ones; the stars of
    --catalogue are measured at its positions, and no others. Fluxes have the light beyond the
    stamps of MODEL, which the bright stars show; these show the gain, too, if it is not known.

    Parameters
    ----------
    image : Path
        FITS image.
    options : ImageOptions
        Options of the image, and its star list.
    zero_point : float, optional
        Magnitude of a flux of 1.
    reference : Path, optional
        Star list with magnitudes, which give it.
    magnitude_column : str
        Column of --reference with the magnitudes.
    residual : Path, optional
        FITS image without its sky and stars.
    overwrite : bool
        Replace files that exist.
    model : Path
        Model of train --method field, .psf of PSFEx, or grid of STDPSF or STPSF.
    out : Path
        Table of the stars: .fits, .ecsv or .csv.
    """
    # Refuse outputs that exist, or have a format that is not written.
    if out.suffix.lower() not in SUFFIXES:
        raise PhotometryError(f"{out}: expected a name that ends in {', '.join(SUFFIXES)}")
    source = ImageInput(image, **vars(options))
    check_targets((*source.files(), reference, model), out, residual, overwrite=overwrite)
    # Measure all stars, and write the table and the residual image, both or none.
    photometry = measure_all_stars(
        load_field(model), source, zero_point, reference, magnitude_column
    )
    with rename_together(out):
        write_table(out, photometry.table)
        if residual is not None:
            write_fits(residual, photometry.residual.to_hdu()[0])
    count = np.count_nonzero(np.isfinite(photometry.table["flux"]))
    print(f"{out}: {len(photometry.table)} stars, {count} measured", *photometry.notes, sep="\n")
    if "mag" not in photometry.table.colnames:
        print("no magnitudes: --zero-point, or --reference with a list of some, gives them")


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
