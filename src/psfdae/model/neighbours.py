"""Bright stars of a crowded image without the light of their neighbours.

Where many bright stars have a neighbour, a model of the field is made of those that have none. All
stars are then fitted with it, and in the stamp of each star the light of all others is subtracted,
so that stars can be learnt from whose neighbours are further away than `NEAREST_FWHM`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np

from psfdae.errors import Error
from psfdae.image.observation import cut_image
from psfdae.methods.field import FieldMixture
from psfdae.model import crowded
from psfdae.model.field_psfs import FieldPsfs
from psfdae.model.fitting import fitted_to
from psfdae.model.psf_grid import PsfGrid
from psfdae.model.stars import DETECTED_SIGMA, Stars

NEAREST_FWHM = 1.25  # of a neighbour whose light can be told from that of its star
SAME_PX = 1.5  # from a star of the list to the same star as it was fitted


class _Field(FieldPsfs):
    """The field that a fit knows, without the calibration that a model in a bundle has."""

    name, image_px = "of stars without neighbours", None

    def __init__(self, fitted: FieldMixture, stamp_px: int) -> None:
        self.fitted, self.stamp_px = fitted, stamp_px

    @property
    def order(self) -> int:
        return self.fitted.order

    @cached_property
    def sha256(self) -> str:
        return hashlib.sha256(self.fitted.coefficients.tobytes()).hexdigest()

    def field_range(self) -> tuple[np.ndarray, np.ndarray]:
        return self.fitted.low[:2], self.fitted.high[:2]

    def check_scale(self, pixel_scale_arcsec: float | None, purpose: str) -> None:
        """It is of the image that it is applied to."""

    def _drawn(self, place: np.ndarray, oversampling: int) -> np.ndarray:
        return self.fitted.psf_at(place, oversampling)


def without_neighbours(stars: Stars, neighbour_ratio: float) -> Stars:
    """The stars of the same image, each without the light of all others.

    Where the stars were chosen in spite of neighbours brighter than `neighbour_ratio`, in units of
    the star, the stars that come out are the start of a second round. What they were is what comes
    back if their image cannot be fitted, with a note that says why.
    """
    observation, notes = stars.observation, stars.notes
    accepted = stars.settings.calibration_stars.neighbour_ratio
    calibration = stars.settings.calibration_stars.model_copy(
        update={"neighbour_ratio": neighbour_ratio}
    )
    settings = stars.settings.model_copy(update={"calibration_stars": calibration})
    assert observation.positions is not None
    for _ in range(2 if accepted > neighbour_ratio else 1):
        field = _Field(fitted_to(stars, FieldMixture), settings.framing.stamp_px)
        try:
            subtracted = crowded.photometry(field, observation, DETECTED_SIGMA)
            isolation_px = NEAREST_FWHM * field.fwhm_px()
            cleaned = replace(
                observation, others=light_of_others(subtracted, observation.positions)
            )
            isolated = Stars.chosen(stars.source, cleaned, settings, isolation_px)
        except Error as error:
            note = f"neighbours: their light was not subtracted ({error})"
            return replace(stars, notes=(*stars.notes, note))
        message = (
            f"neighbours: the light of {len(subtracted.stars)} stars was subtracted in the others' "
            f"stamps; {len(stars)} stars are good with no neighbour above {100 * accepted:g} % of "
            f"their brightness within {calibration.isolation_px:g} px, {len(isolated)} with none "
            f"above {100 * neighbour_ratio:g} % within {isolation_px:.2g} px"
        )
        stars = replace(isolated, observation=observation, wings=subtracted.wings)
        notes = (*isolated.notes, message)
    return replace(stars, notes=notes)


def light_of_others(
    photometry: crowded.CrowdedPhotometry, place: np.ndarray
) -> Callable[[slice, int, int], np.ndarray]:
    """Light of all stars of an image but the one in the middle, for stamps of stars of a list.

    Parameters
    ----------
    photometry : CrowdedPhotometry
    place : ndarray, shape (n, 2)
        Positions of the list, x and y.

    Returns
    -------
    callable
        Of a part of the list, the side of the stamps and the margin around them, as
        `psfdae.image.observation.cut_image` cuts them; (m, s, s), s with both margins.
    """
    from scipy.spatial import cKDTree

    stars = photometry.stars
    fitted = np.stack([stars["x"], stars["y"]], axis=1)
    measured = np.flatnonzero(np.isfinite(fitted).all(axis=1) & np.isfinite(stars["flux_model"]))
    off, nearest = cKDTree(fitted[measured]).query(np.nan_to_num(place, nan=-np.inf))
    psfs, flux = PsfGrid.of(photometry.model), np.array(stars["flux_model"])

    def light(part: slice, stamp_px: int, margin: int) -> np.ndarray:
        x, y = place[part].T
        stamps = cut_image(photometry.light, photometry.light.shape, x, y, stamp_px, margin)[0]
        rows = np.flatnonzero(off[part] <= SAME_PX)
        star = measured[nearest[part][rows]]
        corner = np.rint(place[part][rows]).astype(int) - stamp_px // 2 - margin
        star_light = psfs.stamps(fitted[star], corner, stamps.shape[-1])[:, 0]
        stamps[rows] -= flux[star, None, None] * star_light
        return stamps

    return light
