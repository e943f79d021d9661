"""Epochs of trainings in MLflow while they run: `make reproduce TRACK=live`.

A training logs its epochs if the environment asks for it
(`psfdae.methods.networks.training.listener`). Its run lasts until `psfdae paper track` imports the
finished one. The path of its checkpoint identifies the training.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from psfdae_paper.stages.track import (
    LIVE,
    delete_live,
    find_experiment,
    first_line,
    is_external_error,
    lock_database,
    log_metrics,
    make_client,
    server,
)
from psfdae_paper.tracking import epoch_metrics

if TYPE_CHECKING:
    from psfdae.methods.networks.training import Row


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
    uri, database = server(), Path(os.environ["PSFDAE_RESULTS"], "mlflow.db")
    # Checkpoints are METHOD/DATASET/SPLIT-REFERENCE.pt and, of scene 3, alignment-NETWORK.pt.
    source = os.path.relpath(checkpoint.with_suffix(""), database.with_name("checkpoints"))
    source = source.replace("alignment-", "alignment/")
    is_shown = bool(uri or "SLURM_JOB_ID" not in os.environ) and "/" in source
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
            with lock_database(database):
                client = make_client(uri, database)
                if row["epoch"] <= last_epoch or not run_id:
                    # A training that starts again, or resumes from its checkpoint, has a new run.
                    experiment = find_experiment(client, LIVE, uri, database)
                    # A run of an earlier attempt would remain.
                    delete_live(client, source)
                    tags = {"source": source, "preset": os.environ["PRESET"] or "fast"}
                    run_id = client.create_run(experiment, start_ms, tags, source).info.run_id
                log_metrics(client, run_id, epoch_metrics([row], start_ms))
                last_epoch = row["epoch"]
        except Exception as error:
            if not is_external_error(error):
                raise
            is_shown = False  # errors of MLflow must not stop a training
            print(f"the training is not shown in MLflow any more: {first_line(error)}", flush=True)

    return log
