"""The PSFs of a field as splines at the nodes of a grid, and the light of many stars from these.

A PSF between nodes is the bilinear interpolation of the four around it. Each is a bicubic spline
through values that are `oversampling` to the pixel, so that the pixels of a stamp all lie at the
same phase between its knots: a stamp takes one set of 4 × 4 weights (de Boor 1978, A practical
guide to splines), and its derivatives by the position of the star take another.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from psfdae.model.field_psfs import FieldPsfs


@dataclass(frozen=True)
class PsfGrid:
    """Splines of the PSFs of a field.

    Attributes
    ----------
    columns, rows : ndarray, shape (c,) and (r,)
        Of the nodes, in pixels of the image, ascending.
    psfs : ndarray, shape (r, c, m, m)
        Values of each PSF; index m//2 is its centre.
    oversampling : int
        Values per pixel and axis.
    """

    columns: np.ndarray
    rows: np.ndarray
    psfs: np.ndarray
    oversampling: int

    @classmethod
    def of(cls, model: FieldPsfs, nodes: int = 9, oversampling: int = 4) -> PsfGrid:
        """PSFs of a model at `nodes` × `nodes` places over the field of its training stars.

        Raises
        ------
        PredictionError
            If the model knows no PSF of a place.
        """
        x, y = np.rint(model.grid(nodes, nodes)).T
        psfs = model.psf_at(x, y, oversampling)
        # An even stamp has no middle value; with a row and a column of zeros it has.
        psfs = np.pad(psfs, ((0, 0), *[(0, 1 - psfs.shape[-1] % 2)] * 2))
        return cls(x[:nodes], y[::nodes], psfs.reshape(nodes, nodes, *psfs.shape[1:]), oversampling)

    @cached_property
    def splines(self) -> np.ndarray:
        """Coefficients (r · c, m + 4, m + 4) of the splines, mirrored by two at each edge."""
        from scipy.ndimage import spline_filter

        psfs = self.psfs.reshape(-1, *self.psfs.shape[2:])
        return np.stack([np.pad(spline_filter(psf), 2, mode="reflect") for psf in psfs])

    @property
    def side_px(self) -> int:
        """Side of the stamps that hold all light of a PSF wherever its star is in a pixel, odd."""
        return 2 * int(self.psfs.shape[-1] // 2 // self.oversampling + 1) + 1

    def stamps(self, place: np.ndarray, corner: np.ndarray, side_px: int) -> np.ndarray:
        """Light of stars of flux 1 in stamps of the image, and its derivatives.

        Parameters
        ----------
        place : ndarray, shape (n, 2)
            Centres of the stars, x and y, 0-based pixels of the image, finite.
        corner : ndarray of int, shape (n, 2)
            Column and row of the first pixel of each stamp.
        side_px : int

        Returns
        -------
        ndarray, shape (n, 3, side_px, side_px)
            The light, and its derivatives by x and y per pixel; that the PSF changes over the
            field is not in these. 0 beyond the PSF's edge.
        """
        light = np.zeros((len(place), 3, side_px, side_px))
        # Splines with room for stamps that reach beyond them, in which there is no light.
        room = side_px * self.oversampling + 4
        splines = np.pad(self.splines, ((0, 0), *[(room, room)] * 2))
        # Knots u = o (pixel − centre) + m//2 of the first pixel, along x and y.
        size = self.psfs.shape[-1]
        first = self.oversampling * (corner - place) + size // 2
        knot = np.floor(first).astype(int)
        pixel = knot[..., None] + self.oversampling * np.arange(side_px)
        inside = (pixel >= 0) & (pixel + (first > knot)[..., None] <= size - 1)
        lit = np.flatnonzero(inside.any(axis=2).all(axis=1))
        node, share = self._nodes(place)
        weights, slopes = _cubic(first - knot)
        span = self.oversampling * (side_px - 1) + 1
        # Few stars at a time: some 20 values of a spline for every pixel.
        for rows in np.array_split(lit, len(lit) * side_px**2 // 2**17 + 1):
            begin = knot[rows] + room + 1
            squares = self._squares(splines, node[rows], share[rows], begin, span + 3)
            # Σ over the four coefficients around each pixel, along x, then along y.
            taps = [slice(t, t + span, self.oversampling) for t in range(4)]
            smooth, steep = (
                sum(
                    kernel[rows, 0, t, None, None] * squares[:, :, tap]
                    for t, tap in enumerate(taps)
                )
                for kernel in (weights, slopes)
            )
            for derivative, (values, kernel) in enumerate(
                ((smooth, weights), (steep, weights), (smooth, slopes))
            ):
                light[rows, derivative] = sum(
                    kernel[rows, 1, t, None, None] * values[:, tap] for t, tap in enumerate(taps)
                )
        # A star that moves by a pixel moves by −o knots under its pixels.
        light[:, 1:] *= -self.oversampling
        light *= (inside[:, 1, :, None] & inside[:, 0, None, :])[:, None]
        return light

    @staticmethod
    def _squares(
        splines: np.ndarray, node: np.ndarray, share: np.ndarray, begin: np.ndarray, side: int
    ) -> np.ndarray:
        """Coefficients (n, s, s) of the splines at the places of stars, from their first pixel on.

        They are the means, by shares (n, 4), of the splines of four nodes (n, 4).
        """
        squares = np.empty((len(node), side, side))
        for star, (column, row) in enumerate(begin.tolist()):
            square = np.s_[row : row + side, column : column + side]
            squares[star] = share[star, 0] * splines[node[star, 0]][square]
            for corner in range(1, 4):
                squares[star] += share[star, corner] * splines[node[star, corner]][square]
        return squares

    def _nodes(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (n, 4) of the nodes around each place, and their shares in the PSF there."""
        axes = []
        for nodes, value in ((self.columns, place[:, 0]), (self.rows, place[:, 1])):
            lower = np.clip(np.searchsorted(nodes, value) - 1, 0, max(len(nodes) - 2, 0))
            upper = np.minimum(lower + 1, len(nodes) - 1)
            width = np.maximum(nodes[upper] - nodes[lower], 1.0)
            # Beyond the grid the PSF is that at its edge.
            part = np.clip((value - nodes[lower]) / width, 0.0, 1.0)
            axes.append((np.stack([lower, upper]), np.stack([1.0 - part, part])))
        (column, across), (row, down) = axes
        number = row[:, None] * len(self.columns) + column[None]
        share = down[:, None] * across[None]
        return number.reshape(4, -1).T, share.reshape(4, -1).T


def _cubic(part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (…, 4) of cubic B-splines at a part of the way between two knots, and slopes."""
    t, remainder = part[..., None], 1.0 - part[..., None]
    weights = [remainder**3, 3 * t**3 - 6 * t**2 + 4, 3 * remainder**3 - 6 * remainder**2 + 4, t**3]
    slopes = [-(remainder**2), 3 * t**2 - 4 * t, 4 * remainder - 3 * remainder**2, t**2]
    return np.concatenate(weights, axis=-1) / 6.0, np.concatenate(slopes, axis=-1) / 2.0
