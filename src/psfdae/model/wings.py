"""Light of stars beyond the stamps of a model, and the sky that is left without it.

The model knows the light of a star in its stamp, above what is there in a ring around it. The rest
is one profile for all stars: a star of flux F at distance r from its centre has

    F s Σ_k p_k h_k(r)

more in a pixel, with tents h_k in ln r times a power of r, the first one even inside the stamp,
and s the light of the model's PSF in the outer part of its stamp over the mean of all stars:
where the PSF is wider, it has more wings. All pixels of the image together give p_k by weighted
least squares.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from psfdae.image.detection import Sky, sky_level, sky_of

if TYPE_CHECKING:
    from psfdae.image.fits_file import Card
    from psfdae.image.observation import Observation
    from psfdae.model.field_psfs import FieldPsfs
    from psfdae.model.psf_model import PsfModel

FOLLOWED = 0.03  # part of a star's light in a pixel by which its PSF may be off
OUTER, OUTER_RANGE = 0.7, (0.3, 3.0)  # radius of a stamp's outer part over half its side; s
REACH, TENTS, STEEPNESS = 2.5, 6, 3.0  # radius of the wings in stamps; tents; power of 1/r in them
WINGED, BAND_PX = 1000, 128  # brightest stars, whose wings are drawn; rows at a time
CLIPPED_SIGMA = 4.0  # of a pixel from the wings known so far, from which it is left out
LEAST_SEEN = 3.0  # σ, from which wings are real
MOST_LIGHT, MOST_RADIUS_PX = 10.0, 1e5  # of wings over the flux in the stamp; no nonsense
ROUNDS = 3  # of wings and sky
PSFS_AT_ONCE = 2048


@dataclass(frozen=True)
class Wings:
    """Light of stars beyond what their model knows.

    Attributes
    ----------
    radius_px : ndarray, shape (K + 1,)
        Tops of the tents h_k; at the last radius there is no light any more.
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
        """From what `plain` gave.

        Raises
        ------
        ValueError
            If it is damaged.
        """
        names = ("radius_px", "profile", "covariance")
        try:
            arrays = {name: np.array(plain[name], dtype=np.float64) for name in names}
            found = cls(**arrays, outer=float(plain["outer"]))
        except (TypeError, LookupError, ArithmeticError) as error:
            raise ValueError(f"wings without {error}") from None
        radius, count = found.radius_px, found.profile.size
        shapes = [a.shape for a in (found.profile, radius, found.covariance)]
        if shapes != [(count,), (count + 1,), (count, count)]:
            raise ValueError("wings whose numbers do not fit together")
        rising = radius[0] > 0 and (np.diff(radius) > 0).all() and radius[-1] < MOST_RADIUS_PX
        with np.errstate(all="ignore"):
            light, doubt = found.light() if rising else (np.nan, np.nan)
        scale = 0.0 < found.outer < np.inf
        if not (scale and 0.0 <= light < MOST_LIGHT and np.isfinite(doubt)):
            raise ValueError("wings whose light is no part of that of a star")
        return found

    def plain(self) -> dict[str, Any]:
        """Lists and numbers, for a bundle."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}

    def total(self, outer: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flux over that of the model of stars by their `outer_light`, and its error, (n,) both.

        NaN, of stars whose place is not known, counts as a usual star.
        """
        scale = np.clip(np.where(np.isfinite(outer), outer / self.outer, 1.0), *OUTER_RANGE)
        light, error = self.light()
        return 1.0 + scale * light, scale * error

    def light(self, radius_px: float = np.inf) -> tuple[float, float]:
        """Part of the flux within a radius, where s = 1, and its standard error."""
        r = np.linspace(0.0, min(radius_px, self.radius_px[-1]), 4001)
        share = np.trapezoid(2 * np.pi * r * tents(r, self.radius_px), r, axis=1)
        return float(self.profile @ share), float(np.sqrt(share @ self.covariance @ share))

    def cards(self) -> list[Card]:
        """What a FITS header says of them."""
        return [
            ("FLUXRAD", float(self.radius_px[-1]), "[pix] all light of a star is within it"),
            ("INMODEL", 1.0 / (1.0 + self.light()[0]), "part of it in the stamp, usual star"),
        ]

    def __str__(self) -> str:
        light, error = self.light()
        said = (
            f"{100 * light:.2f} ± {100 * error:.2f} % of the flux in the stamp of a usual star, "
            f"out to {self.radius_px[-1]:.3g} px"
        )
        if light / (1.0 + light) > 0.2:
            said += "; over a fifth of the flux: try wider stamps (--stamp-px), or a list without "
            said += "sources that are no stars"
        return said

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
        """The light is no chance."""
        light, error = self.light()
        return light > LEAST_SEEN * error


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

    most = model.stamp_px / 2 if wings is None else float(wings.radius_px[-1])
    if not 0 < radius_px <= most:
        raise ValueError(f"radius {radius_px} px, expected above 0 up to {most:g}")
    psf = model.psf_at(x, y, 1)
    middle = np.array([x, y]) - np.floor(np.array([x, y]) + 0.5) + psf.shape[0] // 2
    inside = float(CircularAperture(middle, radius_px).do_photometry(psf)[0][0])
    if wings is None:
        return 1.0 / inside
    total = float(wings.total(outer_light(model.on_pixels, np.array([[x, y]])))[0][0])
    whole, part = (wings.light(r)[0] for r in (np.inf, radius_px))
    return total / (inside + (total - 1.0) * part / whole)


