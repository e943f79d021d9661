"""Stars in the residuals of an image, found with a filter that is matched to the PSF of the model.

A star at the position c, in residuals r of which each pixel q has the noise σ, has by least squares
the flux F, and this flux the signal-to-noise ratio S,

    F = Σ P(q − c) r/σ² / Σ P(q − c)²/σ²,    S = Σ P(q − c) r/σ² / √(Σ P(q − c)²/σ²).

No other linear filter gives a higher S (Stetson 1987, PASP 99, 191; Zackay & Ofek 2017, ApJ 836,
187). S is computed at all half pixels, because the PSF of an undersampled star changes with its
position within a pixel.
"""

from __future__ import annotations

import numpy as np

from psfdae.psf.grid import PsfGrid
from psfdae.stars.moments import SIGMA_OF_MAD

PHASES_PX = 0.5 * np.array([(0, 0), (1, 0), (0, 1), (1, 1)])  # x and y of the half pixels of one


def find_stars(
    psfs: PsfGrid,
    residual: np.ndarray,
    sigma: np.ndarray,
    star_positions: np.ndarray,
    threshold: float,
    fwhm_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (n, 2), x and y, and fluxes (n,) of the stars in residuals.

    Parameters
    ----------
    psfs : PsfGrid
        PSFs of the field.
    residual, sigma : ndarray, shape (h, w)
        Image without its sky and known stars, finite, and σ of its pixels, in the unit of
        `Observation.sky`. σ includes the errors of the models of these stars. It is infinite for
        bad pixels; a star needs half of Σ P² in others.
    star_positions : ndarray, shape (m, 2)
        Positions x and y of the known stars. A peak at one of them is the star's residual.
    threshold : float
        Minimum S. Where S scatters by more than 1, as in the structure of a nebula, it is that many
        times larger.
    fwhm_px : float
        FWHM of the PSF, px. Stars are at least half of it apart, known ones included.
    """
    from scipy.ndimage import maximum_filter
    from scipy.spatial import cKDTree

    # Tiles of one PSF and one scatter. Beyond 1.5 FWHM, a PSF adds little to S.
    tile_px, half_px = max(64, 16 * int(np.ceil(fwhm_px))), int(np.ceil(1.5 * fwhm_px))
    margin, peaks, columns = half_px + 1, [], np.arange(0, residual.shape[1], tile_px)
    for top in range(0, len(residual), tile_px):
        # PSFs of stars in the middle of each tile of a row, at the four phases.
        middle = np.stack([columns, np.full(len(columns), top)], axis=1) + tile_px // 2
        centre = (middle[:, None] + PHASES_PX).reshape(-1, 2)
        corner, faint = np.repeat(middle - half_px, 4, axis=0), np.zeros(len(centre))
        psf = psfs.stamps(centre, corner, 2 * half_px + 1, flux=faint)[:, 0]
        for start, tile_psf in zip(columns.tolist(), np.split(psf, len(columns)), strict=True):
            # The tile, with a margin of as many pixels as the PSF reaches.
            row, column = max(top - margin, 0), max(start - margin, 0)
            window = np.s_[row : top + tile_px + margin, column : start + tile_px + margin]
            snr, flux = measure_snr(residual[window], sigma[window], tile_psf)
            # Local maxima among all half pixels, as far as they are in the tile.
            at = np.nonzero((snr > threshold) & (snr == maximum_filter(snr, 3)))
            y, x = row + at[0] / 2, column + at[1] / 2
            is_inside = (y // tile_px * tile_px == top) & (x // tile_px * tile_px == start)
            peaks.append(np.column_stack([x, y, flux[at], snr[at]])[is_inside])
    stars = np.concatenate(peaks)
    stars = stars[cKDTree(star_positions).query(stars[:, :2])[0] > 0.5 * fwhm_px]
    # Of two peaks that are too near to each other, the lower one is a part of the other.
    pairs = cKDTree(stars[:, :2]).query_pairs(0.5 * fwhm_px, output_type="ndarray")
    lower = pairs[np.arange(len(pairs)), np.argmin(stars[pairs, 3], axis=1)]
    stars = np.delete(stars, lower, axis=0)
    return stars[:, :2], stars[:, 2]


def measure_snr(residual: np.ndarray, sigma: np.ndarray, psf: np.ndarray) -> np.ndarray:
    """Return S over its scatter, and F, at half pixels of a part (h, w) of an image, (2, 2h, 2w).

    `psf` (4, s, s) has the PSFs of stars at `PHASES_PX` from the middle pixel. S is 0 where more
    than half of Σ P² is in bad pixels.
    """
    from scipy.signal import fftconvolve

    # r/σ and 1/σ: the squares have a number in the unit of `Observation.sky`.
    is_used = np.isfinite(sigma)
    weight, deviation = (1.0 / sigma).astype(np.float32), (residual / sigma).astype(np.float32)
    # Sums over pixels are convolutions with the mirrored PSF: Σ P r/σ², Σ P²/σ², and Σ P² of
    # the good pixels.
    mirror = psf[:, ::-1, ::-1].astype(np.float32)
    square = np.square(mirror)
    (height, width), half = sigma.shape, psf.shape[-1] // 2
    middle = np.s_[:, half : half + height, half : half + width]
    projection, information, good = (
        fftconvolve(values.astype(np.float32)[None], kernel, axes=(1, 2))[middle]
        for values, kernel in ((weight * deviation, mirror), (weight**2, square), (is_used, square))
    )
    is_known = good > 0.5 * square.sum(axis=(1, 2), keepdims=True)
    root = np.sqrt(np.where(is_known, information, np.inf))
    snr = projection / root
    flux = snr / root
    # Structure of the sky, and undetected stars, are noise of S, too.
    if is_known.any():
        snr /= max(SIGMA_OF_MAD * float(np.median(np.abs(snr[is_known]))), 1.0)
    # The four phases of a pixel are its four half pixels.
    values = np.stack([snr, flux]).reshape(2, 2, 2, height, width).transpose(0, 3, 1, 4, 2)
    return values.reshape(2, 2 * height, 2 * width)
