"""How large the stars of an image are: the light of the median star by radius, and what follows.

The profile of a star is the median of the pixels of a ring about its centre, in which a neighbour
does not count, above the median far outside. That of all stars is the median again, up to the
radius from which it is no more than its own noise: there the stars meet the sky.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psfdae.moments import FWHM_OF_SIGMA, robust_scatter, windowed_centres

SIDES_PX = (16, 24, 32, 48, 64)
"""Sides of stamps that are tried, ascending."""

LIGHT_WANTED = 0.98
"""Part of the light that wider stamps hold."""

REACH_PX = 72
"""Radius of the windows in which stars are measured."""

MOST_STARS = 60
"""Brightest stars that are measured."""


@dataclass(frozen=True)
class SourceSize:
    """Size of the median star.

    Attributes
    ----------
    radius_px : ndarray, shape (k,)
        Outer radii of rings, ascending, up to where the star meets the sky; and twice that.
    light : ndarray, shape (k,)
        Part of its light within them, the last one 1.
    peak_offset_px : float
        Median distance of the brightest pixel from the centre, the larger of row and column.
    sharpness_px : float
        √(Σp² / Σ|∇p|²) of the median star p, σ of a Gaussian: the scale of its finest structure.
    """

    radius_px: np.ndarray
    light: np.ndarray
    peak_offset_px: float
    sharpness_px: float

    @property
    def fwhm_px(self) -> float:
        """Twice the radius of half of the light, which is the FWHM of a Gaussian."""
        light, radius = (np.append(0.0, values) for values in (self.light, self.radius_px))
        return 2.0 * float(np.interp(0.5, light, radius))

    def light_within(self, side_px: int) -> float:
        """Part of the light in a square, by that in a circle of the same area."""
        radius = side_px / np.sqrt(np.pi)
        return float(np.interp(radius, np.append(0.0, self.radius_px), np.append(0.0, self.light)))

    @property
    def hollow(self) -> bool:
        """Most stars have their brightest pixel off their centre, as rings have."""
        return self.peak_offset_px > 1.0

    def side(self, light_min: float) -> int:
        """Side of stamps: the least one if it holds so much light, else one that holds 98 %.

        The edge of a hollow star is bright: it must be within the stamp wherever in its pixel the
        star lies.
        """
        if self.hollow:
            enough = (side for side in SIDES_PX if self.light_within(side - 2) >= 0.99)
            return next(enough, SIDES_PX[-1])
        if self.light_within(SIDES_PX[0]) >= light_min:
            return SIDES_PX[0]
        enough = (side for side in SIDES_PX if self.light_within(side) >= LIGHT_WANTED)
        return next(enough, SIDES_PX[-1])


def measure_size(flat: np.ndarray, bad: np.ndarray, position: np.ndarray) -> SourceSize | None:
    """Measure the size of the stars of an image.

    Parameters
    ----------
    flat : ndarray, shape (h, w)
        Sky-subtracted.
    bad : ndarray of bool, shape (h, w)
    position : ndarray, shape (n, 2)
        (x, y) of stars, of which the brightest count; NaN where unknown.

    Returns
    -------
    SourceSize or None
        None if no star is seen.
    """
    windows, measured = _windows(flat, bad, position)
    if not len(windows):
        return None
    # The centre under a window as wide as the star, of which the first profile knows the width.
    centre, size = np.zeros((len(windows), 2)), None
    for _ in range(2):
        size = _profile(windows, measured, centre)
        if size is None:
            return None
        # A ring has no light in its middle: a window narrower than its radius would leave it.
        sigma = np.full(len(windows), max(size.fwhm_px / FWHM_OF_SIGMA, 0.7))
        light = np.where(measured, windows, 0.0)
        centre = windowed_centres(light, np.zeros_like(centre), sigma, 10, max(size.fwhm_px, 1.5))
    return _profile(windows, measured, centre)


def _windows(
    flat: np.ndarray, bad: np.ndarray, position: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Windows (n, s, s) about the brightest stars, and which of their pixels were measured."""
    height, width = flat.shape
    place = np.floor(position[np.isfinite(position).all(axis=1)][:, ::-1] + 0.5).astype(np.int64)
    place = place[((place >= 0) & (place < flat.shape)).all(axis=1)]
    # Brightness: light within 8 px; bad pixels have none.
    clean = np.where(bad, 0.0, flat)
    total = np.zeros((height + 1, width + 1))
    total[1:, 1:] = clean.cumsum(axis=0, dtype=np.float64).cumsum(axis=1)
    low, high = np.clip(place - 8, 0, None), np.minimum(place + 9, flat.shape)
    light = total[high[:, 0], high[:, 1]] - total[low[:, 0], high[:, 1]]
    light += total[low[:, 0], low[:, 1]] - total[high[:, 0], low[:, 1]]
    brightest = place[np.argsort(-light, kind="stable")[:MOST_STARS]]
    pad = np.pad(clean, REACH_PX)
    not_measured = np.pad(bad, REACH_PX, constant_values=True)
    axis = np.arange(2 * REACH_PX + 1)
    rows, columns = (brightest[:, i, None] + axis for i in (0, 1))
    pixels = rows[:, :, None], columns[:, None, :]
    return pad[pixels], ~not_measured[pixels]


