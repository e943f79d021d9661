"""Field points of a telescope and the stars that are put on them."""

from __future__ import annotations

import numpy as np


def square_grid(points: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """A centred square grid of field points.

    Parameters
    ----------
    points : int
        Points P along a side.
    spacing : float
        Distance of neighbours, any unit.

    Returns
    -------
    index : ndarray of int, shape (P², 2)
        Grid index (ix, iy), ix running fastest.
    position : ndarray, shape (P², 2)
        (x, y) in the unit of `spacing`, 0 in the middle of the grid.
    """
    iy, ix = np.divmod(np.arange(points**2), points)
    index = np.stack([ix, iy], axis=1)
    return index, (index - 0.5 * (points - 1)) * spacing


def assign_fields(count: int, fields: int, rng: np.random.Generator) -> np.ndarray:
    """Field of every star: a random permutation of k mod `fields`, k = 0 … count − 1."""
    return rng.permutation(np.arange(count) % fields)


def draw_jitter(count: int, jitter_px: int, rng: np.random.Generator) -> np.ndarray:
    """Centring error of every star in whole pixels (row, column), uniform in ±`jitter_px`."""
    return rng.integers(-jitter_px, jitter_px + 1, size=(count, 2))


def draw_phase(count: int, rng: np.random.Generator) -> np.ndarray:
    """Place of the pixel grid of every star (row, column), uniform in ± ½ pixel."""
    return rng.uniform(-0.5, 0.5, size=(count, 2))


def perturb_seidel(
    seidel: np.ndarray, fraction: float, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Random aberrations: every Seidel coefficient times (1 + fraction · N(0, 1)).

    The paper (section 3.1) gives "variance of different percentage"; `fraction`
    is read as a standard deviation. The draws of the five terms are independent;
    at a field point they act with the power of H of their term.

    Parameters
    ----------
    seidel : ndarray, shape (5,)
        Static coefficients in waves.
    fraction : float
        Relative standard deviation, ≥ 0.

    Returns
    -------
    ndarray, shape (count, 5)
        Coefficients in waves.
    """
    return seidel * (1.0 + fraction * rng.standard_normal((count, seidel.size)))
