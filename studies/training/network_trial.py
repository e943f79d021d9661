"""Trainings of scene 3's networks under other settings: seconds and errors on uniform states.

    python studies/training/network_trial.py KIND TRIAL RESULTS OUT [KEY=VALUE ...]

RESULTS is the folder of a run that has the states of scene 3 and its DAE
(data/alignment/train.h5 and uniform.h5, alignment/dae). A row per noise level is appended to the
CSV OUT. KEY=VALUE are overrides of the configuration.
"""

from __future__ import annotations

import sys
import tempfile
import time
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd

from psfdae.base.files import read_product
from psfdae.methods.dae import Dae
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import load, load_stage
from psfdae_paper.configuration.estimators import ESTIMATORS
from psfdae_paper.source import git_commit
from psfdae_paper.stages.alignment_methods import (
    denoise,
    draw_test_stamps,
    load_predictor,
    network_groups,
    train_network,
)


def main(kind: str, trial: str, results: str, out: str, *overrides: str) -> None:
    """Train, measure, append."""
    root = Path(results)
    states, dae = root / "data/alignment", root / "alignment/dae"
    words = [*Alignment.choice, *overrides]
    config, settings = load(words), load_stage(network_groups(kind), words)
    test = read_product(states / "uniform.h5", "alignment_states", ("states", "stamps"))
    network = None
    if ESTIMATORS[kind].uses_dae:
        network = Dae.load(dae, evaluation=config.evaluation)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        started = time.process_time()
        train_network(
            settings, kind, states / "train.h5", folder / "checkpoint.pt", folder, network and dae
        )
        seconds = time.process_time() - started
        predict, rows = load_predictor(folder, test, config), []
        for level in config.noise.levels:
            noisy = draw_test_stamps(config, test["stamps"], "uniform", level)
            inputs = denoise(network, noisy) if network else noisy
            error = np.abs(predict(inputs) - test["states"]).mean()
            row = dict(network=kind, trial=trial, settings=" ".join(overrides))
            row |= dict(noise_level=level, mean_abs_error=error, cpu_s=seconds)
            rows.append(row | dict(date=date.today().isoformat(), commit=git_commit()))
    table, new = pd.DataFrame(rows), not Path(out).exists()
    table.to_csv(out, mode="a", header=new, index=False, float_format="%.5g")


if __name__ == "__main__":
    main(*sys.argv[1:])
