"""Packing of a fit: a model with its errors on test stars and all that it takes to apply it.

Inputs: a fitted method and the product "stars" that it was fitted to. Output: a `StarModel`, which
is saved as a bundle. Errors of the model are found in `psfdae.training.calibration`.
"""

from __future__ import annotations

import hashlib
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from psfdae.base.files import Product, ProductError
from psfdae.base.settings import OfTest
from psfdae.base.version import __version__
from psfdae.denoise.bundle import Bundle, BundleError, creation_date, estimator
from psfdae.denoise.error_model import ErrorModel
from psfdae.denoise.flux_model import FluxModel, signal_to_noise
from psfdae.denoise.star_model import StarModel
from psfdae.methods.bundle_info import BundleInfo
from psfdae.methods.interface import Estimate, Method
from psfdae.methods.metrics import all_metrics
from psfdae.psf.wings import Wings
from psfdae.training.calibration import (
    StarErrors,
    calibrate_errors,
    cross_validate_coverage,
    noise_nodes,
)
from psfdae.training.star_sets import HeldOutStars, ModelStars, noisy_test_images


def build_model(
    method_fit: Method,
    stars: Product,
    reference: str,
    config: OfTest,
    training_config: Mapping[str, Any],
    name: str,
    licence: str,
    largest_mb: float | None = None,
    estimates: dict[float, tuple[Method, np.ndarray, Estimate]] | None = None,
) -> StarModel:
    """Return the model of a fit, with its errors on test stars and all that it takes to apply it.

    Parameters
    ----------
    method_fit : Method
        Fit to these stars.
    stars : product "stars"
        Stars of the fit.
    reference : "realisation" or "template"
        Target of the denoising.
    config : settings (seed, noise, parts, evaluation)
        Settings by which the model is tested.
    training_config : mapping
        Settings of the fit, and its "split".
    name, licence : str
        Name and licence of the model.
    largest_mb : float, optional
        Size of the arrays, for which a mixture leaves out fine axes.
    estimates : dict, optional
        Receives the model's method, the noisy test stars and its estimate of them by noise level λ.

    Raises
    ------
    BundleError
        If it cannot be that small.
    """
    bundle, model_stars = build_uncalibrated(
        method_fit, stars, reference, config, training_config, name, licence, largest_mb
    )
    return calibrate_model(bundle, method_fit, stars, model_stars, config, estimates)


def calibrate_model(
    bundle: Bundle,
    method_fit: Method,
    stars: Product,
    model_stars: ModelStars,
    config: OfTest,
    estimates: dict[float, tuple[Method, np.ndarray, Estimate]] | None = None,
) -> StarModel:
    """Return the model of a bundle with its errors on test stars.

    Parameters
    ----------
    bundle, model_stars
        Results of `build_uncalibrated`.
    method_fit, stars, config, estimates
        As for `build_model`.
    """
    # Errors are measured with the arrays as the bundle stores them.
    model = StarModel(bundle, estimator(bundle))
    errors, star_errors = calibrate_errors(model, method_fit, model_stars, config.seed)
    # Metrics of test stars at the noise levels of the configuration.
    noisy = (
        (level, noisy_test_images(config, stars, model_stars.test, level))
        for level in config.noise.levels
    )
    area, data_range = bundle.info.noise_equivalent_px, config.evaluation.data_range
    held_out = model_stars.held_out
    estimates = {} if estimates is None else estimates
    metrics = metrics_by_level(
        model.method, held_out, noisy, star_errors, area, data_range, estimates
    )
    # The model as it is written: with errors, and a description that has them.
    settings = {**bundle.info.config, "evaluation": config.evaluation.model_dump()}
    info = bundle.info.model_copy(update={"metrics": metrics, "config": settings})
    return StarModel(replace(bundle, info=info, errors=errors), model.method)


