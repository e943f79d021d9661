"""Epochs of trainings in MLflow while they run: `make reproduce TRACK=live`.

A training logs where the environment asks for it (`psfdae.networks.training.listener`). Its run
lasts until `psfdae track` replaces it by the finished one.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from psfdae_paper.stages.track import (
    LIVE,
    alone,
    client_of,
    experiment_of,
    first_line,
    log_metrics,
    ours_to_explain,
    prepared,
    runs_of_slot,
    tags_of,
)
from psfdae_paper.tracking import epoch_points, training_at

if TYPE_CHECKING:
    from psfdae.networks.training import Row


def logger(checkpoint: Path) -> Callable[[Row], None]:
    """Return a function that logs an epoch of the training with this checkpoint.

    Trainings that MLflow does not show, such as points of sweeps, are passed over. So are those of
    jobs of a cluster, unless MLFLOW_TRACKING_URI names a server: its nodes open no database.
    """
    from mlflow.entities import Metric

    results, preset = Path(os.environ["PSFDAE_RESULTS"]), os.environ["PRESET"]
    uri, database = prepared(), results / "mlflow.db"
    record = training_at(checkpoint, results, preset)
    run_id, last, working = (
        "",
        0.0,
        record is not None and bool(uri or "SLURM_JOB_ID" not in os.environ),
    )

    def log(row: Row) -> None:
        nonlocal run_id, last, working
        if record is None or not working:
            return
        now = int(1000 * time.time())
        try:
            with alone(database):
                client = client_of(uri, database)
                if row["epoch"] <= last or not run_id:
                    # A training that starts anew, or goes on from its checkpoint, has a new run.
                    place = database.parent / "mlartifacts"
                    experiment = experiment_of(client, record.experiment, uri, place)
                    tags = {**tags_of(record), "preset": preset, "config_hash": LIVE}
                    for old in runs_of_slot(client, experiment, tags):
                        if old.data.tags["config_hash"] == LIVE:
                            client.delete_run(old.info.run_id)
                    started = now - int(1000 * row["seconds"])
                    run_id = client.create_run(experiment, started, tags, record.name).info.run_id
                points = epoch_points([row], now - int(1000 * row["seconds"]))
                log_metrics(
                    client, run_id, [Metric(p.name, p.value, p.time_ms, p.epoch) for p in points]
                )
                last = row["epoch"]
        except Exception as error:
            if not ours_to_explain(error):
                raise
            working = False  # a training ends whatever becomes of its picture
            print(f"the training is not shown in MLflow any more: {first_line(error)}", flush=True)

    return log
