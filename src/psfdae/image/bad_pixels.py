"""Pixels of an image that show no light of the sky: blank areas, overscan, cosmic rays, hot pixels.

Inputs: an image (h, w), in any unit, and its headers. Output: `BadPixels`, masks of the pixels that
sky, detection and fits leave out. Each function below finds one kind of bad pixels.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy

from psfdae.base.types import Header
from psfdae.image.interpolation import fill_bad
from psfdae.image.sky_level import SkyLevel, pixel_noise
from psfdae.stars.moments import middle_value, robust_scatter, row_medians


@dataclass(frozen=True)
class BadPixels:
    """Pixels of an image that are left out everywhere.

    Attributes
    ----------
    mask : ndarray of bool, shape (h, w)
        All bad pixels, including the pixels that the user or the file masks.
    cosmic : ndarray of bool, shape (h, w)
        Cosmic rays and hot pixels.
    notes : tuple of str
        Each kind of bad pixels in the image, with the number of pixels.
    sky : SkyLevel, optional
        Sky of the image without these pixels, if it was measured to find trails.
    """

    mask: np.ndarray
    cosmic: np.ndarray
    notes: tuple[str, ...]
    sky: SkyLevel | None = None


class ClippedSkyError(ValueError):
    """The sky of an image is clipped at its minimum value."""


def find_bad_pixels(
    image: np.ndarray, is_masked: np.ndarray, headers: Sequence[Header], saturate: float | None
) -> BadPixels:
    """Find all pixels of an image that show no light of the sky, but for trails.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Image, in the unit of `saturate`.
    is_masked : ndarray of bool, shape (h, w)
        Pixels that are known to be bad, including all pixels that are not finite.
    headers : sequence of Header
        Headers of the image, in which sections of the detector may be given.
    saturate : float, optional
        Counts from which a pixel is saturated.

    Raises
    ------
    ClippedSkyError
        If so many pixels have the minimum value that sky and noise cannot be measured.
    """
    notes: list[str] = []
    mask = np.zeros(is_masked.shape, dtype=bool)

    def leave_out(area: np.ndarray, words: str) -> None:
        """Add pixels (h, w) to the mask, with a note of their number if there are any."""
        np.logical_or(mask, area, out=mask)
        if area.any():
            notes.append(f"{np.count_nonzero(area)} {words}")

    leave_out(is_masked, "pixels that are masked or have no value")
    # Areas of one value, then the columns and rows that the header calls overscan.
    for value, area in find_blank_areas(image, mask, saturate):
        leave_out(area, f"blank pixels (value {value:g})")
    for key, area in find_overscan(headers, image, mask):
        leave_out(area, f"pixels outside the exposed area by {key}")
    refuse_clipped_sky(image, mask)
    # Dead pixels first: next to these, others would look like cosmic rays.
    noise = pixel_noise(image, mask)
    leave_out(find_dead_pixels(image, mask, noise), "dead pixels")
    cosmic = find_cosmic_rays(image, mask, noise, saturate)
    leave_out(cosmic, "pixels of cosmic rays and hot pixels")
    # Of the pixels that remain, an area below the sky without stars did not receive light.
    if (dark := find_dark_area(image, mask)) is not None:
        leave_out(dark[1], f"pixels that are not exposed (level {dark[0]:.4g})")
    return BadPixels(mask, cosmic, tuple(notes))


def find_in_bands(
    find: Callable[..., np.ndarray], *maps: np.ndarray, side_min: int = 32
) -> np.ndarray:
    """Return the mask (h, w) that a function finds in bands of 256 rows of maps (h, w).

    The function sees 16 rows more on each side. Bands bound the memory for a large image. In an
    image of fewer than `side_min` rows or columns, the surroundings are missing: nothing is found.

    Parameters
    ----------
    find : callable
        Receives some rows of each map, and returns a mask of these rows.
    *maps : ndarray, shape (h, w)
        Arguments of the function.
    side_min : int
        Side of the smallest image in px.
    """
    mask = np.zeros(maps[0].shape, dtype=bool)
    height = len(mask) if min(mask.shape) >= side_min else 0
    for top in range(0, height, 256):
        # Rows outside the band, so that filters of a few pixels see the image there.
        start, end = max(top - 16, 0), min(top + 256, height)
        mask[top:end] = find(*(band[start : end + 16] for band in maps))[top - start : end - start]
    return mask


# Blank areas.


def find_blank_areas(
    image: np.ndarray, bad: np.ndarray, saturate: float | None = None
) -> list[tuple[float, np.ndarray]]:
    """Find areas in which all pixels have exactly one value, such as the border of a mosaic.

    A blank area has a square of 8 × 8 pixels, or whole rows or columns. Areas above
    saturation, or above the sky and not at the edge of the image, are cores of saturated stars.
    An image without noise does not contain blank areas: there, one value is the sky.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Image, in any unit.
    bad : ndarray of bool, shape (h, w)
        Pixels to ignore.
    saturate : float, optional
        Value from which a pixel is saturated, in the unit of the image.

    Returns
    -------
    list of (float, ndarray of bool)
        Value and pixels of each kind of area.
    """
    # Squares and lines in which the minimum and the maximum are the same.
    values = np.where(bad, np.nan, image)
    solid = find_in_bands(find_constant_squares, values, side_min=8) & np.isfinite(values)
    # Whole columns and whole rows of one value; NaN is equal to nothing.
    solid |= (values == values[:1]).all(axis=0)
    solid |= (values == values[:, :1]).all(axis=1, keepdims=True)
    if not solid.any():
        return []
    # The 16 most frequent values of these.
    counts = zip(*np.unique(values[solid], return_counts=True), strict=True)
    candidates = sorted(counts, key=lambda pair: -pair[1])[:16]
    areas = []
    for value, _ in candidates:
        # The whole of each connected area of this value that holds a square or a line of it.
        area = scipy.ndimage.binary_propagation(solid & (values == value), mask=values == value)
        # Whole counts of little noise fill a few squares by chance, and much is connected to them.
        if np.count_nonzero(solid & area) < 0.5 * np.count_nonzero(area):
            continue
        # In a large image, one pixel of 16 shows how far the rest is from the value.
        outside = ~area & ~bad
        sample = np.s_[:] if outside.size < 2**22 else np.s_[::4, ::4]
        outside_values = values[sample][outside[sample]]
        if not outside_values.size or (saturate is not None and value >= saturate):
            continue
        # Above the sky, only parts at the edge of the image: a core of a star is not there.
        if value > float(np.median(outside_values)):
            # Parts of the area that touch one of the four edges are kept.
            label, _ = scipy.ndimage.label(area)
            at_edge = np.unique(np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]]))
            area &= np.isin(label, at_edge[at_edge > 0])
        # Next to a blank area, the image is as far from its value as anywhere, and few pixels of
        # the image touch it. Next to the even sky of an image without noise, there is faint light.
        border = scipy.ndimage.binary_dilation(area) & ~area & ~bad
        if not border.any():
            continue
        height_beside = float(np.median(np.abs(values[border] - value)))
        height = float(np.median(np.abs(outside_values - value)))
        if height_beside > 0.25 * height and border.sum() < 0.3 * np.count_nonzero(outside):
            areas.append((float(value), area))
    return areas


def find_constant_squares(values: np.ndarray, side: int = 8) -> np.ndarray:
    """Find the pixels (h, w) of squares that have one value; noise fills none of 8 px with one.

    NaN differs from itself.

    Parameters
    ----------
    values : ndarray, shape (h, w)
        Pixels; NaN where they are ignored.
    side : int
        Side of the squares in px.
    """
    # Each square, also one across an edge, has one of every `side` rows: most images have none in
    # which so many neighbours are the same.
    rows = np.pad(values, side // 2, mode="edge")[::side]
    is_same = np.lib.stride_tricks.sliding_window_view(rows[:, 1:] == rows[:, :-1], side - 1, 1)
    if not is_same.all(axis=2).any():
        return np.zeros(values.shape, dtype=bool)
    # Filters would spread NaN in an order of their own.
    is_finite = np.isfinite(values)
    low = scipy.ndimage.minimum_filter(np.where(is_finite, values, -np.inf), side, mode="nearest")
    high = scipy.ndimage.maximum_filter(np.where(is_finite, values, np.inf), side, mode="nearest")
    corner = (low == high) & np.isfinite(low)
    # A filter of even size covers the pixels from −s/2 to s/2 − 1 about its own.
    return np.asarray(scipy.ndimage.maximum_filter(corner, side, origin=-1))


def refuse_clipped_sky(image: np.ndarray, bad: np.ndarray) -> None:
    """Raise an error if 30 % of the good pixels or more have the minimum value.

    Pixels that lie together, as in the even sky of an image without noise, are allowed, and so are
    counts of few photons, where the next value is as frequent.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Image, in any unit.
    bad : ndarray of bool, shape (h, w)
        Pixels to ignore.

    Raises
    ------
    ClippedSkyError
        If the sky is clipped at its minimum value.
    """
    # Fraction of the good pixels that has the minimum value.
    is_good = ~bad
    count = np.count_nonzero(is_good)
    if not count:
        return
    least_value = float(image.min(where=is_good, initial=np.inf))
    at_least = image == least_value
    fraction = float(np.count_nonzero(at_least & is_good) / count)
    if fraction < 0.3:
        return
    # Independent neighbours differ, one at the minimum and one above, with probability 2p(1 − p).
    pairs = ~(bad[:, 1:] | bad[:, :-1])
    changes = np.count_nonzero((at_least[:, 1:] != at_least[:, :-1]) & pairs)
    by_noise = 2.0 * fraction * (1.0 - fraction) * np.count_nonzero(pairs)
    higher = is_good & ~at_least
    if changes < 0.5 * by_noise or not higher.any():
        return
    # Fraction of the pixels that has the second value.
    second = image.min(where=higher, initial=np.inf)
    if np.count_nonzero((image == second) & higher) / count > 0.3 * fraction:
        return
    raise ClippedSkyError(
        f"{100 * fraction:.0f} % of the pixels have the least value, {least_value:g}: the sky was "
        "clipped there, or has hardly any photons, and neither it nor its noise can be "
        "measured; take the image from before it was clipped, or write negative values, too"
    )


# Overscan.


def find_overscan(
    headers: Sequence[Header], image: np.ndarray, bad: np.ndarray
) -> list[tuple[str, np.ndarray]]:
    """Find the rows and columns that the header's sections exclude from the exposed area.

    Headers often keep sections of the frame before it was trimmed. A section is used only if it
    lies in the image, leaves out at most a quarter of it, and if the pixels outside differ from the
    others in their level or in their noise.

    Returns
    -------
    list of (str, ndarray of bool)
        Key of the header and the pixels (h, w) outside.
    """
    areas = []
    is_excluded = bad.copy()
    section_form = re.compile(r"\[\s*(\d+)\s*:\s*(\d+)\s*,\s*(\d+)\s*:\s*(\d+)\s*\]")
    for key in ("TRIMSEC", "DATASEC", "BIASSEC"):
        # [x0:x1,y0:y1], both ends included, from 1.
        section = next((section_form.search(str(h[key])) for h in headers if key in h), None)
        if section is None:
            continue
        # A section that is not within the image belongs to another frame.
        x0, x1, y0, y1 = map(int, section.groups())
        if not (1 <= x0 <= x1 <= image.shape[1] and 1 <= y0 <= y1 <= image.shape[0]):
            continue
        # BIASSEC is outside of the exposed area, the others are all of it.
        area = np.full(image.shape, key != "BIASSEC")
        area[y0 - 1 : y1, x0 - 1 : x1] = key == "BIASSEC"
        area &= ~is_excluded
        if not 0 < np.count_nonzero(area) <= 0.25 * image.size:
            continue
        inside, outside = image[~(is_excluded | area)], image[area]
        if not inside.size:
            continue
        # Overscan has another level than the sky, or less noise.
        noise, other_noise = (float(robust_scatter(part)) for part in (inside, outside))
        step = abs(float(np.median(outside)) - float(np.median(inside)))
        if step > 3.0 * other_noise or other_noise < 0.8 * noise:
            areas.append((key, area))
            is_excluded |= area
    return areas


# Areas that receive no light.


def find_dark_area(
    image: np.ndarray, bad: np.ndarray, side: int = 8
) -> tuple[float, np.ndarray] | None:
    """Find the area outside of the image circle or a field stop, of any shape, and its soft edge.

    In squares of `side` pixels, such an area has one level, no stars, and less noise than the
    sky. The other squares are far above it and have about one level, too, unlike squares with
    stars, galaxies and nebulae on an empty sky.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Image, in any unit.
    bad : ndarray of bool, shape (h, w)
        Pixels to ignore.
    side : int
        Side of the squares in px.

    Returns
    -------
    level : float
        Level of the area, in counts.
    area : ndarray of bool, shape (h, w)
        Pixels of the area. The function returns None instead of the two without such an area.
    """
    # Mean of each square, and σ from the differences of neighbours: σ² = ⟨(x₁ − x₂)²⟩/2.
    rows, columns = (n // side for n in image.shape)
    in_squares = np.s_[: rows * side, : columns * side]
    squares = np.ma.array(image, mask=bad)[in_squares].reshape(rows, side, columns, side)
    mean = squares.mean(axis=(1, 3)).filled(np.inf)
    noise = np.sqrt(np.square(np.diff(squares, axis=3)).mean(axis=(1, 3)).filled(np.inf) / 2.0)
    has_values = np.isfinite(mean + noise)
    if np.count_nonzero(has_values) < 64:
        return None
    # Level and σ of the darkest squares, of which 16 may be damaged, and all squares within σ.
    is_dark = has_values & (mean <= np.partition(mean, 16, axis=None)[16])
    for _ in range(3):
        level, sigma = (float(np.median(values[is_dark])) for values in (mean, noise))
        is_dark = has_values & (np.abs(mean - level) < sigma)
    # The area of these squares, with holes where it has stars; the part of it that is away from its
    # border; and the exposed squares, away from the border, too.
    around = np.ones((5, 5), dtype=bool)
    area = scipy.ndimage.binary_closing(np.pad(is_dark | ~has_values, 5, mode="edge"), around)
    area = scipy.ndimage.binary_opening(area, around[:3, :3])[5:-5, 5:-5] & has_values
    inside = scipy.ndimage.binary_erosion(area, around[:3, :3], border_value=1)
    is_sky = has_values & ~scipy.ndimage.binary_dilation(area, around)
    if min(np.count_nonzero(area), np.count_nonzero(is_sky)) < 16 or not inside.any():
        return None
    sky, sky_noise = (float(np.median(values[is_sky])) for values in (mean, noise))
    spread, sky_spread = (float(robust_scatter(mean[part])) for part in (area, is_sky))
    has_one_level = spread < 0.5 * sigma and sky_spread < 0.25 * (sky - level)
    is_darker = sigma < 0.7 * sky_noise and sky - level > 3.0 * sigma
    if not (has_one_level and is_darker and is_dark[inside].mean() > 0.98):
        return None
    # From squares to pixels: connected means of 5 × 5 px below half of the darkest sky.
    half_level = 0.5 * (level + float(np.percentile(mean[is_sky], 10)))
    core = np.zeros(image.shape, dtype=bool)
    core[in_squares] = np.kron(area | is_dark, np.ones((side, side), dtype=bool))
    smooth = scipy.ndimage.uniform_filter(fill_bad(image, bad)[0], 5)
    core = scipy.ndimage.binary_propagation(core, mask=core | (smooth < half_level))
    # Level at each distance from these, in steps of 2 px. The edge ends where it is straight within
    # half the noise of a pixel over 32 px, as meshes of the sky follow it.
    step = np.ceil(scipy.ndimage.distance_transform_edt(~core) / 2.0)
    profile = scipy.ndimage.median(image, np.where(bad, -1.0, step), np.arange(1, 81))
    bend = np.abs(profile[16:] - 2.0 * profile[8:-8] + profile[:-16])
    edge_steps = np.append(bend < 0.5 * sky_noise, True).argmax() + 1
    return level, ~bad & (step <= edge_steps)


# Single pixels.


def find_dead_pixels(image: np.ndarray, bad: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Find the pixels (h, w) that are 6 σ below the faintest of their eight neighbours.

    Parameters
    ----------
    image, noise : ndarray, shape (h, w)
        Image, and σ of its pixels (`pixel_noise`).
    bad : ndarray of bool, shape (h, w)
        Pixels to ignore.

    Returns
    -------
    ndarray of bool, shape (h, w)
        All False for an image with a side below 32 px, too small to have surroundings.
    """

    def find(band: np.ndarray, bad: np.ndarray, noise: np.ndarray) -> np.ndarray:
        clean = fill_bad(band, bad)[0]
        # Few pixels are that far below both neighbours in their row: the eight are compared there.
        wide_band = np.pad(clean, ((0, 0), (1, 1)), mode="edge")
        is_low = np.minimum(wide_band[:, :-2], wide_band[:, 2:]) - clean > 6.0 * noise
        row, column = np.nonzero(is_low & ~bad)
        depth = np.empty(len(row), clean.dtype)
        for part, threes in _cut_windows(clean, row, column, 1):
            neighbours = np.delete(threes.reshape(-1, 9), 4, axis=1)
            depth[part] = neighbours.min(axis=1) - threes[:, 1, 1]
        # First against the noise of the square, then against the noise of the pixels around.
        is_deep = depth > 6.0 * noise[row, column]
        row, column, depth = row[is_deep], column[is_deep], depth[is_deep]
        deep = depth > 6.0 * _measure_noise(clean, noise, row, column)
        dead = np.zeros(clean.shape, dtype=bool)
        dead[row[deep], column[deep]] = True
        return dead

    return find_in_bands(find, image, bad, noise)


