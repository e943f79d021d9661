"""Command `psf`: write the PSFs of a field model at positions of its image, for other programs."""

from __future__ import annotations

import re
from contextlib import suppress
from typing import Annotated

import click
import numpy as np

from psfdae.base.options import File
from psfdae.commands.cli import command
from psfdae.commands.predict import check_targets
from psfdae.denoise.field_models import load_field
from psfdae.psf import exchange
from psfdae.psf.interface import FieldPsfs, PredictionError


@command("psf")
def psf(
    model: Annotated[File, {"argument": True}],
    at: tuple[str, ...] = (),
    grid: str | None = None,
    oversampling: Annotated[int | None, click.IntRange(1, 32)] = None,
    overwrite: bool = False,
    *,
    out: File,
) -> None:
    """Write the PSFs of MODEL at positions of the image.

    MODEL is of train --method field, a .psf of PSFEx, or a grid of STDPSF or STPSF.

    Each image of the cube is a PSF of flux 1 with its centre in the middle, sampled at parts of
    a pixel. The header names the positions, y before x, as the files of STScI's STPSF do; photutils
    3.1 reads one, or a grid. A grid in NAME.stdpsf.fits is as STScI's STDPSF, which older releases
    read, too. NAME.psf has the whole field, for SExtractor and other readers of PSFEx's models.

    Parameters
    ----------
    model : Path
        Model that knows the PSF over the field.
    at : sequence of str
        X,Y of a position, 0-based pixels; again for more.
    grid : str, optional
        COLUMNSxROWS of positions over the field of the training.
    oversampling : int, optional
        Values per pixel and axis. [default: 4, of NAME.psf 8]
    overwrite : bool
        Replace a file that exists.
    out : Path
        FITS cube for photutils, NAME.stdpsf.fits, or NAME.psf as of PSFEx.
    """
    # The ending of the name decides the format: PSFEx's, STDPSF, or photutils' cube.
    check_targets((model,), out, overwrite=overwrite)
    for_psfex, for_stdpsf = out.name.endswith(".psf"), out.name.endswith(".stdpsf.fits")
    if for_psfex and (at or grid):
        raise PredictionError(f"{out}: has the whole field; neither --at nor --grid")
    if not for_psfex and bool(at) == (grid is not None):
        raise PredictionError("--at X,Y or --grid COLUMNSxROWS says where")
    # Readers of PSFEx's files interpolate with Lanczos' kernel, which errs less the finer they are.
    oversampling = oversampling or (8 if for_psfex else 4)
    if for_stdpsf and (at or oversampling != 4):
        raise PredictionError(f"{out}: STDPSF has a --grid, and 4 values per pixel and axis")
    grid_shape = None if grid is None else _grid_shape(grid)
    given_positions = np.array([_position(text) for text in at])
    field_model = load_field(model)
    if for_psfex:
        # The polynomial of PSFEx's format does not hold the model exactly: print the error.
        error = exchange.write_psfex(out, field_model, oversampling)
        print(f"{out}: within {error:.1g} of the brightest value of {model}, where compared")
        return
    # The given positions, or the nodes of a grid over the positions of the training stars.
    positions = field_model.grid(*grid_shape) if grid_shape else given_positions
    # What the user should know of these positions, then the file.
    for note in _notes(field_model, positions):
        print(f"{model}: {note}")
    reader = "photutils, as STDPSF"
    if for_stdpsf and grid_shape:
        exchange.write_stdpsf(out, field_model, *grid_shape)
    else:
        exchange.write_grid(out, field_model, positions, oversampling)
        reader = "photutils 3.1 or newer (an older one reads NAME.stdpsf.fits)"
    print(f"{out}: {len(positions)} PSFs, for {reader}")


def _position(text: str) -> tuple[float, float]:
    """Return the pixel position (x, y) of an option --at X,Y."""
    with suppress(ValueError):
        x, y = map(float, text.split(","))
        if np.isfinite([x, y]).all():
            return x, y
    raise PredictionError(f"--at {text!r}: expected X,Y, such as 100,250.5")


def _grid_shape(text: str) -> tuple[int, int]:
    """Return the columns and rows of a grid of the option --grid COLUMNSxROWS."""
    match = re.fullmatch(r"([0-9]{1,3})x([0-9]{1,3})", text.strip())
    columns, rows = map(int, match.groups()) if match else (0, 0)
    if min(columns, rows) < 2:
        raise PredictionError(f"--grid {text!r}: expected COLUMNSxROWS of 2 to 999, such as 9x9")
    return columns, rows


def _notes(model: FieldPsfs, positions: np.ndarray) -> list[str]:
    """Return sentences on positions at which the model does not know the PSF from stars nearby.

    Parameters
    ----------
    model : FieldPsfs
        Model that knows the PSF at every position.
    positions : ndarray, shape (n, 2)
        x and y in px.

    Raises
    ------
    PredictionError
        If a position is off the image that the model was trained on.
    """
    notes = []
    order = model.order  # refuses a model that knows no PSF between its stars
    if model.image_px is not None:
        # The image ends half a pixel beyond the centres of its outermost pixels.
        end = np.array(model.image_px) - 0.5
        is_off_image = ((positions < -0.5) | (positions >= end)).any(axis=1)
        if is_off_image.any():
            x, y = positions[is_off_image][0]
            columns, rows = model.image_px
            raise PredictionError(
                f"{x:g},{y:g} is off the image of {columns} columns and {rows} rows that the "
                f"model {model.name!r} was trained on"
            )
    # Positions beyond the training stars have the PSF of the edge, which is an extrapolation.
    try:
        low, high = model.field_range()
    except PredictionError:  # stars without positions have one PSF, which holds everywhere
        low, high = np.full(2, -np.inf), np.full(2, np.inf)
    outside_count = int(((positions < low) | (positions > high)).any(axis=1).sum())
    if outside_count:
        notes.append(
            f"{outside_count} of {len(positions)} positions are beyond the training stars, "
            f"x {low[0]:.6g} … {high[0]:.6g}, y {low[1]:.6g} … {high[1]:.6g}; the PSF there is "
            "the PSF at their edge"
        )
    # A PSF that does not change over the field makes many positions useless.
    if order == 0 and len(positions) > 1:
        notes.append(
            "the PSF is the same everywhere (order 0: more is not supported by stars left "
            f"out): all {len(positions)} PSFs are equal"
        )
    return notes
