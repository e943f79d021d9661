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
    client_of,
    experiment_of,
    first_line,
    locked,
    log_metrics,
    ours_to_explain,
    runs_of_slot,
    server,
    tags_of,
)
from psfdae_paper.tracking import epoch_metrics, training_at

if TYPE_CHECKING:
    from psfdae.networks.training import Row


def logger(checkpoint: Path) -> Callable[[Row], None]:
    """Return a function that logs an epoch of the training with this checkpoint.

    Trainings that MLflow does not show, such as points of sweeps, are passed over. So are those of
    jobs of a cluster, unless MLFLOW_TRACKING_URI names a server: its nodes open no database.
    """
    results, preset = Path(os.environ["PSFDAE_RESULTS"]), os.environ["PRESET"]
    uri, database = server(), results / "mlflow.db"
    run = training_at(checkpoint, results, preset)
    if not uri and "SLURM_JOB_ID" in os.environ:
        run = None
    run_id, last_epoch = "", 0.0

    def log(row: Row) -> None:
        nonlocal run, run_id, last_epoch
        if run is None:
            return
        start_ms = int(1000 * (time.time() - row["seconds"]))
        try:
            with locked(database):
                client = client_of(uri, database)
                if row["epoch"] <= last_epoch or not run_id:
                    # A training that starts anew, or goes on from its checkpoint, has a new run.
                    experiment = experiment_of(client, run.experiment, uri, database)
                    tags = {**tags_of(run), "preset": preset, "config_hash": LIVE}
                    for old in runs_of_slot(client, experiment, tags):
                        if old.data.tags["config_hash"] == LIVE:
                            client.delete_run(old.info.run_id)
                    run_id = client.create_run(experiment, start_ms, tags, run.name).info.run_id
                log_metrics(client, run_id, epoch_metrics([row], start_ms))
                last_epoch = row["epoch"]
        except Exception as error:
            if not ours_to_explain(error):
                raise
            run = None  # a training ends whatever becomes of its picture
            print(f"the training is not shown in MLflow any more: {first_line(error)}", flush=True)

    return log
