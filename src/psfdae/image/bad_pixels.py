"""Pixels of an image that show no light of the sky: blank areas, overscan, cosmic rays, hot pixels.

Each function takes an image (h, w) and returns the pixels that it found as a mask, so that sky,
detection and fits leave them out. Nothing here depends on the unit of the image.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from astropy.io.fits import Header

BLANK_PX = 8  # side of the smallest blank square; noise fills none with one value
CLIPPED_SHARE = 0.3  # of the pixels at the least value, from which the sky was clipped there
COSMIC_SIGMA, COSMIC_RATIO = 6.0, 5.0  # least height and sharpness of a cosmic ray
BAND_ROWS, BAND_EDGE = 256, 16  # rows that are searched at a time, and beyond them on each side
SECTION = re.compile(r"\[\s*(\d+)\s*:\s*(\d+)\s*,\s*(\d+)\s*:\s*(\d+)\s*\]")


@dataclass(frozen=True)
class BadPixels:
    """Pixels of an image that are left out everywhere.

    Attributes
    ----------
    mask : ndarray of bool, shape (h, w)
        All of them, those that the user or the file masks included.
    cosmic : ndarray of bool, shape (h, w)
        Cosmic rays and hot pixels.
    notes : tuple of str
        What was found, with the number of pixels.
    """

    mask: np.ndarray
    cosmic: np.ndarray
    notes: tuple[str, ...]


class ClippedSkyError(ValueError):
    """The sky of an image was cut off at its least value."""


def find_bad_pixels(
    image: np.ndarray, masked: np.ndarray, headers: Sequence[Header], saturate: float | None
) -> BadPixels:
    """Find all pixels of an image that show no light of the sky.

    Parameters
    ----------
    image : ndarray, shape (h, w)
    masked : ndarray of bool, shape (h, w)
        Pixels that are known to be bad; those that are not finite must be among them.
    headers : sequence of Header
        Of the image, in which sections of the detector may be given.
    saturate : float, optional
        Counts from which a pixel is saturated.

    Raises
    ------
    ClippedSkyError
        If so many pixels have the least value that sky and noise are not measurable.
    """
    notes: list[str] = []
    mask = masked.copy()
    if mask.any():
        notes.append(f"{np.count_nonzero(mask)} pixels that are masked or have no value")
    # Areas of one value, then the columns and rows that the header calls overscan.
    for value, area in blank_areas(image, mask, saturate):
        mask |= area
        notes.append(f"{np.count_nonzero(area)} blank pixels (value {value:g})")
    for key, area in overscan(headers, image, mask):
        mask |= area
        notes.append(f"{np.count_nonzero(area)} pixels outside the exposed area by {key}")
    share, least_value = least_value_share(image, mask)
    if share >= CLIPPED_SHARE:
        raise ClippedSkyError(
            f"{100 * share:.0f} % of the pixels have the least value, {least_value:g}: the sky was "
            "clipped there, or has hardly any photons, and neither it nor its noise can be "
            "measured; take the image from before it was clipped, or write negative values, too"
        )
    noise = pixel_noise(image, mask)
    dead = dead_pixels(image, mask, noise)
    if dead.any():
        mask |= dead
        notes.append(f"{np.count_nonzero(dead)} dead pixels")
    cosmic = cosmic_rays(image, mask, noise, saturate)
    if cosmic.any():
        notes.append(f"{np.count_nonzero(cosmic)} pixels of cosmic rays and hot pixels")
    return BadPixels(mask | cosmic, cosmic, tuple(notes))


# Blank areas.


def blank_areas(
    image: np.ndarray, bad: np.ndarray, saturate: float | None = None
) -> list[tuple[float, np.ndarray]]:
    """Find areas in which all pixels have exactly one value, such as the border of a mosaic.

    A blank area has a square of `BLANK_PX` pixels, or whole rows or columns. Areas above
    saturation, or above the sky and not at the edge of the image, are cores of saturated stars.
    Images without noise have no blank areas: there, one value is the sky.

    Parameters
    ----------
    image : ndarray, shape (h, w)
    bad : ndarray of bool, shape (h, w)
        Pixels that do not count.
    saturate : float, optional

    Returns
    -------
    list of (float, ndarray of bool)
        Value and pixels of each kind of area.
    """
    from scipy import ndimage

    # Squares and lines in which the least and the greatest value are the same.
    values = np.where(bad, np.nan, image)
    solid = _constant_squares(values)
    for axis in (0, 1):
        edge = values[:1] if axis == 0 else values[:, :1]
        solid |= (values == edge).all(axis=axis, keepdims=True)
    if not solid.any():
        return []
    counts = zip(*np.unique(values[solid], return_counts=True), strict=True)
    candidates = sorted(counts, key=lambda pair: -pair[1])[:16]
    areas = []
    for value, _ in candidates:
        # The whole of each connected area of this value that holds a square or a line of it.
        area = ndimage.binary_propagation(solid & (values == value), mask=values == value)
        # Of a large image, one pixel of 16 says how far the rest is from the value.
        outside = ~area & ~bad
        outside_values = (
            values[outside] if outside.size < 2**22 else values[::4, ::4][outside[::4, ::4]]
        )
        if not outside_values.size or (saturate is not None and value >= saturate):
            continue
        middle = float(np.median(outside_values))
        if value > middle:
            label, _ = ndimage.label(area)
            at_edge = np.unique(np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]]))
            area &= np.isin(label, at_edge[at_edge > 0])
        # Beside a blank area, the image is as far from its value as anywhere, and few pixels of
        # the image touch it. Beside the even sky of an image without noise, there is faint light.
        border = ndimage.binary_dilation(area) & ~area & ~bad
        if not border.any():
            continue
        height_beside = float(np.median(np.abs(values[border] - value)))
        height = float(np.median(np.abs(outside_values - value)))
        if height_beside > 0.25 * height and border.sum() < 0.3 * np.count_nonzero(outside):
            areas.append((float(value), area))
    return areas


def _constant_squares(values: np.ndarray) -> np.ndarray:
    """Return the pixels (h, w) of squares of `BLANK_PX` pixels that have one value."""
    from scipy import ndimage

    constant = np.zeros(values.shape, dtype=bool)
    if min(values.shape) < BLANK_PX:
        return constant
    for rows, band_rows, core_rows in _bands(len(values)):
        band = values[band_rows]
        # NaN differs from itself; filters would spread it in an order of their own.
        is_finite = np.isfinite(band)
        low = ndimage.minimum_filter(np.where(is_finite, band, -np.inf), BLANK_PX, mode="nearest")
        high = ndimage.maximum_filter(np.where(is_finite, band, np.inf), BLANK_PX, mode="nearest")
        corner = (low == high) & np.isfinite(low)
        # A filter of even size covers the pixels from −s/2 to s/2 − 1 about its own.
        grown = ndimage.maximum_filter(corner, BLANK_PX, origin=-1)
        constant[rows] = grown[core_rows]
    return np.asarray(constant & np.isfinite(values))


def least_value_share(image: np.ndarray, bad: np.ndarray) -> tuple[float, float]:
    """Return the part of the good pixels that a clipped sky has at its least value, and the value.

    The part is 0 where these pixels lie together, as the even sky of an image without noise
    does, and where the values are counts of few photons: the next value is as frequent then.
    """
    good = ~bad
    count = np.count_nonzero(good)
    if not count:
        return 0.0, np.nan
    least_value = float(image.min(where=good, initial=np.inf))
    at_least = image == least_value
    share = float(np.count_nonzero(at_least & good) / count)
    if share < CLIPPED_SHARE:
        return share, least_value
    # Neighbours change between least and other values 2p(1 − p) times where noise decides it.
    pairs = ~(bad[:, 1:] | bad[:, :-1])
    changes = np.count_nonzero((at_least[:, 1:] != at_least[:, :-1]) & pairs)
    by_noise = 2.0 * share * (1.0 - share) * np.count_nonzero(pairs)
    higher = good & ~at_least
    if changes < 0.5 * by_noise or not higher.any():
        return 0.0, least_value
    second = image.min(where=higher, initial=np.inf)
    following = np.count_nonzero((image == second) & higher) / count
    return (0.0 if following > 0.3 * share else share), least_value


# Overscan.


def overscan(
    headers: Sequence[Header], image: np.ndarray, bad: np.ndarray
) -> list[tuple[str, np.ndarray]]:
    """Find the rows and columns that the header's sections exclude from the exposed area.

    Headers often keep sections of the frame before it was trimmed. A section counts only if it lies
    in the image, leaves out at most a quarter of it, and if the pixels outside differ from the
    others in their level or in their noise.

    Returns
    -------
    list of (str, ndarray of bool)
        Key of the header and the pixels (h, w) outside.
    """
    from psfdae.moments import robust_scatter

    areas = []
    excluded = bad.copy()
    for key in ("TRIMSEC", "DATASEC", "BIASSEC"):
        section = next((SECTION.search(str(h[key])) for h in headers if key in h), None)
        if section is None:
            continue
        x0, x1, y0, y1 = map(int, section.groups())
        if not (1 <= x0 <= x1 <= image.shape[1] and 1 <= y0 <= y1 <= image.shape[0]):
            continue
        area = np.full(image.shape, key != "BIASSEC")
        area[y0 - 1 : y1, x0 - 1 : x1] = key == "BIASSEC"
        area &= ~excluded
        if not 0 < np.count_nonzero(area) <= 0.25 * image.size:
            continue
        inside, outside = image[~(excluded | area)], image[area]
        if not inside.size:
            continue
        noise, other_noise = (float(robust_scatter(part)) for part in (inside, outside))
        step = abs(float(np.median(outside)) - float(np.median(inside)))
        if step > 3.0 * other_noise or other_noise < 0.8 * noise:
            areas.append((key, area))
            excluded |= area
    return areas


# Single pixels.


def dead_pixels(image: np.ndarray, bad: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Find the pixels (h, w) that are 6 σ below the least of their eight neighbours.

    Beside these, others would look like cosmic rays. `bad` pixels (h, w) do not count; `noise`
    (h, w) is that of pixels.
    """
    from scipy import ndimage

    dead = np.zeros(image.shape, dtype=bool)
    around = np.ones((3, 3), dtype=bool)
    around[1, 1] = False
    if min(image.shape) < 2 * BAND_EDGE:
        return dead
    for rows, band_rows, core_rows in _bands(len(image)):
        clean = interpolated(image[band_rows], bad[band_rows])[0]
        depth = ndimage.minimum_filter(clean, footprint=around) - clean
        row, column = np.nonzero((depth > COSMIC_SIGMA * noise[band_rows]) & ~bad[band_rows])
        local = _noise_around(clean, noise[band_rows], row, column)
        deep = depth[row, column] > COSMIC_SIGMA * local
        band = np.zeros(clean.shape, dtype=bool)
        band[row[deep], column[deep]] = True
        dead[rows] = band[core_rows]
    return dead