def build_uncalibrated(
    method_fit: Method,
    stars: Product,
    reference: str,
    config: Any,
    training_config: Mapping[str, Any],
    name: str,
    licence: str,
    largest_mb: float | None = None,
    components: int = 48,
) -> tuple[Bundle, ModelStars]:
    """Return a fit with all that it takes to apply it, but its errors, and the stars for these.

    Parameters are as for `build_model`; of the settings, seed, noise and parts are enough.
    `components` is the number of leading eigenvectors of the flux model that the bundle stores.

    Returns
    -------
    bundle : Bundle
        Its errors are 0, and fluxes are measured as if the method knew every shape.
    model_stars : ModelStars
        Training stars of the fit, and test stars, by which the errors are to be calibrated.
    """
    stamp_fields = _stamp_fields(stars)
    stamp_px = stamp_fields["stamp_px"]
    model_stars = ModelStars.select(stars, training_config["split"], reference, config)
    images, noise = model_stars.images, model_stars.held_out.noise
    # The flux model, its variance beyond the leading eigenvectors spread evenly.
    flux_model = leading(FluxModel.fit(images), components)
    # Range of noise, as pixel RMS over the flux, and of S/N.
    band, area = noise.kappa * np.asarray(config.noise.levels), model_stars.noise_equivalent_px
    least_noise, greatest_noise = float(band.min()), float(band.max())
    arrays, method_fields = pack(method_fit, stamp_px, least_noise, 1e6 * (largest_mb or np.inf))
    # Everything that is needed to apply the method, and to know what it was trained on.
    info = BundleInfo(
        psfdae_version=__version__,
        name=name,
        licence=licence,
        created=creation_date(),
        **stamp_fields,
        kappa=noise.kappa,
        noise_min=least_noise,
        noise_max=greatest_noise,
        snr_min=float(f"{signal_to_noise(greatest_noise, area):.6g}"),
        snr_max=float(f"{signal_to_noise(least_noise, area):.6g}"),
        noise_equivalent_px=area,
        components=components,
        training_sha256=checksum(images, model_stars.references),
        training_stars=len(model_stars.stars),
        method=method_fit.name,
        reference=reference,
        **method_fields,
        config={"stars": stars.config, "train": dict(training_config)},
        metrics=[],
    )
    # Errors are 0 until they are measured.
    nodes = noise_nodes(band, method_fit.knows_field)
    blank = np.zeros((nodes.size, stamp_px, stamp_px), np.float32)
    bundle = Bundle(info, arrays, flux_model, ErrorModel.build_uncalibrated(nodes, blank))
    return bundle, model_stars


def _stamp_fields(product: Product) -> dict[str, Any]:
    """Return the keys of a bundle on stamps, from the configuration of the stars.

    Raises
    ------
    ProductError
        If the description of the stars lacks a key.
    """
    config = product.config
    try:
        # Simulated stars have a telescope with a diameter; of an image, only its scale is known.
        telescope, framing = config["telescope"], config["framing"]
        # Width of a pixel in λ/D, if the aperture is known.
        pixel_lambda_d = None
        if "diameter_m" in telescope:
            diffraction = telescope["wavelength_m"] / telescope["diameter_m"]
            pixel_rad = float(np.deg2rad(telescope["pixel_scale_arcsec"] / 3600.0))
            pixel_lambda_d = pixel_rad / diffraction
        return {
            "stamp_px": product["realisation"].shape[-1],
            "pixel_scale_arcsec": telescope["pixel_scale_arcsec"],
            "pixel_lambda_d": pixel_lambda_d,
            "jitter_px": framing["jitter_px"],
            "subpixel": framing.get("subpixel", False),
            "source": config.get("source", "simulated"),
        }
    except KeyError as error:
        raise ProductError(f"{product.path}: its configuration lacks {error}") from None


