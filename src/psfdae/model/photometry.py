"""Flux, sky and noise of a star from its own stamp, and the image for the network.

Equation 8 of the paper divides a stamp by its own sum. On a noisy stamp the sum is
itself uncertain by κλ√P of the flux (P pixels), and one bad pixel ruins it. Here flux
F and sky b come from one generalised least-squares fit (Aitken 1935, Proc. R. Soc.
Edinb. 55, 42) of the mean PSF m of the training set and a constant,

    x ~ N(F m + b, S),   S = F²C + σ²I,

with the covariance C of that set as part of the noise. PSFs of the training set sum to
1, hence C has no part along a constant: a bright star is measured by its sum, a faint
one by a matched filter, and all between by the best compromise; and b = mean(x) − F/P.
The median of the border is only the start: PSFs with wings have light there, which the
fit knows of. The noise σ is the scatter of the border's residuals in units of what the
fit expects there, so light of the star in the border is no noise.

There are two solvers of the same equations, because neither can do the other's work
at the same cost or to the same digits. `Photometer` fits stars without bad pixels all at
once in the space of C's leading eigenvectors. A star whose pixels leave the range of
the training set, or with bad pixels, goes to `robust_flux`, which knows all of C,
leaves such pixels out and replaces them by what the other pixels make of them. A dead
pixel that reads the sky level looks like another PSF and is not recognised; bad pixels
that are known should be NaN. No star influences another one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from psfdae.image.stamps import Stamps, StarFlag, border_pixels, raise_flag
from psfdae.moments import SIGMA_OF_MAD

FAINT_SNR = 3.0  # flux in units of its error below which a star is faint
CLIP = 5.0  # σ of the noise by which pixels may leave the range of the training set
MARGIN = 1.5  # factor by which that range is widened, for PSFs that the set does not hold
SLACK = 0.01  # excursions up to this part of the brightest training pixel are no outliers, either
NOISE_FLOOR = 1e-6  # least σ in units of a star's median pixel; images may have no noise

# Of `robust_flux`.
KEPT = 0.5  # part of the pixels that must be left for a fit
LARGEST = 1e15  # pixels are cut at this many times the median pixel, so that no square overflows

# Fits of a star by `robust_flux`, where flux, noise and outliers settle in three or four, and
# updates of flux and noise by `Photometer`, where they settle in three.
ROBUST_ROUNDS, UPDATES = 5, 4

# Of `Photometer`.
CLEAR = 2.0  # stars of less flux than this times its error are fitted carefully
GROUP = 16  # stars per careful fit, always filled: other sizes would round otherwise
FREE_SKY = 1e4  # variance of an unknown sky in units of the flux squared: as good as infinite
SCATTER_CLIP = 4.0  # residuals beyond this many σ do not count for the noise
# Flags of `robust_flux` that hold for a star whose flux is given, and for others.
KEPT_IF_GIVEN = StarFlag.MASKED | StarFlag.OUTLIER
KEPT_OTHERWISE = KEPT_IF_GIVEN | StarFlag.FAINT
# A flux of less than this times the brightest pixel has no image in single precision.
TINY = 1.0 / float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class FluxModel:
    """Mean and covariance of the PSFs of a training set.

    Attributes
    ----------
    mean : ndarray, shape (P,)
        Mean PSF, sum 1.
    basis : ndarray, shape (P, K)
        Eigenvectors of the covariance, columns; K = P, or fewer for large stamps.
    variance : ndarray, shape (K,)
        Eigenvalues, ascending.
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
        return bool(self.basis.shape[1] >= self.mean.size)

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

    def with_free_sky(self) -> FluxModel:
        """The model of stars on an unknown constant sky."""
        constant = np.full((self.mean.size, 1), self.mean.size**-0.5)
        if not self.whole:
            # All but the rest of the covariance lives in the space of basis and constant.
            space = np.linalg.qr(np.hstack([self.basis, constant]))[0]
            modes, sky = space.T @ self.basis, space.T @ constant
            inside = (modes * (self.variance - self.rest)) @ modes.T + FREE_SKY * sky @ sky.T
            variance, turn = np.linalg.eigh(inside)
            variance = np.maximum(variance + self.rest, 0.0)
            return replace(self, basis=space @ turn, variance=variance)
        covariance = (self.basis * self.variance) @ self.basis.T
        variance, basis = np.linalg.eigh(covariance + FREE_SKY * constant @ constant.T)
        return replace(self, basis=basis, variance=np.maximum(variance, 0.0))