def cosmic_rays(
    image: np.ndarray, bad: np.ndarray, noise: np.ndarray, saturate: float | None = None
) -> np.ndarray:
    """Find cosmic rays and hot pixels by their sharp edges (van Dokkum 2001, PASP 113, 1420).

    A pixel counts if its Laplacian L⁺ is `COSMIC_SIGMA` times the noise, and larger than the fine
    structure F of the image around it by a factor: `COSMIC_RATIO`, or four times what the bright
    sources of this image have where they are so narrow that it is more. Stars are thus never
    taken for cosmic rays, and where they are nearly as narrow as these, only very high ones are
    found; none are where the median is over 10.

    Parameters
    ----------
    image : ndarray, shape (h, w)
    bad : ndarray of bool, shape (h, w)
        Pixels that do not count.
    noise : ndarray, shape (h, w)
        Of the pixels (`pixel_noise`).
    saturate : float, optional
        Around areas of four or more pixels above it, edges are those of saturated stars.

    Returns
    -------
    ndarray of bool, shape (h, w)
    """
    cosmic = np.zeros(image.shape, dtype=bool)
    if min(image.shape) < 2 * BAND_EDGE:
        return cosmic
    sharpness = sharpness_of_sources(image, bad, noise, saturate)
    if sharpness > 10.0:  # one pixel has nearly all light of a star
        return cosmic
    ratio = max(COSMIC_RATIO, 4.0 * sharpness)
    for rows, band_rows, core_rows in _bands(len(image)):
        band = _cosmic_rays_of_band(
            image[band_rows], bad[band_rows], noise[band_rows], saturate, ratio
        )
        cosmic[rows] = band[core_rows]
    return np.asarray(cosmic & ~bad)


