"""Errors of the DAE trained with the instructions of different processors.

    python studies/seed_scatter/processors.py DATASET STARS ATTEMPTS PRECISION OUT

appends rows to the CSV OUT: mean squared error and SSIM of the test stars of the random split at
each noise level, for each attempt of the training (0 is the run's own), trained on realisations.
STARS is the file of the dataset's stars. PRECISION is `half` (bfloat16 in the second half of the
epochs, as on processors with AVX-512 BF16) or `single` (as on others). With the environment
variables ATEN_CPU_CAPABILITY=avx2 ONEDNN_MAX_CPU_ISA=AVX2 torch uses no AVX-512.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pandas as pd
import torch

from psfdae.base.files import read_product
from psfdae.methods.dae import Dae
from psfdae.methods.metrics import mse, ssim
from psfdae.methods.networks.dae import DaeTraining, run_network
from psfdae.training.star_sets import noisy_test_images, split_stars, training_set
from psfdae_paper.configuration.compose import load
from psfdae_paper.source import git_commit


def main(dataset: str, stars: str, attempts: str, precision: str, out: str) -> None:
    """Train with every attempt, measure, append."""
    torch.set_num_threads(1)
    if precision == "single":
        DaeTraining.half_precision_start = 1.0
    config = load([f"dataset={dataset}"])
    product = read_product(Path(stars), "stars")
    data = training_set(config, Dae, product, "random", "realisation")
    test = split_stars(product, "random", config).test
    truth = product["realisation"][test]
    for attempt in map(int, attempts.split(",")):
        start = time.process_time()
        training = DaeTraining(data, config.dae, config.train, config.seed, attempt)
        while not training.is_finished():
            training.run_epoch()
        training.model.load_state_dict(training.result)
        rows = []
        for level in config.noise.levels:
            noisy = noisy_test_images(config, product, test, level)
            estimate = run_network(training.model, noisy, training.factor)
            rows.append(
                {
                    "commit": git_commit()[:7],
                    "dataset": dataset,
                    "instructions": os.environ.get("ATEN_CPU_CAPABILITY", "avx512"),
                    "precision": precision,
                    "attempt": attempt,
                    "noise_level": level,
                    "mse": f"{mse(estimate, truth).mean():.5g}",
                    "ssim": f"{ssim(estimate, truth, config.evaluation.data_range).mean():.6f}",
                    "cpu_s": f"{time.process_time() - start:.1f}",
                }
            )
        pd.DataFrame(rows).to_csv(out, mode="a", header=not Path(out).exists(), index=False)


if __name__ == "__main__":
    main(*sys.argv[1:])
