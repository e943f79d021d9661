"""Stars of an image without a list: its sky, the sources above it, and whether a list fits.

Inputs: an image (h, w) and its bad pixels. Output: `Sky`, the image without its sky, which finds
stars.

photutils finds them: sources are connected pixels above the sky (Bertin & Arnouts
1996, A&AS 117, 393); touching sources are parted where a saddle is deep enough.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np
import scipy

from psfdae.image.interpolation import fill_bad
from psfdae.image.sky_level import SkyLevel, SkyStructure, sky_level
from psfdae.image.source_size import measure_size
from psfdae.stars.moments import FWHM_OF_SIGMA


@dataclass(frozen=True)
class Sky:
    """An image (h, w) with its sky subtracted, and the sky, in single precision.

    Attributes
    ----------
    flat : ndarray, shape (h, w)
        Image above its sky; interpolated where bad, 0 where no good pixel is near.
    level, noise : ndarray, shape (h, w)
        Level of the sky, and σ of each pixel.
    bad : ndarray of bool, shape (h, w)
        Pixels to ignore.
    noise_scale : float
        Factor of the map of σ, NaN without one.
    structure : SkyStructure
        Steps of the sky's level and of its pixels.
    notes : tuple of str
        Sentences on unusual properties of the sky.
    """

    flat: np.ndarray
    level: np.ndarray
    noise: np.ndarray
    bad: np.ndarray
    noise_scale: float
    structure: SkyStructure = field(default_factory=SkyStructure)
    notes: tuple[str, ...] = ()
    least_px: ClassVar[int] = 5
    """Minimum number of connected pixels above the threshold that are a source."""

    @cached_property
    def holes(self) -> np.ndarray:
        """Bad pixels (h, w) of which more than half of the 5 × 5 pixels around are bad, too.

        Other bad pixels are interpolated, so that a star with one of these is one source.
        """
        if not self.bad.any():
            return self.bad
        # Part of the 5 × 5 pixels that is bad.
        around = scipy.ndimage.uniform_filter(self.bad.astype(np.float32), 5, mode="nearest")
        return np.asarray(self.bad & (around > 0.5))

    def _above(self, threshold: float, fwhm_px: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return the smoothed image, and the threshold of each pixel, (h, w) each.

        It is smoothed slightly, by [1, 2, 1]/4 along both axes, or by a Gaussian of that FWHM.
        """
        if not fwhm_px:
            # Noise of a weighted sum of pixels, σ √(Σ w²).
            kernel = np.outer([1, 2, 1], [1, 2, 1]) / 16.0
            noise_part = float(np.sqrt(np.square(kernel).sum()))
            return scipy.ndimage.convolve(self.flat, kernel), threshold * noise_part * self.noise
        # Noise of a pixel after a Gaussian of σ_g: σ/(2 √π σ_g).
        sigma = fwhm_px / FWHM_OF_SIGMA
        smooth = scipy.ndimage.gaussian_filter(self.flat, sigma)
        return smooth, threshold * self.noise / (2.0 * np.sqrt(np.pi) * sigma)

    def stars(self, threshold: float, wide_px: float = 7.0) -> dict[str, np.ndarray]:
        """Return columns of a star list as SExtractor names them, positions from 1, ids too.

        Where stars are wide, noise would part a star into many: the image is smoothed by a Gaussian
        as wide as the brightest sources before it is searched.

        Parameters
        ----------
        threshold : float
            Minimum height of a source, in σ of the smoothed image.
        wide_px : float
            FWHM from which stars are wide.
        """
        # Slightly smoothed at first.
        columns, smoothing = self._sources(threshold), 0.0
        # The size of the sources, and the sources smoothed by it, until both agree.
        for _ in range(3):
            if "X_IMAGE" not in columns:
                break
            place = np.stack([columns["X_IMAGE"], columns["Y_IMAGE"]], axis=1) - 1
            size = measure_size(self.flat, self.bad, place)
            if size is None or size.fwhm_px < wide_px:
                break
            if abs(size.fwhm_px - smoothing) < 0.2 * smoothing:
                break
            smoothing = size.fwhm_px
            columns = self._sources(threshold, smoothing)
        return columns

    def _sources(self, threshold: float, fwhm_px: float = 0.0) -> dict[str, np.ndarray]:
        """Return columns of a star list of the image, smoothed by a Gaussian or slightly."""
        from photutils.segmentation import SourceCatalog, SourceFinder

        smooth, limit = self._above(threshold, fwhm_px)
        # A source has at least a circle of half the FWHM in diameter.
        least_px = max(self.least_px, round(np.pi * (fwhm_px / 4.0) ** 2))
        # Sources are parted at saddles between 8 levels; 32 levels take three times as long for 1 %
        # more stars. Smoothed stars have shallow saddles between them, which few levels miss.
        finder = SourceFinder(least_px, n_levels=32 if fwhm_px else 8, contrast=0.005)
        finder.progress_bar = False  # photutils 3.0 shows one; the argument goes in 4.0
        parts = finder(smooth, limit, mask=self.holes)
        if parts is None:
            return {"id": np.empty(0, np.int64)}
        # Centroids and fluxes; they are NaN for a source of negative pixels only.
        catalogue = SourceCatalog(self.flat, parts, convolved_data=smooth, mask=self.holes)
        columns = catalogue.x_centroid, catalogue.y_centroid, catalogue.segment_flux
        x, y, flux = (np.atleast_1d(column) for column in columns)
        # Sources of which the centroid is not a number are left out.
        finite = np.isfinite(x) & np.isfinite(y)
        x, y, flux = x[finite], y[finite], flux[finite]
        # Level of the sky at the pixel of each source.
        height, width = self.level.shape
        row = np.clip(np.rint(y), 0, height - 1).astype(int)
        column = np.clip(np.rint(x), 0, width - 1).astype(int)
        level = self.level[row, column]

        def round_digits(values: np.ndarray) -> np.ndarray:
            """Return eight digits, not decimals: the unit of an image may be of any size."""
            return np.array([float(f"{value:.8g}") for value in values.astype(float).tolist()])

        return {
            "id": np.arange(1, len(x) + 1),
            "X_IMAGE": np.round(x + 1, 3),
            "Y_IMAGE": np.round(y + 1, 3),
            "FLUX_ISO": round_digits(flux),
            "BACKGROUND": round_digits(level),
        }

    def is_on_source(self, column: np.ndarray, row: np.ndarray, threshold: float) -> np.ndarray:
        """Return True for pixels (n,) on which a source stands; never off the image."""
        # As photutils parts an image, which takes a second to be loaded.
        smooth, limit = self._above(threshold)
        above = (smooth > limit) & ~self.holes
        # The middle of a ring, such as a star out of focus, is on the star: of up to 100 px.
        hole_label, _ = scipy.ndimage.label(scipy.ndimage.binary_fill_holes(above) & ~above)
        small = np.bincount(hole_label.ravel()) <= 100
        small[0] = False
        parts, _ = scipy.ndimage.label(above | small[hole_label], np.ones((3, 3)))
        # Connected pixels that are enough for a source.
        source = np.bincount(parts.ravel()) >= self.least_px
        source[0] = False
        # Pixels of the list that are on the image.
        height, width = self.flat.shape
        inside: np.ndarray = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        inside[inside] = source[parts[row[inside], column[inside]]]
        return inside


