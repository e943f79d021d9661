"""Flux of star images whose true flux nobody knows, and what to do with broken ones.

Equation 8 of the paper divides a stamp by its own sum. On a noisy stamp the sum is
itself uncertain by κλ√P of the flux (P pixels), and one bad pixel ruins it. Here
the flux comes from a generalised least-squares fit of the mean PSF m of a training
set, with the covariance C of that set as part of the noise,

    x ~ N(F m, S),   S = F²C + σ²I,   F = mᵀS⁻¹x / mᵀS⁻¹m,

the best linear unbiased estimate (Aitken 1935, Proc. R. Soc. Edinb. 55, 42). PSFs
of the training set sum to 1, hence C has no part along the sum: a bright star is
measured by its sum, a faint one by a matched filter, and all between by the best
compromise. Pixels that are not finite, or that no star of the training set can
have at this flux, are left out of the fit and replaced by what the other pixels
make of them.

What comes out for stars that are not as they should be (stamps are sky-subtracted,
in any unit):

| stamp | `sum_flux` | `robust_flux` | flags | normalised image |
|---|---|---|---|---|
| NaN or infinite pixels, less than half | NaN | measured | NONFINITE | repaired |
| saturated, hot or dead pixels | wrong | measured | OUTLIER | repaired |
| more than half of the pixels bad | NaN or wrong | NaN | NO_FLUX and cause | 0 |
| constant, all zero included | its sum | NaN | NO_FLUX | 0 |
| flux ≤ 0, or below its own error | its sum | measured | NO_FLUX | 0 |
| flux below 3 times its error | its sum | measured | FAINT | as usual |

A dead pixel that reads the sky level looks like another PSF and is not recognised;
bad pixels that are known should be NaN. No star influences another one.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntFlag

import numpy as np


class Flag(IntFlag):
    """What is wrong with a star; flags add up."""

    NONFINITE = 1  # pixels that are NaN or infinite
    OUTLIER = 2  # pixels that no star of this flux has
    FAINT = 4  # flux below `FAINT_SNR` times its error
    NO_FLUX = 8  # no usable flux: the normalised image is zero


FAINT_SNR = 3.0
"""Flux in units of its error below which a star is faint."""

KEPT = 0.5
"""Part of the pixels that must be left for a fit."""

CLIP = 5.0
"""Pixels may leave the range of the training set by this many σ of the noise."""

MARGIN = 1.5
"""Factor by which the range of the training set is widened, for PSFs it does not hold."""

SLACK = 0.01
"""Excursions up to this part of the brightest training pixel are no outliers, either."""

ROUNDS = 5
"""Fits per star; flux, noise and outliers settle in three or four."""

NOISE_FLOOR = 1e-6
"""Least σ in units of a star's median pixel; images without noise have none of their own."""

LARGEST = 1e15
"""Pixels are cut at this many times the median pixel, so that no square overflows."""

CHUNK = 2048
"""Stars per pass; bounds the memory."""


