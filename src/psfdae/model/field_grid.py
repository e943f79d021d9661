"""A field of PSFs as photutils takes it, for fits of many stars."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from typing import ClassVar, Self

import numpy as np
from astropy.nddata import NDData
from photutils.psf import GriddedPSFModel
from scipy.ndimage import map_coordinates, spline_filter


class FieldGrid(GriddedPSFModel):  # type: ignore[misc]
    """PSFs at the nodes of a grid, and between them by bilinear interpolation.

    What photutils' own class interpolates from the splines of four PSFs, one after the other, is
    read here from one spline: interpolation is linear, so that the coefficients can be averaged
    first.
    """

    columns: ClassVar[Sequence[float]]
    rows: ClassVar[Sequence[float]]
    splines: ClassVar[np.ndarray]

    @classmethod
    def of(
        cls, name: str, psfs: np.ndarray, x: np.ndarray, y: np.ndarray, oversampling: int
    ) -> Self:
        """The grid of PSFs (rows · columns, m, m) at columns x and rows y, ascending.

        It is of a class of its own, called `name`: photutils 3.0 fits groups with the first model
        of a class.
        """
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        splines = np.stack([spline_filter(psf) for psf in psfs])
        known = {"columns": x.tolist(), "rows": y.tolist()}
        own = type(name, (cls,), known | {"splines": splines.reshape(len(y), len(x), -1)})
        meta = {"grid_xypos": [tuple(place) for place in places], "oversampling": oversampling}
        grid: Self = own(NDData(psfs, meta=meta))
        return grid

    # Without annotations, which astropy would take for units.
    def evaluate(self, x, y, flux, x_0, y_0):  # type: ignore[no-untyped-def]
        """Light of a star in pixels x, y of any shape; 0 beyond the PSF's edge."""
        # photutils gives arrays of one number, too.
        x_0, y_0 = (float(np.ravel(value)[0]) for value in (x_0, y_0))
        (row, down), (column, across) = _between(self.rows, y_0), _between(self.columns, x_0)
        weights = np.outer([1.0 - down, down], [1.0 - across, across]).ravel()
        near = self.splines[row : row + 2, column : column + 2].reshape(weights.size, -1)
        spline = (weights @ near).reshape(self.data.shape[1:])
        across_px, down_px = (
            self.oversampling[0] * (np.asarray(pixels, dtype=float) - middle) + origin
            for pixels, middle, origin in zip((x, y), (x_0, y_0), self.origin, strict=False)
        )
        where = np.stack([down_px, across_px])
        return np.asarray(flux * map_coordinates(spline, where, prefilter=False, mode="constant"))


def _between(nodes: Sequence[float], place: float) -> tuple[int, float]:
    """The node before a place on an axis, and the part of the way to the next one."""
    node = min(max(bisect_left(nodes, place) - 1, 0), len(nodes) - 2)
    part = (place - nodes[node]) / ((nodes[node + 1] - nodes[node]) or 1.0)
    return node, min(max(part, 0.0), 1.0)
