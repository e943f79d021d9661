"""Stage `scaling`: what runs far past one machine cost, from measurements on this one.

`stages` measures the jobs that grow with the stars, `dag` what Snakemake needs for large
workflows, `plan` predicts from both. CPU time is what counts, so that other work on the
machine disturbs little.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from psfdae.benchmark import cost, dag
from psfdae.benchmark.isolated import run_isolated
from psfdae.benchmark.scaling import fit_power_law
from psfdae.configuration.compose import config_dir
from psfdae.files import ProductError, write_text
from psfdae.reading import read_table
from psfdae.stages import scaling_jobs as jobs

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd

ASKED = {"stars": 1e9, "models": 1e4, "points": 1e5}
"""Sizes that the plan is made for: stars, networks with stars of their own, points of a sweep."""

START_S = 10.0
"""CPU time that the start of a job may take; larger workflows are run in parts."""

TRAINED_EPOCHS = 1
"""Epochs of the measured trainings; the cost of more is that of their stars times epochs."""

SIMULATED = 2
"""Simulation and prediction are measured at this many of the smallest numbers of stars."""


def stages(config: Any, out: Path) -> None:
    """Cost of every stage that grows with the number of stars, on one CPU.

    Parameters
    ----------
    config : stage config `scaling`; the numbers are benchmark.star_counts
    out : CSV, columns stage, stars, epochs, time_s, cpu_s, peak_mb (of the whole process),
        disk_mb
    """
    counts = config.benchmark.star_counts
    rows: list[dict[str, Any]] = []
    with TemporaryDirectory() as name, one_cpu():
        folder = Path(name)
        stars, dae = folder / "simulated.h5", folder / "dae"
        templates = folder / "templates.h5"
        run_isolated(
            jobs.make_templates, config.optics.threads, config=_tree(config, 0), out=str(templates)
        )

        def measure(function: Any, count: int, **paths: Path) -> None:
            paths_as_text = {key: str(path) for key, path in paths.items()}
            tree = _tree(config, count)
            threads = config.optics.threads if function is jobs.simulate else 1
            costs = run_isolated(function, threads, config=tree, **paths_as_text)
            epochs = TRAINED_EPOCHS if function is jobs.train else 0
            rows.append({"stage": function.__name__, "stars": count, "epochs": epochs, **costs})

        for count in counts[:SIMULATED]:
            measure(jobs.simulate, count, templates=templates, out=stars)
        repeated, pca_som = folder / "stars.h5", folder / "pca_som.h5"
        for i, count in enumerate(counts):
            run_isolated(jobs.repeat_stars, 1, stars=str(stars), count=count, out=str(repeated))
            measure(jobs.baseline, count, stars=repeated, out=pca_som)
            measure(jobs.train, count, stars=repeated, out=dae)
            measure(
                jobs.evaluate,
                count,
                stars=repeated,
                pca_som=pca_som,
                dae=dae,
                out=folder / f"evaluation{i}",
            )
            if i < SIMULATED:
                measure(jobs.predict, count, dae=dae, stars=repeated, out=folder / "psf.h5")
    _write(out, rows)


def _tree(config: Any, stars: int) -> dict[str, Any]:
    """The config for a number of stars, four fifths of them for training."""
    tree: dict[str, Any] = config.model_dump()
    if stars:
        train = 4 * stars // 5
        tree["stars"]["count"] = stars
        tree["parts"] |= {"train_stars": train, "test_stars": stars - train}
    tree["train"]["epochs"] = TRAINED_EPOCHS
    return tree


@contextmanager
def one_cpu() -> Iterator[None]:
    """Keep this process and those it starts on one CPU, as a job of the SLURM profile is."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


def dag_times(snakefile: Path, counts: Sequence[int], out: Path) -> None:
    """Time of a dry run over the number of datasets, and of points of a sweep.

    Parameters
    ----------
    snakefile : of the workflow
    counts : numbers of jobs, roughly
    out : CSV, columns kind, count, rule, jobs (all rules: rule "total"), plan_s, plan_cpu_s,
        peak_mb, start_s, start_cpu_s
    """
    rows = []
    for kind in dag.KINDS:
        per_unit = JOBS_PER_UNIT[kind]
        sizes = sorted({max(1, round(count / per_unit)) for count in counts})
        for measured in dag.measure(snakefile.resolve(), config_dir(), kind, sizes):
            by_rule = measured.pop("by_rule")
            total = {"rule": "total", "jobs": measured.pop("jobs")}
            key = {"kind": measured.pop("kind"), "count": measured.pop("count")}
            rows.append({**key, **total, **measured})
            rows += [{**key, "rule": rule, "jobs": n} for rule, n in by_rule.items()]
    _write(out, rows)


