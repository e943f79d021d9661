"""Wavefronts that are sums of Zernike polynomials, and their random aberrations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from psfdae.files import Column
from psfdae.optics.field_zernikes import slope_ranges, zernike_images
from psfdae.optics.pupil import Pupil


class ZernikeWavefronts:
    """Zernike wavefronts, one per row of coefficients, on any pupil grid.

    Parameters
    ----------
    noll : sequence of int, length J
        Noll indices of the terms.
    coefficients : ndarray, shape (B, J)
        OPD in waves RMS.
    """

    def __init__(self, noll: Sequence[int], coefficients: np.ndarray) -> None:
        self.noll = tuple(noll)
        self.coefficients = coefficients
        self._basis: dict[tuple[int, str], np.ndarray] = {}

    def __len__(self) -> int:
        return len(self.coefficients)

    def columns(self) -> dict[str, Column]:
        """The coefficients as the product "stars" keeps them."""
        about = f"Noll coefficients j = {', '.join(map(str, self.noll))}"
        return {"zernike": Column(self.coefficients, "wave", about)}

    def slopes(self) -> np.ndarray:
        """Extreme slopes, shape (B, 2, 2); see `slope_ranges`."""
        return slope_ranges(self.noll, self.coefficients)

    def opd(self, index: np.ndarray, pupil: Pupil, dtype: np.dtype) -> np.ndarray:
        """OPD in waves of the wavefronts `index`, shape (b, M, M)."""
        key = (pupil.axis.size, np.dtype(dtype).str)
        if key not in self._basis:
            images = zernike_images(self.noll, pupil.axis[None, :], pupil.axis[:, None])
            self._basis[key] = images.reshape(len(images), -1).astype(dtype)
        size = pupil.axis.size
        maps = self.coefficients[index].astype(dtype) @ self._basis[key]
        return maps.reshape(-1, size, size)


def perturb_terms(
    coefficients: np.ndarray,
    fraction: float,
    jitter_waves: float,
    factors: np.random.Generator,
    shifts: np.random.Generator,
) -> np.ndarray:
    """Random aberrations: every coefficient times (1 + fraction · N(0, 1)) + jitter · N(0, 1).

    All draws are independent. The first kind is that of the paper's scene 1; the
    second also moves terms that vanish, such as focus on the optical axis.

    Parameters
    ----------
    coefficients : ndarray, shape (n, J)
        Static coefficients of every star in waves.
    fraction : float
        Relative standard deviation, ≥ 0.
    jitter_waves : float
        Standard deviation in waves, ≥ 0.
    factors, shifts : Generator
        Where the two kinds of draws come from.
    """
    perturbed = coefficients * (1.0 + fraction * factors.standard_normal(coefficients.shape))
    if jitter_waves:
        perturbed = perturbed + jitter_waves * shifts.standard_normal(coefficients.shape)
    return perturbed
