"""Fit of a model to the bright stars of images: choice of a method, fit, errors, wings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np

from psfdae.base.errors import require_extra
from psfdae.base.rng import stream
from psfdae.base.settings import ConfigError
from psfdae.base.threads import fix_threads
from psfdae.denoise.star_model import StarModel
from psfdae.image.image import Image
from psfdae.methods import list_groups
from psfdae.methods import method as method_of
from psfdae.methods.fit_files import describe_fit
from psfdae.methods.interface import Method
from psfdae.photometry.image_photometry import measure_stars
from psfdae.photometry.photon_noise import add_measured_gain
from psfdae.psf.wings import Wings
from psfdae.training.packing import add_wings, build_uncalibrated, calibrate_model
from psfdae.training.settings import apply_keywords
from psfdae.training.star_choice import ENOUGH_STARS
from psfdae.training.star_sets import field_positions, fit_apart, noise_model
from psfdae.training.stars import ImageStars

Kind = TypeVar("Kind", bound=Method)


def fit_model(
    stars: ImageStars,
    method: str | None = None,
    *,
    name: str | None = None,
    licence: str = "not stated",
    **settings: object,
) -> StarModel:
    """Train a model on the bright stars of images, without those that are held out.

    Parameters are as for `psfdae.fit`.
    """
    # Candidates: the given method, or all methods of the settings, of which the best is chosen.
    names = [method] if method else [n for n in stars.settings.methods if makes_models(n)]
    for method_name in names:
        if not makes_models(method_name):
            raise ConfigError(f"method {method_name!r}: makes no model of an image")
    candidates = worth_trying(stars, [method_of(method_name) for method_name in names])
    # Keywords belong to the settings of the candidates; no setting of a method changes the stars.
    groups = [group for candidate in candidates for group in candidate.groups]
    stars = stars.replace_settings(apply_keywords(stars.settings, groups, settings))
    # With several fits, validation stars decide.
    fits = {candidate.name: fit_method(stars, candidate) for candidate in candidates}
    chosen_name = next(iter(fits)) if len(fits) == 1 else choose_method(stars, fits)[0]
    return pack_model(stars, fits[chosen_name], name or stars.name, licence)


def worth_trying(stars: ImageStars, kinds: Sequence[type[Method]]) -> list[type[Method]]:
    """Return the methods that may become the model: for few stars, "field" alone.

    Too few stars are left to choose a method by validation, and only the method "field" falls back
    to one PSF for all stars.
    """
    # Without the field among them, all are tried, however few the stars are.
    field = [kind for kind in kinds if kind.name == "field"]
    return field if field and len(stars) < ENOUGH_STARS else [*kinds]


def makes_models(name: str) -> bool:
    """Return True if a method makes a model of an image that can be saved."""
    kind = method_of(name)
    return kind.storage is not None and kind.packing is not None


def fit_method(stars: ImageStars, kind: type[Kind], checkpoint: Path | None = None) -> Kind:
    """Fit a method to the stars that are not held out.

    Parameters
    ----------
    stars : ImageStars
        Bright stars of an image, with settings and split.
    kind : type of Method
        Class of the method.
    checkpoint : Path, optional
        File for the state of a long fit, from which it goes on if it was interrupted. Without it,
        an interrupted fit is lost.

    Raises
    ------
    MissingExtraError
        If the method needs a package that is not installed.
    """
    # The stars as the method takes them: of the image, without those that are held out.
    # Networks write their state to a file, which is temporary if none is given.
    with (
        TemporaryDirectory() as folder,
        fix_threads(kind.threads(stars.settings)),
        require_extra(f"the method {kind.name}"),
    ):
        data = stars.training_set(kind, checkpoint=checkpoint or Path(folder, "checkpoint.pt"))
        return kind.fit(data, **kind.settings(stars.settings))


def describe_settings(stars: ImageStars, kind: type[Method]) -> dict[str, Any]:
    """Return the settings that determine a fit, for the description of its product and model.

    Parameters
    ----------
    stars : ImageStars
        Bright stars of an image, with their settings.
    kind : type of Method
        The fitted method, whose groups of settings are described with the split and the reference.
    """
    group_settings = stars.settings.model_dump(include={*list_groups(kind.name)})
    return describe_fit(kind, group_settings, ImageStars.split_kind, ImageStars.reference)


def choose_method(stars: ImageStars, fits: Mapping[str, Method]) -> tuple[str, dict[str, float]]:
    """Choose the method with the smallest error on validation stars, unseen by what is judged.

    Parameters
    ----------
    stars : ImageStars
        Bright stars of an image, with their validation stars.
    fits : mapping of str to Method
        Fits to these stars, by name of the method.

    Returns
    -------
    name : str
        Name of the chosen method.
    errors : dict of str to float
        MSE of PSFs of flux 1 by method: the geometric mean over the noise levels, so that every
        S/N counts alike.
    """
    # Every method restores the same bright stars, degraded with the same noise.
    settings, product, validation = stars.settings, stars.product, stars.split.validation
    truth, positions = product["realisation"][validation], field_positions(product)[validation]
    errors = {}
    for name, method_fit in fits.items():
        judged_fit, kind = method_fit, type(method_fit)
        data = stars.training_set(kind)
        with fix_threads(kind.threads(settings)):
            # A method without a need of validation stars was trained on them as well: what is
            # judged is a fit without them. One that needs them, to stop, has not.
            if not kind.needs.validation:
                judged_fit = fit_apart(kind, data, product["field_index"], settings)
            rng = stream(settings.seed, "noise", "own stars")
            noisy = [noise_model(settings).draw(truth, level, rng) for level in data.levels]
            # Stars to which the model will be applied have an unknown flux: it is free here.
            free_method = judged_fit.free_flux()
            # MSE of PSFs of sum 1 at each noise level, averaged in its logarithm.
            log_mse = []
            for images, level in zip(noisy, data.levels, strict=True):
                psf = free_method.estimate(images, level, positions, with_sigma=False).psf
                psf = psf / psf.sum(axis=(1, 2), keepdims=True)
                log_mse.append(np.log(np.square(psf - truth).mean()))
        errors[name] = float(np.exp(np.mean(log_mse)))
    return min(errors, key=errors.__getitem__), errors


def pack_model(stars: ImageStars, method_fit: Method, name: str, licence: str) -> StarModel:
    """Return the model of a fit with its errors on held-out stars, and with wings.

    Wings are there if the method knows the field, and an image shows any.

    Parameters
    ----------
    stars : ImageStars
        Bright stars of an image, some of them held out.
    method_fit : Method
        Fit to these stars.
    name, licence : str
        Name and licence of the model.
    """
    settings, product = stars.settings, stars.product
    description = describe_settings(stars, type(method_fit))
    with fix_threads(settings.evaluation.threads):
        bundle, model_stars = build_uncalibrated(
            method_fit, product, ImageStars.reference, settings, description, name, licence
        )
        # The wings, which do not depend on the errors of the fit, come first: the nodes of the fit
        # and maps of a large image together would take more memory.
        wings = measure_wings(StarModel(bundle), stars) if method_fit.knows_field else []
        # Calibrate the errors of the fit on held-out stars.
        model = calibrate_model(bundle, method_fit, product, model_stars, settings, stars.estimates)
    if not wings:
        return model
    return StarModel(add_wings(model.bundle, Wings.join(wings)), model.method)


def measure_wings(model: StarModel, stars: ImageStars) -> list[Wings]:
    """Return the light outside the stamps in each image that shows any.

    It is what the photometry with this model measures: `flux_total` of a star and its flux by
    photometry are the same.
    """
    # Stars that are found in the residuals of the first fit change the wings by up to two of their
    # errors, stars of later fits by less than a quarter of one: two fits are enough.
    wings = []
    for image in stars.images:
        if not isinstance(image.observation, Image):
            continue
        observation = add_measured_gain(model, image.observation.assume_scale())
        photometry = measure_stars(model, observation, image.source.given_threshold, 2)
        wings += [] if photometry.image_wings is None else [photometry.image_wings]
    return wings
