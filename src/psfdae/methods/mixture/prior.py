"""Prior distribution of noise-free stars: a Gaussian mixture of clusters of training stars.

Noise-free images x and their references y come from cluster k of training stars with probability
π_k; in each cluster they are jointly normal. Equations are numbered as on the page
docs/mixture.md. This module has the model itself (eq. 1, 2, 9 and 10),
`psfdae.methods.mixture.fit` fits it to training stars (eq. 3),
`psfdae.methods.mixture.densities` has the weights of the clusters for a noisy image (eq. 6), and
`psfdae.methods.mixture.posterior` the mean and the variance of its star, and its flux (eq. 7, 8
and 11).

Coordinates are the eigenvectors of S, the covariance within all clusters. In the leading
coordinates, clusters have their own covariances; in the others, noise hides their differences.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from psfdae.base.rng import stream
from psfdae.methods.mixture.clusters import Cluster, ClusterInverses, remove_slope
from psfdae.stars.noise import NoiseModel


@dataclass(frozen=True, eq=False, repr=False)
class MixturePrior:
    """Mixture of normal distributions of stars and of their references.

    Attributes
    ----------
    axes : ndarray, shape (P, P)
        Eigenvectors of S, columns; P = d² pixels.
    variance : ndarray, shape (P,)
        Eigenvalues of S.
    count : ndarray of int, shape (K,)
        Number of stars of each cluster.
    rows : ndarray of int, shape (K,)
        Number of rows of `deviation` of each cluster: its stars, or fewer rows of the same
        products.
    mean : ndarray, shape (K, P)
        μ_x in coordinates.
    mean_reference : ndarray, shape (K, P), or (0, P)
        μ_y in pixels; empty if the references are the images.
    deviation : ndarray, shape (n, P)
        Residuals of the stars about their cluster's mean, in coordinates, cluster by cluster; in a
        bundle the main axes of each cluster, times the root of the sum of squares along them.
    deviation_reference : ndarray, shape (n, P), or (0, P)
        Residuals of the references in pixels; empty if they are the images.
    cross : ndarray, shape (P, P), or (0, P)
        Covariance within clusters of references (pixels) and images (coordinates).
    variance_reference : ndarray, shape (P,), or (0,)
        Variance of the references within clusters.
    whitening : ndarray, shape (q, q)
        Matrix to positions of unit variance within clusters; q = 2 with positions, else 0.
    center, deviation_center : ndarray, shape (K, q) and (n, q)
        Mean whitened position of each cluster, and each star's deviation from it.
    slope, slope_reference : ndarray, shape (q, P)
        Common change of all clusters with position; deviations do not contain it.
    shrinkage : ndarray, shape (1,)
        ν: the weight of S in each cluster, as a number of stars.
    noise : NoiseModel
        Noise of the training.
    flux_sigma : float
        Standard deviation σ_a of the flux factor a; 0 for known fluxes (eq. 10).
    noise_bin : float
        Range of ln s of stars that share coordinates and axes of a cluster.
    noise_step : float
        Step in ln s between stars that share the posterior variance of their pixels over s.
    flat_variance : float
        Variance of a coordinate over s below which all clusters share one normal distribution
        there.
    least_variance : float
        Variance over s of a cluster's axes; of axes with less, only the mean variance is used.
    """

    axes: np.ndarray
    variance: np.ndarray
    count: np.ndarray
    rows: np.ndarray
    mean: np.ndarray
    mean_reference: np.ndarray
    deviation: np.ndarray
    deviation_reference: np.ndarray
    cross: np.ndarray
    variance_reference: np.ndarray
    whitening: np.ndarray
    center: np.ndarray
    deviation_center: np.ndarray
    slope: np.ndarray
    slope_reference: np.ndarray
    shrinkage: np.ndarray
    noise: NoiseModel
    flux_sigma: float = 0.0
    noise_bin: float = 2.0
    noise_step: float = 0.4
    flat_variance: float = 0.005
    least_variance: float = 5e-4
    variance_ratios: dict[tuple[int, float, float], np.ndarray] = field(
        default_factory=dict, init=False, repr=False
    )
    """Posterior variances over s that `psfdae.methods.mixture.posterior` has computed."""

    @property
    def restores_images(self) -> bool:
        """True if the references are the noise-free images themselves, y = x."""
        return not len(self.cross)

    @cached_property
    def contrast(self) -> np.ndarray:
        """Mean of each cluster minus a flat sky of the same sum, μ_k − 1/P, (K, P)."""
        # An image of 1/P in all pixels has the means of the axes as coordinates.
        return np.asarray(self.mean - self.axes.mean(axis=0))

    @cached_property
    def overall_mean(self) -> np.ndarray:
        """Mean of all stars in coordinates, (P,)."""
        return np.asarray(np.average(self.mean, axis=0, weights=self.count))

    @cached_property
    def total_variance(self) -> np.ndarray:
        """Variance of all stars along each coordinate, (P,), including a free flux."""
        # Variance within clusters, between them, due to the whitened position, and due to the flux.
        between = np.average(np.square(self.mean - self.overall_mean), axis=0, weights=self.count)
        by_flux = np.square(self.flux_sigma * self.contrast).max(axis=0)
        return np.asarray(self.variance + between + np.square(self.slope).sum(axis=0) + by_flux)

    @cached_property
    def squares(self) -> np.ndarray:
        """Squares of the coordinate axes in pixels, or of their covariances with references."""
        return np.asarray(np.square(self.axes if self.restores_images else self.cross))

    def count_distinct(self, s: float) -> int:
        """Return the number of leading coordinates in which clusters differ at noise variance s.

        In all later coordinates, the variance of all stars is at most `flat_variance` s.
        """
        # The largest variance of all later coordinates: variances need not be sorted.
        largest = np.maximum.accumulate(self.total_variance[::-1])
        return int(np.count_nonzero(largest > self.flat_variance * s))

    def count_modelled(self, s: float) -> int:
        """Return the number of leading coordinates in which clusters have their own covariance."""
        # A bundle may have fewer coordinates of the residuals than there are pixels.
        return min(self.count_distinct(s), int(self.deviation.shape[1]))

    @cached_property
    def clusters(self) -> list[Cluster]:
        """Clusters, with shrunk covariances and slopes (eq. 2, 9 and 10)."""
        clusters, nu = [], float(self.shrinkage[0])
        for k, (row_count, last) in enumerate(zip(self.rows, self.rows.cumsum(), strict=True)):
            rows, total = slice(last - row_count, last), self.count[k] + nu
            # P_k of the whitened positions p: their common covariance is 1, with the weight of ν
            # stars.
            p = self.deviation_center[rows]
            scatter = p.T @ p + nu * np.eye(p.shape[1])
            residuals, slope = self.deviation[rows], self.slope
            reference_residuals = self.deviation_reference[rows]
            reference_slope = self.slope_reference
            # Residuals without the change with position; the slope is the common one plus `extra`.
            if p.size:
                inverse = np.linalg.inv(scatter)
                residuals, extra = remove_slope(residuals, p, inverse, nu)
                slope = slope + extra
                if len(reference_residuals):
                    reference_residuals, extra = remove_slope(reference_residuals, p, inverse, nu)
                    reference_slope = reference_slope + extra
            # An unknown flux is an additional row (eq. 10).
            if self.flux_sigma:
                weight = np.float32(self.flux_sigma * np.sqrt(total))
                contrast = weight * self.contrast[k, : residuals.shape[1]]
                residuals = np.vstack([residuals, contrast])
                if len(reference_residuals):
                    row = weight * self.mean_reference[k]
                    reference_residuals = np.vstack([reference_residuals, row])
            square = np.square(reference_residuals).sum(axis=0)
            # More rows than columns: rows of the same products, X = Q R and Y → Qᵀ Y.
            if len(residuals) > residuals.shape[1]:
                rotation, residuals = np.linalg.qr(residuals)
                if len(reference_residuals):
                    reference_residuals = rotation.T @ reference_residuals
            # C_k = (X_kᵀ X_k + ν S) / (n_k + ν), and P_k likewise, whose Cholesky factor is
            # inverted (eq. 2).
            clusters.append(
                Cluster(
                    residuals=residuals,
                    reference_residuals=reference_residuals,
                    reference_square=square,
                    slope=slope,
                    reference_slope=reference_slope,
                    position_whitening=np.linalg.inv(np.linalg.cholesky(scatter / total)),
                    common_factor=float(nu / total),
                    residual_factor=float(1 / total),
                )
            )
        return clusters

    @cached_property
    def inverses(self) -> ClusterInverses:
        """G_k⁻¹ of the clusters for noise of any variance (eq. 4 and 5)."""
        return ClusterInverses(self.clusters, self.variance)

    def keep_leading(self, count: int) -> Self:
        """Return the mixture of images in `count` leading coordinates, without references."""
        empty = np.empty((0, 0), np.float32)
        # Arrays whose last axis is the coordinates.
        arrays: dict[str, Any] = {
            name: np.ascontiguousarray(getattr(self, name)[..., :count])
            for name in ("axes", "variance", "mean", "deviation", "slope")
        }
        # Without references, images are restored: y = x.
        return replace(
            self, **arrays, cross=empty, deviation_reference=empty, slope_reference=empty
        )

    def conditions(self) -> Iterator[tuple[str, str, ArrayLike]]:
        """Yield conditions that any fit fulfils: images of sum 1, no large negative pixels.

        Each has the name of an array, the condition in words, and whether it is fulfilled.
        """
        # The sum of an image is the sum of its coordinates times the sums of the axes.
        total, power = self.axes.sum(axis=0), np.square(self.deviation, dtype=np.float64).sum()
        # Orthonormal columns: Aᵀ A v = v for four random vectors v; the product Aᵀ A would take
        # seconds.
        vectors = stream(0, "gmm", "axes").standard_normal((len(self.axes), 4))
        product = self.axes.T @ (self.axes @ vectors)
        yield "axes", "orthonormal columns", np.abs(product - vectors) < 1e-2
        yield "variance", "numbers from 0 to 1", (self.variance >= 0) & (self.variance <= 1)
        yield "count", "a star or more in each cluster", self.count >= 1
        # The rows of all clusters together are the rows of the deviations.
        adds_up = self.rows.shape == self.count.shape and self.rows.sum() == len(self.deviation)
        yield "rows", "the rows of the deviations", adds_up and (self.rows >= 0)
        yield "mean", "images of the sum 1", np.abs(self.mean @ total - 1) < 1e-2
        # Images of sum 1 without large negative pixels have a sum of squares of at most 1, and
        # differences of two of them at most 4.
        yield "deviation", "images of the sum 1", power <= 4.0 * self.count.sum()
        yield "shrinkage", "a number above 0", self.shrinkage.shape == (1,) and self.shrinkage > 0
