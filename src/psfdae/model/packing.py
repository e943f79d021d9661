"""Errors of a fitted method on test stars, which its bundle states.

Errors are per pixel and per noise level. They are not normally distributed: the core
of a PSF, its wings and the rare star that is unlike all others share a pixel, and the
root mean square is then wider than the interval that holds 68 % of the errors. A
bundle carries both, and by how much the interval that holds 95 % is wider. Where a
method says how sure it is of every pixel, all of them are in units of that: they
correct its σ, which knows the star, by what came true.

All this is for known flux and sky, and for all pixels alike. Where these are estimates, errors are
larger, and where a star is bright they are of another distribution: factors per node, for the
brightest pixels and for the others, make up for it (`with_scales`).
"""

from __future__ import annotations

import hashlib
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np

from psfdae.bright_stars import BrightStars
from psfdae.bundle_info import BundleInfo
from psfdae.files import Product, ProductError
from psfdae.image.stamps import StarFlag
from psfdae.method import (
    DrawsStars,
    Estimate,
    FindsFlux,
    MeasuresStars,
    Method,
    ScoresOutliers,
)
from psfdae.methods import method
from psfdae.model.bundle import (
    Bundle,
    BundleError,
    ModelErrors,
    at_noise,
    brightest,
    creation_date,
    estimator,
    mahalanobis,
)
from psfdae.model.flux_model import FluxModel, signal_to_noise
from psfdae.model.psf_model import PsfModel
from psfdae.model.restoration import SNR_TOLERANCE
from psfdae.model.star_sets import (
    field_positions,
    noise_model,
    noisy_test_images,
    of_image,
    own_noise,
    split_stars,
    star_area,
)
from psfdae.model.wings import Wings
from psfdae.noise import NoiseModel
from psfdae.progress import steps
from psfdae.rng import stream
from psfdae.settings import OfTest
from psfdae.version import __version__

NODES = 8  # noise levels at which errors are measured, equidistant in the logarithm
COMPONENTS = 48  # leading eigenvectors that a bundle stores
COVERAGE = 0.6827  # part of the errors within ± `error68`; of a normal variable within ± 1 σ
COVERAGE95 = 0.95  # part of them within ± `error68` times `ratio95`
LEAST_SIGMA = 1e-12  # of the flux; equal stars leave a method no doubt
CASES = 3  # of what is known of stars: their flux and sky, their sky, or neither
HIDDEN = 0.25  # of a pixel's RMS error, which its `error68` has at least
NORMAL_RATIO95 = 1.96  # σ within which a normal variable has as much
LIMIT = 0.999  # part of the test stars within the limit of the Mahalanobis distance
STEPS = 64  # of the noise up to that of the flux in every pixel, of a model that is to be small
FEW_STARS = 250  # noisy images per node, at least; fewer test stars are seen several times

Restore = Callable[[np.ndarray, float], Estimate]
"""The method: normalised noisy images (n, d, d) of a noise level λ to PSFs."""


