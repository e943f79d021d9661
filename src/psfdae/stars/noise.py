"""Photon noise of a star on a bright sky.

The paper's noise level λ is the RMS of a flux-normalised image's pixels up to
a factor, σ = κλ, and larger for smaller stars. A star of flux F photons on a
sky of B photons per pixel gives exactly that,

    n ~ Poisson(F p + B),   image = (n − B) / F,   F = √B / (κ λ),

with variance (κλ)² + p/F: the star's own photons are included.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class NoiseModel:
    """Background-limited photon noise.

    Attributes
    ----------
    kappa : float
        Pixel RMS of the normalised image per unit of λ.
    background : float
        Sky level B in photons per pixel.
    """

    kappa: float
    background: float

    def flux(self, level: np.ndarray | float) -> np.ndarray:
        """Flux F in photons inside the stamp of a star of noise level λ."""
        return np.sqrt(self.background) / (self.kappa * np.asarray(level, dtype=np.float64))

    def variance(self, psf: np.ndarray, level: np.ndarray | float) -> np.ndarray:
        """Pixel variance of a normalised image with the noise-free image `psf`."""
        return (self.kappa * np.asarray(level)) ** 2 + psf / self.flux(level)

    def draw(
        self, psf: np.ndarray, level: np.ndarray | float, rng: np.random.Generator
    ) -> np.ndarray:
        """Noisy images of stars.

        Parameters
        ----------
        psf : ndarray, shape (B, d, d)
            Noise-free stamps that sum to 1.
        level : float or ndarray, shape (B,)
            Noise level λ of each star.

        Returns
        -------
        ndarray, shape (B, d, d), float32
            Sky-subtracted, normalised by the true flux.
        """
        flux = np.broadcast_to(self.flux(level), (len(psf),))[:, None, None]
        photons = rng.poisson(flux * psf + self.background)
        return ((photons - self.background) / flux).astype(np.float32)


def mixed_levels(levels: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """A random noise level λ of a band for each of `count` stars, shape (count,)."""
    return levels[rng.integers(levels.size, size=count)]
