"""Origin of a list's pixels, 0 or 1, by the stars themselves.

In: an image without its sky and the positions of a list. Out: the origin, if the stars say it.
"""

from __future__ import annotations

import numpy as np

from psfdae.image.detection import Sky
from psfdae.image.stamps import central_pixel, cut_image
from psfdae.moments import robust_scatter, windowed_centres

TOLERANCE_PX = 0.1
"""Greatest difference of a median offset from that of an origin, per axis."""


def origin_of(sky: Sky, listed: np.ndarray, fewest: int = 8) -> tuple[int, np.ndarray, int] | None:
    """Return whether positions count from 0 or 1, where the stars of an image say it clearly.

    The centroids of the brighter stars lie at the positions of the list, less its origin; both
    axes must agree within 0.1 px, and so must their standard errors.

    Parameters
    ----------
    sky : Sky
        The image without its sky.
    listed : ndarray, shape (n, 2)
        Positions x, y as the list has them.
    fewest : int
        Number of stars that are needed.

    Returns
    -------
    origin : int
    offset : ndarray, shape (2,)
        Median of centroid − listed position, x and y in px.
    count : int
        Stars that say it.
    """
    # Stamps of 13 × 13 px, halfway between both origins, so that neither is nearer to the start.
    shape = sky.flat.shape
    x, y = (listed - 0.5).T
    is_cut = cut_image(sky.bad, shape, x, y, 13, 0)[2]
    listed = listed[~is_cut]
    if len(listed) < fewest:
        return None
    x, y = (listed - 0.5).T
    stamps, noise, bad = (
        cut_image(layer, shape, x, y, 13, 0)[0] for layer in (sky.flat, sky.noise, sky.bad)
    )
    # Stars whose inner 5 × 5 pixels are good and stand 20 σ above the sky, the brightest 500.
    core = np.s_[:, 4:9, 4:9]
    snr = stamps[core].sum(axis=(1, 2)) / (5 * np.median(noise, axis=(1, 2)))
    star = np.flatnonzero(~bad[core].any(axis=(1, 2)) & (snr > 20))
    star = star[np.argsort(-snr[star])][:500]
    if len(star) < fewest:
        return None
    # Centroids less positions, of stars that did not run to the end of their reach.
    # A Gaussian window of σ = 1.5 px, within 2 px of the middle.
    window_px = np.full(len(star), 1.5)
    centre = windowed_centres(stamps[star], np.zeros((len(star), 2)), window_px, 10, 2.0)[:, ::-1]
    offset = central_pixel(listed[star] - 0.5) + centre - listed[star]
    offset = offset[(np.abs(centre) < 1.9).all(axis=1)]
    if len(offset) < fewest:
        return None
    # Median, and its error 1.25 σ/√n.
    median = np.median(offset, axis=0)
    error = 1.25 * robust_scatter(offset) / np.sqrt(len(offset))
    for origin in (0, 1):
        if (np.abs(median + origin) < TOLERANCE_PX).all() and (error < TOLERANCE_PX / 2).all():
            return origin, median, len(offset)
    return None
