"""A point of a sweep over denoising autoencoders."""

from __future__ import annotations

from typing import Any

from psfdae.estimators import CONFIG, HISTORY
from psfdae.estimators.dae import WEIGHTS, Dae
from psfdae.files import read_product
from psfdae.models.training import TrainingError
from psfdae.reading import read_table, read_yaml
from psfdae.stages.common import limit_threads
from psfdae.stages.fit import train
from psfdae.sweeps.measured import Measured, Task, measure_images, stage_part

FILES = (WEIGHTS, CONFIG, HISTORY)
FAILURES = (TrainingError,)


def run(config: Any, task: Task) -> Measured:
    """Train as the stage `train` does, and measure.

    Parameters
    ----------
    config : stage config (seed, noise, parts, dae, train, evaluation)
    task : Task

    Raises TrainingError if the training cannot go on.
    """

    part = stage_part("train", config)
    stars = task.data["stars"]
    train(part, stars, task.split, task.reference, task.checkpoint, out=task.folder)
    limit_threads(config.evaluation.threads)
    network = Dae.load(task.folder, evaluation=config.evaluation)
    metrics = measure_images(config, task, "dae", network, network)
    described = read_yaml(task.folder / CONFIG)
    attempt = described.pop("attempt")
    last = read_table(task.folder / HISTORY).iloc[-1]
    return Measured(
        metrics=metrics,
        described={**read_product(stars, "stars", ()).config, **described},
        seconds=float(last["seconds"]),
        cpu_seconds=float(last["cpu_seconds"]),
        epochs=int(last["epoch"]),
        stopped=int(last["epoch"]) < config.train.epochs,
        attempt=attempt,
    )
