"""Stages `sweep list` and `sweep point`: the points of a sweep, and one of its trainings.

Inputs: the names of a sweep and of one of its points, and the data that it is trained and tested
on. Outputs: `result.json` with its metrics, its tables of errors, its cost, and the files of the
trained model.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Annotated, Literal

import click

from psfdae.base.files import write_text
from psfdae.base.options import File, Folder
from psfdae.base.reading import read_json
from psfdae.methods.fit_files import delete_checkpoints
from psfdae.methods.interface import FitError
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.compose import part
from psfdae_paper.configuration.estimators import list_swept_networks
from psfdae_paper.configuration.schema import Config
from psfdae_paper.sweeps.measurement import Measurement, Task
from psfdae_paper.sweeps.points import Point, SweepError, plan_sweep


def training_module(model: str) -> str:
    """Return the name of the module that trains and measures a model.

    It is imported by this name, so that the code of a point does not include the other kind.

    Parameters
    ----------
    model : str
        Name of a method, or of a network of scene 3.
    """
    if model in list_swept_networks():
        return "psfdae_paper.stages.network_point"
    return "psfdae_paper.stages.method_point"


Overrides = Annotated[tuple[str, ...], {"argument": True}]


@command("paper sweep list")
def sweep_list(name: Annotated[str, {"argument": True}], overrides: Overrides = ()) -> None:
    """List the points of a sweep as tab-separated text, without running it.

    Columns are the point's name and its values as KEY=VALUE, or the number of the trial if values
    are proposed only when it runs.
    """
    for entry in plan_sweep(name, overrides).points.values():
        values: Mapping[str, object] = entry.values or {"trial": entry.slot}
        print("\t".join([entry.name, *(f"{k}={json.dumps(v)}" for k, v in values.items())]))


@command("paper sweep point")
def sweep_point(
    name: Annotated[str, {"argument": True}],
    data: tuple[tuple[Literal["stars", "states", "validation", "test"], File], ...],
    checkpoint: File,
    out: Folder,
    overrides: Overrides = (),
) -> None:
    """Train one point of a sweep and measure it.

    The name of a point is the hash of everything that decides its result, and the name of OUT; give
    the overrides with which the sweep was planned. `psfdae paper sweep list NAME` prints the
    points.

    The folder receives result.json with metrics and settings, cost.json with seconds, tables of
    errors, and the files of the model. A training that fails is a result, too.

    Parameters
    ----------
    name : str
        Name of the sweep in a file of config/sweep.
    data : sequence of pairs
        Role and product: stars; for scene 3 states, validation and test.
    checkpoint : Path
        State of an interrupted training.
    out : Path
        Folder for the point's files; its name is the point's.
    overrides : sequence of str
        Words of Hydra with which the sweep was planned.
    """
    plan = plan_sweep(name, overrides)
    sweep = plan.sweep
    # A misspelt folder, or other overrides than in the plan.
    if out.name not in plan.points:
        raise SweepError(f"{out}: sweep {name} has no point {out.name}")
    entry = plan.points[out.name]
    # Networks of scene 3 have separate validation and test states; methods split their stars.
    roles = {"states", "validation", "test"} if sweep.model in list_swept_networks() else {"stars"}
    if {role for role, _ in data} != roles:
        raise click.UsageError(f"--data: {sweep.model} needs {', '.join(sorted(roles))}")
    # For networks of scene 3, tables have the name of the network as dataset.
    dataset = sweep.dataset or sweep.model
    task = Task(*(dataset, sweep.split, sweep.reference), dict(data), plan.levels, out, checkpoint)
    # An adaptive sweep proposes values for a trial when it runs.
    if entry.slot is not None:
        results = [
            read_json(out.parent / earlier.name / "result.json")
            for earlier in plan.earlier_trials(entry)
        ]
        entry = plan.propose_values(entry, results)
    point(part(sweep.reads, entry.config), sweep.model, entry, task)


def point(config: Config, model: str, entry: Point, task: Task) -> None:
    """Train and measure one point; leave `result.json`, `cost.json` and the model's files.

    A training that cannot continue (not finite, or dead in all its starts) is a result, too, with
    the status failed and the reason. `result.json` is written last, and is the same in every run.

    Parameters
    ----------
    config : Config
        Groups that a point of the model reads.
    model : str
        Name of a method, or of a network of scene 3.
    entry : Point
        Values of the axes, configuration keys that differ from the dataset's, and number of a
        trial.
    task : Task
        Data, noise levels, and the folder for the results.

    Raises
    ------
    ProductError
        If an input is missing or damaged.
    """
    # Files of an earlier training are removed.
    training = import_module(training_module(model))
    for name in (*training.list_files(model), *task.tables.values(), "cost.json", "result.json"):
        (task.folder / name).unlink(missing_ok=True)
    outcome = _train(lambda: training.measure(config, task, model), config, task)
    # Metrics and settings only: the cost of a point is in a file of its own.
    result = {
        "point": task.folder.name,
        "slot": entry.slot,
        "model": model,
        "dataset": task.dataset,
        "split": task.split,
        "reference": task.reference,
        "values": entry.values,
        "keys": entry.keys,
        **outcome,
    }
    write_text(task.folder / "result.json", json.dumps(result, indent=1) + "\n")


def _train(measure: Callable[[], Measurement], config: Config, task: Task) -> dict[str, object]:
    """Train and measure a point, and write its cost.

    Parameters
    ----------
    measure : callable
        Trains and measures the point.
    config : Config
        Configuration of the point, which is recorded if the training fails.
    task : Task
        Its folder receives `cost.json`.

    Returns
    -------
    dict
        status, reason, epochs, attempt, metrics and config.
    """
    # The duration of a training that fails is its cost, too.
    start_s, start_cpu_s = time.monotonic(), time.process_time()
    status, reason = "finished", ""
    try:
        measurement = measure()
        status = "stopped" if measurement.is_stopped else "finished"
    except FitError as error:
        # A training that cannot continue is a result without metrics.
        status, reason = "failed", str(error).splitlines()[0]
        print(f"failed: {reason}", flush=True)
        delete_checkpoints(task.checkpoint)
        seconds, cpu_seconds = time.monotonic() - start_s, time.process_time() - start_cpu_s
        measurement = Measurement({}, config.model_dump(), seconds, cpu_seconds, attempt=None)
    # The cost differs from run to run and has a file of its own; times are to a millisecond.
    cost = {key: round(getattr(measurement, key), 3) for key in ("seconds", "cpu_seconds")}
    write_text(task.folder / "cost.json", json.dumps(cost) + "\n")
    return {
        "status": status,
        "reason": reason,
        "epochs": measurement.epochs,
        "attempt": measurement.attempt,
        "metrics": measurement.metrics,
        "config": measurement.config,
    }
