"""Stage `predict`: a FITS file of stars in, a FITS file of their PSFs out, piece by piece."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import click
import numpy as np

from psfdae.cli import AboveZero, File, NameOrNumber, command
from psfdae.own_stars.images import Card
from psfdae.own_stars.model import (
    BLOCK,
    PredictionError,
    PsfModel,
    available_cores,
    load_model,
    one_thread_each,
)
from psfdae.own_stars.observation import Observation, Source
from psfdae.own_stars.prediction import Prediction, prediction_file
from psfdae.own_stars.stamps import Stamps, StarFlag
from psfdae.stages.common import check_outputs
from psfdae.threads import in_order

ROWS = 4 * BLOCK
"""Stars that are read and written at a time, fewer if their stamps are large."""

MARGIN_PX = 2
"""Pixels by which a star of an image may be moved to centre it."""


@dataclass(frozen=True)
class Stated:
    """What is said of an image beside its header."""

    catalogue: Annotated[File | None, "Star list of an image, FITS or CSV."] = None
    pixel_scale: Annotated[
        float | None, AboveZero, "Arcseconds per pixel.  [default: the WCS's]"
    ] = None
    origin: Annotated[int | None, click.IntRange(0, 1), "Index of the first pixel's centre."] = None
    extension: Annotated[
        str | int | None, NameOrNumber(), "Name or number of the extension with the stars."
    ] = None
    mask: Annotated[
        str | int | None, NameOrNumber(), "Extension or FITS file; pixels other than 0 are bad."
    ] = None
    gain: Annotated[float | None, AboveZero, "Electrons per count.  [default: the header's]"] = None
    saturate: Annotated[float | None, AboveZero, "Counts of a saturated pixel."] = None

    def source(self, path: Path, **more: str | None) -> Source:
        """The file with all that is stated about it."""
        stated = vars(self).copy()
        return Source(path, pixel_scale_arcsec=stated.pop("pixel_scale"), **stated, **more)


@command("predict")
def predict(
    stars: Annotated[File, {"argument": True, "metavar": "INPUT"}],
    stated: Stated,
    flux_column: Annotated[
        str | None, "Fluxes inside the stamp; estimated where not given."
    ] = None,
    background_column: Annotated[
        str | None, "Sky levels per pixel; estimated where not given."
    ] = None,
    model: Annotated[File | None, "Model bundle.  [default: the shipped one]"] = None,
    plot: Annotated[File | None, "PNG with a map of the PSF over the field."] = None,
    overwrite: Annotated[bool, "Replace files that exist."] = False,
    threads: Annotated[int | None, click.IntRange(min=1), "[default: all cores]"] = None,
    quiet: Annotated[bool, "Neither progress nor summary."] = False,
    *,
    out: Annotated[File, "FITS file for PSFs, residuals, uncertainties and a table of stars."],
) -> None:
    """Predict the PSFs of the stars in INPUT.

    INPUT is a FITS cube of stamps, or a FITS image with --catalogue. Stars are
    flagged, never dropped. Files that cannot be used end with one line and exit
    code 2.
    """
    from tqdm import tqdm

    source = stated.source(stars, flux_column=flux_column, background_column=background_column)
    check_outputs((out, plot), (source.path, source.catalogue, source.mask, model))
    _check_targets(out, plot, overwrite)
    loaded = load_model(model)
    observation = source.open(loaded.info.stamp_px, MARGIN_PX)
    loaded.check_scale(observation.pixel_scale_arcsec, str(source.path))
    if plot is not None and observation.positions is None:
        raise PredictionError(f"{source.path}: a map needs a catalogue with pixel positions")
    with tqdm(unit="star", unit_scale=True, desc="predict", disable=quiet or None) as bar:
        bar.reset(observation.count)
        try:
            counts, clean = _predict(loaded, source, observation, out, threads, bar.update)
            if plot is not None:
                from psfdae.own_stars.plot import map_of_file
                from psfdae.stages.figures import write_png

                write_png(map_of_file(out), plot)
        except OSError as error:
            said = error.strerror or error
            raise PredictionError(f"{out}: cannot be written ({said})") from error
    if not quiet:
        flagged = zip(StarFlag, counts, strict=True)
        flags = "".join(f"\n  {flag.name}: {count}" for flag, count in flagged if count)
        print(f"{out}: {observation.count} stars, {clean} without a flag{flags}")


def _check_targets(out: Path, plot: Path | None, overwrite: bool) -> None:
    for target in (out, plot):
        if target is None:
            continue
        if target.is_dir():
            raise PredictionError(f"{target}: is a folder, not a file")
        if target.exists() and not overwrite:
            raise PredictionError(f"{target}: exists already; --overwrite replaces it")
    if plot is not None and plot.resolve() == out.resolve():
        raise PredictionError(f"{plot}: is the name of the FITS file, too")


def _predict(
    model: PsfModel,
    source: Source,
    observation: Observation,
    out: Path,
    threads: int | None,
    tick: Callable[[int], object],
) -> tuple[np.ndarray, int]:
    """Write the file; number of stars with each flag, and of those without any."""
    chunks = observation.chunks(min(ROWS, 4 * model.engine.size))
    first = next(chunks)
    counts = np.zeros(len(StarFlag), dtype=int)
    done = clean = 0

    def restored(stamps: Stamps) -> Prediction:
        return Prediction.joined([model.engine.block(b) for b in model.engine.blocks(stamps)])

    history = " ".join(["psfdae", *sys.argv[1:]])  # without the folder of the program
    header = (model.bundle, first, observation.count, _cards(source, observation), history)
    with one_thread_each(), prediction_file(out, *header) as file:
        for stamps, result in in_order(
            restored, itertools.chain([first], chunks), threads or available_cores()
        ):
            file.write(done, stamps, result)
            counts += [(result.flags & int(flag) > 0).sum() for flag in StarFlag]
            clean += int((result.flags == 0).sum())
            done += len(result)
            tick(len(result))
    return counts, clean


def _cards(source: Source, observation: Observation) -> list[Card]:
    cards: list[Card] = [
        ("INFILE", source.path.name, "stars"),
        ("PIXSCALE", observation.pixel_scale_arcsec, "[arcsec] width of a pixel"),
    ]
    if source.catalogue is not None:
        cards.append(("CATALOG", source.catalogue.name, "star list"))
    if observation.gain is not None:
        cards.append(("GAIN", observation.gain, "electrons per count"))
    if observation.saturate is not None:
        cards.append(("SATURATE", observation.saturate, "counts of a saturated pixel"))
    return [*cards, *observation.header_cards]
