"""Stars of an image as training data: bright ones are what the faint ones look like.

A bright star is its own template. Moved by fractions of a pixel it is seen at every
phase of the pixel grid, moved by whole pixels it learns of centring errors, and new
noise makes it a faint star as often as one likes. Every star is a field point of its
own, so the split `held_out` keeps whole stars from the training, all their images
included; those stars are used as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from psfdae.stars.calibration_stars import brightest_pixels
from psfdae.stars.fields import draw_jitter, draw_phase

SHIFT_ORDER = 3
"""Cubic splines: on a star with a FWHM of 3 px they err by an MSE of 1e-8."""

IMAGES_AT_A_TIME = 512
"""Images made before they are framed; bounds the memory."""


@dataclass(frozen=True)
class BrightStars:
    """Stars that are good enough to learn from.

    Attributes
    ----------
    wide : ndarray, shape (n, s, s)
        Sky-subtracted stamps with a margin, counts.
    peak : ndarray of int, shape (n, 2)
        Brightest pixel (row, column) from index (s//2, s//2).
    centre : ndarray, shape (n, 2)
        Centroid (row, column) from index (s//2, s//2).
    position : ndarray, shape (n, 2)
        (x, y) in the image, NaN where unknown.
    flux, noise, snr : ndarray, shape (n,)
        Counts inside the stamp, RMS of the sky per pixel in counts, signal to noise.
    row : ndarray of int, shape (n,)
        Row of the catalogue.
    """

    wide: np.ndarray
    peak: np.ndarray
    centre: np.ndarray
    position: np.ndarray
    flux: np.ndarray
    noise: np.ndarray
    snr: np.ndarray
    row: np.ndarray

    def __len__(self) -> int:
        return len(self.wide)

    def of(self, chosen: np.ndarray) -> BrightStars:
        """Some of the stars, by a mask or by indices."""
        return BrightStars(*(getattr(self, field.name)[chosen] for field in fields(self)))


@dataclass(frozen=True)
class StarImages:
    """Noise-free images for the product "stars", one row each.

    Attributes
    ----------
    realisation, template : ndarray, shape (n, d, d), float32
        The star; the stack of its part of the field at the same sub-pixel phase. Sum 1.
    star : ndarray of int, shape (n,)
        Which star it is.
    jitter : ndarray of int, shape (n, 2)
        Centring error (row, column) in pixels.
    """

    realisation: np.ndarray
    template: np.ndarray
    star: np.ndarray
    jitter: np.ndarray


def star_grid(position: np.ndarray) -> np.ndarray:
    """Stars on a square lattice that keeps their order in the image.

    Columns of equally many stars follow each other in x, the stars of a column in y.
    The pattern of `psfdae.stars.splits.held_out_fields` then takes every fifth star,
    evenly over the field.

    Parameters
    ----------
    position : ndarray, shape (n, 2)
        (x, y); the order of the stars counts where a position is not finite.

    Returns
    -------
    ndarray of int, shape (n, 2)
        (ix, iy) of every star.
    """
    count = len(position)
    rows = max(1, round(np.sqrt(count)))
    known = np.isfinite(position).all()
    by_x = np.argsort(position[:, 0], kind="stable") if known else np.arange(count)
    grid = np.empty((count, 2), dtype=np.int64)
    for column, start in enumerate(range(0, count, rows)):
        members = by_x[start : start + rows]
        if known:
            members = members[np.argsort(position[members, 1], kind="stable")]
        grid[members] = np.stack([np.full(members.size, column), np.arange(members.size)], axis=1)
    return grid


def star_of_images(held_out: np.ndarray, train: int, test: int) -> np.ndarray:
    """Star of every image: each star of a part as often as the others, or once more.

    Parameters
    ----------
    held_out : ndarray of bool, shape (n_stars,)
    train, test : int
        Images wanted of the stars for training and of those held out; at least one
        of each star.

    Returns
    -------
    ndarray of int, shape (n,)
        Training stars first.
    """
    parts = ((np.flatnonzero(~held_out), train), (np.flatnonzero(held_out), test))
    return np.concatenate([np.resize(stars, max(wanted, stars.size)) for stars, wanted in parts])


def bins_of(position: np.ndarray, bins: int) -> np.ndarray:
    """Square part of the field that every star is in, ix + bins·iy, shape (n,).

    Parameters
    ----------
    position : ndarray, shape (n, 2)
        (x, y); where one is not finite, all stars are in the first part.
    bins : int
        Parts along a side.
    """
    if not np.isfinite(position).all():
        return np.zeros(len(position), dtype=np.int64)
    low, high = position.min(axis=0), position.max(axis=0)
    share = (position - low) / np.where(high > low, high - low, 1.0)
    place = np.minimum((share * bins).astype(np.int64), bins - 1)
    return place[:, 0] + bins * place[:, 1]


def moved(wide: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Stamps (n, s, s) moved by (row, column) pixels, splines of `SHIFT_ORDER`."""
    from scipy import ndimage

    out = np.empty(wide.shape)
    for image, step, target in zip(wide, shift, out, strict=True):
        ndimage.shift(image, step, target, order=SHIFT_ORDER, mode="nearest")
    return out


def cut(wide: np.ndarray, offset: np.ndarray, stamp_px: int) -> np.ndarray:
    """Stamps (n, d, d) whose index (d/2, d/2) is `offset` (row, column) from (s//2, s//2).

    What would lie beyond the wide stamp repeats its edge.
    """
    side = wide.shape[-1]
    pixels = side // 2 - stamp_px // 2 + np.arange(stamp_px)
    rows, columns = (np.clip(offset[:, i, None] + pixels, 0, side - 1) for i in (0, 1))
    return wide[np.arange(len(wide))[:, None, None], rows[:, :, None], columns[:, None, :]]


def aligned_stars(stars: BrightStars) -> np.ndarray:
    """Stars of flux 1, moved to a common centre, index (s//2, s//2); shape (n, s, s)."""
    return moved(stars.wide, -stars.centre) / stars.flux[:, None, None]


def stacks(aligned: np.ndarray, snr: np.ndarray, part: np.ndarray, parts: int) -> np.ndarray:
    """Mean star of every part of the field, weighted by signal to noise, (parts, s, s).

    The weight is S/N and not its square, so that one very bright star is not all of
    its part. A part without stars gets the stack of all.

    Parameters
    ----------
    aligned : ndarray, shape (n, s, s)
    snr : ndarray, shape (n,)
    part : ndarray of int, shape (n,)
    parts : int
    """
    everyone = np.average(aligned, axis=0, weights=snr)
    out = np.broadcast_to(everyone, (parts, *everyone.shape)).copy()
    for index in np.unique(part):
        mine = part == index
        out[index] = np.average(aligned[mine], axis=0, weights=snr[mine])
    return out


def templates_of(stars: BrightStars, held_out: np.ndarray, bins: int) -> np.ndarray:
    """Template of every star: the stack of the training stars of its part of the field.

    Returns
    -------
    ndarray, shape (n, s, s)
        Centre at index (s//2, s//2), flux 1 inside the stamp.
    """
    part = bins_of(stars.position, bins)
    training = stars.of(~held_out)
    stacked = stacks(aligned_stars(training), training.snr, part[~held_out], bins**2)
    return stacked[part]


def make_images(
    stars: BrightStars,
    template: np.ndarray,
    star: np.ndarray,
    stamp_px: int,
    jitter_px: int,
    subpixel: np.ndarray,
    rng: np.random.Generator,
) -> StarImages:
    """Frame stars as the network will see them, at new sub-pixel phases where asked for.

    Every star has its brightest pixel at (d/2, d/2), moved by a random jitter, and
    the sum 1. A template lies at its star's phase, in the same pixels.

    Parameters
    ----------
    stars : BrightStars
    template : ndarray, shape (n_stars, s, s)
        Centre at index (s//2, s//2).
    star : ndarray of int, shape (n,)
        Star of every image.
    stamp_px, jitter_px : int
    subpixel : ndarray of bool, shape (n,)
        Images of stars that are moved by up to ± ½ pixel; the others are not interpolated.
    rng : Generator
    """
    phase = np.where(subpixel[:, None], draw_phase(star.size, rng), 0.0)
    jitter = draw_jitter(star.size, jitter_px, rng)
    out = StarImages(
        np.empty((star.size, stamp_px, stamp_px), np.float32),
        np.empty((star.size, stamp_px, stamp_px), np.float32),
        star,
        jitter,
    )
    reach = int(np.abs(stars.peak).max()) + 1
    for start in range(0, star.size, IMAGES_AT_A_TIME):
        rows = slice(start, start + IMAGES_AT_A_TIME)
        who, wide = star[rows], stars.wide[star[rows]]
        wide[subpixel[rows]] = moved(wide[subpixel[rows]], phase[rows][subpixel[rows]])
        offset = brightest_pixels(wide, reach)[0] - jitter[rows]
        placed = moved(template[who], stars.centre[who] + phase[rows])
        for source, target in ((wide, out.realisation), (placed, out.template)):
            stamp = cut(source, offset, stamp_px)
            target[rows] = stamp / stamp.sum(axis=(1, 2), keepdims=True)
    return out
