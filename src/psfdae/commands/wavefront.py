"""Stage `wavefront`: stars of a FITS file and a telescope in; its aberrations out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click
import numpy as np

from psfdae.cli import command
from psfdae.commands.predict import Stated, check_targets, write_list
from psfdae.figures import write_png
from psfdae.files import check_outputs, write_fits
from psfdae.image.catalogue import as_catalogue
from psfdae.image.errors import ascii_line
from psfdae.image.observation import Observation, central_pixel, list_offset
from psfdae.image.tables import fits_values
from psfdae.model.psf_model import SCALE_TOLERANCE
from psfdae.options import File
from psfdae.sensing.joint import Joint
from psfdae.sensing.results import Wavefronts
from psfdae.sensing.results import wavefront as sensed
from psfdae.sensing.stars import SensingError
from psfdae.telescope.settings import OwnTelescope, read_telescope
from psfdae.version import __version__

if TYPE_CHECKING:
    from astropy.io.fits import HDUList
    from astropy.table import Table

    from psfdae.image.catalogue import StarList

FIELD_COLUMNS = ("x_deg", "y_deg")
"""Field angles of the stars, if the star list has them."""

CORRELATED = 0.5
"""Correlations of errors above this are printed."""


@command("wavefront")
def wavefront(
    stars: Annotated[File, {"argument": True, "metavar": "INPUT"}],
    stated: Stated,
    telescope: Annotated[File, "YAML file of the telescope, as in config/telescope."],
    stamp_px: Annotated[int, click.IntRange(8, 64), "Side of the stamps."] = 16,
    axis: Annotated[
        tuple[float, float] | None,
        {"type": (float, float)},
        "Pixel x y (0-based) of the optical axis.  [default: the image's middle]",
    ] = None,
    joint: Annotated[bool, "Fit the telescope's state to all stars together."] = False,
    plot: Annotated[File | None, "PNG: wavefronts over the field."] = None,
    seed: Annotated[int, click.IntRange(min=0), "Of the search."] = 0,
    overwrite: Annotated[bool, "Replace files that exist."] = False,
    *,
    out: Annotated[File, "FITS file for coefficients, PSFs and residuals."],
) -> None:
    """Measure the aberrations of a known telescope from the stars in INPUT.

    INPUT is a FITS image with --catalogue or --detect, or a cube of stamps with a catalogue. The
    field angle of a star is in the columns x_deg, y_deg of the list, or follows from its position.
    Two modes of a star are two wavefronts that its image does not tell apart.
    """
    if stated.all_extensions:
        raise SensingError("psfdae wavefront takes one image: name it with --extension")
    if stated.colour_column:
        raise SensingError("psfdae wavefront takes light of one colour: no --colour-column")
    source = stated.source(stars)
    found_list = out.with_name(f"{out.stem}_stars.csv") if stated.detect else None
    check_outputs((out, plot, found_list), (*source.files(), telescope))
    check_targets(out, plot, found_list, overwrite)
    known = read_telescope(telescope)
    observation = source.open(stamp_px)
    check_scale(observation, known)
    angle = field_angles(observation, source.catalogue, known, axis)
    stamps = next(observation.chunks(observation.count))
    found = sensed(stamps, known, field_deg=angle, joint=joint, seed=seed)
    said = [observation.said(), *off_list(found, observation), *report(found)]
    if found_list is not None:
        write_list(observation, found_list)
    if plot is not None:
        from psfdae.sensing.plot import wavefront_map

        write_png(wavefront_map(found, f"{source.path.name}: {known.name}"), plot)
    # Its name is the last one to be there: it says that all is done.
    write_fits(out, as_fits(found, source.path.name))
    print("\n".join([*said, unexplained(found, out)]))


def off_list(found: Wavefronts, observation: Observation) -> list[str]:
    """How far stars are from their list, which is no mistake: aberrations move them."""
    if observation.shape is None or observation.positions is None:
        return []
    # The centre of the light: that of the chief ray is moved by coma.
    rows, columns = np.indices(found.model.shape[1:])
    total = found.model.sum(axis=(1, 2))
    centre = np.stack([(found.model * axis).sum(axis=(1, 2)) / total for axis in (columns, rows)])
    corner = central_pixel(observation.positions.T) - found.model.shape[-1] // 2
    off = np.where(found.explained, centre + corner - observation.positions.T, np.nan).T
    said = list_offset(observation.catalogue, off, accept=True)
    return [] if said is None else [said]


def check_scale(observation: Observation, telescope: OwnTelescope) -> None:
    """Refuse an image with pixels of another scale than the telescope's.

    Raises
    ------
    SensingError
        If they differ by more than `SCALE_TOLERANCE`.
    """
    scale, wanted = observation.pixel_scale_arcsec, telescope.pixel_scale_arcsec
    if scale is not None and not abs(scale / wanted - 1.0) <= SCALE_TOLERANCE:
        raise SensingError(
            f"{observation.path}: pixels of {scale:.6g} arcsec, but those of the telescope "
            f"{telescope.name!r} are {wanted:.6g} arcsec (tolerance {100 * SCALE_TOLERANCE:g} %)"
        )


def field_angles(
    observation: Observation,
    catalogue: StarList | None,
    telescope: OwnTelescope,
    axis: tuple[float, float] | None,
) -> np.ndarray:
    """Field angles (x, y) of the stars in degrees, (n, 2).

    Raises
    ------
    SensingError
        If neither the list has them, nor the stars positions in an image.
    """
    if catalogue is not None and axis is None:
        table = as_catalogue(catalogue)
        names = set(table.table.colnames)
        if names.issuperset(FIELD_COLUMNS):
            angle = np.stack([table.numbers(name) for name in FIELD_COLUMNS], axis=1)
            if len(table) != observation.count:
                raise SensingError(f"{table.path}: --on-image takes no list with x_deg, y_deg")
            lost = ~np.isfinite(angle).all(axis=1)
            if lost.any():
                raise SensingError(f"{table.path}: no x_deg, y_deg in row {lost.argmax() + 1}")
            return angle
    positions, shape = observation.positions, observation.shape
    if axis is None and shape is not None:
        axis = (0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1))
    if positions is None or axis is None:
        raise SensingError(
            f"{observation.path}: the stars' field angles are not known: a star list with columns "
            "x_deg, y_deg, an image, or --axis with positions says them"
        )
    angle = (positions - np.asarray(axis)) * telescope.pixel_scale_arcsec / 3600.0
    if not np.isfinite(angle).all():
        raise SensingError(f"{observation.path}: stars without a position (--on-image leaves out)")
    return np.asarray(angle)


def as_fits(found: Wavefronts, image: str) -> HDUList:
    """The FITS file: primary header, WAVEFRONT, PSF, UNCERT, MODEL, RESIDUAL, COVAR and JOINT."""
    from astropy.io import fits

    primary = fits.PrimaryHDU()
    prior = found.telescope.prior
    for card in (
        ("CREATOR", f"psfdae {__version__}", ""),
        ("INFILE", ascii_line(image), "stars"),
        ("TELESCOP", found.telescope.name, "its description gave the optics"),
        ("WAVELEN", found.telescope.wavelength_m, "[m] wavelength"),
        ("PRIORFRA", prior.fraction, "prior: standard deviation, part of each term"),
        ("NSTARS", len(found.stamps), "stars"),
        ("NPOOR", int((~found.explained).sum()), "stars that no wavefront explains"),
    ):
        primary.header.append(card)
    rows = found.table
    if rows["id"].dtype.kind == "U":
        rows["id"] = fits_values(rows["id"])
    table = fits.table_to_hdu(rows)
    table.name = "WAVEFRONT"
    table.header["COMMENT"] = "Coefficients and their errors are in waves; a row per star and mode."
    psf, error = found.psf_and_error()
    cubes = {
        "PSF": (psf, "whole light 1, chief ray in the middle"),
        "UNCERT": (error, "standard deviation of PSF"),
        "MODEL": (found.model, "star without sky, unit of the input"),
        "RESIDUAL": (
            np.where(
                found.stamps.bad | found.stamps.saturated,
                np.nan,
                found.stamps.data - found.measured()["sky"][:, None, None] - found.model,
            ),
            "stamp minus sky minus model, NaN where unused",
        ),
        "COVAR": (_by_row(found, rows), "of the coefficients, squared waves; row by row"),
    }
    hdus = [primary, table]
    for name, (values, about) in cubes.items():
        hdu = fits.ImageHDU(values.astype(np.float32), name=name)
        hdu.header["COMMENT"] = about
        hdus.append(hdu)
    if found.joint is not None:
        joint = found.joint
        columns = [
            fits.Column("name", "20A", array=np.array(joint.model.names)),
            fits.Column("unit", "8A", array=np.array(joint.model.units)),
            fits.Column("prior", "D", array=joint.model.mean),
            fits.Column("prior_error", "D", array=joint.model.sd),
            fits.Column("value", "D", array=joint.value),
            fits.Column("error", "D", array=joint.error),
            fits.Column("correlation", f"{joint.value.size}D", array=joint.correlation),
        ]
        state = fits.BinTableHDU.from_columns(columns, name="JOINT")
        state.header["PROB"] = (joint.probability, "of this state against its twin")
        hdus.append(state)
    return fits.HDUList(hdus)


def _by_row(found: Wavefronts, rows: Table) -> np.ndarray:
    """Covariances of the rows of the table; NaN for stars without usable pixels."""
    covariance = found.summary["covariance"]
    whole = np.full((len(rows), *covariance.shape[1:]), np.nan)
    whole[np.isfinite(rows["probability"])] = covariance
    return whole


def report(found: Wavefronts) -> list[str]:
    """Return lines on the stars and the state of the telescope."""
    terms, summary = found.terms, found.summary
    first = np.flatnonzero(np.diff(summary["star"], prepend=-1))
    error = np.sqrt(np.einsum("mkk->mk", summary["covariance"][first]))
    nm = found.wavelength_nm
    two = np.mean(summary["probability"][first] < 0.95)
    rms = nm * np.nanmedian(found.rms[0])
    lines = [
        f"prior of {found.telescope.name}: every coefficient about the telescope's own, with the "
        "standard deviation of the column prior",
        f"{'term':12}{'prior':>10}{'error':>10}{'error':>10}   of one star, median of {len(first)}",
        f"{'':12}{'(waves)':>10}{'(waves)':>10}{'(nm)':>10}",
    ]
    for k, name in enumerate(terms.names):
        prior, own = np.median(terms.sd[summary["star"][first], k]), np.median(error[:, k])
        lines.append(f"{name:12}{prior:10.4f}{own:10.4f}{nm * own:10.2f}")
    lines.append(
        f"RMS of the wavefronts {rms:.3g} nm in the median; {two:.0%} of the stars have a second "
        "wavefront with a probability above 5 %"
    )
    return lines + ([] if found.joint is None else _of_joint(found.joint))


def _of_joint(joint: Joint) -> list[str]:
    lines = [
        f"the telescope, from {joint.star.size} stars together:",
        f"{'number':16}{'unit':>6}{'prior':>12}{'± ':>11}{'found':>12}{'± ':>11}",
    ]
    rows = (joint.model.mean, joint.model.sd, joint.value, joint.error)
    for name, unit, *numbers in zip(joint.model.names, joint.model.units, *rows, strict=True):
        prior, spread, value, error = numbers
        lines.append(f"{name:16}{unit:>6}{prior:12.4g}{spread:11.2g}{value:12.4g}{error:11.2g}")
    strong = np.argwhere(np.triu(np.abs(joint.correlation) > CORRELATED, 1))
    if len(strong):
        pairs = [
            f"{joint.model.names[i]}, {joint.model.names[j]} {joint.correlation[i, j]:+.2f}"
            for i, j in strong
        ]
        lines.append(f"correlations of errors: {'; '.join(pairs)}")
    if joint.twin is not None:
        lines.append(
            f"its probability is {joint.probability:.3f}; the twin, of the other sign of focus, "
            f"astigmatism and spherical aberration, has the rest"
        )
    off = int(joint.disagrees.sum())
    lines.append(f"{off} of {joint.star.size} stars disagree with it by more than 4 σ of their χ²")
    return lines


def unexplained(found: Wavefronts, out: Path) -> str:
    """How many stars no wavefront explains, and what that means."""
    count, poor = len(found.stamps), int((~found.explained).sum())
    chi2 = np.nanmedian(found.chi2)
    said = f"{out}: {count} stars, {poor} not explained ({poor / count:.1%}), χ² {chi2:.2f} median"
    if poor > 0.1 * count:
        said += ": the telescope, its seeing or the prior are not those of the image"
    return said
