"""Flux of a star from its stamp by the mean PSF of a training set and its covariance.

`FluxModel` is the mean PSF m and the covariance C of a training set; `robust_flux` fits it to
stamps, which may have bad pixels, and repairs these.

Equation 8 of the paper divides a stamp by its own sum. On a noisy stamp, that sum is itself
uncertain by κλ√P of the flux (P pixels), and one bad pixel ruins it. Here flux F and sky b come
from one generalised least-squares fit (Aitken 1935, Proc. R. Soc. Edinb. 55, 42) of m and a
constant,

    x ~ N(F m + b, S),   S = F²C + σ²I,

with the covariance C of that set as part of the noise. PSFs of the training set sum to 1, hence C
has zero variance along a constant: a bright star is measured by its sum, a faint one by a matched
filter, and all between by the best compromise; and b = mean(x) − F/P.

A dead pixel that reads the sky level looks like another PSF and is not recognised; bad pixels that
are known should be NaN. No star influences another one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from psfdae.base.rows import Rows
from psfdae.image.stamps import StarFlag, raise_flag
from psfdae.stars.moments import SIGMA_OF_MAD

NOISE_FLOOR = 1e-6
"""Minimum σ in units of a typical pixel of the star, as images may be noise-free."""


@dataclass(frozen=True)
class FluxModel:
    """Mean and covariance of the PSFs of a training set.

    Attributes
    ----------
    mean : ndarray, shape (P,)
        Mean PSF m, sum 1.
    basis : ndarray, shape (P, K)
        Eigenvectors of the covariance C, columns; K = P, or fewer for large stamps.
    variance : ndarray, shape (K,)
        Eigenvalues, ascending.
    low, high : ndarray, shape (P,)
        Least and greatest value of every pixel in the set.
    other_variance : float
        Variance along all directions that `basis` leaves out.
    min_pixel_fraction : float
        Fraction of the pixels of a stamp that a fit needs.
    clip_sigma : float
        σ of the noise by which pixels of a star may leave the range of the training set.
    """

    min_pixel_fraction: ClassVar[float] = 0.5
    clip_sigma: ClassVar[float] = 5.0

    mean: np.ndarray
    basis: np.ndarray
    variance: np.ndarray
    low: np.ndarray
    high: np.ndarray
    other_variance: float = 0.0

    @property
    def is_complete(self) -> bool:
        """True if the basis leaves no direction out."""
        return bool(self.basis.shape[1] >= self.mean.size)

    @property
    def pixel_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest value (P,) of a pixel of a star of flux 1 without noise.

        The range of the training set is widened by half for PSFs that the set does not hold, and by
        1 % of the brightest pixel.
        """
        slack = 0.01 * self.high.max()
        return self.low / 1.5 - slack, 1.5 * self.high + slack

    @classmethod
    def fit(cls, images: np.ndarray) -> FluxModel:
        """Return the model of noise-free training stars.

        It takes some 500 stars for bright stars (S/N above 100) to be measured as well as by their
        sum, 40 for faint ones.

        Parameters
        ----------
        images : ndarray, shape (n, d, d)
            Stars of any flux.

        Raises
        ------
        ValueError
            If an image is not finite or its sum is not positive.
        """
        flat = images.reshape(len(images), -1).astype(np.float64)
        total = flat.sum(axis=1, keepdims=True)
        if not (np.isfinite(total).all() and (total > 0).all()):
            raise ValueError("training stars of a flux model must be finite and of positive sum")
        flat /= total
        # C = Σ (x − m)(x − m)ᵀ / n; rounding may make its smallest eigenvalues negative.
        mean = flat.mean(axis=0)
        variance, basis = np.linalg.eigh((flat - mean).T @ (flat - mean) / len(flat))
        return cls(mean, basis, np.maximum(variance, 0.0), flat.min(axis=0), flat.max(axis=0))

    @cached_property
    def with_free_sky(self) -> FluxModel:
        """Model of stars on an unknown constant sky, which few stars need."""
        # An unknown sky is one more direction of C, of a variance that is as good as infinite in
        # units of the flux squared: C + 10⁴ c cᵀ, with the constant c of length 1.
        free_sky_variance = 1e4
        constant = np.full((self.mean.size, 1), self.mean.size**-0.5)
        if not self.is_complete:
            # All but the rest of the covariance, which is the same along all directions, lives in
            # the space of basis and constant.
            space = np.linalg.qr(np.hstack([self.basis, constant]))[0]
            modes, sky = space.T @ self.basis, space.T @ constant
            inside = (modes * (self.variance - self.other_variance)) @ modes.T
            variance, turn = np.linalg.eigh(inside + free_sky_variance * sky @ sky.T)
            variance = np.maximum(variance + self.other_variance, 0.0)
            return replace(self, basis=space @ turn, variance=variance)
        covariance = (self.basis * self.variance) @ self.basis.T
        variance, basis = np.linalg.eigh(covariance + free_sky_variance * constant @ constant.T)
        return replace(self, basis=basis, variance=np.maximum(variance, 0.0))

    def average_variance_beyond(self, components: int) -> float:
        """Return the mean variance along all directions but so many leading eigenvectors."""
        if not self.is_complete:
            return self.other_variance
        # Eigenvalues ascend. Those of a model from a file are equal; rounding of their mean could
        # change the last digit.
        trailing = self.variance[: self.variance.size - components]
        is_even = trailing.size and (trailing == trailing[0]).all()
        return float(trailing[0] if is_even else trailing.sum() / max(trailing.size, 1))