def _profile(windows: np.ndarray, measured: np.ndarray, centre: np.ndarray) -> SourceSize | None:
    """Size by the median profile of stars whose centres (n, 2) are off the middle of windows."""
    axis = np.arange(windows.shape[-1]) - windows.shape[-1] // 2
    edges = np.concatenate([np.arange(0.0, 10.0), np.arange(10.0, REACH_PX - 3.0, 2.0)])
    area = np.pi * np.diff(edges**2)
    rings = np.full((len(windows), len(edges) - 1), np.nan)
    offset = np.empty(len(windows))
    for star, (image, good, (row, column)) in enumerate(
        zip(windows, measured, centre, strict=True)
    ):
        radius = np.hypot(axis[:, None] - row, axis - column)
        place = (np.digitize(radius[good], edges) - 1).astype(np.int16)  # sorted by their digits
        values = image[good]
        order = np.argsort(place, kind="stable")
        starts = np.searchsorted(place[order], np.arange(len(edges)))
        for ring in range(len(edges) - 1):
            pixels = values[order[starts[ring] : starts[ring + 1]]]
            if len(pixels):
                # Within a few pixels a star is not round on the pixel grid: the mean is the light;
                # beyond, the median is, the mean of the two middle pixels.
                if edges[ring + 1] > 4:
                    middle = [(len(pixels) - 1) // 2, len(pixels) // 2]
                    pixels = np.partition(pixels, middle)[middle]
                rings[star, ring] = pixels.mean()
        core = np.where(radius < max(4.0, REACH_PX / 6), image, -np.inf)
        peak = np.unravel_index(core.argmax(), core.shape)
        offset[star] = max(abs(axis[peak[0]] - row), abs(axis[peak[1]] - column))
    with np.errstate(all="ignore"):
        rings = rings - np.nanmedian(rings[:, -4:], axis=1)[:, None]
    flux = np.nansum(rings[:, edges[1:] <= 16] * area[edges[1:] <= 16], axis=1)
    usable = np.isfinite(rings).mean(axis=1) > 0.5
    usable &= np.isfinite(flux) & (flux > 0)
    if not usable.any():
        return None
    scaled = rings[usable] / flux[usable, None]
    is_covered = np.isfinite(scaled).sum(axis=0) > 0.5 * usable.sum()
    last = len(is_covered) if is_covered.all() else int(np.argmin(is_covered))
    scaled = np.where(np.isfinite(scaled), scaled, np.nanmedian(scaled, axis=0))[:, :last]
    profile = np.median(scaled, axis=0)
    # 1.25 σ/√n is the error of a median; three of these above 0 are light.
    error = 1.25 * robust_scatter(scaled) / np.sqrt(len(scaled))
    dark = (profile <= 3.0 * error) & (edges[1 : last + 1] > 4)
    end = int(np.argmax(dark)) if dark.any() else last
    light = np.cumsum(profile[:end] * area[:end])
    if not len(light) or light[-1] <= 0:
        return None
    outer_light = _beyond(0.5 * (edges[:end] + edges[1 : end + 1]), profile[:end], edges[end])
    radius = np.append(edges[1 : end + 1], 2.0 * edges[end])
    light = np.append(light, light[-1] + min(outer_light, 0.1 * light[-1]))
    stamp = np.median(_scaled(windows[usable], flux[usable]), axis=0)
    rows, columns = np.gradient(stamp)
    gradient = float(np.square(rows).sum() + np.square(columns).sum())
    sharpness = float(np.sqrt(np.square(stamp).sum() / gradient)) if gradient > 0 else 1.0
    return SourceSize(radius, light / light[-1], float(np.median(offset)), sharpness)


def _beyond(radius: np.ndarray, profile: np.ndarray, end: float) -> float:
    """Light beyond a radius `end`, if the profile falls on by the power law of its outer half.

    ∫ p(end) (r/end)^-k 2πr dr = 2π p(end) end² / (k − 2), with k at least 4.
    """
    outer_half = (radius > 0.5 * end) & (profile > 0)
    if np.count_nonzero(outer_half) < 3:
        return 0.0
    slope, height = np.polyfit(np.log(radius[outer_half] / end), np.log(profile[outer_half]), 1)
    return float(2.0 * np.pi * np.exp(height) * end**2 / (max(-slope, 4.0) - 2.0))


def _scaled(windows: np.ndarray, flux: np.ndarray) -> np.ndarray:
    """The inner parts of windows over the fluxes of their stars."""
    middle = windows.shape[-1] // 2
    core = slice(middle - 24, middle + 25)
    return np.asarray(windows[:, core, core] / flux[:, None, None])
