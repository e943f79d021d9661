"""Calibration of a model's errors by stars that no training has seen.

In go a fitted method and noise-free held-out stars; out comes an `ErrorModel`. Each star gets noise
of every noise node, the method restores it, and the errors are counted: in each pixel where flux
and sky are stated, and over all pixels in each case of what had to be estimated. Errors of what
only the model makes, limits of outliers by the training stars themselves, and the noise with which
bright stars are measured best are found here, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from psfdae.base.progress import steps
from psfdae.base.rng import stream
from psfdae.denoise.bundle import Bundle
from psfdae.denoise.denoiser import SNR_TOLERANCE
from psfdae.denoise.error_model import (
    ErrorModel,
    Estimated,
    ModelErrors,
    at_noise,
    brightest,
    mahalanobis,
)
from psfdae.denoise.flux_model import FluxModel
from psfdae.denoise.star_model import StarModel
from psfdae.image.stamps import StarFlag
from psfdae.methods.interface import Method
from psfdae.training.star_sets import HeldOutStars, ModelStars

NODES = 8
"""Noise levels at which errors are measured, equidistant in the logarithm."""

COVERAGE = 0.6827
"""Part of the errors within a half-width; of a normal variable within ± 1 σ."""


@dataclass(frozen=True)
class StarErrors:
    """Errors of the PSFs of test stars of known flux and sky, at S nodes of noise.

    Attributes
    ----------
    nodes : ndarray, shape (S,)
        Pixel RMS over the flux.
    error : ndarray, shape (S, N, d, d), float32
        Moduli, as `HeldOutStars.errors` gives them.
    star : ndarray of int, shape (N,)
        Star of every error.
    distance : ndarray, shape (S, N)
        Mahalanobis distance of the noisy images.
    outlier_score : ndarray, shape (S, N), or None
        Outlier score of the noisy images, if the method has one.
    """

    nodes: np.ndarray
    error: np.ndarray
    star: np.ndarray
    distance: np.ndarray
    outlier_score: np.ndarray | None = None

    @classmethod
    def measure(
        cls,
        stars: HeldOutStars,
        fitted: Method,
        model: FluxModel,
        nodes: np.ndarray,
        components: int,
        rng: np.random.Generator,
    ) -> StarErrors:
        """Measure errors and distances of noisy test stars at nodes (S,), pixel RMS over the flux.

        Distances are along as many `components` of the flux model.
        """
        # Each star at each node of the noise; all are restored together.
        draws = [stars.draw(node, rng) for node in nodes]
        noisy, star = (np.concatenate(arrays) for arrays in zip(*draws, strict=True))
        noise = np.repeat(nodes, len(draws[0][1]))
        level = noise / stars.noise.kappa
        estimate = fitted.estimate(noisy, level, stars.position[star])
        # A method that scores stars by themselves does so in its form for estimated fluxes, as it
        # does for a user's stars.
        score = estimate.outlier_score
        if score is None:
            score = fitted.free_flux().outlier_score(noisy, level)
        # Errors in units of the method's σ, if it has one; distances with the noise of each star.
        error = stars.errors(estimate.psf, star, estimate.sigma).astype(np.float32)
        distance = mahalanobis(noisy, noise, model, components)
        shape = len(nodes), -1
        return cls(
            nodes,
            error.reshape(*shape, *stars.images.shape[1:]),
            draws[0][1],
            distance.reshape(shape),
            None if score is None else score.reshape(shape),
        )

    def of(self, is_selected: np.ndarray) -> StarErrors:
        """Return the errors of some of the stars, by a mask over stars; without their scores."""
        selected = is_selected[self.star]
        return StarErrors(
            self.nodes, self.error[:, selected], self.star[selected], self.distance[:, selected]
        )

    @cached_property
    def half_width(self) -> np.ndarray:
        """Half-width of the interval around 0 that holds 68.27 %, shape (S, d, d).

        At least a quarter of the root mean square: beside much noise of the stars' own, most errors
        in a pixel may be 0.
        """
        # Quantile and root mean square over the stars, for each node and pixel.
        quantile = np.stack([np.quantile(node, COVERAGE, axis=0) for node in self.error])
        rms = np.sqrt(np.stack([np.square(node).mean(axis=0) for node in self.error]))
        return np.asarray(np.maximum(quantile, 0.25 * rms))

    def ratio95(self) -> np.ndarray:
        """Return the half-width that holds 95 % of all pixels over that of 68 %, shape (S,)."""
        # One ratio for all pixels of a node: in units of their half-widths, errors of all pixels
        # are taken to have the same distribution.
        scaled = self.error / np.maximum(self.half_width, 1e-12)[:, None]
        return np.array([np.quantile(node, 0.95) for node in scaled], np.float64)

    def outlier_limit(self) -> np.ndarray | None:
        """Return the outlier score that 0.1 % of the stars exceed at every node, shape (S,).

        The excess over a node's median is taken to be as usual at all of them.
        """
        if self.outlier_score is None:
            return None
        # Scores are squares of distances; excesses are in units of the median absolute deviation,
        # so that all nodes together show the 0.1 % tail.
        few_star_limit = self._few_star_limit(np.sqrt(np.maximum(self.outlier_score, 0.0)))
        median = np.median(self.outlier_score, axis=1)
        spread = np.median(np.abs(self.outlier_score - median[:, None]), axis=1)
        excess = (self.outlier_score - median[:, None]) / np.maximum(spread, 1e-12)[:, None]
        limit = median + spread * np.quantile(excess, 0.999)
        return np.asarray(np.maximum(limit, np.square(few_star_limit)))

    def distance_limit(self) -> float:
        """Return the distance that 0.1 % of the stars exceed."""
        # Distances have the noise in their unit: those of all nodes count together.
        quantile = float(np.quantile(self.distance, 0.999))
        return max(quantile, float(self._few_star_limit(self.distance).max()))

    def _few_star_limit(self, distance: np.ndarray) -> np.ndarray:
        """Return the least limit (S,) of normal distances (S, N) of as few stars as there are.

        Few stars do not show what 0.1 % exceed: the limit is that of a further star beside n normal
        distances, mean + t (1 + 1/n)^½ σ with t of n − 1 degrees of freedom. It is 0 for a hundred
        or more, whose own quantile says it.
        """
        from scipy.stats import t

        # A star that is seen several times, with other noise, shows no more of what stars are like.
        count = len(np.unique(self.star))
        if count >= 100:
            return np.zeros(len(distance))
        factor = float(t.ppf(0.999, max(count - 1, 2))) * np.sqrt(1.0 + 1.0 / count)
        return np.asarray(distance.mean(axis=1) + factor * distance.std(axis=1))


def noise_nodes(band: np.ndarray) -> np.ndarray:
    """Return the noise levels at which errors are measured, ascending.

    They reach as far as stars go without a flag: fluxes are estimates, and half of the faintest
    stars look fainter than they are.
    """
    return np.geomspace(band.min() / SNR_TOLERANCE, band.max() * SNR_TOLERANCE, NODES)


def calibrated(
    bundle: Bundle, fitted: Method, stars: HeldOutStars, seed: int
) -> tuple[Bundle, StarErrors]:
    """Return the bundle with all that test stars say of its errors, and these errors."""
    # Errors of stars of known flux and sky, and limits of outliers.
    rng = stream(seed, "noise", "calibration", "errors")
    nodes, components = bundle.errors.noise, bundle.info.components
    errors = StarErrors.measure(stars, fitted, bundle.flux_model, nodes, components, rng)
    calibration = replace(
        ErrorModel.uncalibrated(nodes, errors.half_width),
        ratio95=errors.ratio95(),
        distance_limit=errors.distance_limit(),
        outlier_limit=errors.outlier_limit(),
        measured=bundle.errors.measured,
    )
    # With other noise, factors of these errors where flux, sky or noise are estimated.
    model = StarModel(replace(bundle, errors=calibration), fitted)
    rng = stream(seed, "noise", "calibration", "scales")
    return replace(bundle, errors=with_case_scales(model, stars, rng)), errors


def with_case_scales(model: StarModel, stars: HeldOutStars, rng: np.random.Generator) -> ErrorModel:
    """Return the errors of a model with what noise, flux, sky and brightness do to them.

    No training must have seen the stars: where noise is far below the errors that a method makes
    on other stars, those of the training do not tell.
    """
    # Noise as it is found, and factors, at each node; the last axis is that of the nodes.
    errors = model.bundle.errors
    nodes = errors.noise
    measured = [_scales_at(model, stars, node, rng) for node in steps("errors of fluxes", nodes)]
    noise, scale, flux_scale = (np.stack(values, axis=-1) for values in zip(*measured, strict=True))
    # Where a star has light that the photometry does not know, its noise is found too large: the
    # factors are those at the noise that was found.
    noise = np.maximum.accumulate(noise, axis=-1)
    for index in np.ndindex(scale.shape[:-1]):
        scale[index] = np.interp(nodes, noise[index[1], index[2]], scale[index])
    flux_scale = np.interp(nodes, noise[1, Estimated.FLUX_AND_SKY], flux_scale)
    # Errors of a method that measures stars were counted where the noise is estimated alone.
    if model.method.knows_field:
        scale[:, 0] = scale[:, 1]
    # Nodes first, as `ErrorModel` has them.
    scale68, scale95 = np.moveaxis(scale, -1, 1)
    return replace(errors, scale68=scale68, scale95=scale95, flux_scale=flux_scale)


def _scales_at(
    model: StarModel, stars: HeldOutStars, node: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return what the cases do to the errors of noisy test stars of one noise.

    Returns
    -------
    noise : ndarray, shape (2, 3)
        Median noise over the flux as it was found: noise stated or estimated; case of `Estimated`.
    scale : ndarray, shape (2, 2, 3, 2)
        Factors of half-widths that hold 68 and 95 %; the two axes of `noise`; faint or bright
        pixels.
    flux_scale : float
        Factor of the stated error of the flux, where all is estimated.
    """
    count = len(Estimated)
    noise, scale, flux_scale = np.full((2, count), node), np.ones((2, 2, count, 2)), 1.0
    # A method that measures stars needs no factor of their fluxes: for their pixels, which are
    # many, a third of the stars is enough in each case. Its errors are the same if noise is known.
    measures = model.method.knows_field
    step, noise_cases = (3, (True,)) if measures else (1, (False, True))
    # Rows are cases times images, once with stated noise and once without.
    noisy, star = stars.draw(node, rng)
    case, image = np.divmod(np.arange(0, count * len(star), step), len(star))
    is_estimated = np.repeat(noise_cases, len(case))
    case, image = np.tile(case, len(noise_cases)), np.tile(image, len(noise_cases))
    prediction = model.predict(
        noisy[image],
        flux=np.where(case < Estimated.FLUX, 1.0, np.nan),
        background=np.where(case < Estimated.FLUX_AND_SKY, 0.0, np.nan),
        noise=np.where(is_estimated, np.nan, node),
        position=stars.position[star[image]],
    )
    # Errors in units of what is stated without factors.
    is_finite = np.isfinite(prediction.psf).all(axis=(1, 2))
    error = stars.errors(prediction.psf, star[image], prediction.uncertainty)
    is_bright = brightest(prediction.psf)
    for index in np.ndindex(noise.shape):
        usable = is_finite & (is_estimated == index[0]) & (case == index[1])
        if not usable.any():
            continue
        noise[index] = np.median((prediction.noise / prediction.flux)[usable])
        # 95 % of errors are within no less than 68 % are, though a star alone has no errors.
        over_ratio = error[usable] / np.maximum(prediction.ratio95, 1.0)[usable, None, None]
        for brightness, pixels in enumerate((~is_bright[usable], is_bright[usable])):
            scale[0, *index, brightness] = np.quantile(error[usable][pixels], COVERAGE)
            scale[1, *index, brightness] = np.quantile(over_ratio[pixels], 0.95)
        # Pull of the flux, |F − 1| / σ_F: 95 % of a normal variable are within 1.96.
        if index == (1, Estimated.FLUX_AND_SKY) and not measures:
            flux_sigma = np.hypot(prediction.flux_error, stars.flux_error[star[image]])[usable]
            pull = np.abs(prediction.flux - 1.0)[usable] / flux_sigma
            flux_scale = float(np.quantile(pull, 0.95) / 1.96)
    return noise, scale, flux_scale


