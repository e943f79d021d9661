"""The border of a stamp: where there is most sky and least star."""

from __future__ import annotations

from functools import cache

import numpy as np

PARTS = 8
"""The border is a ring of 1/8 of the stamp's side, at least a pixel, wide."""


@cache
def border_pixels(side: int) -> np.ndarray:
    """Flat indices of the ring of pixels at the edge of a stamp."""
    width = max(1, side // PARTS)
    border = np.ones((side, side), dtype=bool)
    border[width:-width, width:-width] = False
    return np.flatnonzero(border)


def border_median(stamps: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Median of the good pixels in the border of every stamp, shape (n,), float64.

    Of all good pixels where the border has none; 0 where no pixel is good.

    Parameters
    ----------
    stamps : ndarray, shape (n, s, s)
    bad : ndarray of bool, shape (n, s, s)
    """
    size = (len(stamps), stamps.shape[-1] ** 2)
    flat, hidden = stamps.reshape(size), bad.reshape(size)
    ring = border_pixels(stamps.shape[-1])
    median = np.median(flat[:, ring], axis=1).astype(np.float64)
    for star in np.flatnonzero(hidden.any(axis=1)):
        good = flat[star, ring][~hidden[star, ring]]
        good = good if good.size else flat[star][~hidden[star]]
        median[star] = np.median(good) if good.size else 0.0
    return median


def border_scatter(stamps: np.ndarray) -> np.ndarray:
    """σ of the pixels in the border of every stamp from their median deviation, (n,).

    Light of the star in the border is in it.
    """
    side = stamps.shape[-1]
    ring = stamps.reshape(len(stamps), side**2)[:, border_pixels(side)]
    deviation = np.abs(ring - np.median(ring, axis=1, keepdims=True))
    return 1.4826 * np.median(deviation, axis=1).astype(np.float64)
