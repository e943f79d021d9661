"""A point of a sweep over PCA+SOM."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from psfdae.files import read_product
from psfdae.models.pca_som import fit_pca_som
from psfdae.rng import stream
from psfdae.stages import baseline as stage
from psfdae.stages.common import limit_threads, noise_model, read_stars, split_stars
from psfdae.stars.noise import mixed_levels
from psfdae.sweeps.measured import Measured, Task, measure_images, stage_part

FILES = ("pca_som.h5",)


class TooFewStarsError(RuntimeError):
    """There are fewer stars than components."""


FAILURES = (TooFewStarsError,)


def run(config: Any, task: Task) -> Measured:
    """Fit as the stage `baseline` does, and measure.

    That fit takes the validation stars, too, so the model that is validated is fitted
    once more without them.

    Parameters
    ----------
    config : stage config (seed, noise, parts, baseline, evaluation)
    task : Task

    Raises
    ------
    TooFewStarsError
        If there are fewer stars to fit than components.
    """
    part = stage_part("baseline", config)
    stars, model = task.data["stars"], task.folder / FILES[0]
    fit = split_stars(read_stars(stars), task.split, config).fit.size
    if config.baseline.components > fit:
        raise TooFewStarsError(
            f"baseline.components = {config.baseline.components}: must be at most {fit}, the "
            "number of training stars without those that validate"
        )
    started, started_cpu = time.monotonic(), time.process_time()
    stage.run(part, stars, task.split, model)
    seconds, cpu_seconds = time.monotonic() - started, time.process_time() - started_cpu
    validate_with = _without_validation(part, task)
    limit_threads(config.evaluation.threads)
    test_with = stage.load(model).predict
    metrics = measure_images(
        config, task, "pca_som", _ignoring(validate_with), _ignoring(test_with)
    )
    described = read_product(model, "pca_som", ()).config
    return Measured(
        metrics=metrics,
        described={**read_product(stars, "stars", ()).config, **described},
        seconds=round(seconds, 3),
        cpu_seconds=round(cpu_seconds, 3),
    )


def _without_validation(config: Any, task: Task) -> Callable[[np.ndarray], np.ndarray]:
    """The baseline of the training stars that do not validate, with noise of the same kind."""
    product = read_stars(task.data["stars"])
    fit = split_stars(product, task.split, config).fit
    rng = stream(config.seed, "noise", "baseline validation")
    levels = mixed_levels(np.asarray(config.noise.levels), fit.size, rng)
    noisy = noise_model(config).draw(product["realisation"][fit], levels, rng)
    settings = config.baseline.model_dump(exclude={"threads"})
    seed = int(stream(config.seed, "baseline", "map").integers(2**31))
    return fit_pca_som(noisy, **settings, seed=seed).predict


def _ignoring(
    predict: Callable[[np.ndarray], np.ndarray],
) -> Callable[[np.ndarray, float], np.ndarray]:
    return lambda noisy, level: predict(noisy)
