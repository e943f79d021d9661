"""A bank of simulated stars: the prior of the test stars, as a sample."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from psfdae.noise import NoiseModel
from psfdae_paper.stars.framing import crop_jittered, normalise_flux
from psfdae_paper.stars.symmetry import SYMMETRIES, Symmetry, orbit

MIRROR_MARGIN = 1
"""Pixels beyond the jitter that a flipped stamp needs (`Symmetry.window`)."""


@dataclass(frozen=True)
class Bank:
    """Propagated stars from which those at other jitters and mirrored fields are cut.

    Attributes
    ----------
    framed : ndarray, shape (M, d + 2m, d + 2m), float32
        Intensities, brightest pixel at index d/2 + m, m = `jitter_px` + 1.
    field : ndarray of int, shape (M,)
        Field of every star, ix + P·iy.
    peak : ndarray of int, shape (M, 2)
        Brightest pixel (row, column) from the chief ray.
    points : int
        Field points P along a side.
    jitter_px : int
        Largest centring error in pixels per axis.
    """

    framed: np.ndarray
    field: np.ndarray
    peak: np.ndarray
    points: int
    jitter_px: int

    def __len__(self) -> int:
        return len(self.framed)

    @property
    def margin(self) -> int:
        """Pixels m on either side of the stamp."""
        return self.jitter_px + MIRROR_MARGIN

    def take(self, stars: np.ndarray) -> Bank:
        """Some of the stars, in the order given."""
        part = (self.framed[stars], self.field[stars], self.peak[stars])
        return Bank(*part, self.points, self.jitter_px)

    def stamps(self, window: tuple[int, int]) -> np.ndarray:
        """Stamps cut at a window (first row, first column), sum 1, shape (M, d, d), float64."""
        row, column = window
        side = self.framed.shape[-1] - 2 * self.margin
        # A slice: the same place in all stars needs no list of pixels for each.
        cut = self.framed[:, row : row + side, column : column + side]
        return normalise_flux(cut.astype(np.float64))[0]

    def log_weights(self) -> np.ndarray:
        """Logarithm of `weights`, −∞ for zero, shape (M, 8)."""
        with np.errstate(divide="ignore"):
            logs: np.ndarray = np.log(weights(self.field, self.peak, self.points))
            return logs


def weights(field: np.ndarray, peak: np.ndarray, points: int) -> np.ndarray:
    """How often each symmetry of each star counts so that all fields stay equally likely.

    At a field point on a mirror axis two symmetries (in the centre all eight) lead
    to the same star, with its equal maxima exchanged. Only the one that frames the
    first maximum in (row, column) order is right; it counts for all of them.

    Parameters
    ----------
    field : ndarray of int, shape (M,)
        Field of every star, ix + P·iy.
    peak : ndarray of int, shape (M, 2)
        The star's framed pixel (row, column) from the chief ray.
    points : int
        Field points P along a side.

    Returns
    -------
    ndarray of int, shape (M, 8)
        Zero, or the number of symmetries that lead to the same field; rows sum to 8.
    """
    target = np.stack([s.field(field, points) for s in SYMMETRIES], axis=1)
    pixel = np.stack([s.pixel(peak) for s in SYMMETRIES], axis=1)
    reach = 2 * int(np.abs(peak).max()) + 3
    order = (pixel[..., 0] * reach + pixel[..., 1]) * len(SYMMETRIES) + np.arange(len(SYMMETRIES))
    same = target[:, :, None] == target[:, None, :]
    first = np.where(same, order[:, None, :], np.iinfo(order.dtype).max).min(axis=2)
    return np.where(order == first, same.sum(axis=2), 0)


def jitters(jitter_px: int) -> list[tuple[int, int]]:
    """All centring errors (row, column) of up to `jitter_px` pixels per axis."""
    shifts = range(-jitter_px, jitter_px + 1)
    return list(product(shifts, shifts))


def windows(jitter_px: int) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """Return the stamps that share a window: (row, column) → list of (symmetry, jitter) numbers."""
    margin = jitter_px + MIRROR_MARGIN
    found: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for s, symmetry in enumerate(SYMMETRIES):
        for j, jitter in enumerate(jitters(jitter_px)):
            found.setdefault(symmetry.window(jitter, margin), []).append((s, j))
    return found


def jittered_templates(framed: np.ndarray, jitter_px: int) -> np.ndarray:
    """Static PSFs at all centring errors, as the stage `stars` cuts them.

    Parameters
    ----------
    framed : ndarray, shape (F, d + 2·jitter_px, d + 2·jitter_px)
        Array `psf` of the product "templates".

    Returns
    -------
    ndarray, shape (F, J, d, d), float32
        Sum 1; order of `jitters`.
    """
    framed = framed.astype(np.float64)
    cuts = [crop_jittered(framed, np.array(jitter), jitter_px) for jitter in jitters(jitter_px)]
    return np.stack([normalise_flux(cut)[0] for cut in cuts], axis=1).astype(np.float32)


DEPTH = 30.0
"""Images whose log-likelihood is this far below a star's best are left out.

