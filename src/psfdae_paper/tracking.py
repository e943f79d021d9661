"""Finished runs in the results folder, as MLflow shows them: where they are, what they say."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from psfdae import fits
from psfdae.belonging import STARS, require_origin
from psfdae.files import ProductError, read_product
from psfdae.method import HISTORY, Method
from psfdae.methods import method
from psfdae.reading import number, read_csv, read_yaml
from psfdae_paper.alignment.methods import TRAINED
from psfdae_paper.configuration.methods import registered
from psfdae_paper.sweeps.points import hash_of

NETWORKS = {"dae": "dae.safetensors", **dict.fromkeys(TRAINED, "network.safetensors")}
"""Networks of scene 3 and the files of their weights."""

STATISTICS = ("mean_abs_error", "bias", "variance")

SUMMARY_FILES = ("summary.csv", "cost.csv", "best.yaml", "sweep.yaml")
POINT_FILES = ("result.json", "cost.json", "evaluation.csv", "validation.csv")
"""Files that a point of a sweep may have beside its model; a failed one has the first."""

CONTENT = 1
"""Goes into every content hash: raise it when what is taken from the files changes."""


class Point(NamedTuple):
    """A metric at an epoch (0: of the finished run); time in ms since 1970."""

    name: str
    value: float
    epoch: int
    time_ms: int


@dataclass(frozen=True)
class Run:
    """A finished run.

    `source` is the model's place below the results folder, which tells runs apart that
    agree in everything else; `files` are by their names within the run; `status` is
    MLflow's; `parent` the source of the run that this one is a part of, which comes first.
    """

    kind: str
    dataset: str
    split: str
    reference: str
    source: str
    name: str
    experiment: str
    files: Mapping[str, Path]
    config: Mapping[str, Any]
    points: Sequence[Point]
    start_ms: int
    end_ms: int
    config_hash: str
    content_hash: str
    status: str = "FINISHED"
    parent: str = ""
    tags: Mapping[str, str] = field(default_factory=dict)


def _run(
    files: Mapping[str, Path],
    contents: Mapping[str, str],
    config: Mapping[str, Any],
    points: Sequence[Point],
    **more: Any,
) -> Run:
    config_hash = hash_of(config)
    return Run(
        files=files,
        config=config,
        points=[point for point in points if math.isfinite(point.value)],
        config_hash=config_hash,
        content_hash=hash_of([CONTENT, config_hash, contents]),
        **more,
    )


def runs_of_datasets(results: Path, datasets: Mapping[str, Path]) -> list[Run]:
    """Finished runs of some datasets.

    An evaluation is the last file of a run, so it is what counts: models still in
    training are passed over. A method that is fitted once for both references is measured
    against each of them; each of these measurements is a run, so that the metrics of all
    methods with the same tags can be compared.

    Parameters
    ----------
    results : folder that the workflow writes to
    datasets : name of each dataset, and its product "stars"

    Raises
    ------
    ProductError
        If a dataset has no evaluation, a file is missing or damaged, or a model was
        trained on other stars.
    """
    runs = []
    for dataset, stars in datasets.items():
        folder = results / "evaluation" / dataset
        evaluations = sorted(folder.glob("*-*.csv"))
        if not evaluations:
            raise ProductError(f"{folder}: no evaluations; run `snakemake {dataset}` first")
        for path in evaluations:
            split, reference = path.stem.split("-", 1)
            key = {"dataset": dataset, "split": split, "reference": reference}
            figures = _figures(results / "figures" / dataset, split, reference)
            measured = {row["method"] for row in read_csv(path, "method")}
            for kind in registered():
                if kind.storage and kind.name in measured:
                    runs.append(_of_stars(results, kind, key, stars, path, figures))
    return runs


def _of_stars(
    results: Path,
    kind: type[Method],
    key: dict[str, str],
    stars: Path,
    evaluation: Path,
    figures: Mapping[str, Path],
) -> Run:
    """A model and its evaluation.

    Its config is that of the model together with that of its stars: a network trained on
    the stars of another telescope is another run.
    """
    source = fits.place_of(kind, **key)
    model = results / source
    files = _model_files(kind, model) | {"evaluation.csv": evaluation} | figures
    contents = _contents(files)
    product = read_product(stars, "stars", ())
    require_origin(model, STARS, product)
    own, run_kind = kind.described(model), fits.storage_of(kind).run or kind.name
    # Which start succeeded is an outcome, not a setting.
    own.pop("attempt", None)
    epochs = []
    if HISTORY in fits.storage_of(kind).diagnostics:
        epochs = _epochs(fits.beside(kind, model, HISTORY), "train_mse", "validation_mse")
    try:
        experiment = str(product.config["scene"]["experiment"])
    except (KeyError, TypeError):
        raise ProductError(f"{stars}: its config has no scene.experiment") from None
    start_ms, end_ms = _span_ms(fits.outputs(kind, model)[0], epochs)
    points = _epoch_points(epochs, start_ms)
    for row in read_csv(evaluation, "method", "noise_level", "metric", "value", "stderr"):
        if row["method"] == kind.name:
            metric, level = row["metric"], f"{number(evaluation, row['noise_level']):g}"
            for name, column in ((metric, "value"), (f"{metric}_stderr", "stderr")):
                value = number(evaluation, row[column])
                points.append(Point(f"test_{name}_{level}", value, 0, end_ms))
    return _run(
        files,
        contents,
        {**product.config, **own},
        points,
        **key,
        kind=run_kind,
        source=source,
        name=" ".join([*key.values(), run_kind]),
        experiment=experiment,
        start_ms=start_ms,
        end_ms=end_ms,
    )


def _model_files(kind: type[Method], place: Path) -> dict[str, Path]:
    """Files of a fit by their names within the run; `model/` is what the method loads."""
    model = {f"model/{path.name}": path for path in fits.own_files(kind, place)}
    more = fits.storage_of(kind).diagnostics
    return model | {name: fits.beside(kind, place, name) for name in more}


def _figures(folder: Path, split: str, reference: str) -> dict[str, Path]:
    """Figures of a dataset but for those whose path starts with another split or reference."""
    ours = (f"{split}-{reference}", split)
    labels = [f"{s}-{r}" for s in ("random", "held_out") for r in ("realisation", "template")]
    labels += ["random", "held_out"]
    found = {}
    for path in sorted(folder.rglob("*.png")):
        name = path.relative_to(folder).as_posix()
        label = next((label for label in labels if name.startswith(label)), None)
        if label is None or label in ours:
            found[f"figures/{name}"] = path
    return found


def runs_of_alignment(results: Path) -> list[Run]:
    """The trained networks of scene 3.

    Raises
    ------
    ProductError
        If a file is missing or damaged; the table of errors is the last one of the scene.
    """
    errors = results / "tables/alignment_errors.csv"
    if not errors.is_file():
        raise ProductError(f"{errors}: missing; run `snakemake scene3` first")
    figures = {
        f"figures/{path.name}": path
        for path in sorted((results / "figures/alignment").glob("*.png"))
    }
    return [_of_states(results / "alignment" / kind, errors, figures) for kind in NETWORKS]


def _network_files(folder: Path, weights: str) -> dict[str, Path]:
    model = {f"model/{name}": folder / name for name in (weights, "config.yaml")}
    return {**model, "history.csv": folder / "history.csv"}


def _of_states(folder: Path, errors: Path, figures: Mapping[str, Path]) -> Run:
    kind = folder.name
    weights = NETWORKS[kind]
    files = {**_network_files(folder, weights), "evaluation.csv": errors, **figures}
    contents = _contents(files)
    config = read_yaml(folder / "config.yaml")
    config.pop("attempt", None)
    epochs = _epochs(folder / "history.csv")
    start_ms, end_ms = _span_ms(folder / weights, epochs)
    points = _epoch_points(epochs, start_ms)
    tested = len(points)
    for row in read_csv(errors, "test_set", "noise_level", "method", "parameter", "unit"):
        if (row["method"], row["unit"]) == (kind, "range"):
            level = f"{number(errors, row['noise_level']):g}"
            for statistic in STATISTICS:
                name = f"{row['test_set']}_{row['parameter']}_{statistic}_{level}"
                points.append(Point(name, number(errors, row[statistic]), 0, end_ms))
    if len(points) == tested:
        raise ProductError(f"{errors}: no rows of method {kind!r}")
    return _run(
        files,
        contents,
        config,
        points,
        kind=kind,
        dataset="alignment",
        split="uniform and grid",
        reference="states",
        source=f"alignment/{kind}",
        name=f"alignment {kind}",
        experiment="scene3",
        start_ms=start_ms,
        end_ms=end_ms,
    )


def runs_of_sweep(results: Path, name: str) -> list[Run]:
    """A sweep and the points in its summary, the parent first.

    Raises
    ------
    ProductError
        If the sweep has no summary, or a point no result.
    """
    folder = results / "sweeps" / name
    summary = folder / "summary.csv"
    if not summary.is_file():
        raise ProductError(f"{summary}: missing; run `snakemake sweep --config sweep={name}` first")
    # Every sweep is an experiment of its own, apart from the paper's scenes.
    shared = {"experiment": f"sweep_{name}"}
    names = [row["point"] for row in read_csv(summary, "point", "status")]
    points = [_point_of_sweep(folder / "points" / point, name, point) for point in names]
    figures = sorted((folder / "figures").glob("*.png"))
    paths = [*(folder / file for file in SUMMARY_FILES), *figures]
    files = {path.relative_to(folder).as_posix(): path for path in paths}
    contents = _contents(files)
    config, best = read_yaml(folder / "sweep.yaml"), read_yaml(folder / "best.yaml")
    end_ms = int(summary.stat().st_mtime * 1000)
    metrics = [Point(f"best_{key}", v, 0, end_ms) for key, v in best.get("metrics", {}).items()]
    states = [row["status"] for row in read_csv(summary, "point", "status")]
    for status in ("finished", "stopped", "failed"):
        metrics.append(Point(f"points_{status}", float(states.count(status)), 0, end_ms))
    first = points[0]
    parent = _run(
        files,
        contents,
        config,
        metrics,
        **shared,
        kind="sweep",
        dataset=first.dataset,
        split=first.split,
        reference=first.reference,
        source=f"sweeps/{name}",
        name=f"sweep {name}",
        start_ms=end_ms,
        end_ms=end_ms,
        tags={"best_point": str(best.get("point", ""))},
    )
    return [parent, *points]


def _point_of_sweep(place: Path, name: str, point: str) -> Run:
    from psfdae_paper.configuration.sweep import TRAINED
    from psfdae_paper.sweeps.measured import place_of, read_cost, read_result

    result = read_result(place / "result.json")
    model = result["model"]
    if model in TRAINED:
        of_model = _network_files(place, NETWORKS[model])
    else:
        of_model = _model_files(method(model), place_of(method(model), place))
    files = {file: place / file for file in POINT_FILES} | of_model
    files = {file: path for file, path in files.items() if path.is_file()}
    contents = _contents(files)
    end_ms = int((place / "result.json").stat().st_mtime * 1000)
    start_ms = end_ms - int(1000 * read_cost(place)["seconds"])
    history = place / "history.csv"
    epochs = _epochs(history) if history.is_file() else []
    metrics = [Point(key, value, 0, end_ms) for key, value in result["metrics"].items()]
    values = ", ".join(f"{key}={json.dumps(v)}" for key, v in result["values"].items())
    return _run(
        files,
        contents,
        {**result["config"], "axes": result["values"]},
        metrics + _epoch_points(epochs, start_ms),
        **{key: result[key] for key in ("dataset", "split", "reference")},
        experiment=f"sweep_{name}",
        kind=model,
        source=f"sweeps/{name}/points/{point}",
        name=values or point,
        start_ms=start_ms,
        end_ms=end_ms,
        status="FAILED" if result["status"] == "failed" else "FINISHED",
        parent=f"sweeps/{name}",
        tags={key: result[key] for key in ("point", "status", "reason")},
    )


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Leaves of a config by their dotted names; lists and other values as JSON, text as it is."""
    leaves: dict[str, str] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            leaves |= flatten(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = value if isinstance(value, str) else json.dumps(value)
    return leaves


def _contents(files: Mapping[str, Path]) -> dict[str, str]:
    """Hash of every file; raises ProductError if one is missing."""
    found = {}
    for name, path in files.items():
        try:
            with path.open("rb") as file:
                found[name] = hashlib.file_digest(file, "sha256").hexdigest()
        except FileNotFoundError:
            raise ProductError(f"{path}: no such file") from None
    return found


def _span_ms(model: Path, epochs: list[dict[str, float]]) -> tuple[int, int]:
    """Start and end of a training in ms since 1970: the model's file, and the history's seconds."""
    end_ms = int(model.stat().st_mtime * 1000)
    return end_ms - int(1000 * max((row["seconds"] for row in epochs), default=0.0)), end_ms


def _epochs(history: Path, *columns: str) -> list[dict[str, float]]:
    rows = read_csv(history, "epoch", "seconds", *columns)
    return [{name: number(history, text) for name, text in row.items()} for row in rows]


def _epoch_points(epochs: list[dict[str, float]], start_ms: int) -> list[Point]:
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
