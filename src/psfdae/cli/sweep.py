"""Commands of sweeps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from psfdae.cli.base import (
    FileArgument,
    FolderArgument,
    input_option,
    main,
    out_option,
    overrides,
    reference_option,
    split_option,
)


class JsonType(click.ParamType):
    """A JSON object as one argument."""

    name = "json"

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Parse; a wrong text is a usage error."""
        if isinstance(value, dict):
            return value
        try:
            tree = json.loads(value)
        except json.JSONDecodeError as error:
            self.fail(f"{value!r} is no JSON: {error}", param, ctx)
        if not isinstance(tree, dict):
            self.fail(f"{value!r} is no JSON object", param, ctx)
        return tree


@main.group()
def sweep() -> None:
    """Train many variants of a model and compare them (config/sweep)."""


@sweep.command("list")
@click.argument("name")
@overrides
def sweep_list(name: str, overrides: tuple[str, ...]) -> None:
    """List the points of a sweep as tab-separated text, without running it."""
    from psfdae.sweeps.points import plan_sweep

    for point in plan_sweep(name, overrides).points.values():
        values = point.values or {"trial": point.slot}
        click.echo("\t".join([point.name, *(f"{k}={json.dumps(v)}" for k, v in values.items())]))


@sweep.command("point")
@click.option(
    "--model",
    type=click.Choice(["dae", "pca_som", "original", "noise_trained"]),
    required=True,
    help="What is trained.",
)
@click.option("--dataset", required=True, help="Name that goes into the tables.")
@split_option
@reference_option
@click.option(
    "--data",
    type=(click.Choice(["stars", "states", "validation", "test"]), FileArgument),
    multiple=True,
    required=True,
    help="Role and product: stars; for scene 3 states, validation and test.",
)
@click.option("--level", "levels", type=float, multiple=True, required=True, help="Noise level λ.")
@click.option("--values", type=JsonType(), default="{}", help="Value of every axis, as JSON.")
@click.option("--keys", type=JsonType(), default="{}", help="Keys that were changed, as JSON.")
@input_option("checkpoint", "State of an interrupted training.")
@click.option("--slot", type=int, help="Number of a trial of an adaptive sweep.")
@click.option("--search", type=JsonType(), help="Space and settings of an adaptive sweep, as JSON.")
@click.option("--journal", type=FileArgument, help="Optuna's journal of an adaptive sweep.")
@click.option("--source", default="", help="Hash of the code, with which a result is kept.")
@click.option("--known", multiple=True, help="Point of an earlier trial, beside OUT.")
@out_option("Folder that receives the point's files; its name is the point's.", FolderArgument)
@overrides
def sweep_point(
    model: str,
    dataset: str,
    split: str,
    reference: str,
    data: tuple[tuple[str, Path], ...],
    levels: tuple[float, ...],
    values: dict[str, Any],
    keys: dict[str, Any],
    checkpoint: Path,
    slot: int | None,
    search: dict[str, Any] | None,
    journal: Path | None,
    source: str,
    known: tuple[str, ...],
    out: Path,
    overrides: tuple[str, ...],
) -> None:
    """Train one point of a sweep and measure it."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import sweep as stage
    from psfdae.sweeps.measured import Task

    given = (slot is not None, search is not None, journal is not None)
    if any(given) and not all(given):
        raise click.UsageError("--slot, --search and --journal go together")
    needed = {"stars"} if model in ("dae", "pca_som") else {"states", "validation", "test"}
    if {role for role, _ in data} != needed:
        raise click.UsageError(f"--data: {model} needs {', '.join(sorted(needed))}")
    trial = None
    if slot is not None and search is not None and journal is not None:
        trial = stage.Trial(slot, search, known, journal)
    task = Task(dataset, split, reference, dict(data), levels, out, checkpoint)
    config = load_stage(f"sweep_{model}", overrides)
    stage.point(config, model, values, keys, task, trial, source)


@sweep.command("summary")
@click.argument("name")
@input_option("points", "Folder with a folder for each point.", FolderArgument)
@out_option("Folder for summary.csv, cost.csv, best.yaml and sweep.yaml.", FolderArgument)
@overrides
def sweep_summary(name: str, points: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Tabulate the points of a sweep and choose the best."""
    from psfdae.stages import sweep_summary as stage
    from psfdae.stages.sweep import RESULT
    from psfdae.sweeps.points import plan_sweep

    plan = plan_sweep(name, overrides)
    files = [points / point / RESULT for point in plan.points]
    stage.summary(name, plan.sweep.model_dump(exclude_none=True), overrides, files, out)


@sweep.command("figure")
@click.argument("kind", type=click.Choice(["parallel", "response"]))
@input_option("definition", "sweep.yaml of the command `sweep summary`.")
@input_option("table", "summary.csv of the same.")
@out_option("PNG.")
def sweep_figure(kind: str, definition: Path, table: Path, out: Path) -> None:
    """Draw all points at once, or the metric against each axis."""
    from psfdae.stages import sweep_figures as stage

    stage.run(kind, definition, table, out)


@main.command()
@click.argument("name")
@click.option(
    "--results",
    type=FolderArgument,
    default=Path("results"),
    show_default=True,
    help="Folder that the workflow writes to.",
)
def best(name: str, results: Path) -> None:
    """Print the best point of a sweep as overrides: make reproduce SET="$(psfdae best NAME)"."""
    from psfdae.stages.sweep_summary import best_overrides

    click.echo(" ".join(best_overrides(results, name)))
