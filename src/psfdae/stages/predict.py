"""Stage `predict`: a FITS file of stars in, a FITS file of their PSFs out, piece by piece."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.observations import Observation, Stamps, open_observation
from psfdae.prediction import Prediction, PredictionError, PsfModel, load_model
from psfdae.prediction.engine import BLOCK, one_thread_each
from psfdae.prediction.model import available_cores
from psfdae.prediction.photometry import Known
from psfdae.prediction.results import Stars
from psfdae.prediction.stream import in_order
from psfdae.prediction.writer import Card, writing
from psfdae.stages.common import check_outputs

ROWS = 4 * BLOCK
"""Stars that are read and written at a time, fewer if their stamps are large."""

MARGIN_PX = 2
"""Pixels by which a star of an image may be moved to centre it."""

Tick = Callable[[int], object]


@dataclass(frozen=True)
class Source:
    """Where stars come from, and what is stated about them.

    Attributes are the arguments of `psfdae.observations.open_observation`, and names
    of catalogue columns with fluxes and sky levels that are not to be estimated.
    """

    path: Path
    catalogue: Path | None = None
    extension: str | int | None = None
    origin: int | None = None
    mask: str | int | Path | None = None
    pixel_scale_arcsec: float | None = None
    gain: float | None = None
    saturate: float | None = None
    flux_column: str | None = None
    background_column: str | None = None

    def open(self, stamp_px: int) -> Observation:
        """Check the files and describe them."""
        return open_observation(
            self.path,
            stamp_px=stamp_px,
            catalogue=self.catalogue,
            extension=self.extension,
            origin=self.origin,
            mask=self.mask,
            pixel_scale_arcsec=self.pixel_scale_arcsec,
            gain=self.gain,
            saturate=self.saturate,
            margin=MARGIN_PX,
        )


@dataclass(frozen=True)
class Summary:
    """What a prediction has come to.

    Attributes
    ----------
    stars : int
    flagged : dict of str to int
        Stars with each flag.
    without : int
        Stars without any flag.
    """

    stars: int = 0
    without: int = 0
    flagged: dict[str, int] = field(default_factory=dict)


def run(
    source: Source,
    out: Path,
    *,
    model: Path | None = None,
    plot: Path | None = None,
    overwrite: bool = False,
    threads: int | None = None,
    history: str = "",
    started: Callable[[int], object] = lambda count: None,
    tick: Tick = lambda stars: None,
) -> Summary:
    """Predict the PSFs of all stars of a file.

    Everything that can be checked is checked before the first star.

    Parameters
    ----------
    source : Source
    out : path of the FITS file; see `psfdae.prediction.writer`
    model : path of a bundle, the shipped one by default
    plot : path of a PNG with a map of the PSFs, optional
    overwrite : whether files may be replaced
    threads : all cores by default
    history : goes into the header
    started : called with the number of stars, before the first one
    tick : called with a number of stars that are done

    Raises
    ------
    PredictionError, ObservationError, BundleError, OutputError
        In one line that names the file.
    """
    check_outputs((out, plot), (source.path, source.catalogue, source.mask, model))
    _check_targets(out, plot, overwrite)
    loaded = load_model(model)
    observation = source.open(loaded.info.stamp_px)
    loaded.check_scale(observation.pixel_scale_arcsec, str(source.path))
    if plot is not None and observation.positions is None:
        raise PredictionError(f"{source.path}: a map needs a catalogue with pixel positions")
    started(observation.count)
    try:
        summary = _predict(loaded, source, observation, out, threads, history, tick)
        if plot is not None:
            draw(out, plot)
    except OSError as error:
        raise PredictionError(f"{out}: cannot be written ({error.strerror or error})") from error
    return summary


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
    history: str,
    tick: Tick,
) -> Summary:
    from psfdae.prediction import StarFlag

    chunks = observation.chunks(min(ROWS, 4 * model.engine.size))
    first = next(chunks)
    known = _Known(source, observation)
    counts = np.zeros(len(StarFlag), dtype=int)
    done = clean = 0
    header = (model.bundle, _cards(source, observation), history)
    size = (observation.count, model.info.stamp_px, first.id.dtype)
    numbered = known.stars(itertools.chain([first], chunks))
    with one_thread_each(), writing(out, *size, *header) as file:
        for (_, stamps), result in in_order(
            lambda item: _blocks(model, item[0]), numbered, threads or available_cores()
        ):
            file.write(done, result, {"id": stamps.id, "x": stamps.x, "y": stamps.y})
            counts += [(result.flags & int(flag) > 0).sum() for flag in StarFlag]
            clean += int((result.flags == 0).sum())
            done += len(result)
            tick(len(result))
    flagged = {str(f.name): int(n) for f, n in zip(StarFlag, counts, strict=True) if n}
    return Summary(done, clean, flagged)


def _blocks(model: PsfModel, stars: Stars) -> Prediction:
    return Prediction.joined([model.engine.block(part) for part in model.engine.blocks(stars)])


class _Known:
    """Joins stamps with what the catalogue knows of their stars."""

    def __init__(self, source: Source, observation: Observation) -> None:
        columns = (source.flux_column, source.background_column)
        self.flux, self.background = (
            None if name is None else observation.column(name) for name in columns
        )
        self.gain = np.nan if observation.gain is None else observation.gain

    def stars(self, chunks: Iterator[Stamps]) -> Iterator[tuple[Stars, Stamps]]:
        done = 0
        for stamps in chunks:
            rows = slice(done, done + len(stamps))
            unknown = np.full(len(stamps), np.nan)
            given = [unknown if c is None else c[rows] for c in (self.flux, self.background)]
            yield (
                Stars(
                    stamps.data,
                    stamps.bad,
                    stamps.saturated,
                    stamps.truncated,
                    Known(*given, unknown),
                    np.full(len(stamps), self.gain),
                ),
                stamps,
            )
            done += len(stamps)


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


def draw(predicted: Path, out: Path) -> None:
    """Draw the map of a prediction's PSFs.

    Parameters
    ----------
    predicted : FITS file of this stage
    out : path of the PNG
    """
    from astropy.io import fits

    from psfdae.prediction.plot import FieldStars, chosen_stars, psf_map
    from psfdae.stages.figures import write_png

    with fits.open(predicted, memmap=True) as file:
        table: Any = file["STARS"].data
        stars = FieldStars(*(_native(table[name]) for name in FieldStars.__dataclass_fields__))
        chosen = chosen_stars(stars)
        psf = np.array([file["PSF"].section[int(star)] for star in chosen], dtype=np.float32)
        drawn = len(stars.drawable())
        title = f"{file[0].header['INFILE']}: {drawn} of {len(stars.x)} stars"
    write_png(psf_map(psf, chosen, stars, title), out)


def _native(column: np.ndarray) -> np.ndarray:
    """A copy in the machine's byte order."""
    return column.astype(column.dtype.newbyteorder("="))