def pack(
    method_fit: Method, stamp_px: int, noise: float, largest: float
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return arrays of a fit for this noise, or for the least larger noise that takes few bytes.

    Parameters
    ----------
    method_fit : Method
        Fitted method.
    stamp_px : int
        Side of the stamps.
    noise : float
        Least pixel RMS over the flux that the arrays are for.
    largest : float
        Bytes of the arrays at most.

    Returns
    -------
    arrays : dict of ndarray
        Arrays of the method, by name.
    fields : dict
        Fields of `BundleInfo` that describe them.

    Raises
    ------
    BundleError
        If it takes more than the largest number of bytes in any case.
    """
    # Steps of the noise up to a noise as large as the flux, in every pixel.
    count = 64
    # Axes that are finer than the noise cannot be seen: the more noise, the fewer bytes.
    noises = np.geomspace(noise, max(1.0, noise), count)

    @cache
    def pack_at_step(step: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        return method_fit.export(stamp_px, float(noises[step]))

    def is_small(step: int) -> bool:
        return sum(array.nbytes for array in pack_at_step(step)[0].values()) <= largest

    # Mostly the first one will do, and each takes a while.
    least_step = 0 if is_small(0) else bisect_left(range(count), True, key=is_small)
    if least_step == count:
        raise BundleError(f"{method_fit.look.label}: takes more than {largest / 1e6:.2g} MB")
    return pack_at_step(least_step)


def leading(model: FluxModel, components: int) -> FluxModel:
    """Return the model with the variance beyond its leading eigenvectors spread evenly.

    Parameters
    ----------
    model : FluxModel
        With a full basis; eigenvalues ascend.
    components : int
        Number of leading eigenvectors whose variance stays.
    """
    variance = model.variance.copy()
    trailing = variance[: variance.size - components]
    if trailing.size:
        trailing[:] = trailing.sum() / trailing.size
    return replace(model, variance=variance)


def add_wings(bundle: Bundle, wings: Wings) -> Bundle:
    """Return the bundle of a field model with the light of stars beyond their stamps."""
    info = bundle.info
    # As plain numbers in the description.
    settings = info.config | {"wings": wings.plain()}
    return replace(bundle, info=info.model_copy(update={"config": settings}))


def metrics_by_level(
    method_fit: Method,
    stars: HeldOutStars,
    noisy: Iterable[tuple[float, np.ndarray]],
    errors: StarErrors,
    area: float,
    data_range: float,
    estimates: dict[float, tuple[Method, np.ndarray, Estimate]],
) -> list[dict[str, float]]:
    """Measure errors of the test stars at noise levels λ, and what `errors` at the nodes cover.

    Parameters
    ----------
    method_fit : Method
        Fitted method, as the bundle stores it.
    stars : HeldOutStars
        Test stars.
    noisy : iterable of (float, ndarray)
        Each λ with noisy images of all test stars, shape (n, d, d).
    errors : StarErrors
        Errors of the same stars at the noise nodes.
    area : float
        Noise-equivalent area of a typical star, in pixels.
    data_range : float
        Range of values of the metrics (`psfdae.methods.metrics.all_metrics`).
    estimates : dict
        Receives the method, the noisy images and its estimate of them by λ.

    Returns
    -------
    list of dict
        A row of mean metrics for each level, in their order.
    """
    # Coverage is measured crosswise: on stars by the errors that the other stars show.
    rows, measure_coverage = [], cross_validate_coverage(errors)
    for level, images, estimate in estimate_levels(method_fit, noisy, stars.position):
        noise = stars.noise.kappa * level
        estimates[level] = method_fit, images, estimate
        # Errors of the restored stars, and of the noisy images as a reference.
        quality = all_metrics(estimate.psf, stars.references, data_range)
        rows.append(
            {
                "noise_level": level,
                "noise": noise,
                "snr": signal_to_noise(noise, area),
                "mse_noisy": float(np.square(images - stars.references).mean()),
                **{name: float(values.mean()) for name, values in quality.items()},
                **measure_coverage(stars.errors(estimate.psf, unit=estimate.sigma), noise),
                "stars": len(images),
            }
        )
    return rows


def estimate_levels(
    method_fit: Method, noisy: Iterable[tuple[float, np.ndarray]], position: np.ndarray
) -> Iterator[tuple[float, np.ndarray, Estimate]]:
    """Yield each noise level λ, its noisy images of all stars, and the estimate of a method.

    Parameters are as for `metrics_by_level`, and `position` (n, 2) or (n, 4) of its stars.
    """
    if not method_fit.knows_field:
        for level, images in noisy:
            yield level, images, method_fit.estimate(images, level, position)
        return
    # Each node of a field model takes a time that does not depend on the number of stars: the test
    # stars of an image, which are few, are estimated at all levels together.
    levels, stacks = zip(*noisy, strict=True)
    star_level, repeated_position = (
        np.repeat(levels, len(position)),
        np.tile(position, (len(levels), 1)),
    )
    estimate = method_fit.estimate(np.concatenate(stacks), star_level, repeated_position)
    parts = estimate.split(len(position))
    yield from zip(levels, stacks, parts, strict=True)


def checksum(images: np.ndarray, references: np.ndarray) -> str:
    """Return the SHA-256 of training stars and of the reference images of these.

    Parameters
    ----------
    images, references : ndarray, shape (n, d, d)
        Type, shape and bytes of both count.
    """
    # Arrays of the same bytes but another type or shape are different.
    digest = hashlib.sha256()
    for array in (images, references):
        digest.update(f"{array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
