"""Errors of refined PSFs against the distance of the wavefronts from which the optics start.

    python studies/posterior_network/starts.py > studies/posterior_network/starts.csv

Starts are the true wavefronts of stars of the prior, with normal errors of the same standard
deviation in all eight coefficients. A star has one start and no network.
"""

from __future__ import annotations

import csv
import sys

import numpy as np

from psfdae.base.threads import limit_threads
from psfdae.training.star_sets import noise_model
from psfdae_paper.bounds.estimates import build_stamp_model
from psfdae_paper.bounds.posterior_network import FreshStars, WavefrontCoordinates
from psfdae_paper.bounds.refinement import NetworkStarts, Refiner, SeidelPrior
from psfdae_paper.configuration.compose import load, part
from psfdae_paper.configuration.consistency import SIMULATION

STARS, LEVELS, DISTANCES = 150, {"dataset3": 1e-3, "dataset5": 7e-4}, (0.0, 0.03, 0.07, 0.15)


def main():
    """Print a row for each dataset, number of expansions and distance."""
    limit_threads(1)
    names = "dataset", "noise_level", "start_error_waves", "expansions", "mse", "median", "variance"
    writer = csv.writer(sys.stdout)
    writer.writerow(names)
    for dataset, value in LEVELS.items():
        config = load([f"dataset={dataset}"])
        simulation, noise = part(SIMULATION, config.model_dump()), noise_model(config)
        model = build_stamp_model(simulation)
        prior = SeidelPrior(model.mean, model.sd, model.field, model.telescope.pixel)
        optics = model.telescope.obscuration, model.framing.stamp_px, noise
        fields = np.ones(len(model.field), bool)
        rng, level = np.random.default_rng(0), np.full(STARS, value)
        stars = FreshStars.simulate(simulation, "starts", STARS, fields).draw(STARS, rng)
        side = model.framing.stamp_px
        noisy = noise.draw(stars.stamps.reshape(-1, side, side), level, rng)
        truth = WavefrontCoordinates.decode(stars.wavefront, prior.pixel)
        for distance in DISTANCES:
            start = truth + distance * rng.standard_normal(truth.shape)
            # Without a network's PSF there is one climb, which ends after the last expansion.
            root = WavefrontCoordinates.to_coordinates / max(distance, 1e-3)
            precision = np.broadcast_to(root.T @ root, (STARS, 1, 8, 8))
            proposals = start[:, None], precision, np.ones((STARS, 1))
            anything = NetworkStarts(*proposals, stars.stamps, np.full(stars.stamps.shape, np.inf))
            for expansions in (2, 3):
                Refiner.max_steps, Refiner.linear_waves = expansions, 0.0
                refined = Refiner(prior, *optics).refine(noisy, level, anything)
                error = np.square(refined.psf - stars.stamps).mean(axis=1)
                values = error.mean(), np.median(error), refined.variance.mean()
                row = dataset, value, distance, expansions, *(f"{v:.3g}" for v in values)
                writer.writerow(row)


if __name__ == "__main__":
    main()
