"""Fit of a model to the bright stars of an image, and its steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from psfdae.errors import needed_by
from psfdae.fits import described_by
from psfdae.method import KnowsField, Method, with_free_flux
from psfdae.methods import groups_of
from psfdae.methods import method as method_of
from psfdae.model.packing import model_of, with_wings
from psfdae.model.psf_model import PsfModel
from psfdae.model.settings import with_keywords
from psfdae.model.star_sets import (
    field_positions,
    fit_apart,
    noise_model,
    split_stars,
    training_set,
)
from psfdae.model.stars import ENOUGH_STARS, REFERENCE, SPLIT, Stars
from psfdae.model.wings import Wings, wings_of_stars
from psfdae.rng import stream
from psfdae.settings import ConfigError
from psfdae.threads import fixed_threads

Kind = TypeVar("Kind", bound=Method)


def fit(
    stars: Stars,
    method: str | None = None,
    *,
    name: str | None = None,
    licence: str = "not stated",
    **settings: object,
) -> PsfModel:
    """Train a model on the bright stars of an image, without those that are held out.

    Parameters
    ----------
    stars : Stars
    method : str, optional
        "gmm", "field" or "dae"; by default the one of the first two that errs least on validation
        stars.
    name : str, optional
        Of the model; by default the image's.
    licence : str
        Of the model.
    **settings
        Keys of the method's settings, such as `orders=[0, 1, 2]` for "field".

    Returns
    -------
    PsfModel
        `save` writes it to a file.

    Raises
    ------
    Error
        If the method makes no model of an image, or a setting is wrong.

    Examples
    --------
    >>> psfdae.fit(stars, method="gmm", components=[4], shrinkage=[10.0], name="mine")
    PsfModel('mine', 16×16 px of 1", S/N 5 … 50)
    """
    names = [method] if method else [n for n in stars.settings.methods if makes_models(n)]
    kinds = worth_trying(stars, [model_method(one) for one in names])
    groups = [group for kind in kinds for group in kind.groups]
    stars = stars.with_settings(with_keywords(stars.settings, groups, settings))
    fitted = {kind.name: fitted_to(stars, kind) for kind in kinds}
    best_name = next(iter(fitted)) if len(fitted) == 1 else best(stars, fitted)[0]
    return packed(stars, fitted[best_name], name or stars.name, licence)


def worth_trying(stars: Stars, kinds: Sequence[type[Method]]) -> list[type[Method]]:
    """Return the methods of which one becomes the model: of few stars the field alone.

    Too few are left to choose a method by validation stars, and only the field falls back to one
    PSF for all.
    """
    field = [kind for kind in kinds if kind.name == "field"]
    return field if field and len(stars) < ENOUGH_STARS else [*kinds]


def makes_models(name: str) -> bool:
    """Whether a method makes a model that can be saved, and knows all that it needs of an image."""
    kind = method_of(name)
    return kind.storage is not None and kind.packing is not None


def model_method(name: str) -> type[Method]:
    """The method of a name, if it makes a model of an image.

    Raises
    ------
    ConfigError
        If it does not.
    """
    if not makes_models(name):
        raise ConfigError(f"method {name!r}: makes no model of an image")
    return method_of(name)


def fitted_to(stars: Stars, kind: type[Kind], checkpoint: Path | None = None) -> Kind:
    """A fit of a method to the stars that are not held out.

    A long one keeps its state in the file `checkpoint`, if one is given.
    """
    data = training_set(
        stars.settings, kind, stars.product, SPLIT, REFERENCE, checkpoint=checkpoint
    )
    with fixed_threads(kind.threads(stars.settings)), needed_by(f"the method {kind.name}"):
        return kind.fit(data, **kind.settings(stars.settings))


def described(stars: Stars, kind: type[Method]) -> dict[str, Any]:
    """Settings that decide a fit, as its product and its model say them."""
    group_settings = stars.settings.model_dump(include={*groups_of(kind.name)})
    return described_by(kind, group_settings, SPLIT, REFERENCE)


def best(stars: Stars, fitted: Mapping[str, Method]) -> tuple[str, dict[str, float]]:
    """The method that errs least on validation stars, and the MSE of each of PSFs of flux 1.

    No fit that is asked has seen these stars. Every S/N counts alike: the geometric mean of the
    errors decides.
    """
    settings, product = stars.settings, stars.product
    judges = split_stars(product, SPLIT, settings).validation
    truth, positions = product["realisation"][judges], field_positions(product)[judges]
    errors = {}
    for name, fit_of_all in fitted.items():
        fitted_kind, kind = fit_of_all, type(fit_of_all)
        data = training_set(settings, kind, product, SPLIT, REFERENCE)
        with fixed_threads(kind.threads(settings)):
            if not kind.needs.validation:
                fitted_kind = fit_apart(kind, data, product["field_index"], settings)
            rng = stream(settings.seed, "noise", "own stars")
            noisy = [noise_model(settings).draw(truth, level, rng) for level in data.levels]
            # As of the stars that the model is for.
            with_free = with_free_flux(fitted_kind)
            logs = []
            for images, level in zip(noisy, data.levels, strict=True):
                psf = with_free.restore(images, level, positions)
                psf = psf / psf.sum(axis=(1, 2), keepdims=True)
                logs.append(np.log(np.square(psf - truth).mean()))
        errors[name] = float(np.exp(np.mean(logs)))
    return min(errors, key=errors.__getitem__), errors


def packed(stars: Stars, fitted: Method, name: str, licence: str) -> PsfModel:
    """The model of a fit, with its errors on the stars that are held out, and wings of stars."""
    of = stars.product, REFERENCE, stars.settings, described(stars, type(fitted)), name, licence
    with fixed_threads(stars.settings.evaluation.threads):
        model = model_of(fitted, *of)
        if not isinstance(fitted, KnowsField) or stars.observation.shape is None:
            return model
        wings_of_each = [
            part.wings or wings_of_stars(model, part.observation.with_margin(model.margin_px))
            for part in stars.each
        ]
    known_wings = [wings for wings in wings_of_each if wings is not None]
    if not known_wings:
        return model
    return PsfModel(with_wings(model.bundle, Wings.joined(known_wings)), model.method)
