"""Level and noise of the sky of an image, also where it has steps or structure.

Inputs: an image (h, w) and its bad pixels. Output: `SkyLevel`, a level and a σ for each pixel.

SEP measures both in meshes (Barbary 2016, JOSS 1, 58), between which they are interpolated.
Amplifiers of different bias make steps, which are found first: each part of the image has meshes of
its own. A nebula, or the halo of a bright star, changes within a mesh; there the level is a median
of the surrounding pixels.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
import scipy

from psfdae.image.interpolation import fill_bad
from psfdae.stars.moments import (
    count_step,
    cubic_splines,
    dither,
    middle_value,
    remove_dither,
    robust_scatter,
    row_medians,
)


class SkyStructure(NamedTuple):
    """Lines at which the level of a sky changes within few pixels, and the step of its pixels.

    Attributes
    ----------
    rows, columns : sequence of int
        Rows and columns at which the level has a step.
    is_fine : bool
        True if the level changes within a mesh; there it is a median of the surrounding pixels.
    pixel_step : float
        Step of the pixels if they are whole counts and noise is not much wider, else 0.
    """

    rows: Sequence[int] = ()
    columns: Sequence[int] = ()
    is_fine: bool = False
    pixel_step: float = 0.0


class SkyLevel(NamedTuple):
    """Sky of an image.

    Attributes
    ----------
    level, noise : ndarray, shape (h, w), float32
        Level and σ of the sky at each pixel.
        `noise` is larger than σ of single pixels by `correlation`.
    structure : SkyStructure
        Steps and fine structure.
    correlation : float
        Ratio of the noise of sums of pixels to the noise of sums of independent ones, at least 1.
    notes : tuple of str
        Sentences on steps and structure.
    """

    level: np.ndarray
    noise: np.ndarray
    structure: SkyStructure
    correlation: float
    notes: tuple[str, ...]


def sky_level(
    image: np.ndarray, bad: np.ndarray, structure: SkyStructure | None = None, mesh_px: int = 64
) -> SkyLevel:
    """Measure level and noise of the sky of an image.

    Parameters
    ----------
    image : ndarray of float, shape (h, w)
        Finite pixels.
    bad : ndarray of bool, shape (h, w)
        Pixels that are ignored.
    structure : SkyStructure, optional
        Structure of the sky, if known from the same image with its stars.
    mesh_px : int
        Side of the squares in which the sky is measured.

    Raises
    ------
    ValueError
        If no mesh has enough good pixels.
    """
    return add_shared_noise(image, bad, measure_sky(image, bad, structure, mesh_px))


def measure_sky(
    image: np.ndarray, bad: np.ndarray, structure: SkyStructure | None = None, mesh_px: int = 64
) -> SkyLevel:
    """Measure level and noise as `sky_level` does, but the noise of single pixels.

    Its `correlation` is 1 until `add_shared_noise` has measured it.
    """
    # Dither whole counts, so that medians are not rounded.
    step = structure.pixel_step if structure else count_step(np.where(bad, np.nan, image))
    image, dither_variance = dither(image, step)
    if structure is None:
        rows, columns = (sky_steps(image, bad, axis) for axis in (0, 1))
        structure = SkyStructure(rows, columns, pixel_step=step)
    notes = []
    for name, lines in zip(("row", "column"), structure[:2], strict=True):
        if lines:
            lines_text = ", ".join(map(str, lines))
            notes.append(f"the sky has a step at {name} {lines_text}: the parts have their own sky")
    level, noise, fraction = level_and_noise(image, bad, structure, mesh_px)
    if fraction:
        notes.append(
            f"the sky has structure within {mesh_px} px in {100 * fraction:.0f} % of the image: "
            "it is measured in 14 px there, and light of wide sources is lost in it"
        )
    noise = remove_dither(noise, dither_variance)
    return SkyLevel(level, noise, structure._replace(is_fine=fraction > 0), 1.0, tuple(notes))


def add_shared_noise(image: np.ndarray, bad: np.ndarray, sky: SkyLevel) -> SkyLevel:
    """Return the sky of an image (h, w) with the noise of sums of pixels, which may share noise."""
    # Errors refer to sums of pixels, whose noise is larger if neighbours are correlated.
    middle = _cut_middle(image.shape)
    with np.errstate(all="ignore"):
        part, _ = dither(image[middle], sky.structure.pixel_step)
        deviation = (part - sky.level[middle]) / sky.noise[middle]
        correlation = noise_correlation(np.where(bad[middle], np.nan, deviation))
    if correlation == 1.0:
        return sky
    return sky._replace(noise=np.float32(correlation) * sky.noise, correlation=correlation)


def level_and_noise(
    image: np.ndarray, bad: np.ndarray, structure: SkyStructure, mesh_px: int = 64
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return level and σ (h, w) of a sky of known steps, and the part of it with fine structure.

    The noise is of single pixels; parameters are as in `sky_level`. Level and noise are from the
    meshes, and the part is 0, unless the sky is known to have fine structure, or over 5 % of the
    image has structure that is not due to sources.
    """
    # Each part between steps has meshes of its own.
    rows, columns, is_fine, _ = structure
    if not (rows or columns):
        level, noise = _measure_sky(image, bad, mesh_px)
    else:
        level, noise = (np.zeros(image.shape, np.float32) for _ in range(2))
        for top, bottom in zip((0, *rows), (*rows, len(image)), strict=True):
            for first, last in zip((0, *columns), (*columns, image.shape[1]), strict=True):
                part = np.s_[top:bottom, first:last]
                if not bad[part].all():
                    level[part], noise[part] = _measure_sky(image[part], bad[part], mesh_px)
    # Structure that is finer than the meshes: σ of a mesh over σ from differences of neighbouring
    # pixels is larger there than elsewhere by a factor of 1.5; in resampled images it is larger
    # everywhere. Both change slowly: every fourth pixel is enough.
    pixel_sigma = pixel_noise(image, bad)
    sample = np.s_[::4, ::4]
    ratio = noise[sample] / pixel_sigma[sample]
    ratio = ratio[~bad[sample] & (ratio > 0)]
    typical_ratio = max(float(np.percentile(ratio, 25)), 1e-6) if ratio.size else 1.0
    fraction = float(np.mean(ratio > 1.5 * typical_ratio)) if ratio.size else 0.0
    if not (is_fine or fraction > 0.05):
        return level, noise, 0.0
    fine_level = median_level(image - level, bad)
    if not (is_fine or keeps_peaks(image - level, fine_level, bad, pixel_sigma)):
        return level, noise, 0.0
    weight = structure_weight(noise / (typical_ratio * pixel_sigma), bad, mesh_px)
    level += weight * fine_level
    # The remainder; its noise changes with the light of the structure, in meshes of 16 px.
    remainder, noise = _measure_sky(image - level, bad, mesh_px)
    level += remainder
    noise += weight * (_measure_sky(image - level, bad, 16)[1] - noise)
    return level, noise, fraction


