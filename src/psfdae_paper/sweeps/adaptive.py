"""Adaptive search: Optuna's ask and tell, one process per trial.

What a trial asks for follows from the results of earlier trials alone, which are files
of the workflow. The journal, Optuna's own record of the study, is a view of them that
its tools can open (`optuna-dashboard`); a lost or damaged journal is written again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from psfdae.rng import stream
from psfdae_paper.sweeps.points import tidy

FINISHED = ("finished", "stopped")
"""States of a point that has a result."""


def ask(
    space: Mapping[str, Any],
    search: Mapping[str, Any],
    slot: int,
    known: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Values of all axes for a trial: at random at first, then by a Parzen estimator (TPE).

    Bergstra et al. (2011), *Algorithms for hyper-parameter optimization*, as
    implemented by Optuna.

    Parameters
    ----------
    space : mapping of name to config group `Axis`
    search : mapping
        seed, startup, metric and direction of the sweep; for the journal, also study,
        the name of the study in it.
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
        study.add_trial(_trial(space, result["values"], *_outcome(result, search), result))
    asked = study.ask(_distributions(space)).params
    return {name: _read(axis, asked[name]) for name, axis in space.items()}


def begin(
    journal: Path,
    space: Mapping[str, Any],
    search: Mapping[str, Any],
    about: Mapping[str, Any],
    values: Mapping[str, Any],
    known: Sequence[Mapping[str, Any]],
) -> None:
    """Note a trial as running, and the results of earlier ones that the journal lacks.

    A trial that was interrupted goes on under its number if it asks for the same.

    Parameters
    ----------
    journal : Path
        File of Optuna's journal storage; created if missing, set aside if damaged.
    space, search, known : as for `ask`
    about : mapping
        slot and point of the trial.
    values : mapping
        Result of `ask`.
    """
    from optuna.trial import TrialState

    study = _study(journal, search)
    for result in sorted(known, key=lambda result: result["slot"]):
        _tell(study, space, search, result)
    if _running(study, space, about["slot"], values) is None:
        study.add_trial(_trial(space, values, TrialState.RUNNING, None, about))


def finish(
    journal: Path,
    space: Mapping[str, Any],
    search: Mapping[str, Any],
    results: Sequence[Mapping[str, Any]],
) -> None:
    """Note results of trials, those that are there already excepted.

    Parameters
    ----------
    journal, space, search : as for `begin`
    results : sequence of mappings
        slot, point, values, status and metrics of each.
    """
    study = _study(journal, search)
    for result in results:
        _tell(study, space, search, result)


def _tell(
    study: Any, space: Mapping[str, Any], search: Mapping[str, Any], result: Mapping[str, Any]
) -> None:
    state, value = _outcome(result, search)
    for trial in study.get_trials(deepcopy=False):
        same = trial.user_attrs.get("point") == result["point"]
        if same and (trial.state, trial.value) == (state, value):
            return
    running = _running(study, space, result["slot"], result["values"])
    if running is None:
        study.add_trial(_trial(space, result["values"], state, value, result))
    else:
        study.tell(running.number, value, state)


def _running(
    study: Any, space: Mapping[str, Any], slot: int, values: Mapping[str, Any]
) -> Any | None:
    """The unfinished trial of a slot; others that it has left behind have failed."""
    from optuna.trial import TrialState

    asked = {name: _written(space[name], value) for name, value in values.items()}
    found = None
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        if trial.user_attrs.get("slot") == slot:
            if found is None and trial.params == asked:
                found = trial
            else:
                study.tell(trial.number, state=TrialState.FAIL)
    return found


def _study(journal: Path, search: Mapping[str, Any]) -> Any:
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    _silence()
    journal.parent.mkdir(parents=True, exist_ok=True)
    for attempt in range(2):
        try:
            return optuna.create_study(
                storage=JournalStorage(JournalFileBackend(str(journal))),
                study_name=search["study"],
                direction=search["direction"],
                load_if_exists=True,
            )
        except (ValueError, KeyError) as error:  # a process was killed within a line
            if attempt:
                raise
            print(f"{journal}: damaged ({error}); set aside and written again", flush=True)
            journal.replace(journal.with_name(f"{journal.name}.damaged"))
    raise AssertionError


def _trial(
    space: Mapping[str, Any],
    values: Mapping[str, Any],
    state: Any,
    value: float | None,
    about: Mapping[str, Any],
) -> Any:
    from optuna.trial import create_trial

    return create_trial(
        state=state,
        value=value,
        params={name: _written(axis, values[name]) for name, axis in space.items()},
        distributions=_distributions(space),
        user_attrs={key: about[key] for key in ("slot", "point") if key in about},
    )


def _outcome(result: Mapping[str, Any], search: Mapping[str, Any]) -> tuple[Any, float | None]:
    from optuna.trial import TrialState

    if result["status"] not in FINISHED:
        return TrialState.FAIL, None
    return TrialState.COMPLETE, float(result["metrics"][search["metric"]])


def _distributions(space: Mapping[str, Any]) -> dict[str, Any]:
    from optuna.distributions import (
        CategoricalDistribution,
        FloatDistribution,
        IntDistribution,
    )

    found: dict[str, Any] = {}
    for name, axis in space.items():
        if axis.options:
            found[name] = CategoricalDistribution([_written(axis, v) for v in axis.options])
        elif axis.integer:
            found[name] = IntDistribution(int(axis.low), int(axis.high), log=axis.log)
        else:
            found[name] = FloatDistribution(axis.low, axis.high, log=axis.log)
    return found


def _written(axis: Any, value: Any) -> Any:
    """A value as Optuna stores it; lists are text there."""
    return json.dumps(value) if axis.options else value


def _read(axis: Any, value: Any) -> Any:
    return json.loads(value) if axis.options else tidy(axis, value)


def _silence() -> None:
    """No message of Optuna's for each trial."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
