"""Image metrics per star, and their means with clustered standard errors.

Inputs: restored PSFs and noise-free references, (n, d, d). Outputs: one value of each metric for
each star, and rows of tables.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from psfdae.methods.interface import Estimate


def mse(estimates: np.ndarray, references: np.ndarray) -> np.ndarray:
    """Return the mean squared error of every stamp, shape (n,)."""
    # ⟨(x̂ − x)²⟩, in double precision: errors of 1e-8 are squared.
    difference = estimates.astype(np.float64) - references
    return np.asarray((difference**2).mean(axis=(1, 2)))


def ssim(
    estimates: np.ndarray,
    references: np.ndarray,
    *data_ranges: float | np.ndarray,
    window_px: int = 7,
) -> np.ndarray:
    """Return the structural similarity of every stamp, as scikit-image does by default.

    It is the mean of eq. 13 of Wang et al. 2004 (IEEE Trans. Image Process. 13, 600), with sample
    covariances, over all positions of the window inside the stamp. Several dynamic ranges share
    the moving sums, which take most of the time.

    Parameters
    ----------
    estimates, references : ndarray, shape (n, d, d)
        Stamps to compare, in the same unit.
    *data_ranges : float or ndarray, shape (n,)
        Dynamic ranges; one value or one per star.
    window_px : int
        Side of the uniform window, by default as in scikit-image.

    Returns
    -------
    ndarray, shape (n,), or (number of ranges, n) for several ranges
        Similarity, at most 1; NaN for a stamp with a pixel that is not finite.

    Raises
    ------
    ValueError
        If a stamp is smaller than the window or a range is not positive.
    """
    count, side, _ = references.shape
    if side < window_px:
        raise ValueError(f"stamps of {side} px are smaller than the SSIM window, {window_px} px")
    # One range for each star.
    ranges = np.array([np.broadcast_to(r, count) for r in data_ranges], np.float64)
    if not (ranges > 0).all():
        raise ValueError(f"SSIM data_range must be positive, got {ranges.min()}")
    # Matrix that averages the pixels of an axis over the window: column j is 1/window at the pixels
    # of the window at position j; there are side − window + 1 positions.
    place = np.arange(side)[:, None] - np.arange(side - window_px + 1)
    window_mean = ((place >= 0) & (place < window_px)) / window_px

    def mean(images: np.ndarray) -> np.ndarray:
        """Return the mean of every window, transposed: only the sum over all windows is used."""
        rows = (images.reshape(-1, side) @ window_mean).reshape(len(images), side, -1)
        columns = np.ascontiguousarray(rows.swapaxes(1, 2)).reshape(-1, side)
        return np.asarray((columns @ window_mean).reshape(len(images), *window_mean.shape[1:], -1))

    out = np.empty(ranges.shape)
    # The moving sums of 256 stars fit into a processor's cache.
    for first in range(0, count, 256):
        block = slice(first, first + 256)
        # SSIM does not change if images and range are multiplied by the same factor.
        unit = ranges[0, block, None, None]
        x, y = (a[block].astype(np.float64) / unit for a in (estimates, references))
        with np.errstate(invalid="ignore", over="ignore"):
            # Sample covariances over the window: n/(n − 1) times ⟨xy⟩ − ⟨x⟩⟨y⟩.
            mean_x, mean_y = mean(x), mean(y)
            product, squares = 2 * mean_x * mean_y, mean_x**2 + mean_y**2
            sample = window_px**2 / (window_px**2 - 1)
            covariance = sample * (2 * mean(x * y) - product)
            variances = sample * (mean(x * x + y * y) - squares)
            for row, data_range in zip(out, ranges[:, block, None, None] / unit, strict=True):
                # SSIM = (2μxμy + c1)(2σxy + c2) / ((μx² + μy² + c1)(σx² + σy² + c2)).
                c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
                similar = (product + c1) * (covariance + c2)
                similar /= (squares + c1) * (variances + c2)
                row[block] = similar.mean(axis=(1, 2))
    return out if len(out) > 1 else out[0]


def all_metrics(
    estimates: np.ndarray, references: np.ndarray, data_range: float
) -> dict[str, np.ndarray]:
    """Return every metric of the tables for every star.

    Returns
    -------
    dict of ndarray, shape (n,)
        `mse`; `ssim` with the calibrated range, `ssim_unit` with range 1 and
        `ssim_peak` with each reference's own maximum minus minimum.
    """
    # Three dynamic ranges share the moving sums.
    peak = references.max(axis=(1, 2)) - references.min(axis=(1, 2))
    similar = ssim(estimates, references, data_range, 1.0, peak)
    names = ("ssim", "ssim_unit", "ssim_peak")
    return {"mse": mse(estimates, references), **dict(zip(names, similar, strict=True))}


def quality(estimate: Estimate, truth: np.ndarray, data_range: float) -> dict[str, np.ndarray]:
    """Return metrics of every star (n,), for its PSF and its estimated uncertainty.

    In addition to `all_metrics`, these are `coverage68`, the fraction of the pixels within ± σ,
    `evidence`, and `explained`, 1 or 0, where the estimate has them.
    """
    metrics = all_metrics(estimate.psf, truth, data_range)
    # Fraction of the pixels with an error below the estimated σ; 68 % if σ is right.
    if estimate.sigma is not None:
        inside = np.abs(estimate.psf - truth) <= estimate.sigma
        metrics["coverage68"] = inside.mean(axis=(1, 2))
    if estimate.evidence is not None:
        metrics["evidence"] = estimate.evidence
    if estimate.is_explained is not None:
        metrics["explained"] = estimate.is_explained.astype(float)
    return metrics


def summarise_metrics(
    row: Mapping[str, object], metrics: Mapping[str, np.ndarray], field: np.ndarray
) -> list[dict[str, Any]]:
    """Return the mean of each metric with its standard error, clustered by field, as table rows.

    Each row is a copy of `row` with additional columns.
    """
    # A row for each metric.
    rows = []
    for metric, values in metrics.items():
        mean, stderr = cluster_mean(values, field)
        rows.append({**row, "metric": metric, "value": mean, "stderr": stderr, "n": values.size})
    return rows


def cluster_mean(values: np.ndarray, cluster: np.ndarray) -> tuple[float, float]:
    """Return a mean and its standard error if stars of a field are not independent.

    SE² = G/(G − 1) Σ_g (Σ_{i∈g} (v_i − v̄))² / n², the cluster-robust variance of a
    mean (Liang & Zeger 1986) with G clusters.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Values v, one for each star.
    cluster : ndarray of int, shape (n,)
        Field of every star.

    Returns
    -------
    mean, standard_error : float
        Mean v̄ and its error, which is NaN for a single cluster.
    """
    # Sum of the deviations in each cluster.
    mean = float(values.mean())
    _, member = np.unique(cluster, return_inverse=True)
    sums = np.bincount(member, weights=values - mean)
    groups = sums.size
    # A single cluster does not determine the scatter between clusters.
    if groups < 2:
        return mean, float("nan")
    variance = groups / (groups - 1) * float((sums**2).sum()) / values.size**2
    return mean, float(np.sqrt(variance))


def cluster_ratio(
    values: np.ndarray, denominators: np.ndarray, cluster: np.ndarray
) -> tuple[float, float]:
    """Return the ratio R = v̄/w̄ of two means over the same stars, and its standard error.

    The error of the linearised ratio is the error of the mean of (v − R w)/w̄ (Cochran 1977,
    Sampling Techniques, sect. 6.4), clustered as in `cluster_mean`.

    Parameters
    ----------
    values, denominators : ndarray, shape (n,)
        v and w, star by star.
    cluster : ndarray of int, shape (n,)
        Field of every star.
    """
    # The mean of (v − R w)/w̄ is 0, and its error is the error of the ratio.
    ratio = float(values.mean() / denominators.mean())
    residuals = (values - ratio * denominators) / denominators.mean()
    _, stderr = cluster_mean(residuals, cluster)
    return ratio, stderr
