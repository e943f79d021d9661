"""Errors of refined PSFs against the distance of the wavefronts from which the optics start.

    python studies/posterior_network/starts.py > studies/posterior_network/starts.csv

Starts are the true wavefronts of stars of the prior, with normal errors of the same standard
deviation in all eight coefficients. A star has one start and no network.
"""

from __future__ import annotations

import csv
import sys
from typing import NamedTuple

import numpy as np

from psfdae.base.threads import limit_threads
from psfdae.training.star_sets import noise_model
from psfdae_paper.bounds.estimates import build_stamp_model
from psfdae_paper.bounds.posterior_network import FreshStars, WavefrontCoordinates
from psfdae_paper.bounds.refinement import NetworkStarts, Refiner
from psfdae_paper.configuration.compose import load, part
from psfdae_paper.configuration.consistency import SIMULATION

STARS, LEVELS, DISTANCES = 150, {"dataset3": 1e-3, "dataset5": 7e-4}, (0.0, 0.03, 0.07, 0.15)


class NoisyStars(NamedTuple):
    """Noisy stars of the prior with their truth, and the optics that refine their wavefronts.

    Stamps are of shape (n, P), noisy images (n, d, d), true coefficients (n, 8).
    """

    refiner: Refiner
    stamps: np.ndarray
    noisy: np.ndarray
    level: np.ndarray
    truth: np.ndarray
    rng: np.random.Generator

    @classmethod
    def simulate(cls, dataset, value, name, count):
        """Draw stars of a dataset at a noise level, of the random stream of a name."""
        config = load([f"dataset={dataset}"])
        simulation, noise = part(SIMULATION, config.model_dump()), noise_model(config)
        model = build_stamp_model(simulation)
        side, refiner = model.framing.stamp_px, Refiner.from_model(model, noise)
        fields, rng = np.ones(len(model.field), bool), np.random.default_rng(0)
        stars = FreshStars.simulate(simulation, name, count, fields).draw(count, rng)
        level = np.full(count, value)
        noisy = noise.draw(stars.stamps.reshape(-1, side, side), level, rng)
        truth = WavefrontCoordinates.decode(stars.wavefront, refiner.prior.pixel)
        return cls(refiner, stars.stamps, noisy, level, truth, rng)


def main():
    """Print a row for each dataset, number of expansions and distance."""
    limit_threads(1)
    Refiner.positions = (0.0,)
    names = "dataset", "noise_level", "start_error_waves", "expansions", "mse", "median", "variance"
    writer = csv.writer(sys.stdout)
    writer.writerow(names)
    for dataset, value in LEVELS.items():
        refiner, stamps, noisy, level, truth, rng = NoisyStars.simulate(
            dataset, value, "starts", STARS
        )
        for distance in DISTANCES:
            start = truth + distance * rng.standard_normal(truth.shape)
            # Without a network's PSF there is one climb, which ends after the last expansion.
            root = WavefrontCoordinates.to_coordinates / max(distance, 1e-3)
            precision = np.broadcast_to(root.T @ root, (STARS, 1, 8, 8))
            proposals = start[:, None], precision, np.ones((STARS, 1))
            anything = NetworkStarts(*proposals, stamps, np.full(stamps.shape, np.inf))
            for expansions in (2, 3):
                Refiner.max_steps, Refiner.linear_waves = expansions, 0.0
                refined = refiner.refine(noisy, level, anything)
                error = np.square(refined.psf - stamps).mean(axis=1)
                values = error.mean(), np.median(error), refined.variance.mean()
                row = dataset, value, distance, expansions, *(f"{v:.3g}" for v in values)
                writer.writerow(row)


if __name__ == "__main__":
    main()
