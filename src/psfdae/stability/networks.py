"""Small trainings that several cases use."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from psfdae.models.dae import Dae, DaeTraining, TrainingSet
from psfdae.stability.bench import Bench

STARS = 250
"""Training stars of the network whose arithmetic is tested."""


def training_set(bench: Bench, count: int) -> TrainingSet:
    """The first stars of scene 1 against themselves; one in ten validates."""
    images = bench.seidel.images[:count]
    held = max(1, len(images) // 10)
    return TrainingSet(
        images=images,
        references=images,
        fit=np.arange(held, len(images)),
        validation=np.arange(held),
        levels=np.asarray(bench.config.noise.levels),
        noise=bench.noise,
    )


@lru_cache(maxsize=1)
def trained_network(bench: Bench) -> Dae:
    """The configured network after a few steps: weights as they occur in use."""
    settings = bench.config.train.model_copy(
        update={"epochs": 3, "batch": 25, "threads": 1, "schedule": "onecycle", "patience": 0}
    )
    training = DaeTraining(training_set(bench, STARS), bench.config.dae, settings, bench.seed, 0)
    for _ in range(settings.epochs):
        training.run_epoch()
    return training.model.eval()


def rounding_of(config: Any) -> float:
    """Single-precision rounding of a forward pass over its largest output.

    Every layer sums kernel² · width terms; their roundings add at random.
    """
    terms = sum(kernel**2 for kernel in config.kernels) * max(config.widths)
    return float(np.finfo(np.float32).eps) * float(np.sqrt(terms))
