"""Points of sweeps: their files, their data, threads and code."""

from __future__ import annotations

from functools import cache

from psfdae.methods import method
from psfdae_paper.configuration.estimators import list_swept_networks
from psfdae_paper.configuration.sweep import find_sweeps
from psfdae_paper.source import source_hash
from psfdae_paper.sweeps.figures import ALL_AXES, TWO_AXES
from psfdae_paper.sweeps.points import Plan, Point, SweepError, plan_sweep
from psfdae_paper.workflow.alignment import training_states
from psfdae_paper.workflow.datasets import stars_file
from psfdae_paper.workflow.run import Run, Wildcards, exit_in_one_line


@cache
@exit_in_one_line()
def sweep_plan(run: Run, name: str) -> Plan:
    """Return the points of a sweep; a wrong key ends the program."""
    # Composing all points is slow, and several rules need them: the plan is cached.
    plan = plan_sweep(name, run.overrides)
    # Points are computed once, and checked here.
    assert plan.points
    return plan


@exit_in_one_line()
def sweep_point(run: Run, wildcards: Wildcards) -> Point:
    """Return the point of a job; a name that the sweep does not have ends the program."""
    # The name of a point is a hash of its settings: an edited sweep no longer has it.
    points = sweep_plan(run, wildcards.sweep).points
    if wildcards.point not in points:
        raise SweepError(f"sweep {wildcards.sweep} has no point {wildcards.point}")
    return points[wildcards.point]


def result_file(run: Run, sweep: str, point: str) -> str:
    """Return the result of a point."""
    return f"{run.results}/sweeps/{sweep}/points/{point}/result.json"


def sweep_data(run: Run, name: str) -> dict[str, str]:
    """Return the products that all points of a sweep share, by role."""
    sweep = sweep_plan(run, name).sweep
    # Networks of scene 3 train on states, all other models on stars of a dataset.
    if sweep.dataset:
        return {"stars": stars_file(run, sweep.dataset)}
    folder = f"{run.results}/data/alignment"
    return {
        "states": training_states(run, sweep.model),
        "validation": f"{folder}/validation.h5",
        "test": f"{folder}/uniform.h5",
    }


def known_results(run: Run, wildcards: Wildcards) -> list[str]:
    """Return the results from which the values of an adaptive sweep's trial are proposed."""
    earlier = sweep_plan(run, wildcards.sweep).earlier_trials(sweep_point(run, wildcards))
    return [result_file(run, wildcards.sweep, point.name) for point in earlier]


def point_threads(run: Run, wildcards: Wildcards) -> int:
    """Return the threads of a point: the largest number of its groups of settings."""
    config = sweep_point(run, wildcards).config
    # Threads are a setting of several groups, such as the training and the evaluation.
    groups = [group for group in config.values() if isinstance(group, dict)]
    return max(int(group.get("threads", 1)) for group in groups)


@cache
def sweep_code(run: Run, name: str) -> str:
    """Return the hash of a point's code, with the code of its model."""
    # Imports pandas, for which a run without sweeps would wait.
    from psfdae_paper.stages.sweep import training_module

    sweep = sweep_plan(run, name).sweep
    modules = [] if sweep.model in list_swept_networks() else [method(sweep.model).__module__]
    return source_hash("sweep point", training_module(sweep.model), *modules)


def sweep_results(run: Run, name: str) -> list[str]:
    """Return the results of all points of a sweep."""
    return [result_file(run, name, point) for point in sweep_plan(run, name).points]


def sweep_figures(run: Run, name: str) -> list[str]:
    """Return the figures of a sweep."""
    kinds = ALL_AXES + TWO_AXES * (len(sweep_plan(run, name).sweep.space) > 1)
    return [f"{run.results}/sweeps/{name}/figures/{kind}.png" for kind in kinds]


@exit_in_one_line()
def sweep_products(run: Run) -> list[str]:
    """Return all files that the target sweep builds."""
    name = run.sweep
    if not name:
        names = ", ".join(sorted(find_sweeps()))
        raise SweepError(f"which sweep? --config sweep=NAME, one of {names}")
    sweep_plan(run, name)
    return [
        *(f"{run.results}/sweeps/{name}/{file}" for file in ("summary.csv", "best.yaml")),
        *sweep_figures(run, name),
        f"{run.results}/mlflow/sweep_{name}.csv",
    ]
