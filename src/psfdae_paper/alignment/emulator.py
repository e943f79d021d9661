"""Interpolation of the stamps of any state, and of their derivatives, from many known states.

Stamps are a Gaussian process of the state with unknown mean (ordinary kriging; Rasmussen and
Williams 2006, sections 2.2 and 4.2.1): weighted sums of the stamps of the nearest states, whose
weights are smooth functions of the state. Mirror images are states, too. A few nearest states are
enough: the edges of comatic images pass from pixel to pixel, so that distant states are hardly
correlated with them. Polynomials over the whole range fail for the same reason.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from psfdae_paper.alignment.likelihood import StateOptics
from psfdae_paper.alignment.telescope import design_states, mirror_symmetries
from psfdae_paper.configuration.alignment import Fit


class StampEmulator:
    """Interpolator of stamps and their derivatives, at a small fraction of the cost of the optics.

    Parameters
    ----------
    optics : StateOptics
        The optics that made the stamps, which are not movable.
    states : ndarray, shape (n, 4)
        States within ±1 in units of the range. The first `settings.outer_states` are also stretched
        to between there and `settings.limit`, because nothing can be extrapolated.
    stamps : ndarray, shape (n, F, d, d)
        Noise-free stamps of these states.
    settings : Fit
        Group `fit`: number of neighbours, and how far states are stretched.
    """

    def __init__(
        self, optics: StateOptics, states: np.ndarray, stamps: np.ndarray, settings: Fit
    ) -> None:
        # States outside the range: their largest number is stretched to 1 … limit.
        outer_states = states[: settings.outer_states]
        reach = np.linspace(1.0, settings.limit, len(outer_states))[:, None]
        outer_states = outer_states * reach / np.abs(outer_states).max(axis=1, keepdims=True)
        self.stamps = np.concatenate([stamps, optics.operator(optics.model(outer_states))[0]])
        self.mirrors = mirror_symmetries(stamps.shape[1] - 1)
        states = np.concatenate([states, outer_states])
        all_states = np.concatenate([mirror.states(states) for mirror in self.mirrors])
        # The distance of two states measures how much their stamps differ: with L Lᵀ = Σ ∂p ∂pᵀ
        # over the pixels of 25 states, the distance of two states is |(t − t')ᵀ L|.
        slopes = optics(design_states())[1]
        changes = np.moveaxis(slopes, 2, 0).reshape(4, -1).astype(np.float64)
        self._metric = np.linalg.cholesky(changes @ changes.T)
        self._points = all_states @ self._metric
        self._tree = KDTree(self._points)
        self.neighbours = min(settings.neighbours, len(all_states))

    def __call__(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Interpolate stamps (n, F, d, d) of states (n, 4), and their derivatives.

        Derivatives have the shape (n, F, 4, d, d).
        """
        shape = self.stamps.shape[1:]
        sums = np.zeros((len(states), 5, *shape), np.float32)
        # The equations of 64 states are in memory together.
        for start in range(0, len(states), 64):
            points = states[start : start + 64] @ self._metric
            for row, (neighbour, weight) in enumerate(
                zip(*self._weights(points), strict=True), start
            ):
                # Neighbours by mirror image: each image is mirrored once, as a weighted sum.
                mirror_number, state_number = np.divmod(neighbour, len(self.stamps))
                for number, mirror in enumerate(self.mirrors):
                    in_mirror = mirror_number == number
                    stamps = self.stamps[state_number[in_mirror]].reshape(-1, np.prod(shape))
                    weighted_sum = (weight[:, in_mirror] @ stamps).reshape(5, *shape)
                    sums[row] += mirror.stamps(weighted_sum)
        return sums[:, 0], np.moveaxis(sums[:, 1:], 1, 2)

    def _weights(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return neighbours of points (n, 4), and their weights with derivatives by the state.

        Returns
        -------
        neighbour : ndarray of int, shape (n, k)
        weights : ndarray, shape (n, 5, k), float32
            The weights, then their four derivatives.
        """
        distance, neighbour = self._tree.query(points, self.neighbours)
        # The k nearest of all states and mirror images. Correlation length: three times the
        # distance of the farthest of them.
        unit = 3.0 * distance[:, -1:, None]
        away = (points[:, None] - self._points[neighbour]) / unit
        # Covariance K of the neighbours. The small variance 1e-8 is the rounding of stamps.
        squares = (away[:, :, None] - away[:, None]) ** 2
        covariance, _ = matern(squares.sum(axis=-1))
        covariance += 1e-8 * np.eye(self.neighbours)
        # Covariance k of point and neighbours, and its derivatives by the point.
        value, slope = matern((away**2).sum(axis=-1))
        to_place = np.stack([value, *np.moveaxis(slope[..., None] * away, 2, 0)], axis=2)
        # K⁻¹ k, and K⁻¹ 1 in the last column.
        with_ones = np.pad(to_place, ((0, 0), (0, 0), (0, 1)), constant_values=1)
        solution = np.linalg.solve(covariance, with_ones)
        weights, of_ones = solution[..., :5], solution[..., 5:]
        # The mean is unknown: weights must sum to 1, their derivatives to 0.
        missing = np.eye(5)[0] - weights.sum(axis=1, keepdims=True)
        weights += of_ones * missing / of_ones.sum(axis=1, keepdims=True)
        # From derivatives by the scaled point to derivatives by the state.
        weights[..., 1:] = weights[..., 1:] / unit @ self._metric.T
        return neighbour, np.moveaxis(weights, 1, 2).astype(np.float32)


def matern(squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the Matérn correlation of ν = 5/2 of squared distances, and its derivative by r²/2.

    With r = √5 × distance it is (1 + r + r²/3) e⁻ʳ (Rasmussen and Williams 2006, equation 4.17).
    """
    # Derivative by u = distance²/2: dr/du = 5/r, so it is −(r/3) (1 + r) e⁻ʳ · 5/r.
    r = np.sqrt(5.0 * squares)
    decay = np.exp(-r)
    return (1.0 + r + r**2 / 3.0) * decay, -5.0 / 3.0 * (1.0 + r) * decay
