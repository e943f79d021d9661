"""Models of runs in MLflow: logged with their runs, and registered by dataset and method."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from psfdae_paper import mlflow_model
from psfdae_paper.tracking import MODEL, Run

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities.model_registry import ModelVersion

BEST = "best"
"""Alias of a version; see `choose_best`."""

TEST_MSE = "test_mse"
"""Tag of a version, and metric of its run: the mean over all noise levels."""

EXAMPLE = {"artifact_path": "input_example.json", "type": "ndarray", "format": "tf-serving"}
"""How MLflow finds what shows the input of a model."""


def log_model(client: MlflowClient, experiment: str, run_id: str, record: Run) -> str | None:
    """Log the model of a run with all its files; its id, or None if the run has no model.

    One that restores lone stamps is such that `mlflow.pyfunc` loads it, and says what it takes.
    """
    from mlflow.entities import LoggedModelOutput

    files = {name: path for name, path in record.files.items() if name.startswith(MODEL)}
    if not files:
        return None
    name = registered_name(record)
    made = client.create_logged_model(experiment, name, run_id, model_type=record.kind)
    model_id: str = made.model_id
    client.log_outputs(run_id, [LoggedModelOutput(model_id, 0)])
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary, "files")
        link(files, folder, MODEL)
        if record.fit is not None and record.data is not None:
            example = mlflow_model.write_model(
                record.fit, record.data, record.reference, name, folder
            )
            folder = _loadable(folder, example, run_id, model_id)
        client.log_model_artifacts(model_id, str(folder))
    client.finalize_logged_model(model_id, "READY")
    return model_id


def link(files: Mapping[str, Path], folder: Path, prefix: str = "") -> None:
    """Links to files in a folder, by their names without a prefix."""
    for name, path in files.items():
        place = folder / name.removeprefix(prefix)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(path.resolve())


def registered_name(record: Run) -> str:
    """Name of the models of a dataset and method."""
    return f"{record.dataset}-{record.kind}"


def register(client: MlflowClient, run_id: str, model_id: str, record: Run) -> None:
    """Make the logged model of a run a version of the models of its dataset and method."""
    name = registered_name(record)
    if not client.search_registered_models(f"name = '{name}'"):
        about = f"PSFs of stamps of {record.dataset}, restored by {record.kind}."
        client.create_registered_model(name, description=about)
    tags = {"split": record.split, "reference": record.reference}
    if TEST_MSE in record.metrics:
        tags[TEST_MSE] = f"{record.metrics[TEST_MSE]:.6g}"
    place = client.get_logged_model(model_id).artifact_location
    client.create_model_version(name, place, run_id, tags, model_id=model_id)


def choose_best(client: MlflowClient, name: str) -> None:
    """Give the alias to that version which errs least on its test stars.

    Those of runs that are superseded do not count. Errors to templates are of another truth than
    errors to realisations; they count if there are no others.
    """
    counting = [
        version
        for version in client.search_model_versions(f"name = '{name}'")
        if TEST_MSE in version.tags
        and client.get_run(str(version.run_id)).data.tags.get("superseded") != "true"
    ]
    if counting:
        best = min(counting, key=_rank)
        if BEST not in best.aliases:
            client.set_registered_model_alias(name, BEST, best.version)


def forget(client: MlflowClient, run_id: str) -> None:
    """Delete a run with its models."""
    for version in client.search_model_versions(f"run_id = '{run_id}'"):
        client.delete_model_version(version.name, version.version)
    outputs = client.get_run(run_id).outputs
    for output in outputs.model_outputs if outputs else ():
        client.delete_logged_model(output.model_id)
    client.delete_run(run_id)


def _rank(version: ModelVersion) -> tuple[bool, float]:
    return version.tags["reference"] == "template", float(version.tags[TEST_MSE])


def _loadable(files: Path, stamp: np.ndarray, run_id: str, model_id: str) -> Path:
    """Return a folder that `mlflow.pyfunc` loads, with all files of one that has a bundle.

    Not by `mlflow.pyfunc.save_model`, which looks at all files of all installed packages.
    """
    from mlflow.models import Model, ModelSignature
    from mlflow.pyfunc import add_to_model
    from mlflow.types import Schema, TensorSpec

    folder, side = files.with_name("loadable"), stamp.shape[-1]
    folder.mkdir()
    files.rename(folder / "data")
    example = json.dumps(stamp.tolist())
    (folder / EXAMPLE["artifact_path"]).write_text(example, encoding="utf-8")
    stamps = Schema([TensorSpec(np.dtype(np.float32), (-1, side, side))])
    signature = ModelSignature(stamps, stamps)
    model = Model(
        run_id=run_id, model_id=model_id, signature=signature, saved_input_example_info=EXAMPLE
    )
    add_to_model(model, loader_module=mlflow_model.__name__, data="data")  # type: ignore[no-untyped-call]
    model.save(str(folder / "MLmodel"))
    return folder
