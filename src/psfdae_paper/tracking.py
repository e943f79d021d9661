"""Runs as MLflow shows them, read from the files in the results folder.

Each `TrackedRun` names its files, settings and metrics in the results folder. This module does not
use MLflow's database.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import starmap
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, ClassVar

from psfdae.base.belonging import STARS, require_origin
from psfdae.base.files import ProductError, compute_sha256, read_product
from psfdae.base.reading import from_tree, read_json, read_table, read_yaml
from psfdae.base.settings import leaves
from psfdae.denoise.bundle import SUFFIX
from psfdae.methods import fit_files as fits
from psfdae.methods import method
from psfdae.methods.dae import WEIGHTS as DAE_WEIGHTS
from psfdae.methods.interface import CONFIG, HISTORY, Method
from psfdae_paper.configuration.base import config_dir
from psfdae_paper.configuration.compose import list_datasets, load
from psfdae_paper.configuration.estimators import (
    ESTIMATORS,
    Estimator,
    list_swept_networks,
    list_trained_networks,
)
from psfdae_paper.configuration.methods import list_methods
from psfdae_paper.evaluation.night import read_night
from psfdae_paper.sweeps.points import compute_hash

if TYPE_CHECKING:
    from mlflow.entities import Metric


@dataclass(frozen=True)
class TrackedRun:
    """Run of a method, a network or a sweep.

    Attributes
    ----------
    kind, dataset, split, reference : str
        Method, or kind of network; name of the stars; split and reference of the training.
    source : str
        Path of the model below the results folder, which distinguishes runs that agree in
        everything else.
    name, experiment : str
        Name of the run, and of MLflow's experiment that holds it.
    files : mapping of str to Path
        Files by their names within the run; names of model files begin with `model_prefix`.
    config : mapping
        Configuration of the training and of its stars.
    last_file : Path or None
        File that the run has written last; None while it runs.
    metrics : mapping of str to float
        Metrics of the finished run; the name of one at a noise level ends in it.
    epochs : sequence of mappings
        Rows of the training history.
    seconds : float or None
        Duration of the job that made the run; by default the time up to the last epoch.
    status : str
        Status in MLflow.
    parent : str
        Source of the run that this one is a part of, which is imported before it.
    tags : mapping of str to str
        Tags that not all runs have.
    data : Path or None
        Product with the training data.
    fit : tuple of a type of Method and a Path, or None
        Fit that a model bundle can hold, and its folder or file.
    averaged : tuple of str
        Metrics whose means over the noise levels are also metrics of a run.

    Raises
    ------
    ProductError
        If a file is missing.
    """

    model_prefix: ClassVar = "model/"
    averaged_metrics: ClassVar = ("mse", "ssim")

    kind: str
    dataset: str
    split: str
    reference: str
    source: str
    name: str
    experiment: str
    files: Mapping[str, Path] = field(default_factory=dict)
    config: Mapping[str, Any] = field(default_factory=dict)
    last_file: Path | None = None
    metrics: Mapping[str, float] = field(default_factory=dict)
    epochs: Sequence[Mapping[str, float]] = ()
    seconds: float | None = None
    status: str = "FINISHED"
    parent: str = ""
    tags: Mapping[str, str] = field(default_factory=dict)
    data: Path | None = None
    fit: tuple[type[Method], Path] | None = None

    def __post_init__(self) -> None:
        """Require all files: a run is read as a whole or not at all."""
        for path in (*self.files.values(), self.last_file):
            if path is not None and not path.is_file():
                raise ProductError(f"{path}: no such file")

    @property
    def model_files(self) -> dict[str, Path]:
        """Files of the model by their names without the prefix; none for a sweep as a whole."""
        return {
            name.removeprefix(self.model_prefix): path
            for name, path in self.files.items()
            if name.startswith(self.model_prefix)
        }

    @cached_property
    def config_hash(self) -> str:
        """Hash of the settings alone."""
        return compute_hash(self.config)

    @cached_property
    def content_hash(self) -> str:
        """Hash of files and settings."""
        # 4 is a version: raise it when other metrics or settings are read from the files, and all
        # runs are imported again.
        contents = {name: compute_sha256(path) for name, path in self.files.items()}
        return compute_hash([4, self.config_hash, contents])

    @property
    def end_ms(self) -> int:
        """Time of the end in ms since 1970; 0 for a run that has not ended."""
        return int(1000 * self.last_file.stat().st_mtime) if self.last_file else 0

    @property
    def start_ms(self) -> int:
        """Time of the start in ms since 1970, from the end and the duration."""
        # The history counts seconds from the start of the training.
        seconds = self.seconds
        if seconds is None:
            seconds = max((row["seconds"] for row in self.epochs), default=0.0)
        return self.end_ms - int(1000 * seconds)


def convert_metric(name: str, value: float) -> tuple[str, int, float]:
    """Return a metric as MLflow shows it: name, step and value.

    MLflow prints five decimals: a mean squared error is given in 1e-6, as its name says. The step
    of a metric at a noise level λ is λ in 1e-6, with which the name begins, so that MLflow draws it
    against λ in a section of its own. The step of other metrics is 0.
    """
    # The noise level at the end of the name.
    level = re.search(r"_(\d[\d.e-]*)$", name)
    name = name[: level.start()] if level else name
    if "mse" in name.split("_"):
        name, value = f"{name}_1e-6", 1e6 * value
    return (
        (f"lambda_1e-6/{name}", round(1e6 * float(level[1])), value) if level else (name, 0, value)
    )


def read_job_seconds(benchmark: Path) -> float | None:
    """Return the duration of a job from Snakemake's table of its cost; None without the table."""
    # A job that was repeated has a row for each time.
    return read_table(benchmark, "s", sep="\t").s.iloc[-1] if benchmark.is_file() else None


