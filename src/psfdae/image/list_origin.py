"""Whether a star list counts pixels from 0 or from 1, found from the stars of the image.

Inputs: an image without its sky and the positions of a list. Output: the origin, if the stars show
it.
"""

from __future__ import annotations

import numpy as np

from psfdae.image.sky import Sky
from psfdae.image.stamps import central_pixel, cut_image
from psfdae.stars.moments import find_centroids, robust_scatter

TOLERANCE_PX = 0.1
"""Largest difference, per axis, of the median offset from 0 (origin 0) or −1 (origin 1); standard
errors must be below half of it."""


def find_origin(sky: Sky, xy_px: np.ndarray) -> tuple[int, np.ndarray, int] | None:
    """Find whether positions count from 0 or 1, where the stars of an image show it clearly.

    The centroids of the brighter stars lie at the positions of the list, less its origin. Both
    axes must agree within 0.1 px, with standard errors below 0.05 px. None if fewer than eight
    stars can be used, or neither origin fits.

    Parameters
    ----------
    sky : Sky
        Image less its sky (`signal`), noise per pixel (`noise`) and bad pixels (`bad`).
    xy_px : ndarray, shape (n, 2)
        Positions x, y in px as the list has them, from 0 or from 1.

    Returns
    -------
    origin : int
        Index of the first pixel's centre, 0 or 1.
    offset : ndarray, shape (2,)
        Median of centroid − listed position, x and y in px.
    count : int
        Number of stars in the median.
    """
    # Stamps of 13 × 13 px about the position for an origin of 0.5: the centroids start midway,
    # which favours neither origin. Stars whose stamp crosses the image's edge are left out.
    shape = sky.signal.shape
    x, y = (xy_px - 0.5).T
    crosses_edge = cut_image(sky.bad, shape, x, y, stamp_px=13, margin=0)[2]
    xy_px = xy_px[~crosses_edge]
    x, y = (xy_px - 0.5).T
    layers = sky.signal, sky.noise, sky.bad
    stamps, noise, bad = (cut_image(v, shape, x, y, stamp_px=13, margin=0)[0] for v in layers)
    # Stars whose inner 5 × 5 pixels are good and stand 20 σ above the sky, the brightest 500.
    core = np.s_[:, 4:9, 4:9]
    snr = stamps[core].sum(axis=(1, 2)) / (5 * np.median(noise, axis=(1, 2)))
    star = np.flatnonzero(~bad[core].any(axis=(1, 2)) & (snr > 20))
    star = star[np.argsort(-snr[star])][:500]
    if len(star) < 8:
        return None
    # Centroids (from y, x to x, y) less positions. Gaussian window of σ = 1.5 px, from the middle,
    # 10 iterations, at most 2 px away along each axis; stars that end at that limit found no
    # centre.
    start, window_px = np.zeros((len(star), 2)), np.full(len(star), 1.5)
    centre = find_centroids(stamps[star], start, window_px, rounds=10, reach_px=2.0)[:, ::-1]
    offset = central_pixel(xy_px[star] - 0.5) + centre - xy_px[star]
    offset = offset[(np.abs(centre) < 1.9).all(axis=1)]
    if len(offset) < 8:
        return None
    # Median, and its error 1.25 σ/√n.
    median = np.median(offset, axis=0)
    error = 1.25 * robust_scatter(offset) / np.sqrt(len(offset))
    for origin in (0, 1):
        if (np.abs(median + origin) < TOLERANCE_PX).all() and (error < TOLERANCE_PX / 2).all():
            return origin, median, len(offset)
    return None
