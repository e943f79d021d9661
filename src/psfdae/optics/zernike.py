"""Zernike polynomials in Noll's order and normalisation (Noll 1976, JOSA 66, 207)."""

from __future__ import annotations

from math import comb

import numpy as np


def noll_to_nm(j: int) -> tuple[int, int]:
    """Radial order n and signed azimuthal order m of Noll index j ≥ 1.

    m > 0 marks cosine terms, m < 0 sine terms; even j are cosines.

    Raises
    ------
    ValueError
        If j < 1.
    """
    if j < 1:
        raise ValueError(f"Noll index {j}: must be at least 1")
    n = 0
    while (n + 1) * (n + 2) // 2 < j:
        n += 1
    position = j - n * (n + 1) // 2 - 1
    m = 2 * ((position + 1) // 2) if n % 2 == 0 else 2 * (position // 2) + 1
    return n, m if j % 2 == 0 else -m


def radial_polynomial(n: int, m: int, r: np.ndarray) -> np.ndarray:
    """R_n^|m|(r), 1 at r = 1."""
    m = abs(m)
    return sum(
        (-1) ** k * comb(n - k, k) * comb(n - 2 * k, (n - m) // 2 - k) * r ** (n - 2 * k)
        for k in range((n - m) // 2 + 1)
    )


def zernike(j: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Noll polynomial Z_j on the unit disc, of RMS 1 there.

    Parameters
    ----------
    j : int
        Noll index.
    x, y : ndarray
        Pupil coordinates in pupil radii; values outside the disc are those of
        the polynomial.

    Returns
    -------
    ndarray of the broadcast shape of x and y
    """
    n, m = noll_to_nm(j)
    r, theta = np.hypot(x, y), np.arctan2(y, x)
    if m == 0:
        return np.sqrt(n + 1.0) * radial_polynomial(n, 0, r)
    angular = np.cos(m * theta) if m > 0 else np.sin(-m * theta)
    return np.sqrt(2.0 * (n + 1.0)) * radial_polynomial(n, m, r) * angular


def zernike_basis(count: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Z_1 … Z_count, shape (count, ...)."""
    return np.stack([zernike(j, x, y) for j in range(1, count + 1)])
