"""Training and measurement of one point of a sweep over a method's settings.

In go the point's configuration and the product "stars"; out come the method's fit, as the stage
`fit` makes it, and its errors on validation and test stars.
"""

from __future__ import annotations

import time
from pathlib import Path

from psfdae.base.files import read_product
from psfdae.base.reading import read_table
from psfdae.base.threads import limit_threads
from psfdae.methods import fit_files as fits
from psfdae.methods import groups_of, method
from psfdae.methods.interface import HISTORY
from psfdae.training.star_sets import read_stars, training_set
from psfdae_paper.configuration.compose import part
from psfdae_paper.stages.fit import fit
from psfdae_paper.sweeps.measured import Measured, Training, fit_in, measure_images


class MethodTraining(Training):
    """Fit of a method to the training stars, as the stage `fit` makes it.

    `config` is the point's configuration, `model` the name of the method; `task` has the path of
    the product "stars", split and reference, noise levels and output folder.
    """

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files of the fit.

        They are removed before the point is trained again.
        """
        method_class = method(self.model)
        return tuple(path.name for path in fits.outputs(method_class, fit_in(method_class, Path())))

    def measure(self) -> Measured:
        """Fit the method, and measure it on validation and test stars.

        A method that also fits validation stars is fitted once more without them, for the errors
        on validation stars.

        Returns
        -------
        Measured
            Metrics of validation and test stars, settings, seconds and epochs; see
            `Measured.metrics` for their names.

        Raises
        ------
        FitError
            If the training cannot go on: its errors are not finite, or all its starts have failed.
        """
        config, task, name = self.config, self.task, self.model
        method_class = method(name)
        settings = part(groups_of(name), config)
        stars, place = task.data["stars"], fit_in(method_class, task.folder)
        limit_threads(method_class.threads(settings))
        # Errors on validation stars need a fit that has not seen them. Some methods leave them out,
        # or only choose by them; the others are fitted to them in the main workflow.
        validation_fit = None
        if not method_class.needs.validation:
            product = read_stars(stars, fits.learnt(method_class, task.reference))
            data = training_set(settings, method_class, product, task.split, task.reference)
            validation_fit = method_class.fit(
                data.without_validation(), **method_class.settings(settings)
            )
        # The fit of the main workflow, with its cost.
        started, started_cpu = time.monotonic(), time.process_time()
        fit(
            settings, name, stars, task.split, task.reference, checkpoint=task.checkpoint, out=place
        )
        seconds, cpu_seconds = time.monotonic() - started, time.process_time() - started_cpu
        # Errors on both parts, and how the training ended.
        limit_threads(config.evaluation.threads)
        fitted = method_class.load(place, task.reference, config.evaluation)
        metrics = measure_images(config, task, name, validation_fit or fitted, fitted)
        # Settings of the fit; the start that succeeded is a result.
        described = method_class.described(place)
        attempt = described.pop("attempt", 0)
        epochs, stopped = None, False
        if HISTORY in fits.storage_of(method_class).diagnostics:
            # The history has the duration of the training, with all parts of an interrupted one.
            last_epoch = read_table(fits.path_beside(method_class, place, HISTORY)).iloc[-1]
            seconds, cpu_seconds = float(last_epoch["seconds"]), float(last_epoch["cpu_seconds"])
            # Fewer epochs than allowed: the training was stopped early.
            groups = method_class.settings(settings).values()
            epochs = int(last_epoch["epoch"])
            stopped = epochs < max(getattr(group, "epochs", 0) for group in groups)
        return Measured(
            metrics=metrics,
            described={**read_product(stars, "stars", ()).config, **described},
            seconds=seconds,
            cpu_seconds=cpu_seconds,
            epochs=epochs,
            stopped=stopped,
            attempt=attempt,
        )