def outer_light(draw: Callable[[np.ndarray], np.ndarray], place: np.ndarray) -> np.ndarray:
    """Light of PSFs at places (n, 2), x and y, in the outer part of their stamps, shape (n,).

    `draw` makes PSFs (m, d, d) at m places, which are finite. NaN where a place is not known.
    """
    found = np.full(len(place), np.nan)
    known = np.flatnonzero(np.isfinite(place).all(axis=1))
    for part in (known[a : a + PSFS_AT_ONCE] for a in range(0, len(known), PSFS_AT_ONCE)):
        psf = draw(np.rint(place[part]))
        side = psf.shape[-1]
        axis = np.arange(side) - side // 2
        ring = np.hypot(axis[:, None], axis)
        found[part] = psf[:, (ring >= OUTER * side / 2) & (ring < side / 2)].sum(axis=1)
    return found


def tents(r: np.ndarray, radius_px: np.ndarray) -> np.ndarray:
    """h_k at distances r, shape (K, …)."""
    # ln of r over the first top, where even light ends; tops are equidistant in it.
    radius = radius_px.astype(r.dtype)
    beyond = np.log(np.maximum(r / radius[0], 1.0))
    top = np.arange(len(radius) - 1, dtype=r.dtype).reshape(-1, *[1] * r.ndim)
    off = np.abs(beyond / np.log(radius[1] / radius[0]) - top)
    return np.asarray(np.maximum(1.0 - off, 0.0) * np.exp(-STEEPNESS * beyond))


def star_tents(
    rows: slice, width: int, place: np.ndarray, flux: np.ndarray, outer: np.ndarray, wings: Wings
) -> Iterator[tuple[tuple[slice, slice], np.ndarray]]:
    """Windows about the brightest stars within some rows, and F s h_k there, shape (K, …)."""
    reach, radius = int(wings.radius_px[-1]), wings.radius_px
    light = flux * np.clip(outer / wings.outer, *OUTER_RANGE)
    known = np.flatnonzero(np.isfinite(light) & (light > 0) & np.isfinite(place).all(axis=1))
    brightest = known[np.argsort(-light[known])[:WINGED]]
    # The pixels within reach, as far as they are in these rows.
    middle = np.rint(place[brightest]).astype(int)
    low = np.maximum(middle - reach, [0, rows.start])
    high = np.minimum(middle + reach + 1, [width, rows.stop])
    for inside in np.flatnonzero((low < high).all(axis=1)):
        star, (left, top), (right, end) = brightest[inside], low[inside], high[inside]
        across, down = (
            np.square(np.arange(*ends) - at).astype(np.float32)
            for ends, at in zip(((left, right), (top, end)), place[star], strict=True)
        )
        window = slice(top - rows.start, end - rows.start), slice(left, right)
        yield window, float(light[star]) * tents(np.sqrt(down[:, None] + across), radius)


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
    """Light of the wings of stars in an image (h, w); none if they are not seen."""
    far = np.zeros(shape, np.float32)
    if wings is not None and wings.seen:
        for window, light in star_tents(slice(0, shape[0]), shape[1], place, flux, outer, wings):
            far[window] += np.tensordot(wings.profile, light, 1)
    return far


def wings_of(
    left: np.ndarray,
    error: np.ndarray,
    bad: np.ndarray,
    place: np.ndarray,
    flux: np.ndarray,
    outer: np.ndarray,
    stamp_px: int,
    before: Wings | None = None,
) -> Wings | None:
    """Wings of stars in what is left of an image (h, w) without sky and models; None without light.

    An even light that was left beside them, such as a wrong sky, does not count. Nor do pixels that
    are far from the wings as they were known `before`.
    """
    from scipy.optimize import lsq_linear

    radius = np.geomspace(stamp_px / 2, REACH * stamp_px, TENTS + 1)
    lit = np.isfinite(flux) & (flux > 0)
    lit &= np.isfinite(outer)
    if not lit.any() or not (mean := float(np.average(outer[lit], weights=flux[lit]))) > 0:
        return None
    blank = Wings(radius, np.zeros(TENTS), np.zeros((TENTS, TENTS)), mean)
    normal, right, square, count = np.zeros((TENTS + 1,) * 2), np.zeros(TENTS + 1), 0.0, 0
    for band, tented in tented_light(left.shape, place, flux, outer, blank):
        weight = np.where(bad[band], 0.0, 1.0 / error[band])
        if before is not None:
            off = (left[band] - np.tensordot(before.profile, tented, 1)) * weight
            weight = np.where(np.abs(off) < CLIPPED_SIGMA, weight, 0.0)
        design = np.concatenate([tented, np.ones((1, *weight.shape))]) * weight
        flat, seen = design.reshape(TENTS + 1, -1), (left[band] * weight).ravel()
        normal, right = normal + flat @ flat.T, right + flat @ seen
        square, count = square + float(seen @ seen), count + int(np.count_nonzero(weight))
    unit = np.sqrt(normal.diagonal())
    if not (unit > 0).all():
        return None
    root = np.linalg.cholesky(normal / unit / unit[:, None] + 1e-12 * np.eye(TENTS + 1))
    wanted, bounds = np.linalg.solve(root, right / unit), np.array([0.0] * TENTS + [-np.inf])
    fit = lsq_linear(root.T, wanted, (bounds, np.inf))
    found = fit.x / unit
    # In Σ (seen − design found)², the part that no profile explains is what remains of Σ seen².
    chi2 = (square - wanted @ wanted + 2.0 * fit.cost) / max(count, 1)
    inverse = np.linalg.inv(root @ root.T) / unit / unit[:, None] * max(chi2, 1.0)
    return Wings(radius, found[:-1], inverse[:-1, :-1], mean)


