"""Trainings of the DAE that differ in their seed alone, under several schedules.

    python studies/seed_scatter/scatter.py DATASET TRIAL SEEDS STARS OUT [KEY=VALUE ...]

appends a row per seed and noise level to the CSV OUT: the mean squared error of the test
stars, and what the network's layers are like. KEY=VALUE are settings of the group `train`, or
one of those in `Trial`.
"""

from __future__ import annotations

import csv
import sys
import time
from dataclasses import dataclass, fields
from datetime import date
from pathlib import Path

import numpy as np
import torch
from torch.optim.lr_scheduler import OneCycleLR

from psfdae.base.files import read_product
from psfdae.methods.dae import Dae
from psfdae.methods.networks.dae import DaeTraining, run_network
from psfdae.training.star_sets import noisy_test_images, split_stars, training_set
from psfdae_paper.configuration.compose import load
from psfdae_paper.source import git_commit

AVERAGES = (0.98, 0.99, 0.995)
"""Decays of the moving averages of the weights, a step of the optimiser each."""


COLUMNS = ["date", "commit", "dataset", "trial", "settings", "weights", "seed", "noise_level"]
COLUMNS += ["mse", "mse_of_mean", "flux_error2", "validation_mse", "alive", "cpu_s"]


@dataclass
class Trial:
    """Schedule of a training, where it differs from the one in use."""

    warm: float = 0.3  # part of the steps in which the rate rises
    course: str = "cos"  # of the rate: cos or linear


class TrialTraining(DaeTraining):
    """A training with a trial's schedule, and moving averages of its weights."""

    def __init__(self, trial: Trial, *arguments) -> None:
        super().__init__(*arguments)
        self.trial = trial
        total = self.settings.epochs * self.steps
        if self.settings.schedule == "onecycle":
            self.scheduler = OneCycleLR(
                self.optimiser,
                self.settings.lr,
                total_steps=total,
                pct_start=trial.warm,
                anneal_strategy=trial.course,
            )
        self.averages = {
            decay: [p.detach().clone() for p in self.model.parameters()] for decay in AVERAGES
        }

    def take_step(self, batch, step: int) -> float:
        value = super().take_step(batch, step)
        with torch.no_grad():
            now = list(self.model.parameters())
            for decay, mean in self.averages.items():
                torch._foreach_lerp_(mean, now, 1 - decay)
        return value


@torch.inference_mode()
def alive(model, images: np.ndarray, factor: float) -> str:
    """Channels of each layer that are above zero in any pixel of some images."""
    x, counts = torch.from_numpy(images)[:, None] * factor, []
    for layer in model.layers:
        x = torch.relu(layer(x))
        counts.append(int((x.amax(dim=(0, 2, 3)) > 0).sum()))
    return " ".join(map(str, counts))


def main(dataset: str, name: str, seeds: str, stars: str, out: str, *settings: str) -> None:
    """Train with every seed, measure, append."""
    torch.set_num_threads(1)
    trial_keys = {f.name for f in fields(Trial)}
    pairs = [text.split("=", 1) for text in settings]
    trial = Trial(**{k: type(getattr(Trial, k))(v) for k, v in pairs if k in trial_keys})
    words = [f"train.{k}={v}" for k, v in pairs if k not in trial_keys]
    config = load([f"dataset={dataset}", *words])
    product = read_product(Path(stars), "stars", ("realisation", "field_index", "grid"))
    data = training_set(config, Dae, product, "random", "realisation")
    test = split_stars(product, "random", config).test
    levels = config.noise.levels
    noisy = [noisy_test_images(config, product, test, level) for level in levels]
    truth = product["realisation"][test]
    for seed in map(int, seeds.split(",")):
        training = TrialTraining(trial, data, config.dae, config.train, seed)
        started = time.process_time()
        while not training.is_finished():
            row = training.run_epoch()
            print(
                name,
                seed,
                row["epoch"],
                f"{row['train_mse']:.3e} {row['validation_mse']:.3e}",
                flush=True,
            )
        seconds = time.process_time() - started
        model = training.model
        living = alive(model, noisy[1][:256], training.factor)
        states = {"end": training.result}
        names = [key for key, _ in model.named_parameters()]
        for decay, mean in training.averages.items():
            states[f"average {decay}"] = dict(zip(names, mean, strict=True))
        rows = []
        for weights, state in states.items():
            model.load_state_dict(state)
            for level, images in zip(levels, noisy, strict=True):
                error = run_network(model, images, training.factor) - truth
                mean = error.mean(axis=0)
                rows.append(
                    [
                        date.today(),
                        git_commit()[:7],
                        dataset,
                        name,
                        " ".join(settings),
                        weights,
                        seed,
                        level,
                        f"{np.square(error).mean(dtype=np.float64):.5g}",
                        f"{np.square(mean).mean():.4g}",
                        f"{np.square(error.sum(axis=(1, 2))).mean():.4g}",
                        f"{training.best_mse:.5g}",
                        living,
                        f"{seconds:.1f}",
                    ]
                )
        new = not Path(out).exists()
        with Path(out).open("a", newline="") as file:
            writer = csv.writer(file)
            if new:
                writer.writerow(COLUMNS)
            writer.writerows(rows)


if __name__ == "__main__":
    main(*sys.argv[1:])
