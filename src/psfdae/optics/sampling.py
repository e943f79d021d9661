"""How finely a pupil must be sampled so that nothing is aliased."""

from __future__ import annotations

import numpy as np

ARCSEC = np.pi / 180.0 / 3600.0
"""One arc second in radians."""


class SamplingError(ValueError):
    """The pupil grid is too coarse for a wavefront or for the stamp's position."""


def required_samples(slopes: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Smallest number of pupil samples that represents a wavefront and its stamp.

    Two conditions per axis. The OPD may change by half a wave per sample:
    N ≥ 4·max|∂W/∂ρ|. And the images of the pupil grid repeat every N λ/D, so
    no replica of the geometric blur, which spans 2·∂W/∂ρ, may reach the stamp.

    Parameters
    ----------
    slopes : ndarray, shape (..., 2, 2)
        [axis, (min, max)] slope of the OPD in waves per pupil radius.
    reach : ndarray, shape (..., 2, 2)
        [axis, (min, max)] edges of the stamp in λ/D from the chief ray.

    Returns
    -------
    ndarray of int, shape (...)

    Raises
    ------
    SamplingError
        If a slope is not finite.
    """
    steepest = 4.0 * np.abs(slopes).max(axis=(-2, -1))
    blur = 2.0 * slopes
    replica = np.maximum(
        blur[..., 1] - reach[..., 0],
        reach[..., 1] - blur[..., 0],
    ).max(axis=-1)
    needed = np.maximum(steepest, replica)
    if not np.isfinite(needed).all():
        wavefront = int(np.flatnonzero(~np.isfinite(needed))[0])
        raise SamplingError(f"wavefront {wavefront} is not finite: no grid can sample it")
    # Larger numbers would wrap around as integers; no ladder ends that high.
    return np.ceil(np.minimum(needed, 2.0**53)).astype(np.int64)


def pixel_width(scale_arcsec: float, diameter_m: float, wavelength_m: float) -> float:
    """Width of a pixel in units of λ/D."""
    return scale_arcsec * ARCSEC * diameter_m / wavelength_m


def required_nodes(pixel: float) -> int:
    """Gauss–Legendre nodes per axis that integrate the image over a pixel.

    Across a pixel of width p λ/D the intensity has up to p periods; ⌈πp/2 + 3/2⌉
    nodes keep the MSE of the scenes' stamps within their error budgets for pixels
    of 0.3 to 9 λ/D (target stability).
    """
    return int(np.ceil(0.5 * np.pi * pixel + 1.5))


def choose_samples(needed: np.ndarray, ladder: tuple[int, ...]) -> np.ndarray:
    """Smallest rung of a ladder of grid sizes that serves each wavefront.

    Parameters
    ----------
    needed : ndarray of int, shape (B,)
        Result of `required_samples`.
    ladder : tuple of int
        Available grid sizes N, ascending.

    Returns
    -------
    ndarray of int, shape (B,)

    Raises
    ------
    SamplingError
        If a wavefront needs more than the last rung; names the N that would do.
    """
    worst = int(needed.max())
    if worst > ladder[-1]:
        star = int(needed.argmax())
        raise SamplingError(
            f"optics.pupil_samples = {list(ladder)}: wavefront {star} needs N ≥ {worst} pupil "
            f"samples (half a wave per sample, replicas clear of the stamp); "
            f"{int((needed > ladder[-1]).sum())} of {needed.size} wavefronts exceed the last value"
        )
    rungs = np.asarray(ladder)
    return rungs[np.searchsorted(rungs, needed)]