def read_dataset_runs(results: Path, datasets: Mapping[str, Path]) -> list[TrackedRun]:
    """Read the finished runs of datasets.

    An evaluation is the last file of a run; models still in training lack it. A method that is
    fitted once for both references is measured against each of them; each of these measurements is
    a run, so that the metrics of all methods with the same tags can be compared.

    Parameters
    ----------
    results : Path
        Folder that the workflow writes to.
    datasets : mapping of str to Path
        Product "stars" by name of the dataset.

    Raises
    ------
    ProductError
        If an evaluation or another file is missing or damaged, or a model was trained on
        other stars.
    """
    runs = []
    for dataset, stars in datasets.items():
        folder = results / "evaluation" / dataset
        # A table of errors for each split and reference.
        evaluations = sorted(folder.glob("*-*.csv"))
        if not evaluations:
            raise ProductError(f"{folder}: no evaluations; run `snakemake {dataset}` first")
        for path in evaluations:
            # Every method in the table of errors that leaves files is a run.
            split, reference = path.stem.split("-", 1)
            method_names = {*read_table(path, "method").method}
            for kind in list_methods():
                if kind.storage and kind.name in method_names:
                    runs.append(
                        _read_fit_run(results, kind, (dataset, split, reference), stars, path)
                    )
    return runs


