"""Stages `sweep summary`, `sweep figure` and `best`: tables and figures of a sweep's points.

Input: the results of all points. Outputs: their table and study, the best point as overrides, the
cost of each training, and figures. The best point is chosen without errors on the test part.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import pandas as pd
import yaml

from psfdae.base.figures import write_png
from psfdae.base.files import ProductError, as_yaml, write_csv, write_text
from psfdae.base.options import File, Folder
from psfdae.base.reading import read_json, read_yaml
from psfdae.base.settings import as_overrides
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.sweep import Sweep
from psfdae_paper.sweeps.figures import draw_sweep
from psfdae_paper.sweeps.measurement import read_cost
from psfdae_paper.sweeps.points import SweepError, plan_sweep
from psfdae_paper.sweeps.study import create_study, drop_times, read_study


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
        Folder for summary.csv, cost.csv, best.yaml, sweep.yaml and study.journal.
    overrides : sequence of str
        Words of Hydra with which the sweep was planned.
    """
    plan = plan_sweep(name, overrides)
    # Points in the order of the plan, not in the order in which they ended.
    files = [points / point / "result.json" for point in plan.points]
    tabulate_points(name, plan.sweep, overrides, files, out)


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
    name: str, sweep: Sweep, overrides: Sequence[str], points: Sequence[Path], out: Path
) -> None:
    """Tabulate the points of a sweep and choose the best by its metric.

    Parameters
    ----------
    name : str
        Name of the sweep.
    sweep : Sweep
        Checked sweep.
    overrides : sequence of str
        Overrides of the workflow that all points share, its preset first.
    points : sequence of Path
        `result.json` of every point, in the order of the table.
    out : Path
        Folder for `summary.csv` (point, a column per axis, status, reason, epochs, attempt, best,
        metrics), `cost.csv` (seconds of each training), `best.yaml`, `sweep.yaml`, and
        `study.journal`, the study of Optuna.

    Raises
    ------
    ProductError
        If a result is missing or damaged.
    SweepError
        If no point has a metric.
    """
    # The study of all points is written as a whole: Optuna itself appends to an earlier file.
    results = [read_json(path) for path in points]
    with tempfile.TemporaryDirectory() as temporary:
        journal = Path(temporary, "study.journal")
        study = create_study(sweep, results, name=name, journal=journal)
        write_text(out / journal.name, drop_times(journal.read_text()))
        # Of equal points, the first is the best; without any metric, the sweep has failed.
        try:
            best_result = results[study.best_trial.number]
        except ValueError:
            reason = f"{results[0]['point']}: {results[0]['reason']}"
            message = f"all {len(results)} points of sweep {name} failed; the first, {reason}"
            raise SweepError(message) from None
    definition = sweep.model_dump(exclude_none=True)
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
    kind: Annotated[Literal["parallel", "response", "contours", "importance"], {"argument": True}],
    study: File,
    out: File,
) -> None:
    """Draw the points of a sweep by their validation metric.

    All at once as lines over the axes (parallel), against each axis (response), over each pair of
    axes (contours), or the fraction of the metric's variance by axis (importance).

    Parameters
    ----------
    kind : str
        Which figure; the last two need a sweep of two axes or more.
    study : Path
        study.journal of the command `sweep summary`.
    out : Path
        PNG.
    """
    write_png(draw_sweep(read_study(study), kind), out)
