"""Bright stars of a crowded image after the light of their neighbours is subtracted.

Where many bright stars have a neighbour, a model of the field is fitted to stars without. All
stars are then fitted with it, and in the stamp of each star the light of all others is subtracted.
Stars whose neighbours are further away than about a FWHM can then be used for the training.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np

from psfdae.base.errors import Error
from psfdae.base.threads import fix_threads
from psfdae.image.image import Image
from psfdae.image.selection import collect
from psfdae.image.stamps import cut_image
from psfdae.methods.field import select_fit_stars
from psfdae.methods.field.prior import FieldSettings
from psfdae.methods.field.residuals import MARGIN_PX
from psfdae.methods.field.search import fit_first_field
from psfdae.methods.field.spline import FieldModel
from psfdae.photometry import crowded
from psfdae.psf.grid import PsfGrid
from psfdae.psf.interface import FieldPsfs
from psfdae.training.star_residuals import reject_misfits
from psfdae.training.stars import ImageStars, select_stars


class _Field(FieldPsfs):
    """PSF over the field of a fit, without the errors that a model in a bundle has.

    Parameters
    ----------
    model : FieldModel
        Fit to the stars without neighbours.
    list_offset : ndarray, shape (2,)
        Offset (row, column) of the field's centres from the list, in pixels.
    stamp_px : int
        Side of the stamps that the fit was made of.
    """

    name, image_px = "of stars without neighbours", None

    def __init__(self, model: FieldModel, list_offset: np.ndarray, stamp_px: int) -> None:
        self.model, self.list_offset, self.stamp_px = model, list_offset, stamp_px

    @property
    def order(self) -> int:
        return self.model.order

    @cached_property
    def sha256(self) -> str:
        return hashlib.sha256(self.model.coefficients.tobytes()).hexdigest()

    def field_range(self) -> tuple[np.ndarray, np.ndarray]:
        return self.model.low[:2], self.model.high[:2]

    def check_scale(self, pixel_scale_arcsec: float | None, source: str) -> None:
        """Accept any scale: the fit is used on its own image."""

    def draw_psfs(self, position: np.ndarray, oversampling: int) -> np.ndarray:
        terms = self.model.terms(position)
        return self.model.psfs(terms, position, self.list_offset, self.stamp_px, oversampling)


def fit_isolated_stars(stars: ImageStars) -> _Field:
    """Fit a field to the bright stars of one image, without those that are held out."""
    settings, bright = stars.settings, stars.candidates.bright.select(~stars.held_out)
    stamp_px, frame_px = settings.framing.stamp_px, settings.framing.stamp_px + 2 * MARGIN_PX
    bright = bright.select(select_fit_stars(bright.snr, frame_px**2, settings.seed))
    field = getattr(settings, "field", None) or FieldSettings()
    sky_photons = settings.noise.background_photons
    with fix_threads(field.threads):
        _, fit = fit_first_field(bright, sky_photons, frame_px, stamp_px, field)
    # The offset from the list is unknown without a list, or with few stars.
    return _Field(fit.model, np.nan_to_num(fit.list_error(bright)[0]), stamp_px)


def subtract_neighbours(stars: ImageStars, neighbour_ratio: float) -> ImageStars:
    """Choose the bright stars of an image again, with the light of all other stars subtracted.

    Parameters
    ----------
    stars : ImageStars
        Bright stars of one image. If they were chosen in spite of neighbours that are brighter than
        `neighbour_ratio`, they start a second round.
    neighbour_ratio : float
        Maximum brightness of an accepted neighbour, over the brightness of the star.

    Returns
    -------
    ImageStars
        The stars unchanged, with a note that gives the reason, if their image cannot be fitted.
    """
    # The new choice has the given limit on neighbours, and a nearer one on their distance.
    observation, notes = stars.observation, stars.notes
    accepted_ratio = stars.settings.calibration_stars.neighbour_ratio
    calibration = stars.settings.calibration_stars.model_copy(
        update={"neighbour_ratio": neighbour_ratio}
    )
    settings = stars.settings.model_copy(update={"calibration_stars": calibration})
    assert isinstance(observation, Image)  # with neighbours on it
    for _ in range(2 if accepted_ratio > neighbour_ratio else 1):
        # A field from the stars so far, photometry of all stars with it, and a new choice of
        # bright stars in the cleaned image.
        field = fit_isolated_stars(stars)
        try:
            # Stars that are hidden in the light of others are searched for once; wings are far
            # wider than a stamp, whose own sky is measured.
            photometry = crowded.photometry(field, observation, turns=3, with_wings=False)
            # Within 1.25 FWHM, the light of two stars cannot be separated well enough.
            isolation_px = 1.25 * field.fwhm_px()
            light = draw_other_stars(photometry, observation.positions)
            cleaned_observation = replace(observation, neighbour_light=light)
            candidates = collect(cleaned_observation, calibration, settings.framing, isolation_px)
            candidates = reject_misfits(candidates, settings, cleaned_observation.gain)
            isolated_stars = select_stars(stars.source, cleaned_observation, candidates, settings)
        except Error as error:
            note = f"neighbours: their light was not subtracted ({error})"
            return replace(stars, notes=(*stars.notes, note))
        # The next round starts from these stars, on the image as it was.
        message = (
            f"neighbours: the light of {len(photometry.stars)} stars was subtracted in the others' "
            f"stamps; bright stars before: {len(stars)}, no neighbour above "
            f"{100 * accepted_ratio:g} % of their brightness within {calibration.isolation_px:g} "
            f"px; now: {len(isolated_stars)}, none above {100 * neighbour_ratio:g} % within "
            f"{isolation_px:.2g} px"
        )
        stars = replace(isolated_stars, observation=observation)
        notes = (*isolated_stars.notes, message)
    return replace(stars, notes=notes)


def draw_other_stars(
    photometry: crowded.CrowdedPhotometry, list_positions: np.ndarray
) -> Callable[[slice, int, int], np.ndarray]:
    """Return a function that gives the light of all stars but the one in the middle of a stamp.

    Parameters
    ----------
    photometry : CrowdedPhotometry
        Joint fit of all stars of the image, with their light.
    list_positions : ndarray, shape (n, 2)
        Positions of a star list, x and y.

    Returns
    -------
    callable
        Its arguments are a slice of the list, the side of the stamps and the margin around them, as
        `psfdae.image.stamps.cut_image` takes them. It returns the light (m, s, s), s with both
        margins.
    """
    from scipy.spatial import cKDTree

    # Fluxes without the wings, which belong to no stamp alone.
    stars = photometry.stars
    centre = np.stack([stars["x"], stars["y"]], axis=1)
    flux, psfs = np.array(stars["flux_model"]), PsfGrid.sample(photometry.model, by_magnitude=True)
    star_rows = np.flatnonzero(np.isfinite(centre).all(axis=1) & np.isfinite(stars["flux_model"]))
    # The fitted star of each star of the list; none is within 1.5 px of a star without position.
    distance, nearest = cKDTree(centre[star_rows]).query(np.nan_to_num(list_positions, nan=-np.inf))

    # The fit has the light of all stars in one image; a list asks for it a part at a time.
    def light(rows: slice, stamp_px: int, margin: int) -> np.ndarray:
        x, y = list_positions[rows].T
        stamps = cut_image(photometry.light, photometry.light.shape, x, y, stamp_px, margin)[0]
        # The light of all fitted stars, minus the light of the star itself.
        fitted_rows = np.flatnonzero(distance[rows] <= 1.5)
        star = star_rows[nearest[rows][fitted_rows]]
        corner = np.rint(list_positions[rows][fitted_rows]).astype(int) - stamp_px // 2 - margin
        star_light = psfs.stamps(centre[star], corner, stamps.shape[-1], flux[star])
        stamps[fitted_rows] -= flux[star, None, None] * star_light
        return stamps

    return light
