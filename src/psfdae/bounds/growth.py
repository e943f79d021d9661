"""How an estimate over a bank changes with the size of the bank."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from psfdae.bounds.posterior import PosteriorSums, merge

TIGHT = 0.05
"""A bank is dense enough if its last fourfold growth changes the error by at most this."""

FITTED_POINTS = 4
"""Least number of bank sizes to which three parameters are fitted."""


def segments(count: int, largest: int = 16) -> int:
    """Number of equal parts of a bank: the largest power of two up to `largest` and `count`."""
    return 1 << (min(largest, count).bit_length() - 1)


def nested_means(
    parts: Sequence[PosteriorSums], measure: Callable[[PosteriorSums], np.ndarray]
) -> dict[int, np.ndarray]:
    """A per-star quantity for banks of one, two, four … parts.

    A bank of k parts can be had several times from the same parts; the mean over
    those disjoint banks is taken, which steadies the small sizes.

    Parameters
    ----------
    parts : sequence of PosteriorSums
        Sums over equally large disjoint parts; their number is a power of two.
    measure : function
        From the sums over a bank to an array; its mean is returned by number of parts.
    """
    means: dict[int, np.ndarray] = {}
    level = list(parts)
    size = 1
    while True:
        means[size] = np.mean([measure(sums) for sums in level], axis=0)
        if len(level) == 1:
            return means
        level = [merge(level[i : i + 2]) for i in range(0, len(level), 2)]
        size *= 2


def last_change(errors: Sequence[float]) -> float:
    """|error(M/4)/error(M) − 1| of banks that double in size; NaN for fewer than three."""
    if len(errors) < 3:
        return float("nan")
    return abs(errors[-3] / errors[-1] - 1.0)


def extrapolate(draws: np.ndarray, errors: np.ndarray) -> tuple[float, float, float]:
    """Fit error(M) = a + b M^−c and return a, c and the RMS of the relative residuals.

    Parameters
    ----------
    draws : ndarray, shape (k,)
        Bank sizes M.
    errors : ndarray, shape (k,)
        Mean squared errors, all positive.

    Returns
    -------
    limit, exponent, residual : float
        NaN if there are fewer than four sizes. The limit lies between 0 and the
        smallest error: the fit extrapolates, it proves nothing.
    """
    from scipy.optimize import least_squares

    if len(draws) < FITTED_POINTS:
        return (float("nan"),) * 3
    size = np.asarray(draws, float) / draws[-1]
    scale = float(np.min(errors))
    ratio = np.asarray(errors) / scale

    def misfit(parameters: np.ndarray) -> np.ndarray:
        limit, excess, exponent = parameters
        return (limit + excess * size**-exponent) / ratio - 1.0

    start = (0.9, max(ratio[-1] - 0.9, 1e-3), 0.7)
    fit = least_squares(misfit, start, bounds=((0.0, 0.0, 0.05), (1.0, np.inf, 3.0)), xtol=1e-12)
    return scale * fit.x[0], float(fit.x[2]), float(np.sqrt(np.mean(fit.fun**2)))
