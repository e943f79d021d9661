"""Fit of the light of stars outside their stamps, and of the sky that is left without it.

All pixels of the image together give the profile p of the wings (`psfdae.psf.wings`) by weighted
least squares, with a prior: the light falls off outside of the stamp about as for other telescopes.
Bright stars outweigh the prior; few faint ones hardly change it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from psfdae.base.progress import steps
from psfdae.image.sky import Sky, subtract_sky
from psfdae.image.sky_level import add_shared_noise, measure_sky
from psfdae.image.trails import cut_window
from psfdae.psf.wings import Wings, compute_hats, compute_prior_profile
from psfdae.stars.moments import label_medians


class StarFluxes(NamedTuple):
    """Positions and fluxes of n stars, and how wide their PSFs are.

    Attributes
    ----------
    position : ndarray, shape (n, 2)
        x and y in px; NaN where unknown.
    flux : ndarray, shape (n,)
        In the unit of the image, summed over pixels. Stars whose flux is NaN or not above 0 are
        left out.
    outer_share : ndarray, shape (n,)
        Fraction of the light in the outer part of the stamp, as `outer_shares` gives it; stars of
        which it is NaN are left out.
    """

    position: np.ndarray
    flux: np.ndarray
    outer_share: np.ndarray

    def select(self, rows: np.ndarray) -> StarFluxes:
        """Return some of the stars."""
        return StarFluxes(*(values[rows] for values in self))


BINS_PER_PX = 64
"""Distances of pixels from stars are rounded to this part of a pixel: wings are smooth."""


def tabulate_hats(wings: Wings) -> np.ndarray:
    """Return h_0 … h_{K−1} in bins of the distance from a star, shape (bins, K).

    The first bin is the stamp, where h_0 is 1 and the hat functions are 0.
    """
    # The corner of a window is √2 times as far as its edge.
    last = int(np.ceil(1.5 * (wings.radius_px[-1] + 1.0) * BINS_PER_PX))
    distance = np.arange(last + 1, dtype=np.float32) / BINS_PER_PX
    heights = np.pad(compute_hats(distance, wings.radius_px), ((1, 0), (1, 0)))
    heights[0, 0] = 1.0
    return np.ascontiguousarray(heights.T)


def select_lit_stars(
    stars: StarFluxes, wings: Wings, share: float = 1.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (m, 2) and F s (m,) of the 1000 stars of the brightest wings, or fewer.

    In a crowded image, these have most of the light of all wings. The brightest ones that have
    a `share` of Σ (F s)² are enough.
    """
    # F s, the factor of all hat functions of a star.
    scaled_flux = stars.flux * wings.scale(stars.outer_share)
    # Unlike in `scale`, stars of unknown outer share are left out.
    scaled_flux = np.where(np.isfinite(stars.outer_share), scaled_flux, np.nan)
    is_lit = np.isfinite(scaled_flux) & (scaled_flux > 0) & np.isfinite(stars.position).all(axis=1)
    lit_stars = np.flatnonzero(is_lit)
    brightest = lit_stars[np.argsort(-scaled_flux[lit_stars], kind="stable")[:1000]]
    information = np.cumsum(np.square(scaled_flux[brightest]))
    brightest = brightest[: 1 + np.searchsorted(information, share * information[-1:])[:1].sum()]
    return stars.position[brightest], scaled_flux[brightest]