def find_sky(
    image: np.ndarray,
    bad: np.ndarray,
    sigma: np.ndarray | None = None,
    least_noise: float = 0.0,
    known_sky: SkyLevel | None = None,
    structure: SkyStructure | None = None,
) -> Sky:
    """Subtract the sky of an image; return the image with its sky.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Image, in any unit.
    bad : ndarray of bool, shape (h, w)
        Pixels to ignore.
    sigma : ndarray, shape (h, w), optional
        σ of every pixel but for a factor, which is fitted here.
    least_noise : float
        Lower limit of the noise, in the unit of the image.
    known_sky : SkyLevel, optional
        Sky of the image, if it was measured before.
    structure : SkyStructure, optional
        Structure of the sky, if it is known from the image with its stars.

    Raises
    ------
    ValueError
        If no mesh has enough good pixels.
    """
    # Level and noise from the good pixels.
    image = np.where(bad, 0.0, image)
    sky = sky_level(image, bad, structure) if known_sky is None else known_sky
    level, noise, structure, notes = sky
    # Whole counts, or images without noise, may show none; the threshold must not be 0 there.
    least_noise = max(least_noise, 1e-13 * float(np.ptp(image)), float(np.finfo(np.float32).tiny))
    noise = np.maximum(noise, least_noise, out=noise)
    # A map of σ is scaled so that its median equals the median of the measured noise.
    scale = np.nan
    if sigma is not None:
        scale = float(np.median(noise[~bad] / sigma[~bad]))
        # Bad pixels, for which the map may lack σ, keep the noise of the sky around.
        noise = np.where(np.isfinite(sigma), scale * sigma, noise).astype(np.float32)
    flat = fill_bad((image - level).astype(np.float32), bad)[0]
    return Sky(flat, level, noise, bad, scale, structure, notes)
