"""Clusters of similar training stars: their normal distributions, without and with noise.

Equations are numbered as on the page docs/mixture.md. `psfdae.methods.mixture.prior` makes
the clusters of a mixture; `psfdae.methods.mixture.gaussians` has the algebra of their
covariances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from psfdae.methods.mixture.gaussians import AxesInverse, ClusterAxes, WoodburyInverse


class Cluster(NamedTuple):
    """One cluster of a mixture with its covariances, all conditional on the position.

    Attributes
    ----------
    residuals, reference_residuals : ndarray, shape (r, P)
        Residuals X_k in coordinates and Y_k in pixels, or fewer rows with the same products.
    reference_square : ndarray, shape (P,)
        Diagonal of YᵀY.
    slope, reference_slope : ndarray, shape (q, P)
        Change of the means per unit of the position.
    position_whitening : ndarray, shape (q, q)
        Inverse of the Cholesky factor of P_k, the covariance of the positions.
    common_factor, residual_factor : float
        Factors of S and of XᵀX in C_k: ν/(n_k + ν) and 1/(n_k + ν).
    """

    residuals: np.ndarray
    reference_residuals: np.ndarray
    reference_square: np.ndarray
    slope: np.ndarray
    reference_slope: np.ndarray
    position_whitening: np.ndarray
    common_factor: float
    residual_factor: float


def remove_slope(
    residuals: np.ndarray, position: np.ndarray, inverse: np.ndarray, shrinkage: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals without a linear change with the position, and its slope (eq. 9).

    Parameters
    ----------
    residuals : ndarray, shape (n, m)
        Residuals X about the mean, without the common slope of all clusters.
    position : ndarray, shape (n, q)
        Whitened positions p about their mean.
    inverse : ndarray, shape (q, q)
        (pᵀp + ν)⁻¹.
    shrinkage : float
        Weight ν of the common slope, as a number of stars.

    Returns
    -------
    rows : ndarray, shape (n + q, m)
        X − p B, and the rows √ν B.
    slope : ndarray, shape (q, m)
        B, the difference of the cluster's slope from the common one.
    """
    # Ridge regression: B minimises |X − p B|² + ν |B|²; both terms are sums of squares of the rows.
    slope = (inverse @ (position.T @ residuals)).astype(np.float32)
    remaining = residuals - position.astype(np.float32) @ slope
    return np.vstack([remaining, np.float32(np.sqrt(shrinkage)) * slope]), slope


@dataclass
class ClusterInverses:
    """Inverses G_k⁻¹ of the covariances of clusters with noise, with a cache.

    Attributes
    ----------
    clusters : sequence of Cluster
        Clusters of the mixture.
    variance : ndarray, shape (P,)
        Eigenvalues of S, the common covariance of all clusters.
    """

    clusters: Sequence[Cluster]
    variance: np.ndarray
    _axes: dict[tuple[int, int], ClusterAxes] = field(default_factory=dict, init=False)
    _woodbury: dict[tuple[int, float], dict[int, WoodburyInverse]] = field(
        default_factory=dict, init=False
    )

    def invert_any(self, k: int, width: int, least_variance: float) -> AxesInverse:
        """Return G_k⁻¹ of cluster k in the leading coordinates for every noise variance (eq. 4).

        Axes with at most the least variance are replaced by their mean variance.

        Parameters
        ----------
        k : int
            Index of the cluster.
        width : int
            Number of leading coordinates.
        least_variance : float
            Minimum variance of an axis that is used individually.
        """
        if (k, width) not in self._axes:
            # C_k = (X_kᵀ X_k + ν S) / (n_k + ν), with S diagonal in these coordinates (eq. 2).
            cluster = self.clusters[k]
            rows = cluster.residuals[:, :width].astype(np.float64)
            covariance = cluster.residual_factor * (rows.T @ rows)
            covariance[np.diag_indices(width)] += cluster.common_factor * self.variance[:width]
            self._axes[k, width] = ClusterAxes.from_covariance(covariance)
        # The eigenvectors are the same for every noise; the number of relevant ones depends on it.
        return self._axes[k, width].inverse(least_variance)

    def invert_one(self, k: int, width: int, s: float) -> WoodburyInverse:
        """Return G_k⁻¹ of cluster k in the leading coordinates for one noise variance s (eq. 5).

        Parameters
        ----------
        k : int
            Index of the cluster.
        width : int
            Number of leading coordinates.
        s : float
            Noise variance of a pixel.
        """
        # Only the inverses of the last noise variance are kept.
        if (width, s) not in self._woodbury:
            self._woodbury.clear()
            self._woodbury[width, s] = {}
        inverses = self._woodbury[width, s]
        if k not in inverses:
            # D = ν S / (n_k + ν) + s and U = X_k / √(n_k + ν) of G_k = D + UᵀU.
            cluster = self.clusters[k]
            diagonal = cluster.common_factor * self.variance[:width] + s
            rows = cluster.residuals[:, :width].astype(np.float64)
            inverses[k] = WoodburyInverse.build(diagonal, rows * np.sqrt(cluster.residual_factor))
        return inverses[k]
