"""Calibration of a model's errors on stars that no training has seen.

Inputs: a model whose errors are not calibrated, and its held-out and training stars. Output: an
`ErrorModel`, in five steps (`calibrate_errors`). Held-out stars are free of noise: each gets the
noise of every node, the method denoises it, and quantiles of the errors become half-widths.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from psfdae.base.progress import steps
from psfdae.base.rng import stream
from psfdae.denoise.denoiser import SNR_TOLERANCE
from psfdae.denoise.error_model import (
    ErrorModel,
    Estimated,
    ModelErrors,
    brightest,
    interpolate_at_noise,
    mahalanobis,
)
from psfdae.denoise.flux_model import FluxModel
from psfdae.denoise.prediction import Prediction
from psfdae.denoise.star_model import StarModel
from psfdae.image.stamps import StarFlag
from psfdae.methods.interface import FitError, Method
from psfdae.training.star_sets import HeldOutStars, ModelStars

NODES = 8
"""Noise levels at which errors are measured, equidistant in the logarithm."""

COVERAGE = 0.6827
"""Fraction of the errors within a half-width, as of a normal variable within ± 1 σ."""


@dataclass(frozen=True)
class StarErrors:
    """Errors of the PSFs of test stars of known flux and sky, at S nodes of noise.

    Attributes
    ----------
    nodes : ndarray, shape (S,)
        Pixel RMS over the flux.
    error : ndarray, shape (S, N, d, d), float32
        Absolute errors (`HeldOutStars.errors`) of N noisy images, in units of the method's σ of the
        pixel if it has one, else of the flux.
    star : ndarray of int, shape (N,)
        Index of the star of each image.
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
        method_fit: Method,
        model: FluxModel,
        nodes: np.ndarray,
        components: int,
        rng: np.random.Generator,
    ) -> StarErrors:
        """Measure errors and distances of noisy test stars at nodes (S,) of the noise.

        Nodes are the RMS of a pixel divided by the flux. Distances are along the leading
        `components` of the flux model.
        """
        # Each star at each node of the noise; all are denoised together. Few stars of an image are
        # drawn several times, half of which are enough for a method that knows the field: the
        # number of stars limits its half-widths, not the noise. Every star is drawn once at least,
        # as the images of stars come in turn.
        draws = [stars.draw(node, rng) for node in nodes]
        count = len(draws[0][1])
        if method_fit.knows_field:
            count = max(count // 2, stars.count_stars())
        draws = [(images[:count], star[:count]) for images, star in draws]
        noisy, star = (np.concatenate(arrays) for arrays in zip(*draws, strict=True))
        noise = np.repeat(nodes, count)
        level = noise / stars.noise.kappa
        estimate = method_fit.estimate(noisy, level, stars.position[star])
        # A method that scores stars by themselves does so in its form for estimated fluxes, as it
        # does for a user's stars.
        score = estimate.outlier_score
        if score is None:
            score = method_fit.free_flux().outlier_score(noisy, level)
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

    def select(self, is_selected: np.ndarray) -> StarErrors:
        """Return the errors of some of the stars, by a mask over stars; without their scores."""
        is_star_selected = is_selected[self.star]
        return StarErrors(
            self.nodes,
            self.error[:, is_star_selected],
            self.star[is_star_selected],
            self.distance[:, is_star_selected],
        )

    @cached_property
    def half_width68(self) -> np.ndarray:
        """Half-width of the interval around 0 that holds 68.27 %, shape (S, d, d).

        At least a quarter of the root mean square: after the stars' own noise is subtracted, most
        errors in a pixel may be 0.
        """
        # Quantile and root mean square over the stars, for each node and pixel.
        quantile = np.stack([np.quantile(node, COVERAGE, axis=0) for node in self.error])
        rms = np.sqrt(np.stack([np.square(node).mean(axis=0) for node in self.error]))
        return np.asarray(np.maximum(quantile, 0.25 * rms))

    def ratio95(self) -> np.ndarray:
        """Return the ratio of the half-widths that hold 95 and 68 % of all pixels, shape (S,)."""
        # One ratio for all pixels of a node: in units of their half-widths, errors of all pixels
        # are taken to have the same distribution.
        scaled_error = self.error / np.maximum(self.half_width68, 1e-12)[:, None]
        return np.array([np.quantile(node, 0.95) for node in scaled_error], np.float64)

    def outlier_limit(self) -> np.ndarray | None:
        """Return the outlier score that 0.1 % of the stars exceed at every node, shape (S,).

        Scores minus the median of their node, divided by their spread, are taken to have the same
        distribution at all nodes.
        """
        if self.outlier_score is None:
            return None
        # Scores are squares of distances, for which the limit of few stars is made. The excesses of
        # all nodes together, in units of the median absolute deviation, show the 0.1 % tail.
        few_star_limit = self._few_star_limit(np.sqrt(np.maximum(self.outlier_score, 0.0)))
        median = np.median(self.outlier_score, axis=1)
        spread = np.median(np.abs(self.outlier_score - median[:, None]), axis=1)
        excess = (self.outlier_score - median[:, None]) / np.maximum(spread, 1e-12)[:, None]
        limit = median + spread * np.quantile(excess, 0.999, method="weibull")
        return np.asarray(np.maximum(limit, np.square(few_star_limit)))

    def distance_limit(self) -> float:
        """Return the distance that 0.1 % of the stars exceed."""
        # A distance has the noise of its star in its unit: all nodes are used together.
        quantile = float(np.quantile(self.distance, 0.999, method="weibull"))
        return max(quantile, float(self._few_star_limit(self.distance).max()))

    def _few_star_limit(self, distance: np.ndarray) -> np.ndarray:
        """Return the smallest limit (S,) that distances (S, N) of n stars allow; 0 for n ≥ 100.

        Few stars do not show which distance 0.1 % exceed. If distances are normally distributed,
        one more star exceeds mean + t (1 + 1/n)^½ σ with this probability, where t is the quantile
        of Student's distribution of n − 1 degrees of freedom, at least 2.
        """
        from scipy.special import stdtrit

        # A star that is seen several times, with other noise, shows no more of what stars are like.
        count = len(np.unique(self.star))
        if count >= 100:
            return np.zeros(len(distance))
        factor = float(stdtrit(max(count - 1, 2), 0.999)) * np.sqrt(1.0 + 1.0 / count)
        return np.asarray(distance.mean(axis=1) + factor * distance.std(axis=1))


def noise_nodes(band: np.ndarray, gives_sigma: bool) -> np.ndarray:
    """Return the noise levels at which errors are measured, ascending.

    They cover the S/N of all stars without a flag, which is wider than the `band` of the training
    by a tolerance: fluxes are estimates, and half of the faintest stars look fainter than they are.
    Errors in units of a σ that the method gives change less with the noise than errors in units of
    the flux: three quarters of the nodes are enough.
    """
    count = 3 * NODES // 4 if gives_sigma else NODES
    return np.geomspace(band.min() / SNR_TOLERANCE, band.max() * SNR_TOLERANCE, count)


def calibrate_errors(
    model: StarModel, method_fit: Method, stars: ModelStars, seed: int
) -> tuple[ErrorModel, StarErrors]:
    """Calibrate the errors of a model on stars that its training has not seen.

    Parameters
    ----------
    model : StarModel
        Its errors are `ErrorModel.build_uncalibrated`.
    method_fit : Method
        The fit before it was packed, which draws stars of its own distribution.
    stars : ModelStars
        Held-out and training stars.
    seed : int
        Seed of the random streams of the steps.

    Returns
    -------
    errors : ErrorModel
    star_errors : StarErrors
        Errors of the held-out stars at the noise nodes.
    """
    held_out = stars.held_out
    # 1. Shape errors bias the flux of bright stars: the noise floor at which fluxes are measured.
    model = model.replace_errors(fit_noise_floor(model, held_out, seed))
    # 2. Errors of the PSF model itself, of stars that the method measures.
    model = model.replace_errors(fit_model_errors(model, method_fit, seed))
    # 3. Half-widths of 68 and 95 % for known flux and sky, and limits of outliers.
    errors, star_errors = fit_half_widths(model, held_out, seed)
    model = model.replace_errors(errors)
    # 4. Factors of the half-widths where noise, flux or sky are estimated.
    model = model.replace_errors(fit_case_scales(model, held_out, seed))
    # 5. Training stars of an image are not outliers.
    return fit_outlier_limits(model, stars), star_errors


def fit_noise_floor(model: StarModel, stars: HeldOutStars, seed: int) -> ErrorModel:
    """Return the errors of a model with the noise floor that minimises the MSE of bright stars.

    A method that finds fluxes takes what it does not know of a star's shape for flux where there is
    little noise. Tried are a floor of 0 and the noise nodes, until the MSE rises.

    Raises
    ------
    FitError
        If the model measures no star with any floor.
    """
    errors, method = model.bundle.errors, model.method
    if not method.finds_flux:
        return errors
    rng = stream(seed, "noise", "calibration", "misfit")
    test_stars = replace(stars, images=stars.images[: stars.min_images])
    # Bright stars: the lower half of the noise nodes.
    noisy = [test_stars.draw(node, rng) for node in errors.noise[: len(errors.noise) // 2]]
    # Geometric mean over the nodes of the MSE of PSFs of flux 1.
    log_mse: list[float] = []
    floors = (0.0, *errors.noise.tolist())
    for floor in floors:
        tried_model = model.replace_errors(replace(errors, noise_floor=floor))
        node_log_mse = []
        for images, star in noisy:
            prediction = tried_model.predict(images)
            psf = prediction.psf / prediction.flux[:, None, None]
            squares = np.square(psf - stars.references[star])
            # A floor with which no star has a flux is the worst one.
            has_flux = np.isfinite(squares).any()
            node_log_mse.append(np.log(np.nanmean(squares)) if has_flux else np.inf)
        log_mse.append(float(np.mean(node_log_mse)))
        if log_mse[-1] > min(log_mse):
            break
    if not np.isfinite(min(log_mse)):
        raise FitError(
            f"none of {len(test_stars.images)} held-out stars can be measured at the noise nodes "
            f"{', '.join(f'{node:.2g}' for node in errors.noise[: len(noisy)])}: the model has no "
            "usable PSF; more training stars may help"
        )
    return replace(errors, noise_floor=floors[int(np.argmin(log_mse))])


def fit_model_errors(model: StarModel, method_fit: Method, seed: int) -> ErrorModel:
    """Return the errors of a model with errors of flux, sky and centre due to the PSF.

    Stars that are drawn from the uncertainty of the fit are measured with hardly any noise: what
    the errors by noise do not explain is due to the model. A method that measures no stars has
    none.
    """
    errors = model.bundle.errors
    if not method_fit.knows_field:
        return errors
    rng = stream(seed, "noise", "calibration", "model")
    # S/N 2000 of a matched filter, where noise is far below the errors of most models.
    noise = 1.0 / (2000.0 * np.sqrt(model.info.noise_equivalent_px))
    # Stars of flux 1 on a sky of 0, with known centres.
    images, position, centre = method_fit.draw_stars(HeldOutStars.min_images, rng)
    noisy = images + noise * rng.normal(size=images.shape)
    prediction = model.predict(noisy, position=position)
    usable = (prediction.flags & (StarFlag.NO_FLUX | StarFlag.OUTLIER)) == 0
    if not usable.any():
        raise FitError(
            f"none of {len(usable)} stars drawn from the fitted field can be measured: it has no "
            "usable PSF; more training stars, or a lower order of the field, may help"
        )
    # Drawn centres count from the middle of the stamp, fitted ones from its corner.
    centre = centre + images.shape[-1] // 2

    def compute_excess(offset: np.ndarray, sigma: np.ndarray) -> float:
        """Return √(e² − σ²), where e is the scatter of the offsets and σ their median error.

        e/σ is the mean of two estimates: the 68 % quantile of |offset|/σ of each star, and the 95 %
        quantile divided by 1.96. It is 0 where σ explains the scatter.
        """
        # e/σ, and σ √((e/σ)² − 1).
        ratio = np.abs(offset) / sigma
        scale = 0.5 * (np.quantile(ratio, COVERAGE) + np.quantile(ratio, 0.95) / 1.96)
        return float(np.median(sigma) * np.sqrt(max(scale**2 - 1.0, 0.0)))

    # The errors of the flux, of the sky, and of the centre, both axes together.
    fitted_flux, *growth_over_field = method_fit.estimate_flux_error()
    flux = compute_excess((prediction.flux - 1.0)[usable], prediction.flux_error[usable])
    # What the model of a bright star lacks may be fitted as flux or as an even sky: the error of
    # the sky, summed over the stamp, is not below the error of the flux.
    sky = compute_excess(prediction.background[usable], prediction.background_error[usable])
    sky = max(sky, flux / images[0].size)
    offset = np.concatenate([prediction.y_fit - centre[:, 0], prediction.x_fit - centre[:, 1]])
    sigma = np.concatenate([prediction.y_error, prediction.x_error])
    usable_centres = np.concatenate([usable, usable])
    centre_error = compute_excess(offset[usable_centres], sigma[usable_centres])
    # Few fields are drawn: the flux error is not below the error of a fit on a known sky.
    model_errors = ModelErrors(
        max(flux, fitted_flux), sky, centre_error, fitted_flux, *growth_over_field
    )
    return replace(errors, model_errors=model_errors)


def fit_half_widths(
    model: StarModel, stars: HeldOutStars, seed: int
) -> tuple[ErrorModel, StarErrors]:
    """Return the errors of a model with half-widths and limits of outliers, and the stars' errors.

    Flux and sky of the stars are known. All factors of the half-widths are 1 (`fit_case_scales`).
    """
    errors = model.bundle.errors
    rng = stream(seed, "noise", "calibration", "errors")
    star_errors = StarErrors.measure(
        stars, model.method, model.bundle.flux_model, errors.noise, model.info.components, rng
    )
    errors = replace(
        errors,
        half_width68=star_errors.half_width68,
        ratio95=star_errors.ratio95(),
        scale68=np.ones_like(errors.scale68),
        scale95=np.ones_like(errors.scale95),
        distance_limit=star_errors.distance_limit(),
        outlier_limit=star_errors.outlier_limit(),
    )
    return errors, star_errors


def fit_case_scales(model: StarModel, stars: HeldOutStars, seed: int) -> ErrorModel:
    """Return the errors of a model with their factors where noise, flux or sky are estimated.

    Factors depend on the case, on the noise and on the brightness of a pixel.
    """
    errors, rng = model.bundle.errors, stream(seed, "noise", "calibration", "scales")
    nodes, count = errors.noise, len(Estimated)
    # A method that measures stars needs no factor of their fluxes: for their pixels, which are
    # many, a sixth of the images is enough in each case. Its errors are the same if noise is known.
    fraction, noise_cases = (1 / 6, (True,)) if model.method.knows_field else (1.0, (False, True))
    # Rows of a node are cases times images, once with the noise given and once without. The images
    # of a case are drawn: every sixth one would be of the same few stars, which come in turn.
    draws = [stars.draw(node, rng) for node in nodes]
    star = draws[0][1]
    size = int(np.ceil(fraction * len(star)))
    case = np.repeat(np.arange(count), size)
    image = np.concatenate([np.sort(rng.permutation(len(star))[:size]) for _ in range(count)])
    is_estimated = np.repeat(noise_cases, len(case))
    case, image = np.tile(case, len(noise_cases)), np.tile(image, len(noise_cases))
    # As many nodes at a time as fit in memory.
    parts = min(-(-len(nodes) * len(case) * stars.images[0].size // 2**20), len(nodes))
    node_results = []
    for part in steps("errors of fluxes", np.array_split(np.arange(len(nodes)), parts)):
        cases = np.tile(case, len(part))
        prediction = model.predict(
            np.concatenate([draws[node][0][image] for node in part]),
            flux=np.where(cases < Estimated.FLUX, 1.0, np.nan),
            background=np.where(cases < Estimated.FLUX_AND_SKY, 0.0, np.nan),
            noise=np.where(
                np.tile(is_estimated, len(part)), np.nan, np.repeat(nodes[part], len(case))
            ),
            position=np.tile(stars.position[star[image]], (len(part), 1)),
        )
        for number, node in enumerate(part):
            node_prediction = prediction.of(slice(number * len(case), (number + 1) * len(case)))
            node_results.append(
                _scales_at(
                    node_prediction, model, stars, nodes[node], star[image], case, is_estimated
                )
            )
    # Noise as the photometry estimates it, and factors; the last axis of all arrays is the node.
    noise, scale, flux_scale = (
        np.stack(values, axis=-1) for values in zip(*node_results, strict=True)
    )
    # Where a star has light that the photometry does not know, its noise estimate is too large: the
    # factors are given at the estimates.
    noise = np.maximum.accumulate(noise, axis=-1)
    for index in np.ndindex(scale.shape[:-1]):
        scale[index] = np.interp(nodes, noise[index[1], index[2]], scale[index])
    flux_scale = np.interp(nodes, noise[1, Estimated.FLUX_AND_SKY], flux_scale)
    # Errors of a method that measures stars were only counted where the noise is estimated too.
    if model.method.knows_field:
        scale[:, 0] = scale[:, 1]
    # 68 and 95 % apart, and nodes first, as `ErrorModel` has them.
    scale68, scale95 = np.moveaxis(scale, -1, 1)
    return replace(errors, scale68=scale68, scale95=scale95, flux_scale=flux_scale)


def _scales_at(
    prediction: Prediction,
    model: StarModel,
    stars: HeldOutStars,
    node: float,
    star: np.ndarray,
    case: np.ndarray,
    is_estimated: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the factors of the errors of noisy test stars of one noise, for each case.

    Parameters
    ----------
    prediction : Prediction
        Predictions of n noisy test stars of flux 1.
    model : StarModel
        Model of these predictions.
    stars : HeldOutStars
        Test stars.
    node : float
        RMS of a pixel over the flux.
    star : ndarray of int, shape (n,)
        Star of each image.
    case : ndarray of int, shape (n,)
        Case of `Estimated`.
    is_estimated : ndarray of bool, shape (n,)
        True where the noise is estimated, too.

    Returns
    -------
    noise : ndarray, shape (2, 3)
        Median noise estimate over the flux: noise given or estimated; case of `Estimated`.
    scale : ndarray, shape (2, 2, 3, 2)
        Factors of half-widths that hold 68 and 95 %; the two axes of `noise`; faint or bright
        pixels.
    flux_scale : float
        Factor of the error of the flux, where all is estimated.
    """
    count = len(Estimated)
    noise, scale, flux_scale = np.full((2, count), node), np.ones((2, 2, count, 2)), 1.0
    # Errors in units of the half-widths without factors.
    is_finite = np.isfinite(prediction.psf).all(axis=(1, 2))
    error = stars.errors(prediction.psf, star, prediction.uncertainty)
    is_bright = brightest(prediction.psf)
    for index in np.ndindex(noise.shape):
        usable = is_finite & (is_estimated == index[0]) & (case == index[1])
        if not usable.any():
            continue
        noise[index] = np.median((prediction.noise / prediction.flux)[usable])
        # The 95 % half-width is not below the 68 % one; of a single star without errors, the ratio
        # is 0.
        over_ratio = error[usable] / np.maximum(prediction.ratio95, 1.0)[usable, None, None]
        for brightness, pixels in enumerate((~is_bright[usable], is_bright[usable])):
            scale[0, *index, brightness] = np.quantile(error[usable][pixels], COVERAGE)
            scale[1, *index, brightness] = np.quantile(over_ratio[pixels], 0.95)
        # Pull of the flux, |F − 1| / σ_F: 95 % of a normal variable are within 1.96.
        if index == (1, Estimated.FLUX_AND_SKY) and not model.method.knows_field:
            flux_sigma = np.hypot(prediction.flux_error, stars.flux_error[star])[usable]
            pull = np.abs(prediction.flux - 1.0)[usable] / flux_sigma
            flux_scale = float(np.quantile(pull, 0.95) / 1.96)
    return noise, scale, flux_scale


def fit_outlier_limits(model: StarModel, stars: ModelStars) -> ErrorModel:
    """Return the errors of a model with limits of outliers above 99 % of its training stars.

    The axes of the training contain the noise of few training stars, so that other stars of the
    same noise look like outliers. Training stars have less noise than the lowest node, whose limit
    applies to all brighter stars: it becomes at least 1.1 times the 99 % quantile of the training
    stars. Simulated stars are noise-free, and change nothing.
    """
    errors = model.bundle.errors
    if errors.outlier_limit is None or (bright := stars.bright) is None:
        return errors
    # The stars as they are in the image, framed, with the flux 1.
    images, is_measured = bright.cut_frames(model.info.stamp_px)
    images = np.where(is_measured, images, 0.0) / bright.flux[:, None, None]
    noise = bright.noise / bright.flux
    prediction = model.predict(images, noise=noise, background=0.0, position=bright.coordinates)
    # All but 1 % of them, which may be unlike the others, and a margin for other pixels.
    score, distance = (
        1.1 * float(np.quantile(values[np.isfinite(values)], 0.99))
        if np.isfinite(values).any()
        else 0.0
        for values in (prediction.outlier_score, prediction.distance)
    )
    # The first node has the least noise, and its limit holds for all stars of less noise.
    outlier_limit = errors.outlier_limit.copy()
    outlier_limit[0] = max(outlier_limit[0], score)
    distance_limit = max(errors.distance_limit, distance)
    return replace(errors, outlier_limit=outlier_limit, distance_limit=distance_limit)


def cross_validate_coverage(errors: StarErrors) -> Callable[[np.ndarray, float], dict[str, float]]:
    """Return a function that counts errors within half-widths calibrated on other stars.

    Parameters
    ----------
    errors : StarErrors
        Errors that give the half-widths.

    Returns
    -------
    callable
        Function of other errors of the same stars (n, d, d), each star once, and of their noise
        divided by the flux. It returns the fractions `coverage68` and `coverage95` of errors within
        the half-widths, the mean over both halves of the stars; nothing for a single star.
    """
    # Stars that gave the half-widths would be covered too often: each half is judged by the other.
    count = 1 + int(errors.star.max())
    halves = []
    for parity in (0, 1) if count > 1 else ():
        other_half = errors.select(np.arange(count) % 2 != parity)
        width = other_half.half_width68
        width95 = (width * other_half.ratio95()[:, None, None]).astype(width.dtype)
        halves.append((parity, {"coverage68": width, "coverage95": width95}))

    # Each half by the map of the other half, at the noise that is asked for; then their mean.
    def measure_coverage(error: np.ndarray, noise: float) -> dict[str, float]:
        coverages: dict[str, list[float]] = {}
        for parity, widths in halves:
            for name, maps in widths.items():
                is_inside = error[parity::2] <= interpolate_at_noise(
                    np.array([noise]), errors.nodes, maps
                )
                coverages.setdefault(name, []).append(float(is_inside.mean()))
        return {name: float(np.mean(values)) for name, values in coverages.items()}

    return measure_coverage
