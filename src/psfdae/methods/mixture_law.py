"""Posterior of a star under a Gaussian mixture: its PSF, flux and evidence.

Noise-free images x and their references y come from clusters k of training stars with probability
π_k, in each of which they are jointly normal. The posterior mean of a noisy image z is then a
weighted sum of linear estimators (Zoran & Weiss 2011, ICCV, 479; Yu, Sapiro & Mallat 2012, IEEE
TIP 21, 2481),

    ŷ = Σ w_k [μ_y,k + C_yx,k G_k⁻¹ (z − μ_k)],   w_k ∝ π_k N(z; μ_k, G_k),   G_k = C_k + s,

with the variance s of a pixel's noise. Equations are numbered as on the page docs/mixture.md, which
has the shrinkage of the covariances, methods that are given positions, and images whose flux and
sky are estimates.

Coordinates are the eigenvectors of S, the covariance within all clusters. In the leading ones,
clusters have covariances of their own; in the others, noise hides how they differ.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np

from psfdae.method import Estimate
from psfdae.methods.gaussians import ClusterAxes, NoisyCovariance, WoodburyInverse
from psfdae.mixing import mixing_weights
from psfdae.noise import NoiseModel

NOISE_BIN = 2.0
"""Range of ln s of stars for which the same coordinates and axes of a cluster are used."""

NOISE_STEP = 0.4
"""Step in ln s between stars that share the posterior variance of their pixels over s."""

OUTLIER_COORDINATES = 40
"""Number of leading coordinates that enter the outlier score. More of them detect more outliers
that are bright, and fewer that are faint."""

FLAT_VARIANCE = 0.005
"""Variance of a coordinate over s below which all clusters share one normal distribution there."""

LEAST_VARIANCE = 5e-4
"""Variance over s of a cluster's axes; of axes with less, only the mean variance is used."""


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


class StarBatch(NamedTuple):
    """Noisy images of stars whose noise is about the same.

    Attributes
    ----------
    images : ndarray, shape (n, P)
    coordinates : ndarray, shape (n, P), float32
        The images z in the eigenvectors of S.
    position : ndarray, shape (n, q)
        Whitened positions p.
    noise_variance : ndarray, shape (n, 1), float32
        s of each star.
    rounded_variance : ndarray, shape (n,)
        s rounded to steps of `NOISE_STEP` in ln, so that few values differ.
    least_variance : float
        Lower end of the bin in which every s lies.
    common_variance : float or None
        The noise variance of all images, if one level was given for all.
    """

    images: np.ndarray
    coordinates: np.ndarray
    position: np.ndarray
    noise_variance: np.ndarray
    rounded_variance: np.ndarray
    least_variance: float
    common_variance: float | None


