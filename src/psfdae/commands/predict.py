"""Stage `predict`: a FITS file of stars in, a FITS file of their PSFs out, piece by piece."""

from __future__ import annotations

import itertools
import sys
from contextlib import nullcontext
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import click
import numpy as np

from psfdae.cli import command
from psfdae.commands.mosaic import each, images_of, with_name
from psfdae.figures import write_png
from psfdae.files import atomic_path, check_outputs, interrupted
from psfdae.image.fits_file import Card
from psfdae.image.observation import Observation, Source, list_offset
from psfdae.image.stamps import Stamps, StarFlag
from psfdae.method import KnowsField, MeasuresStars
from psfdae.model.bundle import SUFFIX
from psfdae.model.field_psfs import PredictionError
from psfdae.model.prediction import Prediction, prediction_file
from psfdae.model.psf_model import PsfModel, load_model
from psfdae.options import File, NameOrNumber
from psfdae.progress import silence


@dataclass(frozen=True)
class Stated:
    """Image options; each overrides the FITS header."""

    catalogue: Annotated[File | None, "Star list of an image, FITS or CSV."] = None
    detect: Annotated[bool, "Find the stars of an image; the list is written, too."] = False
    on_image: Annotated[bool, "Leave out stars of the list that are off the image."] = False
    threshold: Annotated[float, "Of --detect, in σ above the sky."] = 5.0
    pixel_scale: Annotated[float | None, "Arcseconds per pixel.  [default: the WCS's]"] = None
    origin: Annotated[int | None, click.IntRange(0, 1), "Index of the first pixel's centre."] = None
    extension: Annotated[
        str | int | None, NameOrNumber(), "Name or number of the extension with the stars."
    ] = None
    all_extensions: Annotated[
        bool, "All images of the file, each by itself and in parallel; OUT gets their names."
    ] = False
    mask: Annotated[
        str | int | None,
        NameOrNumber(),
        "Extension or FITS file; pixels other than 0 are bad.  [default: DQ of the file; none]",
    ] = None
    bad_bits: Annotated[
        int | None,
        click.IntRange(1, 2**63 - 1),
        "Sum of the mask's bits that are bad.  [default: all]",
    ] = None
    weight: Annotated[
        str | int | None, NameOrNumber(), "Extension or FITS file with 1/variance of the pixels."
    ] = None
    variance: Annotated[
        str | int | None, NameOrNumber(), "Extension or FITS file with their variance."
    ] = None
    error: Annotated[
        str | int | None,
        NameOrNumber(),
        "Extension or FITS file with their σ.  [default: ERR of the file; none]",
    ] = None
    gain: Annotated[float | None, "Electrons per count.  [default: the header's]"] = None
    read_noise: Annotated[float | None, "Electrons.  [default: the header's]"] = None
    saturate: Annotated[float | None, "Counts of a saturated pixel.  [default: the header's]"] = (
        None
    )
    colour_column: Annotated[
        str | None,
        "Colours of the list's stars, with which the PSF may change; empty where unknown.",
    ] = None
    accept_offset: Annotated[bool, "Take a star list that is off by more than a pixel."] = False

    def words(self) -> list[str]:
        """The options that state it, as they are typed."""
        words = []
        for option in fields(self):
            value = getattr(self, option.name)
            if value != option.default:
                flag = f"--{option.name.replace('_', '-')}"
                words += [flag] if value is True else [flag, str(value)]
        return words

    def source(
        self, path: Path, flux_column: str | None = None, background_column: str | None = None
    ) -> Source:
        """The file with all that is stated about it."""
        stated = vars(self).copy()
        threshold, scale = stated.pop("threshold"), stated.pop("pixel_scale")
        del stated["all_extensions"]
        stated["detect"] = threshold if stated["detect"] else None
        return Source(
            path,
            pixel_scale_arcsec=scale,
            flux_column=flux_column,
            background_column=background_column,
            **stated,
        )


