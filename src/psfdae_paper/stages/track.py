"""Stage `track`: finished runs become MLflow runs, and again without duplicates.

The results folder is the truth and the database a view of it: a lost database is rebuilt by
running the stage again. Folders with results go in (`psfdae_paper.tracking` reads them). Out come
runs in a database or on a server, their models (`psfdae_paper.registry`) and views
(`psfdae_paper.views`), and a receipt with what was done.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import starmap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from psfdae.base.errors import Error
from psfdae.base.files import as_csv, as_yaml, sha256_of, write_text
from psfdae.base.options import File, Folder
from psfdae.base.progress import steps
from psfdae.base.version import __version__
from psfdae.methods.interface import CONFIG
from psfdae_paper.configuration.command import command
from psfdae_paper.registry import choose_best, forget, link, log_model, registered_name
from psfdae_paper.source import git_commit
from psfdae_paper.tracking import (
    TrackedRun,
    epoch_metrics,
    runs_of_alignment,
    runs_of_datasets,
    runs_of_night,
    runs_of_sweep,
    settings_of,
    tracked_metric,
)
from psfdae_paper.views import show

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Metric, Param

SLOT = ("kind", "dataset", "split", "reference", "preset", "source")
"""Tags that name a place in the results folder; with `config_hash` they name a run."""

LIVE = "live"
"""Experiment of trainings that are under way; the import of the finished run deletes them."""


class TrackingError(Error, RuntimeError):
    """The MLflow database cannot be used."""


@command("paper track")
def track(
    results: Folder,
    preset: str,
    database: File,
    out: File,
    stars: tuple[tuple[str, File], ...] = (),
    alignment: bool = False,
    night: bool = False,
    sweeps: Annotated[tuple[str, ...], {"flag": "--sweep"}] = (),
) -> None:
    """Import finished runs into MLflow; MLFLOW_TRACKING_URI names a server instead.

    A run is known by its place in the results and its config. If it is there
    with the same files nothing is done; with other files it is replaced (MLflow
    can only append to metrics); with another config it stays for comparison,
    with the tag superseded = true, beside the new one.

    If a server fails there is a message and no error: it must not stop a workflow.

    Parameters
    ----------
    results : Path
        Folder that the workflow writes to.
    preset : str
        Goes into the tags.
    database : Path
        SQLite file; mlartifacts/ lies beside it.
    out : Path
        CSV with the MLflow id of every run and what was done.
    stars : sequence of pairs
        Dataset and its product of the stage stars.
    alignment : bool
        The networks of scene 3.
    night : bool
        The images of a night.
    sweeps : sequence of str
        The points of a sweep.
    """
    # Methods, networks of scene 3, images of a night and sweeps; a sweep before its points.
    runs = runs_of_datasets(results, dict(stars))
    runs += runs_of_alignment(results) if alignment else []
    runs += runs_of_night(results) if night else []
    runs += [run for sweep in sweeps for run in runs_of_sweep(results, sweep)]
    import_runs(runs, preset, database, out)


def import_runs(runs: Sequence[TrackedRun], preset: str, database: Path, receipt: Path) -> None:
    """Import runs, and write what was done with each.

    Parameters
    ----------
    runs : sequence of TrackedRun
        A parent before its children.
    preset : str
        Goes into the tags.
    database : Path
        SQLite file, unless the environment names a server.
    receipt : Path
        CSV with MLflow's id of each run, the action and the tags that name it.

    Raises
    ------
    TrackingError
        If the database cannot be used.
    """
    uri = server()
    # Tags that tell with which program the runs were imported.
    import_tags = {"preset": preset, "commit": git_commit(), "psfdae_version": __version__}
    # MLflow's id of each run, and what was done with it.
    outcomes: list[tuple[str, str]] = []
    with locked(database):
        try:
            for outcome in _import(runs, import_tags, uri, database):
                outcomes.append(outcome)
        except Exception as error:
            # A server that fails must not stop a workflow; a database is a file to be mended.
            if not ours_to_explain(error):
                raise
            if not uri:
                raise TrackingError(
                    f"{database}: {first_line(error)} (if it is damaged, delete it: the next "
                    "import rebuilds it)"
                ) from error
            print(
                f"MLflow at {uri} cannot be used: {first_line(error)}\n"
                f"Not sent: {', '.join(run.name for run in runs[len(outcomes) :])}\n"
                "To send later, repeat the import (snakemake --forcerun track)."
            )
    outcomes += [("", "not sent")] * (len(runs) - len(outcomes))
    # The receipt: a row for each run.
    rows = []
    for run, (run_id, action) in zip(runs, outcomes, strict=True):
        tags = {"preset": preset, **tags_of(run)}
        row = {"run_id": run_id, "action": action, "experiment": run.experiment}
        rows.append(row | {key: tags[key] for key in (*SLOT, "config_hash")})
    write_text(receipt, as_csv(rows))
    counts = sorted(Counter(action for _, action in outcomes).items())
    print(f"{len(runs)} runs:", ", ".join(f"{count} {action}" for action, count in counts))


def server() -> str:
    """Return the address of the server that the environment names, "" if none; set up MLflow.

    MLFLOW_TRACKING_URI names it; without one, runs go into a database of the results folder.
    """
    os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
    # MLflow's own waits add up to minutes for a server that is away.
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "20")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    return os.environ.get("MLFLOW_TRACKING_URI", "")


@contextmanager
def locked(database: Path) -> Iterator[None]:
    """Wait for other importers: two that meet on a new database would ruin it.

    Parameters
    ----------
    database : Path
        SQLite file; the lock is a hidden file beside it.
    """
    import fcntl

    # The lock of a process that ends is given up by the system.
    database.parent.mkdir(parents=True, exist_ok=True)
    with database.with_name(f".{database.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _import(
    runs: Sequence[TrackedRun], import_tags: dict[str, str], uri: str, database: Path
) -> Iterator[tuple[str, str]]:
    """Import one run after the other; yield MLflow's id of each, and what was done.

    Parameters
    ----------
    runs : sequence of TrackedRun
    import_tags : dict of str
        Tags that all runs of this import have.
    uri : str
        Address of a server; "" takes the database.
    database : Path
    """
    client = client_of(uri, database)
    # MLflow's ids of the experiments by name, and of the runs by their source.
    experiments: dict[str, str] = {}
    imported: dict[str, str] = {}
    for run in steps("runs", runs):
        if run.experiment not in experiments:
            experiments[run.experiment] = experiment_of(client, run.experiment, uri, database)
        tags = {**import_tags, **tags_of(run)}
        if run.parent:
            # MLflow shows a run with this tag as a part of another.
            tags["mlflow.parentRunId"] = imported[run.parent]
        outcome = import_run(client, experiments[run.experiment], run, tags)
        imported[run.source] = outcome[0]
        yield outcome
    # What depends on all runs: the best version of each model, and tables that compare runs.
    for name in dict.fromkeys(registered_name(run) for run in runs if run.fit):
        choose_best(client, name)
    for name, experiment in experiments.items():
        show(client, experiment, [run for run in runs if run.experiment == name])


def client_of(uri: str, database: Path) -> MlflowClient:
    """Return a client of a server, or else of the database, which it makes if it is missing.

    Parameters
    ----------
    uri : str
        Address of a server; "" takes the database.
    database : Path
        SQLite file.
    """
    from mlflow import MlflowClient

    return MlflowClient(uri or f"sqlite:///{database.resolve()}")


def experiment_of(client: MlflowClient, name: str, uri: str, database: Path) -> str:
    """Return the id of an experiment, which is made if missing.

    Parameters
    ----------
    client : MlflowClient
    name : str
        Name of the experiment.
    uri : str
        Address of a server; "" for the database.
    database : Path

    Raises
    ------
    TrackingError
        If the database keeps files in another place than `mlartifacts` beside it.

    Returns
    -------
    str
        MLflow's id.
    """
    # A server decides itself where artifacts go.
    is_served = uri.startswith(("http", "databricks"))
    location = None if is_served else (database.parent.resolve() / "mlartifacts" / name).as_uri()
    # An experiment that was deleted keeps its name: it is restored.
    experiment = client.get_experiment_by_name(name)
    if experiment is None:
        return str(client.create_experiment(name, artifact_location=location))
    if not uri and experiment.artifact_location != location:
        # A copied results folder would otherwise write into the original's files.
        raise TrackingError(
            f"the database keeps its files in {experiment.artifact_location}, not in {location}; "
            "was the results folder moved? Delete mlflow.db and import again"
        )
    if experiment.lifecycle_stage == "deleted":
        client.restore_experiment(experiment.experiment_id)
    return str(experiment.experiment_id)


def delete_live(client: MlflowClient, source: str) -> None:
    """Delete the runs of trainings, seen live, whose model has a place in the results folder.

    Parameters
    ----------
    client : MlflowClient
    source : str
        Place of the model, such as dae/dataset3/random-realisation.
    """
    if experiment := client.get_experiment_by_name(LIVE):
        for run in client.search_runs([experiment.experiment_id], f"tags.source = '{source}'"):
            client.delete_run(run.info.run_id)


def import_run(
    client: MlflowClient, experiment: str, run: TrackedRun, tags: dict[str, str]
) -> tuple[str, str]:
    """Leave exactly one active run with the files and settings of a run.

    Parameters
    ----------
    client : MlflowClient
    experiment : str
        Id of the experiment.
    run : TrackedRun
    tags : dict of str
        All tags of the run.

    Returns
    -------
    run_id, action : str
        MLflow's id of the run, and what was done.
    """
    # Active runs of the same place in the results folder that this stage has made.
    # The source tells the method; earlier versions had another name for some.
    conditions = [f"tags.{key} = '{tags[key]}'" for key in SLOT if key != "kind"]
    query = " and ".join([*conditions, "tags.config_hash LIKE '%'"])
    slot = client.search_runs([experiment], query)
    # Of these, the ones with the same settings, and the one with the same files as well.
    make_settings = [old for old in slot if old.data.tags["config_hash"] == run.config_hash]
    # An import that was killed leaves a run without content_hash.
    unchanged = [r for r in make_settings if r.data.tags.get("content_hash") == run.content_hash]
    # A run that is there with the same files is left alone but for tags that others decide.
    if unchanged:
        run_id, action = str(unchanged[0].info.run_id), "unchanged"
        for key in ("superseded", "mlflow.parentRunId"):
            # A parent that has new files is another run.
            if key in tags and unchanged[0].data.tags.get(key) != tags[key]:
                client.set_tag(run_id, key, tags[key])
    else:
        run_id = create_run(client, experiment, run, tags)
        action = "updated" if make_settings else "created"
    # Other runs of the same settings give way, and so does the training as it was seen live; runs
    # of other settings are superseded.
    for old in slot:
        if old.info.run_id == run_id:
            continue
        if old in make_settings:
            forget(client, old.info.run_id)
        elif old.data.tags.get("superseded") != "true":
            client.set_tag(old.info.run_id, "superseded", "true")
    delete_live(client, run.source)
    return run_id, action


def create_run(client: MlflowClient, experiment: str, run: TrackedRun, tags: dict[str, str]) -> str:
    """Create a run in MLflow with all that belongs to it, and return its id.

    These are its tags, data, model, metrics, parameters and files. The parameters are the settings
    that distinguish it (`settings_of`); all are in its file config.yaml.

    Parameters
    ----------
    client : MlflowClient
    experiment : str
        Id of the experiment.
    run : TrackedRun
    tags : dict of str
        All tags of the run.

    Returns
    -------
    str
        MLflow's id of the run.
    """
    from mlflow.entities import Dataset, DatasetInput, InputTag, Metric, Param

    run_id: str = client.create_run(experiment, run.start_ms, tags, run.name).info.run_id
    # Metrics of the finished run name the data that it was trained on, and its model.
    origin: dict[str, str] = {}
    if run.data is not None and run.data.is_file():
        source = json.dumps({"uri": run.data.resolve().as_uri()})
        # Sixteen digits of the checksum tell a dataset from others.
        data = Dataset(run.dataset, sha256_of(run.data)[:16], "local", source)
        training = [InputTag("mlflow.data.context", "training")]
        client.log_inputs(run_id, [DatasetInput(data, training)])
        origin = {"dataset_name": data.name, "dataset_digest": data.digest}
    if model_id := log_model(client, experiment, run_id, run):
        origin["model_id"] = model_id
    # Metrics of the finished run, then those of each epoch.
    metrics = [
        Metric(name, value, run.end_ms, step, **origin)
        for name, step, value in starmap(tracked_metric, run.metrics.items())
    ]
    metrics += epoch_metrics(run.epochs, run.start_ms)
    # MLflow takes 6000 characters of a param.
    params = [Param(key, v[:6000]) for key, v in settings_of(run, tags["preset"]).items()]
    log_metrics(client, run_id, metrics, params)
    # Files that are not part of the model: tables, figures and settings.
    with tempfile.TemporaryDirectory() as folder:
        side_files = {k: v for k, v in run.files.items() if not k.startswith(run.model_prefix)}
        link(side_files, Path(folder))
        client.log_artifacts(run_id, folder)
    client.log_text(run_id, as_yaml(run.config), CONFIG)
    client.set_terminated(run_id, run.status, run.end_ms)
    # Last, so that a run without it is known to be incomplete.
    client.set_tag(run_id, "content_hash", run.content_hash)
    return run_id


def log_metrics(
    client: MlflowClient, run_id: str, metrics: Sequence[Metric], params: Sequence[Param] = ()
) -> None:
    """Log metrics as far as they are finite, and params; MLflow takes 1000 at once.

    Parameters
    ----------
    client : MlflowClient
    run_id : str
    metrics : sequence of Metric
    params : sequence of Param
        Settings of the run.
    """
    # A training that diverged has infinite errors, which no database takes.
    finite = [metric for metric in metrics if math.isfinite(metric.value)]
    # 100 of the 1000 may be params.
    for i in range(max(len(finite) // 900, len(params) // 100) + 1):
        rows = finite[900 * i : 900 * (i + 1)], params[100 * i : 100 * (i + 1)]
        client.log_batch(run_id, *rows, synchronous=True)


def tags_of(run: TrackedRun) -> dict[str, str]:
    """Return the tags of a run in MLflow, but for those of the whole import.

    A run with other settings that takes the place of this one sets `superseded` to "true".

    Parameters
    ----------
    run : TrackedRun

    Returns
    -------
    dict of str
        Those of `SLOT`, of the run itself, and the hash of its settings.
    """
    # The preset is a tag of the whole import.
    slot = {key: getattr(run, key) for key in SLOT if key != "preset"}
    return {**slot, **run.tags, "config_hash": run.config_hash, "superseded": "false"}


def ours_to_explain(error: Exception) -> bool:
    """Return True if an error comes from the database, the server or the disk, not from a bug.

    Parameters
    ----------
    error : Exception
        What an import raised.
    """
    # MLflow raises its own errors, those of its database and those of files.
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    # Any other error is a mistake of this program, and is not hidden.
    return isinstance(error, MlflowException | SQLAlchemyError | OSError)


def first_line(error: Exception) -> str:
    """Return the first line of an error."""
    return str(error).strip().split("\n", 1)[0]
