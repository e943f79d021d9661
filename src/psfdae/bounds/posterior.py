"""Posterior mean of a star over a bank of simulated stars.

With the bank as a sample of the prior, the posterior mean is the average of the
bank's images weighted with their likelihoods. It is an estimator like any other,
so its error is an upper limit of the Bayes error, and the limit itself once the
bank is dense enough.

The bank is read once, in chunks; sums are kept relative to the largest
log-likelihood so far of every star.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from psfdae.bounds.bank import Bank, jitters, windows
from psfdae.bounds.likelihood import Likelihood
from psfdae.bounds.symmetry import SYMMETRIES, Symmetry

DEPTH = 30.0
"""Images whose log-likelihood is this far below a star's best are left out.

Millions of them together weigh less than 1e-6 of the best one.
"""

CHUNK = 512
"""Stars of the bank per matrix product; scores of 420 test stars then fit the cache."""


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
        return cls(
            np.full(stars, -np.inf),
            np.zeros(stars),
            np.zeros(stars),
            np.zeros((stars, pixels)),
            np.zeros((stars, fields, shifts)),
        )

    @property
    def mean_image(self) -> np.ndarray:
        """Posterior mean of the noise-free image, shape (n, P)."""
        return self.image / self.total[:, None]

    @property
    def effective_size(self) -> np.ndarray:
        """Effective sample size 1/Σw² of the normalised weights, shape (n,)."""
        return self.total**2 / self.square

    def mean_template(self, templates: np.ndarray) -> np.ndarray:
        """Posterior mean of the static PSF, shape (n, P).

        Parameters
        ----------
        templates : ndarray, shape (F, J, d, d)
        """
        weight = self.share.reshape(len(self.share), -1) / self.total[:, None]
        return weight @ templates.reshape(weight.shape[1], -1).astype(np.float64)

    def raise_peak(self, peak: np.ndarray) -> None:
        """Refer the weights to another largest log-likelihood, shape (n,)."""
        changed = np.flatnonzero(peak != self.peak)
        # A star without any image so far has peak −∞ and sums of zero.
        scale = np.exp(self.peak[changed] - peak[changed])
        self.total[changed] *= scale
        self.square[changed] *= scale**2
        self.image[changed] *= scale[:, None]
        self.share[changed] *= scale[:, None, None]
        self.peak = peak


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
    for part in _chunks(bank, chunk):
        log_weights = part.log_weights()
        for window, members in windows(bank.jitter_px).items():
            stamps = part.stamps(window).reshape(len(part), -1)
            ratio, offset = likelihood.factors(stamps)
            images, ratio_t = stamps.astype(np.float32), ratio.T.astype(np.float32)
            for s, jitter in members:
                scores = mirrored[s] @ ratio_t + (offset + log_weights[:, s])
                field = SYMMETRIES[s].field(part.field, bank.points)
                _accumulate(sums, scores, images, SYMMETRIES[s], field, jitter)
    return sums


def _chunks(bank: Bank, size: int) -> Iterator[Bank]:
    """Parts of a bank, stars of a field side by side."""
    order = np.argsort(bank.field, kind="stable")
    for start in range(0, order.size, size):
        yield bank.take(order[start : start + size])


def _accumulate(
    sums: PosteriorSums,
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
    peak = np.maximum(sums.peak, scores.max(axis=1))
    used = np.flatnonzero((scores > (peak - DEPTH)[:, None]).any(axis=0))
    if not used.size:
        return
    sums.raise_peak(peak)
    weight = np.exp((scores[:, used] - peak[:, None]).astype(np.float32))
    sums.total += weight.sum(axis=1, dtype=np.float64)
    sums.square += np.einsum("nk,nk->n", weight, weight, dtype=np.float64)
    side = int(np.sqrt(images.shape[1]))
    added = symmetry.image((weight @ images[used]).reshape(-1, side, side))
    sums.image += added.reshape(sums.image.shape)
    start = np.flatnonzero(np.diff(field[used], prepend=-1))
    sums.share[:, field[used][start], jitter] += np.add.reduceat(weight, start, axis=1)