def find_cosmic_rays(
    image: np.ndarray, bad: np.ndarray, noise: np.ndarray, saturate: float | None = None
) -> np.ndarray:
    """Find cosmic rays and hot pixels by their sharp edges (van Dokkum 2001, PASP 113, 1420).

    A pixel is found if its Laplacian L⁺ (`compute_edges`) is 6 times the noise, and larger than the
    fine structure F of the image around it by a factor: 5, or four times the median L⁺/F of the
    bright sources of this image where they are so narrow that this is more. Stars are thus never
    taken for cosmic rays, and where they are nearly as narrow as these, only very high ones are
    found; none are found where the median is over 10.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Image, in any unit.
    bad : ndarray of bool, shape (h, w)
        Pixels to ignore.
    noise : ndarray, shape (h, w)
        σ of the pixels (`pixel_noise`).
    saturate : float, optional
        Value from which a pixel is saturated; edges around four or more such pixels are ignored.

    Returns
    -------
    ndarray of bool, shape (h, w)
    """
    # How sharp the stars of this image are decides how sharp a cosmic ray must be.
    sharpness = measure_sharpness(image, bad, noise, saturate)
    if sharpness > 10.0:  # one pixel has nearly all light of a star
        return np.zeros(image.shape, dtype=bool)
    ratio = max(5.0, 4.0 * sharpness)
    find = partial(find_cosmic_rays_in_band, saturate=saturate, ratio=ratio)
    return np.asarray(find_in_bands(find, image, bad, noise) & ~bad)


