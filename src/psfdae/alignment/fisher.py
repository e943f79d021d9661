"""What the photons of a state's stamps tell about it: Fisher information and its bound.

Photon counts are Poisson, n ~ Poisson(F p + B). Their Fisher information about
the state t, per pixel F² ∂p ∂pᵀ / (F p + B), is that of a Gaussian with the
variance (κλ)² + p/F, summed over pixels and fields (Kay 1993, chapter 3).
"""

from __future__ import annotations

import numpy as np

from psfdae.alignment.stamps import AlignmentStamps
from psfdae.alignment.telescope import QuadraticModel
from psfdae.stars.noise import NoiseModel

CHUNK = 64
"""States whose derivatives are in memory at a time."""


def fisher_information(
    stamps: np.ndarray, derivatives: np.ndarray, noise: NoiseModel, level: float
) -> np.ndarray:
    """Fisher matrices of states.

    Parameters
    ----------
    stamps : ndarray, shape (n, F, d, d)
        Noise-free, each sums to 1.
    derivatives : ndarray, shape (n, F, K, d, d)
        By the K parameters.
    noise : NoiseModel
    level : float
        Noise level λ.

    Returns
    -------
    ndarray, shape (n, K, K)
    """
    slopes = by_parameter(derivatives)
    weight = 1.0 / noise.variance(stamps.reshape(len(stamps), 1, -1).astype(np.float64), level)
    return (slopes * weight) @ slopes.swapaxes(1, 2)


def by_parameter(derivatives: np.ndarray) -> np.ndarray:
    """Derivatives (n, F, K, d, d) as rows per parameter, shape (n, K, F·d²), float64."""
    count, _, parameters = derivatives.shape[:3]
    return np.moveaxis(derivatives, 2, 1).astype(np.float64).reshape(count, parameters, -1)


def bound_covariances(
    model: QuadraticModel,
    operator: AlignmentStamps,
    noise: NoiseModel,
    levels: list[float],
    states: np.ndarray,
) -> np.ndarray:
    """Cramér–Rao bounds on the covariance of any unbiased estimate of states (n, 4).

    Returns
    -------
    ndarray, shape (L, n, 4, 4)
        For the L noise levels λ, in squared units of the range.
    """
    out = np.empty((len(levels), len(states), 4, 4))
    for start in range(0, len(states), CHUNK):
        part = slice(start, start + CHUNK)
        images, slopes = operator.derivatives(model(states[part]), model.jacobian(states[part]))
        for index, level in enumerate(levels):
            out[index, part] = np.linalg.inv(fisher_information(images, slopes, noise, level))
    return out


def expected_abs_error(covariances: np.ndarray) -> np.ndarray:
    """Mean absolute error of normal errors, √(2/π) σ, (..., K, K) to (..., K)."""
    return np.sqrt(2.0 / np.pi) * np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))


def coma_free_decentre(model: QuadraticModel, tilts: np.ndarray, noll: np.ndarray) -> np.ndarray:
    """Decentres that cancel the field-constant coma of tilts, to first order, (n, 2) to (n, 2).

    In units of the range; `noll` are the Noll indices of the model's coefficients. Along
    this line tilt and decentre leave hardly more than linear astigmatism, whose sign an
    image in focus does not show: in focus, t and −t on it are twins.
    """
    coma = np.isin(noll, (7, 8))
    slopes = model.coefficients[:, 1:5][:, :, coma].mean(axis=0)
    return -np.linalg.solve(slopes[:2].T, slopes[2:].T @ tilts.T).T


def twin_states(model: QuadraticModel, states: np.ndarray, noll: np.ndarray) -> np.ndarray:
    """States with the opposite tilt and the same field-constant coma, shape (n, 4).

    In focus their stamps hardly differ from those of `states`.
    """
    change = -2.0 * states[:, 2:]
    decentre = states[:, :2] + coma_free_decentre(model, change, noll)
    return np.concatenate([decentre, -states[:, 2:]], axis=1)
