"""A field of PSFs as photutils takes it, for fits of many stars."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import ClassVar, Self

import numpy as np
from astropy.nddata import NDData
from photutils.psf import GriddedPSFModel
from scipy.ndimage import map_coordinates, spline_filter

from psfdae.field_psf import SLOPE_PX

KEPT, KEPT_PX = 256, 4096
"""Places of stars whose light is kept, those last asked for, and the most pixels that it has."""


class FieldGrid(GriddedPSFModel):  # type: ignore[misc]
    """PSFs at the nodes of a grid, and between them by bilinear interpolation.

    What photutils' own class interpolates from the splines of four PSFs, one after the other, is
    read here from one spline: interpolation is linear, so that the coefficients can be averaged
    first. A fit of a group asks for the light of all of its stars each time that one of them moves
    or changes its flux; that of the others is kept.
    """

    columns: ClassVar[Sequence[float]]
    rows: ClassVar[Sequence[float]]
    splines: ClassVar[np.ndarray]
    kept: Callable[[float, float, bytes, bytes], np.ndarray]

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
        grid.kept = lru_cache(KEPT)(grid._light)  # by its copies, too
        return grid

    # Without annotations, which astropy would take for units.
    def evaluate(self, x, y, flux, x_0, y_0):  # type: ignore[no-untyped-def]
        """Light of a star in pixels x, y of any shape; 0 beyond the PSF's edge."""
        x, y = (np.asarray(pixels, dtype=float) for pixels in (x, y))
        find = self._light if x.size > KEPT_PX else self.kept
        return flux * find(_number(x_0), _number(y_0), x.tobytes(), y.tobytes()).reshape(x.shape)

    def fit_deriv(self, x, y, flux, x_0, y_0):  # type: ignore[no-untyped-def]
        """Derivatives of the light in pixels x, y by flux, x_0 and y_0.

        That the PSF changes slowly over the grid is not in them.
        """
        x_0, y_0 = _number(x_0), _number(y_0)
        off = np.stack([np.asarray(x, dtype=float) - x_0, np.asarray(y, dtype=float) - y_0])
        steps = SLOPE_PX * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=float)
        moved = off[:, None] + steps.T.reshape(2, -1, *(1,) * np.ndim(x))
        light, right, left, up, down = self._read(self._spline(x_0, y_0), *moved)
        slope = flux / (2 * SLOPE_PX)
        return [light, slope * (left - right), slope * (down - up)]

    def _light(self, x_0: float, y_0: float, x: bytes, y: bytes) -> np.ndarray:
        """Light of a star of flux 1 in pixels, which are the bytes of float64."""
        return self._read(self._spline(x_0, y_0), np.frombuffer(x) - x_0, np.frombuffer(y) - y_0)

    def _spline(self, x_0: float, y_0: float) -> np.ndarray:
        """Coefficients of the PSF at a place."""
        (row, down), (column, across) = _between(self.rows, y_0), _between(self.columns, x_0)
        near = self.splines[row : row + 2, column : column + 2].reshape(-1, self.splines.shape[-1])
        weights = np.outer([1.0 - down, down], [1.0 - across, across]).ravel()
        return np.asarray((weights @ near).reshape(self.data.shape[1:]))

    def _read(self, spline: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
        """Values at distances from the star, in pixels."""
        where = np.stack(
            [
                self.oversampling[0] * down + self.origin[1],
                self.oversampling[1] * across + self.origin[0],
            ]
        )
        return np.asarray(map_coordinates(spline, where, prefilter=False, mode="constant"))


def _number(value: float | np.ndarray) -> float:
    """A number, or the only one of an array, which photutils gives, too."""
    return float(np.ravel(value)[0])


def _between(nodes: Sequence[float], place: float) -> tuple[int, float]:
    """The node before a place on an axis, and the part of the way to the next one."""
    node = min(max(bisect_left(nodes, place) - 1, 0), len(nodes) - 2)
    part = (place - nodes[node]) / ((nodes[node + 1] - nodes[node]) or 1.0)
    return node, min(max(part, 0.0), 1.0)
