"""Command `predict`: restore the stars of a FITS file, and write their PSFs to another one.

Stars are read, restored and written in pieces, so that memory does not grow with their number.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import click
import numpy as np

from psfdae.base.figures import write_png
from psfdae.base.files import atomic_path, check_outputs, is_cut_off, rename_together
from psfdae.base.options import File
from psfdae.commands.cli import command
from psfdae.commands.mosaic import name_image_path, options_by_image, run_for_images
from psfdae.denoise.bundle import SUFFIX
from psfdae.denoise.image_prediction import notes_on_model, offsets_from_list, open_for_model
from psfdae.denoise.prediction import prediction_file
from psfdae.denoise.star_model import StarModel
from psfdae.image.fits_file import Card
from psfdae.image.image import Image
from psfdae.image.image_input import ImageInput, ImageOptions
from psfdae.image.observation import Observation
from psfdae.image.positions import list_offset
from psfdae.image.stamps import StarFlag
from psfdae.psf.interface import PredictionError
from psfdae.report.plot import read_psf_map


def write_list(observation: Observation, path: Path) -> None:
    """Write the stars that were detected in an image as a star list in CSV."""
    assert observation.detections is not None
    with atomic_path(path) as temporary:
        observation.detections.table.write(temporary, format="ascii.csv", overwrite=True)


@command("predict")
def predict_command(
    stars: Annotated[File, {"argument": True, "metavar": "INPUT"}],
    options: ImageOptions,
    all_extensions: bool = False,
    flux_column: str | None = None,
    background_column: str | None = None,
    fixed_positions: bool = False,
    model: Annotated[Path | None, click.Path(path_type=Path)] = None,
    plot: File | None = None,
    overwrite: bool = False,
    threads: Annotated[int | None, click.IntRange(min=1)] = None,
    *,
    out: File,
) -> str:
    """Predict the PSFs of the stars in INPUT.

    INPUT is a FITS cube of stamps, or a FITS image with --catalogue or --detect.
    Stars are flagged, never dropped. Files that cannot be used end with one line
    and exit code 2.

    Parameters
    ----------
    stars : Path
        FITS image, or FITS cube of stamps.
    options : ImageOptions
        Options of the image, and its star list.
    all_extensions : bool
        All images of the file, each by itself and in parallel; OUT gets their names.
    flux_column : str, optional
        Fluxes inside the stamp; estimated where not given.
    background_column : str, optional
        Sky levels per pixel; estimated where not given.
    fixed_positions : bool
        The star list's centres are exact; for models that measure centres (field).
    model : Path, optional
        Model bundle, or folder of train. [default: the shipped one]
    plot : Path, optional
        PNG with a map of the PSF over the field.
    overwrite : bool
        Replace files that exist.
    threads : int, optional
        [default: all cores]
    out : Path
        FITS file for PSFs, residuals, uncertainties and a table of stars.
    """
    arguments = dict(locals())
    if all_extensions:
        # Images are worked on side by side, each by one thread, with its own model and outputs.
        jobs = {}
        for image, image_options in options_by_image(stars, options).items():
            changes = {"options": image_options, "all_extensions": False, "threads": 1}
            outputs = {"plot": name_image_path(plot, image), "out": name_image_path(out, image)}
            jobs[image] = {**arguments, **changes, "model": find_bundle(model, image), **outputs}
        run_for_images(predict_command, jobs, stars)
        return ""
    # Check all that can be checked without reading pixels: inputs, outputs, and the model.
    source = ImageInput(
        stars, **vars(options), flux_column=flux_column, background_column=background_column
    )
    list_path = out.with_name(f"{out.stem}_stars.csv") if options.detect else None
    bundle = find_bundle(model, source.name)
    check_targets((*source.files(), bundle), out, plot, list_path, overwrite=overwrite)
    denoiser = StarModel.load(bundle)
    observation = open_for_model(denoiser, source, fixed_positions)
    if plot is not None and observation.positions is None:
        raise PredictionError(f"{source.path}: a map needs a catalogue with pixel positions")
    try:
        # The FITS file gets its name last: if it exists, everything is done.
        with rename_together(out), atomic_path(out) as temporary_path:
            flags, list_note = write_prediction(
                denoiser, source, observation, temporary_path, threads, fixed_positions
            )
            if list_path is not None:
                write_list(observation, list_path)
            if plot is not None:
                write_png(read_psf_map(temporary_path), plot)
    except OSError as error:
        name = error.filename or out
        raise PredictionError(f"{name}: cannot be written ({error.strerror or error})") from error
    # Summary: the image, its list, what limits the trust in the model, and the flags.
    lines = [observation.summary(), list_note, *notes_on_model(denoiser, observation, flags)]
    lines.append(f"{out}: {observation.count} stars, {(flags == 0).sum()} without a flag")
    counts_by_flag = [(flag.name, np.count_nonzero(flags & int(flag))) for flag in StarFlag]
    lines += [f"  {name}: {count}" for name, count in counts_by_flag if count]
    summary = "\n".join(line for line in lines if line)
    print(summary)
    return summary


def find_bundle(model: Path | None, name: str) -> Path | None:
    """Return the bundle of an image, if `model` is a folder with one for each; else `model`.

    `train` leaves NAME.psf.safetensors in the folder itself, or with --all-extensions
    one bundle in the subfolder NAME.

    Raises
    ------
    PredictionError
        If the folder does not have exactly one bundle of this image.
    """
    if model is None or not model.is_dir():
        return model
    # A model of this name; or the only one in the folder of this name.
    bundle = model / f"{name}{SUFFIX}"
    bundles = [bundle] if bundle.is_file() else sorted((model / name).glob(f"*{SUFFIX}"))
    if len(bundles) != 1:
        raise PredictionError(f"{model / name}: {len(bundles)} models, expected one")
    return bundles[0]


def check_targets(
    inputs: Sequence[object], out: Path, *other_outputs: Path | None, overwrite: bool
) -> None:
    """Raise an error for existing outputs, unless `overwrite` is set or a killed run left them.

    Parameters
    ----------
    inputs : sequence
        All that the command reads.
    out : Path
        The output; none of the others may have its name.
    *other_outputs : Path or None
        Further outputs; None is left out.
    overwrite : bool
        Existing outputs are replaced.

    Raises
    ------
    OutputError, PredictionError
        If a path is an input, a folder or an existing file, or two outputs have the same name.
    """
    overwrite = overwrite or is_cut_off(out)
    # An output is neither an input nor another output, and replaces nothing without a word.
    targets = [out, *filter(None, other_outputs)]
    check_outputs(targets, inputs)
    for target in targets:
        if target.exists() and not overwrite:
            raise PredictionError(f"{target}: exists already; --overwrite replaces it")
    for target in targets[1:]:
        if target.resolve() == out.resolve():
            raise PredictionError(f"{target}: two outputs have this name")


def write_prediction(
    model: StarModel,
    source: ImageInput,
    observation: Observation,
    out: Path,
    threads: int | None,
    fixed_positions: bool,
) -> tuple[np.ndarray, str | None]:
    """Restore the stars in pieces and write them to a FITS file.

    Returns
    -------
    flags : ndarray of int, shape (n,)
        Sums of the `StarFlag` of all stars.
    list_note : str or None
        A sentence on how far the stars are off the positions of their list.

    Raises
    ------
    ObservationError
        If the positions of the list are far off (`list_offset`); nothing is left of the file.
    """
    # The first stars give the types of the columns.
    pieces = model.stream(observation, threads, fixed_positions)
    first_piece = next(pieces)
    star_index, flags, offsets = 0, [], []
    # Header cards: the file, its pixel scale, the star list, and what is known of the detector.
    scale_note = ", assumed" if observation.scale_assumed else ""
    catalogue = None if observation.catalogue is None else observation.catalogue.name
    known_cards: list[Card] = [
        ("CATALOG", catalogue, "star list"),
        ("GAIN", observation.gain, "electrons per count"),
        ("SATURATE", observation.saturate, "counts of a saturated pixel"),
    ]
    cards: list[Card] = [
        ("INFILE", source.path.name, "stars"),
        ("PIXSCALE", observation.pixel_scale_arcsec, f"[arcsec] width of a pixel{scale_note}"),
        # Unknown values have no card.
        *(card for card in known_cards if card[1] is not None),
        *observation.header_cards,
    ]
    history = " ".join(["psfdae", *sys.argv[1:]])  # without the folder of the program
    header = (first_piece[1], observation.count, cards, history)
    with prediction_file(out, model.bundle, *header) as file:
        # Rows of the file, flags of the stars, and distances to the list.
        for stamps, prediction in itertools.chain([first_piece], pieces):
            file.write(star_index, prediction)
            flags.append(prediction.flags)
            offsets.append(offsets_from_list(stamps, prediction, model.margin_px))
            star_index += len(prediction)
        note = list_offset(observation.catalogue, np.concatenate(offsets), source.accept_offset)
    return np.concatenate(flags), note if isinstance(observation, Image) else None
