"""Finished networks of scene 3 in the results folder, as runs that MLflow can import."""

from __future__ import annotations

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
    span_ms,
)

NETWORKS = {
    "dae": ("dae.safetensors", "dae"),
    "original": ("cnn.safetensors", "original"),
    "noise_trained": ("cnn.safetensors", "noise_trained"),
    "dae_retrained": ("cnn.safetensors", "dae_retrained"),
}
"""File of each network's weights, and the method of the table of errors that it stands for."""

EXPERIMENT = "scene3"
STATISTICS = ("mean_abs_error", "bias", "variance")


@dataclass(frozen=True)
class AlignmentEntry:
    """Where the files of one trained network of scene 3 are."""

    kind: str
    source: str
    folder: Path
    errors: Path
    figures: tuple[tuple[str, Path], ...] = ()
    dataset: str = "alignment"
    split: str = "uniform and grid"
    reference: str = "states"

    @property
    def name(self) -> str:
        """For people: alignment noise_trained."""
        return f"{self.dataset} {self.kind}"

    def files(self) -> dict[str, Path]:
        """Name within the run, and file."""
        weights = NETWORKS[self.kind][0]
        return {
            f"model/{weights}": self.folder / weights,
            "model/config.yaml": self.folder / "config.yaml",
            "history.csv": self.folder / "history.csv",
            "evaluation.csv": self.errors,
            **{f"figures/{name}": path for name, path in self.figures},
        }

    def read(self) -> Record:
        """Config, metrics and hashes; raises ProductError if a file is missing or damaged."""
        files = self.files()
        contents = {name: sha256(path) for name, path in files.items()}
        config = read_yaml(files["model/config.yaml"])
        config.pop("attempt", None)
        history = files["history.csv"]
        epochs = [
            {key: number(history, text) for key, text in row.items()}
            for row in read_csv(history, "epoch", "seconds")
        ]
        start_ms, end_ms = span_ms(self.folder / NETWORKS[self.kind][0], epochs)
        points = epoch_points(epochs, start_ms) + self._test_points(end_ms)
        config_hash = hash_of(config)
        return Record(
            entry=self,
            experiment=EXPERIMENT,
            config=config,
            config_hash=config_hash,
            content_hash=hash_of([CONTENT, config_hash, contents]),
            points=[point for point in points if math.isfinite(point.value)],
            start_ms=start_ms,
            end_ms=end_ms,
        )

    def _test_points(self, time_ms: int) -> list[Point]:
        method = NETWORKS[self.kind][1]
        rows = read_csv(self.errors, "test_set", "noise_level", "method", "parameter", "unit")
        points = []
        for row in rows:
            if (row["method"], row["unit"]) == (method, "range"):
                level = f"{number(self.errors, row['noise_level']):g}"
                for statistic in STATISTICS:
                    name = f"{row['test_set']}_{row['parameter']}_{statistic}_{level}"
                    points.append(Point(name, number(self.errors, row[statistic]), 0, time_ms))
        if not points:
            raise ProductError(f"{self.errors}: no rows of method {method!r}")
        return points


def discover_alignment(results: Path) -> list[AlignmentEntry]:
    """The trained networks of scene 3.

    Parameters
    ----------
    results : folder that the workflow writes to

    Raises
    ------
    ProductError
        If the table of errors is missing: it is the last file of the scene.
    """
    errors = results / "tables/alignment_errors.csv"
    if not errors.is_file():
        raise ProductError(f"{errors}: missing; run `snakemake scene3` first")
    figures = tuple((p.name, p) for p in sorted((results / "figures/alignment").glob("*.png")))
    return [
        AlignmentEntry(kind, f"alignment/{kind}", results / "alignment" / kind, errors, figures)
        for kind in NETWORKS
    ]