def find_cosmic_rays_in_band(
    band: np.ndarray, bad: np.ndarray, noise: np.ndarray, saturate: float | None, ratio: float
) -> np.ndarray:
    """Find the cosmic rays of some rows (r, w) that are sharper than stars by a ratio.

    They are 6 times as high as the noise, or half of it next to a higher one.

    Parameters
    ----------
    band, noise : ndarray, shape (r, w)
        Rows of the image, and σ of their pixels.
    bad : ndarray of bool, shape (r, w)
        Pixels to ignore.
    saturate : float or None
        Counts from which a pixel is saturated.
    ratio : float
        Minimum L⁺ over fine structure F of a cosmic ray.
    """
    # Cosmic rays are not searched for next to a bad pixel, or at the edge of a saturated star.
    clean = fill_bad(band, bad)[0]
    forbidden = scipy.ndimage.binary_dilation(bad)
    if saturate is not None and (is_full := band >= saturate).any():
        # Pixels in and around areas of four saturated pixels or more.
        label, _ = scipy.ndimage.label(is_full, np.ones((3, 3)))
        large = np.bincount(label.ravel()) >= 4
        large[0] = False
        forbidden |= scipy.ndimage.binary_dilation(large[label], np.ones((3, 3)), 2)
    cosmic = np.zeros(band.shape, dtype=bool)
    # L⁺ is nowhere below 0, and neither is its median: where L⁺ is below the limit, so is L⁺ less
    # its median.
    edge = compute_edges(clean)
    row, column = np.nonzero((edge > 3.0 * noise) & ~forbidden)
    # Tracks are found from their ends inwards: found pixels are replaced, and the search repeats
    # where pixels of the windows about a pixel changed.
    for _ in range(8):
        is_new = edge[row, column] > 6.0 * noise[row, column]
        at = row[is_new], column[is_new]
        is_new[is_new] = exceeds_limit(clean, edge, noise, *at, ratio)
        # Next to a cosmic ray, half the height is enough for both.
        new = np.zeros_like(cosmic)
        new[row[is_new], column[is_new]] = True
        is_beside = ~is_new
        for part, threes in _cut_windows(new, row, column, 1):
            is_beside[part] &= threes.any(axis=(1, 2))
        at = row[is_beside], column[is_beside]
        is_new[is_beside] = exceeds_limit(clean, edge, noise, *at, ratio, part=0.5)
        if not is_new.any():
            break
        row, column = row[is_new], column[is_new]
        cosmic[row, column] = True
        clean = fill_bad(clean, cosmic | bad)[0]
        # Pixels within 7 px of these: their L⁺ anew, and which of them may be cosmic rays.
        is_changed = np.zeros_like(cosmic)
        rows, columns = (
            np.clip(at[:, None] + np.arange(-7, 8), 0, size - 1)
            for at, size in zip((row, column), band.shape, strict=True)
        )
        is_changed[rows[:, :, None], columns[:, None]] = True
        row, column = np.nonzero(is_changed)
        for part, threes in _cut_windows(clean, row, column, 1):
            edge[row[part], column[part]] = mean_quarters(
                threes[:, 1, 1],
                (threes[:, 0, 1], threes[:, 2, 1]),
                (threes[:, 1, 0], threes[:, 1, 2]),
            )
        row, column = np.nonzero(is_changed & ~(forbidden | cosmic))
        is_high = edge[row, column] > 3.0 * noise[row, column]
        row, column = row[is_high], column[is_high]
    return cosmic


