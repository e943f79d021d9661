"""Denoising of stars by a model: from stamps to PSFs with errors and flags.

Each star goes through three steps, and no star influences another one:

1. `Denoiser._centre`: the star is moved to the middle of its stamp, and its flux, sky and noise
   are estimated with the mean PSF of the training (`psfdae.denoise.star_flux`).
2. `_denoise`: the method gives its PSF. A `FieldDenoiser` has a method that measures flux, sky and
   centre itself (`psfdae.methods.field`), a `StampDenoiser` one that corrects the photometry.
3. `Denoiser._predict`: half-widths of the errors, χ², light outside the stamp, shape and flags.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations, pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np

from psfdae.base.rows import Rows
from psfdae.denoise.bundle import Bundle
from psfdae.denoise.error_model import ErrorModel, mahalanobis
from psfdae.denoise.flux_model import NOISE_FLOOR, FluxModel, Photometry, is_faint
from psfdae.denoise.prediction import Prediction
from psfdae.denoise.star_flux import Photometer
from psfdae.image.sky import border_median, border_scatter
from psfdae.image.stamps import (
    Stamps,
    StarFlag,
    cut,
    displacement,
    raise_flag,
)
from psfdae.methods.interface import Method, Packing
from psfdae.psf.wings import Wings, outer_shares
from psfdae.stars.bright_stars import magnitude
from psfdae.stars.moments import measure_shapes

SNR_TOLERANCE = 1.25
"""Factor by which a S/N may be outside the range of the training: it has an error itself."""

MAX_CHI2 = 10.0
"""Largest reduced χ² of a star without the flag POOR_FIT."""


class CentredStars(NamedTuple):
    """Stars in the middle of their stamps, with their photometry, before they are denoised.

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
        Flags of the list, of pixels and of centring.
    border_level : ndarray, shape (n,)
        Median of the border of a stamp, a rough sky.
    photometry : Photometry
        Flux, sky and noise by the mean PSF, and stamps above the sky of flux 1.
    """

    stars: Stamps
    has_exact_centre: np.ndarray
    stamps: np.ndarray
    bad: np.ndarray
    shift: np.ndarray
    flags: np.ndarray
    border_level: np.ndarray
    photometry: Photometry

    def repair_stamps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return stamps above the level of their border, repaired, with their noise.

        Returns
        -------
        data : ndarray, shape (n, d, d), float64
            0 in stamps that are unusable.
        noise : ndarray, shape (n,)
            Standard deviation of a pixel by sky and photons, larger where pixels share noise.
        is_unusable : ndarray of bool, shape (n,)
            True if a stamp has nothing to measure: too many bad pixels, no contrast, or pixels or
            noise that are not finite.
        """
        photometry, stamps, bad = self.photometry, self.stamps, self.bad
        # Bad pixels as the photometry repaired them, or the level of the border where it could not.
        is_unmeasured = (photometry.flags & StarFlag.NO_FLUX) > 0
        level = self.border_level[:, None, None]
        filled_stamps = (
            photometry.images * photometry.flux[:, None, None]
            + photometry.background[:, None, None]
        )
        filled_stamps = np.where(
            is_unmeasured[:, None, None], np.where(bad, level, stamps), filled_stamps
        )
        data = np.where(photometry.is_used & ~bad, stamps, filled_stamps).astype(np.float64) - level
        # Stamps need as many usable pixels as the photometry asks for, and some contrast.
        largest = np.abs(data).max(axis=(1, 2))
        has_pixels = bad.mean(axis=(1, 2)) <= 1 - FluxModel.min_pixel_fraction
        is_unusable = ~(has_pixels & (largest > 0) & np.isfinite(largest))
        is_unusable |= (np.ptp(data, axis=(1, 2)) <= 0) | ~np.isfinite(photometry.noise)
        data = np.where(is_unusable[:, None, None], 0.0, data)
        # σ² of a pixel: the sky's, as it is in sums of pixels, and the mean of the star's photons.
        noise = np.fmax(self.stars.noise_correlation * photometry.noise, NOISE_FLOOR * largest)
        photons = np.maximum(photometry.flux, 0.0) / self.stars.gain / stamps[0].size
        noise = np.where(is_unusable, 1.0, np.sqrt(noise**2 + np.nan_to_num(photons)))
        return data, noise, is_unusable


