"""CPU time per star against error, of the optics at several efforts and of the other methods.

    python studies/optics/cost.py RESULTS OUT.csv

RESULTS is the folder of a run with `results/evaluation/dataset3/random-realisation.csv` and the
target `wavefront`. Dataset 3, λ = 0.001, reference realisation, test stars of the error bounds, one
thread, on a machine that does nothing else.
"""

from __future__ import annotations

import inspect
import subprocess
import sys
import time
from datetime import date
from functools import partial
from pathlib import Path

import pandas as pd

from psfdae.base.files import read_product
from psfdae.base.threads import limit_threads
from psfdae.methods import fit_files as fits
from psfdae.methods import method
from psfdae.methods.metrics import cluster_mean, mse
from psfdae.training.star_sets import field_positions, read_stars, training_set
from psfdae_paper.bounds import mode_search
from psfdae_paper.bounds.estimates import read_test_stars
from psfdae_paper.configuration.compose import load
from psfdae_paper.methods.wavefront import Wavefront
from psfdae_paper.stages.evaluate import estimators

DATASET, LEVEL, REFERENCE = "dataset3", 1e-3, "realisation"
REPEATS = 3
DEFAULT = {"starts": None, "draws": Wavefront.draws_per_star}
EFFORTS = (
    {"starts": 1, "draws": 25},
    {"starts": 2, "draws": 50},
    DEFAULT,
    {"starts": 8, "draws": 200},
    {"starts": 16, "draws": 800},
)
"""Fields (without the field) or offsets (in it) from whose best matches modes are sought."""


def main(results: Path, out: Path) -> None:
    """Write a row for each method and effort."""
    limit_threads(1)
    config = load([f"dataset={DATASET}"])
    name = config.stars.name
    product = read_stars(results / "data" / config.scene.name / f"{name}.h5", REFERENCE)
    stars = read_test_stars(config, product)
    position = field_positions(product)[stars.star]
    noisy, truth = stars.noisy[LEVEL], stars.truth[REFERENCE]
    rows = []

    def add(kind, estimator, effort, repeats=REPEATS):
        seconds = []
        for _ in range(repeats):
            started = time.process_time()
            psf = estimator.estimate(noisy, LEVEL, position).psf
            seconds.append(time.process_time() - started)
        error, stderr = cluster_mean(mse(psf, truth), stars.field)
        ms = 1000 * min(seconds) / len(noisy)
        rows.append({"method": kind.name, **effort, "mse": error, "stderr": stderr})
        rows[-1] |= {"ms_per_star": ms, "n": len(noisy)}
        print(rows[-1], flush=True)

    models = {
        n: results / fits.get_fit_path(method(n), DATASET, "random", REFERENCE)
        for n in config.methods
        if method(n).storage
    }
    for estimator in estimators(config, product, models, "random", REFERENCE).values():
        if type(estimator).look.restores:
            add(type(estimator), estimator, {"starts": None, "draws": None})
    bank = read_product(results / "bounds/bank" / f"{name}.h5", "bank").arrays
    search = mode_search.search
    defaults = inspect.signature(search).parameters
    for optics in ("wavefront", "wavefront_position"):
        kind = method(optics)
        data = training_set(config, kind, product, "random", REFERENCE)
        fitted = kind.from_bank(bank, config, data)
        _ = fitted.mixture  # fitted here, where no clock runs
        for effort in EFFORTS:
            starts = effort["starts"]
            fewer_starts = {"fields": starts, "offsets": starts} if starts else {}
            mode_search.search = partial(search, **fewer_starts)
            Wavefront.draws_per_star = effort["draws"]
            default_starts = defaults["offsets" if kind.needs.position else "fields"].default
            add(kind, fitted, effort | {"starts": starts or default_starts}, repeats=1)
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    table = pd.DataFrame(rows).assign(date=date.today().isoformat(), commit=commit)
    table.to_csv(out, index=False, float_format="%.5g")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
