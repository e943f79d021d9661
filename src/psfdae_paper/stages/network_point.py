"""Training and measurement of one point of a sweep over a network of scene 3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from psfdae.belonging import require
from psfdae.files import read_product, write_csv
from psfdae.method import CONFIG, HISTORY
from psfdae.reading import read_table, read_yaml
from psfdae.threads import limit_threads
from psfdae_paper.configuration.aligners import WEIGHTS
from psfdae_paper.configuration.alignment import STAMP_KEYS
from psfdae_paper.configuration.compose import part
from psfdae_paper.configuration.schema import Config
from psfdae_paper.evaluation.alignment_tables import Row, error_rows
from psfdae_paper.stages.alignment_methods import (
    network_groups,
    network_predictor,
    noisy_test_states,
    train_network,
)
from psfdae_paper.sweeps.measured import EVALUATION, VALIDATION, Measured, Task, geometric_mean


def files_of(name: str) -> tuple[str, ...]:
    """Return the names of the files of a point's training."""
    return (WEIGHTS, CONFIG, HISTORY)


def run(config: Config, task: Task, name: str) -> Measured:
    """Train as the stage of the same network does, and measure.

    Parameters
    ----------
    config : Config
        Stage configuration (seed, noise, cnn, perceptron, train_<name>, evaluation).
    task : Task
    name : str
        Name of the network, original or noise_trained.

    Raises
    ------
    TrainingError
        If the training cannot continue.
    ProductError
        If the products are of different telescopes or stamps.
    """
    import pandas as pd

    trained_on = read_product(task.data["states"], "alignment_states", ())
    for role in ("validation", "test"):
        product = read_product(task.data[role], "alignment_states", ())
        require(product.path, product.config, STAMP_KEYS, trained_on.config, trained_on.path)
    settings = part(network_groups(name), config)
    train_network(settings, name, task.data["states"], task.checkpoint, task.folder)
    limit_threads(config.evaluation.threads)
    metrics: dict[str, float] = {}
    for role, file in (("validation", VALIDATION), ("test", EVALUATION)):
        rows = _rows(config, task, role)
        metrics |= _metrics(role, rows)
        write_csv(task.folder / file, pd.DataFrame(rows))
    described = read_yaml(task.folder / CONFIG)
    history = read_table(task.folder / HISTORY)
    return Measured(
        metrics=metrics,
        described={**trained_on.config, **described},
        seconds=float(history["seconds"].iloc[-1]),
        cpu_seconds=float("nan"),
        epochs=int(history["epoch"].iloc[-1]),
    )


def _rows(config: Config, task: Task, role: str) -> list[Row]:
    """Measure one network at all noise levels; return rows like those of the main workflow."""
    product = read_product(task.data[role], "alignment_states", ("states", "stamps", "unit"))
    predict = network_predictor(task.folder, product, config)
    # The test part is the uniform set, with the noise that it has in the main workflow.
    test_set = "uniform" if role == "test" else role
    rows: list[Row] = []
    for level in task.levels:
        stamps = noisy_test_states(config, product["stamps"], test_set, level)
        key = {"test_set": test_set, "noise_level": level, "method": task.dataset}
        rows += error_rows(key, predict(stamps) - product["states"], product["unit"])
    return rows


def _metrics(role: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the mean absolute error of all parameters, over all noise levels and at each.

    It is in units of the range.
    """
    errors_by_level: dict[float, list[float]] = {}
    for row in rows:
        if row["unit"] == "range":
            errors_by_level.setdefault(row["noise_level"], []).append(row["mean_abs_error"])
    mae = {level: float(np.mean(errors)) for level, errors in errors_by_level.items()}
    metrics = {f"{role}_mae": geometric_mean(list(mae.values()))}
    return metrics | {f"{role}_mae_{level:g}": value for level, value in mae.items()}