def star_bins(
    area: tuple[slice, slice], positions: np.ndarray, wings: Wings
) -> Iterator[tuple[int, tuple[slice, slice], np.ndarray]]:
    """Yield the number of each star near an area, its window, and bins of the pixels there.

    A window has the pixels of the area that the wings of the star reach, rows and columns from the
    first ones of the area; the bins (rows, columns) are indices of `tabulate_hats`. `positions`
    (n, 2) are x and y.
    """
    rows, columns = area
    reach, half_px = int(wings.radius_px[-1]), wings.radius_px[0]
    # Windows of the pixels within reach of a star, as far as they are in this area: x and y.
    middle = np.rint(positions).astype(int)
    first = np.maximum(middle - reach, [columns.start, rows.start])
    end = np.minimum(middle + reach + 1, [columns.stop, rows.stop])
    # Its stamp in the window: pixels less than half a stamp from the star along both axes.
    stamp_first = np.maximum(np.floor(positions - half_px).astype(int) + 1 - first, 0)
    stamp_end = np.maximum(np.ceil(positions + half_px).astype(int) - first, 0)
    limits = np.concatenate([first, end, stamp_first, stamp_end], axis=1)
    for star in np.flatnonzero((first < end).all(axis=1)).tolist():
        # Python numbers: arithmetic with single elements of an array takes longer.
        x, y = positions[star].tolist()
        column, row, column_end, row_end, *stamp = limits[star].tolist()
        # Distances of the pixels from the star along either axis, and from its centre, in bins.
        across = BINS_PER_PX * (np.arange(column, column_end) - x).astype(np.float32)
        down = BINS_PER_PX * (np.arange(row, row_end) - y).astype(np.float32)
        distance = np.sqrt(np.square(down)[:, None] + np.square(across))
        distance += 1.5
        bins = distance.astype(np.int32)
        bins[stamp[1] : stamp[3], stamp[0] : stamp[2]] = 0
        window = (
            slice(row - rows.start, row_end - rows.start),
            slice(column - columns.start, column_end - columns.start),
        )
        yield star, window, bins


def draw_hats(
    shape: tuple[int, ...], stars: StarFluxes, wings: Wings, tile_px: int
) -> Iterator[tuple[tuple[slice, slice], np.ndarray]]:
    """Yield tiles of an image (h, w), and Σ F s h_k of the stars in them, shape (K, rows, columns).

    The shape of tiles that no wings reach is (0, rows, columns). Faint stars, which have 0.2 % of
    Σ (F s)², tell next to nothing of the wings, and are left out.
    """
    heights, (positions, scaled_flux) = tabulate_hats(wings), select_lit_stars(stars, wings, 0.998)
    # The hat functions of a whole image would take K times its memory.
    height, width = shape
    for top in steps("wings", range(0, height, tile_px)):
        for left in range(0, width, tile_px):
            tile = slice(top, min(top + tile_px, height)), slice(left, min(left + tile_px, width))
            sides = tile[0].stop - top, tile[1].stop - left
            tile_hats = None
            for star, window, bins in star_bins(tile, positions, wings):
                if tile_hats is None:
                    tile_hats = np.zeros((*sides, len(wings.profile)), np.float32)
                star_hats = np.take(heights, bins, axis=0, mode="clip")
                star_hats *= scaled_flux[star]
                tile_hats[window] += star_hats
            yield (
                tile,
                np.moveaxis(np.empty((*sides, 0)) if tile_hats is None else tile_hats, 2, 0),
            )


def draw_wings(shape: tuple[int, ...], stars: StarFluxes, wings: Wings | None) -> np.ndarray:
    """Return the light of the wings of stars in an image (h, w): Σ F s Σ_k p_k h_k."""
    image = np.zeros(shape, np.float32)
    if wings is not None:
        add_wings(image, stars, wings)
    return image


def add_wings(image: np.ndarray, stars: StarFluxes, wings: Wings, factor: float = 1.0) -> None:
    """Add the light of the wings of stars, times a factor, to an image (h, w)."""
    # Each star adds its light in its window, not in an image of its own.
    light = (tabulate_hats(wings) @ wings.profile).astype(np.float32)
    positions, scaled_flux = select_lit_stars(stars, wings)
    height, width = image.shape
    for star, window, bins in star_bins(np.s_[0:height, 0:width], positions, wings):
        image[window] += factor * float(scaled_flux[star]) * np.take(light, bins, mode="clip")