def with_training_stars(model: StarModel, stars: ModelStars) -> Bundle:
    """Return the bundle of a model with limits of outliers that training stars are not beyond.

    The noise of a training star is in the axes of the training, along which a star of the same
    noise is an outlier by as much as there are few of them. Training stars have less noise than the
    least node, of which the limit is that of all brighter stars.

    Parameters
    ----------
    model : StarModel
    stars : ModelStars
        Those of a simulation change nothing: they have no noise.
    """
    bundle, errors = model.bundle, model.bundle.errors
    if errors.outlier_limit is None or (bright := stars.bright) is None:
        return bundle
    # The stars as they are in the image, framed, with the flux 1.
    images, is_measured = bright.framed(bundle.info.stamp_px)
    images = np.where(is_measured, images, 0.0) / bright.flux[:, None, None]
    noise = bright.noise / bright.flux
    prediction = model.predict(images, noise=noise, background=0.0, position=bright.place)
    # All but 1 % of them, which may be unlike the others, and a margin for other pixels.
    score, distance = (
        1.1 * float(np.quantile(values[np.isfinite(values)], 0.99))
        if np.isfinite(values).any()
        else 0.0
        for values in (prediction.outlier_score, prediction.distance)
    )
    # The first node has the least noise, and its limit is that of all stars of less noise.
    outlier_limit = errors.outlier_limit.copy()
    outlier_limit[0] = max(outlier_limit[0], score)
    distance_limit = max(errors.distance_limit, distance)
    errors = replace(errors, outlier_limit=outlier_limit, distance_limit=distance_limit)
    return replace(bundle, errors=errors)


