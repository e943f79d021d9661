"""Photometry of held-out stars: errors of flux and centre, and whether the predicted errors hold.

In: a model, bright stars, and their images degraded to low S/N. Out: a table with a row for each
S/N, of which the report page (`psfdae.report.page`) shows the most important columns.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from psfdae.base.types import Table
from psfdae.denoise.flux_model import signal_to_noise
from psfdae.denoise.star_model import StarModel
from psfdae.image.tables import rows_to_table
from psfdae.methods.metrics import cluster_mean
from psfdae.training.calibration import COVERAGE
from psfdae.training.star_sets import field_positions, own_noise, star_area
from psfdae.training.stars import ImageStars


def measure_photometry(
    model: StarModel, stars: ImageStars, denoised_images: Mapping[float, Mapping[str, np.ndarray]]
) -> Table:
    """Measure held-out stars of flux 1 at each noise level λ, from their stamps and places alone.

    The model is given neither flux, sky, noise nor centre. The bright star that is the truth has
    noise itself, which counts in every error.

    Parameters
    ----------
    model : StarModel
        Model that measures the stars.
    stars : ImageStars
        Bright stars, some of them held out.
    denoised_images : mapping of float to mapping of str to ndarray, shape (n, d, d)
        Degraded images (`noisy`) by noise level λ.

    Returns
    -------
    Table
        Rows by S/N, ascending: `lost`, the part of the stars without a usable flux; bias of the
        flux, its pull, RMS error of the centre in px; and the parts of fluxes, coordinates of
        centres and pixels whose errors are within the predicted ones. A column that ends in
        `_stderr` is the standard error of the one before it, clustered by star.
    """
    product, test = stars.product, stars.split.test
    kappa, background = stars.settings.noise.kappa, stars.settings.noise.background_photons
    area = star_area(product, stars.split.train)
    star, truth = product["field_index"][test], product[stars.reference][test]
    # Errors of the truth: of its flux and pixels by its noise, of its centre by a fit.
    truth_errors = own_noise(product, product[stars.reference], background)
    truth_flux_error, truth_sigma = (errors[test] for errors in truth_errors)
    positions, noise = field_positions(product)[test], product["noise"][star]
    bright = model.predict(truth, flux=1.0, background=0.0, noise=noise, position=positions)
    levels, count = sorted(denoised_images, reverse=True), len(test)  # S/N ascending
    # The gain that makes σ = √B / gain the sky noise of stars of flux 1.
    gain = np.sqrt(background) / (kappa * np.repeat(levels, count))
    noisy = np.concatenate([denoised_images[level]["noisy"] for level in levels])
    estimates = model.predict(noisy, gain=gain, position=np.tile(positions, (len(levels), 1)))
    rows = []
    for number, level in enumerate(levels):
        estimate = estimates.of(slice(number * count, (number + 1) * count))
        # Stars that have a flux and an error of it.
        usable = np.isfinite(estimate.psf).all(axis=(1, 2)) & (estimate.flux_error > 0)
        # Offsets of the centre, and their standard errors, along x and y.
        offset = np.stack([estimate.x_fit - bright.x_fit, estimate.y_fit - bright.y_fit])
        offset_error = np.stack(
            [np.hypot(estimate.x_error, bright.x_error), np.hypot(estimate.y_error, bright.y_error)]
        )
        # Pull of the flux: its error over the standard error, with the error of the truth.
        pull = np.abs(estimate.flux - 1.0) / np.hypot(estimate.flux_error, truth_flux_error)
        # Bias, quantile of the pull, and RMS of the distance of the centres.
        flux_bias, flux_bias_stderr = usable_mean(estimate.flux - 1.0, star, usable)
        flux_pull = float(np.quantile(pull[usable], COVERAGE)) if usable.any() else np.nan
        mean_square_px = usable_mean(np.square(offset).sum(axis=0), star, usable)[0]
        row = {
            "snr": signal_to_noise(kappa * level, area),
            "lost": float(1.0 - usable.mean()),
            "flux_bias": flux_bias,
            "flux_bias_stderr": flux_bias_stderr,
            "flux_pull": flux_pull,
            "centre_rms_px": mean_square_px**0.5,
        }
        # Coverage: fraction of errors within the predicted ones.
        pixel_error = np.hypot(estimate.uncertainty, truth_sigma)
        has_centre = np.isfinite(offset).all(axis=0)
        coverage = {
            "flux": np.where(usable, pull < 1.0, np.nan),
            "centre": np.where(has_centre, (np.abs(offset) < offset_error).mean(axis=0), np.nan),
            "psf": (np.abs(estimate.psf - truth) < pixel_error).mean(axis=(1, 2)),
        }
        for name, fraction in coverage.items():
            row[f"{name}_within"], row[f"{name}_within_stderr"] = usable_mean(
                fraction, star, usable
            )
        rows.append(row)
    return rows_to_table(rows)


def usable_mean(values: np.ndarray, star: np.ndarray, usable: np.ndarray) -> tuple[float, float]:
    """Return the mean of usable images and its standard error, clustered by star; NaN if none is.

    `values`, `star` and the mask `usable` have the shape (n,).

    Parameters
    ----------
    values, star : ndarray, shape (n,)
        Value of each image, and number of the star that it shows.
    usable : ndarray of bool, shape (n,)
        True for images that are averaged.
    """
    return cluster_mean(values[usable], star[usable]) if usable.any() else (np.nan, np.nan)
