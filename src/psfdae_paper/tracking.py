"""Finished runs in the results folder, as MLflow shows them: where they are, what they say."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple, TypedDict

from psfdae import fits
from psfdae.belonging import STARS, require_origin
from psfdae.files import Product, ProductError, read_product
from psfdae.method import CONFIG, HISTORY, Method
from psfdae.methods import method
from psfdae.methods.dae import WEIGHTS as DAE_WEIGHTS
from psfdae.reading import number, read_csv, read_yaml
from psfdae_paper.configuration.aligners import ALIGNERS, SWEPT, TRAINED
from psfdae_paper.configuration.aligners import WEIGHTS as NETWORK_WEIGHTS
from psfdae_paper.configuration.base import config_dir
from psfdae_paper.configuration.compose import dataset_names, load
from psfdae_paper.configuration.methods import registered
from psfdae_paper.sweeps.points import hash_of

WEIGHTS = {"dae": DAE_WEIGHTS, **dict.fromkeys(TRAINED, NETWORK_WEIGHTS)}
"""Files of the networks of scene 3, in their folders."""

MEASURED = ("method", "noise_level", "metric", "value", "stderr")
"""Columns of tables of errors."""

AVERAGED = ("mse", "ssim")
"""Metrics of which a run has the mean over the noise levels, too."""

STATISTICS = ("mean_abs_error", "bias", "variance")

OF_DATASET = ("stars.name", "stars.aberration_fraction", "noise.name", "noise.levels")
"""Settings by which datasets differ."""

MODEL = "model/"
"""Files of a run that are its model have names that begin so."""

SUMMARY_FILES = ("summary.csv", "cost.csv", "best.yaml", "sweep.yaml")
POINT_FILES = ("result.json", "cost.json", "evaluation.csv", "validation.csv")
"""Files that a point of a sweep may have beside its model; a failed one has the first."""

CONTENT = 2
"""Goes into every content hash: raise it when what is taken from the files changes."""


class Point(NamedTuple):
    """A metric at an epoch (0: of the finished run); time in ms since 1970."""

    name: str
    value: float
    epoch: int
    time_ms: int


class Named(TypedDict):
    """Name of a run; see `Run`."""

    kind: str
    dataset: str
    split: str
    reference: str
    source: str
    name: str
    experiment: str


class Fit(NamedTuple):
    """A fit of a method that a model bundle can hold, and its place."""

    kind: type[Method]
    place: Path


@dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes
    ----------
    kind, dataset, split, reference : str
    source : str
        The model's place below the results folder, which tells runs apart that agree in
        everything else.
    name, experiment : str
    files : mapping
        By their names within the run.
    config : mapping
    end_ms : int
        In ms since 1970.
    metrics : mapping
        Of the finished run.
    epochs : sequence
        Rows of the course of the training.
    seconds : float or None
        That the run took; None: those of the last epoch.
    status : str
        MLflow's.
    parent : str
        Source of the run that this one is a part of, which comes first.
    tags : mapping
        Beside those that all runs have.
    data : Path or None
        Product that was learnt from.
    fit : Fit or None
        Of a run whose model restores lone stamps.
    content_hash : str
        Of files and settings.

    Raises
    ------
    ProductError
        If a file is missing.
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
    end_ms: int
    metrics: Mapping[str, float]
    epochs: Sequence[Mapping[str, float]] = ()
    seconds: float | None = None
    status: str = "FINISHED"
    parent: str = ""
    tags: Mapping[str, str] = field(default_factory=dict)
    data: Path | None = None
    fit: Fit | None = None
    content_hash: str = field(init=False)

    def __post_init__(self) -> None:
        contents = {name: digest_of(path) for name, path in self.files.items()}
        object.__setattr__(self, "content_hash", hash_of([CONTENT, self.config_hash, contents]))

    @property
    def config_hash(self) -> str:
        """Tells settings apart; `content_hash` settings and files."""
        return hash_of(self.config)

    @property
    def start_ms(self) -> int:
        """The end less the seconds that the run took."""
        took = max((row["seconds"] for row in self.epochs), default=0.0)
        return self.end_ms - int(1000 * (took if self.seconds is None else self.seconds))

    @property
    def points(self) -> list[Point]:
        """All metrics that are finite."""
        points = epoch_points(self.epochs, self.start_ms)
        points += [Point(name, value, 0, self.end_ms) for name, value in self.metrics.items()]
        return [point for point in points if math.isfinite(point.value)]


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
    files = {**_model_files(kind, model), "evaluation.csv": evaluation, **figures}
    product = read_product(stars, "stars", ())
    require_origin(model, STARS, product)
    own, run_kind = kind.described(model), fits.storage_of(kind).run or kind.name
    # Which start succeeded is an outcome, not a setting.
    own.pop("attempt", None)
    metrics: dict[str, float] = {}
    rows = [row for row in read_csv(evaluation, *MEASURED) if row["method"] == kind.name]
    for row in rows:
        metrics |= _measured(evaluation, row)
    for metric in AVERAGED:
        values = [number(evaluation, row["value"]) for row in rows if row["metric"] == metric]
        if values:
            metrics[f"test_{metric}"] = fmean(values)
    trained = HISTORY in fits.storage_of(kind).diagnostics
    return Run(
        dataset=key["dataset"],
        split=key["split"],
        reference=key["reference"],
        kind=run_kind,
        source=source,
        name=" ".join([*key.values(), run_kind]),
        experiment=_experiment(product),
        files=files,
        config={**product.config, **own},
        end_ms=_time_ms(fits.outputs(kind, model)[0]),
        metrics=metrics,
        data=stars,
        fit=Fit(kind, model) if kind.packing else None,
        epochs=_epochs(fits.path_beside(kind, model, HISTORY), "train_mse", "validation_mse")
        if trained
        else (),
    )


def _experiment(stars: Product) -> str:
    """Name of the experiment of stars, their scene; raises ProductError without one."""
    try:
        return str(stars.config["scene"]["experiment"])
    except (KeyError, TypeError):
        raise ProductError(f"{stars.path}: its config has no scene.experiment") from None


def _measured(path: Path, row: Mapping[str, str]) -> dict[str, float]:
    """Value and standard error of a row of a table of errors, by their names in MLflow."""
    metric, level = row["metric"], f"{number(path, row['noise_level']):g}"
    named = ((metric, "value"), (f"{metric}_stderr", "stderr"))
    return {f"test_{name}_{level}": number(path, row[column]) for name, column in named}


def _model_files(kind: type[Method], place: Path) -> dict[str, Path]:
    """Files of a fit by their names within the run; `model/` is what the method loads."""
    model = {f"{MODEL}{path.name}": path for path in fits.own_files(kind, place)}
    more = fits.storage_of(kind).diagnostics
    return model | {name: fits.path_beside(kind, place, name) for name in more}


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
    figures = sorted((results / "figures/alignment").glob("*.png"))
    more = {"evaluation.csv": errors, **{f"figures/{path.name}": path for path in figures}}
    states = {kind: ALIGNERS[kind].states for kind in TRAINED} | {"dae": "grid"}
    data = {kind: results / f"data/alignment/{name}.h5" for kind, name in states.items()}
    return [_of_states(results / "alignment" / kind, data[kind], errors, more) for kind in WEIGHTS]


def _network_files(folder: Path, weights: str) -> dict[str, Path]:
    return {f"{MODEL}{name}": folder / name for name in (weights, CONFIG)} | {
        HISTORY: folder / HISTORY
    }


def _of_states(folder: Path, data: Path, errors: Path, more: Mapping[str, Path]) -> Run:
    kind, weights = folder.name, WEIGHTS[folder.name]
    files = {**_network_files(folder, weights), **more}
    config = read_yaml(folder / CONFIG)
    config.pop("attempt", None)
    metrics = {}
    for row in read_csv(errors, "test_set", "noise_level", "method", "parameter", "unit"):
        if (row["method"], row["unit"]) == (kind, "range"):
            level = f"{number(errors, row['noise_level']):g}"
            for statistic in STATISTICS:
                name = f"{row['test_set']}_{row['parameter']}_{statistic}_{level}"
                metrics[name] = number(errors, row[statistic])
    if not metrics:
        raise ProductError(f"{errors}: no rows of method {kind!r}")
    return Run(
        **_of_scene3(kind),
        files=files,
        config=config,
        end_ms=_time_ms(folder / weights),
        metrics=metrics,
        data=data,
        epochs=_epochs(folder / HISTORY),
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
    rows = list(read_csv(summary, "point", "status"))
    points = [_point_of_sweep(folder / "points" / row["point"], name, row["point"]) for row in rows]
    figures = sorted((folder / "figures").glob("*.png"))
    paths = [*(folder / file for file in SUMMARY_FILES), *figures]
    best, states = read_yaml(folder / "best.yaml"), [row["status"] for row in rows]
    metrics = {f"best_{key}": value for key, value in best.get("metrics", {}).items()}
    for status in ("finished", "stopped", "failed"):
        metrics[f"points_{status}"] = float(states.count(status))
    parent = Run(
        kind="sweep",
        **{key: getattr(points[0], key) for key in ("dataset", "split", "reference")},
        source=f"sweeps/{name}",
        name=f"sweep {name}",
        # Every sweep is an experiment of its own, apart from the paper's scenes.
        experiment=f"sweep_{name}",
        files={path.relative_to(folder).as_posix(): path for path in paths},
        config=read_yaml(folder / "sweep.yaml"),
        end_ms=_time_ms(summary),
        metrics=metrics,
        tags={"best_point": str(best.get("point", ""))},
    )
    return [parent, *points]


def _point_of_sweep(place: Path, name: str, point: str) -> Run:
    from psfdae_paper.sweeps.measured import fit_in, read_cost, read_result

    result = read_result(place / "result.json")
    model = result["model"]
    if model in SWEPT:
        of_model = _network_files(place, NETWORK_WEIGHTS)
    else:
        of_model = _model_files(method(model), fit_in(method(model), place))
    files = {file: place / file for file in POINT_FILES} | of_model
    history = place / HISTORY
    values = ", ".join(f"{key}={json.dumps(v)}" for key, v in result["values"].items())
    return Run(
        kind=model,
        **{key: result[key] for key in ("dataset", "split", "reference")},
        source=f"sweeps/{name}/points/{point}",
        name=values or point,
        experiment=f"sweep_{name}",
        files={file: path for file, path in files.items() if path.is_file()},
        config={**result["config"], "axes": result["values"]},
        end_ms=_time_ms(place / "result.json"),
        metrics=result["metrics"],
        epochs=_epochs(history) if history.is_file() else (),
        seconds=read_cost(place)["seconds"],
        status="FAILED" if result["status"] == "failed" else "FINISHED",
        parent=f"sweeps/{name}",
        tags={key: result[key] for key in ("point", "status", "reason")},
        data=_data_of(place.parents[3], result),
    )


def _data_of(results: Path, result: Mapping[str, Any]) -> Path | None:
    """Product of a point of a sweep, if the workflow made it under its usual name."""
    config = result["config"]
    try:
        if result["model"] in SWEPT:
            return results / f"data/alignment/{ALIGNERS[result['model']].states}.h5"
        return results / f"data/{config['scene']['name']}/{config['stars']['name']}.h5"
    except KeyError:
        return None


def training_at(checkpoint: Path, results: Path, preset: str) -> Run | None:
    """Return the run of a training under way, by its checkpoint's place; None if it has no run.

    Those of datasets and of scene 3 have runs.
    """
    folder = results / "checkpoints"
    if not checkpoint.is_relative_to(folder):
        return None
    *places, stem = checkpoint.relative_to(folder).with_suffix("").parts
    network = stem.removeprefix("alignment-")
    if len(places) == len(("method", "dataset")):
        (kind, dataset), (split, reference) = places, stem.split("-", 1)
        name = fits.storage_of(method(kind)).run or kind
        said = Named(
            kind=name,
            dataset=dataset,
            split=split,
            reference=reference,
            source=fits.place_of(method(kind), dataset, split, reference),
            name=" ".join([dataset, split, reference, name]),
            experiment=load((f"dataset={dataset}", f"preset={preset}")).scene.experiment,
        )
    elif network in WEIGHTS and network != stem:
        said = _of_scene3(network)
    else:
        return None
    return Run(**said, files={}, config={}, metrics={}, end_ms=0, status="RUNNING")


def _of_scene3(kind: str) -> Named:
    """Return the name of the run of a network of scene 3."""
    return Named(
        kind=kind,
        dataset="alignment",
        split="uniform and grid",
        reference="states",
        source=f"alignment/{kind}",
        name=f"alignment {kind}",
        experiment="scene3",
    )


def settings_of(run: Run, preset: str) -> dict[str, str]:
    """The settings that tell a run from others, by their dotted names.

    They are what its dataset and its method are, and those that are not the configuration's for
    this dataset and preset. Which they are does not depend on other runs.
    """
    usual = _usual(run.dataset, preset)
    differing = {
        key: value
        for key, value in flatten(run.config).items()
        if key in OF_DATASET or usual.get(key) != value
    }
    return {"method": run.kind, "split": run.split, "reference": run.reference, **differing}


@cache
def _usual(dataset: str, preset: str) -> dict[str, str]:
    """Settings of a dataset where nobody gives others; none if the configuration has it not."""
    if dataset not in dataset_names() or not (config_dir() / f"preset/{preset}.yaml").is_file():
        return {}
    return flatten(load((f"dataset={dataset}", f"preset={preset}")).model_dump())


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Leaves of a config by their dotted names; lists and other values as JSON, text as it is."""
    leaves: dict[str, str] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            leaves |= flatten(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = value if isinstance(value, str) else json.dumps(value)
    return leaves


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file; raises ProductError if it is missing."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        raise ProductError(f"{path}: no such file") from None


def _time_ms(path: Path) -> int:
    """When a file was written, in ms since 1970."""
    try:
        return int(path.stat().st_mtime * 1000)
    except FileNotFoundError:
        raise ProductError(f"{path}: no such file") from None


def _epochs(history: Path, *columns: str) -> list[dict[str, float]]:
    rows = read_csv(history, "epoch", "seconds", *columns)
    return [{name: number(history, text) for name, text in row.items()} for row in rows]


def epoch_points(epochs: Sequence[Mapping[str, float]], start_ms: int) -> list[Point]:
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