JOBS_PER_UNIT = {"models": 11, "points": 1}
"""Jobs of a dataset of one network, and of a point; only to choose sizes."""


def plan(
    config: Any,
    tables: Mapping[str, Path],
    results: Path,
    home: Sequence[str],
    site: cost.Site,
    out: Path,
    limits: Path,
) -> None:
    """Core-hours, storage and jobs of the sizes of `ASKED`, and what breaks first.

    Parameters
    ----------
    config : stage config `scaling`
    tables : CSVs by name: "stages" and "dag" of this stage, "runtime" of the workflow
    results : folder of a finished run, whose files are counted
    home : rules that run beside snakemake
    site : limits of the cluster
    out : CSV, columns case, asked, per_dag, rule, jobs, core_h, storage_gb, longest_h,
        memory_gb, submit
    limits : CSV, columns case, where, limit, allowed, reached_at, asked, breaks

    Raises
    ------
    ProductError
        If a table or the finished run is missing.
    CostError
        If a table allows no prediction.
    """

    for path in tables.values():
        if not path.is_file():
            raise ProductError(f"{path}: missing; run `snakemake scaling` first")
    read = {name: read_table(path) for name, path in tables.items()}
    measured = stage_lines(read["stages"])
    planning = {kind: planning_of(read["dag"], kind) for kind in dag.KINDS}
    network = footprint(results)
    stars, epochs = config.stars.count, config.train.epochs
    whole = {**measured, "train": _epochs(measured["train"], epochs)}
    costs = _job_costs(whole, read["runtime"], stars)

    rows = cost.stars_case(ASKED["stars"], measured, site, whole["train"], stars)
    found = cost.stars_limits(ASKED["stars"], whole, site)
    for case in dag.KINDS:
        # A model has stars of its own; points share theirs.
        stored = costs["stars"][1] if case == "models" else 0.0
        own = point_footprint(results, network) if case == "points" else network
        each = cost.Footprint(own.files, own.storage_bytes + stored)
        more, more_limits = _dag_plan(case, planning[case], costs, each, site)
        rows += more
        found += more_limits
    start = planning["models"].start_s.fixed
    for row in rows:
        row["asked"] = ASKED[row["case"]]
        row["submit"] = cost.submission(row, frozenset(home), start)
    found.sort(key=lambda row: (list(ASKED).index(row["case"]), row["reached_at"]))
    _write(out, rows)
    _write(limits, found)