def exceeds_limit(
    image: np.ndarray,
    edge: np.ndarray,
    noise: np.ndarray,
    row: np.ndarray,
    column: np.ndarray,
    ratio: float,
    part: float = 1.0,
) -> np.ndarray:
    """Return True for pixels (n,) as sharp as a cosmic ray, or as a part of that.

    The limit of L⁺ is 6 σ, or the ratio times F + σ where this is more. Fine structure takes the
    most time: it is measured only where L⁺ reaches the limit without it.

    Parameters
    ----------
    image, edge, noise : ndarray, shape (h, w)
        Image without bad pixels, its positive Laplacian, and σ of its pixels.
    row, column : ndarray of int, shape (n,)
        Positions of the pixels, from 0.
    ratio : float
        Minimum L⁺ over F + σ of a cosmic ray.
    part : float
        Fraction of the limit that is enough.
    """
    height, sigma = _measure_height(edge, row, column), _measure_noise(image, noise, row, column)
    is_sharp = height > part * np.maximum(6.0, ratio) * sigma
    structure = _measure_structure(image, row[is_sharp], column[is_sharp])
    limit = part * ratio * (np.maximum(structure, 0.0) + sigma[is_sharp])
    is_sharp[is_sharp] = height[is_sharp] > limit
    return np.asarray(is_sharp)


