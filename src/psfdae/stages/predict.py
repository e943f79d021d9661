"""Stage `predict`: a FITS file of stars in, a FITS file of their PSFs out, piece by piece."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

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

Tick = Callable[[int], object]


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
    out : path of the FITS file; see `psfdae.own_stars.prediction`
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
    observation = source.open(loaded.info.stamp_px, MARGIN_PX)
    loaded.check_scale(observation.pixel_scale_arcsec, str(source.path))
    if plot is not None and observation.positions is None:
        raise PredictionError(f"{source.path}: a map needs a catalogue with pixel positions")
    started(observation.count)
    try:
        summary = _predict(loaded, source, observation, out, threads, history, tick)
        if plot is not None:
            from psfdae.own_stars.plot import map_of_file
            from psfdae.stages.figures import write_png

            write_png(map_of_file(out), plot)
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
    chunks = observation.chunks(min(ROWS, 4 * model.engine.size))
    first = next(chunks)
    counts = np.zeros(len(StarFlag), dtype=int)
    done = clean = 0

    def predict(stamps: Stamps) -> Prediction:
        return Prediction.joined([model.engine.block(b) for b in model.engine.blocks(stamps)])

    header = (model.bundle, first, observation.count, _cards(source, observation), history)
    with one_thread_each(), prediction_file(out, *header) as file:
        for stamps, result in in_order(
            predict, itertools.chain([first], chunks), threads or available_cores()
        ):
            file.write(done, stamps, result)
            counts += [(result.flags & int(flag) > 0).sum() for flag in StarFlag]
            clean += int((result.flags == 0).sum())
            done += len(result)
            tick(len(result))
    flagged = {str(f.name): int(n) for f, n in zip(StarFlag, counts, strict=True) if n}
    return Summary(done, clean, flagged)


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
