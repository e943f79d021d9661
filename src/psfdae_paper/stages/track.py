"""Stage `track`: finished runs become MLflow runs, and again without duplicates.

The results folder is the truth and the database a view of it: no training talks
to MLflow, and a lost database is rebuilt by running the stage again.
"""

from __future__ import annotations

import csv
import io
import json
import os
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from psfdae.errors import Error
from psfdae.files import atomic_path, write_text
from psfdae.method import CONFIG
from psfdae.options import File, Folder
from psfdae.version import __version__
from psfdae_paper.configuration.command import command
from psfdae_paper.registry import (
    choose_best,
    forget,
    link,
    log_model,
    register,
    registered_name,
)
from psfdae_paper.source import git_commit
from psfdae_paper.tracking import (
    MODEL,
    Run,
    digest_of,
    runs_of_alignment,
    runs_of_datasets,
    runs_of_sweep,
    settings_of,
)
from psfdae_paper.views import show

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Metric
    from mlflow.entities import Run as MlflowRun

SLOT = ("kind", "dataset", "split", "reference", "preset", "source")
"""Tags that name a place in the results folder; with `config_hash` they name a run."""

LIVE = "live"
"""Stands for the hash of the config of a run that is under way; the import replaces it."""

PARENT = "mlflow.parentRunId"
"""Tag by which MLflow shows a run as a part of another."""

BATCH, PARAM_LENGTH = 100, 6000
"""MLflow takes 100 params, or 1000 metrics, at once, and 6000 characters of a param."""

MOST_RUNS = 50_000
"""Runs of an experiment that MLflow gives at once, at most."""

DIGEST = 16
"""Characters of the SHA-256 of its product that tell a dataset from others."""

COLUMNS = ("run_id", "action", "experiment", *SLOT, "config_hash")
NOT_SENT = "not sent"


class TrackingError(Error, RuntimeError):
    """The MLflow database cannot be used."""


@command("track")
def track(
    results: Annotated[Folder, "Folder that the workflow writes to."],
    preset: Annotated[str, "Goes into the tags."],
    database: Annotated[File, "SQLite file; mlartifacts/ lies beside it."],
    out: Annotated[File, "CSV with the MLflow id of every run and what was done."],
    stars: Annotated[
        tuple[tuple[str, File], ...], "Dataset and its product of the stage stars."
    ] = (),
    alignment: Annotated[bool, "The networks of scene 3."] = False,
    sweeps: Annotated[tuple[str, ...], "The points of a sweep.", {"flag": "--sweep"}] = (),
) -> None:
    """Import finished runs into MLflow; MLFLOW_TRACKING_URI names a server instead.

    A run is known by its place in the results and its config. If it is there
    with the same files nothing is done; with other files it is replaced (MLflow
    can only append to metrics); with another config it stays for comparison,
    with the tag superseded = true, beside the new one.

    If a server fails there is a message and no error: it must not stop a workflow.
    """
    runs = runs_of_datasets(results, dict(stars))
    runs += runs_of_alignment(results) if alignment else []
    runs += [run for sweep in sweeps for run in runs_of_sweep(results, sweep)]
    import_runs(runs, preset, database, out)


def import_runs(runs: Sequence[Run], preset: str, database: Path, receipt: Path) -> None:
    """Import runs; see `track`. Raises TrackingError if the database cannot be used."""
    artifacts = database.parent / "mlartifacts"
    uri = prepared()
    tags = {"preset": preset, "commit": git_commit(), "psfdae_version": __version__}
    done: list[tuple[str, str]] = []
    with alone(database):
        try:
            for outcome in _import(runs, tags, uri, database, artifacts):
                done.append(outcome)
        except Exception as error:
            if not ours_to_explain(error):
                raise
            if not uri:
                raise TrackingError(
                    f"{database}: {first_line(error)} (if it is damaged, delete it: the next "
                    "import rebuilds it)"
                ) from error
            print(
                f"MLflow at {uri} cannot be used: {first_line(error)}\n"
                f"Not sent: {', '.join(r.name for r in runs[len(done) :])}\n"
                "To send later, repeat the import (snakemake --forcerun track)."
            )
    done += [("", NOT_SENT)] * (len(runs) - len(done))
    write_text(receipt, _as_csv(runs, preset, done))
    counts = Counter(action for _, action in done)
    print(f"{len(done)} runs:", ", ".join(f"{n} {action}" for action, n in sorted(counts.items())))


