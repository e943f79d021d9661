"""Posterior of a star under a Gaussian mixture: its mean, the variance of its pixels, its flux.

The posterior mean of a noisy image z is a weighted sum of linear estimators (Zoran & Weiss 2011,
ICCV, 479; Yu, Sapiro & Mallat 2012, IEEE TIP 21, 2481),

    ŷ = Σ w_k [μ_y,k + C_yx,k G_k⁻¹ (z − μ_k)],   w_k ∝ π_k N(z; μ_k, G_k),   G_k = C_k + s,

with the variance s of a pixel's noise. Equations are numbered as on the page docs/mixture.md.
"""

from __future__ import annotations

import numpy as np

from psfdae.methods.mixture_densities import StarBatch, noisy_covariance, stars_by_cluster
from psfdae.methods.mixture_law import MixtureLaw


def posterior_mean(
    law: MixtureLaw, batch: StarBatch, weight: np.ndarray, with_sigma: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the posterior mean (n, P) and its σ, NaN unless `with_sigma` (eq. 7 and 8).

    Parameters
    ----------
    law : MixtureLaw
    batch : StarBatch
    weight : ndarray, shape (n, K)
        Weight w_k of each cluster for each image.
    with_sigma : bool
    """
    restores_images, m = law.restores_images, law.modelled_count(batch.least_variance)
    # Noise of simulated stars may be far above the star: second − first² would cancel in single
    # precision.
    sum_type = np.float32 if batch.common_variance is None else np.float64
    first, second = np.zeros((2, *batch.images.shape), sum_type)
    # Weighted means of the clusters in the coordinates beyond the leading m.
    mean_beyond = weight @ law.mean[:, m:]
    images = law.axes if restores_images else law.cross
    # Without σ, what is linear in the images is summed over the clusters in coordinates, and
    # turned into pixels once.
    linear_sum = np.zeros((len(weight), m), np.float32)
    for k, rows, offset, residual, inverse in stars_by_cluster(law, batch, weight > 0, m):
        cluster, w, s = law.clusters[k], weight[rows, k, None], batch.noise_variance[rows]
        # C_yx G⁻¹ (z − μ): with y = x, it is (z − μ) − s G⁻¹ (z − μ), and z is added at the end;
        # otherwise C_yx has a common part and that of the cluster's own residuals.
        gained = inverse.solve(residual, s)
        if offset.size:
            mean_beyond[rows] += w * (offset @ cluster.slope[:, m:])
        linear = (-s if restores_images else cluster.common_factor) * gained
        restored = linear @ images[:, :m].T if with_sigma else np.float32(0.0)
        if not restores_images:
            # μ_y,k + Yᵀ X G⁻¹ (z − μ_k) / (n_k + ν), and the change of μ_y,k with the position.
            by_residuals = (gained @ cluster.residuals[:, :m].T) @ cluster.reference_residuals
            restored = restored + law.mean_reference[k]
            restored = restored + cluster.residual_factor * by_residuals
            restored += offset @ cluster.reference_slope if offset.size else 0.0
        if with_sigma or not restores_images:
            first[rows] += w * restored
        # Σ w_k (Var_k + ŷ_k²).
        if with_sigma:
            variance = s * pixel_variance_ratio(law, k, batch, batch.rounded_variance[rows])
            second[rows] += w * (variance + np.square(restored, dtype=sum_type))
        else:
            linear_sum[rows] += w * linear
    if not with_sigma:
        first += linear_sum @ images[:, :m].T
    # Coordinates beyond the leading ones have one linear estimator: (S + s)⁻¹ (z − μ), by which the
    # image is less s times it (y = x), or the covariance with the references is multiplied.
    gain = (batch.coordinates[:, m:] - mean_beyond) / (
        law.variance[m:].astype(np.float32) + batch.noise_variance
    )
    # σ² = Σ w_k (Var_k + ŷ_k²) − ŷ². What is common to all clusters does not change it.
    sigma = np.sqrt(np.maximum(second - np.square(first), 0.0)) if with_sigma else second + np.nan
    if restores_images:
        first += batch.images - batch.noise_variance * gain @ images[:, m:].T
    else:
        first += gain @ images[:, m:].T
    return first, sigma


def pixel_variance_ratio(law: MixtureLaw, k: int, batch: StarBatch, s: np.ndarray) -> np.ndarray:
    """Return the posterior variance of pixels over s, (n, P), inside cluster k (eq. 8).

    It is computed once for each of the noise variances s (n,), of which few differ.
    """
    unique, index = np.unique(s, return_inverse=True)
    scale = batch.common_variance or batch.least_variance
    keys = [(k, scale, variance) for variance in unique.tolist()]
    if missing := [key for key in keys if key not in law.variance_ratios]:
        m = law.modelled_count(batch.least_variance)
        cluster, noise = law.clusters[k], np.array([[variance] for _, _, variance in missing])
        # Covariance of references with the leading coordinates, C_yx; images are their own
        # references, for which the explained variance is that of s (1 − s G⁻¹).
        leading = law.axes[:, :m]
        if not law.restores_images:
            leading = cluster.common_factor * law.cross[:, :m]
            by_residuals = cluster.residual_factor * cluster.reference_residuals.T
            leading = leading + by_residuals @ cluster.residuals[:, :m]
        # diag(C_yx G⁻¹ C_xy), beyond the leading coordinates with S + s in place of G.
        explained = noisy_covariance(law, k, batch).mahalanobis2_of_all(leading, noise)
        explained += (1.0 / (law.variance[m:] + noise)) @ law.squares[:, m:].T
        if law.restores_images:
            ratios = np.maximum(1.0 - noise * explained, 0.0)
        else:
            prior = cluster.common_factor * law.variance_reference
            prior = prior + cluster.residual_factor * cluster.reference_square
            ratios = np.maximum(prior - explained, 0.0) / noise
        law.variance_ratios.update(zip(missing, ratios, strict=True))
    return np.stack([law.variance_ratios[key] for key in keys])[index]


def flux_factor(law: MixtureLaw, batch: StarBatch, weight: np.ndarray) -> np.ndarray:
    """Return the posterior mean of the flux factor a, (n,) (eq. 11).

    Parameters
    ----------
    law : MixtureLaw
        With a flux that is an estimate; otherwise the factor is 1.
    batch : StarBatch
    weight : ndarray, shape (n, K)
        Weight w_k of each cluster for each image.
    """
    flux, m = np.ones(len(weight)), law.modelled_count(batch.least_variance)
    variance_beyond = law.variance[m:].astype(np.float32)
    width = batch.coordinates.shape[1]
    for k, rows, _, residual, inverse in stars_by_cluster(law, batch, weight > 0, width):
        s, leading, contrast = batch.noise_variance[rows], residual[:, :m], law.contrast[k]
        # (μ_k − 1/P)ᵀ G_k⁻¹ (z − μ_k), with S + s in place of G_k beyond the leading coordinates.
        product = inverse.product(leading, contrast[:m], s)
        product += (residual[:, m:] / (variance_beyond + s)) @ contrast[m:]
        flux[rows] += law.flux_sigma**2 * weight[rows, k] * product
    return flux
