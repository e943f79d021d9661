"""Photometry of all stars of an image, those that overlap together, with a model of its field.

photutils finds, groups and fits the stars (`PSFPhotometry`). What brighter stars hid is then found
where their models are subtracted, and all are fitted again, on a sky without the light of stars.
Stars that were hidden and have no flux of 3 σ are dropped, and the others fitted a last time.

The model knows the light of a star in its stamp, above what is there in a ring around it. The rest
is one profile for all stars: a star of flux F at distance r from its centre has

    F s Σ_k p_k h_k(r)

more in a pixel, with tents h_k in ln r times a power of r, the first one even inside the stamp,
and s the light of the model's PSF in the outer part of its stamp over the mean of all stars:
where the PSF is wider, it has more wings. All pixels of the image together give p_k by weighted
least squares.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from psfdae.image.detection import Sky, sky_of
from psfdae.image.observation import Observation

if TYPE_CHECKING:
    from astropy.table import Table

    from psfdae.model.field_psfs import FieldPsfs

ROUNDS, SKIES = 3, 3  # of fits, at most; of wings and sky in each
FIT_FWHM, GROUP_FWHM = 1.6, 2.4  # side of the pixels that are fitted; nearest of two groups
MOST_MOVED_FWHM, SAME_FWHM = 1.0, 0.5  # by a fit; nearer to each other, two stars are one
LARGEST_GROUP, CLOSER = 50, 0.8  # stars that are fitted together; a larger group is parted nearer
FOLLOWED = 0.03  # part of a star's light in a pixel by which its PSF may be off
OUTER, OUTER_RANGE = 0.7, (0.3, 3.0)  # radius of a stamp's outer part over half its side; s
REACH, TENTS, STEEPNESS = 2.5, 6, 3.0  # radius of the wings in stamps; tents; power of 1/r in them
WINGED, BAND_PX = 1000, 512  # brightest stars, whose wings are drawn; rows at a time
CLIPPED_SIGMA = 4.0  # of a pixel from the wings known so far, from which it is left out
LEAST_SEEN = 3.0  # σ, from which wings and hidden stars are real
NEAREST_PX = 0.1  # of stars in a group that is to be parted
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

    def light(self, radius_px: float = np.inf) -> tuple[float, float]:
        """Part of the flux within a radius, where s = 1, and its standard error."""
        r = np.linspace(0.0, min(radius_px, self.radius_px[-1]), 4001)
        share = np.trapezoid(2 * np.pi * r * tents(r, self.radius_px), r, axis=1)
        return float(self.profile @ share), float(np.sqrt(share @ self.covariance @ share))

    @property
    def seen(self) -> bool:
        """The light is no chance."""
        light, error = self.light()
        return light > LEAST_SEEN * error


@dataclass(frozen=True)
class CrowdedPhotometry:
    """Stars of an image, and what is left of the image without them.

    Attributes
    ----------
    model : FieldPsfs
    stars : Table
        A row for each: `id`, `x`, `y` (0-based pixels), `x_error`, `y_error`, `flux` (counts,
        wings included), `flux_error`, `flux_model` (without the wings), `group`, `group_size`,
        `parted` (the group was too large, and is a part of it), `chi2` (reduced, of the pixels of
        the fit), `flags` of photutils. Errors are √χ² times those of the noise where χ² > 1.
    residual, light : ndarray, shape (h, w)
        Image without sky and stars, and that of all stars, counts.
    wings : Wings or None
        None if no star is bright enough to show any.
    """

    model: FieldPsfs
    stars: Table
    residual: np.ndarray
    light: np.ndarray
    wings: Wings | None

    @property
    def radius_px(self) -> float:
        """Inside of which a flux is the light of its star; that of a stamp without wings."""
        half = self.model.stamp_px / 2
        return half if self.wings is None else float(self.wings.radius_px[-1])

    def total(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Flux over that of the model at places (n,), wings included."""
        if self.wings is None:
            return np.ones(len(x))
        scale = outer_light(self.model, np.stack([x, y], axis=1)) / self.wings.outer
        return 1.0 + np.clip(scale, *OUTER_RANGE) * self.wings.light()[0]

    def part_of_model(self) -> tuple[float, float]:
        """Part of a usual star's flux that the model knows, and its standard error."""
        light, error = (0.0, 0.0) if self.wings is None else self.wings.light()
        return 1.0 / (1.0 + light), error / (1.0 + light) ** 2

    def aperture_correction(self, x: float, y: float, radius_px: float) -> float:
        """Flux of a star at a place over what an aperture of a radius about it gets.

        The aperture has parts of the pixels at its edge, as photutils' `CircularAperture`.

        Raises
        ------
        ValueError
            If the radius is not above 0, or beyond `radius_px`.
        """
        from photutils.aperture import CircularAperture

        if not 0 < radius_px <= self.radius_px:
            raise ValueError(f"radius {radius_px} px, expected above 0 up to {self.radius_px:g}")
        psf = self.model.psf_at(x, y, 1)
        middle = np.array([x, y]) - np.floor(np.array([x, y]) + 0.5) + psf.shape[0] // 2
        inside = float(CircularAperture(middle, radius_px).do_photometry(psf)[0][0])
        total = float(self.total(np.array([x]), np.array([y]))[0])
        if self.wings is not None:
            whole, part = (self.wings.light(r)[0] for r in (np.inf, radius_px))
            inside += (total - 1.0) * part / whole
        return total / inside


