"""Third-order (Seidel) wavefront of a telescope over its field.

W(H, ρ, φ) = W040 ρ⁴ + W131 H ρ³cosφ + W222 H²ρ²cos²φ + W220 H²ρ² + W311 H³ρcosφ

with φ counted from the direction of the field point and H = 1 at the edge of
the field on an axis. Written with the field vector h = (h_x, h_y), |h| = H,
every term is a polynomial in the pupil's (x, y), so one set of eight monomial
images serves all field points and no angle has to be formed (it would be
undefined on axis).
"""

from __future__ import annotations

import numpy as np

SEIDEL_TERMS = ("spherical", "coma", "astigmatism", "field_curvature", "distortion")
"""Order of the coefficients W040, W131, W222, W220, W311 in every array."""

MONOMIALS = ("r4", "r2x", "r2y", "xx", "xy", "yy", "x", "y")
"""Order of the pupil monomials of a Seidel wavefront (r² = x² + y²)."""


def monomial_coefficients(seidel: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Seidel coefficients at field points, as coefficients of pupil monomials.

    Parameters
    ----------
    seidel : ndarray, shape (..., 5)
        Coefficients in waves in the order of `SEIDEL_TERMS`.
    field : ndarray, shape (..., 2)
        Field vector (h_x, h_y), 1 at the edge of the field on an axis.

    Returns
    -------
    ndarray, shape (..., 8)
        Coefficients in waves in the order of `MONOMIALS`.
    """
    w040, w131, w222, w220, w311 = np.moveaxis(np.asarray(seidel, float), -1, 0)
    hx, hy = np.moveaxis(np.asarray(field, float), -1, 0)
    h2 = hx**2 + hy**2
    terms = (
        w040,
        w131 * hx,
        w131 * hy,
        w222 * hx**2 + w220 * h2,
        2.0 * w222 * hx * hy,
        w222 * hy**2 + w220 * h2,
        w311 * h2 * hx,
        w311 * h2 * hy,
    )
    return np.stack(np.broadcast_arrays(*terms), axis=-1)


def monomial_images(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Values of the eight monomials at pupil points.

    Parameters
    ----------
    x, y : ndarray, broadcastable to one shape (...)
        Pupil coordinates in units of the pupil radius.

    Returns
    -------
    ndarray, shape (8, ...)
    """
    x, y = np.broadcast_arrays(x, y)
    r2 = x**2 + y**2
    return np.stack([r2**2, r2 * x, r2 * y, x**2, x * y, y**2, x, y])
