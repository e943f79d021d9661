"""Wavefronts that are sums of modes, on whatever pupil grid.

A mode is the OPD in waves of a unit coefficient: a Seidel monomial, a Zernike
polynomial. Scenes differ in their modes and in how they draw coefficients, no more.

The third-order (Seidel) wavefront of a telescope over its field is

W(H, ρ, φ) = W040 ρ⁴ + W131 H ρ³cosφ + W222 H²ρ²cos²φ + W220 H²ρ² + W311 H³ρcosφ

with φ counted from the direction of the field point and H = 1 at the edge of
the field on an axis. Written with the field vector h = (h_x, h_y), |h| = H,
every term is a polynomial in the pupil's (x, y), so one set of eight monomial
images serves all field points and no angle has to be formed (it would be
undefined on axis). Zernike polynomials are in Noll's order and normalisation
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
"""First Noll index of terms that are no piston and no tilt: those only move the image."""

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
    found: np.ndarray = sum(
        (-1) ** k * comb(n - k, k) * comb(n - 2 * k, (n - m) // 2 - k) * r ** (n - 2 * k)
        for k in range((n - m) // 2 + 1)
    )
    return found


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
        return np.asarray(np.sqrt(n + 1.0) * radial_polynomial(n, 0, r))
    angular = np.cos(m * theta) if m > 0 else np.sin(-m * theta)
    return np.asarray(np.sqrt(2.0 * (n + 1.0)) * radial_polynomial(n, m, r) * angular)


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


Modes = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Modes at pupil points (x, y) in pupil radii, shapes (...) to (J, ...)."""


def movable_modes(modes: Modes, pixel: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Modes, (J, ...), and two tilts that move the image by a pixel along x and y, (J + 2, ...)."""
    tilts = 0.5 * pixel * np.stack(np.broadcast_arrays(x, y))
    return np.concatenate([modes(x, y), tilts])


HIGHEST_DEGREE = 16
"""Highest degree of modes, in either coordinate of the pupil."""


def legendre(degrees: Sequence[int], x: np.ndarray) -> np.ndarray:
    """Legendre polynomials at x (n,), shape (A, n)."""
    return np.polynomial.legendre.legvander(x, max(degrees)).T[list(degrees)]


def legendre_expansion(modes: Modes) -> tuple[np.ndarray, np.ndarray]:
    """Modes as sums of products P_a(x) P_b(y) of Legendre polynomials.

    Returns
    -------
    degrees : ndarray of int, shape (T, 2)
        (a, b) of every product that occurs, but for the constant.
    coefficients : ndarray, shape (J, T)

    Raises
    ------
    ValueError
        If modes are no polynomials of a degree below `HIGHEST_DEGREE`.
    """
    nodes, weights = np.polynomial.legendre.leggauss(HIGHEST_DEGREE + 1)
    values = modes(nodes[None, :], nodes[:, None])
    norm = np.arange(HIGHEST_DEGREE + 1) + 0.5
    onto = legendre(range(HIGHEST_DEGREE + 1), nodes) * weights * norm[:, None]
    found = (onto @ values @ onto.T).swapaxes(1, 2)  # [mode, a, b]
    size = np.abs(found).max(axis=(1, 2), keepdims=True)
    occurs = (np.abs(found) > 1e-11 * size).any(axis=0)
    if occurs[-1].any() or occurs[:, -1].any():
        raise ValueError(f"modes: no polynomials of a degree below {HIGHEST_DEGREE}")
    occurs[0, 0] = False
    return np.argwhere(occurs), found[:, occurs]


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
    u, v = np.append(x[inside], np.cos(angle)), np.append(y[inside], np.sin(angle))
    return (
        (modes(u + STEP, v) - modes(u - STEP, v)) / (2.0 * STEP),
        (modes(u, v + STEP) - modes(u, v - STEP)) / (2.0 * STEP),
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
        return np.asarray(
            (self.coefficients[index].astype(dtype) @ self._images[key]).reshape(-1, size, size)
        )


def seidel_wavefronts(seidel: np.ndarray, field: np.ndarray) -> ModalWavefronts:
    """Third-order wavefronts of field points.

    Parameters
    ----------
    seidel : ndarray, shape (B, 5)
        Coefficients in waves in the order of `SEIDEL_TERMS`.
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
