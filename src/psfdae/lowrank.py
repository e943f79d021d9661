"""Covariances that are a diagonal plus few rows, and mixtures of normal laws with them.

By Woodbury's identity (D + b XᵀX)⁻¹ = D⁻¹ − AᵀA with A = L⁻¹ X D⁻¹ and L Lᵀ = 1/b + X D⁻¹Xᵀ, of
which no matrix is larger than the number of rows.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

NOISE_STEP = 0.4
"""Step in ln s between noise variances s of single stars that share a factorisation; s is then
wrong by half of it at most, and the error grows by the square."""

LEAST_WEIGHT = 1e-3
"""Least weight of a law that counts in the sum over a mixture."""

FLUX_SIGMA = 0.2
"""Standard deviation of a star's flux over what it was found to be before."""


class Factorised(NamedTuple):
    """Inverse of a diagonal D plus rows X: D⁻¹ − AᵀA, and its determinant.

    Attributes
    ----------
    low : ndarray, shape (r, m + q), or (n, r, m + q) of several
        A in the leading m coordinates, where X is not 0; then L⁻¹ of q further columns.
    half_det : float, or ndarray, shape (n,)
        ½ ln of the determinant over that of D.
    """

    low: np.ndarray
    half_det: Any


def factorised(
    diagonal: np.ndarray, rows: np.ndarray, weight: float = 1.0, beside: np.ndarray | None = None
) -> Factorised:
    """Factorise D + b XᵀX, for one set of rows or for several of the same number at once.

    Parameters
    ----------
    diagonal : ndarray, shape (m,)
        D in the coordinates of the rows.
    rows : ndarray, shape (r, m) or (n, r, m)
        X.
    weight : float
        b.
    beside : ndarray, shape (r, q) or (n, r, q), optional
        Further columns of which L⁻¹ is wanted.
    """
    size = rows.shape[-2]
    weighted = rows / diagonal
    cholesky = np.linalg.cholesky(np.eye(size) / weight + weighted @ rows.swapaxes(-1, -2))
    columns = weighted if beside is None else np.concatenate([weighted, beside], axis=-1)
    if rows.ndim == 2:
        from scipy.linalg.blas import dtrsm

        low = dtrsm(1.0, cholesky.T, columns.T, side=1).T  # a third of solve_triangular's time
    else:  # many small ones: their inverses take less than a call for each
        low = np.linalg.inv(cholesky) @ columns
    half_det = np.log(np.diagonal(cholesky, axis1=-2, axis2=-1)).sum(axis=-1)
    return Factorised(low, half_det + 0.5 * size * np.log(weight))


def mixing_weights(log: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights (n, K) of K laws from ln of their probabilities, and ln of these' sum, (n,).

    Those below `LEAST_WEIGHT` are 0.
    """
    peak = log.max(axis=1)
    weight = np.exp(log - peak[:, None])
    total = weight.sum(axis=1)
    weight[weight < LEAST_WEIGHT * total[:, None]] = 0.0
    return weight / weight.sum(axis=1, keepdims=True), peak + np.log(total)


Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


class Kept(Generic[Key, Value]):
    """What was computed for some keys and laws; of more keys than fit, the first are dropped."""

    def __init__(self) -> None:
        self._of: dict[Key, dict[int, Value]] = {}

    def __call__(self, key: Key, law: int, make: Callable[[], Value]) -> Value:
        """What there is for a key and the number of a law, or is made now."""
        known = self._of.setdefault(key, {})  # whole, whatever another thread drops
        if law not in known:
            known[law] = make()
        return known[law]

    def missing(self, key: Key, laws: Iterable[int]) -> list[int]:
        """Those of some laws of which nothing is kept for a key."""
        known = self._of.get(key, {})
        return [law for law in laws if law not in known]

    def trim(self, most: int) -> None:
        """Drop all but the `most` last keys."""
        for old in list(self._of)[:-most]:
            self._of.pop(old, None)
