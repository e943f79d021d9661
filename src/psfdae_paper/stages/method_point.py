"""A point of a sweep over a method."""

from __future__ import annotations

import time
from pathlib import Path

from psfdae import fits
from psfdae.files import read_product
from psfdae.method import HISTORY
from psfdae.methods import groups_of, method
from psfdae.model.star_sets import read_stars, training_set
from psfdae.reading import read_table
from psfdae.threads import limit_threads
from psfdae_paper.configuration.compose import part
from psfdae_paper.configuration.schema import Config
from psfdae_paper.stages.fit import fit
from psfdae_paper.sweeps.measured import Measured, Task, fit_in, measure_images


def files_of(name: str) -> tuple[str, ...]:
    """Names of the files of a point's fit."""
    return tuple(path.name for path in fits.outputs(method(name), fit_in(method(name), Path())))


def run(config: Config, task: Task, name: str) -> Measured:
    """Fit as the stage `fit` does, and measure.

    If that fit takes the validation stars, too, the model that is validated is fitted
    once more without them.

    Parameters
    ----------
    config : groups of the method, and evaluation
    task : Task
    name : str
        Of the method.

    Raises
    ------
    FitError
        If it cannot be fitted.
    """
    kind = method(name)
    own = part(groups_of(name), config)
    stars, place = task.data["stars"], fit_in(kind, task.folder)
    limit_threads(kind.threads(own))
    validated = None
    if not kind.needs.validation:
        product = read_stars(stars, fits.learnt(kind, task.reference))
        data = training_set(own, kind, product, task.split, task.reference)
        validated = kind.fit(data.without_validation(), **kind.settings(own))
    started, started_cpu = time.monotonic(), time.process_time()
    fit(own, name, stars, task.split, task.reference, checkpoint=task.checkpoint, out=place)
    seconds, cpu_seconds = time.monotonic() - started, time.process_time() - started_cpu
    limit_threads(config.evaluation.threads)
    fitted = kind.load(place, task.reference, config.evaluation)
    metrics = measure_images(config, task, name, validated or fitted, fitted)
    described = kind.described(place)
    attempt = described.pop("attempt", 0)
    epochs, stopped = None, False
    if HISTORY in fits.storage_of(kind).diagnostics:
        last = read_table(fits.beside(kind, place, HISTORY)).iloc[-1]
        # Of the training alone, and of all its parts if it was interrupted.
        seconds, cpu_seconds = float(last["seconds"]), float(last["cpu_seconds"])
        most = max(getattr(group, "epochs", 0) for group in kind.settings(own).values())
        epochs = int(last["epoch"])
        stopped = epochs < most
    return Measured(
        metrics=metrics,
        described={**read_product(stars, "stars", ()).config, **described},
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        epochs=epochs,
        stopped=stopped,
        attempt=attempt,
    )
