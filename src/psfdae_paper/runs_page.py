"""What MLflow's page of an experiment shows: its description, and tables made to compare runs.

MLflow keeps a view that somebody shares as a tag of the experiment, and opens it by an address
with the tag's name. Views are made here in the same form.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING
from urllib.parse import urlencode

from psfdae_paper.tracking import AVERAGED, MODEL, Run

if TYPE_CHECKING:
    from mlflow import MlflowClient

VIEW = "mlflow.sharedViewState."
"""Begins the names of tags that are views."""

ALL = "all"
"""The view of all runs of an experiment; the others have the names of datasets."""

KIND = {"mlflow.experimentKind": "custom_model_development"}
"""Tag by which MLflow opens the runs of an experiment and not its pages for language models."""

MODE = {"workflowType": "machine_learning"}
"""Part of an address that hides what is for language models."""

NOTE = "mlflow.note.content"

NAME_PX, NUMBER_PX = 280, 120
"""Widths of columns: a name says dataset, split, reference and method of a run."""

COMPARED = (*(f"test_{name}" for name in AVERAGED), "best_validation_mse", "validation_mse")
"""Metrics of which each has the same meaning for every run of an experiment."""

MOST = 8
"""Metrics of an experiment that has none of these."""

ABOUT = {
    "scene1": "Scene 1: a wide-field telescope with aberrations that depend on the field.",
    "scene2": "Scene 2: a telescope in turbulence.",
    "scene3": "Scene 3: alignment of a secondary mirror.",
}


def show(client: MlflowClient, experiment: str, records: Sequence[Run]) -> None:
    """Set the tags of the experiment of some records, where they differ.

    Records without a model are in its tables, but do not shape them.
    """
    found = client.get_experiment(experiment)
    known = dict(found.tags)
    wanted = {f"{VIEW}{name}": view for name, view in views(records).items()}
    # Somebody may have written another description, or chosen another kind.
    if known.get(NOTE) in (None, note(found.name, experiment, {*known})):
        wanted[NOTE] = note(found.name, experiment, {*known, *wanted})
    wanted |= {key: kind for key, kind in KIND.items() if key not in known}
    for key, value in wanted.items():
        if known.get(key) != value:
            client.set_experiment_tag(experiment, key, value)


def views(records: Sequence[Run]) -> dict[str, str]:
    """Views of records by name, as MLflow reads them."""
    shaping = [r for r in records if any(name.startswith(MODEL) for name in r.files)]
    if not shaping:
        return {}
    made = {ALL: _view(shaping, "")}
    if not any(record.parent for record in shaping):
        for name in dict.fromkeys(r.dataset for r in shaping if r.data is not None and r.fit):
            own = [record for record in shaping if record.dataset == name]
            levels = sorted({key for r in own for key in r.metrics if _at_level(key)})
            made[name] = _view(own, f" and tags.dataset = '{name}'", levels)
    return made


def note(name: str, experiment: str, tags: set[str]) -> str:
    """The description of an experiment in Markdown, from the names of its tags."""
    datasets = sorted(tag.removeprefix(VIEW) for tag in tags if tag.startswith(VIEW))
    links = [f"[{d}]({address(experiment, d)})" for d in datasets if d != ALL]
    return "\n\n".join(
        [
            ABOUT.get(name, f"Runs of {name}."),
            f"[All runs]({address(experiment, ALL)})"
            + (f", or those of one dataset: {', '.join(links)}." if links else "."),
            "What the columns mean: `docs/compare.md`, section *In the browser*.",
        ]
    )


def address(experiment: str, view: str) -> str:
    """Of a view, within MLflow's page."""
    return f"#/experiments/{experiment}/runs?{urlencode({'viewStateShareKey': view, **MODE})}"


def _view(records: Sequence[Run], only: str, more: Sequence[str] = ()) -> str:
    """Runs that are not superseded, the least error first, with the columns that differ."""
    metrics = [name for name in COMPARED if any(name in r.metrics for r in records)]
    if not metrics:
        metrics = [name for name in records[0].metrics if "stderr" not in name][:MOST]
    axes = dict.fromkeys(f"axes.{key}" for r in records for key in r.config.get("axes", ()))
    numbers = [_column("params", axis) for axis in axes]
    numbers += [_column("metrics", metric) for metric in (*metrics, *more)]
    selected = [*numbers, *(_column("attributes", key) for key in ("Models", "Dataset"))]
    name = _column("attributes", "Run Name")
    state = {
        "searchFilter": f"tags.superseded = 'false'{only}",
        "orderByKey": _column("metrics", metrics[0]),
        "orderByAsc": True,
        "selectedColumns": selected,
        "columnOrder": [name, *selected],
        "columnWidths": {name: NAME_PX, **dict.fromkeys(numbers, NUMBER_PX)},
    }
    return json.dumps(state)


def _column(kind: str, name: str) -> str:
    return f"{kind}.`{name}`"


def _at_level(metric: str) -> bool:
    return re.fullmatch(r"test_mse_[^a-z]\S*", metric) is not None