def photometry(model: FieldPsfs, observation: Observation, threshold: float) -> CrowdedPhotometry:
    """Positions and fluxes of all stars of an image.

    Parameters
    ----------
    model : FieldPsfs
        That knows the PSF at every place of this image.
    observation : Observation
        The image with its stars. No others are looked for if they are those of a list.
    threshold : float
        Of hidden stars, in σ above the sky.

    Raises
    ------
    PredictionError
        If the model knows no PSF of a place.
    ObservationError
        If there is no sky to measure.
    """
    psf, fwhm, side = model.to_photutils(), model.fwhm_px(), model.stamp_px
    sky = observation.sky()
    mapped = np.isfinite(sky.noise_scale)
    image, bad = sky.flat + sky.level, sky.bad
    if observation.saturate is not None:
        bad = bad | (image >= observation.saturate)
    place, flux = np.array(observation.positions, dtype=np.float64), None
    light, far, wings = np.maximum(sky.flat, 0.0), np.zeros(image.shape), None
    for turn in range(ROUNDS):
        flat = image - sky.level - far
        error = np.sqrt(sky.noise**2 + (light / observation.gain if observation.gain else 0.0))
        table, drawn = _fitted(psf, fwhm, flat, error, bad, place, flux)
        fit = np.stack([table["x_fit"], table["y_fit"]], axis=1).astype(np.float64)
        place = np.where(np.isfinite(fit), fit, place)
        flux, flux_error = (np.array(table[c], dtype=np.float64) for c in ("flux_fit", "flux_err"))
        outer = outer_light(model, np.nan_to_num(place))
        for _ in range(SKIES):
            left, doubt = image - sky.level - drawn, np.hypot(error, FOLLOWED * drawn)
            wings = wings_of(left, doubt, bad, place, flux, outer, side, wings)
            far = np.zeros(image.shape)
            if wings is not None and wings.seen:
                for band, tented in _tented(image.shape, place, flux, outer, wings):
                    far[band] = np.tensordot(wings.profile, tented, 1)
            sky = sky_of(image - drawn - far, bad, sky.noise if mapped else None)
        # Noise in the weights would make fluxes too small: from now on they are of the models.
        light = np.maximum(drawn + far, 0.0)
        if turn == 0 and observation.found is not None:
            place, flux = _with_hidden(sky, doubt, place, flux, threshold, fwhm)
        elif turn > 0:
            real = flux > LEAST_SEEN * flux_error
            real[: observation.count] = True
            if real.all():
                break
            place, flux = place[real], flux[real]
    return _described(
        model, table, sky.flat, drawn + far, wings if wings is not None and wings.seen else None
    )