def with_model_errors(model: StarModel, fitted: Method, seed: int) -> Bundle:
    """Return the bundle of a model with the errors of measured stars that the model makes.

    Stars that are drawn by what the fit leaves open are measured with hardly any noise; what their
    stated errors lack is the model's.
    """
    bundle, rng = model.bundle, stream(seed, "noise", "calibration", "model")
    # S/N 2000 of a matched filter, where noise is far below the errors of most models.
    noise = 1.0 / (2000.0 * np.sqrt(bundle.info.noise_equivalent_px))
    # Measure stars of the fit's own law, of which flux, sky and centre are known: 1, 0 and drawn.
    images, position, centre = fitted.draw_stars(HeldOutStars.min_images, rng)
    noisy = images + noise * rng.normal(size=images.shape)
    prediction = model.predict(noisy, position=position)
    usable = (prediction.flags & (StarFlag.NO_FLUX | StarFlag.OUTLIER)) == 0
    # Drawn centres count from the middle of the stamp, fitted ones from its corner.
    centre = centre + images.shape[-1] // 2

    def lacking(off: np.ndarray, stated: np.ndarray) -> float:
        """√(e² − stated²) for the e within which 68 % of normal errors are, or 95 % within 1.96."""
        # e in units of what is stated, from both quantiles; the model's part of e² is the rest.
        ratio = np.abs(off) / stated
        scale = 0.5 * (np.quantile(ratio, COVERAGE) + np.quantile(ratio, 0.95) / 1.96)
        return float(np.median(stated) * np.sqrt(max(scale**2 - 1.0, 0.0)))

    # The errors of the flux, of the sky, and of the centre, both axes together.
    fitted_flux, *growth = fitted.fitted_flux_error()
    flux = lacking((prediction.flux - 1.0)[usable], prediction.flux_error[usable])
    # Light that a stamp of a bright star has more than its model is sky to one, flux to the other.
    sky = lacking(prediction.background[usable], prediction.background_error[usable])
    sky = max(sky, flux / images[0].size)
    off = np.concatenate([prediction.y_fit - centre[:, 0], prediction.x_fit - centre[:, 1]])
    stated = np.concatenate([prediction.y_error, prediction.x_error])
    usable_centres = np.concatenate([usable, usable])
    centre_error = lacking(off[usable_centres], stated[usable_centres])
    # Few fields are drawn: the error of the flux is not below that of a fit on a known sky.
    measured = ModelErrors(max(flux, fitted_flux), sky, centre_error, fitted_flux, *growth)
    return replace(bundle, errors=replace(bundle.errors, measured=measured))