def _read_fit_run(
    results: Path, kind: type[Method], key: tuple[str, str, str], stars: Path, evaluation: Path
) -> TrackedRun:
    """Read a fit to the stars of a dataset, and its evaluation.

    Its config holds the settings of the model and of its stars: a network trained on the
    stars of another telescope is another run.

    Parameters
    ----------
    results : Path
        Folder that the workflow writes to.
    kind : type of Method
        Class of the fitted method.
    key : tuple of three str
        Dataset, split and reference of the training.
    stars, evaluation : Path
        Product "stars", and table of errors.
    """
    dataset, split, reference = key
    # The model must have been trained on the stars of the dataset.
    model = results / fits.get_fit_path(kind, *key)
    product = read_product(stars, "stars", ())
    require_origin(model, STARS, product)
    # The settings of the model are in a file of the fit, the settings of its stars in their
    # product.
    settings = kind.read_config(model)
    # The number of the start that succeeded is a result, not a setting.
    settings.pop("attempt", None)
    # Means over the noise levels, the first that MLflow compares, then value and standard error of
    # each metric at each level λ.
    table = read_table(evaluation, "method", "noise_level", "metric", "value", "stderr")
    rows = table[table.method == kind.name]
    metrics: dict[str, float] = {}
    for metric in TrackedRun.averaged_metrics:
        if metric in {*rows.metric}:
            metrics[f"test_{metric}"] = fmean(rows.value[rows.metric == metric])
    for row in rows.to_dict("records"):
        metrics[f"test_{row['metric']}_{row['noise_level']:g}"] = row["value"]
        metrics[f"test_{row['metric']}_stderr_{row['noise_level']:g}"] = row["stderr"]
    # Figures of the dataset, without those whose name has another split or reference.
    figures = {}
    folder = results / "figures" / dataset
    for path in sorted(folder.rglob("*.png")):
        name = path.relative_to(folder).as_posix()
        label = re.match("(random|held_out)(-(realisation|template))?", name)
        if label is None or label[0] in (split, f"{split}-{reference}"):
            figures[f"figures/{name}"] = path
    # Methods that are trained in epochs have a history.
    storage = fits.get_storage(kind)
    history = fits.path_beside(kind, model, HISTORY) if HISTORY in storage.diagnostics else None
    job = f"{fits.get_rule_name(kind)}/{fits.stem(kind, *key)}"
    return TrackedRun(
        kind=kind.name,
        dataset=dataset,
        split=split,
        reference=reference,
        source=fits.get_fit_path(kind, *key),
        name=" ".join([kind.name, *key]),
        experiment=from_tree(stars, product.config, "scene", lambda scene: scene["experiment"]),
        files={**_model_files(kind, model), "evaluation.csv": evaluation, **figures},
        config={**product.config, **settings},
        last_file=fits.outputs(kind, model)[0],
        metrics=metrics,
        data=stars,
        fit=(kind, model) if kind.packing else None,
        epochs=_epochs(history) if history else (),
        seconds=read_job_seconds(results / f"benchmarks/{job}.tsv"),
    )


def _model_files(kind: type[Method], path: Path) -> dict[str, Path]:
    """List the files of a fit by their names within the run; `model/` is what the method loads."""
    model = {f"{TrackedRun.model_prefix}{file.name}": file for file in fits.own_files(kind, path)}
    # Course of the training and the like, which `load` does not need.
    diagnostics = fits.get_storage(kind).diagnostics
    return model | {name: fits.path_beside(kind, path, name) for name in diagnostics}


def read_alignment_runs(results: Path) -> list[TrackedRun]:
    """Read the trained networks of scene 3.

    Raises
    ------
    ProductError
        If a file is missing or damaged; the table of errors is the last one of the scene.
    """
    errors = results / "tables/alignment_errors.csv"
    if not errors.is_file():
        raise ProductError(f"{errors}: missing; run `snakemake scene3` first")
    columns = ("test_set", "noise_level", "method", "parameter", "unit")
    table = read_table(errors, *columns, "mean_abs_error", "bias", "variance")
    # All networks share the table of errors and the figures of the scene.
    figures = sorted((results / "figures/alignment").glob("*.png"))
    scene_files = {"evaluation.csv": errors, **{f"figures/{path.name}": path for path in figures}}
    runs = []
    for kind in ("dae", *list_trained_networks()):
        weights = DAE_WEIGHTS if kind == "dae" else Estimator.weights_file
        folder = results / "alignment" / kind
        # As for datasets, the number of the start that succeeded is not a setting.
        config = read_yaml(folder / CONFIG)
        config.pop("attempt", None)
        # Errors of the state parameters in units of their range, by test set and noise level.
        rows = table[(table.method == kind) & (table.unit == "range")]
        if rows.empty:
            raise ProductError(f"{errors}: no rows of method {kind!r}")
        metrics = {
            f"{row['test_set']}_{row['parameter']}_{name}_{row['noise_level']:g}": row[name]
            for row in rows.to_dict("records")
            for name in ("mean_abs_error", "bias", "variance")
        }
        # The set of states on which it was trained.
        states = "grid" if kind == "dae" else ESTIMATORS[kind].states
        runs.append(
            TrackedRun(
                kind=kind,
                dataset="alignment",
                split="uniform and grid",
                reference="states",
                source=f"alignment/{kind}",
                name=f"alignment {kind}",
                experiment="scene3",
                files={**_network_files(folder, weights), **scene_files},
                config=config,
                last_file=folder / weights,
                metrics=metrics,
                data=results / f"data/alignment/{states}.h5",
                epochs=_epochs(folder / HISTORY),
                seconds=read_job_seconds(results / f"benchmarks/alignment/{kind}.tsv"),
            )
        )
    return runs