def is_faint(flux: np.ndarray, error: np.ndarray, snr_min: float = 3.0) -> np.ndarray:
    """Return True for stars whose flux is below `snr_min` times its standard error: FAINT."""
    return flux < snr_min * error


def signal_to_noise(noise: float, area: float) -> float:
    """Return the S/N of a star, 1 / (σ √A).

    Parameters
    ----------
    noise : float
        RMS σ of a pixel over the flux of the star.
    area : float
        Noise-equivalent area A in pixels.
    """
    return float(1.0 / (noise * np.sqrt(area)))


@dataclass(frozen=True)
class Photometry(Rows):
    """Photometry of n stamps, in the unit of the stamps; NaN where it is not possible.

    Attributes
    ----------
    flux, background, noise : ndarray, shape (n,)
        Flux of the star, sky per pixel, and RMS of a pixel by the noise of the sky.
    flux_error : ndarray, shape (n,)
        Standard error from the noise of the sky and the variation of the PSF, without the photon
        noise of the star; NaN where the flux was given.
    images : ndarray, shape (n, d, d)
        Stamps without sky and repaired, zero without flux: as they are by `robust_flux`, of flux 1
        and float32 by `psfdae.denoise.star_flux.Photometer`.
    is_used : ndarray of bool, shape (n, d, d)
        Pixels that were measured; the others are repaired.
    flags : ndarray of uint16, shape (n,)
        Sum of the values of `StarFlag`.
    """

    flux: np.ndarray
    flux_error: np.ndarray
    background: np.ndarray
    noise: np.ndarray
    images: np.ndarray
    is_used: np.ndarray
    flags: np.ndarray

    def scale_flux(self, factor: np.ndarray) -> Photometry:
        """Return the same light with fluxes times a factor (n,), the rest of it being sky."""
        # F image + b = f F image' + b', where image' has the sum 1 as well: what the flux has less,
        # the sky has more, b' = b + F (1 − f)/P.
        sky, scale = (1.0 - factor) / self.images[0].size, factor[:, None, None]
        return replace(
            self,
            flux=self.flux * factor,
            background=self.background + self.flux * sky,
            images=((self.images - sky[:, None, None]) / scale).astype(self.images.dtype),
        )