@dataclass(frozen=True)
class HeldOutStars:
    """Noise-free stars of flux 1 that no training has seen, (n, d, d), noise, and places (n, 2).

    The places of an image's stars have magnitudes and colours, too, (n, 4). These stars are not
    free of noise: `own_noise` (n, d, d) is in their pixels, and makes their flux, which is taken to
    be 1, uncertain by `flux_error` (n,).
    """

    images: np.ndarray
    references: np.ndarray
    noise: NoiseModel
    position: np.ndarray
    flux_error: np.ndarray
    own_noise: np.ndarray

    @classmethod
    def of(
        cls, stars: Product, reference: str, noise: NoiseModel, test: np.ndarray
    ) -> HeldOutStars:
        """Return some stars of a product "stars", by their indices."""
        truth = stars[reference]
        doubts = own_noise(stars, truth, noise.background)
        arrays = (stars["realisation"], truth, field_positions(stars), *doubts)
        images, references, position, *of_test = (array[test] for array in arrays)
        return cls(images, references, noise, position, *of_test)

    def errors(self, psf: np.ndarray, star: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return moduli of the errors of PSFs of some stars, less the stars' own noise, at least 0.

        Quantiles above the own noise are those of errors to noise-free stars; means are larger.
        """
        square = np.square(psf - self.references[star]) - np.square(self.own_noise[star])
        return np.asarray(np.sqrt(np.maximum(square, 0.0)))


@dataclass(frozen=True)
class Errors:
    """Errors of the PSFs of test stars at S nodes of noise, as `errors_of` gives them."""

    nodes: np.ndarray  # (S,), pixel RMS over the flux
    error: np.ndarray  # (S, N, d, d), float32, moduli
    star: np.ndarray  # (N,), of every error
    distance: np.ndarray  # (S, N), Mahalanobis', of the noisy images
    outlier_score: np.ndarray | None = None  # (S, N), if the method has one

    def of(self, is_selected: np.ndarray) -> Errors:
        """Return the errors of some of the stars, by a mask over stars."""
        selected = is_selected[self.star]
        return Errors(
            self.nodes, self.error[:, selected], self.star[selected], self.distance[:, selected]
        )

    @cached_property
    def half_width(self) -> np.ndarray:
        """Half-width of the interval around 0 that holds 68.27 %, shape (S, d, d).

        At least `HIDDEN` of the root mean square: beside much noise of the stars' own, most
        errors in a pixel may be 0.
        """
        holds = np.stack([np.quantile(np.abs(node), COVERAGE, axis=0) for node in self.error])
        return np.asarray(np.maximum(holds, HIDDEN * self.rms()))

    def ratio95(self) -> np.ndarray:
        """Return the half-width that holds 95 % of all pixels over that of 68 %, shape (S,)."""
        scaled = np.abs(self.error) / np.maximum(self.half_width, LEAST_SIGMA)[:, None]
        return np.array([np.quantile(node, COVERAGE95) for node in scaled], np.float64)

    def rms(self) -> np.ndarray:
        """Return the root mean square per pixel, shape (S, d, d)."""
        return np.asarray(np.sqrt(np.stack([np.square(node).mean(axis=0) for node in self.error])))

    def strange_limit(self) -> np.ndarray | None:
        """Return the outlier score that 0.1 % of the stars exceed at every node, shape (S,).

        The excess over a node's median is taken to be as usual at all of them. Few stars do not
        show what 0.1 % exceed: the limit is at least that of a further star beside n normal √score,
        mean + t (1 + 1/n)^½ σ with t of n − 1 degrees of freedom.
        """
        if self.outlier_score is None:
            return None
        few_star_limit = np.square(self._of_few(np.sqrt(np.maximum(self.outlier_score, 0.0))))
        median = np.median(self.outlier_score, axis=1)
        spread = np.median(np.abs(self.outlier_score - median[:, None]), axis=1)
        excess = (self.outlier_score - median[:, None]) / np.maximum(spread, 1e-12)[:, None]
        return np.asarray(np.maximum(median + spread * np.quantile(excess, LIMIT), few_star_limit))

    def distance_limit(self) -> float:
        """Return the distance that 0.1 % of the stars exceed; as high as few stars ask for."""
        quantile = float(np.quantile(self.distance, LIMIT))
        return max(quantile, float(self._of_few(self.distance).max()))

    def _of_few(self, distance: np.ndarray) -> np.ndarray:
        """Return the limit (S,) of normal distances (S, N) that knows how few stars it rests on.

        0 for a hundred or more, whose own quantile says it.
        """
        from scipy.stats import t

        count = len(np.unique(self.star))
        if count >= 100:
            return np.zeros(len(distance))
        factor = float(t.ppf(LIMIT, max(count - 1, 2))) * np.sqrt(1.0 + 1.0 / count)
        return np.asarray(distance.mean(axis=1) + factor * distance.std(axis=1))


@dataclass(frozen=True)
class StarFacts:
    """Facts on the stars of a training that a bundle states, whatever was fitted to them.

    Attributes
    ----------
    info : mapping
        Fields of its `BundleInfo`, as plain values.
    flux_model : FluxModel
        Of the training stars.
    held_out : HeldOutStars
    levels : ndarray
        Noise levels λ of the training.
    seed : int
        Of the training.
    """

    info: Mapping[str, Any]
    flux_model: FluxModel
    held_out: HeldOutStars
    levels: np.ndarray
    seed: int

    @classmethod
    def of(
        cls, stars: Product, reference: str, config: Any, trained: Mapping[str, Any]
    ) -> StarFacts:
        """Return the facts of a product "stars"; the rest is as in `model_of`."""
        stamps, parts = _kind_of_stamps(stars), split_stars(stars, trained["split"], config)
        images, references = stars["realisation"], stars[reference]
        noise, levels = noise_model(config), np.asarray(config.noise.levels)
        info = {
            **stamps,
            **reach(noise.kappa * levels, star_area(stars, parts.train)),
            "components": COMPONENTS,
            "training_sha256": checksum(images[parts.train], references[parts.train]),
            "training_stars": _trained_on(stars, parts.train),
            "config": {"stars": stars.config, "train": dict(trained)},
        }
        held_out = HeldOutStars.of(stars, reference, noise, parts.test)
        model = leading(FluxModel.fit(images[parts.train]), COMPONENTS)
        return cls(info, model, held_out, levels, config.seed)


def without_errors(
    fitted: Method,
    facts: StarFacts,
    reference: str,
    name: str,
    licence: str,
    largest_mb: float | None = None,
) -> Bundle:
    """Return a fit with all that it takes to apply it, but its errors; raises as `model_of`."""
    band, stamp_px = facts.held_out.noise.kappa * facts.levels, facts.info["stamp_px"]
    arrays, packed_fields = packed(
        fitted, stamp_px, float(band.min()), 1e6 * (largest_mb or np.inf)
    )
    info = BundleInfo(
        psfdae_version=__version__,
        name=name,
        licence=licence,
        created=creation_date(),
        metrics=[],
        **facts.info,
        **(packed_fields or {"method": fitted.name, "reference": reference}),
    )
    nodes = noise_nodes(band)
    nothing = np.zeros((nodes.size, stamp_px, stamp_px), np.float32)
    bundle = Bundle(
        info, arrays, facts.flux_model, nodes, nothing, nothing, np.ones(nodes.size), 0.0
    )
    return with_misfit(bundle, facts.held_out, stream(facts.seed, "noise", "calibration", "misfit"))


def model_of(
    fitted: Method,
    stars: Product,
    reference: str,
    config: OfTest,
    trained: Mapping[str, Any],
    name: str,
    licence: str,
    largest_mb: float | None = None,
) -> PsfModel:
    """Return the model of a fit, with its errors on test stars and all that it takes to apply it.

    Parameters
    ----------
    fitted : Method
    stars : product "stars", of which the fit is
    reference : "realisation" or "template", which is restored
    config : settings (seed, noise, parts, evaluation)
    trained : mapping
        Settings of the fit, and its "split".
    name, licence : str
    largest_mb : float, optional
        Size of the arrays, for which a mixture leaves out fine axes.

    Raises
    ------
    BundleError
        If it cannot be that small.
    """
    facts = StarFacts.of(stars, reference, config, trained)
    bundle = without_errors(fitted, facts, reference, name, licence, largest_mb)
    held_out = facts.held_out
    unpacked = estimator(bundle)  # what it errs as packed
    if isinstance(fitted, DrawsStars):
        bundle = with_model_errors(PsfModel(bundle, unpacked), fitted, config.seed)
    bundle, errors = calibrated(bundle, unpacked, held_out, config.seed)
    if of_image(stars) and bundle.strange_limit is not None:
        train = np.unique(stars["field_index"][split_stars(stars, trained["split"], config).train])
        bright = BrightStars.of_product(stars).of(train)
        bundle = with_training_stars(PsfModel(bundle, unpacked), bright)
    test = split_stars(stars, trained["split"], config).test
    metrics = measure_levels(
        config.noise.levels,
        held_out,
        lambda level: noisy_test_images(config, stars, test, level),
        lambda noisy, level: unpacked.estimate(noisy, level, held_out.position),
        errors,
        bundle.info.noise_equivalent_px,
        config.evaluation.data_range,
    )
    settings = {**bundle.info.config, "evaluation": config.evaluation.model_dump()}
    info = bundle.info.model_copy(update={"metrics": metrics, "config": settings})
    return PsfModel(replace(bundle, info=info), unpacked)


def _trained_on(product: Product, train: np.ndarray) -> int:
    """Return the number of training stars; each star of an image is in several of its images."""
    return len(np.unique(product["field_index"][train])) if of_image(product) else len(train)


def _kind_of_stamps(product: Product) -> dict[str, Any]:
    """Return the keys of a bundle on stamps, from the configuration of the stars."""
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


def packed(
    fitted: Method, stamp_px: int, noise: float, largest: float
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return arrays of a fit for this noise, or for the least above it that takes few bytes.

    Raises
    ------
    BundleError
        If it takes more than the largest number of bytes in any case.
    """
    noises = np.geomspace(noise, max(1.0, noise), STEPS)

    @cache
    def arrays_of(step: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        return fitted.pack(stamp_px, float(noises[step]))

    def is_small(step: int) -> bool:
        return sum(array.nbytes for array in arrays_of(step)[0].values()) <= largest

    # Mostly the first one will do, and each takes a while.
    least_step = 0 if is_small(0) else bisect_left(range(STEPS), True, key=is_small)
    if least_step == STEPS:
        raise BundleError(f"{fitted.look.label}: takes more than {largest / 1e6:.2g} MB")
    return arrays_of(least_step)


def noise_nodes(band: np.ndarray) -> np.ndarray:
    """Return the noise levels at which errors are measured, ascending.

    They reach as far as stars go without a flag: fluxes are estimates, and half of the faintest
    stars look fainter than they are.
    """
    return np.geomspace(band.min() / SNR_TOLERANCE, band.max() * SNR_TOLERANCE, NODES)


def leading(model: FluxModel, components: int) -> FluxModel:
    """Return the model with the variance beyond its leading eigenvectors spread evenly."""
    variance = model.variance.copy()
    trailing = variance[: variance.size - components]
    if trailing.size:
        trailing[:] = trailing.sum() / trailing.size
    return replace(model, variance=variance)


def reach(band: np.ndarray, area: float) -> dict[str, float]:
    """Return the range of noise and S/N of a training from its noise levels and its stars' area."""
    least_noise, greatest_noise = float(band.min()), float(band.max())
    return {
        "noise_min": least_noise,
        "noise_max": greatest_noise,
        "snr_min": signal_to_noise(greatest_noise, area),
        "snr_max": signal_to_noise(least_noise, area),
        "noise_equivalent_px": area,
    }


def measure_errors(
    stars: HeldOutStars,
    fitted: Method,
    model: FluxModel,
    nodes: np.ndarray,
    rng: np.random.Generator,
) -> Errors:
    """Measure errors and distances of noisy test stars at nodes (S,), pixel RMS over the flux."""
    # Each star at each node of the noise; all are restored together.
    draws = [_noisy(stars, node, rng) for node in nodes]
    noisy, star = (np.concatenate(arrays) for arrays in zip(*draws, strict=True))
    noise = np.repeat(nodes, len(draws[0][1]))
    level = noise / stars.noise.kappa
    estimate = fitted.estimate(noisy, level, stars.position[star])
    score, free_flux = estimate.outlier_score, fitted.free_flux()
    if score is None and isinstance(free_flux, ScoresOutliers):
        score = free_flux.outlier_score(noisy, level)
    error = errors_of(estimate, stars, star).astype(np.float32)
    distance = mahalanobis(noisy, noise, model, COMPONENTS)
    shape = len(nodes), -1
    return Errors(
        nodes,
        error.reshape(*shape, *stars.images.shape[1:]),
        draws[0][1],
        distance.reshape(shape),
        None if score is None else score.reshape(shape),
    )


def errors_of(
    estimate: Estimate, stars: HeldOutStars, star: np.ndarray | slice = slice(None)
) -> np.ndarray:
    """Return moduli of errors (n, d, d), in units of σ if the method says it, else of the flux."""
    error = stars.errors(estimate.psf, star)
    return error if estimate.sigma is None else error / np.maximum(estimate.sigma, LEAST_SIGMA)


def calibrated(
    bundle: Bundle, fitted: Method, stars: HeldOutStars, seed: int
) -> tuple[Bundle, Errors]:
    """Return the bundle with all that test stars say of its errors, and these errors."""
    rng = stream(seed, "noise", "calibration", "errors")
    errors = measure_errors(stars, fitted, bundle.flux_model, bundle.noise_nodes, rng)
    uncalibrated = replace(
        bundle,
        error68=errors.half_width,
        rms=errors.rms(),
        distance_limit=errors.distance_limit(),
        ratio95=errors.ratio95(),
        strange_limit=errors.strange_limit(),
        scale68=None,
        scale95=None,
        flux_error_scale=None,
    )
    rng = stream(seed, "noise", "calibration", "scales")
    return with_scales(PsfModel(uncalibrated, fitted), stars, rng), errors


def with_scales(model: PsfModel, stars: HeldOutStars, rng: np.random.Generator) -> Bundle:
    """Return the bundle of a model with what flux, sky and brightness do to its errors.

    No training must have seen the stars: where noise is far below the errors that a method makes
    on other stars, those on its own do not tell.
    """
    bundle, measures = model.bundle, isinstance(model.method, MeasuresStars)
    nodes, shape = bundle.noise_nodes, (2, CASES)  # the noise is known, or estimated
    noise = np.tile(nodes, (*shape, 1))
    width, of_flux = np.ones((2, *shape, 2, len(nodes))), np.ones(len(nodes))
    # A method that measures stars needs no factor of their fluxes: for their pixels, which are
    # many, a third of the stars is enough in each case. Its errors are the same if noise is known.
    every, kinds = (3, (True,)) if measures else (1, (False, True))
    for place, node in enumerate(steps("errors of fluxes", nodes)):
        noisy, star = _noisy(stars, node, rng)
        case, image = np.divmod(np.arange(0, CASES * len(star), every), len(star))
        estimated = np.repeat(kinds, len(case))
        case, image = np.tile(case, len(kinds)), np.tile(image, len(kinds))
        prediction = model.predict(
            noisy[image],
            flux=np.where(case == 0, 1.0, np.nan),
            background=np.where(case <= 1, 0.0, np.nan),
            noise=np.where(estimated, np.nan, node),
            position=stars.position[star[image]],
        )
        finite = np.isfinite(prediction.psf).all(axis=(1, 2))
        error = stars.errors(prediction.psf, star[image])
        error /= np.maximum(prediction.uncertainty, LEAST_SIGMA)
        bright = brightest(prediction.psf)
        for index in np.ndindex(shape):
            usable = finite & (estimated == index[0]) & (case == index[1])
            if not usable.any():
                continue
            noise[*index, place] = np.median((prediction.noise / prediction.flux)[usable])
            # 95 % of errors are within no less than 68 % are, though a star alone has no errors.
            over_ratio = error[usable] / np.maximum(prediction.ratio95, 1.0)[usable, None, None]
            for pixels, kind in ((~bright[usable], 0), (bright[usable], 1)):
                width[0, *index, kind, place] = np.quantile(error[usable][pixels], COVERAGE)
                width[1, *index, kind, place] = np.quantile(over_ratio[pixels], COVERAGE95)
            if index == (1, CASES - 1) and not measures:
                doubt = np.hypot(prediction.flux_error, stars.flux_error[star[image]])[usable]
                off = np.abs(prediction.flux - 1.0)[usable] / doubt
                of_flux[place] = np.quantile(off, COVERAGE95) / NORMAL_RATIO95
    # Where a star has light that the photometry does not know, its noise is found too large.
    noise = np.maximum.accumulate(noise, axis=-1)
    for index in np.ndindex(width.shape[:-1]):
        _, *case_index, _ = index
        width[index] = np.interp(nodes, noise[tuple(case_index)], width[index])
    if measures:
        width[:, 0] = width[:, 1]
    scale68, scale95 = np.moveaxis(width, -1, 1)
    return replace(
        bundle,
        scale68=scale68,
        scale95=scale95,
        flux_error_scale=np.interp(nodes, noise[1, -1], of_flux),
    )


def with_training_stars(model: PsfModel, stars: BrightStars) -> Bundle:
    """Return the bundle of a model with a limit of outliers that training stars are not beyond.

    The noise of a training star is in the axes of the training, along which a star of the same
    noise is an outlier by as much as there are few of them. Training stars have less noise than the
    least node, of which the limit is that of all brighter stars.
    """
    bundle = model.bundle
    if bundle.strange_limit is None or not len(stars):
        return bundle
    images, is_measured = stars.framed(bundle.info.stamp_px)
    images = np.where(is_measured, images, 0.0) / stars.flux[:, None, None]
    noise = stars.noise / stars.flux
    prediction = model.predict(images, noise=noise, background=0.0, position=stars.place)
    score = prediction.outlier_score[np.isfinite(prediction.outlier_score)]
    limit = bundle.strange_limit.copy()
    if score.size:
        # All but 1 % of them, which may be unlike the others, and a margin for other pixels.
        limit[0] = max(limit[0], 1.1 * float(np.quantile(score, 0.99)))
    distance = prediction.distance[np.isfinite(prediction.distance)]
    distance_limit = 1.1 * float(np.quantile(distance, 0.99)) if distance.size else 0.0
    return replace(
        bundle, strange_limit=limit, distance_limit=max(bundle.distance_limit, distance_limit)
    )


def with_model_errors(model: PsfModel, fitted: DrawsStars, seed: int) -> Bundle:
    """Return the bundle of a model with the errors of measured stars that the model makes.

    Stars that are drawn by what the fit leaves open are measured with hardly any noise; what their
    stated errors lack is the model's.
    """
    bundle, rng = model.bundle, stream(seed, "noise", "calibration", "model")
    # S/N 2000 of a matched filter, where noise is far below the errors of most models.
    noise = 1.0 / (2000.0 * np.sqrt(bundle.info.noise_equivalent_px))
    images, position, centre = fitted.draw_stars(FEW_STARS, rng)
    noisy = images + noise * rng.normal(size=images.shape)
    prediction = model.predict(noisy, position=position)
    usable = (prediction.flags & (StarFlag.NO_FLUX | StarFlag.OUTLIER)) == 0
    centre = centre + images.shape[-1] // 2

    def lacking(off: np.ndarray, stated: np.ndarray) -> float:
        """√(e² − stated²) for the e within which 68 % of normal errors are, or 95 % within 1.96."""
        ratio = np.abs(off) / stated
        scale = 0.5 * (
            np.quantile(ratio, COVERAGE) + np.quantile(ratio, COVERAGE95) / NORMAL_RATIO95
        )
        return float(np.median(stated) * np.sqrt(max(scale**2 - 1.0, 0.0)))

    fitted_flux, growth = fitted.fitted_flux_error()
    flux = lacking((prediction.flux - 1.0)[usable], prediction.flux_error[usable])
    # Light that a stamp of a bright star has more than its model is sky to one, flux to the other.
    sky = lacking(prediction.background[usable], prediction.background_error[usable])
    sky = max(sky, flux / images[0].size)
    off = np.concatenate([prediction.y_fit - centre[:, 0], prediction.x_fit - centre[:, 1]])
    stated = np.concatenate([prediction.y_error, prediction.x_error])
    usable_centres = np.concatenate([usable, usable])
    centre_error = lacking(off[usable_centres], stated[usable_centres])
    # Few fields are drawn: the error of the flux is not below that of a fit on a known sky.
    errors = ModelErrors(max(flux, fitted_flux), sky, centre_error, fitted_flux, growth)
    info = bundle.info
    settings = info.config | {"model_errors": errors._asdict()}
    return replace(bundle, info=info.model_copy(update={"config": settings}))


def with_wings(bundle: Bundle, wings: Wings) -> Bundle:
    """Return the bundle of a field model with the light of stars beyond their stamps."""
    info = bundle.info
    settings = info.config | {"wings": wings.plain()}
    return replace(bundle, info=info.model_copy(update={"config": settings}))


def with_misfit(bundle: Bundle, stars: HeldOutStars, rng: np.random.Generator) -> Bundle:
    """Return the bundle with the noise over the flux with which bright stars are measured best.

    What the method does not know of a star's shape would pass for flux, if there is little noise
    beside it. Tried are none and the nodes of the noise, on stars that no training has seen.
    """
    if not issubclass(method(bundle.info.method), FindsFlux):
        return bundle
    nodes, errors = bundle.noise_nodes, []
    names = ("images", "references", "position")
    test_stars = replace(stars, **{name: getattr(stars, name)[:FEW_STARS] for name in names})
    noisy = [_noisy(test_stars, node, rng) for node in nodes[: len(nodes) // 2]]
    noises = (0.0, *nodes)
    for value in noises:
        model = PsfModel(replace(bundle, info=bundle.info.model_copy(update={"misfit": value})))
        restored = [(model.predict(images), stars.references[star]) for images, star in noisy]
        logs = [
            np.log(np.nanmean(np.square(t.psf / t.flux[:, None, None] - truth)))
            for t, truth in restored
        ]
        errors.append(float(np.mean(logs)))
        if errors[-1] > min(errors):
            break
    best_noise = float(noises[int(np.argmin(errors))])
    return replace(bundle, info=bundle.info.model_copy(update={"misfit": best_noise}))


def _noisy(
    stars: HeldOutStars, noise: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return at least `FEW_STARS` noisy images (n, d, d) of flux 1, and their stars, (n,)."""
    star = np.resize(np.arange(len(stars.images)), max(len(stars.images), FEW_STARS))
    return stars.noise.draw(stars.images[star], noise / stars.noise.kappa, rng), star


def measure_levels(
    levels: Sequence[float],
    stars: HeldOutStars,
    draw: Callable[[float], np.ndarray],
    restore: Restore,
    errors: Errors,
    area: float,
    data_range: float,
) -> list[dict[str, float]]:
    """Measure errors of the test stars at noise levels λ, and what `errors` at the nodes cover.

    `draw` gives noisy images of all test stars at a λ; `area` is the noise-equivalent one
    in pixels, `data_range` that of `psfdae.metrics.all_metrics`.
    """
    from psfdae.metrics import all_metrics

    rows, halves = [], crossed_maps(errors, len(stars.images))
    for level in levels:
        noisy, noise = draw(level), stars.noise.kappa * level
        estimate = restore(noisy, level)
        quality = all_metrics(estimate.psf, stars.references, data_range)
        rows.append(
            {
                "noise_level": level,
                "noise": noise,
                "snr": signal_to_noise(noise, area),
                "mse_noisy": float(np.square(noisy - stars.references).mean()),
                **{name: float(values.mean()) for name, values in quality.items()},
                **crossed_coverage(halves, errors.nodes, errors_of(estimate, stars), noise),
                "stars": len(noisy),
            }
        )
    return rows


def coverage(error: np.ndarray, noise: np.ndarray, nodes: np.ndarray, maps: np.ndarray) -> float:
    """Return the part of the errors (n, d, d) within ± the map at the noise of each star (n,)."""
    return float((np.abs(error) <= at_noise(noise, nodes, maps)).mean())


def crossed_maps(errors: Errors, count: int) -> list[tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Return either half of so many stars, bool (count,), with maps (S, d, d) of the other half.

    They are named by what they are to cover: `coverage68` the half-width, `coverage95` the wider
    one and `coverage_rms` the root mean square.
    """
    is_even = np.arange(count) % 2 == 0
    halves = []
    for half in (is_even, ~is_even) if count > 1 else ():
        other_half = errors.of(~half)
        half_width = other_half.half_width
        half_width95 = (half_width * other_half.ratio95()[:, None, None]).astype(half_width.dtype)
        maps = {
            "coverage68": half_width,
            "coverage95": half_width95,
            "coverage_rms": other_half.rms(),
        }
        halves.append((half, maps))
    return halves


def crossed_coverage(
    halves: Sequence[tuple[np.ndarray, Mapping[str, np.ndarray]]],
    nodes: np.ndarray,
    error: np.ndarray,
    noise: float,
) -> dict[str, float]:
    """Return the coverage of either half of the stars by the `crossed_maps` of the other half.

    `error` (n, d, d) holds every star once, at `noise`; the maps are those at the `nodes` (S,).
    """
    parts: dict[str, list[float]] = {}
    for half, of in halves:
        level = np.full(int(half.sum()), noise)
        for name, maps in of.items():
            parts.setdefault(name, []).append(coverage(error[half], level, nodes, maps))
    return {name: float(np.mean(values)) for name, values in parts.items()}


def checksum(images: np.ndarray, references: np.ndarray) -> str:
    """Return the SHA-256 of training stars and of what was to be learnt from them."""
    digest = hashlib.sha256()
    for array in (images, references):
        digest.update(f"{array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
