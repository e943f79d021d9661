"""Stages `sweep summary`, `sweep figure` and `best`: tables and figures of a sweep's points.

Input: the results of all points. Outputs: their table, the best point as overrides, the cost of
each training, and two figures. The best point is chosen without errors on the test part.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import pandas as pd
import yaml

from psfdae.base.figures import write_png
from psfdae.base.files import ProductError, as_yaml, write_csv, write_text
from psfdae.base.options import File, Folder
from psfdae.base.reading import read_json, read_table, read_yaml
from psfdae.base.settings import as_overrides
from psfdae_paper.configuration.command import command
from psfdae_paper.evaluation import sweep_figures
from psfdae_paper.sweeps.measurement import read_cost
from psfdae_paper.sweeps.points import SweepError, plan_sweep


@command("paper sweep summary")
def sweep_summary(
    name: Annotated[str, {"argument": True}],
    points: Folder,
    out: Folder,
    overrides: Annotated[tuple[str, ...], {"argument": True}] = (),
) -> None:
    """Tabulate the points of a sweep and choose the best by its validation metric.

    All points must be finished; one that failed has a row with the reason.

    best.yaml has the best point as overrides, as `psfdae paper best` prints them.

    Parameters
    ----------
    name : str
        Name of the sweep in a file of config/sweep.
    points : Path
        Folder with a folder for each point.
    out : Path
        Folder for summary.csv, cost.csv, best.yaml and sweep.yaml.
    overrides : sequence of str
        Words of Hydra with which the sweep was planned.
    """
    plan = plan_sweep(name, overrides)
    # Points in the order of the plan, not in the order in which they ended.
    files = [points / point / "result.json" for point in plan.points]
    tabulate_points(name, plan.sweep.model_dump(exclude_none=True), overrides, files, out)


@command("paper best")
def best(name: Annotated[str, {"argument": True}], results: Folder = Path("results")) -> None:
    """Print the best point of a sweep as overrides: make reproduce SET="$(psfdae paper best NAME)".

    Parameters
    ----------
    name : str
        Name of the sweep.
    results : Path
        Folder that the workflow writes to.
    """
    print(" ".join(best_overrides(results, name)))


def tabulate_points(
    name: str,
    definition: Mapping[str, Any],
    overrides: Sequence[str],
    points: Sequence[Path],
    out: Path,
) -> None:
    """Tabulate the points of a sweep and choose the best by its metric.

    Parameters
    ----------
    name : str
        Name of the sweep.
    definition : mapping
        Configuration group `Sweep`.
    overrides : sequence of str
        Overrides of the workflow that all points share, its preset first.
    points : sequence of Path
        `result.json` of every point, in the order of the table.
    out : Path
        Folder for `summary.csv` (point, a column per axis, status, reason, epochs, attempt, best,
        metrics), `cost.csv` (seconds of each training), `best.yaml` and `sweep.yaml`.

    Raises
    ------
    ProductError
        If a result is missing or damaged.
    SweepError
        If no point has a metric.
    """
    # The best point by the validation metric; a sweep without any metric has failed.
    results = [read_json(path) for path in points]
    best_result = choose(results, definition["metric"], definition["direction"])
    if best_result is None:
        reason = f"{results[0]['point']}: {results[0]['reason']}"
        raise SweepError(f"all {len(results)} points of sweep {name} failed; the first, {reason}")
    # Metrics are the same in every run of a point; its cost is in a table of its own.
    rows = []
    for result in results:
        # A value of an axis may be a list, which is one cell of the table as JSON.
        values = {axis: result["values"][axis] for axis in definition["space"]}
        values = {k: json.dumps(v) if isinstance(v, list) else v for k, v in values.items()}
        outcome = {key: result[key] for key in ("status", "reason", "epochs", "attempt")}
        outcome["best"] = "yes" if result is best_result else "no"
        rows.append({"point": result["point"], **values, **outcome, **result["metrics"]})
    write_csv(out / "summary.csv", pd.DataFrame(rows))
    costs = [
        {"point": result["point"], **read_cost(path.parent)}
        for result, path in zip(results, points, strict=True)
    ]
    write_text(out / "cost.csv", pd.DataFrame(costs).to_csv(index=False))
    sweep_tree = {"sweep": name, "given": list(overrides), **definition}
    # Unsorted: the order of the axes is used in the figures.
    write_text(out / "sweep.yaml", yaml.safe_dump(sweep_tree, sort_keys=False))
    # The best point as overrides: first of the workflow, then of the point. The preset has a key of
    # its own, because `make reproduce` takes it separately.
    preset = "preset="
    point_overrides = [word.removeprefix("++") for word in as_overrides(best_result["keys"])]
    best_point = {
        "sweep": name,
        "point": best_result["point"],
        "preset": next((w.removeprefix(preset) for w in overrides if w.startswith(preset)), ""),
        "overrides": [*(w for w in overrides if not w.startswith(preset)), *point_overrides],
        "dataset": definition.get("dataset") or definition["model"],
        "split": best_result["split"],
        "reference": best_result["reference"],
        "metric": definition["metric"],
        "metrics": {key: float(f"{v:.8g}") for key, v in best_result["metrics"].items()},
    }
    write_text(out / "best.yaml", as_yaml(best_point))


def choose(
    results: Sequence[Mapping[str, Any]], metric: str, direction: str
) -> Mapping[str, Any] | None:
    """Return the result with the best validation metric, the first of equals.

    None if all points failed.

    Parameters
    ----------
    results : sequence of mapping
        `result.json` of every point.
    metric : str
        Name of a metric, such as "validation_mse".
    direction : str
        "minimize" or "maximize".
    """
    # `min` returns the first of equals.
    sign = 1.0 if direction == "minimize" else -1.0
    with_metric = [result for result in results if metric in result["metrics"]]
    return min(with_metric, key=lambda result: sign * result["metrics"][metric], default=None)


def best_overrides(results: Path, name: str) -> list[str]:
    """Return the Hydra overrides of the best point of a sweep.

    Parameters
    ----------
    results : Path
        Folder that the workflow writes to.
    name : str
        Name of the sweep.

    Returns
    -------
    list of str
        Words for `make reproduce SET="…"`.

    Raises
    ------
    ProductError
        If the sweep has not been run.
    """
    path = results / "sweeps" / name / "best.yaml"
    if not path.is_file():
        raise ProductError(f"{path}: missing; run `snakemake sweep --config sweep={name}` first")
    # A list of words for the command line.
    overrides = read_yaml(path).get("overrides")
    if not isinstance(overrides, list):
        raise ProductError(f"{path}: damaged (no overrides); delete it and run again")
    return [str(override) for override in overrides]


@command("paper sweep figure")
def sweep_figure(
    kind: Annotated[Literal["parallel", "response"], {"argument": True}],
    definition: File,
    table: File,
    out: File,
) -> None:
    """Draw all points at once (parallel), or the metric against each axis (response).

    In the first figure a point is a line through its value on every axis, coloured by its rank; the
    second has a panel for each axis, with validation and test metric.

    Parameters
    ----------
    kind : str
        Which of the two figures.
    definition : Path
        sweep.yaml of the command `sweep summary`.
    table : Path
        summary.csv of the same.
    out : Path
        PNG.
    """
    sweep_tree = read_yaml(definition)
    # Axes as text: they may be numbers or names of options.
    table_of_points = read_table(table, dtype=dict.fromkeys(sweep_tree["space"], str))
    points = sweep_figures.SweepPoints(table_of_points, sweep_tree)
    # Both figures take the same points.
    draw = {
        "parallel": sweep_figures.draw_parallel_coordinates,
        "response": sweep_figures.draw_response_curves,
    }[kind]
    write_png(draw(points), out)