def robust_flux(images: np.ndarray, model: FluxModel) -> Photometry:
    """Fit flux and noise of every stamp, without its bad pixels.

    | stamp | flux | flags |
    |---|---|---|
    | NaN or infinite pixels, less than half | measured | MASKED |
    | saturated, hot or dead pixels | measured | OUTLIER |
    | more than half of the pixels bad | NaN | NO_FLUX and cause |
    | constant, all zero included | NaN | NO_FLUX |
    | flux ≤ 0, or below its own error | measured | NO_FLUX |
    | flux below 3 times its error | measured | FAINT |

    Parameters
    ----------
    images : ndarray, shape (n, d, d)
        Sky-subtracted stamps in any unit, framed as the model's training stars.
    model : FluxModel
        Mean, covariance and range of pixels of the training stars.

    Raises
    ------
    ValueError
        If the stamps have another number of pixels than the model.
    """
    pixels = int(np.prod(images.shape[1:]))
    if pixels != model.mean.size:
        raise ValueError(f"stamps of {pixels} px, but the flux model has {model.mean.size}")
    # A fit is possible with half of the pixels, of which not all are the same.
    flat = images.reshape(len(images), pixels).astype(np.float64)
    finite = np.isfinite(flat)
    flat = np.where(finite, flat, 0.0)
    maximum = flat.max(axis=1, where=finite, initial=-np.inf)
    minimum = flat.min(axis=1, where=finite, initial=np.inf)
    possible = (finite.mean(axis=1) >= model.min_pixel_fraction) & (maximum > minimum)
    # A stand-in for hopeless stars: linear algebra on fewer rows would round the others anew.
    x = np.where(possible[:, None], flat, model.mean)
    usable_pixel = finite | ~possible[:, None]
    # Unit of the fit: median modulus of the pixels, or the largest one if that is zero. Pixels
    # beyond 10¹⁵ of it are cut, so that no square overflows.
    modulus = np.abs(x)
    unit = np.median(modulus, axis=1)
    unit = np.where(unit > 0, unit, modulus.max(axis=1))
    with np.errstate(over="ignore"):
        scaled_pixels = np.clip(x / unit[:, None], -1e15, 1e15)
    flux, error, sigma, is_used, repaired_pixels = _robust_fit(scaled_pixels, usable_pixel, model)
    # Flags: NO_FLUX if too few pixels are left, or the flux is below its error.
    is_fitted = possible & (is_used.mean(axis=1) >= model.min_pixel_fraction)
    usable = is_fitted & (flux > error)
    flags = np.zeros(len(images), np.uint16)
    raise_flag(flags, StarFlag.MASKED, ~finite.all(axis=1))
    raise_flag(flags, StarFlag.OUTLIER, possible & (is_used < usable_pixel).any(axis=1))
    raise_flag(flags, StarFlag.FAINT, usable & is_faint(flux, error))
    raise_flag(flags, StarFlag.NO_FLUX, ~usable)
    flux, error, sigma = (np.where(is_fitted, v * unit, np.nan) for v in (flux, error, sigma))
    repaired_pixels = np.where(is_fitted[:, None], repaired_pixels * unit[:, None], 0.0)
    is_used = is_used & is_fitted[:, None]
    stamps = (repaired_pixels.reshape(images.shape), is_used.reshape(images.shape))
    return Photometry(flux, error, np.zeros(len(flux)), sigma, *stamps, flags)


