"""Light of stars beyond the stamps of a model, and the sky that is left without it.

The model knows the light of a star in its stamp, above what is there in a ring around it. The rest
is one profile for all stars: a star of flux F has

    F s (p_0 h_0 + Σ_k p_k h_k(r))

more in a pixel, with h_0 = 1 in its stamp and 0 elsewhere, tents h_k in ln r times a power of r
outside of the stamp, r the distance from its centre, and s the light of the model's PSF in the
outer part of its stamp over the mean of all stars: where the PSF is wider, it has more wings.
All pixels of the image together give p by weighted least squares, beside what is expected of p
before: that the light falls on outside of the stamp about as that of other telescopes does. Bright
stars say more than that, and few faint ones hardly anything.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from psfdae.image.detection import Sky, sky_of
from psfdae.image.sky_level import sky_level

if TYPE_CHECKING:
    from psfdae.image.fits_file import Card
    from psfdae.image.observation import Observation
    from psfdae.model.field_psfs import FieldPsfs
    from psfdae.model.psf_model import PsfModel

FOLLOWED = 0.03  # part of a star's light in a pixel by which its PSF may be off
ROUND = 0.3  # the same of wings, which are round here, and are not there
OUTER, OUTER_RANGE = 0.7, (0.3, 3.0)  # radius of a stamp's outer part over half its side; s
REACH, TENTS, STEEPNESS = 2.5, 6, 3.0  # radius of the wings in stamps; tents; power of 1/r in them
WINGED, BAND_PX = 1000, 128  # brightest stars, whose wings are drawn; rows at a time
CLIPPED_SIGMA = 4.0  # of a pixel from the wings known so far, from which it is left out
MOST_LIGHT, MOST_RADIUS_PX = 10.0, 1e5  # of wings over the flux in the stamp; no nonsense
ROUNDS, SAME = 8, 0.1  # of wings and sky, at most; change of the light in σ with which they end
PSFS_AT_ONCE = 2048


@dataclass(frozen=True)
class Wings:
    """Light of stars beyond what their model knows.

    Attributes
    ----------
    radius_px : ndarray, shape (K,)
        Tops of the tents h_1 …, the first one at half the side of the stamp; at the last radius
        there is no light any more.
    profile : ndarray, shape (K,)
        p_k, per pixel.
    covariance : ndarray, shape (K, K)
        Of p_k.
    outer : float
        Mean light of the model's PSFs in the outer part of their stamps.
    """

    radius_px: np.ndarray
    profile: np.ndarray
    covariance: np.ndarray
    outer: float

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> Self:
        """Inverse of `plain`.

        Raises
        ------
        ValueError
            If it is damaged.
        """
        names = ("radius_px", "profile", "covariance")
        try:
            arrays = {name: np.array(plain[name], dtype=np.float64) for name in names}
            wings = cls(**arrays, outer=float(plain["outer"]))
        except (TypeError, LookupError, ArithmeticError) as error:
            raise ValueError(f"wings without {error}") from None
        radius, count = wings.radius_px, wings.profile.size
        shapes = [a.shape for a in (wings.profile, radius, wings.covariance)]
        if count < 2 or shapes != [(count,), (count,), (count, count)]:
            raise ValueError("wings whose numbers do not fit together")
        rising = radius[0] > 0 and (np.diff(radius) > 0).all() and radius[-1] < MOST_RADIUS_PX
        with np.errstate(all="ignore"):
            light, doubt = wings.light() if rising else (np.nan, np.nan)
        scale = 0.0 < wings.outer < np.inf
        if not (scale and abs(light) < MOST_LIGHT and np.isfinite(doubt)):
            raise ValueError("wings whose light is no part of that of a star")
        return wings

    def plain(self) -> dict[str, Any]:
        """Lists and numbers, for a bundle."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}

    def scale(self, outer: np.ndarray) -> np.ndarray:
        """s of stars by their `outer_light` (n,), 1 where that is NaN, of an unknown place."""
        ratio = np.where(np.isfinite(outer), outer / self.outer, 1.0)
        return np.asarray(np.clip(ratio, *OUTER_RANGE))

    def total(self, outer: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flux over that of the model of stars by their `outer_light`, and its error, (n,) both.

        How the wings change with the PSF is known to half of the change.
        """
        scale = self.scale(outer)
        light, error = self.light()
        return 1.0 + scale * light, np.hypot(scale * error, 0.5 * (scale - 1.0) * light)

    def light(self, radius_px: float = np.inf) -> tuple[float, float]:
        """Part of the flux within a radius, where s = 1, and its standard error."""
        half = self.radius_px[0]
        r = np.linspace(0.0, min(radius_px, self.radius_px[-1]), 4001)
        # Part of a circle outside of the square of side 2 half, the stamp: 4/π arccos(half/r) ≤ 1.
        outside = np.clip(np.arccos(np.minimum(half / np.maximum(r, half), 1.0)) * 4 / np.pi, 0, 1)
        height = np.concatenate([1.0 - outside[None], outside * tents(r, self.radius_px)])
        share = np.trapezoid(2 * np.pi * r * height, r, axis=1)
        return float(self.profile @ share), float(np.sqrt(share @ self.covariance @ share))

    def cards(self) -> list[Card]:
        """Return cards for a FITS header: radius of all light, and part of it in the stamp."""
        return [
            ("FLUXRAD", float(self.radius_px[-1]), "[pix] all light of a star is within it"),
            ("INMODEL", 1.0 / (1.0 + self.light()[0]), "part of it in the stamp, usual star"),
        ]

    def __str__(self) -> str:
        light, error = self.light()
        sentence = (
            f"{100 * light:.2f} ± {100 * error:.2f} % of the flux in the stamp of a usual star, "
            f"out to {self.radius_px[-1]:.3g} px"
        )
        if light / (1.0 + light) > 0.2:
            sentence += (
                "; over a fifth of the flux: try wider stamps (--stamp-px), or a list without "
            )
            sentence += "sources that are no stars"
        return sentence

    @classmethod
    def joined(cls, several: Sequence[Wings]) -> Wings:
        """Those of several images with one model, each by the inverse of its light's variance."""
        weight = np.array([wings.light()[1] ** -2.0 for wings in several])
        weight /= weight.sum()
        outer = float(weight @ [wings.outer for wings in several])
        share = weight * [outer / wings.outer for wings in several]
        profile = np.tensordot(share, [wings.profile for wings in several], 1)
        covariance = np.tensordot(share**2, [wings.covariance for wings in several], 1)
        return cls(several[0].radius_px, profile, covariance, outer)

    @property
    def seen(self) -> bool:
        """The pixels of the image say something of the light: its error is less than expected."""
        sigma = expected_profile(self.radius_px, self.outer)[1]
        return self.light()[1] < replace(self, covariance=np.diag(sigma**2)).light()[1]


def aperture_correction(
    model: FieldPsfs, wings: Wings | None, x: float, y: float, radius_px: float
) -> float:
    """Flux of a star at a place over what an aperture of a radius about it gets.

    The aperture has parts of the pixels at its edge, as photutils' `CircularAperture`.

    Raises
    ------
    ValueError
        If the radius is not above 0, or beyond the wings, or half the stamp without wings.
    """
    from photutils.aperture import CircularAperture

    radius_max = model.stamp_px / 2 if wings is None else float(wings.radius_px[-1])
    if not 0 < radius_px <= radius_max:
        raise ValueError(f"radius {radius_px} px, expected above 0 up to {radius_max:g}")
    psf = model.psf_at(x, y, 1)
    middle = np.array([x, y]) - np.floor(np.array([x, y]) + 0.5) + psf.shape[0] // 2
    inside = float(CircularAperture(middle, radius_px).do_photometry(psf)[0][0])
    if wings is None:
        return 1.0 / inside
    scale = float(wings.scale(outer_light(model.on_pixels, np.array([[x, y]])))[0])
    all_wings, inner_wings = (scale * wings.light(r)[0] for r in (np.inf, radius_px))
    return (1.0 + all_wings) / (inside + inner_wings)


def outer_light(draw: Callable[[np.ndarray], np.ndarray], place: np.ndarray) -> np.ndarray:
    """Light of PSFs at places (n, 2), x and y, in the outer part of their stamps, shape (n,).

    `draw` makes PSFs (m, d, d) at m places, which are finite. NaN where a place is not known.
    """
    outer_parts = np.full(len(place), np.nan)
    located = np.flatnonzero(np.isfinite(place).all(axis=1))
    for part in (located[a : a + PSFS_AT_ONCE] for a in range(0, len(located), PSFS_AT_ONCE)):
        psf = draw(np.rint(place[part]))
        side = psf.shape[-1]
        axis = np.arange(side) - side // 2
        ring = np.hypot(axis[:, None], axis)
        outer_parts[part] = psf[:, (ring >= OUTER * side / 2) & (ring < side / 2)].sum(axis=1)
    return outer_parts


def tents(r: np.ndarray, radius_px: np.ndarray) -> np.ndarray:
    """h_1 … at distances r, shape (K − 1, …), as they are outside of the stamp."""
    # ln of r over the first top; tops are equidistant in it.
    radius = radius_px.astype(r.dtype)
    log_radius = np.log(np.maximum(r / radius[0], 1.0))
    top = np.arange(len(radius) - 1, dtype=r.dtype).reshape(-1, *[1] * r.ndim)
    off = np.abs(log_radius / np.log(radius[1] / radius[0]) - top)
    return np.asarray(np.maximum(1.0 - off, 0.0) * np.exp(-STEEPNESS * log_radius))


def star_tents(
    rows: slice, width: int, place: np.ndarray, flux: np.ndarray, outer: np.ndarray, wings: Wings
) -> Iterator[tuple[tuple[slice, slice], np.ndarray]]:
    """Windows about the brightest stars within some rows, and F s h_k there, shape (K, …)."""
    reach, radius = int(wings.radius_px[-1]), wings.radius_px
    light = np.where(np.isfinite(outer), flux * wings.scale(outer), np.nan)
    shining = np.flatnonzero(np.isfinite(light) & (light > 0) & np.isfinite(place).all(axis=1))
    brightest = shining[np.argsort(-light[shining])[:WINGED]]
    # The pixels within reach, as far as they are in these rows.
    middle = np.rint(place[brightest]).astype(int)
    low = np.maximum(middle - reach, [0, rows.start])
    high = np.minimum(middle + reach + 1, [width, rows.stop])
    for inside in np.flatnonzero((low < high).all(axis=1)):
        star, (first_column, first_row), (last_column, last_row) = (
            brightest[inside],
            low[inside],
            high[inside],
        )
        across, down = (
            (np.arange(*ends) - at).astype(np.float32)
            for ends, at in zip(
                ((first_column, last_column), (first_row, last_row)), place[star], strict=True
            )
        )
        distance = np.sqrt(np.square(down)[:, None] + np.square(across))
        stamp = np.maximum(np.abs(down)[:, None], np.abs(across)) < radius[0]
        shape = np.concatenate([stamp[None], np.where(stamp, 0.0, tents(distance, radius))])
        window = (
            slice(first_row - rows.start, last_row - rows.start),
            slice(first_column, last_column),
        )
        yield window, float(light[star]) * shape


def tented_light(
    shape: tuple[int, ...], place: np.ndarray, flux: np.ndarray, outer: np.ndarray, wings: Wings
) -> Iterator[tuple[slice, np.ndarray]]:
    """Bands of rows, and Σ F s h_k of the stars in them, shape (K, rows, w)."""
    height, width = shape
    for top in range(0, height, BAND_PX):
        rows = slice(top, min(top + BAND_PX, height))
        tented = np.zeros((len(wings.profile), rows.stop - top, width), np.float32)
        for window, light in star_tents(rows, width, place, flux, outer, wings):
            tented[:, *window] += light
        yield rows, tented


def wing_light(
    shape: tuple[int, ...],
    place: np.ndarray,
    flux: np.ndarray,
    outer: np.ndarray,
    wings: Wings | None,
) -> np.ndarray:
    """Light of the wings of stars in an image (h, w)."""
    image = np.zeros(shape, np.float32)
    if wings is not None:
        for window, light in star_tents(slice(0, shape[0]), shape[1], place, flux, outer, wings):
            image[window] += np.tensordot(wings.profile, light, 1)
    return image


def expected_profile(radius_px: np.ndarray, outer: float) -> tuple[np.ndarray, np.ndarray]:
    """Return what is expected of p before any pixel outside of stamps is seen, and its σ, (K,).

    Outside of a stamp of the half side h, the light falls on as a (r/h)^-5, the mean slope of
    Moffat profiles there (Moffat 1969, A&A 3, 455), where a follows from the light `outer` between
    0.7 h and h. It may be more by half of what falls as r^-3, as light that mirrors and air scatter
    does (King 1971, PASP 83, 199), or less, and has an error of 0.1 % of the star at least.
    """
    half = radius_px[0]
    # ∫ 2π r (r/h)^-5 dr from 0.7 h to h is 2π h² (0.7^-3 − 1)/3.
    edge = max(outer, 0.0) * 3.0 / (2.0 * np.pi * half**2 * (OUTER**-3.0 - 1.0))
    # In the stamp, what the ring around it has was taken for sky: the light at 1.5 h.
    expected = edge * np.append(1.5**-5.0, (radius_px[:-1] / half) ** (STEEPNESS - 5.0))
    sigma = np.hypot(np.full(len(radius_px), 0.5 * edge), 1e-3 / (2.0 * np.pi * half**2))
    # The model may have 1.5 % too much or too little light in its stamp.
    sigma[0] = 0.015 / (2.0 * half) ** 2
    return expected, sigma


def wings_of(
    residual: np.ndarray,
    error: np.ndarray,
    bad: np.ndarray,
    place: np.ndarray,
    flux: np.ndarray,
    outer: np.ndarray,
    stamp_px: int,
    earlier: Wings | None = None,
) -> Wings | None:
    """Wings of stars in what is left of an image (h, w) without sky and models; None without stars.

    An even light that was left beside them, such as a wrong sky, does not count. Nor do pixels that
    are far from the wings of an `earlier` turn.
    """
    from scipy.ndimage import uniform_filter

    radius = np.geomspace(stamp_px / 2, REACH * stamp_px, TENTS + 1)
    lit = np.isfinite(flux) & (flux > 0)
    lit &= np.isfinite(outer)
    if not lit.any() or not (mean := float(np.average(outer[lit], weights=flux[lit]))) > 0:
        return None
    count = len(radius)
    blank = Wings(radius, np.zeros(count), np.zeros((count, count)), mean)
    normal, projection, square, pixels = np.zeros((count + 1,) * 2), np.zeros(count + 1), 0.0, 0
    blocks = []
    # Within a stamp all pixels count alike: then p_0 is the mean of what the model leaves there,
    # and p_0 times the area of the stamp the light that it lacks, as an aperture would find it.
    unit_sigma = float(error.mean(dtype=np.float64))  # no square of a pixel's unit may overflow
    even_error = uniform_filter(np.square(error / unit_sigma), stamp_px, mode="nearest")
    even_error = unit_sigma * np.sqrt(even_error)
    for band, tented in tented_light(residual.shape, place, flux, outer, blank):
        used = ~bad[band]
        if earlier is not None:
            off = residual[band] - np.tensordot(earlier.profile, tented, 1)
            used &= np.abs(off) < CLIPPED_SIGMA * error[band]
        weight = np.where(used, 1.0 / even_error[band].astype(np.float64), 0.0)
        design = np.concatenate([tented, np.full((1, *weight.shape), unit_sigma)]) * weight
        flat, data = design.reshape(count + 1, -1), (residual[band] * weight).ravel()
        normal, projection = normal + flat @ flat.T, projection + flat @ data
        square, pixels = square + float(data @ data), pixels + int(np.count_nonzero(weight))
        summands = np.concatenate([design, [residual[band] * weight, weight > 0]])
        blocks.append(block_sums(summands, stamp_px).reshape(len(summands), -1))
    if not normal[-1, -1] > 0:
        return None
    *block_design, block_light, block_pixels = np.concatenate(blocks, axis=1)
    # Generalised least squares of p and of the even light, of which nothing is expected, in units
    # of the σ that are expected: (N/χ² + 1) x = b/χ² + μ, χ² at least 1 and that of the pixels, or
    # of sums over blocks of a stamp: a sky that is not even, and stars and galaxies that nobody
    # sees, are residuals that neighbouring pixels share, and wings are as wide as these.
    expected, sigma = expected_profile(radius, mean)
    unit = np.append(sigma, normal[-1, -1] ** -0.5)
    normal, projection = normal * unit * unit[:, None], projection * unit
    prior, start = np.diag(np.append(np.ones(count), 0.0)), np.append(expected / sigma, 0.0)
    chi2 = 1.0
    for _ in range(3):
        inverse = np.linalg.inv(normal / chi2 + prior)
        parameters = inverse @ (projection / chi2 + start)
        of_pixels = (
            square - 2.0 * parameters @ projection + parameters @ normal @ parameters
        ) / max(pixels, 1)
        shared = block_light - (parameters * unit) @ np.array(block_design)
        chi2 = max(of_pixels, float(shared @ shared) / max(block_pixels.sum(), 1.0), 1.0)
    parameters, inverse = parameters * unit, inverse * unit * unit[:, None]
    return Wings(radius, parameters[:-1], inverse[:-1, :-1], mean)


def block_sums(values: np.ndarray, side: int) -> np.ndarray:
    """Return sums over blocks of side × side pixels of the last two axes of an array.

    Blocks at the lower and right edges may be smaller.
    """
    for axis in (-2, -1):
        values = np.add.reduceat(values, range(0, values.shape[axis], side), axis=axis)
    return values


class StarSurroundings(NamedTuple):
    """Sky, light of wings (h, w) and wings of an image beside the models of its stars."""

    sky: Sky
    wing_light: np.ndarray
    wings: Wings | None
    sigma: np.ndarray  # σ of every pixel without models and wings, with what these may be off by


def around_stars(
    image: np.ndarray,
    sky: Sky,
    error: np.ndarray,
    star_light: np.ndarray,
    place: np.ndarray,
    flux: np.ndarray,
    outer: np.ndarray,
    stamp_px: int,
    earlier: Wings | None = None,
) -> StarSurroundings:
    """Return wings and sky of an image (h, w), found by turns beside the models of its stars.

    A map of the sky takes wings that are wider than its meshes for sky, until these are known.

    Parameters
    ----------
    image, error, star_light : ndarray, shape (h, w)
        Sky included, σ of its pixels, and light of the stars.
    sky : Sky
        As it is known so far; its `bad` pixels do not count.
    place, flux, outer : ndarray, shape (n, 2) and (n,)
        Of the stars, and their `outer_light`.
    stamp_px : int
    earlier : Wings, optional
    """
    sigma = np.hypot(error, FOLLOWED * star_light)
    without_stars, stars = image - star_light, (place, flux, outer)
    wings = _wings_beside(without_stars, sky, sigma, *stars, stamp_px, earlier)
    light_of_wings = wing_light(image.shape, *stars, wings)
    mapped = np.isfinite(sky.noise_scale)
    sky = sky_of(without_stars - light_of_wings, sky.bad, sky.noise if mapped else None)
    # The map has the most frequent value of the pixels, which is below the mean where noise is that
    # of photons, and where stars are too faint to be seen: both are in the pixels of stars, too.
    deviation = (without_stars - sky.level - light_of_wings) / sigma
    clipped = sky.bad | (np.abs(deviation) > CLIPPED_SIGMA)
    # Σ (d/σ)/σ over Σ 1/σ², in units of the mean σ.
    unit_sigma = float(sigma.mean(dtype=np.float64))
    weight = np.where(clipped, 0.0, unit_sigma / sigma)
    deviation *= weight
    weight *= weight
    total_weight = max(float(weight.sum(dtype=np.float64)), np.finfo(float).tiny)
    even_light = unit_sigma * float(deviation.sum(dtype=np.float64)) / total_weight
    sky = replace(sky, level=sky.level + even_light, flat=sky.flat - even_light)
    return StarSurroundings(sky, light_of_wings, wings, np.hypot(sigma, ROUND * light_of_wings))


def _wings_beside(
    without_stars: np.ndarray,
    sky: Sky,
    doubt: np.ndarray,
    place: np.ndarray,
    flux: np.ndarray,
    outer: np.ndarray,
    stamp_px: int,
    earlier: Wings | None = None,
) -> Wings | None:
    """Wings of stars in an image (h, w) without its models, in turns with the level of its sky."""
    wings, level, bad = earlier, sky.level, sky.bad
    shown = np.where(_like_stars(without_stars - level, doubt, bad, place), flux, np.nan)
    for turn in range(ROUNDS):
        latest = wings
        if turn:
            without_light = without_stars - wing_light(bad.shape, place, flux, outer, latest)
            without_light[bad] = 0.0
            level = sky_level(without_light, bad, sky.steps).level
        wings = wings_of(without_stars - level, doubt, bad, place, shown, outer, stamp_px, latest)
        if wings is None:
            break
        light, sigma = wings.light()
        if latest is not None and abs(light - latest.light()[0]) < SAME * sigma:
            break
    return wings


def _like_stars(
    residual: np.ndarray, sigma: np.ndarray, bad: np.ndarray, place: np.ndarray
) -> np.ndarray:
    """Return True for the sources (n,) whose light about them may say what wings of stars are.

    The residuals (h, w) in 5 × 5 px about them are within twice their σ, which has what the PSF may
    be off by, and most of these pixels are good. Galaxies, blends and saturated stars are not.
    """
    from scipy.ndimage import uniform_filter

    deviation = np.where(bad, 0.0, residual / sigma).astype(np.float32)
    squares = uniform_filter(np.square(deviation), 5, mode="constant")
    part_good = uniform_filter((~bad).astype(np.float32), 5, mode="constant")
    height, width = bad.shape
    column, row = np.rint(np.nan_to_num(place, nan=-9.0)).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = np.where(inside, row, 0), np.where(inside, column, 0)
    return np.asarray(inside & (part_good[at] > 0.5) & (squares[at] < 4.0 * part_good[at]))


def wings_of_stars(model: PsfModel, observation: Observation) -> Wings | None:
    """Wings of the stars of an image, restored one by one; None if there is no light at all.

    In a crowded image, where stars restored alone lack light, they come out too large.

    Raises
    ------
    ObservationError
        If there is no sky to measure.
    """
    sky, side = observation.sky(), model.stamp_px
    middles, fluxes, outers = [], [], []
    # With the room of a stamp on all sides, for those that reach beyond the image.
    star_light = np.zeros(np.add(sky.flat.shape, 2 * side), np.float32)
    for stamps, prediction in model.stream(observation, threads=1):
        place = np.stack([stamps.x, stamps.y], axis=1)
        shift = np.stack([prediction.shift_x, prediction.shift_y], axis=1)
        corner = np.floor(np.nan_to_num(place) + 0.5).astype(int) + shift + side - side // 2
        is_restored = np.isfinite(place).all(axis=1) & np.isfinite(prediction.psf).all(axis=(1, 2))
        for x, y, psf in zip(*corner[is_restored].T, prediction.psf[is_restored], strict=True):
            stamp = np.s_[y : y + side, x : x + side]
            if min(x, y) >= 0 and star_light[stamp].shape == psf.shape:
                star_light[stamp] += psf
        outers.append(outer_light(model.on_pixels, place))
        # Wings begin where the stamps end: they are those about the middles of the stamps.
        middles.append(np.where(is_restored[:, None], corner - side + 0.5 * (side - 1), np.nan))
        fluxes.append(np.where(is_restored, prediction.flux, np.nan))
    core = np.s_[side:-side, side:-side]
    light, gain = star_light[core], observation.gain
    middle, flux, outer = (np.concatenate(values) for values in (middles, fluxes, outers))
    # σ² = sky noise² + photons of the stars + (3 % of their light)².
    photon_sigma = np.sqrt(np.maximum(light, 0.0) / gain) if gain else 0.0
    sigma = np.hypot(np.hypot(sky.noise, photon_sigma), FOLLOWED * light)
    without_stars = sky.flat + sky.level - light
    return _wings_beside(without_stars, sky, sigma, middle, flux, outer, side)
