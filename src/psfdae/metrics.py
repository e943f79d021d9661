"""Image metrics per star, their means with clustered standard errors, correlations of errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from psfdae.method import Estimate

SSIM_WINDOW = 7
"""Side of the uniform SSIM window in pixels, scikit-image's default."""


def mse(estimates: np.ndarray, references: np.ndarray) -> np.ndarray:
    """Return the mean squared error of every stamp, shape (n,)."""
    difference = estimates.astype(np.float64) - references
    return np.asarray((difference**2).mean(axis=(1, 2)))


def ssim(
    estimates: np.ndarray, references: np.ndarray, *data_ranges: float | np.ndarray
) -> np.ndarray:
    """Return the structural similarity of every stamp, as scikit-image does by default.

    The mean over all places of the window inside the stamp of Wang et al. 2004 (IEEE Trans.
    Image Process. 13, 600), eq. 13, with sample covariances. Several dynamic ranges share
    the moving sums, which take most of the time.

    Parameters
    ----------
    estimates, references : ndarray, shape (n, d, d)
    *data_ranges : float or ndarray, shape (n,)
        Dynamic ranges; one value or one per star.

    Returns
    -------
    ndarray, shape (n,), or (number of ranges, n) of several
        NaN for a stamp with a pixel that is not finite.

    Raises
    ------
    ValueError
        If a stamp is smaller than the window or a range is not positive.
    """
    count, side, _ = references.shape
    if side < SSIM_WINDOW:
        raise ValueError(f"stamps of {side} px are smaller than the SSIM window, {SSIM_WINDOW} px")
    ranges = np.array([np.broadcast_to(r, count) for r in data_ranges], np.float64)
    if not (ranges > 0).all():
        raise ValueError(f"SSIM data_range must be positive, got {ranges.min()}")
    # Matrix that averages the pixels of an axis over the window: column j is 1/window at the pixels
    # of the window at place j, of which there are side − window + 1.
    place = np.arange(side)[:, None] - np.arange(side - SSIM_WINDOW + 1)
    window_mean = ((place >= 0) & (place < SSIM_WINDOW)) / SSIM_WINDOW

    def mean(images: np.ndarray) -> np.ndarray:
        """Return the mean of every window, transposed: only its sum over all places is used."""
        rows = (images.reshape(-1, side) @ window_mean).reshape(len(images), side, -1)
        columns = np.ascontiguousarray(rows.swapaxes(1, 2)).reshape(-1, side)
        return np.asarray((columns @ window_mean).reshape(len(images), *window_mean.shape[1:], -1))

    out = np.empty(ranges.shape)
    # The moving sums of 256 stars fit into a processor's cache.
    for first in range(0, count, 256):
        block = slice(first, first + 256)
        # SSIM does not change if both images and the range are scaled alike.
        unit = ranges[0, block, None, None]
        x, y = (a[block].astype(np.float64) / unit for a in (estimates, references))
        with np.errstate(invalid="ignore", over="ignore"):
            # Sample covariances over the window: n/(n − 1) times ⟨xy⟩ − ⟨x⟩⟨y⟩.
            mean_x, mean_y = mean(x), mean(y)
            product, squares = 2 * mean_x * mean_y, mean_x**2 + mean_y**2
            sample = SSIM_WINDOW**2 / (SSIM_WINDOW**2 - 1)
            covariance = sample * (2 * mean(x * y) - product)
            variances = sample * (mean(x * x + y * y) - squares)
            for row, data_range in zip(out, ranges[:, block, None, None] / unit, strict=True):
                # SSIM = (2μxμy + c1)(2σxy + c2) / ((μx² + μy² + c1)(σx² + σy² + c2)).
                c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
                similar = (product + c1) * (covariance + c2)
                similar /= (squares + c1) * (variances + c2)
                row[block] = similar.mean(axis=(1, 2))
    return out if len(out) > 1 else out[0]


def peak_range(references: np.ndarray) -> np.ndarray:
    """Return the maximum minus minimum of every reference, shape (n,)."""
    return np.asarray(references.max(axis=(1, 2)) - references.min(axis=(1, 2)))


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
    similar = ssim(estimates, references, data_range, 1.0, peak_range(references))
    names = ("ssim", "ssim_unit", "ssim_peak")
    return {"mse": mse(estimates, references), **dict(zip(names, similar, strict=True))}


def quality(estimate: Estimate, truth: np.ndarray, data_range: float) -> dict[str, np.ndarray]:
    """Return metrics of every star (n,), of its PSF and of the stated uncertainty.

    Beside those of `all_metrics`: `coverage68`, the part of the pixels within ± σ, `evidence`, and
    whether the star is `explained`, 1 or 0.
    """
    metrics = all_metrics(estimate.psf, truth, data_range)
    if estimate.sigma is not None:
        inside = np.abs(estimate.psf - truth) <= estimate.sigma
        metrics["coverage68"] = inside.mean(axis=(1, 2))
    if estimate.evidence is not None:
        metrics["evidence"] = estimate.evidence
    if estimate.explained is not None:
        metrics["explained"] = estimate.explained.astype(float)
    return metrics


