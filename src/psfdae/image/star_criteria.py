"""Criteria for stars that are good enough to train a PSF model on.

Inputs: measurements (n,) and stamps (n, s, s) of n stars; each star is near index (s//2, s//2).
Output: one value for each star. `selection` applies the criteria.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import repeat

import numpy as np
import scipy

from psfdae.image.stamps import blur_stamps, cut, peaks
from psfdae.stars.moments import robust_scatter

# Brightness.


def stamp_snr(stamps: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the S/N of a filter matched to the star itself, √(Σx²/σ² − P), shape (n,).

    For an image x = F p of P pixels the expectation of Σx² is F²Σp² + Pσ², so the result is
    F/(σ √A) with the noise-equivalent area A = 1/Σp² (King 1983, PASP 95, 163). The PSF need not
    be known. The S/N is 0 where the noise is 0.

    Parameters
    ----------
    stamps : ndarray, shape (n, d, d)
        Sky-subtracted stamps.
    noise : ndarray, shape (n,)
        RMS noise σ of a pixel.
    """
    # Noise alone has Σx²/σ² = P; a smaller sum has an S/N of 0.
    power = np.square(stamps, dtype=np.float64).sum(axis=(1, 2))
    safe = np.where(noise > 0, noise, np.inf)
    return np.asarray(np.sqrt(np.maximum(power / safe**2 - stamps[0].size, 0.0)))


