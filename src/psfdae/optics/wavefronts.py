"""Wavefronts that are sums of modes, on any pupil grid.

A mode is the OPD in waves for a coefficient of 1, such as a Seidel monomial or a
Zernike polynomial. Scenes differ only in their modes and in the distribution of
their coefficients.

The third-order (Seidel) wavefront of a telescope over its field is

W(H, ρ, φ) = W040 ρ⁴ + W131 H ρ³cosφ + W222 H²ρ²cos²φ + W220 H²ρ² + W311 H³ρcosφ

with φ counted from the direction of the field point and H = 1 at the edge of
the field on an axis. With the field vector h = (h_x, h_y), |h| = H, every term
is a polynomial in the pupil's (x, y): one set of eight monomial images is enough
for all field points, and no angle is needed (it is undefined on the axis).
Zernike polynomials are in Noll's order and normalisation
(Noll 1976, JOSA 66, 207).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from math import comb
from typing import Protocol

import numpy as np

from psfdae.optics.pupil import Pupil

SEIDEL_TERMS = ("spherical", "coma", "astigmatism", "field_curvature", "distortion")
"""Order of the coefficients W040, W131, W222, W220, W311 in every array."""

FIRST_NOLL = 4
"""First Noll index after piston and tilts, which only move the image."""

MONOMIALS = ("r4", "r2x", "r2y", "xx", "xy", "yy", "x", "y")
"""Order of the pupil monomials of a Seidel wavefront (r² = x² + y²)."""


def monomial_coefficients(seidel: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Convert Seidel coefficients at field points to coefficients of pupil monomials.

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
    # W040 ρ⁴ + W131 (h·ρ) ρ² + W222 (h·ρ)² + W220 h² ρ² + W311 h² (h·ρ), term by term.
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
    """Return the values of the eight monomials at pupil points.

    Parameters
    ----------
    x, y : ndarray, broadcastable to one shape (...)
        Pupil coordinates in units of the pupil radius.

    Returns
    -------
    ndarray, shape (8, ...)
        Values in the order of `MONOMIALS`.
    """
    # In the order of `MONOMIALS`.
    x, y = np.broadcast_arrays(x, y)
    r2 = x**2 + y**2
    return np.stack([r2**2, r2 * x, r2 * y, x**2, x * y, y**2, x, y])


def noll_to_nm(j: int) -> tuple[int, int]:
    """Return radial order n and signed azimuthal order m of Noll index j ≥ 1.

    m > 0 marks cosine terms, m < 0 sine terms; even j are cosines.

    Raises
    ------
    ValueError
        If j < 1.
    """
    if j < 1:
        raise ValueError(f"Noll index {j}: must be at least 1")
    # Order n has n + 1 terms, the first one after n (n + 1)/2 of lower orders: the smallest n with
    # (n + 1) (n + 2)/2 ≥ j.
    n = 0
    while (n + 1) * (n + 2) // 2 < j:
        n += 1
    # |m| is even for even n and grows by 2 with every pair of terms.
    position = j - n * (n + 1) // 2 - 1
    m = 2 * ((position + 1) // 2) if n % 2 == 0 else 2 * (position // 2) + 1
    return n, m if j % 2 == 0 else -m


def radial_polynomial(n: int, m: int, r: np.ndarray) -> np.ndarray:
    """Return Zernike's R_n^|m|(r), 1 at r = 1."""
    m = abs(m)
    # Σ_k (−1)^k (n−k)! / (k! ((n+m)/2−k)! ((n−m)/2−k)!) r^(n−2k), as two binomials.
    polynomial: np.ndarray = sum(
        (-1) ** k * comb(n - k, k) * comb(n - 2 * k, (n - m) // 2 - k) * r ** (n - 2 * k)
        for k in range((n - m) // 2 + 1)
    )
    return polynomial


def zernike(j: int, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the Noll polynomial Z_j, whose RMS over the unit disc is 1.

    Parameters
    ----------
    j : int
        Noll index.
    x, y : ndarray
        Pupil coordinates in pupil radii; the polynomial is also evaluated outside of the disc.

    Returns
    -------
    ndarray of the broadcast shape of x and y
        Values of the polynomial.
    """
    # √(n+1) R_n⁰ for m = 0, else √(2(n+1)) R_n^m times cos mθ or sin mθ.
    n, m = noll_to_nm(j)
    r, theta = np.hypot(x, y), np.arctan2(y, x)
    # The factor makes the mean square over the disc 1: the mean of cos² is ½ for m ≠ 0.
    if m == 0:
        return np.asarray(np.sqrt(n + 1.0) * radial_polynomial(n, 0, r))
    angular = np.cos(m * theta) if m > 0 else np.sin(-m * theta)
    return np.asarray(np.sqrt(2.0 * (n + 1.0)) * radial_polynomial(n, m, r) * angular)


def zernike_images(noll: Iterable[int], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return values of Noll polynomials at pupil points in pupil radii, shape (J, ...)."""
    return np.stack([zernike(j, x, y) for j in noll])


def field_coefficients(
    polynomials: Sequence[Mapping[tuple[int, int], float]], field: np.ndarray
) -> np.ndarray:
    """Evaluate coefficients that are polynomials of the field, at field points.

    In nodal aberration theory, every Zernike coefficient of a telescope, aligned or not, is a
    polynomial of the field vector (Thompson 2005, JOSA A 22, 1389). Pupil and field have the
    same axes x and y: a coefficient of Z8 that is proportional to x is coma of Seidel's theory.

    Parameters
    ----------
    polynomials : sequence of length J
        For each term, coefficients in waves by the powers (of x, of y) of the field.
    field : ndarray, shape (F, 2)
        Field vector (x, y), 1 at the edge of the field on an axis.

    Returns
    -------
    ndarray, shape (F, J)
        Coefficients in waves.
    """
    # Σ waves x^a y^b of every term; a term without powers is 0.
    x, y = field[:, 0], field[:, 1]
    terms = [
        sum((waves * x**a * y**b for (a, b), waves in polynomial.items()), np.zeros(len(field)))
        for polynomial in polynomials
    ]
    return np.stack(terms, axis=1)


PupilModes = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function of pupil points (x, y) in pupil radii, shapes (...), that returns J modes (J, ...)."""


def movable_modes(modes: PupilModes, pixel: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return modes and two tilts that move the image by a pixel along x and y, (J + 2, ...).

    A tilt of a waves per pupil radius moves the image by 2a λ/D; `pixel` is in λ/D.
    """
    tilts = 0.5 * pixel * np.stack(np.broadcast_arrays(x, y))
    return np.concatenate([modes(x, y), tilts])


def legendre(degrees: Sequence[int], x: np.ndarray) -> np.ndarray:
    """Return Legendre polynomials at x (n,), shape (A, n)."""
    return np.polynomial.legendre.legvander(x, max(degrees)).T[list(degrees)]


def legendre_expansion(modes: PupilModes) -> tuple[np.ndarray, np.ndarray]:
    """Expand modes as sums of products P_a(x) P_b(y) of Legendre polynomials.

    Returns
    -------
    degrees : ndarray of int, shape (T, 2)
        (a, b) of every product that occurs, except the constant.
    coefficients : ndarray, shape (J, T)
        Coefficient of each product in each mode.

    Raises
    ------
    ValueError
        If a mode is not a polynomial of a degree below 16 in either coordinate.
    """
    # Gauss–Legendre quadrature of (a + ½) (b + ½) ∫∫ M P_a(x) P_b(y) dx dy, exact for polynomials.
    highest = 16
    nodes, weights = np.polynomial.legendre.leggauss(highest + 1)
    values = modes(nodes[None, :], nodes[:, None])
    norm = np.arange(highest + 1) + 0.5  # ∫ P_a² dx = 1/(a + ½)
    projection = legendre(range(highest + 1), nodes) * weights * norm[:, None]
    coefficients = (projection @ values @ projection.T).swapaxes(1, 2)  # [mode, a, b]
    # Products that occur in a mode, apart from rounding. A product of the highest degree shows
    # that a mode is not a polynomial.
    largest = np.abs(coefficients).max(axis=(1, 2), keepdims=True)
    occurs = (np.abs(coefficients) > 1e-11 * largest).any(axis=0)
    if occurs[-1].any() or occurs[:, -1].any():
        raise ValueError(f"modes: no polynomials of a degree below {highest}")
    # A constant is piston, which does not change an image.
    occurs[0, 0] = False
    return np.argwhere(occurs), coefficients[:, occurs]


class WavefrontSource(Protocol):
    """Batch of wavefronts that can be evaluated on any pupil grid."""

    def __len__(self) -> int:
        """Return the number B of wavefronts."""

    def slopes(self) -> np.ndarray:
        """Return extreme slopes in waves per pupil radius, (B, 2, 2).

        The axes are [wavefront, axis (x, y), (min, max)].
        """

    def opd(self, index: np.ndarray, pupil: Pupil, dtype: np.dtype) -> np.ndarray:
        """Return the OPD in waves of the wavefronts `index` on the grid of `pupil`, (b, M, M)."""


def mode_slopes(modes: PupilModes) -> tuple[np.ndarray, np.ndarray]:
    """Compute slopes of modes along x and y over the full disc and its rim, (J, points) each.

    An obscured centre is included: slopes are smaller there and do not decide.
    """
    # 65 points along the diameter, and 520 on the rim.
    axis = np.linspace(-1.0, 1.0, 65)
    # Slopes are often largest at the rim, which a square grid would miss.
    grid_x, grid_y = np.meshgrid(axis, axis)
    is_inside = grid_x**2 + grid_y**2 <= 1.0
    angle = np.linspace(0.0, 2.0 * np.pi, 8 * axis.size, endpoint=False)
    x = np.append(grid_x[is_inside], np.cos(angle))
    y = np.append(grid_y[is_inside], np.sin(angle))
    # Central differences, with errors below 1e-6 for polynomials.
    step = 1e-4
    return (
        (modes(x + step, y) - modes(x - step, y)) / (2.0 * step),
        (modes(x, y + step) - modes(x, y - step)) / (2.0 * step),
    )


def slope_ranges(
    mode_slopes: tuple[np.ndarray, np.ndarray], coefficients: np.ndarray
) -> np.ndarray:
    """Compute the extreme slopes of wavefronts.

    Parameters
    ----------
    mode_slopes : pair of ndarray, shape (J, points)
        Slopes of the modes along x and y, the result of `mode_slopes`.
    coefficients : ndarray, shape (B, J)
        Coefficients of the modes in waves.

    Returns
    -------
    ndarray, shape (B, 2, 2)
        [wavefront, axis (x, y), (min, max)] in waves per pupil radius.
    """
    # Slopes of 256 wavefronts are in memory at a time: 8 MB per axis.
    # ∂W/∂x = Σ c_j ∂M_j/∂x at all points, and its minimum and maximum.
    ranges = np.empty((len(coefficients), 2, 2))
    for axis, gradient in enumerate(mode_slopes):
        for start in range(0, len(coefficients), 256):
            part = slice(start, start + 256)
            slopes = coefficients[part] @ gradient
            ranges[part, axis, 0] = slopes.min(axis=1)
            ranges[part, axis, 1] = slopes.max(axis=1)
    return ranges


class ModalWavefronts:
    """Wavefronts that are sums of modes, one per row of coefficients; a `WavefrontSource`.

    Parameters
    ----------
    modes : PupilModes
        Function that returns the J modes at pupil points.
    coefficients : ndarray, shape (B, J)
        Coefficients of the modes in waves.
    star_columns : mapping of str to (ndarray, str), optional
        Columns of a product of stars, by name: coefficients in waves and their meaning.
    """

    def __init__(
        self,
        modes: PupilModes,
        coefficients: np.ndarray,
        star_columns: Mapping[str, tuple[np.ndarray, str]] | None = None,
    ) -> None:
        self.modes = modes
        self.coefficients = coefficients
        self.star_columns = star_columns or {}
        self._images: dict[tuple[int, str], np.ndarray] = {}

    def __len__(self) -> int:
        """Return the number B of wavefronts."""
        return len(self.coefficients)

    def slopes(self) -> np.ndarray:
        """Return extreme slopes, shape (B, 2, 2); see `slope_ranges`."""
        return slope_ranges(mode_slopes(self.modes), self.coefficients)

    def opd(self, index: np.ndarray, pupil: Pupil, dtype: np.dtype) -> np.ndarray:
        """Return the OPD in waves of the wavefronts `index`, shape (b, M, M)."""
        # Images of the modes are kept for each grid and precision.
        size = pupil.axis.size
        key = (size, np.dtype(dtype).str)
        if key not in self._images:
            images = self.modes(pupil.axis[None, :], pupil.axis[:, None])
            self._images[key] = images.reshape(len(images), -1).astype(dtype)
        # W = Σ c_j M_j.
        opd = self.coefficients[index].astype(dtype) @ self._images[key]
        return np.asarray(opd.reshape(-1, size, size))


def seidel_wavefronts(seidel: np.ndarray, field: np.ndarray) -> ModalWavefronts:
    """Return third-order wavefronts at field points.

    Parameters
    ----------
    seidel : ndarray, shape (B, 5)
        Coefficients in waves in the order of `SEIDEL_TERMS`.
    field : ndarray, shape (B, 2)
        Relative field vector (h_x, h_y).
    """
    columns = {"seidel": (seidel, "W040, W131, W222, W220, W311 at H = 1")}
    return ModalWavefronts(monomial_images, monomial_coefficients(seidel, field), columns)


def zernike_wavefronts(noll: Sequence[int], coefficients: np.ndarray) -> ModalWavefronts:
    """Return wavefronts that are sums of Zernike polynomials.

    Parameters
    ----------
    noll : sequence of int, length J
        Noll indices of the terms.
    coefficients : ndarray, shape (B, J)
        OPD in waves RMS.
    """
    about = f"Noll coefficients j = {', '.join(map(str, noll))}"
    columns = {"zernike": (coefficients, about)}
    return ModalWavefronts(partial(zernike_images, tuple(noll)), coefficients, columns)