Millions of them together weigh less than 1e-6 of the best one.
"""

CHUNK = 512
"""Stars of the bank per matrix product; scores of 420 test stars then fit the cache."""


@dataclass(frozen=True)
class Likelihood:
    """Poisson likelihood of stars of one noise level.

    Attributes
    ----------
    flux, background : float
        Photons F in the stamp and B per pixel.
    centre : ndarray, shape (P,)
        Mean image that is taken out. It must not change under the symmetries of
        the square, because counts and images are compared mirrored, too.
    """

    flux: float
    background: float
    centre: np.ndarray

    @classmethod
    def of(cls, noise: NoiseModel, level: float, images: np.ndarray) -> Likelihood:
        """Likelihood at noise level λ, centred on images of shape (n, d, d)."""
        mean = images.mean(axis=0, dtype=np.float64)
        symmetric = np.mean([symmetry.image(mean) for symmetry in SYMMETRIES], axis=0)
        return cls(float(noise.flux(level)), noise.background, symmetric.ravel())

    def residuals(self, noisy: np.ndarray) -> np.ndarray:
        """Counts n − n̄ of images (n, d, d) that `NoiseModel.draw` gives, (n, P), float64.

        Counts are whole numbers, so rounding undoes the loss of single precision.
        """
        return self.counts(noisy) - self.background - self.flux * self.centre

    def counts(self, noisy: np.ndarray) -> np.ndarray:
        """Photons of the images, sky included, shape (n, P), float64."""
        signal = np.rint(self.flux * noisy.reshape(len(noisy), -1).astype(np.float64))
        return signal + self.background

    def factors(self, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the factor of the residuals and the constant of the product, for stamps (K, P).

        That is ℓ − ℓ̄, shape (K, P), and n̄·ℓ − F Σp, shape (K,), in float64.
        """
        scale = self.flux / self.background
        ratio = np.log1p(scale * stamps)
        expected = self.background + self.flux * self.centre
        offset = ratio @ expected - self.flux * stamps.sum(axis=1)
        ratio -= np.log1p(scale * self.centre)
        return ratio, offset


