"""Measurement of a sweep's points: tasks, tables of errors, results and their files.

A point is a configuration with the products that it is trained and tested on. Its folder receives
its tables of errors and its cost; `result.json` has its metrics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from psfdae.base.files import write_csv
from psfdae.base.reading import from_tree, read_json
from psfdae.base.rng import stream
from psfdae.base.settings import Reference, SplitKind
from psfdae.methods.fit_files import get_storage
from psfdae.methods.interface import Method
from psfdae.training.star_sets import noise_model, noisy_test_images, read_stars, split_stars
from psfdae_paper.configuration.schema import Config
from psfdae_paper.evaluation.measure import MeasuredStars


@dataclass(frozen=True)
class Task:
    """One point to train and measure.

    Attributes
    ----------
    dataset, split, reference : str
        Names in the tables.
    data : mapping of role to Path
        Products: "stars", or "states", "validation" and "test".
    levels : sequence of float
        Noise levels λ of validation and test.
    folder : Path
        Folder for all files of the point; its name is the point's.
    checkpoint : Path
        File from which an interrupted training resumes.
    tables : dict of str
        Names of the tables of errors by part of the data; the test part has the main workflow's
        name.
    """

    tables: ClassVar = {"validation": "validation.csv", "test": "evaluation.csv"}

    dataset: str
    split: SplitKind
    reference: Reference
    data: Mapping[str, Path]
    levels: Sequence[float]
    folder: Path
    checkpoint: Path


@dataclass(frozen=True)
class Measurement:
    """Metrics and cost of a point that was trained.

    Attributes
    ----------
    metrics : dict
        validation_<metric> and test_<metric> over all levels, and at each: …_<λ>.
    config : dict
        The point's whole configuration, with the configuration of its stars or states.
    seconds, cpu_seconds : float
        Duration of the training in seconds; NaN if a resumed training did not record it.
    epochs : int or None
        Passes over the training data; None for methods without epochs.
    is_stopped : bool
        The training ended by early stopping.
    attempt : int or None
        New starts after a dead network; None for a training that failed.
    """

    metrics: dict[str, float]
    config: dict[str, Any]
    seconds: float
    cpu_seconds: float
    epochs: int | None = None
    is_stopped: bool = False
    attempt: int | None = 0


def geometric_mean(values: Sequence[float]) -> float:
    """Return the geometric mean, which weights relative changes at all noise levels equally."""
    return float(np.exp(np.mean(np.log(values))))


def average_metrics(part: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return MSE and SSIM of a part, over all noise levels and at each.

    The MSE of different levels differs by orders of magnitude: its mean is the geometric one.

    Parameters
    ----------
    part : str
        "validation" or "test", with which the names of the metrics begin.
    rows : sequence of mapping
        Rows of the part's table of errors: metric, noise_level and value.
    """
    # Name of the metric, and its mean over noise levels.
    metrics: dict[str, float] = {}
    for metric, mean in (("mse", geometric_mean), ("ssim", lambda v: float(np.mean(v)))):
        # One row of the table for each level and metric.
        by_level = {row["noise_level"]: row["value"] for row in rows if row["metric"] == metric}
        metrics[f"{part}_{metric}"] = mean(list(by_level.values()))
        metrics |= {f"{part}_{metric}_{level:g}": value for level, value in by_level.items()}
    return metrics


def measure_images(
    config: Config, task: Task, method: str, validate_with: Method, test_with: Method
) -> dict[str, float]:
    """Measure a model on validation and test stars, and write both tables.

    The noise of a part is the same for all points of a sweep; the test part has the noise of
    the main workflow.

    Parameters
    ----------
    config : Config
        Stage configuration (seed, noise, parts, evaluation).
    task : Task
        Stars, noise levels, and the folder for the tables.
    method : str
        Name in the tables.
    validate_with : Method
        Method that has not been fitted to the validation stars.
    test_with : Method
        Method that has been fitted as in the main workflow.

    Returns
    -------
    dict
        See `Measurement.metrics`.
    """
    # Stars and their split, as in the main workflow.
    product = read_stars(task.data["stars"], task.reference)
    parts = split_stars(product, task.split, config)

    def noisy_validation(images: np.ndarray, level: float) -> np.ndarray:
        """Add noise from a stream of the noise level, which no other part uses."""
        rng = stream(config.seed, "noise", "validation", f"{level:.6g}")
        return noise_model(config).draw(images, level, rng)

    def noisy_test(images: np.ndarray, level: float) -> np.ndarray:
        """Add the noise that test stars have in the main workflow."""
        return noisy_test_images(config, product, parts.test, level)

    # Each part has its own stars, noise, fit and table.
    key = {"dataset": task.dataset, "split": task.split, "reference": task.reference}
    metrics: dict[str, float] = {}
    for part, indices, noisy, model in (
        ("validation", parts.validation, noisy_validation, validate_with),
        ("test", parts.test, noisy_test, test_with),
    ):
        # Truth, field and position of the stars; then their errors at each noise level.
        stars = MeasuredStars.from_product(product, indices, task.reference)
        images = product["realisation"][indices]
        rows = []
        for level in task.levels:
            estimate = model.estimate(noisy(images, level), level, stars.position)
            row = {**key, "method": method, "noise_level": level}
            rows += stars.errors(row, estimate, config.evaluation.data_range)[0]
        metrics |= average_metrics(part, rows)
        # Written after all levels: a table is whole or absent.
        write_csv(task.folder / task.tables[part], pd.DataFrame(rows))
    return metrics


def read_cost(folder: Path) -> dict[str, float]:
    """Read seconds and CPU seconds of a point's training; raises ProductError."""
    path = folder / "cost.json"
    tree = read_json(path)
    # NaN where the training did not record it.
    return {key: from_tree(path, tree, key, make=float) for key in ("seconds", "cpu_seconds")}


def locate_fit(kind: type[Method], folder: Path) -> Path:
    """Return the path of a point's fit: the folder itself, or a file in it.

    A method with several files, such as a network, has a folder; one with a product has a file.
    """
    return folder if get_storage(kind).files else folder / f"{kind.name}.h5"