def write_list(observation: Observation, path: Path) -> None:
    """The stars that were found, as a star list."""
    assert observation.found is not None
    with atomic_path(path) as temporary:
        observation.found.table.write(temporary, format="ascii.csv", overwrite=True)


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
    fixed_positions: Annotated[
        bool, "The star list's centres are exact; for models that measure centres (field)."
    ] = False,
    model: Annotated[
        Path | None,
        click.Path(path_type=Path),
        "Model bundle, or folder of from-stars.  [default: the shipped one]",
    ] = None,
    plot: Annotated[File | None, "PNG with a map of the PSF over the field."] = None,
    overwrite: Annotated[bool, "Replace files that exist."] = False,
    threads: Annotated[int | None, click.IntRange(min=1), "[default: all cores]"] = None,
    quiet: Annotated[bool, "Neither progress nor summary."] = False,
    *,
    out: Annotated[File, "FITS file for PSFs, residuals, uncertainties and a table of stars."],
) -> None:
    """Predict the PSFs of the stars in INPUT.

    INPUT is a FITS cube of stamps, or a FITS image with --catalogue or --detect.
    Stars are flagged, never dropped. Files that cannot be used end with one line
    and exit code 2.
    """
    job = dict(locals())
    if not stated.all_extensions:
        said = restored(**job)
        if not quiet:
            print(said)
        return
    jobs = {
        name: {
            **job,
            "stated": of_image,
            "model": bundle_of(model, name),
            "plot": with_name(plot, name),
            "threads": 1,
            "quiet": True,
            "out": with_name(out, name),
        }
        for name, of_image in images_of(stars, stated).items()
    }
    each(restored, jobs, stars)


def bundle_of(model: Path | None, name: str) -> Path | None:
    """The bundle of an image, if the model is a folder with one for each."""
    if model is None or not model.is_dir():
        return model
    own = model / f"{name}{SUFFIX}"
    found = [own] if own.is_file() else sorted((model / name).glob(f"*{SUFFIX}"))
    if len(found) != 1:
        raise PredictionError(f"{model / name}: {len(found)} models, expected one")
    return found[0]


def restored(
    stars: Path,
    stated: Stated,
    flux_column: str | None,
    background_column: str | None,
    fixed_positions: bool,
    model: Path | None,
    plot: Path | None,
    overwrite: bool,
    threads: int | None,
    quiet: bool,
    out: Path,
) -> str:
    """Predict the stars of one image; what there is to say of it."""
    source = stated.source(stars, flux_column=flux_column, background_column=background_column)
    found = out.with_name(f"{out.stem}_stars.csv") if stated.detect else None
    model = bundle_of(model, source.name)
    check_outputs((out, plot, found), (*source.files(), model))
    check_targets(out, plot, found, overwrite)
    loaded = load_model(model)
    observation = source.open(loaded.info.stamp_px, loaded.margin_px)
    if loaded.info.source == "stars":  # which may have been trained without knowing it, too
        observation = observation.assuming()
    assumed = " (scale assumed, --pixel-scale states it)" if observation.scale_assumed else ""
    loaded.check_scale(observation.pixel_scale_arcsec, f"{source.path}{assumed}")
    measures = isinstance(loaded.method, MeasuresStars)
    if fixed_positions and not (measures and observation.shape):
        raise PredictionError(
            f"{source.path}: --fixed-positions takes an image with a star list, and a model of "
            "psfdae from-stars --method field"
        )
    if plot is not None and observation.positions is None:
        raise PredictionError(f"{source.path}: a map needs a catalogue with pixel positions")
    try:
        # Its name is the last one to be there: it says that all is done.
        with atomic_path(out) as unfinished, silence() if quiet else nullcontext():
            work = (loaded, source, observation, unfinished, threads)
            counts, clean, off = write_prediction(*work, fixed_positions)
            if found is not None:
                write_list(observation, found)
            if plot is not None:
                from psfdae.model.plot import map_of_file

                write_png(map_of_file(unfinished), plot)
    except OSError as error:
        said = error.strerror or error
        raise PredictionError(f"{out}: cannot be written ({said})") from error
    flagged = zip(StarFlag, counts, strict=True)
    flags = "".join(f"\n  {flag.name}: {count}" for flag, count in flagged if count)
    clean_of = f"{out}: {observation.count} stars, {clean} without a flag{flags}"
    other = loaded.other_instrument(observation.instrument, observation.colour_column)
    unlike = f"{source.path}: {other}" if other else None
    alone = None
    if observation.shape and isinstance(loaded.method, KnowsField) and not loaded.wings:
        alone = (
            "flux_total is NaN: no bright star of the training showed light beyond its stamp of "
            f"{loaded.stamp_px} px; flux is the light in the stamp"
        )
    return "\n".join(line for line in (observation.said(), off, unlike, alone, clean_of) if line)