class Around(NamedTuple):
    """What is beside the models of stars in an image: sky, light of wings (h, w), and these."""

    sky: Sky
    far: np.ndarray
    wings: Wings | None
    doubt: np.ndarray  # of every pixel without models and wings


def around_stars(
    image: np.ndarray,
    sky: Sky,
    error: np.ndarray,
    drawn: np.ndarray,
    place: np.ndarray,
    flux: np.ndarray,
    outer: np.ndarray,
    stamp_px: int,
    before: Wings | None = None,
) -> Around:
    """Wings and sky of an image (h, w), by turns, where models of its stars are `drawn`.

    Parameters
    ----------
    image, error, drawn : ndarray, shape (h, w)
        Sky included, σ of its pixels, and light of the stars.
    sky : Sky
        As it is known so far; its `bad` pixels do not count.
    place, flux, outer : ndarray, shape (n, 2) and (n,)
        Of the stars, and their `outer_light`.
    stamp_px : int
    before : Wings, optional
    """
    doubt, beside, light = np.hypot(error, FOLLOWED * drawn), image - drawn, (place, flux, outer)
    wings = _wings_beside(beside, sky.level, doubt, sky.bad, *light, stamp_px, before)
    far = wing_light(image.shape, *light, wings)
    mapped = np.isfinite(sky.noise_scale)
    return Around(sky_of(beside - far, sky.bad, sky.noise if mapped else None), far, wings, doubt)


def _wings_beside(
    beside: np.ndarray,
    level: np.ndarray,
    doubt: np.ndarray,
    bad: np.ndarray,
    place: np.ndarray,
    flux: np.ndarray,
    outer: np.ndarray,
    stamp_px: int,
    before: Wings | None = None,
) -> Wings | None:
    """Wings of stars in an image (h, w) without its models, in turns with the level of its sky."""
    left, stars = beside - level, (place, flux, outer)
    wings = wings_of(left, doubt, bad, *stars, stamp_px, before)
    for _ in range(ROUNDS - 1):
        # The sky without the wings as known so far, and the wings above it; all in place.
        np.subtract(beside, wing_light(beside.shape, *stars, wings), out=left)
        np.subtract(beside, sky_level(left, bad), out=left)
        wings = wings_of(left, doubt, bad, *stars, stamp_px, wings)
    return wings


def wings_of_stars(model: PsfModel, observation: Observation) -> Wings | None:
    """Wings of the stars of an image, restored one by one; None if there is no light at all.

    In a crowded image, where stars restored alone lack light, they come out too large.

    Raises
    ------
    ObservationError
        If there is no sky to measure.
    """
    sky, side = observation.sky(), model.stamp_px
    places, fluxes = [], []
    # With the room of a stamp on all sides, for those that reach beyond the image.
    drawn = np.zeros(np.add(sky.flat.shape, 2 * side), np.float32)
    for stamps, found in model.stream(observation, threads=1):
        place = np.stack([stamps.x, stamps.y], axis=1)
        shift = np.stack([found.shift_x, found.shift_y], axis=1)
        corner = np.floor(np.nan_to_num(place) + 0.5).astype(int) + shift + side - side // 2
        known = np.isfinite(place).all(axis=1) & np.isfinite(found.psf).all(axis=(1, 2))
        for x, y, psf in zip(*corner[known].T, found.psf[known], strict=True):
            stamp = np.s_[y : y + side, x : x + side]
            if min(x, y) >= 0 and drawn[stamp].shape == psf.shape:
                drawn[stamp] += psf
        places.append(place)
        fluxes.append(np.where(known, found.flux, np.nan))
    light = drawn[side:-side, side:-side]
    place, flux, gain = np.concatenate(places), np.concatenate(fluxes), observation.gain
    photons = np.maximum(light, 0.0) / gain if gain else 0.0
    doubt = np.sqrt(sky.noise**2 + photons + (FOLLOWED * light) ** 2)
    outer = outer_light(model.on_pixels, place)
    # The image without its models, in their place in memory.
    beside = np.subtract(sky.flat + sky.level, light, out=light)
    return _wings_beside(beside, sky.level, doubt, sky.bad, place, flux, outer, side)
