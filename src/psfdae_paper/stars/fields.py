"""Field points of a telescope, and random aberrations of the stars at them."""

from __future__ import annotations

import numpy as np

from psfdae_paper.configuration.schema import Grid


def square_grid(points: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a centred square grid of field points.

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


def relative_field(grid: Grid) -> np.ndarray:
    """Return field vectors (h_x, h_y) of a grid, 1 at the edge on an axis, shape (P², 2)."""
    _, angle_deg = square_grid(grid.points, grid.spacing_deg)
    return angle_deg / grid.edge_deg


def number_fields(position: np.ndarray, points: int) -> np.ndarray:
    """Return the numbers ix + P iy of fields, (n,), by their grid indices (ix, iy), (n, 2)."""
    fields: np.ndarray = np.rint(position @ [1, points]).astype(int)
    return fields


def assign_fields(count: int, fields: int, rng: np.random.Generator) -> np.ndarray:
    """Return a field for every star: a random permutation of k mod `fields`, k < `count`.

    Numbers of stars in different fields differ by at most one. Integers, shape (count,).
    """
    return rng.permutation(np.arange(count) % fields)


def perturb(
    coefficients: np.ndarray,
    fraction: float,
    factors: np.random.Generator,
    jitter_waves: float = 0.0,
    shifts: np.random.Generator | None = None,
) -> np.ndarray:
    """Draw aberrations: every coefficient times (1 + fraction · N(0, 1)) + jitter · N(0, 1).

    The paper (section 3.1) gives "variance of different percentage"; `fraction` is read
    as a standard deviation. The jitter also moves terms that vanish, such as focus on the
    optical axis. All draws are independent; Seidel coefficients are given at H = 1.

    Parameters
    ----------
    coefficients : ndarray, shape (n, J)
        Static coefficients of every star in waves.
    fraction : float
        Relative standard deviation, ≥ 0.
    factors, shifts : Generator
        Random streams of the factors and of the jitter.
    jitter_waves : float
        Standard deviation in waves, ≥ 0.

    Returns
    -------
    ndarray, shape (n, J)
        Coefficients in waves.
    """
    result = coefficients * (1.0 + fraction * factors.standard_normal(coefficients.shape))
    if jitter_waves and shifts:
        result = result + jitter_waves * shifts.standard_normal(coefficients.shape)
    return result
