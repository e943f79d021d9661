"""Training and evaluation of one point of a sweep over a method's settings.

Inputs: the point's configuration and the product "stars". Outputs: the method's fit, as the stage
`fit` makes it, and its errors on validation and test stars.
"""

from __future__ import annotations

import time
from pathlib import Path

from psfdae.base.files import read_product
from psfdae.base.reading import read_table
from psfdae.base.threads import limit_threads
from psfdae.methods import fit_files as fits
from psfdae.methods import list_groups, method
from psfdae.methods.interface import HISTORY
from psfdae.training.star_sets import read_stars, training_set
from psfdae_paper.configuration.compose import part
from psfdae_paper.configuration.schema import Config
from psfdae_paper.stages.fit import fit
from psfdae_paper.sweeps.measurement import Measurement, Task, locate_fit, measure_images


def list_files(model: str) -> tuple[str, ...]:
    """Return the names of the files of a fit, which are removed before a new training."""
    method_class = method(model)
    return tuple(path.name for path in fits.outputs(method_class, locate_fit(method_class, Path())))


def measure(config: Config, task: Task, model: str) -> Measurement:
    """Fit a method, and measure it on validation and test stars.

    A method that also fits validation stars is fitted once more without them, for the errors on
    validation stars.

    Parameters
    ----------
    config : Config
        Configuration of the point.
    task : Task
        Path of the product "stars", split and reference images, noise levels and output folder.
    model : str
        Name of the method.

    Returns
    -------
    Measurement
        Metrics on validation and test stars, settings, duration in seconds, and epochs.

    Raises
    ------
    FitError
        If the training cannot continue: its errors are not finite, or all its starts have failed.
    """
    method_class = method(model)
    settings = part(list_groups(model), config)
    stars, out = task.data["stars"], locate_fit(method_class, task.folder)
    limit_threads(method_class.threads(settings))
    # Errors on validation stars need a fit without these stars. Methods that need validation stars
    # are not fitted to them, or use them only to stop the training; the main workflow fits all
    # other methods to them.
    validation_fit = None
    if not method_class.needs.validation:
        product = read_stars(stars, fits.get_training_reference(method_class, task.reference))
        data = training_set(settings, method_class, product, task.split, task.reference)
        validation_fit = method_class.fit(data.drop_validation(), **method_class.settings(settings))
    # The same fit as in the main workflow, with its elapsed and CPU time.
    start_s, start_cpu_s = time.monotonic(), time.process_time()
    fit(settings, model, stars, task.split, task.reference, checkpoint=task.checkpoint, out=out)
    seconds, cpu_seconds = time.monotonic() - start_s, time.process_time() - start_cpu_s
    # Errors on validation and test stars.
    limit_threads(config.evaluation.threads)
    estimator = method_class.load(out, task.reference, config.evaluation)
    metrics = measure_images(config, task, model, validation_fit or estimator, estimator)
    # Settings of the fit; the number of the attempt that succeeded is a result, not a setting.
    fit_config = method_class.read_config(out)
    attempt = fit_config.pop("attempt", 0)
    epochs, is_stopped = None, False
    if HISTORY in fits.get_storage(method_class).diagnostics:
        # The history has the time of the whole training, also if it was interrupted and resumed.
        last_epoch = read_table(fits.path_beside(method_class, out, HISTORY)).iloc[-1]
        seconds, cpu_seconds = float(last_epoch["seconds"]), float(last_epoch["cpu_seconds"])
        # Fewer epochs than allowed: the training was stopped early.
        groups = method_class.settings(settings).values()
        epochs = int(last_epoch["epoch"])
        is_stopped = epochs < max(getattr(group, "epochs", 0) for group in groups)
    return Measurement(
        metrics=metrics,
        config={**read_product(stars, "stars", ()).config, **fit_config},
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        epochs=epochs,
        is_stopped=is_stopped,
        attempt=attempt,
    )
