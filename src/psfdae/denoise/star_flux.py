"""Flux, sky and noise of stars from their own stamps, and the images for the network.

`Photometer` fits stars without bad pixels all at once, in the space of the leading eigenvectors of
the covariance of the training set (`psfdae.denoise.leading_modes`). A star whose pixels leave the
range of the training set, or with bad pixels, goes to `psfdae.denoise.flux_model.robust_flux`,
which has the equations: it solves the same ones with all eigenvectors, leaves such pixels out and
replaces them by what the others make of them. Neither can do the work of the other at the same cost
or to the same digits.

The median of the border is only the start for the sky: PSFs with wings have light there, which the
fit knows of. The noise σ is the scatter of the residuals of the border in units of what the fit
expects there, so that light of the star in the border is not taken for noise.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from psfdae.denoise.flux_model import FluxModel, Photometry, is_faint, robust_flux
from psfdae.denoise.leading_modes import LeadingModes
from psfdae.image.stamps import Stamps, StarFlag, raise_flag


class Photometer:
    """Photometry of stars by the PSFs of a training set.

    Parameters
    ----------
    model : FluxModel
        Mean, covariance and range of pixels of the training stars.
    components : int
        Number of leading eigenvectors that the fit of many stars knows.
    """

    least_flux: ClassVar[float] = 1.0 / float(np.finfo(np.float32).max)
    """Least flux over the brightest pixel of a star with an image of flux 1 in single precision."""

    def __init__(self, model: FluxModel, components: int) -> None:
        self.model = model
        self.leading = LeadingModes(model, components)
        self._low, self._high = (limit.astype(np.float32) for limit in model.pixel_range)

    def measure(
        self, stamps: np.ndarray, bad: np.ndarray, start: np.ndarray, given_stars: Stamps
    ) -> Photometry:
        """Measure flux, sky and noise of stars.

        Parameters
        ----------
        stamps : ndarray, shape (n, d, d)
            Stamps in any unit, sky included, finite.
        bad : ndarray of bool, shape (n, d, d)
            Pixels that are not used.
        start : ndarray, shape (n,)
            Sky to start from (`psfdae.image.sky.border_median`).
        given_stars : Stamps
            Its `flux`, `background` and `noise` are taken where they are not NaN.
        """
        count = len(stamps)
        hidden = bad.reshape(count, -1)
        flux_known, sky_known = np.isfinite(given_stars.flux), np.isfinite(given_stars.background)
        # Stamps above the sky in units of their brightest pixel, in which no square overflows; a
        # mean PSF in place of those without light.
        sky = np.where(sky_known, given_stars.background, start)
        x = (stamps.reshape(count, -1) - sky[:, None]).astype(np.float32)
        np.copyto(x, 0.0, where=hidden)
        scale = np.abs(x).max(axis=1).astype(np.float64)
        lit = np.isfinite(scale) & (scale > 0)
        scale = np.where(lit, scale, 1.0)
        x[~lit] = self.model.mean
        x /= scale.astype(np.float32)[:, None]
        # All stars in the space of the leading eigenvectors.
        fit = self.leading.fit(x, sky_known, given_stars.flux / scale, given_stars.noise / scale)
        # Images of flux 1 without the sky that is left, (x − b) / F.
        has_flux = fit.flux > self.least_flux
        flux = np.where(has_flux, fit.flux, 1.0)
        images = x - fit.sky.astype(np.float32)[:, None]
        images /= flux.astype(np.float32)[:, None]
        # Good pixels are in the range of the training set, but for their noise.
        reach = (self.model.clip_sigma * fit.noise / flux).astype(np.float32)[:, None]
        has_outlier = (images - reach > self._high).any(axis=1)
        has_outlier |= (images + reach < self._low).any(axis=1)
        images[~has_flux] = 0.0
        # In the unit of the stamps; given values stay unchanged.
        photometry = Photometry(
            flux=np.where(flux_known, given_stars.flux, fit.flux * scale),
            flux_error=np.where(flux_known, np.nan, fit.error * scale),
            background=np.where(sky_known, sky, sky + fit.sky * scale),
            noise=np.where(np.isfinite(given_stars.noise), given_stars.noise, fit.noise * scale),
            images=images.reshape(stamps.shape),
            is_used=np.ones(stamps.shape, dtype=bool),
            flags=np.zeros(count, dtype=np.uint16),
        )
        raise_flag(
            photometry.flags, StarFlag.FAINT, is_faint(photometry.flux, photometry.flux_error)
        )
        # Stars with bad pixels, outliers, or less flux than twice its error again, with care.
        is_clear = flux_known | (fit.flux > 2.0 * fit.error)
        careful = hidden.any(axis=1) | ~lit | ~is_clear | ~has_flux | has_outlier
        self._carefully(np.flatnonzero(careful), stamps, hidden, sky, given_stars, photometry)
        return photometry

    def _carefully(
        self,
        stars: np.ndarray,
        stamps: np.ndarray,
        hidden: np.ndarray,
        sky: np.ndarray,
        given_stars: Stamps,
        photometry: Photometry,
    ) -> None:
        """Fit the stars of some rows with `robust_flux`; overwrite their rows of `photometry`."""
        # Stars of unknown sky have a model of their own, in which any sky is as likely.
        has_free_sky = ~np.isfinite(given_stars.background[stars])
        for is_free, members in ((True, stars[has_free_sky]), (False, stars[~has_free_sky])):
            if not members.size:
                continue
            model, blind_estimate = self.model.with_free_sky if is_free else self.model, None
            # 16 stars per fit, made up with mean PSFs: other sizes would round otherwise.
            for group in np.split(members, range(16, members.size, 16)):
                x, side = np.tile(self.model.mean, (16, 1)), stamps.shape[-1]
                flat = stamps[group].reshape(group.size, -1).astype(np.float64)
                x[: group.size] = np.where(hidden[group], np.nan, flat - sky[group, None])
                # Fluxes, and stamps with bad pixels and outliers repaired, of the whole group.
                # Groups without a good pixel, the stars beyond an image, are all the same.
                blind = group.size == 16 and hidden[group].all()
                estimate = blind_estimate if blind else None
                if estimate is None:
                    estimate = robust_flux(x.reshape(-1, side, side), model)
                    blind_estimate = estimate if blind else blind_estimate
                group_stars = given_stars.select(group)
                photometry.put(group, self._complete(estimate, sky[group], group_stars))

    def _complete(self, padded_estimate: Photometry, sky: np.ndarray, stars: Stamps) -> Photometry:
        """Return the photometry of stars, the first of an estimate; their given values are kept."""
        # A flux that is given counts, and so do the repaired pixels and their noise.
        count = len(stars)
        estimate = padded_estimate.select(slice(count))
        known_flux, known_noise = stars.flux, stars.noise
        has_flux, filled_pixels = np.isfinite(known_flux), estimate.images.reshape(count, -1)
        fitted_flux, fit_flags = estimate.flux, estimate.flags
        is_fitted, flux = np.isfinite(fitted_flux), np.where(has_flux, known_flux, fitted_flux)
        # NO_FLUX: the star was not fitted, if the flux is below its error and not given, or
        # if it has no image in single precision. A flux that is given is not faint.
        is_lost = ~is_fitted | ~(flux > self.least_flux * np.abs(filled_pixels).max(axis=1))
        is_lost |= ~has_flux & ((fit_flags & StarFlag.NO_FLUX) > 0)
        # NO_FLUX is judged with the fluxes that are given; all other flags come from the fit.
        flags = fit_flags & ~np.uint16(StarFlag.NO_FLUX)
        flags[has_flux] &= ~np.uint16(StarFlag.FAINT)
        raise_flag(flags, StarFlag.NO_FLUX, is_lost)
        # The sky that is left, b = mean(x) − F/P, and images of flux 1 without it.
        flux_per_pixel = np.nan_to_num(fitted_flux) / filled_pixels.shape[1]
        residual_sky = filled_pixels.mean(axis=1) - flux_per_pixel
        residual_sky = np.where(np.isfinite(stars.background), 0.0, residual_sky)
        images = (filled_pixels - residual_sky[:, None]) / np.where(is_lost, 1.0, flux)[:, None]
        images[is_lost] = 0.0
        # The noise as of other stars, by the pixels of the border that were used.
        known_images = np.tile(self.model.mean.astype(np.float32), (len(padded_estimate.flux), 1))
        known_images[:count] = images
        # These are images of flux 1 without sky, both known here: only the noise is fitted.
        unit, is_used = np.ones(len(known_images)), padded_estimate.is_used
        sky_known, unknown_noise = unit > 0, np.nan * unit
        is_used = is_used.reshape(known_images.shape)
        fit = self.leading.fit(known_images, sky_known, unit, unknown_noise, is_used)
        noise = fit.noise[:count] * flux
        noise = np.where(is_lost, estimate.noise, noise)
        # Given values stay unchanged.
        return Photometry(
            flux=flux,
            flux_error=np.where(has_flux, np.nan, estimate.flux_error),
            background=sky + np.where(is_fitted, residual_sky, 0.0),
            noise=np.where(np.isfinite(known_noise), known_noise, noise),
            images=images.reshape(estimate.images.shape),
            is_used=estimate.is_used,
            flags=flags,
        )
