"""Command `photometry`: fluxes of all stars of an image with the PSF of its field."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from psfdae.cli import command
from psfdae.commands.predict import check_targets
from psfdae.errors import Error
from psfdae.files import write_fits
from psfdae.image.catalogue import as_catalogue
from psfdae.image.errors import ascii_line
from psfdae.image.image_input import ImageInput, ImageStatements
from psfdae.image.positions import list_offset
from psfdae.image.stamps import StarFlag, raise_flag
from psfdae.image.tables import SUFFIXES, star_table, write_table
from psfdae.model.exchange import load_field
from psfdae.options import File

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from psfdae.image.observation import Observation
    from psfdae.model.crowded import CrowdedPhotometry
    from psfdae.model.field_psfs import FieldPsfs


class PhotometryError(Error, ValueError):
    """Options that exclude each other, or too few stars for a zero point."""


@command("photometry")
def photometry_command(
    image: Annotated[File, {"argument": True}],
    options: ImageStatements,
    zero_point: Annotated[float | None, "Magnitude of a flux of 1."] = None,
    reference: Annotated[File | None, "Star list with magnitudes, which give it."] = None,
    magnitude_column: Annotated[str, "Column of --reference with the magnitudes."] = "mag",
    residual: Annotated[File | None, "FITS image without its sky and stars."] = None,
    overwrite: Annotated[bool, "Replace files that exist."] = False,
    *,
    model: Annotated[File, "Bundle of from-stars --method field, or .psf of PSFEx, of this image."],
    out: Annotated[File, "Table of the stars: .fits, .ecsv or .csv."],
) -> None:
    """Measure the fluxes of all stars of IMAGE, overlapping ones together.

    --detect finds the stars, and in a second round those that brighter ones hide; those of
    --catalogue are measured where it says, and no others. Fluxes have the light beyond the
    stamps of MODEL, which the bright stars show; these show the gain, too, if it is not known.
    """
    # Refuse options that do not fit together, and outputs that exist.
    if out.suffix.lower() not in SUFFIXES:
        raise PhotometryError(f"{out}: expected a name that ends in {', '.join(SUFFIXES)}")
    if zero_point is not None and (reference is not None or not math.isfinite(zero_point)):
        raise PhotometryError("--zero-point takes a number, or --reference gives it")
    # With --detect, no list of the image needs an origin: --origin is that of the reference.
    origin_of_reference = reference is not None and options.detect
    source = ImageInput(image, **vars(options))
    source = replace(source, origin=None) if origin_of_reference else source
    check_targets((*source.files(), reference, model), out, residual, overwrite=overwrite)
    if options.colour_column:
        raise PhotometryError(
            f"{image}: all stars get the PSF of the usual one: no --colour-column"
        )
    # The model must know the PSF at every place (`field_range` refuses others), and have pixels
    # as large as those of the image.
    loaded = load_field(model)
    loaded.field_range()
    observation = source.open(loaded.stamp_px).assuming()
    if observation.shape is None:
        raise PhotometryError(f"{image}: photometry takes an image, no cube of stamps")
    loaded.check_scale(observation.pixel_scale_arcsec, str(image))
    # Read the stars of the reference before the long work, in case they cannot be used.
    magnitudes = None
    if reference is not None:
        listed = replace(source, catalogue=reference, origin=options.origin, detect=False)
        positions = replace(listed, on_image=False).open(loaded.stamp_px).positions
        assert positions is not None  # of an image
        magnitudes = positions, as_catalogue(reference).numbers(magnitude_column)

    from psfdae.model.photon_noise import with_measured_gain

    observation = with_measured_gain(loaded, observation)
    measured, list_note = measure_stars(loaded, observation, options.threshold)
    if magnitudes is not None:
        zero_point, zero_point_note = measure_zero_point(measured, *magnitudes, reference)
        print(zero_point_note)
    # Write the table with its header, and the residual image.
    table = photometry_table(measured, observation, zero_point)
    table.meta |= {
        "INFILE": ascii_line(image.name),
        "PSFMODEL": ascii_line(measured.model.name),
        "PSFSHA": measured.model.sha256,
        "FLUXRAD": measured.radius_px,
        "INMODEL": measured.part_of_model()[0],
        **({} if zero_point is None else {"ZEROPT": zero_point}),
    }
    write_table(out, table)
    if residual is not None:
        from astropy.io import fits

        write_fits(residual, fits.PrimaryHDU(measured.residual.astype(np.float32)))
    summary = summary_lines(measured, out, bool(options.detect))
    print(*filter(None, [observation.summary(), list_note, *summary]), sep="\n")


def measure_stars(
    model: FieldPsfs, observation: Observation, threshold: float
) -> tuple[CrowdedPhotometry, str | None]:
    """Measure the stars that can be measured, and return a row for every star of the list.

    Returns
    -------
    measured : CrowdedPhotometry
        The stars, and the image without them.
    list_note : str or None
        A sentence on how far the stars are off the positions of their list, if there is one.
    """
    from psfdae.model.crowded import photometry as crowded_photometry

    # A row without a position cannot be fitted, and one of a star that is listed twice has no
    # light of its own: measure the others, and add flagged rows for these.
    unusable = observation.without_position() | observation.listed_again()
    usable = observation.select(~unusable) if unusable.any() else observation
    measured = crowded_photometry(model, usable, threshold)
    if unusable.any():
        measured = replace(
            measured, stars=with_unmeasured_rows(measured.stars, observation, unusable)
        )
    if observation.catalogue is None or len(measured.stars) != observation.count:
        return measured, None
    # The stars are fitted where they are, whatever the list says.
    offset = np.stack([measured.stars["x"], measured.stars["y"]], axis=1) - observation.positions
    return measured, list_offset(observation.catalogue, offset, accept=True)


def summary_lines(measured: CrowdedPhotometry, out: Path, detected: bool) -> list[str]:
    """Return lines on the number of stars, the light that fluxes contain, and their bias."""
    # Stars with a flux, and how much of it the model of the PSF does not have.
    measured_count = int(np.isfinite(measured.stars["flux"]).sum())
    lines = [f"{out}: {len(measured.stars)} stars, {measured_count} measured"]
    if measured.wings is None:
        lines.append("no star is bright enough to show light beyond the model's stamp")
    else:
        part, part_error = measured.part_of_model()
        lines.append(
            f"fluxes are the light within {measured.radius_px:.3g} px; the model of the PSF has "
            f"{100 * part:.2f} ± {100 * part_error:.2f} % of it"
        )
    if detected:
        # Selection by brightness: Eddington (1913, MNRAS 73, 359).
        lines.append(
            "of stars near the detection threshold, those are found that noise makes brighter: "
            "their fluxes are too large in the mean, the more the fainter they are"
        )
    return lines


def with_unmeasured_rows(stars: Table, observation: Observation, unusable: np.ndarray) -> Table:
    """Return a row for every star of the list; those that were not measured have NaN and flags.

    Parameters
    ----------
    stars : Table
        A row for each star that was measured, in the order of the list.
    observation : Observation
        All stars of the list.
    unusable : ndarray of bool, shape (n,)
        Rows that were not measured.
    """
    from astropy.table import Table

    assert observation.positions is not None
    # Each column with 0 or NaN in the rows that were not measured.
    rows = Table()
    for name in stars.colnames:
        measured = np.array(stars[name])
        column = np.zeros(len(unusable), measured.dtype)
        if measured.dtype.kind == "f":
            column[:] = np.nan
        column[~unusable] = measured
        rows[name] = column
    # What the list says of these stars.
    rows["id"] = observation.stars.id
    rows["x"][unusable], rows["y"][unusable] = observation.positions[unusable].T
    rows["flags"] |= observation.stars.flags
    raise_flag(rows["flags"], StarFlag.NO_FLUX, unusable)
    return rows


def measure_zero_point(
    measured: CrowdedPhotometry,
    positions: np.ndarray,
    magnitude: np.ndarray,
    reference: Path | None,
) -> tuple[float, str]:
    """Return the zero point in magnitudes, and a sentence with its standard error.

    Parameters
    ----------
    measured : CrowdedPhotometry
        Stars of the image with their fluxes F.
    positions : ndarray, shape (n, 2)
        Pixel positions x, y of the reference stars in the image.
    magnitude : ndarray, shape (n,)
        Their magnitudes m.
    reference : Path or None
        The star list, for messages.

    Raises
    ------
    PhotometryError
        If fewer than three reference stars are stars of the image.
    """
    from scipy.spatial import cKDTree

    from psfdae.moments import robust_scatter

    # Stars of the image with a flux above 0, and reference stars with position and magnitude.
    stars = measured.stars
    flux = np.array(stars["flux"], dtype=np.float64)
    has_flux = np.flatnonzero(np.isfinite(flux) & (flux > 0))
    star_positions = np.stack([stars["x"], stars["y"]], axis=1)[has_flux]
    complete = np.isfinite(positions).all(axis=1) & np.isfinite(magnitude)
    # Each reference star is the nearest star of the image if that is within half a FWHM.
    distance_px, star = cKDTree(star_positions).query(positions[complete])
    matched = distance_px < 0.5 * measured.model.fwhm_px()
    # ZP = m + 2.5 log₁₀ F for each; the median, as stars may be variable or matched wrongly.
    zero_points = magnitude[complete][matched] + 2.5 * np.log10(flux[has_flux[star[matched]]])
    count = len(zero_points)
    if count < 3:
        raise PhotometryError(
            f"{reference}: {count} of its stars with a magnitude are stars of the image, 3 are "
            "needed for a zero point"
        )
    error = float(robust_scatter(zero_points[:, None])[0]) / math.sqrt(count)
    value = float(np.median(zero_points))
    return value, f"zero point {value:.4f} ± {error:.4f} mag ({count} stars of {reference})"


def photometry_table(
    measured: CrowdedPhotometry, observation: Observation, zero_point: float | None = None
) -> QTable:
    """Return the stars with units, magnitudes, sky coordinates and the columns of their list.

    Parameters
    ----------
    measured : CrowdedPhotometry
        The stars; one for every star of the observation if these are of a list.
    observation : Observation
        The image, which has the unit of the fluxes and, perhaps, a WCS.
    zero_point : float, optional
        Magnitude of a flux of 1; without it there are no magnitudes.
    """
    # Columns of the fit; magnitudes if the zero point is known, and places on the sky.
    columns = {name: np.array(measured.stars[name]) for name in measured.stars.colnames}
    columns["flags"] = columns["flags"].astype(np.int32)  # FITS has no unsigned integers
    with np.errstate(all="ignore"):
        if zero_point is not None:
            # m = ZP − 2.5 log₁₀ F, and σ_m = 2.5 / ln 10 · σ_F / F.
            flux = np.where(columns["flux"] > 0, columns["flux"], np.nan)
            columns["mag"] = zero_point - 2.5 * np.log10(flux)
            columns["mag_error"] = 2.5 / math.log(10.0) * columns["flux_error"] / flux
        sky_position = observation.on_sky(columns["x"], columns["y"])
    if sky_position is not None:
        columns["ra"], columns["dec"] = sky_position
    return star_table(columns, observation.unit, observation.list_columns)