# Noise of pixels and of sums of pixels.


def pixel_noise(image: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return the noise (h, w) of pixels from the differences of neighbours, in squares of 64.

    It is infinite where neighbours do not differ, so that ratios to it are 0.

    Parameters
    ----------
    image : ndarray of float, shape (h, w)
        Finite pixels.
    bad : ndarray of bool, shape (h, w)
        Pixels that are ignored.
    """
    noise = np.full(image.shape, np.inf, image.dtype)
    for top in range(0, len(image), 64):
        band, is_hidden = image[top : top + 64], bad[top : top + 64]
        # |x₁ − x₂| of neighbours in a row; the last pixel of a row is compared with the one before.
        difference = np.abs(np.diff(band, axis=1, append=band[:, -2:-1]))
        is_hidden = is_hidden | np.concatenate([is_hidden[:, 1:], is_hidden[:, -2:-1]], axis=1)
        # A row for each mesh; NaN where pixels are ignored, and beyond the last row and column.
        rows, width = band.shape
        meshes = np.full((64, -(-width // 64) * 64), np.nan, difference.dtype)
        meshes[:rows, :width] = np.where(is_hidden, np.nan, difference)
        values = meshes.reshape(64, -1, 64).swapaxes(0, 1).reshape(-1, 64**2)
        # σ of one pixel from the median of |x₁ − x₂|, which has √2 σ.
        sigma = 1.4826 / np.sqrt(2.0) * row_medians(values)
        noise[top : top + 64] = np.repeat(np.where(sigma > 0, sigma, np.inf), 64)[: band.shape[1]]
    return noise


def noise_correlation(deviation: np.ndarray) -> float:
    """Return the noise of sums of pixels over sums of independent pixels, at least 1.

    It is √(Σ ρ a) over the correlations ρ of pixels up to 2 px apart, where a is the
    autocorrelation of the image's bright sources: in a sum that is weighted by a PSF, pixels
    farther apart share less. Without five bright sources a is 1, as in sums over many pixels. Faint
    sources and structure of the sky correlate pixels 3 and 4 px apart nearly as much as neighbours,
    along rows and columns alike; the ρ at these distances is due to them, and is subtracted. A
    larger ρ along rows or columns only is noise: offsets of rows or columns, as from 1/f noise. The
    result is 1 unless 0.15 remain of the correlation of neighbours then, or 0.05 along rows or
    columns.

    Parameters
    ----------
    deviation : ndarray, shape (h, w)
        Pixels without their sky, in σ; NaN where they are ignored. Sources are masked here.
    """
    deviation = deviation[_cut_middle(deviation.shape)]
    values = deviation
    if min(values.shape) < 16:
        return 1.0
    # Means of 3 × 3 pixels scatter by σ/3, or more if these are correlated: three times this.
    light = np.abs(scipy.ndimage.uniform_filter(np.nan_to_num(values), 3)) > 1.5
    values = np.where(scipy.ndimage.binary_dilation(light, iterations=3), np.nan, values)
    values[np.abs(values) > 3.0] = np.nan
    # Faint sources and structure, by pixels 3 and 4 px apart, and offsets of rows or columns.
    along_rows, along_columns = (
        0.5 * sum(_correlation(values, px * down, px * across) for px in (3, 4))
        for down, across in ((0, 1), (1, 0))
    )
    structure = max(min(along_rows, along_columns), 0.0)
    offsets = max(along_rows, along_columns, 0.0) - structure
    # Neighbours below and on the right; without correlation, most images end here.
    nearest = 0.5 * (_correlation(values, 0, 1) + _correlation(values, 1, 0))
    if nearest - structure - 0.5 * offsets < 0.15:
        # Offsets alone: pixels of a row up to 2 px apart on both sides.
        return float(np.sqrt(1.0 + 4.0 * offsets)) if offsets > 0.05 else 1.0
    # √(1 + 2 Σ ρ a): each lag stands for itself and its opposite.
    lags = [(0, 1), (0, 2), *product((1, 2), range(-2, 3))]
    noise_correlations = np.array([_correlation(values, *lag) for lag in lags])
    source_correlations = correlate_sources(deviation, lags, noise_correlations)
    excess = float((noise_correlations - structure) @ source_correlations)
    excess /= max(1.0 - structure, 0.1)
    return float(np.sqrt(max(1.0 + 2.0 * excess, 1.0)))


def _cut_middle(shape: tuple[int, ...]) -> tuple[slice, ...]:
    """Return the middle 1024 rows and columns of an image, enough to measure shared noise."""
    return tuple(slice(max(0, size // 2 - 512), size // 2 + 512) for size in shape)


def correlate_sources(
    deviation: np.ndarray, lags: Sequence[tuple[int, int]], noise_correlations: np.ndarray
) -> np.ndarray:
    """Return the autocorrelation of bright sources at lags (rows, columns), its median, 0 … 1.

    It is 1 with fewer than five sources of 8 σ that have no bad pixel within 6 px.

    Parameters
    ----------
    deviation : ndarray, shape (h, w)
        Pixels without their sky, in σ; NaN where they are ignored.
    lags : sequence of (int, int)
        Offsets of up to 2 px.
    noise_correlations : ndarray, shape (k,)
        Correlation of the noise at these lags.
    """
    # Local maxima, the 300 brightest, and windows of 9 × 9 px about them and a lag away.
    clean = np.nan_to_num(deviation)
    is_peak = (clean > 8.0) & (clean == scipy.ndimage.maximum_filter(clean, 9))
    row, column = np.nonzero(is_peak)
    brightest = np.argsort(-clean[row, column], kind="stable")[:300]
    row, column = row[brightest] + 2, column[brightest] + 2
    wide_image = np.pad(deviation, 6, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(wide_image, (9, 9))
    source, *neighbours = (windows[row + down, column + across] for down, across in [(0, 0), *lags])
    # Products of a source with itself; the noise of 81 pixels adds its own.
    products = np.array([(source * pixels).sum(axis=(1, 2)) for pixels in (source, *neighbours)])
    products -= np.prod(windows.shape[-2:]) * np.append(1.0, noise_correlations)[:, None]
    products = products[:, np.isfinite(products).all(axis=0)]
    if products.shape[1] < 5:
        return np.ones(len(lags))
    return np.asarray(np.clip(np.median(products[1:] / products[0], axis=1), 0.0, 1.0))


def _correlation(values: np.ndarray, rows_apart: int, columns_apart: int) -> float:
    """Return the correlation of pixels (h, w) with pixels some rows below and columns to the right.

    ρ = (s²(a + b) − s²(a − b))/(s²(a + b) + s²(a − b)) of pairs a, b, with s by median deviations;
    0 if fewer than 1000 pairs are finite.
    """
    # a and b are the same pixels, seen from the lag's two ends.
    height, width = values.shape
    a = values[: height - rows_apart, max(0, -columns_apart) : width - max(0, columns_apart)]
    b = values[rows_apart:, max(0, columns_apart) : width - max(0, -columns_apart)]
    # Some of the rows, with 2¹⁸ pairs, of which sources may hide most.
    every = np.s_[:: a.size // 2**18 + 1]
    a, b = a[every], b[every]
    is_finite = np.isfinite(a) & np.isfinite(b)
    if np.count_nonzero(is_finite) < 1000:
        return 0.0
    # 2¹⁶ pairs are enough, evenly spread: ρ has the error 0.006.
    step = np.count_nonzero(is_finite) // 2**16 + 1
    a, b = a[is_finite][::step], b[is_finite][::step]
    plus, minus = (float(middle_value(np.abs(v - middle_value(v)))) ** 2 for v in (a + b, a - b))
    return (plus - minus) / (plus + minus) if plus + minus > 0 else 0.0


# Meshes.


def _measure_sky(image: np.ndarray, bad: np.ndarray, mesh_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Measure level and σ in meshes and interpolate them, (h, w); 80 % of a mesh may be bad.

    Parameters
    ----------
    image : ndarray of float, shape (h, w)
        Finite pixels.
    bad : ndarray of bool, shape (h, w)
        Pixels that are ignored.
    mesh_px : int
        Side of the meshes in px.

    Raises
    ------
    ValueError
        If every mesh has more than 80 % bad pixels.
    """
    level, sigma = measure_meshes(image, bad, mesh_px)
    neighbours = _smooth_meshes(level)
    # A mesh differs from its neighbours by its error, about 2.5 σ/√N for the mode of N pixels, and
    # by the curvature of the sky: the larger the curvature, the larger its own weight (James &
    # Stein 1961). A mesh that differs by far more than the others has stars in it.
    deviation = level - neighbours
    scatter = 1.4826 * float(np.median(np.abs(deviation)))
    error = 2.5 * float(np.median(sigma)) / mesh_px
    mesh_weight = 1.0 - (error / scatter) ** 2 if scatter > error else 0.0
    has_stars = np.abs(deviation) > 4.0 * max(scatter, error)
    smooth = neighbours + np.where(has_stars, 0.0, mesh_weight * deviation)
    noise = _to_pixels(_smooth_meshes(sigma), image.shape, mesh_px, 0.0)
    return _to_pixels(smooth, image.shape, mesh_px, mesh_weight), noise


def measure_meshes(
    image: np.ndarray, bad: np.ndarray, mesh_px: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return mode and σ of the pixels in meshes, (m, n) each, as SEP estimates them.

    These are of pixels within 3 σ of their median; the mode is 2.5 median − 1.5 mean, or the median
    of skewed pixels (Bertin & Arnouts 1996, A&AS 117, 393). Meshes in which a fifth of the pixels
    or less are good take the mean of the ten nearest others, weighted by 1/distance.

    Parameters
    ----------
    image : ndarray of float, shape (h, w)
        Finite pixels.
    bad : ndarray of bool, shape (h, w)
        Pixels that are ignored.
    mesh_px : int
        Side of the meshes in px. Those at the lower and right edges may be smaller.

    Raises
    ------
    ValueError
        If every mesh has too few pixels.
    """
    import sep
    from scipy.spatial import cKDTree

    level, noise = np.full((2, *(-(-side // mesh_px) for side in image.shape)), np.nan)
    for row, column in np.ndindex(level.shape):
        mesh = tuple(np.s_[n * mesh_px : (n + 1) * mesh_px] for n in (row, column))
        # One row of the good pixels: SEP takes no mesh of which half is masked. It computes in
        # single precision, in which a level is compared with pixels below.
        pixels = image[mesh][~bad[mesh]][None].astype(np.float32)
        if pixels.size <= 0.2 * mesh_px**2:
            continue
        background = sep.Background(pixels, bw=pixels.size, bh=1, fw=1, fh=1)
        level[row, column], noise[row, column] = background.globalback, background.globalrms
        # SEP gives σ = 1 for pixels without scatter.
        if noise[row, column] == 1.0 and np.mean(pixels == level[row, column]) > 0.5:
            noise[row, column] = 0.0
    # Meshes without a value, from their neighbours.
    is_known = np.isfinite(level)
    if not is_known.any():
        raise ValueError(f"no mesh of {mesh_px} px has enough good pixels")
    if not is_known.all():
        nearest = min(10, int(np.count_nonzero(is_known)))
        tree = cKDTree(np.argwhere(is_known))
        distance, index = tree.query(np.argwhere(~is_known), k=range(1, nearest + 1))
        for values in (level, noise):
            values[~is_known] = np.average(values[is_known][index], axis=1, weights=1.0 / distance)
    return level, noise


def _extrapolate(mesh: np.ndarray, width: int, slope: float = 1.0) -> np.ndarray:
    """Extrapolate values of meshes (m, n) beyond the edges with a part of their slope.

    Parameters
    ----------
    mesh : ndarray, shape (m, n)
        Values in the meshes.
    width : int
        Number of meshes that are added on each side.
    slope : float
        0 repeats the edge, 1 continues the straight line through it.
    """
    # Along rows, then along columns: the edge repeated, and the same with its slope.
    for axis, count in enumerate(mesh.shape):
        pads = [(width, width) if axis == padded_axis else (0, 0) for padded_axis in (0, 1)]
        level = np.pad(mesh, pads, mode="edge")
        if count > width:
            line = np.pad(mesh, pads, mode="reflect", reflect_type="odd")
            level += slope * (line - level)
        mesh = level
    return mesh


def _smooth_meshes(mesh: np.ndarray) -> np.ndarray:
    """Smooth values of meshes (m, n) by their neighbours, without outliers.

    The result is the median of the value itself and of the means of the four pairs of opposite
    neighbours: all five are the same where the sky is a plane, up to the edges of the image.
    """
    # Meshes outside the edges are extrapolated along straight lines.
    squares = np.lib.stride_tricks.sliding_window_view(_extrapolate(mesh, 1), (3, 3))
    pairs = [
        0.5 * (squares[..., 1 + down, 1 + across] + squares[..., 1 - down, 1 - across])
        for down, across in ((0, 1), (1, 0), (1, 1), (1, -1))
    ]
    return np.asarray(np.median([mesh, *pairs], axis=0))


def _to_pixels(mesh: np.ndarray, shape: tuple[int, ...], mesh_px: int, slope: float) -> np.ndarray:
    """Interpolate values of meshes (m, n) to the pixels of an image (h, w), by cubic splines.

    Outside the middles of the outer meshes they are extrapolated with a part of their slope.

    Parameters
    ----------
    mesh : ndarray, shape (m, n)
        Values in the middles of the meshes.
    shape : tuple of int
        Rows and columns of the image.
    mesh_px : int
        Side of a mesh in pixels.
    slope : float
        Part of the slope outside the outer meshes, as in `_extrapolate`.
    """
    from scipy.sparse import csr_array

    # Coefficients of the spline through the meshes, which ends 14 meshes outside the image.
    margin = 14
    extended_mesh = np.pad(_extrapolate(mesh, 2, slope), margin - 2, mode="edge")
    coefficients = scipy.ndimage.spline_filter(extended_mesh, mode="mirror")
    # Weights of the coefficients along rows and columns: four at each pixel. Positions are in
    # meshes from the middle one.
    row_weights, column_weights = (
        csr_array(cubic_splines((np.arange(pixels) + 0.5) / mesh_px - 0.5 * count, knots, 1.0))
        for pixels, count, knots in zip(shape, mesh.shape, coefficients.shape, strict=True)
    )
    # A few rows at a time: products take twice the memory of the values.
    columns = np.ascontiguousarray((column_weights @ coefficients.T).T)
    values = np.empty(shape, np.float32)
    for top in range(0, len(values), 64):
        values[top : top + 64] = row_weights[top : top + 64] @ columns
    return values


# Structure within a mesh.


def median_level(image: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return the median (h, w) of the 14 × 14 px around each pixel, from means of 2 × 2 px."""
    # Means of squares of 2 × 2 px, the last row or column repeated where the number is odd.
    height, width = image.shape
    even_sized = np.pad(fill_bad(image, bad)[0], ((0, height % 2), (0, width % 2)), mode="edge")
    squares = even_sized.reshape(even_sized.shape[0] // 2, 2, even_sized.shape[1] // 2, 2)
    square_means = squares.mean(axis=(1, 3))
    # Median of 7 × 7 squares, smoothed by σ = 1 square.
    smooth = scipy.ndimage.median_filter(square_means, 7, mode="nearest")
    smooth = scipy.ndimage.gaussian_filter(smooth, 1.0)
    # Back to the pixels: linear between the middles of the squares.
    row, column = (np.arange(0.0, n) / 2.0 - 0.25 for n in (height, width))
    at = np.meshgrid(row, column, indexing="ij")
    return np.asarray(scipy.ndimage.map_coordinates(smooth, at, order=1, mode="nearest"))


def keeps_peaks(light: np.ndarray, level: np.ndarray, bad: np.ndarray, noise: np.ndarray) -> bool:
    """Return True if the brightest sources of an image (h, w) keep most of their peaks.

    A level (h, w) that removes more than a quarter of their peaks follows the sources themselves.
    With fewer than five sources of 50 σ, such as where their models are subtracted, it is True.

    Parameters
    ----------
    light : ndarray, shape (h, w)
        Image above the sky of its meshes.
    level : ndarray, shape (h, w)
        Finer level that would be subtracted as well.
    bad : ndarray of bool, shape (h, w)
        Pixels that are not searched for peaks.
    noise : ndarray, shape (h, w)
        σ of the pixels.
    """
    # Local maxima in squares of 25 px, and the 30 highest of them.
    height = light - level
    high = (height == scipy.ndimage.maximum_filter(height, 25)) & ~bad
    peak = np.flatnonzero(high & (light > 50.0 * noise))
    brightest = peak[np.argsort(-height.ravel()[peak], kind="stable")[:30]]
    height_left = height.ravel()[brightest] / light.ravel()[brightest]
    return bool(brightest.size < 5 or np.median(height_left) > 0.75)


def structure_weight(noise_excess: np.ndarray, bad: np.ndarray, mesh_px: int) -> np.ndarray:
    """Return the weight of the fine level of a sky, from 0 to 1, (h, w).

    Parameters
    ----------
    noise_excess : ndarray, shape (h, w)
        σ of a mesh over σ from differences of neighbouring pixels, over its typical value.
    bad : ndarray of bool, shape (h, w)
        Pixels whose own weight is 0.
    mesh_px : int
        Side of a mesh in px.
    """
    # From 0 at 1.25 times the typical ratio to 1 at 1.75 times.
    weight = np.clip((noise_excess - 1.25) / 0.5, 0.0, 1.0)
    weight[bad] = 0.0
    # Meshes next to structure are interpolated from it, and wrong, too.
    wide_weight = scipy.ndimage.maximum_filter(weight, 2 * mesh_px + 1, mode="nearest")
    return np.asarray(scipy.ndimage.uniform_filter(wide_weight, mesh_px, mode="nearest"))


# Steps.


def sky_steps(image: np.ndarray, bad: np.ndarray, axis: int, reach_px: int = 24) -> list[int]:
    """Return the rows (axis 0) or columns (axis 1) at which the sky of an image has a step.

    The step extends along the whole line or half of it.

    Parameters
    ----------
    image : ndarray of float, shape (h, w)
        Finite pixels.
    bad : ndarray of bool, shape (h, w)
        Pixels that are ignored.
    axis : int
        0 for steps between rows, 1 for steps between columns.
    reach_px : int
        Width in px of the strips on both sides of a line that are compared.
    """
    # Along all of the line and its halves, each with at most 512 columns of it.
    values, is_good = (image, ~bad) if axis == 0 else (image.T, ~bad.T)
    count = values.shape[1]
    lines: list[int] = []
    for part in (slice(0, count), slice(0, count // 2), slice(count // 2, count)):
        every = max(1, (part.stop - part.start) // 256)
        lines += _steps_across(values[:, part][:, ::every], is_good[:, part][:, ::every], reach_px)
    # Lines that several parts found are one.
    steps: list[int] = []
    for line in sorted(lines):
        if not steps or line > steps[-1] + reach_px:
            steps.append(line)
    return steps


def _steps_across(values: np.ndarray, is_good: np.ndarray, reach_px: int) -> list[int]:
    """Return the rows of some columns (h, n) at which the level has a step.

    A step is the same in most eighths of the columns, up to 3 px from the row and from 3 to 12 and
    12 to 24 px, slopes subtracted; and above a tenth of the noise, eight times its error, and four
    times the scatter of all rows.

    Parameters
    ----------
    values : ndarray, shape (h, n)
        Pixels of the image, or of every few columns.
    is_good : ndarray of bool, shape (h, n)
        Pixels that are used.
    reach_px : int
        Rows on either side of a step that must show it, 24.
    """
    height, count = values.shape
    if height < 4 * reach_px or count < 64:
        return []
    # Sums of the good pixels and their numbers up to each row: their differences give means.
    sums = (
        np.cumsum(v, axis=0, dtype=np.float64) for v in (np.where(is_good, values, 0.0), is_good)
    )
    light, number = (np.pad(v, ((1, 0), (0, 0))) for v in sums)
    first_line, end_line, side = 2 * reach_px, height - 2 * reach_px + 1, reach_px // 2

    def jumps(start: int, end: int, at: slice) -> np.ndarray:
        """Return the mean of each column `start` to `end` px after rows, less the mean before."""

        def means(start: int, end: int) -> np.ndarray:
            first, last = (np.s_[at.start + px : at.stop + px] for px in (start, end))
            return np.asarray((light[last] - light[first]) / (number[last] - number[first]))

        with np.errstate(all="ignore"):
            return np.asarray(means(start, end) - means(-end, -start))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of rows without good pixels
        # Step at each row: median over the columns, and the scatter about it.
        step_sizes = jumps(0, 3, np.s_[first_line:end_line])
        middle = row_medians(step_sizes)
        spread = 1.4826 * row_medians(np.abs(step_sizes - middle[:, None]))
        # Slope of the level per px: changes within 12 px on both sides, a pixel off the line. Of
        # two signs they are bad rows, not a slope.
        slope_before, slope_after = (
            row_medians(jumps(0, side, np.s_[first_line + px : end_line + px]))
            for px in (-side - 1, side + 1)
        )
        smaller = np.minimum(np.abs(slope_before), np.abs(slope_after)) / side
        slope = np.where(slope_before * slope_after > 0, np.sign(slope_before) * smaller, 0.0)
        # Less the slope over 3 px. A difference of means of 3 px scatters by √(2/3) σ of a pixel.
        jump = middle - 3.0 * slope
        noise = spread * np.sqrt(1.5)
        error = 1.25 * spread / np.sqrt(count)
        # Offsets of single rows, as of 1/f noise, are shared by all columns: jumps scatter by them.
        row_scatter = float(robust_scatter(jump[np.isfinite(jump)]))
        limit = np.maximum(np.maximum(0.1 * noise, 8.0 * error), 4.0 * row_scatter)
        candidates = np.flatnonzero(np.abs(jump) > limit)
        # Candidates from the largest jump on: each must agree in most eighths of the line and at
        # all three distances.
        steps: list[int] = []
        for k in candidates[np.argsort(-np.abs(jump[candidates]))]:
            line, height_of_step = first_line + int(k), jump[k]
            eighths = [
                row_medians(part[None])[0] - (start + end) * slope[k]
                for start, end in ((0, 3), (3, side), (side, reach_px))
                for part in np.array_split(jumps(start, end, np.s_[line : line + 1])[0], 8)
            ]
            is_same = np.abs(np.array(eighths) - height_of_step) < 0.5 * abs(height_of_step)
            is_new = all(abs(line - step) > reach_px for step in steps)
            if is_new and is_same.reshape(3, 8).mean(axis=1).min() >= 0.75:
                steps.append(line)
    return steps
