"""Trails of satellites and aeroplanes, and spikes of saturated stars: straight, narrow features.

Inputs: an image and its bad pixels. Output: bad pixels, with trails and spikes added.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from psfdae.image.bad_pixels import BadPixels
from psfdae.image.interpolation import fill_bad
from psfdae.image.sky_level import SkyLevel, sky_level
from psfdae.stars.moments import SIGMA_OF_MAD


class Line(NamedTuple):
    """A line x sin θ − y cos θ = d, in 0-based pixels."""

    angle_rad: float
    distance_px: float

    def across(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the signed distances of positions from the line, in px."""
        across = x * np.sin(self.angle_rad) - y * np.cos(self.angle_rad)
        return np.asarray(across - self.distance_px)

    def along(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the coordinates of positions along the line, in px."""
        return np.asarray(x * np.cos(self.angle_rad) + y * np.sin(self.angle_rad))


def add_trails(image: np.ndarray, bad_pixels: BadPixels, saturate: float) -> BadPixels:
    """Add the pixels of trails and spikes to the bad pixels of an image (h, w).

    Of an image whose shorter side has 2000 px or more, means over squares of pixels are searched;
    all lengths in pixels are then in sides of these squares.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Image of finite values, in the unit of `saturate`.
    bad_pixels : BadPixels
        Bad pixels of other kinds, which are left out of the search.
    saturate : float
        Value from which a pixel is saturated. If it is unknown, it is infinite, and no spikes are
        found.

    Returns
    -------
    BadPixels
        With the pixels of trails and spikes, and a note on each kind. If there are none, with the
        sky of the image, which was measured for the search, unless squares were searched. Unchanged
        if no sky can be measured, or if a side of the image is below 100 px.
    """
    if min(image.shape) < 100:
        return bad_pixels
    # Of large images, means of the good pixels in squares are enough, 1000 to 2000 of them along
    # the shorter side.
    square_px = max(min(image.shape) // 1000, 1)
    values, bad = image, bad_pixels.mask
    if square_px > 1:
        # Rows and columns of pixels in squares; the last ones may be in none.
        rows, columns = (size // square_px for size in image.shape)
        inside = np.s_[: rows * square_px, : columns * square_px]
        values, count = (
            pixels[inside].reshape(rows, square_px, columns, square_px).sum(axis=(1, 3))
            for pixels in (np.where(bad, 0.0, image), ~bad)
        )
        values, bad = values / np.maximum(count, 1).astype(values.dtype), count == 0
    # Saturated cores do not become bad pixels, so that these stars are flagged as saturated.
    is_saturated = (values >= saturate) & ~bad
    is_core = scipy.ndimage.binary_dilation(is_saturated, np.ones((3, 3)), 3)
    values = np.where(bad, 0.0, values)
    try:
        sky = sky_level(values, bad)
    except ValueError:  # no mesh has enough good pixels
        return bad_pixels
    spikes = find_spikes(values, bad, sky, is_saturated) & ~is_core
    trails, trail_count = find_trails(values, bad | spikes | is_core, sky)
    if not (trail_count or spikes.any()):
        return bad_pixels if square_px > 1 else replace(bad_pixels, sky=sky)
    mask, notes = bad_pixels.mask.copy(), list(bad_pixels.notes)
    trail_text = "a satellite trail" if trail_count == 1 else f"{trail_count} satellite trails"
    for squares, kind in (spikes, "spikes of saturated stars"), (trails, trail_text):
        # From squares back to pixels; the last rows and columns may be in no square.
        pixels = squares.repeat(square_px, axis=0).repeat(square_px, axis=1)
        margins = [(0, n - m) for n, m in zip(mask.shape, pixels.shape, strict=True)]
        new_mask = np.pad(pixels, margins) & ~mask
        mask |= new_mask
        if new_mask.any():
            notes.append(f"{np.count_nonzero(new_mask)} pixels of {kind}")
    return replace(bad_pixels, mask=mask, notes=tuple(notes))


def find_spikes(
    image: np.ndarray, bad: np.ndarray, sky: SkyLevel, is_saturated: np.ndarray
) -> np.ndarray:
    """Find straight, narrow features that start at the cores of saturated stars.

    These are diffraction spikes, in any number and direction, and charge that bleeds along
    columns: along a ray from the core, they are brighter than the halo for at least 24 px.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Image of finite values.
    bad : ndarray of bool, shape (h, w)
        Pixels that are left out of the search.
    sky : SkyLevel
        Sky of the image.
    is_saturated : ndarray of bool, shape (h, w)
        Saturated pixels.

    Returns
    -------
    ndarray of bool, shape (h, w)
        True for pixels of spikes.
    """
    spikes, cores = np.zeros(image.shape, dtype=bool), find_saturated_cores(is_saturated)
    if not len(cores):
        return spikes
    snr = smooth_light(image, bad, sky) / sky.noise
    part_px, angles, parts = 8, 720, 32
    reach_px = part_px * parts
    # Rows and columns of the pixels of all rays, from the core.
    turn = 2.0 * np.pi * np.arange(angles)[:, None] / angles
    rays_at = np.stack([np.sin(turn), np.cos(turn)]) * np.arange(reach_px)
    for x, y, core_px in cores:
        middle = y, x
        first_part = int(2.0 * core_px / part_px) + 1
        # A core as long as the rays has none; the level of saturation is probably wrong.
        if first_part >= parts:
            continue
        # Lower and upper quartiles of the S/N in parts of 8 px of rays, one ray every half degree.
        at = rays_at + np.array(middle)[:, None, None]
        rays = scipy.ndimage.map_coordinates(snr, at, order=1, cval=np.nan)
        quartiles = np.percentile(rays.reshape(angles, parts, part_px), [25, 75], axis=2)
        quartiles = quartiles[:, :, first_part:]
        is_outside = ~np.isfinite(quartiles)
        quartiles[is_outside] = 0.0
        part_number = np.arange(1, parts - first_part + 1)
        end_px = np.zeros(angles)
        # Bright spikes are found in single parts, faint ones in five parts together, by the second
        # lowest of these, which stars in some parts do not change.
        for run in (1, 5):
            light = scipy.ndimage.rank_filter(quartiles, run // 3, (1, 1, run), mode="mirror")
            # Subtract the halo, which may be uneven or off centre: the median of every eighth ray
            # within ±30° at the same distance. A spike is narrower.
            halo = scipy.ndimage.median_filter(light[:, ::8], (1, 15, 1), mode="wrap")
            light = np.ma.array(light - np.repeat(halo, 8, axis=1), mask=is_outside)
            # The lower quartile of a part: a row of separate stars has dark gaps, a spike has none.
            low, high = light
            # Parts with light: 0.6 σ is three times the noise of a part.
            scatter = SIGMA_OF_MAD * np.ma.median(np.abs(low), axis=0)
            limit = np.maximum(4.0 * scatter.filled(np.inf), 0.6 / np.sqrt(run))
            # Spikes come in opposite pairs: each is evidence of the other.
            pair_light = np.ma.minimum(low, np.roll(low, angles // 2, axis=0))
            is_light = (low > limit).filled(False) | (pair_light > 0.5 * limit).filled(False)
            is_light &= (low > 0.4 * high).filled(False)
            # A spike ends at the last part with light up to which at least three of four parts from
            # the core on have light. The first parts may be dark where the halo is so uneven that
            # it hides spikes.
            is_hidden = np.logical_and.accumulate(limit > 2.0 * np.median(limit))
            count = np.cumsum(is_light, axis=1)
            is_ray = is_light & (count >= 0.75 * np.cumsum(is_light | ~is_hidden, axis=1))
            length = (is_ray & (count >= max(3, run))) * part_number
            end_px = np.maximum(end_px, (first_part + length.max(axis=1)) * part_px)
        # Pixels of these rays outside the core, in a window around it.
        window = cut_window(np.array(middle), reach_px, image.shape)
        row, column = np.mgrid[window] - np.array(middle)[:, None, None]
        turns = np.arctan2(row, column) / (2.0 * np.pi) % 1.0
        ray = (turns * angles).astype(int) % angles
        radius = np.hypot(row, column)
        spikes[window] |= (
            (end_px[ray] > first_part * part_px) & (radius < end_px[ray]) & (radius > core_px)
        )
    return np.asarray(scipy.ndimage.binary_dilation(spikes, np.ones((3, 3)), 2))


def find_saturated_cores(is_saturated: np.ndarray) -> np.ndarray:
    """Return the centres and radii of the cores of saturated stars: x, y and r in px, (k, 3).

    A core has at least four pixels; the 50 largest ones of an image (h, w) are returned. The centre
    is the point farthest from the edge of the core, in whatever direction its charge bleeds; the
    radius is its distance from the edge.
    """
    if not is_saturated.any():
        return np.empty((0, 3))
    label, _ = scipy.ndimage.label(is_saturated, np.ones((3, 3)))
    boxes, area = scipy.ndimage.find_objects(label), np.bincount(label.ravel())[1:]
    largest = np.argsort(-area, kind="stable")[: min(50, np.count_nonzero(area >= 4))]
    cores = np.empty((len(largest), 3))
    for core, index in zip(cores, largest, strict=True):
        # Distance of each pixel from the edge of the core; the mean position of the farthest ones.
        core_mask = np.pad(label[boxes[index]] == index + 1, 1)
        depth = scipy.ndimage.distance_transform_edt(core_mask)[1:, 1:]
        row, column = np.argwhere(depth == depth.max()).mean(axis=0)
        core[:] = column + boxes[index][1].start, row + boxes[index][0].start, depth.max()
    return cores


def cut_window(middle: np.ndarray, reach_px: int, shape: tuple[int, ...]) -> tuple[slice, ...]:
    """Return the rows and columns of an image (h, w) up to a distance from a row and column."""
    return tuple(
        slice(max(at - reach_px, 0), min(at + reach_px + 1, size))
        for at, size in zip(np.rint(middle).astype(int).tolist(), shape, strict=True)
    )


def smooth_light(image: np.ndarray, bad: np.ndarray, sky: SkyLevel) -> np.ndarray:
    """Return an image (h, w) minus its sky, smoothed over 3 × 3 px: its noise is σ/3."""
    return np.asarray(scipy.ndimage.uniform_filter(fill_bad(image - sky.level, bad)[0], 3))


def find_trails(image: np.ndarray, bad: np.ndarray, sky: SkyLevel) -> tuple[np.ndarray, int]:
    """Find trails in an image, each at least 100 px and a sixth of the shorter side long.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Image of finite values.
    bad : ndarray of bool, shape (h, w)
        Pixels that are left out of the search.
    sky : SkyLevel
        Sky of the image.

    Returns
    -------
    mask : ndarray of bool, shape (h, w)
        True for pixels of trails.
    count : int
        Number of trails.
    """
    mask, count = np.zeros(image.shape, dtype=bool), 0
    min_length_px = max(100, min(image.shape) // 6)
    smooth_image, noise = np.where(bad, 0.0, smooth_light(image, bad, sky)), sky.noise / 3.0
    # Groups of connected bright pixels that may be part of a trail. In each of the 20 longest ones,
    # up to four lines are searched, among the pixels outside the trails found so far.
    label, _ = scipy.ndimage.label(smooth_image > 4.0 * noise, np.ones((3, 3)))
    boxes = scipy.ndimage.find_objects(label)
    length = np.array([np.hypot(*(part.stop - part.start for part in box)) for box in boxes])
    for index in np.argsort(-length, kind="stable")[:20]:
        # Pixels of this group, in pixels of the image.
        box = boxes[index]
        row, column = np.nonzero((label[box] == index + 1) & ~mask[box])
        row, column = row + box[0].start, column + box[1].start
        for _ in range(4):
            if min(length[index], len(row)) < min_length_px / 4:
                break
            trail = trail_on_line(line_through(column, row), smooth_image, noise, min_length_px)
            if trail is None:
                break
            mask |= trail
            count += 1
            # Another trail may cross it: the pixels outside this one are searched again.
            is_left = ~trail[row, column]
            row, column = row[is_left], column[is_left]
    return mask, count


def line_through(x: np.ndarray, y: np.ndarray) -> Line:
    """Return the line on which most of the pixels (n,) lie (Hough 1962, US patent 3069654).

    Parameters
    ----------
    x, y : ndarray of int, shape (n,)
        Columns and rows of the pixels.

    Returns
    -------
    Line
        Least-squares fit to the pixels within 3 px of the line that has most of them.
    """
    # Number of pixels in strips of 2 px, for lines of all directions: some directions at a time, so
    # that their numbers stay in the processor's cache.
    line, most_pixels = Line(0.0, 0.0), 0
    sample, angles = np.s_[:: max(1, len(x) // 5000)], np.deg2rad(np.arange(0.0, 180.0, 0.5))
    for part in np.array_split(angles, len(x[sample]) * len(angles) // 2**16 + 1):
        across = x[sample] * np.sin(part)[:, None] - y[sample] * np.cos(part)[:, None]
        smallest = across.min(axis=1)
        strip = ((across - smallest[:, None]) / 2.0).astype(int)
        size = len(part), int(strip.max()) + 1
        strip += size[1] * np.arange(size[0])[:, None]
        count = np.bincount(strip.ravel(), minlength=size[0] * size[1]).reshape(size)
        best_angle, best_strip = np.unravel_index(count.argmax(), size)
        if count[best_angle, best_strip] > most_pixels:
            most_pixels = int(count[best_angle, best_strip])
            distance_px = float(smallest[best_angle]) + 2.0 * float(best_strip) + 1.0
            line = Line(float(part[best_angle]), distance_px)
    # Least-squares fit of angle and distance to the pixels near the line, three times.
    for reach_px in (5.0, 3.0, 3.0):
        across, along = line.across(x, y), line.along(x, y)
        is_near = np.abs(across) < reach_px
        if np.count_nonzero(is_near) < 10:
            break
        # The line turned by −arctan(slope) follows the pixels; its distance is their mean distance.
        slope, _ = np.polyfit(along[is_near], across[is_near], 1)
        central = Line(line.angle_rad - float(np.arctan(slope)), 0.0)
        line = central._replace(distance_px=float(np.mean(central.across(x[is_near], y[is_near]))))
    return line


def trail_on_line(
    line: Line, smooth_image: np.ndarray, noise: np.ndarray, min_length_px: int
) -> np.ndarray | None:
    """Return the pixels (h, w) of the trail on a line; None without a trail.

    Parameters
    ----------
    line : Line
        The line on which a trail is searched.
    smooth_image, noise : ndarray, shape (h, w)
        Smoothed image minus its sky, in any unit, and its σ.
    min_length_px : int
        Minimum length of a trail in px.
    """
    # Pixels within 21 px of the line; the middle of a trail is within 1 px.
    height, width = smooth_image.shape
    row, column = np.nonzero(np.abs(line.across(np.arange(width), np.arange(height)[:, None])) < 21)
    light, distance_px = smooth_image[row, column], np.abs(line.across(column, row))
    along = line.along(column, row)
    middle = distance_px < 1.0
    # Parts of the line, 8 px long, with a mean S/N above 2 in the middle. The S/N is per smoothed
    # pixel; the mean of a part has about half their noise.
    part_px = 8
    part = ((along - along.min()) / part_px).astype(int)
    pixels = np.bincount(part[middle])
    snr = light[middle] / noise[row, column][middle]
    is_bright = (np.bincount(part[middle], snr) > 2.0 * pixels) & (pixels > 0)
    # The longest run of bright parts, with gaps of up to two parts closed.
    has_light = (np.convolve(np.pad(is_bright, 2), np.ones(3), "same") > 0)[2:-2]
    edges = np.flatnonzero(np.diff(np.pad(has_light.astype(np.int8), 1)))
    if not edges.size:
        return None
    longest = int((edges[1::2] - edges[::2]).argmax())
    start, end = int(edges[2 * longest]), int(edges[2 * longest + 1])
    if (end - start) * part_px < min_length_px or is_bright[start:end].mean() < 0.85:
        return None
    # A row of separate stars has dark gaps; a trail may be uneven, but has light all along. Of the
    # means over 2 px in each two successive parts, the 15th percentile is divided by the 85th; the
    # median of these ratios is at least 0.3 for a trail.
    short_part = ((along - along.min())[middle] / 2.0).astype(int)
    means = np.bincount(short_part, light[middle]) / np.maximum(np.bincount(short_part), 1)
    means_2px = means[4 * start : 4 * (end - 1)].reshape(-1, 4)
    low, high = np.percentile(np.hstack([means_2px[:-1], means_2px[1:]]), [15, 85], axis=1)
    if np.median(low / np.maximum(high, 1e-30)) < 0.3:
        return None
    # Half-width: the distance at which the median light falls below half the noise σ of a pixel of
    # the image, σ/2 = 1.5 · σ/3. A trail is narrower than 40 px and than a tenth of its length;
    # anything wider may be a filament of a nebula.
    inside = (part >= start) & (part < end)
    for half_px in range(2, 20):
        # A strip of 1 px on either side at this distance.
        edge = inside & (distance_px >= half_px) & (distance_px < half_px + 1)
        if edge.any() and np.median(light[edge]) < 1.5 * np.median(noise[row, column][edge]):
            if (end - start) * part_px <= 20 * half_px:
                return None
            trail = np.zeros(smooth_image.shape, dtype=bool)
            is_trail = inside & (distance_px < half_px + 1)
            trail[row[is_trail], column[is_trail]] = True
            return trail
    return None
