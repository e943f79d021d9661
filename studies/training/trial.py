"""Trainings of the DAE under other settings: seconds and errors of the test stars.

    python studies/training/trial.py DATASET TRIAL SEEDS STARS OUT [KEY=VALUE ...]

appends a row per seed, reference and noise level to the CSV OUT. KEY=VALUE are overrides of the
configuration, as for the workflow, or of the schedule of the learning rate: course=cos (how it
rises and falls; linear in use) and peak=0.15 (part of the steps before the peak; 0.3 in use). Or
sides=8,8,16,16:12,16 says the side in pixels of the stamps' middle that each epoch sees, of the
realisations and, after the colon, of the templates (else the same); there are as many epochs as
sides. A side is as even or odd as the stamps'. half=all or half=none lets all epochs or none
compute with half precision, not those of the second half.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pandas as pd
from torch.optim.lr_scheduler import OneCycleLR

from psfdae.base.files import read_product
from psfdae.methods.dae import Dae
from psfdae.methods.interface import HISTORY
from psfdae.methods.networks import dae, training
from psfdae.training.star_sets import noisy_test_images, split_stars, training_set
from psfdae_paper.configuration.compose import load
from psfdae_paper.source import git_commit


def with_schedule(**changes):
    """Let trainings take another one-cycle schedule."""
    training.OneCycleLR = lambda *words, **settings: OneCycleLR(*words, **{**settings, **changes})


def with_sides(text):
    """Let each epoch see the middle of stamps of a side of its own; overrides that go with it."""
    sides_px, *templates = [[int(side) for side in part.split(",")] for part in text.split(":")]
    sides = {"realisation": sides_px, "template": templates[0] if templates else sides_px}
    # All epochs but the last being cropped, their part that is over says which one it is.
    dae.middle_px = lambda _, part, reference: sides[reference][
        round(part * (len(sides[reference]) - 1))
    ]
    continued = len(sides["template"]) / len(sides_px)
    return [
        "train.crop_epochs=0.999",
        f"train.epochs={len(sides_px)}",
        f"train.continued_epochs={continued}",
    ]


def with_half_precision(epochs):
    """Let all epochs of a training, or none, compute with half precision."""
    half_precision, enabled = training.use_half_precision, {"all": True, "none": False}[epochs]
    training.use_half_precision = lambda _: half_precision(enabled)


def main(dataset: str, name: str, seeds: str, stars: str, out: str, *settings: str) -> None:
    """Train with every seed, measure, append."""
    words = dict(word.split("=", 1) for word in settings)
    keys = {"course": ("anneal_strategy", str), "peak": ("pct_start", float)}
    with_schedule(**{keys[k][0]: keys[k][1](v) for k, v in words.items() if k in keys})
    overrides = [f"{k}={v}" for k, v in words.items() if k not in {*keys, "sides", "half"}]
    overrides += with_sides(words["sides"]) if "sides" in words else []
    if "half" in words:
        with_half_precision(words["half"])
    config = load([f"dataset={dataset}", *overrides])
    references = config.dataset.references
    product = read_product(Path(stars), "stars", ("field_index", "grid", *references))
    for seed in map(int, seeds.split(",")):
        start = None
        for reference in references:
            data = training_set(config, Dae, product, "random", reference)
            if reference == "template" and config.train.continued_epochs:
                data = replace(data, start=start)
            with tempfile.TemporaryDirectory() as folder:
                data = replace(data, seed=seed, checkpoint=Path(folder) / "checkpoint")
                start = fitted = Dae.fit(data, config.dae, config.train)
            history = fitted.diagnostic_rows[HISTORY]
            lowest = np.nanmin([row["validation_mse"] for row in history])
            test = split_stars(product, "random", config).test
            rows = []
            for level in config.noise.levels:
                noisy = noisy_test_images(config, product, test, level)
                error = fitted.predict(noisy) - product[reference][test]
                row = dict(dataset=dataset, trial=name, settings=" ".join(settings), seed=seed)
                row |= dict(split="random", reference=reference, noise_level=level)
                row |= dict(mse=np.square(error).mean(dtype=np.float64), validation_mse=lowest)
                row |= dict(attempt=fitted.attempt, cpu_s=history[-1]["cpu_seconds"])
                rows.append(row | dict(date=date.today().isoformat(), commit=git_commit()))
            table, new = pd.DataFrame(rows), not Path(out).exists()
            table.to_csv(out, mode="a", header=new, index=False, float_format="%.5g")


if __name__ == "__main__":
    main(*sys.argv[1:])