def _robust_fit(
    x: np.ndarray, finite: np.ndarray, model: FluxModel
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Fit flux and noise, and leave out pixels that are beyond the range of the training set.

    Parameters
    ----------
    x : ndarray, shape (n, P)
        Stamps in units of a typical pixel of each star.
    finite : ndarray of bool, shape (n, P)
        Pixels that may be used.
    model : FluxModel
        Mean, covariance and range of pixels of the training stars.

    Returns
    -------
    flux, error, sigma : ndarray, shape (n,)
        Flux, its standard error, and σ of the noise in a pixel, in the unit of x.
    is_used : ndarray of bool, shape (n, P)
        Pixels within the range of the training set.
    repaired_pixels : ndarray, shape (n, P)
        Stamps with the other pixels at their conditional expectation.
    """

    def scatter(modulus: np.ndarray, is_used: np.ndarray) -> np.ndarray:
        """Return σ (n,) of a normal variable from the median of its modulus in used pixels."""
        return SIGMA_OF_MAD * np.nanmedian(np.where(is_used, modulus, np.nan), axis=1)

    # Start: the flux that minimises Σ|x − F m|, which is the median of x/m with weights m. Bad
    # pixels cannot move it far: together they weigh what the mean PSF has on them.
    lit = model.mean > 1e-6 * model.mean.max()
    ratio = x[:, lit] / model.mean[lit]
    weight = np.where(finite[:, lit], model.mean[lit], 0.0)
    order = np.argsort(ratio, axis=1)
    share = np.cumsum(np.take_along_axis(weight, order, axis=1), axis=1)
    middle = (share >= 0.5 * share[:, -1:]).argmax(axis=1)
    median_index = np.take_along_axis(order, middle[:, None], axis=1)
    flux = np.take_along_axis(ratio, median_index, axis=1)[:, 0]
    first_sigma = scatter(np.abs(x - flux[:, None] * model.mean), finite)
    sigma = np.maximum(first_sigma, NOISE_FLOOR)
    low, high = model.pixel_range
    # Flux, noise and outliers settle in three or four rounds.
    for _ in range(5):
        positive = np.maximum(flux, 0.0)[:, None]
        noise = model.clip_sigma * sigma[:, None]
        is_used = finite & (x <= positive * high + noise) & (x >= positive * low - noise)
        # A star without enough pixels is given up; its numbers only have to be defined.
        has_pixels = is_used.mean(axis=1, keepdims=True) >= model.min_pixel_fraction
        in_fit = np.where(has_pixels, is_used, finite)
        # F² in S, from the last round, and never below the variance of F by the noise alone.
        prior = np.maximum(flux, 0.0) ** 2 + sigma**2 / (model.mean @ model.mean)
        flux, error, score, repaired_pixels = solve_least_squares(x, in_fit, prior, sigma, model)
        # Scores have a standard deviation of 1 if σ is right.
        sigma = np.maximum(sigma * np.clip(scatter(score, in_fit), 0.2, 1.5), NOISE_FLOOR)
    return flux, error, sigma, is_used, repaired_pixels


def solve_least_squares(
    x: np.ndarray, is_used: np.ndarray, prior: np.ndarray, sigma: np.ndarray, model: FluxModel
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Fit the flux with S = prior · C + σ²I over the used pixels of every star.

    In the eigenbasis B of C all stars are solved at once; directions without an eigenvector of
    their own share one weight w₀, S⁻¹ = B (w − w₀) Bᵀ + w₀. Unused pixels get the values at which
    they carry no weight, S⁻¹x = 0 there; sums over all pixels are then sums over the used ones.

    Parameters
    ----------
    x : ndarray, shape (n, P)
        Stamps without sky, in units of a typical pixel of each star.
    is_used : ndarray of bool, shape (n, P)
        Pixels that are fitted.
    prior, sigma : ndarray, shape (n,)
        Square of the flux in S, and σ of the noise in a pixel.
    model : FluxModel
        Mean, covariance and range of pixels of the training stars.

    Returns
    -------
    flux, error : ndarray, shape (n,)
        F and its standard error, in the unit of x.
    score : ndarray, shape (n, P)
        |Leave-one-out residual| in units of its standard deviation.
    repaired_pixels : ndarray, shape (n, P)
        Stamps with the unused pixels at their conditional expectation.
    """
    # w₀, w − w₀, and the diagonal of S⁻¹.
    common = 0.0 * sigma if model.is_complete else 1.0 / (prior * model.other_variance + sigma**2)
    weight = 1.0 / (prior[:, None] * model.variance + sigma[:, None] ** 2) - common[:, None]
    precision = weight @ (model.basis**2).T + common[:, None]
    data = np.where(is_used, x, 0.0)
    mean = np.where(is_used, model.mean, 0.0)
    # Unused pixels b: x_b = −(S⁻¹_bb)⁻¹ S⁻¹_bu x_u, and the same for m. The inverse of S over the
    # used pixels has the diagonal of S⁻¹ − S⁻¹_ub (S⁻¹_bb)⁻¹ S⁻¹_bu.
    for star in np.flatnonzero(~is_used.all(axis=1)):
        bad = np.flatnonzero(~is_used[star])
        if model.is_complete:
            columns = (model.basis * weight[star]) @ model.basis[bad].T
            gain = columns @ np.linalg.inv(columns[bad])
            data[star, bad] = -data[star] @ gain
            mean[star, bad] = -mean[star] @ gain
            precision[star] -= (gain * columns).sum(axis=1)
        else:
            # The same by Woodbury's identity, in the space of K eigenvectors: S⁻¹_ub (S⁻¹_bb)⁻¹ =
            # B_u R B_bᵀ with R = (w₀ + (w − w₀) G)⁻¹ (w − w₀) and G = B_bᵀB_b.
            rows, excess = model.basis[bad], weight[star]
            gram, identity = rows.T @ rows, np.eye(excess.size)
            # Modes that lie in the unused pixels alone would make it singular, but for the last
            # digits.
            system = common[star] * (1.0 + 1e-12) * identity + excess[:, None] * gram
            solution = np.linalg.solve(system, np.diag(excess))
            correction = excess[:, None] * (identity - gram @ solution) / common[star]
            fill = correction @ rows.T
            data[star, bad] = -(data[star] @ model.basis) @ fill
            mean[star, bad] = -(mean[star] @ model.basis) @ fill
            # The diagonal of S⁻¹ falls by the diagonal of B R G (w − w₀) Bᵀ.
            loss = (correction @ gram) * excess
            precision[star] -= ((model.basis @ loss) * model.basis).sum(axis=1)
    # F = mᵀS⁻¹x / mᵀS⁻¹m, and its variance 1 / mᵀS⁻¹m.
    data_modes, mean_modes = data @ model.basis, mean @ model.basis
    information = (mean_modes**2 * weight).sum(axis=1) + common * (mean**2).sum(axis=1)
    signal = (mean_modes * data_modes * weight).sum(axis=1) + common * (mean * data).sum(axis=1)
    flux = signal / information
    # S⁻¹(x − F m), whose elements have the variances of the diagonal of S⁻¹.
    residual = ((data_modes - flux[:, None] * mean_modes) * weight) @ model.basis.T
    residual += common[:, None] * (data - flux[:, None] * mean)
    score = np.abs(residual) / np.sqrt(np.where(is_used, precision, 1.0))
    repaired_pixels = np.where(is_used, x, data + flux[:, None] * (model.mean - mean))
    return flux, 1.0 / np.sqrt(information), score, repaired_pixels
