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
        light = np.empty((len(place), 3, side_px, side_px))
        # Few stars at a time: 16 values of four splines for every pixel.
        step = max(1, 2**17 // side_px**2)
        for part in (slice(a, a + step) for a in range(0, len(place), step)):
            light[part] = self._stamps(place[part], corner[part], side_px)
        return light

    def _stamps(self, place: np.ndarray, corner: np.ndarray, side_px: int) -> np.ndarray:
        """As `stamps`, of a few stars."""
        count, size = len(place), self.splines.shape[-1]
        # Knots u = o (pixel − centre) + m//2 of the first pixel, along x and y.
        first = self.oversampling * (corner - place) + self.psfs.shape[-1] // 2
        knot = np.floor(first).astype(int)
        weights, slopes = _cubic(first - knot)
        # The four coefficients around each pixel along either axis: (n, side · 4).
        pixel = self.oversampling * np.arange(side_px)
        index = (knot[..., None, None] + 2) + pixel[:, None] + np.arange(-1, 3)
        inside = (index[..., 1] >= 2) & (index[..., 1] + (first > knot)[..., None] <= size - 3)
        index = np.clip(index, 0, size - 1).reshape(count, 2, -1)
        flat = index[:, 1, :, None] * size + index[:, 0, None, :]
        # The spline at the place of each star: the bilinear mean of four.
        node, share = self._nodes(place)
        values = np.zeros(flat.shape)
        for which in range(4):
            offset = flat + (node[:, which] * size**2)[:, None, None]
            values += share[:, which, None, None] * self.splines.ravel().take(offset)
        values = values.reshape(count, -1, side_px, 4)
        # Σ over the four coefficients along x, then along y.
        along_x = np.stack(
            [np.einsum("nvsk,nk->nvs", values, kernel[:, 0]) for kernel in (weights, slopes)],
            axis=1,
        ).reshape(count, 2, side_px, 4, side_px)
        light = np.empty((count, 3, side_px, side_px))
        light[:, :2] = np.einsum("npskt,nk->npst", along_x, weights[:, 1])
        light[:, 2] = np.einsum("nskt,nk->nst", along_x[:, 0], slopes[:, 1])
        # A star that moves by a pixel moves by −o knots under its pixels.
        light[:, 1:] *= -self.oversampling
        light *= (inside[:, 1, :, None] & inside[:, 0, None, :])[:, None]
        return light

    def _nodes(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (n, 4) of the nodes around each place, and their shares in the PSF there."""
        axes = []
        for nodes, value in ((self.columns, place[:, 0]), (self.rows, place[:, 1])):
            before = np.clip(np.searchsorted(nodes, value) - 1, 0, max(len(nodes) - 2, 0))
            after = np.minimum(before + 1, len(nodes) - 1)
            width = np.maximum(nodes[after] - nodes[before], 1.0)
            # Beyond the grid the PSF is that at its edge.
            part = np.clip((value - nodes[before]) / width, 0.0, 1.0)
            axes.append((np.stack([before, after]), np.stack([1.0 - part, part])))
        (column, across), (row, down) = axes
        number = row[:, None] * len(self.columns) + column[None]
        share = down[:, None] * across[None]
        return number.reshape(4, -1).T, share.reshape(4, -1).T


def _cubic(part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (…, 4) of cubic B-splines at a part of the way between two knots, and slopes."""
    t, left = part[..., None], 1.0 - part[..., None]
    weights = [left**3, 3 * t**3 - 6 * t**2 + 4, 3 * left**3 - 6 * left**2 + 4, t**3]
    slopes = [-(left**2), 3 * t**2 - 4 * t, 4 * left - 3 * left**2, t**2]
    return np.concatenate(weights, axis=-1) / 6.0, np.concatenate(slopes, axis=-1) / 2.0
