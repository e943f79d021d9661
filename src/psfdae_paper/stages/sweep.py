"""Stage `sweep point`: one training of a sweep, measured on validation and test part."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal

import click

from psfdae.files import ProductError, write_text
from psfdae.method import FitError
from psfdae.options import File, Folder
from psfdae.settings import Reference, SplitKind, validate
from psfdae_paper.configuration.aligners import SWEPT
from psfdae_paper.configuration.alignment import CHOICE
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.compose import decisive_settings, load_stage
from psfdae_paper.configuration.schema import Config
from psfdae_paper.configuration.sweep import Axis, Value, models, point_groups
from psfdae_paper.sweeps.measured import (
    CHECKSUM,
    COST,
    EVALUATION,
    FINISHED,
    RESULT,
    VALIDATION,
    Measured,
    Task,
    checksum,
    read_result,
)
from psfdae_paper.sweeps.points import changes, with_values

ADAPTIVE_MODULE = "psfdae_paper.sweeps.adaptive"
"""Module of the adaptive search; it is imported only if it is used, because it needs Optuna."""


def module_of(model: str) -> str:
    """Return the name of the module that trains and measures a model."""
    return f"psfdae_paper.stages.{'network' if model in SWEPT else 'method'}_point"


@dataclass(frozen=True)
class Trial:
    """A trial of an adaptive sweep.

    Attributes
    ----------
    slot : int
        Number of the trial.
    search : dict
        space, seed, startup, metric and direction of the sweep.
    earlier_points : sequence of str
        Names of the points from whose results it learns.
    """

    slot: int
    search: Mapping[str, Any]
    earlier_points: Sequence[str]


class JsonType(click.ParamType):  # type: ignore[type-arg]  # click below 8.5 takes none
    """A JSON object as one argument."""

    name = "json"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> dict[str, Any]:
        """Return the object of a JSON text; any other text is a usage error."""
        if isinstance(value, dict):
            return value
        try:
            tree = json.loads(value)
        except json.JSONDecodeError as error:
            self.fail(f"{value!r} is no JSON: {error}", param, ctx)
        if not isinstance(tree, dict):
            self.fail(f"{value!r} is no JSON object", param, ctx)
        return tree


Json = Annotated[dict[str, Any], JsonType()]
Overrides = Annotated[tuple[str, ...], {"argument": True}]


@command("sweep list")
def sweep_list(name: Annotated[str, {"argument": True}], overrides: Overrides = ()) -> None:
    """List the points of a sweep as tab-separated text, without running it."""
    from psfdae_paper.sweeps.points import plan_sweep

    for entry in plan_sweep(name, overrides).points.values():
        values: Mapping[str, object] = entry.values or {"trial": entry.slot}
        print("\t".join([entry.name, *(f"{k}={json.dumps(v)}" for k, v in values.items())]))


@command("sweep point")
def sweep_point(
    model: Annotated[str, click.Choice(models()), "What is trained."],
    dataset: Annotated[str, "Name that goes into the tables."],
    split: SplitKind = "random",
    reference: Reference = "realisation",
    *,
    data: Annotated[
        tuple[tuple[Literal["stars", "states", "validation", "test"], File], ...],
        "Role and product: stars; for scene 3 states, validation and test.",
    ],
    levels: Annotated[tuple[float, ...], {"flag": "--level"}, "Noise level λ."],
    values: Annotated[Json | None, "Value of every axis, as JSON."] = None,
    keys: Annotated[Json | None, "Keys that were changed, as JSON."] = None,
    checkpoint: Annotated[File, "State of an interrupted training."],
    slot: Annotated[int | None, "Number of a trial of an adaptive sweep."] = None,
    search: Annotated[Json | None, "Space and settings of an adaptive sweep, as JSON."] = None,
    source: Annotated[
        str, "Hash of the code, with which a result is kept.", {"show_default": False}
    ] = "",
    known: Annotated[tuple[str, ...], "Point of an earlier trial, beside OUT."] = (),
    out: Annotated[Folder, "Folder that receives the point's files; its name is the point's."],
    overrides: Overrides = (),
) -> None:
    """Train one point of a sweep and measure it."""
    if (slot is None) != (search is None):
        raise click.UsageError("--slot and --search go together")
    is_network = model in SWEPT
    roles = {"states", "validation", "test"} if is_network else {"stars"}
    if {role for role, _ in data} != roles:
        raise click.UsageError(f"--data: {model} needs {', '.join(sorted(roles))}")
    trial = None
    if slot is not None and search is not None:
        trial = Trial(slot, search, known)
    task = Task(dataset, split, reference, dict(data), levels, out, checkpoint)
    config = load_stage(point_groups(model), (*(CHOICE if is_network else ()), *overrides))
    point(config, model, values or {}, keys or {}, task, trial, source)


def point(
    config: Config,
    model: str,
    values: Mapping[str, Value],
    keys: Mapping[str, Value],
    task: Task,
    trial: Trial | None = None,
    source: str = "",
) -> None:
    """Train and measure one point; leave `result.json`, `cost.json` and the model's files.

    A training that cannot go on (not finite, or dead in all its starts) is a result, too: status
    failed, with the reason. `result.json` is written last; nothing in it differs between two
    runs. A point finished with the same code, configuration and data is not trained again.

    Parameters
    ----------
    config : Config
        Groups that a point of the model reads.
    model : str
        Name of a method, or of a network of scene 3.
    values : mapping
        Value of every axis; those of a trial are proposed here.
    keys : mapping
        Configuration keys that differ from the dataset's.
    task : Task
    trial : Trial, optional
        Trial of an adaptive sweep.
    source : str
        Hash of the code of which the point consists.

    Raises
    ------
    ProductError
        If an input is missing or damaged.
    ConfigError
        If a trial proposes values that the configuration does not allow.
    """
    module = import_module(module_of(model))
    files = module.files_of(model)
    # A trial gets its values from the results of earlier trials.
    if trial is not None:
        space, values = _proposed_values(trial, task.folder)
        trial_keys = changes(space, values)
        # The configuration with these values is checked again.
        tree = with_values(config.model_dump(), trial_keys)
        config, keys = validate(type(config), tree), {**keys, **trial_keys}
    # A result is reused if code, configuration and data are the same.
    content = [
        source,
        model,
        decisive_settings(config.model_dump()),
        dict(values),
        dict(keys),
        task.described(),
    ]
    fingerprint = checksum(content)
    result = _finished_result(task.folder, fingerprint, files)
    if result is None:
        # No file of another training may stay beside the new ones.
        for name in (*files, EVALUATION, VALIDATION, COST, RESULT, FINISHED):
            (task.folder / name).unlink(missing_ok=True)
        result = {
            "point": task.folder.name,
            "slot": trial.slot if trial else None,
            "model": model,
            "dataset": task.dataset,
            "split": task.split,
            "reference": task.reference,
            "values": dict(values),
            "keys": dict(keys),
            **_outcome(module, config, task, model),
            "fingerprint": fingerprint,
        }
        write_text(task.folder / FINISHED, as_json(result))
    write_text(task.folder / RESULT, as_json(result))


def _finished_result(folder: Path, fingerprint: str, files: Sequence[str]) -> dict[str, Any] | None:
    """Return the result of an earlier run of the same point if all of its files are there."""
    try:
        result = read_result(folder / FINISHED)
    except ProductError:
        return None
    required = [COST] if result["status"] == "failed" else [COST, *files]
    if result.get("fingerprint") != fingerprint:
        return None
    if not all((folder / name).is_file() for name in required):
        return None
    print("finished before with the same code, configuration and data; kept", flush=True)
    return result


def as_json(result: Mapping[str, Any]) -> str:
    """Return a result as JSON text with its checksum."""
    return json.dumps({**result, CHECKSUM: checksum(result)}, indent=1) + "\n"


def _outcome(module: ModuleType, config: Config, task: Task, model: str) -> dict[str, object]:
    """Train and measure a point; return status, metrics and configuration.

    The cost, which differs between runs, is written to a file of its own.
    """
    started, started_cpu = time.monotonic(), time.process_time()
    try:
        measured: Measured = module.run(config, task, model)
    except FitError as error:
        reason = str(error).splitlines()[0]
        print(f"failed: {reason}", flush=True)
        task.checkpoint.unlink(missing_ok=True)
        cost = (time.monotonic() - started, time.process_time() - started_cpu)
        _write_cost(task.folder, *cost)
        return {
            "status": "failed",
            "reason": reason,
            "epochs": None,
            "attempt": None,
            "metrics": {},
            "config": config.model_dump(),
        }
    _write_cost(task.folder, measured.seconds, measured.cpu_seconds)
    return {
        "status": "stopped" if measured.stopped else "finished",
        "reason": "",
        "epochs": measured.epochs,
        "attempt": measured.attempt,
        "metrics": measured.metrics,
        "config": measured.described,
    }


def _write_cost(folder: Path, seconds: float, cpu_seconds: float) -> None:
    """Write the duration of a training."""
    cost = {"seconds": round(seconds, 3), "cpu_seconds": round(cpu_seconds, 3)}
    write_text(folder / COST, json.dumps(cost) + "\n")


def _proposed_values(trial: Trial, folder: Path) -> tuple[dict[str, Axis], dict[str, Value]]:
    """Return the axes of the space, and the values that the search proposes for a trial."""
    space = {name: validate(Axis, axis) for name, axis in trial.search["space"].items()}
    earlier_results = [
        read_result(folder.parent / point / RESULT) for point in trial.earlier_points
    ]
    adaptive = import_module(ADAPTIVE_MODULE)
    values: dict[str, Value] = adaptive.ask(space, trial.search, trial.slot, earlier_results)
    return space, values