def measure_sharpness(
    image: np.ndarray, bad: np.ndarray, noise: np.ndarray, saturate: float | None = None
) -> float:
    """Measure the median of L⁺/F at the brightest pixels of the bright stars; 0 without stars.

    It is 0.5 where stars have a FWHM of 2.8 px, 1.3 for 1.8 px, 3 to 5 for 1.2 px, and 7 to 15 for
    0.9 px. Sources above 20 are not stars.

    Parameters
    ----------
    image, noise : ndarray, shape (h, w)
        Image, and σ of its pixels.
    bad : ndarray of bool, shape (h, w)
        Pixels to ignore.
    saturate : float, optional
        Counts from which a pixel is saturated; such sources are left out.
    """
    full = np.inf if saturate is None else saturate
    ratios = []
    # A band of rows at a time, which bounds the memory.
    for rows in (slice(top, top + 256) for top in range(0, len(image), 256)):
        # Fill bad pixels first: the Laplacian would see their edges.
        hidden, sigma = bad[rows], noise[rows]
        clean = fill_bad(image[rows], hidden)[0]
        edge = compute_edges(clean)
        # Local maxima, so bright that noise does not matter, and not saturated.
        above = clean - middle_value(clean.ravel())
        top = (clean == scipy.ndimage.maximum_filter(clean, 7)) & (above > 50.0 * sigma)
        row, column = np.nonzero(top & ~hidden)
        is_usable = np.empty(len(row), dtype=bool)
        for part, fives in _cut_windows(clean, row, column, 2):
            is_usable[part] = fives.max(axis=(1, 2)) < full
        row, column = row[is_usable], column[is_usable]
        brightest = np.argsort(-above[row, column], kind="stable")[:1000]
        row, column = row[brightest], column[brightest]
        # Ratio L⁺/F of each; F is at least the noise, so that flat surroundings are not taken for
        # sharp.
        height = _measure_height(edge, row, column)
        ratio = height / np.maximum(_measure_structure(clean, row, column), sigma[row, column])
        ratios.append(ratio[ratio < 20.0])
    return float(np.median(np.concatenate(ratios))) if sum(map(len, ratios)) >= 5 else 0.0


