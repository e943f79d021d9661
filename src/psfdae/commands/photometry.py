"""Stage `photometry`: fluxes of all stars of an image with the PSF of its field."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from psfdae.cli import command
from psfdae.commands.predict import Stated, check_targets
from psfdae.errors import Error
from psfdae.files import check_outputs, write_fits
from psfdae.image.catalogue import as_catalogue
from psfdae.image.errors import ascii_line
from psfdae.image.observation import list_offset
from psfdae.image.stamps import StarFlag, raise_flag
from psfdae.image.tables import SUFFIXES, star_table, write_table
from psfdae.model.exchange import load_field
from psfdae.options import File

if TYPE_CHECKING:
    from astropy.table import QTable, Table

    from psfdae.image.observation import Observation
    from psfdae.model.crowded import CrowdedPhotometry

MATCHED_FWHM, FEWEST = 0.5, 3  # distance of a reference star; those that a zero point takes


class PhotometryError(Error, ValueError):
    """Nothing to measure, or no zero point."""


@command("photometry")
def photometry(
    image: Annotated[File, {"argument": True}],
    stated: Stated,
    zero_point: Annotated[float | None, "Magnitude of a flux of 1."] = None,
    reference: Annotated[File | None, "Star list with magnitudes, which give it."] = None,
    magnitude_column: Annotated[str, "Of --reference."] = "mag",
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
    if out.suffix.lower() not in SUFFIXES:
        raise PhotometryError(f"{out}: expected a name that ends in {', '.join(SUFFIXES)}")
    if zero_point is not None and (reference is not None or not math.isfinite(zero_point)):
        raise PhotometryError("--zero-point takes a number, or --reference gives it")
    # Of stars that are found, the origin is known; then it is that of the reference.
    found_here = reference is not None and stated.detect
    source = (replace(stated, origin=None) if found_here else stated).source(image)
    check_outputs((out, residual), (*source.files(), reference, model))
    check_targets(out, residual, None, overwrite)
    if stated.all_extensions:
        raise PhotometryError(f"{image}: photometry takes one image, not --all-extensions")
    if stated.colour_column:
        raise PhotometryError(
            f"{image}: all stars get the PSF of the usual one: no --colour-column"
        )
    loaded = load_field(model)
    loaded.field_range()  # or it knows no place
    observation = source.open(loaded.stamp_px).assuming()
    if observation.shape is None:
        raise PhotometryError(f"{image}: photometry takes an image, no cube of stamps")
    loaded.check_scale(observation.pixel_scale_arcsec, str(image))
    magnitudes = None
    if reference is not None:
        listed = replace(stated, catalogue=reference, detect=False, on_image=False)
        places = listed.source(image).open(loaded.stamp_px).positions
        assert places is not None  # of an image
        magnitudes = places, as_catalogue(reference).numbers(magnitude_column)

    from psfdae.model.crowded import photometry as measured
    from psfdae.model.photon_noise import with_measured_gain

    observation = with_measured_gain(loaded, observation)
    found, offset = _of_all_rows(
        observation, lambda usable: measured(loaded, usable, stated.threshold)
    )
    if magnitudes is not None:
        zero_point, said = _zero_point(found, *magnitudes, reference)
        print(said)
    table = photometry_table(found, observation, zero_point)
    table.meta |= _said(found, image, zero_point)
    write_table(out, table)
    if residual is not None:
        from astropy.io import fits

        write_fits(residual, fits.PrimaryHDU(found.residual.astype(np.float32)))
    print(
        *filter(None, [observation.said(), offset, _summary(found, out, stated.detect)]), sep="\n"
    )


def _of_all_rows(
    observation: Observation, measured: Callable[[Observation], CrowdedPhotometry]
) -> tuple[CrowdedPhotometry, str | None]:
    """Measure the stars that can be, and return a row for every one; and how far a list is off."""
    # Rows without a position cannot be fitted, and those of a star that is listed twice have no
    # light of their own.
    unusable = observation.without_position() | observation.listed_again()
    found = measured(observation.of(~unusable) if unusable.any() else observation)
    if unusable.any():
        found = replace(found, stars=_with_rows(found.stars, observation, unusable))
    if observation.catalogue is None or len(found.stars) != observation.count:
        return found, None
    # The stars are fitted where they are, whatever the list says.
    fitted = np.stack([found.stars["x"], found.stars["y"]], axis=1)
    return found, list_offset(observation.catalogue, fitted - observation.positions, accept=True)


def _with_rows(stars: Table, observation: Observation, unusable: np.ndarray) -> Table:
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
    rows = Table()
    for name in stars.colnames:
        measured = np.array(stars[name])
        column = np.zeros(len(unusable), measured.dtype)
        if measured.dtype.kind == "f":
            column[:] = np.nan
        column[~unusable] = measured
        rows[name] = column
    rows["id"] = observation.identifiers
    rows["x"][unusable], rows["y"][unusable] = observation.positions[unusable].T
    rows["flags"] |= observation.list_flags
    raise_flag(rows["flags"], StarFlag.NO_FLUX, unusable)
    return rows


def _zero_point(
    found: CrowdedPhotometry, places: np.ndarray, magnitude: np.ndarray, reference: Path | None
) -> tuple[float, str]:
    """Median of what stars of the reference say, in magnitudes, and how sure it is."""
    from scipy.spatial import cKDTree

    from psfdae.moments import robust_scatter

    stars = found.stars
    flux = np.array(stars["flux"], dtype=np.float64)
    used = np.flatnonzero(np.isfinite(flux) & (flux > 0))
    place = np.stack([stars["x"], stars["y"]], axis=1)[used]
    known = np.isfinite(places).all(axis=1) & np.isfinite(magnitude)
    off, star = cKDTree(place).query(places[known])
    near = off < MATCHED_FWHM * found.model.fwhm_px()
    zero = magnitude[known][near] + 2.5 * np.log10(flux[used[star[near]]])
    if len(zero) < FEWEST:
        raise PhotometryError(
            f"{reference}: {len(zero)} of its stars with a magnitude are stars of the image, "
            f"{FEWEST} are needed for a zero point"
        )
    error = float(robust_scatter(zero[:, None])[0]) / math.sqrt(len(zero))
    value = float(np.median(zero))
    return value, f"zero point {value:.4f} ± {error:.4f} mag ({len(zero)} stars of {reference})"


def photometry_table(
    found: CrowdedPhotometry, observation: Observation, zero_point: float | None = None
) -> QTable:
    """Return the stars with units, magnitudes, sky coordinates and the columns of their list.

    Parameters
    ----------
    found : CrowdedPhotometry
        With a row for every star of the observation if these are of a list.
    observation : Observation
        The image, which has the unit of the fluxes and, perhaps, a WCS.
    zero_point : float, optional
        Magnitude of a flux of 1; without it there are no magnitudes.
    """
    columns = {name: np.array(found.stars[name]) for name in found.stars.colnames}
    columns["flags"] = columns["flags"].astype(np.int32)  # FITS has no unsigned integers
    with np.errstate(all="ignore"):
        if zero_point is not None:
            # m = ZP − 2.5 log₁₀ F, and σ_m = 2.5 / ln 10 · σ_F / F.
            flux = np.where(columns["flux"] > 0, columns["flux"], np.nan)
            columns["mag"] = zero_point - 2.5 * np.log10(flux)
            columns["mag_error"] = 2.5 / math.log(10.0) * columns["flux_error"] / flux
        sky = observation.on_sky(columns["x"], columns["y"])
    if sky is not None:
        columns["ra"], columns["dec"] = sky
    return star_table(columns, observation.unit, observation.list_columns)


def _said(found: CrowdedPhotometry, image: Path, zero_point: float | None) -> dict[str, Any]:
    """Return the header of the table."""
    return {
        "INFILE": ascii_line(image.name),
        "PSFMODEL": ascii_line(found.model.name),
        "PSFSHA": found.model.sha256,
        "FLUXRAD": found.radius_px,
        "INMODEL": found.part_of_model()[0],
        **({} if zero_point is None else {"ZEROPT": zero_point}),
    }


def _summary(found: CrowdedPhotometry, out: Path, detected: bool) -> str:
    count, measured = len(found.stars), int(np.isfinite(found.stars["flux"]).sum())
    beyond = "no star is bright enough to show light beyond the model's stamp"
    if found.wings is not None:
        part, error = found.part_of_model()
        beyond = (
            f"fluxes are the light within {found.radius_px:.3g} px; the model of the PSF has "
            f"{100 * part:.2f} ± {100 * error:.2f} % of it"
        )
    said = f"{out}: {count} stars, {measured} measured"
    if detected:
        # Selection by brightness: Eddington (1913, MNRAS 73, 359).
        beyond += (
            "\nof stars near the detection threshold, those are found that noise makes brighter: "
            "their fluxes are too large in the mean, the more the fainter they are"
        )
    return f"{said}\n{beyond}"
