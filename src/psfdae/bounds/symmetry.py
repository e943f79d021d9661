"""The eight mirror images and rotations of a square field, and how they move a frame.

A rotationally symmetric telescope gives, at a mirrored field point, the mirrored
image. One propagated star therefore stands for eight: its image, transposed and
flipped, is the star of the same coefficients at the field transposed and flipped.
Only the frame does not follow. The brightest pixel belongs at index d/2 of an even
stamp, and a flip takes index d/2 to d/2 − 1, so a flipped stamp is cut one pixel
farther; and of two equally bright pixels the first in (row, column) order is
framed, before and after a flip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Symmetry:
    """Exchange of rows and columns, then flips of either axis.

    Rows run along the field angle y, columns along x, so the same operation moves
    images and field points.

    Attributes
    ----------
    transpose, flip_rows, flip_columns : bool
    """

    transpose: bool
    flip_rows: bool
    flip_columns: bool

    def image(self, stamps: np.ndarray) -> np.ndarray:
        """Move images, shape (..., h, h)."""
        if self.transpose:
            stamps = stamps.swapaxes(-1, -2)
        return self._flip(stamps)

    def undo(self, stamps: np.ndarray) -> np.ndarray:
        """Take `image` back, shape (..., h, h)."""
        stamps = self._flip(stamps)
        return stamps.swapaxes(-1, -2) if self.transpose else stamps

    def pixel(self, index: np.ndarray) -> np.ndarray:
        """Move pixels (row, column) counted from the chief ray, shape (..., 2).

        Pixel j spans j … j + 1, so its mirror image is −1 − j.
        """
        index = index[..., ::-1] if self.transpose else index
        return np.where([self.flip_rows, self.flip_columns], -1 - index, index)

    def field(self, index: np.ndarray, points: int) -> np.ndarray:
        """Move field points, numbered ix + P·iy on a grid of `points` = P a side."""
        iy, ix = np.divmod(index, points)
        if self.transpose:
            iy, ix = ix, iy
        iy = points - 1 - iy if self.flip_rows else iy
        ix = points - 1 - ix if self.flip_columns else ix
        return ix + points * iy

    def window(self, jitter: tuple[int, int], margin: int) -> tuple[int, int]:
        """First row and column to cut from the unmoved image.

        Parameters
        ----------
        jitter : (row, column) of the moved stamp
        margin : int
            The unmoved image has d + 2·`margin` pixels a side and its brightest one
            at index d/2 + `margin`; |jitter| must be below `margin`.

        Returns
        -------
        (row, column)
            The d × d pixels from there, moved by `image`, have the brightest pixel
            at (d/2, d/2) + `jitter`.
        """
        flips = (self.flip_rows, self.flip_columns)
        start = [
            margin + 1 + shift if flip else margin - shift
            for shift, flip in zip(jitter, flips, strict=True)
        ]
        return (start[1], start[0]) if self.transpose else (start[0], start[1])

    def _flip(self, stamps: np.ndarray) -> np.ndarray:
        if self.flip_rows:
            stamps = stamps[..., ::-1, :]
        return stamps[..., ::-1] if self.flip_columns else stamps


SYMMETRIES = tuple(
    Symmetry(transpose, rows, columns)
    for transpose in (False, True)
    for rows in (False, True)
    for columns in (False, True)
)
"""All eight, the identity first."""


def weights(field: np.ndarray, peak: np.ndarray, points: int) -> np.ndarray:
    """How often each symmetry of each star counts so that all fields stay equally likely.

    At a field point on a mirror axis two symmetries (in the centre all eight) lead
    to the same star, with its equal maxima exchanged. Only the one that frames the
    first maximum in (row, column) order is right; it counts for all of them.

    Parameters
    ----------
    field : ndarray of int, shape (M,)
        Field of every star, ix + P·iy.
    peak : ndarray of int, shape (M, 2)
        The star's framed pixel (row, column) from the chief ray.
    points : int
        Field points P along a side.

    Returns
    -------
    ndarray of int, shape (M, 8)
        Zero, or the number of symmetries that lead to the same field; rows sum to 8.
    """
    target = np.stack([s.field(field, points) for s in SYMMETRIES], axis=1)
    pixel = np.stack([s.pixel(peak) for s in SYMMETRIES], axis=1)
    reach = 2 * int(np.abs(peak).max()) + 3
    order = (pixel[..., 0] * reach + pixel[..., 1]) * len(SYMMETRIES) + np.arange(len(SYMMETRIES))
    same = target[:, :, None] == target[:, None, :]
    first = np.where(same, order[:, None, :], np.iinfo(order.dtype).max).min(axis=2)
    return np.where(order == first, same.sum(axis=2), 0)
