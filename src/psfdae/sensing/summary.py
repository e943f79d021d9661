"""Summaries of measured wavefronts: the mode of each draw, and the table of modes.

In: draws from the posteriors of the stars with their modes, or `psfdae.sensing.results.Wavefronts`,
whose property `table` is made here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.sensing.stars import StarModes

if TYPE_CHECKING:
    from astropy.table import Table

    from psfdae.sensing.results import Wavefronts


def nearest_modes(draws: np.ndarray, modes: StarModes) -> np.ndarray:
    """Return the number of the mode that is nearest to every draw by the Mahalanobis distance.

    Parameters
    ----------
    draws : ndarray, shape (m, s, K + 4)
        m draws for each of the s stars with modes: coefficients, place, flux and sky in the units
        of `StarModes.parameters`.
    modes : StarModes

    Returns
    -------
    ndarray of int, shape (m, s)
        Numbers from 0 among all modes.
    """
    nearest = np.empty(draws.shape[:2], int)
    for row, star in enumerate(modes.best_modes.star):
        # Squared distance (x − μ)ᵀ C⁻¹ (x − μ) of all draws from all modes of the star.
        numbers = np.flatnonzero(modes.star == star)
        gap = draws[row][None] - modes.parameters[numbers][:, None]
        precision = np.linalg.inv(modes.covariance[numbers])
        distance = np.einsum("mni,mij,mnj->mn", gap, precision, gap)
        nearest[row] = numbers[distance.argmin(axis=0)]
    return nearest


def summarise_modes(
    coefficients: np.ndarray, mode_of_draw: np.ndarray, modes: StarModes, prior_sigma: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the table of posterior modes, by star and the most probable first.

    Parameters
    ----------
    coefficients : ndarray, shape (m, s, K)
        Draws of the coefficients in waves.
    mode_of_draw : ndarray of int, shape (m, s)
        Result of `nearest_modes`.
    modes : StarModes
    prior_sigma : ndarray, shape (n, K)
        Standard deviation of the prior of all n stars, in waves.

    Returns
    -------
    dict of ndarray
        `star` (M,), its number; `probability` (M,), the part of its draws; `mean` (M, K) and
        `covariance` (M, K, K) of the coefficients in waves.
    """
    # Draws belong to the mode that is nearest; a mode without draws is left out.
    k = coefficients.shape[-1]
    rows: list[tuple[Any, ...]] = []
    for row, star in enumerate(modes.best_modes.star):
        # The probability of a mode is its fraction of the star's draws.
        numbers, count = np.unique(mode_of_draw[row], return_counts=True)
        for mode in numbers[np.argsort(-count, kind="stable")]:
            draws = coefficients[row, mode_of_draw[row] == mode]
            # Too few draws have no useful covariance: that of the peak takes its place.
            if len(draws) > 2 * k:
                covariance = np.atleast_2d(np.cov(draws, rowvar=False))
            else:
                covariance = modes.covariance[mode, :k, :k] * np.outer(
                    prior_sigma[star], prior_sigma[star]
                )
            probability = len(draws) / coefficients.shape[1]
            rows.append((star, probability, draws.mean(axis=0), covariance))
    names, columns = ("star", "probability", "mean", "covariance"), zip(*rows, strict=True)
    return {name: np.array(values) for name, values in zip(names, columns, strict=True)}


def wavefront_table(wavefronts: Wavefronts) -> Table:
    """Return the table with a row for every star and mode; see `Wavefronts.table`."""
    from astropy.table import Column, Table

    # Rows of the summary, then one for each star without usable pixels, ordered by star.
    summary, stamps = wavefronts.summary, wavefronts.stamps
    star = np.append(summary["star"], np.setdiff1d(np.arange(len(stamps)), wavefronts.star))
    unusable = np.full(star.size - summary["star"].size, np.nan)
    order = np.argsort(star, kind="stable")
    star = star[order]

    def completed(values: np.ndarray) -> np.ndarray:
        # Values of the summary, and NaN for stars that it has not.
        return np.append(values, unusable)[order]

    columns: list[tuple[str, np.ndarray, str | None]] = [
        ("id", stamps.id[star], None),
        # Number of the mode: rows since the first one of the star.
        ("mode", np.arange(star.size) - np.searchsorted(star, star), None),
        ("probability", completed(summary["probability"]), None),
        ("explained", wavefronts.explained[star], None),
        ("chi2", wavefronts.chi2[star], None),
        ("snr", wavefronts.snr[star], None),
        ("x_deg", wavefronts.field_deg[star, 0], "deg"),
        ("y_deg", wavefronts.field_deg[star, 1], "deg"),
    ]
    for k, name in enumerate(wavefronts.terms.names):
        # Coefficients with the standard deviation of their mode.
        error = np.sqrt(summary["covariance"][:, k, k])
        columns.append((name, completed(summary["mean"][:, k]), "wave"))
        columns.append((f"{name}_error", completed(error), "wave"))
    # The RMS is that of the whole posterior, the same for all modes of a star.
    for name, waves in zip(("rms", "rms_error"), wavefronts.rms, strict=True):
        columns.append((name, wavefronts.wavelength_nm * waves[star], "nm"))
    for name, values in wavefronts.measured().items():
        columns.append((name, values[star], "pix" if name[0] in "xy" else None))
    table = Table()
    for name, values, unit in columns:
        # A wave is no unit of the FITS standard; the description has it.
        fits_unit = None if unit == "wave" else unit
        table[name] = Column(values, unit=fits_unit, description=unit)
    return table
