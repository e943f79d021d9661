"""Stamps of stars: the container, flags of stars, and how stamps are cut and centred.

A stamp is a square of pixels about a star, sky included. Stamps are cut at positions in an image,
and the displacement of each is measured. `psfdae.image.sky` measures their sky.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from typing import Self

import numpy as np

from psfdae.base.rows import Rows
from psfdae.image.fits_file import ImageFile
from psfdae.image.sky import border_scatter
from psfdae.stars.moments import FWHM_OF_SIGMA


@dataclass(frozen=True)
class Stamps(Rows):
    """Stamps of n stars, s = stamp_px + 2·margin pixels wide, and columns of the stars.

    Attributes
    ----------
    data : ndarray, shape (n, s, s)
        Counts, sky included; 0 where not finite or off the image.
    bad, saturated : ndarray of bool, shape (n, s, s)
        Masked, missing and non-finite pixels; pixels at the saturation level.
    flags : ndarray of uint16, shape (n,)
        `StarFlag`s of the list; TRUNCATED if a pixel, margin aside, is off the image.
    id : ndarray of int64 or str, shape (n,)
        Identifiers of the stars.
    x, y : ndarray, shape (n,)
        Position in the image, 0-based pixel centres.
    flux, background, noise : ndarray, shape (n,)
        Flux inside the stamp, sky level, and RMS of the sky in a pixel; NaN where they are to be
        estimated.
    sky_level : ndarray, shape (n,)
        Median of the margin around the stamp (`psfdae.image.sky.sky_around`); NaN where it was not
        measured.
    noise_correlation : ndarray, shape (n,)
        Ratio of the noise of sums of pixels of the sky to the noise of sums of independent pixels,
        at least 1.
    gain : ndarray, shape (n,)
        Electrons per unit of the stamps.
    magnitude : ndarray, shape (n,)
        Magnitude at which the PSF is evaluated; NaN for the magnitude of the estimated flux.
    colour : ndarray, shape (n,)
        Colour from the list, such as g − r.
    listed : ndarray, shape (n, 2)
        Centre (row, column) from index s//2, from the list.

    All are NaN where unknown.
    """

    data: np.ndarray
    bad: np.ndarray
    saturated: np.ndarray
    flags: np.ndarray
    id: np.ndarray
    x: np.ndarray
    y: np.ndarray
    flux: np.ndarray
    background: np.ndarray
    noise: np.ndarray
    sky_level: np.ndarray
    noise_correlation: np.ndarray
    gain: np.ndarray
    magnitude: np.ndarray
    colour: np.ndarray
    listed: np.ndarray

    def __len__(self) -> int:
        return len(self.data)


class StarFlag(IntFlag):
    """Reasons to distrust a star; flags are summed. Rows are flagged, never dropped.

    Examples
    --------
    >>> psfdae.StarFlag(48)
    <StarFlag.SATURATED|TRUNCATED: 48>
    >>> 48 & psfdae.StarFlag.SATURATED > 0
    True
    """

    meaning: str

    def __new__(cls, value: int, meaning: str = "") -> Self:
        """Make a flag with a line on its meaning."""
        flag = int.__new__(cls, value)
        flag._value_ = value
        flag.meaning = meaning
        return flag

    MASKED = 1, "pixels that are masked, not finite or off the image; replaced"
    OUTLIER = 2, "pixels that no star of the training set can have; replaced"
    FAINT = 4, "flux below three times its error; below five for stars that photometry detects"
    NO_FLUX = 8, "no usable flux: PSF, residual and uncertainty are NaN"
    SATURATED = 16, "saturated pixels, replaced; or the star list says so"
    TRUNCATED = 32, "part of the stamp is off the image; or the star list says so"
    SNR_LOW = 64, "S/N less than 1/1.25 of the least that the training had"
    SNR_HIGH = 128, "S/N over 1.25 times the largest of the training; not of field models"
    OFF_CENTRE = (
        256,
        "brightest pixel farther from the centre than the stamp could be moved; in "
        "photometry, the fit moved the star by half a FWHM and three errors of its position",
    )
    UNLIKE_TRAINING = (
        512,
        "farther from the training set than 99.9 % of its test stars; in photometry, of an "
        "image with far larger chi2 than the training's",
    )
    BLENDED = (
        1024,
        "the star list says that it was parted from a neighbour; in photometry, a star is "
        "nearer than one FWHM",
    )
    SKY_OFF = 2048, "the sky that was given is over 5 sigma off the border of the stamp"
    POOR_FIT = 4096, "chi2 above 10: the residual is far above the noise; or a fit did not end"
    BEYOND = (
        8192,
        "brighter, fainter or of another colour than all stars of the training, where the "
        "PSF changes with that",
    )
    SHARP = 16384, "a cosmic ray or hot pixel within 1 px of its position: perhaps no star"


def raise_flag(flags: np.ndarray, flag: StarFlag, stars: np.ndarray | np.bool) -> None:
    """Add a flag to some stars of `flags`, shape (n,), uint16."""
    flags[stars] |= np.uint16(flag)


def find_unlike_stars(flags: np.ndarray) -> np.ndarray:
    """Return True for stars that are unlike the training, and not for the light of a neighbour.

    A brighter pixel off the middle (`OFF_CENTRE`) shows a neighbour, or a position without a star.
    Stars of a turned image or of another PSF are centred.

    Parameters
    ----------
    flags : ndarray of int, shape (n,)
        Sums of `StarFlag`.
    """
    is_unlike = (flags & int(StarFlag.UNLIKE_TRAINING)) > 0
    return np.asarray(is_unlike & ((flags & int(StarFlag.OFF_CENTRE)) == 0))


# Cutting stamps out of an image.

LARGEST_POSITION_PX = 2**30
"""Positions are clipped to ± this many pixels, far off any image."""


def central_pixel(position: np.ndarray) -> np.ndarray:
    """Return the pixel in which a 0-based position lies, int64; one far off the image for NaN.

    Pixel k covers k − ½ ≤ position < k + ½.
    """
    limit = LARGEST_POSITION_PX
    pixel = np.floor(np.nan_to_num(position, nan=-limit, posinf=limit, neginf=-limit) + 0.5)
    return np.asarray(np.clip(pixel, -limit, limit), np.int64)


def cut_image(
    pixels: ImageFile | np.ndarray,
    shape: tuple[int, ...],
    x: np.ndarray,
    y: np.ndarray,
    stamp_px: int,
    margin: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a stamp around each star, with the star's pixel at index d//2 + margin.

    Parameters
    ----------
    pixels : ImageFile or ndarray, shape (h, w)
        The image, indexed once with arrays of rows and columns.
    shape : tuple of int
        Rows and columns of the image.
    x, y : ndarray, shape (n,)
        0-based positions; NaN is off the image.
    stamp_px, margin : int
        Side d of the stamps, and pixels added on every side.

    Returns
    -------
    stamps : ndarray, shape (n, d + 2·margin, d + 2·margin)
        Pixels of the image, 0 off the image.
    inside : ndarray of bool, shape (n, d + 2·margin, d + 2·margin)
        True for pixels on the image.
    truncated : ndarray of bool, shape (n,)
        True if a pixel of the stamp, margin aside, is off the image.
    """
    # Rows and columns of every stamp in the image.
    side = np.arange(stamp_px + 2 * margin) - stamp_px // 2 - margin
    rows = central_pixel(y)[:, None] + side
    columns = central_pixel(x)[:, None] + side
    row_inside: np.ndarray = (rows >= 0) & (rows < shape[0])
    column_inside: np.ndarray = (columns >= 0) & (columns < shape[1])
    # Pixels off the image are read at its edge first, then set to 0.
    stamps: np.ndarray = pixels[
        np.clip(rows, 0, shape[0] - 1)[:, :, None], np.clip(columns, 0, shape[1] - 1)[:, None, :]
    ]
    inside = row_inside[:, :, None] & column_inside[:, None, :]
    if not inside.all():
        stamps = np.where(inside, stamps, 0)
    stamp = slice(margin, margin + stamp_px)
    # A star is whole if all rows and columns of its stamp, margin aside, are on the image.
    is_whole = row_inside[:, stamp].all(axis=1) & column_inside[:, stamp].all(axis=1)
    return stamps, inside, np.asarray(~is_whole)


