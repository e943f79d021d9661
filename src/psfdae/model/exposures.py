"""A field model of some exposures for one, which may have few bright stars of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from psfdae.bright_stars import BrightStars
from psfdae.image.observation import Observation, Source, list_offset
from psfdae.image.selection import collect
from psfdae.methods.field import FieldMixture
from psfdae.model.bundle import creation_date
from psfdae.model.field_psfs import PredictionError
from psfdae.model.psf_model import PsfModel
from psfdae.model.settings import of_config
from psfdae.model.stars import Stars
from psfdae.version import __version__

FEWEST_STARS = 5
"""Bright stars of an exposure, of which one can be left out to judge the others."""


def exposure(model: PsfModel, source: Source, name: str) -> tuple[PsfModel, str]:
    """A model for another exposure of the same camera, by its own bright stars.

    The PSF at a place changes from that of `model` by as much as the stars that are left out
    support. The scatter of stars about the field, and the calibration of errors, stay those of the
    training of `model`.

    Parameters
    ----------
    model : PsfModel
        Of the method field, of an exposure with many stars.
    source : Source
        The other exposure, and what is stated about it.
    name : str
        Of the new model.

    Returns
    -------
    model : PsfModel
    said : str
        How many stars it rests on, and whether it is of another telescope, camera or filter.

    Raises
    ------
    PredictionError
        If `model` knows no places, was adapted itself, or is of pixels of another size.
    Error
        If the image cannot be used, or has too few bright stars.
    """
    model.field_range()
    info, field = model.info, model.method
    if not isinstance(field, FieldMixture):
        raise PredictionError(f"the model {model.name!r}: of {field.look.label}, expected a field")
    if info.adapted:
        raise PredictionError(
            f"the model {model.name!r} was itself adapted to {info.adapted}; expected that of the "
            "exposure it was trained on"
        )
    try:
        trained = info.config["stars"]
        settings = of_config({key: trained[key] for key in ("calibration_stars", "framing")})
    except (KeyError, TypeError):
        raise PredictionError(
            f"the model {model.name!r} does not say how its stars were chosen"
        ) from None
    calibration = settings.calibration_stars.model_copy(update={"stars_min": FEWEST_STARS})
    observation = source.open(info.stamp_px, calibration.margin_px).assuming()
    if observation.shape is None:
        raise PredictionError(f"{observation.path}: a cube of stamps; expected an image")
    model.check_scale(observation.pixel_scale_arcsec, str(observation.path))
    difference = model.other_instrument(observation.instrument, observation.colour_column)
    bright = collect(observation, calibration, settings.framing).bright
    if not np.isfinite(bright.position).all():
        raise PredictionError(f"{observation.path}: positions of bright stars are not known")
    sentence = f"{len(bright)} stars of {observation.path.name} change the field of {model.name}"
    off = list_offset(
        observation.catalogue, (bright.centre - bright.listed)[:, ::-1], source.accept_offset
    )
    adapted = _adapted(model, field, observation, bright, name)
    sentence = f"{sentence} ({difference})" if difference else sentence
    return adapted, "\n".join([*observation.remarks, *filter(None, [off]), sentence])


def for_exposures(model: PsfModel, stars: Stars) -> dict[str, PsfModel]:
    """A model for each exposure of several, by its own bright stars.

    Parameters
    ----------
    model : PsfModel
        Fitted to them, as `psfdae.fit` does it.
    stars : Stars
        Of several images.

    Returns
    -------
    dict of str to PsfModel
        By the images' names without suffix, as `psfdae exposure` adapts a model to an exposure;
        `model` itself where its method knows no field, or an image has fewer than 5 bright stars.
    """
    field, models = model.method, {}
    for part in stars.exposures:
        bright, exposure_model = part.candidates.bright, model
        if isinstance(field, FieldMixture) and len(bright) >= FEWEST_STARS:
            exposure_model = _adapted(model, field, part.observation, bright, part.name)
        models[part.name] = exposure_model
    return models


def _adapted(
    model: PsfModel, field: FieldMixture, observation: Observation, bright: BrightStars, name: str
) -> PsfModel:
    info, trained = model.info, model.info.config["stars"]
    sky = bright.sky_photons(observation.gain, field.noise.background)
    arrays, _ = field.of_exposure(bright, sky).pack(info.stamp_px, info.noise_min)
    changed = {key: arrays[key].astype(model.bundle.weights[key].dtype) for key in CHANGED}
    image = {
        "image": observation.path.name,
        "image_sha256": observation.sha256(),
        "trained_on": trained.get("image_sha256", ""),
        "image_px": [*reversed(observation.shape or ())],
        "instrument": observation.instrument,
        "adapted": {"from": model.sha256, "stars": len(bright)},
    }
    described = info.model_copy(
        update={
            "name": name,
            "created": creation_date(),
            "psfdae_version": __version__,
            "config": info.config | {"stars": trained | image},
        }
    )
    bundle = replace(model.bundle, info=described, weights={**model.bundle.weights, **changed})
    return PsfModel(bundle)


CHANGED = ("coefficients", "listed")
"""Arrays of a bundle that an exposure has of its own."""
