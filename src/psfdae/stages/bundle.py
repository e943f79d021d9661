"""Stage `bundle`: a trained network with all that it takes to apply it, in one file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import psfdae
from psfdae.belonging import SAME_IMAGE, SAME_STARS, STARS, require_origin
from psfdae.configuration.compose import as_overrides
from psfdae.estimators import CONFIG
from psfdae.estimators.dae import WEIGHTS, Dae
from psfdae.files import Product, ProductError
from psfdae.own_stars import packing
from psfdae.own_stars.bundle import (
    Architecture,
    Bundle,
    BundleError,
    BundleInfo,
    creation_date,
    write_bundle,
)
from psfdae.own_stars.photometry import FluxModel
from psfdae.reading import read_yaml
from psfdae.rng import stream
from psfdae.stages.common import (
    limit_threads,
    noise_model,
    noisy_test_images,
    read_stars,
    split_stars,
)

SEEN_BY_TRAINING = ("seed", "noise", "parts")
"""Groups in which the configuration must be that of the training."""


def run(
    config: Any, stars: Path, dae: Path, split: str | None, name: str, licence: str, out: Path
) -> None:
    """Measure a network on the test stars of its split and write the bundle.

    The configuration inside the product "stars" says what kind of stamps they are:
    `telescope` holds `pixel_scale_arcsec`, and `diameter_m` and `wavelength_m` where
    the optics are known; `framing` holds `jitter_px` and `subpixel`; `source` is
    "stars" for those that are not simulated.

    Parameters
    ----------
    config : stage config (seed, noise, parts, evaluation)
    stars : product "stars" that the network was trained on
    dae : folder of a trained network
    split : "random" or "held_out"; None for that of the training
    name, licence : what the bundle says of itself
    out : path of the bundle

    Raises
    ------
    BundleError
        If the network was trained with another seed, noise, parts or split.
    ProductError
        If the configuration of the stars lacks what a bundle must know, or the network
        was trained on other stars.
    """
    limit_threads(config.evaluation.threads)
    trained = _trained(dae, config, split)
    product = read_stars(stars, trained["reference"])
    kind = _kind_of_stamps(product)
    require_origin(dae, (*STARS, *SAME_STARS, *SAME_IMAGE), product)
    network = _load(dae, kind["stamp_px"], config)
    parts = split_stars(product, trained["split"], config)
    images, references = product["realisation"], product[trained["reference"]]
    held_out = packing.HeldOutStars(images[parts.test], references[parts.test], noise_model(config))
    model = packing.leading(FluxModel.fit(images[parts.train]), packing.COMPONENTS)
    band = config.noise.kappa * np.asarray(config.noise.levels)
    errors = packing.measure_errors(
        held_out,
        network.predict,
        model,
        packing.noise_nodes(band),
        stream(config.seed, "noise", "bundle"),
    )
    reach = packing.reach(band, model.mean)
    metrics = packing.measure_levels(
        config.noise.levels,
        held_out,
        lambda level: noisy_test_images(config, held_out.images, level),
        network.predict,
        errors,
        reach["noise_equivalent_px"],
        config.evaluation.data_range,
    )
    info = BundleInfo(
        psfdae_version=psfdae.__version__,
        name=name,
        licence=licence,
        created=creation_date(),
        **kind,
        **reach,
        image_scale=network.factor,
        components=packing.COMPONENTS,
        training_sha256=packing.checksum(images[parts.train], references[parts.train]),
        training_stars=parts.train.size,
        dae=Architecture(**{key: trained["dae"][key] for key in ("kernels", "widths")}),
        config={
            "stars": product.config,
            "train": trained,
            "evaluation": config.evaluation.model_dump(),
        },
        metrics=metrics,
    )
    maps = (errors.nodes, errors.half_width(), errors.rms(), errors.distance_limit())
    write_bundle(Bundle(info, network.weights, model, *maps), out)


@dataclass(frozen=True)
class _Network:
    """A trained network as a function, its weights, and the factor of its images."""

    predict: packing.Predict
    weights: dict[str, np.ndarray]
    factor: float


def _trained(folder: Path, config: Any, split: str | None) -> dict[str, Any]:
    """Configuration of a training, if it is that of the stage."""
    for path in (folder / CONFIG, folder / WEIGHTS):
        if not path.is_file():
            raise BundleError(f"{path}: no such file; psfdae train writes it")
    trained = read_yaml(folder / CONFIG)
    lacking = {*SEEN_BY_TRAINING, "dae", "split", "reference"} - set(trained)
    if lacking:
        raise BundleError(f"{folder / CONFIG}: key {min(lacking)!r} is missing")
    asked = config.model_dump(include={*SEEN_BY_TRAINING}) | {"split": split or trained["split"]}
    _refuse_mismatch({key: trained[key] for key in asked}, asked, folder / CONFIG)
    return trained


def _refuse_mismatch(trained: dict[str, Any], asked: dict[str, Any], path: Path) -> None:
    found, wanted = ([word.strip("+") for word in as_overrides(t)] for t in (trained, asked))
    differing = sorted({*found} - {*wanted}) or sorted({*wanted} - {*found})
    if differing:
        key = differing[0].split("=")[0]
        other = next((word for word in wanted if word.startswith(f"{key}=")), f"no {key}")
        raise BundleError(
            f"{path}: the network was trained with {differing[0]}, "
            f"but the bundle is asked for with {other}"
        )


def _load(folder: Path, stamp_px: int, config: Any) -> _Network:
    from psfdae.models.dae import image_scale

    dae = Dae.load(folder, evaluation=config.evaluation)
    state = dae.network.state_dict()
    weights = {name: value.contiguous().numpy() for name, value in state.items()}
    return _Network(dae.predict, weights, image_scale(dae.settings.scale, stamp_px))


def _kind_of_stamps(product: Product) -> dict[str, Any]:
    """What the configuration of the stars says of their stamps."""
    config = product.config
    try:
        telescope, framing = config["telescope"], config["framing"]
        pixel = None
        if "diameter_m" in telescope:
            diffraction = telescope["wavelength_m"] / telescope["diameter_m"]
            pixel = float(np.deg2rad(telescope["pixel_scale_arcsec"] / 3600.0)) / diffraction
        return {
            "stamp_px": product["realisation"].shape[-1],
            "pixel_scale_arcsec": telescope["pixel_scale_arcsec"],
            "pixel_lambda_d": pixel,
            "jitter_px": framing["jitter_px"],
            "subpixel": framing.get("subpixel", False),
            "source": config.get("source", "simulated"),
        }
    except KeyError as error:
        raise ProductError(f"{product.path}: its configuration lacks {error}") from None
