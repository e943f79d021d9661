"""Flux, sky and noise of stars from their own stamps, and the images for the network.

`Photometer` fits stars without bad pixels all at once, in the space of the leading eigenvectors of
the covariance of the training set. A star whose pixels leave the range of the training set, or with
bad pixels, goes to `psfdae.model.flux_model.robust_flux`, which has the equations: it solves the
same ones with all eigenvectors, leaves such pixels out and replaces them by what the others make of
them. Neither can do the work of the other at the same cost or to the same digits.

The median of the border is only the start for the sky: PSFs with wings have light there, which the
fit knows of. The noise σ is the scatter of the residuals of the border in units of what the fit
expects there, so that light of the star in the border is no noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from psfdae.image.stamps import Stamps, StarFlag, border_pixels, raise_flag
from psfdae.model.flux_model import (
    CLIP_SIGMA,
    FAINT_SNR,
    NOISE_FLOOR,
    FluxEstimate,
    FluxModel,
    robust_flux,
)
from psfdae.moments import SIGMA_OF_MAD

LEAST_FLUX = 1.0 / float(np.finfo(np.float32).max)
"""Least flux over the brightest pixel of a star with an image of flux 1 in single precision."""


@dataclass(frozen=True)
class Photometry:
    """Photometry of n stamps, in the unit of the stamps; NaN where it is not possible.

    Attributes
    ----------
    flux, background, noise : ndarray, shape (n,)
        Flux of the star, sky per pixel, and RMS of a pixel by the noise of the sky.
    flux_error : ndarray, shape (n,)
        Standard error; NaN where the flux was given.
    images : ndarray, shape (n, d, d), float32
        Stamps of flux 1, without sky and repaired; zero without flux.
    used : ndarray of bool, shape (n, d, d)
        Pixels that were measured; the others are repaired.
    flags : ndarray of uint16, shape (n,)
        Sum of the values of `StarFlag`.
    """

    flux: np.ndarray
    flux_error: np.ndarray
    background: np.ndarray
    noise: np.ndarray
    images: np.ndarray
    used: np.ndarray
    flags: np.ndarray

    def part(self, rows: slice) -> Photometry:
        """Return the photometry of a part of the stamps."""
        return Photometry(*(getattr(self, field.name)[rows] for field in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Photometry]) -> Photometry:
        """Return the photometry of the stamps of several, one after the other."""
        if len(parts) == 1:
            return parts[0]
        columns = ([getattr(p, field.name) for p in parts] for field in fields(cls))
        return cls(*map(np.concatenate, columns))

    def with_flux(self, factor: np.ndarray) -> Photometry:
        """Return the same light with fluxes times a factor (n,), the rest of it being sky."""
        sky, scale = (1.0 - factor) / self.images[0].size, factor[:, None, None]
        return replace(
            self,
            flux=self.flux * factor,
            background=self.background + self.flux * sky,
            images=((self.images - sky[:, None, None]) / scale).astype(self.images.dtype),
        )


class _Fit(NamedTuple):
    """Flux, error, noise and sky left over (n,), in units of each star's brightest pixel."""

    flux: np.ndarray
    error: np.ndarray
    noise: np.ndarray
    sky: np.ndarray


