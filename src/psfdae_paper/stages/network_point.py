"""Training and measurement of a network of scene 3 (misaligned mirror) at one point of a sweep.

Inputs: the configuration of the point, and states with their stamps for training, validation and
test. Outputs: the trained network and its errors of states, in units of the range of each number
and in physical units.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from psfdae.base.belonging import require
from psfdae.base.files import read_product, write_csv
from psfdae.base.reading import read_table, read_yaml
from psfdae.base.threads import limit_threads
from psfdae.methods.interface import CONFIG, HISTORY
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import part
from psfdae_paper.configuration.estimators import Estimator
from psfdae_paper.configuration.schema import Config
from psfdae_paper.evaluation.alignment_tables import tabulate_errors
from psfdae_paper.stages.alignment_methods import (
    draw_test_stamps,
    load_predictor,
    network_groups,
    train_network,
)
from psfdae_paper.sweeps.measurement import Measurement, Task, geometric_mean


def list_files(model: str) -> tuple[str, ...]:
    """Return the names of the files of a training, the same for every network."""
    return (Estimator.weights_file, CONFIG, HISTORY)


def measure(config: Config, task: Task, model: str) -> Measurement:
    """Train a network, and measure it on the validation states and the uniform test states.

    The workflow has the same results with the same settings, so that a sweep and `make reproduce`
    can be compared.

    Parameters
    ----------
    config : Config
        Configuration of the point.
    task : Task
        Paths of the products, noise levels and output folder.
    model : str
        Name of the network.

    Returns
    -------
    Measurement
        Metrics are `{role}_mae_{level}`, the mean absolute error in units of the range at each
        noise level for the roles validation and test, and `{role}_mae`, their geometric mean;
        settings, seconds and epochs.

    Raises
    ------
    ProductError
        If the products are of different telescopes or stamps.
    """
    # All states must have stamps of one telescope.
    trained_on = read_product(task.data["states"], "alignment_states", ())
    reference_config = trained_on.config, trained_on.path
    for role in ("validation", "test"):
        product = read_product(task.data[role], "alignment_states", ())
        require(product.path, product.config, Alignment.stamp_keys, *reference_config)
    # Train as the stage `alignment train-network` does; the files go to the task's folder.
    settings = part(network_groups(model), config)
    train_network(settings, model, task.data["states"], task.checkpoint, task.folder)
    # The same number of threads for every evaluation.
    limit_threads(config.evaluation.threads)
    # The test part is the uniform set, with the noise that it has in the main workflow.
    metrics: dict[str, float] = {}
    for role, test_set in (("validation", "validation"), ("test", "uniform")):
        product = read_product(task.data[role], "alignment_states", ("states", "stamps", "unit"))
        predict = load_predictor(task.folder, product, config)
        rows, mae = [], {}
        for level in task.levels:
            stamps = draw_test_stamps(config, product["stamps"], test_set, level)
            errors = predict(stamps) - product["states"]
            # Mean absolute error over the four numbers of the state, in units of their range.
            mae[f"{role}_mae_{level:g}"] = float(np.abs(errors).mean(axis=0).mean())
            # Rows as in the main workflow; the column of the method has the name of the point.
            key = {"test_set": test_set, "noise_level": level, "method": task.dataset}
            rows += tabulate_errors(key, errors, product["unit"])
        # Over the levels, the geometric mean.
        metrics |= {f"{role}_mae": geometric_mean(list(mae.values())), **mae}
        write_csv(task.folder / task.tables[role], pd.DataFrame(rows))
    # Settings and cost, from the files of the training.
    network_config = read_yaml(task.folder / CONFIG)
    history = read_table(task.folder / HISTORY)
    # The history does not have the CPU time.
    return Measurement(
        metrics=metrics,
        config={**trained_on.config, **network_config},
        seconds=float(history["seconds"].iloc[-1]),
        cpu_seconds=float("nan"),
        epochs=int(history["epoch"].iloc[-1]),
    )
