"""Output of measured wavefronts: the FITS file with all results, and the report for a terminal.

Inputs: `psfdae.sensing.results.Wavefronts`. The command `psfdae wavefront` writes the file and
prints the report.
"""

from __future__ import annotations

import numpy as np

from psfdae.base.types import HDUList
from psfdae.base.version import __version__
from psfdae.image.errors import ascii_line
from psfdae.image.tables import fits_values
from psfdae.sensing.joint import Joint
from psfdae.sensing.results import Wavefronts


def wavefront_hdus(wavefronts: Wavefronts, image: str) -> HDUList:
    """Return the FITS file with all results.

    Parameters
    ----------
    wavefronts : Wavefronts
        Measured wavefronts, with a joint fit or without.
    image : str
        Name of the image, for the header.

    Returns
    -------
    HDUList
        WAVEFRONT, a table with a row for each star and mode; PSF, UNCERT, MODEL and RESIDUAL,
        cubes with a stamp for each star; COVAR, the covariance of the coefficients for each row
        of the table; with a joint fit, JOINT, a table with a row for each number of the telescope.
    """
    from astropy.io import fits

    # Header: image, telescope and prior of the measurement.
    primary = fits.PrimaryHDU()
    prior = wavefronts.telescope.prior
    primary.header.extend(
        [
            ("CREATOR", f"psfdae {__version__}", ""),
            ("INFILE", ascii_line(image), "stars"),
            ("TELESCOP", wavefronts.telescope.name, "its description gave the optics"),
            ("WAVELEN", wavefronts.telescope.wavelength_m, "[m] wavelength"),
            ("PRIORFRA", prior.fraction, "prior: standard deviation, part of each term"),
            ("NSTARS", len(wavefronts.stamps), "stars"),
            ("NPOOR", int((~wavefronts.explained).sum()), "stars that no wavefront explains"),
        ]
    )
    # A row for each mode of a star: each wavefront that is compatible with its image.
    modes = wavefronts.table
    # Names of stars are ASCII in FITS.
    if modes["id"].dtype.kind == "U":
        modes["id"] = fits_values(modes["id"])
    table = fits.table_to_hdu(modes)
    table.name = "WAVEFRONT"
    table.header["COMMENT"] = "Coefficients and their errors are in waves; a row per star and mode."
    # Covariances of the coefficients of each mode; NaN for stars without usable pixels, which have
    # a row in the table but no mode.
    of_modes = wavefronts.summary["covariance"]
    covariance = np.full((len(modes), *of_modes.shape[1:]), np.nan)
    covariance[np.isfinite(modes["probability"])] = of_modes
    # Images of each star: its PSF with errors, and the residuals of the used pixels.
    psf, psf_error = wavefronts.psf_and_error()
    hdus = [primary, table]
    for name, values, comment in (
        ("PSF", psf, "whole light 1, chief ray in the middle"),
        ("UNCERT", psf_error, "standard deviation of PSF"),
        ("MODEL", wavefronts.model, "star without sky, unit of the input"),
        ("RESIDUAL", wavefronts.residual, "stamp minus sky minus model, NaN where unused"),
        ("COVAR", covariance, "of the coefficients, squared waves; row by row"),
    ):
        hdu = fits.ImageHDU(values.astype(np.float32), name=name)
        hdu.header["COMMENT"] = comment
        hdus.append(hdu)
    # State of the telescope, if it was fitted to all stars: a row for each of its numbers.
    if wavefronts.joint is not None:
        joint = wavefronts.joint
        state = fits.table_to_hdu(joint.table)
        state.name = "JOINT"
        state.header["PROB"] = (joint.probability, "of this state against its twin")
        hdus.append(state)
    return fits.HDUList(hdus)


def report_lines(wavefronts: Wavefronts) -> list[str]:
    """Return a table of the errors of a single star, and sentences on the modes and the telescope.

    Errors are medians over the stars, in waves and in nanometres.

    Returns
    -------
    list of str
        Lines for a terminal.
    """
    terms, summary = wavefronts.terms, wavefronts.summary
    # First row of each star: modes are sorted by star, the most probable one first.
    first = np.flatnonzero(np.diff(summary["star"], prepend=-1))
    error = np.sqrt(np.einsum("mkk->mk", summary["covariance"][first]))
    wavelength_nm = wavefronts.wavelength_nm
    lines = [
        f"prior of {wavefronts.telescope.name}: every coefficient about the telescope's own, with "
        "the standard deviation of the column prior",
        f"{'term':12}{'prior':>10}{'error':>10}{'error':>10}   of one star, median of {len(first)}",
        f"{'':12}{'(waves)':>10}{'(waves)':>10}{'(nm)':>10}",
    ]
    # A line for each coefficient. The prior may differ from star to star, as the aberrations do.
    for k, name in enumerate(terms.names):
        prior = np.median(terms.sd[summary["star"][first], k])
        term_error = np.median(error[:, k])
        lines.append(f"{name:12}{prior:10.4f}{term_error:10.4f}{wavelength_nm * term_error:10.2f}")
    # One wave of OPD is a wavelength.
    rms_nm = wavelength_nm * np.nanmedian(wavefronts.rms[0])
    # If the best mode has less than 95 %, another one is compatible with the image, too.
    ambiguous = np.mean(summary["probability"][first] < 0.95)
    lines.append(
        f"RMS of the wavefronts {rms_nm:.3g} nm in the median; {ambiguous:.0%} of the stars have a "
        "second wavefront with a probability above 5 %"
    )
    return lines if wavefronts.joint is None else lines + joint_report_lines(wavefronts.joint)


def joint_report_lines(joint: Joint) -> list[str]:
    """Return a table of the telescope's state, and sentences on the accuracy of the state.

    The table has the prior of each number and its fitted value, both with standard deviations.

    Returns
    -------
    list of str
        Lines for a terminal.
    """
    lines = [
        f"the telescope, from {joint.star.size} stars together:",
        f"{'number':16}{'unit':>6}{'prior':>12}{'± ':>11}{'found':>12}{'± ':>11}",
    ]
    form = "{:16}{:>6}{:12.4g}{:11.2g}{:12.4g}{:11.2g}"
    lines += [
        form.format(*row)
        for row in joint.table["name", "unit", "prior", "prior_error", "value", "error"]
    ]
    # Errors of two numbers with a similar effect on the image are correlated: pairs with a
    # correlation above 0.5 are named.
    correlated_pairs = np.argwhere(np.triu(np.abs(joint.correlation) > 0.5, 1))
    if len(correlated_pairs):
        pairs = [
            f"{joint.model.names[i]}, {joint.model.names[j]} {joint.correlation[i, j]:+.2f}"
            for i, j in correlated_pairs
        ]
        lines.append(f"correlations of errors: {'; '.join(pairs)}")
    # A pupil that is equal at opposite points hides the sign of the even aberrations.
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
