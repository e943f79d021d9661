"""Stage `track`: finished runs become MLflow runs, and again without duplicates.

The results folder is authoritative and the database a view of it: a lost database is rebuilt by
running the stage again. Input: folders with results (`psfdae_paper.tracking` reads them). Outputs:
runs in a database or on a server, their models (`psfdae_paper.registry`) and views
(`psfdae_paper.views`), and a receipt with the action for each run.
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
from psfdae.base.files import as_csv, as_yaml, compute_sha256, write_text
from psfdae.base.options import File, Folder
from psfdae.base.progress import steps
from psfdae.base.version import __version__
from psfdae.methods.interface import CONFIG
from psfdae_paper.configuration.command import command
from psfdae_paper.registry import choose_best, forget, link_files, log_model, make_model_name
from psfdae_paper.source import git_commit
from psfdae_paper.tracking import (
    TrackedRun,
    convert_metric,
    epoch_metrics,
    read_alignment_runs,
    read_dataset_runs,
    read_night_runs,
    read_sweep_runs,
    select_settings,
)
from psfdae_paper.views import show

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Metric, Param

SLOT = ("kind", "dataset", "split", "reference", "preset", "source")
"""Tags that name a position in the results folder; with `config_hash` they identify a run."""

LIVE = "live"
"""Experiment of unfinished trainings; the import of the finished run deletes them."""


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

    A run is identified by its position in the results and its config. If MLflow has it with the
    same files, nothing is done; with other files it is replaced (MLflow can only append to
    metrics); with another config it stays for comparison, with the tag superseded = true.

    If a server fails there is a message, not an error: it must not stop a workflow.

    Parameters
    ----------
    results : Path
        Folder that the workflow writes to.
    preset : str
        Name of the preset, a tag of all runs.
    database : Path
        SQLite file; mlartifacts/ is in the same folder.
    out : Path
        CSV with the MLflow id of every run and the action.
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
    runs = read_dataset_runs(results, dict(stars))
    runs += read_alignment_runs(results) if alignment else []
    runs += read_night_runs(results) if night else []
    runs += [run for sweep in sweeps for run in read_sweep_runs(results, sweep)]
    import_runs(runs, preset, database, out)


def import_runs(runs: Sequence[TrackedRun], preset: str, database: Path, receipt: Path) -> None:
    """Import runs, and write the action for each.

    Parameters
    ----------
    runs : sequence of TrackedRun
        A parent before its children.
    preset : str
        Name of the preset, a tag of all runs.
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
    # Tags with the version of the program that imported the runs.
    import_tags = {"preset": preset, "commit": git_commit(), "psfdae_version": __version__}
    # MLflow's id of each run, and the action.
    outcomes: list[tuple[str, str]] = []
    with lock_database(database):
        try:
            for outcome in _import(runs, import_tags, uri, database):
                outcomes.append(outcome)
        except Exception as error:
            # A server that fails must not stop a workflow; a database is a file to be mended.
            if not is_external_error(error):
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
        tags = {"preset": preset, **make_tags(run)}
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
    # MLflow's default timeouts add up to minutes if a server does not answer.
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "20")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    return os.environ.get("MLFLOW_TRACKING_URI", "")


@contextmanager
def lock_database(database: Path) -> Iterator[None]:
    """Wait for other importers: two at once would damage a new database.

    Parameters
    ----------
    database : Path
        SQLite file; the lock is a hidden file in its folder.
    """
    import fcntl

    # The system releases the lock of a process that ends.
    database.parent.mkdir(parents=True, exist_ok=True)
    with database.with_name(f".{database.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _import(
    runs: Sequence[TrackedRun], import_tags: dict[str, str], uri: str, database: Path
) -> Iterator[tuple[str, str]]:
    """Import one run after the other; yield MLflow's id and the action for each.

    Parameters
    ----------
    runs : sequence of TrackedRun
        A parent before its children.
    import_tags : dict of str
        Tags that all runs of this import have.
    uri : str
        Address of a server; "" takes the database.
    database : Path
        SQLite file, if there is no server.
    """
    client = make_client(uri, database)
    # MLflow's ids of the experiments by name, and of the runs by their source.
    experiments: dict[str, str] = {}
    run_ids: dict[str, str] = {}
    for run in steps("runs", runs):
        if run.experiment not in experiments:
            experiments[run.experiment] = find_experiment(client, run.experiment, uri, database)
        tags = {**import_tags, **make_tags(run)}
        if run.parent:
            # MLflow shows a run with this tag as a part of another.
            tags["mlflow.parentRunId"] = run_ids[run.parent]
        outcome = import_run(client, experiments[run.experiment], run, tags)
        run_ids[run.source] = outcome[0]
        yield outcome
    # These depend on all runs: the best version of each model, and tables that compare runs.
    for name in dict.fromkeys(make_model_name(run) for run in runs if run.fit):
        choose_best(client, name)
    for name, experiment in experiments.items():
        show(client, experiment, [run for run in runs if run.experiment == name])


def make_client(uri: str, database: Path) -> MlflowClient:
    """Return a client of a server, or else of the database, which is created if missing.

    Parameters
    ----------
    uri : str
        Address of a server; "" takes the database.
    database : Path
        SQLite file.
    """
    from mlflow import MlflowClient

    return MlflowClient(uri or f"sqlite:///{database.resolve()}")