@dataclass(frozen=True)
class DenoisedStars(Rows):
    """PSFs of stars as a method gives them.

    Attributes
    ----------
    psf : ndarray, shape (n, d, d)
        PSFs of flux 1; NaN for stars without a flux.
    sigma : ndarray, shape (n, d, d), or None
        Standard deviation of `psf`, if the method knows it.
    photometry : Photometry
        Fluxes and skies by the method where it measures them.
    has_no_flux : ndarray of bool, shape (n,)
        True for stars whose flux cannot be used, which get the flag NO_FLUX.
    outlier_score : ndarray, shape (n,)
        How unlike all training stars a star is; NaN for a method without a score.
    centre : ndarray, shape (n, 2)
        Centre (row, column) by the method, in the image if the stars come from one, else in
        their stamps; NaN unless the method measures stars.
    covariance : ndarray, shape (n, 4, 4)
        Covariance of flux, sky, row and column; NaN unless the method measures stars.
    """

    psf: np.ndarray
    sigma: np.ndarray | None
    photometry: Photometry
    has_no_flux: np.ndarray
    outlier_score: np.ndarray
    centre: np.ndarray
    covariance: np.ndarray

    def centre_columns(self) -> dict[str, np.ndarray]:
        """Return the columns on centres, and on all errors but the flux error.

        A number that is known has the error 0, and correlates with nothing.
        """
        sigma = np.sqrt(np.maximum(np.einsum("nii->ni", self.covariance), 0.0))
        names = ("flux", "background", "y", "x")
        columns = {"y_fit": self.centre[:, 0], "x_fit": self.centre[:, 1]}
        columns |= {f"{name}_error": sigma[:, i] for i, name in enumerate(names) if i}
        # ρ_ij = C_ij / (σ_i σ_j).
        for i, j in combinations(range(4), 2):
            product = sigma[:, i] * sigma[:, j]
            correlation = self.covariance[:, i, j] / np.where(product > 0, product, 1.0)
            columns[f"corr_{names[i]}_{names[j]}"] = np.where(product == 0, 0.0, correlation)
        return columns