def fit_wings(
    residual: np.ndarray,
    sigma: np.ndarray,
    bad: np.ndarray,
    stars: StarFluxes,
    stamp_px: int,
    earlier: Wings | None = None,
) -> Wings | None:
    """Fit the wings of stars to what is left of an image without sky and models of its stars.

    An even light, such as a wrong level of the sky, is fitted with them and not returned. Where
    `earlier` wings are subtracted, pixels more than 4 σ from them are left out.

    Parameters
    ----------
    residual, sigma : ndarray, shape (h, w)
        What is left of the image, and σ of its pixels, in its unit.
    bad : ndarray of bool, shape (h, w)
        Pixels that are not fitted.
    stars : StarFluxes
        Positions and fluxes of the stars.
    stamp_px : int
        Side of the models' stamps.
    earlier : Wings, optional
        Wings of the previous fit, which are subtracted from `residual`; their radii are used again.

    Returns
    -------
    Wings or None
        None without a star that has light, or without a good pixel.
    """
    # The mean of the outer share, weighted with the flux: the share for which s = 1.
    flux, outer_share = stars.flux, stars.outer_share
    has_light = np.isfinite(flux) & (flux > 0) & np.isfinite(outer_share)
    if not has_light.any():
        return None
    mean_share = float(np.average(outer_share[has_light], weights=flux[has_light]))
    if not mean_share > 0:
        return None
    # Six hat functions, of which the last ends 2.5 stamps from the star, or as in an earlier fit,
    # whose profile belongs to its own mean share and is rescaled to this one.
    radius, profile = np.geomspace(stamp_px / 2, 2.5 * stamp_px, 7), np.zeros(7)
    if earlier is not None:
        radius = earlier.radius_px
        profile = earlier.profile * (mean_share / earlier.outer_share)
    count = len(radius)
    hats_of_fit = Wings(radius, profile, np.zeros((count, count)), mean_share)
    limit = np.inf if earlier is None else 4.0
    normal, projection, square, pixels, blocks = sum_products(
        residual, sigma, bad, stars, hats_of_fit, stamp_px, limit
    )
    if not normal[-1, -1] > 0:
        return None
    *block_design, block_light, block_pixels = blocks
    # The same of the residual with the earlier wings: d + A p.
    start = np.append(profile, 0.0)
    square += 2.0 * float(start @ projection) + float(start @ normal @ start)
    projection += normal @ start
    block_light += start @ np.array(block_design)
    # Least squares of p with its prior, and of the even light without one, in units of the prior's
    # σ: (N/χ² + 1) x = b/χ² + μ, without 1 and μ for the even light. χ² is the greatest of 1, χ²
    # of the pixels and χ² of sums over blocks: an uneven sky and undetected sources leave
    # residuals as wide as wings, in which pixels are not independent.
    prior_profile, prior_sigma = compute_prior_profile(radius, mean_share)
    unit = np.append(prior_sigma, normal[-1, -1] ** -0.5)
    normal, projection = normal * unit * unit[:, None], projection * unit
    prior = np.diag(np.append(np.ones(count), 0.0))
    prior_projection = np.append(prior_profile / prior_sigma, 0.0)
    # χ² depends on x: three rounds.
    chi2 = 1.0
    for _ in range(3):
        inverse = np.linalg.inv(normal / chi2 + prior)
        parameters = inverse @ (projection / chi2 + prior_projection)
        residual_square = square - 2.0 * parameters @ projection + parameters @ normal @ parameters
        chi2_of_pixels = residual_square / max(pixels, 1)
        # The square of a sum of n independent residuals is n on average.
        block_residual = block_light - (parameters * unit) @ np.array(block_design)
        chi2_of_blocks = float(block_residual @ block_residual) / max(block_pixels.sum(), 1.0)
        chi2 = max(chi2_of_pixels, chi2_of_blocks, 1.0)
    parameters, inverse = parameters * unit, inverse * unit * unit[:, None]
    return Wings(radius, parameters[:-1], inverse[:-1, :-1], mean_share)


class Products(NamedTuple):
    """Sums over the pixels of an image for the fit of K numbers p, and of an even light.

    A row of the design A is (F s h_k, 1)/σ of a pixel, and d is its residual over σ.

    Attributes
    ----------
    normal, projection : ndarray, shape (K + 1, K + 1) and (K + 1,)
        AᵀA and Aᵀd.
    square : float
        dᵀd.
    pixels : int
        Number of pixels.
    blocks : ndarray, shape (K + 3, m)
        Sums over blocks of a stamp: of the columns of A, of d, and of the pixels.
    """

    normal: np.ndarray
    projection: np.ndarray
    square: float
    pixels: int
    blocks: np.ndarray


