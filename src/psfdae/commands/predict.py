"""Command `predict`: restore the stars of a FITS file, and write their PSFs to another one.

Stars are read, restored and written in pieces, so that memory does not grow with their number.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import click
import numpy as np

from psfdae.cli import command
from psfdae.commands.mosaic import options_by_image, path_of_image, run_for_images
from psfdae.figures import write_png
from psfdae.files import atomic_path, check_outputs
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
class ImageOptions:
    """Options on an image and its stars, which several commands take; each overrides the header."""

    catalogue: Annotated[File | None, "Star list of an image, FITS or CSV."] = None
    detect: Annotated[bool, "Find the stars of an image; the list is written, too."] = False
    on_image: Annotated[bool, "Leave out stars of the list that are off the image."] = False
    threshold: Annotated[float, "Detection limit of --detect, in σ above the sky."] = 5.0
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
        """Return the options that differ from their defaults, as they are typed."""
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
        """Return the image in the file `path`, with all that the options say about it."""
        statements = vars(self).copy()
        threshold, pixel_scale = statements.pop("threshold"), statements.pop("pixel_scale")
        del statements["all_extensions"]
        statements["detect"] = threshold if statements["detect"] else None
        return Source(
            path,
            pixel_scale_arcsec=pixel_scale,
            flux_column=flux_column,
            background_column=background_column,
            **statements,
        )


def write_list(observation: Observation, path: Path) -> None:
    """Write the stars that were detected in an image as a star list in CSV."""
    assert observation.found is not None
    with atomic_path(path) as temporary:
        observation.found.table.write(temporary, format="ascii.csv", overwrite=True)


@command("predict")
def predict(
    stars: Annotated[File, {"argument": True, "metavar": "INPUT"}],
    options: ImageOptions,
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
    if not options.all_extensions:
        summary = predict_image(**job)
        if not quiet:
            print(summary)
        return
    # Images are worked on side by side, each by one thread.
    jobs = {
        name: {
            **job,
            "options": image_options,
            "model": _bundle_of_image(model, name),
            "plot": path_of_image(plot, name),
            "threads": 1,
            "quiet": True,
            "out": path_of_image(out, name),
        }
        for name, image_options in options_by_image(stars, options).items()
    }
    run_for_images(predict_image, jobs, stars)


def _bundle_of_image(model: Path | None, name: str) -> Path | None:
    """Return the bundle of an image, if `model` is a folder with one for each; else `model`.

    `from-stars` leaves NAME.psf.safetensors in the folder itself, or with --all-extensions
    one bundle in the subfolder NAME.

    Raises
    ------
    PredictionError
        If the folder has no bundle of this image, or several.
    """
    if model is None or not model.is_dir():
        return model
    bundle = model / f"{name}{SUFFIX}"
    bundles = [bundle] if bundle.is_file() else sorted((model / name).glob(f"*{SUFFIX}"))
    if len(bundles) != 1:
        raise PredictionError(f"{model / name}: {len(bundles)} models, expected one")
    return bundles[0]


def predict_image(
    stars: Path,
    options: ImageOptions,
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
    """Predict the stars of one image, and write the FITS file, the star list and the map.

    Parameters are those of `predict`.

    Returns
    -------
    str
        Lines about the image, its star list, the model, and the number of stars with each flag.

    Raises
    ------
    PredictionError
        If the options do not fit the image or the model, or a file cannot be written.
    """
    # Check all that can be checked without reading pixels.
    source = options.source(stars, flux_column=flux_column, background_column=background_column)
    list_path = out.with_name(f"{out.stem}_stars.csv") if options.detect else None
    model = _bundle_of_image(model, source.name)
    check_targets((*source.files(), model), out, plot, list_path, overwrite=overwrite)
    loaded = load_model(model)
    observation = source.open(loaded.info.stamp_px, loaded.margin_px)
    if loaded.info.source == "stars":
        # A model of an image may have been trained without a known pixel scale, too.
        observation = observation.assuming()
    assumed = " (scale assumed, --pixel-scale states it)" if observation.scale_assumed else ""
    loaded.check_scale(observation.pixel_scale_arcsec, f"{source.path}{assumed}")
    measures_centres = isinstance(loaded.method, MeasuresStars)
    if fixed_positions and not (measures_centres and observation.shape):
        raise PredictionError(
            f"{source.path}: --fixed-positions takes an image with a star list, and a model of "
            "psfdae from-stars --method field"
        )
    if plot is not None and observation.positions is None:
        raise PredictionError(f"{source.path}: a map needs a catalogue with pixel positions")
    try:
        # The FITS file gets its name last: if it exists, everything is done.
        with atomic_path(out) as unfinished, silence() if quiet else nullcontext():
            flag_counts, unflagged, list_note = _write_prediction(
                loaded, source, observation, unfinished, threads, fixed_positions
            )
            if list_path is not None:
                write_list(observation, list_path)
            if plot is not None:
                from psfdae.model.plot import map_of_file

                write_png(map_of_file(unfinished), plot)
    except OSError as error:
        raise PredictionError(f"{out}: cannot be written ({error.strerror or error})") from error
    # Summary: the image, its list, what limits the trust in the model, and the flags.
    lines = [observation.said(), list_note]
    instrument_note = loaded.other_instrument(observation.instrument, observation.colour_column)
    if instrument_note:
        lines.append(f"{source.path}: {instrument_note}")
    if observation.shape and isinstance(loaded.method, KnowsField) and not loaded.wings:
        lines.append(
            "flux_total is NaN: no bright star of the training showed light beyond its stamp of "
            f"{loaded.stamp_px} px; flux is the light in the stamp"
        )
    lines.append(f"{out}: {observation.count} stars, {unflagged} without a flag")
    flagged = zip(StarFlag, flag_counts, strict=True)
    lines += [f"  {flag.name}: {count}" for flag, count in flagged if count]
    return "\n".join(line for line in lines if line)


def check_targets(
    inputs: Sequence[object], out: Path, *other_outputs: Path | None, overwrite: bool
) -> None:
    """Refuse outputs that exist, unless `overwrite` is set.

    Parameters
    ----------
    inputs : sequence
        All that the command reads.
    out : Path
        The output; none of the others may have its name.
    other_outputs : Path or None

    Raises
    ------
    OutputError, PredictionError
        If a path is an input, a folder or an existing file, or two outputs have the same name.
    """
    targets = [out, *filter(None, other_outputs)]
    check_outputs(targets, inputs)
    for target in targets:
        if target.is_dir():
            raise PredictionError(f"{target}: is a folder, not a file")
        if target.exists() and not overwrite:
            raise PredictionError(f"{target}: exists already; --overwrite replaces it")
    for target in targets[1:]:
        if target.resolve() == out.resolve():
            raise PredictionError(f"{target}: two outputs have this name")


def _write_prediction(
    model: PsfModel,
    source: Source,
    observation: Observation,
    out: Path,
    threads: int | None,
    fixed_positions: bool,
) -> tuple[np.ndarray, int, str | None]:
    """Restore the stars in pieces and write them to a FITS file.

    Returns
    -------
    flag_counts : ndarray of int, shape (flags,)
        Number of stars with each `StarFlag`.
    unflagged : int
        Number of stars without any flag.
    list_note : str or None
        A sentence on how far the stars are off the positions of their list.

    Raises
    ------
    ObservationError
        If the positions of the list are far off (`list_offset`); nothing is left of the file.
    """
    pieces = model.stream(observation, threads, fixed_positions)
    first_piece = next(pieces)
    flag_counts = np.zeros(len(StarFlag), dtype=int)
    star_index, unflagged, offsets = 0, 0, []
    # Header cards: the file, its pixel scale, the star list, and what is known of the detector.
    assumed = ", assumed" if observation.scale_assumed else ""
    scale = observation.pixel_scale_arcsec
    cards: list[Card] = [
        ("INFILE", source.path.name, "stars"),
        ("PIXSCALE", scale, f"[arcsec] width of a pixel{assumed}"),
    ]
    if observation.catalogue is not None:
        cards.append(("CATALOG", observation.catalogue.name, "star list"))
    if observation.gain is not None:
        cards.append(("GAIN", observation.gain, "electrons per count"))
    if observation.saturate is not None:
        cards.append(("SATURATE", observation.saturate, "counts of a saturated pixel"))
    cards += observation.header_cards
    history = " ".join(["psfdae", *sys.argv[1:]])  # without the folder of the program
    header = (first_piece[1], observation.count, cards, history)
    with prediction_file(out, model.bundle, *header) as file:
        for stamps, prediction in itertools.chain([first_piece], pieces):
            file.write(star_index, prediction)
            flag_counts += [(prediction.flags & int(flag) > 0).sum() for flag in StarFlag]
            unflagged += int((prediction.flags == 0).sum())
            offsets.append(_list_offsets(stamps, prediction))
            star_index += len(prediction)
        note = list_offset(observation.catalogue, np.concatenate(offsets), source.accept_offset)
    return flag_counts, unflagged, note if observation.shape else None


def _list_offsets(stamps: Stamps, prediction: Prediction) -> np.ndarray:
    """Return the offsets of stars from their listed positions.

    Returns
    -------
    ndarray, shape (n, 2)
        Along x and y in px; NaN for stars that are too faint, have no flux, or are not listed.
    """
    # A model that measures centres (field) gives the offset itself.
    centre_offset = np.stack([prediction.x_fit - stamps.x, prediction.y_fit - stamps.y], axis=1)
    # For another one, it is the shift by which the stamp was centred on its brightest pixel. A star
    # that is off by more than the margin allows is given a pixel more than that.
    off_centre = (prediction.flags & int(StarFlag.OFF_CENTRE)) > 0
    shift = np.stack([prediction.shift_x, prediction.shift_y], axis=1)
    shift = np.where(off_centre[:, None], PsfModel.margin_px + 1.0, shift)
    unclear = (prediction.flags & int(StarFlag.FAINT | StarFlag.NO_FLUX)) > 0
    unclear |= ~np.isfinite(stamps.listed).all(axis=1)
    offset = np.where(np.isfinite(centre_offset), centre_offset, shift)
    return np.where(unclear[:, None], np.nan, offset)
