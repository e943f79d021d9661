"""Stage `example_field`: a simulated exposure as FITS file, with a star list."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from psfdae.own_stars.example import ExampleField, FieldRecipe, example_field, write_field


def run(out: Path, catalogue: Path, seed: int, **recipe: int) -> ExampleField:
    """Write the image and its star list.

    The image has a WCS and the cards GAIN and SATURATE; the list has pixel (1-based)
    and sky coordinates of all stars but the companions of blended ones.

    Parameters
    ----------
    out, catalogue : paths of the FITS image and of the CSV file
    seed : of all random numbers
    **recipe : attributes of `FieldRecipe`
    """
    made = FieldRecipe(**recipe)
    field = example_field(made, seed)
    write_field(
        out,
        catalogue,
        field.image.astype(np.float32),
        *field.centroid.T,
        pixel_scale_arcsec=made.pixel_scale_arcsec,
        GAIN=made.gain,
        SATURATE=float(made.saturation),
    )
    return field
