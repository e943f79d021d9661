"""Tables of runs that MLflow's page of an experiment opens by the links of its description.

MLflow keeps a view that somebody shares as a tag of the experiment, and opens it by an address
with the tag's name. Views are made here in the same form.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING
from urllib.parse import urlencode

from psfdae_paper.tracking import AVERAGED, MODEL, Run

if TYPE_CHECKING:
    from mlflow import MlflowClient

VIEW = "mlflow.sharedViewState."
"""Begins the names of tags that are views."""

NOTE = "mlflow.note.content"
"""Tag with the description of an experiment."""

COMPARED = (*(f"test_{name}" for name in AVERAGED), "best_validation_mse", "validation_mse")
"""Metrics of which each has the same meaning for every run of an experiment."""


def show(client: MlflowClient, experiment: str, records: Sequence[Run]) -> None:
    """Set the views of the records of an experiment, and its description if nobody wrote one."""
    known = dict(client.get_experiment(experiment).tags)
    wanted = {f"{VIEW}{name}": view for name, view in views(records).items()}
    if known.get(NOTE) in (None, note(experiment, {*known})):
        wanted[NOTE] = note(experiment, {*known, *wanted})
    for key, value in wanted.items():
        if known.get(key) != value:
            client.set_experiment_tag(experiment, key, value)


def views(records: Sequence[Run]) -> dict[str, str]:
    """Return the views as MLflow reads them: of all runs, and of each dataset by its name."""
    shown = [r for r in records if any(name.startswith(MODEL) for name in r.files)]
    made = {"all": _view(shown, "")} if shown else {}
    for name in dict.fromkeys(r.dataset for r in shown if r.fit and not r.parent):
        ours = [record for record in shown if record.dataset == name]
        made[name] = _view(ours, f" and tags.dataset = '{name}'")
    return made


def note(experiment: str, tags: set[str]) -> str:
    """Return the description of an experiment in Markdown, with a link to each view."""
    names = sorted(tag.removeprefix(VIEW) for tag in tags if tag.startswith(VIEW))
    links = [f"[{name}]({address(experiment, name)})" for name in names]
    return f"Runs of {', '.join(links)}; docs/compare.md says what the columns mean."


def address(experiment: str, view: str) -> str:
    """Return the address of a view within MLflow's page."""
    # The second word hides pages that are for language models.
    words = {"viewStateShareKey": view, "workflowType": "machine_learning"}
    return f"#/experiments/{experiment}/runs?{urlencode(words)}"


def _view(records: Sequence[Run], only: str) -> str:
    """Return a table of the runs that are not superseded, the least error first."""
    metrics = [name for name in COMPARED if any(name in r.metrics for r in records)]
    metrics = metrics or list(records[0].metrics)[:8]
    axes = dict.fromkeys(f"axes.{key}" for r in records for key in r.config.get("axes", ()))
    columns = [f"params.`{axis}`" for axis in axes] + [f"metrics.`{name}`" for name in metrics]
    state = {
        "searchFilter": f"tags.superseded = 'false'{only}",
        "orderByKey": f"metrics.`{metrics[0]}`",
        "orderByAsc": True,
        "selectedColumns": [*columns, "attributes.`Models`", "attributes.`Dataset`"],
    }
    return json.dumps(state)
