"""Approximate posteriors near modes, from images that are quadratic in the parameters.

At an offset x from its mode, in units of the covariance, the parameters of a star are mean + S x,
where S Sᵀ is the covariance, and its image is p(x) = Σ c_j φ_j(x), with φ = 1, x_i, x_i x_k. The
vectors c_j are fitted to images at a design of offsets. Deviations of the counts from
μ = F f p + B + √B s, the flux f and sky s being free, are weighted by the variance of the counts at
the mode. χ² is then the square of a vector that is linear in f φ, s and 1, which a QR decomposition
shortens from a row for each pixel to one for each term: an evaluation takes a few microseconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

MAX_PARAMETERS = 21
"""Largest number of parameters: more have too many products for a fit to pay."""


def quadratic_terms(offset: np.ndarray) -> np.ndarray:
    """Return 1, x_i, and all products x_i x_k of the components of offsets (m, D), (m, Q)."""
    rows, columns = np.triu_indices(offset.shape[1])
    products = offset.T[rows] * offset.T[columns]
    return np.concatenate([np.ones((1, len(offset))), offset.T, products]).T


def draw_design(size: int, rng: np.random.Generator) -> np.ndarray:
    """Return offsets (n, D) from a standard normal, each with its opposite.

    Terms of odd order then do not disturb the fit of even ones, of which there are two for three
    pairs.
    """
    half = rng.standard_normal((3 * (1 + size * (size + 1) // 2) // 2, size))
    return np.concatenate([half, -half])


@dataclass(frozen=True, eq=False)
class QuadraticPosterior:
    """Approximate posteriors near M modes.

    Attributes
    ----------
    mean, factor : ndarray, shapes (M, D + 2) and (M, D + 2, D + 2)
        Parameters are mean + factor · x at the offset x. The factor is lower triangular; flux and
        sky, the last two parameters, do not change the image.
    prior_precision : ndarray, shape (D + 2,)
        Inverse variance of the prior of the parameters.
    root : mapping of int to ndarray, shape (R, Q + 2)
        By the index of the mode, the matrix R for which χ² = |R v|² with v = (f φ, s, −1).
    """

    mean: np.ndarray
    factor: np.ndarray
    prior_precision: np.ndarray
    root: Mapping[int, np.ndarray]

    def __call__(self, mode: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return logarithms (m,) of the posteriors at offsets (m, D + 2) from ascending modes."""
        terms, height = quadratic_terms(offset[:, :-2]), np.empty(len(offset))
        numbers, starts = np.unique(mode, return_index=True)
        for number, first, end in zip(numbers, starts, [*starts[1:], len(mode)], strict=True):
            part = slice(first, end)
            parameters = self.mean[number] + offset[part] @ self.factor[number].T
            flux, sky = parameters[:, -2:-1], parameters[:, -1:]
            vector = np.concatenate([flux * terms[part], sky, np.full_like(sky, -1.0)], axis=1)
            residual = vector.astype(np.float32) @ self.root[number].T
            chi2 = np.einsum("mr,mr->m", residual, residual)
            height[part] = -0.5 * (chi2 + parameters**2 @ self.prior_precision)
        return height


def fit_root(
    offset: np.ndarray,
    images: np.ndarray,
    counts: np.ndarray,
    flux: float,
    sky_counts: float,
    mode_flux: float,
) -> np.ndarray:
    """Return the matrix `QuadraticPosterior.root` of a star at a mode.

    Parameters
    ----------
    offset : ndarray, shape (n, D)
        Offsets of the design.
    images : ndarray, shape (n, P)
        Images of light 1 there, pixel by pixel.
    counts : ndarray, shape (P,)
        Counts of the star; NaN where a pixel is not used.
    flux, sky_counts : float
        Units F of the flux and B of the sky.
    mode_flux : float
        Flux f of the mode, in units of F.
    """
    used = np.isfinite(counts)
    # Coefficients c_j of each pixel; the first one is the image in the mode.
    coefficients = flux * (np.linalg.pinv(quadratic_terms(offset)) @ images[:, used])
    variance = np.maximum(mode_flux * coefficients[0] + sky_counts, 0.01 * sky_counts)
    # Rows: coefficients, a unit of sky, and the counts of the star.
    sky = np.full_like(variance, np.sqrt(sky_counts))
    rows = np.concatenate([coefficients, [sky, counts[used] - sky_counts]]) / np.sqrt(variance)
    return np.asarray(np.linalg.qr(rows.T, mode="r"), np.float32)
