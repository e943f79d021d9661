"""Errors, coverage and time of a network, alone and with wavefronts that the optics refine.

    python studies/posterior_network/errors.py RESULTS DATASET FIT.h5 OUT.csv [OVERRIDE ...]

RESULTS is the folder of a run with the stars of DATASET; settings are changed by overrides such as
posterior_network.epochs=8, or seed=1; test stars stay the same. The least possible errors are those
of the run of record. The fit is written to FIT.h5, or read from there if it exists, and its history
to FIT.csv; `fit_cpu_s` is the CPU time of its epochs. One thread.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from time import process_time

import numpy as np
import pandas as pd
import torch

from psfdae.base.files import read_product
from psfdae.base.threads import limit_threads
from psfdae.methods import method
from psfdae.methods.interface import HISTORY
from psfdae.methods.metrics import mse
from psfdae.training.star_sets import training_set
from psfdae_paper.bounds.estimates import SPLIT, read_test_stars
from psfdae_paper.configuration.compose import load

ROOT = Path(__file__).parents[2]
STARS = {"dataset3": "data/seidel/seidel_10pct.h5", "dataset5": "data/seidel/seidel_50pct.h5"}


def read_least_errors(dataset):
    """Return the error of the posterior mean by noise level, and whether it is tight."""
    table = pd.read_csv(ROOT / "results/reference/tables/psf_bounds.csv", low_memory=False)
    query = "dataset == @dataset and reference == 'realisation' and metric == 'mse'"
    rows = table.query(f"{query} and method == 'bayes'").set_index("noise_level")
    return rows[["value", "tight"]]


def measure(fitted, config, tested, dataset):
    """Yield a row of errors for each noise level."""
    truth, least = tested.truth["realisation"], read_least_errors(dataset)
    for level in config.noise.levels:
        noisy = tested.noisy[level]
        fitted.estimate(noisy[:2], level)
        start = process_time()
        estimate = fitted.estimate(noisy, level)
        seconds = process_time() - start
        error, ratio = mse(estimate.psf, truth).mean(), np.abs(estimate.psf - truth)
        ratio /= estimate.sigma
        levels, ratio95 = fitted.calibration
        ratio95 = np.interp(np.log(level), np.log(levels), ratio95)
        yield {
            "noise_level": level,
            "mse": f"{error:.4e}",
            "mse_least": f"{least.value[level]:.4e}",
            "tight": least.tight[level],
            "over_least": f"{error / least.value[level]:.3f}",
            "coverage68": f"{(ratio < 1).mean():.4f}",
            "coverage95": f"{(ratio < ratio95).mean():.4f}",
            "ms_per_star": f"{1e3 * seconds / len(noisy):.3f}",
        }


def fit(data, config, place):
    """Fit the network with its optics, and save it with its settings and its history."""
    refined, groups = method("posterior_network_refined"), ("seed", "noise", "posterior_network")
    fitted = refined.fit(data, config.posterior_network)
    history = pd.DataFrame(fitted.diagnostic_rows[HISTORY])
    history.to_csv(place.with_suffix(".csv"), index=False)
    # Epochs of both trainings follow one another. Their times are of all runs of a fit.
    epochs = config.posterior_network.epochs
    cpu_s = {"network": history.cpu_seconds[epochs - 1], "both": history.cpu_seconds.iloc[-1]}
    fitted.save(place, {**config.model_dump(include={*groups}), "fit_cpu_s": cpu_s})


def main(results, dataset, place, out, *overrides):
    """Fit the network with its optics, and append rows to a table."""
    limit_threads(1)
    torch.set_num_threads(1)
    config = load([f"dataset={dataset}", *overrides])
    product = read_product(Path(results) / STARS[dataset], "stars")
    refined, place = method("posterior_network_refined"), Path(place)
    if not place.exists():
        kinds = config, refined, product, SPLIT, "realisation"
        fit(training_set(*kinds, checkpoint=place.with_suffix(".pt")), config, place)
    fitted, settings = refined.load(place), refined.read_config(place)
    tested, path = read_test_stars(load([f"dataset={dataset}"]), product), Path(out)
    # The network alone is a part of the same fit.
    alone = method("posterior_network")(fitted.network)
    methods = {
        "posterior_network": (alone, "network"),
        "posterior_network_refined": (fitted, "both"),
    }
    rows = [
        {
            "dataset": dataset,
            "method": name,
            "seed": settings["seed"],
            "epochs": settings["posterior_network"]["epochs"],
            "stars_per_epoch": settings["posterior_network"]["stars"],
            "fit_cpu_s": f"{settings['fit_cpu_s'][trainings]:.1f}",
            **row,
        }
        for name, (kind, trainings) in methods.items()
        for row in measure(kind, config, tested, dataset)
    ]
    is_new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        if is_new:
            writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main(*sys.argv[1:])
