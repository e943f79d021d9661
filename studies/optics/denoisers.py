"""Errors and times of denoisers that know no star, per dataset.

    python studies/optics/denoisers.py RESULTS DATASET OUT.csv

RESULTS is the folder of a run (`make reproduce`), of which the noise-free stars are read. The test
stars are those of the error bounds, with the same noise. One thread.

The benchmark times the best of them on datasets 3 and 5 (`workflow/benchmarks/denoisers.py`).
"""

from __future__ import annotations

import subprocess
import sys
import time
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd

from psfdae.base.threads import limit_threads
from psfdae.methods.lmmse import LinearMmse
from psfdae.methods.metrics import cluster_mean, mse
from psfdae.training.star_sets import read_stars, training_set
from psfdae_paper.bounds.estimates import read_test_stars
from psfdae_paper.configuration.compose import load

sys.path.append(str(Path(__file__).parents[2] / "workflow/benchmarks"))
from denoisers import Denoisers, nl_means, tv, wavelet


def main(results: Path, dataset: str, out: Path) -> None:
    """Measure the methods on one dataset."""
    limit_threads(1)
    config = load([f"dataset={dataset}"])
    place = results / "data" / config.scene.name / f"{config.stars.name}.h5"
    product = read_stars(place, "template")
    stars = read_test_stars(config, product)
    rows = []

    def add(name, level, reference, error, seconds):
        mean, stderr = cluster_mean(error, stars.field)
        rows.append(
            {
                "dataset": dataset,
                "method": name,
                "reference": reference,
                "noise_level": level,
                "mse": mean,
                "stderr": stderr,
                "median": np.median(error),
                "n": error.size,
                "ms_per_star": 1000 * seconds / error.size,
            }
        )
        print(rows[-1], flush=True)

    for denoise in (wavelet, nl_means, tv):
        for reference in config.dataset.references:
            # Stars and noise of a method that is told the noise level.
            data = training_set(config, LinearMmse, product, "random", reference)
            fitted = Denoisers.fit(data, (denoise,))
            for level, noisy in stars.noisy.items():
                started = time.process_time()
                psf = fitted.predict(noisy, level)
                took = time.process_time() - started
                add(denoise.__name__, level, reference, mse(psf, stars.truth[reference]), took)
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    table = pd.DataFrame(rows).assign(date=date.today().isoformat(), commit=commit)
    table.to_csv(out, index=False, float_format="%.5g")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
