"""Stage `track`: finished runs become MLflow runs, and again without duplicates.

The results folder is authoritative and the database a view of it: a lost database is rebuilt by
running the stage again. Input: folders with results (`psfdae_paper.tracking` reads them). Outputs:
runs in a database or on a server, their models (`psfdae_paper.registry`), and a receipt with the
action for each run.

A training shows its epochs in MLflow while it runs, if the environment asks for it by
PSFDAE_EPOCHS=psfdae_paper.stages.track:logger (`psfdae.methods.networks.training.listener`), and
names folder and preset by PSFDAE_RESULTS and PRESET. `make reproduce TRACK=live` sets all three.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import starmap
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from psfdae.base.errors import Error
from psfdae.base.files import as_csv, write_text
from psfdae.base.options import File, Folder
from psfdae.base.progress import steps
from psfdae.base.version import __version__
from psfdae_paper import registry, tracking
from psfdae_paper.configuration.command import command
from psfdae_paper.mlflow_files import open_artifacts
from psfdae_paper.source import git_commit
from psfdae_paper.tracking import KEY, TrackedRun

if TYPE_CHECKING:
    from mlflow import MlflowClient

    from psfdae.methods.networks.training import Row

SLOT = (*KEY, "preset", "source")
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
    experiment: str = "",
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
        Dataset, or variant of the experiment, and its product of the stage stars.
    alignment : bool
        The networks of scene 3.
    night : bool
        The images of a night.
    sweeps : sequence of str
        The points of a sweep.
    experiment : str
        Name of an experiment.
    """
    # Methods, networks of scene 3, images of a night and sweeps; a sweep or experiment before its
    # points.
    target = f"experiment --config name={experiment}" if experiment else ""
    runs = tracking.read_dataset_runs(results, dict(stars), target)
    runs = tracking.join_experiment(results, experiment, runs) if experiment else runs
    runs += tracking.read_alignment_runs(results) if alignment else []
    runs += tracking.read_night_runs(results) if night else []
    runs += [run for sweep in sweeps for run in tracking.read_sweep_runs(results, sweep)]
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
    # Tags of each run, with the version of the program; its id in MLflow and the action.
    versions = {"preset": preset, "commit": git_commit(), "psfdae_version": __version__}
    tags = [{**make_tags(run), **versions} for run in runs]
    outcomes = [("", "not sent")] * len(runs)
    run_ids: dict[str, str] = {}
    try:
        with open_mlflow(database) as client:
            for i, run in enumerate(steps("runs", runs)):
                if run.parent:
                    # MLflow shows a run with this tag as a part of another.
                    tags[i]["mlflow.parentRunId"] = run_ids[run.parent]
                outcomes[i] = import_run(client, run, tags[i])
                run_ids[run.source] = outcomes[i][0]
            # The best version of each model depends on all runs.
            for run in runs:
                registry.choose_best(client, find_experiment(client, run.experiment), run)
    except TrackingError as error:
        # A server that fails must not stop a workflow; a database is a file to be mended.
        if not server():
            raise
        unsent = ", ".join(r.name for r, o in zip(runs, outcomes, strict=True) if not o[0])
        print(f"{error}\nNot sent: {unsent}\nTo send later: snakemake --forcerun track")
    # The receipt: a row for each run.
    rows = [
        {"run_id": run_id, "action": action, **{key: row[key] for key in (*SLOT, "config_hash")}}
        for (run_id, action), row in zip(outcomes, tags, strict=True)
    ]
    write_text(receipt, as_csv(rows))
    counts = Counter(row["action"] for row in rows)
    print(f"{len(runs)} runs:", ", ".join(f"{counts[key]} {key}" for key in sorted(counts)))


def server() -> str:
    """Return the address of the server that MLFLOW_TRACKING_URI names, "" if it is not set.

    Without one, runs go into a database of the results folder.
    """
    return os.environ.get("MLFLOW_TRACKING_URI", "")


@contextmanager
def open_mlflow(database: Path) -> Iterator[MlflowClient]:
    """Open the server, or else the database, which is created if missing.

    Other importers wait meanwhile: two at once would damage a new database.

    Parameters
    ----------
    database : Path
        SQLite file, if there is no server; the lock is a hidden file in its folder.

    Yields
    ------
    MlflowClient
        Client of the server or the database.

    Raises
    ------
    TrackingError
        If the server, the database or the disk fails.
    """
    # MLflow's default timeouts add up to minutes if a server does not answer.
    defaults = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_HTTP_REQUEST_TIMEOUT": "20"}
    os.environ |= {**defaults, "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1", **os.environ}
    from filelock import FileLock
    from mlflow import MlflowClient
    from mlflow.exceptions import MlflowException
    from mlflow.store.artifact import artifact_repository_registry as repositories
    from sqlalchemy.exc import SQLAlchemyError

    # Other programs find this function by the entry point of the installed package.
    schemes: dict[str, Any] = repositories.get_registered_artifact_repositories()
    schemes["mlflow-artifacts"] = open_artifacts
    try:
        with FileLock(database.with_name(f".{database.name}.lock")):
            yield MlflowClient(server() or f"sqlite:///{database.resolve()}")
    except (MlflowException, SQLAlchemyError, OSError) as error:
        # Any other error is a mistake of this program, and is not hidden.
        advice = "" if server() else "; if it is damaged, delete it: the next import rebuilds it"
        line = str(error).strip().split("\n", 1)[0]
        raise TrackingError(f"{server() or database}: {line}{advice}") from error


