"""Adaptation of a field model to another exposure, which may have few bright stars."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import TypeVar

import numpy as np

from psfdae.base.errors import warn
from psfdae.base.version import __version__
from psfdae.denoise.bundle import creation_date
from psfdae.denoise.image_prediction import other_instrument
from psfdae.denoise.star_model import StarModel
from psfdae.image.image import Image
from psfdae.image.image_input import ImageInput
from psfdae.image.observation import Observation
from psfdae.image.opening import open_observation
from psfdae.image.positions import list_offset
from psfdae.image.selection import collect
from psfdae.methods.field import FieldMixture
from psfdae.psf.interface import PredictionError
from psfdae.stars.bright_stars import BrightStars
from psfdae.training.packing import checksum
from psfdae.training.settings import Settings, make_settings
from psfdae.training.star_choice import MIN_STARS_WITH_ERROR
from psfdae.training.stars import ImageStars

Model = TypeVar("Model", bound=StarModel)


def exposure(model: Model, source: ImageInput, name: str) -> tuple[Model, str]:
    """Adapt a model to the bright stars of another exposure of the same camera.

    The PSF at a position changes from the PSF of `model` by as much as cross-validation with the
    stars supports. The scatter of stars about the field and the calibration of errors stay as in
    `model`.

    Parameters
    ----------
    model : StarModel
        Model of the method field, trained on an exposure with many stars.
    source : ImageInput
        The other exposure, with its star list and options.
    name : str
        Name of the new model.

    Returns
    -------
    model : StarModel
    message : str
        Remarks on the image and its list, the number of stars, and a difference of telescope,
        camera or filter; one line each.

    Raises
    ------
    PredictionError
        If `model` knows no positions, was adapted itself, or has pixels of another size.
    Error
        If the image cannot be used, or has too few bright stars.
    """
    model.field_range()  # refuses a model without positions
    info, field = model.info, model.method
    if not isinstance(field, FieldMixture):
        title = field.look.title
        raise PredictionError(f"the model {model.name!r}: a {title}, expected a field model")
    # How much an exposure may change is judged from the field of the training.
    if info.adapted:
        raise PredictionError(
            f"the model {model.name!r} was itself adapted to {info.adapted}; expected the model "
            "of the exposure it was trained on"
        )
    settings = read_training_settings(model)
    # Its bright stars, chosen as in the training, but few are enough.
    calibration = settings.calibration_stars.model_copy(update={"stars_min": MIN_STARS_WITH_ERROR})
    # The image must have the pixels of the training; another filter is only reported.
    observation = open_observation(source, info.stamp_px, calibration.margin_px).assume_scale()
    if not isinstance(observation, Image):
        raise PredictionError(f"{observation.path}: a cube of stamps; expected an image")
    model.check_scale(observation.pixel_scale_arcsec, observation.name_with_scale)
    model, frame_notes = model.to_image_frame(observation)
    difference = other_instrument(model, observation)
    bright = collect(observation, calibration, settings.framing).bright
    if not np.isfinite(bright.position).all():
        raise PredictionError(f"{observation.path}: positions of bright stars are not known")
    sentence = f"{len(bright)} stars of {observation.path.name} change the field of {model.name}"
    sentence = f"{sentence} ({difference})" if difference else sentence
    # Remarks for the user: offset of the star list, number of stars, differences.
    offset_note = list_offset(
        observation.catalogue, (bright.centre - bright.listed)[:, ::-1], source.accept_offset
    )
    # The part of the field that the image shows.
    last_pixel = np.array(observation.shape[::-1]) - 1.0
    low, high = np.clip(model.field_range(), 0.0, last_pixel)
    warnings = [*frame_notes, *note_empty_quarters(low, high, bright.position)]
    warn(warnings)
    lines = [*observation.remarks, *filter(None, [offset_note]), *warnings, sentence]
    return _adapt(model, observation, bright, name), "\n".join(lines)


def read_training_settings(model: StarModel) -> Settings:
    """Return the settings by which the training stars of a model were chosen.

    Raises
    ------
    PredictionError
        If the model does not have them, because its training stars were simulated.
    """
    try:
        training_config = model.info.config["stars"]
        return make_settings(
            {key: training_config[key] for key in ("seed", "calibration_stars", "framing", "parts")}
        )
    except (KeyError, TypeError):
        raise PredictionError(
            f"the model {model.name!r} does not say how its stars were chosen"
        ) from None


def note_empty_quarters(low: np.ndarray, high: np.ndarray, position: np.ndarray) -> list[str]:
    """Return a sentence on quarters of a field with hardly a star; none if all have some.

    Parameters
    ----------
    low, high : ndarray, shape (2,)
        Range of the field along x and y.
    position : ndarray, shape (n, 2)
        Positions of the stars, x and y.
    """
    # A quarter is a half along x and a half along y; a 16th of the stars is too few for one.
    middle, limit, empty = 0.5 * (low + high), len(position) // 16, []
    for quarter in product((False, True), repeat=2):
        if ((position > middle) == quarter).all(axis=1).sum() <= limit:
            (x0, y0), (x1, y1) = np.where(quarter, (middle, high), (low, middle))
            empty.append(f"x {x0:.0f} … {x1:.0f}, y {y0:.0f} … {y1:.0f}")
    note = f"{limit} bright stars or fewer in {len(empty)} of the 4 quarters ({'; '.join(empty)})"
    return [f"{note}: the change of the PSF is not measured there"] if empty else []


def adapt_to_exposures(model: Model, stars: ImageStars) -> dict[str, Model]:
    """Adapt a model of several exposures to each of them.

    Parameters
    ----------
    model : StarModel
        Model that `psfdae.fit` made of the stars of all exposures.
    stars : ImageStars
        Stars of several images.

    Returns
    -------
    dict of str to StarModel
        Adapted models, by the images' names without suffix; `model` itself where its method knows
        no field, or an image has fewer than 5 bright stars.
    """
    # An image with too few bright stars keeps the model of all images.
    field, models = model.method, {}
    for image in stars.exposures:
        bright, models[image.name] = image.candidates.bright, model
        if isinstance(field, FieldMixture) and len(bright) >= MIN_STARS_WITH_ERROR:
            models[image.name] = _adapt(model, image.observation, bright, image.name)
    return models


def adapt_to_stars(model: Model, stars: ImageStars) -> Model:
    """Adapt a model to the stars of one other image, without those that are held out for a test.

    Parameters
    ----------
    model : StarModel
        Model of the method field, with stamps as large as the stars' stamps, that was not adapted
        itself.
    stars : ImageStars
        Bright stars of the other image.
    """
    model, train = model.to_image_frame(stars.observation)[0], stars.split.train
    bright = stars.candidates.bright.select(np.flatnonzero(~stars.held_out))
    adapted_model = _adapt(model, stars.observation, bright, stars.name)
    # The checksum of the training stars shows a test that no other stars were used.
    training_sha256 = checksum(
        stars.product["realisation"][train], stars.product[stars.reference][train]
    )
    info = adapted_model.info.model_copy(update={"training_sha256": training_sha256})
    return type(model)(replace(adapted_model.bundle, info=info))


def _adapt(model: Model, observation: Observation, bright: BrightStars, name: str) -> Model:
    """Return a copy of a model with the field of an exposure, and a description that says so."""
    info, training, field = model.info, model.info.config["stars"], model.method
    assert isinstance(field, FieldMixture)
    # New coefficients of the field; all other arrays, and errors, stay as in the training.
    sky = bright.sky_photons(observation.gain, field.noise.background)
    arrays, _ = field.refit_exposure(bright, sky).export(info.stamp_px, info.noise_min)
    weights = dict(model.bundle.weights)
    for key in ("coefficients", "listed"):
        weights[key] = arrays[key].astype(weights[key].dtype)
    # The description names the new image, and keeps the image of the training.
    image = {
        "image": observation.path.name,
        "image_sha256": observation.sha256(),
        "trained_on": training.get("image_sha256", ""),
        "image_px": [*reversed(observation.shape)],
        "detector": observation.detector_frames,
        "instrument": observation.instrument,
        "adapted": {"from": model.sha256, "stars": len(bright)},
    }
    description = {
        "name": name,
        "created": creation_date(),
        "psfdae_version": __version__,
        "config": info.config | {"stars": training | image},
    }
    info = info.model_copy(update=description)
    return type(model)(replace(model.bundle, info=info, weights=weights))