@dataclass(frozen=True)
class FluxModel:
    """What a training set of PSFs looks like.

    Attributes
    ----------
    mean : ndarray, shape (P,)
        Mean PSF, sum 1.
    basis : ndarray, shape (P, K)
        Eigenvectors of the covariance, columns; K = P, or fewer for large stamps.
    variance : ndarray, shape (K,)
        Eigenvalues.
    low, high : ndarray, shape (P,)
        Least and greatest value of every pixel in the set.
    rest : float
        Variance along all directions that `basis` leaves out.
    """

    mean: np.ndarray
    basis: np.ndarray
    variance: np.ndarray
    low: np.ndarray
    high: np.ndarray
    rest: float = 0.0

    @property
    def whole(self) -> bool:
        """The basis leaves no direction out."""
        return self.basis.shape[1] >= self.mean.size

    @classmethod
    def fit(cls, images: np.ndarray) -> FluxModel:
        """Model of noise-free training stars, shape (n, d, d), of any flux.

        It takes some 500 stars for bright stars (signal to noise above 100) to be
        measured as well as by their sum, 40 for faint ones.

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
        mean = flat.mean(axis=0)
        variance, basis = np.linalg.eigh((flat - mean).T @ (flat - mean) / len(flat))
        return cls(mean, basis, np.maximum(variance, 0.0), flat.min(axis=0), flat.max(axis=0))


@dataclass(frozen=True)
class FluxEstimate:
    """Fluxes of stars, in the unit of their images.

    Attributes
    ----------
    flux, error : ndarray, shape (n,), float64
        Estimate and standard error (sky noise and PSF variation; the star's own
        photons are not in it). NaN where no fit was possible.
    noise : ndarray, shape (n,), float64
        RMS σ of a pixel's noise, from the residuals. NaN where no fit was possible.
    flags : ndarray, shape (n,), uint8
        Sum of `Flag`s, 0 for a star without complaint.
    images : ndarray, shape (n, d, d), float64
        The stamps with bad pixels replaced; zero where no fit was possible.
    """

    flux: np.ndarray
    error: np.ndarray
    noise: np.ndarray
    flags: np.ndarray
    images: np.ndarray


def sum_flux(images: np.ndarray) -> np.ndarray:
    """Sum of every stamp (eq. 8), shape (n,), float64; NaN where a pixel is not finite."""
    flat = _flat(images).astype(np.float64)
    finite = np.isfinite(flat)
    return np.where(finite.all(axis=1), np.where(finite, flat, 0.0).sum(axis=1), np.nan)


def robust_flux(images: np.ndarray, model: FluxModel) -> FluxEstimate:
    """Generalised least-squares flux of every stamp; see the module for broken stamps.

    Parameters
    ----------
    images : ndarray, shape (n, d, d)
        Sky-subtracted stamps in any unit, framed as those of the model.
    model : FluxModel

    Raises
    ------
    ValueError
        If the stamps have another number of pixels than the model.
    """
    flat = _flat(images)
    if flat.shape[1] != model.mean.size:
        raise ValueError(f"stamps of {flat.shape[1]} px, but the flux model has {model.mean.size}")
    count = len(flat)
    out = FluxEstimate(
        *(np.full(count, np.nan) for _ in range(3)),
        np.zeros(count, np.uint8),
        np.zeros(flat.shape),
    )
    for start in range(0, count, CHUNK):
        part = slice(start, start + CHUNK)
        chunk = (getattr(out, field.name)[part] for field in fields(out))
        _measure(flat[part].astype(np.float64), model, FluxEstimate(*chunk))
    return replace(out, images=out.images.reshape(images.shape))


def normalise_images(images: np.ndarray, flux: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Images divided by their flux, defined for every input.

    Parameters
    ----------
    images : ndarray, shape (n, d, d)
    flux : ndarray, shape (n,)
        In the unit of the images, from whatever source.

    Returns
    -------
    normalised : ndarray, shape (n, d, d), float32
        Finite. Zero for pixels that are not finite, and for whole stars whose flux
        is not positive or so small that the quotient overflows.
    flags : ndarray, shape (n,), uint8
        NONFINITE and NO_FLUX where that happened.
    """
    finite = np.isfinite(images)
    good = np.isfinite(flux) & (flux > 0)
    divisor = np.where(good, flux, 1.0)[:, None, None]
    with np.errstate(over="ignore"):
        normalised = (np.where(finite, images, 0.0) / divisor).astype(np.float32)
    good &= np.isfinite(normalised).all(axis=(1, 2))
    normalised[~good] = 0.0
    flags = np.where(finite.all(axis=(1, 2)), 0, Flag.NONFINITE) | np.where(good, 0, Flag.NO_FLUX)
    return normalised, flags.astype(np.uint8)


def normalise_robustly(images: np.ndarray, model: FluxModel) -> tuple[np.ndarray, FluxEstimate]:
    """What the network should see of real stamps: repaired and divided by a robust flux.

    Returns
    -------
    normalised : ndarray, shape (n, d, d), float32
        Finite; zero for stars flagged NO_FLUX.
    estimate : FluxEstimate
    """
    estimate = robust_flux(images, model)
    usable = (estimate.flags & Flag.NO_FLUX) == 0
    normalised, flags = normalise_images(estimate.images, np.where(usable, estimate.flux, np.nan))
    return normalised, replace(estimate, flags=estimate.flags | flags)


