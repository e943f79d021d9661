"""Stars of an image without a list: its sky, what stands above it, and whether a list fits.

photutils does it: sources as connected pixels above it (Bertin & Arnouts
1996, A&AS 117, 393), those that touch parted where a saddle is deep enough.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from psfdae.image.bad_pixels import interpolated
from psfdae.image.sky_level import sky_level
from psfdae.image.source_size import measure_size
from psfdae.moments import FWHM_OF_SIGMA

LEAST_PX = 5  # pixels of a source
LEVELS, CONTRAST = 8, 0.005  # of the parting; 32 levels take three times as long for 1 % more stars
SMOOTHING = np.outer([1, 2, 1], [1, 2, 1]) / 16.0
SMOOTHED_NOISE = float(np.sqrt(np.square(SMOOTHING).sum()))  # that of a pixel, in σ of before
DECIMALS = 3  # of positions
WIDE_PX = 7.0  # FWHM of sources from which an image is smoothed by it before it is searched


@dataclass(frozen=True)
class Sky:
    """An image (h, w) with its sky subtracted, and what was subtracted, in single precision."""

    flat: np.ndarray  # interpolated where bad; 0 where no good pixel is near
    level: np.ndarray
    noise: np.ndarray  # σ of every pixel
    bad: np.ndarray
    noise_scale: float  # of the map of σ, if there was one
    notes: tuple[str, ...] = ()  # what is unusual in the sky

    @cached_property
    def holes(self) -> np.ndarray:
        """Bad pixels (h, w) of which more than half of the 5 × 5 pixels around are bad, too.

        Other bad pixels are interpolated, so that a star with one of these is one source.
        """
        from scipy import ndimage

        if not self.bad.any():
            return self.bad
        around = ndimage.uniform_filter(self.bad.astype(np.float32), 5, mode="nearest")
        return np.asarray(self.bad & (around > 0.5))

    def _above(self, threshold: float, fwhm_px: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """The smoothed image, and where its threshold is.

        It is smoothed slightly, or by a Gaussian of that FWHM.
        """
        from scipy import ndimage

        if not fwhm_px:
            return ndimage.convolve(self.flat, SMOOTHING), threshold * SMOOTHED_NOISE * self.noise
        # Noise of a pixel after a Gaussian of σ_g: σ/(2 √π σ_g).
        sigma = fwhm_px / FWHM_OF_SIGMA
        smooth = ndimage.gaussian_filter(self.flat, sigma)
        return smooth, threshold * self.noise / (2.0 * np.sqrt(np.pi) * sigma)

    def stars(self, threshold: float, fwhm_px: float | None = None) -> dict[str, np.ndarray]:
        """Columns of a star list as SExtractor names them, positions from 1, ids too.

        `threshold` is in σ of the smoothed image: slightly, or, where stars are wide, by a Gaussian
        as wide as the brightest sources. Otherwise noise would part a star into many. The FWHM of
        stars is measured if it is not known.
        """
        if fwhm_px is not None:
            return self._sources(threshold, fwhm_px if fwhm_px >= WIDE_PX else 0.0)
        columns, smoothing = self._sources(threshold), 0.0
        for _ in range(3):
            if "X_IMAGE" not in columns:
                break
            place = np.stack([columns["X_IMAGE"], columns["Y_IMAGE"]], axis=1) - 1
            size = measure_size(self.flat, self.bad, place)
            if size is None or size.fwhm_px < WIDE_PX:
                break
            if abs(size.fwhm_px - smoothing) < 0.2 * smoothing:
                break
            smoothing = size.fwhm_px
            columns = self._sources(threshold, smoothing)
        return columns

    def _sources(self, threshold: float, fwhm_px: float = 0.0) -> dict[str, np.ndarray]:
        """Columns of a star list of the image, smoothed by a Gaussian of that FWHM or slightly."""
        from photutils.segmentation import SourceCatalog, SourceFinder

        smooth, limit = self._above(threshold, fwhm_px)
        # A source has at least a circle of half the FWHM in diameter.
        least_px = max(LEAST_PX, round(np.pi * (fwhm_px / 4.0) ** 2))
        # Smoothed stars have shallow saddles between them, which few levels miss.
        levels = 4 * LEVELS if fwhm_px else LEVELS
        finder = SourceFinder(least_px, n_levels=levels, contrast=CONTRAST)
        finder.progress_bar = False  # photutils 3.0 shows one; the argument goes in 4.0
        parts = finder(smooth, limit, mask=self.holes)
        if parts is None:
            return {"id": np.empty(0, np.int64)}
        catalogue = SourceCatalog(self.flat, parts, convolved_data=smooth, mask=self.holes)
        x, y, flux = (
            np.atleast_1d(v)
            for v in (catalogue.x_centroid, catalogue.y_centroid, catalogue.segment_flux)
        )
        finite = np.isfinite(x) & np.isfinite(y)
        x, y, flux = x[finite], y[finite], flux[finite]
        height, width = self.level.shape
        row, column = (
            np.clip(np.rint(v), 0, n - 1).astype(int) for v, n in ((y, height), (x, width))
        )
        return {
            "id": np.arange(1, len(x) + 1),
            "X_IMAGE": np.round(x + 1, DECIMALS),
            "Y_IMAGE": np.round(y + 1, DECIMALS),
            # Digits, not decimals: the unit of an image may be of any size.
            "FLUX_ISO": _with_digits(flux.astype(float)),
            "BACKGROUND": _with_digits(self.level[row, column].astype(float)),
        }

    def covered(self, column: np.ndarray, row: np.ndarray, threshold: float) -> np.ndarray:
        """Whether a source stands on each pixel (n,), bool; never off the image."""
        from scipy import ndimage

        # As photutils parts an image, which takes a second to be loaded.
        smooth, limit = self._above(threshold)
        above = (smooth > limit) & ~self.holes
        # The middle of a ring, such as a star out of focus, is on the star: of up to 100 px.
        enclosed, _ = ndimage.label(ndimage.binary_fill_holes(above) & ~above)
        small = np.bincount(enclosed.ravel()) <= 100
        small[0] = False
        parts, _ = ndimage.label(above | small[enclosed], np.ones((3, 3)))
        source = np.bincount(parts.ravel()) >= LEAST_PX
        source[0] = False
        height, width = self.flat.shape
        inside: np.ndarray = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        inside[inside] = source[parts[row[inside], column[inside]]]
        return inside


def _with_digits(values: np.ndarray) -> np.ndarray:
    """Return numbers (n,) with eight significant digits."""
    return np.array([float(f"{value:.8g}") for value in values.tolist()])


def sky_of(
    image: np.ndarray, bad: np.ndarray, sigma: np.ndarray | None = None, least_noise: float = 0.0
) -> Sky:
    """Sky and noise of an image.

    Parameters
    ----------
    image : ndarray, shape (h, w)
    bad : ndarray of bool, shape (h, w)
        Pixels that do not count.
    sigma : ndarray, shape (h, w), optional
        σ of every pixel but for a factor, which is found here.
    least_noise : float
        The noise is nowhere below this.

    Raises
    ------
    ValueError
        If no mesh has enough pixels that count.
    """
    image = np.where(bad, 0.0, image)
    measured = sky_level(image, bad)
    level = measured.level
    # Whole counts, or images without noise, may show none; the threshold must not be 0 there.
    least_noise = max(least_noise, 1e-13 * float(np.ptp(image)), float(np.finfo(np.float32).tiny))
    noise = np.maximum(measured.noise, least_noise, out=measured.noise)
    scale = np.nan
    if sigma is not None:
        scale = float(np.median(noise[~bad] / sigma[~bad]))
        noise = (scale * sigma).astype(np.float32)
    flat = interpolated((image - level).astype(np.float32), bad)[0]
    return Sky(flat, level, noise, bad, scale, measured.notes)
