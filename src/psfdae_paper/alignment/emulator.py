"""Stamps of any state, and their derivatives, from those of many states that are there already.

Stamps are a Gaussian process of the state with unknown mean (ordinary kriging; Rasmussen and
Williams 2006, sections 2.2 and 4.2.1): weighted sums of the stamps of the nearest states, whose
weights are smooth functions of the state. Mirror images are states, too. A few nearest states do,
because the edges of comatic images that pass from pixel to pixel leave nothing to learn from
distant ones; polynomials over the whole range fail for the same reason.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from psfdae_paper.alignment.fisher import CHUNK, stamps_and_slopes
from psfdae_paper.alignment.stamps import AlignmentStamps
from psfdae_paper.alignment.telescope import QuadraticModel, design_states, mirror_symmetries
from psfdae_paper.configuration.alignment import Fit

LENGTH = 3.0
"""Length of the correlation in distances of the farthest neighbour."""

NUGGET = 1e-8
"""Variance of the rounding of stamps, in that of the process."""


class StampEmulator:
    """Stamps of states and their derivatives, at a small part of the cost of the optics.

    Parameters
    ----------
    model : QuadraticModel
    operator : AlignmentStamps
        The optics that made the stamps.
    states : ndarray, shape (n, 4)
        Within ±1 in units of the range. The first `settings.outer_states` are also stretched to
        between there and `settings.limit`, because nothing can be extrapolated.
    stamps : ndarray, shape (n, F, d, d)
        Of these states, noise-free.
    settings : config group `fit`
    """

    def __init__(
        self,
        model: QuadraticModel,
        operator: AlignmentStamps,
        states: np.ndarray,
        stamps: np.ndarray,
        settings: Fit,
    ) -> None:
        outer = states[: settings.outer_states]
        reach = np.linspace(1.0, settings.limit, len(outer))[:, None]
        outer = outer * reach / np.abs(outer).max(axis=1, keepdims=True)
        self.stamps = np.concatenate([stamps, operator(model(outer))[0]])
        self.mirrors = mirror_symmetries(stamps.shape[1] - 1)
        states = np.concatenate([states, outer])
        every = np.concatenate([mirror.states(states) for mirror in self.mirrors])
        # States are the nearer the less their stamps differ.
        slopes = stamps_and_slopes(model, operator, design_states())[1]
        changes = np.moveaxis(slopes, 2, 0).reshape(4, -1).astype(np.float64)
        self._metric = np.linalg.cholesky(changes @ changes.T)
        self._places = every @ self._metric
        self._tree = KDTree(self._places)
        self.neighbours = min(settings.neighbours, len(every))

    def __call__(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Stamps (n, F, d, d) of states (n, 4), and their derivatives, (n, F, 4, d, d)."""
        shape = self.stamps.shape[1:]
        out = np.zeros((len(states), 5, *shape), np.float32)
        for start in range(0, len(states), CHUNK):
            chosen, weights = self._weights(states[start : start + CHUNK] @ self._metric)
            for row, (near, weight) in enumerate(zip(chosen, weights, strict=True), start):
                which, rows = np.divmod(near, len(self.stamps))
                for index, mirror in enumerate(self.mirrors):
                    own = which == index
                    known = self.stamps[rows[own]].reshape(-1, np.prod(shape))
                    out[row] += mirror.stamps((weight[:, own] @ known).reshape(5, *shape))
        return out[:, 0], np.moveaxis(out[:, 1:], 1, 2)

    def _weights(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Neighbours (n, k) of places (n, 4), their weights and their derivatives, (n, 5, k)."""
        distance, chosen = self._tree.query(places, self.neighbours)
        unit = LENGTH * distance[:, -1:, None]
        away = (places[:, None] - self._places[chosen]) / unit
        others = (away[:, :, None] - away[:, None]) ** 2
        known, _ = matern(others.sum(axis=-1))
        known += NUGGET * np.eye(self.neighbours)
        value, slope = matern((away**2).sum(axis=-1))
        asked = np.stack([value, *np.moveaxis(slope[..., None] * away, 2, 0)], axis=2)
        solved = np.linalg.solve(known, np.pad(asked, ((0, 0), (0, 0), (0, 1)), constant_values=1))
        weights, even = solved[..., :5], solved[..., 5:]
        # Weights sum to 1, their derivatives to 0.
        missing = np.eye(5)[0] - weights.sum(axis=1, keepdims=True)
        weights += even * missing / even.sum(axis=1, keepdims=True)
        weights[..., 1:] = weights[..., 1:] / unit @ self._metric.T
        return chosen, np.moveaxis(weights, 1, 2).astype(np.float32)


def matern(squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matérn correlation of ν = 5/2 of squared distances r², and its derivative by r²/2."""
    r = np.sqrt(5.0 * squares)
    fall = np.exp(-r)
    return (1.0 + r + r**2 / 3.0) * fall, -5.0 / 3.0 * (1.0 + r) * fall
