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

SLOPE_BATCH = 256
"""Wavefronts whose slopes are held at a time: at 65² points 8 MB per axis."""

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


def monomial_gradients(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the eight monomials with respect to x and to y.

    Parameters are those of `monomial_images`; each returned array has shape
    (8, ...), in waves per pupil radius for unit coefficients.
    """
    x, y = np.broadcast_arrays(x, y)
    r2 = x**2 + y**2
    zero, one = np.zeros_like(x), np.ones_like(x)
    d_dx = np.stack([4 * r2 * x, r2 + 2 * x**2, 2 * x * y, 2 * x, y, zero, one, zero])
    d_dy = np.stack([4 * r2 * y, 2 * x * y, r2 + 2 * y**2, zero, x, 2 * y, zero, one])
    return d_dx, d_dy


def gradient_ranges(coefficients: np.ndarray, points: int = 65) -> np.ndarray:
    """Extreme slopes of Seidel wavefronts over the full pupil disc.

    The gradient is sampled analytically on `points`² grid points inside the
    disc and on its rim. The obscured centre is included: its slopes are the
    smaller ones and never decide.

    Parameters
    ----------
    coefficients : ndarray, shape (B, 8)
        Monomial coefficients in waves.

    Returns
    -------
    ndarray, shape (B, 2, 2)
        [star, axis (x, y), (min, max)] slope in waves per pupil radius.
    """
    axis = np.linspace(-1.0, 1.0, points)
    xx, yy = np.meshgrid(axis, axis)
    inside = xx**2 + yy**2 <= 1.0
    angle = np.linspace(0.0, 2.0 * np.pi, 8 * points, endpoint=False)
    x = np.concatenate([xx[inside], np.cos(angle)])
    y = np.concatenate([yy[inside], np.sin(angle)])
    ranges = np.empty((len(coefficients), 2, 2))
    for axis_index, gradient in enumerate(monomial_gradients(x, y)):
        for start in range(0, len(coefficients), SLOPE_BATCH):
            part = slice(start, start + SLOPE_BATCH)
            slopes = coefficients[part] @ gradient
            ranges[part, axis_index, 0] = slopes.min(axis=1)
            ranges[part, axis_index, 1] = slopes.max(axis=1)
    return ranges