@dataclass
class PosteriorSums:
    """Weighted sums over a part of the bank, weights relative to exp(`peak`).

    Attributes
    ----------
    peak : ndarray, shape (n,)
        Largest log-likelihood of every test star.
    total, square : ndarray, shape (n,)
        Σw and Σw².
    image, power : ndarray, shape (n, P)
        Σw p and Σw p², p the bank's images.
    share : ndarray, shape (n, F, J)
        Σw by field and jitter.
    """

    peak: np.ndarray
    total: np.ndarray
    square: np.ndarray
    image: np.ndarray
    power: np.ndarray
    share: np.ndarray

    @classmethod
    def empty(cls, stars: int, pixels: int, fields: int, shifts: int) -> PosteriorSums:
        """Sums over nothing."""
        shapes = ((), (), (pixels,), (pixels,), (fields, shifts))
        zeros = (np.zeros((stars, *shape)) for shape in shapes)
        return cls(np.full(stars, -np.inf), *zeros)

    @classmethod
    def stack(cls, parts: Sequence[PosteriorSums]) -> PosteriorSums:
        """Sums of several groups of test stars, one after the other."""
        return cls(*(np.concatenate([getattr(p, key) for p in parts]) for key in vars(parts[0])))

    def take(self, stars: np.ndarray) -> PosteriorSums:
        """Those of some stars, in the order given."""
        return PosteriorSums(*(values[stars] for values in vars(self).values()))

    def put(self, stars: np.ndarray, others: PosteriorSums) -> None:
        """Put others in place of those of some stars."""
        for name, values in vars(others).items():
            getattr(self, name)[stars] = values

    @property
    def mean_image(self) -> np.ndarray:
        """Posterior mean of the noise-free image, shape (n, P); NaN where none was possible."""
        with np.errstate(invalid="ignore"):
            mean: np.ndarray = self.image / self.total[:, None]
            return mean

    @property
    def effective_size(self) -> np.ndarray:
        """Effective sample size 1/Σw² of the normalised weights, shape (n,)."""
        size: np.ndarray = self.total**2 / np.maximum(self.square, np.finfo(float).tiny)
        return size

    @property
    def variance(self) -> np.ndarray:
        """Posterior variance of every pixel of the noise-free image, (n, P); NaN as above."""
        with np.errstate(invalid="ignore"):
            # Rounding makes none of it negative.
            variance: np.ndarray = np.maximum(
                self.power / self.total[:, None] - self.mean_image**2, 0.0
            )
        return variance

    def template(self, templates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Posterior mean and variance of the static PSF, (n, P) both; NaN as `mean_image`.

        Parameters
        ----------
        templates : ndarray, shape (F, J, d, d)
        """
        with np.errstate(invalid="ignore"):
            weight = self.share.reshape(len(self.share), -1) / self.total[:, None]
        return mixture(weight, templates.reshape(weight.shape[1], -1).astype(np.float64))

    def add(
        self,
        scores: np.ndarray,
        images: np.ndarray,
        symmetry: Symmetry,
        field: np.ndarray,
        jitter: int,
    ) -> None:
        """Add images of one symmetry and jitter.

        Parameters
        ----------
        scores : ndarray, shape (n, K), float64
            Log-likelihood plus log-prior.
        images : ndarray, shape (K, P), float32
            Images before `symmetry`.
        field : ndarray of int, shape (K,)
            Field after `symmetry`; equal values lie side by side.
        """
        peak = np.maximum(self.peak, scores.max(axis=1))
        used = np.flatnonzero((scores > (peak - DEPTH)[:, None]).any(axis=0))
        if not used.size:
            return
        changed = np.flatnonzero(peak != self.peak)
        # A star without any image so far has peak −∞ and sums of zero.
        scale = np.exp(self.peak[changed] - peak[changed])
        self.total[changed] *= scale
        self.square[changed] *= scale**2
        self.image[changed] *= scale[:, None]
        self.power[changed] *= scale[:, None]
        self.share[changed] *= scale[:, None, None]
        self.peak = peak
        # A star of which no image is possible so far keeps weights of zero.
        above = scores[:, used] - np.maximum(peak, np.finfo(float).min)[:, None]
        weight = np.exp(above.astype(np.float32))
        self.total += weight.sum(axis=1, dtype=np.float64)
        self.square += np.einsum("nk,nk->n", weight, weight, dtype=np.float64)
        side = int(np.sqrt(images.shape[1]))
        for whole, values in ((self.image, images[used]), (self.power, images[used] ** 2)):
            part = symmetry.image((weight @ values).reshape(-1, side, side))
            np.add(whole, part.reshape(whole.shape), out=whole)
        start = np.flatnonzero(np.diff(field[used], prepend=-1))
        self.share[:, field[used][start], jitter] += np.add.reduceat(weight, start, axis=1)


def mixture(weight: np.ndarray, images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance, (n, P) both, of images (K, P) by weights (n, K)."""
    mean = weight @ images
    return mean, np.maximum(weight @ images**2 - mean**2, 0.0)


def merge(parts: Sequence[PosteriorSums]) -> PosteriorSums:
    """Sums over several parts of the bank; the parts stay as they are."""
    first = parts[0]
    whole = PosteriorSums.empty(first.total.size, first.image.shape[1], *first.share.shape[1:])
    whole.peak = np.max([part.peak for part in parts], axis=0)
    for part in parts:
        # Where no image was possible in any part, the sums stay zero.
        scale = np.exp(part.peak - np.maximum(whole.peak, np.finfo(float).min))
        whole.total += scale * part.total
        whole.square += scale**2 * part.square
        whole.image += scale[:, None] * part.image
        whole.power += scale[:, None] * part.power
        whole.share += scale[:, None, None] * part.share
    return whole


@dataclass(frozen=True)
class Scored:
    """Stars of a bank at one symmetry and jitter, weighed by noisy images.

    Attributes
    ----------
    star, field : ndarray of int, shape (K,)
        Their places in the bank and their fields after `symmetry`; equal fields lie side by side.
    symmetry, jitter : int
        Numbers in `SYMMETRIES` and `jitters`.
    images : ndarray, shape (K, P), float32
        Before `symmetry`.
    scores : ndarray, shape (n, K), float64
        Log-likelihood plus log-prior.
    """

    star: np.ndarray
    field: np.ndarray
    symmetry: int
    jitter: int
    images: np.ndarray
    scores: np.ndarray


def scored(
    bank: Bank, noisy: np.ndarray, likelihood: Likelihood, chunk: int = CHUNK
) -> Iterator[Scored]:
    """All stars of a bank at all jitters and symmetries; parameters as in `posterior_sums`."""
    residuals = likelihood.residuals(noisy).reshape(noisy.shape)
    # Instead of mirroring every image of the bank, the test stars are mirrored back.
    mirrored = [
        symmetry.undo(residuals).reshape(len(noisy), -1).astype(np.float32)
        for symmetry in SYMMETRIES
    ]
    order = np.argsort(bank.field, kind="stable")  # stars of a field side by side
    for start in range(0, order.size, chunk):
        stars = order[start : start + chunk]
        part = bank.take(stars)
        log_weights = part.log_weights()
        for window, members in windows(bank.jitter_px).items():
            stamps = part.stamps(window).reshape(len(part), -1)
            ratio, offset = likelihood.factors(stamps)
            images, ratio_t = stamps.astype(np.float32), ratio.T.astype(np.float32)
            for s, jitter in members:
                scores = mirrored[s] @ ratio_t + (offset + log_weights[:, s])
                field = SYMMETRIES[s].field(part.field, bank.points)
                yield Scored(stars, field, s, jitter, images, scores)


def companions(
    count: int, own: np.ndarray | None, bank: Bank
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Groups of noisy images, by their numbers, and the stars of a bank that may explain each.

    All with all; if the images' fields are given, `own` (n,), with stars that symmetries take
    there. Fields that are mirror images of each other share theirs.
    """
    if own is None:
        return [(np.arange(count), np.arange(len(bank)))]
    ours, theirs = orbit(own, bank.points), orbit(bank.field, bank.points)
    return [(np.flatnonzero(ours == o), np.flatnonzero(theirs == o)) for o in np.unique(ours)]


def posterior_sums(
    bank: Bank,
    noisy: np.ndarray,
    likelihood: Likelihood,
    chunk: int = CHUNK,
    own_field: np.ndarray | None = None,
) -> PosteriorSums:
    """Weigh all stars of a bank, at all jitters and symmetries, by noisy images.

    Parameters
    ----------
    bank : Bank
    noisy : ndarray, shape (n, d, d)
        Noisy images of one noise level.
    likelihood : Likelihood
        Of that noise level.
    chunk : int
        Stars of the bank per matrix product; does not change the result.
    own_field : ndarray of int, shape (n,), optional
        Field of every noisy image: only stars that a symmetry takes there count. Each star
        of the bank must have one that does.
    """
    shifts = len(jitters(bank.jitter_px))
    sums = PosteriorSums.empty(len(noisy), noisy[0].size, bank.points**2, shifts)
    for part in scored(bank, noisy, likelihood, chunk):
        if own_field is not None:
            part.scores[own_field[:, None] != part.field] = -np.inf
        symmetry = SYMMETRIES[part.symmetry]
        sums.add(part.scores, part.images, symmetry, part.field, part.jitter)
    return sums


def exact_posterior(
    noisy: np.ndarray,
    templates: np.ndarray,
    likelihood: Likelihood,
    own_field: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Posterior mean, variance and probability of the templates, centring errors summed out.

    All templates and all centring errors are equally likely beforehand.

    Parameters
    ----------
    noisy : ndarray, shape (n, d, d)
    templates : ndarray, shape (F, J, d, d)
        Every template at every centring error.
    likelihood : Likelihood
        Of the images' noise level.
    own_field : ndarray of int, shape (n,), optional
        Field of every noisy image: only its template counts.

    Returns
    -------
    mean : ndarray, shape (n, d, d)
    variance : ndarray, shape (n,)
        Posterior variance, mean of the pixels.
    probability : ndarray, shape (n, F)
    """
    fields, shifts = templates.shape[:2]
    images = templates.reshape(fields * shifts, -1).astype(np.float64)
    ratio, offset = likelihood.factors(images)
    scores = likelihood.residuals(noisy) @ ratio.T + offset
    if own_field is not None:
        scores[own_field[:, None] != np.repeat(np.arange(fields), shifts)] = -np.inf
    weight = np.exp(scores - scores.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    mean, variance = mixture(weight, images)
    share = weight.reshape(-1, fields, shifts).sum(axis=2)
    return mean.reshape(noisy.shape), variance.mean(axis=1), share


FITTED_POINTS = 4
"""Least number of bank sizes to which three parameters are fitted."""


def segments(count: int, largest: int = 16) -> int:
    """Number of equal parts of a bank: the largest power of two up to `largest` and `count`."""
    return 1 << (min(largest, count).bit_length() - 1)


def nested_means(
    parts: Sequence[PosteriorSums], measure: Callable[[PosteriorSums], np.ndarray]
) -> dict[int, np.ndarray]:
    """A per-star quantity for banks of one, two, four … parts.

    A bank of k parts can be had several times from the same parts; the mean over
    those disjoint banks is taken, which steadies the small sizes.

    Parameters
    ----------
    parts : sequence of PosteriorSums
        Sums over equally large disjoint parts; their number is a power of two.
    measure : function
        From the sums over a bank to an array; its mean is returned by number of parts.
    """
    means: dict[int, np.ndarray] = {}
    level = list(parts)
    size = 1
    while True:
        means[size] = np.mean([measure(sums) for sums in level], axis=0)
        if len(level) == 1:
            return means
        level = [merge(level[i : i + 2]) for i in range(0, len(level), 2)]
        size *= 2


def last_change(errors: Sequence[float] | np.ndarray) -> float:
    """|error(M/4)/error(M) − 1| of banks that double in size; NaN for fewer than three."""
    if len(errors) < 3:
        return float("nan")
    return float(abs(errors[-3] / errors[-1] - 1.0))


def extrapolate(draws: np.ndarray, errors: np.ndarray) -> tuple[float, float, float]:
    """Fit error(M) = a + b M^−c and return a, c and the RMS of the relative residuals.

    Parameters
    ----------
    draws : ndarray, shape (k,)
        Bank sizes M.
    errors : ndarray, shape (k,)
        Mean squared errors, all positive.

    Returns
    -------
    limit, exponent, residual : float
        NaN if there are fewer than four sizes. The limit lies between 0 and the
        smallest error: the fit extrapolates, it proves nothing.
    """
    from scipy.optimize import least_squares

    if len(draws) < FITTED_POINTS:
        return (float("nan"),) * 3
    size = np.asarray(draws, float) / draws[-1]
    scale = float(np.min(errors))
    ratio = np.asarray(errors) / scale

    def misfit(parameters: np.ndarray) -> np.ndarray:
        limit, excess, exponent = parameters
        relative: np.ndarray = (limit + excess * size**-exponent) / ratio - 1.0
        return relative

    start = (0.9, max(ratio[-1] - 0.9, 1e-3), 0.7)
    fit = least_squares(misfit, start, bounds=((0.0, 0.0, 0.05), (1.0, np.inf, 3.0)), xtol=1e-12)
    return scale * fit.x[0], float(fit.x[2]), float(np.sqrt(np.mean(fit.fun**2)))
