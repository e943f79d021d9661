"""Posterior mean of a star over a sample of what it could be.

With a bank of simulated stars as a sample of the prior, the posterior mean is the
average of the bank's images weighted with their likelihoods. It is an estimator like
any other, so its error is an upper limit of the Bayes error, and the limit itself once
the bank is dense enough. Where a star can only be one of a few known images (scene 2)
the sum over them is exact.

A star with the noise-free image p (Σp = 1), flux F and sky B gives counts
n ~ Poisson(F p + B). Up to terms without p,

    log L(n | p) = n·ℓ(p) − F Σp,   ℓ(p) = log(1 + F p / B),

a matrix product for all stars and all p at once. With counts of 10⁴ and more its
sums reach 10⁶, where single precision cannot see differences of order 1. So the
counts n̄ and the ℓ̄ of a mean image are taken out of both factors,

    log L = (n − n̄)·(ℓ − ℓ̄) + [n̄·ℓ − F Σp] + terms without p:

the bracket depends on p alone and is summed in double precision. The bank is read
once, in chunks; sums are kept relative to the largest log-likelihood so far of every
star.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from psfdae.bounds.bank import Bank, jitters, windows
from psfdae.stars.noise import NoiseModel
from psfdae.stars.symmetry import SYMMETRIES, Symmetry

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
        counts = np.rint(self.flux * noisy.reshape(len(noisy), -1).astype(np.float64))
        return counts - self.flux * self.centre

    def factors(self, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What multiplies the residuals, and what is added to the product, for stamps (K, P).

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
    image : ndarray, shape (n, P)
        Σw p, p the bank's images.
    share : ndarray, shape (n, F, J)
        Σw by field and jitter.
    """

    peak: np.ndarray
    total: np.ndarray
    square: np.ndarray
    image: np.ndarray
    share: np.ndarray

    @classmethod
    def empty(cls, stars: int, pixels: int, fields: int, shifts: int) -> PosteriorSums:
        """Sums over nothing."""
        zeros = (np.zeros((stars, *shape)) for shape in ((), (), (pixels,), (fields, shifts)))
        return cls(np.full(stars, -np.inf), *zeros)

    @property
    def mean_image(self) -> np.ndarray:
        """Posterior mean of the noise-free image, shape (n, P)."""
        return self.image / self.total[:, None]

    @property
    def effective_size(self) -> np.ndarray:
        """Effective sample size 1/Σw² of the normalised weights, shape (n,)."""
        return self.total**2 / self.square

    def mean_template(self, templates: np.ndarray) -> np.ndarray:
        """Posterior mean of the static PSF, (F, J, d, d) to (n, P)."""
        weight = self.share.reshape(len(self.share), -1) / self.total[:, None]
        return weight @ templates.reshape(weight.shape[1], -1).astype(np.float64)

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
        self.share[changed] *= scale[:, None, None]
        self.peak = peak
        weight = np.exp((scores[:, used] - peak[:, None]).astype(np.float32))
        self.total += weight.sum(axis=1, dtype=np.float64)
        self.square += np.einsum("nk,nk->n", weight, weight, dtype=np.float64)
        side = int(np.sqrt(images.shape[1]))
        added = symmetry.image((weight @ images[used]).reshape(-1, side, side))
        self.image += added.reshape(self.image.shape)
        start = np.flatnonzero(np.diff(field[used], prepend=-1))
        self.share[:, field[used][start], jitter] += np.add.reduceat(weight, start, axis=1)


def merge(parts: Sequence[PosteriorSums]) -> PosteriorSums:
    """Sums over several parts of the bank; the parts stay as they are."""
    first = parts[0]
    whole = PosteriorSums.empty(first.total.size, first.image.shape[1], *first.share.shape[1:])
    whole.peak = np.max([part.peak for part in parts], axis=0)
    for part in parts:
        scale = np.exp(part.peak - whole.peak)
        whole.total += scale * part.total
        whole.square += scale**2 * part.square
        whole.image += scale[:, None] * part.image
        whole.share += scale[:, None, None] * part.share
    return whole


def posterior_sums(
    bank: Bank, noisy: np.ndarray, likelihood: Likelihood, chunk: int = CHUNK
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
    """
    residuals = likelihood.residuals(noisy).reshape(noisy.shape)
    # Instead of mirroring every image of the bank, the test stars are mirrored back.
    mirrored = [
        symmetry.undo(residuals).reshape(len(noisy), -1).astype(np.float32)
        for symmetry in SYMMETRIES
    ]
    shifts = len(jitters(bank.jitter_px))
    sums = PosteriorSums.empty(len(noisy), noisy[0].size, bank.points**2, shifts)
    order = np.argsort(bank.field, kind="stable")  # stars of a field side by side
    for start in range(0, order.size, chunk):
        part = bank.take(order[start : start + chunk])
        log_weights = part.log_weights()
        for window, members in windows(bank.jitter_px).items():
            stamps = part.stamps(window).reshape(len(part), -1)
            ratio, offset = likelihood.factors(stamps)
            images, ratio_t = stamps.astype(np.float32), ratio.T.astype(np.float32)
            for s, jitter in members:
                scores = mirrored[s] @ ratio_t + (offset + log_weights[:, s])
                field = SYMMETRIES[s].field(part.field, bank.points)
                sums.add(scores, images, SYMMETRIES[s], field, jitter)
    return sums


def exact_posterior(
    noisy: np.ndarray, templates: np.ndarray, likelihood: Likelihood
) -> tuple[np.ndarray, np.ndarray]:
    """Posterior mean and probability of every template, its centring error summed out.

    All templates and all centring errors are equally likely beforehand.

    Parameters
    ----------
    noisy : ndarray, shape (n, d, d)
    templates : ndarray, shape (F, J, d, d)
        Every template at every centring error.
    likelihood : Likelihood
        Of the images' noise level.

    Returns
    -------
    mean : ndarray, shape (n, d, d)
    probability : ndarray, shape (n, F)
    """
    fields, shifts = templates.shape[:2]
    images = templates.reshape(fields * shifts, -1).astype(np.float64)
    ratio, offset = likelihood.factors(images)
    scores = likelihood.residuals(noisy) @ ratio.T + offset
    weight = np.exp(scores - scores.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    mean = (weight @ images).reshape(noisy.shape)
    return mean, weight.reshape(-1, fields, shifts).sum(axis=2)
