"""Size of the stars of an image, from the light of the median star as a function of radius.

Inputs: an image without its sky and the positions of its stars. Output: `SourceSize`.

The profile of a star is the median of the pixels in rings about its centre, which excludes
neighbours, above the median far outside. The profile of all stars is the median of their profiles,
up to the radius at which it falls below its own noise: there the stars meet the sky.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from psfdae.image.errors import silent
from psfdae.image.stamps import cut, cut_image
from psfdae.stars.moments import FWHM_OF_SIGMA, find_centroids, middle_value, robust_scatter


@dataclass(frozen=True)
class SourceSize:
    """Size of the median star.

    Attributes
    ----------
    radius_px : ndarray, shape (k,)
        Outer radii of rings, ascending, up to where the star meets the sky; then twice this radius.
    light : ndarray, shape (k,)
        Fraction of the light within these radii; the last one is 1.
    peak_offset_px : float
        Median distance of the brightest pixel from the centre, the larger of row and column.
    sharpness_px : float
        √(Σp² / Σ|∇p|²) of the median star p, σ of a Gaussian: the scale of its finest structure.
    """

    radius_px: np.ndarray
    light: np.ndarray
    peak_offset_px: float
    sharpness_px: float
    sides: ClassVar[tuple[int, ...]] = (16, 24, 32, 48, 64)
    """Sides of stamps in px."""

    @property
    def fwhm_px(self) -> float:
        """Twice the radius of half of the light, which is the FWHM of a Gaussian."""
        # The light within radius 0 is 0.
        light, radius = (np.append(0.0, values) for values in (self.light, self.radius_px))
        return 2.0 * float(np.interp(0.5, light, radius))

    def light_within(self, side_px: int) -> float:
        """Return the fraction of the light in a square, from a circle of the same area."""
        radius = side_px / np.sqrt(np.pi)
        return float(np.interp(radius, np.append(0.0, self.radius_px), np.append(0.0, self.light)))

    @property
    def is_hollow(self) -> bool:
        """True if most stars have their brightest pixel off their centre, as rings do."""
        return self.peak_offset_px > 1.0

    def side(self, light_min: float) -> int:
        """Return the side of stamps, one of `sides`.

        It is 16 px if these hold `light_min` of the light, else the first that holds 98 %.
        The edge of a hollow star is bright: it must be within the stamp at any phase on the pixel
        grid, with 99 % of the light.
        """
        if not self.is_hollow and self.light_within(self.sides[0]) >= light_min:
            return self.sides[0]
        edge_px, fraction = (2, 0.99) if self.is_hollow else (0, 0.98)
        sides = (side for side in self.sides if self.light_within(side - edge_px) >= fraction)
        return next(sides, self.sides[-1])


def measure_size(data: np.ndarray, bad: np.ndarray, position: np.ndarray) -> SourceSize | None:
    """Measure the size of the 60 brightest stars of an image, in windows with a radius of 72 px.

    Parameters
    ----------
    data : ndarray, shape (h, w)
        Image without its sky.
    bad : ndarray of bool, shape (h, w)
        Pixels that are ignored.
    position : ndarray, shape (n, 2)
        (x, y) of stars, NaN where unknown.

    Returns
    -------
    SourceSize or None
        None if no star has light.
    """

    # Windows about stars, in which bad pixels are 0.
    def cut_windows(pixel: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray]:
        """Return windows (n, s, s) about pixels (n, 2), and which of their pixels are measured."""
        windows_at = (data.shape, pixel[:, 1], pixel[:, 0], side, 0)
        windows, inside, _ = cut_image(data, *windows_at)
        is_measured = inside & (cut_image(bad, *windows_at)[0] == 0)
        return np.where(is_measured, windows, 0.0), is_measured

    # The brightest stars by the light within 8 px, of 4096 stars at a time.
    pixel = np.floor(position[np.isfinite(position).all(axis=1)][:, ::-1] + 0.5).astype(np.int64)
    pixel = pixel[((pixel >= 0) & (pixel < data.shape)).all(axis=1)]
    if not len(pixel):
        return None
    light = [
        cut_windows(part, 17)[0].sum(axis=(1, 2), dtype=np.float64)
        for part in np.array_split(pixel, -(-len(pixel) // 4096))
    ]
    brightest = pixel[np.argsort(-np.concatenate(light), kind="stable")[:60]]
    windows, is_measured = cut_windows(brightest, 145)
    # The centre under a window as wide as the star, from a first profile about the given positions;
    # 5 σ of it are enough.
    centre = np.zeros((len(windows), 2))
    size = measure_windows(windows, is_measured, centre)
    if size is None:
        return None
    # A ring is dark in its middle: a window narrower than its radius would drift off.
    sigma, reach_px = max(size.fwhm_px / FWHM_OF_SIGMA, 0.7), max(size.fwhm_px, 1.5)
    middle = cut(windows, min(2 * int(np.ceil(5.0 * sigma + reach_px)) + 1, windows.shape[-1]))
    centre = find_centroids(middle, centre, np.full(len(windows), sigma), 10, reach_px)
    return measure_windows(windows, is_measured, centre)


def measure_windows(
    windows: np.ndarray, is_measured: np.ndarray, centre: np.ndarray
) -> SourceSize | None:
    """Measure the size from the median profile of stars; None without light.

    Parameters
    ----------
    windows : ndarray, shape (n, s, s)
        Images of the stars without their sky.
    is_measured : ndarray of bool, shape (n, s, s)
        Pixels that are used.
    centre : ndarray, shape (n, 2)
        Centres (row, column) from the middle of the windows.
    """
    reach_px = windows.shape[-1] // 2
    axis = np.arange(windows.shape[-1]) - reach_px
    edges = np.concatenate([np.arange(0.0, 10.0), np.arange(10.0, reach_px - 3.0, 2.0)])
    area = np.pi * np.diff(edges**2)
    # Light per pixel in the rings of each star, and the offset of its brightest pixel.
    rings = np.empty((len(windows), len(area)))
    offset = np.empty(len(windows))
    stars = zip(windows, is_measured, centre, strict=True)
    for star, (window, is_used, (row, column)) in enumerate(stars):
        # Distance of each pixel from the centre of the star.
        radius = np.hypot(axis[:, None] - row, axis - column)
        rings[star] = ring_light(window[is_used], radius[is_used], edges)
        # A neighbour farther out may be brighter than the star.
        core = np.where(radius < max(4.0, reach_px / 6), window, -np.inf)
        peak = np.unravel_index(core.argmax(), core.shape)
        offset[star] = max(abs(axis[peak[0]] - row), abs(axis[peak[1]] - column))
    # Subtract the sky, the median of the four outer rings; scale to flux 1 within 16 px.
    with silent():  # near an edge, the outer rings of a star may be empty
        rings = rings - np.nanmedian(rings[:, -4:], axis=1)[:, None]
    flux = np.nansum(rings[:, edges[1:] <= 16] * area[edges[1:] <= 16], axis=1)
    usable = np.isfinite(rings).mean(axis=1) > 0.5
    usable &= np.isfinite(flux) & (flux > 0)
    if not usable.any():
        return None
    profiles = rings[usable] / flux[usable, None]
    # Median profile, up to the first ring that half of the stars lack.
    is_covered = np.isfinite(profiles).sum(axis=0) > 0.5 * usable.sum()
    last = len(is_covered) if is_covered.all() else int(np.argmin(is_covered))
    profiles = profiles[:, :last]
    profiles = np.where(np.isfinite(profiles), profiles, np.nanmedian(profiles, axis=0))
    profile = np.median(profiles, axis=0)
    # 1.25 σ/√n is the error of a median; a profile above three errors is light.
    error = 1.25 * robust_scatter(profiles) / np.sqrt(len(profiles))
    dark = (profile <= 3.0 * error) & (edges[1 : last + 1] > 4)
    end = int(np.argmax(dark)) if dark.any() else last
    profile, end_px = profile[:end], edges[end]
    # Light within radius r: ∫ p(r) 2πr dr as a sum over rings.
    light = np.cumsum(profile * area[:end])
    if not len(light) or light[-1] <= 0:
        return None
    # Light outside the end, if the profile p continues with the power law of its outer half:
    # ∫ p(end) (r/end)^-k 2πr dr = 2π p(end) end² / (k − 2), with k ≥ 4; a tenth at most.
    light_beyond, middle = 0.0, 0.5 * (edges[:end] + edges[1 : end + 1])
    is_outer = (middle > 0.5 * end_px) & (profile > 0)
    if np.count_nonzero(is_outer) >= 3:
        slope, height = np.polyfit(np.log(middle[is_outer] / end_px), np.log(profile[is_outer]), 1)
        light_beyond = float(2.0 * np.pi * np.exp(height) * end_px**2 / (max(-slope, 4.0) - 2.0))
    radius = np.append(edges[1 : end + 1], 2.0 * end_px)
    light = np.append(light, light[-1] + min(light_beyond, 0.1 * light[-1]))
    # The inner 49 × 49 px of the median star show how fine its structure is.
    middle_px = slice(reach_px - 24, reach_px + 25)
    middles = windows[usable][:, middle_px, middle_px]
    stamp = np.median(middles / flux[usable][:, None, None], axis=0)
    # σ of a Gaussian is √(Σp² / Σ|∇p|²), as Σ|∇p|² = Σp² / σ² in two dimensions.
    rows, columns = np.gradient(stamp)
    gradient = float(np.square(rows).sum() + np.square(columns).sum())
    sharpness = float(np.sqrt(np.square(stamp).sum() / gradient)) if gradient > 0 else 1.0
    return SourceSize(radius, light / light[-1], float(np.median(offset)), sharpness)


def ring_light(values: np.ndarray, radius: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the light per pixel of a star in rings between some radii, (k,), NaN without pixels.

    Within 4 px, where a star is not round on the pixel grid, it is the mean; outside, the median.

    Parameters
    ----------
    values, radius : ndarray, shape (n,)
        Pixels of the star, and their distances from its centre.
    edges : ndarray, shape (k + 1,)
        Radii, whole numbers, ascending.
    """
    # Pixels in the order of their rings; rings are small whole numbers, which are sorted by digits.
    pixel_ring = np.digitize(np.arange(int(radius.max(initial=0.0)) + 1), edges) - 1
    ring = pixel_ring.astype(np.int16)[radius.astype(np.int16)]
    order = np.argsort(ring, kind="stable")
    values, starts = values[order], np.searchsorted(ring[order], np.arange(len(edges)))
    light = np.full(len(edges) - 1, np.nan)
    for k in range(len(light)):
        pixels = values[starts[k] : starts[k + 1]]
        if not len(pixels):
            continue
        if edges[k + 1] > 4:
            light[k] = middle_value(pixels)
        else:
            light[k] = pixels.mean()
    return light
