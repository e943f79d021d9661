"""Zernike wavefronts whose coefficients are polynomials of the field.

Nodal aberration theory writes every Zernike coefficient of a telescope, aligned or
not, as a polynomial of the field vector (Thompson 2005, JOSA A 22, 1389). Here they
are Noll's, an OPD in waves RMS over the unit disc. The pupil's x and y are those of
the field: a coefficient of Z8 that grows with x is coma as in Seidel's theory.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from psfdae.optics.zernike import zernike

SLOPE_POINTS = 65
"""Points per axis at which slopes are measured."""

SLOPE_BATCH = 256
"""Wavefronts whose slopes are held at a time."""

STEP = 1e-4
"""Step of the central differences of polynomials; they err by less than 1e-6."""


def field_coefficients(
    polynomials: Sequence[Mapping[tuple[int, int], float]], field: np.ndarray
) -> np.ndarray:
    """Coefficients at field points.

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


def zernike_images(noll: Sequence[int], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values of some Noll polynomials at pupil points in pupil radii, shape (J, ...)."""
    return np.stack([zernike(j, x, y) for j in noll])


def slope_ranges(noll: Sequence[int], coefficients: np.ndarray) -> np.ndarray:
    """Extreme slopes of Zernike wavefronts over the full disc and its rim.

    Parameters
    ----------
    noll : sequence of int, length J
    coefficients : ndarray, shape (B, J)
        In waves.

    Returns
    -------
    ndarray, shape (B, 2, 2)
        [wavefront, axis (x, y), (min, max)] in waves per pupil radius.
    """
    axis = np.linspace(-1.0, 1.0, SLOPE_POINTS)
    xx, yy = np.meshgrid(axis, axis)
    inside = xx**2 + yy**2 <= 1.0
    angle = np.linspace(0.0, 2.0 * np.pi, 8 * SLOPE_POINTS, endpoint=False)
    x = np.append(xx[inside], np.cos(angle))
    y = np.append(yy[inside], np.sin(angle))
    ranges = np.empty((len(coefficients), 2, 2))
    for number, (dx, dy) in enumerate(((STEP, 0.0), (0.0, STEP))):
        ahead, behind = (zernike_images(noll, x + s * dx, y + s * dy) for s in (1, -1))
        gradient = (ahead - behind) / (2.0 * STEP)
        for start in range(0, len(coefficients), SLOPE_BATCH):
            slopes = coefficients[start : start + SLOPE_BATCH] @ gradient
            ranges[start : start + SLOPE_BATCH, number, 0] = slopes.min(axis=1)
            ranges[start : start + SLOPE_BATCH, number, 1] = slopes.max(axis=1)
    return ranges
