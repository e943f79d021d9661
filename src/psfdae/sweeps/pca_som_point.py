"""A point of a sweep over PCA+SOM."""

from __future__ import annotations

import time
from typing import Any

from psfdae.estimators import FitError
from psfdae.estimators.pca_som import PcaSom
from psfdae.files import read_product
from psfdae.stages.common import limit_threads, read_stars
from psfdae.stages.fit import baseline, training_set
from psfdae.sweeps.measured import Measured, Task, measure_images, stage_part

FILES = ("pca_som.h5",)


FAILURES = (FitError,)


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
    FitError
        If there are fewer stars to fit than components.
    """
    part = stage_part("baseline", config)
    stars, place = task.data["stars"], task.folder / FILES[0]
    data = training_set(part, PcaSom, read_stars(stars, "template"), task.split, task.reference)
    validating = PcaSom.fit(data.without_validation(), **PcaSom.settings(part))
    started, started_cpu = time.monotonic(), time.process_time()
    baseline(part, stars, task.split, out=place)
    seconds, cpu_seconds = time.monotonic() - started, time.process_time() - started_cpu
    limit_threads(config.evaluation.threads)
    metrics = measure_images(config, task, "pca_som", validating, PcaSom.load(place))
    described = read_product(place, "pca_som", ()).config
    return Measured(
        metrics=metrics,
        described={**read_product(stars, "stars", ()).config, **described},
        seconds=round(seconds, 3),
        cpu_seconds=round(cpu_seconds, 3),
    )
