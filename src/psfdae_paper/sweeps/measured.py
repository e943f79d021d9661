"""Training and measurement of a sweep's points: tasks, tables, results and their files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.files import ProductError
from psfdae.fits import storage_of
from psfdae.method import Method
from psfdae.reading import from_tree, read_json
from psfdae.settings import Reference, SplitKind

if TYPE_CHECKING:
    from psfdae.files import Product
    from psfdae_paper.configuration.schema import Config

EVALUATION = "evaluation.csv"
"""Table of a point's errors on the test part, as in the main workflow."""

VALIDATION = "validation.csv"
"""Table of a point's errors on the validation part."""

RESULT = "result.json"
"""Result of a point."""

FINISHED = "finished.json"
"""Copy of a point's result that the workflow does not know.

A workflow that is killed takes the outputs of its last jobs for incomplete and deletes them, even
if the jobs still came to their end; the copy keeps these trainings from being repeated.
"""

COST = "cost.json"
"""Seconds and CPU seconds of a point's training."""

CHECKSUM = "sha256"
"""Key of the checksum of all other keys in a result."""


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
        Folder for all files of the point.
    checkpoint : Path
        File from which an interrupted training resumes.
    """

    dataset: str
    split: SplitKind
    reference: Reference
    data: Mapping[str, Path]
    levels: Sequence[float]
    folder: Path
    checkpoint: Path

    def described(self) -> dict[str, object]:
        """Return all that decides the result: names, levels and digests of the products."""
        digests = {}
        for role, path in sorted(self.data.items()):
            with path.open("rb") as file:
                digests[role] = hashlib.file_digest(file, "sha256").hexdigest()
        return {
            "names": [self.dataset, self.split, self.reference],
            "levels": list(self.levels),
            "data": digests,
        }


@dataclass(frozen=True)
class Measured:
    """Metrics and cost of a point that was trained.

    Attributes
    ----------
    metrics : dict
        validation_<metric> and test_<metric> over all levels, and at each: …_<λ>.
    described : dict
        The point's whole configuration, with that of its stars or states.
    seconds, cpu_seconds : float
        Duration of the training; NaN if it was resumed and has no record of it.
    epochs : int or None
        Passes over the training data; None for methods without epochs.
    stopped : bool
        The training ended by early stopping.
    attempt : int
        New starts after a dead network.
    """

    metrics: dict[str, float]
    described: dict[str, Any]
    seconds: float
    cpu_seconds: float
    epochs: int | None = None
    stopped: bool = False
    attempt: int = 0


def geometric_mean(values: Sequence[float]) -> float:
    """Return the mean over noise levels in which relative changes of all levels count alike."""
    return float(np.exp(np.mean(np.log(values))))


def image_rows(
    config: Config,
    task: Task,
    method: str,
    product: Product,
    stars: np.ndarray,
    noisy: Callable[[np.ndarray, float], np.ndarray],
    model: Method,
) -> list[dict[str, Any]]:
    """Measure one method at all noise levels; return rows like those of the stage `evaluate`.

    Parameters
    ----------
    config : Config
        Stage configuration with `evaluation`.
    task : Task
    method : str
        Name in the table.
    product : Product
        Product "stars" with the reference.
    stars : ndarray of int, shape (n,)
        Stars that are measured; standard errors are clustered by their fields.
    noisy : callable
        Function of noise-free images and a noise level that returns noisy images.
    model : Method
        Fitted method.
    """
    from psfdae.metrics import quality, summarised
    from psfdae.model.star_sets import field_positions

    images, truth = (product[kind][stars] for kind in ("realisation", task.reference))
    field, position = product["field_index"][stars], field_positions(product)[stars]
    key = {"dataset": task.dataset, "split": task.split, "reference": task.reference}
    # Errors of all stars at each level, summarised with standard errors clustered by field.
    rows = []
    for level in task.levels:
        estimate = model.estimate(noisy(images, level), level, position)
        errors = quality(estimate, truth, config.evaluation.data_range)
        rows += summarised({**key, "method": method, "noise_level": level}, errors, field)
    return rows


def image_metrics(part: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return MSE and SSIM of a part, over all noise levels and at each.

    The MSE of different levels differ by orders of magnitude, and get the geometric mean.
    """
    metrics: dict[str, float] = {}
    for metric, mean in (("mse", geometric_mean), ("ssim", lambda v: float(np.mean(v)))):
        by_level = {row["noise_level"]: row["value"] for row in rows if row["metric"] == metric}
        metrics[f"{part}_{metric}"] = mean(list(by_level.values()))
        metrics |= {f"{part}_{metric}_{level:g}": value for level, value in by_level.items()}
    return metrics


def measure_images(
    config: Config,
    task: Task,
    method: str,
    validate_with: Method,
    test_with: Method,
) -> dict[str, float]:
    """Measure a model on validation and test stars, and write both tables.

    The noise of a part is the same for all points of a sweep; that of the test part is
    the main workflow's.

    Parameters
    ----------
    config : Config
        Stage configuration (seed, noise, parts, evaluation).
    task : Task
    method : str
        Name in the tables.
    validate_with : Method
        Method that has not been fitted to the validation stars.
    test_with : Method
        Method that has been fitted as in the main workflow.

    Returns
    -------
    dict
        See `Measured.metrics`.
    """
    import pandas as pd

    from psfdae.files import write_csv
    from psfdae.model.star_sets import noise_model, noisy_test_images, read_stars, split_stars
    from psfdae.rng import stream

    product = read_stars(task.data["stars"], task.reference)
    parts = split_stars(product, task.split, config)
    noise = noise_model(config)

    def noisy_validation(images: np.ndarray, level: float) -> np.ndarray:
        rng = stream(config.seed, "noise", "validation", f"{level:.6g}")
        return noise.draw(images, level, rng)

    def noisy_test(images: np.ndarray, level: float) -> np.ndarray:
        return noisy_test_images(config, product, parts.test, level)

    # Each part has its own stars, noise, fit and table.
    metrics: dict[str, float] = {}
    for part, stars, noisy, model, table in (
        ("validation", parts.validation, noisy_validation, validate_with, VALIDATION),
        ("test", parts.test, noisy_test, test_with, EVALUATION),
    ):
        rows = image_rows(config, task, method, product, stars, noisy, model)
        metrics |= image_metrics(part, rows)
        write_csv(task.folder / table, pd.DataFrame(rows))
    return metrics


def read_result(path: Path) -> dict[str, Any]:
    """Read a point's `result.json`, and return it without its checksum.

    Raises
    ------
    ProductError
        If the file is missing, or does not agree with its checksum.
    """
    tree = read_json(path)
    if tree.pop(CHECKSUM, None) != checksum(tree):
        raise ProductError(f"{path}: damaged (wrong checksum); delete it and run again")
    return tree


def read_cost(folder: Path) -> dict[str, float]:
    """Read seconds and CPU seconds of a point's training; raises ProductError."""
    path = folder / COST
    tree = read_json(path)
    return {key: from_tree(path, tree, key, make=float) for key in ("seconds", "cpu_seconds")}


def fit_in(kind: type[Method], folder: Path) -> Path:
    """Return the place of a point's fit: the folder itself, or a file in it."""
    return folder if storage_of(kind).files else folder / f"{kind.name}.h5"


def checksum(tree: object) -> str:
    """Return the SHA-256 of a tree as JSON."""
    return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()
