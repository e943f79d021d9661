"""Stars of an image as training data: bright stars are examples of the faint ones.

Inputs: bright stars (`selection`), and which of them are held out. Outputs: images of these stars
for the training and the test of methods, and their templates.

A bright star is its own template. Moved by fractions of a pixel it is seen at every phase of the
pixel grid, moved by whole pixels it has the centring errors of faint stars, and added noise makes
any number of faint stars from it. Every star is a field point of its own, so the split `held_out`
keeps all images of a star from the training; held-out stars are not interpolated.
"""

from __future__ import annotations

import numpy as np

from psfdae.base.files import Column
from psfdae.base.settings import Parts, Stamp
from psfdae.image.stamps import cut
from psfdae.image.star_criteria import brightest_pixels
from psfdae.stars.bright_stars import BrightStars
from psfdae.stars.moments import shift_stamps
from psfdae.stars.splits import draw_jitter, draw_phase


def star_grid(position: np.ndarray) -> np.ndarray:
    """Return positions of stars on a square lattice that keeps their order in the image.

    Columns of equally many stars follow each other in x, the stars of a column in y.
    The pattern of `psfdae.stars.splits.held_out_fields` then takes every fifth star,
    evenly over the field.

    Parameters
    ----------
    position : ndarray, shape (n, 2)
        (x, y) in the image; if one is not finite, the order of the stars is used.

    Returns
    -------
    ndarray of int, shape (n, 2)
        (ix, iy) of every star.
    """
    # Columns of √n stars, in the order of x; in each, the order of y.
    count = len(position)
    rows = max(1, round(np.sqrt(count)))
    is_located = np.isfinite(position).all()
    by_x = np.argsort(position[:, 0], kind="stable") if is_located else np.arange(count)
    grid = np.empty((count, 2), dtype=np.int64)
    for column, start in enumerate(range(0, count, rows)):
        members = by_x[start : start + rows]
        if is_located:
            members = members[np.argsort(position[members, 1], kind="stable")]
        # Column of the lattice, and position in it.
        grid[members] = np.stack([np.full(members.size, column), np.arange(members.size)], axis=1)
    return grid


def assign_stars(held_out: np.ndarray, train: int, test: int) -> np.ndarray:
    """Return the star of every image, shape (images,): training stars, then held-out stars.

    `train` and `test` are the numbers of images of the two parts, but every star has at least one
    image; the numbers of images of the stars of a part differ by one at most.
    """
    # Stars of each part in turn, until there are enough images.
    parts = ((np.flatnonzero(~held_out), train), (np.flatnonzero(held_out), test))
    return np.concatenate([np.resize(stars, max(count, stars.size)) for stars, count in parts])


def compute_bins(position: np.ndarray, bins: int) -> np.ndarray:
    """Return the part of the field of each star, ix + bins·iy of bins × bins parts, (n,).

    If a position (n, 2) is not finite, all stars are in the first part.
    """
    if not np.isfinite(position).all():
        return np.zeros(len(position), dtype=np.int64)
    # Position relative to the range of all positions, 0 … 1, along both axes.
    low, high = position.min(axis=0), position.max(axis=0)
    fraction = (position - low) / np.where(high > low, high - low, 1.0)
    bin_index = np.minimum((fraction * bins).astype(np.int64), bins - 1)
    return np.asarray(bin_index[:, 0] + bins * bin_index[:, 1])


def stack_parts(images: np.ndarray, snr: np.ndarray, part: np.ndarray, parts: int) -> np.ndarray:
    """Return the mean star of every part of the field, weighted by S/N, shape (parts, s, s).

    The weight is S/N and not its square, so that one very bright star does not dominate its part. A
    part without stars gets the stack of all.

    Parameters
    ----------
    images : ndarray, shape (n, s, s)
        Stars of flux 1, moved to a common centre.
    snr : ndarray, shape (n,)
        S/N of the stars, their weight.
    part : ndarray of int, shape (n,)
        Part of the field of each star, from 0.
    parts : int
        Number of parts of the field.
    """
    # The stack of all stars, replaced where a part has stars of its own.
    mean_star = np.average(images, axis=0, weights=snr)
    stack = np.broadcast_to(mean_star, (parts, *mean_star.shape)).copy()
    for index in np.unique(part):
        members = part == index
        stack[index] = np.average(images[members], axis=0, weights=snr[members])
    return stack


def compute_templates(stars: BrightStars, held_out: np.ndarray, bins: int) -> np.ndarray:
    """Return the template of every star: the stack of training stars of its part of the field.

    Returns
    -------
    ndarray, shape (n, s, s)
        Centre at index (s//2, s//2), flux 1 inside the stamp.
    """
    # Held-out stars get the stack of the training stars in their part.
    part = compute_bins(stars.position, bins)
    training = stars.select(~held_out)
    return np.asarray(stack_parts(training.align(), training.snr, part[~held_out], bins**2)[part])


def stack_all(stars: BrightStars, held_out: np.ndarray) -> np.ndarray:
    """Return the stack of all training stars, (s, s), centre at index (s//2, s//2)."""
    # The field as a whole is the only part: all templates are the same.
    return np.asarray(compute_templates(stars, held_out, bins=1)[0])