def _cosmic_rays_of_band(
    band: np.ndarray, bad: np.ndarray, noise: np.ndarray, saturate: float | None, ratio: float
) -> np.ndarray:
    """Find the cosmic rays of some rows (r, w) that are sharper than stars by a ratio."""
    from scipy import ndimage

    clean = interpolated(band, bad)[0]
    forbidden = ndimage.binary_dilation(bad)
    if saturate is not None:
        forbidden |= _saturated_stars(band, saturate)
    cosmic = np.zeros(band.shape, dtype=bool)
    # Tracks are found from their ends inwards: what was found is replaced, and the search repeated.
    for _ in range(8):
        edge = edges(clean)
        row, column = np.nonzero((edge > 0.5 * COSMIC_SIGMA * noise) & ~forbidden & ~cosmic)
        if not row.size:
            break
        local = _noise_around(clean, noise, row, column)
        height, structure = _contrast(clean, edge, row, column)
        high = height > COSMIC_SIGMA * local
        sharp = high & (height > ratio * (np.maximum(structure, 0.0) + local))
        new = np.zeros_like(cosmic)
        new[row[sharp], column[sharp]] = True
        # Beside a cosmic ray, half the height is enough, and no sharpness is asked for.
        lower = height > 0.5 * COSMIC_SIGMA * local
        is_beside = ndimage.binary_dilation(new, np.ones((3, 3)))[row, column] & lower
        is_beside &= height > 0.5 * ratio * (np.maximum(structure, 0.0) + local)
        new[row[is_beside], column[is_beside]] = True
        if not new.any():
            break
        cosmic |= new
        clean = interpolated(clean, cosmic | bad)[0]
    return cosmic