# Centring, to the convention of the training: brightest pixel near (d/2, d/2).


def smooth_stamps(stamps: np.ndarray) -> np.ndarray:
    """Convolve stamps (n, s, s) with [1, 2, 1]/4 along both axes; edge pixels are repeated."""
    # [1, 2, 1] along columns, then along rows; 16 is the sum of the weights.
    padded_stamps = np.pad(stamps, ((0, 0), (1, 1), (1, 1)), mode="edge")
    rows = padded_stamps[:, :-2] + 2 * padded_stamps[:, 1:-1] + padded_stamps[:, 2:]
    return np.asarray((rows[:, :, :-2] + 2 * rows[:, :, 1:-1] + rows[:, :, 2:]) / 16)


def blur_stamps(stamps: np.ndarray, fwhm_px: float) -> np.ndarray:
    """Convolve stamps (n, s, s) with a Gaussian; edges are repeated, a FWHM of 0 changes nothing.

    The brightest pixel of a ring, or of a star much wider than a pixel, is then in its middle.
    """
    from scipy import ndimage

    if not fwhm_px:
        return stamps
    sigma = fwhm_px / FWHM_OF_SIGMA
    return np.asarray(ndimage.gaussian_filter(stamps, (0.0, sigma, sigma), mode="nearest"))


