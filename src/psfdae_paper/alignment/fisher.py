"""Fisher information of the photons of a state's stamps, and its bound.

Photon counts are Poisson, n ~ Poisson(F p + B). Their Fisher information about
the state t, per pixel F² ∂p ∂pᵀ / (F p + B), is that of a Gaussian with the
variance (κλ)² + p/F, summed over pixels and fields (Kay 1993, chapter 3).

Flux and centroid of a star are unknown. With an operator of movable
stamps they are parameters, too: (n, 4) states become (n, 4 + 3F) parameters. After
the state come three for each stamp in turn: the difference of its flux from 1, and the
place (x, y) of its star in pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from psfdae.noise import NoiseModel
from psfdae.sensing.climbing import combine_images, poisson_information
from psfdae_paper.alignment.stamps import AlignmentStamps
from psfdae_paper.alignment.telescope import QuadraticModel

Stamps = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function of parameters (n, K) that returns what `stamps_and_slopes` returns."""

STATES_AT_ONCE = 64
"""States whose derivatives are in memory together."""


def parameters_of(
    model: QuadraticModel, operator: AlignmentStamps, states: np.ndarray
) -> np.ndarray:
    """Complete states (n, 4) to parameters, with flux 1 and the star in the stamp's centre.

    Parameters that are complete are returned unchanged.
    """
    size = 4 + 3 * len(model.coefficients) * operator.movable
    return np.pad(states, ((0, 0), (0, size - states.shape[1])))


