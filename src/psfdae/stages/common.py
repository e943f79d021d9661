"""What stages share: scene, threads, stars, their parts and their noise."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.files import Column, Product, ProductError, atomic_path, read_product
from psfdae.own_stars.photometry import noise_equivalent_px
from psfdae.rng import stream
from psfdae.stars.fields import Split, held_out_split, random_split
from psfdae.stars.noise import NoiseModel

DPI = 150
"""Pixels per inch of a figure."""


class OutputError(ValueError):
    """A result would take the place of what it is made of."""


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Any]) -> None:
    """Refuse outputs that are inputs, too; what is no path of a file is passed over.

    Raises
    ------
    OutputError
    """
    given = {Path(name).resolve() for name in inputs if isinstance(name, str | Path)}
    for out in outputs:
        if out is not None and out.resolve() in given:
            raise OutputError(f"{out}: is an input, too; choose another name")


def write_png(figure: Any, out: Path) -> None:
    """Write a matplotlib figure atomically; the same figure gives the same bytes."""
    with atomic_path(out) as temporary:
        # The temporary name ends in .tmp; the default metadata names matplotlib's version.
        figure.savefig(temporary, format="png", dpi=DPI, metadata={"Software": None})


def scene_of(config: Any) -> Any:
    """The scene of a stage's config."""
    from psfdae.stars.scenes import SCENES

    return SCENES[config.scene.name](config.grid, config.telescope, config.wavefront)


def template_wavefronts(config: Any) -> Any:
    """Static wavefronts of all fields of a stage's scene."""
    return scene_of(config).templates()


def star_wavefronts(config: Any, star_field: np.ndarray) -> Any:
    """Wavefronts of stars with random aberrations, `star_field` the field of each."""
    return scene_of(config).stars(config.stars, star_field, config.seed)


def drawn_columns(source: Any) -> dict[str, Column]:
    """What the stars' random aberrations were, as products keep it."""
    return {name: Column(values, "wave", about) for name, (values, about) in source.drawn.items()}


def limit_threads(threads: int) -> None:
    """Use this many threads for linear algebra, whatever the environment says.

    Results depend on it in the last digits, so it comes from the config.
    """
    from threadpoolctl import threadpool_limits

    threadpool_limits(threads)


def read_stars(path: Path, *references: str) -> Product:
    """Stars with their noise-free images, fields and the references asked for."""
    names = ("realisation", *(r for r in references if r != "realisation"), "field_index", "grid")
    return read_product(path, "stars", names)


def field_positions(stars: Product) -> np.ndarray:
    """Where each star stands, shape (n, 2): in steps of the field's grid, or pixels of an image.

    NaN where an image's list does not say it.
    """
    if stars.config.get("source") == "stars":
        return read_product(stars.path, "stars", ("position",))["position"][stars["field_index"]]
    return stars["grid"][stars["field_index"]]


def star_area(stars: Product, train: np.ndarray) -> float:
    """Noise-equivalent area in pixels of the typical star, of which `train` are training images.

    Bright stars of an image have their own, A = (F / (σ S/N))², free of their noise.
    """
    if stars.config.get("source") == "stars":
        known = read_product(stars.path, "stars", ("noise", "snr"))
        return float(np.median((known["noise"] * known["snr"]) ** -2.0))
    return noise_equivalent_px(stars["realisation"][train])


def split_stars(stars: Product, kind: str, config: Any) -> Split:
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


def noise_model(config: Any) -> NoiseModel:
    """The noise of a stage's config."""
    return NoiseModel(config.noise.kappa, config.noise.background_photons)


def noisy_test_images(config: Any, stars: Product, test: np.ndarray, level: float) -> np.ndarray:
    """Noisy images of test stars, numbers `test` of a product "stars", at one λ.

    The noise of a star depends on seed, set of stars, λ and star only. Datasets differ in
    set or λ, so that their columns are independent; methods, references, bounds and splits
    share it, so that what they make of a star is compared on one image.
    """
    of = stars.config.get("stars", {}).get("name", "own")
    rng = stream(config.seed, "noise", "test", of, f"{level:.6g}")
    return noise_model(config).draw(stars["realisation"], level, rng)[test]
