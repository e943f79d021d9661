"""Residuals of the training stars about the field: their mean and covariance at every centre.

The residual of a star depends on the position of its centre in its pixel, its phase. Residuals are
stored by phase, in frames that are larger than a stamp by a margin: a stamp whose star is off the
middle pixel by whole pixels is a window of the frame.

Inputs: the residuals of a fit of the field. Outputs: the mean e₀ and the covariance C = RᵀR + diag
of the equations of the page docs/field_model.md.
"""

from __future__ import annotations

import numpy as np

from psfdae.base.progress import steps
from psfdae.stars.moments import moving_matrices

MARGIN_PX = 2
"""Width in pixels of the margin around a stamp in which field and residuals are known, too."""


def list_phases(step_px: float) -> np.ndarray:
    """Return the distinct offsets of nodes from the centre of their pixel, in pixels."""
    # Positions of nodes along an axis, minus the centres of their pixels.
    count = round(MARGIN_PX / step_px)
    place = step_px * np.arange(-count, count + 1)
    return np.unique(np.round(place - np.floor(place + 0.5), 9))


def find_phase(place: np.ndarray, phases: np.ndarray, side: int) -> tuple[int, np.ndarray]:
    """Return the phase and the window of the stored residuals of stars with a given centre.

    Parameters
    ----------
    place : ndarray, shape (2,)
        Centre (row, column) from the middle pixel of a stamp.
    phases : ndarray
        Result of `list_phases`.
    side : int
        Side of the stamp in pixels.

    Returns
    -------
    phase : int
        Index of the phase nearest to the centre.
    window : ndarray of int, shape (side²,)
        Pixels of the stamp in a frame whose star is in its middle pixel.
    """
    # If the star's pixel is off the middle, the window is shifted in the opposite direction.
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
        Fraction of their variance that is assigned to the diagonal, 0 … 1.

    Returns
    -------
    offset : ndarray, shape (f², w²)
        Mean residual e₀ at each of the f² phases, in frames of w² pixels.
    modes : ndarray, shape (f², r, w²)
        Rows R of the covariance.
    diagonal : ndarray, shape (f², w²)
        Variance of single pixels in addition to the modes.
    """
    side = residual.shape[-1]
    # Weight of a star: the fraction of its residual that is not noise, signal / (signal + noise).
    core = residual[:, 1:-1, 1:-1]
    noise_square = noise**2 * core[0].size
    signal = np.median(np.maximum(np.square(core).sum(axis=(1, 2)) - noise_square, 0.0))
    weight = (signal + 1e-12) / (signal + 1e-12 + noise_square)
    weight /= weight.sum()
    # A shift by splines averages noise: half of its variance remains, and is not part of C. The
    # noise of all pixels is in as many components as there are stars, if these are fewer.
    noise_variance = 0.5 * float(weight @ noise**2) * max(side**2 / len(residual), 1.0)
    # Matrices that shift the star from its centre to each phase, along rows and columns.
    shifts = list_phases(step_px)[:, None, None] - centre
    rows, columns = (moving_matrices(side, shifts[..., axis]) for axis in (0, 1))
    columns = columns.transpose(0, 1, 3, 2)
    covariances = []
    for row in steps("residuals", rows):
        shifted_rows = row @ residual
        for column in columns:
            flat_residuals = (shifted_rows @ column).reshape(len(residual), -1)
            # Principal components of the residuals, and their variances minus the noise.
            mean = weight @ flat_residuals
            scatter = np.sqrt(weight)[:, None] * (flat_residuals - mean)
            square, axes = find_components(scatter)
            modes = np.sqrt(np.maximum(square - noise_variance, 0.0))[:, None] * axes
            # The leading components are modes. The diagonal has a fraction of their variance and
            # all other components, because modes of few stars are not the directions of all stars.
            variance = np.square(modes).sum(axis=0)
            modes = np.sqrt(1.0 - diagonal_fraction) * modes[:mode_count]
            diagonal = variance - np.square(modes).sum(axis=0)
            # The variance of a pixel is at least 1 % of the mean variance.
            covariances.append((mean, modes, np.maximum(diagonal, 0.01 * diagonal.mean())))
    offset, all_modes, diagonals = (np.stack(arrays) for arrays in zip(*covariances, strict=True))
    # An error of 1e-6 of the flux in any pixel keeps C invertible.
    return offset, all_modes, np.maximum(diagonals, 1e-6**2)


def find_components(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the principal components of rows (n, P) about 0, the largest first.

    Returns
    -------
    square : ndarray, shape (m,)
        Sums of squares of the rows along the components, m = min(n, P).
    axes : ndarray, shape (m, P)
        The components, orthonormal, but those without a sum are 0.
    """
    # Eigenvectors of the smaller one of RᵀR and RRᵀ, in a third of the time of singular values.
    count, pixels = rows.shape
    if count >= pixels:
        square, axes = np.linalg.eigh(rows.T @ rows)
        return square[::-1], axes[:, ::-1].T
    square, weights = np.linalg.eigh(rows @ rows.T)
    square = np.maximum(square[::-1], 0.0)
    size = np.sqrt(square)[:, None]
    axes = np.divide(weights[:, ::-1].T @ rows, size, out=np.zeros_like(rows), where=size > 0)
    return square, axes
