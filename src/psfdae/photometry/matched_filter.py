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
    changed_positions: np.ndarray | None = None,
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
    changed_positions : ndarray, shape (k, 2), optional
        Stars that were added to the model or dropped since the last search: only tiles that these
        reach are searched. By default, all are.
    """
    from numpy.lib.stride_tricks import sliding_window_view
    from scipy.spatial import cKDTree

    # Tiles of one PSF and one scatter. Beyond 1.5 FWHM, a PSF adds little to S.
    tile_px, half_px = max(64, 16 * int(np.ceil(fwhm_px))), int(np.ceil(1.5 * fwhm_px))
    (height, width), margin = residual.shape, half_px + 1
    first_columns = np.arange(0, width, tile_px)
    is_searched = np.ones((-(-height // tile_px), len(first_columns)), dtype=bool)
    if changed_positions is not None:
        # Tiles with a pixel whose S has light of a changed star.
        reach_px = psfs.side_px // 2 + margin
        ends = np.stack([changed_positions - reach_px, changed_positions + reach_px], axis=2)
        is_searched[:] = False
        for columns, rows in (np.maximum(ends, 0.0) // tile_px).astype(int):
            is_searched[rows[0] : rows[1] + 1, columns[0] : columns[1] + 1] = True
    peaks = [np.empty((0, 4))]
    for top in (tile_px * np.flatnonzero(is_searched.any(axis=1))).tolist():
        # PSFs of stars in the middle of each tile of a row, at the four phases.
        tiles = np.flatnonzero(is_searched[top // tile_px])
        columns = first_columns[tiles]
        middle = np.stack([columns, np.full(len(columns), top)], axis=1) + tile_px // 2
        centre = (middle[:, None] + PHASES_PX).reshape(-1, 2)
        corner, faint = np.repeat(middle - half_px, 4, axis=0), np.zeros(len(centre))
        psf = psfs.stamps(centre, corner, 2 * half_px + 1, flux=faint)
        # r/σ and 1/σ of these tiles, (tiles, rows, columns), with a margin of a pixel more than the
        # PSF reaches. Both are 0 off the image; squares have a number in the unit of the sky.
        first, end = max(top - margin, 0), min(top + tile_px + margin, height)
        pads = (first - top + margin, top + tile_px + margin - end), (margin, margin + tile_px)
        bands = (
            np.pad(values.astype(np.float32), pads)
            for values in (residual[first:end] / sigma[first:end], 1.0 / sigma[first:end])
        )
        side = tile_px + 2 * margin
        deviation, weight = (
            sliding_window_view(band, side, axis=1)[:, ::tile_px].swapaxes(0, 1)[tiles]
            for band in bands
        )
        tile_psfs = psf.reshape(len(columns), 4, *psf.shape[1:])
        snr, flux = measure_snr(deviation, weight, tile_psfs)
        # Local maxima among all half pixels of the tile; a pixel more surrounds it.
        tile, row, column = np.nonzero(snr[:, 2:-2, 2:-2] > threshold)
        around = np.ix_([1, 2, 3], [1, 2, 3])
        rows, across = (
            at[:, None, None] + axis for at, axis in zip((row, column), around, strict=True)
        )
        neighbours = snr[tile[:, None, None], rows, across]
        at = tile, row + 2, column + 2
        values = [columns[tile] + column / 2, top + row / 2, flux[at], snr[at]]
        peaks.append(np.stack(values, axis=1)[snr[at] == neighbours.max(axis=(1, 2))])
    stars = np.concatenate(peaks)
    stars = stars[cKDTree(star_positions).query(stars[:, :2])[0] > 0.5 * fwhm_px]
    # Of two peaks that are too near to each other, the lower one is a part of the other.
    pairs = cKDTree(stars[:, :2]).query_pairs(0.5 * fwhm_px, output_type="ndarray")
    lower = pairs[np.arange(len(pairs)), np.argmin(stars[pairs, 3], axis=1)]
    stars = np.delete(stars, lower, axis=0)
    return stars[:, :2], stars[:, 2]


def measure_snr(
    deviation: np.ndarray, weight: np.ndarray, psf: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return S over its scatter, and F, at the half pixels of n parts of an image.

    Parameters
    ----------
    deviation, weight : ndarray, shape (n, h, w), float32
        r/σ and 1/σ, 0 for bad pixels.
    psf : ndarray, shape (n, 4, s, s)
        PSFs of stars at `PHASES_PX` from the middle pixel, s odd.

    Returns
    -------
    snr, flux : ndarray, shape (n, 2(h + 1 − s), 2(w + 1 − s))
        At the pixels about which a part has the whole PSF. S and F are 0 where more than half of
        Σ P² is in bad pixels, and where Σ P²/σ² is below 1e-6 of its largest value: the sums are in
        single precision.
    """
    from scipy import fft

    # Sums over pixels are correlations with the PSF: Σ P r/σ², Σ P²/σ², and Σ P² of the good
    # pixels. Those that reach across the edge to the other side are cut off.
    *_, height, width = weight.shape
    size = [fft.next_fast_len(side, real=True) for side in (height, width)]
    inner = np.s_[..., : height + 1 - psf.shape[-1], : width + 1 - psf.shape[-1]]
    square = np.square(psf.astype(np.float32))
    # Rows beyond the PSF are 0, and so are their transforms along x.
    kernels = [
        np.conj(fft.fft(fft.rfft(values, size[1]), size[0], axis=-2))
        for values in (psf.astype(np.float32), square)
    ]

    def correlate(values: np.ndarray, kernel: np.ndarray) -> np.ndarray:
        product = fft.rfft2(values.astype(np.float32), size)[:, None] * kernel
        return np.asarray(fft.irfft2(product, size)[inner])

    projection = correlate(weight * deviation, kernels[0])
    information = correlate(weight**2, kernels[1])
    # The error of a sum is 1e-7 of the largest one: in the light of a star of 10⁵ σ, whose model's
    # error makes σ 10³ times as large, nothing can be found.
    is_known = information > 1e-6 * information.max(axis=(1, 2, 3), keepdims=True)
    # Only parts with bad pixels, or at an edge, can lack half of Σ P².
    is_used = weight > 0
    parts = np.flatnonzero(~is_used.all(axis=(1, 2)))
    if parts.size:
        total = square[parts].sum(axis=(2, 3), keepdims=True)
        is_known[parts] &= correlate(is_used[parts], kernels[1][parts]) > 0.5 * total
    root = np.sqrt(np.where(is_known, information, np.inf))
    snr = projection / root
    flux = snr / root
    # Structure of the sky, and undetected stars, are noise of S, too: its median modulus at the
    # middles of the pixels. Unknown values are last.
    modulus = np.where(is_known[:, 0], np.abs(snr[:, 0]), np.inf).reshape(len(snr), -1)
    count = np.count_nonzero(is_known[:, 0], axis=(1, 2))
    modulus.sort(axis=1)
    scatter = SIGMA_OF_MAD * modulus[np.arange(len(snr)), np.maximum(count - 1, 0) // 2]
    snr /= np.where(count > 0, np.maximum(scatter, 1.0), 1.0)[:, None, None, None]
    # The four phases of a pixel are its four half pixels.
    tiles, _, height, width = snr.shape
    snr, flux = (
        values.reshape(tiles, 2, 2, height, width)
        .transpose(0, 3, 1, 4, 2)
        .reshape(tiles, 2 * height, 2 * width)
        for values in (snr, flux)
    )
    return snr, flux