def _network_files(folder: Path, weights: str) -> dict[str, Path]:
    """List the files of a network of scene 3 by their names within the run."""
    model = {f"{TrackedRun.model_prefix}{name}": folder / name for name in (weights, CONFIG)}
    return model | {HISTORY: folder / HISTORY}


def read_night_runs(results: Path) -> list[TrackedRun]:
    """Read the images of a night that have a model, each a run of the experiment "night".

    Raises
    ------
    ProductError
        If the table of the night or a model is missing.
    """
    night = read_night(results / "night/night.csv", "image", "name", "verdict")
    runs = []
    for row in night[night.verdict != "failed"].to_dict("records"):
        name = str(row["name"])
        source = f"night/images/{name}{SUFFIX}"
        # All numbers of the row are metrics, and the texts tags.
        numbers = {str(k): float(v) for k, v in row.items() if isinstance(v, int | float)}
        texts = {str(k): v for k, v in row.items() if isinstance(v, str) and v}
        runs.append(
            TrackedRun(
                kind="field",
                dataset="night",
                split="held_out",
                reference="realisation",
                source=source,
                name=name,
                experiment="night",
                files={f"{TrackedRun.model_prefix}{name}{SUFFIX}": results / source},
                config={"image": row["image"]},
                last_file=results / source,
                metrics={k: number for k, number in numbers.items() if math.isfinite(number)},
                seconds=0.0,
                tags={key: texts[key] for key in ("verdict", "reason", "time") if key in texts},
            )
        )
    return runs


def read_sweep_runs(results: Path, name: str) -> list[TrackedRun]:
    """Read a sweep and the points in its summary, the parent first.

    Raises
    ------
    ProductError
        If the summary of the sweep or the result of a point is missing.
    """
    folder = results / "sweeps" / name
    summary = folder / "summary.csv"
    if not summary.is_file():
        raise ProductError(f"{summary}: missing; run `snakemake sweep --config sweep={name}` first")
    # A row of the summary for each point, and a run of its own.
    table = read_table(summary, "point", "status", dtype=str)
    # The parent has the split and the reference of its points, which all are the same.
    points = [_read_point_run(results, name, point) for point in table.point]
    tables = [folder / file for file in ("summary.csv", "cost.csv", "best.yaml", "sweep.yaml")]
    paths = [*tables, *sorted((folder / "figures").glob("*.png"))]
    # Metrics of the best point, and numbers of points by their status.
    best_point = read_yaml(folder / "best.yaml")
    metrics = {f"best_{key}": value for key, value in best_point.get("metrics", {}).items()}
    for status in ("finished", "stopped", "failed"):
        metrics[f"points_{status}"] = float((table.status == status).sum())
    parent = TrackedRun(
        kind="sweep",
        **{key: getattr(points[0], key) for key in ("dataset", "split", "reference")},
        source=f"sweeps/{name}",
        name=f"sweep {name}",
        # Every sweep is an experiment of its own, apart from the paper's scenes.
        experiment=f"sweep_{name}",
        files={path.relative_to(folder).as_posix(): path for path in paths},
        config=read_yaml(folder / "sweep.yaml"),
        last_file=summary,
        metrics=metrics,
        tags={"best_point": str(best_point.get("point", ""))},
        # From the start of its first point.
        seconds=summary.stat().st_mtime - min(point.start_ms for point in points) / 1000,
    )
    return [parent, *points]


