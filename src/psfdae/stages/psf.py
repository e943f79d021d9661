"""Stage `psf`: the PSF of a model of one's own stars at places of their image."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import click
import numpy as np

import psfdae
from psfdae.cli import File, command
from psfdae.files import atomic_path
from psfdae.own_stars.model import PredictionError, PsfModel, load_model
from psfdae.stages.common import check_outputs

PLACE = re.compile(r"([-+0-9.eE]+),([-+0-9.eE]+)")
GRID = re.compile(r"([0-9]{1,3})x([0-9]{1,3})")


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
    a pixel. The header names the places, as photutils and WebbPSF do; photutils wants one, or
    a grid.
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
    # About the middle of a pixel: what comes out is centred.
    x, y = np.rint(places).T
    write(out, loaded, places, loaded.psf_at(x, y, oversampling), oversampling)


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


def write(
    path: Path, model: PsfModel, places: np.ndarray, images: np.ndarray, oversampling: int
) -> None:
    """A cube of PSFs (n, m, m) with the keywords that photutils.psf.webbpsf_reader asks for."""
    from astropy.io import fits

    primary = fits.PrimaryHDU(images.astype(np.float32))
    header = primary.header
    header["CREATOR"] = (f"psfdae {psfdae.__version__}", "program that made this file")
    header["PSFMODEL"] = (model.info.name, "model bundle")
    header["PSFSHA"] = model.bundle.sha256
    header["OVERSAMP"] = (oversampling, "values per pixel and axis")
    for number, (x, y) in enumerate(places.tolist()):
        header[f"DET_YX{number}"] = (f"({x:.6g}, {y:.6g})", "x, y, 0-based")
    with atomic_path(path) as temporary:
        primary.writeto(temporary, overwrite=True)
