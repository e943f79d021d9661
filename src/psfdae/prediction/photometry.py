"""Flux, sky and noise of a star from its own stamp, and the image for the network.

Flux F and sky b come from one generalised least-squares fit (Aitken 1935) of the
mean PSF m of the training set and a constant,

    x ~ N(F m + b, S),   S = F²C + σ²I,

with the covariance C of the training set, as in `psfdae.stars.flux`. The median of
the border is only the start: PSFs with wings have light there, which the fit knows
of. PSFs of sum 1 give C no part along a constant, so the fit is one of the stamp
without its mean, and b = mean(x) − F/P. The noise σ is the scatter of the border's
residuals in units of what the fit expects there, so light of the star in the border
is no noise.

Stars without bad pixels are fitted all at once in the space of C's leading
eigenvectors; a star whose pixels leave the range of the training set, or with bad
pixels, goes to `robust_flux`, which repairs them, one small group of stars at a time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from psfdae.prediction.border import border_pixels
from psfdae.prediction.flags import raise_flag
from psfdae.stars.flux import (
    CLIP,
    FAINT_SNR,
    MARGIN,
    NOISE_FLOOR,
    SLACK,
    Flag,
    FluxEstimate,
    FluxModel,
    robust_flux,
)

ROUNDS = 4
"""Updates of flux and noise; they settle in three."""

CLEAR = 2.0
"""Stars of less flux than this times its error are fitted carefully."""

GROUP = 16
"""Stars per careful fit, always filled: other sizes would round otherwise."""

FREE_SKY = 1e4
"""Variance of an unknown sky in units of the flux squared: as good as infinite."""

KEPT_IF_GIVEN = Flag.NONFINITE | Flag.OUTLIER
KEPT_OTHERWISE = KEPT_IF_GIVEN | Flag.FAINT
"""Flags of `robust_flux` that hold for a star whose flux is given, and for others."""

SCATTER_CLIP = 4.0
"""Residuals beyond this many σ do not count for the noise."""


@dataclass(frozen=True)
class Known:
    """What is known of n stars in advance, shape (n,) each; NaN where it is to be estimated."""

    flux: np.ndarray
    background: np.ndarray
    noise: np.ndarray

    def part(self, stars: np.ndarray | slice) -> Known:
        """The same of some stars."""
        return Known(self.flux[stars], self.background[stars], self.noise[stars])


@dataclass(frozen=True)
class Photometry:
    """What a stamp says of its star, in the unit of the stamps.

    Attributes
    ----------
    flux, flux_error, background, noise : ndarray, shape (n,), float64
        The error is NaN where the flux was given. All are NaN where nothing could
        be estimated.
    images : ndarray, shape (n, d, d), float32
        Sky-subtracted, repaired, of flux 1; zero where there is no usable flux.
    used : ndarray of bool, shape (n, d, d)
        Pixels that were measured; the others are repaired.
    flags : ndarray, shape (n,), uint16
        Sum of `psfdae.stars.flux.Flag`s.
    """

    flux: np.ndarray
    flux_error: np.ndarray
    background: np.ndarray
    noise: np.ndarray
    images: np.ndarray
    used: np.ndarray
    flags: np.ndarray


@dataclass(frozen=True)
class _Fit:
    """Flux, error, noise and sky left over, in units of each star's scale."""

    flux: np.ndarray
    error: np.ndarray
    noise: np.ndarray
    sky: np.ndarray


