"""Models of runs in MLflow, logged with their runs and registered by dataset and method."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.model.bundle import SUFFIX, write_bundle
from psfdae.model.packing import uncalibrated
from psfdae.model.psf_model import PsfModel, load_model
from psfdae.model.star_sets import read_stars
from psfdae.rng import stream
from psfdae_paper.configuration.compose import part
from psfdae_paper.tracking import MODEL, Run

if TYPE_CHECKING:
    from mlflow import MlflowClient

TEST_MSE = "test_mse"
"""Tag of a version, and metric of its run: the mean over all noise levels."""


class PyfuncModel:
    """A model of PSFs as `mlflow.pyfunc` calls it."""

    def __init__(self, model: PsfModel) -> None:
        self.model = model

    def predict(self, model_input: np.ndarray, params: Mapping[str, Any] | None = None) -> Any:
        """Return PSFs of stamps (n, d, d), times their fluxes; stamps in any unit, with sky."""
        return self.model.predict(model_input).psf


def _load_pyfunc(path: str) -> PyfuncModel:
    """Load the bundle of a folder, as `mlflow.pyfunc.load_model` asks for."""
    (bundle,) = Path(path).glob(f"*{SUFFIX}")
    return PyfuncModel(load_model(bundle))


def log_model(client: MlflowClient, experiment: str, run_id: str, run: Run) -> str | None:
    """Log the model of a run with all its files, and register one that restores single stamps.

    Returns
    -------
    str or None
        Id of the model in MLflow; None if the run has no model, such as that of a sweep.
    """
    from mlflow.entities import LoggedModelOutput

    files = {name: path for name, path in run.files.items() if name.startswith(MODEL)}
    if not files:
        return None
    name = registered_name(run)
    logged = client.create_logged_model(experiment, name, run_id, model_type=run.kind)
    model_id: str = logged.model_id
    client.log_outputs(run_id, [LoggedModelOutput(model_id, 0)])
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary, "files")
        link(files, folder, MODEL)
        if run.fit is not None and run.data is not None:
            folder = _with_bundle(folder, run, run_id, model_id)
        client.log_model_artifacts(model_id, str(folder))
    client.finalize_logged_model(model_id, "READY")
    # The model becomes a version of the models of its dataset and method.
    if run.fit is not None:
        if not client.search_registered_models(f"name = '{name}'"):
            description = f"PSFs of stamps of {run.dataset}, restored by {run.kind}."
            client.create_registered_model(name, description=description)
        tags = {"split": run.split, "reference": run.reference}
        if TEST_MSE in run.metrics:
            tags[TEST_MSE] = f"{run.metrics[TEST_MSE]:.6g}"
        location = client.get_logged_model(model_id).artifact_location
        client.create_model_version(name, location, run_id, tags, model_id=model_id)
    return model_id


def registered_name(run: Run) -> str:
    """Return the name of the models of a dataset and method."""
    return f"{run.dataset}-{run.kind}"


def link(files: Mapping[str, Path], folder: Path, prefix: str = "") -> None:
    """Make links to files in a folder, by their names without a prefix.

    MLflow copies a folder; links save a copy of large files.
    """
    for name, path in files.items():
        target = folder / name.removeprefix(prefix)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(path.resolve())


def _with_bundle(files: Path, run: Run, run_id: str, model_id: str) -> Path:
    """Add a bundle to the files of a fit; return a folder that `mlflow.pyfunc` can load.

    The bundle has no errors, which take a minute to measure (`psfdae bundle`); no PSF depends on
    them.
    """
    from mlflow.models import Model, ModelSignature
    from mlflow.pyfunc import save_model
    from mlflow.types import Schema, TensorSpec

    assert run.fit is not None and run.data is not None
    method_class, place = run.fit
    described, product = method_class.described(place), read_stars(run.data, run.reference)
    # Groups of settings that tell which stars a fit was trained on, and with which noise.
    groups = ("seed", "noise", "parts")
    config = part(groups, {group: described[group] for group in groups})
    name, fitted = registered_name(run), method_class.load(place, run.reference)
    bundle, held_out = uncalibrated(
        fitted, product, run.reference, config, described, name, "not stated"
    )
    write_bundle(bundle, files / f"{name}{SUFFIX}")
    # An example of input: a noisy stamp of a test star on its sky, in photons, shape (1, d, d).
    noise, rng = held_out.noise, stream(config.seed, "noise", "example")
    flux = noise.flux(float(np.median(config.noise.levels)))
    stamp = rng.poisson(flux * held_out.images[:1] + noise.background).astype(np.float32)
    # Stamps in, PSFs of the same size out. MLflow would look for requirements by itself for long.
    stamps = Schema([TensorSpec(np.dtype(np.float32), (-1, *stamp.shape[1:]))])
    folder = files.with_name("loadable")
    save_model(
        str(folder),
        loader_module=__name__,
        data_path=str(files),
        pip_requirements=["psfdae"],
        signature=ModelSignature(stamps, stamps),
        input_example=stamp,
        mlflow_model=Model(run_id=run_id, model_id=model_id),
    )
    return folder


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
