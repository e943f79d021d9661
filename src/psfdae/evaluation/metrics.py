"""Image metrics per star and their means with clustered standard errors."""

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