def find_experiment(client: MlflowClient, name: str, uri: str, database: Path) -> str:
    """Return the id of an experiment, which is created if missing.

    Parameters
    ----------
    client : MlflowClient
        Client of the database or server.
    name : str
        Name of the experiment.
    uri : str
        Address of a server; "" for the database.
    database : Path
        SQLite file.

    Returns
    -------
    str
        MLflow's id.

    Raises
    ------
    TrackingError
        If the files of the database are not in `mlartifacts` in its folder.
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
    """Delete the live runs of the training of a model.

    Parameters
    ----------
    client : MlflowClient
        Client of the database or server.
    source : str
        Path of the model in the results folder, such as dae/dataset3/random-realisation.
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
        Client of the database or server.
    experiment : str
        Id of the experiment.
    run : TrackedRun
        Finished run, with its files.
    tags : dict of str
        All tags of the run.

    Returns
    -------
    run_id, action : str
        MLflow's id of the run, and created, updated or unchanged.
    """
    # Active runs of this stage with the same position in the results folder. The source implies the
    # method, for which earlier versions had other names.
    conditions = [f"tags.{key} = '{tags[key]}'" for key in SLOT if key != "kind"]
    query = " and ".join([*conditions, "tags.config_hash LIKE '%'"])
    slot = client.search_runs([experiment], query)
    # Of these, the ones with the same settings, and the one with the same files as well.
    make_settings = [old for old in slot if old.data.tags["config_hash"] == run.config_hash]
    # An import that was killed leaves a run without content_hash.
    same_runs = [r for r in make_settings if r.data.tags.get("content_hash") == run.content_hash]
    # Of a run with the same files, only tags that depend on other runs are changed.
    if same_runs:
        run_id, action = str(same_runs[0].info.run_id), "unchanged"
        for key in ("superseded", "mlflow.parentRunId"):
            # A parent that has new files is another run.
            if key in tags and same_runs[0].data.tags.get(key) != tags[key]:
                client.set_tag(run_id, key, tags[key])
    else:
        run_id = create_run(client, experiment, run, tags)
        action = "updated" if make_settings else "created"
    # Other runs of the same settings, and the live run of the training, are deleted; runs of other
    # settings are superseded.
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
    """Create a complete run in MLflow, and return its id.

    It has tags, data, model, metrics, parameters and files. The parameters are the settings that
    distinguish it (`select_settings`); all settings are in its file config.yaml.

    Parameters
    ----------
    client : MlflowClient
        Client of the database or server.
    experiment : str
        Id of the experiment.
    run : TrackedRun
        Finished run, with its files.
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
        # Sixteen digits of the checksum identify a dataset.
        data = Dataset(run.dataset, compute_sha256(run.data)[:16], "local", source)
        training = [InputTag("mlflow.data.context", "training")]
        client.log_inputs(run_id, [DatasetInput(data, training)])
        origin = {"dataset_name": data.name, "dataset_digest": data.digest}
    if model_id := log_model(client, experiment, run_id, run):
        origin["model_id"] = model_id
    # Metrics of the finished run, then of each epoch.
    metrics = [
        Metric(name, value, run.end_ms, step, **origin)
        for name, step, value in starmap(convert_metric, run.metrics.items())
    ]
    metrics += epoch_metrics(run.epochs, run.start_ms)
    # MLflow takes 6000 characters of a param.
    params = [Param(key, v[:6000]) for key, v in select_settings(run, tags["preset"]).items()]
    log_metrics(client, run_id, metrics, params)
    # Files that are not part of the model: tables, figures and settings.
    with tempfile.TemporaryDirectory() as folder:
        side_files = {k: v for k, v in run.files.items() if not k.startswith(run.model_prefix)}
        link_files(side_files, Path(folder))
        client.log_artifacts(run_id, folder)
    client.log_text(run_id, as_yaml(run.config), CONFIG)
    client.set_terminated(run_id, run.status, run.end_ms)
    # Last, so that a run without it is known to be incomplete.
    client.set_tag(run_id, "content_hash", run.content_hash)
    return run_id


def log_metrics(
    client: MlflowClient, run_id: str, metrics: Sequence[Metric], params: Sequence[Param] = ()
) -> None:
    """Log finite metrics, and params; MLflow takes 1000 at once.

    Parameters
    ----------
    client : MlflowClient
        Client of the database or server.
    run_id : str
        MLflow's id of the run.
    metrics : sequence of Metric
        Values with their steps; those that are not finite are left out.
    params : sequence of Param
        Settings of the run.
    """
    # A training that diverged has infinite errors, which no database takes.
    finite = [metric for metric in metrics if math.isfinite(metric.value)]
    # 100 of the 1000 may be params.
    for i in range(max(len(finite) // 900, len(params) // 100) + 1):
        rows = finite[900 * i : 900 * (i + 1)], params[100 * i : 100 * (i + 1)]
        client.log_batch(run_id, *rows, synchronous=True)


def make_tags(run: TrackedRun) -> dict[str, str]:
    """Return the tags of a run in MLflow, without the tags of the whole import.

    The import of a run with other settings sets `superseded` to "true".

    Parameters
    ----------
    run : TrackedRun
        Finished run.

    Returns
    -------
    dict of str
        Tags of `SLOT`, of the run itself, and the hash of its settings.
    """
    # The preset is a tag of the whole import.
    slot = {key: getattr(run, key) for key in SLOT if key != "preset"}
    return {**slot, **run.tags, "config_hash": run.config_hash, "superseded": "false"}


def is_external_error(error: Exception) -> bool:
    """Return True if an error comes from the database, the server or the disk, not from a bug.

    Parameters
    ----------
    error : Exception
        Error of an import.
    """
    # MLflow raises its own errors, and errors of its database and of files.
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    # Any other error is a mistake of this program, and is not hidden.
    return isinstance(error, MlflowException | SQLAlchemyError | OSError)


def first_line(error: Exception) -> str:
    """Return the first line of an error."""
    return str(error).strip().split("\n", 1)[0]
