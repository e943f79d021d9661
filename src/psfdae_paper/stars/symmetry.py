"""The eight mirror images and rotations of a square, and how they move a framed image.

A rotationally symmetric telescope gives, at a mirrored field point, the mirrored
image. One propagated star therefore represents eight: its image, transposed and
flipped, is the star of the same coefficients at the field transposed and flipped.
Only the frame does not follow. The brightest pixel belongs at index d/2 of an even
stamp, and a flip takes index d/2 to d/2 − 1, so a flipped stamp is cut one pixel
farther; and of two equally bright pixels the first in (row, column) order is
framed, before and after a flip.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np


@dataclass(frozen=True)
class Symmetry:
    """Exchange of rows and columns, then flips of either axis.

    Rows run along the field angle y, columns along x, so the same operation moves
    images and field points.
    """

    transpose: bool
    flip_rows: bool
    flip_columns: bool

    def image(self, stamps: np.ndarray) -> np.ndarray:
        """Move images, shape (..., h, h)."""
        return self._flip(stamps.swapaxes(-1, -2) if self.transpose else stamps)

    def undo(self, stamps: np.ndarray) -> np.ndarray:
        """Take `image` back, shape (..., h, h)."""
        stamps = self._flip(stamps)
        return stamps.swapaxes(-1, -2) if self.transpose else stamps

    @property
    def matrix(self) -> np.ndarray:
        """Matrix that moves field vectors (x, y), shape (2, 2)."""
        exchange = np.eye(2)[::-1] if self.transpose else np.eye(2)
        return np.diag([1 - 2 * self.flip_columns, 1 - 2 * self.flip_rows]) @ exchange

    def pixel(self, index: np.ndarray) -> np.ndarray:
        """Move pixels (row, column) counted from the chief ray, shape (..., 2).

        Pixel j spans j … j + 1, so its mirror image is −1 − j.
        """
        index = index[..., ::-1] if self.transpose else index
        return np.where([self.flip_rows, self.flip_columns], -1 - index, index)

    def field(self, index: np.ndarray, points: int) -> np.ndarray:
        """Move field points, numbered ix + P·iy on a grid of `points` = P a side.

        The grid is centred, so a flip takes index i to P − 1 − i.
        """
        iy, ix = np.divmod(index, points)
        if self.transpose:
            iy, ix = ix, iy
        iy = points - 1 - iy if self.flip_rows else iy
        ix = points - 1 - ix if self.flip_columns else ix
        return np.asarray(ix + points * iy)

    def window(self, jitter: tuple[int, int], margin: int) -> tuple[int, int]:
        """Return the first row and column to cut from an image with a margin around the stamp.

        The brightest pixel of the image is at (d/2, d/2) + `margin`. In the d × d pixels from
        the returned corner, moved by `image`, it is at (d/2, d/2) + `jitter`; |jitter| must be
        below `margin`.
        """
        flips = (self.flip_rows, self.flip_columns)
        # A flip takes index d/2 of an even stamp to d/2 − 1, and the jitter changes its sign.
        start = [
            margin + 1 + shift if flip else margin - shift
            for shift, flip in zip(jitter, flips, strict=True)
        ]
        return (start[1], start[0]) if self.transpose else (start[0], start[1])

    def _flip(self, stamps: np.ndarray) -> np.ndarray:
        """Mirror images (..., h, h) along the axes that this symmetry flips."""
        if self.flip_rows:
            stamps = stamps[..., ::-1, :]
        return stamps[..., ::-1] if self.flip_columns else stamps


SYMMETRIES = tuple(Symmetry(*flags) for flags in product((False, True), repeat=3))
"""The eight symmetries of a square, the identity first."""


def orbit(field: np.ndarray, points: int) -> np.ndarray:
    """Return the lowest of the fields to which symmetries take each: a name of their orbit."""
    return np.asarray(np.min([symmetry.field(field, points) for symmetry in SYMMETRIES], axis=0))
