"""Sums over the laws of a mixture, and what all mixtures take a star's flux for."""

from __future__ import annotations

import numpy as np

LEAST_WEIGHT = 1e-3
"""Least weight of a law that counts in the sum over a mixture."""

FLUX_SIGMA = 0.2
"""Standard deviation of a star's flux over what it was found to be before."""


def mixing_weights(log: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (n, K) of K laws from ln of their probabilities, and ln of these' sum, (n,).

    Those below `LEAST_WEIGHT` are 0.
    """
    peak = log.max(axis=1)
    weight = np.exp(log - peak[:, None])
    total = weight.sum(axis=1)
    weight[weight < LEAST_WEIGHT * total[:, None]] = 0.0
    return weight / weight.sum(axis=1, keepdims=True), peak + np.log(total)
