"""Scene 1: a wide-field telescope with field-dependent Seidel aberrations."""

from __future__ import annotations

from typing import Any

import numpy as np

from psfdae.configuration.schema import Grid
from psfdae.files import Column
from psfdae.optics.pupil import Pupil
from psfdae.optics.seidel import gradient_ranges, monomial_coefficients, monomial_images
from psfdae.rng import stream
from psfdae.stars.fields import perturb_seidel, square_grid


class SeidelWavefronts:
    """Seidel wavefronts, one per row of coefficients, on any pupil grid.

    Parameters
    ----------
    seidel : ndarray, shape (B, 5)
        Coefficients in waves in the order of `SEIDEL_TERMS`.
    field : ndarray, shape (B, 2)
        Relative field vector (h_x, h_y).
    """

    def __init__(self, seidel: np.ndarray, field: np.ndarray) -> None:
        self.seidel = seidel
        self.coefficients = monomial_coefficients(seidel, field)
        self._basis: dict[tuple[int, str], np.ndarray] = {}

    def __len__(self) -> int:
        return len(self.coefficients)

    def columns(self) -> dict[str, Column]:
        """The coefficients as the product "stars" keeps them."""
        return {"seidel": Column(self.seidel, "wave", "W040, W131, W222, W220, W311 at H = 1")}

    def slopes(self) -> np.ndarray:
        """Extreme slopes, shape (B, 2, 2); see `gradient_ranges`."""
        return gradient_ranges(self.coefficients)

    def opd(self, index: np.ndarray, pupil: Pupil, dtype: np.dtype) -> np.ndarray:
        """OPD in waves of the wavefronts `index`, shape (b, M, M)."""
        key = (pupil.axis.size, np.dtype(dtype).str)
        if key not in self._basis:
            images = monomial_images(pupil.axis[None, :], pupil.axis[:, None])
            self._basis[key] = images.reshape(len(images), -1).astype(dtype)
        basis = self._basis[key]
        size = pupil.axis.size
        return (self.coefficients[index].astype(dtype) @ basis).reshape(-1, size, size)


def relative_field(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """Field points of the scene.

    Returns
    -------
    index : ndarray of int, shape (F, 2)
        Grid index (ix, iy).
    field : ndarray, shape (F, 2)
        (h_x, h_y), 1 at the edge of the field on an axis.
    """
    index, angle_deg = square_grid(grid.points, grid.spacing_deg)
    return index, angle_deg / grid.edge_deg


def template_wavefronts(config: Any) -> SeidelWavefronts:
    """Static wavefronts of all fields; `config` holds `grid` and `wavefront`."""
    _, field = relative_field(config.grid)
    return SeidelWavefronts(np.tile(config.wavefront.coefficients, (len(field), 1)), field)


def star_wavefronts(config: Any, star_field: np.ndarray) -> SeidelWavefronts:
    """Wavefronts of stars with random aberrations.

    Parameters
    ----------
    config : stage config with `seed`, `grid`, `wavefront` and `stars`
    star_field : ndarray of int, shape (n,)
        Field of every star.
    """
    _, field = relative_field(config.grid)
    rng = stream(config.seed, "aberration", config.stars.name)
    seidel = perturb_seidel(
        config.wavefront.coefficients, config.stars.aberration_fraction, len(star_field), rng
    )
    return SeidelWavefronts(seidel, field[star_field])
