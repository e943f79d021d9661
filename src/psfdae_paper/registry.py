"""Models of runs in MLflow, logged with their runs and registered by dataset and method."""

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

TEST_MSE = "test_mse"
"""Tag of a version, and metric of its run: the mean over all noise levels."""


def log_model(client: MlflowClient, experiment: str, run_id: str, record: Run) -> str | None:
    """Log the model of a run with all its files; return its id, or None if the run has no model.

    `mlflow.pyfunc` can load a model that restores single stamps; its signature and an example
    describe its input.
    """
    from mlflow.entities import LoggedModelOutput

    # A run without files of a model, such as a sweep, has nothing to log.
    files = {name: path for name, path in record.files.items() if name.startswith(MODEL)}
    if not files:
        return None
    name = registered_name(record)
    logged = client.create_logged_model(experiment, name, run_id, model_type=record.kind)
    model_id: str = logged.model_id
    client.log_outputs(run_id, [LoggedModelOutput(model_id, 0)])
    # MLflow copies a folder; links in it save a copy of large files.
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
    """Make links to files in a folder, by their names without a prefix."""
    for name, path in files.items():
        target = folder / name.removeprefix(prefix)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(path.resolve())


def registered_name(record: Run) -> str:
    """Return the name of the models of a dataset and method."""
    return f"{record.dataset}-{record.kind}"


def register(client: MlflowClient, run_id: str, model_id: str, record: Run) -> None:
    """Make the logged model of a run a version of the models of its dataset and method."""
    name = registered_name(record)
    if not client.search_registered_models(f"name = '{name}'"):
        description = f"PSFs of stamps of {record.dataset}, restored by {record.kind}."
        client.create_registered_model(name, description=description)
    tags = {"split": record.split, "reference": record.reference}
    if TEST_MSE in record.metrics:
        tags[TEST_MSE] = f"{record.metrics[TEST_MSE]:.6g}"
    location = client.get_logged_model(model_id).artifact_location
    client.create_model_version(name, location, run_id, tags, model_id=model_id)


def choose_best(client: MlflowClient, name: str) -> None:
    """Give the alias "best" to the version with the smallest error on its test stars.

    Versions of superseded runs do not count. Errors to templates have another truth than
    errors to realisations; they count if there are no others.
    """
    candidates = [
        version
        for version in client.search_model_versions(f"name = '{name}'")
        if TEST_MSE in version.tags
        and client.get_run(str(version.run_id)).data.tags.get("superseded") != "true"
    ]
    if candidates:
        winner = min(
            candidates, key=lambda v: (v.tags["reference"] == "template", float(v.tags[TEST_MSE]))
        )
        if "best" not in winner.aliases:
            client.set_registered_model_alias(name, "best", winner.version)


def forget(client: MlflowClient, run_id: str) -> None:
    """Delete a run with its models."""
    # Registered versions, logged models, then the run itself.
    for version in client.search_model_versions(f"run_id = '{run_id}'"):
        client.delete_model_version(version.name, version.version)
    outputs = client.get_run(run_id).outputs
    for output in outputs.model_outputs if outputs else ():
        client.delete_logged_model(output.model_id)
    client.delete_run(run_id)


def _loadable(files: Path, stamp: np.ndarray, run_id: str, model_id: str) -> Path:
    """Move the files of a model into a folder that `mlflow.pyfunc` can load, and return it.

    `mlflow.pyfunc.save_model` is not used: it reads all files of all installed packages.

    Parameters
    ----------
    files : Path
        Folder with a bundle and further files; it is moved.
    stamp : ndarray, shape (1, d, d)
        Example of the model's input.
    run_id, model_id : str
    """
    from mlflow.models import Model, ModelSignature
    from mlflow.pyfunc import add_to_model
    from mlflow.types import Schema, TensorSpec

    folder, side = files.with_name("loadable"), stamp.shape[-1]
    folder.mkdir()
    files.rename(folder / "data")
    # The description by which MLflow finds and reads the example.
    example = {"artifact_path": "input_example.json", "type": "ndarray", "format": "tf-serving"}
    text = json.dumps(stamp.tolist())
    (folder / example["artifact_path"]).write_text(text, encoding="utf-8")
    # Stamps in, PSFs of the same size out.
    stamps = Schema([TensorSpec(np.dtype(np.float32), (-1, side, side))])
    signature = ModelSignature(stamps, stamps)
    model = Model(
        run_id=run_id, model_id=model_id, signature=signature, saved_input_example_info=example
    )
    add_to_model(model, loader_module=mlflow_model.__name__, data="data")  # type: ignore[no-untyped-call]
    model.save(str(folder / "MLmodel"))
    return folder
