"""The origin of a list's pixels, 0 or 1, by the stars themselves."""

from __future__ import annotations

import numpy as np

from psfdae.image.detection import Sky
from psfdae.moments import windowed_centres

TOLERANCE_PX = 0.1  # of the median offset, per axis, from that of an origin
FEWEST = 8  # stars


def origin_of(sky: Sky, listed: np.ndarray) -> tuple[int, np.ndarray, int] | None:
    """Return whether positions count from 0 or 1, where the stars of an image say it clearly.

    The centroids of the brighter stars lie at the positions of the list, less its origin; both
    axes must agree within 0.1 px, and so must their standard errors.

    Parameters
    ----------
    sky : Sky
        The image without its sky.
    listed : ndarray, shape (n, 2)
        Positions x, y as the list has them.

    Returns
    -------
    origin : int
    offset : ndarray, shape (2,)
        Median of centroid − listed position, x and y in px.
    count : int
        Stars that say it.
    """
    height, width = sky.flat.shape
    # Halfway between both origins, so that neither is nearer to the start.
    middle = listed - 0.5
    pixel = np.floor(np.nan_to_num(middle, nan=-1e9) + 0.5).astype(int)
    reach = 6
    inside = (pixel >= reach).all(axis=1) & (pixel < np.array([width, height]) - reach).all(axis=1)
    pixel, listed = pixel[inside], listed[inside]
    if len(listed) < FEWEST:
        return None
    axis = np.arange(-reach, reach + 1)
    rows, columns = pixel[:, 1, None, None] + axis[:, None], pixel[:, 0, None, None] + axis
    stamps, noise = sky.flat[rows, columns], sky.noise[rows, columns]
    core = slice(reach - 2, reach + 3)
    # Stars whose inner 5 × 5 pixels stand 20 σ above the sky, the brightest 500 of them.
    snr = stamps[:, core, core].sum(axis=(1, 2)) / (5 * np.median(noise, axis=(1, 2)))
    complete = ~sky.bad[rows, columns][:, core, core].any(axis=(1, 2))
    star = np.flatnonzero(complete & (snr > 20))
    star = star[np.argsort(-snr[star])][:500]
    if len(star) < FEWEST:
        return None
    start = np.full((len(star), 2), 0.0)
    centre = windowed_centres(stamps[star], start, np.full(len(star), 1.5), 10, 2.0)[:, ::-1]
    off = pixel[star] + centre - listed[star]
    off = off[(np.abs(centre) < 1.9).all(axis=1)]
    if len(off) < FEWEST:
        return None
    median = np.median(off, axis=0)
    error = 1.25 * 1.48 * np.median(np.abs(off - median), axis=0) / np.sqrt(len(off))
    for origin in (0, 1):
        if (np.abs(median + origin) < TOLERANCE_PX).all() and (error < TOLERANCE_PX / 2).all():
            return origin, median, len(off)
    return None