def signal_to_noise(noise: float, area: float) -> float:
    """S/N of a star from the pixel RMS over its flux and the noise-equivalent area in pixels."""
    return float(1.0 / (noise * np.sqrt(area)))


# Few stars with care.


@dataclass(frozen=True)
class FluxEstimate:
    """Fluxes of n stars; NaN and an image of zeros where no fit was possible."""

    flux: np.ndarray
    error: np.ndarray  # standard: sky noise and PSF variation, but not the star's own photons
    noise: np.ndarray  # RMS of a pixel, from the residuals
    flags: np.ndarray  # MASKED, OUTLIER, FAINT or NO_FLUX, uint16
    images: np.ndarray  # (n, d, d), float64, with bad pixels replaced


def robust_flux(images: np.ndarray, model: FluxModel) -> FluxEstimate:
    """Generalised least-squares flux of every stamp, and what to do with broken ones.

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
        Sky-subtracted stamps in any unit, framed as those of the model.
    model : FluxModel

    Raises
    ------
    ValueError
        If the stamps have another number of pixels than the model.
    """
    pixels = int(np.prod(images.shape[1:]))
    if pixels != model.mean.size:
        raise ValueError(f"stamps of {pixels} px, but the flux model has {model.mean.size}")
    flat = images.reshape(len(images), pixels).astype(np.float64)
    finite = np.isfinite(flat)
    possible = finite.mean(axis=1) >= KEPT
    flat = np.where(finite, flat, 0.0)
    possible &= flat.max(axis=1, where=finite, initial=-np.inf) > flat.min(
        axis=1, where=finite, initial=np.inf
    )
    # A stand-in for hopeless stars: linear algebra on fewer rows would round the others anew.
    x = np.where(possible[:, None], flat, model.mean)
    usable_pixel = finite | ~possible[:, None]
    # Median modulus of the pixels, or the largest one if that is zero.
    modulus = np.abs(x)
    unit = np.median(modulus, axis=1)
    unit = np.where(unit > 0, unit, modulus.max(axis=1))
    with np.errstate(over="ignore"):
        scaled = np.clip(x / unit[:, None], -LARGEST, LARGEST)
    flux, error, sigma, is_used, repaired = _robust_fit(scaled, usable_pixel, model)
    fitted = possible & (is_used.mean(axis=1) >= KEPT)
    usable = fitted & (flux > error)
    flags = np.zeros(len(images), np.uint16)
    raise_flag(flags, StarFlag.MASKED, ~finite.all(axis=1))
    raise_flag(flags, StarFlag.OUTLIER, possible & (is_used < usable_pixel).any(axis=1))
    raise_flag(flags, StarFlag.FAINT, usable & (flux < FAINT_SNR * error))
    raise_flag(flags, StarFlag.NO_FLUX, ~usable)
    flux, error, sigma = (np.where(fitted, v * unit, np.nan) for v in (flux, error, sigma))
    repaired = np.where(fitted[:, None], repaired * unit[:, None], 0.0)
    return FluxEstimate(flux, error, sigma, flags, repaired.reshape(images.shape))


