"""Correlations of errors, with confidence intervals."""

from __future__ import annotations

import numpy as np

LEAST_SAMPLES = 4
"""Fisher's z has the standard error 1/√(n − 3): fewer samples have no interval."""


def error_correlation(
    errors: np.ndarray, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pearson correlations of signed errors with intervals from Fisher's z.

    z = artanh r is nearly normal with the standard error 1/√(n − 3) for
    independent, jointly normal errors (Fisher 1921, Metron 1, 3).

    Parameters
    ----------
    errors : ndarray, shape (n, k)
        One row per sample, one column per parameter, any unit.
    confidence : float
        Probability of the two-sided interval, 0 … 1.

    Returns
    -------
    matrix, low, high : ndarray, shape (k, k)
        Correlations and the ends of their intervals; 1 on the diagonal. A column
        without variance correlates with nothing: its row and column are NaN,
        diagonal included, and no warning is given. With fewer than four samples
        the intervals are NaN off the diagonal.

    Raises
    ------
    ValueError
        If there is no sample, or an error is not finite.
    """
    from scipy.stats import norm

    errors = np.asarray(errors, np.float64)
    if not errors.size or not np.isfinite(errors).all():
        raise ValueError(f"errors of shape {errors.shape}: must be at least one and all finite")
    count = len(errors)
    varies = np.ptp(errors, axis=0) > 0
    # In units of the largest deviation, so that no square under- or overflows.
    deviation = errors - errors.mean(axis=0)
    deviation = deviation / np.where(varies, np.abs(deviation).max(axis=0), 1.0)
    length = np.where(varies, np.sqrt((deviation**2).sum(axis=0)), 1.0)
    matrix = np.clip((deviation / length).T @ (deviation / length), -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    with np.errstate(divide="ignore"):
        z = np.arctanh(matrix)
    half = norm.isf(0.5 * (1.0 - confidence)) / np.sqrt(max(count - 3, 1))
    low, high = np.tanh(z - half), np.tanh(z + half)
    if count < LEAST_SAMPLES:
        off = ~np.eye(len(matrix), dtype=bool)
        low[off] = high[off] = np.nan
    for array in (matrix, low, high):
        array[~varies, :] = array[:, ~varies] = np.nan
    return matrix, low, high
