"""Sets of stars, products of the kind "stars": their parts, their noise, what methods learn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.bright_stars import BrightStars, places
from psfdae.files import Product, ProductError, read_product
from psfdae.fits import learnt
from psfdae.method import MeasuresStars, Method, TrainingSet
from psfdae.noise import NoiseModel, OwnNoise, noise_equivalent_px
from psfdae.rng import stream
from psfdae.settings import Config, OfFit, WithNoise
from psfdae.splits import Split, held_out_split, random_split

INNER = 10
"""One of so many stars chooses the settings of a fit that has not seen the validation stars."""


def read_stars(path: Path, *references: str) -> Product:
    """Stars with their noise-free images, fields and the references asked for."""
    names = ("realisation", *(r for r in references if r != "realisation"), "field_index", "grid")
    return read_product(path, "stars", names)


def of_image(stars: Product) -> bool:
    """Whether the stars are those of an image, not of a simulation."""
    return stars.config.get("source") == "stars"


def field_positions(stars: Product) -> np.ndarray:
    """Return the field position of each star, in steps of the field's grid, shape (n, 2).

    Of an image in pixels, NaN where its list does not say it, with two more columns: magnitude and
    colour of the bright star, which stay those of its noisy images.
    """
    if not of_image(stars):
        return np.asarray(stars["grid"][stars["field_index"]])
    place = places(stars["position"], stars["flux"], stars["colour"])
    return np.asarray(place[stars["field_index"]])


def star_area(stars: Product, train: np.ndarray) -> float:
    """Noise-equivalent area in pixels of the typical star, of which `train` are training images.

    Bright stars of an image have their own, A = (F / (σ S/N))², free of their noise.
    """
    if of_image(stars):
        return float(np.median((stars["noise"] * stars["snr"]) ** -2.0))
    return noise_equivalent_px(stars["realisation"][train])


def split_stars(stars: Product, kind: str, config: OfFit) -> Split:
    """Training, validation and test stars of a split.

    Raises
    ------
    ProductError
        If the file holds fewer stars than the config's parts need.
    """
    parts, count = config.parts, len(stars["field_index"])
    if kind == "held_out":
        return held_out_split(
            stars["field_index"], stars["grid"], parts.validation_fraction, config.seed
        )
    if parts.train_stars + parts.test_stars > count:
        raise ProductError(
            f"{stars.path}: holds {count} stars, but parts.train_stars + parts.test_stars = "
            f"{parts.train_stars + parts.test_stars}"
        )
    return random_split(
        count, parts.train_stars, parts.test_stars, parts.validation_fraction, config.seed
    )


def noise_model(config: WithNoise) -> NoiseModel:
    """The noise of a stage's config."""
    return NoiseModel(config.noise.kappa, config.noise.background_photons)


def noisy_test_images(config: OfFit, stars: Product, test: np.ndarray, level: float) -> np.ndarray:
    """Noisy images of test stars, numbers `test` of a product "stars", at one λ.

    The noise of a star depends on seed, set of stars, λ and star only. Datasets differ in
    set or λ, so that their columns are independent; methods, references, bounds and splits
    share it, so that what they make of a star is compared on one image.
    """
    of = stars.config.get("stars", {}).get("name", "own")
    rng = stream(config.seed, "noise", "test", of, f"{level:.6g}")
    return np.asarray(noise_model(config).draw(stars["realisation"], level, rng)[test])


def own_noise(
    stars: Product, images: np.ndarray, background: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the noise that stars of a product "stars" have themselves, in images of flux 1.

    Simulated stars have none.

    Parameters
    ----------
    stars : product "stars"
    images : ndarray, shape (n, d, d)
    background : float
        Photons of the sky in a pixel.

    Returns
    -------
    flux_error : ndarray, shape (n,)
        Of the sum of the pixels, by which stars have the flux 1, above a sky that is the median of
        the pixels around them.
    noise : ndarray, shape (n, d, d)
        σ of every pixel: of the sky's noise σ and the star's F = √B / σ photons.
    """
    if not of_image(stars):
        return np.zeros(len(images)), np.broadcast_to(np.float32(0.0), images.shape)
    noise = stars["noise"][stars["field_index"]]
    sigma = noise[:, None, None]
    square = sigma**2 + np.maximum(images, 0.0) * sigma / np.sqrt(background)
    # P pixels have the noise √P σ; the median of n pixels around them errs by √(π/2n) σ in each.
    pixels = images[0].size
    around = max(stars["wide"][0].size - pixels, 1)
    return noise * np.sqrt(pixels + np.pi / 2 * pixels**2 / around), np.sqrt(square)


def training_set(
    config: OfFit,
    kind: type[Method],
    stars: Product,
    split: str,
    reference: str,
    **more: Any,
) -> TrainingSet:
    """Return the training part of a split, with the noise of a configuration."""
    parts = split_stars(stars, split, config)
    if of_image(stars):
        more["own_noise"] = _own_noise(stars, config.noise.background_photons)
        if issubclass(kind, MeasuresStars):
            more |= {"bright": BrightStars.of_product(stars), "star": stars["field_index"]}
    else:
        more["simulation"] = stars.config
    return TrainingSet(
        images=stars["realisation"],
        references=stars[learnt(kind, reference)],
        fit=parts.fit,
        validation=parts.validation,
        levels=np.asarray(config.noise.levels),
        noise=noise_model(config),
        seed=config.seed,
        reference=reference,
        positions=field_positions(stars),
        **more,
    )


def fit_apart(kind: type[Method], data: TrainingSet, star: np.ndarray, config: Config) -> Method:
    """A fit that has learnt nothing from the validation stars, for methods that else do.

    Some stars of `fit` choose its settings instead; `star` says which images are of the same.
    """
    inner = np.isin(star[data.fit], np.unique(star[data.fit])[::INNER])
    some = replace(data, fit=data.fit[~inner], validation=data.fit[inner])
    return kind.fit(some, **kind.settings(config))


def _own_noise(stars: Product, background: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Noise of the bright stars of an image; its arrays are read if a method asks for it."""

    def own_noise(images: np.ndarray, mean: np.ndarray) -> np.ndarray:
        star = stars["field_index"]
        return OwnNoise(stars["noise"][star], background, stars["phase"], star)(images, mean)

    return own_noise
