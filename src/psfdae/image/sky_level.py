"""Level and noise of the sky of an image, also where it has steps or structure.

photutils measures both in meshes and interpolates between them. Amplifiers of different bias make
steps, which are found first: each part of the image has meshes of its own. A nebula, or the halo of
a bright star, changes within a mesh; there the level is a median of the pixels around.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np

from psfdae.image.bad_pixels import interpolated, pixel_noise

MESH_PX = 64
"""Side of the squares in which the sky is measured."""

REACH_PX = 24
"""Width of the strips on both sides of a line that say whether the sky has a step there."""


class SkyLevel(NamedTuple):
    """Level and σ (h, w) of the sky, and sentences on what is unusual in it."""

    level: np.ndarray
    noise: np.ndarray
    notes: tuple[str, ...]


def sky_level(image: np.ndarray, bad: np.ndarray) -> SkyLevel:
    """Measure level and noise of the sky of an image.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Finite.
    bad : ndarray of bool, shape (h, w)
        Pixels that do not count.

    Raises
    ------
    ValueError
        If no mesh has enough pixels that count.
    """
    # Parts between steps of the sky, each with meshes of its own.
    rows, columns = (sky_steps(image, bad, axis) for axis in (0, 1))
    notes = []
    for name, lines in (("row", rows), ("column", columns)):
        if lines:
            lines_text = ", ".join(map(str, lines))
            notes.append(f"the sky has a step at {name} {lines_text}: the parts have their own sky")
    # Single precision: of a large image, each map takes much memory.
    level, noise = (np.zeros(image.shape, np.float32) for _ in range(2))
    for top, bottom in zip((0, *rows), (*rows, len(image)), strict=True):
        for first, last in zip((0, *columns), (*columns, image.shape[1]), strict=True):
            part = np.s_[top:bottom, first:last]
            if not bad[part].all() or not (rows or columns):
                level[part], noise[part] = _meshed(image[part], bad[part])
    pixel_sigma = pixel_noise(interpolated(image, bad)[0], bad)
    # σ of a mesh over that from differences of neighbouring pixels. Where the sky has structure it
    # is larger than elsewhere by a factor of 1.5; that of resampled images is larger everywhere.
    # Both are of meshes: every fourth pixel shows them.
    sample = np.s_[::4, ::4]
    ratio = noise[sample] / pixel_sigma[sample]
    ratio = ratio[~bad[sample] & (ratio > 0)]
    typical_ratio = max(float(np.percentile(ratio, 25)), 1e-6) if ratio.size else 1.0
    share = float(np.mean(ratio > 1.5 * typical_ratio)) if ratio.size else 0.0
    around = _median_level(image - level, bad) if share > 0.05 else None
    if around is not None and _sources_stay(image - level, around, bad, pixel_sigma):
        weight = structure_weight(noise / (typical_ratio * pixel_sigma), bad)
        level += weight * around
        # What is left; its noise changes with the light of the structure, from mesh to mesh of 16.
        remainder, noise = _meshed(image - level, bad)
        level += remainder
        noise += weight * (_meshed(image - level, bad, 16)[1] - noise)
        notes.append(
            f"the sky has structure within {MESH_PX} px in {100 * share:.0f} % of the image: "
            "it is measured in 14 px there, and light of wide sources is lost in it"
        )
    with np.errstate(all="ignore"):
        correlation = noise_correlation(np.where(bad, np.nan, (image - level) / noise))
    if correlation > 1.0:
        noise *= correlation
        notes.append(
            f"neighbouring pixels share their noise, as in resampled images: that of sums of "
            f"pixels is {correlation:.2f} times as large, and errors are of sums"
        )
    return SkyLevel(level, noise, tuple(notes))


def noise_correlation(deviation: np.ndarray) -> float:
    """Return the noise of sums of pixels over that of independent ones, at least 1.

    √(Σ ρ) over the correlations ρ of pixels up to 2 px apart. Faint sources and structure of the
    sky correlate pixels 3 and 4 px apart nearly as much as neighbours; the ρ at these distances is
    of them, and is subtracted. Unless 0.15 are left of that of neighbours, the result is 1.

    Parameters
    ----------
    deviation : ndarray, shape (h, w)
        Pixels without their sky, in σ; NaN where they do not count. Sources are left out here.
    """
    from scipy import ndimage

    middle = tuple(slice(max(0, n // 2 - 512), n // 2 + 512) for n in deviation.shape)
    values = deviation[middle]
    # Means of 3 × 3 pixels scatter by σ/3, or more if these are correlated: three times this.
    light = np.abs(ndimage.uniform_filter(np.nan_to_num(values), 3)) > 1.5
    values = np.where(ndimage.binary_dilation(light, iterations=3), np.nan, values)
    values[np.abs(values) > 3.0] = np.nan

    def correlation(rows_apart: int, columns_apart: int) -> float:
        """ρ = (s²(a + b) − s²(a − b))/(s²(a + b) + s²(a − b)), s by median deviations."""
        height, width = values.shape
        a = values[: height - rows_apart, max(0, -columns_apart) : width - max(0, columns_apart)]
        b = values[rows_apart:, max(0, columns_apart) : width - max(0, -columns_apart)]
        is_finite = np.isfinite(a) & np.isfinite(b)
        if np.count_nonzero(is_finite) < 1000:
            return 0.0
        plus, minus = (
            float(np.median(np.abs(v - np.median(v)))) ** 2
            for v in (a[is_finite] + b[is_finite], a[is_finite] - b[is_finite])
        )
        return (plus - minus) / (plus + minus) if plus + minus > 0 else 0.0

    if min(values.shape) < 16:
        return 1.0
    nearest = 0.5 * (correlation(0, 1) + correlation(1, 0))
    if nearest < 0.15:
        return 1.0
    distant = [correlation(*lag) for lag in ((0, 3), (3, 0), (0, 4), (4, 0))]
    shared = max(float(np.mean(distant)), 0.0)
    if nearest - shared < 0.15:
        return 1.0
    lags = [(0, 1), (0, 2), *((down, right) for down in (1, 2) for right in range(-2, 3))]
    excess = sum(correlation(*lag) - shared for lag in lags) / max(1.0 - shared, 0.1)
    return float(np.sqrt(max(1.0 + 2.0 * excess, 1.0)))


def _meshed(
    image: np.ndarray, bad: np.ndarray, mesh_px: int = MESH_PX
) -> tuple[np.ndarray, np.ndarray]:
    """Return level and σ (h, w) in meshes, interpolated; 80 % of one may be bad."""
    from photutils.background import Background2D

    meshes = Background2D(image, mesh_px, filter_size=1, mask=bad, exclude_percentile=80.0)
    level, sigma = meshes.background_mesh, meshes.background_rms_mesh
    neighbours = _of_neighbours(level)
    # A mesh differs from what its neighbours say by its error, about 2.5 σ/√N of the mode of N
    # pixels, and by the curvature of the sky: the more of that there is, the more it counts itself
    # (James & Stein 1961). A mesh that differs by far more than the others has stars in it.
    off = level - neighbours
    scatter = 1.4826 * float(np.median(np.abs(off)))
    error = 2.5 * float(np.median(sigma)) / mesh_px
    own_weight = 1.0 - (error / scatter) ** 2 if scatter > error else 0.0
    smooth = neighbours + np.where(np.abs(off) > 4.0 * max(scatter, error), 0.0, own_weight * off)
    return (
        _on_pixels(smooth, image.shape, mesh_px, own_weight),
        _on_pixels(_of_neighbours(sigma), image.shape, mesh_px, 0.0),
    )


def _continued(mesh: np.ndarray, width: int, slope: float = 1.0) -> np.ndarray:
    """Return values of meshes (m, n), continued beyond the edges with a part of their slope."""
    for axis, count in enumerate(mesh.shape):
        pads = [(width, width) if axis == padded_axis else (0, 0) for padded_axis in (0, 1)]
        level = np.pad(mesh, pads, mode="edge")
        if count > width:
            line = np.pad(mesh, pads, mode="reflect", reflect_type="odd")
            level += slope * (line - level)
        mesh = level
    return mesh


def _of_neighbours(mesh: np.ndarray) -> np.ndarray:
    """Return values of meshes (m, n) by their neighbours, without a few that are far off.

    It is the median of the value itself and of the means of the four pairs of neighbours that face
    each other: all five are the same where the sky is a plane, up to the edges of the image.
    """
    rows, columns = mesh.shape
    continued = _continued(mesh, 1)

    def shifted(rows_down: int, right: int) -> np.ndarray:
        return continued[1 + rows_down : rows + 1 + rows_down, 1 + right : columns + 1 + right]

    pairs = [
        0.5 * (shifted(rows_down, right) + shifted(-rows_down, -right))
        for rows_down, right in ((0, 1), (1, 0), (1, 1), (1, -1))
    ]
    return np.asarray(np.median([mesh, *pairs], axis=0))


def _on_pixels(mesh: np.ndarray, shape: tuple[int, ...], mesh_px: int, slope: float) -> np.ndarray:
    """Return values of meshes (m, n) at the pixels of an image (h, w), by cubic splines.

    Beyond the middles of the outer meshes they go on with a part of their slope.
    """
    from scipy import ndimage

    continued = _continued(mesh, 2, slope)
    row, column = ((np.arange(count) + 0.5) / mesh_px - 0.5 + 2.0 for count in shape)
    values = np.empty(shape, np.float32)
    # A few rows at a time: their coordinates take twice the memory of the values.
    for part in (slice(top, top + 256) for top in range(0, len(row), 256)):
        grid = np.meshgrid(row[part], column, indexing="ij")
        values[part] = ndimage.map_coordinates(continued, grid, order=3, mode="nearest")
    return values


def _median_level(image: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return the median (h, w) of the 14 × 14 px around each pixel, from means of 2 × 2 px."""
    from scipy import ndimage

    height, width = image.shape
    even_sized = np.pad(interpolated(image, bad)[0], ((0, height % 2), (0, width % 2)), mode="edge")
    binned = even_sized.reshape(even_sized.shape[0] // 2, 2, even_sized.shape[1] // 2, 2).mean(
        axis=(1, 3)
    )
    smooth = ndimage.gaussian_filter(ndimage.median_filter(binned, 7, mode="nearest"), 1.0)
    # Back to the pixels: linear between the middles of the squares.
    row, column = (np.arange(0.0, n) / 2.0 - 0.25 for n in (height, width))
    at = np.meshgrid(row, column, indexing="ij")
    return np.asarray(ndimage.map_coordinates(smooth, at, order=1, mode="nearest"))


