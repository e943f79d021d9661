"""Restoration of stars by a model bundle: from stamps to PSFs with errors and flags.

Each star goes through three steps, and no star influences another one:

1. `Restorer._centred`: the star is moved to the middle of its stamp, and its flux, sky and noise
   are found by the mean PSF of the training (`psfdae.model.photometry`).
2. The method restores its PSF: `Restorer._by_own_fluxes` for a method that measures flux, sky and
   centre itself (`psfdae.methods.field`), `Restorer._by_photometry` for all others.
3. `Restorer._prediction`: half-widths of the errors, χ², light beyond the stamp, shape and flags.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from psfdae.bright_stars import magnitude
from psfdae.image.stamps import (
    Stamps,
    StarFlag,
    border_median,
    border_scatter,
    cut,
    displacement,
    raise_flag,
)
from psfdae.method import (
    FindsFlux,
    KnowsField,
    MeasuresStars,
    Method,
    Packing,
    ScoresOutliers,
)
from psfdae.model.bundle import Bundle, ModelErrors, at_noise, brightest, mahalanobis
from psfdae.model.flux_model import FAINT_SNR, MIN_GOOD_PIXELS, NOISE_FLOOR
from psfdae.model.photometry import Photometer, Photometry
from psfdae.model.prediction import Prediction, measured_of, unmeasured
from psfdae.model.wings import Wings, outer_shares
from psfdae.moments import measure_shapes

SNR_TOLERANCE = 1.25
"""Factor by which a star may be beyond the S/N of the training: its S/N is no better known."""

MAX_CHI2 = 10.0
"""Largest reduced χ² of a star without the flag POOR_FIT."""


class CentredStars(NamedTuple):
    """Stars in the middle of their stamps, with their photometry, before they are restored.

    Attributes
    ----------
    stars : Stamps
        As they were given.
    has_exact_centre : ndarray of bool, shape (n,)
        True where the listed centre is exact.
    stamps, bad : ndarray, shape (n, d, d)
        Centred stamps, and True for pixels that are not used.
    shift : ndarray of int, shape (n, 2)
        Pixels by which the stars were moved, (row, column).
    flags : ndarray of uint16, shape (n,)
    border_level : ndarray, shape (n,)
        Median of the border of a stamp, a rough sky.
    photometry : Photometry
    """

    stars: Stamps
    has_exact_centre: np.ndarray
    stamps: np.ndarray
    bad: np.ndarray
    shift: np.ndarray
    flags: np.ndarray
    border_level: np.ndarray
    photometry: Photometry


class RestoredStars(NamedTuple):
    """PSFs of stars as a method gives them.

    Attributes
    ----------
    psf : ndarray, shape (n, d, d)
        PSFs of flux 1; NaN where there is no flux.
    sigma : ndarray, shape (n, d, d), or None
        Standard deviation of `psf`, if the method knows it.
    photometry : Photometry
        Fluxes and skies by the method where it measures them.
    has_no_flux : ndarray of bool, shape (n,)
    outlier_score : ndarray, shape (n,)
        How unlike all training stars a star is; NaN where the method has no score.
    centre_columns : dict of ndarray
        Columns of `Prediction` on centres; empty unless the method measures stars.
    """

    psf: np.ndarray
    sigma: np.ndarray | None
    photometry: Photometry
    has_no_flux: np.ndarray
    outlier_score: np.ndarray
    centre_columns: dict[str, np.ndarray]


class Restorer:
    """A bundle that is ready to use: the method, and the matrices of the photometry.

    Safe to use from several threads.

    Parameters
    ----------
    bundle : Bundle
    method : Method
        That of the bundle.
    """

    def __init__(self, bundle: Bundle, method: Method) -> None:
        self.bundle, self.method = bundle, method
        self.free_flux = method.free_flux()
        packing = method.packing or Packing()
        # Stamps of more than 32 px come in smaller blocks.
        pixels = bundle.info.stamp_px**2
        self.block_size = min(packing.together, max(1, packing.together * 32**2 // pixels))
        # A network rounds otherwise if it computes another number of stars together.
        self._padded_count = self.block_size if packing.padded else 1
        self._photometer = Photometer(bundle.flux_model, bundle.info.components)
        self.wings: Wings | None = bundle.wings
        calibration = bundle.info.config.get("stars", {}).get("calibration_stars", {})
        self._centring_px = float(calibration.get("centring_px") or 0.0)

    def blocks(self, stars: Stamps) -> list[Stamps]:
        """Return stars in parts of `block_size`."""
        size = self.block_size
        return [stars.part(slice(start, start + size)) for start in range(0, len(stars), size)]

    def restore(self, stars: Stamps, fixed: bool = False) -> Prediction:
        """Return the PSFs of at most `block_size` stars, whose listed centres are exact if `fixed`.

        Raises
        ------
        ValueError
            If the method meets a pixel that is not finite.
        """
        count = len(stars)
        if count < self._padded_count:
            stars = _padded(stars, self.bundle, self._padded_count)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            # 2048 stars at a time are measured and described: their arrays fit in memory.
            parts = [stars.part(slice(start, start + 2048)) for start in range(0, len(stars), 2048)]
            centred = [self._centred(part, fixed) for part in parts]
            if isinstance(self.method, MeasuresStars):
                restored = [self._by_own_fluxes(part, self.method) for part in centred]
            else:
                restored = self._by_photometry(centred)
            predictions = map(self._prediction, centred, restored)
            return Prediction.joined([*predictions]).of(slice(count))

    # Step 1: centring and photometry.

    def _centred(self, stars: Stamps, fixed: bool) -> CentredStars:
        """Move stars to the middle of their stamps, and measure flux, sky and noise there."""
        has_exact_centre = fixed & np.isfinite(stars.listed).all(axis=1)
        side = self.bundle.info.stamp_px
        margin = (stars.data.shape[-1] - side) // 2
        # Saturated pixels show where the star is; the other bad ones would mislead.
        data, hidden = stars.data, stars.bad & ~stars.saturated
        if hidden.any():
            data = np.where(hidden, border_median(data, hidden)[:, None, None], data)
        shift = displacement(data, self.bundle.info.jitter_px, self._centring_px)
        shift[has_exact_centre] = 0
        is_too_far = np.abs(shift).max(axis=1) > margin
        shift[is_too_far] = 0
        stamps, bad, saturated = (
            cut(frames, side, shift) for frames in (data, stars.bad, stars.saturated)
        )
        flags = stars.flags.copy()
        raise_flag(flags, StarFlag.MASKED, bad.any(axis=(1, 2)))
        raise_flag(flags, StarFlag.SATURATED, saturated.any(axis=(1, 2)))
        raise_flag(flags, StarFlag.OFF_CENTRE, is_too_far)
        bad = bad | saturated
        # A sky that is given and is not that of the border is flagged.
        border_level = border_median(stamps, bad)
        if np.isfinite(stars.background).any():
            limit = 5.0 * border_scatter(stamps)
            raise_flag(flags, StarFlag.SKY_OFF, np.abs(border_level - stars.background) > limit)
        photometry = self._photometer.measure(stamps, bad, border_level, stars)
        return CentredStars(
            stars, has_exact_centre, stamps, bad, shift, flags, border_level, photometry
        )

    # Step 2: the method.

    def _by_own_fluxes(self, centred: CentredStars, method: MeasuresStars) -> RestoredStars:
        """Restore stars with the fluxes that the method measures in place of the photometry.

        The photometry repairs bad pixels and tells the noise.
        """
        stars, photometry = centred.stars, centred.photometry
        stamps, bad, border_level = centred.stamps, centred.bad, centred.border_level
        has_flux = np.isfinite(stars.flux)
        is_unmeasured = (photometry.flags & StarFlag.NO_FLUX) > 0
        # Stamps above the level of their border, with bad pixels as the photometry repaired them.
        level = border_level[:, None, None]
        repaired = (
            photometry.images * photometry.flux[:, None, None]
            + photometry.background[:, None, None]
        )
        repaired = np.where(is_unmeasured[:, None, None], np.where(bad, level, stamps), repaired)
        data = np.where(photometry.used & ~bad, stamps, repaired).astype(np.float64) - level
        # Stamps without anything to measure: bad, constant, or beyond any number.
        modulus = np.abs(data).max(axis=(1, 2))
        has_pixels = bad.mean(axis=(1, 2)) <= 1 - MIN_GOOD_PIXELS
        is_unusable = ~(has_pixels & (modulus > 0) & np.isfinite(modulus))
        is_unusable |= (np.ptp(data, axis=(1, 2)) <= 0) | ~np.isfinite(photometry.noise)
        data = np.where(is_unusable[:, None, None], 0.0, data)
        # σ² of a pixel: that of the sky, and the mean of the star's photons.
        noise = np.fmax(photometry.noise, NOISE_FLOOR * modulus)
        photons = np.maximum(photometry.flux, 0.0) / stars.gain / stamps[0].size
        noise = np.where(is_unusable, 1.0, np.sqrt(noise**2 + np.nan_to_num(photons)))
        flux = np.where(has_flux, stars.flux, photometry.flux)
        star_magnitude = np.where(np.isnan(stars.magnitude), magnitude(flux), stars.magnitude)
        place = np.stack([stars.x, stars.y, star_magnitude, stars.colour], axis=1)
        estimate = method.measure(
            data,
            noise,
            place,
            stars.listed - centred.shift,
            centred.has_exact_centre,
            flux=stars.flux,
            sky=stars.background - border_level,
            gain=stars.gain,
        )
        measured = estimate.measured
        assert measured is not None and estimate.sigma is not None
        errors = self.bundle.model_errors
        place_factor = errors.flux_factor(np.stack([stars.x, stars.y], axis=1))
        covariance = _with_model_errors(measured.covariance, measured.flux, errors, place_factor)
        flux_error = np.sqrt(covariance[:, 0, 0])
        flux = np.where(has_flux, stars.flux, measured.flux)
        has_no_flux = is_unusable | np.where(has_flux, is_unmeasured, ~(flux > flux_error))
        flags = photometry.flags & np.uint16(StarFlag.MASKED | StarFlag.OUTLIER)
        raise_flag(flags, StarFlag.NO_FLUX, has_no_flux)
        is_faint = ~has_flux & ~has_no_flux & (flux < FAINT_SNR * flux_error)
        raise_flag(flags, StarFlag.FAINT, is_faint)
        raise_flag(flags, StarFlag.BEYOND, method.is_out_of_range(place) & ~has_no_flux)
        # The same photometry with the method's fluxes and skies.
        unit = np.where(has_no_flux, 1.0, flux)[:, None, None]
        images = (data - measured.background[:, None, None]) / unit
        sky = border_level + measured.background
        photometry = replace(
            photometry,
            flux=np.where(is_unusable, np.nan, flux),
            flux_error=np.where(has_flux | is_unusable, np.nan, flux_error),
            background=np.where(is_unusable, photometry.background, sky),
            images=np.where(has_no_flux[:, None, None], 0.0, images).astype(np.float32),
            flags=flags,
        )
        # The pixel at the middle of the stamp as it was given, in the image if that is known.
        middle = np.stack([stars.y, stars.x], axis=1) - stars.listed
        middle = np.where(np.isfinite(middle), middle, stars.data.shape[-1] // 2)
        columns = measured_of(middle + centred.shift + measured.centre, covariance)
        columns = {name: np.where(has_no_flux, np.nan, v) for name, v in columns.items()}
        estimate.psf[has_no_flux] = estimate.sigma[has_no_flux] = np.nan
        score = np.full(len(has_no_flux), np.nan)
        if self.bundle.strange_limit is not None and estimate.outlier_score is not None:
            score[~has_no_flux] = estimate.outlier_score[~has_no_flux]
        return RestoredStars(estimate.psf, estimate.sigma, photometry, has_no_flux, score, columns)

    def _by_photometry(self, centred: Sequence[CentredStars]) -> list[RestoredStars]:
        """Restore stars with the fluxes of the photometry, which the method may correct.

        A method that finds fluxes does so first, for stars of unknown flux and sky. It takes the
        noise for larger then: what it does not know of a bright star would pass for flux. Parts are
        restored together, in which some stars have about the same noise.
        """
        info = self.bundle.info
        photometry = Photometry.joined([part.photometry for part in centred])
        has_no_flux = (photometry.flags & StarFlag.NO_FLUX) > 0
        mean_psf = self.bundle.flux_model.mean.reshape(photometry.images.shape[1:])

        def normalised_images() -> tuple[np.ndarray, np.ndarray]:
            """Return images of flux 1, and their noise; a mean PSF for stars without flux."""
            images = photometry.images
            if has_no_flux.any():
                images = np.where(has_no_flux[:, None, None], mean_psf, images)
                images = images.astype(photometry.images.dtype)
            noise = photometry.noise / np.where(has_no_flux, np.nan, photometry.flux)
            return images, np.where(has_no_flux, info.noise_max, noise)

        # Factors of the fluxes, within what a correction may be.
        near_clusters: dict[str, Any] = {}
        is_free = ~has_no_flux & np.concatenate(
            [np.isnan(part.stars.flux) & np.isnan(part.stars.background) for part in centred]
        )
        if is_free.any() and isinstance(self.free_flux, FindsFlux):
            images, noise = normalised_images()
            level = np.hypot(noise, info.misfit) / info.kappa
            factor, near_clusters["near_clusters"] = self.free_flux.flux(images, level)
            is_free &= np.isfinite(factor)  # a damaged model may find none
            photometry = photometry.with_flux(np.where(is_free, np.clip(factor, 0.5, 2.0), 1.0))
        psf, sigma = np.full_like(photometry.images, np.nan), None
        score = np.full(len(has_no_flux), np.nan)
        # Stars of a catalogue that reaches far beyond the image have all no flux.
        if not has_no_flux.all():
            images, noise = normalised_images()
            estimate = self.method.estimate(images, noise / info.kappa, **near_clusters)
            psf, sigma = estimate.psf.astype(np.float32, copy=False), estimate.sigma
            for array in (psf, sigma):
                if array is not None:
                    array[has_no_flux] = np.nan
            if self.bundle.strange_limit is not None:
                clusters = {name: v[~has_no_flux] for name, v in near_clusters.items()}
                level = noise[~has_no_flux] / info.kappa
                assert isinstance(self.free_flux, ScoresOutliers)
                images = images[~has_no_flux]
                score[~has_no_flux] = self.free_flux.outlier_score(images, level, **clusters)
        # The parts again.
        ends = np.cumsum([0, *(len(part.stars) for part in centred)])
        return [
            RestoredStars(
                psf[rows],
                None if sigma is None else sigma[rows],
                photometry.part(rows),
                has_no_flux[rows],
                score[rows],
                {},
            )
            for rows in (slice(*pair) for pair in pairwise(ends))
        ]

    # Step 3: errors and flags.

    def _prediction(self, centred: CentredStars, restored: RestoredStars) -> Prediction:
        """Return the PSFs in the unit of the stamps, with errors, χ², shapes and flags."""
        bundle, info = self.bundle, self.bundle.info
        stars, flags, photometry = centred.stars, centred.flags, restored.photometry
        psf, sigma, measures_stars = restored.psf, restored.sigma, bool(restored.centre_columns)
        noise = photometry.noise / np.where(restored.has_no_flux, np.nan, photometry.flux)
        shapes = measure_shapes(psf)
        # S/N of a matched filter: √(Σ psf²) F/σ.
        snr = np.sqrt(np.square(psf, dtype=np.float64).sum(axis=(1, 2))) / noise
        flux_sigma = None if sigma is None else sigma * photometry.flux[:, None, None]
        distance = mahalanobis(photometry.images, noise, bundle.flux_model, info.components)
        flux = photometry.flux.astype(np.float32)[:, None, None]
        half_width, ratio95, flux_error_scale = _error_widths(bundle, psf, sigma, noise, stars)
        uncertainty = flux * half_width
        psf *= flux
        residual = (centred.stamps - photometry.background[:, None, None]).astype(np.float32) - psf
        residual[~photometry.used] = np.nan
        flags |= photometry.flags
        raise_flag(flags, StarFlag.SNR_LOW, snr < info.snr_min / SNR_TOLERANCE)
        # A method that measures stars knows their noise, and comes ever nearer to the star itself.
        is_bright = snr > info.snr_max * SNR_TOLERANCE
        raise_flag(flags, StarFlag.SNR_HIGH, (not measures_stars) & is_bright)
        is_unlike = distance > bundle.distance_limit
        if bundle.strange_limit is not None:
            limit = np.interp(noise, bundle.noise_nodes, bundle.strange_limit)
            is_unlike |= restored.outlier_score > limit
        raise_flag(flags, StarFlag.UNLIKE_TRAINING, is_unlike)
        chi2 = _chi2(residual, psf, flux_sigma, photometry.noise, stars.gain)
        raise_flag(flags, StarFlag.POOR_FIT, chi2 > MAX_CHI2)
        # Photons of the star, unless they are in the errors of the method already.
        photons = np.nan_to_num(np.maximum(photometry.flux, 0.0) / stars.gain)
        if measures_stars:
            photons[:] = 0.0
        centres: dict[str, Any] = restored.centre_columns or unmeasured(len(stars))
        flux_error = np.sqrt((flux_error_scale * photometry.flux_error) ** 2 + photons)
        return Prediction(
            id=stars.id,
            x=stars.x,
            y=stars.y,
            psf=psf,
            residual=residual,
            uncertainty=uncertainty,
            ratio95=ratio95[:, 0],
            ratio95_bright=ratio95[:, 1],
            flux=photometry.flux,
            flux_error=flux_error,
            **self._total_fluxes(stars, photometry, flux_error),
            noise=photometry.noise,
            snr=snr,
            chi2=chi2,
            distance=distance,
            outlier_score=restored.outlier_score,
            fwhm_px=shapes.fwhm_px,
            ellipticity=shapes.ellipticity,
            position_angle_deg=shapes.position_angle_deg,
            shift_x=centred.shift[:, 1],
            shift_y=centred.shift[:, 0],
            flags=flags,
            **centres,
        )

    def _total_fluxes(
        self, stars: Stamps, photometry: Photometry, flux_error: np.ndarray
    ) -> dict[str, Any]:
        """Return fluxes with the light beyond the stamps, and skies without that in the stamps."""
        flux, sky = photometry.flux, photometry.background
        if self.wings is None or not isinstance(self.method, KnowsField):
            unknown = np.full(len(flux), np.nan)
            return {"flux_total": unknown, "flux_total_error": unknown, "background": sky}
        place = np.stack([stars.x, stars.y], axis=1)
        outer_part = outer_shares(self.method.psf_at, place)
        factor, factor_error = self.wings.total(outer_part)
        # The error of a flux that was given is not known: it is NaN.
        total_error = np.hypot(flux_error * factor, flux * factor_error)
        # Light of wings that is even in the stamp is in the sky of a star whose sky is not known.
        even_light = np.maximum(flux, 0.0) * self.wings.scale(outer_part) * self.wings.profile[0]
        sky = np.where(np.isnan(stars.background), sky - np.nan_to_num(even_light), sky)
        return {"flux_total": flux * factor, "flux_total_error": total_error, "background": sky}


def _error_widths(
    bundle: Bundle, psf: np.ndarray, sigma: np.ndarray | None, noise: np.ndarray, stars: Stamps
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return how wide the errors of PSFs of flux 1 are.

    All depends on which of noise, flux and sky of a star were estimated.

    Parameters
    ----------
    bundle : Bundle
    psf : ndarray, shape (n, d, d)
    sigma : ndarray, shape (n, d, d), or None
        By the method.
    noise : ndarray, shape (n,)
        Pixel RMS over the flux.
    stars : Stamps
        Flux, sky and noise as they were given; NaN where they were estimated.

    Returns
    -------
    half_width : ndarray, shape (n, d, d)
        Of the interval that holds 68 % of the errors.
    ratio95 : ndarray, shape (n, 2)
        Its factor for 95 %, of faint and of bright pixels.
    flux_error_scale : ndarray, shape (n,)
        Factor of the error of the flux.
    """
    rows = np.arange(len(noise))
    # Errors of stars of known flux and sky, at this noise, in units of the method's σ.
    half_width = at_noise(noise, bundle.noise_nodes, bundle.error68)
    if sigma is not None:
        half_width = half_width * sigma
    ratio = np.interp(noise, bundle.noise_nodes, bundle.ratio95)
    ratio95 = np.stack([ratio, ratio], axis=1)
    if (scales := bundle.scales(noise)) is None:
        return half_width, ratio95, np.ones(len(noise))
    # Factors of the case: nothing, the flux, or flux and sky estimated; the noise known or not.
    estimates_noise, estimates_flux, estimates_sky = (
        np.isnan(values) for values in (stars.noise, stars.flux, stars.background)
    )
    case = np.where(estimates_sky, 2, estimates_flux.astype(int))
    scale68, scale95 = (table[rows, estimates_noise.astype(int), case] for table in scales[:2])
    faint_scale, bright_scale = scale68.T.astype(np.float32)[:, :, None, None]
    half_width = half_width * np.where(brightest(psf), bright_scale, faint_scale)
    flux_error_scale = np.where(estimates_flux & estimates_sky, scales[2], np.ones(len(noise)))
    return half_width, ratio95 * scale95 / scale68, flux_error_scale


