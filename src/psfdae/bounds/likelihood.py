"""Likelihood of photon counts, written so that single precision can sum it.

A star with the noise-free image p (Σp = 1), flux F and sky B gives counts
n ~ Poisson(F p + B). Up to terms without p,

    log L(n | p) = n·ℓ(p) − F Σp,   ℓ(p) = log(1 + F p / B),

a matrix product for all stars and all p at once. With counts of 10⁴ and more its
sums reach 10⁶, where single precision cannot see differences of order 1. So the
counts n̄ and the ℓ̄ of a mean image are taken out of both factors,

    log L = (n − n̄)·(ℓ − ℓ̄) + [n̄·ℓ − F Σp] + terms without p:

the bracket depends on p alone and is summed in double precision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psfdae.bounds.symmetry import SYMMETRIES
from psfdae.stars.noise import NoiseModel


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
        """Counts n − n̄ of normalised, sky-subtracted images.

        Parameters
        ----------
        noisy : ndarray, shape (n, d, d)
            As `NoiseModel.draw` gives them; counts are whole numbers, so rounding
            undoes the loss of single precision.

        Returns
        -------
        ndarray, shape (n, P), float64
        """
        counts = np.rint(self.flux * noisy.reshape(len(noisy), -1).astype(np.float64))
        return counts - self.flux * self.centre

    def factors(self, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What multiplies the residuals, and what is added to the product.

        Parameters
        ----------
        stamps : ndarray, shape (K, P), float64

        Returns
        -------
        ratio : ndarray, shape (K, P), float64
            ℓ − ℓ̄.
        offset : ndarray, shape (K,), float64
            n̄·ℓ − F Σp.
        """
        scale = self.flux / self.background
        ratio = np.log1p(scale * stamps)
        expected = self.background + self.flux * self.centre
        offset = ratio @ expected - self.flux * stamps.sum(axis=1)
        ratio -= np.log1p(scale * self.centre)
        return ratio, offset
