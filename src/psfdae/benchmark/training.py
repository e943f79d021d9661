"""Which training is long enough: the Pareto front of error and time, and its knee."""

from __future__ import annotations

import numpy as np

WORTHWHILE = 0.9
"""A longer training must bring the error to this fraction per doubling of the time."""


def pareto(time: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Points that no other point beats in both time and error.

    Parameters
    ----------
    time, error : ndarray, shape (n,)

    Returns
    -------
    ndarray of int
        Indices of the front, by ascending time.
    """
    order = np.lexsort((error, time))
    best = np.minimum.accumulate(error[order])
    leads = np.r_[True, error[order][1:] < best[:-1]]
    return order[leads]


def knee(time: np.ndarray, error: np.ndarray, worthwhile: float = WORTHWHILE) -> int:
    """The point of the front beyond which more time is not worth it.

    From the cheapest point on, a later point of the front is taken if it lowers
    the error to `worthwhile` or less per doubling of the time.

    Parameters
    ----------
    time, error : ndarray, shape (n,)
        Positive.

    Returns
    -------
    int
        Index of the knee.
    """
    front = pareto(time, error)
    chosen = front[0]
    for candidate in front[1:]:
        doublings = np.log2(time[candidate] / time[chosen])
        if error[candidate] / error[chosen] <= worthwhile**doublings:
            chosen = candidate
    return int(chosen)


def stopping_point(scores: np.ndarray, patience: int) -> int:
    """Index of the validation after which a training with this patience stops.

    A training is deterministic, so a full history tells what `train.patience`
    would have done.

    Parameters
    ----------
    scores : ndarray, shape (n,)
        Validation errors in order.
    patience : int
        Validations without a better one.
    """
    best = np.minimum.accumulate(scores)
    since = np.arange(scores.size) - np.searchsorted(-best, -best, side="left")
    stale = np.flatnonzero(since >= patience)
    return int(stale[0]) if stale.size else scores.size - 1
