"""A sweep as a study of Optuna: values from its samplers, results of points as its trials.

The files of the workflow are authoritative: each process makes a study of the results that it
needs, so that values follow from results alone, and a study is stored as a journal.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psfdae.base.files import ProductError
from psfdae.base.rng import stream
from psfdae_paper.configuration.sweep import Axis, Sweep, Value

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.storages import JournalStorage


def create_study(
    sweep: Sweep,
    results: Sequence[Mapping[str, Any]] = (),
    slot: int = 0,
    name: str | None = None,
    journal: Path | None = None,
) -> Study:
    """Make a study of a sweep, with the sampler of its kind and a trial for each result.

    The kinds are every combination, random draws, and the tree-structured Parzen estimator (TPE):
    Bergstra et al. (2011), *Algorithms for hyper-parameter optimization*. The latter draws
    `startup` trials at random, then where the density of good trials is large compared with the
    density of the others.

    Parameters
    ----------
    sweep : Sweep
        Checked sweep.
    results : sequence of mappings
        values and metrics of points, in the order of their trials.
    slot : int
        Number of the trial that is asked for next, which decides the seed of the sampler.
    name : str, optional
        Name of the study.
    journal : Path, optional
        New file that stores the study; in memory without it.
    """
    import optuna
    from optuna import samplers
    from optuna.trial import TrialState, create_trial

    # Without this, Optuna writes a message for each trial.
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    # A seed of its own for each process: proposals do not repeat.
    seed = int(stream(sweep.seed, "sweep", "trial", slot).integers(2**31))
    sampler: samplers.BaseSampler = samplers.RandomSampler(seed)
    if sweep.kind == "grid":
        options = {k: [_to_optuna(v) for v in axis.options] for k, axis in sweep.space.items()}
        sampler = samplers.GridSampler(options, seed)
    elif sweep.kind == "adaptive":
        sampler = samplers.TPESampler(seed=seed, n_startup_trials=sweep.startup)
    study = optuna.create_study(
        storage=open_journal(journal) if journal else None,
        sampler=sampler,
        study_name=name,
        direction=sweep.direction,
    )
    study.set_user_attr("metric", sweep.metric)
    for result in results:
        # A trial that was stopped early has metrics like one that was trained to its end.
        value = result["metrics"].get(sweep.metric, math.nan)
        is_finite = math.isfinite(value)
        trial = create_trial(
            state=TrialState.COMPLETE if is_finite else TrialState.FAIL,
            value=value if is_finite else None,
            params={key: _to_optuna(result["values"][key]) for key in sweep.space},
            distributions=_list_distributions(sweep),
            user_attrs={"point": result["point"], **result["metrics"]},
        )
        study.add_trial(trial)
    return study


def open_journal(path: Path) -> JournalStorage:
    """Open the file of a study."""
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    return JournalStorage(JournalFileBackend(str(path)))


def drop_times(journal: str) -> str:
    """Return a journal without the process and the times that differ between equal sweeps.

    Optuna writes the time of the summary, which says nothing of the trainings.
    """
    records = [json.loads(line) for line in journal.splitlines()]
    for record in records:
        record["worker_id"] = "summary"
        for key in {"datetime_start", "datetime_complete"} & {*record}:
            record[key] = "1970-01-01T00:00:00+00:00"
    return "".join(json.dumps(record, separators=(",", ":")) + "\n" for record in records)


def read_study(path: Path) -> Study:
    """Read the study of a sweep.

    Raises
    ------
    ProductError
        If the file is missing, or no journal of one study.
    """
    import optuna

    # Optuna would make a new file.
    if not path.is_file():
        raise ProductError(f"{path}: missing; `psfdae paper sweep summary` writes it")
    try:
        return optuna.load_study(study_name=None, storage=open_journal(path))
    except (ValueError, KeyError):
        raise ProductError(f"{path}: damaged, or no journal of a study of Optuna") from None


def list_values(sweep: Sweep) -> list[dict[str, Value]]:
    """Return the values of all axes at each point of a grid, or of random draws.

    A grid is in the order of its axes, the last one fastest. More draws extend the list.
    """
    study, space = create_study(sweep), sweep.space
    count = sweep.trials or math.prod(len(axis.options) for axis in space.values())
    values = [ask(study, sweep) for _ in range(count)]
    # Optuna shuffles a grid.
    if sweep.kind == "grid":
        values.sort(key=lambda point: [axis.options.index(point[k]) for k, axis in space.items()])
    return values


def ask(study: Study, sweep: Sweep) -> dict[str, Value]:
    """Return the values of all axes that the sampler of a study proposes for its next trial.

    Options are as the axis has them, numbers of a range have four significant digits: enough for a
    search, and the same on all processors.
    """
    values: dict[str, Value] = {}
    for name, value in study.ask(_list_distributions(sweep)).params.items():
        axis = sweep.space[name]
        if axis.options:
            values[name] = next(v for v in axis.options if _to_optuna(v) == value)
        elif axis.integer:
            values[name] = int(value)
        else:
            # Rounding may leave the range by half a digit.
            values[name] = min(max(float(f"{value:.4g}"), axis.ends[0]), axis.ends[1])
    return {name: values[name] for name in sweep.space}


def _list_distributions(sweep: Sweep) -> dict[str, BaseDistribution]:
    """Return Optuna's distributions of the axes: categories, whole numbers, or a range."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    distributions: dict[str, BaseDistribution] = {}
    for name, axis in sweep.space.items():
        ends, log, integer = _find_range(axis, sweep.kind)
        if not ends:
            distributions[name] = CategoricalDistribution([_to_optuna(v) for v in axis.options])
        elif integer:
            distributions[name] = IntDistribution(int(ends[0]), int(ends[1]), log=log)
        else:
            distributions[name] = FloatDistribution(ends[0], ends[1], log=log)
    return distributions


def _find_range(axis: Axis, kind: str) -> tuple[tuple[float, ...], bool, bool]:
    """Return the ends of a range, () for options; whether it is logarithmic, and of integers.

    Numbers of a grid are points of a range, so that figures show their distances: on a logarithmic
    scale if the largest is 5 times the smallest or more.
    """
    if not axis.options:
        return axis.ends, axis.log, axis.integer
    numbers = [v for v in axis.options if isinstance(v, int | float) and not isinstance(v, bool)]
    if kind != "grid" or len(numbers) < len(axis.options):
        return (), False, False
    ends = min(numbers), max(numbers)
    return ends, 0 < 5 * ends[0] <= ends[1], all(isinstance(v, int) for v in numbers)


def _to_optuna(value: Value) -> Any:
    """Return a value as Optuna stores it: lists as JSON."""
    return json.dumps(value, separators=(",", ":")) if isinstance(value, list) else value