def edges(image: np.ndarray) -> np.ndarray:
    """Return the positive Laplacian L⁺ of an image (h, w) that is subsampled twice, in its unit.

    A pixel of height h on an even sky has L⁺ = h. A quarter of a pixel that is repeated twice along
    both axes differs from two neighbours only, one along each axis; L⁺ is the mean of the four
    quarters, each cut off at 0.
    """
    padded = np.pad(image, 1, mode="edge")
    upper_pixels, lower_pixels, left_pixels, right_pixels = (
        padded[:-2, 1:-1],
        padded[2:, 1:-1],
        padded[1:-1, :-2],
        padded[1:-1, 2:],
    )
    quarters = [
        np.maximum(2.0 * image - a - b, 0.0)
        for a in (upper_pixels, lower_pixels)
        for b in (left_pixels, right_pixels)
    ]
    return np.asarray(sum(quarters) / 8.0)


def _contrast(
    image: np.ndarray, edge: np.ndarray, row: np.ndarray, column: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return L⁺ above its surroundings, and the fine structure F, at some pixels (n,).

    L⁺ less its median over 5 × 5 pixels is free of smooth sources. F is the median over 3 × 3
    pixels less that over 7 × 7 of these medians.
    """
    height, structure = np.empty((2, len(row)))
    wide_edge, padded = np.pad(edge, 2, mode="edge"), np.pad(image, 4, mode="edge")
    fives = np.lib.stride_tricks.sliding_window_view(wide_edge, (5, 5))
    nines = np.lib.stride_tricks.sliding_window_view(padded, (9, 9))
    for part in (slice(start, start + 4096) for start in range(0, len(row), 4096)):
        at = row[part], column[part]
        height[part] = edge[at] - np.median(fives[at].reshape(-1, 25), axis=1)
        threes = np.lib.stride_tricks.sliding_window_view(nines[at], (3, 3), axis=(1, 2))
        medians = np.median(threes.reshape(-1, 7, 7, 9), axis=3)
        structure[part] = medians[:, 3, 3] - np.median(medians.reshape(-1, 49), axis=1)
    return height, structure


def pixel_noise(image: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return the noise (h, w) of pixels from the differences of neighbours, in squares of 64.

    It is infinite where neighbours do not differ: there is no noise with which to compare.
    """
    difference = np.abs(np.diff(image, axis=1, append=image[:, -2:-1]))
    hidden = bad | np.concatenate([bad[:, 1:], bad[:, -2:-1]], axis=1)
    difference[hidden] = np.nan
    height, width = image.shape
    noise = np.full(image.shape, np.inf, difference.dtype)
    for top in range(0, height, 64):
        for residual in range(0, width, 64):
            square = np.s_[top : top + 64, residual : residual + 64]
            values, is_good = difference[square].ravel(), np.count_nonzero(~hidden[square])
            if not is_good:
                continue
            # σ of one pixel from the median of |x₁ − x₂|, which has √2 σ; NaN comes last.
            middle = [(is_good - 1) // 2, is_good // 2]
            sigma = 1.4826 / np.sqrt(2.0) * float(np.partition(values, middle)[middle].mean())
            noise[square] = sigma if sigma > 0 else np.inf
    return noise


def _noise_around(
    image: np.ndarray, noise: np.ndarray, row: np.ndarray, column: np.ndarray
) -> np.ndarray:
    """Return the noise about some pixels (n,), at least that of their square.

    In the light of a bright star the noise is larger than in the sky.
    """
    scatter = np.empty(len(row))
    padded = np.pad(image, 4, mode="edge")
    nines = np.lib.stride_tricks.sliding_window_view(padded, (9, 9))
    for part in (slice(start, start + 4096) for start in range(0, len(row), 4096)):
        difference = np.abs(np.diff(nines[row[part], column[part]], axis=2)).reshape(-1, 72)
        scatter[part] = 1.4826 / np.sqrt(2.0) * np.median(difference, axis=1)
    return np.asarray(np.maximum(scatter, noise[row, column]))


def _saturated_stars(image: np.ndarray, saturate: float) -> np.ndarray:
    """Return the pixels (h, w) in and around areas of four saturated pixels or more."""
    from scipy import ndimage

    label, _ = ndimage.label(image >= saturate, np.ones((3, 3)))
    large = np.bincount(label.ravel()) >= 4
    large[0] = False
    return np.asarray(ndimage.binary_dilation(large[label], np.ones((3, 3)), 2))


def sharpness_of_sources(
    image: np.ndarray, bad: np.ndarray, noise: np.ndarray, saturate: float | None = None
) -> float:
    """Return the median of L⁺/F at the brightest pixels of the bright stars; 0 if there are none.

    It is 0.5 where stars have a FWHM of 2.8 px, 1.3 for 1.8 px, 3 to 5 for 1.2 px, and 7 to 15 for
    0.9 px. Sources above 20 are no stars.
    """
    from scipy import ndimage

    full = np.inf if saturate is None else saturate
    ratios = []
    for rows, _, _ in _bands(len(image)):
        hidden, sigma = bad[rows], noise[rows]
        clean = interpolated(image[rows], hidden)[0]
        edge = edges(clean)
        # Local maxima, so bright that noise does not matter.
        above = clean - np.median(clean)
        top = (clean == ndimage.maximum_filter(clean, 7)) & (above > 50.0 * sigma)
        top &= (ndimage.maximum_filter(clean, 5) < full) & ~hidden
        row, column = np.nonzero(top)
        brightest = np.argsort(-above[row, column], kind="stable")[:1000]
        height, structure = _contrast(clean, edge, row[brightest], column[brightest])
        ratio = height / np.maximum(structure, sigma[row, column][brightest])
        ratios.append(ratio[ratio < 20.0])
    return float(np.median(np.concatenate(ratios))) if sum(map(len, ratios)) >= 5 else 0.0


def interpolated(image: np.ndarray, bad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an image with its bad pixels interpolated, and those that have no neighbours for it.

    Along rows and columns, a cubic polynomial goes through the two nearest pixels on each side;
    a line through the nearest ones is taken where these are bad, and else the mean of the good
    ones of 5 × 5 pixels, weighted by a Gaussian of σ = 1 px.

    Parameters
    ----------
    image : ndarray, shape (h, w)
    bad : ndarray of bool, shape (h, w)

    Returns
    -------
    image : ndarray, shape (h, w)
        A copy; 0 where nothing is near.
    left : ndarray of bool, shape (h, w)
    """
    filled, remaining = np.where(bad, 0.0, image), np.zeros(bad.shape, dtype=bool)
    row, column = np.nonzero(bad)
    if not row.size:
        return filled, remaining
    reach = 2
    padded = np.pad(filled, reach)
    good = np.pad(~bad, reach)
    steps = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (steps[:, None] ** 2 + steps**2))
    total, count, mean, light = np.zeros((4, len(row)))
    for down in steps:
        for across in steps:
            at = row + reach + down, column + reach + across
            weight = weights[down + reach, across + reach] * good[at]
            mean += weight * padded[at]
            light += weight
    for axis in (np.array([1, 0]), np.array([0, 1])):
        values, has_neighbours = [], []
        for step in (-2, -1, 1, 2):
            at = row + reach + step * axis[0], column + reach + step * axis[1]
            values.append(padded[at])
            has_neighbours.append(good[at])
        nearby = has_neighbours[1] & has_neighbours[2]
        distant = nearby & has_neighbours[0] & has_neighbours[3]
        line = 0.5 * (values[1] + values[2])
        cubic = (4.0 * (values[1] + values[2]) - values[0] - values[3]) / 6.0
        # A cubic counts twice as much as a line, which cuts off peaks.
        part = np.where(distant, 2.0, nearby * 1.0)
        total += part * np.where(distant, cubic, line)
        count += part
    is_good = light > 0
    mean = mean / np.where(is_good, light, 1.0)
    filled[row, column] = np.where(count > 0, total / np.maximum(count, 1.0), mean)
    remaining[row, column] = ~is_good
    return filled, remaining


def interpolated_stamps(stamps: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return stamps (n, s, s) with their bad pixels `interpolated`, each from its own pixels."""
    rows = np.flatnonzero(bad.any(axis=(1, 2)))
    if not rows.size:
        return stamps
    # Two rows of bad pixels part each stamp from the next one.
    between = ((0, 0), (0, 2), (0, 0))
    side = stamps.shape[-1]
    tall = np.pad(stamps[rows], between).reshape(-1, side)
    hidden = np.pad(bad[rows], between, constant_values=True).reshape(-1, side)
    out = np.array(stamps)
    out[rows] = interpolated(tall, hidden)[0].reshape(len(rows), side + 2, side)[:, :side]
    return out


def _bands(height: int) -> list[tuple[slice, slice, slice]]:
    """Return bands of rows, the rows with those beside them, and the place of the first in these.

    Of a large image, only a band is searched at a time, which bounds the memory.
    """
    bands = []
    for top in range(0, height, BAND_ROWS):
        end, start = min(top + BAND_ROWS, height), max(top - BAND_EDGE, 0)
        band_rows = slice(start, min(end + BAND_EDGE, height))
        bands.append((slice(top, end), band_rows, slice(top - start, end - start)))
    return bands
