"""Trails of satellites and aeroplanes: long, straight, narrow, and about as bright all along.

In: an image and its bad pixels. Out: bad pixels with those of trails.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from psfdae.image.bad_pixels import BadPixels
from psfdae.image.interpolation import interpolated
from psfdae.image.sky_level import SkyLevel, sky_level


class Line(NamedTuple):
    """A line x sin θ − y cos θ = d, in 0-based pixels."""

    angle_rad: float
    distance_px: float

    def across(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the signed distance of places from the line, px."""
        across = x * np.sin(self.angle_rad) - y * np.cos(self.angle_rad)
        return np.asarray(across - self.distance_px)

    def along(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the place along the line, px."""
        return np.asarray(x * np.cos(self.angle_rad) + y * np.sin(self.angle_rad))


def with_trails(image: np.ndarray, bad_pixels: BadPixels) -> BadPixels:
    """Return the bad pixels of an image (h, w) with those of trails.

    Without a trail, they are returned with the sky of the image, which was measured to find one,
    unless the image is so large that its means over squares were searched. They are returned as
    they are if no sky can be measured, or if the image is smaller than a trail.

    Parameters
    ----------
    image : ndarray, shape (h, w)
    bad_pixels : BadPixels
        Bad pixels of other kinds, which are left out of the search.
    """
    if min(image.shape) < 100:
        return bad_pixels
    # Of large images, means of squares are enough: a side has 1000 to 2000 of them.
    size = min(image.shape) // 1000
    values, hidden = image, bad_pixels.mask
    if size > 1:
        rows, columns = (n // size for n in image.shape)
        # Mean of the good pixels of each square; a square without any is bad.
        squares = rows, size, columns, size
        good = np.where(hidden, 0.0, image)[: rows * size, : columns * size]
        count = (~hidden[: rows * size, : columns * size]).reshape(squares).sum(axis=(1, 3))
        values = good.reshape(squares).sum(axis=(1, 3)) / np.maximum(count, 1)
        hidden = count == 0
    values = np.where(hidden, 0.0, values)
    try:
        sky = sky_level(values, hidden)
    except ValueError:  # no mesh has enough good pixels
        return bad_pixels
    trails, number = find_trails(values, hidden, sky)
    if not number:
        return bad_pixels if size > 1 else replace(bad_pixels, sky=sky)
    # From squares back to pixels; those of the last rows and columns are in none.
    mask = np.zeros(image.shape, dtype=bool)
    large = np.kron(trails, np.ones((max(size, 1), max(size, 1)), dtype=bool))
    mask[: large.shape[0], : large.shape[1]] = large
    mask &= ~bad_pixels.mask
    words = "a trail" if number == 1 else f"{number} trails"
    note = f"{np.count_nonzero(mask)} pixels of {words} of satellites"
    return replace(bad_pixels, mask=bad_pixels.mask | mask, notes=(*bad_pixels.notes, note))


def find_trails(image: np.ndarray, bad: np.ndarray, sky: SkyLevel) -> tuple[np.ndarray, int]:
    """Find the pixels of trails in an image, each of at least 100 px and a sixth of the image.

    Parameters
    ----------
    image : ndarray, shape (h, w)
    bad : ndarray of bool, shape (h, w)
        Pixels that do not count.
    sky : SkyLevel
        Sky of the image.

    Returns
    -------
    mask : ndarray of bool, shape (h, w)
    count : int
        Number of trails.
    """
    from scipy import ndimage

    mask, count = np.zeros(image.shape, dtype=bool), 0
    shortest_px = max(100, min(image.shape) // 6)
    # The image above its sky, smoothed by 3 × 3 pixels: noise σ/3.
    flat = ndimage.uniform_filter(interpolated(image - sky.level, bad)[0], 3)
    noise = sky.noise / 3.0
    bright = (flat > 4.0 * noise) & ~bad
    # Connected pixels that reach as far as a trail; a line is searched in each until none is left.
    label, _ = ndimage.label(bright, np.ones((3, 3)))
    for number, box in enumerate(ndimage.find_objects(label), 1):
        if np.hypot(*(part.stop - part.start for part in box)) < shortest_px:
            continue
        # Pixels of this source, counted from the corner of the image.
        row, column = np.nonzero(label[box] == number)
        row, column = row + box[0].start, column + box[1].start
        for _ in range(4):
            trail = trail_on_line(line_through(column, row), flat, noise, bright, shortest_px)
            if trail is None:
                break
            mask |= trail
            count += 1
            # Another trail may cross it: the pixels off this one are searched again.
            is_left = ~trail[row, column]
            row, column = row[is_left], column[is_left]
            if len(row) < shortest_px:
                break
    return mask, count


def line_through(x: np.ndarray, y: np.ndarray) -> Line:
    """Return the line on which most of some pixels (n,) lie (Hough 1962, US patent 3069654).

    Parameters
    ----------
    x, y : ndarray of int, shape (n,)
        Columns and rows of the pixels.

    Returns
    -------
    Line
        Least squares on the pixels within 3 px of the line that has most of them.
    """
    # Number of pixels in strips of 2 px, for lines of all directions.
    line, most_pixels = Line(0.0, 0.0), 0
    thinned = np.s_[:: max(1, len(x) // 5000)]
    for angle in np.deg2rad(np.arange(0.0, 180.0, 0.5)):
        across = Line(float(angle), 0.0).across(x[thinned], y[thinned])
        count, edge = np.histogram(across, max(1, int(np.ptp(across) / 2.0)))
        if count.max() > most_pixels:
            most_pixels = int(count.max())
            line = Line(float(angle), float(edge[count.argmax()]) + 1.0)
    # Least squares on the pixels nearby: offset and slope along the line.
    for reach_px in (5.0, 3.0, 3.0):
        across, along = line.across(x, y), line.along(x, y)
        is_near = np.abs(across) < reach_px
        if np.count_nonzero(is_near) < 10:
            break
        # A line that is turned by −arctan(slope) follows the pixels; its distance is their mean.
        slope, _ = np.polyfit(along[is_near], across[is_near], 1)
        turned = Line(line.angle_rad - float(np.arctan(slope)), 0.0)
        line = turned._replace(distance_px=float(np.mean(turned.across(x[is_near], y[is_near]))))
    return line


def trail_on_line(
    line: Line, flat: np.ndarray, noise: np.ndarray, bright: np.ndarray, shortest_px: int
) -> np.ndarray | None:
    """Return the pixels (h, w) of the trail on a line; None if there is none.

    Parameters
    ----------
    line : Line
    flat, noise : ndarray, shape (h, w)
        Smoothed image without its sky, and its σ.
    bright : ndarray of bool, shape (h, w)
        Pixels far above the noise.
    shortest_px : int
        Least length of a trail.
    """
    # Parts of the line, 8 px long, of which three of four pixels are bright.
    part_px = 8
    row, column = (np.asarray(places, np.float64) for places in np.indices(flat.shape))
    across, along = line.across(column, row), line.along(column, row)
    part = ((along - float(along.min())) / part_px).astype(int)
    middle = np.abs(across) < 1.0
    # Pixels of each part within 1 px of the line, and those of them that are bright.
    pixels = np.bincount(part[middle], minlength=part.max() + 1)
    is_bright = np.bincount(part[middle], bright[middle], minlength=len(pixels)) > 0.75 * pixels
    is_bright &= pixels > 0
    # The longest run of these, gaps of two parts closed.
    closed = (np.convolve(np.pad(is_bright, 2), np.ones(3), "same") > 0)[2:-2]
    edges = np.flatnonzero(np.diff(np.pad(closed.astype(np.int8), 1)))
    if not edges.size:
        return None
    longest = int((edges[1::2] - edges[::2]).argmax())
    start, end = int(edges[2 * longest]), int(edges[2 * longest + 1])
    if (end - start) * part_px < shortest_px or is_bright[start:end].mean() < 0.85:
        return None
    # Stars in a row have bright and dark parts; a trail is as bright all along.
    heights = [np.median(flat[middle & (part == k)]) for k in range(start, end) if pixels[k]]
    low, median_height = np.percentile(heights, [15, 50])
    if low < 0.7 * median_height:
        return None
    # Half width: to where the median height is no more than half the noise of a pixel, σ/2 = 1.5
    # σ/3; a trail is narrower than 40 px, and than a tenth of its length, or it is a filament of a
    # nebula.
    inside = (part >= start) & (part < end)
    ring = np.abs(across)
    for half_px in range(2, 20):
        # A strip of 1 px on either side at this distance.
        edge = inside & (ring >= half_px) & (ring < half_px + 1)
        if edge.any() and np.median(flat[edge]) < 1.5 * np.median(noise[edge]):
            is_narrow = (end - start) * part_px > 20 * half_px
            return np.asarray(inside & (ring < half_px + 1)) if is_narrow else None
    return None
