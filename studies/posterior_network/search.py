"""Errors and time of refined PSFs with and without a new search for unexplained stars.

    python studies/posterior_network/search.py > studies/posterior_network/search.csv

Four proposals of each star are its true wavefront with normal errors, whose standard deviation
differs from star to star: log-normal with a median of 0.15 waves in each coefficient. There is no
network. The first row of a dataset has climbs from the true wavefronts. One thread.
"""

from __future__ import annotations

import csv
import sys
from time import process_time

import numpy as np
from starts import NoisyStars

from psfdae.base.threads import limit_threads
from psfdae.sensing.climbing import compute_deviance_limit
from psfdae_paper.bounds.posterior_network import WavefrontCoordinates
from psfdae_paper.bounds.refinement import NetworkStarts, Refiner

STARS, LEVELS, MEDIAN_ERROR = 400, {"dataset3": 1e-3, "dataset5": 7e-4}, 0.15
WEIGHTS = (0.55, 0.25, 0.12, 0.08)


def main():
    """Print a row for each dataset and kind of start."""
    limit_threads(1)
    names = "dataset", "noise_level", "starts", "mse", "median", "unexplained", "ms_per_star"
    writer = csv.writer(sys.stdout)
    writer.writerow(names)
    for dataset, value in LEVELS.items():
        refiner, stamps, noisy, level, truth, rng = NoisyStars.simulate(
            dataset, value, "search", STARS
        )
        flux, noise = refiner.noise.flux(value), refiner.noise
        counts = np.rint(flux * noisy.reshape(STARS, -1)) + noise.background
        # Proposals with known scatter; without a network's PSF.
        sd = MEDIAN_ERROR * np.exp(0.7 * rng.standard_normal((STARS, 1, 1)))
        points = truth[:, None] + sd * rng.standard_normal((STARS, len(WEIGHTS), 8))
        root = WavefrontCoordinates.to_coordinates
        precision = np.tile(root.T @ root, (len(WEIGHTS), 1, 1)) / sd[..., None] ** 2
        psf = stamps, np.ones_like(stamps)
        proposals = NetworkStarts(points, precision, np.tile(WEIGHTS, (STARS, 1)), *psf)
        only = np.zeros((STARS, 1, 8, 8)), np.ones((STARS, 1))
        from_truth = NetworkStarts(truth[:, None], *only, *psf)
        # Propagators are made before the time is measured.
        refiner.refine(noisy, level, proposals)
        for name, starts, limit in (
            ("truth", from_truth, 4.0),
            ("proposals", proposals, np.inf),
            ("proposals and search", proposals, 4.0),
        ):
            Refiner.misfit_sigma, start = limit, process_time()
            refined = refiner.refine(noisy, level, starts)
            seconds = process_time() - start
            error = np.square(refined.psf - stamps).mean(axis=1)
            mean_counts = flux * refined.psf + noise.background
            chi2 = (np.square(counts - mean_counts) / mean_counts).sum(axis=1)
            values = error.mean(), np.median(error)
            misfits = np.mean(chi2 > compute_deviance_limit(counts.shape[1]))
            row = dataset, value, name, *(f"{v:.3g}" for v in values), f"{misfits:.4f}"
            writer.writerow([*row, f"{1e3 * seconds / STARS:.2f}"])


if __name__ == "__main__":
    main()
