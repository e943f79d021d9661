"""Stars of an image without a list: the sources above its sky, and whether a list fits.

SEP finds them (Barbary 2016, JOSS 1, 58): sources are connected pixels above the sky (Bertin &
Arnouts 1996, A&AS 117, 393); touching sources are parted where a saddle is deep enough.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import scipy

from psfdae.image.sky import Sky
from psfdae.image.source_size import measure_size
from psfdae.stars.moments import FWHM_OF_SIGMA

MIN_SOURCE_PX = 5
"""Minimum number of connected pixels above the threshold that are a source."""


def _smooth(sky: Sky, threshold: float, fwhm_px: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return the image without its sky, smoothed, and the threshold of each pixel, (h, w) each.

    It is smoothed slightly, by [1, 2, 1]/4 along both axes, or by a Gaussian of that FWHM.
    """
    if not fwhm_px:
        # Noise of a weighted sum of pixels, σ √(Σ w²).
        kernel = np.outer([1, 2, 1], [1, 2, 1]) / 16.0
        noise_factor = float(np.sqrt(np.square(kernel).sum()))
        return scipy.ndimage.convolve(sky.signal, kernel), threshold * noise_factor * sky.noise
    # Noise of a pixel after a Gaussian of σ_g: σ/(2 √π σ_g).
    sigma = fwhm_px / FWHM_OF_SIGMA
    smooth = scipy.ndimage.gaussian_filter(sky.signal, sigma)
    return smooth, threshold * sky.noise / (2.0 * np.sqrt(np.pi) * sigma)


def find_sources(sky: Sky, threshold: float) -> dict[str, np.ndarray]:
    """Return columns of a star list as SExtractor names them, positions from 1, ids too.

    Where stars have a FWHM of 7 px or more, noise would part a star into many: the image is
    smoothed by a Gaussian as wide as the brightest sources before it is searched.

    Parameters
    ----------
    sky : Sky
        The image without its sky.
    threshold : float
        Minimum height of a source, in σ of the smoothed image.
    """
    # Slightly smoothed at first.
    columns, smoothing = _list_sources(sky, threshold), 0.0
    # The size of the sources, and the sources smoothed by it, until both agree.
    for _ in range(3):
        if "X_IMAGE" not in columns:
            break
        position = np.stack([columns["X_IMAGE"], columns["Y_IMAGE"]], axis=1) - 1
        size = measure_size(sky.signal, sky.bad, position)
        if size is None or size.fwhm_px < 7.0 or abs(size.fwhm_px - smoothing) < 0.2 * smoothing:
            break
        smoothing = size.fwhm_px
        columns = _list_sources(sky, threshold, smoothing)
    return columns


def _list_sources(sky: Sky, threshold: float, fwhm_px: float = 0.0) -> dict[str, np.ndarray]:
    """Return columns of a star list of the image, smoothed by a Gaussian or slightly."""
    import sep

    smooth, limit = _smooth(sky, threshold, fwhm_px)
    # A source has at least a circle of half the FWHM in diameter.
    min_px = max(MIN_SOURCE_PX, round(np.pi * (fwhm_px / 4.0) ** 2))
    # Sources are parted at saddles between 8 levels; 32 levels find 1 to 3 % more. Smoothed stars
    # have shallow saddles between them, which few levels miss.
    with enlarge_buffers(int(np.count_nonzero(smooth > limit)), min_px):
        sources, number = sep.extract(
            np.ascontiguousarray(smooth, np.float32),
            1.0,
            err=np.ascontiguousarray(limit, np.float32),
            mask=np.ascontiguousarray(sky.holes),
            minarea=min_px,
            filter_kernel=None,
            deblend_nthresh=32 if fwhm_px else 8,
            deblend_cont=0.005,
            clean=False,
            segmentation_map=True,
        )
    if not len(sources):
        return {"id": np.empty(0, np.int64)}
    # Centroids of the smoothed light, and the flux of each source's pixels.
    x, y = sources["x"], sources["y"]
    flux = np.bincount(number.ravel(), sky.signal.ravel(), len(sources) + 1)[1:]
    # Level of the sky at the pixel of each source.
    height, width = sky.level.shape
    row = np.clip(np.rint(y), 0, height - 1).astype(int)
    column = np.clip(np.rint(x), 0, width - 1).astype(int)
    level = sky.level[row, column]

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


@contextmanager
def enlarge_buffers(bright_px: int, min_px: int) -> Iterator[None]:
    """Enlarge the buffers of sep for an image; they are the user's, too, and restored at the end.

    Parameters
    ----------
    bright_px : int
        Pixels above the limit.
    min_px : int
        Pixels of the smallest source, of which one may have many.
    """
    import sep

    stack_px, source_count = sep.get_extract_pixstack(), sep.get_sub_object_limit()
    try:
        sep.set_extract_pixstack(max(300_000, 2 * bright_px))
        sep.set_sub_object_limit(max(1024, bright_px // min_px))
        yield
    finally:
        sep.set_extract_pixstack(stack_px)
        sep.set_sub_object_limit(source_count)


def is_on_source(sky: Sky, column: np.ndarray, row: np.ndarray, threshold: float) -> np.ndarray:
    """Return True for pixels (n,) on which a source stands; never off the image."""
    smooth, limit = _smooth(sky, threshold)
    above = (smooth > limit) & ~sky.holes
    # The middle of a ring, such as a star out of focus, is on the star: of up to 100 px.
    hole_label, _ = scipy.ndimage.label(scipy.ndimage.binary_fill_holes(above) & ~above)
    small = np.bincount(hole_label.ravel()) <= 100
    small[0] = False
    parts, _ = scipy.ndimage.label(above | small[hole_label], np.ones((3, 3)))
    # Connected pixels that are enough for a source.
    source = np.bincount(parts.ravel()) >= MIN_SOURCE_PX
    source[0] = False
    # Pixels of the list that are on the image.
    height, width = sky.signal.shape
    inside: np.ndarray = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    inside[inside] = source[parts[row[inside], column[inside]]]
    return inside
