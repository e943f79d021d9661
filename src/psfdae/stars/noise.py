"""Noise of a star on a bright sky, by several noise laws.

Inputs: noise-free PSFs of sum 1, (n, d, d), and noise levels. Outputs: variances of pixels and
noisy images; for bright stars, the contribution of noise to the scatter of their images.

The paper's noise level λ is the RMS of the pixels of a flux-normalised image up to
a factor, σ = κλ, and larger for fainter stars. A star of flux F photons on a
sky of B photons per pixel gives exactly that,

    n ~ Poisson(F p + B),   image = (n − B) / F,   F = √B / (κ λ),

with variance (κλ)² + p/F: the star's own photons are included. This is `NoiseModel`, the paper's
law. In all other laws of `LAWS`, too, κλ is the RMS of a pixel of the sky over the flux, so that
levels of different laws are comparable.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, ClassVar

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
    has_independent_pixels : bool
        False if the noise of a pixel is correlated with its neighbours'.
    """

    has_independent_pixels: ClassVar[bool] = True

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

    def covariance(self, psf: np.ndarray, level: float) -> np.ndarray:
        """Return the covariance of the pixels (P, P) of an image (P,) of a square stamp."""
        return np.diag(self.variance(psf, level))

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


@dataclass(frozen=True)
class GaussianNoise(NoiseModel):
    """Gaussian noise of the same variance in all pixels, as of a detector's read noise.

    image = p + κλ z with standard normal z. The star's photons add no noise: the law holds for
    faint stars on a detector whose read noise √B, in electrons, exceeds the noise of the sky.
    """

    def variance(self, psf: np.ndarray, level: np.ndarray | float) -> np.ndarray:
        """Return the pixel variance (κλ)² in the shape of `psf`."""
        return np.broadcast_to((self.kappa * np.asarray(level)) ** 2, np.shape(psf))

    def draw(
        self, psf: np.ndarray, level: np.ndarray | float, rng: np.random.Generator
    ) -> np.ndarray:
        """Draw noisy images as `NoiseModel.draw_gaussian`, which is exact for this law."""
        return self.draw_gaussian(psf, level, rng)


@dataclass(frozen=True)
class DetectorNoise(NoiseModel):
    """Photon noise of star and sky, Gaussian read noise, and rounding to whole counts.

    The electrons of a pixel are n ~ Poisson(F p + B) + r z, and the image is
    (g round(n / g) − B) / F with F = √(B + r² + g²/12) / (κ λ): the variance of a pixel is
    (κλ)² + p/F, as of `NoiseModel`, with a brighter star for the same λ.

    Attributes
    ----------
    read_noise_e : float
        RMS r of the read noise in electrons.
    gain_e : float
        Electrons g per count; 0: images are not rounded.
    """

    read_noise_e: float
    gain_e: float

    def flux(self, level: np.ndarray | float) -> np.ndarray:
        """Return the flux F in photons inside the stamp of a star of noise level λ."""
        # Rounding to steps g has the variance g²/12 of a uniform error.
        variance = self.background + self.read_noise_e**2 + self.gain_e**2 / 12.0
        return np.asarray(np.sqrt(variance) / (self.kappa * np.asarray(level, np.float64)))

    def draw(
        self, psf: np.ndarray, level: np.ndarray | float, rng: np.random.Generator
    ) -> np.ndarray:
        """Draw noisy images, sky-subtracted and normalised by the true flux, as `NoiseModel`."""
        flux = _per_image(self.flux(level), psf)
        electrons = rng.poisson(np.maximum(flux * psf + self.background, 0.0)).astype(np.float64)
        electrons += self.read_noise_e * rng.standard_normal(psf.shape)
        if self.gain_e:
            electrons = self.gain_e * np.rint(electrons / self.gain_e)
        return np.asarray((electrons - self.background) / flux, np.float32)


@dataclass(frozen=True)
class CorrelatedNoise(NoiseModel):
    """Noise of pixels that were interpolated linearly to a grid shifted by s pixels per axis.

    A pixel is (1 − s) a + s b of two neighbours along each axis, as in registered and stacked
    images. Neighbours have the correlation ρ = s (1 − s) / ((1 − s)² + s²). Each pixel keeps the
    variance of `NoiseModel` for its λ and its star; the star is not interpolated, because its PSF
    in such images includes the interpolation.

    Attributes
    ----------
    shift_px : float
        Shift s, 0 to 0.5.
    """

    has_independent_pixels: ClassVar[bool] = False

    shift_px: float

    def covariance(self, psf: np.ndarray, level: float) -> np.ndarray:
        """Return the covariance of the pixels (P, P) of an image (P,) of a square stamp."""
        # Correlation along one axis; correlations along both axes multiply.
        s, side = self.shift_px, round(psf.size**0.5)
        rho = s * (1.0 - s) / ((1.0 - s) ** 2 + s**2)
        along = np.eye(side) + rho * (np.eye(side, k=1) + np.eye(side, k=-1))
        sigma = np.sqrt(self.variance(psf, level))
        return np.asarray(np.kron(along, along) * sigma * sigma[:, None])

    def draw(
        self, psf: np.ndarray, level: np.ndarray | float, rng: np.random.Generator
    ) -> np.ndarray:
        """Draw noisy images of stars (B, d, d) with correlated photon noise."""
        # Photon noise of unit variance on a stamp with one more row and column.
        wide_psf, levels = self._widen(psf), _per_image(level, psf)
        error = super().draw(wide_psf, level, rng) - wide_psf
        unit_noise = error / np.sqrt(self.variance(wide_psf, levels))
        return self._add_noise(psf, levels, unit_noise)

    def draw_gaussian(
        self, psf: np.ndarray, level: np.ndarray | float, rng: np.random.Generator
    ) -> np.ndarray:
        """Draw images as `draw` does, but with Gaussian noise of the same covariance."""
        unit_noise = rng.standard_normal(self._widen(psf).shape, dtype=np.float32)
        return self._add_noise(psf, _per_image(level, psf), unit_noise)

    @staticmethod
    def _widen(psf: np.ndarray) -> np.ndarray:
        """Return stamps with one more row and column, equal to the last ones."""
        return np.pad(psf, ((0, 0), (0, 1), (0, 1)), mode="edge")

    def _add_noise(self, psf: np.ndarray, level: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return stars with interpolated noise, from noise of variance 1 on wider stamps."""
        # Weights whose squares add up to 1 keep the variance.
        s = self.shift_px
        first, second = np.array([1.0 - s, s]) / np.hypot(1.0 - s, s)
        noise = first * noise[:, :-1] + second * noise[:, 1:]
        noise = first * noise[:, :, :-1] + second * noise[:, :, 1:]
        return np.asarray(psf + np.sqrt(self.variance(psf, level)) * noise, np.float32)


LAWS: Mapping[str, type[NoiseModel]] = {
    "poisson": NoiseModel,
    "gaussian": GaussianNoise,
    "detector": DetectorNoise,
    "correlated": CorrelatedNoise,
}
"""Classes of the noise laws by the key `noise.law`."""


def build_noise(noise: Mapping[str, Any]) -> NoiseModel:
    """Return the noise model of dumped settings `psfdae.base.settings.Noise`.

    Files of earlier versions lack the law, which is Poisson noise.
    """
    law = LAWS[noise.get("law", "poisson")]
    values = {**noise, "background": noise["background_photons"]}
    return law(**{field.name: values[field.name] for field in fields(law)})


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
