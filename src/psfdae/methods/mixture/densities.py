"""Weights of the clusters of a Gaussian mixture for noisy images, and the images' evidence.

The weight of a cluster is π_k times the density N(z; μ_k, G_k) of the image there (eq. 6 of
docs/mixture.md; where a position is given, with the means and the factor of eq. 9).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from psfdae.methods.mixing import mixing_weights
from psfdae.methods.mixture.gaussians import NoisyCovariance
from psfdae.methods.mixture.prior import MixturePrior


class StarBatch(NamedTuple):
    """Noisy images of stars whose noise is about the same.

    Attributes
    ----------
    images : ndarray, shape (n, P)
        Noisy images.
    coordinates : ndarray, shape (n, P), float32
        The images z in the eigenvectors of S.
    position : ndarray, shape (n, q)
        Whitened positions p.
    noise_variance : ndarray, shape (n, 1), float32
        s of each star.
    rounded_variance : ndarray, shape (n,)
        s rounded to steps of `MixturePrior.noise_step` in ln, so that few values differ.
    least_variance : float
        Lower end of the bin that contains every s.
    common_variance : float or None
        Noise variance of all images, if a single level was given.
    """

    images: np.ndarray
    coordinates: np.ndarray
    position: np.ndarray
    noise_variance: np.ndarray
    rounded_variance: np.ndarray
    least_variance: float
    common_variance: float | None


def star_batches(
    prior: MixturePrior,
    noisy: np.ndarray,
    level: float | np.ndarray,
    position: np.ndarray | None = None,
) -> Iterator[tuple[np.ndarray, StarBatch]]:
    """Yield the indices of images of about the same noise, and these images.

    Parameters
    ----------
    prior : MixturePrior
        Prior distribution of the stars.
    noisy : ndarray, shape (n, d, d)
        Noisy images of stars.
    level : float or ndarray, shape (n,)
        Noise level λ.
    position : ndarray, shape (n, q), optional
        Positions of the stars in the field, if the mixture uses them.

    Raises
    ------
    ValueError
        If a pixel is not finite.
    """
    flat = noisy.reshape(len(noisy), math.prod(noisy.shape[1:]))
    if not np.isfinite(flat).all():
        raise ValueError("noisy images must be finite")
    place = position @ prior.whitening if prior.whitening.size else np.empty((len(flat), 0))
    # s: the variance of a pixel if the star's photons are spread evenly over the stamp (eq. 1).
    even_star = np.full(len(flat), 1.0 / flat.shape[1])
    s, step = prior.noise.variance(even_star, np.asarray(level)), prior.noise_step
    # Rounding depends only on the value, so that stars do not influence each other.
    coarse_s = np.exp(np.rint(np.log(s) / step) * step) if np.ndim(level) else s
    s, coarse_s = (np.broadcast_to(a, len(flat)) for a in (s, coarse_s))
    common = None if np.ndim(level) else float(s[0]) if len(s) else None
    noise_bin = np.floor(np.log(s) / prior.noise_bin)
    for number in np.unique(noise_bin):
        (stars,) = (noise_bin == number).nonzero()
        # At most 4096 images together limit the memory.
        for part in np.array_split(stars, -(-stars.size // 4096)):
            images = flat.take(part, axis=0)
            batch = StarBatch(
                images=images,
                coordinates=(images @ prior.axes).astype(np.float32),
                position=place[part],
                noise_variance=s[part, None].astype(np.float32),
                rounded_variance=coarse_s[part],
                least_variance=float(np.exp(prior.noise_bin * number)),
                common_variance=common,
            )
            yield part, batch


def noisy_covariance(prior: MixturePrior, k: int, batch: StarBatch) -> NoisyCovariance:
    """Return G_k⁻¹ for the noise of a batch, in the leading coordinates (eq. 4 or 5)."""
    width = prior.count_modelled(batch.least_variance)
    if batch.common_variance is not None:
        return prior.inverses.invert_one(k, width, batch.common_variance)
    return prior.inverses.invert_any(k, width, prior.least_variance * batch.least_variance)


def stars_by_cluster(
    prior: MixturePrior, batch: StarBatch, is_near: np.ndarray, width: int
) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray, NoisyCovariance]]:
    """Yield each cluster with the images to which it is near, (n, K) of bool.

    Yields
    ------
    k : int
        Index of the cluster.
    rows : ndarray of int, shape (r,)
        Indices of the images.
    offset : ndarray, shape (r, q)
        Their whitened positions minus the position of the cluster.
    residual : ndarray, shape (r, width)
        Their leading coordinates minus the cluster's mean at this position (eq. 9).
    inverse : NoisyCovariance
        G_k⁻¹.
    """
    leading = np.ascontiguousarray(batch.coordinates[:, :width])
    for k, mask in enumerate(np.ascontiguousarray(is_near.T)):
        (rows,) = mask.nonzero()
        if rows.size:
            # z − μ_k − (p − p_k) B_k.
            offset = (batch.position[rows] - prior.center[k]).astype(np.float32)
            residual = leading.take(rows, axis=0)
            residual -= prior.mean[k, :width]
            if offset.size:
                residual -= offset @ prior.clusters[k].slope[:, :width]
            yield k, rows, offset, residual, noisy_covariance(prior, k, batch)


def nearest_clusters(
    prior: MixturePrior, batch: StarBatch, limit: int = 32, leading: int = 64
) -> np.ndarray:
    """Return the clusters that are nearest to each image by the covariance S, (n, K) of bool.

    By default these are 32 clusters by 64 coordinates: the others of 512 clusters have less than
    1 % of the weight.
    """
    if len(prior.count) <= limit:
        return np.ones((len(batch.coordinates), len(prior.count)), bool)
    # Without the common slope, the squared distance of star and cluster is the sum over their
    # images and their whitened positions.
    star, mean = (
        (a - p @ prior.slope)[:, :leading]
        for a, p in ((batch.coordinates, batch.position), (prior.mean, prior.center))
    )
    # |z − μ_k|² with (S + s)⁻¹, less |z|², which is the same for all clusters.
    precision = 1.0 / (prior.variance[:leading] + batch.noise_variance)
    distance2 = precision @ np.square(mean).T - 2.0 * (precision * star) @ mean.T
    distance2 += np.square(prior.center).sum(axis=1) - 2.0 * batch.position @ prior.center.T
    nearest = np.argpartition(distance2, limit, axis=1)[:, :limit]
    is_near = np.zeros(distance2.shape, bool)
    np.put_along_axis(is_near, nearest, True, axis=1)
    return is_near


def log_densities(prior: MixturePrior, batch: StarBatch, is_near: np.ndarray) -> np.ndarray:
    """Return ln of π_k N(z; μ_k, G_k) for each near cluster, (n, K) (eq. 6).

    The term of 2π is left out; the result is −inf for the other clusters.
    """
    log = np.full((len(batch.coordinates), len(prior.count)), -np.inf)
    # In the leading m coordinates, clusters have their own covariances; up to `width`, only their
    # own means; the others are common to all clusters.
    width = prior.count_distinct(batch.least_variance)
    m = prior.count_modelled(batch.least_variance)
    # ½ ln det G as a function of ln s is interpolated between 41 values in the bin.
    ln_s = np.log(batch.noise_variance[:, 0].astype(np.float64))
    ln_grid = np.log(batch.least_variance) + np.linspace(0.0, prior.noise_bin, 41)
    for k, rows, offset, residual, inverse in stars_by_cluster(prior, batch, is_near, width):
        whitening, s = prior.clusters[k].position_whitening, batch.noise_variance[rows]
        # (z − μ_k)ᵀ G_k⁻¹ (z − μ_k) and ½ ln det G_k, in the leading coordinates and up to `width`.
        distance2 = inverse.mahalanobis2(residual[:, :m], s)
        half_log_det = inverse.half_log_det(np.exp(ln_grid))
        if width > m:
            variance = prior.variance[m:width]
            distance2 += (np.square(residual[:, m:]) / (variance + s)).sum(axis=1)
            half_log_det += 0.5 * np.log(variance + np.exp(ln_grid)[:, None]).sum(axis=1)
        distance2 = distance2.astype(np.float64)
        # (p − p_k)ᵀ P_k⁻¹ (p − p_k), and −½ ln det P_k (eq. 9).
        if offset.size:
            distance2 += np.square(offset @ whitening.T).sum(axis=1)
        constant = np.log(prior.count[k] / prior.count.sum()) + np.log(whitening.diagonal()).sum()
        log[rows, k] = constant - np.interp(ln_s[rows], ln_grid, half_log_det) - 0.5 * distance2
    # In the other coordinates, all clusters have nearly the same normal distribution.
    variance = prior.variance[width:] + batch.noise_variance
    square = np.square(batch.coordinates[:, width:] - prior.overall_mean[width:])
    log -= 0.5 * (square / variance + np.log(variance)).sum(axis=1, keepdims=True)
    return log


def cluster_weights(
    prior: MixturePrior, batch: StarBatch, is_near: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the weight of each cluster for each image, (n, K), and the evidence (eq. 6).

    Only near clusters, (n, K) of bool, have a weight, by default `nearest_clusters`.
    """
    is_near = nearest_clusters(prior, batch) if is_near is None else is_near
    weight, evidence = mixing_weights(log_densities(prior, batch, is_near))
    # The term of 2π, the same for all clusters.
    evidence -= 0.5 * batch.coordinates.shape[1] * np.log(2 * np.pi)
    return weight.astype(np.float32), evidence
