"""Light of stars beyond the stamps of a model, and the sky that is left without it.

The model knows the light of a star within its stamp, over that of a ring around it, taken for sky.
The rest is one profile for all stars: a star of flux F has

    F s (p_0 h_0 + Σ_k p_k h_k(r))

more in a pixel, with h_0 = 1 in its stamp and 0 elsewhere, tents h_k in ln r times a power of r
outside of the stamp, r the distance from its centre, and s the light of the model's PSF in the
outer part of its stamp over the mean of all stars: where the PSF is wider, it has more wings.
All pixels of the image together give p by weighted least squares, with a prior: that the light
falls off outside of the stamp about as that of other telescopes does. Bright stars outweigh the
prior; few faint ones hardly change it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import numpy as np

from psfdae.base.arguments import ArgumentError
from psfdae.base.errors import keyword
from psfdae.base.progress import steps
from psfdae.image.detection import Sky, sky_of
from psfdae.image.sky_level import level_and_noise
from psfdae.image.trails import saturated_cores
from psfdae.stars.bright_stars import magnitude
from psfdae.stars.moments import dither

if TYPE_CHECKING:
    from psfdae.image.fits_file import Card
    from psfdae.psf.interface import FieldPsfs


@dataclass(frozen=True)
class Wings:
    """Light of stars beyond what their model knows.

    Attributes
    ----------
    radius_px : ndarray, shape (K,)
        r_1 … r_K: tops of the K − 1 tents, r_1 half the side of the stamp; from r_K on there is no
        light.
    profile : ndarray, shape (K,)
        p_0 … p_{K−1}, part of the flux per pixel: p_0 in the stamp, p_k (r_k/r_1)^-3 at r_k.
    covariance : ndarray, shape (K, K)
        Of p_k.
    outer_share : float
        Mean of the stars' `outer_shares`, for which s = 1.
    outer_part_from : float
        Radius at which the outer part of a stamp begins, over half its side.
    steepness : float
        Power of 1/r in the tents: that of light that mirrors and air scatter.
    """

    outer_part_from: ClassVar[float] = 0.7
    steepness: ClassVar[float] = 3.0

    radius_px: np.ndarray
    profile: np.ndarray
    covariance: np.ndarray
    outer_share: float

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> Self:
        """Return wings from the lists and numbers of `plain`.

        Raises
        ------
        ValueError
            If one is missing, they do not fit together, or their light is no part of a star's.
        """
        # A number of another type, or one that is missing, is as wrong as one that does not fit.
        names = ("radius_px", "profile", "covariance")
        try:
            arrays = {name: np.array(plain[name], dtype=np.float64) for name in names}
            wings = cls(**arrays, outer_share=float(plain["outer_share"]))
        except (TypeError, LookupError, ArithmeticError) as error:
            raise ValueError(f"wings without {error}") from None
        radius, count = wings.radius_px, wings.profile.size
        shapes = [a.shape for a in (wings.profile, radius, wings.covariance)]
        if count < 2 or shapes != [(count,), (count,), (count, count)]:
            raise ValueError("wings whose numbers do not fit together")
        # No wings reach beyond 100 000 px, or have ten times the light of the star.
        is_rising = radius[0] > 0 and (np.diff(radius) > 0).all() and radius[-1] < 1e5
        with np.errstate(all="ignore"):
            light, light_sigma = wings.light() if is_rising else (np.nan, np.nan)
        is_scaled = 0.0 < wings.outer_share < np.inf
        if not (is_scaled and abs(light) < 10.0 and np.isfinite(light_sigma)):
            raise ValueError("wings whose light is no part of that of a star")
        return wings

    def plain(self) -> dict[str, Any]:
        """Lists and numbers, for a bundle."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}

    def scale(self, outer_share: np.ndarray) -> np.ndarray:
        """Return s of stars with these `outer_shares` (n,), 1 where they are not known (NaN)."""
        ratio = np.where(np.isfinite(outer_share), outer_share / self.outer_share, 1.0)
        # A factor of three in either direction is no PSF of the same telescope.
        return np.asarray(np.clip(ratio, 0.3, 3.0))

    def total_over_flux(self, outer_share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return flux_total over flux of stars with these `outer_shares` (n,), and its error.

        Both have the shape (n,). Half of the change of wings with the PSF counts as its error.
        """
        # 1 + s L, with the errors s σ_L and (s − 1) L / 2.
        scale = self.scale(outer_share)
        light, error = self.light()
        return 1.0 + scale * light, np.hypot(scale * error, 0.5 * (scale - 1.0) * light)

    def differs_from(self, wings: Wings) -> bool:
        """Return True if the light differs by more than 3 σ from the light of these wings."""
        (light, error), (wing_light, wing_error) = self.light(), wings.light()
        return abs(light - wing_light) > 3.0 * float(np.hypot(error, wing_error))

    def light(self, radius_px: float = np.inf) -> tuple[float, float]:
        """Return the light that the model lacks within a radius in px, and its standard error.

        Both are over the star's flux, where s = 1.
        """
        # ∫ 2π r (h_0 p_0 + Σ h_k p_k) dr.
        half = self.radius_px[0]
        r = np.linspace(0.0, min(radius_px, self.radius_px[-1]), 4001)
        # Part of a circle outside of the square of side 2 half, the stamp: 4/π arccos(half/r) ≤ 1.
        outside = np.clip(np.arccos(np.minimum(half / np.maximum(r, half), 1.0)) * 4 / np.pi, 0, 1)
        height = np.concatenate([1.0 - outside[None], outside * tents(r, self.radius_px)])
        share = np.trapezoid(2 * np.pi * r * height, r, axis=1)
        return float(self.profile @ share), float(np.sqrt(share @ self.covariance @ share))

    def cards(self) -> list[Card]:
        """Return cards for a FITS header: radius of all light, and part of it in the model."""
        return [
            ("FLUXRAD", float(self.radius_px[-1]), "[pix] all light of a star is within it"),
            ("INMODEL", 1.0 / (1.0 + self.light()[0]), "part of it in the model, usual star"),
        ]

    def __repr__(self) -> str:
        return f"Wings({self})"

    def __str__(self) -> str:
        light, error = self.light()
        sentence = (
            f"{100 * light:.2f} ± {100 * error:.2f} % of the flux in the stamp of a usual star, "
            f"out to {self.radius_px[-1]:.3g} px"
        )
        if light / (1.0 + light) > 0.2:
            sentence += (
                f"; over a fifth of the flux: try wider stamps ({keyword('stamp_px')}), or a list "
                "without sources that are no stars"
            )
        return sentence

    @classmethod
    def joined(cls, several: Sequence[Wings]) -> Wings:
        """Average the wings of several images with one model, weighted by 1/σ² of their light."""
        weight = np.array([wings.light()[1] ** -2.0 for wings in several])
        weight /= weight.sum()
        # First each profile is rescaled to the mean outer share, with which p grows. The images are
        # independent: C = Σ w² C_i.
        outer_share = float(weight @ [wings.outer_share for wings in several])
        weight *= [outer_share / wings.outer_share for wings in several]
        profile = np.tensordot(weight, [wings.profile for wings in several], 1)
        covariance = np.tensordot(weight**2, [wings.covariance for wings in several], 1)
        return cls(several[0].radius_px, profile, covariance, outer_share)

    @property
    def is_measured(self) -> bool:
        """True if the pixels of the image made the error of the light smaller than the prior's."""
        sigma = expected_profile(self.radius_px, self.outer_share)[1]
        return self.light()[1] < replace(self, covariance=np.diag(sigma**2)).light()[1]


def aperture_correction(
    model: FieldPsfs, wings: Wings | None, x: float, y: float, radius_px: float
) -> float:
    """Return the whole flux of a star at (x, y), in px from 0, over that in an aperture about it.

    The aperture has parts of the pixels at its edge, as photutils' `CircularAperture`.

    Raises
    ------
    ValueError
        If the radius is not above 0, or beyond the wings, or half the stamp without wings.
    """
    from photutils.aperture import CircularAperture

    radius_max = model.stamp_px / 2 if wings is None else float(wings.radius_px[-1])
    if not 0 < radius_px <= radius_max:
        raise ArgumentError(f"radius_px {radius_px} px, expected above 0 up to {radius_max:g}")
    # Light of the PSF in the aperture, about the star's place in the stamp.
    psf = model.psf_at(x, y, 1)
    middle = np.array([x, y]) - np.floor(np.array([x, y]) + 0.5) + psf.shape[0] // 2
    inside = float(CircularAperture(middle, radius_px).do_photometry(psf)[0][0])
    if wings is None:
        return 1.0 / inside
    # All light over that in the aperture, each with the wings of this PSF.
    scale = float(wings.scale(outer_shares(model.on_pixels, np.array([[x, y]])))[0])
    all_wings, inner_wings = (scale * wings.light(r)[0] for r in (np.inf, radius_px))
    return (1.0 + all_wings) / (inside + inner_wings)


def outer_shares(
    draw: Callable[[np.ndarray], np.ndarray], place: np.ndarray, flux: np.ndarray | None = None
) -> np.ndarray:
    """Return the part of a star's flux in the outer part of its stamp, (n,), at places (n, 2).

    Pixels between 0.7 times half the side of the stamp and half the side count. `draw` makes PSFs
    (m, d, d) of m stars by their x, y and, if fluxes (n,) in counts are given, magnitude. NaN where
    a place, x and y in px, or a flux is not known.
    """
    shares = np.full(len(place), np.nan)
    position = np.rint(place)  # at whole pixels, so that phases do not change the share
    if flux is not None:
        position = np.column_stack([position, magnitude(flux)])
    located = np.flatnonzero(np.isfinite(position).all(axis=1))
    # Some at a time, so that their PSFs take little memory.
    for first in range(0, len(located), 2048):
        part = located[first : first + 2048]
        psf = draw(position[part])
        side = psf.shape[-1]
        # Pixels by their distance from the middle of the stamp.
        axis = np.arange(side) - side // 2
        radius = np.hypot(axis[:, None], axis)
        ring = (radius >= Wings.outer_part_from * side / 2) & (radius < side / 2)
        shares[part] = psf[:, ring].sum(axis=1)
    return shares


def tents(r: np.ndarray, radius_px: np.ndarray) -> np.ndarray:
    """Return h_1 … at distances r in pixels, shape (K − 1, …), as they are outside of the stamp.

    h_k = max(1 − |ln(r/r_1)/ln(r_2/r_1) − (k − 1)|, 0) (r/r_1)^-3: tops are equidistant in ln r.
    """
    # ln(r/r_1), 0 inside of the stamp; tops are at multiples of ln(r_2/r_1).
    radius = radius_px.astype(r.dtype)
    log_radius = np.log(np.maximum(r / radius[0], 1.0))
    top = np.arange(len(radius) - 1, dtype=r.dtype).reshape(-1, *[1] * r.ndim)
    off = np.abs(log_radius / np.log(radius[1] / radius[0]) - top)
    return np.asarray(np.maximum(1.0 - off, 0.0) * np.exp(-Wings.steepness * log_radius))


class StarFluxes(NamedTuple):
    """Places and fluxes of n stars, in whose light wings are looked for.

    Attributes
    ----------
    place : ndarray, shape (n, 2)
        x and y in px; NaN where unknown.
    flux : ndarray, shape (n,)
        In the unit of the image, summed over pixels. Stars whose flux is NaN or not above 0 have no
        wings.
    outer_share : ndarray, shape (n,)
        Part of the light in the outer part of the stamp, as `outer_shares` gives it; NaN: no wings.
    """

    place: np.ndarray
    flux: np.ndarray
    outer_share: np.ndarray


def star_tents(
    rows: slice, width: int, stars: StarFluxes, wings: Wings
) -> Iterator[tuple[tuple[slice, slice], np.ndarray]]:
    """Yield windows about the 1000 brightest stars, and F s h_k there, shape (K, …).

    A window is of rows, counted from `rows.start`, and columns; the image is `width` px wide.
    """
    reach, radius = int(wings.radius_px[-1]), wings.radius_px
    # F s, the factor of all tents of a star.
    scaled_flux = stars.flux * wings.scale(stars.outer_share)
    # Unlike in `scale`, stars of unknown outer share are left out.
    scaled_flux = np.where(np.isfinite(stars.outer_share), scaled_flux, np.nan)
    is_lit = np.isfinite(scaled_flux) & (scaled_flux > 0) & np.isfinite(stars.place).all(axis=1)
    # In a crowded image, the thousand brightest stars have most of the light of all wings.
    lit_stars = np.flatnonzero(is_lit)
    brightest = lit_stars[np.argsort(-scaled_flux[lit_stars])[:1000]]
    # Windows of the pixels within reach of a star, as far as they are in these rows: x and y.
    middle = np.rint(stars.place[brightest]).astype(int)
    first = np.maximum(middle - reach, [0, rows.start])
    end = np.minimum(middle + reach + 1, [width, rows.stop])
    windows = zip(brightest.tolist(), first.tolist(), end.tolist(), strict=True)
    for star, (column, row), (column_end, row_end) in windows:
        if column >= column_end or row >= row_end:
            continue
        # Distances of the pixels from the star along either axis, and from its centre.
        x, y = stars.place[star]
        across = (np.arange(column, column_end) - x).astype(np.float32)
        down = (np.arange(row, row_end) - y).astype(np.float32)
        distance = np.sqrt(np.square(down)[:, None] + np.square(across))
        # h_0 is 1 in the stamp, and the tents are 0 there.
        in_stamp = np.maximum(np.abs(down)[:, None], np.abs(across)) < radius[0]
        tents_outside = np.where(in_stamp, 0.0, tents(distance, radius))
        window = np.s_[row - rows.start : row_end - rows.start, column:column_end]
        yield window, float(scaled_flux[star]) * np.concatenate([in_stamp[None], tents_outside])


def draw_tents(
    shape: tuple[int, ...], stars: StarFluxes, wings: Wings
) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield bands of rows, and Σ F s h_k of the stars in them, shape (K, rows, w)."""
    height, width = shape
    # The tents of a whole image would take K times its memory.
    for top in steps("wings", range(0, height, 128)):
        rows = slice(top, min(top + 128, height))
        tented = np.zeros((len(wings.profile), rows.stop - top, width), np.float32)
        for window, tented_star in star_tents(rows, width, stars, wings):
            tented[:, *window] += tented_star
        yield rows, tented


def draw_wings(shape: tuple[int, ...], stars: StarFluxes, wings: Wings | None) -> np.ndarray:
    """Return the light of the wings of stars in an image (h, w): Σ F s Σ_k p_k h_k."""
    # One map, to which each star adds the light in its window.
    image, rows = np.zeros(shape, np.float32), slice(0, shape[0])
    if wings is not None:
        for window, tented_star in star_tents(rows, shape[1], stars, wings):
            image[window] += np.tensordot(wings.profile, tented_star, 1)
    return image


def expected_profile(radius_px: np.ndarray, outer_share: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what is expected of p before any pixel outside of stamps is seen, and its σ, (K,).

    Outside of a stamp of the half side h, the light falls off as a (r/h)^-5, the mean slope of
    Moffat profiles there (Moffat 1969, A&A 3, 455), where a follows from the `outer_share` of the
    light, between 0.7 h and h. Its σ is half of a at h and falls as r^-3, as light that mirrors and
    air scatter does (King 1971, PASP 83, 199), with 0.1 % of the star in quadrature.
    """
    half = radius_px[0]
    # ∫ 2π r (r/h)^-5 dr from 0.7 h to h is 2π h² (0.7^-3 − 1)/3.
    outer_integral = Wings.outer_part_from**-3.0 - 1.0
    edge = max(outer_share, 0.0) * 3.0 / (2.0 * np.pi * half**2 * outer_integral)
    # The ring, at 1.5 h, was taken for sky: every pixel of the stamp lacks its light.
    expected = edge * np.append(1.5**-5.0, (radius_px[:-1] / half) ** (Wings.steepness - 5.0))
    # ∫ 2π r (r/h)^-3 dr from h on is 2π h².
    sigma = np.hypot(np.full(len(radius_px), 0.5 * edge), 1e-3 / (2.0 * np.pi * half**2))
    # The model may have 1.5 % too much or too little light in its stamp.
    sigma[0] = 0.015 / (2.0 * half) ** 2
    return expected, sigma


def wings_of(
    residual: np.ndarray,
    sigma: np.ndarray,
    bad: np.ndarray,
    stars: StarFluxes,
    stamp_px: int,
    earlier: Wings | None = None,
) -> Wings | None:
    """Fit the wings of stars to what is left of an image without sky and models of its stars.

    An even light that was left beside them, such as a wrong sky, does not count. Nor do pixels that
    are more than 4 σ from the wings of an `earlier` fit.

    Parameters
    ----------
    residual, sigma : ndarray, shape (h, w)
        What is left of the image, and σ of its pixels, in its unit.
    bad : ndarray of bool, shape (h, w)
    stars : StarFluxes
    stamp_px : int
        Side of the models' stamps.
    earlier : Wings, optional

    Returns
    -------
    Wings or None
        None without a star that has light, or without a good pixel.
    """
    from scipy.ndimage import uniform_filter

    # Six tents, of which the last one ends 2.5 stamps from the star; those of an earlier fit stay.
    radius = np.geomspace(stamp_px / 2, 2.5 * stamp_px, 7)
    if earlier is not None:
        radius = earlier.radius_px
    # The mean of the outer share by light, for which s = 1.
    flux, outer_share = stars.flux, stars.outer_share
    has_light = np.isfinite(flux) & (flux > 0) & np.isfinite(outer_share)
    if not has_light.any():
        return None
    mean_share = float(np.average(outer_share[has_light], weights=flux[has_light]))
    if not mean_share > 0:
        return None
    count = len(radius)
    unfitted = Wings(radius, np.zeros(count), np.zeros((count, count)), mean_share)
    # Within a stamp all pixels count alike: then p_0 is the mean of what the model leaves there,
    # and p_0 times the area of the stamp the light that it lacks, as an aperture would find it.
    # So σ² is averaged over a stamp.
    variance = np.square(sigma)
    smooth_variance = uniform_filter(variance, stamp_px, mode="nearest")
    # A mean is not below the least value, but for the rounding of running sums.
    np.maximum(smooth_variance, variance.min(), out=smooth_variance)
    smooth_sigma = np.sqrt(smooth_variance, out=smooth_variance)
    del variance, smooth_variance
    # Sums over all pixels for the K numbers p and the even light: N = AᵀA and b = Aᵀd, where a row
    # of A is (F s h_k, 1)/σ of a pixel, and d its residual over σ; the same in blocks of a stamp.
    normal, projection = np.zeros((count + 1,) * 2), np.zeros(count + 1)
    square, pixels, blocks = 0.0, 0, []
    for band, tented in draw_tents(residual.shape, stars, unfitted):
        is_used = ~bad[band]
        if earlier is not None:
            deviation = residual[band] - np.tensordot(earlier.profile, tented, 1)
            # Stars and galaxies that nobody sees are left out: 4 σ is far for noise alone.
            is_used &= np.abs(deviation) < 4.0 * sigma[band]
        weight = np.where(is_used, 1.0 / smooth_sigma[band].astype(np.float64), 0.0)
        design = np.concatenate([tented, np.ones((1, *weight.shape))]) * weight
        flat, data = design.reshape(count + 1, -1), (residual[band] * weight).ravel()
        normal, projection = normal + flat @ flat.T, projection + flat @ data
        square, pixels = square + float(data @ data), pixels + int(np.count_nonzero(weight))
        # Blocks at the lower and right edges may be smaller.
        sums = np.concatenate([design, [residual[band] * weight, weight > 0]])
        for axis in (1, 2):
            sums = np.add.reduceat(sums, range(0, sums.shape[axis], stamp_px), axis=axis)
        blocks.append(sums.reshape(len(sums), -1))
    if not normal[-1, -1] > 0:
        return None
    *block_design, block_light, block_pixels = np.concatenate(blocks, axis=1)
    # Least squares of p with its prior, and of the even light without one, in units of the prior's
    # σ: (N/χ² + 1) x = b/χ² + μ, without 1 and μ for the even light. χ² is the greatest of 1, that
    # of the pixels and that of sums over blocks: an uneven sky and undetected sources leave
    # residuals that neighbours share, as wide as wings.
    expected, prior_sigma = expected_profile(radius, mean_share)
    unit = np.append(prior_sigma, normal[-1, -1] ** -0.5)
    normal, projection = normal * unit * unit[:, None], projection * unit
    prior = np.diag(np.append(np.ones(count), 0.0))
    prior_projection = np.append(expected / prior_sigma, 0.0)
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


def add_model_errors(
    error: np.ndarray, star_light: np.ndarray, wing_light: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return σ (h, w) of an image without its stars: its noise, and the errors of their models.

    These are 3 % of the models' light and 30 % of the wings': wings are round here; a telescope's
    may differ from that by as much in a pixel.
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
    is_saturated: np.ndarray,
) -> tuple[Sky, np.ndarray, Wings | None]:
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
        Turns end when the light of the wings changes by less than this part of its error.
    is_saturated : ndarray of bool, shape (h, w)
        Saturated pixels.

    Returns
    -------
    sky : Sky
        Sky without wings; its `flat` is what is left without sky, stars and wings.
    light_of_wings : ndarray, shape (h, w)
        With the halos of saturated cores without a fitted star.
    wings : Wings or None
    """
    # What is left beside the models has their errors, too.
    sigma = add_model_errors(error, star_light)
    without_stars = image - star_light
    wings = _wings_beside(without_stars, sky, sigma, stars, stamp_px, earlier, tolerance)
    light_of_wings = draw_wings(image.shape, stars, wings)
    # The sky without them, of the same structure, and with its noise map if it has one.
    sigma_map = sky.noise if np.isfinite(sky.noise_scale) else None
    without_light = without_stars - light_of_wings
    sky = sky_of(without_light, sky.bad, sigma_map, structure=sky.structure)
    del without_light
    # The map is the most frequent value, below the mean for photon noise and undetected stars. Both
    # are under stars, too: the mean deviation is added to the level.
    deviation = (without_stars - sky.level - light_of_wings) / sigma
    clipped = sky.bad | (np.abs(deviation) > 4.0)
    # Mean deviation Σ (d/σ)/σ over Σ 1/σ².
    weight = np.where(clipped, 0.0, 1.0 / sigma)
    deviation *= weight
    weight *= weight
    total_weight = max(float(weight.sum(dtype=np.float64)), np.finfo(float).tiny)
    even_light = float(deviation.sum(dtype=np.float64)) / total_weight
    sky = replace(sky, level=sky.level + even_light, flat=sky.flat - even_light)
    # Saturated stars that are not fitted have halos, too.
    middles = stars.place[stars.flux > 0]
    for core in saturated_cores(is_saturated):
        if np.hypot(*(middles - core[:2]).T).min(initial=np.inf) > 2.0:
            halo = measure_halo(sky.flat, sky.bad, sigma, core)
            light_of_wings += halo
            sky = replace(sky, flat=sky.flat - halo)
    return sky, light_of_wings, wings


def measure_halo(
    residual: np.ndarray, bad: np.ndarray, sigma: np.ndarray, core: np.ndarray
) -> np.ndarray:
    """Return the light (h, w) around a saturated core: at each distance, the median.

    It ends at the first ring of which the median is below five times its error, or at 256 px.

    Parameters
    ----------
    residual, sigma : ndarray, shape (h, w)
        Image without sky and stars, and σ of its pixels.
    bad : ndarray of bool, shape (h, w)
        Pixels that are in no ring.
    core : ndarray, shape (3,)
        Middle x, y and radius in px.
    """
    from scipy import ndimage

    halo, (height, width) = np.zeros_like(residual), residual.shape
    column, row = np.rint(core[:2]).astype(int)
    rows = slice(max(row - 256, 0), min(row + 257, height))
    window = rows, slice(max(column - 256, 0), min(column + 257, width))
    y, x = np.mgrid[window]
    radius = np.hypot(x - core[0], y - core[1])
    # Rings wider by a tenth each; bad pixels are in none.
    edges = np.geomspace(core[2], 256.0, 8 + int(10 * np.log(256.0 / core[2])))
    ring = np.where(bad[window], 0, np.digitize(radius, edges))
    numbers = np.unique(ring)[1:-1]
    level = ndimage.median(residual[window], ring, numbers)
    middle = ndimage.mean(radius, ring, numbers)
    # The error of a median of n values is 1.25 σ/√n.
    error = 1.25 * ndimage.mean(sigma[window], ring, numbers)
    error /= np.sqrt(np.bincount(ring.ravel())[numbers])
    # Between the rings it is a power of the distance.
    count = int(np.logical_and.accumulate(level > 5.0 * error).sum())
    if count:
        log_level = np.log(level[:count])
        power = np.interp(np.log(np.maximum(radius, 1.0)), np.log(middle[:count]), log_level)
        halo[window] = np.where(radius <= middle[count - 1], np.exp(power), 0.0)
    return halo


def _wings_beside(
    without_stars: np.ndarray,
    sky: Sky,
    sigma: np.ndarray,
    stars: StarFluxes,
    stamp_px: int,
    earlier: Wings | None,
    tolerance: float,
) -> Wings | None:
    """Return the wings of stars in an image (h, w) without its models, in turns with its sky."""
    from scipy.ndimage import uniform_filter

    wings, all_stars = earlier, stars
    # Galaxies, blends and saturated stars say nothing of the wings of stars: a star counts if most
    # of the 5 × 5 px about it are good, and their RMS residual is below 2 σ, which includes errors
    # of the PSF.
    residual, bad = without_stars - sky.level, sky.bad
    squares = np.square(np.where(bad, 0.0, residual / sigma).astype(np.float32))
    mean_square = uniform_filter(squares, 5, mode="constant")
    good_part = uniform_filter((~bad).astype(np.float32), 5, mode="constant")
    height, width = bad.shape
    column, row = np.rint(np.nan_to_num(stars.place, nan=-9.0)).astype(int).T
    is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = np.where(is_inside, row, 0), np.where(is_inside, column, 0)
    is_star = is_inside & (good_part[at] > 0.5) & (mean_square[at] < 4.0 * good_part[at])
    del squares, mean_square, good_part  # of a large image, each map takes much memory
    stars = all_stars._replace(flux=np.where(is_star, all_stars.flux, np.nan))
    unlike_psf = all_stars._replace(flux=np.where(is_star, np.nan, all_stars.flux))
    # Each turn finds the sky without the wings so far, then the wings on this sky.
    for _ in steps("light beyond the stamps", range(8)):
        previous = wings
        if previous is not None:
            without_wings = without_stars - draw_wings(bad.shape, all_stars, previous)
            without_wings[bad] = 0.0
            without_wings, _ = dither(without_wings, sky.structure.pixel_step)
            residual = without_stars - level_and_noise(without_wings, bad, sky.structure)[0]
            # Stars unlike the PSF have wings, too, which would pass for sky: all wings came out too
            # small.
            residual -= draw_wings(bad.shape, unlike_psf, previous)
        wings = wings_of(residual, sigma, bad, stars, stamp_px, previous)
        if wings is None:
            break
        # Until their light changes by less than a part of its error.
        light, light_sigma = wings.light()
        if previous is not None and abs(light - previous.light()[0]) < tolerance * light_sigma:
            break
    return wings