def displacement(
    stamps: np.ndarray, jitter_px: int, centring_px: float = 0.0, bad: np.ndarray | None = None
) -> np.ndarray:
    """Return the displacement of each star from the range of centring errors of the training.

    The training moves stars by up to `jitter_px` whole pixels, so only a star outside this range is
    moved. Neither noise nor the second peak of an aberrated star must move it: the brightest pixel
    is used only if the smoothed stamp has its maximum there as well, well above all of the middle.

    Parameters
    ----------
    stamps : ndarray, shape (n, s, s)
        Stamps of even side, bad pixels at the sky level. The sky need not be subtracted.
    jitter_px : int
        Maximum centring error of the training, in pixels along each axis.
    centring_px : float
        FWHM of the Gaussian with which the training smooths stars to find their brightest pixels.
    bad : ndarray of bool, shape (n, s, s), optional
        Pixels that were filled, which show no noise.

    Returns
    -------
    ndarray of int, shape (n, 2)
        (row, column) of the brightest pixel from (s/2, s/2); 0 for stars within
        `jitter_px`, or without a significant peak.
    """
    # Pixels in the middle that the jitter of the training reaches.
    middle = stamps.shape[-1] // 2
    centre = slice(middle - jitter_px, middle + jitter_px + 1)
    # Brightest pixels of the stamps, and of the stamps smoothed once more.
    soft = blur_stamps(stamps, centring_px)
    smooth = smooth_stamps(soft)
    brightest, brightest_smooth = (peaks(images) - middle for images in (soft, smooth))
    # Stars whose peaks are both outside the middle, and agree to a pixel.
    agrees = np.abs(brightest - brightest_smooth).max(axis=1) <= 1
    star = np.flatnonzero((np.abs(brightest).max(axis=1) > jitter_px) & agrees)
    offset = np.zeros((len(stamps), 2), dtype=np.int16)
    if not star.size:
        return offset
    # The peak must exceed the middle by 5 σ of the difference of two smoothed pixels, which is
    # √2 · 6/16 = 0.53 of the σ of a pixel.
    excess = smooth[star].max(axis=(1, 2)) - smooth[star, centre, centre].max(axis=(1, 2))
    noise = border_scatter(stamps[star], None if bad is None else bad[star])
    significant = excess > 5.0 * 0.53 * noise
    offset[star[significant]] = brightest[star[significant]]
    return offset


def peaks(images: np.ndarray) -> np.ndarray:
    """Return (row, column) of the brightest pixel of every image, the first of equal ones."""
    flat = images.reshape(len(images), -1).argmax(axis=1)
    return np.stack(np.divmod(flat, images.shape[-1]), axis=1)


def cut(window: np.ndarray, stamp_px: int, offset: np.ndarray | None = None) -> np.ndarray:
    """Cut stamps (n, d, d) out of larger ones (n, s, s), index d//2 from s//2 + offset.

    Parameters
    ----------
    window : ndarray, shape (n, s, s)
        Larger stamps, s ≥ d.
    stamp_px : int
        Side d of the stamps.
    offset : ndarray of int, shape (n, 2), optional
        (row, column), 0 by default. Pixels outside the window repeat its edge.

    Returns
    -------
    ndarray, shape (n, d, d)
        The stamps.
    """
    side = window.shape[-1]
    # Stamps without an offset are the middle of the window.
    pixels = side // 2 - stamp_px // 2 + np.arange(stamp_px)
    middle = window[:, pixels[0] : pixels[-1] + 1, pixels[0] : pixels[-1] + 1]
    if offset is None or not offset.any():
        return np.ascontiguousarray(middle)
    # Only stars with an offset are cut one by one.
    star = np.flatnonzero(offset.any(axis=1))
    stamps = middle.copy()
    rows, columns = (np.clip(offset[star, i, None] + pixels, 0, side - 1) for i in (0, 1))
    stamps[star] = window[star[:, None, None], rows[:, :, None], columns[:, None, :]]
    return stamps