def summarised(
    row: Mapping[str, object], metrics: Mapping[str, np.ndarray], field: np.ndarray
) -> list[dict[str, Any]]:
    """Return the mean of each metric with its standard error, clustered by field, as table rows.

    Each is added to a copy of `row`.
    """
    rows = []
    for metric, values in metrics.items():
        mean, stderr = clustered_mean(values, field)
        rows.append({**row, "metric": metric, "value": mean, "stderr": stderr, "n": values.size})
    return rows


def clustered_mean(values: np.ndarray, cluster: np.ndarray) -> tuple[float, float]:
    """Return a mean and its standard error when stars of a field are not independent.

    SE² = G/(G − 1) Σ_g (Σ_{i∈g} (v_i − v̄))² / n², the cluster-robust variance of a
    mean (Liang & Zeger 1986) with G clusters.

    Parameters
    ----------
    values : ndarray, shape (n,)
    cluster : ndarray of int, shape (n,)
        Field of every star.

    Returns
    -------
    mean, standard_error : float
        The error is NaN if there is one cluster only.
    """
    # Sum of the deviations in each cluster.
    mean = float(values.mean())
    _, member = np.unique(cluster, return_inverse=True)
    sums = np.bincount(member, weights=values - mean)
    groups = sums.size
    if groups < 2:
        return mean, float("nan")
    variance = groups / (groups - 1) * float((sums**2).sum()) / values.size**2
    return mean, float(np.sqrt(variance))


def clustered_ratio(
    values: np.ndarray, denominators: np.ndarray, cluster: np.ndarray
) -> tuple[float, float]:
    """Return the ratio R = v̄/w̄ of two means over the same stars, and its standard error.

    The error is that of the linearised ratio, the mean of (v − R w)/w̄ (Cochran 1977, Sampling
    Techniques, sect. 6.4), clustered as in `clustered_mean`.

    Parameters
    ----------
    values, denominators : ndarray, shape (n,)
        v and w, star by star.
    cluster : ndarray of int, shape (n,)
        Field of every star.
    """
    ratio = float(values.mean() / denominators.mean())
    residuals = (values - ratio * denominators) / denominators.mean()
    _, stderr = clustered_mean(residuals, cluster)
    return ratio, stderr


def error_correlation(
    errors: np.ndarray, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Pearson correlations of signed errors with intervals from Fisher's z.

    z = artanh r is nearly normal with the standard error 1/√(n − 3) for
    independent, jointly normal errors (Fisher 1921, Metron 1, 3).

    Parameters
    ----------
    errors : ndarray, shape (n, k)
        One row per sample, one column per parameter, any unit.
    confidence : float
        Probability of the two-sided interval, 0 … 1.

    Returns
    -------
    matrix, low, high : ndarray, shape (k, k)
        Correlations and the ends of their intervals; 1 on the diagonal. A column
        without variance correlates with nothing: its row and column are NaN,
        diagonal included, and no warning is given. With fewer than four samples
        the intervals are NaN off the diagonal.

    Raises
    ------
    ValueError
        If there is no sample, or an error is not finite.
    """
    from scipy.stats import norm

    errors = np.asarray(errors, np.float64)
    if not errors.size or not np.isfinite(errors).all():
        raise ValueError(f"errors of shape {errors.shape}: must be at least one and all finite")
    count = len(errors)
    varies = np.ptp(errors, axis=0) > 0
    # In units of the largest deviation, so that no square under- or overflows.
    deviation = errors - errors.mean(axis=0)
    deviation = deviation / np.where(varies, np.abs(deviation).max(axis=0), 1.0)
    length = np.where(varies, np.sqrt((deviation**2).sum(axis=0)), 1.0)
    matrix = np.clip((deviation / length).T @ (deviation / length), -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    with np.errstate(divide="ignore"):
        z = np.arctanh(matrix)
    # Interval z ± q/√(n − 3); with fewer than four samples there is none.
    half = norm.isf(0.5 * (1.0 - confidence)) / np.sqrt(max(count - 3, 1))
    low, high = np.tanh(z - half), np.tanh(z + half)
    if count < 4:
        off_diagonal = ~np.eye(len(matrix), dtype=bool)
        low[off_diagonal] = high[off_diagonal] = np.nan
    for array in (matrix, low, high):
        array[~varies, :] = array[:, ~varies] = np.nan
    return matrix, low, high


def seed_stderr(scatter: float, metric: str, mean: float) -> float:
    """Return the standard deviation of a mean error between seeds of a training.

    Parameters
    ----------
    scatter : float
        Standard deviation of the MSE between seeds, over the MSE; NaN if it was not measured.
    metric : str
        "mse", or an SSIM, of which 1 − SSIM is nearly proportional to the MSE; NaN for others.
    mean : float
        Mean of the metric.
    """
    error = mean if metric == "mse" else 1.0 - mean if metric.startswith("ssim") else np.nan
    return scatter * error