class Photometer:
    """Measures stars against the training set of a network.

    Parameters
    ----------
    model : FluxModel
        Eigenvalues ascending.
    components : int
        Leading eigenvectors that the fast fit knows of; what the star has beyond
        them counts as noise, so that of a very bright star is overestimated.
    """

    def __init__(self, model: FluxModel, components: int) -> None:
        self.model = model
        self.pixels = pixels = model.mean.size
        self.side = round(pixels**0.5)
        # At least a quarter of the directions must be left to tell the noise.
        kept = min(components, 3 * pixels // 4)
        leading = model.basis[:, -kept:]
        self._variance = model.variance[-kept:]
        self._peak = float(model.mean @ model.mean)
        unseen = model.variance[: pixels - kept] if model.whole else np.array([model.rest])
        self._unseen = float(unseen.mean())
        self._others = pixels - 1 - kept
        contrast = model.mean - 1.0 / pixels
        # Double precision: OpenBLAS rounds single precision by the place of a star in its block.
        self._projector = np.column_stack([leading, contrast])
        self._modes = leading.T @ contrast
        self._left = max(float(contrast @ contrast - self._modes @ self._modes), 0.0)
        ring = self._ring = border_pixels(self.side)
        self._ring_contrast = contrast[ring]
        self._ring_basis = np.ascontiguousarray(leading[ring].T)
        limit = SLACK * model.high.max()
        self._high = (MARGIN * model.high + limit).astype(np.float32)
        self._low = (model.low / MARGIN - limit).astype(np.float32)
        self._free_sky = _with_free_sky(model)

    def measure(
        self, stamps: np.ndarray, bad: np.ndarray, start: np.ndarray, known: Known
    ) -> Photometry:
        """Photometry of stamps (n, d, d).

        Parameters
        ----------
        stamps : ndarray, shape (n, d, d)
            In any unit, sky included; finite.
        bad : ndarray of bool, shape (n, d, d)
            Pixels that are not to be used.
        start : ndarray, shape (n,)
            Sky to start from (`border_median`).
        known : Known
        """
        count = len(stamps)
        hidden = bad.reshape(count, -1)
        flux_known, sky_known = np.isfinite(known.flux), np.isfinite(known.background)
        sky = np.where(sky_known, known.background, start)
        x = (stamps.reshape(count, -1) - sky[:, None]).astype(np.float32)
        np.copyto(x, 0.0, where=hidden)
        scale = np.abs(x).max(axis=1).astype(np.float64)
        lit = np.isfinite(scale) & (scale > 0)
        scale = np.where(lit, scale, 1.0)
        x[~lit] = self.model.mean
        x /= scale.astype(np.float32)[:, None]
        fit = self._fit(x, sky_known, known.flux / scale, known.noise / scale)
        images, fits_in = self._normalise(x, fit)
        measured = Photometry(
            flux=np.where(flux_known, known.flux, fit.flux * scale),
            flux_error=np.where(flux_known, np.nan, fit.error * scale),
            background=np.where(sky_known, sky, sky + fit.sky * scale),
            noise=np.where(np.isfinite(known.noise), known.noise, fit.noise * scale),
            images=images.reshape(stamps.shape),
            used=np.ones(stamps.shape, dtype=bool),
            flags=np.zeros(count, dtype=np.uint16),
        )
        clear = flux_known | (fit.flux > CLEAR * fit.error)
        careful = hidden.any(axis=1) | ~lit | ~clear | ~fits_in
        raise_flag(measured.flags, Flag.FAINT, measured.flux < FAINT_SNR * measured.flux_error)
        self._carefully(np.flatnonzero(careful), stamps, hidden, sky, known, measured)
        return measured

    def _fit(
        self,
        x: np.ndarray,
        sky_known: np.ndarray,
        flux: np.ndarray,
        noise: np.ndarray,
        used: np.ndarray | None = None,
    ) -> _Fit:
        """Fit all stars (n, P) in the space of the leading eigenvectors.

        Flux and noise that are NaN are estimated; `used` (n, P) are the pixels that
        tell the noise.
        """
        total = x.sum(axis=1, dtype=np.float64)
        x = x - (total / self.pixels)[:, None]
        projected = x @ self._projector
        modes, along = projected[:, :-1], projected[:, -1]
        outside = along - modes @ self._modes
        energy = np.einsum("ij,ij->i", x, x) - (modes**2).sum(axis=1)
        # A known sky makes the mean of the stamp a measurement of the flux.
        known = sky_known / self.pixels

        def flux_of(found: np.ndarray, sigma2: np.ndarray, unseen: float) -> tuple[np.ndarray, ...]:
            prior = np.maximum(found, 0.0) ** 2 + sigma2 / self._peak
            weight = 1.0 / (prior[:, None] * self._variance + sigma2[:, None])
            rest = 1.0 / (prior * unseen + sigma2)
            information = weight @ self._modes**2 + rest * self._left + known / sigma2
            signal = (weight * modes) @ self._modes + rest * outside + known * total / sigma2
            found = np.where(np.isfinite(flux), flux, signal / information)
            return found, 1.0 / np.sqrt(information), weight

        found = np.where(np.isfinite(flux), flux, along / (self._left + self._modes @ self._modes))
        for _ in range(ROUNDS):
            left = energy - 2.0 * found * outside + found**2 * self._left
            sigma2 = np.maximum(left / self._others, NOISE_FLOOR**2)
            sigma2 = np.where(np.isfinite(noise), noise**2, sigma2)
            # What the star has beyond the leading eigenvectors is in σ² here.
            found, _, weight = flux_of(found, sigma2, 0.0)
        score = self._border_scores(x, modes, total, found, weight, sigma2, sky_known)
        if used is not None:
            score[~used[:, self._ring]] = np.nan
        scatter = np.where(np.isfinite(noise), 1.0, _clipped_rms(score))
        sigma = np.maximum(np.sqrt(sigma2) * scatter, NOISE_FLOOR)
        found, error, _ = flux_of(found, sigma**2, self._unseen)
        return _Fit(found, error, sigma, np.where(sky_known, 0.0, (total - found) / self.pixels))

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
        """Leave-one-out residuals S⁻¹(x − Fm) of the border in units of their σ, (n, ring)."""
        beyond = weight - 1.0 / sigma2[:, None]
        pull = beyond * (modes - flux[:, None] * self._modes)
        mean = np.where(sky_known, (total - flux) / self.pixels, 0.0)[:, None]
        ring = x[:, self._ring] - flux[:, None] * self._ring_contrast + mean
        residual = ring / sigma2[:, None] + pull @ self._ring_basis
        lost = np.where(sky_known, 0.0, 1.0 / self.pixels)
        precision = beyond @ self._ring_basis**2 + ((1.0 - lost) / sigma2)[:, None]
        return residual / np.sqrt(precision)

    def _normalise(self, x: np.ndarray, fit: _Fit) -> tuple[np.ndarray, np.ndarray]:
        """Images of flux 1, and which of them stay in the range of the training set."""
        usable = fit.flux > 0
        flux = np.where(usable, fit.flux, 1.0)
        images = x - fit.sky.astype(np.float32)[:, None]
        images /= flux.astype(np.float32)[:, None]
        reach = (CLIP * fit.noise / flux).astype(np.float32)[:, None]
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
        known: Known,
        out: Photometry,
    ) -> None:
        """Fit some stars with `robust_flux` and overwrite their rows of `out`."""
        free = ~np.isfinite(known.background[stars])
        for model, members in ((self._free_sky, stars[free]), (self.model, stars[~free])):
            nothing = None
            for begin in range(0, members.size, GROUP):
                group = members[begin : begin + GROUP]
                x = np.tile(self.model.mean, (GROUP, 1))
                flat = stamps[group].reshape(group.size, -1).astype(np.float64)
                x[: group.size] = np.where(hidden[group], np.nan, flat - sky[group, None])
                # Groups without a good pixel, the stars beyond an image, are all the same.
                blind = group.size == GROUP and hidden[group].all()
                estimate = nothing if blind else None
                if estimate is None:
                    estimate = robust_flux(x.reshape(-1, self.side, self.side), model)
                    nothing = estimate if blind else nothing
                self._overwrite(out, group, x, estimate, sky[group], known.part(group))

    def _overwrite(
        self,
        out: Photometry,
        group: np.ndarray,
        x: np.ndarray,
        estimate: FluxEstimate,
        sky: np.ndarray,
        known: Known,
    ) -> None:
        """Rows `group` of `out` from the estimate of the first stamps x (GROUP, P)."""
        count = group.size
        repaired = estimate.images.reshape(GROUP, -1)
        used = np.isclose(repaired, x, rtol=1e-9, atol=0.0)
        given, fitted = np.isfinite(known.flux), np.isfinite(estimate.flux[:count])
        flux = np.where(given, known.flux, estimate.flux[:count])
        fit_flags = estimate.flags[:count].astype(np.uint16)
        lost = ~fitted | ~(flux > 0) | (~given & ((fit_flags & Flag.NO_FLUX) > 0))
        fit_flags &= np.where(given, *(np.uint16(kept) for kept in (KEPT_IF_GIVEN, KEPT_OTHERWISE)))
        raise_flag(fit_flags, Flag.NO_FLUX, lost)
        left = repaired.mean(axis=1)[:count] - np.nan_to_num(estimate.flux[:count]) / self.pixels
        left = np.where(np.isfinite(known.background), 0.0, left)
        images = (repaired[:count] - left[:, None]) / np.where(lost, 1.0, flux)[:, None]
        images[lost] = 0.0
        filled = np.tile(self.model.mean.astype(np.float32), (GROUP, 1))
        filled[:count] = images
        ones = np.ones(GROUP)
        noise = self._fit(filled, ones > 0, ones, np.nan * ones, used).noise[:count] * flux
        noise = np.where(lost, estimate.noise[:count], noise)
        out.flux[group] = flux
        out.flux_error[group] = np.where(given, np.nan, estimate.error[:count])
        out.background[group] = sky + np.where(fitted, left, 0.0)
        out.noise[group] = np.where(np.isfinite(known.noise), known.noise, noise)
        out.images[group] = images.reshape(count, self.side, self.side)
        out.used[group] = used[:count].reshape(count, self.side, self.side)
        out.flags[group] = fit_flags


