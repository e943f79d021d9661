"""Stars of an image without a list: the sources above its sky, and whether a list fits.

Sources are connected pixels above the sky (Bertin & Arnouts 1996, A&AS 117, 393); touching sources
are parted where a saddle is deep enough.
"""

from __future__ import annotations

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
    smooth, limit = _smooth(sky, threshold, fwhm_px)
    # A source has at least a circle of half the FWHM in diameter.
    min_px = max(MIN_SOURCE_PX, round(np.pi * (fwhm_px / 4.0) ** 2))
    # Sources are parted at saddles between 8 levels; 32 levels find 1 % more stars. Smoothed stars
    # have shallow saddles between them, which few levels miss.
    sources = label_areas((smooth > limit) & ~sky.holes, min_px)
    if not sources.any():
        return {"id": np.empty(0, np.int64)}
    sources = part_sources(smooth, sources, min_px, levels=32 if fwhm_px else 8)
    # Sums of pixels of each source: centroids of the smoothed light, and fluxes.
    row, column = np.nonzero(sources)
    label = np.unique(sources[row, column], return_inverse=True)[1]
    weight = smooth[row, column].astype(np.float64)
    total, x, y, flux = (
        np.bincount(label, values)
        for values in (weight, weight * column, weight * row, sky.signal[row, column])
    )
    x, y = x / total, y / total
    # Sources of which the centroid is not a number are left out.
    finite = np.isfinite(x) & np.isfinite(y)
    x, y, flux = x[finite], y[finite], flux[finite]
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


def label_areas(is_bright: np.ndarray, min_px: int) -> np.ndarray:
    """Return numbers (h, w) of connected areas of at least `min_px` pixels, and 0 elsewhere."""
    number, _ = scipy.ndimage.label(is_bright, np.ones((3, 3)))
    is_large = np.bincount(number.ravel()) >= min_px
    is_large[0] = False
    return np.asarray(np.where(is_large[number], number, 0))


def part_sources(
    smooth: np.ndarray, sources: np.ndarray, min_px: int, levels: int, least_share: float = 0.005
) -> np.ndarray:
    """Return numbers (h, w) of the pixels of touching sources that have a saddle between them.

    The sources of photutils' `deblend_sources` (Bertin & Arnouts 1996, A&AS 117, 393), of the whole
    image at once, which takes a fraction of its time.

    Parameters
    ----------
    smooth : ndarray, shape (h, w)
        Image, above 0 in sources.
    sources : ndarray of int, shape (h, w)
        Numbers of the sources (`label_areas`).
    min_px : int
        Minimum number of pixels of a part.
    levels : int
        Number of levels between which saddles are seen.
    least_share : float
        Minimum light of a part, as a fraction of its source's.
    """
    from skimage.segmentation import watershed

    # Level of each pixel: the k-th of n levels is low (high / low)^(k / (n + 1)), between the least
    # and the greatest value of a source.
    row, column = np.nonzero(sources)
    values, number = np.log(smooth[row, column]), sources[row, column]
    low, high = np.full(number.max() + 1, np.inf), np.full(number.max() + 1, -np.inf)
    np.minimum.at(low, number, values)
    np.maximum.at(high, number, values)
    span = np.where(high > low, high - low, np.inf)
    level = np.zeros(sources.shape, np.float32)
    level[row, column] = (levels + 1) * (values - low[number]) / span[number]
    # A part that has several parts at the next level is replaced by these.
    parts = sources
    for k in range(1, levels + 1):
        upper = label_areas(level > k, min_px)
        first_pixel = np.unique(upper, return_index=True)[1][1:]
        is_parted = np.bincount(parts.ravel()[first_pixel], minlength=parts.max() + 1) > 1
        upper[upper > 0] += parts.max()
        parts = np.where(is_parted[parts], upper, parts)
    # All pixels of a source belong to the part to which they lead uphill. The faintest parts of a
    # source that have too little light together are dropped, and the others grow, until all have
    # enough.
    is_open = np.ones(number.max() + 1, bool)
    while True:
        region = is_open[sources] & (sources > 0)
        grown = watershed(-smooth, np.where(region, parts, 0), np.ones((3, 3)), mask=region)
        parts = np.where(region, grown, parts)
        part_number, first_pixel = (a[1:] for a in np.unique(parts, return_index=True))
        light = np.bincount(parts.ravel(), smooth.ravel())[part_number]
        source = sources.ravel()[first_pixel]
        share = light / np.bincount(source, light)[source]
        order = np.lexsort((share, source))
        total = np.cumsum(share[order]) - np.searchsorted(np.unique(source), source[order])
        dropped = order[total < least_share]
        if not len(dropped):
            return parts
        is_open[:] = False
        is_open[source[dropped]] = True
        parts[np.isin(parts, part_number[dropped])] = 0


def is_on_source(sky: Sky, column: np.ndarray, row: np.ndarray, threshold: float) -> np.ndarray:
    """Return True for pixels (n,) on which a source stands; never off the image."""
    smooth, limit = _smooth(sky, threshold)
    above = (smooth > limit) & ~sky.holes
    # The middle of a ring, such as a star out of focus, is on the star: of up to 100 px.
    hole_label, _ = scipy.ndimage.label(scipy.ndimage.binary_fill_holes(above) & ~above)
    small = np.bincount(hole_label.ravel()) <= 100
    small[0] = False
    sources = label_areas(above | small[hole_label], MIN_SOURCE_PX)
    # Pixels of the list that are on the image.
    height, width = sky.signal.shape
    inside: np.ndarray = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    inside[inside] = sources[row[inside], column[inside]] > 0
    return inside
