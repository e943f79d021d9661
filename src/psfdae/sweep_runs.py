"""Sweeps in the results folder, as runs that MLflow can import: one parent, a child per point."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

from psfdae.files import ProductError
from psfdae.reading import number, read_csv, read_yaml
from psfdae.runs import (
    CONTENT,
    Point,
    Record,
    epoch_points,
    hash_of,
    sha256,
)
from psfdae.stages.sweep import COST, RESULT, read_cost, read_result

SUMMARY_FILES = ("summary.csv", "cost.csv", "best.yaml", "sweep.yaml")

POINT_FILES = (
    *(RESULT, COST, "evaluation.csv", "validation.csv"),
    *("dae.safetensors", "cnn.safetensors", "pca_som.h5", "config.yaml", "history.csv"),
)
"""Files that a point may have; a failed one has the first two only."""

MODEL_FILES = POINT_FILES[4:8]
"""Those of the folder `model`, which the stage `evaluate` can load."""


@dataclass(frozen=True)
class SweepEntry:
    """Where the files of a sweep are; stands for the run that its points are parts of."""

    folder: Path
    source: str
    dataset: str
    split: str
    reference: str
    kind: str = "sweep"

    @property
    def name(self) -> str:
        """For people: sweep dae_width."""
        return f"sweep {self.folder.name}"

    def files(self) -> dict[str, Path]:
        """Name within the run, and file."""
        figures = sorted((self.folder / "figures").glob("*.png"))
        files = [*(self.folder / name for name in SUMMARY_FILES), *figures]
        return {path.relative_to(self.folder).as_posix(): path for path in files}

    def read(self) -> Record:
        """Definition, the best point's metrics and hashes; raises ProductError."""
        files = self.files()
        contents = {name: sha256(path) for name, path in files.items()}
        config, best = (read_yaml(files[name]) for name in ("sweep.yaml", "best.yaml"))
        end_ms = int(files["summary.csv"].stat().st_mtime * 1000)
        metrics = best.get("metrics", {})
        points = [Point(f"best_{name}", value, 0, end_ms) for name, value in metrics.items()]
        rows = read_csv(files["summary.csv"], "point", "status")
        for status in ("finished", "stopped", "failed"):
            count = sum(row["status"] == status for row in rows)
            points.append(Point(f"points_{status}", float(count), 0, end_ms))
        config_hash = hash_of(config)
        return Record(
            entry=self,
            experiment=_experiment(self.folder),
            config=config,
            config_hash=config_hash,
            content_hash=hash_of([CONTENT, config_hash, contents]),
            points=points,
            start_ms=end_ms,
            end_ms=end_ms,
            tags={"best_point": str(best.get("point", ""))},
        )


@dataclass(frozen=True)
class PointEntry:
    """Where the files of a point of a sweep are."""

    folder: Path
    source: str
    parent: str
    dataset: str
    split: str
    reference: str
    kind: str

    @property
    def name(self) -> str:
        """For people: the axes with their values, or the point's name."""
        values = read_result(self.folder / RESULT)["values"].items()
        return ", ".join(f"{key}={json.dumps(value)}" for key, value in values) or self.folder.name

    def files(self) -> dict[str, Path]:
        """Name within the run, and file."""
        found = [name for name in POINT_FILES if (self.folder / name).is_file()]
        return {
            f"model/{name}" if name in MODEL_FILES else name: self.folder / name for name in found
        }

    def read(self) -> Record:
        """Configuration, metrics and hashes; raises ProductError."""
        files = self.files()
        contents = {name: sha256(path) for name, path in files.items()}
        result = read_result(self.folder / RESULT)
        config = {**result["config"], "axes": result["values"]}
        end_ms = int((self.folder / RESULT).stat().st_mtime * 1000)
        start_ms = end_ms - int(1000 * read_cost(self.folder)["seconds"])
        points = [Point(name, value, 0, end_ms) for name, value in result["metrics"].items()]
        points += epoch_points(self._epochs(), start_ms)
        config_hash = hash_of(config)
        return Record(
            entry=self,
            experiment=_experiment(self.folder.parents[1]),
            config=config,
            config_hash=config_hash,
            content_hash=hash_of([CONTENT, config_hash, contents]),
            points=[point for point in points if math.isfinite(point.value)],
            start_ms=start_ms,
            end_ms=end_ms,
            status="FAILED" if result["status"] == "failed" else "FINISHED",
            parent=self.parent,
            tags={"point": result["point"], "status": result["status"], "reason": result["reason"]},
        )

    def _epochs(self) -> list[dict[str, float]]:
        path = self.folder / "history.csv"
        if not path.is_file():
            return []
        return [
            {key: number(path, text) for key, text in row.items()}
            for row in read_csv(path, "epoch", "seconds")
        ]


def discover_sweep(results: Path, name: str) -> list[SweepEntry | PointEntry]:
    """A sweep and the points in its summary, the parent first.

    Parameters
    ----------
    results : folder that the workflow writes to
    name : of the sweep

    Raises
    ------
    ProductError
        If the sweep has no summary, or a point no result.
    """
    folder = results / "sweeps" / name
    if not (folder / "summary.csv").is_file():
        raise ProductError(
            f"{folder / 'summary.csv'}: missing; run `snakemake sweep --config sweep={name}` first"
        )
    source = f"sweeps/{name}"
    points = []
    for row in read_csv(folder / "summary.csv", "point", "status"):
        place = folder / "points" / row["point"]
        result = read_result(place / RESULT)
        points.append(
            PointEntry(
                folder=place,
                source=f"{source}/points/{row['point']}",
                parent=source,
                dataset=result["dataset"],
                split=result["split"],
                reference=result["reference"],
                kind=result["model"],
            )
        )
    first = points[0]
    parent = SweepEntry(folder, source, first.dataset, first.split, first.reference)
    return [parent, *points]


def _experiment(folder: Path) -> str:
    """Every sweep is an experiment of its own, apart from the paper's scenes."""
    return f"sweep_{folder.name}"
