"""Trails of satellites and aeroplanes: long, straight, narrow, and about as bright all along."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from psfdae.image.bad_pixels import BadPixels, interpolated
from psfdae.image.sky_level import sky_level

STEP_PX = 8
"""Length of the parts of a line in which it is seen or not."""

WIDEST_PX = 20
"""Largest half width of a trail."""


class Line(NamedTuple):
    """x sin θ − y cos θ = d, in 0-based pixels."""

    angle_rad: float
    distance_px: float

    def across(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Distance of places from the line, signed, px."""
        across = x * np.sin(self.angle_rad) - y * np.cos(self.angle_rad)
        return np.asarray(across - self.distance_px)

    def along(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Place along the line, px."""
        return np.asarray(x * np.cos(self.angle_rad) + y * np.sin(self.angle_rad))


def with_trails(image: np.ndarray, bad_pixels: BadPixels) -> BadPixels:
    """Return the bad pixels of an image (h, w) with those of trails; as they are without a sky."""
    try:
        trails, count = find_trails(image, bad_pixels.mask)
    except ValueError:  # no mesh has enough good pixels
        return bad_pixels
    if not count:
        return bad_pixels
    words = "a trail" if count == 1 else f"{count} trails"
    note = f"{np.count_nonzero(trails)} pixels of {words} of satellites"
    notes = (*bad_pixels.notes, note)
    return replace(bad_pixels, mask=bad_pixels.mask | trails, notes=notes)


def find_trails(image: np.ndarray, bad: np.ndarray) -> tuple[np.ndarray, int]:
    """Find the pixels of trails in an image.

    Parameters
    ----------
    image : ndarray, shape (h, w)
    bad : ndarray of bool, shape (h, w)
        Pixels that do not count.

    Returns
    -------
    mask : ndarray of bool, shape (h, w)
    count : int
        Number of trails.
    """
    from scipy import ndimage

    # Of large images, means of squares are enough: a side has 1000 to 2000 of them.
    size = max(1, min(image.shape) // 1000)
    values, hidden = _binned(image, bad, size)
    mask, count = np.zeros(values.shape, dtype=bool), 0
    shortest = max(100 // size, min(values.shape) // 6)
    if min(values.shape) < shortest or hidden.all():
        return np.zeros(image.shape, dtype=bool), count
    # The image above its sky, smoothed by 3 × 3 pixels: noise σ/3.
    sky = sky_level(np.where(hidden, 0.0, values), hidden)
    flat = ndimage.uniform_filter(interpolated(values - sky.level, hidden)[0], 3)
    noise = sky.noise / 3.0
    bright = (flat > 4.0 * noise) & ~hidden
    # Connected pixels that reach as far as a trail; a line is searched in each until none is left.
    label, _ = ndimage.label(bright, np.ones((3, 3)))
    for number, box in enumerate(ndimage.find_objects(label), 1):
        if np.hypot(*(part.stop - part.start for part in box)) < shortest:
            continue
        row, column = np.nonzero(label[box] == number)
        row, column = row + box[0].start, column + box[1].start
        for _ in range(4):
            trail = _trail(_line(column, row), flat, noise, bright, shortest)
            if trail is None:
                break
            mask |= trail
            count += 1
            is_left = ~trail[row, column]
            row, column = row[is_left], column[is_left]
            if len(row) < shortest:
                break
    full_mask = np.zeros(image.shape, dtype=bool)
    large = np.kron(mask, np.ones((size, size), dtype=bool))
    full_mask[: large.shape[0], : large.shape[1]] = large
    return full_mask & ~bad, count


def _binned(image: np.ndarray, bad: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the means of the good pixels of squares, and squares without any."""
    if size == 1:
        return image.astype(np.float64), bad
    rows, columns = (n // size for n in image.shape)
    part = np.s_[: rows * size, : columns * size]
    squares = rows, size, columns, size
    count = (~bad[part]).reshape(squares).sum(axis=(1, 3))
    total = np.where(bad, 0.0, image)[part].reshape(squares).sum(axis=(1, 3))
    return total / np.maximum(count, 1), count == 0


def _line(x: np.ndarray, y: np.ndarray) -> Line:
    """Return the line on which most of some pixels lie (Hough 1962, US patent 3069654)."""
    line, most_pixels = Line(0.0, 0.0), 0
    thinned = np.s_[:: max(1, len(x) // 5000)]
    for angle in np.deg2rad(np.arange(0.0, 180.0, 0.5)):
        across = Line(float(angle), 0.0).across(x[thinned], y[thinned])
        count, edge = np.histogram(across, max(1, int(np.ptp(across) / 2.0)))
        if count.max() > most_pixels:
            most_pixels, line = (
                int(count.max()),
                Line(float(angle), float(edge[count.argmax()]) + 1.0),
            )
    # Least squares on the pixels nearby: offset and slope along the line.
    for reach in (5.0, 3.0, 3.0):
        across, along = line.across(x, y), line.along(x, y)
        is_near = np.abs(across) < reach
        if np.count_nonzero(is_near) < 10:
            break
        slope, _ = np.polyfit(along[is_near], across[is_near], 1)
        turned = Line(line.angle_rad - float(np.arctan(slope)), 0.0)
        line = turned._replace(distance_px=float(np.mean(turned.across(x[is_near], y[is_near]))))
    return line


def _trail(
    line: Line, flat: np.ndarray, noise: np.ndarray, bright: np.ndarray, shortest: int
) -> np.ndarray | None:
    """Return the pixels (h, w) of the trail on a line; None if there is none."""
    row, column = (np.asarray(places, np.float64) for places in np.indices(flat.shape))
    across, along = line.across(column, row), line.along(column, row)
    start = float(along.min())
    part = ((along - start) / STEP_PX).astype(int)
    middle = np.abs(across) < 1.0
    # Parts of the line of which three of four pixels are bright, gaps of two parts closed.
    pixels = np.bincount(part[middle], minlength=part.max() + 1)
    is_bright = np.bincount(part[middle], bright[middle], minlength=len(pixels)) > 0.75 * pixels
    is_bright &= pixels > 0
    gaps = np.convolve(np.pad(is_bright, 2), np.ones(3), "same")
    run = _longest((gaps > 0)[2:-2])
    if (
        run is None
        or (run[1] - run[0]) * STEP_PX < shortest
        or is_bright[slice(*run)].mean() < 0.85
    ):
        return None
    inside = (part >= run[0]) & (part < run[1])
    # Stars in a row have bright and dark parts; a trail is as bright all along.
    heights = np.array([np.median(flat[middle & (part == k)]) for k in range(*run) if pixels[k]])
    low, median_height = np.percentile(heights, [15, 50])
    if low < 0.7 * median_height:
        return None
    # Half width: to where the median height is no more than half the noise of a pixel.
    ring = np.abs(across)
    for half in range(2, WIDEST_PX):
        edge = inside & (ring >= half) & (ring < half + 1)
        if edge.any() and np.median(flat[edge]) < 1.5 * np.median(noise[edge]):
            narrow = (run[1] - run[0]) * STEP_PX > 20 * half  # or it is a filament of a nebula
            return np.asarray(inside & (ring < half + 1)) if narrow else None
    return None


def _longest(is_true: np.ndarray) -> tuple[int, int] | None:
    """Return start and end of the longest run of True, None without one."""
    edges = np.flatnonzero(np.diff(np.pad(is_true.astype(np.int8), 1)))
    if not edges.size:
        return None
    starts, ends = edges[::2], edges[1::2]
    k = int((ends - starts).argmax())
    return int(starts[k]), int(ends[k])