@dataclass(frozen=True, eq=False)
class MixtureLaw:
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
        Number of rows of `deviation` of each cluster: its stars, or fewer with the same products.
    mean : ndarray, shape (K, P)
        μ_x in coordinates.
    mean_reference : ndarray, shape (K, P), or (0, P)
        μ_y in pixels; none where the references are the images.
    deviation : ndarray, shape (n, P)
        Residuals of the stars about their cluster's mean, in coordinates, cluster by cluster; in a
        bundle the main axes of each, times the root of the sum of squares along them.
    deviation_reference : ndarray, shape (n, P), or (0, P)
        The same of the references in pixels; none where they are the images.
    cross : ndarray, shape (P, P), or (0, P)
        Covariance within clusters of references (pixels) and images (coordinates).
    variance_reference : ndarray, shape (P,), or (0,)
        Variance of the references within clusters.
    whitening : ndarray, shape (q, q)
        Matrix to positions of unit variance within clusters; q = 2 where positions are given,
        else 0.
    center, deviation_center : ndarray, shape (K, q) and (n, q)
        Mean whitened position of each cluster, and each star's deviation from it.
    slope, slope_reference : ndarray, shape (q, P)
        Change with position that is common to all clusters; deviations are without it.
    shrinkage : ndarray, shape (1,)
        ν: the number of stars for which S counts in each cluster.
    noise : NoiseModel
    flux_sigma : float
        Standard deviation σ_a of the flux factor a, or 0 where fluxes are known (eq. 10).
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
    _axes_cache: dict[tuple[int, int], ClusterAxes] = field(
        default_factory=dict, init=False, repr=False
    )
    _inverse_cache: dict[tuple[int, float], list[WoodburyInverse]] = field(
        default_factory=dict, init=False, repr=False
    )
    _variance_cache: dict[tuple[int, float, float], np.ndarray] = field(
        default_factory=dict, init=False, repr=False
    )

    @property
    def _restores_images(self) -> bool:
        """The references are the noise-free images themselves, y = x."""
        return not len(self.cross)

    # The posterior of stars.

    def _batches(
        self, noisy: np.ndarray, level: float | np.ndarray, position: np.ndarray | None = None
    ) -> Iterator[tuple[np.ndarray, StarBatch]]:
        """Yield the numbers of images of about the same noise, and these images.

        Parameters
        ----------
        noisy : ndarray, shape (n, d, d)
        level : float or ndarray, shape (n,)
            Noise level λ.
        position : ndarray, shape (n, q), optional

        Raises
        ------
        ValueError
            If a pixel is not finite.
        """
        flat = noisy.reshape(len(noisy), math.prod(noisy.shape[1:]))
        if not np.isfinite(flat).all():
            raise ValueError("noisy images must be finite")
        place = position @ self.whitening if self.whitening.size else np.empty((len(flat), 0))
        # Variance of a pixel if the star's photons are spread evenly over the stamp.
        even_star = np.full(len(flat), 1.0 / flat.shape[1])
        s = self.noise.variance(even_star, np.asarray(level))
        # Rounding depends on the value alone, not on the other stars: they do not influence
        # each other.
        rounded = np.exp(np.rint(np.log(s) / NOISE_STEP) * NOISE_STEP) if np.ndim(level) else s
        s, rounded = (np.broadcast_to(a, len(flat)) for a in (s, rounded))
        common = None if np.ndim(level) else float(s[0]) if len(s) else None
        noise_bin = np.floor(np.log(s) / NOISE_BIN)
        for number in np.unique(noise_bin):
            (stars,) = (noise_bin == number).nonzero()
            least = float(np.exp(NOISE_BIN * number))
            # At most 4096 images together limit the memory.
            for part in np.array_split(stars, -(-stars.size // 4096)):
                images = flat.take(part, axis=0)
                yield (
                    part,
                    StarBatch(
                        images=images,
                        coordinates=(images @ self.axes).astype(np.float32),
                        position=place[part],
                        noise_variance=s[part, None].astype(np.float32),
                        rounded_variance=rounded[part],
                        least_variance=least,
                        common_variance=common,
                    ),
                )

    def _estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None,
        with_sigma: bool,
        near_clusters: np.ndarray | None = None,
    ) -> Estimate:
        """Return the posterior of images from the clusters that are near, (n, K) of bool."""
        psf, sigma = (np.empty(noisy.shape, np.float32) for _ in range(2))
        evidence, flux = np.empty((2, len(noisy)))
        for part, batch in self._batches(noisy, level, position):
            near = None if near_clusters is None else near_clusters[part]
            weight, evidence[part] = self._weights(batch, near)
            mean, mean_sigma = self._posterior(batch, weight, with_sigma)
            if self.flux_sigma:
                flux[part] = self._flux(batch, weight)
                # The image is a x + (1 − a)/P: its sky (1 − a)/P is no part of the star.
                if self._restores_images:
                    mean += ((flux[part] - 1.0) / mean.shape[1])[:, None]
            psf[part], sigma[part] = (a.reshape(-1, *noisy.shape[1:]) for a in (mean, mean_sigma))
        flux_or_none = flux if self.flux_sigma else None
        return Estimate(psf, sigma if with_sigma else None, evidence, flux_or_none)

    def _weights(self, batch: StarBatch, near: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the weight of each cluster for each image, (n, K), and the evidence (eq. 6)."""
        weight, evidence = mixing_weights(self._log_densities(batch, near))
        evidence -= 0.5 * batch.coordinates.shape[1] * np.log(2 * np.pi)
        return weight.astype(np.float32), evidence

    def _posterior(
        self, batch: StarBatch, weight: np.ndarray, with_sigma: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the posterior mean (n, P) and its σ, NaN unless `with_sigma` (eq. 7 and 8)."""
        same, m = self._restores_images, self._modelled_count(batch.least_variance)
        # Noise of simulated stars may be far above the star: second − first² would cancel in
        # single precision.
        sum_type = np.float32 if batch.common_variance is None else np.float64
        first, second = np.zeros((2, *batch.images.shape), sum_type)
        # Weighted means of the clusters in the coordinates beyond the leading m.
        mean_beyond = weight @ self.mean[:, m:]
        images = self.axes if same else self.cross
        # Without σ, what is linear in the images is summed over the clusters in coordinates, and
        # turned into pixels once.
        linear_sum = np.zeros((len(weight), m), np.float32)
        for k, rows, offset, residual, inverse in self._pairs(batch, weight > 0, m):
            cluster, w, s = self._clusters[k], weight[rows, k, None], batch.noise_variance[rows]
            # C_yx G⁻¹ (z − μ): with y = x, it is (z − μ) − s G⁻¹ (z − μ), and z is added at the
            # end; otherwise C_yx has a common part and that of the cluster's own residuals.
            gained = inverse.solve(residual, s)
            if offset.size:
                mean_beyond[rows] += w * (offset @ cluster.slope[:, m:])
            linear = (-s if same else cluster.common_factor) * gained
            restored = linear @ images[:, :m].T if with_sigma else np.float32(0.0)
            if not same:
                by_residuals = (gained @ cluster.residuals[:, :m].T) @ cluster.reference_residuals
                restored = restored + self.mean_reference[k]
                restored = restored + cluster.residual_factor * by_residuals
                restored += offset @ cluster.reference_slope if offset.size else 0.0
            if with_sigma or not same:
                first[rows] += w * restored
            if with_sigma:
                variance = s * self._variance_ratio(k, batch, batch.rounded_variance[rows])
                second[rows] += w * (variance + np.square(restored, dtype=sum_type))
            else:
                linear_sum[rows] += w * linear
        if not with_sigma:
            first += linear_sum @ images[:, :m].T
        # Coordinates beyond the leading ones have one linear estimator, S (S + s)⁻¹.
        gain = (batch.coordinates[:, m:] - mean_beyond) / (
            self.variance[m:].astype(np.float32) + batch.noise_variance
        )
        sigma = (
            np.sqrt(np.maximum(second - np.square(first), 0.0)) if with_sigma else second + np.nan
        )
        if same:
            first += batch.images - batch.noise_variance * gain @ images[:, m:].T
        else:
            first += gain @ images[:, m:].T
        return first, sigma

    def _flux(self, batch: StarBatch, weight: np.ndarray) -> np.ndarray:
        """Return the posterior mean of the flux factor a, (n,) (eq. 11)."""
        flux, m = np.ones(len(weight)), self._modelled_count(batch.least_variance)
        variance_beyond = self.variance[m:].astype(np.float32)
        width = batch.coordinates.shape[1]
        for k, rows, _, residual, inverse in self._pairs(batch, weight > 0, width):
            s, leading, contrast = batch.noise_variance[rows], residual[:, :m], self._contrast[k]
            product = inverse.product(leading, contrast[:m], s)
            product += (residual[:, m:] / (variance_beyond + s)) @ contrast[m:]
            flux[rows] += self.flux_sigma**2 * weight[rows, k] * product
        return flux

    def _pairs(
        self, batch: StarBatch, is_near: np.ndarray, width: int
    ) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray, NoisyCovariance]]:
        """Yield each cluster with the images to which it is near, (n, K) of bool.

        Yields
        ------
        k : int
            Number of the cluster.
        rows : ndarray of int, shape (r,)
            Numbers of the images.
        offset : ndarray, shape (r, q)
            Their whitened positions less that of the cluster.
        residual : ndarray, shape (r, width)
            Their leading coordinates less the cluster's mean at this position (eq. 9).
        inverse : NoisyCovariance
            G_k⁻¹.
        """
        leading = np.ascontiguousarray(batch.coordinates[:, :width])
        for k, mask in enumerate(np.ascontiguousarray(is_near.T)):
            (rows,) = mask.nonzero()
            if rows.size:
                offset = (batch.position[rows] - self.center[k]).astype(np.float32)
                residual = leading.take(rows, axis=0)
                residual -= self.mean[k, :width]
                if offset.size:
                    residual -= offset @ self._clusters[k].slope[:, :width]
                yield k, rows, offset, residual, self._inverse(k, batch)

    def _log_densities(self, batch: StarBatch, is_near: np.ndarray | None) -> np.ndarray:
        """Return ln of π_k N(z; μ_k, G_k) for each near cluster, (n, K) (eq. 6).

        Without the term of 2π; −inf for the other clusters.
        """
        is_near = self._nearest_clusters(batch) if is_near is None else is_near
        log = np.full((len(batch.coordinates), len(self.count)), -np.inf)
        # Coordinates: the leading m have covariances of clusters, those up to `width` their means
        # alone, and the others are common to all clusters.
        width = self._distinct_count(batch.least_variance)
        m = self._modelled_count(batch.least_variance)
        # ½ ln det G as a function of ln s is interpolated between 41 values in the bin.
        ln_s = np.log(batch.noise_variance[:, 0].astype(np.float64))
        ln_grid = np.log(batch.least_variance) + np.linspace(0.0, NOISE_BIN, 41)
        for k, rows, offset, residual, inverse in self._pairs(batch, is_near, width):
            cluster, s = self._clusters[k], batch.noise_variance[rows]
            distance2 = inverse.mahalanobis2(residual[:, :m], s)
            half_log_det = inverse.half_log_det(np.exp(ln_grid))
            if width > m:
                variance = self.variance[m:width]
                distance2 += (np.square(residual[:, m:]) / (variance + s)).sum(axis=1)
                half_log_det += 0.5 * np.log(variance + np.exp(ln_grid)[:, None]).sum(axis=1)
            distance2 = distance2.astype(np.float64)
            if offset.size:
                distance2 += np.square(offset @ cluster.position_whitening.T).sum(axis=1)
            constant = np.log(self.count[k] / self.count.sum())
            constant += np.log(cluster.position_whitening.diagonal()).sum()
            log[rows, k] = constant - np.interp(ln_s[rows], ln_grid, half_log_det) - 0.5 * distance2
        # In the other coordinates all clusters have nearly one normal distribution.
        variance = self.variance[width:] + batch.noise_variance
        square = np.square(batch.coordinates[:, width:] - self._overall_mean[width:])
        log -= 0.5 * (square / variance + np.log(variance)).sum(axis=1, keepdims=True)
        return log

    @cached_property
    def _contrast(self) -> np.ndarray:
        """Mean of each cluster less an even sky of the same sum, μ_k − 1/P, (K, P)."""
        return np.asarray(self.mean - self.axes.mean(axis=0))

    def _nearest_clusters(self, batch: StarBatch) -> np.ndarray:
        """Return the 32 clusters that are nearest by the common covariance S, (n, K) of bool.

        The other ones of 512 hold less than 1 % of the weight; 64 coordinates find them.
        """
        limit, leading = 32, 64
        if len(self.count) <= limit:
            return np.ones((len(batch.coordinates), len(self.count)), bool)
        star, mean = (
            (a - p @ self.slope)[:, :leading]
            for a, p in ((batch.coordinates, batch.position), (self.mean, self.center))
        )
        # |z − μ_k|² with (S + s)⁻¹, less |z|², which is the same for all clusters.
        precision = 1.0 / (self.variance[:leading] + batch.noise_variance)
        distance2 = precision @ np.square(mean).T - 2.0 * (precision * star) @ mean.T
        distance2 += np.square(self.center).sum(axis=1) - 2.0 * batch.position @ self.center.T
        nearest = np.argpartition(distance2, limit, axis=1)[:, :limit]
        is_near = np.zeros(distance2.shape, bool)
        np.put_along_axis(is_near, nearest, True, axis=1)
        return is_near

    # The clusters.

    @cached_property
    def _clusters(self) -> list[Cluster]:
        """Each cluster, its slope shrunk as its covariances are (eq. 9)."""
        p, nu, total = self.deviation_center, float(self.shrinkage[0]), self.count + self.shrinkage
        ends = self.rows.cumsum()
        parts = [slice(b - n, b) for b, n in zip(ends, self.rows, strict=True)]
        scatter = np.array([p[rows].T @ p[rows] for rows in parts]) + nu * np.eye(p.shape[1])
        inverse = np.linalg.inv(scatter)
        whitening = np.linalg.inv(np.linalg.cholesky(scatter / total[:, None, None]))
        return [self._cluster(k, rows, inverse[k], whitening[k]) for k, rows in enumerate(parts)]

    def _cluster(self, k: int, rows: slice, inverse: np.ndarray, whitening: np.ndarray) -> Cluster:
        """Return one cluster.

        Parameters
        ----------
        k : int
        rows : slice
            Rows of its residuals in `deviation`.
        inverse : ndarray, shape (q, q)
            (p pᵀ + ν)⁻¹ of the positions p of its stars.
        whitening : ndarray, shape (q, q)
            `Cluster.position_whitening`.
        """
        p = self.deviation_center[rows]
        nu, total = float(self.shrinkage[0]), self.count[k] + float(self.shrinkage[0])

        def without_slope(a: np.ndarray, common: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Return residuals without the slope of the cluster, and that slope.

            What it differs from that of all clusters counts as rows of its own, of weight ν.
            """
            if not (p.size and len(a)):
                return a, common
            extra = (inverse @ (p.T @ a)).astype(np.float32)
            rows = np.vstack([a - p.astype(np.float32) @ extra, np.float32(np.sqrt(nu)) * extra])
            return rows, common + extra

        residuals, slope = without_slope(self.deviation[rows], self.slope)
        reference_residuals, reference_slope = without_slope(
            self.deviation_reference[slice(0) if self._restores_images else rows],
            self.slope_reference,
        )
        # An unknown flux is one row more (eq. 10).
        if self.flux_sigma:
            weight = np.float32(self.flux_sigma * np.sqrt(total))
            contrast = weight * self._contrast[k, : residuals.shape[1]]
            residuals = np.vstack([residuals, contrast])
            if len(reference_residuals):
                row = weight * self.mean_reference[k]
                reference_residuals = np.vstack([reference_residuals, row])
        square = np.square(reference_residuals).sum(axis=0)
        # More rows than columns: rows of the same products, X = Q R.
        if len(residuals) > residuals.shape[1]:
            rotation, residuals = np.linalg.qr(residuals)
            if len(reference_residuals):
                reference_residuals = rotation.T @ reference_residuals
        return Cluster(
            residuals=residuals,
            reference_residuals=reference_residuals,
            reference_square=square,
            slope=slope,
            reference_slope=reference_slope,
            position_whitening=whitening,
            common_factor=float(nu / total),
            residual_factor=float(1 / total),
        )

    def _inverse(self, k: int, batch: StarBatch) -> NoisyCovariance:
        """Return G_k⁻¹ for the noise of some images, in the leading coordinates."""
        s, width = batch.least_variance, self._modelled_count(batch.least_variance)
        if batch.common_variance is not None:
            return self._woodbury_inverses(width, batch.common_variance)[k]
        return self._axes(k, width).inverse(LEAST_VARIANCE * s)

    def _woodbury_inverses(self, width: int, s: float) -> list[WoodburyInverse]:
        """Return G_k⁻¹ of all clusters for one noise variance; those of the last one are kept."""
        if cached := self._inverse_cache.get((width, s)):
            return cached
        inverses: dict[int, WoodburyInverse] = {}
        # Clusters with as many rows are one stack of matrices.
        for size in np.unique([len(cluster.residuals) for cluster in self._clusters]):
            numbers = [
                k for k, cluster in enumerate(self._clusters) if len(cluster.residuals) == size
            ]
            clusters = [self._clusters[k] for k in numbers]
            common = np.array([[cluster.common_factor] for cluster in clusters])
            factor = np.array([[cluster.residual_factor] for cluster in clusters])
            # D and U of G_k = D + UᵀU.
            diagonal = common * self.variance[:width] + s
            rows = np.stack([c.residuals[:, :width] for c in clusters])
            parts = WoodburyInverse.of_stack(diagonal, rows * np.sqrt(factor)[..., None])
            inverses |= dict(zip(numbers, parts, strict=True))
        self._inverse_cache.clear()
        self._inverse_cache[width, s] = [inverses[k] for k in range(len(self.count))]
        return self._inverse_cache[width, s]

    def _axes(self, k: int, width: int) -> ClusterAxes:
        """Return the axes of C_k in the leading coordinates, which are computed once."""
        if (k, width) not in self._axes_cache:
            # C_k = (X_kᵀ X_k + ν S) / (n_k + ν), with S diagonal in these coordinates (eq. 2).
            cluster = self._clusters[k]
            rows = cluster.residuals[:, :width].astype(np.float64)
            covariance = cluster.residual_factor * (rows.T @ rows)
            covariance[np.diag_indices(width)] += cluster.common_factor * self.variance[:width]
            self._axes_cache[k, width] = ClusterAxes.of(covariance)
        return self._axes_cache[k, width]

    def _distinct_count(self, s: float) -> int:
        """Return the number of leading coordinates in which clusters differ at noise variance s.

        They end where no later coordinate has a variance of all stars above `FLAT_VARIANCE` s.
        """
        largest = np.maximum.accumulate(self._total_variance[::-1])
        return int(np.count_nonzero(largest > FLAT_VARIANCE * s))

    def _modelled_count(self, s: float) -> int:
        """Return the number of leading coordinates in which clusters have own covariances."""
        return min(self._distinct_count(s), int(self.deviation.shape[1]))

    @cached_property
    def _overall_mean(self) -> np.ndarray:
        """Mean of all stars in coordinates, (P,)."""
        return np.asarray(np.average(self.mean, axis=0, weights=self.count))

    @cached_property
    def _total_variance(self) -> np.ndarray:
        """Variance of all stars along each coordinate, (P,), of a free flux at least."""
        between = np.average(np.square(self.mean - self._overall_mean), axis=0, weights=self.count)
        by_flux = np.square(self.flux_sigma * self._contrast).max(axis=0)
        return np.asarray(self.variance + between + np.square(self.slope).sum(axis=0) + by_flux)

    # The posterior variance of pixels.

    def _variance_ratio(self, k: int, batch: StarBatch, s: np.ndarray) -> np.ndarray:
        """Return the posterior variance of pixels over s, (n, P), inside cluster k (eq. 8).

        It is computed once for each of the noise variances s (n,), of which few differ.
        """
        unique, index = np.unique(s, return_inverse=True)
        scale = batch.common_variance or batch.least_variance
        keys = [(k, scale, variance) for variance in unique.tolist()]
        if missing := [key for key in keys if key not in self._variance_cache]:
            ratios = self._computed_variance_ratio(k, batch, np.array([v for _, _, v in missing]))
            self._variance_cache.update(zip(missing, ratios, strict=True))
        return np.stack([self._variance_cache[key] for key in keys])[index]

    def _computed_variance_ratio(self, k: int, batch: StarBatch, s: np.ndarray) -> np.ndarray:
        """Return the posterior variance of pixels over s, (n, P), inside cluster k (eq. 8)."""
        m, s = self._modelled_count(batch.least_variance), s[:, None]
        cluster = self._clusters[k]
        # Covariance of references with the leading coordinates; images are their own references,
        # for which it is s (1 − s G⁻¹).
        leading = self.axes[:, :m]
        if not self._restores_images:
            leading = cluster.common_factor * self.cross[:, :m]
            by_residuals = cluster.residual_factor * cluster.reference_residuals.T
            leading = leading + by_residuals @ cluster.residuals[:, :m]
        explained = self._inverse(k, batch).mahalanobis2_of_all(leading, s)
        explained += (1.0 / (self.variance[m:] + s)) @ self._squares[:, m:].T
        if self._restores_images:
            return np.asarray(np.maximum(1.0 - s * explained, 0.0))
        prior = cluster.common_factor * self.variance_reference
        prior = prior + cluster.residual_factor * cluster.reference_square
        return np.asarray(np.maximum(prior - explained, 0.0) / s)

    @cached_property
    def _squares(self) -> np.ndarray:
        """Squares of the coordinate axes in pixels, or of their covariances with references."""
        return np.asarray(np.square(self.axes if self._restores_images else self.cross))

    @cached_property
    def _outlier_law(self) -> Self:
        """The mixture in the leading `OUTLIER_COORDINATES` alone (eq. 12)."""
        empty = np.empty((0, 0), np.float32)
        # Arrays whose last axis are the coordinates.
        arrays: dict[str, Any] = {
            name: np.ascontiguousarray(getattr(self, name)[..., :OUTLIER_COORDINATES])
            for name in ("axes", "variance", "mean", "deviation", "slope")
        }
        return replace(
            self, **arrays, cross=empty, deviation_reference=empty, slope_reference=empty
        )
