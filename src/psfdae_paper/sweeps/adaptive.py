"""Adaptive search by Optuna, one process per trial.

Inputs: the axes of a sweep and the results of earlier trials. Output: the values of the next trial.
They follow only from the results of earlier trials, which are files of the workflow: each process
makes a new study and adds these results to it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from psfdae.base.rng import stream
from psfdae_paper.configuration.sweep import Axis, Value
from psfdae_paper.sweeps.points import round_value

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution


def ask(
    space: Mapping[str, Axis],
    search: Mapping[str, Any],
    slot: int,
    earlier_results: Sequence[Mapping[str, Any]],
) -> dict[str, Value]:
    """Propose values of all axes: at random at first, then by a Parzen estimator (TPE).

    Bergstra et al. (2011), *Algorithms for hyper-parameter optimization*, as
    implemented by Optuna.

    Parameters
    ----------
    space : mapping of str to Axis
        Axes by name.
    search : mapping
        seed, startup, metric and direction of the sweep.
    slot : int
        Number of the trial.
    earlier_results : sequence of mappings
        slot, values, status and metrics of earlier trials.

    Returns
    -------
    dict
        Value by axis. It does not depend on the order of the results.
    """
    import optuna
    from optuna.trial import TrialState, create_trial

    # A seed of its own for each trial: proposals do not repeat.
    seed = int(stream(search["seed"], "sweep", "trial", slot).integers(2**31))
    # Without this, Optuna writes a message for each trial.
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    # The sampler draws `startup` trials at random, then where the Parzen estimator of good trials
    # is large compared with the estimator of the others.
    study = optuna.create_study(
        direction=search["direction"],
        sampler=optuna.samplers.TPESampler(seed=seed, n_startup_trials=search["startup"]),
    )
    # Earlier trials in the order of their numbers, so that the study is always the same.
    for result in sorted(earlier_results, key=lambda result: result["slot"]):
        # A trial that was stopped early has metrics like one that was trained to its end.
        has_metrics = result["status"] in ("finished", "stopped")
        values = result["values"]
        trial = create_trial(
            state=TrialState.COMPLETE if has_metrics else TrialState.FAIL,
            value=float(result["metrics"][search["metric"]]) if has_metrics else None,
            params={name: _to_optuna(axis, values[name]) for name, axis in space.items()},
            distributions=_distributions(space),
        )
        study.add_trial(trial)
    # Options come back as JSON, numbers of a range are rounded like random draws.
    parameters = study.ask(_distributions(space)).params
    return {
        name: json.loads(parameters[name]) if axis.options else round_value(axis, parameters[name])
        for name, axis in space.items()
    }


def _distributions(space: Mapping[str, Axis]) -> dict[str, BaseDistribution]:
    """Return Optuna's distributions of the axes: categories, whole numbers, or a range."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    # Whole numbers and logarithmic ranges as the axis says.
    distributions: dict[str, BaseDistribution] = {}
    for name, axis in space.items():
        if axis.options:
            options = [_to_optuna(axis, option) for option in axis.options]
            distributions[name] = CategoricalDistribution(options)
        elif axis.integer:
            # Both ends belong to the range, as in `draws`.
            low, high = map(int, axis.ends)
            distributions[name] = IntDistribution(low, high, log=axis.log)
        else:
            distributions[name] = FloatDistribution(*axis.ends, log=axis.log)
    return distributions


def _to_optuna(axis: Axis, value: Any) -> Any:
    """Return a value for Optuna's storage; options, which may be lists, as JSON."""
    return json.dumps(value) if axis.options else value
