"""Files beside an MLflow database, which MLflow opens by an entry point of the package."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlparse

if TYPE_CHECKING:
    from mlflow.store.artifact.artifact_repo import ArtifactRepository


def open_artifacts(
    artifact_uri: str, tracking_uri: str | None = None, registry_uri: str | None = None
) -> ArtifactRepository:
    """Open files of MLflow's scheme mlflow-artifacts, which name no folder.

    A server knows the folder of its files. For a database without a server, MLflow cannot say where
    they are: they are in mlartifacts in the folder of the database, wherever it has been moved.

    Parameters
    ----------
    artifact_uri : str
        Address such as mlflow-artifacts:/scene1/….
    tracking_uri : str, optional
        Database or server; by default MLflow's present one.
    registry_uri : str, optional
        Database or server of the registered models, which a server may need.
    """
    from mlflow import get_tracking_uri
    from mlflow.store.artifact.local_artifact_repo import LocalArtifactRepository
    from mlflow.store.artifact.mlflow_artifacts_repo import MlflowArtifactsRepository

    tracking_uri = tracking_uri or get_tracking_uri()
    if not tracking_uri.startswith("sqlite:///"):
        return MlflowArtifactsRepository(artifact_uri, tracking_uri, registry_uri)
    database = Path(tracking_uri.removeprefix("sqlite:///")).resolve()
    folder = database.parent / "mlartifacts" / urlparse(artifact_uri).path.lstrip("/")
    return LocalArtifactRepository(folder.as_uri())