def _read_point_run(results: Path, name: str, point: str) -> TrackedRun:
    """Read a point of the sweep `name`; a failed point has only files of its result and cost."""
    from psfdae_paper.sweeps.measurement import locate_fit

    # A point has a folder with all its files.
    folder = results / "sweeps" / name / "points" / point
    result = read_json(folder / "result.json")
    model, config = result["model"], result["config"]
    # Files of the model, and the product with its training data if the workflow made it.
    data = None
    if model in list_swept_networks():
        model_files = _network_files(folder, Estimator.weights_file)
        data = results / f"data/alignment/{ESTIMATORS[model].states}.h5"
    else:
        model_files = _model_files(method(model), locate_fit(method(model), folder))
        with suppress(KeyError):
            data = results / f"data/{config['scene']['name']}/{config['stars']['name']}.h5"
    # A point that was stopped or failed lacks some of these.
    tables = ("result.json", "cost.json", "evaluation.csv", "validation.csv")
    files = {file: folder / file for file in tables} | model_files
    history = folder / HISTORY
    # The run is named by the values of the point on the axes of the sweep.
    values = ", ".join(f"{key}={json.dumps(v)}" for key, v in result["values"].items())
    return TrackedRun(
        kind=model,
        **{key: result[key] for key in ("dataset", "split", "reference")},
        source=f"sweeps/{name}/points/{point}",
        name=values or point,
        experiment=f"sweep_{name}",
        files={file: path for file, path in files.items() if path.is_file()},
        config={**config, "axes": result["values"]},
        last_file=folder / "result.json",
        metrics=result["metrics"],
        epochs=_epochs(history) if history.is_file() else (),
        seconds=read_job_seconds(results / f"benchmarks_on_request/sweep/{name}/{point}.tsv"),
        status="FAILED" if result["status"] == "failed" else "FINISHED",
        parent=f"sweeps/{name}",
        tags={key: result[key] for key in ("point", "status", "reason")},
        data=data,
    )


def select_settings(run: TrackedRun, preset: str) -> dict[str, str]:
    """Return the settings that distinguish a run from others, by their dotted names.

    These are its method, the settings in which datasets differ, and the settings that differ from
    the configuration of this dataset and preset. The choice does not depend on other runs.
    """
    # Always shown: the settings in which the paper's datasets differ.
    dataset_keys = ("stars.name", "stars.aberration_fraction", "noise.name", "noise.levels")
    defaults = {}
    # Stars other than the datasets, such as a user's own, lack defaults.
    if run.dataset in list_datasets() and (config_dir() / f"preset/{preset}.yaml").is_file():
        # Settings of the dataset as the preset alone has them.
        defaults = flatten(load((f"dataset={run.dataset}", f"preset={preset}")).model_dump())
    differing = {
        key: value
        for key, value in flatten(run.config).items()
        if key in dataset_keys or defaults.get(key) != value
    }
    return {"method": run.kind, "split": run.split, "reference": run.reference, **differing}


def flatten(tree: Mapping[str, Any]) -> dict[str, str]:
    """Return the leaves of a config by their dotted names: text unchanged, other values as JSON."""
    return {key: v if isinstance(v, str) else json.dumps(v) for key, v in leaves(tree)}


def _epochs(history: Path) -> list[dict[str, float]]:
    """Read the rows of a training history, whose columns are all numbers."""
    rows = read_table(history, "epoch", "seconds", dtype=float).to_dict("records")
    return [{str(name): value for name, value in row.items()} for row in rows]


def epoch_metrics(epochs: Sequence[Mapping[str, float]], start_ms: int) -> list[Metric]:
    """Return the metrics of every epoch of a history, and the best validation error.

    `start_ms` is the start of the training in ms since 1970.
    """
    from mlflow.entities import Metric

    # Other columns of the history are counters and times, not metrics.
    metrics = [
        Metric(f"epoch/{name}", value, start_ms + int(1000 * row["seconds"]), int(row["epoch"]))
        for row in epochs
        for name, _, value in starmap(convert_metric, row.items())
        if name not in ("epoch", "step", "seconds", "cpu_seconds")
    ]
    # MLflow's lists show the last value of a metric; the network that is stored has the lowest.
    errors = [m for m in metrics if "/validation_mse" in m.key and math.isfinite(m.value)]
    if errors:
        best_metric = min(errors, key=lambda m: m.value)
        name = best_metric.key.replace("epoch/", "best_")
        metrics.append(Metric(name, best_metric.value, best_metric.timestamp, best_metric.step))
    return metrics
