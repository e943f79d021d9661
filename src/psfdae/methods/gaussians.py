"""Normal distributions with a covariance of low rank, seen through noise of any variance.

A stamp with noise of variance s per pixel has the covariance G = C + s, where C is that of the
stars without noise. Few directions have a variance that noise does not hide: C is diagonal along
its leading axes V and a multiple of 1 beyond them, so that G⁻¹ is known for every s at once
(`AxesInverse`, eq. 4 of docs/mixture.md). For one s alone, Woodbury's formula is faster
(`WoodburyInverse`). For the field, `psfdae.methods.field_nodes.NodeAxes` has the same form of G.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np


class NoisyCovariance(Protocol):
    """Covariance G = C + s of stars with noise, of which the inverse is known.

    Noise variances s of n stars are arrays of shape (n, 1). Rows are stars of the same n, or, where
    it says so, all are seen with every noise variance.
    """

    def solve(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return the product of rows (n, m) with G⁻¹, (n, m)."""

    def mahalanobis2(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ xᵀ of each of the rows x (n, m), with its own noise, (n,)."""

    def product(self, rows: np.ndarray, vector: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ vᵀ of the rows x (n, m) with one vector v (m,), (n,)."""

    def mahalanobis2_of_all(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ xᵀ of every row x (r, m) for every noise variance, (n, r)."""

    def half_log_det(self, s: np.ndarray) -> np.ndarray:
        """Return ½ ln det G for noise variances s (n,), (n,)."""


class AxesInverse(NamedTuple):
    """G_k⁻¹ of a cluster for any noise variance s above `StarBatch.least_variance` (eq. 4).

    Noise variances s of n stars are arrays of shape (n, 1).

    Attributes
    ----------
    vectors : ndarray, shape (m, a), float32
        Axes V, columns.
    variance : ndarray, shape (a,)
        Variance λ along each axis.
    variance_beyond : float
        Mean variance λ₀ beyond the axes in the m coordinates; infinite if nothing is beyond.
    """

    vectors: np.ndarray
    variance: np.ndarray
    variance_beyond: float

    def _inverse(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return 1/(λ + s) along the axes, (n, a), and 1/(λ₀ + s) beyond them, (n, 1)."""
        variance = self.variance.astype(s.dtype)
        return 1 / (variance + s), 1 / (s.dtype.type(self.variance_beyond) + s)

    def solve(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return the product of rows (n, m) with G⁻¹, (n, m)."""
        along, beyond = self._inverse(s)
        axes = rows @ self.vectors
        # One product with the axes for both: V (λ + s)⁻¹ Vᵀ and the projection V Vᵀ of the rows.
        both = np.vstack([along * axes, axes]) @ self.vectors.T
        return np.asarray(both[: len(rows)] + beyond * (rows - both[len(rows) :]))

    def mahalanobis2(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ xᵀ of each of the rows x (n, m), with its own noise, (n,)."""
        along, beyond = self._inverse(s)
        squares = np.square(rows @ self.vectors)
        squares_beyond = np.square(rows).sum(axis=1) - squares.sum(axis=1)
        return np.asarray((squares * along).sum(axis=1) + squares_beyond * beyond[:, 0])

    def product(self, rows: np.ndarray, vector: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ vᵀ of the rows x (n, m) with one vector v (m,), (n,)."""
        along, beyond = self._inverse(s)
        row_axes, vector_axes = rows @ self.vectors, vector @ self.vectors
        return np.asarray(
            (along * row_axes) @ vector_axes
            + beyond[:, 0] * (rows @ vector - row_axes @ vector_axes)
        )

    def mahalanobis2_of_all(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ xᵀ of every row x (r, m) for every noise variance, (n, r)."""
        along, beyond = self._inverse(s)
        squares = np.square(rows @ self.vectors).T
        return np.asarray(
            along @ squares + beyond * (np.square(rows).sum(axis=1) - squares.sum(axis=0))
        )

    def half_log_det(self, s: np.ndarray) -> np.ndarray:
        """Return ½ ln det G for noise variances s (n,), in the m coordinates, (n,)."""
        dimensions = len(self.vectors) - len(self.variance)
        along = np.log(self.variance + s[:, None]).sum(axis=1)
        beyond = dimensions * np.log(self.variance_beyond + s) if dimensions else 0.0
        return np.asarray(0.5 * (along + beyond))


class ClusterAxes(NamedTuple):
    """Eigenvectors of the covariance C_k of a cluster in the leading w coordinates.

    Attributes
    ----------
    vectors : ndarray, shape (w, w), float32
        Columns, by descending variance.
    variance : ndarray, shape (w,)
        Variance along each.
    total_variance : float
        Sum of the variances.
    """

    vectors: np.ndarray
    variance: np.ndarray
    total_variance: float

    @classmethod
    def of(cls, covariance: np.ndarray) -> ClusterAxes:
        """Return the eigenvectors of a covariance (w, w)."""
        variance, vectors = np.linalg.eigh(covariance)
        return cls(
            vectors=np.ascontiguousarray(vectors[:, ::-1], dtype=np.float32),
            variance=np.maximum(variance[::-1], 0.0),
            total_variance=float(np.trace(covariance)),
        )

    def inverse(self, least_variance: float) -> AxesInverse:
        """Return G_k⁻¹ by the axes of a larger variance, with the mean of the others (eq. 4)."""
        variance = self.variance[self.variance > least_variance]
        dimensions = len(self.variance) - len(variance)
        beyond = (self.total_variance - variance.sum()) / dimensions if dimensions else np.inf
        return AxesInverse(self.vectors[:, : len(variance)], variance, float(beyond))


class WoodburyInverse(NamedTuple):
    """G_k⁻¹ for one noise variance, which takes far less to compute than axes (eq. 5).

    Methods are those of `AxesInverse`; their argument s only says how many results are wanted.

    Attributes
    ----------
    diagonal : ndarray, shape (m,)
        D⁻¹, with G_k = D + UᵀU and a diagonal D.
    rows : ndarray, shape (r, m), float32
        L⁻¹ U D⁻¹, with L Lᵀ = 1 + U D⁻¹ Uᵀ; G_k⁻¹ is D⁻¹ less the products of these.
    half_log : float
        ½ ln det G_k.
    """

    diagonal: np.ndarray
    rows: np.ndarray
    half_log: float

    @classmethod
    def of_stack(cls, diagonal: np.ndarray, rows: np.ndarray) -> Iterator[WoodburyInverse]:
        """Return G⁻¹ of D + UᵀU for a stack of K covariances (eq. 5).

        Parameters
        ----------
        diagonal : ndarray, shape (K, m)
            D.
        rows : ndarray, shape (K, r, m)
            U.
        """
        # U D⁻¹, then L with L Lᵀ = 1 + U D⁻¹ Uᵀ, and ln det G = ln det D + 2 ln det L.
        weighted = rows / diagonal[:, None]
        lower = np.linalg.cholesky(np.eye(rows.shape[1]) + weighted @ rows.transpose(0, 2, 1))
        half_log = 0.5 * np.log(diagonal).sum(axis=1)
        half_log += np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
        solved = (np.linalg.inv(lower) @ weighted).astype(np.float32)
        return map(cls, 1.0 / diagonal, solved, half_log)

    def solve(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return the product of rows (n, m) with G⁻¹, (n, m)."""
        diagonal = self.diagonal.astype(rows.dtype)
        return np.asarray(rows * diagonal - (rows @ self.rows.T) @ self.rows)

    def mahalanobis2(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ xᵀ of each of the rows x (n, m), (n,)."""
        explained = np.square(rows @ self.rows.T).sum(axis=1)
        return np.asarray(np.square(rows) @ self.diagonal.astype(rows.dtype) - explained)

    def product(self, rows: np.ndarray, vector: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ vᵀ of the rows x (n, m) with one vector v (m,), (n,)."""
        return np.asarray(
            rows @ (self.diagonal * vector) - (rows @ self.rows.T) @ (self.rows @ vector)
        )

    def mahalanobis2_of_all(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ xᵀ of every row x (r, m), the same for every s, (n, r)."""
        distance = np.square(rows) @ self.diagonal - np.square(rows @ self.rows.T).sum(axis=1)
        return np.asarray(np.repeat(distance[None], len(s), axis=0))

    def half_log_det(self, s: np.ndarray) -> np.ndarray:
        """Return ½ ln det G, the same for every s (n,), (n,)."""
        return np.full(len(s), self.half_log)
