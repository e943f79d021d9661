"""Strange stars that a fit of `errors.py` finds, and its errors on stars of POPPY.

    python studies/posterior_network/checks.py RESULTS DATASET FIT.h5 OUT.csv

Strange stars are found at 1 % of false alarms: by the evidence of the refined wavefronts, and by
the outlier score of a Gaussian mixture. Stars of POPPY have the errors of stars of the simulation
if both optics are the same. Flux, sky and noise level are known. One thread.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import torch
from errors import SPLIT, STARS

from psfdae.base.files import read_product
from psfdae.base.rng import stream
from psfdae.base.threads import limit_threads
from psfdae.methods import method
from psfdae.training.star_sets import training_set
from psfdae_paper.bounds.estimates import read_test_stars
from psfdae_paper.configuration.compose import load

sys.path.insert(0, str(Path(__file__).parents[2] / "workflow/benchmarks"))
from prediction import FALSE_ALARMS, NOISY_EACH, changed_stars, poppy_stars

POPPY_STARS = 400


def compare_scores(methods, images, config, noise):
    """Yield the part of strange stars above the limit, by noise level, kind and method."""
    kinds = changed_stars(np.tile(images, (NOISY_EACH, 1, 1)), stream(config.seed, "strange"))
    for level in config.noise.levels:
        limits = {}
        for kind, stamps in kinds.items():
            rng = stream(config.seed, "strange", f"{level:g}", kind)
            noisy, levels = noise.draw(stamps, level, rng), np.full(len(stamps), level)
            for name, fitted in methods.items():
                score = fitted.outlier_score(noisy, levels)
                if score is None:
                    score = fitted.estimate(noisy, levels).outlier_score
                limits.setdefault(name, np.quantile(score, 1.0 - FALSE_ALARMS))
                found = np.mean(score > limits[name])
                yield {"quantity": kind, "level": level, "method": name, "value": f"{found:.4f}"}


def compare_with_poppy(fitted, tested, config, noise):
    """Yield the mean errors of POPPY's stars over the errors of test stars, and its error."""
    images = poppy_stars(config, POPPY_STARS)
    for level in config.noise.levels:
        noisy = noise.draw(images, level, stream(config.seed, "poppy", f"{level:g}"))
        errors = [
            np.square(fitted.estimate(stamps, level).psf - truth).mean(axis=(1, 2))
            for stamps, truth in (
                (noisy, images),
                (tested.noisy[level], tested.truth["realisation"]),
            )
        ]
        mean, error = np.array([(e.mean(), e.std() / e.size**0.5 / e.mean()) for e in errors]).T
        ratio = mean[0] / mean[1]
        quantities = ("poppy ratio", ratio), ("its error", ratio * np.hypot(*error))
        for quantity, value in quantities:
            row = {"quantity": quantity, "level": level, "method": fitted.name}
            yield row | {"value": f"{value:.4f}"}


def main(results, dataset, place, out):
    """Write the table of both comparisons."""
    limit_threads(1)
    torch.set_num_threads(1)
    config = load([f"dataset={dataset}"])
    product = read_product(Path(results) / STARS[dataset], "stars")
    refined, mixture = method("posterior_network_refined").load(Path(place)), method("gmm")
    data = training_set(config, mixture, product, SPLIT, "realisation")
    methods = {refined.name: refined, mixture.name: mixture.fit(data, **mixture.settings(config))}
    tested = read_test_stars(config, product)
    rows = [
        *compare_scores(methods, tested.truth["realisation"], config, data.noise),
        *compare_with_poppy(refined, tested, config, data.noise),
    ]
    with Path(out).open("w", newline="") as file:
        writer = csv.DictWriter(file, ["dataset", *rows[0]])
        writer.writeheader()
        writer.writerows({"dataset": dataset, **row} for row in rows)


if __name__ == "__main__":
    main(*sys.argv[1:])