def compute_edges(image: np.ndarray) -> np.ndarray:
    """Compute the positive Laplacian L⁺ of an image (h, w) that is subsampled twice, in its unit.

    A pixel of height h on an even sky has L⁺ = h. A quarter of a pixel that is repeated twice along
    both axes differs from two neighbours only, one along each axis; L⁺ is the mean of the four
    quarters, each cut off at 0.
    """
    wide_image = np.pad(image, 1, mode="edge")
    middle = np.s_[1:-1]
    return mean_quarters(
        image,
        (wide_image[:-2, middle], wide_image[2:, middle]),
        (wide_image[middle, :-2], wide_image[middle, 2:]),
    )


def mean_quarters(
    pixel: np.ndarray,
    vertical: tuple[np.ndarray, np.ndarray],
    horizontal: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Return L⁺ of pixels (…) from their two neighbours along a column and along a row."""
    # 2 x − a − b of the neighbours a above or below and b on the left or right, ≥ 0.
    quarters = [np.maximum(2.0 * pixel - a - b, 0.0) for a in vertical for b in horizontal]
    return np.asarray(sum(quarters) / 8.0)


def _measure_height(edge: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Measure L⁺ (h, w) less its median over 5 × 5 pixels, which is free of smooth sources, (n,).

    Pixels are given by their rows and columns, from 0.
    """
    height = np.empty(len(row))
    for part, fives in _cut_windows(edge, row, column, 2):
        height[part] = fives[:, 2, 2] - row_medians(fives.reshape(-1, 25))
    return height


def _measure_structure(image: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Measure the fine structure F of an image (h, w) at pixels (n,) of some rows and columns.

    F is the median over 3 × 3 pixels less the median over 7 × 7 of these medians.
    """
    structure = np.empty(len(row))
    for part, nines in _cut_windows(image, row, column, 4):
        # Medians over 3 × 3 pixels at the 7 × 7 positions about the pixel; the one in the middle
        # is its own.
        threes = np.lib.stride_tricks.sliding_window_view(nines, (3, 3), axis=(1, 2))
        medians = row_medians(threes.reshape(-1, 9)).reshape(-1, 7, 7)
        structure[part] = medians[:, 3, 3] - row_medians(medians.reshape(-1, 49))
    return structure


def _measure_noise(
    image: np.ndarray, noise: np.ndarray, row: np.ndarray, column: np.ndarray
) -> np.ndarray:
    """Measure the noise about some pixels (n,), at least the noise of their square.

    In the light of a bright star the noise is larger than in the sky.
    """
    # Median |x₁ − x₂| of the neighbours in 9 × 9 px, over √2.
    scatter = np.empty(len(row))
    for part, nines in _cut_windows(image, row, column, 4):
        difference = np.abs(np.diff(nines, axis=2)).reshape(-1, 72)
        scatter[part] = 1.4826 / np.sqrt(2.0) * row_medians(difference)
    return np.asarray(np.maximum(scatter, noise[row, column]))


def _cut_windows(
    image: np.ndarray, row: np.ndarray, column: np.ndarray, reach_px: int
) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield slices of some pixels (n,), and windows (k, s, s) of the image (h, w) about these.

    A window reaches some pixels to each side; pixels at the edge of the image are repeated.
    """
    # 4096 windows at a time, to bound the memory.
    axis, (height, width) = np.arange(-reach_px, reach_px + 1), image.shape
    for part in (slice(start, start + 4096) for start in range(0, len(row), 4096)):
        rows = np.clip(row[part, None] + axis, 0, height - 1)
        columns = np.clip(column[part, None] + axis, 0, width - 1)
        yield part, image[rows[:, :, None], columns[:, None]]
