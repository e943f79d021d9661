"""What the points of a sweep share when they are trained and measured."""

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

EVALUATION, VALIDATION = "evaluation.csv", "validation.csv"
"""Tables of a point: on the test part, as in the main workflow, and on the validation part."""


@dataclass(frozen=True)
class Task:
    """One point to train and measure.

    Attributes
    ----------
    dataset, split, reference : str
        Go into the tables.
    data : mapping of role to Path
        Products: "stars", or "states", "validation" and "test".
    levels : sequence of float
        Noise levels λ of validation and test.
    folder : Path
        Receives all files of the point.
    checkpoint : Path
        Lets an interrupted training resume.
    """

    dataset: str
    split: SplitKind
    reference: Reference
    data: Mapping[str, Path]
    levels: Sequence[float]
    folder: Path
    checkpoint: Path

    def described(self) -> dict[str, object]:
        """What of the task decides its result: names, levels and the bytes of the products."""
        return {
            "names": [self.dataset, self.split, self.reference],
            "levels": list(self.levels),
            "data": {role: _digest(path) for role, path in sorted(self.data.items())},
        }


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@dataclass(frozen=True)
class Measured:
    """What became of a point.

    Attributes
    ----------
    metrics : dict
        validation_<metric> and test_<metric> over all levels, and at each: …_<λ>.
    described : dict
        The point's whole configuration, that of its stars or states included.
    seconds, cpu_seconds : float
        Of the training; NaN where a resumed one does not know.
    epochs : int or None
        Passes over the training data, where they may end early.
    stopped : bool
        Ended by early stopping.
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
    """Mean over noise levels in which every level counts alike."""
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
    """Rows of a table as the stage `evaluate` makes them, of one method.

    Parameters
    ----------
    config : stage config with `evaluation`
    task : Task
    method : str
        Name in the table.
    product : product "stars" with the reference
    stars : ndarray of int, shape (n,)
        Those that are measured; standard errors are clustered by their fields.
    noisy : callable
        Noisy images of noise-free ones at a noise level.
    model : Method
    """
    from psfdae.metrics import quality, summarised
    from psfdae.model.star_sets import field_positions

    images, truth = (product[kind][stars] for kind in ("realisation", task.reference))
    field, position = product["field_index"][stars], field_positions(product)[stars]
    key = {"dataset": task.dataset, "split": task.split, "reference": task.reference}
    rows = []
    for level in task.levels:
        estimate = model.estimate(noisy(images, level), level, position)
        found = quality(estimate, truth, config.evaluation.data_range)
        rows += summarised({**key, "method": method, "noise_level": level}, found, field)
    return rows


def image_metrics(part: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """MSE and SSIM of a part, over all noise levels and at each."""
    metrics: dict[str, float] = {}
    for metric, mean in (("mse", geometric_mean), ("ssim", lambda v: float(np.mean(v)))):
        found = {row["noise_level"]: row["value"] for row in rows if row["metric"] == metric}
        metrics[f"{part}_{metric}"] = mean(list(found.values()))
        metrics |= {f"{part}_{metric}_{level:g}": value for level, value in found.items()}
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
    config : stage config (seed, noise, parts, evaluation)
    task : Task
    method : str
        Name in the tables.
    validate_with, test_with : Method
        One that has not been fitted to the validation stars, and the main workflow's.
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

    metrics: dict[str, float] = {}
    for part, stars, noisy, model, name in (
        ("validation", parts.validation, noisy_validation, validate_with, VALIDATION),
        ("test", parts.test, noisy_test, test_with, EVALUATION),
    ):
        rows = image_rows(config, task, method, product, stars, noisy, model)
        metrics |= image_metrics(part, rows)
        write_csv(task.folder / name, pd.DataFrame(rows))
    return metrics


RESULT, COST, FINISHED = "result.json", "cost.json", "finished.json"
"""Result and cost of a point, and a copy of its result that a workflow does not know.

A workflow that was killed takes what its last jobs still brought to an end for
incomplete and deletes their results; the copy keeps these trainings from being repeated.
"""


CHECKSUM = "sha256"
"""Key of the checksum of all other keys in a result."""


def read_result(path: Path) -> dict[str, Any]:
    """A point's `result.json` without its checksum.

    Raises
    ------
    ProductError
        If the file is missing, or not what was written.
    """
    tree = read_json(path)
    if tree.pop(CHECKSUM, None) != checksum(tree):
        raise ProductError(f"{path}: damaged (wrong checksum); delete it and run again")
    return tree


def read_cost(folder: Path) -> dict[str, float]:
    """Seconds and CPU seconds of a point's training; raises ProductError."""
    path = folder / COST
    tree = read_json(path)
    return {key: from_tree(path, tree, key, make=float) for key in ("seconds", "cpu_seconds")}


def fit_in(kind: type[Method], folder: Path) -> Path:
    """Where the fit of a point is: the folder itself, or a file in it."""
    return folder if storage_of(kind).files else folder / f"{kind.name}.h5"


def checksum(tree: object) -> str:
    """SHA-256 of a tree as JSON."""
    return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()
