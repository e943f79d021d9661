"""The sky of images and stamps: its level and noise, and its subtraction.

| of | by | result |
|---|---|---|
| an image in memory | `subtract_sky` | `Sky`: level and noise in each pixel, the image without it |
| an image on the disk | `sample_sky` | `SkySample`: one level and noise, from squares |
| stamps with a margin | `sky_around` | level and noise around each star |
| stamps without a margin | `border_median`, `border_scatter` | level and noise in their border |

`psfdae.image.sky_level` has the algorithm by which level and noise of each pixel are measured.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from functools import cache, cached_property

import numpy as np
import scipy

from psfdae.image.fits_file import ImageFile, open_pixels
from psfdae.image.interpolation import fill_bad
from psfdae.image.sky_level import SkyLevel, SkyStructure, noise_correlation, sky_level
from psfdae.stars.moments import (
    SIGMA_OF_MAD,
    count_step,
    dither,
    remove_dither,
    row_medians,
)


@dataclass(frozen=True)
class Sky:
    """Sky of an image (h, w), and the image without it, in single precision.

    Attributes
    ----------
    signal : ndarray, shape (h, w)
        Image minus its sky; interpolated where bad, 0 where no good pixel is near.
    level, noise : ndarray, shape (h, w)
        Level of the sky, and σ of each pixel.
    bad : ndarray of bool, shape (h, w)
        Pixels to ignore.
    noise_scale : float
        Factor from the map of σ that was given to `noise`; NaN without a map.
    least_noise : float
        Lower limit of `noise`, in the unit of the image.
    structure : SkyStructure
        Lines at which the level of the sky changes, and step of the pixels in counts.
    correlation : float
        Factor by which `noise` is larger than σ of single pixels, because pixels share noise.
    notes : tuple of str
        Sentences on steps and structure of the sky.
    """

    signal: np.ndarray
    level: np.ndarray
    noise: np.ndarray
    bad: np.ndarray
    noise_scale: float
    least_noise: float = 0.0
    structure: SkyStructure = field(default_factory=SkyStructure)
    correlation: float = 1.0
    notes: tuple[str, ...] = ()

    @cached_property
    def holes(self) -> np.ndarray:
        """Bad pixels (h, w) of which more than half of the 5 × 5 pixels around are bad, too.

        Other bad pixels are interpolated, so that a star with one of these is one source.
        """
        if not self.bad.any():
            return self.bad
        # Fraction of the 5 × 5 pixels that is bad.
        around = scipy.ndimage.uniform_filter(self.bad.astype(np.float32), 5, mode="nearest")
        return np.asarray(self.bad & (around > 0.5))


def subtract_sky(
    image: np.ndarray,
    bad: np.ndarray,
    sigma: np.ndarray | None = None,
    least_noise: float = 0.0,
    known_sky: SkyLevel | None = None,
    structure: SkyStructure | None = None,
) -> Sky:
    """Measure the sky of an image; return it, and the image without it.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Image, in any unit.
    bad : ndarray of bool, shape (h, w)
        Pixels to ignore.
    sigma : ndarray, shape (h, w), optional
        σ of every pixel but for a factor, which is fitted here.
    least_noise : float
        Lower limit of the noise, in the unit of the image.
    known_sky : SkyLevel, optional
        Sky of the image, if it was measured before; its noise is changed here.
    structure : SkyStructure, optional
        Structure of the sky, if it is known from the image with its stars.

    Raises
    ------
    ValueError
        If no mesh has enough good pixels.
    """
    # Level and noise from the good pixels.
    image = np.where(bad, 0.0, image)
    sky = sky_level(image, bad, structure) if known_sky is None else known_sky
    level, noise, *_ = sky
    # Whole counts or simulated images may show no noise. Thresholds are multiples of the noise, and
    # must not be 0: the limit is about the rounding of a double, and above 0.
    least_noise = max(least_noise, 1e-13 * float(np.ptp(image)), float(np.finfo(np.float32).tiny))
    noise = np.maximum(noise, least_noise, out=noise)
    # A map of σ is scaled by the median ratio of the measured noise to it.
    scale = np.nan
    if sigma is not None:
        scale = float(np.median(noise[~bad] / sigma[~bad]))
        # Bad pixels, for which the map may lack σ, keep the noise of the sky around.
        noise = np.where(np.isfinite(sigma), scale * sigma, noise).astype(np.float32)
    # In place: of a large image, each copy takes much memory.
    image = np.subtract(image, level, out=image, casting="same_kind")
    signal = fill_bad(image.astype(np.float32, copy=False), bad)[0]
    return Sky(signal, level, noise, bad, scale, least_noise, *sky[2:])


@dataclass(frozen=True)
class SkySample:
    """Sky of an image from squares spread over it, in the image's unit.

    Attributes
    ----------
    level : float
        Median over the squares of their medians.
    noise : float
        Median over the squares of σ by their median deviation, times `correlation`.
    highest : float
        Largest pixel of all squares.
    correlation : float
        Ratio of the noise of sums of pixels to the noise of sums of independent ones, at least 1.
    checker : float
        Mean of the pixels whose row and column are both even or both odd, minus the mean of the
        others, in units of the noise: the contrast of a chessboard.
    level_range : float
        Deviation of the squares' medians from `level` in units of their noise, which 5 % exceed.
    """

    level: float
    noise: float
    highest: float
    correlation: float
    checker: float
    level_range: float


def sample_sky(image: ImageFile, square_px: int = 32) -> SkySample | None:
    """Measure the sky in squares of at most 32 bands of rows; None if no square shows noise.

    Squares of one value, such as an area without data, are ignored.

    Parameters
    ----------
    image : ImageFile
        Image (h, w) whose pixels are read.
    square_px : int
        Side of the squares in which sky and noise are measured.
    """
    rows, columns = image.shape
    # Bands of rows, evenly spread over the image.
    last_row = max(rows - square_px, 0)
    count = min(32, -(-rows // square_px))
    starts = np.unique(np.linspace(0, last_row, count).astype(int) // 2 * 2)
    level_parts, noise_parts, highest = [], [], -np.inf
    # Deviations from the sky in σ, band below band, with four rows without values between them.
    deviations = np.full((len(starts), square_px + 4, columns), np.nan, np.float32)
    with open_pixels(image, in_pieces=True, dtype=np.float64) as pixels:
        for start, deviation in zip(starts, deviations, strict=True):
            band = pixels[start : start + square_px]
            band = np.where(np.isfinite(band), band, np.nan)
            highest = max(highest, float(np.nanmax(band, initial=-np.inf)))
            # Medians of whole counts become the medians of the counts before rounding.
            band, dither_variance = dither(band, count_step(band))
            # A row for each square; NaN beyond the last row and column.
            pads = (0, square_px - len(band)), (0, -columns % square_px)
            wide_band = np.pad(band, pads, constant_values=np.nan)
            parts = wide_band.reshape(square_px, -1, square_px).swapaxes(0, 1)
            squares = parts.reshape(-1, square_px**2)
            # Stars in a square hardly change its median and its median deviation.
            square_level = row_medians(squares)
            offset = squares - square_level[:, None]
            scatter = SIGMA_OF_MAD * row_medians(np.abs(offset))
            square_noise = remove_dither(scatter, dither_variance)
            is_measured = np.count_nonzero(np.isfinite(squares), axis=1) >= square_px
            is_measured &= square_noise > 0
            level_parts.append(square_level[is_measured])
            noise_parts.append(square_noise[is_measured])
            # Larger deviations are of stars, and could leave the range of single precision.
            offset[~is_measured] = np.nan
            offset = np.clip(offset / square_noise[:, None], -1e6, 1e6).reshape(parts.shape)
            in_band = offset.swapaxes(0, 1).reshape(wide_band.shape)[: len(band), :columns]
            deviation[: len(band)] = in_band
    levels, noises = np.concatenate(level_parts), np.concatenate(noise_parts)
    if not levels.size:
        return None
    # White pixels are found by the parity of row and column, as bands begin at even rows. Means of
    # values that are clipped at 3 σ, against stars: medians of whole counts would mostly be equal.
    bands = deviations.reshape(-1, columns)
    clipped = np.clip(bands, -3.0, 3.0)
    white, black = (
        np.nanmean(np.append(clipped[::2, first::2], clipped[1::2, 1 - first :: 2]), dtype=float)
        for first in (0, 1)
    )
    checker = float(white - black)
    # Resampled pixels share noise: sums of them scatter by more than independent ones. 512 × 512 px
    # are enough, of which a correlation has the error 0.006.
    middle = tuple(slice(max(0, size // 2 - 256), size // 2 + 256) for size in bands.shape)
    correlation = noise_correlation(bands[middle])
    level, noise = float(np.median(levels)), correlation * float(np.median(noises))
    level_range = float(np.percentile(np.abs(np.subtract(levels, level)) / noises, 95))
    return SkySample(level, noise, highest, correlation, checker, level_range)


# Stamps: the sky in their border, and around them.


@cache
def border_pixels(side: int) -> np.ndarray:
    """Return the flat indices of the ring at the edge of a stamp, an eighth of its side wide."""
    width = max(1, side // 8)
    border = np.ones((side, side), dtype=bool)
    border[width:-width, width:-width] = False
    return np.flatnonzero(border)


def border_median(stamps: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return the median of the good pixels in the border of every stamp (n, s, s).

    Returns
    -------
    ndarray, shape (n,), float64
        Median of all good pixels if the border has no good pixel; 0 if no pixel is good.
    """
    size = (len(stamps), stamps.shape[-1] ** 2)
    flat, is_bad = stamps.reshape(size), bad.reshape(size)
    ring = border_pixels(stamps.shape[-1])
    # All stamps at once, then those with bad pixels one by one.
    median = np.median(flat[:, ring], axis=1).astype(np.float64)
    for star in np.flatnonzero(is_bad.any(axis=1)):
        good_pixels = flat[star, ring][~is_bad[star, ring]]
        good_pixels = good_pixels if good_pixels.size else flat[star][~is_bad[star]]
        median[star] = np.median(good_pixels) if good_pixels.size else 0.0
    return median