def _fitted(
    psf: object,
    fwhm: float,
    flat: np.ndarray,
    error: np.ndarray,
    bad: np.ndarray,
    place: np.ndarray,
    flux: np.ndarray | None,
) -> tuple[Table, np.ndarray]:
    """What photutils fits to stars at places (n, 2), x and y, and the image of their models."""
    from astropy.table import Table
    from photutils.psf import PSFPhotometry

    side = 2 * int(np.ceil(FIT_FWHM * fwhm / 2)) + 1
    start = Table({"id": np.arange(1, len(place) + 1), "x": place[:, 0], "y": place[:, 1]})
    start["group_id"], parted = groups_of(place, GROUP_FWHM * fwhm)
    if flux is not None:
        start["flux"] = np.where(np.isfinite(flux), flux, 0.0)
    bounds = MOST_MOVED_FWHM * fwhm
    fit = PSFPhotometry(
        psf, side, aperture_radius=fwhm, xy_bounds=bounds, group_warning_threshold=10**9
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = fit(flat, mask=bad, error=error, init_params=start)
        drawn = fit.make_model_image(flat.shape)
    found.sort("id")
    found["parted"] = parted
    return found, drawn


def groups_of(place: np.ndarray, distance_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Numbers from 1 of groups of stars at places (n, 2), and who was in a larger one, (n,).

    Chains of stars that are nearer to each other than a distance are a group; of more than
    `LARGEST_GROUP`, those that are nearer still.
    """
    from photutils.psf import SourceGrouper

    known = np.flatnonzero(np.isfinite(place).all(axis=1))
    group, todo = np.arange(1, len(place) + 1), [(known, distance_px)]
    parted = np.zeros(len(place), dtype=bool)
    while todo:
        stars, distance = todo.pop()
        if len(stars) < 2:
            continue
        label = np.asarray(SourceGrouper(distance)(*place[stars].T))
        if distance < NEAREST_PX:  # as good as one place
            label = np.arange(len(stars)) // LARGEST_GROUP
        for one in np.unique(label):
            members = stars[label == one]
            if len(members) > LARGEST_GROUP:
                parted[members] = True
                todo.append((members, CLOSER * distance))
            else:
                group[members] = members[0] + 1
    return group, parted


def _with_hidden(
    sky: Sky, error: np.ndarray, place: np.ndarray, flux: np.ndarray, threshold: float, fwhm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Places and fluxes with those of stars in what is left of an image with this error."""
    from scipy.spatial import cKDTree

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of photutils, if there is none
        left = Sky(sky.flat, sky.level, error, sky.bad, np.nan).stars(threshold)
    if not len(left["id"]):
        return place, flux
    new = np.stack([left["X_IMAGE"], left["Y_IMAGE"]], axis=1) - 1.0
    known = place[np.isfinite(place).all(axis=1)]
    alone = cKDTree(known).query(new)[0] > SAME_FWHM * fwhm
    return np.concatenate([place, new[alone]]), np.append(flux, left["FLUX_ISO"][alone])


def outer_light(model: FieldPsfs, place: np.ndarray) -> np.ndarray:
    """Light of the PSFs at places (n, 2) in the outer part of their stamps, shape (n,)."""
    side = model.stamp_px
    axis = np.arange(side) - side // 2
    ring = np.hypot(axis[:, None], axis)
    ring = (ring >= OUTER * side / 2) & (ring < side / 2)
    parts = [place[a : a + PSFS_AT_ONCE] for a in range(0, len(place), PSFS_AT_ONCE)]
    psfs = (model.psf_at(x, y, 1) for x, y in (np.rint(part).T for part in parts))
    return np.concatenate([some[:, ring].sum(axis=1) for some in psfs])


def tents(r: np.ndarray, radius_px: np.ndarray) -> np.ndarray:
    """h_k at distances r, shape (K, …)."""
    tops = np.log(radius_px)
    inside = np.maximum(r, radius_px[0])
    off = np.abs(np.log(inside) - tops[:-1].reshape(-1, *[1] * r.ndim)) / (tops[1] - tops[0])
    return np.asarray(np.maximum(1.0 - off, 0.0) * (inside / radius_px[0]) ** -STEEPNESS)


def _tented(
    shape: tuple[int, ...], place: np.ndarray, flux: np.ndarray, outer: np.ndarray, wings: Wings
) -> Iterator[tuple[slice, np.ndarray]]:
    """Bands of rows, and Σ F s h_k of the stars in them, shape (K, rows, w)."""
    reach, radius = int(wings.radius_px[-1]), wings.radius_px
    light = flux * np.clip(outer / wings.outer, *OUTER_RANGE)
    known = np.flatnonzero(np.isfinite(light) & (light > 0) & np.isfinite(place).all(axis=1))
    brightest = known[np.argsort(-light[known])[:WINGED]]
    height, width = shape
    for top in range(0, height, BAND_PX):
        rows = min(BAND_PX, height - top)
        tented = np.zeros((len(radius) - 1, rows, width))
        for star in brightest:
            x, y = place[star]
            first, last = (np.clip(round(y) + d - top, 0, rows) for d in (-reach, reach + 1))
            left, right = (np.clip(round(x) + d, 0, width) for d in (-reach, reach + 1))
            if first < last and left < right:
                r = np.hypot(np.arange(first, last)[:, None] + top - y, np.arange(left, right) - x)
                tented[:, first:last, left:right] += light[star] * tents(r, radius)
        yield slice(top, top + rows), tented


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
    if not lit.any() or not (mean := float(np.average(outer[lit], weights=flux[lit]))) > 0:
        return None
    blank = Wings(radius, np.zeros(TENTS), np.zeros((TENTS, TENTS)), mean)
    normal, right, square, count = np.zeros((TENTS + 1,) * 2), np.zeros(TENTS + 1), 0.0, 0
    for band, tented in _tented(left.shape, place, flux, outer, blank):
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


def _described(
    model: FieldPsfs, table: Table, left: np.ndarray, light: np.ndarray, wings: Wings | None
) -> CrowdedPhotometry:
    """The stars with the fluxes that they have with their wings."""
    from astropy.table import Table

    names = {"id": "id", "x_fit": "x", "y_fit": "y", "x_err": "x_error", "y_err": "y_error"}
    stars = Table({new: np.array(table[old]) for old, new in names.items()})
    found = CrowdedPhotometry(model, stars, left, light, wings)
    total = found.total(*(np.nan_to_num(np.array(stars[axis])) for axis in "xy"))
    stars["flux"], stars["flux_error"] = (table[c] * total for c in ("flux_fit", "flux_err"))
    # Light that no model explains, of the PSF's own errors or of stars that nobody sees, is as much
    # in the fluxes as in the residuals.
    chi2 = np.array(table["reduced_chi2"], dtype=np.float64)
    for name in ("x_error", "y_error", "flux_error"):
        stars[name] *= np.sqrt(np.fmax(chi2, 1.0))
    stars["flux_model"] = table["flux_fit"]
    stars["group"], stars["group_size"] = table["group_id"], table["group_size"]
    stars["parted"] = table["parted"]
    stars["chi2"], stars["flags"] = table["reduced_chi2"], table["flags"]
    return found
