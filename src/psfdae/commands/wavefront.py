"""Command `wavefront`: measure the aberrations of a known telescope from stars of an image."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import click
import numpy as np

from psfdae.cli import command
from psfdae.commands.predict import ImageOptions, check_targets, write_list
from psfdae.figures import write_png
from psfdae.files import write_fits
from psfdae.image.catalogue import as_catalogue
from psfdae.image.errors import ascii_line
from psfdae.image.observation import Observation, central_pixel, list_offset
from psfdae.image.tables import fits_values
from psfdae.model.psf_model import SCALE_TOLERANCE
from psfdae.options import File
from psfdae.sensing.joint import Joint
from psfdae.sensing.results import Wavefronts
from psfdae.sensing.results import wavefront as measure_wavefronts
from psfdae.sensing.stars import SensingError
from psfdae.telescope.settings import OwnTelescope, read_telescope
from psfdae.version import __version__

if TYPE_CHECKING:
    from astropy.io.fits import HDUList

    from psfdae.image.catalogue import StarList


@command("wavefront")
def wavefront(
    stars: Annotated[File, {"argument": True, "metavar": "INPUT"}],
    options: ImageOptions,
    telescope: Annotated[File, "YAML file of the telescope, as in config/telescope."],
    stamp_px: Annotated[int, click.IntRange(8, 64), "Side of the stamps."] = 16,
    axis: Annotated[
        tuple[float, float] | None,
        {"type": (float, float)},
        "Pixel x y (0-based) of the optical axis.  [default: the image's middle]",
    ] = None,
    joint: Annotated[bool, "Fit the telescope's state to all stars together."] = False,
    plot: Annotated[File | None, "PNG: wavefronts over the field."] = None,
    seed: Annotated[int, click.IntRange(min=0), "Seed of the search."] = 0,
    overwrite: Annotated[bool, "Replace files that exist."] = False,
    *,
    out: Annotated[File, "FITS file for coefficients, PSFs and residuals."],
) -> None:
    """Measure the aberrations of a known telescope from the stars in INPUT.

    INPUT is a FITS image with --catalogue or --detect, or a cube of stamps with a catalogue. The
    field angle of a star is in the columns x_deg, y_deg of the list, or follows from its position.
    Two modes of a star are two wavefronts that its image does not tell apart.
    """
    # Refuse options that do not fit together, and outputs that exist.
    if options.all_extensions:
        raise SensingError("psfdae wavefront takes one image: name it with --extension")
    if options.colour_column:
        raise SensingError("psfdae wavefront takes light of one colour: no --colour-column")
    source = options.source(stars)
    list_path = out.with_name(f"{out.stem}_stars.csv") if options.detect else None
    check_targets((*source.files(), telescope), out, plot, list_path, overwrite=overwrite)
    optics = read_telescope(telescope)
    observation = source.open(stamp_px)
    _check_scale(observation, optics)
    field_deg = _field_angles(observation, source.catalogue, optics, axis)
    # All stars are one piece: the joint fit takes them together.
    stamps = next(observation.chunks(observation.count))
    wavefronts = measure_wavefronts(stamps, optics, field_deg=field_deg, joint=joint, seed=seed)
    lines = [observation.said(), *_list_note(wavefronts, observation), *_report(wavefronts)]
    if list_path is not None:
        write_list(observation, list_path)
    if plot is not None:
        from psfdae.sensing.plot import wavefront_map

        write_png(wavefront_map(wavefronts, f"{source.path.name}: {optics.name}"), plot)
    # The FITS file is written last: if it exists, everything is done.
    write_fits(out, _as_fits(wavefronts, source.path.name))
    # Many stars that no wavefront explains mean that the description of the telescope is wrong.
    count, unexplained = len(wavefronts.stamps), int((~wavefronts.explained).sum())
    summary = (
        f"{out}: {count} stars, {unexplained} not explained ({unexplained / count:.1%}), "
        f"χ² {np.nanmedian(wavefronts.chi2):.2f} median"
    )
    if unexplained > 0.1 * count:
        summary += ": the telescope, its seeing or the prior are not those of the image"
    print("\n".join([*lines, summary]))


def _list_note(wavefronts: Wavefronts, observation: Observation) -> list[str]:
    """Return a sentence on how far stars are off the positions of their list, if there is one.

    This is no mistake of the list: aberrations such as coma move the light of a star.
    """
    if observation.shape is None or observation.positions is None:
        return []
    # Centroid of the light of the fitted star, in pixels of its stamp (Σ x I / Σ I); the chief
    # ray, about which PSFs are centred, is elsewhere if there is coma.
    rows, columns = np.indices(wavefronts.model.shape[1:])
    total = wavefronts.model.sum(axis=(1, 2))
    centroid = np.stack(
        [(wavefronts.model * index).sum(axis=(1, 2)) / total for index in (columns, rows)]
    )
    # From pixels of the stamp to those of the image: add the stamp's first pixel.
    corner = central_pixel(observation.positions.T) - wavefronts.model.shape[-1] // 2
    offset = centroid + corner - observation.positions.T
    offset = np.where(wavefronts.explained, offset, np.nan).T
    note = list_offset(observation.catalogue, offset, accept=True)
    return [] if note is None else [note]


def _check_scale(observation: Observation, telescope: OwnTelescope) -> None:
    """Refuse an image with pixels of another scale than the telescope's.

    Raises
    ------
    SensingError
        If they differ by more than `SCALE_TOLERANCE`.
    """
    scale, telescope_scale = observation.pixel_scale_arcsec, telescope.pixel_scale_arcsec
    # "not <=" refuses a scale that is not a number, too.
    if scale is not None and not abs(scale / telescope_scale - 1.0) <= SCALE_TOLERANCE:
        raise SensingError(
            f"{observation.path}: pixels of {scale:.6g} arcsec, but those of the telescope "
            f"{telescope.name!r} are {telescope_scale:.6g} arcsec (tolerance "
            f"{100 * SCALE_TOLERANCE:g} %)"
        )


def _field_angles(
    observation: Observation,
    catalogue: StarList | None,
    telescope: OwnTelescope,
    axis: tuple[float, float] | None,
) -> np.ndarray:
    """Return the field angles of the stars: listed ones, or those of their pixel positions.

    Parameters
    ----------
    observation : Observation
        The image or cube with n stars.
    catalogue : StarList or None
        The star list, perhaps with columns x_deg and y_deg.
    telescope : OwnTelescope
        Gives the angle of a pixel.
    axis : tuple of float or None
        Pixel x, y of the optical axis, by default the middle of the image. If it is stated,
        angles in the list are not used.

    Returns
    -------
    ndarray, shape (n, 2)
        x and y in degrees, along columns and rows.

    Raises
    ------
    SensingError
        If neither the list has angles, nor the stars positions in an image.
    """
    if catalogue is not None and axis is None:
        table = as_catalogue(catalogue)
        if {"x_deg", "y_deg"} <= set(table.table.colnames):
            angle = np.stack([table.numbers("x_deg"), table.numbers("y_deg")], axis=1)
            # --on-image has removed stars from the observation, but not from the list.
            if len(table) != observation.count:
                raise SensingError(f"{table.path}: --on-image takes no list with x_deg, y_deg")
            incomplete = ~np.isfinite(angle).all(axis=1)
            if incomplete.any():
                row = incomplete.argmax() + 1
                raise SensingError(f"{table.path}: no x_deg, y_deg in row {row}")
            return angle
    positions, shape = observation.positions, observation.shape
    if axis is None and shape is not None:
        axis = (0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1))
    if positions is None or axis is None:
        raise SensingError(
            f"{observation.path}: the stars' field angles are not known: a star list with columns "
            "x_deg, y_deg, an image, or --axis with positions says them"
        )
    # Distance from the axis in pixels, times arcseconds per pixel, in degrees.
    angle = (positions - np.asarray(axis)) * telescope.pixel_scale_arcsec / 3600.0
    if not np.isfinite(angle).all():
        raise SensingError(f"{observation.path}: stars without a position (--on-image leaves out)")
    return np.asarray(angle)


def _as_fits(wavefronts: Wavefronts, image: str) -> HDUList:
    """Return the FITS file with all results.

    Its extensions are WAVEFRONT (table), PSF, UNCERT, MODEL, RESIDUAL (cubes), COVAR and, with
    a joint fit, JOINT (table).
    """
    from astropy.io import fits

    primary = fits.PrimaryHDU()
    prior = wavefronts.telescope.prior
    for card in (
        ("CREATOR", f"psfdae {__version__}", ""),
        ("INFILE", ascii_line(image), "stars"),
        ("TELESCOP", wavefronts.telescope.name, "its description gave the optics"),
        ("WAVELEN", wavefronts.telescope.wavelength_m, "[m] wavelength"),
        ("PRIORFRA", prior.fraction, "prior: standard deviation, part of each term"),
        ("NSTARS", len(wavefronts.stamps), "stars"),
        ("NPOOR", int((~wavefronts.explained).sum()), "stars that no wavefront explains"),
    ):
        primary.header.append(card)
    # A row for each mode of a star, that is, each wavefront that its image does not exclude.
    modes = wavefronts.table
    if modes["id"].dtype.kind == "U":
        modes["id"] = fits_values(modes["id"])
    table = fits.table_to_hdu(modes)
    table.name = "WAVEFRONT"
    table.header["COMMENT"] = "Coefficients and their errors are in waves; a row per star and mode."
    # Covariances of the coefficients of each mode; NaN for stars without usable pixels, which
    # have a row in the table, but no mode.
    of_modes = wavefronts.summary["covariance"]
    covariance = np.full((len(modes), *of_modes.shape[1:]), np.nan)
    covariance[np.isfinite(modes["probability"])] = of_modes
    psf, psf_error = wavefronts.psf_and_error()
    sky = wavefronts.measured()["sky"][:, None, None]
    residual = np.where(
        wavefronts.stamps.bad | wavefronts.stamps.saturated,
        np.nan,
        wavefronts.stamps.data - sky - wavefronts.model,
    )
    hdus = [primary, table]
    for name, values, comment in (
        ("PSF", psf, "whole light 1, chief ray in the middle"),
        ("UNCERT", psf_error, "standard deviation of PSF"),
        ("MODEL", wavefronts.model, "star without sky, unit of the input"),
        ("RESIDUAL", residual, "stamp minus sky minus model, NaN where unused"),
        ("COVAR", covariance, "of the coefficients, squared waves; row by row"),
    ):
        hdu = fits.ImageHDU(values.astype(np.float32), name=name)
        hdu.header["COMMENT"] = comment
        hdus.append(hdu)
    # State of the telescope, if one was fitted to all stars: a row for each of its numbers.
    if wavefronts.joint is not None:
        joint = wavefronts.joint
        state = fits.table_to_hdu(joint.table)
        state.name = "JOINT"
        state.header["PROB"] = (joint.probability, "of this state against its twin")
        hdus.append(state)
    return fits.HDUList(hdus)


def _report(wavefronts: Wavefronts) -> list[str]:
    """Return a table of the errors of one star, and sentences on the modes and the telescope."""
    terms, summary = wavefronts.terms, wavefronts.summary
    # Modes stand star by star, the most probable one first: the first row of each star.
    first = np.flatnonzero(np.diff(summary["star"], prepend=-1))
    error = np.sqrt(np.einsum("mkk->mk", summary["covariance"][first]))
    wavelength_nm = wavefronts.wavelength_nm
    lines = [
        f"prior of {wavefronts.telescope.name}: every coefficient about the telescope's own, with "
        "the standard deviation of the column prior",
        f"{'term':12}{'prior':>10}{'error':>10}{'error':>10}   of one star, median of {len(first)}",
        f"{'':12}{'(waves)':>10}{'(waves)':>10}{'(nm)':>10}",
    ]
    for k, name in enumerate(terms.names):
        prior = np.median(terms.sd[summary["star"][first], k])
        term_error = np.median(error[:, k])
        lines.append(f"{name:12}{prior:10.4f}{term_error:10.4f}{wavelength_nm * term_error:10.2f}")
    rms_nm = wavelength_nm * np.nanmedian(wavefronts.rms[0])
    ambiguous = np.mean(summary["probability"][first] < 0.95)
    lines.append(
        f"RMS of the wavefronts {rms_nm:.3g} nm in the median; {ambiguous:.0%} of the stars have a "
        "second wavefront with a probability above 5 %"
    )
    return lines if wavefronts.joint is None else lines + _joint_report(wavefronts.joint)


def _joint_report(joint: Joint) -> list[str]:
    """Return a table of the telescope's state, and sentences on how well stars determine it."""
    lines = [
        f"the telescope, from {joint.star.size} stars together:",
        f"{'number':16}{'unit':>6}{'prior':>12}{'± ':>11}{'found':>12}{'± ':>11}",
    ]
    form = "{:16}{:>6}{:12.4g}{:11.2g}{:12.4g}{:11.2g}"
    lines += [
        form.format(*row)
        for row in joint.table["name", "unit", "prior", "prior_error", "value", "error"]
    ]
    # Two numbers that change the image alike are known worse than their errors suggest, each by
    # itself: name pairs with a correlation above 0.5.
    correlated = np.argwhere(np.triu(np.abs(joint.correlation) > 0.5, 1))
    if len(correlated):
        pairs = [
            f"{joint.model.names[i]}, {joint.model.names[j]} {joint.correlation[i, j]:+.2f}"
            for i, j in correlated
        ]
        lines.append(f"correlations of errors: {'; '.join(pairs)}")
    if joint.twin is not None:
        lines.append(
            f"its probability is {joint.probability:.3f}; the twin, of the other sign of focus, "
            f"astigmatism and spherical aberration, has the rest"
        )
    disagreeing = int(joint.disagrees.sum())
    lines.append(
        f"{disagreeing} of {joint.star.size} stars disagree with it by more than 4 σ of their χ²"
    )
    return lines