def prepared() -> str:
    """Address of the server that the environment names, "" if none; MLflow is made ready."""
    os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
    # MLflow's own waits add up to minutes for a server that is away.
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "20")
    os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
    return os.environ.get("MLFLOW_TRACKING_URI", "")


@contextmanager
def alone(database: Path) -> Iterator[None]:
    """Wait for other importers: two that meet on a new database would ruin it."""
    import fcntl

    database.parent.mkdir(parents=True, exist_ok=True)
    with database.with_name(f".{database.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _import(
    runs: Sequence[Run], tags: dict[str, str], uri: str, database: Path, artifacts: Path
) -> Iterator[tuple[str, str]]:
    """Id and action of one record after the other."""
    client = client_of(uri, database)
    experiments: dict[str, str] = {}
    known: dict[tuple[str, ...], list[MlflowRun]] = {}
    imported: dict[str, str] = {}
    for record in runs:
        name = record.experiment
        if name not in experiments:
            experiments[name] = experiment_of(client, name, uri, artifacts)
            for old in _runs(client, experiments[name]):
                known.setdefault((name, *_slot(old.data.tags)), []).append(old)
        own = {**tags, **tags_of(record)}
        if record.parent:
            own[PARENT] = imported[record.parent]
        outcome = _import_one(
            client, experiments[name], record, own, known.get((name, *_slot(own)), ())
        )
        imported[record.source] = outcome[0]
        yield outcome
    for name in dict.fromkeys(registered_name(record) for record in runs if record.fit):
        choose_best(client, name)
    for name, experiment in experiments.items():
        show(client, experiment, [record for record in runs if record.experiment == name])


def client_of(uri: str, database: Path) -> MlflowClient:
    """A client of a server, or else of the database, which is made if missing."""
    from mlflow import MlflowClient

    if not uri:
        if not database.exists():
            # The migrations take seconds; killed within them, MLflow could not go on.
            with atomic_path(database, digest=False) as temporary:
                MlflowClient(f"sqlite:///{temporary.resolve()}").search_experiments(max_results=1)
        uri = f"sqlite:///{database.resolve()}"
    return MlflowClient(uri)


def experiment_of(client: MlflowClient, name: str, uri: str, artifacts: Path) -> str:
    """Id of an experiment, which is made if missing; raises TrackingError if it was moved."""
    # A server decides itself where artifacts go.
    served = uri.startswith(("http", "databricks"))
    location = None if served else (artifacts.resolve() / name).as_uri()
    found = client.get_experiment_by_name(name)
    if found is None:
        return str(client.create_experiment(name, artifact_location=location))
    if not uri and found.artifact_location != location:
        # A copied results folder would otherwise write into the original's files.
        raise TrackingError(
            f"the database keeps its files in {found.artifact_location}, not in {location}; "
            "was the results folder moved? Delete mlflow.db and import again"
        )
    if found.lifecycle_stage == "deleted":
        client.restore_experiment(found.experiment_id)
    return str(found.experiment_id)


def runs_of_slot(client: MlflowClient, experiment: str, tags: Mapping[str, str]) -> list[MlflowRun]:
    """Return the active runs of a place in the results folder that this stage has made."""
    return [run for run in _runs(client, experiment) if _slot(run.data.tags) == _slot(tags)]


def _runs(client: MlflowClient, experiment: str) -> Iterator[MlflowRun]:
    """Active runs of an experiment that this stage has made."""
    known = client.search_runs([experiment], max_results=MOST_RUNS)
    yield from (run for run in known if "config_hash" in run.data.tags)


