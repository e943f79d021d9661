"""Epochs of trainings in MLflow while they run: `make reproduce TRACK=live`.

A training logs where the environment asks for it (`psfdae.methods.networks.training.listener`).
Its run lasts until `psfdae paper track` imports the finished one. The path of a checkpoint goes in,
which says whose training it is, and a function of the rows of the history comes out.
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
    delete_live,
    experiment_of,
    first_line,
    locked,
    log_metrics,
    ours_to_explain,
    server,
)
from psfdae_paper.tracking import epoch_metrics

if TYPE_CHECKING:
    from psfdae.methods.networks.training import Row


def logger(checkpoint: Path) -> Callable[[Row], None]:
    """Return a function that logs an epoch of the training with this checkpoint.

    Trainings that MLflow does not show, such as points of sweeps, are passed over. So are those of
    jobs of a cluster, unless MLFLOW_TRACKING_URI names a server: its nodes open no database.

    Parameters
    ----------
    checkpoint : Path
        File of the training's state, whose place in the results folder names the training.

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
        # Passed over from the start, or since MLflow has failed.
        if not is_shown:
            return
        # The history counts seconds from the start of the training, MLflow from 1970.
        start_ms = int(1000 * (time.time() - row["seconds"]))
        try:
            with locked(database):
                client = client_of(uri, database)
                if row["epoch"] <= last_epoch or not run_id:
                    # A training that starts anew, or goes on from its checkpoint, has a new run.
                    experiment = experiment_of(client, LIVE, uri, database)
                    # A run of an earlier attempt would stay beside the new one.
                    delete_live(client, source)
                    tags = {"source": source, "preset": os.environ["PRESET"] or "fast"}
                    run_id = client.create_run(experiment, start_ms, tags, source).info.run_id
                log_metrics(client, run_id, epoch_metrics([row], start_ms))
                last_epoch = row["epoch"]
        except Exception as error:
            if not ours_to_explain(error):
                raise
            is_shown = False  # a training ends whatever becomes of its picture
            print(f"the training is not shown in MLflow any more: {first_line(error)}", flush=True)

    return log