class Photometer:
    """Photometry of stars by the training set of a network.

    The fast fit knows the leading eigenvectors of the covariance; what the star has beyond them
    counts as noise, so that the noise of a very bright star is overestimated.

    Parameters
    ----------
    model : FluxModel
    components : int
        Number of leading eigenvectors.
    """

    def __init__(self, model: FluxModel, components: int) -> None:
        self.model = model
        self.pixels = pixels = model.mean.size
        self.side = round(pixels**0.5)
        # Leading eigenvectors E; at least a quarter of the directions must be left to tell the
        # noise. Those left out have the variance `_unseen` in the mean.
        leading_count = min(components, 3 * pixels // 4)
        leading = model.basis[:, -leading_count:]
        self._variance = model.variance[-leading_count:]
        self._peak = float(model.mean @ model.mean)
        unseen = (
            model.variance[: pixels - leading_count]
            if model.is_complete
            else np.array([model.other_variance])
        )
        self._unseen = float(unseen.mean())
        self._unseen_count = pixels - 1 - leading_count
        # Mean PSF without its mean, c = m − 1/P; its part along E, and the square of the rest.
        contrast = model.mean - 1.0 / pixels
        # Double precision: OpenBLAS rounds single precision by the place of a star in its block.
        self._projector = np.column_stack([leading, contrast])
        self._modes = leading.T @ contrast
        self._unseen_power = max(float(contrast @ contrast - self._modes @ self._modes), 0.0)
        ring = self._ring = border_pixels(self.side)
        self._ring_contrast = contrast[ring]
        self._ring_basis = np.ascontiguousarray(leading[ring].T)
        self._low, self._high = (limit.astype(np.float32) for limit in model.pixel_range)

    @cached_property
    def _free_sky(self) -> FluxModel:
        """Model of stars on an unknown sky, which few stars with bad pixels ask for."""
        return self.model.with_free_sky()

    def measure(
        self, stamps: np.ndarray, bad: np.ndarray, start: np.ndarray, stated: Stamps
    ) -> Photometry:
        """Measure flux, sky and noise of stars.

        Parameters
        ----------
        stamps : ndarray, shape (n, d, d)
            Stamps in any unit, sky included, finite.
        bad : ndarray of bool, shape (n, d, d)
            Pixels that are not used.
        start : ndarray, shape (n,)
            Sky to start from (`psfdae.image.stamps.border_median`).
        stated : Stamps
            Its `flux`, `background` and `noise` are taken where they are not NaN.
        """
        count = len(stamps)
        hidden = bad.reshape(count, -1)
        flux_known, sky_known = np.isfinite(stated.flux), np.isfinite(stated.background)
        # Stamps above the sky in units of their brightest pixel; a mean PSF for those without.
        sky = np.where(sky_known, stated.background, start)
        x = (stamps.reshape(count, -1) - sky[:, None]).astype(np.float32)
        np.copyto(x, 0.0, where=hidden)
        scale = np.abs(x).max(axis=1).astype(np.float64)
        lit = np.isfinite(scale) & (scale > 0)
        scale = np.where(lit, scale, 1.0)
        x[~lit] = self.model.mean
        x /= scale.astype(np.float32)[:, None]
        # All stars by the fast fit.
        fit = self._fit(x, sky_known, stated.flux / scale, stated.noise / scale)
        images, fits_in = self._normalise(x, fit)
        measured = Photometry(
            flux=np.where(flux_known, stated.flux, fit.flux * scale),
            flux_error=np.where(flux_known, np.nan, fit.error * scale),
            background=np.where(sky_known, sky, sky + fit.sky * scale),
            noise=np.where(np.isfinite(stated.noise), stated.noise, fit.noise * scale),
            images=images.reshape(stamps.shape),
            used=np.ones(stamps.shape, dtype=bool),
            flags=np.zeros(count, dtype=np.uint16),
        )
        raise_flag(measured.flags, StarFlag.FAINT, measured.flux < FAINT_SNR * measured.flux_error)
        # Stars with bad pixels, outliers, or less flux than twice its error again, with care.
        clear = flux_known | (fit.flux > 2.0 * fit.error)
        careful = hidden.any(axis=1) | ~lit | ~clear | ~fits_in
        self._carefully(np.flatnonzero(careful), stamps, hidden, sky, stated, measured)
        return measured

    def _fit(
        self,
        x: np.ndarray,
        sky_known: np.ndarray,
        flux: np.ndarray,
        noise: np.ndarray,
        used: np.ndarray | None = None,
    ) -> _Fit:
        """Fit all stars in the space of the leading eigenvectors E.

        Parameters
        ----------
        x : ndarray, shape (n, P)
            Stamps above the known sky, or above the sky of the start.
        sky_known : ndarray of bool, shape (n,)
        flux, noise : ndarray, shape (n,)
            Known values; they are estimated where they are NaN.
        used : ndarray of bool, shape (n, P), optional
            Pixels that tell the noise.
        """
        # Without its mean, x has the part `modes` along E and `along` along c; the part of the
        # latter that E does not hold is `outside`, and x² beyond E is `energy`.
        total = x.sum(axis=1, dtype=np.float64)
        x = x - (total / self.pixels)[:, None]
        projected = x @ self._projector
        modes, along = projected[:, :-1], projected[:, -1]
        outside = along - modes @ self._modes
        energy = np.einsum("ij,ij->i", x, x) - (modes**2).sum(axis=1)
        # A known sky makes the mean of the stamp a measurement of the flux.
        sky_variance = sky_known / self.pixels

        def flux_of(
            fitted_flux: np.ndarray, sigma2: np.ndarray, unseen: float
        ) -> tuple[np.ndarray, ...]:
            """Return F = cᵀS⁻¹x / cᵀS⁻¹c, its error, and the weights along E, with S of a flux.

            `unseen` is the variance of PSFs along every direction beyond E.
            """
            prior = np.maximum(fitted_flux, 0.0) ** 2 + sigma2 / self._peak
            weight = 1.0 / (prior[:, None] * self._variance + sigma2[:, None])
            rest_weight = 1.0 / (prior * unseen + sigma2)
            information = (
                weight @ self._modes**2 + rest_weight * self._unseen_power + sky_variance / sigma2
            )
            signal = (
                (weight * modes) @ self._modes
                + rest_weight * outside
                + sky_variance * total / sigma2
            )
            fitted_flux = np.where(np.isfinite(flux), flux, signal / information)
            return fitted_flux, 1.0 / np.sqrt(information), weight

        # Flux and noise settle in three rounds; the start is the flux in white noise, cᵀx / cᵀc.
        fitted_flux = np.where(
            np.isfinite(flux), flux, along / (self._unseen_power + self._modes @ self._modes)
        )
        for _ in range(4):
            # σ² is the mean of (x − F c)² beyond E.
            rest_energy = energy - 2.0 * fitted_flux * outside + fitted_flux**2 * self._unseen_power
            sigma2 = np.maximum(rest_energy / self._unseen_count, NOISE_FLOOR**2)
            sigma2 = np.where(np.isfinite(noise), noise**2, sigma2)
            # What the star has beyond the leading eigenvectors is in σ² here.
            fitted_flux, _, weight = flux_of(fitted_flux, sigma2, 0.0)
        # The noise is that of the border, where the star has little light.
        score = self._border_scores(x, modes, total, fitted_flux, weight, sigma2, sky_known)
        if used is not None:
            score[~used[:, self._ring]] = np.nan
        scatter = np.where(np.isfinite(noise), 1.0, _clipped_rms(score))
        sigma = np.maximum(np.sqrt(sigma2) * scatter, NOISE_FLOOR)
        fitted_flux, error, _ = flux_of(fitted_flux, sigma**2, self._unseen)
        sky = np.where(sky_known, 0.0, (total - fitted_flux) / self.pixels)
        return _Fit(fitted_flux, error, sigma, sky)

    def _border_scores(
        self,
        x: np.ndarray,
        modes: np.ndarray,
        total: np.ndarray,
        flux: np.ndarray,
        weight: np.ndarray,
        sigma2: np.ndarray,
        sky_known: np.ndarray,
    ) -> np.ndarray:
        """Return leave-one-out residuals S⁻¹(x − Fm) of the border in units of their σ, (n, ring).

        With the weights w along E (`weight`), S⁻¹ = E (w − 1/σ²) Eᵀ + 1/σ², without its part along
        a constant where the sky is not known.
        """
        excess = weight - 1.0 / sigma2[:, None]
        pull = excess * (modes - flux[:, None] * self._modes)
        mean = np.where(sky_known, (total - flux) / self.pixels, 0.0)[:, None]
        ring = x[:, self._ring] - flux[:, None] * self._ring_contrast + mean
        residual = ring / sigma2[:, None] + pull @ self._ring_basis
        # The variance of an element of S⁻¹(x − Fm) is that of the diagonal of S⁻¹.
        sky_loss = np.where(sky_known, 0.0, 1.0 / self.pixels)
        precision = excess @ self._ring_basis**2 + ((1.0 - sky_loss) / sigma2)[:, None]
        return np.asarray(residual / np.sqrt(precision))

    def _normalise(self, x: np.ndarray, fit: _Fit) -> tuple[np.ndarray, np.ndarray]:
        """Return images of flux 1, and which of them stay in the range of the training set."""
        usable = fit.flux > LEAST_FLUX
        flux = np.where(usable, fit.flux, 1.0)
        images = x - fit.sky.astype(np.float32)[:, None]
        images /= flux.astype(np.float32)[:, None]
        reach = (CLIP_SIGMA * fit.noise / flux).astype(np.float32)[:, None]
        outlier = (images - reach > self._high).any(axis=1)
        outlier |= (images + reach < self._low).any(axis=1)
        images[~usable] = 0.0
        return images, usable & ~outlier

    def _carefully(
        self,
        stars: np.ndarray,
        stamps: np.ndarray,
        hidden: np.ndarray,
        sky: np.ndarray,
        stated: Stamps,
        measured: Photometry,
    ) -> None:
        """Fit the stars of some rows with `robust_flux`, and overwrite their rows of `measured`."""
        has_free_sky = ~np.isfinite(stated.background[stars])
        for is_free, members in ((True, stars[has_free_sky]), (False, stars[~has_free_sky])):
            if not members.size:
                continue
            model, blind_estimate = self._free_sky if is_free else self.model, None
            # 16 stars per fit, made up with mean PSFs: other sizes would round otherwise.
            for group in np.split(members, range(16, members.size, 16)):
                x = np.tile(self.model.mean, (16, 1))
                flat = stamps[group].reshape(group.size, -1).astype(np.float64)
                x[: group.size] = np.where(hidden[group], np.nan, flat - sky[group, None])
                # Groups without a good pixel, the stars beyond an image, are all the same.
                blind = group.size == 16 and hidden[group].all()
                estimate = blind_estimate if blind else None
                if estimate is None:
                    estimate = robust_flux(x.reshape(-1, self.side, self.side), model)
                    blind_estimate = estimate if blind else blind_estimate
                self._overwrite(measured, group, estimate, sky[group], stated)

    def _overwrite(
        self,
        measured: Photometry,
        group: np.ndarray,
        estimate: FluxEstimate,
        sky: np.ndarray,
        stated: Stamps,
    ) -> None:
        """Overwrite rows `group` of a photometry by an estimate, of which they are the first."""
        count = group.size
        known_flux, known_noise = stated.flux[group], stated.noise[group]
        has_flux, repaired = np.isfinite(known_flux), estimate.images[:count].reshape(count, -1)
        fitted_flux, fit_flags = estimate.flux[:count], estimate.flags[:count]
        fitted, flux = np.isfinite(fitted_flux), np.where(has_flux, known_flux, fitted_flux)
        # A star has no flux if it was not fitted, if the flux is below its error and not given, or
        # if it has no image in single precision. A flux that is given is not faint.
        is_lost = ~fitted | ~(flux > LEAST_FLUX * np.abs(repaired).max(axis=1))
        is_lost |= ~has_flux & ((fit_flags & StarFlag.NO_FLUX) > 0)
        flags = fit_flags & ~np.uint16(StarFlag.NO_FLUX)
        flags[has_flux] &= ~np.uint16(StarFlag.FAINT)
        raise_flag(flags, StarFlag.NO_FLUX, is_lost)
        # The sky that is left, b = mean(x) − F/P, and images of flux 1 without it.
        residual_sky = repaired.mean(axis=1) - np.nan_to_num(fitted_flux) / self.pixels
        residual_sky = np.where(np.isfinite(stated.background[group]), 0.0, residual_sky)
        images = (repaired - residual_sky[:, None]) / np.where(is_lost, 1.0, flux)[:, None]
        images[is_lost] = 0.0
        # The noise as of other stars, by the pixels of the border that were used.
        filled = np.tile(self.model.mean.astype(np.float32), (len(estimate.flux), 1))
        filled[:count] = images
        unit, used = np.ones(len(filled)), estimate.used.reshape(filled.shape)
        noise = self._fit(filled, unit > 0, unit, np.nan * unit, used).noise[:count] * flux
        noise = np.where(is_lost, estimate.noise[:count], noise)
        measured.flux[group] = flux
        measured.flux_error[group] = np.where(has_flux, np.nan, estimate.error[:count])
        measured.background[group] = sky + np.where(fitted, residual_sky, 0.0)
        measured.noise[group] = np.where(np.isfinite(known_noise), known_noise, noise)
        measured.images[group] = images.reshape(count, self.side, self.side)
        measured.used[group] = estimate.used[:count]
        measured.flags[group] = flags


def _clipped_rms(score: np.ndarray) -> np.ndarray:
    """Return the RMS of each row without values beyond 4 σ, with σ from the median of the modulus.

    NaN is left out; a row of nothing else counts as 1.
    """
    modulus = np.abs(score)
    unused = np.isnan(modulus)
    if unused.any():
        ascending = np.sort(modulus, axis=1)  # NaN goes last
        middle = np.maximum((~unused).sum(axis=1, keepdims=True) - 1, 0) // 2
        median = np.take_along_axis(ascending, middle, axis=1)
    else:
        median = np.median(modulus, axis=1, keepdims=True)
    is_used = ~unused & (modulus <= 4.0 * SIGMA_OF_MAD * median)
    squares = np.where(is_used, modulus, 0.0)
    count = is_used.sum(axis=1)
    total = np.einsum("ij,ij->i", squares, squares)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), 1.0))
