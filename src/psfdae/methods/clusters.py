"""Clusters of similar training stars: their normal distributions, and these with noise.

Equations are numbered as on the page docs/mixture.md. `psfdae.methods.mixture_law` makes the
clusters of a mixture; `psfdae.methods.gaussians` has the algebra of their covariances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from psfdae.methods.gaussians import AxesInverse, ClusterAxes, WoodburyInverse


class Cluster(NamedTuple):
    """One cluster of a mixture with its covariances (all given the position).

    Attributes
    ----------
    residuals, reference_residuals : ndarray, shape (r, P)
        Residuals X_k in coordinates and Y_k in pixels, or rows of the same products if these are
        fewer.
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


def without_slope(
    residuals: np.ndarray, position: np.ndarray, inverse: np.ndarray, shrinkage: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals that a linear change with the position leaves, and this slope (eq. 9).

    Parameters
    ----------
    residuals : ndarray, shape (n, m)
        Residuals X about the mean, without the slope that is common to all clusters.
    position : ndarray, shape (n, q)
        Whitened positions p about their mean.
    inverse : ndarray, shape (q, q)
        (pᵀp + ν)⁻¹.
    shrinkage : float
        ν.

    Returns
    -------
    rows : ndarray, shape (n + q, m)
        X − p B, and the rows √ν B.
    slope : ndarray, shape (q, m)
        B, by how much the slope of the cluster differs from the common one.
    """
    # Ridge regression: B minimises |X − p B|² + ν |B|², and both terms are squares of rows.
    slope = (inverse @ (position.T @ residuals)).astype(np.float32)
    remaining = residuals - position.astype(np.float32) @ slope
    return np.vstack([remaining, np.float32(np.sqrt(shrinkage)) * slope]), slope


@dataclass
class ClusterInverses:
    """Inverses G_k⁻¹ of the covariances of clusters with noise; what is computed is kept.

    Attributes
    ----------
    clusters : sequence of Cluster
    variance : ndarray, shape (P,)
        Eigenvalues of S, the covariance that all clusters have in common.
    """

    clusters: Sequence[Cluster]
    variance: np.ndarray
    _axes: dict[tuple[int, int], ClusterAxes] = field(default_factory=dict, init=False)
    _woodbury: dict[tuple[int, float], dict[int, WoodburyInverse]] = field(
        default_factory=dict, init=False
    )

    def of_any_noise(self, k: int, width: int, least_variance: float) -> AxesInverse:
        """Return G_k⁻¹ of cluster k in the leading coordinates for every noise variance (eq. 4).

        Axes with no more than the least variance are not used one by one.

        Parameters
        ----------
        k : int
            Number of the cluster.
        width : int
            Number of leading coordinates.
        least_variance : float
            Least noise variance of a pixel that the inverse will be asked for.
        """
        if (k, width) not in self._axes:
            # C_k = (X_kᵀ X_k + ν S) / (n_k + ν), with S diagonal in these coordinates (eq. 2).
            cluster = self.clusters[k]
            rows = cluster.residuals[:, :width].astype(np.float64)
            covariance = cluster.residual_factor * (rows.T @ rows)
            covariance[np.diag_indices(width)] += cluster.common_factor * self.variance[:width]
            self._axes[k, width] = ClusterAxes.of(covariance)
        # The eigenvectors are those of every noise; how many of them matter depends on it.
        return self._axes[k, width].inverse(least_variance)

    def of_one_noise(self, k: int, width: int, s: float) -> WoodburyInverse:
        """Return G_k⁻¹ of cluster k in the leading coordinates for one noise variance s (eq. 5).

        Parameters
        ----------
        k : int
            Number of the cluster.
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
            inverses[k] = WoodburyInverse.of(diagonal, rows * np.sqrt(cluster.residual_factor))
        return inverses[k]
