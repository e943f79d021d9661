"""Errors of the networks of scene 3, trained with other seeds on the same states.

    python studies/seed_scatter/alignment.py DATA SEEDS OUT

appends rows to the CSV OUT: errors of the states in units of their ranges, on the test stamps of
the workflow with their noise, for each seed, method, test set, noise level and parameter. DATA is
the folder results/data/alignment of a run with the same settings.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import pandas as pd

from psfdae.base.files import read_product
from psfdae.methods.dae import Dae
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.evaluation.alignment_tables import tabulate_errors
from psfdae_paper.source import git_commit
from psfdae_paper.stages.alignment_methods import (
    denoise,
    draw_test_stamps,
    load_predictor,
    network_groups,
    train_dae,
    train_network,
)

NETWORKS = {"original": "grid", "noise_trained": "train"}
"""States that each network is trained on. The DAE's output goes to the network "original"."""


def train(data: Path, seed: int, folder: Path) -> None:
    """Train the DAE and the networks with a seed."""
    words = (*Alignment.choice, f"seed={seed}")
    checkpoint = folder / "checkpoint.pt"
    config = load_stage(("seed", "noise", "dae", "dae_train"), words)
    train_dae(config, data / "grid.h5", data / "train.h5", checkpoint, folder / "dae")
    for kind, states in NETWORKS.items():
        config = load_stage(network_groups(kind), words)
        train_network(config, kind, data / f"{states}.h5", checkpoint, folder / kind)


def measure(data: Path, folder: Path) -> list[dict]:
    """Measure the networks on the noisy stamps of the workflow, whose seed stays the same."""
    config = load_stage(("seed", "noise", "evaluation"), Alignment.choice)
    dae, rows = Dae.load(folder / "dae", evaluation=config.evaluation), []
    for test_set in ("uniform", "grid"):
        product = read_product(
            data / f"{test_set}.h5", "alignment_states", ("states", "stamps", "unit")
        )
        predict = {kind: load_predictor(folder / kind, product, config) for kind in NETWORKS}
        for level in config.noise.levels:
            stamps = draw_test_stamps(config, product["stamps"], test_set, level)
            estimates = {kind: predict[kind](stamps) for kind in NETWORKS}
            estimates["dae"] = predict["original"](denoise(dae, stamps))
            for method, states in estimates.items():
                key = {"test_set": test_set, "noise_level": level, "method": method}
                rows += tabulate_errors(key, states - product["states"], product["unit"])
    return [row for row in rows if row["unit"] == "range"]


def main(data: str, seeds: str, out: str) -> None:
    """Train with every seed, measure, append."""
    for seed in map(int, seeds.split(",")):
        started = time.process_time()
        with TemporaryDirectory() as folder:
            train(Path(data), seed, Path(folder))
            rows = measure(Path(data), Path(folder))
        table = pd.DataFrame(rows).drop(columns="unit")
        table.insert(0, "seed", seed)
        table.insert(0, "commit", git_commit()[:7])
        table["cpu_s"] = round(time.process_time() - started, 1)
        table.to_csv(out, mode="a", header=not Path(out).exists(), index=False)


if __name__ == "__main__":
    main(*sys.argv[1:])
