"""Training and measurement of a network of scene 3 (misaligned mirror) at one point of a sweep.

A point is a set of settings. In go its configuration and states with their stamps, for training,
validation and test; out come the trained network and its errors of states, in units of the range of
each number and in physical units.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from psfdae.base.belonging import require
from psfdae.base.files import read_product, write_csv
from psfdae.base.reading import read_table, read_yaml
from psfdae.base.threads import limit_threads
from psfdae.methods.interface import CONFIG, HISTORY
from psfdae_paper.configuration.aligners import Aligner
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import part
from psfdae_paper.evaluation.alignment_tables import Row, error_rows
from psfdae_paper.stages.alignment_methods import (
    network_groups,
    network_predictor,
    noisy_test_states,
    train_network,
)
from psfdae_paper.sweeps.measured import Measured, Training, geometric_mean


class StateNetworkTraining(Training):
    """Training of a network of scene 3, as the stage `alignment train-network` makes it.

    `config` is the point's configuration, `model` the name of the network, `task` the paths, noise
    levels and output folder.
    """

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files of the training."""
        return (Aligner.weights_file, CONFIG, HISTORY)

    def measure(self) -> Measured:
        """Train the network, and measure it on the validation states and the uniform test states.

        Returns
        -------
        Measured
            Metrics are `{role}_mae_{level}`, the mean absolute error in units of the range at each
            noise level for the roles validation and test, and `{role}_mae`, their geometric mean;
            settings, seconds and epochs besides.

        Raises
        ------
        ProductError
            If the products are of different telescopes or stamps.
        """
        config, task, name = self.config, self.task, self.model
        # All states must have stamps of one telescope.
        trained_on = read_product(task.data["states"], "alignment_states", ())
        expected = trained_on.config, trained_on.path
        for role in ("validation", "test"):
            product = read_product(task.data[role], "alignment_states", ())
            require(product.path, product.config, Alignment.stamp_keys, *expected)
        # Train as the stage `alignment train-network` does; the files go to the task's folder.
        settings = part(network_groups(name), config)
        train_network(settings, name, task.data["states"], task.checkpoint, task.folder)
        # The same number of threads for every evaluation.
        limit_threads(config.evaluation.threads)
        # The test part is the uniform set, with the noise that it has in the main workflow.
        metrics: dict[str, float] = {}
        for role, test_set in (("validation", "validation"), ("test", "uniform")):
            product = read_product(
                task.data[role], "alignment_states", ("states", "stamps", "unit")
            )
            predict = network_predictor(task.folder, product, config)
            # Errors at all noise levels, as rows like those of the main workflow.
            rows: list[Row] = []
            for level in task.levels:
                stamps = noisy_test_states(config, product["stamps"], test_set, level)
                # The point's name stands in the column of the method.
                key = {"test_set": test_set, "noise_level": level, "method": task.dataset}
                rows += error_rows(key, predict(stamps) - product["states"], product["unit"])
            # Mean absolute error over the four numbers of the state, in units of their range, at
            # each noise level.
            mae: dict[str, float] = {}
            for level in task.levels:
                at_level = [row for row in rows if row["noise_level"] == level]
                errors: Any = [row["mean_abs_error"] for row in at_level if row["unit"] == "range"]
                mae[f"{role}_mae_{level:g}"] = float(np.mean(errors))
            # Over the levels, the geometric mean.
            metrics |= {f"{role}_mae": geometric_mean(list(mae.values())), **mae}
            write_csv(task.folder / task.tables[role], pd.DataFrame(rows))
        # Settings and cost, from the files of the training.
        described = read_yaml(task.folder / CONFIG)
        history = read_table(task.folder / HISTORY)
        # The history has no CPU time.
        return Measured(
            metrics=metrics,
            described={**trained_on.config, **described},
            seconds=float(history["seconds"].iloc[-1]),
            cpu_seconds=float("nan"),
            epochs=int(history["epoch"].iloc[-1]),
        )
