"""Zernike polynomials in Noll's order and normalisation (Noll 1976, JOSA 66, 207)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
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


def zernike_images(noll: Iterable[int], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values of some Noll polynomials at pupil points in pupil radii, shape (J, ...)."""
    return np.stack([zernike(j, x, y) for j in noll])


def zernike_basis(count: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Z_1 … Z_count, shape (count, ...)."""
    return zernike_images(range(1, count + 1), x, y)


def field_coefficients(
    polynomials: Sequence[Mapping[tuple[int, int], float]], field: np.ndarray
) -> np.ndarray:
    """Coefficients whose field dependence is polynomial, at field points.

    Nodal aberration theory writes every Zernike coefficient of a telescope, aligned or
    not, as a polynomial of the field vector (Thompson 2005, JOSA A 22, 1389). Pupil and
    field share x and y: a coefficient of Z8 that grows with x is coma as in Seidel's theory.

    Parameters
    ----------
    polynomials : sequence of length J
        Per term: coefficient in waves by the powers (of x, of y) of the field.
    field : ndarray, shape (F, 2)
        Field vector (x, y), 1 at the edge of the field on an axis.

    Returns
    -------
    ndarray, shape (F, J)
        In waves.
    """
    x, y = field[:, 0], field[:, 1]
    terms = [
        sum((waves * x**a * y**b for (a, b), waves in polynomial.items()), np.zeros(len(field)))
        for polynomial in polynomials
    ]
    return np.stack(terms, axis=1)
