"""Stage `psf`: the PSF of a model of one's own stars at places of their image."""

from __future__ import annotations

import re
from typing import Annotated

import click
import numpy as np

from psfdae.cli import command
from psfdae.files import check_outputs
from psfdae.model import exchange
from psfdae.model.exchange import PSFEX, STDPSF, load_field
from psfdae.model.field_psfs import FieldPsfs, PredictionError
from psfdae.options import File

PLACE = re.compile(r"([-+0-9.eE]+),([-+0-9.eE]+)")
GRID = re.compile(r"([0-9]{1,3})x([0-9]{1,3})")


@command("psf")
def psf(
    model: Annotated[File, {"argument": True}],
    at: Annotated[tuple[str, ...], "X,Y of a place, 0-based pixels; again for more."] = (),
    grid: Annotated[str | None, "COLUMNSxROWS of places over the field of the training."] = None,
    oversampling: Annotated[
        int | None, click.IntRange(1, 32), "Values per pixel and axis.  [default: 4, of NAME.psf 8]"
    ] = None,
    overwrite: Annotated[bool, "Replace a file that exists."] = False,
    *,
    out: Annotated[File, "FITS cube for photutils, NAME.stdpsf.fits, or NAME.psf as of PSFEx."],
) -> None:
    """Write the PSFs of MODEL, of from-stars --method field or of PSFEx, at places of the image.

    Each image of the cube is a PSF of flux 1 with its centre in the middle, sampled at parts of
    a pixel. The header names the places, y before x, as the files of STScI's STPSF do; photutils
    3.1 reads one, or a grid. A grid in NAME.stdpsf.fits is as STScI's STDPSF, which older releases
    read, too. NAME.psf has the whole field, for SExtractor and other readers of PSFEx's models.
    """
    check_outputs((out,), (model,))
    if out.exists() and not overwrite:
        raise PredictionError(f"{out}: exists already; --overwrite replaces it")
    whole, standard = out.name.endswith(PSFEX), out.name.endswith(STDPSF)
    if whole and (at or grid):
        raise PredictionError(f"{out}: has the whole field; neither --at nor --grid")
    if not whole and bool(at) == (grid is not None):
        raise PredictionError("--at X,Y or --grid COLUMNSxROWS says where")
    # Readers of PSFEx's files interpolate with Lanczos' kernel, which errs less the finer they are.
    oversampling = oversampling or (exchange.PSFEX_SAMPLES if whole else exchange.GRID_SAMPLES)
    if standard and (at or oversampling != exchange.GRID_SAMPLES):
        raise PredictionError(
            f"{out}: STDPSF has a --grid, and {exchange.GRID_SAMPLES} values per pixel and axis"
        )
    loaded = load_field(model)
    if whole:
        off = exchange.write_psfex(out, loaded, oversampling)
        print(f"{out}: within {off:.1g} of the brightest value of {model} at the places looked at")
        return
    size = None if grid is None else _size(grid)
    places = np.array([_place(text) for text in at]) if size is None else loaded.grid(*size)
    for note in _notes(loaded, places):
        print(f"{model}: {note}")
    if standard and size is not None:
        exchange.write_stdpsf(out, loaded, *size)
    else:
        exchange.write_grid(out, loaded, places, oversampling)


def _place(text: str) -> tuple[float, float]:
    found = PLACE.fullmatch(text.strip())
    try:
        if found is None:
            raise ValueError
        return float(found[1]), float(found[2])
    except ValueError:
        raise PredictionError(f"--at {text!r}: expected X,Y, such as 100,250.5") from None


def _size(text: str) -> tuple[int, int]:
    found = GRID.fullmatch(text.strip())
    columns, rows = (int(n) for n in found.groups()) if found else (0, 0)
    if min(columns, rows) < 2:
        raise PredictionError(f"--grid {text!r}: expected COLUMNSxROWS of 2 to 999, such as 9x9")
    return columns, rows


def _notes(model: FieldPsfs, places: np.ndarray) -> list[str]:
    """Return notes on places (n, 2); PredictionError if one is off the image."""
    order, size, notes = model.order, model.image_px, []
    if size is not None:
        off = ((places < -0.5) | (places >= np.array(size) - 0.5)).any(axis=1)
        for x, y in places[off][:1]:
            raise PredictionError(
                f"{x:g},{y:g} is off the image of {size[0]} columns and {size[1]} rows that the "
                f"model {model.name!r} was trained on"
            )
    try:
        low, high = model.field_range()
    except PredictionError:  # of stars without positions, which have one PSF
        low, high = np.full((2, 2), (-np.inf, np.inf)).T
    if beyond := int(((places < low) | (places > high)).any(axis=1).sum()):
        x, y = (
            f"{a} {least:.6g} … {most:.6g}" for a, least, most in zip("xy", low, high, strict=True)
        )
        notes.append(
            f"{beyond} of {len(places)} places are beyond the training stars, {x}, {y}; the PSF "
            "there is that of their edge"
        )
    if order == 0 and len(places) > 1:
        notes.append(
            "the PSF is the same everywhere (order 0: more is not supported by stars left "
            f"out): all {len(places)} PSFs are equal"
        )
    return notes
