"""Photometry of all stars of an image, those that overlap together, with a model of its field.

photutils finds, groups and fits the stars (`PSFPhotometry`). What brighter stars hid is then found
where their models are subtracted, and all are fitted again, on a sky without the light of stars.
Stars that were hidden and have no flux of 3 σ are dropped, and the others fitted a last time. The
light that a star has beyond its stamp is measured with them (`psfdae.model.wings`).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from psfdae.image.detection import Sky
from psfdae.image.observation import Observation
from psfdae.image.stamps import StarFlag, raise_flag
from psfdae.model.photometry import FAINT_SNR
from psfdae.model.wings import Wings, aperture_correction, around_stars, outer_light

if TYPE_CHECKING:
    from astropy.table import Table

    from psfdae.model.field_psfs import FieldPsfs

ROUNDS = 3  # of fits, at most
FIT_FWHM, GROUP_FWHM = 1.6, 2.4  # side of the pixels that are fitted; nearest of two groups
MOST_MOVED_FWHM, SAME_FWHM = 1.0, 0.5  # by a fit; nearer to each other, two stars are one
LARGEST_GROUP, CLOSER = 50, 0.8  # stars that are fitted together; a larger group is parted nearer
LEAST_SEEN = 3.0  # σ, from which hidden stars are real
NEAREST_PX = 0.1  # of stars in a group that is to be parted


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
        the fit), `flags` (`StarFlag`s), `photutils_flags`. Stars of a list have its `id` and come
        in its order. Errors are √χ² times those of the noise where χ² > 1;
        that of the flux has the model's, too (`FieldPsfs.flux_error`).
    residual, light : ndarray, shape (h, w)
        Image without sky and stars, and that of all stars, counts.
    wings : Wings or None
        Those of the model if no star is bright enough to show any.
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

    def part_of_model(self) -> tuple[float, float]:
        """Part of a usual star's flux that the model knows, and its standard error."""
        light, error = (0.0, 0.0) if self.wings is None else self.wings.light()
        return 1.0 / (1.0 + light), error / (1.0 + light) ** 2

    def aperture_correction(self, x: float, y: float, radius_px: float) -> float:
        """Flux of a star over what an aperture gets; see `psfdae.model.wings`."""
        return aperture_correction(self.model, self.wings, x, y, radius_px)


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
    image, bad = sky.flat + sky.level, sky.bad
    if observation.saturate is not None:
        bad = bad | (image >= observation.saturate)
        sky = replace(sky, bad=bad)
    place, flux = np.array(observation.positions, dtype=np.float64), None
    light, far, wings = np.maximum(sky.flat, 0.0), np.zeros(image.shape), None
    for turn in range(ROUNDS):
        flat = image - sky.level - far
        error = np.sqrt(sky.noise**2 + (light / observation.gain if observation.gain else 0.0))
        table, drawn = _fitted(psf, fwhm, flat, error, bad, place, flux)
        fit = np.stack([table["x_fit"], table["y_fit"]], axis=1).astype(np.float64)
        place = np.where(np.isfinite(fit), fit, place)
        flux, flux_error = (np.array(table[c], dtype=np.float64) for c in ("flux_fit", "flux_err"))
        outer = outer_light(model.on_pixels, place)
        sky, far, wings, doubt = around_stars(
            image, sky, error, drawn, place, flux, outer, side, wings
        )
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
    seen = wings if wings is not None and wings.seen else model.wings
    found = _described(model, table, sky.flat, drawn + far, seen)
    stars = found.stars
    # The error of the PSF is no noise, and is as large a part of each flux.
    stars["flux_error"] = np.hypot(stars["flux_error"], model.flux_error * stars["flux"])
    saturated = np.zeros(image.shape, dtype=bool)
    if observation.saturate is not None:
        saturated = image >= observation.saturate
    stars["flags"] = star_flags(table, stars, bad & ~saturated, saturated, _box(fwhm), fwhm)
    if observation.found is None:
        stars["id"] = observation.identifiers
        stars["flags"] |= observation.list_flags
    return found


