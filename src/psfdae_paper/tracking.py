"""Runs of the results folder for MLflow: tables in, runs out.

A `TrackedRun` names the tables, settings and files of a method, a network, an image or a sweep in
the results folder. This module does not use MLflow's database.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from psfdae.base.belonging import STARS, require_origin
from psfdae.base.files import ProductError, compute_sha256, read_product
from psfdae.base.reading import from_tree, read_json, read_table, read_yaml
from psfdae.base.settings import leaves, parse_settings
from psfdae.denoise.bundle import SUFFIX, Bundle, read_bundle
from psfdae.methods import fit_files as fits
from psfdae.methods import method
from psfdae.methods.interface import CONFIG, HISTORY, Method
from psfdae.training.packing import build_uncalibrated
from psfdae.training.star_sets import read_stars
from psfdae_paper.configuration import estimators
from psfdae_paper.configuration.compose import part
from psfdae_paper.configuration.experiment import Experiment
from psfdae_paper.evaluation.night import read_night
from psfdae_paper.sweeps.points import compute_hash

TASK = ("seed", "noise", "parts")
"""Groups of settings that decide with which stars and noise a method is trained and tested."""

KEY = ("kind", "dataset", "split", "reference")
"""Names of method, stars, split and reference of a run."""


@dataclass(frozen=True)
class TrackedRun:
    """Run of a method, a network or a sweep.

    Attributes
    ----------
    root : Path
        Folder of the results, which has all files of the run.
    experiment : str
        Name of MLflow's experiment.
    source : str
        Path below `root` that distinguishes runs which agree in everything else.
    key : tuple of four str
        Method, or kind of network; name of the stars; split and reference of the training (`KEY`).
    config : mapping
        Settings of the training and of its stars.
    fit_files : sequence of Path
        Files of the model or of the result; the first one was written last.
    files : sequence of Path
        Tables and figures. A history has a row for each epoch.
    metrics : mapping of str to float
        Metrics of the finished run, by the names that tables give them.
    job : str
        Path of the cost of the job that made the run, a table of Snakemake below `root`.
    name : str
        Name of the run, by default its key.
    parent : str
        Source of the run that this one is a part of, which is imported before it.
    tags : mapping of str to str
        Tags that not all runs have.
    data : Path or None
        Product with the training data, if there is one.
    bundle : callable or None
        Function that returns the model bundle of the run; None if no bundle can hold its model.

    Raises
    ------
    ProductError
        If a file is missing.
    """

    root: Path
    experiment: str
    source: str
    key: tuple[str, ...]
    config: Mapping[str, Any]
    fit_files: Sequence[Path]
    files: Sequence[Path] = ()
    metrics: Mapping[str, float] = field(default_factory=dict)
    job: str = ""
    name: str = ""
    parent: str = ""
    tags: Mapping[str, str] = field(default_factory=dict)
    data: Path | None = None
    bundle: Callable[[], Bundle] | None = None

    def __post_init__(self) -> None:
        """Require all files: a run is read as a whole or not at all."""
        for path in (*self.fit_files, *self.files):
            if not path.is_file():
                raise ProductError(f"{path}: no such file")
        object.__setattr__(self, "name", self.name or " ".join(self.key))

    @cached_property
    def config_hash(self) -> str:
        """Hash of the settings alone."""
        return compute_hash(self.config)

    @cached_property
    def content_hash(self) -> str:
        """Hash of files and settings."""
        # 5 is a version: raise it when other metrics or settings are read from the files, and all
        # runs are imported again.
        paths = (*self.fit_files, *self.files)
        contents = {path.relative_to(self.root).as_posix(): compute_sha256(path) for path in paths}
        return compute_hash([5, self.config_hash, contents])

    @cached_property
    def data_hash(self) -> str:
        """First 16 digits of the checksum of the training data; "" without such data."""
        return compute_sha256(self.data)[:16] if self.data and self.data.is_file() else ""

    @property
    def validation_hash(self) -> str:
        """Hash of all that validation errors must have in common to be compared.

        These are the stars, the parts into which they are split, the truth, and the noise.
        """
        return compute_hash([self.data_hash, *self.key, *map(self.config.get, TASK)])

    @property
    def params(self) -> dict[str, str]:
        """All settings by their dotted names: texts unchanged, other values as JSON."""
        return flatten(self.config) | dict(zip(KEY, self.key, strict=True))

    @cached_property
    def epochs(self) -> list[dict[str, float]]:
        """Rows of the training history, whose columns are all numbers; none without a history."""
        paths = [path for path in self.files if path.name.endswith(HISTORY)]
        rows = (read_table(p, "epoch", "seconds", dtype=float).to_dict("records") for p in paths)
        return [
            {str(name): value for name, value in row.items()} for table in rows for row in table
        ]

    @property
    def best_validation(self) -> dict[str, float]:
        """Smallest validation error of the training, at which its network was kept, by its name."""
        errors = [row.get("validation_mse", math.nan) for row in self.epochs]
        finite = [error for error in errors if math.isfinite(error)]
        return {"best_validation_mse": min(finite)} if finite else {}

    @property
    def times_ms(self) -> tuple[int, int]:
        """Times of start and end in ms since 1970."""
        # A job that was repeated has a row for each time; a history counts from its start.
        cost, end = self.root / self.job, self.fit_files[0].stat().st_mtime
        if self.job and cost.is_file():
            seconds = read_table(cost, "s", sep="\t").s.iloc[-1]
        else:
            seconds = max((row["seconds"] for row in self.epochs), default=0.0)
        return int(1000 * (end - seconds)), int(1000 * end)


def flatten(tree: Mapping[str, Any]) -> dict[str, str]:
    """Return the leaves of a config by their dotted names: text unchanged, other values as JSON."""
    return {key: v if isinstance(v, str) else json.dumps(v) for key, v in leaves(tree)}


def convert_metric(name: str, value: float) -> tuple[str, float]:
    """Return a metric as MLflow shows it.

    MLflow's table of runs prints numbers in full: a mean squared error is given in 1e-6, as its
    name says. The metrics at the noise levels λ, at which names of tables end, are a section:
    test_mse_0.001 becomes test_mse_1e-6/0.001.
    """
    stem, level = re.fullmatch(r"(.+?)(_\d[\d.e-]*)?", name).groups("")  # type: ignore[union-attr]  # matches any
    unit = "_1e-6" if "mse" in stem.split("_") else ""
    return f"{stem}{unit}{level.replace('_', '/')}", 1e6 * value if unit else value


def read_dataset_runs(
    results: Path, datasets: Mapping[str, Path], target: str = ""
) -> list[TrackedRun]:
    """Read the finished runs of datasets: a run for each method of each evaluation.

    Models still in training lack an evaluation. A method that is fitted once for both references
    has a run for each, so that the metrics of all methods with the same tags can be compared.

    Parameters
    ----------
    results : Path
        Folder that the workflow writes to.
    datasets : mapping of str to Path
        Product "stars" by name of the dataset, or of the variant of a dataset.
    target : str
        Target of the workflow that evaluates them, for messages. [default: the dataset]

    Raises
    ------
    ProductError
        If an evaluation or another file is missing or damaged, or a model was trained on
        other stars.
    """
    runs = []
    for dataset, stars in datasets.items():
        # A table of errors for each split and reference.
        folder = results / "evaluation" / dataset
        evaluations = sorted(folder.glob("*-*.csv"))
        if not evaluations:
            raise ProductError(
                f"{folder}: no evaluations; run `snakemake {target or dataset}` first"
            )
        for path in evaluations:
            table = read_table(path, "method", "noise_level", "metric", "value", "stderr")
            for name, rows in table.groupby("method", sort=False):
                # Means over the noise levels, then each level with its standard error.
                means = rows.groupby("metric").value.mean()
                metrics = {f"test_{m}": means[m] for m in ("mse", "ssim") if m in means}
                for _, r in rows.iterrows():
                    names = (f"test_{r.metric}{part}_{r.noise_level:g}" for part in ("", "_stderr"))
                    metrics |= dict(zip(names, (r.value, r.stderr), strict=True))
                runs.append(_read_method_run(results, method(str(name)), stars, path, metrics))
    return runs


def _read_method_run(
    results: Path, kind: type[Method], stars: Path, table: Path, metrics: dict[str, float]
) -> TrackedRun:
    """Read a method with the metrics of a table, the evaluation on the stars of a dataset."""
    key = (table.parent.name, *table.stem.split("-", 1))
    product = read_product(stars, "stars", ())
    fields: dict[str, Any] = {}
    # Settings of the fit, or of the evaluation for a method that is fitted there, such as the noisy
    # image. A network trained on the stars of another telescope is another run.
    if kind.storage is None:
        tree = read_product(table.with_suffix(".h5"), "restored", ()).config
        settings = {group: tree[group] for group in (*TASK, *kind.groups)}
        source, fit_files, files = "/".join([kind.name, key[0], table.stem]), [table], []
    else:
        source = fits.get_fit_path(kind, *key)
        fit = results / source
        require_origin(fit, STARS, product)
        settings, fit_files = kind.read_config(fit), fits.own_files(kind, fit)
        # The evaluation, the course of a training, and figures.
        diagnostics = [fits.path_beside(kind, fit, name) for name in kind.storage.diagnostics]
        files = [table, *diagnostics, *sorted((results / "figures" / key[0]).glob("*.png"))]
        fields["job"] = f"benchmarks/{fits.get_rule_name(kind)}/{fits.stem(kind, *key)}.tsv"
        if kind.packing:
            inputs = (kind, fit, stars, key[2], f"{key[0]}-{kind.name}")
            fields["bundle"] = partial(make_bundle, *inputs)
    # The number of the start that succeeded is a result, not a setting.
    settings.pop("attempt", None)
    config = {**product.config, **settings}
    experiment = from_tree(stars, product.config, "scene", lambda scene: scene["experiment"])
    place = (results, experiment, source, (kind.name, *key))
    return TrackedRun(*place, config, fit_files, files, metrics, data=stars, **fields)


def make_bundle(kind: type[Method], fit: Path, stars: Path, reference: str, name: str) -> Bundle:
    """Return the bundle of a fit, without errors, which take a minute to measure.

    The errors do not change its PSFs; `psfdae paper bundle` measures them.

    Parameters
    ----------
    kind : type of Method
        Class of the method.
    fit, stars : Path
        Files of the fit, and product "stars" of its training.
    reference : str
        Truth that is estimated.
    name : str
        Name of the model.

    Raises
    ------
    ProductError
        If the fit or the stars are damaged.
    """
    fit_config, product = kind.read_config(fit), read_stars(stars, reference)
    # Groups of settings that decide which stars a fit was trained on, and with which noise.
    config, estimator = part(TASK, {g: fit_config[g] for g in TASK}), kind.load(fit, reference)
    inputs = (estimator, product, reference, config, fit_config)
    return build_uncalibrated(*inputs, name, "not stated")[0]


def _list_fit_files(kind: str, place: Path) -> list[Path]:
    """Return the files of a method, or of a network of scene 3; `place` is its folder or file."""
    if kind in estimators.list_trained_networks():
        return [place / estimators.Estimator.weights_file, place / CONFIG]
    return fits.own_files(method(kind), place)


def read_alignment_runs(results: Path) -> list[TrackedRun]:
    """Read the trained networks of scene 3.

    Raises
    ------
    ProductError
        If a file is missing or damaged; the table of errors is the last one of the scene.
    """
    keys, values = ("test_set", "parameter", "noise_level"), ("mean_abs_error", "bias", "variance")
    errors = results / "tables/alignment_errors.csv"
    table = read_table(errors, *keys, *values, "method", "unit")
    # All networks share the table of errors and the figures of the scene.
    files = [errors, *sorted((results / "figures/alignment").glob("*.png"))]
    runs = []
    for kind in ("dae", *estimators.list_trained_networks()):
        source, key = f"alignment/{kind}", (kind, "alignment", "uniform and grid", "states")
        # As for datasets, the number of the start that succeeded is not a setting.
        config = read_yaml(results / source / CONFIG)
        config.pop("attempt", None)
        # Errors of the state parameters in units of their range, by test set and noise level.
        rows = table[(table.method == kind) & (table.unit == "range")].melt([*keys], [*values])
        if rows.empty:
            raise ProductError(f"{errors}: no rows of method {kind!r}")
        metrics = {f"{r[0]}_{r[1]}_{r[3]}_{r[2]:g}": r[4] for r in rows.to_numpy()}
        # The set of states on which it was trained.
        states = "grid" if kind == "dae" else estimators.ESTIMATORS[kind].states
        data, job = results / f"data/alignment/{states}.h5", f"benchmarks/{source}.tsv"
        fit_files, history = _list_fit_files(kind, results / source), results / source / HISTORY
        content = (config, fit_files, [history, *files], metrics)
        runs.append(TrackedRun(results, "scene3", source, key, *content, job, data=data))
    return runs


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
        source = f"night/images/{row['name']}{SUFFIX}"
        model, key = results / source, ("field", "night", "held_out", "realisation")
        # All numbers of the row are metrics, and some texts tags.
        metrics = {str(k): float(v) for k, v in row.items() if isinstance(v, int | float)}
        tags = {k: str(row[k]) for k in ("verdict", "reason", "time") if row.get(k, "") != ""}
        place, config = (results, "night", source, key), {"image": row["image"]}
        labels: dict[str, Any] = {"name": str(row["name"]), "tags": tags, "metrics": metrics}
        bundle = partial(read_bundle, model)
        runs.append(TrackedRun(*place, config, [model], bundle=bundle, **labels))
    return runs


def read_sweep_runs(results: Path, name: str) -> list[TrackedRun]:
    """Read a sweep and the points in its summary, the parent first.

    Raises
    ------
    ProductError
        If the summary of the sweep or the result of a point is missing.
    """
    source, folder = f"sweeps/{name}", results / "sweeps" / name
    # A row of the summary for each point, and a run of its own.
    table = read_table(folder / "summary.csv", "point", "status", dtype=str)
    points = [_read_point_run(results, name, point) for point in table.point]
    # Metrics of the best point, and numbers of points by their status.
    best_point = read_yaml(folder / "best.yaml")
    metrics = {f"best_{key}": value for key, value in best_point.get("metrics", {}).items()}
    metrics |= {f"points_{k}": float(n) for k, n in table.status.value_counts().items()}
    # Every sweep is an experiment of its own. Its points have the same stars, split and reference.
    tables = [folder / file for file in ("summary.csv", "cost.csv", "best.yaml", "sweep.yaml")]
    figures = sorted((folder / "figures").glob("*.png"))
    content = (read_yaml(folder / "sweep.yaml"), tables, figures, metrics)
    place = (results, f"sweep_{name}", source, ("sweep", *points[0].key[1:]))
    tags = {"best_point": str(best_point.get("point", ""))}
    return [TrackedRun(*place, *content, name=f"sweep {name}", tags=tags), *points]


def join_experiment(results: Path, name: str, runs: Sequence[TrackedRun]) -> list[TrackedRun]:
    """Return an experiment and the runs of its variants, the parent first.

    The runs have the names of datasets and settings in place of the names of variants, and no
    models: registered models are of datasets without overrides.

    Parameters
    ----------
    results : Path
        Folder that the workflow writes to.
    name : str
        Name of the experiment.
    runs : sequence of TrackedRun
        Runs of the variants, as `read_dataset_runs` returns them.

    Raises
    ------
    ConfigError, ProductError
        If the table or the settings of the experiment are missing or damaged.
    """
    source, folder = f"experiments/{name}", results / "experiments" / name
    tree = read_yaml(folder / "experiment.yaml")
    definition = parse_settings(Experiment, {k: v for k, v in tree.items() if k != "given"})
    # All methods of all variants, with the table and the figure that compare them.
    key = ("experiment", " ".join(definition.datasets), "all", "all")
    tables = [folder / file for file in ("errors.csv", "errors.md", "experiment.yaml")]
    content = (f"experiment_{name}", source, key, tree, tables, [folder / "errors.png"])
    parent = TrackedRun(results, *content, name=f"experiment {name}")
    variants, children = {variant.name: variant for variant in definition.variants}, []
    for run in runs:
        variant = variants[run.key[1]]
        labels = {
            "key": (run.key[0], variant.dataset, *run.key[2:]),
            "name": f"{run.key[0]} {variant.dataset} {variant.setting} seed={variant.seed}",
            "tags": {"setting": variant.setting, "overrides": " ".join(variant.overrides)},
        }
        fields: dict[str, Any] = {"experiment": parent.experiment, "parent": source, **labels}
        children.append(replace(run, **fields, bundle=None))
    return [parent, *children]


def _read_point_run(results: Path, name: str, point: str) -> TrackedRun:
    """Read a point of the sweep `name`; a failed point has only files of its result and cost."""
    from psfdae_paper.sweeps.measurement import locate_fit

    # A point has a folder with all its files; one that was stopped or failed lacks some of them.
    data: Path | None
    source = f"sweeps/{name}/points/{point}"
    folder = results / source
    result = read_json(folder / "result.json")
    kind, config = result["model"], result["config"]
    # Files of the model, and the product with its training data if the workflow made it.
    if kind in estimators.list_swept_networks():
        place = folder
        data = results / f"data/alignment/{estimators.ESTIMATORS[kind].states}.h5"
    else:
        place, data = locate_fit(method(kind), folder), find_stars(results, config)
    names = ("cost.json", "evaluation.csv", "validation.csv", HISTORY)
    fit_files = [folder / "result.json", *filter(Path.is_file, _list_fit_files(kind, place))]
    files = [*filter(Path.is_file, (folder / name for name in names))]
    # The run is named by the values of the point on the axes of the sweep.
    values = ", ".join(f"{key}={json.dumps(v)}" for key, v in result["values"].items())
    return TrackedRun(
        results,
        f"sweep_{name}",
        source,
        (kind, *(result[key] for key in KEY[1:])),
        *(config, fit_files, files, result["metrics"]),
        job=f"benchmarks_on_request/sweep/{name}/{point}.tsv",
        name=values or point,
        parent=f"sweeps/{name}",
        tags={key: result[key] for key in ("point", "status", "reason")},
        data=data,
    )


def find_stars(results: Path, config: Mapping[str, Any]) -> Path | None:
    """Return the stars that were simulated with the settings of a point; None without them.

    Parameters
    ----------
    results : Path
        Folder of the results.
    config : mapping
        Settings of the point and of its stars.

    Raises
    ------
    ProductError
        If a file of stars is damaged.
    """
    # A hash ends the names of stars and their folder if a dataset changes the scene.
    scene, stars = (config.get(group, {}).get("name", "") for group in ("scene", "stars"))
    for path in sorted(results.glob(f"data/{scene}*/{stars}*.h5")) if scene and stars else ():
        simulation = read_product(path, "stars", ()).config
        if all(config.get(group) == settings for group, settings in simulation.items()):
            return path
    return None
