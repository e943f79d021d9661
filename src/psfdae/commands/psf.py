"""Stage `psf`: the PSF of a model of one's own stars at places of their image."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import click
import numpy as np

from psfdae.cli import command
from psfdae.files import atomic_path, check_outputs
from psfdae.image.errors import ascii_line
from psfdae.image.fits_file import BLOCK_BYTES
from psfdae.model.psf_model import PredictionError, PsfModel, load_model
from psfdae.options import File
from psfdae.version import __version__

PLACE = re.compile(r"([-+0-9.eE]+),([-+0-9.eE]+)")
GRID = re.compile(r"([0-9]{1,3})x([0-9]{1,3})")

AT_ONCE = 2**20
"""Values of PSFs that are made before they are written."""


@command("psf")
def psf(
    model: Annotated[File, {"argument": True}],
    at: Annotated[tuple[str, ...], "X,Y of a place, 0-based pixels; again for more."] = (),
    grid: Annotated[str | None, "COLUMNSxROWS of places over the field of the training."] = None,
    oversampling: Annotated[int, click.IntRange(1, 32), "Values per pixel and axis."] = 4,
    overwrite: Annotated[bool, "Replace a file that exists."] = False,
    *,
    out: Annotated[File, "FITS cube, which photutils' GriddedPSFModel reads, too."],
) -> None:
    """Write the PSFs of MODEL, of from-stars --method field, at places of the image.

    Each image of the cube is a PSF of flux 1 with its centre in the middle, sampled at parts of
    a pixel. The header names the places, y before x, as the files of STScI's STPSF do; photutils
    3.1 reads one, or a grid.
    """
    check_outputs((out,), (model,))
    if out.exists() and not overwrite:
        raise PredictionError(f"{out}: exists already; --overwrite replaces it")
    if bool(at) == (grid is not None):
        raise PredictionError("--at X,Y or --grid COLUMNSxROWS says where")
    loaded = load_model(model)
    places = np.array([_place(text) for text in at]) if at else _grid(str(grid), loaded)
    for note in _notes(loaded, places):
        print(f"{model}: {note}")
    write(out, loaded, places, oversampling)


def _place(text: str) -> tuple[float, float]:
    found = PLACE.fullmatch(text.strip())
    try:
        if found is None:
            raise ValueError
        return float(found[1]), float(found[2])
    except ValueError:
        raise PredictionError(f"--at {text!r}: expected X,Y, such as 100,250.5") from None


def _notes(model: PsfModel, places: np.ndarray) -> list[str]:
    """What is to be said of places (n, 2); PredictionError if one is off the image."""
    model.psf_at(0.0, 0.0, 1)  # or it has no field
    low, high = np.array(model.bundle.weights["low"]), np.array(model.bundle.weights["high"])
    size = model.info.config.get("stars", {}).get("image_px")
    if size is not None:
        off = ((places < -0.5) | (places >= np.array(size) - 0.5)).any(axis=1)
        for x, y in places[off][:1]:
            raise PredictionError(
                f"{x:g},{y:g} is off the image of {size[0]} columns and {size[1]} rows that the "
                f"model {model.info.name!r} was trained on"
            )
    field, notes = model.engine.estimator, []
    beyond = int(((places < low) | (places > high)).any(axis=1).sum())
    if beyond and (high > low).all():
        x, y = (
            f"{a} {least:.6g} … {most:.6g}" for a, least, most in zip("xy", low, high, strict=True)
        )
        notes.append(
            f"{beyond} of {len(places)} places are beyond the training stars, {x}, {y}; the PSF "
            "there is that of their edge"
        )
    if len(places) > 1 and field.model.order == 0:
        notes.append(f"{field.facts()['Field']}: all {len(places)} PSFs are equal")
    return notes


def _grid(text: str, model: PsfModel) -> np.ndarray:
    """Places (n, 2) that are spread over the range of the training stars."""
    found = GRID.fullmatch(text.strip())
    columns, rows = (int(n) for n in found.groups()) if found else (0, 0)
    if min(columns, rows) < 2:
        raise PredictionError(f"--grid {text!r}: expected COLUMNSxROWS of 2 to 999, such as 9x9")
    low, high = model.field_range()
    x, y = (np.linspace(low[i], high[i], count) for i, count in ((0, columns), (1, rows)))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def write(path: Path, model: PsfModel, places: np.ndarray, oversampling: int) -> None:
    """A cube of PSFs (n, m, m) at places (n, 2), x and y, as STPSF's `psf_grid` lays it out."""
    from astropy.io import fits

    # About the middle of a pixel: what comes out is centred.
    x, y = np.rint(places).T
    first = model.psf_at(x[0], y[0], oversampling)
    header = fits.PrimaryHDU(first[None].astype(np.float32)).header
    header["NAXIS3"] = len(places)
    cards = [
        *header.cards,
        ("CREATOR", f"psfdae {__version__}", "program that made this file"),
        ("PSFMODEL", ascii_line(model.info.name), "model bundle"),
        ("PSFSHA", model.bundle.sha256, ""),
        ("OVERSAMP", oversampling, "values per pixel and axis"),
        # photutils 3.0 takes every key with these letters, in any case, for a place, and would
        # exchange x and y without a word: now it stops at this one. Others look for capitals.
        ("HIERARCH Det_yx for photutils 3.0", "this needs photutils 3.1 or newer", ""),
    ]
    for number, (column, row) in enumerate(places.tolist()):
        key = f"DET_YX{number}" if number < 100 else f"HIERARCH DET_YX{number}"
        cards.append((key, f"({row:.8g}, {column:.8g})", "y, x, 0-based"))
    header = fits.Header(cards)  # `extend` takes the square of the time
    # Not by astropy's StreamingHDU: its error on a full disk has no cause and no file.
    step = max(1, AT_ONCE // first.size)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(header.tostring().encode("ascii"))
        for start in range(0, len(places), step):
            part = slice(start, start + step)
            file.write(model.psf_at(x[part], y[part], oversampling).astype(">f4").tobytes())
        file.truncate(-(-file.tell() // BLOCK_BYTES) * BLOCK_BYTES)