def _with_free_sky(model: FluxModel) -> FluxModel:
    """The flux model of stars on an unknown constant sky."""
    constant = np.full((model.mean.size, 1), model.mean.size**-0.5)
    if not model.whole:
        # All but the rest of the covariance lives in the space of basis and constant.
        space = np.linalg.qr(np.hstack([model.basis, constant]))[0]
        modes, sky = space.T @ model.basis, space.T @ constant
        inside = (modes * (model.variance - model.rest)) @ modes.T + FREE_SKY * sky @ sky.T
        variance, turn = np.linalg.eigh(inside)
        variance = np.maximum(variance + model.rest, 0.0)
        return replace(model, basis=space @ turn, variance=variance)
    covariance = (model.basis * model.variance) @ model.basis.T
    variance, basis = np.linalg.eigh(covariance + FREE_SKY * constant @ constant.T)
    return replace(model, basis=basis, variance=np.maximum(variance, 0.0))


def _clipped_rms(score: np.ndarray) -> np.ndarray:
    """RMS of each row without outliers, those found by the median of the modulus.

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
    kept = ~unused & (modulus <= SCATTER_CLIP * 1.4826 * median)
    squares = np.where(kept, modulus, 0.0)
    count = kept.sum(axis=1)
    total = np.einsum("ij,ij->i", squares, squares)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), 1.0))
