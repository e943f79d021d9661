"""Distances between modes of posteriors, and the merging of modes that are one maximum.

Inputs: positions, covariances and masses of modes, as `psfdae.sensing.climbing.Peaks` gives them.
The posteriors are of the wavefronts of single stars (`psfdae.sensing.stars`), or of the stars whose
errors are bounded (`psfdae_paper.bounds`).
"""

from __future__ import annotations

import numpy as np


def compute_squared_distance(gap: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the squares of the Mahalanobis distances gᵀ C⁻¹ g of gaps g from M modes.

    Parameters
    ----------
    gap : ndarray, shape (M, n, K)
        Differences of n positions from each mode.
    covariance : ndarray, shape (M, K, K)
        Covariance C of each mode.

    Returns
    -------
    ndarray, shape (M, n)
        1 at a distance of one standard deviation.
    """
    weighted_gap = np.linalg.solve(covariance, gap.swapaxes(1, 2)).swapaxes(1, 2)
    return np.asarray((gap * weighted_gap).sum(axis=2))


def merge_modes(
    position: np.ndarray, covariance: np.ndarray, evidence: np.ndarray, group: np.ndarray
) -> np.ndarray:
    """Find the modes that are the same maximum: less than one standard deviation apart.

    Parameters
    ----------
    position, covariance : ndarray, shapes (M, K) and (M, K, K)
        Position and covariance of each mode.
    evidence : ndarray, shape (M,)
        Logarithm of the mass of each mode.
    group : ndarray of int, shape (M,)
        Modes of different groups are never the same.

    Returns
    -------
    ndarray of int, shape (M,)
        Index of the mode of greatest evidence at the maximum of each mode; its own if it is that
        one.
    """
    representative = np.arange(len(evidence))
    distinct: dict[int, list[int]] = {}
    # In descending order of evidence, so that each mode is compared with better ones.
    for mode in np.argsort(-evidence, kind="stable").tolist():
        better_modes = distinct.setdefault(int(group[mode]), [])
        gap = (position[mode] - position[better_modes])[:, None]
        is_near = compute_squared_distance(gap, covariance[better_modes])[:, 0] < 1.0
        if is_near.any():
            representative[mode] = better_modes[is_near.argmax()]
        else:
            better_modes.append(mode)
    return representative