def _dag_plan(
    case: str,
    planning: cost.Planning,
    costs: Mapping[str, tuple[float, float, float]],
    each: cost.Footprint,
    site: cost.Site,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows and limits of a run whose DAG grows, in parts whose jobs start soon enough."""
    asked = ASKED[case]
    steps = cost.dag_case(case, asked, planning, costs)
    total = sum(row["jobs"] for row in steps)
    work = sum(row["core_h"] for row in steps) * cost.HOUR / total
    share = min(asked, cost.count_per_dag(planning, START_S))
    starts = {**cost.snakemake_row(case, total, share, planning), "per_dag": share}
    return [*steps, starts], cost.dag_limits(case, asked, planning, each, work, site)


def stage_lines(table: pd.DataFrame) -> dict[str, cost.Stage]:
    """The lines of every stage of the table of `stages`; training per epoch."""
    lines = {}
    for name, part in table.groupby("stage", sort=False):
        x = part["stars"].to_numpy(float)
        lines[str(name)] = cost.Stage(
            seconds=cost.fit_line(x, part["cpu_s"].to_numpy()),
            memory_bytes=cost.fit_line(x, cost.MB * part["peak_mb"].to_numpy()),
            storage_bytes=cost.fit_line(x, cost.MB * part["disk_mb"].to_numpy()),
        )
    return lines


def _epochs(stage: cost.Stage, epochs: int) -> cost.Stage:
    """A training of more epochs than were measured."""
    factor = epochs / TRAINED_EPOCHS
    seconds = cost.Line(stage.seconds.fixed, factor * stage.seconds.slope)
    return cost.Stage(seconds, stage.memory_bytes, stage.storage_bytes)


def planning_of(table: pd.DataFrame, kind: str) -> cost.Planning:
    """What Snakemake costs, from the table of `dag_times`."""
    part = table[table["kind"] == kind].sort_values("count")
    total = part[part["rule"] == "total"]
    x = total["count"].to_numpy(float)
    by_rule = {
        str(rule): _jobs_of(jobs_of["count"].to_numpy(float), jobs_of["jobs"].to_numpy(float))
        for rule, jobs_of in part[part["rule"] != "total"].groupby("rule", sort=False)
    }
    return cost.Planning(
        seconds=fit_power_law(x, total["plan_cpu_s"].to_numpy()),
        start_s=cost.fit_line(x, total["start_cpu_s"].to_numpy()),
        memory_bytes=cost.fit_line(x, cost.MB * total["peak_mb"].to_numpy()),
        jobs=by_rule,
    )


def _jobs_of(count: np.ndarray, number: np.ndarray) -> cost.Line:
    """Jobs of a rule over the number of units: those that are there once, and those of each.

    The two largest sizes tell, which differ in nothing but their number of units.
    """
    if count.size < 2:
        return cost.Line(float(number[0]), 0.0)
    slope = (number[-1] - number[-2]) / (count[-1] - count[-2])
    return cost.Line(float(number[-1] - slope * count[-1]), float(slope))


def footprint(results: Path) -> cost.Footprint:
    """Files and bytes of a finished run per trained network, without what is shared.

    Raises
    ------
    ProductError
        If the folder has no trained network.
    """
    networks = len(list(results.glob("dae/*/*/dae.safetensors")))
    if not networks:
        raise ProductError(f"{results}: no trained network; run `snakemake scene1` first")
    shared = {"data", "reference", "mlartifacts", "mlflow.db", "alignment", "bounds", "knee"}
    shared |= {"sweeps", "benchmark"}
    files = [
        path
        for path in results.rglob("*")
        if path.is_file() and path.relative_to(results).parts[0] not in shared
    ]
    size = sum(path.stat().st_size for path in files)
    return cost.Footprint(len(files) / networks, size / networks)


def point_footprint(results: Path, network: cost.Footprint) -> cost.Footprint:
    """Files and bytes of a point of a sweep, its log and benchmark among them.

    A run without a sweep leaves only a network to judge by.
    """
    points = list(results.glob("sweeps/*/points/*/result.json"))
    if not points:
        return network
    files = [path for point in points for path in point.parent.iterdir() if path.is_file()]
    size = sum(path.stat().st_size for path in files)
    return cost.Footprint(len(files) / len(points) + 2, size / len(points))


def _job_costs(
    lines: Mapping[str, cost.Stage], runtime: pd.DataFrame, stars: int
) -> dict[str, tuple[float, float, float]]:
    """Seconds, bytes on disk and memory of one job of every rule, at the configured stars.

    The rules that grow with the stars come from their lines, the others from the record of
    what they have cost; a point of a sweep is a training and its evaluation.
    """
    costs = {}
    for rule, part in runtime.groupby("rule"):
        memory = cost.MB * float(part["peak_mb"].max())
        costs[str(rule)] = (float(part["wall_s"].median()), 0.0, memory)
    names = {"stars": "simulate", "baseline": "baseline", "train": "train", "evaluate": "evaluate"}
    for rule, name in names.items():
        stage = lines[name]
        costs[rule] = stage.seconds(stars), stage.storage_bytes(stars), stage.memory_bytes(stars)
    point, test = costs["train"], costs["evaluate"]
    costs["sweep_point"] = point[0] + test[0], point[1] + test[1], max(point[2], test[2])
    return costs


def _write(out: Path, table: Any) -> None:
    import pandas as pd

    write_text(out, pd.DataFrame(table).to_csv(index=False, float_format="%.6g"))
