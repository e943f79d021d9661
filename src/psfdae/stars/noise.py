"""Photon noise of a star on a bright sky.

Inputs: noise-free PSFs of sum 1, (n, d, d), and noise levels. Outputs: variances of pixels and
noisy images; for bright stars, the contribution of noise to the scatter of their images.

The paper's noise level λ is the RMS of the pixels of a flux-normalised image up to
a factor, σ = κλ, and larger for fainter stars. A star of flux F photons on a
sky of B photons per pixel gives exactly that,

    n ~ Poisson(F p + B),   image = (n − B) / F,   F = √B / (κ λ),

with variance (κλ)² + p/F: the star's own photons are included.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from psfdae.stars.moments import moving_matrices


@dataclass(frozen=True)
class NoiseModel:
    """Background-limited photon noise.

    Noise-free images `psf` sum to 1; a noise level λ is a number, or an array with one per star.

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
        """Return the flux F in photons inside the stamp of a star of noise level λ."""
        # F = √B / (κ λ).
        noise = self.kappa * np.asarray(level, np.float64)
        return np.asarray(np.sqrt(self.background) / noise)

    def variance(self, psf: np.ndarray, level: np.ndarray | float) -> np.ndarray:
        """Return the pixel variance of a normalised image; `level` broadcasts against `psf`."""
        # σ² = (κλ)² + p/F.
        return np.asarray((self.kappa * np.asarray(level)) ** 2 + psf / self.flux(level))

    def draw(
        self, psf: np.ndarray, level: np.ndarray | float, rng: np.random.Generator
    ) -> np.ndarray:
        """Draw noisy images of stars, sky-subtracted and normalised by the true flux.

        Parameters
        ----------
        psf : ndarray, shape (B, ...)
            Noise-free images of sum 1.
        level : float or ndarray, shape (B,)
            Noise level λ, > 0, of all images or of each.
        rng : Generator
            Source of the photon counts.

        Returns
        -------
        ndarray, shape (B, ...), float32
            Noisy images.
        """
        # n ~ Poisson(F p + B), and the image (n − B)/F.
        flux = _per_image(self.flux(level), psf)
        # A pixel of a real star may lie so far below the sky that the rate would be negative.
        photons = rng.poisson(np.maximum(flux * psf + self.background, 0.0))
        return np.asarray((photons - self.background) / flux, np.float32)

    def draw_gaussian(
        self, psf: np.ndarray, level: np.ndarray | float, rng: np.random.Generator
    ) -> np.ndarray:
        """Draw images as `draw` does, but with Gaussian noise of the same variance; for training.

        With 1e4 photons of sky in a pixel the two distributions differ by 1 % in skewness,
        and the draw takes a tenth of the time.
        """
        # p + σ z, in place and in single precision: training draws millions of pixels.
        sigma: np.ndarray = np.sqrt(self.variance(psf, _per_image(level, psf)))
        noisy = sigma.astype(np.float32)
        noisy *= rng.standard_normal(psf.shape, dtype=np.float32)
        noisy += psf
        return noisy


def _per_image(values: np.ndarray | float, psf: np.ndarray) -> np.ndarray:
    """Return one value for each of the images (B, ...), with axes to broadcast against them."""
    return np.broadcast_to(values, len(psf)).reshape(-1, *[1] * (psf.ndim - 1))


def draw_levels(levels: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw one of the noise levels λ of a band for each of `count` stars, shape (count,)."""
    # Each level with the same probability.
    return levels[rng.integers(levels.size, size=count)]


def noise_equivalent_px(psf: np.ndarray) -> float:
    """Return the noise-equivalent area A = 1/Σp² in pixels of a PSF p of sum 1.

    (King 1983, PASP 95, 163.) For several PSFs, shape (n, d, d), it follows from the mean of their
    Σp². The mean of the images would be wider than each image, because the stars have different
    positions in their stamps.
    """
    # n/Σp² of all images is the inverse of the mean of Σp².
    count = len(psf) if psf.ndim == 3 else 1
    return count / float(np.square(psf, dtype=np.float64).sum())


@dataclass(frozen=True)
class OwnNoise:
    """Noise of bright stars in images that were shifted to a common centre.

    Attributes
    ----------
    noise : ndarray, shape (n,)
        Ratio of the RMS of the sky noise in a pixel to the flux, of every image before its shift.
    background : float
        Sky level in photons per pixel.
    phase : ndarray, shape (n, 2)
        Fraction of a pixel by which the image was shifted, along rows and columns.
    star : ndarray of int, shape (n,)
        Star of every image; its images share their noise.
    """

    noise: np.ndarray
    background: float
    phase: np.ndarray
    star: np.ndarray

    def __call__(self, images: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Return the contribution of noise to the scatter of images about their mean, (P, P).

        Splines correlate neighbouring pixels along rows and columns, and the division by the
        sum removes noise along the star. Pixels have the variance of the sky and of the photons
        of the mean star (`NoiseModel`).

        Parameters
        ----------
        images : ndarray of int
            Indices of the images.
        mean : ndarray, shape (P,)
            Mean of these images, of sum 1.
        """
        # The mean contains a fraction of the noise of each star: no scatter about the mean.
        _, star, count = np.unique(self.star[images], return_inverse=True, return_counts=True)
        fraction = 1.0 - count[star] / images.size
        noise, side = self.noise[images], round(mean.size**0.5)
        sky = fraction * noise**2
        # Correlation of pixels: covariance of shifted white noise, averaged over the shifts of the
        # images, for pairs of pixels (a, c) along rows and (b, d) along columns.
        along = compute_shifted_noise(side)
        phases = len(along)
        index = np.rint(2 * (phases - 1) * np.abs(self.phase[images])).astype(int)
        weight = np.zeros((phases, phases))
        np.add.at(weight, (index[:, 0], index[:, 1]), sky / max(sky.sum(), 1e-300))
        pairs = np.einsum("pac,pbd->abcd", along, np.tensordot(weight, along, 1))
        # RMS of each pixel, by the sky and by the photons of the mean star.
        photons = (fraction * noise).sum() / np.sqrt(self.background) * np.maximum(mean, 0.0)
        rms = np.sqrt(sky.sum() + photons)
        covariance = pairs.reshape(mean.size, mean.size) * rms * rms[:, None]
        # Images have the sum 1: x − Σx m has no noise along the mean m.
        projection = np.eye(mean.size) - mean[:, None]
        return np.asarray(projection @ covariance @ projection.T)


@cache
def compute_shifted_noise(side: int, phases: int = 17) -> np.ndarray:
    """Return the covariance of white noise after a shift by splines, (phases, d, d).

    Shifts are 0 … ½ pixel along one axis. The d pixels are the middle third of a longer axis, so
    that its ends have no influence.
    """
    moving = moving_matrices(3 * side, np.linspace(0.0, 0.5, phases))
    # A matrix M turns white noise into noise of covariance M Mᵀ.
    rows = moving[:, side : 2 * side]
    return np.asarray(rows @ rows.transpose(0, 2, 1))
