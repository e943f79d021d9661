"""Stage `example_field`: a simulated exposure as FITS file, with a star list."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import click
import numpy as np

from psfdae.cli import File, command
from psfdae.own_stars.example import ExampleField, FieldRecipe, write_field
from psfdae.own_stars.example import example_field as simulated
from psfdae.stages.common import check_outputs


@command("example-field")
def example_field(
    catalogue: Annotated[File, "CSV file for the star list."],
    seed: Annotated[int, click.IntRange(min=0)] = 1,
    side: Annotated[
        int | None, click.IntRange(min=100), "Pixels along a side.  [default: 1500]"
    ] = None,
    bright: Annotated[int | None, click.IntRange(min=1), "Bright stars.  [default: 300]"] = None,
    faint: Annotated[int | None, click.IntRange(min=0), "Faint stars.  [default: 700]"] = None,
    *,
    out: Annotated[File, "FITS image."],
) -> None:
    """Simulate an image of a star field with its star list, to try things on."""
    check_outputs((out,), (catalogue,))
    asked = {"side_px": side, "bright": bright, "faint": faint}
    write_example(out, catalogue, seed, **{k: v for k, v in asked.items() if v is not None})


def write_example(out: Path, catalogue: Path, seed: int, **recipe: int) -> ExampleField:
    """Write an image and its star list; `recipe` are attributes of `FieldRecipe`.

    The image has a WCS and the cards GAIN and SATURATE; the list has pixel (1-based)
    and sky coordinates of all stars but the companions of blended ones.
    """
    made = FieldRecipe(**recipe)
    field = simulated(made, seed)
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