def _with_model_errors(
    covariance: np.ndarray, flux: np.ndarray, errors: ModelErrors, place_factor: np.ndarray
) -> np.ndarray:
    """Return covariances (n, 4, 4) of flux, sky, row and column with the errors of the model too.

    These are `place_factor` (n,) times those of the field. A number that is known, whose
    variance is almost 0, stays so.
    """
    unit, zeros = np.maximum(flux, 0.0)[:, None], np.zeros((len(flux), 2))
    model_sigma = np.concatenate([unit * [errors.flux, errors.sky], zeros + errors.centre], axis=1)
    model_sigma *= place_factor[:, None]
    variance = np.maximum(np.einsum("nii->ni", covariance), 0.0)
    known_sigma = np.concatenate([unit * 1e-5, unit * 1e-12, zeros + 1e-9], axis=1)
    model_sigma[np.sqrt(variance) < known_sigma] = 0.0
    return np.asarray(covariance + model_sigma[:, :, None] ** 2 * np.eye(4))


def _chi2(
    residual: np.ndarray,
    psf: np.ndarray,
    flux_sigma: np.ndarray | None,
    noise: np.ndarray,
    gain: np.ndarray,
) -> np.ndarray:
    """Return Σ r²/v over what is expected of it, over pixels that are not NaN, (n,).

    A restored star follows its own noise where it is bright. If the method knows the σ u of its
    pixels, in a noise of the mean variance s, it leaves the part k = 1 − u²/s, at least 1 %, of
    what noise does to each, and Σ (s k + k² (v − s))/v is expected; else the number of pixels is.

    Parameters
    ----------
    residual, psf : ndarray, shape (n, d, d)
        r and the PSF in the unit of the stamps.
    flux_sigma : ndarray, shape (n, d, d), or None
        u, in the same unit.
    noise, gain : ndarray, shape (n,)
        σ of the sky in a pixel, and electrons per unit, NaN where unknown: v = σ² + PSF/gain.
    """
    variance = np.broadcast_to((noise**2)[:, None, None], residual.shape)
    if np.isfinite(gain).any():
        per_electron = np.where(gain > 0, 1.0 / gain, 0.0)[:, None, None]
        variance = variance + np.maximum(psf, 0.0) * per_electron
    is_used = np.isfinite(residual) & np.isfinite(variance)
    expected = np.ones(residual.shape)
    if flux_sigma is not None:
        mean_variance = variance.mean(axis=(1, 2), keepdims=True)
        part = np.clip(1.0 - flux_sigma.astype(np.float64) ** 2 / mean_variance, 0.01, 1.0)
        expected = part * (mean_variance + part * (variance - mean_variance)) / variance
    total, expected_total = (
        np.where(is_used, values, 0.0).sum(axis=(1, 2), dtype=np.float64)
        for values in (residual**2 / variance, expected)
    )
    chi2 = total / np.where(expected_total > 0, expected_total, np.inf)
    return np.where(is_used.any(axis=(1, 2)), chi2, np.nan)


def _padded(stars: Stamps, bundle: Bundle, size: int) -> Stamps:
    """Return stars made up to `size`, the last ones mean PSFs of which nothing is known."""
    count, side = len(stars), bundle.info.stamp_px
    columns = {}
    for column in fields(stars):
        values = getattr(stars, column.name)
        blank = np.nan if values.dtype.kind == "f" else 0
        blanks = np.full((size - count, *values.shape[1:]), blank, values.dtype)
        columns[column.name] = np.concatenate([values, blanks])
    margin = (stars.data.shape[-1] - side) // 2
    core = slice(margin, margin + side)
    columns["data"][count:] = 0.0
    columns["data"][count:, core, core] = bundle.flux_model.mean.reshape(side, side)
    return Stamps(**columns)