def _import_one(
    client: MlflowClient,
    experiment: str,
    record: Run,
    tags: dict[str, str],
    known: Sequence[MlflowRun],
) -> tuple[str, str]:
    """Leave exactly one active run of the record; `known` are those of its slot."""
    same = [run for run in known if run.data.tags["config_hash"] == record.config_hash]
    # An import that was killed leaves a run without content_hash.
    valid = [r for r in same if r.data.tags.get("content_hash") == record.content_hash]
    if valid:
        run_id, action = valid[0].info.run_id, "unchanged"
        for key in ("superseded", PARENT):
            # A parent that has new files is another run.
            if key in tags and valid[0].data.tags.get(key) != tags[key]:
                client.set_tag(run_id, key, tags[key])
    else:
        run_id, action = _create(client, experiment, record, tags), "created"
        if same:
            action = "updated"
    for old in known:
        if (old in same or old.data.tags["config_hash"] == LIVE) and old.info.run_id != run_id:
            forget(client, old.info.run_id)
        elif old not in same and old.data.tags.get("superseded") != "true":
            client.set_tag(old.info.run_id, "superseded", "true")
    return run_id, action


def _create(client: MlflowClient, experiment: str, record: Run, tags: dict[str, str]) -> str:
    import yaml
    from mlflow.entities import Metric, Param

    created = client.create_run(experiment, record.start_ms, tags, record.name)
    run_id: str = created.info.run_id
    data = _log_data(client, run_id, record)
    model_id = log_model(client, experiment, run_id, record)
    of_model = {"model_id": model_id, **data} if model_id else data
    metrics = [
        Metric(p.name, p.value, p.time_ms, p.epoch, **({} if p.epoch else of_model))
        for p in record.points
    ]
    settings = settings_of(record, tags["preset"])
    params = [Param(k, v[:PARAM_LENGTH]) for k, v in settings.items()]
    for i in range(0, len(params), BATCH):
        client.log_batch(run_id, params=params[i : i + BATCH], synchronous=True)
    log_metrics(client, run_id, metrics)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        link({k: path for k, path in record.files.items() if not k.startswith(MODEL)}, folder)
        (folder / CONFIG).write_text(yaml.safe_dump(record.config), encoding="utf-8")
        client.log_artifacts(run_id, str(folder))
    if record.fit and model_id:
        register(client, run_id, model_id, record)
    client.set_terminated(run_id, record.status, record.end_ms)
    client.set_tag(run_id, "content_hash", record.content_hash)
    return run_id


def log_metrics(client: MlflowClient, run_id: str, metrics: Sequence[Metric]) -> None:
    """Log any number of metrics."""
    for i in range(0, len(metrics), 10 * BATCH):
        client.log_batch(run_id, metrics=metrics[i : i + 10 * BATCH], synchronous=True)


def _log_data(client: MlflowClient, run_id: str, record: Run) -> dict[str, str]:
    """Log what a run has learnt from, if it is there; how metrics name it."""
    if record.data is None or not record.data.is_file():
        return {}
    from mlflow.entities import Dataset, DatasetInput, InputTag

    source = json.dumps({"uri": record.data.resolve().as_uri()})
    data = Dataset(record.dataset, digest_of(record.data)[:DIGEST], "local", source)
    of_training = [InputTag("mlflow.data.context", "training")]
    client.log_inputs(run_id, [DatasetInput(data, of_training)])
    return {"dataset_name": data.name, "dataset_digest": data.digest}


def tags_of(record: Run) -> dict[str, str]:
    """Tags of a run in MLflow, but for those of the whole import."""
    own = {key: getattr(record, key) for key in SLOT if key != "preset"}
    own |= record.tags
    return {**own, "config_hash": record.config_hash, "superseded": "false"}


def _slot(tags: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(tags.get(key, "") for key in SLOT)


def ours_to_explain(error: Exception) -> bool:
    """Whether an error comes from the database, the server or the disk, not from a bug."""
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    return isinstance(error, MlflowException | SQLAlchemyError | OSError)


def first_line(error: Exception) -> str:
    """Return the first line of an error."""
    return str(error).strip().split("\n", 1)[0]


def _as_csv(runs: Sequence[Run], preset: str, done: Sequence[tuple[str, str]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for record, (run_id, action) in zip(runs, done, strict=True):
        row = {"run_id": run_id, "action": action, "experiment": record.experiment}
        writer.writerow({**row, "preset": preset, **tags_of(record)})
    return text.getvalue()
