"""Residuals of the training stars about the field: their mean and covariance at every centre.

What the field leaves of a star depends on where its centre lies in its pixel, its phase. Residuals
are stored by phase, in frames that are larger than a stamp by a margin: a stamp whose star is off
the middle pixel by whole pixels is a window of the frame. In go the residuals of a fit of the
field; out come the mean e₀ and the covariance C = RᵀR + diag of the equations of the page
docs/field_model.md.
"""

from __future__ import annotations

import numpy as np

from psfdae.base.progress import steps
from psfdae.stars.moments import moving_matrices

MARGIN_PX = 2
"""Width in pixels of the margin around a stamp in which field and residuals are known as well."""


def phases_of(step_px: float) -> np.ndarray:
    """Return the offsets from the centre of a pixel at which nodes lie, in pixels."""
    # Places of nodes along an axis, less those of their pixels' centres, each once.
    count = round(MARGIN_PX / step_px)
    place = step_px * np.arange(-count, count + 1)
    return np.unique(np.round(place - np.floor(place + 0.5), 9))


def phase_of(place: np.ndarray, phases: np.ndarray, side: int) -> tuple[int, np.ndarray]:
    """Return where the residuals of stars with a given centre are stored.

    Parameters
    ----------
    place : ndarray, shape (2,)
        Centre (row, column) from the middle pixel of a stamp.
    phases : ndarray
        Offsets of `phases_of`.
    side : int
        Side of the stamp in pixels.

    Returns
    -------
    phase : int
        Number of the phase nearest to the centre.
    window : ndarray of int, shape (side²,)
        Pixels of the frame, which has a star in its middle pixel, that are the stamp.
    """
    # A star whose nearest pixel is off the middle is seen by a window that is moved the other way.
    nearest_pixel = np.floor(np.round(place, 9) + 0.5)
    row, column = np.abs((place - nearest_pixel)[:, None] - phases).argmin(axis=1)
    rows, columns = (np.arange(side) + MARGIN_PX - w for w in nearest_pixel.astype(int))
    window = (rows[:, None] * (side + 2 * MARGIN_PX) + columns).ravel()
    return int(row * len(phases) + column), np.asarray(window)


def residual_covariance(
    residual: np.ndarray,
    centre: np.ndarray,
    noise: np.ndarray,
    step_px: float,
    mode_count: int,
    diagonal_fraction: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean, modes and diagonal of the residual covariance C at every phase of a pixel.

    Parameters
    ----------
    residual : ndarray, shape (n, w, w)
        Residuals of n stars of flux 1, in frames about their brightest pixel.
    centre : ndarray, shape (n, 2)
        (row, column) of the stars from the middle pixel.
    noise : ndarray, shape (n,)
        RMS of a pixel of each star, over its flux.
    step_px : float
        Distance of two nodes.
    mode_count : int
        Number r of leading modes that are kept.
    diagonal_fraction : float
        Part of the variance of these that counts as one of single pixels.

    Returns
    -------
    offset : ndarray, shape (f², w²)
        Mean residual e₀ at each of the f² phases, in frames of w² pixels.
    modes : ndarray, shape (f², r, w²)
        Rows R of the covariance.
    diagonal : ndarray, shape (f², w²)
    """
    side = residual.shape[-1]
    # Weight of a star: which part of its residual is not noise, signal / (signal + noise).
    core = residual[:, 1:-1, 1:-1]
    noise_square = noise**2 * core[0].size
    signal = np.median(np.maximum(np.square(core).sum(axis=(1, 2)) - noise_square, 0.0))
    weight = (signal + 1e-12) / (signal + 1e-12 + noise_square)
    weight /= weight.sum()
    # Splines that move an image average its noise: half of the variance is left, which is no part
    # of C.
    noise_variance = 0.5 * float(weight @ noise**2)
    # Matrices that move the star from its centre to each phase, along rows and columns.
    shifts = phases_of(step_px)[:, None, None] - centre
    rows, columns = (
        np.array([moving_matrices(side, row) for row in shifts[..., axis]]) for axis in (0, 1)
    )
    columns = columns.transpose(0, 1, 3, 2)
    covariances = []
    for row in steps("residuals", rows):
        shifted_rows = row @ residual
        for column in columns:
            shifted = (shifted_rows @ column).reshape(len(residual), -1)
            # Principal components of the residuals, their variances less that of noise.
            mean = weight @ shifted
            scatter = np.sqrt(weight)[:, None] * (shifted - mean)
            _, size, axes = np.linalg.svd(scatter, full_matrices=False)
            modes = np.sqrt(np.maximum(size**2 - noise_variance, 0.0))[:, None] * axes
            # The leading ones are modes, a part of their variance and all other components the
            # diagonal: of few stars, modes are not the directions of all stars.
            variance = np.square(modes).sum(axis=0)
            modes = np.sqrt(1.0 - diagonal_fraction) * modes[:mode_count]
            diagonal = variance - np.square(modes).sum(axis=0)
            # No pixel is much surer than the others: 1 % of their mean variance at least.
            covariances.append((mean, modes, np.maximum(diagonal, 0.01 * diagonal.mean())))
    offset, all_modes, diagonals = (np.stack(arrays) for arrays in zip(*covariances, strict=True))
    # An error of 1e-6 of the flux in any pixel keeps C invertible.
    return offset, all_modes, np.maximum(diagonals, 1e-6**2)
