"""Flux, sky and noise of many stars at once, in the space of the leading eigenvectors of PSFs.

The equations are as in `psfdae.denoise.flux_model`: x ~ N(F m + b, S) with S = F²C + σ²I. Here C
has the leading eigenvectors E of a training set, with their variances Λ, and one variance for all
directions beyond them. Then

    S⁻¹ = E (w − w₀) Eᵀ + w₀,    w = 1/(F²Λ + σ²),    w₀ = 1/(F²Λ₀ + σ²),

and every sum over the pixels of a star is one over its modes Eᵀx and a few numbers beside them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from psfdae.denoise.flux_model import NOISE_FLOOR, FluxModel
from psfdae.image.sky import border_pixels
from psfdae.stars.moments import SIGMA_OF_MAD


class ModesFit(NamedTuple):
    """Flux, its error, noise and sky left over, (n,) each, in the unit of the stamps."""

    flux: np.ndarray
    error: np.ndarray
    noise: np.ndarray
    sky: np.ndarray


class LeadingModes:
    """Mean PSF and leading eigenvectors of a training set, ready to be fitted to stars.

    What a star has beyond the leading eigenvectors counts as noise, so that the noise of a very
    bright star is overestimated.

    Parameters
    ----------
    model : FluxModel
        Mean and covariance of the training stars.
    components : int
        Number of leading eigenvectors.
    """

    def __init__(self, model: FluxModel, components: int) -> None:
        self.pixels = pixels = model.mean.size
        # At least a quarter of the directions must be left to estimate the noise.
        leading_count = min(components, 3 * pixels // 4)
        leading = model.basis[:, -leading_count:]
        self._variance = model.variance[-leading_count:]
        self._peak = float(model.mean @ model.mean)
        # Λ₀, the mean variance along the directions beyond E. One of these is the constant, which
        # the sky takes.
        self._other_variance = model.average_variance_beyond(leading_count)
        self._other_count = pixels - 1 - leading_count
        # An unknown sky takes the mean of a stamp: the flux is fitted with the mean PSF without its
        # mean, c = m − 1/P. It has the part Eᵀc along E, and |c|² − |Eᵀc|² beyond.
        contrast = model.mean - 1.0 / pixels
        # Double precision: OpenBLAS rounds single precision by the place of a star in its block.
        self._projector = np.column_stack([leading, contrast])
        self._modes = leading.T @ contrast
        self._other_power = max(float(contrast @ contrast - self._modes @ self._modes), 0.0)
        # The same for the pixels of the border, whose residuals give the noise.
        ring = self._ring = border_pixels(round(pixels**0.5))
        self._ring_contrast = contrast[ring]
        self._ring_basis = np.ascontiguousarray(leading[ring].T)

    def fit(
        self,
        x: np.ndarray,
        sky_known: np.ndarray,
        flux: np.ndarray,
        noise: np.ndarray,
        is_used: np.ndarray | None = None,
    ) -> ModesFit:
        """Fit flux and noise of all stars, and the sky where it is not known.

        Parameters
        ----------
        x : ndarray, shape (n, P)
            Stamps above the known sky, or else above a first estimate of it.
        sky_known : ndarray of bool, shape (n,)
            False for stars of which the sky left over is fitted, too.
        flux, noise : ndarray, shape (n,)
            Known values; they are estimated where they are NaN.
        is_used : ndarray of bool, shape (n, P), optional
            Pixels from which the noise is estimated.
        """
        # Without its mean, x has the part `modes` along E and `along` along c; the part of the
        # latter that E does not hold is `outside`, and x² beyond E is `energy`.
        total = x.sum(axis=1, dtype=np.float64)
        x = x - (total / self.pixels)[:, None]
        mode_scores = x @ self._projector
        modes, along = mode_scores[:, :-1], mode_scores[:, -1]
        outside = along - modes @ self._modes
        energy = np.einsum("ij,ij->i", x, x) - (modes**2).sum(axis=1)
        # A known sky makes the mean of the stamp a measurement of the flux, Σx = F ± σ √P.
        sky_variance = sky_known / self.pixels

        def solve_flux(
            fitted_flux: np.ndarray, sigma2: np.ndarray, other_variance: float
        ) -> tuple[np.ndarray, ...]:
            """Return F = cᵀS⁻¹x / cᵀS⁻¹c, its error, and the weights along E, with S of a flux.

            `other_variance` is Λ₀, the variance of PSFs along every direction beyond E.
            """
            # F² in S is never below the variance of F by the noise alone, σ²/|m|².
            prior = np.maximum(fitted_flux, 0.0) ** 2 + sigma2 / self._peak
            weight = 1.0 / (prior[:, None] * self._variance + sigma2[:, None])
            other_weight = 1.0 / (prior * other_variance + sigma2)
            # cᵀS⁻¹c and cᵀS⁻¹x: parts along E, beyond E, and of the mean of the stamp.
            information = weight @ self._modes**2 + other_weight * self._other_power
            information += sky_variance / sigma2
            signal = (weight * modes) @ self._modes + other_weight * outside
            signal += sky_variance * total / sigma2
            fitted_flux = np.where(np.isfinite(flux), flux, signal / information)
            return fitted_flux, 1.0 / np.sqrt(information), weight

        # Flux and noise settle in three rounds; the start is the flux in white noise, cᵀx / cᵀc.
        contrast_power = self._other_power + self._modes @ self._modes
        fitted_flux = np.where(np.isfinite(flux), flux, along / contrast_power)
        for _ in range(4):
            # σ² is the mean of (x − F c)² over the directions beyond E.
            residual = energy - 2.0 * fitted_flux * outside + fitted_flux**2 * self._other_power
            sigma2 = np.maximum(residual / self._other_count, NOISE_FLOOR**2)
            sigma2 = np.where(np.isfinite(noise), noise**2, sigma2)
            # What the star has beyond the leading eigenvectors is in σ² here: Λ₀ = 0.
            fitted_flux, _, weight = solve_flux(fitted_flux, sigma2, 0.0)
        # The noise is measured in the border, where the star has little light: the scores there
        # have the standard deviation 1 if σ is right.
        score = self.border_scores(x, modes, total, fitted_flux, weight, sigma2, sky_known)
        if is_used is not None:
            score[~is_used[:, self._ring]] = np.nan
        scatter = np.where(np.isfinite(noise), 1.0, compute_clipped_rms(score))
        sigma = np.maximum(np.sqrt(sigma2) * scatter, NOISE_FLOOR)
        # With this noise, what the star has beyond E belongs to its covariance again.
        fitted_flux, error, _ = solve_flux(fitted_flux, sigma**2, self._other_variance)
        # b = mean(x) − F/P, since PSFs have the sum 1.
        sky = np.where(sky_known, 0.0, (total - fitted_flux) / self.pixels)
        return ModesFit(fitted_flux, error, sigma, sky)

    def border_scores(
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

        Parameters
        ----------
        x : ndarray, shape (n, P)
            Stamps without their mean.
        modes, weight : ndarray, shape (n, K)
            Eᵀx and w.
        total, flux, sigma2 : ndarray, shape (n,)
            Sum of the stamp before its mean was taken off, F, and σ².
        sky_known : ndarray of bool, shape (n,)
            True for stars of known sky.
        """
        # S⁻¹(x − Fm) in the border: E (w − 1/σ²) (Eᵀx − F Eᵀc), and what is left of x over σ². A
        # known sky leaves the mean of x − Fm in it.
        excess = weight - 1.0 / sigma2[:, None]
        pull = excess * (modes - flux[:, None] * self._modes)
        mean = np.where(sky_known, (total - flux) / self.pixels, 0.0)[:, None]
        ring = x[:, self._ring] - flux[:, None] * self._ring_contrast + mean
        residual = ring / sigma2[:, None] + pull @ self._ring_basis
        # Elements of S⁻¹(x − Fm) have the variances on the diagonal of S⁻¹; an unknown sky takes
        # 1/P from it.
        sky_loss = np.where(sky_known, 0.0, 1.0 / self.pixels)
        precision = excess @ self._ring_basis**2 + ((1.0 - sky_loss) / sigma2)[:, None]
        return np.asarray(residual / np.sqrt(precision))


def compute_clipped_rms(score: np.ndarray) -> np.ndarray:
    """Return the RMS of each row without values beyond 4 σ, with σ from the median of the modulus.

    NaN is left out; a row of nothing else counts as 1.
    """
    # The median of the values that are there, the lower of two in the middle where some are NaN.
    modulus = np.abs(score)
    unused_pixels = np.isnan(modulus)
    if unused_pixels.any():
        ascending = np.sort(modulus, axis=1)  # NaN goes last
        middle = np.maximum((~unused_pixels).sum(axis=1, keepdims=True) - 1, 0) // 2
        median = np.take_along_axis(ascending, middle, axis=1)
    else:
        median = np.median(modulus, axis=1, keepdims=True)
    # σ = 1.4826 times the median of the modulus of a normal variable.
    is_used = ~unused_pixels & (modulus <= 4.0 * SIGMA_OF_MAD * median)
    squares = np.where(is_used, modulus, 0.0)
    count = is_used.sum(axis=1)
    total = np.einsum("ij,ij->i", squares, squares)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), 1.0))
