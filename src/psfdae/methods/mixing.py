"""Weights of the parts of a mixture, and the prior of a star's flux in all mixtures."""

from __future__ import annotations

import numpy as np

LEAST_WEIGHT = 1e-3
"""Minimum weight of a part in the sum over a mixture."""

FLUX_SIGMA = 0.2
"""Relative standard deviation of a star's flux about its first estimate."""


def mixing_weights(log: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of the parts of a mixture, such as its nodes or clusters.

    Parameters
    ----------
    log : ndarray, shape (n, K)
        ln of prior times likelihood of each of K parts, for n stars.

    Returns
    -------
    weight : ndarray, shape (n, K)
        Weights of sum 1; those below `LEAST_WEIGHT` are 0.
    evidence : ndarray, shape (n,)
        ln of the sum of prior times likelihood over all parts.
    """
    # Relative to the largest one, so that exponentials do not overflow.
    peak = log.max(axis=1)
    weight = np.exp(log - peak[:, None])
    total = weight.sum(axis=1)
    weight[weight < LEAST_WEIGHT * total[:, None]] = 0.0
    return weight / weight.sum(axis=1, keepdims=True), peak + np.log(total)
