"""Prediction of the stars of an image, for the command `predict` and for `psfdae.PsfModel`.

Inputs: a model, and an image with its star list. Outputs: predictions of all stars, an observation
whose pixels have the model's scale, and warnings about limits of the predictions.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from psfdae.base.errors import call
from psfdae.denoise.prediction import Prediction
from psfdae.denoise.star_model import StarModel
from psfdae.image.camera import other_instruments
from psfdae.image.image import Image
from psfdae.image.image_input import ImageInput
from psfdae.image.observation import Observation
from psfdae.image.opening import open_observation
from psfdae.image.positions import list_offset
from psfdae.image.stamps import Stamps, StarFlag, find_unlike_stars
from psfdae.psf.interface import PredictionError

CAUSES = "an image that is turned, of another part of the detector, or of another PSF?"
"""Possible causes if all stars are unlike the training stars."""


def predict_stars(
    model: StarModel, source: ImageInput, threads: int | None, fixed: bool
) -> Prediction:
    """Return the predictions of all stars of an image, with warnings about their limits.

    Parameters
    ----------
    model : StarModel
        Model with stamps of the size and scale that it was trained on.
    source : ImageInput
        The image with its list and its options.
    threads : int or None
        Number of threads; None uses all cores.
    fixed : bool
        True if the listed centres are exact, and are not fitted.

    Raises
    ------
    PredictionError
        As `open_for_model`.
    ObservationError
        If the image or its list cannot be used, or the positions of the list are far off.
    """
    observation = open_for_model(model, source, fixed)
    # Of the stamps, only the offsets of the stars from their listed positions stay in memory.
    predictions, offsets = [], []
    for stamps, prediction in model.stream(observation, threads, fixed):
        predictions.append(prediction)
        offsets.append(offsets_from_list(stamps, prediction, model.margin_px))
    # `list_offset` raises an error if the stars are far from their listed positions.
    offset_note = list_offset(observation.catalogue, np.concatenate(offsets), source.accept_offset)
    notes = [observation.summary(), offset_note if isinstance(observation, Image) else None]
    prediction = Prediction.joined(predictions)
    notes += notes_on_model(model, observation, prediction.flags)
    return replace(prediction, notes=tuple(filter(None, notes)))


def open_for_model(model: StarModel, source: ImageInput, fixed: bool = False) -> Observation:
    """Open an image whose pixels must have the scale of a model.

    Raises
    ------
    PredictionError
        If its pixel scale is unknown or differs from the model's; or if listed centres are exact
        (`fixed`), and the input is not an image, or the model does not measure centres.
    """
    observation = open_observation(source, model.info.stamp_px, model.margin_px)
    if model.info.source == "stars":
        # A model of an image may have been trained without a known pixel scale, too.
        observation = observation.assume_scale()
    model.check_scale(observation.pixel_scale_arcsec, observation.name_with_scale)
    if fixed and not (model.method.knows_field and isinstance(observation, Image)):
        raise PredictionError(
            f"{source.path}: {call('fixed=True', '--fixed-positions')} needs an image with a star "
            f"list, and a model of the method field"
        )
    return observation


def notes_on_model(model: StarModel, observation: Observation, flags: np.ndarray) -> list[str]:
    """Return warnings about limits of the predictions for an image.

    They concern a frame or instrument other than the training image's, stars unlike the training
    stars by the `flags` (n,) of all stars, and light outside the stamps.
    """
    notes = model.to_image_frame(observation)[1]
    # Another telescope, camera or filter, if both headers name it.
    if difference := other_instrument(model, observation):
        notes.append(f"{observation.path}: {difference}")
    # Of stars like the training stars, 0.1 % have this flag.
    unlike_count = int(find_unlike_stars(flags).sum())
    if unlike_count >= max(3, 0.1 * observation.count):
        fraction = f"{unlike_count} of {observation.count} stars are unlike the training stars"
        notes.append(f"{observation.path}: {fraction}: {CAUSES}")
    if isinstance(observation, Image) and model.method.knows_field and not model.wings:
        notes.append(
            "flux_total is NaN: no bright training star showed light outside its stamp of "
            f"{model.stamp_px} px; flux is the light in the stamp"
        )
    return notes


def offsets_from_list(stamps: Stamps, prediction: Prediction, margin_px: int) -> np.ndarray:
    """Return the offsets of stars from their listed positions.

    Parameters
    ----------
    stamps : Stamps
        Stamps cut at the listed positions.
    prediction : Prediction
        Predictions of these stamps.
    margin_px : int
        Largest shift, in pixels, by which a star may have been moved to the middle of its stamp.

    Returns
    -------
    ndarray, shape (n, 2)
        Along x and y in px; NaN for stars that are too faint, have no flux, or are not listed.
    """
    # A model that measures centres (field) gives the offset itself.
    centre_offset = np.stack([prediction.x_fit - stamps.x, prediction.y_fit - stamps.y], axis=1)
    # For other models, the offset is the shift that centred the stamp on its brightest pixel. Stars
    # farther off than the margin get the margin plus one pixel.
    is_off_centre = (prediction.flags & int(StarFlag.OFF_CENTRE)) > 0
    shift = np.stack([prediction.shift_x, prediction.shift_y], axis=1)
    shift = np.where(is_off_centre[:, None], margin_px + 1.0, shift)
    # Noise moves the brightest pixel of a faint star.
    is_unclear = (prediction.flags & int(StarFlag.FAINT | StarFlag.NO_FLUX)) > 0
    is_unclear |= ~np.isfinite(stamps.listed).all(axis=1)
    offset = np.where(np.isfinite(centre_offset), centre_offset, shift)
    return np.where(is_unclear[:, None], np.nan, offset)


def other_instrument(model: StarModel, observation: Observation) -> str:
    """Describe how an image's telescope, camera or filter differs from the training image.

    The columns of colours are compared, too, if the image's star list has one.

    Returns
    -------
    difference : str
        Empty if the values that both images name are the same.
    """
    # Telescope, camera and filter of the headers, and the column of colours of the star lists.
    stars, instrument = model.info.config.get("stars", {}), observation.instrument
    trained_on = dict(stars.get("instrument", {}))
    if observation.colour_column and "colour_column" in stars:
        key = "the column of colours"
        trained_on[key] = stars["colour_column"]
        instrument = {**instrument, key: observation.colour_column}
    return "; ".join(
        f"{key} is {value!r}, the model {model.name!r} was trained on {trained_value!r}"
        for key, trained_value, value in other_instruments(trained_on, instrument)
    )