def _robust_fit(
    x: np.ndarray, finite: np.ndarray, model: FluxModel
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Flux, error, σ, pixels kept and repaired stamps, in units of a star's median pixel."""
    flux = _least_absolute(x, finite, model.mean)
    first = _scatter(np.abs(x - flux[:, None] * model.mean), finite)
    sigma = np.maximum(first, NOISE_FLOOR)
    limit = SLACK * model.high.max()
    for _ in range(ROBUST_ROUNDS):
        positive = np.maximum(flux, 0.0)[:, None]
        noise = CLIP * sigma[:, None]
        is_used = finite & (x <= positive * (MARGIN * model.high + limit) + noise)
        is_used &= x >= positive * (model.low / MARGIN - limit) - noise
        # A star without enough pixels is given up; its numbers only have to be defined.
        used = np.where((is_used.mean(axis=1) >= KEPT)[:, None], is_used, finite)
        prior = np.maximum(flux, 0.0) ** 2 + sigma**2 / (model.mean @ model.mean)
        flux, error, score, repaired = _generalised_least_squares(x, used, prior, sigma, model)
        sigma = np.maximum(sigma * np.clip(_scatter(score, used), 0.2, 1.5), NOISE_FLOOR)
    return flux, error, sigma, is_used, repaired


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
    median_index = np.take_along_axis(order, middle[:, None], axis=1)
    return np.take_along_axis(ratio, median_index, axis=1)[:, 0]


def _scatter(modulus: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Standard deviation of a normal variable from the median of its modulus."""
    return SIGMA_OF_MAD * np.nanmedian(np.where(used, modulus, np.nan), axis=1)


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
            fill, is_visible = _reduced(model.basis[bad], weight[star], common[star])
            data[star, bad] = -(data[star] @ model.basis) @ fill
            mean[star, bad] = -(mean[star] @ model.basis) @ fill
            precision[star] -= ((model.basis @ is_visible) * model.basis).sum(axis=1)
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

    From the basis' rows (b, K) of the unused pixels and the weights beyond the common
    one: (K, b) from a star's modes to what its unused pixels lack, and the form (K, K)
    by which the precision of the used pixels falls.
    """
    gram = rows.T @ rows
    # Modes that lie in the unused pixels alone would make it singular, but for the last digits.
    system = common * (1.0 + 1e-12) * np.eye(weight.size) + weight[:, None] * gram
    solution = np.linalg.solve(system, np.diag(weight))
    reduced = weight[:, None] * (np.eye(weight.size) - gram @ solution) / common
    return reduced @ rows.T, (reduced @ gram) * weight


# Many stars at once.


@dataclass(frozen=True)
class Photometry:
    """Photometry of n stamps, in the unit of the stamps; NaN where it is not possible."""

    flux: np.ndarray
    flux_error: np.ndarray  # NaN where the flux was given
    background: np.ndarray
    noise: np.ndarray
    images: np.ndarray  # (n, d, d), float32: sky-subtracted, repaired, of flux 1; zero without flux
    used: np.ndarray  # (n, d, d): pixels that were measured; the others are repaired
    flags: np.ndarray  # uint16

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
        """The same light with fluxes times a factor (n,), the rest of it being sky."""
        sky, scale = (1.0 - factor) / self.images[0].size, factor[:, None, None]
        return replace(
            self,
            flux=self.flux * factor,
            background=self.background + self.flux * sky,
            images=((self.images - sky[:, None, None]) / scale).astype(self.images.dtype),
        )


class _Fit(NamedTuple):
    """Flux, error, noise and sky left over, in units of each star's scale."""

    flux: np.ndarray
    error: np.ndarray
    noise: np.ndarray
    sky: np.ndarray


class Photometer:
    """Measures stars against the training set of a network.

    The fast fit knows of as many leading eigenvectors as `components`; what the star has
    beyond them counts as noise, so that of a very bright star is overestimated.
    """

    def __init__(self, model: FluxModel, components: int) -> None:
        self.model = model
        self.pixels = pixels = model.mean.size
        self.side = round(pixels**0.5)
        # At least a quarter of the directions must be left to tell the noise.
        leading_count = min(components, 3 * pixels // 4)
        leading = model.basis[:, -leading_count:]
        self._variance = model.variance[-leading_count:]
        self._peak = float(model.mean @ model.mean)
        unseen = model.variance[: pixels - leading_count] if model.whole else np.array([model.rest])
        self._unseen = float(unseen.mean())
        self._others = pixels - 1 - leading_count
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

    @cached_property
    def _free_sky(self) -> FluxModel:
        """The model of stars on an unknown sky, which few stars with bad pixels ask for."""
        return self.model.with_free_sky()

    def measure(
        self, stamps: np.ndarray, bad: np.ndarray, start: np.ndarray, stated: Stamps
    ) -> Photometry:
        """Photometry of stamps (n, d, d) in any unit, sky included, finite.

        `bad` pixels (n, d, d) are not used; `start` (n,) is the sky to start from
        (`border_median`). `flux`, `background` and `noise` of `known` are taken where they
        are not NaN.
        """
        count = len(stamps)
        hidden = bad.reshape(count, -1)
        flux_known, sky_known = np.isfinite(stated.flux), np.isfinite(stated.background)
        sky = np.where(sky_known, stated.background, start)
        x = (stamps.reshape(count, -1) - sky[:, None]).astype(np.float32)
        np.copyto(x, 0.0, where=hidden)
        scale = np.abs(x).max(axis=1).astype(np.float64)
        lit = np.isfinite(scale) & (scale > 0)
        scale = np.where(lit, scale, 1.0)
        x[~lit] = self.model.mean
        x /= scale.astype(np.float32)[:, None]
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
        clear = flux_known | (fit.flux > CLEAR * fit.error)
        careful = hidden.any(axis=1) | ~lit | ~clear | ~fits_in
        raise_flag(measured.flags, StarFlag.FAINT, measured.flux < FAINT_SNR * measured.flux_error)
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
        sky_variance = sky_known / self.pixels

        def flux_of(
            fitted_flux: np.ndarray, sigma2: np.ndarray, unseen: float
        ) -> tuple[np.ndarray, ...]:
            prior = np.maximum(fitted_flux, 0.0) ** 2 + sigma2 / self._peak
            weight = 1.0 / (prior[:, None] * self._variance + sigma2[:, None])
            rest_weight = 1.0 / (prior * unseen + sigma2)
            information = weight @ self._modes**2 + rest_weight * self._left + sky_variance / sigma2
            signal = (
                (weight * modes) @ self._modes
                + rest_weight * outside
                + sky_variance * total / sigma2
            )
            fitted_flux = np.where(np.isfinite(flux), flux, signal / information)
            return fitted_flux, 1.0 / np.sqrt(information), weight

        fitted_flux = np.where(
            np.isfinite(flux), flux, along / (self._left + self._modes @ self._modes)
        )
        for _ in range(UPDATES):
            rest_energy = energy - 2.0 * fitted_flux * outside + fitted_flux**2 * self._left
            sigma2 = np.maximum(rest_energy / self._others, NOISE_FLOOR**2)
            sigma2 = np.where(np.isfinite(noise), noise**2, sigma2)
            # What the star has beyond the leading eigenvectors is in σ² here.
            fitted_flux, _, weight = flux_of(fitted_flux, sigma2, 0.0)
        score = self._border_scores(x, modes, total, fitted_flux, weight, sigma2, sky_known)
        if used is not None:
            score[~used[:, self._ring]] = np.nan
        scatter = np.where(np.isfinite(noise), 1.0, _clipped_rms(score))
        sigma = np.maximum(np.sqrt(sigma2) * scatter, NOISE_FLOOR)
        fitted_flux, error, _ = flux_of(fitted_flux, sigma**2, self._unseen)
        return _Fit(
            fitted_flux, error, sigma, np.where(sky_known, 0.0, (total - fitted_flux) / self.pixels)
        )

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
        excess = weight - 1.0 / sigma2[:, None]
        pull = excess * (modes - flux[:, None] * self._modes)
        mean = np.where(sky_known, (total - flux) / self.pixels, 0.0)[:, None]
        ring = x[:, self._ring] - flux[:, None] * self._ring_contrast + mean
        residual = ring / sigma2[:, None] + pull @ self._ring_basis
        sky_loss = np.where(sky_known, 0.0, 1.0 / self.pixels)
        precision = excess @ self._ring_basis**2 + ((1.0 - sky_loss) / sigma2)[:, None]
        return np.asarray(residual / np.sqrt(precision))

    def _normalise(self, x: np.ndarray, fit: _Fit) -> tuple[np.ndarray, np.ndarray]:
        """Images of flux 1, and which of them stay in the range of the training set."""
        usable = fit.flux > TINY
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
        stated: Stamps,
        out: Photometry,
    ) -> None:
        """Fit some stars with `robust_flux` and overwrite their rows of `out`."""
        has_free_sky = ~np.isfinite(stated.background[stars])
        for is_free, members in ((True, stars[has_free_sky]), (False, stars[~has_free_sky])):
            if not members.size:
                continue
            model, nothing = self._free_sky if is_free else self.model, None
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
                self._overwrite(out, group, x, estimate, sky[group], stated)

    def _overwrite(
        self,
        out: Photometry,
        group: np.ndarray,
        x: np.ndarray,
        estimate: FluxEstimate,
        sky: np.ndarray,
        stated: Stamps,
    ) -> None:
        """Rows `group` of `out` from the estimate of the first stamps x (GROUP, P)."""
        count = group.size
        known_flux, known_noise = stated.flux[group], stated.noise[group]
        repaired = estimate.images.reshape(GROUP, -1)
        used = np.isclose(repaired, x, rtol=1e-9, atol=0.0)
        has_flux, fitted = np.isfinite(known_flux), np.isfinite(estimate.flux[:count])
        flux = np.where(has_flux, known_flux, estimate.flux[:count])
        fit_flags = estimate.flags[:count].copy()
        peak = np.abs(repaired[:count]).max(axis=1)
        is_lost = (
            ~fitted | ~(flux > TINY * peak) | (~has_flux & ((fit_flags & StarFlag.NO_FLUX) > 0))
        )
        fit_flags &= np.where(
            has_flux, *(np.uint16(flag) for flag in (KEPT_IF_GIVEN, KEPT_OTHERWISE))
        )
        raise_flag(fit_flags, StarFlag.NO_FLUX, is_lost)
        residual_sky = (
            repaired.mean(axis=1)[:count] - np.nan_to_num(estimate.flux[:count]) / self.pixels
        )
        residual_sky = np.where(np.isfinite(stated.background[group]), 0.0, residual_sky)
        images = (repaired[:count] - residual_sky[:, None]) / np.where(is_lost, 1.0, flux)[:, None]
        images[is_lost] = 0.0
        filled = np.tile(self.model.mean.astype(np.float32), (GROUP, 1))
        filled[:count] = images
        unit = np.ones(GROUP)
        noise = self._fit(filled, unit > 0, unit, np.nan * unit, used).noise[:count] * flux
        noise = np.where(is_lost, estimate.noise[:count], noise)
        out.flux[group] = flux
        out.flux_error[group] = np.where(has_flux, np.nan, estimate.error[:count])
        out.background[group] = sky + np.where(fitted, residual_sky, 0.0)
        out.noise[group] = np.where(np.isfinite(known_noise), known_noise, noise)
        out.images[group] = images.reshape(count, self.side, self.side)
        out.used[group] = used[:count].reshape(count, self.side, self.side)
        out.flags[group] = fit_flags


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
    is_used = ~unused & (modulus <= SCATTER_CLIP * SIGMA_OF_MAD * median)
    squares = np.where(is_used, modulus, 0.0)
    count = is_used.sum(axis=1)
    total = np.einsum("ij,ij->i", squares, squares)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), 1.0))
