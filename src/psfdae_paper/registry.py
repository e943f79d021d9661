"""Models of runs in MLflow, logged with their runs and registered by dataset and method.

A run with a model becomes a logged model with its files and, if it denoises single stamps, a
version of the registered models of its dataset and method. The best version has the alias "best".
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from psfdae.denoise.bundle import SUFFIX, Bundle, write_bundle
from psfdae.training.packing import build_uncalibrated
from psfdae.training.star_sets import read_stars
from psfdae_paper.configuration.compose import part
from psfdae_paper.tracking import TrackedRun

if TYPE_CHECKING:
    from mlflow import MlflowClient


def log_model(client: MlflowClient, experiment: str, run_id: str, run: TrackedRun) -> str | None:
    """Log the model of a run with all its files; register it if it denoises single stamps.

    A registered model has a bundle among its files, which `psfdae.load_model` reads. The bundle
    lacks the errors, which take a minute to measure (`psfdae paper bundle`) and do not change its
    PSFs.

    Parameters
    ----------
    client : MlflowClient
        Client of the database or server.
    experiment, run_id : str
        MLflow's ids of the experiment and of the run.
    run : TrackedRun
        Run with its files; `fit` is None if no bundle can be made of it.

    Returns
    -------
    str or None
        Id of the model in MLflow; None for a run without a model, such as a whole sweep.
    """
    from mlflow.entities import LoggedModelOutput

    if not run.model_files:
        return None
    # Pending until its files are there (READY, below).
    name = make_model_name(run)
    logged_model = client.create_logged_model(experiment, name, run_id, model_type=run.kind)
    model_id: str = logged_model.model_id
    client.log_outputs(run_id, [LoggedModelOutput(model_id, 0)])
    # Its files, with a bundle for all that can be put into one.
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        link_files(run.model_files, folder)
        if run.fit is not None:
            write_bundle(make_bundle(run), folder / f"{name}{SUFFIX}")
        client.log_model_artifacts(model_id, temporary)
    client.finalize_logged_model(model_id, "READY")
    # The model becomes a version of the models of its dataset and method.
    if run.fit is not None:
        if not client.search_registered_models(f"name = '{name}'"):
            # MLflow lists it next to the name.
            description = f"PSFs of stamps of {run.dataset}, restored by {run.kind}."
            client.create_registered_model(name, description=description)
        tags = {"split": run.split, "reference": run.reference}
        # The mean over all noise levels, by which `choose_best` compares versions.
        if "test_mse" in run.metrics:
            tags["test_mse"] = f"{run.metrics['test_mse']:.6g}"
        # A version points to the files of the model; they are not copied.
        location = client.get_logged_model(model_id).artifact_location
        client.create_model_version(name, location, run_id, tags, model_id=model_id)
    return model_id


def make_bundle(run: TrackedRun) -> Bundle:
    """Return the bundle, without errors, of a run that has a fit and the stars of its training.

    Raises
    ------
    ProductError
        If the fit or the stars are damaged.
    """
    assert run.fit is not None and run.data is not None
    method_class, path = run.fit
    fit_config, product = method_class.read_config(path), read_stars(run.data, run.reference)
    # Groups of settings that decide which stars a fit was trained on, and with which noise.
    groups = ("seed", "noise", "parts")
    config = part(groups, {group: fit_config[group] for group in groups})
    # The bundle is named like the registered model.
    fit, name = method_class.load(path, run.reference), make_model_name(run)
    bundle, _ = build_uncalibrated(
        fit, product, run.reference, config, fit_config, name, "not stated"
    )
    return bundle


def make_model_name(run: TrackedRun) -> str:
    """Return the name of the models of a dataset and method."""
    return f"{run.dataset}-{run.kind}"


def link_files(files: Mapping[str, Path], folder: Path) -> None:
    """Make links to files in a folder, by their names.

    MLflow copies a folder; links save a copy of large files.

    Parameters
    ----------
    files : mapping of str to Path
        Files by names, which may have folders.
    folder : Path
        Folder that receives the links; it exists.
    """
    for name, path in files.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(path.resolve())


def choose_best(client: MlflowClient, name: str) -> None:
    """Give the alias "best" to the version with the smallest error on its test stars.

    Versions of superseded runs are left out. Errors to templates have another truth than
    errors to realisations, and are used only if there are no others.
    """
    candidates = [
        version
        for version in client.search_model_versions(f"name = '{name}'")
        if "test_mse" in version.tags
        and client.get_run(str(version.run_id)).data.tags.get("superseded") != "true"
    ]
    # Versions that are tested on realisations precede versions that are tested on templates.
    if candidates:
        winner = min(
            candidates, key=lambda v: (v.tags["reference"] == "template", float(v.tags["test_mse"]))
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
