"""Stamps cut out of an image around the positions of stars."""

from __future__ import annotations

from typing import Any

import numpy as np

FAR = 2**30
"""Positions are clipped to ± this many pixels, far off any image."""


def central_pixel(position: np.ndarray) -> np.ndarray:
    """The pixel in which a 0-based position lies, int64; −`FAR` where it is NaN.

    Pixel k covers k − ½ ≤ position < k + ½.
    """
    rounded = np.floor(np.nan_to_num(position, nan=-FAR, posinf=FAR, neginf=-FAR) + 0.5)
    return np.clip(rounded, -FAR, FAR).astype(np.int64)


def on_image(x: np.ndarray, y: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Whether the pixel of a star is a pixel of the image, bool, shape (n,)."""
    column, row = central_pixel(x), central_pixel(y)
    return (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])


def cut_stamps(
    pixels: Any, shape: tuple[int, int], x: np.ndarray, y: np.ndarray, stamp_px: int, margin: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a stamp around each star, with the star's pixel at index (d/2, d/2) + margin.

    Parameters
    ----------
    pixels : array-like (h, w), indexed once with arrays of rows and columns
    shape : (h, w)
    x, y : ndarray, shape (n,)
        0-based positions; NaN is off the image.
    stamp_px : int
        d; for odd d the index is (d − 1)/2.
    margin : int
        Pixels added on every side.

    Returns
    -------
    stamps : ndarray, shape (n, d + 2·margin, d + 2·margin)
        0 off the image.
    inside : ndarray of bool, the same shape
        Whether a pixel is on the image.
    truncated : ndarray of bool, shape (n,)
        Part of the d × d stamp, without margin, is off the image.
    """
    side = np.arange(stamp_px + 2 * margin) - stamp_px // 2 - margin
    rows = central_pixel(y)[:, None] + side
    columns = central_pixel(x)[:, None] + side
    row_inside = (rows >= 0) & (rows < shape[0])
    column_inside = (columns >= 0) & (columns < shape[1])
    stamps = pixels[
        np.clip(rows, 0, shape[0] - 1)[:, :, None], np.clip(columns, 0, shape[1] - 1)[:, None, :]
    ]
    inside = row_inside[:, :, None] & column_inside[:, None, :]
    stamp = slice(margin, margin + stamp_px)
    truncated = ~(row_inside[:, stamp].all(axis=1) & column_inside[:, stamp].all(axis=1))
    if not inside.all():
        stamps = np.where(inside, stamps, 0)
    return stamps, inside, truncated
