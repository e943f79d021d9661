"""Summary of the draws from the posteriors of stars: the mode of each draw, and its moments."""

from __future__ import annotations

from typing import Any

import numpy as np

from psfdae.sensing.modes import compute_squared_distance
from psfdae.sensing.stars import StarModes


def nearest_modes(draws: np.ndarray, modes: StarModes) -> np.ndarray:
    """Return the index of the mode that is nearest to every draw by the Mahalanobis distance.

    Parameters
    ----------
    draws : ndarray, shape (m, s, K + 4)
        s draws for each of the m stars with modes: coefficients, position, flux and sky in the
        units of `StarModes.parameters`.
    modes : StarModes
        Modes of these stars.

    Returns
    -------
    ndarray of int, shape (m, s)
        Indices among all modes.
    """
    nearest = np.empty(draws.shape[:2], int)
    for row, star in enumerate(modes.best_modes.star):
        # Distances of all draws from all modes of the star.
        numbers = np.flatnonzero(modes.star == star)
        gap = draws[row] - modes.parameters[numbers][:, None]
        distance = compute_squared_distance(gap, modes.covariance[numbers])
        nearest[row] = numbers[distance.argmin(axis=0)]
    return nearest


def summarise_modes(
    coefficients: np.ndarray, mode_of_draw: np.ndarray, modes: StarModes, prior_sigma: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the table of posterior modes, by star and the most probable first.

    Parameters
    ----------
    coefficients : ndarray, shape (m, s, K)
        Draws of the coefficients in waves.
    mode_of_draw : ndarray of int, shape (m, s)
        Result of `nearest_modes`.
    modes : StarModes
        Modes of the stars.
    prior_sigma : ndarray, shape (n, K)
        Standard deviation of the prior of all n stars, in waves.

    Returns
    -------
    dict of ndarray
        `star` (M,), its index; `probability` (M,), the fraction of its draws; `mean` (M, K) and
        `covariance` (M, K, K) of the coefficients in waves.
    """
    # Draws belong to the nearest mode; a mode without draws is left out.
    k = coefficients.shape[-1]
    rows: list[tuple[Any, ...]] = []
    for row, star in enumerate(modes.best_modes.star):
        # The probability of a mode is its fraction of the star's draws.
        numbers, count = np.unique(mode_of_draw[row], return_counts=True)
        for mode in numbers[np.argsort(-count, kind="stable")]:
            draws = coefficients[row, mode_of_draw[row] == mode]
            # Too few draws do not determine a covariance: the peak's covariance is used.
            if len(draws) > 2 * k:
                covariance = np.atleast_2d(np.cov(draws, rowvar=False))
            else:
                covariance = modes.covariance[mode, :k, :k] * np.outer(
                    prior_sigma[star], prior_sigma[star]
                )
            probability = len(draws) / coefficients.shape[1]
            rows.append((star, probability, draws.mean(axis=0), covariance))
    names, columns = ("star", "probability", "mean", "covariance"), zip(*rows, strict=True)
    return {name: np.array(values) for name, values in zip(names, columns, strict=True)}