def sum_products(
    residual: np.ndarray,
    sigma: np.ndarray,
    bad: np.ndarray,
    stars: StarFluxes,
    wings: Wings,
    stamp_px: int,
    limit: float,
) -> Products:
    """Return the sums over the pixels of an image (h, w) that fit the profile of wings.

    Parameters are as in `fit_wings`; pixels over `limit` σ are left out, and `wings` give the hat
    functions h_k and s.
    """
    from scipy.ndimage import uniform_filter

    count = len(wings.profile)
    normal, projection = np.zeros((count + 1,) * 2), np.zeros(count + 1)
    square, pixels, blocks = 0.0, 0, []
    tile_px = stamp_px * max(1, 128 // stamp_px)
    for tile, tile_hats in draw_hats(residual.shape, stars, wings, tile_px):
        # Within a stamp all pixels count alike: then p_0 is the mean of what the model leaves
        # there, and p_0 times the area of the stamp the light that it lacks, as an aperture would
        # find it. So σ² is averaged over a stamp, also across the edge of the tile.
        margin = stamp_px // 2 + 1
        around = tuple(slice(max(s.start - margin, 0), s.stop + margin) for s in tile)
        inner = tuple(
            slice(s.start - a.start, s.stop - a.start) for s, a in zip(tile, around, strict=True)
        )
        variance = np.square(sigma[around])
        smooth_variance = uniform_filter(variance, stamp_px, mode="nearest")[inner]
        # A mean is not below the least value, but for the rounding of running sums.
        smooth_variance = np.maximum(smooth_variance, variance.min())
        # Undetected stars and galaxies are left out.
        is_used = ~bad[tile] & (np.abs(residual[tile]) < limit * sigma[tile])
        # Rows of the design of a tile: hat functions, if wings reach it, the even light, the data,
        # and the number of the pixels. Their sums are small enough for single precision.
        design = np.empty((len(tile_hats) + 3, *is_used.shape), np.float32)
        design[:-3], design[-3], design[-2] = tile_hats, 1.0, residual[tile]
        design[:-1] *= np.where(is_used, 1.0 / np.sqrt(smooth_variance), 0.0)
        design[-1] = is_used
        flat, first = design[:-1].reshape(len(design) - 1, -1), count - len(tile_hats)
        products = flat @ flat.T
        normal[first:, first:] += products[:-1, :-1]
        projection[first:] += products[:-1, -1]
        square += float(products[-1, -1])
        pixels += int(np.count_nonzero(is_used))
        # Sums over blocks are products with matrices of 0 and 1. Blocks at the lower and right
        # edges may be smaller.
        down, across = (
            np.equal.outer(np.arange(-(-size // stamp_px)), np.arange(size) // stamp_px)
            for size in is_used.shape
        )
        sums = down.astype(np.float32) @ (design @ across.T.astype(np.float32))
        block = np.zeros((count + 3, sums[0].size))
        block[first:] = sums.reshape(len(sums), -1)
        blocks.append(block)
    return Products(normal, projection, square, pixels, np.concatenate(blocks, axis=1))


def add_model_errors(
    error: np.ndarray, star_light: np.ndarray, wing_light: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return σ (h, w) of an image without its stars: its noise, and the errors of their models.

    These are 3 % of the models' light and 30 % of the wings' light: wings are round here, and those
    of a telescope may differ from that by as much in a pixel.
    """
    return np.asarray(np.hypot(np.hypot(error, 0.03 * star_light), 0.3 * wing_light))


def around_stars(
    image: np.ndarray,
    sky: Sky,
    error: np.ndarray,
    star_light: np.ndarray,
    stars: StarFluxes,
    stamp_px: int,
    earlier: Wings | None,
    tolerance: float,
    cores: np.ndarray,
    with_wings: bool = True,
) -> tuple[Sky, np.ndarray, Wings | None, np.ndarray]:
    """Find wings and sky of an image (h, w) in turns, without the models of its stars.

    A sky map takes wide wings for sky until the wings are known.

    Parameters
    ----------
    image, error, star_light : ndarray, shape (h, w)
        Image with its sky, σ of its pixels, and light of the models of its stars.
    sky : Sky
        As it is known so far; its `bad` pixels do not count.
    stars : StarFluxes
        Positions and fluxes of the stars.
    stamp_px : int
        Side of the stamps in which the model has the light of a star.
    earlier : Wings or None
        Wings with which the turns begin.
    tolerance : float
        Turns end when the light of the wings is known to this fraction of its error.
    cores : ndarray, shape (k, 3)
        Saturated cores, middle x, y and radius in px (`find_saturated_cores`).
    with_wings : bool
        False for the sky alone: the wings stay the earlier ones, and no halos are measured.

    Returns
    -------
    sky : Sky
        Sky without wings; its `signal` is what is left without sky, stars and wings.
    wing_light : ndarray, shape (h, w)
        With the halos of saturated cores.
    wings : Wings or None
        The earlier ones if no star fits its model.
    halo_error : ndarray, shape (h, w)
        Standard error of these halos in a pixel, which neighbours share.
    """
    # What is left beside the models has their errors, too.
    sigma = add_model_errors(error, star_light)
    without_stars, bad = image - star_light, sky.bad
    wings, fitted_stars = earlier, None
    # Each turn finds the sky without the wings so far, of the same structure, then the wings on
    # this sky. The sky of the last turn is off by far less than the error of the wings.
    last_light, last_change = np.nan, np.nan
    for _ in steps("light beyond the stamps", range(8)):
        residual = draw_wings(image.shape, stars, wings)
        np.subtract(without_stars, residual, out=residual)
        residual[bad] = 0.0
        known_sky = measure_sky(residual, bad, sky.structure)
        if not with_wings:
            break
        residual -= known_sky.level
        if fitted_stars is None:
            # The wings of stars unlike the PSF are subtracted, but not fitted.
            is_like = is_like_psf(residual, bad, sigma, stars.position)
            fitted_stars = stars._replace(flux=np.where(is_like, stars.flux, np.nan))
        previous, fit = wings, fit_wings(residual, sigma, bad, fitted_stars, stamp_px, wings)
        # Without a star that fits, the wings stay the earlier ones, without which the sky is.
        if fit is None:
            break
        wings = fit
        # The sky has taken a part of the wings that were not subtracted yet: it gives it back in
        # turns, each a fraction ρ of the turn before. A change δ is followed by δ ρ/(1 − ρ), which
        # is added at once; half of that may be wrong. The two latest turns, from x₁ to F(x₁) and
        # from x₂ to F(x₂), show ρ = (F(x₂) − F(x₁))/(x₂ − x₁), as in the secant method: ρ of the
        # first turns would let later ones diverge where ρ changes, as around clipped pixels.
        light, light_sigma = wings.light()
        start_light = 0.0 if previous is None else previous.light()[0]
        change = light - start_light
        with np.errstate(all="ignore"):
            ratio = 1.0 + np.divide(change - last_change, start_light - last_light)
        last_light, last_change = start_light, change
        unknown_light = abs(change)
        if previous is not None and abs(ratio) < 0.75:
            growth = ratio / (1.0 - ratio)
            unknown_light *= 0.5 * abs(growth)
            wings = replace(
                wings, profile=wings.profile + growth * (wings.profile - previous.profile)
            )
        if previous is not None and unknown_light < tolerance * light_sigma:
            break
    else:
        # Wings that have not settled are known to the last change only.
        assert wings is not None  # a turn without wings ends the loop
        scale = 1.0 + (unknown_light / light_sigma) ** 2
        wings = replace(wings, covariance=scale * wings.covariance)
    del residual  # of a large image, each map takes much memory
    wing_light = draw_wings(image.shape, stars, wings)
    without_stars -= wing_light
    # Sky and signal without the wings, with the noise map if the image has one.
    sigma_map = sky.noise if np.isfinite(sky.noise_scale) else None
    known_sky = add_shared_noise(without_stars, bad, known_sky)
    sky = subtract_sky(without_stars, bad, sigma_map, sky.least_noise, known_sky)
    del without_stars
    # The map estimates the mode, below the mean for photon noise and undetected stars. Both
    # are under stars, too: the mean deviation Σ d/σ² / Σ 1/σ² of all pixels within 4 σ is added
    # to the level.
    is_used = ~bad & (np.abs(sky.signal) <= 4.0 * sigma)
    weight = np.divide(1.0, np.square(sigma), out=np.zeros_like(sigma), where=is_used)
    total_weight = max(float(weight.sum(dtype=np.float64)), np.finfo(float).tiny)
    weight *= sky.signal
    even_light = float(weight.sum(dtype=np.float64)) / total_weight
    sky = replace(sky, level=sky.level + even_light, signal=sky.signal - even_light)
    if not with_wings:
        return sky, wing_light, wings, np.zeros_like(wing_light)
    halo_error = subtract_halos(sky.signal, wing_light, bad, sigma, stars, wings, cores)
    return sky, wing_light, wings, halo_error


def is_like_psf(
    residual: np.ndarray, bad: np.ndarray, sigma: np.ndarray, positions: np.ndarray
) -> np.ndarray:
    """Return True for stars (n,) that their models fit.

    Galaxies, blends and saturated stars say nothing of the wings of stars: a star counts if more
    than half of the 5 × 5 px about it are good, and the RMS of these is below 2 σ.

    Parameters
    ----------
    residual, sigma : ndarray, shape (h, w)
        Image without sky and stars, and σ of its pixels, which has the errors of the PSF, too.
    bad : ndarray of bool, shape (h, w)
        Pixels that do not count.
    positions : ndarray, shape (n, 2)
        x and y of the stars, NaN where unknown.
    """
    column, row = np.rint(np.nan_to_num(positions, nan=-9.0)).astype(int).T
    axis, (height, width) = np.arange(-2, 3), bad.shape
    rows, columns = row[:, None, None] + axis[:, None], column[:, None, None] + axis
    is_inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    at = np.where(is_inside, rows, 0), np.where(is_inside, columns, 0)
    is_good = is_inside & ~bad[at]
    count = np.count_nonzero(is_good, axis=(1, 2))
    square = np.square(residual[at] / sigma[at]).sum(axis=(1, 2), where=is_good)
    is_fitted = (count > 0.5 * axis.size**2) & (square < 4.0 * count)
    return np.asarray(is_inside[:, 2, 2] & is_fitted)


def subtract_halos(
    residual: np.ndarray,
    wing_light: np.ndarray,
    bad: np.ndarray,
    sigma: np.ndarray,
    stars: StarFluxes,
    wings: Wings | None,
    cores: np.ndarray,
) -> np.ndarray:
    """Subtract the halos of saturated cores, whose stars have no or few pixels to be fitted.

    The wings of stars on the cores belong to the halos, which need not be round as wings are: they
    are added to the residual again before halos are measured.

    Parameters
    ----------
    residual, wing_light : ndarray, shape (h, w)
        Image without sky and stars, and light of wings: changed here.
    bad : ndarray of bool, shape (h, w)
        Pixels that do not count.
    sigma : ndarray, shape (h, w)
        σ of the pixels.
    stars : StarFluxes
        Positions and fluxes of the stars.
    wings : Wings or None
        Wings that were subtracted.
    cores : ndarray, shape (k, 3)
        As in `around_stars`.

    Returns
    -------
    ndarray, shape (h, w)
        Standard error of the halos in a pixel, which neighbours share.
    """

    def move_wings(rows: np.ndarray, sign: float) -> None:
        """Add wings of the stars of a mask to the residual (`sign` 1), or subtract them (−1)."""
        if wings is not None and rows.any():
            add_wings(residual, stars.select(rows), wings, sign)
            add_wings(wing_light, stars.select(rows), wings, -sign)

    halo_error = np.zeros_like(residual)
    distance = np.hypot(*(stars.position[:, None] - cores[:, :2]).T)
    is_on_core = distance < cores[:, 2:] + 1.0
    is_added = is_on_core.any(axis=0)
    move_wings(is_added, 1.0)
    for core, is_on_this in zip(cores, is_on_core, strict=True):
        # A star on several cores counts once: its wings are a part of the first halo, or they are
        # subtracted again if its first core has none, since they are all that is known then.
        is_first = is_on_this & is_added
        is_added &= ~is_on_this
        if (halo := measure_halo(residual, bad, sigma, core)) is None:
            move_wings(is_first, -1.0)
            continue
        wing_light[halo.window] += halo.light
        residual[halo.window] -= halo.light
        halo_error[halo.window] = np.hypot(halo_error[halo.window], halo.error)
    return halo_error


class Halo(NamedTuple):
    """Light around a saturated core.

    Attributes
    ----------
    window : tuple of slice
        Rows and columns of the pixels.
    light, error : ndarray, shape (h, w)
        Light in the window, negative where the model of a star has too much, and its standard error
        in a pixel, which neighbours share.
    """

    window: tuple[slice, ...]
    light: np.ndarray
    error: np.ndarray


class Rings(NamedTuple):
    """Rings of a window around a core, those that show its halo.

    Attributes
    ----------
    window : tuple of slice
        Rows and columns of the pixels.
    offset : ndarray, shape (2, h, w)
        Rows and columns of the pixels from the middle.
    round_offset, radius : ndarray, shape (2, h, w) and (h, w)
        The same where ellipses are turned into circles, and the distance, px.
    number : ndarray of int, shape (h, w)
        Number of the ring of each pixel; 0 for the core and bad pixels.
    halo_rings : ndarray of int, shape (k,)
        Numbers of the rings up to the end of the halo.
    log_radius, level, error : ndarray, shape (k,)
        ln of the radius of each of these, the median of its pixels, and the error of that.
    slope : float
        Power of the distance with which the light falls off outside of them.
    """

    window: tuple[slice, ...]
    offset: np.ndarray
    round_offset: np.ndarray
    radius: np.ndarray
    number: np.ndarray
    halo_rings: np.ndarray
    log_radius: np.ndarray
    level: np.ndarray
    error: np.ndarray
    slope: float

    def draw_light(self, radius: np.ndarray) -> np.ndarray:
        """Return the light at distances (h, w) from the middle, 0 from 256 px on."""
        # Between rings, r³ h is linear in ln r; farther out, h is the power of the distance.
        log_r, end = np.log(np.maximum(radius, 1.0)), self.log_radius[-1]
        scaled_level = self.level * np.exp(3.0 * self.log_radius)
        light = np.interp(log_r, self.log_radius, scaled_level)
        outer_exponent = self.slope * np.maximum(log_r - end, 0.0)
        light *= np.exp(outer_exponent - 3.0 * np.minimum(log_r, end))
        light[radius >= 256.0] = 0.0
        return np.asarray(light)


def find_rings(
    residual: np.ndarray,
    bad: np.ndarray,
    sigma: np.ndarray,
    core: np.ndarray,
    middle: np.ndarray,
    to_circle: np.ndarray,
) -> Rings | None:
    """Find the rings that show the halo of a core, in a window as wide as they are.

    Parameters are as in `measure_halo`, with the row and column of the `middle` (2,) and the matrix
    `to_circle` (2, 2) that turns rings into circles. None if no two successive rings show a halo.
    """
    # Rings wider by a tenth each, in windows of which each is twice as wide as the one before.
    edges = np.geomspace(core[2], 256.0, 8 + int(10 * np.log(256.0 / core[2])))
    reach_px = min(256, max(64, int(4.0 * core[2])))
    while True:
        window = cut_window(core[1::-1], reach_px, residual.shape)
        offset = np.mgrid[window] - middle[:, None, None]
        round_offset = np.tensordot(to_circle, offset, 1)
        radius = np.hypot(*round_offset)
        ring = np.where(bad[window], 0, np.digitize(radius, edges))
        # Ring 0 is the core and bad pixels, the last one everything outside of 256 px.
        numbers = np.setdiff1d(np.flatnonzero(np.bincount(ring.ravel())), [0, len(edges)])
        level = label_medians(residual[window], ring, len(edges) + 1)[numbers]
        # The error of a median of n values is 1.25 σ/√n.
        pixels, radius_sum, noise_sum = (
            np.bincount(ring.ravel(), weights)[numbers]
            for weights in (None, radius.ravel(), sigma[window].ravel())
        )
        log_radius, error = np.log(radius_sum / pixels), 1.25 * noise_sum / pixels**1.5
        # The halo is the first run of rings that show it: near the core, errors of the model of a
        # fitted star may hide it.
        is_seen = np.append(np.abs(level) > 5.0 * error, False)
        first = int(is_seen.argmax())
        end = first + int(is_seen[first:].argmin())
        # It is known as soon as a ring after it is whole, that is, its outer edge in the window.
        is_whole = end < len(numbers) and edges[numbers[end]] < reach_px - 1
        if is_whole or reach_px == 256 or not is_seen.any():
            break
        reach_px = min(2 * reach_px, 256)
    if end - first < 2:
        return None
    # Noise hides the light of farther rings: it goes on along a power of the distance that fits the
    # last four, at least r^-2.
    last = np.s_[max(end - 4, first) : end]
    slope = min(np.polyfit(log_radius[last], np.log(np.abs(level[last])), 1)[0], -2.0)
    profile = numbers[:end], log_radius[:end], level[:end], error[:end], float(slope)
    return Rings(window, offset, round_offset, radius, ring, *profile)


def fit_shape(
    rings: Rings, residual: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return how far the middle of rings is off, (2,), and the matrix (2, 2) that rounds them.

    Residual and σ (h, w) are as in `measure_halo`.
    """
    data, light, radius = residual[rings.window], rings.draw_light(rings.radius), rings.radius
    # The centre is known to half a pixel, and halos may be oval: an offset δ leaves −δ ∇h, and
    # stretches g₁ along the axes and g₂ along the diagonals leave r h' (g₁ cos 2φ + g₂ sin 2φ).
    # Least squares, where uneven light counts as an error of 30 %.
    doubt = np.hypot(sigma[rings.window], 0.3 * light)
    is_fitted = (rings.number > 0) & (np.abs(data - light) < 3.0 * doubt)
    is_fitted &= np.log(np.maximum(radius, 1.0)) < rings.log_radius[-1]
    slopes = np.stack(np.gradient(light))
    along = (slopes * rings.offset).sum(axis=0) / np.maximum(radius, 1.0) ** 2  # h'/r
    down, across = rings.round_offset
    stretches = [-along * (down**2 - across**2), -along * 2.0 * down * across]
    design = np.stack([*slopes, *stretches])[:, is_fitted] / doubt[is_fitted]
    change = np.linalg.lstsq(design.T, ((light - data) / doubt)[is_fitted], rcond=None)[0]
    along_axes, along_diagonals = np.clip(change[2:], -0.05, 0.05)
    stretch = [[1.0 + along_axes, along_diagonals], [along_diagonals, 1.0 - along_axes]]
    return np.clip(change[:2], -1.0, 1.0), np.array(stretch)


def measure_halo(
    residual: np.ndarray, bad: np.ndarray, sigma: np.ndarray, core: np.ndarray
) -> Halo | None:
    """Measure the light that is left around a saturated core: in each ring, the median.

    Rings are ellipses of one shape, which is fitted with their centre. The halo begins within 64 px
    or four radii of the core, and ends at the first ring of which the median is below five times
    its error; farther out, it falls off as the power of the distance that the last four rings
    follow, up to 256 px.

    Parameters
    ----------
    residual, sigma : ndarray, shape (h, w)
        Image without sky and stars, and σ of its pixels.
    bad : ndarray of bool, shape (h, w)
        Pixels that are in no ring.
    core : ndarray, shape (3,)
        Middle x, y and radius in px.

    Returns
    -------
    Halo or None
        None if no two rings that follow each other show a halo.
    """
    middle, to_circle = core[1::-1].astype(float), np.eye(2)
    rings = find_rings(residual, bad, sigma, core, middle, to_circle)
    for _ in range(4):
        if rings is None:
            return None
        move, stretch = fit_shape(rings, residual, sigma)
        middle, to_circle = middle + move, stretch @ to_circle
        rings = find_rings(residual, bad, sigma, core, middle, to_circle)
    if rings is None:
        return None
    # A halo is not an ellipse: medians in eighths of a ring scatter by more than noise does, whose
    # variance is 8 times the variance e² of the ring's median. σ² is their mean square minus 7 e²,
    # at least e². Outside of the rings that show the halo, σ is half of the light.
    eighth = np.floor(np.arctan2(*rings.offset) * 4.0 / np.pi).astype(int) % 8
    count = 8 * int(rings.number.max()) + 8
    remainder = residual[rings.window] - rings.draw_light(rings.radius)
    uneven = label_medians(remainder, rings.number * 8 + eighth, count).reshape(-1, 8)
    noise_variance = np.square(rings.error)
    variance = np.nanmean(np.square(uneven[rings.halo_rings]), axis=1) - 7.0 * noise_variance
    ring_error = np.sqrt(np.maximum(variance, noise_variance))
    # Light and error of all pixels up to 256 px.
    window = cut_window(core[1::-1], 256, residual.shape)
    offset = np.mgrid[window] - middle[:, None, None]
    radius = np.hypot(*np.tensordot(to_circle, offset, 1))
    light, log_r = rings.draw_light(radius), np.log(np.maximum(radius, 1.0))
    error = np.interp(log_r, rings.log_radius, ring_error)
    return Halo(window, light, np.where(log_r > rings.log_radius[-1], 0.5 * np.abs(light), error))
