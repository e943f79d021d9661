"""Errors and times of methods that know the telescope, and of classical denoisers, per dataset.

    python studies/optics/optics.py RESULTS DATASET OUT.csv

RESULTS is the folder of a run (`make reproduce`), of which the noise-free stars are read. The test
stars are those of the error bounds, with the same noise. One thread.
"""

from __future__ import annotations

import subprocess
import sys
import time
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd

from psfdae.methods import method
from psfdae.methods.gmm import Gmm
from psfdae.metrics import clustered_mean, mse
from psfdae.model.star_sets import field_positions, read_stars, training_set
from psfdae.threads import limit_threads
from psfdae_paper.bounds.estimates import bounded_stars, static_psfs
from psfdae_paper.configuration.compose import load

DENOISERS = ("wavelet", "nl_means", "tv")
OPTICS = ("wavefront", "wavefront_position")
AT_ONCE = 210


def main(results: Path, dataset: str, out: Path) -> None:
    """Measure the methods on one dataset."""
    limit_threads(1)
    config = load([f"dataset={dataset}"])
    place = results / "data" / config.scene.name / f"{config.stars.name}.h5"
    product = read_stars(place, "template")
    stars = bounded_stars(config, product)
    rows = []

    def add(name, level, reference, error, seconds, missed):
        mean, stderr = clustered_mean(error, stars.field)
        rows.append(
            {
                "dataset": dataset,
                "method": name,
                "reference": reference,
                "noise_level": level,
                "mse": mean,
                "stderr": stderr,
                "median": np.median(error),
                "missed": missed,
                "n": error.size,
                "ms_per_star": 1000 * seconds / error.size,
            }
        )
        print(rows[-1], flush=True)

    for name in DENOISERS:
        kind = method(name)
        for reference in config.dataset.references:
            fitted = kind.fit(training_set(config, kind, product, "random", reference))
            for level, noisy in stars.noisy.items():
                started = time.process_time()
                psf = fitted.predict(noisy, level)
                took = time.process_time() - started
                add(name, level, reference, mse(psf, stars.truth[reference]), took, 0)
    if config.scene.name == "seidel" and config.stars.aberration_fraction:
        optics(config, product, stars, add)
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=True
    ).stdout.strip()
    table = pd.DataFrame(rows).assign(date=date.today().isoformat(), commit=commit)
    table.to_csv(out, index=False, float_format="%.5g")


def optics(config, product, stars, add) -> None:
    """Both references from the same samples; missed stars have the mixture's PSF."""
    position = field_positions(product)[stars.star]
    static = static_psfs(config)
    for name in OPTICS:
        kind = method(name)
        fits = {
            reference: kind.fallback.fit(
                training_set(config, kind.fallback, product, "random", reference), Gmm()
            )
            for reference in stars.truth
        }
        fitted = kind.fit(training_set(config, kind, product, "random", "realisation"))
        for level, noisy in stars.noisy.items():
            psf = {r: np.array(fit.restore(noisy, level, position)) for r, fit in fits.items()}
            started, missed = time.process_time(), 0
            for start in range(0, len(noisy), AT_ONCE):
                block = np.arange(start, min(start + AT_ONCE, len(noisy)))
                sums, known = fitted.posterior(noisy[block], level, position[block], start)
                missed += int((~known).sum())
                means = {"realisation": sums.mean_image, "template": sums.template(static)[0]}
                for reference, mean in means.items():
                    psf[reference][block[known]] = mean[known].reshape(-1, *noisy.shape[1:])
            took = time.process_time() - started
            for reference, truth in stars.truth.items():
                add(name, level, reference, mse(psf[reference], truth), took, missed)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], Path(sys.argv[3]))
