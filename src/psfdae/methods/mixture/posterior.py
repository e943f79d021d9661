"""Posterior of a star under a Gaussian mixture: its mean, the variance of its pixels, its flux.

The posterior mean of a noisy image z is a weighted sum of linear estimators (Zoran & Weiss 2011,
ICCV, 479; Yu, Sapiro & Mallat 2012, IEEE TIP 21, 2481),

    ŷ = Σ w_k [μ_y,k + C_yx,k G_k⁻¹ (z − μ_k)],   w_k ∝ π_k N(z; μ_k, G_k),   G_k = C_k + s,

with the noise variance s of a pixel. Equations are numbered as on the page docs/mixture.md.
"""

from __future__ import annotations

import numpy as np

from psfdae.methods.mixture.densities import StarBatch, noisy_covariance, stars_by_cluster
from psfdae.methods.mixture.prior import MixturePrior


def posterior_mean(
    prior: MixturePrior, batch: StarBatch, weight: np.ndarray, with_sigma: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the posterior mean (n, P) and its σ, NaN unless `with_sigma` (eq. 7 and 8).

    Parameters
    ----------
    prior : MixturePrior
        Prior distribution of the stars.
    batch : StarBatch
        Noisy images of n stars.
    weight : ndarray, shape (n, K)
        Weight w_k of each cluster for each image.
    with_sigma : bool
        Compute σ, which takes most of the time.
    """
    restores_images, m = prior.restores_images, prior.count_modelled(batch.least_variance)
    # Noise of simulated stars may be far larger than the star: second − first² would cancel in
    # single precision.
    sum_type = np.float32 if batch.common_variance is None else np.float64
    first, second = np.zeros((2, *batch.images.shape), sum_type)
    # Weighted means of the clusters in the coordinates beyond the leading m.
    mean_beyond = weight @ prior.mean[:, m:]
    images = prior.axes if restores_images else prior.cross
    # Without σ, terms that are linear in the images are summed over the clusters in coordinates,
    # and transformed to pixels once.
    linear_sum = np.zeros((len(weight), m), np.float32)
    for k, rows, offset, residual, inverse in stars_by_cluster(prior, batch, weight > 0, m):
        cluster, w, s = prior.clusters[k], weight[rows, k, None], batch.noise_variance[rows]
        # C_yx G⁻¹ (z − μ): with y = x, it is (z − μ) − s G⁻¹ (z − μ), and z is added at the end;
        # otherwise C_yx has a common part and a part due to the cluster's own residuals.
        solution = inverse.solve(residual, s)
        if offset.size:
            mean_beyond[rows] += w * (offset @ cluster.slope[:, m:])
        linear = (-s if restores_images else cluster.common_factor) * solution
        star_pixels = linear @ images[:, :m].T if with_sigma else np.float32(0.0)
        if not restores_images:
            # μ_y,k + Yᵀ X G⁻¹ (z − μ_k) / (n_k + ν), and the change of μ_y,k with the position.
            by_residuals = (solution @ cluster.residuals[:, :m].T) @ cluster.reference_residuals
            star_pixels = star_pixels + prior.mean_reference[k]
            star_pixels = star_pixels + cluster.residual_factor * by_residuals
            star_pixels += offset @ cluster.reference_slope if offset.size else 0.0
        if with_sigma or not restores_images:
            first[rows] += w * star_pixels
        # Σ w_k (Var_k + ŷ_k²).
        if with_sigma:
            variance = s * find_variance_ratio(prior, k, batch, batch.rounded_variance[rows])
            second[rows] += w * (variance + np.square(star_pixels, dtype=sum_type))
        else:
            linear_sum[rows] += w * linear
    if not with_sigma:
        first += linear_sum @ images[:, :m].T
    # The other coordinates have one linear estimator, with the gain (S + s)⁻¹ (z − μ): s times the
    # gain is subtracted from the image (y = x), or it is multiplied by the covariance with y.
    gain = (batch.coordinates[:, m:] - mean_beyond) / (
        prior.variance[m:].astype(np.float32) + batch.noise_variance
    )
    # σ² = Σ w_k (Var_k + ŷ_k²) − ŷ²; terms that are the same for all clusters do not change it.
    sigma = np.sqrt(np.maximum(second - np.square(first), 0.0)) if with_sigma else second + np.nan
    if restores_images:
        first += batch.images - batch.noise_variance * gain @ images[:, m:].T
    else:
        first += gain @ images[:, m:].T
    return first, sigma


def find_variance_ratio(prior: MixturePrior, k: int, batch: StarBatch, s: np.ndarray) -> np.ndarray:
    """Return the posterior variance of pixels over s, (n, P), inside cluster k (eq. 8).

    It is computed once for each distinct noise variance s (n,); few of them are distinct.
    """
    unique, index = np.unique(s, return_inverse=True)
    scale = batch.common_variance or batch.least_variance
    keys = [(k, scale, variance) for variance in unique.tolist()]
    if missing := [key for key in keys if key not in prior.variance_ratios]:
        m = prior.count_modelled(batch.least_variance)
        cluster, noise = prior.clusters[k], np.array([[variance] for _, _, variance in missing])
        # Covariance C_yx of references with the leading coordinates. If images are the references,
        # the posterior variance is s (1 − s G⁻¹).
        leading = prior.axes[:, :m]
        if not prior.restores_images:
            leading = cluster.common_factor * prior.cross[:, :m]
            by_residuals = cluster.residual_factor * cluster.reference_residuals.T
            leading = leading + by_residuals @ cluster.residuals[:, :m]
        # diag(C_yx G⁻¹ C_xy), beyond the leading coordinates with S + s in place of G.
        reduction = noisy_covariance(prior, k, batch).mahalanobis2_pairs(leading, noise)
        reduction += (1.0 / (prior.variance[m:] + noise)) @ prior.squares[:, m:].T
        if prior.restores_images:
            ratios = np.maximum(1.0 - noise * reduction, 0.0)
        else:
            prior_variance = cluster.common_factor * prior.variance_reference
            prior_variance = prior_variance + cluster.residual_factor * cluster.reference_square
            ratios = np.maximum(prior_variance - reduction, 0.0) / noise
        prior.variance_ratios.update(zip(missing, ratios, strict=True))
    return np.stack([prior.variance_ratios[key] for key in keys])[index]


def flux_factor(prior: MixturePrior, batch: StarBatch, weight: np.ndarray) -> np.ndarray:
    """Return the posterior mean of the flux factor a, (n,) (eq. 11).

    Parameters
    ----------
    prior : MixturePrior
        Prior distribution with a free flux; otherwise the factor is 1.
    batch : StarBatch
        Noisy images of n stars.
    weight : ndarray, shape (n, K)
        Weight w_k of each cluster for each image.
    """
    flux, m = np.ones(len(weight)), prior.count_modelled(batch.least_variance)
    variance_beyond = prior.variance[m:].astype(np.float32)
    width = batch.coordinates.shape[1]
    for k, rows, _, residual, inverse in stars_by_cluster(prior, batch, weight > 0, width):
        s, leading, contrast = batch.noise_variance[rows], residual[:, :m], prior.contrast[k]
        # (μ_k − 1/P)ᵀ G_k⁻¹ (z − μ_k), with S + s in place of G_k beyond the leading coordinates.
        product = inverse.product(leading, contrast[:m], s)
        product += (residual[:, m:] / (variance_beyond + s)) @ contrast[m:]
        flux[rows] += prior.flux_sigma**2 * weight[rows, k] * product
    return flux
