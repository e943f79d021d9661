"""Centring of stamps to the convention of the training: brightest pixel near (d/2, d/2).

The training moves stars by up to `jitter_px` whole pixels, so only a star beyond
that is moved. Noise must not move a star, nor may the second peak of an aberrated
one: the brightest pixel counts as elsewhere only if the smoothed stamp has its
maximum there as well, and well above all of the middle.
"""

from __future__ import annotations

import numpy as np

from psfdae.prediction.border import border_scatter

SIGNIFICANCE = 5.0
"""Least excess of a peak elsewhere over the middle, in σ of their difference."""

SMOOTHED_NOISE = 0.53
"""σ of the difference of two pixels of the smoothed stamp, in σ of a pixel: √2 · (6/16)."""


def smoothed(stamps: np.ndarray) -> np.ndarray:
    """Stamps (n, s, s) convolved with [1, 2, 1]/4 along both axes; edge pixels repeated."""
    wide = np.pad(stamps, ((0, 0), (1, 1), (1, 1)), mode="edge")
    rows = wide[:, :-2] + 2 * wide[:, 1:-1] + wide[:, 2:]
    return (rows[:, :, :-2] + 2 * rows[:, :, 1:-1] + rows[:, :, 2:]) / 16


def displacement(stamps: np.ndarray, jitter_px: int) -> np.ndarray:
    """How far each star lies off the place where the training would have put it.

    Parameters
    ----------
    stamps : ndarray, shape (n, s, s)
        s even; bad pixels at the sky level. The sky need not be subtracted.
    jitter_px : int
        Distance (per axis) that the training covers.

    Returns
    -------
    ndarray of int, shape (n, 2)
        (row, column) of the brightest pixel from (s/2, s/2); 0 for stars that lie
        within `jitter_px`, or of which that cannot be said.
    """
    middle = stamps.shape[-1] // 2
    near = slice(middle - jitter_px, middle + jitter_px + 1)
    smooth = smoothed(stamps)
    brightest, second = (_peak(images) - middle for images in (stamps, smooth))
    outside = np.abs(brightest).max(axis=1) > jitter_px
    star = np.flatnonzero(outside & (np.abs(brightest - second).max(axis=1) <= 1))
    out = np.zeros((len(stamps), 2), dtype=np.int16)
    if not star.size:
        return out
    excess = smooth[star].max(axis=(1, 2)) - smooth[star, near, near].max(axis=(1, 2))
    sure = excess > SIGNIFICANCE * SMOOTHED_NOISE * border_scatter(stamps[star])
    out[star[sure]] = brightest[star[sure]]
    return out


def _peak(images: np.ndarray) -> np.ndarray:
    flat = images.reshape(len(images), -1).argmax(axis=1)
    return np.stack(np.divmod(flat, images.shape[-1]), axis=1)


def recut(wide: np.ndarray, shift: np.ndarray, stamp_px: int) -> np.ndarray:
    """Cut (n, d, d) out of wider stamps (n, s, s).

    Parameters
    ----------
    wide : ndarray, shape (n, s, s)
        s − d even.
    shift : ndarray of int, shape (n, 2)
        (row, column) by which the middle moves, at most (s − d)/2.
    stamp_px : int
        Side d.
    """
    margin = (wide.shape[-1] - stamp_px) // 2
    inner = slice(margin, margin + stamp_px)
    cut = wide[:, inner, inner]
    star = np.flatnonzero(shift.any(axis=1))
    if star.size:
        cut = cut.copy()
        pixels = margin + np.arange(stamp_px)
        rows, columns = shift[star, :1] + pixels, shift[star, 1:] + pixels
        cut[star] = wide[star[:, None, None], rows[:, :, None], columns[:, None, :]]
    return cut
