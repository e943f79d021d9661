"""Finished runs in the results folder: where their files are and what they say."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from psfdae.belonging import STARS, require_origin
from psfdae.files import ProductError, read_product
from psfdae.reading import number, read_csv, read_yaml

METHODS = {"dae": "dae", "baseline": "pca_som"}
"""Kind of a run, and its name in the column `method` of an evaluation."""

CONTENT = 1
"""Goes into every content hash: raise it when `read` changes what it takes from the files."""


class Point(NamedTuple):
    """A metric at an epoch (0: of the finished run); time in ms since 1970."""

    name: str
    value: float
    epoch: int
    time_ms: int


class Source(Protocol):
    """A finished run of any kind, as the import into MLflow sees it."""

    @property
    def name(self) -> str: ...

    @property
    def source(self) -> str: ...

    def files(self) -> dict[str, Path]: ...

    def read(self) -> Record: ...


@dataclass(frozen=True)
class Entry:
    """Where the files of one finished run are.

    `source` is the model's place below the results folder. It tells runs apart
    that agree in everything else, such as the points of a sweep.
    """

    kind: str
    dataset: str
    split: str
    reference: str
    source: str
    stars: Path
    model: Path
    evaluation: Path
    config: Path | None = None
    history: Path | None = None
    figures: tuple[tuple[str, Path], ...] = ()

    def read(self) -> Record:
        """Config, metrics and hashes; see the function `read`."""
        return read(self)

    @property
    def name(self) -> str:
        """For people: dataset3 random template dae."""
        return f"{self.dataset} {self.split} {self.reference} {self.kind}"

    def files(self) -> dict[str, Path]:
        """Name within the run, and file; `model/` is a folder that `evaluate` can load."""
        files = {f"model/{self.model.name}": self.model, "evaluation.csv": self.evaluation}
        if self.config and self.history:
            files |= {"model/config.yaml": self.config, "history.csv": self.history}
        return files | {f"figures/{name}": path for name, path in self.figures}


@dataclass(frozen=True)
class Record:
    """What a finished run says about itself.

    `status` is MLflow's, FINISHED or FAILED; `parent` the source of the run that this
    one is a part of, which must be imported before it; `tags` are tags of its own.
    """

    entry: Source
    experiment: str
    config: dict[str, Any]
    config_hash: str
    content_hash: str
    points: list[Point]
    start_ms: int
    end_ms: int
    status: str = "FINISHED"
    parent: str = ""
    tags: Mapping[str, str] = field(default_factory=dict)


def discover(results: Path, datasets: Mapping[str, Path]) -> list[Entry]:
    """Finished runs of some datasets.

    An evaluation is the last file of a run, so it is what counts: models still in
    training are passed over. The baseline is fitted once per split but measured
    against every reference; each of these measurements is a run, so that the
    metrics of a baseline and a network with the same tags can be compared.

    Parameters
    ----------
    results : folder that the workflow writes to
    datasets : name of each dataset, and its product "stars"

    Raises
    ------
    ProductError
        If a dataset has no evaluation.
    """
    entries = []
    for dataset, stars in datasets.items():
        folder = results / "evaluation" / dataset
        evaluations = sorted(folder.glob("*-*.csv"))
        if not evaluations:
            raise ProductError(f"{folder}: no evaluations; run `snakemake {dataset}` first")
        for path in evaluations:
            split, reference = path.stem.split("-", 1)
            dae = f"dae/{dataset}/{path.stem}"
            baseline = f"pca_som/{dataset}/{split}.h5"
            key = {"dataset": dataset, "split": split, "reference": reference}
            shared = {"stars": stars, "evaluation": path}
            shared["figures"] = _figures(results / "figures" / dataset, split, reference)
            own = {
                "model": results / dae / "dae.safetensors",
                "config": results / dae / "config.yaml",
                "history": results / dae / "history.csv",
            }
            entries.append(Entry("dae", **key, source=dae, **own, **shared))
            model = results / baseline
            entries.append(Entry("baseline", **key, source=baseline, model=model, **shared))
    return entries


def _figures(folder: Path, split: str, reference: str) -> tuple[tuple[str, Path], ...]:
    """Figures of a dataset but for those whose path starts with another split or reference."""
    ours = (f"{split}-{reference}", split)
    labels = [f"{s}-{r}" for s in ("random", "held_out") for r in ("realisation", "template")]
    labels += ["random", "held_out"]
    found = []
    for path in sorted(folder.rglob("*.png")):
        name = path.relative_to(folder).as_posix()
        label = next((label for label in labels if name.startswith(label)), None)
        if label is None or label in ours:
            found.append((name, path))
    return tuple(found)


def read(entry: Entry) -> Record:
    """Read the config, metrics and hashes of a finished run.

    The config is that of the model together with that of its stars: a network
    trained on the stars of another telescope is another run.

    Raises
    ------
    ProductError
        If a file is missing or damaged, or the model was trained on other stars; the
        message names it.
    """
    contents = {name: sha256(path) for name, path in entry.files().items()}
    stars = read_product(entry.stars, "stars", ())
    if entry.kind == "dae":
        require_origin(entry.model.parent, STARS, stars)
        own = read_yaml(entry.config)
        # Which start succeeded is an outcome, not a setting.
        own.pop("attempt", None)
    else:
        require_origin(entry.model, STARS, stars)
        own = read_product(entry.model, "pca_som", ()).config
    config = {**stars.config, **own}
    config_hash = hash_of(config)
    epochs = _epochs(entry.history) if entry.history else []
    start_ms, end_ms = span_ms(entry.model, epochs)
    points = epoch_points(epochs, start_ms) + _test_points(entry, end_ms)
    return Record(
        entry=entry,
        experiment=_experiment(entry.stars, stars.config),
        config=config,
        config_hash=config_hash,
        content_hash=hash_of([CONTENT, config_hash, contents]),
        points=[point for point in points if math.isfinite(point.value)],
        start_ms=start_ms,
        end_ms=end_ms,
    )


def span_ms(model: Path, epochs: list[dict[str, float]]) -> tuple[int, int]:
    """Start and end of a training in ms since 1970: the model's file, and the history's seconds."""
    end_ms = int(model.stat().st_mtime * 1000)
    return end_ms - int(1000 * max((row["seconds"] for row in epochs), default=0.0)), end_ms


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Leaves of a config by their dotted names; lists and other values as JSON, text as it is."""
    leaves: dict[str, str] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            leaves |= flatten(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = value if isinstance(value, str) else json.dumps(value)
    return leaves


def epoch_points(epochs: list[dict[str, float]], start_ms: int) -> list[Point]:
    """Metrics of every epoch of a history, and the best validation error."""
    points = [
        Point(name, value, int(row["epoch"]), start_ms + int(1000 * row["seconds"]))
        for row in epochs
        for name, value in row.items()
        if name not in ("epoch", "step", "seconds", "cpu_seconds")
    ]
    # MLflow's lists show the last value; the network kept is that of the lowest.
    valid = [p for p in points if p.name == "validation_mse" and math.isfinite(p.value)]
    if valid:
        points.append(min(valid, key=lambda p: p.value)._replace(name="best_validation_mse"))
    return points


def _test_points(entry: Entry, time_ms: int) -> list[Point]:
    points = []
    for row in read_csv(entry.evaluation, "method", "noise_level", "metric", "value", "stderr"):
        if row["method"] == METHODS[entry.kind]:
            metric, level = row["metric"], f"{number(entry.evaluation, row['noise_level']):g}"
            for name, column in ((metric, "value"), (f"{metric}_stderr", "stderr")):
                value = number(entry.evaluation, row[column])
                points.append(Point(f"test_{name}_{level}", value, 0, time_ms))
    if not points:
        raise ProductError(f"{entry.evaluation}: no rows of method {METHODS[entry.kind]!r}")
    return points


def _epochs(path: Path) -> list[dict[str, float]]:
    rows = read_csv(path, "epoch", "train_mse", "validation_mse", "seconds")
    return [{name: number(path, text) for name, text in row.items()} for row in rows]


def _experiment(path: Path, stars: Mapping[str, Any]) -> str:
    try:
        return str(stars["scene"]["experiment"])
    except (KeyError, TypeError):
        raise ProductError(f"{path}: its config has no scene.experiment") from None


def hash_of(tree: Any) -> str:
    """Hash of a tree in its canonical JSON."""
    canonical = json.dumps(tree, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()


def sha256(path: Path) -> str:
    """Hash of a file's bytes; raises ProductError if it is missing."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        raise ProductError(f"{path}: no such file") from None