def border_scatter(stamps: np.ndarray, bad: np.ndarray | None = None) -> np.ndarray:
    """Return σ of the pixels in the border of every stamp from their median deviation.

    Light of the star in the border increases it; repaired pixels, which have the median, reduce it.

    Parameters
    ----------
    stamps : ndarray, shape (n, s, s)
        Stamps, with or without sky.
    bad : ndarray of bool, shape (n, s, s), optional
        Pixels that are left out, unless the whole border is bad.

    Returns
    -------
    ndarray, shape (n,)
        σ of each stamp.
    """
    from astropy.stats import mad_std

    size = (len(stamps), stamps.shape[-1] ** 2)
    border = border_pixels(stamps.shape[-1])
    ring = stamps.reshape(size)[:, border]
    if bad is None:
        return np.asarray(mad_std(ring, axis=1), np.float64)
    # Bad pixels of the ring are left out, unless the whole ring is bad.
    is_bad = bad.reshape(size)[:, border]
    is_bad &= ~is_bad.all(axis=1, keepdims=True)
    ring = np.where(is_bad, np.nan, ring)
    return np.asarray(mad_std(ring, axis=1, ignore_nan=True), np.float64)


def sky_around(window: np.ndarray, bad: np.ndarray, stamp_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Return median and scatter of the pixels outside the stamps, other stars clipped.

    Without a margin (s < d + 4) the pixels are the outer two rows and columns of the stamp itself,
    in which light of the star is taken for sky.

    Parameters
    ----------
    window : ndarray, shape (n, s, s)
        Stamps with their margins.
    bad : ndarray of bool, shape (n, s, s)
        Pixels that are ignored.
    stamp_px : int
        Side d of the stamps.

    Returns
    -------
    level, noise : ndarray, shape (n,)
        Median and σ of a pixel, in the unit of the stamps; 0 where all pixels are bad.
    """
    from astropy.stats import SigmaClip
    from astropy.utils.exceptions import AstropyUserWarning

    # The ring around the stamp.
    side = window.shape[-1]
    hole_px = stamp_px if side >= stamp_px + 4 else side - 4
    start = side // 2 - hole_px // 2
    ring = np.ones((side, side), dtype=bool)
    ring[start : start + hole_px, start : start + hole_px] = False
    # Dither whole counts, so that medians are not rounded.
    step = count_step(np.where(bad, np.nan, window).reshape(-1, side))
    # In double precision, which the window has only in another unit than the image's own: rounding
    # must not depend on the unit.
    window, dither_variance = dither(window.astype(np.float64), step)
    # Pixels of the ring more than 3 σ off their median belong to other stars.
    values = np.where(bad[:, ring], np.nan, window[:, ring])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyUserWarning)  # bad pixels are no numbers
        warnings.simplefilter("ignore", RuntimeWarning)  # stars off the image have no pixels
        values = SigmaClip(3.0, stdfunc="mad_std")(values, axis=1, masked=False)
        level, noise = row_medians(values), np.nanstd(values, axis=1, dtype=np.float64)
    level, noise = np.nan_to_num(level).astype(np.float64), np.nan_to_num(noise)
    return level, np.where(noise > 0, remove_dither(noise, dither_variance), 0.0)