def make_images(
    stars: BrightStars,
    template: np.ndarray,
    star: np.ndarray,
    framing: Stamp,
    subpixel: np.ndarray,
    rng: np.random.Generator,
    centring_px: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Frame stars as the input of the network, some of them at new sub-pixel phases.

    Every star has its brightest pixel at (d/2, d/2), moved by a random jitter, and
    the sum 1. A template has its star's phase, in the same pixels. No pixel of a moved star is
    below −`BrightStars.defect_sigma` σ of its sky, before the sum is made 1.

    Parameters
    ----------
    stars : BrightStars
        Stars with wide stamps.
    template : ndarray, shape (n_stars, s, s)
        Template of every star, centre at index (s//2, s//2).
    star : ndarray of int, shape (n,)
        Star of every image.
    framing : Stamp
        Settings, of which `stamp_px` and `jitter_px` are used.
    subpixel : ndarray of bool, shape (n,)
        Images of stars that are moved by up to ± ½ pixel; the others are not interpolated.
    rng : Generator
        Generator of phases and jitter.
    centring_px : float
        FWHM of the Gaussian that smooths stars before their brightest pixel is searched.

    Returns
    -------
    realisation, template : ndarray, shape (n, d, d), float32
        Images of the stars, and their templates, of sum 1.
    jitter : ndarray of int, shape (n, 2)
        Centring error (row, column) in pixels.
    phase : ndarray, shape (n, 2)
        Fraction of a pixel (row, column) by which the star was moved.
    """
    # All draws come first, so that images do not depend on the size of the chunks.
    side = framing.stamp_px
    phase = np.where(subpixel[:, None], draw_phase(star.size, rng), 0.0)
    jitter = draw_jitter(star.size, framing.jitter_px, rng)
    realisations, templates = np.empty((2, star.size, side, side), np.float32)
    # The brightest pixel of a moved star may be one px farther off.
    reach = int(np.abs(stars.peak).max()) + 1
    # 512 images at a time, which bounds the memory.
    for rows in (slice(start, start + 512) for start in range(0, star.size, 512)):
        star_rows, stamps = star[rows], stars.stamps[star[rows]]
        # Move the star by its phase. Splines ring next to the remains of a saturated
        # neighbour.
        is_moved = subpixel[rows]
        floor = -BrightStars.defect_sigma * stars.noise[star_rows[is_moved], None, None]
        stamps[is_moved] = np.maximum(
            shift_stamps(stars.stamps, phase[rows][is_moved], star_rows[is_moved]), floor
        )
        # The brightest pixel goes to the middle, off by the jitter; the template likewise.
        offset = brightest_pixels(stamps, reach, centring_px)[0] - jitter[rows]
        shifted_templates = shift_stamps(template, stars.centre[star_rows] + phase[rows], star_rows)
        for source, target in ((stamps, realisations), (shifted_templates, templates)):
            stamp = cut(source, side, offset)
            target[rows] = stamp / stamp.sum(axis=(1, 2), keepdims=True)
    return realisations, templates, jitter, phase


def training_columns(
    bright: BrightStars,
    grid: np.ndarray,
    held_out: np.ndarray,
    bins: int,
    framing: Stamp,
    parts: Parts,
    rng: np.random.Generator,
    centring_px: float = 0.0,
) -> dict[str, Column]:
    """Return columns of the product "stars": images of bright stars, and measurements of these.

    `grid` (n, 2) is their position on the lattice of `star_grid`; stars of each of `bins`² parts of
    the field are stacked, and stars are framed by `make_images`.
    """
    # Images of every star; those held out are not interpolated.
    star = assign_stars(held_out, parts.train_stars, parts.test_stars)
    template = compute_templates(bright, held_out, bins)
    subpixel = ~held_out[star] & framing.subpixel
    images, templates, jitter, phase = make_images(
        bright, template, star, framing, subpixel, rng, centring_px
    )
    # The bright stars themselves, of flux 1.
    bright_stamps = (bright.stamps / bright.flux[:, None, None]).astype(np.float32)
    return {
        "template": Column(templates, "1", "stack of the star's part of the field, sum 1"),
        "realisation": Column(images, "1", "the star itself, sum 1"),
        "field_index": Column(star, "1", "star that the image shows"),
        "grid": Column(grid, "1", "place (ix, iy) of every star in the order of x and y"),
        "jitter": Column(jitter, "pixel", "centring error (row, column)"),
        "phase": Column(phase, "pixel", "(row, column) that splines moved the star"),
        "position": Column(bright.position, "pixel", "(x, y) of every star, 0-based"),
        "flux": Column(bright.flux, "count", "of every star inside its stamp"),
        "colour": Column(bright.colour, "mag", "of every star by the catalogue, NaN if unknown"),
        "snr": Column(bright.snr, "1", "signal to noise of every star"),
        "noise": Column(bright.noise / bright.flux, "1", "pixel RMS over flux of every star"),
        "row": Column(bright.row, "1", "row of every star in the catalogue"),
        "wide": Column(bright_stamps, "1", "the bright stars with a margin, of flux 1"),
        "peak": Column(bright.peak, "pixel", "brightest pixel (row, column) from the middle's"),
        "listed": Column(bright.listed, "pixel", "centre by the catalogue, likewise"),
        "bad": Column(bright.bad, "1", "pixels of `wide` that were not measured"),
    }
