"""Photometry of the stars of an image in one call, for the command line and for Python.

Inputs: a model that knows the PSF at every position, an image with its options, and perhaps
reference stars. Outputs: a table of all stars, and the image without its sky and stars. The fit
itself is in `psfdae.photometry.crowded`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from psfdae.base.errors import Error, keyword, warn
from psfdae.base.progress import task
from psfdae.base.types import WCS, CCDData, QTable, Table
from psfdae.denoise.image_prediction import CAUSES
from psfdae.image.catalogue import StarList, as_catalogue
from psfdae.image.errors import ascii_line
from psfdae.image.image import Image
from psfdae.image.image_input import ImageInput
from psfdae.image.observation import Observation
from psfdae.image.opening import open_observation
from psfdae.image.positions import list_offset
from psfdae.image.stamps import StarFlag, raise_flag
from psfdae.image.tables import star_table
from psfdae.photometry import crowded
from psfdae.photometry.crowded import CrowdedPhotometry
from psfdae.photometry.photon_noise import add_measured_gain
from psfdae.psf.interface import FieldPsfs
from psfdae.stars.moments import robust_scatter

MAX_MAGNITUDE = 50.0
"""A larger magnitude of a reference star, of either sign, means that it is not known."""


class PhotometryError(Error, ValueError):
    """Options that exclude each other, or too few stars for a zero point."""


@dataclass(frozen=True)
class ImagePhotometry:
    """Stars of an image with their fluxes.

    Attributes
    ----------
    star_fit : CrowdedPhotometry
        The fit; its `residual` is the image without sky and stars.
    table : QTable
        A row for each star, with units, magnitudes if the zero point is known, sky coordinates if
        the image has a WCS, and further columns of the star list. Its meta names the image and the
        model, and has the zero point.
    notes : tuple of str
        Sentences on the image, its list, the zero point and the light that fluxes contain.
    wcs : WCS or None
        World coordinates of the image.
    """

    star_fit: CrowdedPhotometry
    table: QTable
    notes: tuple[str, ...]
    wcs: WCS | None

    @property
    def residual(self) -> CCDData:
        """Image without its sky and stars, in the unit of the image and with its WCS."""
        from astropy.nddata import CCDData

        pixels, unit = self.star_fit.residual.astype(np.float32), self.table["flux"].unit
        return CCDData(pixels, unit=unit, wcs=self.wcs)


def measure_all_stars(
    model: FieldPsfs,
    source: ImageInput,
    zero_point: float | None = None,
    reference: StarList | None = None,
    magnitude_column: str = "mag",
    opened: Observation | None = None,
) -> ImagePhotometry:
    """Measure the fluxes of all stars of an image, overlapping ones together.

    Parameters
    ----------
    model : FieldPsfs
        Model that knows the PSF at every position of this image.
    source : ImageInput
        The image with its options. With `detect`, its `origin` applies to the list of reference
        stars.
    zero_point : float, optional
        Magnitude of a flux of 1.
    reference : StarList, optional
        Star list with magnitudes, which give the zero point.
    magnitude_column : str
        Column of the reference with the magnitudes.
    opened : Observation, optional
        `source` with its stars, if it was opened before: it is not read and searched again.

    Raises
    ------
    PhotometryError
        If options exclude each other, the image is a cube, or fewer than three reference stars
        are stars of the image.
    PredictionError
        If the model knows no PSF of a position, or has pixels of another scale.
    ObservationError
        If the image or a list cannot be used; or if the stars are far off the positions of their
        list, unless that is accepted.
    """
    # Reject options that do not fit together.
    if zero_point is not None and (reference is not None or not math.isfinite(zero_point)):
        raise PhotometryError(
            f"{keyword('zero_point')} takes a number, or {keyword('reference')} gives it"
        )
    if source.colour_column:
        raise PhotometryError(
            f"{source.path}: stars get the PSF of the mean colour: no {keyword('colour_column')}"
        )
    # With --detect, the origin applies to the list of reference stars.
    origin = source.origin
    if reference is not None and source.detect:
        source = replace(source, origin=None)
    # The model must know the PSF at every position (`field_range` rejects others), and have pixels
    # as large as the image's.
    model.field_range()
    # Progress is shown from here on: an image may take long to be opened.
    with task("photometry", 2) as advance:
        observation = opened or open_observation(source, model.stamp_px).assume_scale()
        advance(1, "image")
        if not isinstance(observation, Image):
            raise PhotometryError(f"{source.path}: photometry takes an image, no cube of stamps")
        model.check_scale(observation.pixel_scale_arcsec, observation.name_with_scale)
        # The image may show another part of the detector than the training.
        model, frame_notes = model.to_image_frame(observation)
        # Read the stars of the reference before the long work, in case they cannot be used.
        magnitudes = scatter = None
        if reference is not None:
            stars = replace(
                source, catalogue=reference, origin=origin, detect=False, on_image=False
            )
            positions = open_observation(stars, model.stamp_px).positions
            assert positions is not None  # of an image
            star_list = as_catalogue(reference)
            magnitudes = positions, star_list.numbers(magnitude_column), str(star_list.path)
        # All stars of the image, and the zero point by those that the reference has.
        observation = add_measured_gain(model, observation)
        star_fit = measure_stars(model, observation, source.given_threshold)
    # Reject a list of another image: its fluxes would belong to the sky and to other stars.
    offset = measure_list_offsets(star_fit, observation)
    list_note = list_offset(observation.catalogue, offset, source.accept_offset)
    zero_point_note = None
    if magnitudes is not None:
        zero_point, scatter, zero_point_note = measure_zero_point(star_fit, *magnitudes)
    table = photometry_table(star_fit, observation, zero_point)
    table.meta |= {
        "INFILE": ascii_line(source.path.name),
        "PSFMODEL": ascii_line(star_fit.model.name),
        "PSFSHA": star_fit.model.sha256,
        "FLUXRAD": star_fit.radius_px,
        "INMODEL": star_fit.compute_model_share()[0],
        **({} if zero_point is None else {"ZEROPT": zero_point}),
        **({} if scatter is None else {"ZEROPTSD": scatter}),
    }
    if star_fit.chi2_ratio > crowded.MAX_CHI2_RATIO:
        misfit = f"χ² of bright stars is {star_fit.chi2_ratio:.3g} times the training's (median)"
        frame_notes.append(f"{source.path}: {misfit}, all are flagged UNLIKE_TRAINING: {CAUSES}")
    warn(frame_notes)
    notes = zero_point_note, observation.summary(), list_note, *light_notes(star_fit, source)
    notes = (*notes, *frame_notes)
    return ImagePhotometry(star_fit, table, tuple(filter(None, notes)), observation.wcs)


def measure_stars(
    model: FieldPsfs, observation: Image, threshold: float | None = None, turns: int = 5
) -> CrowdedPhotometry:
    """Measure the stars that can be measured, and return a row for every star of the list.

    Parameters
    ----------
    model : FieldPsfs
        Model that knows the PSF at every position.
    observation : Image
        The image with its stars.
    threshold : float, optional
        Minimum S/N of stars that are found in residuals.
    turns : int
        Maximum number of joint fits (`crowded.photometry`).

    Returns
    -------
    CrowdedPhotometry
        The stars, and the image without them.
    """
    # A row without a position cannot be fitted, and a star that is listed twice would share its
    # light: measure the others, and add flagged rows for these.
    unusable = observation.lacks_position() | observation.find_repeated_stars()
    usable = observation.select(~unusable) if unusable.any() else observation
    star_fit = crowded.photometry(model, usable, threshold or crowded.RESIDUAL_SNR, turns)
    if unusable.any():
        stars = add_unmeasured_rows(star_fit.stars, observation, unusable)
        star_fit = replace(star_fit, stars=stars)
    return star_fit


def measure_list_offsets(star_fit: CrowdedPhotometry, observation: Image) -> np.ndarray:
    """Return the offsets of stars from the positions of their list.

    Parameters
    ----------
    star_fit : CrowdedPhotometry
        Stars of the image.
    observation : Image
        The image with the stars of the list.

    Returns
    -------
    ndarray, shape (n, 2)
        Along x and y in px; NaN for stars that are faint or without a flux, whose positions noise
        decides. No rows if there is no list, or if the stars were detected.
    """
    # Rows of stars that were detected have no listed position.
    stars = star_fit.stars
    if observation.catalogue is None or len(stars) != observation.count:
        return np.empty((0, 2))
    offset = np.stack([stars["x"], stars["y"]], axis=1) - observation.positions
    is_unclear = (np.array(stars["flags"]) & int(StarFlag.FAINT | StarFlag.NO_FLUX)) > 0
    return np.where(is_unclear[:, None], np.nan, offset)


def light_notes(star_fit: CrowdedPhotometry, source: ImageInput) -> list[str]:
    """Return sentences on the light that fluxes contain, and on their bias."""
    # The fraction of a flux outside the model of the PSF.
    if star_fit.wings is None:
        notes = ["no star is bright enough to show light beyond the model's stamp"]
    else:
        part, part_error = star_fit.compute_model_share()
        notes = [
            f"fluxes are the light within {star_fit.radius_px:.3g} px; the model of the PSF has "
            f"{100 * part:.2f} ± {100 * part_error:.2f} % of it"
        ]
        model_wings = star_fit.model.wings
        if model_wings is not None and star_fit.wings.differs_from(model_wings):
            notes.append(
                f"light outside the stamps: {star_fit.wings} in this image, which its fluxes have; "
                f"{model_wings} in the training, which flux_total of psfdae predict has"
            )
    if source.detect:
        # Selection by brightness: Eddington (1913, MNRAS 73, 359).
        notes.append(
            "of stars near the detection threshold, those are found that noise makes brighter: "
            "their fluxes are too large in the mean, the more the fainter they are"
        )
    return notes


def add_unmeasured_rows(stars: Table, observation: Image, unusable: np.ndarray) -> Table:
    """Return a row for every star of the list; those that were not measured have NaN and flags.

    Parameters
    ----------
    stars : Table
        A row for each star that was measured, in the order of the list.
    observation : Image
        All stars of the list.
    unusable : ndarray of bool, shape (n,)
        Rows that were not measured.
    """
    from astropy.table import Table

    # Each column with 0 or NaN in the rows that were not measured.
    rows = Table()
    for name in stars.colnames:
        column = np.array(stars[name])
        missing = np.nan if column.dtype.kind == "f" else 0
        rows[name] = np.full(len(unusable), missing, column.dtype)
        rows[name][~unusable] = column
    # What the list says of these stars.
    rows["id"] = observation.stars.id
    rows["x"][unusable], rows["y"][unusable] = observation.positions[unusable].T
    rows["flags"] |= observation.stars.flags
    raise_flag(rows["flags"], StarFlag.NO_FLUX, unusable)
    return rows


def measure_zero_point(
    star_fit: CrowdedPhotometry, positions: np.ndarray, magnitude: np.ndarray, reference: str
) -> tuple[float, float, str]:
    """Return the zero point, the scatter of its stars, and a sentence with its standard error.

    Both are in magnitudes; the scatter is the standard deviation of one star's zero point.

    Parameters
    ----------
    star_fit : CrowdedPhotometry
        Stars of the image with their fluxes F.
    positions : ndarray, shape (n, 2)
        Pixel positions x, y of the reference stars in the image.
    magnitude : ndarray, shape (n,)
        Their magnitudes m; NaN, or beyond ± `MAX_MAGNITUDE`, where they are not known.
    reference : str
        Name of the star list, for messages.

    Raises
    ------
    PhotometryError
        If fewer than three reference stars are stars of the image.
    """
    from scipy.spatial import cKDTree

    # Stars of the image with a flux above 0, and reference stars with position and magnitude.
    stars = star_fit.stars
    flux = np.array(stars["flux"], dtype=np.float64)
    has_flux = np.flatnonzero(np.isfinite(flux) & (flux > 0))
    star_positions = np.stack([stars["x"], stars["y"]], axis=1)[has_flux]
    # SExtractor and DAOPHOT write ±99 for a magnitude that they could not measure.
    complete = np.isfinite(positions).all(axis=1) & (np.abs(magnitude) < MAX_MAGNITUDE)
    # Each reference star is the nearest star of the image if that is within half a FWHM.
    distance_px, star = cKDTree(star_positions).query(positions[complete])
    is_match = distance_px < 0.5 * star_fit.model.fwhm_px()
    # ZP = m + 2.5 log₁₀ F for each; the median, as stars may be variable or matched wrongly.
    zero_points = magnitude[complete][is_match] + 2.5 * np.log10(flux[has_flux[star[is_match]]])
    count = len(zero_points)
    if count < 3:
        raise PhotometryError(
            f"{reference}: {count} of its stars with a magnitude are stars of the image, 3 are "
            "needed for a zero point"
        )
    # The median of n normal values has the standard error √(π/2n) σ.
    scatter = float(robust_scatter(zero_points[:, None])[0])
    value, error = float(np.median(zero_points)), math.sqrt(0.5 * math.pi / count) * scatter
    note = f"zero point {value:.4f} ± {error:.4f} mag ({count} stars of {reference})"
    return value, scatter, note


def photometry_table(
    star_fit: CrowdedPhotometry, observation: Image, zero_point: float | None = None
) -> QTable:
    """Return the stars with units, magnitudes, sky coordinates and the columns of their list.

    Parameters
    ----------
    star_fit : CrowdedPhotometry
        The stars; one for every star of the observation if these are of a list.
    observation : Image
        The image, which has the unit of the fluxes and, perhaps, a WCS.
    zero_point : float, optional
        Magnitude of a flux of 1; if None, the table lacks magnitudes.
    """
    # Columns of the fit; magnitudes if the zero point is known, and positions on the sky.
    columns = {name: np.array(star_fit.stars[name]) for name in star_fit.stars.colnames}
    columns["flags"] = columns["flags"].astype(np.int32)  # FITS does not have unsigned integers
    with np.errstate(all="ignore"):
        if zero_point is not None:
            # m = ZP − 2.5 log₁₀ F, and σ_m = 2.5 / ln 10 · σ_F / F.
            flux = np.where(columns["flux"] > 0, columns["flux"], np.nan)
            columns["mag"] = zero_point - 2.5 * np.log10(flux)
            columns["mag_error"] = 2.5 / math.log(10.0) * columns["flux_error"] / flux
        columns |= observation.sky_columns(columns["x"], columns["y"])
    return star_table(columns, observation.unit, observation.list_columns)