def brightest_pixels(
    stamps: np.ndarray, search_px: int, centring_px: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Find the brightest pixel near the middle of every stamp.

    Parameters
    ----------
    stamps : ndarray, shape (n, s, s)
        Sky-subtracted stamps.
    search_px : int
        Half width of the search window about the middle.
    centring_px : float
        FWHM in px of the Gaussian that smooths the stamps first; 0: none.

    Returns
    -------
    peak : ndarray of int, shape (n, 2)
        (row, column) of the brightest pixel from index (s//2, s//2).
    inside : ndarray of bool, shape (n,)
        True if no pixel just outside the search window is brighter.
    """
    # One more pixel on each side shows stars whose brightest pixel is outside the window.
    middle, reach = stamps.shape[-1] // 2, search_px + 1
    window = slice(middle - reach, middle + reach + 1)
    peak = peaks(blur_stamps(stamps, centring_px)[:, window, window]) - reach
    return peak, np.abs(peak).max(axis=1, initial=0) <= search_px


def find_pile_up(brightest: np.ndarray, sky: np.ndarray, brightness: np.ndarray) -> float:
    """Return the counts at which brightest pixels of stars pile up; infinite if none do.

    Stars of the same brightness have the same brightest pixels, too. In stars that are cut off, the
    brightest pixel has a smaller fraction of the light than in others.

    Parameters
    ----------
    brightest : ndarray, shape (n,)
        Brightest pixel of every star in counts, sky included.
    sky, brightness : ndarray, shape (n,)
        Sky in counts, and light of the star in any unit.
    """
    height = brightest - sky
    top = height.max(initial=0.0)
    # Three stars or more whose brightest pixels agree within 3 %, and fainter ones to compare with.
    is_piled = height >= 0.97 * top
    fainter = (height >= 0.1 * top) & ~is_piled
    if top <= 0 or is_piled.sum() < 3 or not fainter.any():
        return np.inf
    # If cut off, they have a smaller fraction of the light than in fainter stars, by a tenth.
    sharpness = height / np.where(brightness > 0, brightness, 1.0)
    if np.median(sharpness[is_piled]) > 0.9 * np.median(sharpness[fainter]):
        return np.inf
    # Six digits, rounded down, so that the printed number is the exact one.
    pile_up = float(brightest[is_piled].min())
    unit = 10.0 ** (np.floor(np.log10(pile_up)) - 5) if pile_up > 0 else 1.0
    return float(f"{np.floor(pile_up / unit * (1 + 1e-12)) * unit:.6g}")


# Neighbours.


def find_crowded(
    position: np.ndarray, brightness: np.ndarray, distance_px: float, ratio: float
) -> np.ndarray:
    """Return True for stars with a neighbour of at least `ratio` of their brightness nearby, (n,).

    Parameters
    ----------
    position : ndarray, shape (n, 2)
        Positions in pixels; a star at NaN has no neighbours.
    brightness : ndarray, shape (n,)
        Brightness of the stars in any linear unit.
    distance_px, ratio : float
        Maximum distance of a neighbour, and the minimum ratio of its brightness to the star's.
    """
    # Each pair in both orders.
    indices = np.flatnonzero(np.isfinite(position).all(axis=1))
    is_crowded = np.zeros(len(position), dtype=bool)
    tree = scipy.spatial.cKDTree(position[indices])
    pairs = indices[tree.query_pairs(distance_px, output_type="ndarray")]
    for first, second in ((pairs[:, 0], pairs[:, 1]), (pairs[:, 1], pairs[:, 0])):
        is_crowded[first[brightness[second] >= ratio * brightness[first]]] = True
    return is_crowded


def measure_overlap(position: np.ndarray, side: int) -> float:
    """Return the fraction of the stars (n, 2) whose stamps of a side contain another star."""
    # Distance of the nearest other star along the farther axis, as stamps are squares.
    finite = position[np.isfinite(position).all(axis=1)]
    if len(finite) < 2:
        return 0.0
    distance, _ = scipy.spatial.cKDTree(finite).query(finite, k=2, p=np.inf)
    return float((distance[:, 1] < 0.5 * side).mean())


# Size and shape.


def sharper_than_stars(area: np.ndarray) -> np.ndarray:
    """Return which sources (n,) have a far smaller noise-equivalent area than the median source.

    It is less than half of the median, and less by more than five times the scatter: the area of
    stars changes over the field, and with the phase on the pixel grid where stars are narrow.
    """
    if len(area) < 4:
        return np.zeros(len(area), dtype=bool)
    # Factors are differences of logarithms.
    size = np.log(area)
    limit = max(np.log(2.0), 5.0 * float(robust_scatter(size)))
    return np.asarray(size < np.median(size) - limit)


def wider_than_stars(area: np.ndarray, position: np.ndarray, size_error: np.ndarray) -> np.ndarray:
    """Return which sources have a far larger noise-equivalent area than the stars around them.

    Stars have nearly one size, other sources any size. Of the logarithms of all areas, each less
    the lower quartile of its nearest sources, the shortest interval that has a quarter of them
    gives the stars. Sources above it by a factor of 1.5, and by more than five times the scatter
    that the interval implies, are rejected; the interval is then searched again. Where the PSF
    changes over the field, so do the nearest sources.

    If the remaining sources still have many sizes, most are galaxies. The stars are then the
    narrowest group of bright sources of one size, and a source is a star only if its size is known
    well enough.

    Parameters
    ----------
    area : ndarray, shape (n,)
        Noise-equivalent areas in pixels.
    position : ndarray, shape (n, 2)
        (x, y) in the image; if one is not finite, all sources are neighbours of each other.
    size_error : ndarray, shape (n,)
        Standard error of the logarithm of the area.
    """
    # Fewer than four sources show no locus of stars, fewer than eight a rough one.
    is_wide = np.zeros(len(area), dtype=bool)
    if len(area) < 4:
        return is_wide
    size, factor = np.log(area), 1.5 if len(area) >= 8 else 3.0
    for _ in range(10):
        # The locus is searched among the sources that are not yet rejected.
        star = np.flatnonzero(~is_wide)
        if len(star) < 4:
            break
        excess = size - size_around(size[star], position[star], position)
        middle, scatter = shortest_interval(excess[star])
        is_wider = excess > middle + max(np.log(factor), 5.0 * scatter)
        if not (is_wider & ~is_wide).any():
            break
        is_wide |= is_wider
    is_star = ~is_wide
    if has_many_sizes(size[is_star], position[is_star], size_error[is_star]):
        middle, scatter = narrowest_group(size[size_error < 0.1])
        limit = middle + max(np.log(1.2), min(5.0 * scatter, np.log(1.5)))
        return np.asarray(size + 2.0 * size_error > limit)
    return is_wide


def size_around(
    star_size: np.ndarray, star_position: np.ndarray, position: np.ndarray
) -> np.ndarray:
    """Return the lower quartile of the sizes of the eight stars nearest to each position, (n,).

    Usually one of these eight sources is a star.
    """
    if len(star_size) <= 8 or not np.isfinite(position).all():
        return np.full(len(position), np.percentile(star_size, 25))
    nearest = scipy.spatial.cKDTree(star_position).query(position, k=8)[1]
    return np.asarray(np.percentile(star_size[nearest], 25, axis=1))


def shortest_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the middle of the shortest interval that has a quarter of the values, and the scatter.

    A quarter of a normal distribution about its middle has the width 0.637 σ.
    """
    ascending, count = np.sort(values), -(-len(values) // 4)
    width = ascending[count:] - ascending[:-count]
    first = int(width.argmin())
    return float(np.median(ascending[first : first + count + 1])), float(width[first]) / 0.637


def has_many_sizes(size: np.ndarray, position: np.ndarray, size_error: np.ndarray) -> bool:
    """Return True if sources differ in size more than stars do, also of a PSF that changes.

    ln A of stars scatters by 0.25 at most about the sizes of their neighbours, and ln A of bright
    stars about a plane over the image; ln A of galaxies scatters by 0.4 and more.

    Parameters
    ----------
    size, size_error : ndarray, shape (n,)
        ln A and its standard error.
    position : ndarray, shape (n, 2)
        (x, y) in the image, NaN where unknown.
    """
    # With fewer than ten sources, neighbours and a plane are not significant.
    excess, is_sharp = size - size_around(size, position, position), size_error < 0.1
    if np.count_nonzero(is_sharp) < 10 or shortest_interval(excess)[1] < 0.2:
        return False
    # The plane is a constant where no position is known.
    terms = np.nan_to_num(np.column_stack([np.ones(len(size)), position]))[is_sharp]
    excess = size[is_sharp] - terms @ np.linalg.lstsq(terms, size[is_sharp], rcond=None)[0]
    return bool(robust_scatter(excess) > 0.35)


def narrowest_group(size: np.ndarray) -> tuple[float, float]:
    """Return middle and scatter of the narrowest sources that share one size, such as stars.

    The stellar locus among galaxies in a diagram of size and magnitude, as Piff (`SizeMag`;
    Jarvis et al. 2021, MNRAS 501, 1282) and PSFEx (Bertin 2011, ASP Conf. 442, 435) find it: no
    source is narrower than the PSF.

    Parameters
    ----------
    size : ndarray, shape (n,)
        ln A of sources, with standard errors below 0.1.
    """
    # Four sources or more within 3 % in diameter, or the four that are nearest to this.
    ascending = np.sort(size)
    width = ascending[3:] - ascending[:-3]
    first = int(np.argmax(width <= max(width.min(), 0.06)))
    middle = np.median(ascending[first : first + 4])
    group = ascending[np.abs(ascending - middle) <= max(width[first], 0.1)]
    return float(np.median(group)), float(robust_scatter(group))


def misfit(aligned_stamps: np.ndarray, position: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return how unlike its neighbours each star is, relative to the median star, shape (n,).

    A star is compared with the 12 nearest stars, pixel by pixel: its difference from their median
    in units of their robust scatter, as a root mean square over the stamp, or over the worst 3 × 3
    pixels of its core, which reveal a close companion or a flat or hollow core. Where the PSF
    varies, so do the neighbours; a companion or a cosmic ray lies where they agree. The median star
    has 1, in its worst pixels 1/1.2, because the worst pixels of good stars scatter more than their
    stamps as a whole.

    Parameters
    ----------
    aligned_stamps : ndarray, shape (n, d, d)
        Stars of flux 1, moved to a common centre.
    position : ndarray, shape (n, 2)
        (x, y) in the image; if one is not finite, all stars are neighbours of each other.
    noise : ndarray, shape (n,)
        Ratio of the RMS of a pixel to the flux.
    """
    count, side = len(aligned_stamps), aligned_stamps.shape[-1]
    if count < 4:
        return np.ones(count)

    def compute_statistics(stars: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return median and robust variance of every pixel of some stars, (d, d) each."""
        scatter = robust_scatter(stars)
        # A dozen stars may agree in a pixel by chance.
        return np.median(stars, axis=0), scatter**2 + np.median(scatter) ** 2

    local_medians: Iterable[tuple[np.ndarray, np.ndarray]]
    # Neighbours of each star; all stars where there are few, or positions are not known.
    if np.isfinite(position).all() and count > 12:
        neighbours = scipy.spatial.cKDTree(position).query(position, k=13)[1]
        companion_rows = (rows[rows != star] for star, rows in enumerate(neighbours))
        local_medians = (compute_statistics(aligned_stamps[rows]) for rows in companion_rows)
    else:
        local_medians = repeat(compute_statistics(aligned_stamps), count)
    # Half of the stamp, at least 8 px: faint neighbours farther out do not matter.
    core_px = min(side, max(side // 2, 8))
    score = np.empty((count, 2))
    for star, (median, variance) in enumerate(local_medians):
        # χ² of each pixel; its mean, and the largest mean of 3 × 3 pixels.
        square = (aligned_stamps[star] - median) ** 2 / (variance + noise[star] ** 2)
        patches = scipy.ndimage.uniform_filter(square, 3)[None]
        score[star] = square.mean(), cut(patches, core_px).max()
    score = np.sqrt(score)
    return np.asarray((score / np.median(score, axis=0) / (1.0, 1.2)).max(axis=1))