def _sources_stay(light: np.ndarray, level: np.ndarray, bad: np.ndarray, noise: np.ndarray) -> bool:
    """Return True if the brightest sources of an image (h, w) keep most of their peaks.

    A level (h, w) that takes more than a quarter of them is that of the sources themselves. Without
    five sources of 50 σ, such as where their models are subtracted, there are none to lose.
    """
    from scipy import ndimage

    height = light - level
    high = (height == ndimage.maximum_filter(height, 25)) & ~bad
    peak = np.flatnonzero(high & (light > 50.0 * noise))
    brightest = peak[np.argsort(-height.ravel()[peak], kind="stable")[:30]]
    height_left = height.ravel()[brightest] / light.ravel()[brightest]
    return bool(brightest.size < 5 or np.median(height_left) > 0.75)


def structure_weight(noise_excess: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return how much the sky of an image changes within a mesh, from 0 to 1, (h, w).

    Parameters
    ----------
    noise_excess : ndarray, shape (h, w)
        σ of a mesh over that from differences of neighbouring pixels, over the usual ratio.
    bad : ndarray of bool, shape (h, w)
    """
    from scipy import ndimage

    # Meshes beside those with structure are interpolated from these, and wrong, too.
    weight = np.clip((noise_excess - 1.25) / 0.5, 0.0, 1.0)
    weight[bad] = 0.0
    widened = ndimage.maximum_filter(weight, 2 * MESH_PX + 1, mode="nearest")
    return np.asarray(ndimage.uniform_filter(widened, MESH_PX, mode="nearest"))


def sky_steps(image: np.ndarray, bad: np.ndarray, axis: int) -> list[int]:
    """Return the rows (axis 0) or columns (axis 1) at which the sky of an image has a step.

    The step goes along the whole line or half of it.

    Parameters
    ----------
    image : ndarray, shape (h, w)
    bad : ndarray of bool, shape (h, w)
        Pixels that do not count.
    """
    values, good = (image.T, ~bad.T) if axis == 0 else (image, ~bad)
    count = len(values)
    lines: list[int] = []
    for part in (slice(0, count), slice(0, count // 2), slice(count // 2, count)):
        every = max(1, (part.stop - part.start) // 256)
        lines += _steps_along(values[part][::every], good[part][::every])
    # Lines that several parts found are one.
    steps: list[int] = []
    for line in sorted(lines):
        if not steps or line > steps[-1] + REACH_PX:
            steps.append(line)
    return steps


def _steps_along(values: np.ndarray, good: np.ndarray) -> list[int]:
    """Return the columns of some rows (n, w) at which the level has a step.

    It is the same in all eighths of the rows, up to 3 px from the column and from 3 to 12 and 12 to
    24 px, slopes subtracted; and above a tenth of the noise and eight times its error.
    """
    count, width = values.shape
    if width < 4 * REACH_PX or count < 64:
        return []
    light, number = (
        np.pad(np.cumsum(v, axis=1, dtype=np.float64), ((0, 0), (1, 0)))
        for v in (np.where(good, values, 0.0), good)
    )
    lines = np.arange(2 * REACH_PX, width - 2 * REACH_PX + 1)
    side = REACH_PX // 2

    def jumps(start: int, end: int, at: np.ndarray) -> np.ndarray:
        """Mean of each row from `start` to `end` px after columns, less that before them."""
        with np.errstate(all="ignore"):
            mean_after, mean_before = (
                (light[:, b] - light[:, a]) / (number[:, b] - number[:, a])
                for a, b in ((at + start, at + end), (at - end, at - start))
            )
        return np.asarray(mean_after - mean_before)

    median = np.median if good.all() else np.nanmedian
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of columns without good pixels
        step_sizes = jumps(0, 3, lines)
        middle = median(step_sizes, axis=0)
        spread = 1.4826 * median(np.abs(step_sizes - middle), axis=0)
        # Slope of the level per px: changes within 12 px on both sides, a pixel off the line.
        slope_before, slope_after = (
            median(jumps(0, side, lines + sign * (side + 1)), axis=0) for sign in (-1, 1)
        )
        smaller = (
            np.sign(slope_before) * np.minimum(np.abs(slope_before), np.abs(slope_after)) / side
        )
        slope = np.where(
            slope_before * slope_after > 0, smaller, 0.0
        )  # of two kinds: none, but bad columns
        jump = middle - 3.0 * slope
        noise = spread * np.sqrt(1.5)
        error = 1.25 * spread / np.sqrt(count)
        candidates = np.flatnonzero(np.abs(jump) > np.maximum(0.1 * noise, 8.0 * error))
        steps: list[int] = []
        for k in candidates[np.argsort(-np.abs(jump[candidates]))]:
            line, height = int(lines[k]), jump[k]
            eighths = [
                median(part) - (start + end) * slope[k]
                for start, end in ((0, 3), (3, side), (side, REACH_PX))
                for part in np.array_split(jumps(start, end, np.array([line]))[:, 0], 8)
            ]
            is_same = np.abs(np.array(eighths) - height) < 0.5 * abs(height)
            if is_same.reshape(3, 8).mean(axis=1).min() >= 0.75 and all(
                abs(line - step) > REACH_PX for step in steps
            ):
                steps.append(line)
    return steps
