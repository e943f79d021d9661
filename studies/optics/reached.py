"""How near the optics of the telescope come to the least possible error, and what they miss.

    python studies/optics/reached.py RESULTS DATASET OUT.csv

RESULTS is the folder of a run with the targets `wavefront` and `bounds`. Both are paired star by
star. A mode is missed if the climb from the truth ends e¹⁰ times as likely as every mode found;
modes are sought for all stars here, also for those of which the bank alone says enough.
"""

from __future__ import annotations

import subprocess
import sys
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd

from psfdae.base.files import read_product
from psfdae.base.threads import limit_threads
from psfdae.methods import method
from psfdae.methods.metrics import cluster_mean
from psfdae.training.star_sets import field_positions, training_set
from psfdae_paper.bounds.estimates import get_true_modes, read_test_stars
from psfdae_paper.bounds.mode_search import climb
from psfdae_paper.bounds.stamp_model import StarPosteriors
from psfdae_paper.configuration.compose import load

BOUND_OF = {"wavefront": "bayes", "wavefront_position": "bayes_position"}
MISSED = 10.0
KEY = ["reference", "noise_level", "star", "field"]


def main(results: Path, dataset: str, out: Path) -> None:
    """Compare, and seek modes once more."""
    limit_threads(1)
    config = load([f"dataset={dataset}"])
    name = config.stars.name
    product = read_product(results / "data" / config.scene.name / f"{name}.h5", "stars")
    bank = read_product(results / "bounds/bank" / f"{name}.h5", "bank").arrays
    estimates = pd.read_parquet(results / "wavefront" / f"{dataset}.parquet")
    bounds = pd.read_parquet(results / "bounds" / f"{dataset}.parquet")
    summary = pd.read_csv(results / "bounds" / f"{dataset}.csv").query("metric == 'mse'")
    floors = bounds[bounds.method == "floor"].rename(columns={"mse": "mse_floor"})
    rows = []
    for optics, bound in BOUND_OF.items():
        missed = misses(config, product, bank, optics)
        limits = bounds[bounds.method == bound]
        joined = estimates[estimates.method == optics].merge(
            limits, on=KEY, suffixes=("", "_bound")
        )
        for (reference, level), pairs in joined.groupby(["reference", "noise_level"]):
            pair = pairs[np.isfinite(pairs.mse_bound)]
            mse, stderr = cluster_mean(pair.mse.to_numpy(), pair.field.to_numpy())
            gap = (pair.mse - pair.mse_bound).to_numpy()
            limit = pair.mse_bound.mean()
            tight = summary.query("method == @bound and reference == @reference")
            tight = tight[np.isclose(tight.noise_level, level)].tight.iloc[0]
            row = {"dataset": dataset, "method": optics, "reference": reference}
            row |= {"noise_level": level, "mse": mse, "stderr": stderr, "bound": limit}
            row |= {"tight": tight, "ratio": mse / limit}
            row |= {"ratio_stderr": cluster_mean(gap, pair.field.to_numpy())[1] / limit}
            row["flagged"] = int((pairs.is_explained == 0).sum())
            if reference == "realisation":
                floor = floors[np.isclose(floors.noise_level, level)]
                floored = pairs.merge(floor[["star", "mse_floor"]], on="star")
                row["median_over_floor"] = (floored.mse / floored.mse_floor).median()
                missing, doubtful = missed[level]
                row |= {"missed": len(missing), "missed_flagged": len(set(missing) & set(doubtful))}
                row["others_flagged"] = len(set(doubtful) - set(missing))
            rows.append(row | {"n": len(pairs)})
            print(rows[-1], flush=True)
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    table = pd.DataFrame(rows).assign(date=date.today().isoformat(), commit=commit)
    table.to_csv(out, index=False, float_format="%.5g")


def misses(config, product, bank, optics) -> dict:
    """Return by noise level the stars whose better mode is missed, and those that are flagged."""
    kind = method(optics)
    data = training_set(config, kind, product, "random", "realisation")
    fitted = kind.from_bank(bank, config, data)
    stars = read_test_stars(config, product)
    position, count = field_positions(product)[stars.star], len(stars.star)
    truth = get_true_modes(fitted.model, product, stars)
    by_level = {}
    for level, noisy in stars.noisy.items():
        modes, doubtful = fitted.modes(noisy, level, position)
        summits = climb(truth, StarPosteriors(noisy, fitted.likelihood(level), fitted.model))
        highest = np.full(count, -np.inf)
        np.maximum.at(highest, modes.star, modes.evidence)
        missing = summits.star[summits.evidence > highest[summits.star] + MISSED]
        by_level[level] = missing.tolist(), doubtful.tolist()
    return by_level


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
