"""CPU seconds of the fit of a mixture as in the workflow, and of its estimates of test stars.

    python studies/training/mixture_fit.py DATASET METHOD REFERENCE STARS OUT

METHOD is gmm or gmm_position; a row is appended to the CSV OUT.
"""

from __future__ import annotations

import sys
from datetime import date
from pathlib import Path
from time import process_time

import numpy as np
import pandas as pd

from psfdae.base.files import read_product
from psfdae.methods import method
from psfdae.training.star_sets import (
    field_positions,
    noisy_test_images,
    split_stars,
    training_set,
)
from psfdae_paper.configuration.compose import load
from psfdae_paper.source import git_commit


def main(dataset: str, name: str, reference: str, stars: str, out: str) -> None:
    """Fit, estimate at all noise levels, append."""
    kind, config = method(name), load([f"dataset={dataset}"])
    product = read_product(Path(stars), "stars", ("field_index", "grid", reference))
    data, settings = training_set(config, kind, product, "random", reference), kind.settings(config)
    start = process_time()
    fitted = kind.fit(data, **settings)
    row = dict(dataset=dataset, method=name, reference=reference, clusters=len(fitted.count))
    row |= dict(shrinkage=fitted.shrinkage[0], fit_cpu_s=process_time() - start)
    test, errors, start = split_stars(product, "random", config).test, [], process_time()
    position = field_positions(product)[test] if kind.needs.position else None
    for level in config.noise.levels:
        noisy = noisy_test_images(config, product, test, level)
        estimate = fitted.estimate(noisy, level, position)
        errors.append(np.square(estimate.psf - product[reference][test]).mean(dtype=np.float64))
    row |= dict(estimate_cpu_s=process_time() - start, mse=np.exp(np.mean(np.log(errors))))
    table = pd.DataFrame([row | dict(date=date.today().isoformat(), commit=git_commit())])
    table.to_csv(out, mode="a", header=not Path(out).exists(), index=False, float_format="%.5g")


if __name__ == "__main__":
    main(*sys.argv[1:])
