"""Wavefronts that are sums of modes, on whatever pupil grid.

A mode is the OPD in waves of a unit coefficient: a Seidel monomial, a Zernike
polynomial. Scenes differ in their modes and in how they draw coefficients, no more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Protocol

import numpy as np

from psfdae.optics.pupil import Pupil
from psfdae.optics.seidel import monomial_coefficients, monomial_images
from psfdae.optics.zernike import zernike_images

Modes = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Modes at pupil points (x, y) in pupil radii, shapes (...) to (J, ...)."""

SLOPE_POINTS = 65
"""Points per axis at which slopes are measured."""

SLOPE_BATCH = 256
"""Wavefronts whose slopes are held at a time: 8 MB per axis."""

STEP = 1e-4
"""Step of the central differences of polynomials; they err by less than 1e-6."""


class WavefrontSource(Protocol):
    """A batch of wavefronts that can be put on any pupil grid."""

    def __len__(self) -> int: ...

    def slopes(self) -> np.ndarray:
        """[wavefront, axis (x, y), (min, max)] slope in waves per pupil radius, (B, 2, 2)."""

    def opd(self, index: np.ndarray, pupil: Pupil, dtype: np.dtype) -> np.ndarray:
        """OPD in waves of the wavefronts `index` on the grid of `pupil`, shape (b, M, M)."""


def mode_slopes(modes: Modes) -> tuple[np.ndarray, np.ndarray]:
    """Slopes of modes by x and by y over the full disc and its rim, shape (J, points) each.

    An obscured centre is included: its slopes are the smaller ones and never decide.
    """
    axis = np.linspace(-1.0, 1.0, SLOPE_POINTS)
    x, y = np.meshgrid(axis, axis)
    inside = x**2 + y**2 <= 1.0
    angle = np.linspace(0.0, 2.0 * np.pi, 8 * SLOPE_POINTS, endpoint=False)
    x, y = np.append(x[inside], np.cos(angle)), np.append(y[inside], np.sin(angle))
    return (
        (modes(x + STEP, y) - modes(x - STEP, y)) / (2.0 * STEP),
        (modes(x, y + STEP) - modes(x, y - STEP)) / (2.0 * STEP),
    )


def slope_ranges(
    mode_slopes: tuple[np.ndarray, np.ndarray], coefficients: np.ndarray
) -> np.ndarray:
    """Extreme slopes of wavefronts.

    Parameters
    ----------
    mode_slopes : pair of ndarray, shape (J, points)
    coefficients : ndarray, shape (B, J)
        In waves.

    Returns
    -------
    ndarray, shape (B, 2, 2)
        [wavefront, axis (x, y), (min, max)] in waves per pupil radius.
    """
    ranges = np.empty((len(coefficients), 2, 2))
    for axis, gradient in enumerate(mode_slopes):
        for start in range(0, len(coefficients), SLOPE_BATCH):
            part = slice(start, start + SLOPE_BATCH)
            slopes = coefficients[part] @ gradient
            ranges[part, axis, 0] = slopes.min(axis=1)
            ranges[part, axis, 1] = slopes.max(axis=1)
    return ranges


class ModalWavefronts:
    """Wavefronts as sums of modes, one per row of coefficients; a `WavefrontSource`.

    Parameters
    ----------
    modes : Modes
    coefficients : ndarray, shape (B, J)
        In waves.
    drawn : mapping of str to (ndarray, str), optional
        What a product of stars keeps of them: by name, values in waves and their meaning.
    """

    def __init__(
        self,
        modes: Modes,
        coefficients: np.ndarray,
        drawn: Mapping[str, tuple[np.ndarray, str]] | None = None,
    ) -> None:
        self.modes = modes
        self.coefficients = coefficients
        self.drawn = drawn or {}
        self._images: dict[tuple[int, str], np.ndarray] = {}

    def __len__(self) -> int:
        return len(self.coefficients)

    def slopes(self) -> np.ndarray:
        """Extreme slopes, shape (B, 2, 2); see `slope_ranges`."""
        return slope_ranges(mode_slopes(self.modes), self.coefficients)

    def opd(self, index: np.ndarray, pupil: Pupil, dtype: np.dtype) -> np.ndarray:
        """OPD in waves of the wavefronts `index`, shape (b, M, M)."""
        size = pupil.axis.size
        key = (size, np.dtype(dtype).str)
        if key not in self._images:
            images = self.modes(pupil.axis[None, :], pupil.axis[:, None])
            self._images[key] = images.reshape(len(images), -1).astype(dtype)
        return (self.coefficients[index].astype(dtype) @ self._images[key]).reshape(-1, size, size)


def seidel_wavefronts(seidel: np.ndarray, field: np.ndarray) -> ModalWavefronts:
    """Third-order wavefronts of field points.

    Parameters
    ----------
    seidel : ndarray, shape (B, 5)
        Coefficients in waves in the order of `psfdae.optics.seidel.SEIDEL_TERMS`.
    field : ndarray, shape (B, 2)
        Relative field vector (h_x, h_y).
    """
    drawn = {"seidel": (seidel, "W040, W131, W222, W220, W311 at H = 1")}
    return ModalWavefronts(monomial_images, monomial_coefficients(seidel, field), drawn)


def zernike_wavefronts(noll: Sequence[int], coefficients: np.ndarray) -> ModalWavefronts:
    """Sums of Zernike polynomials.

    Parameters
    ----------
    noll : sequence of int, length J
        Noll indices of the terms.
    coefficients : ndarray, shape (B, J)
        OPD in waves RMS.
    """
    about = f"Noll coefficients j = {', '.join(map(str, noll))}"
    drawn = {"zernike": (coefficients, about)}
    return ModalWavefronts(partial(zernike_images, tuple(noll)), coefficients, drawn)