class Denoiser(ABC):
    """A model that is ready to use: the method, and the matrices of the photometry.

    Safe to use from several threads.

    Parameters
    ----------
    bundle : Bundle
        Description, arrays and errors of the model.
    method : Method
        Its fitted method.
    """

    has_snr_max: ClassVar[bool]
    """True if stars above the S/N of the training get the flag SNR_HIGH."""

    def __init__(self, bundle: Bundle, method: Method) -> None:
        self.bundle, self.method = bundle, method
        packing = method.packing or Packing()
        # Stamps of more than 32 px come in smaller blocks.
        pixels = bundle.info.stamp_px**2
        self.block_size = min(packing.batch_size, max(1, packing.batch_size * 32**2 // pixels))
        # A network rounds in another way if it computes another number of stars together.
        self._padded_count = self.block_size if packing.is_padded else 1
        self._photometer = Photometer(bundle.flux_model, bundle.info.components)
        self.wings: Wings | None = bundle.wings
        calibration = bundle.info.config.get("stars", {}).get("calibration_stars", {})
        self._centring_px = float(calibration.get("centring_px") or 0.0)

    def denoise(self, stars: Stamps, fixed: bool = False) -> Prediction:
        """Return the PSFs of at most `block_size` stars, whose listed centres are exact if `fixed`.

        Raises
        ------
        ValueError
            If the method meets a pixel that is not finite.
        """
        count = len(stars)
        if count < self._padded_count:
            # Stars are repeated up to that number, and these are dropped again; without a star,
            # blank ones are taken.
            columns = (getattr(stars, column.name) for column in fields(stars))
            size = self._padded_count
            stars = Stamps(*(np.resize(values, (size, *values.shape[1:])) for values in columns))
        # Unusable stars are NaN or infinite on the way, and are flagged.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            # 2048 stars at a time are measured and described: their arrays fit in memory.
            centred_stars = [self._centre(part, fixed) for part in stars.split(2048)]
            predictions = map(self._predict, centred_stars, self._denoise(centred_stars))
            return Prediction.joined([*predictions]).of(slice(count))

    # Step 1: centring and photometry.

    def _centre(self, stars: Stamps, fixed: bool) -> CentredStars:
        """Move stars to the middle of their stamps, and measure flux, sky and noise there."""
        has_exact_centre = fixed & np.isfinite(stars.listed).all(axis=1)
        side = self.bundle.info.stamp_px
        margin = (stars.data.shape[-1] - side) // 2
        # The light in the middle of the stamp shows where the star is. Saturated pixels belong to
        # it; the other bad ones would mislead, and get the level of the border.
        data, hidden = stars.data, stars.bad & ~stars.saturated
        if hidden.any():
            data = np.where(hidden, border_median(data, hidden)[:, None, None], data)
        shift = displacement(data, self.bundle.info.jitter_px, self._centring_px, hidden)
        shift[has_exact_centre] = 0
        # A star cannot be moved farther than the pixels around its stamp reach.
        is_too_far = np.abs(shift).max(axis=1) > margin
        shift[is_too_far] = 0
        # Stamps of the model's side about the star; pixels that none shows are bad.
        stamps, bad, saturated_pixels = (
            cut(frames, side, shift) for frames in (data, stars.bad, stars.saturated)
        )
        # Flags of the list, of pixels and of centring.
        flags = stars.flags.copy()
        raise_flag(flags, StarFlag.MASKED, bad.any(axis=(1, 2)))
        raise_flag(flags, StarFlag.SATURATED, saturated_pixels.any(axis=(1, 2)))
        raise_flag(flags, StarFlag.OFF_CENTRE, is_too_far)
        bad = bad | saturated_pixels
        # A sky that is given and is more than 5 σ off the sky of the border is flagged.
        border_level = border_median(stamps, bad)
        if np.isfinite(stars.background).any():
            limit = 5.0 * border_scatter(stamps, bad)
            raise_flag(flags, StarFlag.SKY_OFF, np.abs(border_level - stars.background) > limit)
        photometry = self._photometer.measure(stamps, bad, border_level, stars)
        return CentredStars(
            stars, has_exact_centre, stamps, bad, shift, flags, border_level, photometry
        )

    # Step 2: the method.

    @abstractmethod
    def _denoise(self, centred_stars: Sequence[CentredStars]) -> list[DenoisedStars]:
        """Return the PSFs of stars by the method, with fluxes and skies."""

    # Step 3: errors and flags.

    def _predict(self, centred_stars: CentredStars, denoised_stars: DenoisedStars) -> Prediction:
        """Return the PSFs in the unit of the stamps, with errors, χ², shapes and flags."""
        info, errors = self.bundle.info, self.bundle.errors
        stars, flags = centred_stars.stars, centred_stars.flags
        psf, sigma, photometry = denoised_stars.psf, denoised_stars.sigma, denoised_stars.photometry
        # Noise divided by the flux, as in the training: errors and limits depend on it. PSFs and
        # fluxes are sums of pixels, which have more noise where pixels share it.
        noise = photometry.noise / np.where(denoised_stars.has_no_flux, np.nan, photometry.flux)
        noise *= stars.noise_correlation
        shapes = measure_shapes(psf)
        # S/N of a matched filter: √(Σ psf²) F/σ.
        snr = np.sqrt(np.square(psf, dtype=np.float64).sum(axis=(1, 2))) / noise
        distance = mahalanobis(photometry.images, noise, self.bundle.flux_model, info.components)
        # PSFs, their errors and what is left of the stamps, in the unit of the stamps: errors of
        # PSFs of flux 1 times the flux, and r = x − b − F psf.
        flux = photometry.flux.astype(np.float32)[:, None, None]
        # F psf ± F w, with the half-width w of the case of each star.
        half_width, ratio95, flux_scale = errors.compute_half_widths(psf, sigma, noise, stars)
        psf *= flux
        stamps = centred_stars.stamps - photometry.background[:, None, None]
        residual = stamps.astype(np.float32) - psf
        # Pixels that were repaired have no residual.
        residual[~photometry.is_used] = np.nan
        flux_sigma = None if sigma is None else sigma * photometry.flux[:, None, None]
        chi2 = compute_reduced_chi2(residual, psf, flux_sigma, photometry.noise, stars.gain)
        flux_error = self._flux_errors(photometry, flux_scale, stars)
        # Flags in addition to centring, photometry and method. The S/N of a star is known to its
        # tolerance.
        is_unlike = errors.is_unlike_training(noise, distance, denoised_stars.outlier_score)
        flags |= photometry.flags
        raise_flag(flags, StarFlag.SNR_LOW, snr < info.snr_min / SNR_TOLERANCE)
        is_bright = snr > info.snr_max * SNR_TOLERANCE
        raise_flag(flags, StarFlag.SNR_HIGH, self.has_snr_max & is_bright)
        raise_flag(flags, StarFlag.UNLIKE_TRAINING, is_unlike)
        raise_flag(flags, StarFlag.POOR_FIT, chi2 > MAX_CHI2)
        # One entry for each column; `Prediction` orders them.
        columns = {
            "id": stars.id,
            "x": stars.x,
            "y": stars.y,
            "flux": photometry.flux,
            "flux_error": flux_error,
            "noise": photometry.noise,
            "snr": snr,
            "ratio95": ratio95[:, 0],
            "ratio95_bright": ratio95[:, 1],
            "chi2": chi2,
            "distance": distance,
            "outlier_score": denoised_stars.outlier_score,
            **vars(shapes),  # FWHM, ellipticity and position angle
            "shift_x": centred_stars.shift[:, 1],
            "shift_y": centred_stars.shift[:, 0],
            "flags": flags,
        }
        columns |= self._total_fluxes(stars, photometry, flux_error)
        columns |= denoised_stars.centre_columns()
        return Prediction(
            columns=columns, psf=psf, residual=residual, uncertainty=flux * half_width
        )

    @abstractmethod
    def _flux_errors(
        self, photometry: Photometry, flux_scale: np.ndarray, stars: Stamps
    ) -> np.ndarray:
        """Return the standard errors of fluxes (n,), with the photons of the stars.

        `flux_scale` (n,) is the factor of the errors by noise.
        """

    def _total_fluxes(
        self, stars: Stamps, photometry: Photometry, flux_error: np.ndarray
    ) -> dict[str, Any]:
        """Return fluxes with the light outside the stamps, and skies without that in the stamps.

        By default, this light is not known.
        """
        unknown, sky = np.full(len(photometry.flux), np.nan), photometry.background
        return {"flux_total": unknown, "flux_total_error": unknown, "background": sky}


class StampDenoiser(Denoiser):
    """Denoiser with a method that knows the PSF of a star alone, and corrects its photometry."""

    has_snr_max = True

    def __init__(self, bundle: Bundle, method: Method) -> None:
        super().__init__(bundle, method)
        self._free_flux = method.free_flux()

    def _denoise(self, centred_stars: Sequence[CentredStars]) -> list[DenoisedStars]:
        """Denoise stars with the fluxes of the photometry, which the method may correct.

        A method that finds fluxes does so first, for stars of unknown flux and sky. It then adds
        the noise floor to the noise, because errors of the PSF's shape would bias the flux of
        bright stars. All parts are denoised in one call of the method.
        """
        # Photometry of all parts together, and stars without a flux.
        info = self.bundle.info
        photometry = Photometry.join([part.photometry for part in centred_stars])
        has_no_flux = (photometry.flags & StarFlag.NO_FLUX) > 0
        has_flux = ~has_no_flux
        # Stars whose flux and sky are both estimates get a factor of the flux, between 1/2 and 2;
        # more would not be a correction. A method is given the noise of images of flux 1 as a noise
        # level of its training, λ = σ/(F κ).
        near_clusters: dict[str, Any] = {}
        is_free = has_flux & np.concatenate(
            [np.isnan(part.stars.flux) & np.isnan(part.stars.background) for part in centred_stars]
        )
        if is_free.any() and self.method.finds_flux:
            # √(noise² + floor²): what the method does not know of a star counts as noise.
            images, noise = self._normalise(photometry, has_no_flux)
            noise_level = np.hypot(noise, self.bundle.errors.noise_floor) / info.kappa
            factor, near_clusters["near_clusters"] = self._free_flux.flux(images, noise_level)
            is_free &= np.isfinite(factor)  # a damaged model may find none
            photometry = photometry.scale_flux(np.where(is_free, np.clip(factor, 0.5, 2.0), 1.0))
        psf, sigma = np.full_like(photometry.images, np.nan), None
        score = np.full(len(has_flux), np.nan)
        # The PSFs. All stars may be without a flux, such as a part of a list far off the image.
        if has_flux.any():
            images, noise = self._normalise(photometry, has_no_flux)
            noise_level = noise / info.kappa
            estimate = self.method.estimate(images, noise_level, **near_clusters)
            psf, sigma = estimate.psf.astype(np.float32, copy=False), estimate.sigma
            psf[has_no_flux] = np.nan
            if sigma is not None:
                sigma[has_no_flux] = np.nan
            # Only a model with a limit asks how unlike the training stars they are.
            if self.bundle.errors.outlier_limit is not None:
                clusters = {name: values[has_flux] for name, values in near_clusters.items()}
                score[has_flux] = (
                    self._free_flux.outlier_score(
                        images[has_flux], noise_level[has_flux], **clusters
                    )
                    if estimate.outlier_score is None
                    else estimate.outlier_score[has_flux]
                )
        # The parts again, without centres.
        ends = np.cumsum([0, *(len(part.stars) for part in centred_stars)])
        unknown = np.full((len(psf), 2), np.nan), np.full((len(psf), 4, 4), np.nan)
        denoised_stars = DenoisedStars(psf, sigma, photometry, has_no_flux, score, *unknown)
        return [denoised_stars.select(slice(*rows)) for rows in pairwise(ends)]

    def _normalise(
        self, photometry: Photometry, has_no_flux: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return images (n, d, d) of flux 1 and their noise (n,); the mean PSF without a flux."""
        # Stars without flux cost as much, and are NaN afterwards; their noise is the largest of the
        # training.
        images = photometry.images
        if has_no_flux.any():
            mean_psf = self.bundle.flux_model.mean.reshape(images.shape[1:])
            images = np.where(has_no_flux[:, None, None], mean_psf, images).astype(images.dtype)
        noise = photometry.noise / np.where(has_no_flux, np.nan, photometry.flux)
        return images, np.where(has_no_flux, self.bundle.info.noise_max, noise)

    def _flux_errors(
        self, photometry: Photometry, flux_scale: np.ndarray, stars: Stamps
    ) -> np.ndarray:
        # σ² of the sky's noise in a sum of pixels, scaled, and the photons of the star.
        photons = np.nan_to_num(np.maximum(photometry.flux, 0.0) / stars.gain)
        scale = flux_scale * stars.noise_correlation
        return np.asarray(np.sqrt((scale * photometry.flux_error) ** 2 + photons))


class FieldDenoiser(Denoiser):
    """Denoiser with a method that knows the PSF at every position, and measures stars itself.

    It knows the noise of bright stars, and its PSF comes ever nearer to the star itself: there is
    no upper limit of the S/N. Its errors of fluxes have the photons of the star.
    """

    has_snr_max = False

    def _denoise(self, centred_stars: Sequence[CentredStars]) -> list[DenoisedStars]:
        return [measure_stars(part, self.method, self.bundle.errors) for part in centred_stars]

    def _flux_errors(
        self, photometry: Photometry, flux_scale: np.ndarray, stars: Stamps
    ) -> np.ndarray:
        return np.asarray(np.abs(flux_scale * photometry.flux_error))

    def _total_fluxes(
        self, stars: Stamps, photometry: Photometry, flux_error: np.ndarray
    ) -> dict[str, Any]:
        """Return fluxes with the light beyond the stamps, and skies without that in the stamps."""
        if self.wings is None:
            return super()._total_fluxes(stars, photometry, flux_error)
        flux, sky = photometry.flux, photometry.background
        # A PSF with more light in the outer part of its stamp has more light beyond it.
        outer_share = outer_shares(self.method.psf_at, stack_coordinates(stars, flux))
        factor, factor_error = self.wings.total_over_flux(outer_share)
        # The error of a flux that was given is not known: it is NaN.
        total_error = np.hypot(flux_error * factor, flux * factor_error)
        # Light of wings that is even in the stamp is in the sky of a star whose sky is not known.
        even_light = np.maximum(flux, 0.0) * self.wings.scale(outer_share) * self.wings.profile[0]
        sky = np.where(np.isnan(stars.background), sky - np.nan_to_num(even_light), sky)
        return {"flux_total": flux * factor, "flux_total_error": total_error, "background": sky}


def stack_coordinates(stars: Stamps, flux: np.ndarray) -> np.ndarray:
    """Return x, y, magnitude and colour, on which the PSF of a star depends, (n, 4).

    A star without a listed magnitude has the magnitude of its flux (n,), in counts.
    """
    star_magnitude = np.where(np.isnan(stars.magnitude), magnitude(flux), stars.magnitude)
    return np.stack([stars.x, stars.y, star_magnitude, stars.colour], axis=1)


def measure_stars(centred_stars: CentredStars, method: Method, errors: ErrorModel) -> DenoisedStars:
    """Denoise stars with the fluxes that the method measures in place of the photometry.

    The photometry repairs bad pixels and gives the noise.

    Parameters
    ----------
    centred_stars : CentredStars
        Stars in the middle of their stamps, with the photometry of the flux model.
    method : Method
        One with the capability `knows_field`.
    errors : ErrorModel
        Errors of measured stars due to the PSF model, which are added to the method's errors.
    """
    stars, photometry = centred_stars.stars, centred_stars.photometry
    border_level = centred_stars.border_level
    # Stamps above the level of their border; the measured sky is relative to it, too.
    data, noise, is_unusable = centred_stars.repair_stamps()
    flux_is_given = np.isfinite(stars.flux)
    flux = np.where(flux_is_given, stars.flux, photometry.flux)
    position = stack_coordinates(stars, flux)
    # PSF, flux, sky and centre at once; given values are taken unchanged. Centres count from the
    # middle of the stamp, which was moved.
    estimate = method.measure(
        data,
        noise,
        position,
        stars.listed - centred_stars.shift,
        centred_stars.has_exact_centre,
        flux=stars.flux,
        sky=stars.background - border_level,
        gain=stars.gain,
    )
    # Errors of the method, by noise, and errors of the PSF model add up: C = C_noise + C_model.
    star_fit = estimate.measurements
    assert star_fit is not None and estimate.sigma is not None
    covariance = errors.model_errors.add_to_covariance(
        star_fit.covariance, star_fit.flux, position[:, :2]
    )
    flux_error = np.sqrt(covariance[:, 0, 0])
    # A given flux is used unless the photometry refused it, a measured one if it is above its
    # error.
    flux = np.where(flux_is_given, stars.flux, star_fit.flux)
    is_refused = (photometry.flags & StarFlag.NO_FLUX) > 0
    has_no_flux = is_unusable | np.where(flux_is_given, is_refused, ~(flux > flux_error))
    # Flags on pixels come from the photometry, flags on the flux from the method.
    flags = photometry.flags & np.uint16(StarFlag.MASKED | StarFlag.OUTLIER)
    raise_flag(flags, StarFlag.NO_FLUX, has_no_flux)
    is_own_flux = ~flux_is_given & ~has_no_flux
    raise_flag(flags, StarFlag.FAINT, is_own_flux & is_faint(flux, flux_error))
    raise_flag(flags, StarFlag.BEYOND, method.is_outside_range(position) & ~has_no_flux)
    # The same photometry with the method's fluxes and skies: images are (x − b) / F.
    divisor = np.where(has_no_flux, 1.0, flux)[:, None, None]
    images = (data - star_fit.background[:, None, None]) / divisor
    sky = border_level + star_fit.background
    photometry = replace(
        photometry,
        flux=np.where(is_unusable, np.nan, flux),
        flux_error=np.where(flux_is_given | is_unusable, np.nan, flux_error),
        background=np.where(is_unusable, photometry.background, sky),
        images=np.where(has_no_flux[:, None, None], 0.0, images).astype(np.float32),
        flags=flags,
    )
    # Centres count from the middle of the stamp as it was given: its pixel in the image if that is
    # known.
    middle = np.stack([stars.y, stars.x], axis=1) - stars.listed
    middle = np.where(np.isfinite(middle), middle, stars.data.shape[-1] // 2)
    centre = middle + centred_stars.shift + star_fit.centre
    # Stars without a flux have no result.
    score = estimate.outlier_score
    score = np.full(len(flux), np.nan) if score is None else score.copy()
    for array in (estimate.psf, estimate.sigma, centre, covariance, score):
        array[has_no_flux] = np.nan
    return DenoisedStars(
        estimate.psf, estimate.sigma, photometry, has_no_flux, score, centre, covariance
    )


def compute_reduced_chi2(
    residual: np.ndarray,
    psf: np.ndarray,
    flux_sigma: np.ndarray | None,
    noise: np.ndarray,
    gain: np.ndarray,
) -> np.ndarray:
    """Return Σ r²/v divided by its expected value, (n,); sums are over pixels that are not NaN.

    The PSF of a bright star follows some of its noise. If the method knows the σ u of its pixels,
    in a noise of the mean variance s, the fraction k = 1 − u²/s of the noise of each, at least 1 %,
    is left in the residual. Σ (s k + k² (v − s))/v is expected then, else the number of pixels.

    Parameters
    ----------
    residual, psf : ndarray, shape (n, d, d)
        r and the PSF in the unit of the stamps.
    flux_sigma : ndarray, shape (n, d, d), or None
        u, in the same unit.
    noise, gain : ndarray, shape (n,)
        σ of the sky in a pixel, and electrons per unit, NaN where unknown: v = σ² + PSF/gain.
    """
    # v = σ² + PSF/gain, where the gain is known.
    variance = np.broadcast_to((noise**2)[:, None, None], residual.shape)
    if np.isfinite(gain).any():
        electron = np.where(gain > 0, 1.0 / gain, 0.0)[:, None, None]  # in the unit of the stamps
        variance = variance + np.maximum(psf, 0.0) * electron
    # What is expected of r²/v in each pixel: 1, or less by what the star follows of its own noise.
    is_used = np.isfinite(residual) & np.isfinite(variance)
    expected_square = np.ones(residual.shape)
    if flux_sigma is not None:
        mean_variance = variance.mean(axis=(1, 2), keepdims=True)
        fraction = np.clip(1.0 - flux_sigma.astype(np.float64) ** 2 / mean_variance, 0.01, 1.0)
        expected_square = (
            fraction * (mean_variance + fraction * (variance - mean_variance)) / variance
        )
    total, expected_total = (
        np.where(is_used, values, 0.0).sum(axis=(1, 2), dtype=np.float64)
        for values in (np.square(residual / np.sqrt(variance)), expected_square)
    )
    chi2 = total / np.where(expected_total > 0, expected_total, np.inf)
    return np.where(is_used.any(axis=(1, 2)), chi2, np.nan)


def make_denoiser(bundle: Bundle, method: Method) -> Denoiser:
    """Return the denoiser of a model with this fitted method."""
    return (FieldDenoiser if method.knows_field else StampDenoiser)(bundle, method)