def _measure(flat: np.ndarray, model: FluxModel, out: FluxEstimate) -> None:
    """Fill `out`, views of one chunk, from stamps of shape (n, P)."""
    finite = np.isfinite(flat)
    possible = finite.mean(axis=1) >= KEPT
    flat = np.where(finite, flat, 0.0)
    possible &= flat.max(axis=1, where=finite, initial=-np.inf) > flat.min(
        axis=1, where=finite, initial=np.inf
    )
    # A stand-in for hopeless stars: linear algebra on fewer rows would round the others anew.
    x = np.where(possible[:, None], flat, model.mean)
    usable_pixel = finite | ~possible[:, None]
    unit = _unit(x)
    with np.errstate(over="ignore"):
        scaled = np.clip(x / unit[:, None], -LARGEST, LARGEST)
    flux, error, sigma, kept, repaired = _fit(scaled, usable_pixel, model)
    fitted = possible & (kept.mean(axis=1) >= KEPT)
    out.flux[fitted] = (flux * unit)[fitted]
    out.error[fitted] = (error * unit)[fitted]
    out.noise[fitted] = (sigma * unit)[fitted]
    out.images[fitted] = (repaired * unit[:, None])[fitted]
    usable = fitted & (flux > error)
    for flag, stars in (
        (Flag.NONFINITE, ~finite.all(axis=1)),
        (Flag.OUTLIER, possible & (kept < usable_pixel).any(axis=1)),
        (Flag.FAINT, usable & (flux < FAINT_SNR * error)),
        (Flag.NO_FLUX, ~usable),
    ):
        out.flags[stars] |= np.uint8(flag)


def _flat(images: np.ndarray) -> np.ndarray:
    return images.reshape(len(images), int(np.prod(images.shape[1:])))


def _unit(flat: np.ndarray) -> np.ndarray:
    """Median modulus of the pixels of every star, or the largest one if that is zero."""
    modulus = np.abs(flat)
    median = np.median(modulus, axis=1) if len(flat) else np.empty(0)
    return np.where(median > 0, median, modulus.max(axis=1, initial=0.0))


