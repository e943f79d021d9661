"""Which proposals of a fit of `errors.py` to refine: errors of the optics against expansions.

    python studies/posterior_network/proposals.py DATASET LEVEL FIT.h5 > OUT.csv

Fresh stars of the prior. The last row has climbs from the true wavefronts. Prints to stderr how
well an image determines coma if the other coefficients are known, and the mean probability of the
most likely proposal.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np

from psfdae.base.threads import limit_threads
from psfdae.methods import method
from psfdae_paper.bounds.posterior_network import FreshStars, WavefrontCoordinates
from psfdae_paper.bounds.refinement import NetworkStarts, Refiner
from psfdae_paper.configuration.compose import load, part
from psfdae_paper.configuration.consistency import SIMULATION

STARS = 200
RULES = [  # maximum number of proposals, total probability of the others, gap of the evidence
    *((1, 0.0, np.inf), (2, 0.0, np.inf), (4, 0.0, np.inf), (8, 0.0, np.inf)),
    *((8, 0.2, np.inf), (8, 0.1, np.inf), (8, 0.05, np.inf)),
    *((8, 0.1, 0.0), (8, 0.1, 6.0), (8, 0.05, 6.0), (4, 0.1, 6.0), (4, 0.05, 6.0)),
]


def main(dataset, level, place):
    """Print a row for each rule."""
    limit_threads(1)
    simulation = part(SIMULATION, load([f"dataset={dataset}"]).model_dump())
    fitted = method("posterior_network_refined").load(Path(place))
    refiner, rng = fitted.refiner, np.random.default_rng(0)
    fields = np.ones(len(refiner.prior.field), bool)
    stars = FreshStars.simulate(simulation, "proposals", STARS, fields).draw(STARS, rng)
    levels, side = np.full(STARS, float(level)), refiner.stamp_px
    noisy = refiner.noise.draw(stars.stamps.reshape(-1, side, side), levels, rng)
    starts = NetworkStarts.compute(
        fitted.network, fitted.proposer, noisy, levels, refiner.prior.pixel
    )
    truth = WavefrontCoordinates.decode(stars.wavefront, refiner.prior.pixel)
    only = np.zeros((STARS, 1, 8, 8)), np.ones((STARS, 1)), starts.psf, starts.variance
    from_truth, expansions = NetworkStarts(truth[:, None], *only), []
    # Count the stars of all expansions.
    measure = Refiner.measure

    def count(self, point, *arrays):
        expansions.append(len(point))
        return measure(self, point, *arrays)

    Refiner.measure = count
    writer = csv.writer(sys.stdout)
    writer.writerow(["max_proposals", "min_weight", "max_gap", "expansions", "mse", "median"])
    for rule, start in [*((rule, starts) for rule in RULES), (("truth", 0, 0), from_truth)]:
        limits = (1, 0.0, np.inf) if start is from_truth else rule
        Refiner.max_proposals, Refiner.min_weight, Refiner.max_gap = limits
        expansions.clear()
        error = np.square(refiner.refine(noisy, levels, start).psf - stars.stamps).mean(axis=1)
        values = sum(expansions) / STARS, error.mean(), np.median(error)
        writer.writerow([*rule, *(f"{value:.3g}" for value in values)])
    # Posterior about the true wavefronts.
    flux = refiner.noise.flux(levels)
    counts = np.rint(flux[:, None] * noisy.reshape(STARS, -1)) + refiner.noise.background
    every_field = np.broadcast_to(np.arange(fields.size), (STARS, fields.size))
    _, covariance = refiner.expand(truth, counts, flux, every_field).components.moments()
    # Error of a coefficient if all others are known, over its error.
    precision = np.linalg.inv(covariance + 1e-12 * np.eye(8))
    ratio = 1.0 / np.sqrt(np.einsum("nii,nii->ni", covariance, precision))
    print(f"coma: conditional error over error {np.median(ratio[:, 1:3]):.3f}", file=sys.stderr)
    print(f"first proposal: probability {starts.weight[:, 0].mean():.3f}", file=sys.stderr)


if __name__ == "__main__":
    main(*sys.argv[1:])