def stamps_and_slopes(
    model: QuadraticModel,
    operator: AlignmentStamps,
    parameters: np.ndarray,
    emulator: Stamps | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute stamps and their derivatives.

    Parameters
    ----------
    model : QuadraticModel
    operator : AlignmentStamps
    parameters : ndarray, shape (n, 4) or, if stamps are movable, (n, 4 + 3F)
    emulator : Stamps, optional
        Source of the derivatives by the state, for stars in the centre of their stamps.

    Returns
    -------
    stamps : ndarray, shape (n, F, d, d)
    slopes : ndarray, shape (n, F, k, d, d)
        Derivatives by the k parameters of each stamp: the four of the state and, if stamps are
        movable, the stamp's own three.
    """
    states, star_parameters = parameters[:, :4], parameters[:, 4:]
    zernikes, directions = model(states), model.jacobian(states)
    if emulator is not None:
        directions = directions[:, :, :0]
    if operator.movable:
        # The place of the star is two more coefficients of the wavefront.
        star_parameters = star_parameters.reshape(*zernikes.shape[:2], 3)
        zernikes = np.concatenate([zernikes, star_parameters[:, :, 1:]], axis=2)
        directions = np.pad(directions, ((0, 0), (0, 0), (0, 0), (0, 2)))
    shapes, slopes = operator.derivatives(zernikes, directions)
    if emulator is not None:
        slopes = np.concatenate([emulator(states)[1], slopes], axis=2)
    if not operator.movable:
        return shapes, slopes
    # A stamp is flux × shape: its derivative by the flux is the shape, the others are multiplied.
    flux = 1.0 + star_parameters[:, :, :1, None]
    slopes = np.concatenate([slopes[:, :, :4], shapes[:, :, None], slopes[:, :, 4:]], axis=2)
    slopes[:, :, [0, 1, 2, 3, 5, 6]] *= flux[:, :, None]
    return flux * shapes, slopes


def deviance_and_information(
    noise: NoiseModel, level: float, images: np.ndarray, stamps: np.ndarray, slopes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the deviance of noisy stamps from expected ones, and its derivatives.

    Parameters
    ----------
    noise : NoiseModel
    level : float
        Noise level λ.
    images, stamps : ndarray, shape (n, F, d, d)
        Observed and expected stamps, normalised by the true flux.
    slopes : ndarray, shape (n, F, k, d, d)
        Derivatives by the parameters of each stamp: the first four are shared by all.

    Returns
    -------
    deviance : ndarray, shape (n,)
    score : ndarray, shape (n, K)
        Slope of the log-likelihood by all K parameters.
    information : ndarray, shape (n, K, K)
        Fisher matrix.
    """
    count, fields, k = slopes.shape[:3]
    flux, sky = noise.flux(level), noise.background
    # Counts of every stamp by itself, sky included.
    observed, expected = (
        flux * array.reshape(count * fields, -1).astype(np.float64) + sky
        for array in (images, stamps)
    )
    slopes = flux * slopes.reshape(count * fields, k, -1).astype(np.float64)
    deviance, score, information = poisson_information(observed, expected, slopes)
    # Photons of different fields are independent: their information about the state adds up.
    information = information.reshape(count, fields, k, k)
    score, information = combine_images(score.reshape(count, fields, k), information, 4)
    return deviance.reshape(count, fields).sum(axis=1), score, information


def bound_covariances(
    model: QuadraticModel,
    operator: AlignmentStamps,
    noise: NoiseModel,
    levels: list[float],
    states: np.ndarray,
    unknown_flux: Sequence[bool],
) -> np.ndarray:
    """Compute Cramér–Rao bounds on the covariance of any unbiased estimate of states (n, 4).

    Parameters
    ----------
    model : QuadraticModel
    operator : AlignmentStamps
    noise : NoiseModel
    levels : list of float
        Noise levels λ, L in all.
    states : ndarray, shape (n, 4)
    unknown_flux : sequence of bool
        A bound each: True if flux and place of the stars are unknown, for which the operator's
        stamps must be movable.

    Returns
    -------
    ndarray, shape (len(unknown_flux), L, n, 4, 4)
        Covariances in squared units of the range.
    """
    covariances = np.empty((len(unknown_flux), len(levels), len(states), 4, 4))
    for start in range(0, len(states), STATES_AT_ONCE):
        part = slice(start, start + STATES_AT_ONCE)
        parameters = parameters_of(model, operator, states[part])
        stamps, slopes = stamps_and_slopes(model, operator, parameters)
        for bound, level in np.ndindex(covariances.shape[:2]):
            # The inverse of the Fisher matrix by all parameters; its part for the state is the
            # bound with the others unknown.
            by_parameters = slopes if unknown_flux[bound] else slopes[:, :, :4]
            information = deviance_and_information(
                noise, levels[level], stamps, stamps, by_parameters
            )[2]
            covariances[bound, level, part] = np.linalg.inv(information)[:, :4, :4]
    return covariances


def expected_abs_error(covariances: np.ndarray) -> np.ndarray:
    """Return the mean absolute error of normal errors, √(2/π) σ, (..., K, K) to (..., K)."""
    sigma = np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
    return np.asarray(np.sqrt(2.0 / np.pi) * sigma)


def coma_free_decentre(model: QuadraticModel, tilts: np.ndarray, noll: np.ndarray) -> np.ndarray:
    """Solve for decentres that cancel the field-constant coma of tilts, to first order.

    Along this line tilt and decentre leave hardly more than linear astigmatism, whose sign an
    image in focus does not show: in focus, t and −t on it are twins.

    Parameters
    ----------
    model : QuadraticModel
    tilts : ndarray, shape (n, 2)
        Tilts in units of the range.
    noll : ndarray of int
        Noll indices of the model's coefficients.

    Returns
    -------
    ndarray, shape (n, 2)
        Decentres in units of the range.
    """
    # Slopes S of both comas by the four numbers, mean of the fields: S_d decentre + S_t tilt = 0.
    coma = np.isin(noll, (7, 8))
    slopes = model.coefficients[:, 1:5][:, :, coma].mean(axis=0)
    return -np.linalg.solve(slopes[:2].T, slopes[2:].T @ tilts.T).T


def twin_states(model: QuadraticModel, states: np.ndarray, noll: np.ndarray) -> np.ndarray:
    """Return states with the opposite tilt and the same field-constant coma, shape (n, 4).

    In focus their stamps hardly differ from those of `states`; parameters after the four are
    unchanged.
    """
    tilts = states[:, 2:4]
    decentre = states[:, :2] + coma_free_decentre(model, -2.0 * tilts, noll)
    return np.concatenate([decentre, -tilts, states[:, 4:]], axis=1)