def _fit(
    x: np.ndarray, finite: np.ndarray, model: FluxModel
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Flux, error, σ, pixels kept and repaired stamps, in units of a star's median pixel."""
    flux = _least_absolute(x, finite, model.mean)
    first = _scatter(np.abs(x - flux[:, None] * model.mean), finite)
    sigma = np.maximum(first, NOISE_FLOOR)
    limit = SLACK * model.high.max()
    for _ in range(ROUNDS):
        positive = np.maximum(flux, 0.0)[:, None]
        noise = CLIP * sigma[:, None]
        kept = finite & (x <= positive * (MARGIN * model.high + limit) + noise)
        kept &= x >= positive * (model.low / MARGIN - limit) - noise
        # A star without enough pixels is given up; its numbers only have to be defined.
        used = np.where((kept.mean(axis=1) >= KEPT)[:, None], kept, finite)
        prior = np.maximum(flux, 0.0) ** 2 + sigma**2 / (model.mean @ model.mean)
        flux, error, score, repaired = _generalised_least_squares(x, used, prior, sigma, model)
        sigma = np.maximum(sigma * np.clip(_scatter(score, used), 0.2, 1.5), NOISE_FLOOR)
    return flux, error, sigma, kept, repaired


def _least_absolute(x: np.ndarray, finite: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Flux that minimises Σ|x − F m|: the median of x/m with weights m.

    A start that bad pixels cannot move far: together they weigh what the mean
    PSF has on them.
    """
    lit = mean > 1e-6 * mean.max()
    ratio = x[:, lit] / mean[lit]
    weight = np.where(finite[:, lit], mean[lit], 0.0)
    order = np.argsort(ratio, axis=1)
    share = np.cumsum(np.take_along_axis(weight, order, axis=1), axis=1)
    middle = (share >= 0.5 * share[:, -1:]).argmax(axis=1)
    chosen = np.take_along_axis(order, middle[:, None], axis=1)
    return np.take_along_axis(ratio, chosen, axis=1)[:, 0]


def _scatter(modulus: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Standard deviation of a normal variable from the median of its modulus."""
    if not len(modulus):
        return np.empty(0)
    return 1.4826 * np.nanmedian(np.where(used, modulus, np.nan), axis=1)


def _generalised_least_squares(
    x: np.ndarray, used: np.ndarray, prior: np.ndarray, sigma: np.ndarray, model: FluxModel
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """One fit with S = prior·C + σ²I over the used pixels of every star.

    In the eigenbasis of C all stars are solved at once; directions without an
    eigenvector of their own share one weight, S⁻¹ = B (w − w₀) Bᵀ + w₀. Unused pixels get the
    values at which they carry no weight, S⁻¹x = 0 there; the sums over all pixels
    are then those over the used ones.

    Returns
    -------
    flux, error : ndarray, shape (n,)
    score : ndarray, shape (n, P)
        |Leave-one-out residual| in units of its standard deviation.
    repaired : ndarray, shape (n, P)
        Stamps with the unused pixels at their conditional expectation.
    """
    common = 0.0 * sigma if model.whole else 1.0 / (prior * model.rest + sigma**2)
    weight = 1.0 / (prior[:, None] * model.variance + sigma[:, None] ** 2) - common[:, None]
    precision = weight @ (model.basis**2).T + common[:, None]
    data = np.where(used, x, 0.0)
    mean = np.where(used, model.mean, 0.0)
    for star in np.flatnonzero(~used.all(axis=1)):
        bad = np.flatnonzero(~used[star])
        if model.whole:
            columns = (model.basis * weight[star]) @ model.basis[bad].T
            gain = columns @ np.linalg.inv(columns[bad])
            data[star, bad] = -data[star] @ gain
            mean[star, bad] = -mean[star] @ gain
            precision[star] -= (gain * columns).sum(axis=1)
        else:
            fill, seen = _reduced(model.basis[bad], weight[star], common[star])
            data[star, bad] = -(data[star] @ model.basis) @ fill
            mean[star, bad] = -(mean[star] @ model.basis) @ fill
            precision[star] -= ((model.basis @ seen) * model.basis).sum(axis=1)
    data_modes, mean_modes = data @ model.basis, mean @ model.basis
    information = (mean_modes**2 * weight).sum(axis=1) + common * (mean**2).sum(axis=1)
    signal = (mean_modes * data_modes * weight).sum(axis=1) + common * (mean * data).sum(axis=1)
    flux = signal / information
    residual = ((data_modes - flux[:, None] * mean_modes) * weight) @ model.basis.T
    residual += common[:, None] * (data - flux[:, None] * mean)
    score = np.abs(residual) / np.sqrt(np.where(used, precision, 1.0))
    repaired = np.where(used, x, data + flux[:, None] * (model.mean - mean))
    return flux, 1.0 / np.sqrt(information), score, repaired


def _reduced(rows: np.ndarray, weight: np.ndarray, common: float) -> tuple[np.ndarray, np.ndarray]:
    """The same for unused pixels by Woodbury's identity, in the space of K eigenvectors.

    Parameters
    ----------
    rows : ndarray, shape (b, K)
        Of the basis, those of the unused pixels.
    weight : ndarray, shape (K,)
        Beyond the common one.
    common : float

    Returns
    -------
    fill : ndarray, shape (K, b)
        From a star's modes to what its unused pixels lack.
    seen : ndarray, shape (K, K)
        Form by which the precision of the used pixels falls.
    """
    gram = rows.T @ rows
    # Modes that lie in the unused pixels alone would make it singular, but for the last digits.
    system = common * (1.0 + 1e-12) * np.eye(weight.size) + weight[:, None] * gram
    inner = np.linalg.solve(system, np.diag(weight))
    left = weight[:, None] * (np.eye(weight.size) - gram @ inner) / common
    return left @ rows.T, (left @ gram) * weight
