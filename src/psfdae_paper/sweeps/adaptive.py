"""Adaptive search: Optuna's ask and tell, one process per trial.

What a trial asks for follows from the results of earlier trials alone, which are files
of the workflow: each process tells a new study what they were.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from psfdae.rng import stream
from psfdae_paper.configuration.sweep import Axis, Value
from psfdae_paper.sweeps.points import tidy

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial

FINISHED = ("finished", "stopped")
"""States of a point that has a result."""


def ask(
    space: Mapping[str, Axis],
    search: Mapping[str, Any],
    slot: int,
    known: Sequence[Mapping[str, Any]],
) -> dict[str, Value]:
    """Values of all axes for a trial: at random at first, then by a Parzen estimator (TPE).

    Bergstra et al. (2011), *Algorithms for hyper-parameter optimization*, as
    implemented by Optuna.

    Parameters
    ----------
    space : axes by name
    search : mapping
        seed, startup, metric and direction of the sweep.
    slot : int
        Number of the trial.
    known : sequence of mappings
        Results of earlier trials: slot, values, status and metrics.

    Returns
    -------
    dict
        The same for the same arguments, in whatever order the results come.
    """
    import optuna

    seed = int(stream(search["seed"], "sweep", "trial", slot).integers(2**31))
    _silence()
    study = optuna.create_study(
        direction=search["direction"],
        sampler=optuna.samplers.TPESampler(seed=seed, n_startup_trials=search["startup"]),
    )
    for result in sorted(known, key=lambda result: result["slot"]):
        study.add_trial(_trial(space, result, search))
    asked = study.ask(_distributions(space)).params
    return {name: _read(axis, asked[name]) for name, axis in space.items()}


def _trial(
    space: Mapping[str, Axis], result: Mapping[str, Any], search: Mapping[str, Any]
) -> FrozenTrial:
    from optuna.trial import TrialState, create_trial

    done = result["status"] in FINISHED
    return create_trial(
        state=TrialState.COMPLETE if done else TrialState.FAIL,
        value=float(result["metrics"][search["metric"]]) if done else None,
        params={name: _written(axis, result["values"][name]) for name, axis in space.items()},
        distributions=_distributions(space),
    )


def _distributions(space: Mapping[str, Axis]) -> dict[str, BaseDistribution]:
    from optuna.distributions import (
        CategoricalDistribution,
        FloatDistribution,
        IntDistribution,
    )

    found: dict[str, BaseDistribution] = {}
    for name, axis in space.items():
        if axis.options:
            found[name] = CategoricalDistribution([_written(axis, v) for v in axis.options])
        elif axis.integer:
            low, high = map(int, axis.ends)
            found[name] = IntDistribution(low, high, log=axis.log)
        else:
            found[name] = FloatDistribution(*axis.ends, log=axis.log)
    return found


def _written(axis: Axis, value: Any) -> Any:
    """A value as Optuna stores it; lists are text there."""
    return json.dumps(value) if axis.options else value


def _read(axis: Axis, value: Any) -> Any:
    return json.loads(value) if axis.options else tidy(axis, value)


def _silence() -> None:
    """No message of Optuna's for each trial."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
