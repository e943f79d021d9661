"""Fisher information of the photons of a state's stamps, and its bound.

Photon counts are Poisson, n ~ Poisson(F p + B). Their Fisher information about
the state t, per pixel F² ∂p ∂pᵀ / (F p + B), is that of a Gaussian with the
variance (κλ)² + p/F, summed over pixels and fields (Kay 1993, chapter 3).

Flux and centroid of a star are unknown. With an operator of movable
stamps they are parameters, too: (n, 4) states become (n, 4 + 3F) parameters, after
the state the three of each stamp in turn, what is missing to its flux relative to
1, and its star's place (x, y) in pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from psfdae.noise import NoiseModel
from psfdae.sensing.climbing import combine_images, poisson_information
from psfdae_paper.alignment.stamps import AlignmentStamps
from psfdae_paper.alignment.telescope import QuadraticModel

Stamps = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function of parameters (n, K): stamps and derivatives, as of `stamps_and_slopes`."""

CHUNK = 64
"""States whose derivatives are in memory at a time."""


def parameters_of(
    model: QuadraticModel, operator: AlignmentStamps, states: np.ndarray
) -> np.ndarray:
    """States (n, 4) with all that is free, flux 1 and the star in the stamp's centre.

    Parameters that are complete are given back.
    """
    size = 4 + 3 * len(model.coefficients) * operator.movable
    return np.pad(states, ((0, 0), (0, size - states.shape[1])))


def stamps_and_slopes(
    model: QuadraticModel,
    operator: AlignmentStamps,
    parameters: np.ndarray,
    emulator: Stamps | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (n, F, d, d), and their derivatives by the k parameters of each, (n, F, k, d, d).

    These are the four of the state and, if the stamps are movable, the stamp's own three.
    Those by the state are an emulator's, if there is one, and then of stars in their place.
    """
    states, own = parameters[:, :4], parameters[:, 4:]
    zernikes, directions = model(states), model.jacobian(states)
    if emulator is not None:
        directions = directions[:, :, :0]
    if operator.movable:
        own = own.reshape(*zernikes.shape[:2], 3)
        zernikes = np.concatenate([zernikes, own[:, :, 1:]], axis=2)
        directions = np.pad(directions, ((0, 0), (0, 0), (0, 0), (0, 2)))
    shapes, slopes = operator.derivatives(zernikes, directions)
    if emulator is not None:
        slopes = np.concatenate([emulator(states)[1], slopes], axis=2)
    if not operator.movable:
        return shapes, slopes
    flux = 1.0 + own[:, :, :1, None]
    slopes = np.concatenate([slopes[:, :, :4], shapes[:, :, None], slopes[:, :, 4:]], axis=2)
    slopes[:, :, [0, 1, 2, 3, 5, 6]] *= flux[:, :, None]
    return flux * shapes, slopes


def deviance_and_information(
    noise: NoiseModel, level: float, images: np.ndarray, stamps: np.ndarray, slopes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Deviance (n,), its score (n, K) and Fisher matrix (n, K, K), by all K parameters.

    Parameters
    ----------
    noise : NoiseModel
    level : float
        Noise level λ.
    images, stamps : ndarray, shape (n, F, d, d)
        What is observed and what is expected, normalised by the true flux.
    slopes : ndarray, shape (n, F, k, d, d)
        By the parameters of each stamp: the first four are shared by all.
    """
    count, fields, k = slopes.shape[:3]
    flux, sky = noise.flux(level), noise.background
    observed, expected = (
        flux * each.reshape(count * fields, -1).astype(np.float64) + sky
        for each in (images, stamps)
    )
    slopes = flux * slopes.reshape(count * fields, k, -1).astype(np.float64)
    deviance, score, information = poisson_information(observed, expected, slopes)
    information = information.reshape(count, fields, k, k)
    score, joint = combine_images(score.reshape(count, fields, k), information, 4)
    return deviance.reshape(count, fields).sum(axis=1), score, joint


def bound_covariances(
    model: QuadraticModel,
    operator: AlignmentStamps,
    noise: NoiseModel,
    levels: list[float],
    states: np.ndarray,
    free: Sequence[bool],
) -> np.ndarray:
    """Cramér–Rao bounds on the covariance of any unbiased estimate of states (n, 4).

    Each of `free` is a bound: whether nobody knows the flux and the place of any star, for which
    the operator's stamps must be movable.

    Returns
    -------
    ndarray, shape (len(free), L, n, 4, 4)
        For the L noise levels λ, in squared units of the range.
    """
    out = np.empty((len(free), len(levels), len(states), 4, 4))
    for start in range(0, len(states), CHUNK):
        part = slice(start, start + CHUNK)
        parameters = parameters_of(model, operator, states[part])
        images, slopes = stamps_and_slopes(model, operator, parameters)
        for bound, level in np.ndindex(out.shape[:2]):
            own = slopes if free[bound] else slopes[:, :, :4]
            fisher = deviance_and_information(noise, levels[level], images, images, own)[2]
            out[bound, level, part] = np.linalg.inv(fisher)[:, :4, :4]
    return out


def expected_abs_error(covariances: np.ndarray) -> np.ndarray:
    """Mean absolute error of normal errors, √(2/π) σ, (..., K, K) to (..., K)."""
    expected: np.ndarray = np.sqrt(2.0 / np.pi) * np.sqrt(
        np.diagonal(covariances, axis1=-2, axis2=-1)
    )
    return expected


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

    In focus their stamps hardly differ from those of `states`; what follows the four is kept.
    """
    tilts = states[:, 2:4]
    decentre = states[:, :2] + coma_free_decentre(model, -2.0 * tilts, noll)
    return np.concatenate([decentre, -tilts, states[:, 4:]], axis=1)
