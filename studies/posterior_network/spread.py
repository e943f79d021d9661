"""Errors and time of a fit of `errors.py` against the starts of its wavefronts.

    python studies/posterior_network/spread.py RESULTS DATASET FIT.h5 OUT.csv

The network's mean has no part in these errors: they are of the refined PSFs alone. Rows have the
positions of the starts along the axis of a proposal, in its standard deviations, and how many
proposals have starts. With the true wavefront among the starts, nothing is left to find. One
thread.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from time import process_time

import numpy as np
import torch
from errors import STARS, read_least_errors

from psfdae.base.files import read_product
from psfdae.base.threads import limit_threads
from psfdae.methods import method
from psfdae.methods.metrics import mse
from psfdae.optics.wavefronts import monomial_coefficients
from psfdae_paper.bounds.estimates import read_test_stars
from psfdae_paper.bounds.refinement import Refiner
from psfdae_paper.configuration.compose import load

POSITIONS = [(0.0,), (-1.0, 1.0), (-1.5, 0.0, 1.5), (-1.5, -0.5, 0.5, 1.5)]


def add_truth(starts, prior, product, tested):
    """Return starts whose first proposal is the true wavefront, with the precision of the best."""
    star = tested.star
    truth = monomial_coefficients(product["seidel"][star], prior.field[tested.field])
    # Tilts show the image at the middle of the stamp: columns run along x, rows along y.
    offset = product["peak"][star] - product["jitter"][star]
    truth[:, -2:] -= 0.5 * prior.pixel * offset[:, ::-1]
    points = np.concatenate([truth[:, None], starts.points], axis=1)
    precision = np.concatenate([starts.precision[:, :1], starts.precision], axis=1)
    weight = np.concatenate([np.ones((len(star), 1)), starts.weight], axis=1)
    return starts._replace(points=points, precision=precision, weight=weight)


def main(results, dataset, place, out):
    """Write a row for each tight noise level and kind of starts."""
    limit_threads(1)
    torch.set_num_threads(1)
    config = load([f"dataset={dataset}"])
    product = read_product(Path(results) / STARS[dataset], "stars")
    tested, least = read_test_stars(config, product), read_least_errors(dataset)
    fitted = method("posterior_network_refined").load(Path(place))
    truth, refiner = tested.truth["realisation"], fitted.refiner
    kinds = [(positions, number, False) for positions in POSITIONS for number in (1, 3, 8)]
    kinds.append((Refiner.positions, Refiner.proposals + 1, True))
    rows = []
    for value in least.index[least.tight == "yes"]:
        noisy, level = tested.noisy[value], np.full(len(tested.star), value)
        starts, _ = fitted.refine(noisy, level)
        for positions, number, has_truth in kinds:
            Refiner.positions, Refiner.proposals = positions, number
            begin = add_truth(starts, refiner.prior, product, tested) if has_truth else starts
            start = process_time()
            refined = refiner.refine(noisy, level, begin)
            seconds = process_time() - start
            error = mse(refined.psf.reshape(truth.shape), truth).mean()
            rows.append(
                {
                    "dataset": dataset,
                    "noise_level": value,
                    "positions": " ".join(f"{position:g}" for position in positions),
                    "proposals": number,
                    "has_truth": "yes" if has_truth else "no",
                    "over_least": f"{error / least.value[value]:.3f}",
                    "ms_per_star": f"{1e3 * seconds / len(noisy):.2f}",
                }
            )
    with Path(out).open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main(*sys.argv[1:])