def star_flags(
    table: Table,
    stars: Table,
    bad: np.ndarray,
    saturated: np.ndarray,
    side: int,
    fwhm: float,
) -> np.ndarray:
    """Flags (n,), uint16, of stars that were fitted in boxes of `side` pixels.

    Parameters
    ----------
    table, stars : Table
        What photutils says of the fits, and the stars as they are described.
    bad, saturated : ndarray of bool, shape (h, w)
        Pixels that were not fitted.
    side : int
    fwhm : float
        In pixels.
    """
    from scipy.ndimage import maximum_filter
    from scipy.spatial import cKDTree

    place = np.stack([stars["x"], stars["y"]], axis=1)
    seen = np.isfinite(place).all(axis=1)
    flags, photutils = np.zeros(len(stars), np.uint16), np.array(table["flags"])
    # Pixels of the box about each star.
    height, width = bad.shape
    column, row = np.rint(np.where(seen[:, None], place, -side)).astype(int).T
    half = side // 2
    edge = (column < half) | (row < half) | (column >= width - half) | (row >= height - half)
    at = np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
    for pixels, flag in ((bad, StarFlag.MASKED), (saturated, StarFlag.SATURATED)):
        raise_flag(flags, flag, seen & maximum_filter(pixels, side, mode="constant")[at])
    raise_flag(flags, StarFlag.TRUNCATED, edge & seen)
    # Flux, fit and neighbours.
    flux, error = np.array(stars["flux"]), np.array(stars["flux_error"])
    raise_flag(flags, StarFlag.NO_FLUX, ~np.isfinite(flux))
    raise_flag(flags, StarFlag.FAINT, flux < FAINT_SNR * error)
    # No convergence or no covariance; a place at its bound.
    raise_flag(flags, StarFlag.POOR_FIT, (np.array(stars["chi2"]) > 10.0) | (photutils & 24 > 0))
    raise_flag(flags, StarFlag.OFF_CENTRE, photutils & 32 > 0)
    known = np.flatnonzero(seen)
    near = cKDTree(place[known]).query_pairs(fwhm, output_type="ndarray")
    raise_flag(flags, StarFlag.BLENDED, known[near.ravel()])
    raise_flag(flags, StarFlag.BLENDED, np.array(stars["parted"], dtype=bool))
    return flags


def _box(fwhm: float) -> int:
    """Side of the pixels that are fitted to a star, odd."""
    return 2 * int(np.ceil(FIT_FWHM * fwhm / 2)) + 1


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

    side = _box(fwhm)
    start = Table({"id": np.arange(1, len(place) + 1), "x": place[:, 0], "y": place[:, 1]})
    start["group_id"], parted = groups_of(place, GROUP_FWHM * fwhm)
    if flux is not None:
        start["flux"] = np.where(np.isfinite(flux), flux, 0.0)
    bounds = MOST_MOVED_FWHM * fwhm
    # Where the noise is no number of about 1 to 1000, the fitters of astropy end too early: fluxes
    # and centres have to be of sizes that one tolerance suits.
    noise = float(np.median(error[~bad])) if not bad.all() else 1.0
    unit = 1.0 if 2.0**-4 <= noise <= 2.0**13 else 2.0 ** (round(np.log2(noise)) - 4)
    if flux is not None:
        start["flux"] /= unit
    fit = PSFPhotometry(
        psf, side, aperture_radius=fwhm, xy_bounds=bounds, group_warning_threshold=10**9
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = fit(flat / unit, mask=bad, error=error / unit, init_params=start)
        drawn = unit * fit.make_model_image(flat.shape)
    for name in ("flux_init", "flux_fit", "flux_err"):
        found[name] *= unit
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
        left = Sky(sky.flat, sky.level, error, sky.bad, np.nan).stars(threshold, fwhm)
    if not len(left["id"]):
        return place, flux
    new = np.stack([left["X_IMAGE"], left["Y_IMAGE"]], axis=1) - 1.0
    known = place[np.isfinite(place).all(axis=1)]
    alone = cKDTree(known).query(new)[0] > SAME_FWHM * fwhm
    return np.concatenate([place, new[alone]]), np.append(flux, left["FLUX_ISO"][alone])


def _described(
    model: FieldPsfs, table: Table, left: np.ndarray, light: np.ndarray, wings: Wings | None
) -> CrowdedPhotometry:
    """The stars with the fluxes that they have with their wings."""
    from astropy.table import Table

    names = {"id": "id", "x_fit": "x", "y_fit": "y", "x_err": "x_error", "y_err": "y_error"}
    stars = Table({new: np.array(table[old]) for old, new in names.items()})
    found = CrowdedPhotometry(model, stars, left, light, wings)
    total: np.ndarray | float = 1.0
    if wings is not None:
        place = np.stack([stars["x"], stars["y"]], axis=1)
        total, _ = wings.total(outer_light(model.on_pixels, place))
    stars["flux"], stars["flux_error"] = (table[c] * total for c in ("flux_fit", "flux_err"))
    # Light that no model explains, of the PSF's own errors or of stars that nobody sees, is as much
    # in the fluxes as in the residuals.
    chi2 = np.array(table["reduced_chi2"], dtype=np.float64)
    for name in ("x_error", "y_error", "flux_error"):
        stars[name] *= np.sqrt(np.fmax(chi2, 1.0))
    stars["flux_model"] = table["flux_fit"]
    stars["group"], stars["group_size"] = table["group_id"], table["group_size"]
    stars["parted"] = table["parted"]
    stars["chi2"], stars["photutils_flags"] = table["reduced_chi2"], table["flags"]
    return found
