"""Tables of runs that open by links in the description of an MLflow experiment.

MLflow stores a view of its table of runs that a user shares as a tag of the experiment, and opens
it by an address with the tag's name. This module makes views of runs in the same form.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING
from urllib.parse import urlencode

from psfdae_paper.tracking import TrackedRun, convert_metric

if TYPE_CHECKING:
    from mlflow import MlflowClient


def show(client: MlflowClient, experiment: str, records: Sequence[TrackedRun]) -> None:
    """Set the views of the records of an experiment, and its description if no user wrote one.

    Parameters
    ----------
    client : MlflowClient
        Client of the database or server.
    experiment : str
        Id of the experiment.
    records : sequence of TrackedRun
        Runs that were imported now; views of other datasets stay.
    """
    # MLflow's tags: the description of an experiment, and one for each view.
    description, view = "mlflow.note.content", "mlflow.sharedViewState."
    tags = dict(client.get_experiment(experiment).tags)
    names = {tag.removeprefix(view) for tag in tags if tag.startswith(view)}
    new_views = views(records)
    new_tags = {f"{view}{name}": state for name, state in new_views.items()}
    # A description that is another one than ours is a user's, and stays.
    if tags.get(description) in (None, note(experiment, names)):
        new_tags[description] = note(experiment, {*names, *new_views})
    for key, value in new_tags.items():
        if tags.get(key) != value:
            client.set_experiment_tag(experiment, key, value)


def views(records: Sequence[TrackedRun]) -> dict[str, str]:
    """Return the view of all runs with a model, and the view of each dataset, by name."""
    # A sweep itself lacks a model; its points are not in the view of a dataset.
    with_model = [r for r in records if r.model_files]
    by_name = {"all": _view(with_model, "")} if with_model else {}
    for dataset in dict.fromkeys(r.dataset for r in with_model if r.fit and not r.parent):
        of_dataset = [record for record in with_model if record.dataset == dataset]
        by_name[dataset] = _view(of_dataset, f" and tags.dataset = '{dataset}'")
    return by_name


def note(experiment: str, names: set[str]) -> str:
    """Return the description of an experiment in Markdown, with a link to each of some views."""
    # Addresses of MLflow's pages begin with # and are relative to its server.
    links = []
    for name in sorted(names):
        # The workflow type hides pages that are for language models.
        query = urlencode({"viewStateShareKey": name, "workflowType": "machine_learning"})
        links.append(f"[{name}](#/experiments/{experiment}/runs?{query})")
    return f"Runs of {', '.join(links)}; docs/sweeps.md says what the columns mean."


def _view(records: Sequence[TrackedRun], condition: str) -> str:
    """Return a view as MLflow reads it: runs that are not superseded, the smallest error first.

    `condition` limits the runs further, in the language of MLflow's search.
    """
    # Metrics that have the same meaning for every run; without them, the first eight.
    common = [
        *(f"test_{name}" for name in TrackedRun.averaged_metrics),
        "best_validation_mse",
        "validation_mse",
    ]
    metrics = [name for name in common if any(name in r.metrics for r in records)]
    metrics = metrics or list(records[0].metrics)[:8]
    metrics = list(dict.fromkeys(convert_metric(name, 0.0)[0] for name in metrics))
    # Axes of a sweep come first: its points differ in them.
    axes = dict.fromkeys(f"axes.{key}" for r in records for key in r.config.get("axes", ()))
    columns = [f"params.`{axis}`" for axis in axes] + [f"metrics.`{name}`" for name in metrics]
    state = {
        "searchFilter": f"tags.superseded = 'false'{condition}",
        "orderByKey": f"metrics.`{metrics[0]}`",
        "orderByAsc": True,
        "selectedColumns": [*columns, "attributes.`Models`", "attributes.`Dataset`"],
    }
    return json.dumps(state)
