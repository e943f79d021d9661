"""Normal distributions with a covariance of low rank, with noise of any variance.

A stamp with noise of variance s per pixel has the covariance G = C + s, where C is the covariance
of stars without noise. Few directions have a variance above the noise: C is approximated as
diagonal along its leading axes V and a multiple of 1 beyond them, so that G⁻¹ is known for every s
(`AxesInverse`, eq. 4 of docs/mixture.md). For a single s, Woodbury's formula is faster
(`WoodburyInverse`). For the field, `psfdae.methods.field.nodes.NodeAxes` has the same form of G.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class AxesInverse(NamedTuple):
    """G_k⁻¹ of a cluster for any noise variance s of a bin or above it (eq. 4).

    Noise variances s of n stars are arrays of shape (n, 1). Rows are the same n stars, except where
    all rows are combined with every noise variance.

    Attributes
    ----------
    vectors : ndarray, shape (m, a), float32
        Axes V, columns.
    variance : ndarray, shape (a,)
        Variance λ along each axis.
    variance_beyond : float
        Mean variance λ₀ beyond the axes in the m coordinates; infinite if the axes are complete.
    """

    vectors: np.ndarray
    variance: np.ndarray
    variance_beyond: float

    def _inverse(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return 1/(λ + s) along the axes, (n, a), and 1/(λ₀ + s) beyond them, (n, 1)."""
        # In the precision of the noise variances, so that products with images stay in theirs.
        variance = self.variance.astype(s.dtype)
        return 1 / (variance + s), 1 / (s.dtype.type(self.variance_beyond) + s)

    def solve(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return the product of rows (n, m) with G⁻¹, (n, m)."""
        along, gain_beyond = self._inverse(s)
        axes = rows @ self.vectors
        # V (λ + s)⁻¹ Vᵀ of the rows, and their projection V Vᵀ, by one product with the axes.
        product, projection = np.split(np.vstack([along * axes, axes]) @ self.vectors.T, 2)
        return np.asarray(product + gain_beyond * (rows - projection))

    def mahalanobis2(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ xᵀ of each of the rows x (n, m), with its own noise, (n,)."""
        along, gain_beyond = self._inverse(s)
        # |x|² is the sum of the squares along the axes and beyond them.
        squares = np.square(rows @ self.vectors)
        squares_beyond = np.square(rows).sum(axis=1) - squares.sum(axis=1)
        return np.asarray((squares * along).sum(axis=1) + squares_beyond * gain_beyond[:, 0])

    def product(self, rows: np.ndarray, vector: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ vᵀ of the rows x (n, m) with one vector v (m,), (n,)."""
        along, gain_beyond = self._inverse(s)
        # x V (λ + s)⁻¹ Vᵀ vᵀ, plus (λ₀ + s)⁻¹ times the product beyond the axes.
        row_axes, vector_axes = rows @ self.vectors, vector @ self.vectors
        return np.asarray(
            (along * row_axes) @ vector_axes
            + gain_beyond[:, 0] * (rows @ vector - row_axes @ vector_axes)
        )

    def mahalanobis2_pairs(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ xᵀ of every row x (r, m) for every noise variance, (n, r)."""
        along, gain_beyond = self._inverse(s)
        # As `mahalanobis2`, for all pairs of a noise variance and a row.
        squares = np.square(rows @ self.vectors).T
        return np.asarray(
            along @ squares + gain_beyond * (np.square(rows).sum(axis=1) - squares.sum(axis=0))
        )

    def half_log_det(self, s: np.ndarray) -> np.ndarray:
        """Return ½ ln det G for noise variances s (n,), in the m coordinates, (n,)."""
        dimensions = len(self.vectors) - len(self.variance)
        # ½ Σ ln(λ + s) over the axes, and (m − a)/2 times ln(λ₀ + s) beyond them.
        along = np.log(self.variance + s[:, None]).sum(axis=1)
        log_beyond = dimensions * np.log(self.variance_beyond + s) if dimensions else 0.0
        return np.asarray(0.5 * (along + log_beyond))


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
    def from_covariance(cls, covariance: np.ndarray) -> ClusterAxes:
        """Return the eigenvectors of a covariance (w, w)."""
        # By descending variance; rounding may make the smallest ones negative.
        variance, vectors = np.linalg.eigh(covariance)
        return cls(
            vectors=np.ascontiguousarray(vectors[:, ::-1], dtype=np.float32),
            variance=np.maximum(variance[::-1], 0.0),
            total_variance=float(np.trace(covariance)),
        )

    def inverse(self, least_variance: float) -> AxesInverse:
        """Return G_k⁻¹ by the axes of a larger variance, with the mean of the others (eq. 4)."""
        # λ₀: the trace without the axes, over the number of dimensions beyond them.
        variance = self.variance[self.variance > least_variance]
        dimensions = len(self.variance) - len(variance)
        sum_beyond = self.total_variance - variance.sum()
        variance_beyond = float(sum_beyond / dimensions) if dimensions else np.inf
        return AxesInverse(self.vectors[:, : len(variance)], variance, variance_beyond)


class WoodburyInverse(NamedTuple):
    """G_k⁻¹ for one noise variance, which takes far less time than the axes (eq. 5).

    It has the methods of `AxesInverse`, whose argument s only determines the number of results.

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
    def build(cls, diagonal: np.ndarray, rows: np.ndarray) -> WoodburyInverse:
        """Return G⁻¹ of D + UᵀU with D (m,) and U (r, m) (eq. 5)."""
        # U D⁻¹, then L with L Lᵀ = 1 + U D⁻¹ Uᵀ, and ln det G = ln det D + 2 ln det L.
        weighted_rows = rows / diagonal
        lower = np.linalg.cholesky(np.eye(len(rows)) + weighted_rows @ rows.T)
        half_log = 0.5 * np.log(diagonal).sum() + np.log(lower.diagonal()).sum()
        solution = (np.linalg.inv(lower) @ weighted_rows).astype(np.float32)
        return cls(1.0 / diagonal, solution, float(half_log))

    def solve(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return the product of rows (n, m) with G⁻¹, (n, m)."""
        # x D⁻¹ − x (L⁻¹ U D⁻¹)ᵀ (L⁻¹ U D⁻¹).
        diagonal = self.diagonal.astype(rows.dtype)
        return np.asarray(rows * diagonal - (rows @ self.rows.T) @ self.rows)

    def mahalanobis2(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ xᵀ of each of the rows x (n, m), (n,)."""
        # x D⁻¹ xᵀ minus the part along the rows.
        explained_part = np.square(rows @ self.rows.T).sum(axis=1)
        return np.asarray(np.square(rows) @ self.diagonal.astype(rows.dtype) - explained_part)

    def product(self, rows: np.ndarray, vector: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ vᵀ of the rows x (n, m) with one vector v (m,), (n,)."""
        return np.asarray(
            rows @ (self.diagonal * vector) - (rows @ self.rows.T) @ (self.rows @ vector)
        )

    def mahalanobis2_pairs(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Return x G⁻¹ xᵀ of every row x (r, m), the same for every s, (n, r)."""
        # The noise variance is the same for all.
        distance = np.square(rows) @ self.diagonal - np.square(rows @ self.rows.T).sum(axis=1)
        return np.asarray(np.repeat(distance[None], len(s), axis=0))

    def half_log_det(self, s: np.ndarray) -> np.ndarray:
        """Return ½ ln det G, the same for every s (n,), (n,)."""
        return np.full(len(s), self.half_log)


NoisyCovariance = AxesInverse | WoodburyInverse
"""Covariance G = C + s of stars of a cluster with noise, in the form of its inverse."""