def find_experiment(client: MlflowClient, name: str) -> str:
    """Return the id of an experiment, which is created if missing.

    Its files have addresses that name no folder (`psfdae_paper.mlflow_files.open_artifacts`).

    Parameters
    ----------
    client : MlflowClient
        Client of the database or server.
    name : str
        Name of the experiment.

    Raises
    ------
    TrackingError
        If an earlier version has made the database, whose files have absolute paths.
    """
    # A server decides itself where artifacts go.
    location = None if server() else f"mlflow-artifacts:/{name}"
    if client.get_experiment_by_name(name) is None:
        with registry.accept_existing():
            client.create_experiment(name, artifact_location=location)
    experiment = client.get_experiment_by_name(name)
    assert experiment is not None
    if location and experiment.artifact_location != location:
        raise TrackingError("mlflow.db: of an earlier version: delete it, and mlartifacts")
    # An experiment that was deleted keeps its name: it is restored.
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


def import_run(client: MlflowClient, run: TrackedRun, tags: dict[str, str]) -> tuple[str, str]:
    """Leave exactly one active run with the files and settings of a run.

    Parameters
    ----------
    client : MlflowClient
        Client of the database or server.
    run : TrackedRun
        Finished run, with its files.
    tags : dict of str
        All tags of the run.

    Returns
    -------
    run_id, action : str
        MLflow's id of the run, and created, updated or unchanged.
    """
    experiment = find_experiment(client, run.experiment)
    # Runs with the same position in the results folder; of these, the ones with the same settings;
    # and of these, one with the same files. An import that was killed leaves no content_hash.
    slot = client.search_runs([experiment], " and ".join(f"tags.{k} = '{tags[k]}'" for k in SLOT))
    twins = [old for old in slot if old.data.tags.get("config_hash") == run.config_hash]
    current = [old for old in twins if old.data.tags.get("content_hash") == run.content_hash][:1]
    if current:
        # Only tags that depend on other runs are changed: a parent with new files is another run.
        run_id, action = str(current[0].info.run_id), "unchanged"
        for key in tags.keys() & {"superseded", "mlflow.parentRunId"}:
            client.set_tag(run_id, key, tags[key])
    else:
        run_id, action = (
            create_run(client, experiment, run, tags),
            "updated" if twins else "created",
        )
    # Other runs of the same settings, and the live run of the training, are deleted; runs of other
    # settings are superseded.
    for old in slot:
        if old not in twins:
            client.set_tag(old.info.run_id, "superseded", "true")
        elif old not in current:
            registry.forget(client, old.info.run_id)
    delete_live(client, run.source)
    return run_id, action


def create_run(client: MlflowClient, experiment: str, run: TrackedRun, tags: dict[str, str]) -> str:
    """Create a complete run in MLflow, and return its id.

    It has tags, data, model, metrics, files, and all settings as parameters.

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
    """
    from mlflow.entities import Dataset, DatasetInput, InputTag, Param

    start_ms, end_ms = run.times_ms
    run_id: str = client.create_run(experiment, start_ms, tags, run.name).info.run_id
    # Metrics of the finished run name the data that it was trained on, and its model.
    origin: dict[str, str] = {}
    if run.data and run.data_hash:
        source = json.dumps({"uri": run.data.relative_to(run.root).as_posix()})
        data = Dataset(run.key[1], run.data_hash, "local", source)
        training = [InputTag("mlflow.data.context", "training")]
        client.log_inputs(run_id, [DatasetInput(data, training)])
        origin = {"dataset_name": data.name, "dataset_digest": data.digest}
    if model_id := registry.log_model(client, experiment, run_id, run):
        origin["model_id"] = model_id
    # Metrics of the finished run, then of each epoch.
    log_metrics(client, run_id, [(0, end_ms, {**run.metrics, **run.best_validation})], **origin)
    log_metrics(client, run_id, list_epochs(run.epochs, start_ms))
    # All settings are parameters; MLflow takes 6000 characters of each.
    texts = run.params | {"preset": tags["preset"]}
    params = [Param(name, text[:6000]) for name, text in texts.items()]
    client.log_batch(run_id, params=params)
    # Files have the same names as in the results folder; the model holds the files of a fit.
    for path in (*run.files, *(() if run.bundle else run.fit_files)):
        client.log_artifact(run_id, str(path), str(path.parent.relative_to(run.root)))
    has_failed = run.tags.get("status") == "failed"
    client.set_terminated(run_id, "FAILED" if has_failed else "FINISHED", end_ms)
    # Last, so that a run without it is known to be incomplete.
    client.set_tag(run_id, "content_hash", run.content_hash)
    return run_id


