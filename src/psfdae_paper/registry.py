"""Models of runs in MLflow: logged once with their runs, registered by dataset and method.

A run whose model a bundle can hold has a `pyfunc` model: the bundle with signature, input example
and requirements. A method of a dataset is a registered model; its versions are runs.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from psfdae.methods import method
from psfdae.methods.interface import Method
from psfdae_paper.served import write_pyfunc
from psfdae_paper.tracking import KEY, TrackedRun

if TYPE_CHECKING:
    from mlflow import MlflowClient

WITHOUT_VALIDATION = (
    "This method is fitted to the validation stars as well, so that it has no validation error, "
    'and no version has the alias "best": test errors choose nothing.'
)
"""Description of a registered model of such a method."""


def log_model(client: MlflowClient, experiment: str, run_id: str, run: TrackedRun) -> str | None:
    """Log the model of a run; register it if it is a method of a dataset.

    Parameters
    ----------
    client : MlflowClient
        Client of the database or server.
    experiment, run_id : str
        MLflow's ids of the experiment and of the run.
    run : TrackedRun
        Run with its files.

    Returns
    -------
    str or None
        Id of the model in MLflow; None for a run without a bundle.
    """
    from mlflow.entities import LoggedModelOutput

    if run.bundle is None:
        return None
    # Pending until its files are there (READY, below).
    name = f"{run.key[1]}-{run.key[0]}"
    model = client.create_logged_model(experiment, name, run_id, model_type=run.key[0])
    model_id: str = model.model_id
    client.log_outputs(run_id, [LoggedModelOutput(model_id, 0)])
    with tempfile.TemporaryDirectory() as temporary:
        write_pyfunc(run.bundle(), Path(temporary, "model"))
        client.log_model_artifacts(model_id, f"{temporary}/model")
    client.finalize_logged_model(model_id, "READY")
    # A version points to the files of the model; they are not copied.
    if run.data is not None:
        register(client, name, method(run.key[0]))
        tags = dict(zip(KEY[2:], run.key[2:], strict=True))
        client.create_model_version(name, model.artifact_location, run_id, tags, model_id=model_id)
    return model_id


def register(client: MlflowClient, name: str, kind: type[Method]) -> None:
    """Create a registered model of a method, unless there is one of this name."""
    # Only methods that leave out the validation stars have a validation error.
    description = None if kind.needs.validation else WITHOUT_VALIDATION
    with accept_existing():
        client.create_registered_model(name, description=description)


@contextmanager
def accept_existing() -> Iterator[None]:
    """Accept that a name is in use: another importer may create it at any time."""
    from mlflow.exceptions import MlflowException

    try:
        yield
    except MlflowException as error:
        if error.error_code != "RESOURCE_ALREADY_EXISTS":
            raise


def choose_best(client: MlflowClient, experiment: str, run: TrackedRun) -> None:
    """Give the alias "best" to the version with the smallest validation error.

    Test errors choose nothing. All versions compete that have the split, the reference, the
    validation stars and their noise in common with this run, whatever their other settings. The
    alias is "best" for random splits and realisations, otherwise "best-SPLIT-REFERENCE". Methods
    that are fitted to the validation stars as well do not have it (`WITHOUT_VALIDATION`).

    Parameters
    ----------
    client : MlflowClient
        Client of the database or server.
    experiment : str
        MLflow's id of the experiment.
    run : TrackedRun
        Run of the present results.
    """
    # Of equal errors, the newest run.
    error = "metrics.`best_validation_mse_1e-6`"
    query = f"tags.validation = '{run.validation_hash}' and {error} >= 0"
    order = [f"{error} ASC", "attributes.start_time DESC"]
    part = "-".join(run.key[2:])
    for winner in client.search_runs([experiment], query, max_results=1, order_by=order):
        alias = "best" if part == "random-realisation" else f"best-{part}"
        for version in client.search_model_versions(f"run_id = '{winner.info.run_id}'"):
            client.set_registered_model_alias(version.name, alias, version.version)


def forget(client: MlflowClient, run_id: str) -> None:
    """Delete a run with its models."""
    # Registered versions, logged models, then the run itself.
    for version in client.search_model_versions(f"run_id = '{run_id}'"):
        client.delete_model_version(version.name, version.version)
    outputs = client.get_run(run_id).outputs
    for output in outputs.model_outputs if outputs else ():
        client.delete_logged_model(output.model_id)
    client.delete_run(run_id)