def check_targets(out: Path, plot: Path | None, found: Path | None, overwrite: bool) -> None:
    """Refuse files that are there already, unless a killed run left them or `overwrite` says so."""
    ours = overwrite or (not out.exists() and interrupted(out))
    for target in (out, plot, found):
        if target is None:
            continue
        if target.is_dir():
            raise PredictionError(f"{target}: is a folder, not a file")
        if target.exists() and not ours:
            raise PredictionError(f"{target}: exists already; --overwrite replaces it")
    if plot is not None and plot.resolve() == out.resolve():
        raise PredictionError(f"{plot}: is the name of the FITS file, too")


def write_prediction(
    model: PsfModel,
    source: Source,
    observation: Observation,
    out: Path,
    threads: int | None,
    fixed: bool = False,
) -> tuple[np.ndarray, int, str | None]:
    """Write the file; number of stars with each flag, of those without any, and how good a list is.

    Nothing is left of it if the list's positions are far off (`list_offset`).
    """
    pairs = model.stream(observation, threads, fixed)
    first = next(pairs)
    counts = np.zeros(len(StarFlag), dtype=int)
    done, clean, off = 0, 0, []
    history = " ".join(["psfdae", *sys.argv[1:]])  # without the folder of the program
    header = (first[1], observation.count, _cards(source, observation), history)
    with prediction_file(out, model.bundle, *header) as file:
        for stamps, result in itertools.chain([first], pairs):
            file.write(done, result)
            counts += [(result.flags & int(flag) > 0).sum() for flag in StarFlag]
            clean += int((result.flags == 0).sum())
            off.append(_off(stamps, result))
            done += len(result)
        said = list_offset(observation.catalogue, np.concatenate(off), source.accept_offset)
    return counts, clean, said if observation.shape else None


def _off(stamps: Stamps, found: Prediction) -> np.ndarray:
    """How far stars are from their positions (n, 2), x and y in px; NaN where that is not clear.

    A model that measures no centres knows how far their stamps were moved, or should have been.
    """
    centre = np.stack([found.x_fit - stamps.x, found.y_fit - stamps.y], axis=1)
    lost = (found.flags & int(StarFlag.OFF_CENTRE)) > 0
    shift = np.stack([found.shift_x, found.shift_y], axis=1)
    moved = np.where(lost[:, None], PsfModel.margin_px + 1.0, shift)
    unclear = (found.flags & int(StarFlag.FAINT | StarFlag.NO_FLUX)) > 0
    unclear |= ~np.isfinite(stamps.listed).all(axis=1)
    return np.where(unclear[:, None], np.nan, np.where(np.isfinite(centre), centre, moved))


def _cards(source: Source, observation: Observation) -> list[Card]:
    cards: list[Card] = [
        ("INFILE", source.path.name, "stars"),
        (
            *("PIXSCALE", observation.pixel_scale_arcsec),
            f"[arcsec] width of a pixel{', assumed' if observation.scale_assumed else ''}",
        ),
    ]
    if observation.catalogue is not None:
        cards.append(("CATALOG", observation.catalogue.name, "star list"))
    if observation.gain is not None:
        cards.append(("GAIN", observation.gain, "electrons per count"))
    if observation.saturate is not None:
        cards.append(("SATURATE", observation.saturate, "counts of a saturated pixel"))
    return [*cards, *observation.header_cards]
