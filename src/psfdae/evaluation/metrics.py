"""Image metrics per star, their means with clustered standard errors, correlations of errors."""

from __future__ import annotations

import numpy as np

SSIM_WINDOW = 7
"""Side of scikit-image's default uniform SSIM window in pixels."""

TAME = 1e3
"""Pixels up to this many data ranges may share an image with other stars.

scikit-image's moving sums run on from star to star and carry rounding errors along,
1e-16 of the largest square: a broken star would spoil its neighbours.
"""


def mse(estimates: np.ndarray, references: np.ndarray) -> np.ndarray:
    """Mean squared error of every stamp, shape (n,)."""
    difference = estimates.astype(np.float64) - references
    return (difference**2).mean(axis=(1, 2))


def ssim(
    estimates: np.ndarray, references: np.ndarray, data_range: float | np.ndarray
) -> np.ndarray:
    """Structural similarity of every stamp, scikit-image's defaults.

    Stamps go through scikit-image in one call, as one tall image: its local map
    is exact wherever the window stays inside a stamp, and the border that
    scikit-image leaves out of the mean is just the rest. Stamps with a pixel
    beyond `TAME` data ranges go alone; not-a-number and infinity give NaN.

    Parameters
    ----------
    estimates, references : ndarray, shape (n, d, d)
    data_range : float or ndarray, shape (n,)
        Dynamic range; one value or one per star.

    Returns
    -------
    ndarray, shape (n,)

    Raises
    ------
    ValueError
        If a stamp is smaller than the window or a range is not positive.
    """
    count, side, _ = references.shape
    if side < SSIM_WINDOW:
        raise ValueError(f"stamps of {side} px are smaller than the SSIM window, {SSIM_WINDOW} px")
    scale = np.broadcast_to(np.asarray(data_range, dtype=np.float64), (count,))
    if not (scale > 0).all():
        raise ValueError(f"SSIM data_range must be positive, got {scale.min()}")
    # SSIM does not change if both images and the range are scaled alike.
    x, y = (a.astype(np.float64) / scale[:, None, None] for a in (estimates, references))
    largest = np.maximum(np.abs(x), np.abs(y)).max(axis=(1, 2))
    out = np.full(count, np.nan)
    tame = largest <= TAME
    if tame.any():
        out[tame] = _tall_ssim(x[tame], y[tame])
    for star in np.flatnonzero(np.isfinite(largest) & ~tame):
        out[star] = _tall_ssim(x[star : star + 1], y[star : star + 1])[0]
    return out


def _tall_ssim(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Mean of scikit-image's local SSIM in every stamp, data range 1, shape (n,)."""
    from skimage.metrics import structural_similarity

    count, side, _ = x.shape
    tall = (a.reshape(count * side, side) for a in (x, y))
    _, local = structural_similarity(*tall, data_range=1.0, win_size=SSIM_WINDOW, full=True)
    border = SSIM_WINDOW // 2
    inner = slice(border, side - border)
    return local.reshape(count, side, side)[:, inner, inner].mean(axis=(1, 2))


def peak_range(references: np.ndarray) -> np.ndarray:
    """Maximum minus minimum of every reference, shape (n,)."""
    return references.max(axis=(1, 2)) - references.min(axis=(1, 2))


def all_metrics(
    estimates: np.ndarray, references: np.ndarray, data_range: float
) -> dict[str, np.ndarray]:
    """Every metric of the tables for every star.

    Returns
    -------
    dict of ndarray, shape (n,)
        `mse`; `ssim` with the calibrated range, `ssim_unit` with range 1 and
        `ssim_peak` with each reference's own maximum minus minimum.
    """
    return {
        "mse": mse(estimates, references),
        "ssim": ssim(estimates, references, data_range),
        "ssim_unit": ssim(estimates, references, 1.0),
        "ssim_peak": ssim(estimates, references, peak_range(references)),
    }


def clustered_mean(values: np.ndarray, cluster: np.ndarray) -> tuple[float, float]:
    """Mean and its standard error when stars of a field are not independent.

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
    mean = float(values.mean())
    _, member = np.unique(cluster, return_inverse=True)
    sums = np.bincount(member, weights=values - mean)
    groups = sums.size
    if groups < 2:
        return mean, float("nan")
    variance = groups / (groups - 1) * float((sums**2).sum()) / values.size**2
    return mean, float(np.sqrt(variance))


LEAST_SAMPLES = 4
"""Fisher's z has the standard error 1/√(n − 3): fewer samples have no interval."""


def error_correlation(
    errors: np.ndarray, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pearson correlations of signed errors with intervals from Fisher's z.

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
    half = norm.isf(0.5 * (1.0 - confidence)) / np.sqrt(max(count - 3, 1))
    low, high = np.tanh(z - half), np.tanh(z + half)
    if count < LEAST_SAMPLES:
        off = ~np.eye(len(matrix), dtype=bool)
        low[off] = high[off] = np.nan
    for array in (matrix, low, high):
        array[~varies, :] = array[:, ~varies] = np.nan
    return matrix, low, high