def with_misfit(
    bundle: Bundle, fitted: Method, stars: HeldOutStars, rng: np.random.Generator
) -> Bundle:
    """Return the bundle with the noise over the flux with which bright stars are measured best.

    What the method does not know of a star's shape would pass for flux, if there is little noise
    beside it. Tried are none and the nodes of the noise, on stars that no training has seen.
    """
    if not fitted.finds_flux:
        return bundle
    info, nodes = bundle.info, bundle.errors.noise
    test_stars = replace(stars, images=stars.images[: stars.min_images])
    # Bright stars: the lower half of the noise nodes.
    noisy = [test_stars.draw(node, rng) for node in nodes[: len(nodes) // 2]]
    # Geometric mean over the nodes of the MSE of PSFs of flux 1, until it rises.
    log_mse: list[float] = []
    misfits = (0.0, *nodes)
    for misfit in misfits:
        # The same stars with another idea of the noise of the flux's estimate.
        tried_info = info.model_copy(update={"misfit": misfit})
        model = StarModel(replace(bundle, info=tried_info), fitted)
        logs = []
        for images, star in noisy:
            prediction = model.predict(images)
            psf = prediction.psf / prediction.flux[:, None, None]
            logs.append(np.log(np.nanmean(np.square(psf - stars.references[star]))))
        log_mse.append(float(np.mean(logs)))
        if log_mse[-1] > min(log_mse):
            break
    best_misfit = float(misfits[int(np.argmin(log_mse))])
    return replace(bundle, info=info.model_copy(update={"misfit": best_misfit}))


def crossed_coverage(errors: StarErrors) -> Callable[[np.ndarray, float], dict[str, float]]:
    """Return a function that tells how many errors are within half-widths of other stars.

    Parameters
    ----------
    errors : StarErrors
        Errors that give the half-widths.

    Returns
    -------
    callable
        Function of other errors of the same stars (n, d, d), each star once, and of their noise
        over the flux. It returns the parts `coverage68` and `coverage95` within the half-widths,
        for either half of the stars by those of the other half; nothing for a star alone.
    """
    # Stars that gave the half-widths would be covered too often: each half is judged by the other.
    count = 1 + int(errors.star.max())
    is_even = np.arange(count) % 2 == 0
    halves = []
    for half in (is_even, ~is_even) if count > 1 else ():
        other_half = errors.of(~half)
        width = other_half.half_width
        width95 = (width * other_half.ratio95()[:, None, None]).astype(width.dtype)
        halves.append((half, {"coverage68": width, "coverage95": width95}))

    # Each half by the map of the other half, at the noise that is asked for; then their mean.
    def covered(error: np.ndarray, noise: float) -> dict[str, float]:
        parts: dict[str, list[float]] = {}
        for half, widths in halves:
            for name, maps in widths.items():
                is_inside = error[half] <= at_noise(np.array([noise]), errors.nodes, maps)
                parts.setdefault(name, []).append(float(is_inside.mean()))
        return {name: float(np.mean(values)) for name, values in parts.items()}

    return covered