def list_epochs(epochs: Sequence[Row], start_ms: int) -> list[tuple[int, int, Row]]:
    """Return number, time in ms since 1970, and errors of each epoch, named `epoch/NAME`.

    Parameters
    ----------
    epochs : sequence of mappings
        Rows of the history.
    start_ms : int
        Start of the training in ms since 1970.
    """
    # Other columns of the history are counters and times.
    counters = ("epoch", "step", "seconds", "cpu_seconds")
    rows = [{f"epoch/{k}": v for k, v in row.items() if k not in counters} for row in epochs]
    times = [(int(row["epoch"]), start_ms + int(1000 * row["seconds"])) for row in epochs]
    return [(*time, row) for time, row in zip(times, rows, strict=True)]


def log_metrics(
    client: MlflowClient, run_id: str, rows: Iterable[tuple[int, int, Row]], **origin: str
) -> None:
    """Log finite metrics: a training that diverged has infinite errors, which no database takes.

    Parameters
    ----------
    client : MlflowClient
        Client of the database or server.
    run_id : str
        MLflow's id of the run.
    rows : iterable of (int, int, mapping)
        Step, time in ms since 1970, and values by name.
    **origin : str
        Names of the data and of the model that all values are of.
    """
    from mlflow.entities import Metric

    metrics = [
        Metric(name, value, time_ms, step, **origin)
        for step, time_ms, row in rows
        for name, value in starmap(tracking.convert_metric, row.items())
        if math.isfinite(value)
    ]
    client.log_batch(run_id, metrics)


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
    slot = {**dict(zip(KEY, run.key, strict=True)), "source": run.source}
    hashes = {"config_hash": run.config_hash, "validation": run.validation_hash}
    return {**slot, **run.tags, **hashes, "superseded": "false"}


def logger(checkpoint: Path) -> Callable[[Row], None]:
    """Return a function that logs an epoch of the training with this checkpoint.

    Trainings that MLflow does not show, such as points of sweeps, are not logged, nor are trainings
    on a cluster unless MLFLOW_TRACKING_URI names a server: nodes of a cluster do not open the
    database.

    Parameters
    ----------
    checkpoint : Path
        File of the training's state, whose path in the results folder names the training.

    Returns
    -------
    callable
        Function of a row of the history: epoch, seconds and errors. An MLflow that fails does not
        stop the training.
    """
    database = Path(os.environ["PSFDAE_RESULTS"], "mlflow.db")
    # Checkpoints are METHOD/DATASET/SPLIT-REFERENCE.pt and, of scene 3, alignment-NETWORK.pt. A
    # second training of the same fit has a further suffix, and replaces the first one.
    stem = checkpoint.with_name(checkpoint.name.partition(".")[0])
    source = os.path.relpath(stem, database.with_name("checkpoints"))
    source = source.replace("alignment-", "alignment/")
    is_shown = bool(server() or "SLURM_JOB_ID" not in os.environ) and "/" in source
    # MLflow's id of the run, and the last epoch that it has; "" before the first one.
    run_id, last_epoch = "", 0.0

    def log(row: Row) -> None:
        nonlocal is_shown, run_id, last_epoch
        # Not shown from the start, or since MLflow has failed.
        if not is_shown:
            return
        # The history counts seconds from the start of the training, MLflow from 1970.
        start_ms = int(1000 * (time.time() - row["seconds"]))
        try:
            with open_mlflow(database) as client:
                if row["epoch"] <= last_epoch or not run_id:
                    # A training that starts again, or resumes from its checkpoint, has a new run,
                    # without which the run of an earlier attempt would remain.
                    delete_live(client, source)
                    tags = {"source": source, "preset": os.environ["PRESET"] or "fast"}
                    live = find_experiment(client, LIVE)
                    run_id = client.create_run(live, start_ms, tags, source).info.run_id
                log_metrics(client, run_id, list_epochs([row], start_ms))
                last_epoch = row["epoch"]
        except TrackingError as error:
            is_shown = False  # errors of MLflow must not stop a training
            print(f"the training is not shown in MLflow any more: {error}", flush=True)

    return log
