"""Shared fixtures: small pupils, a tiny set of stars, the real configuration."""

from __future__ import annotations

import fcntl
import os
import shutil
from contextlib import contextmanager

import pytest

from image_training import Training
from job_server import job_server
from prediction_stars import fresh_psfs, gaussians, with_network
from psfdae import load_model
from psfdae.api import PsfModel
from psfdae.denoise.bundle import read_bundle
from psfdae.optics.pupil import annular_pupil
from psfdae.stars.noise import NoiseModel
from psfdae_paper.alignment.stamps import AlignmentStamps
from psfdae_paper.alignment.telescope import (
    StateTracer,
    design_states,
    fit_quadratic,
    grid_states,
)
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import clear_caches, config_dir, load
from tracked_results import Site
from workflow_runs import PATH, snakemake


def pytest_addoption(parser):
    help_text = "K/N: only the tests of every N-th file, from the K-th on; K = 1 … N"
    parser.addoption("--part", metavar="K/N", help=help_text)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Keep the files of a part; begin with one that makes the smoke run, end with others of it.

    All tests of a file run in one worker. While the first makes the smoke run, which takes longest,
    no other waits for it.
    """
    if part := config.getoption("--part"):
        first, parts = map(int, part.split("/"))
        if not 1 <= first <= parts:
            raise pytest.UsageError(f"--part {part}: expected K/N with K = 1 … N")
        files = sorted({item.path for item in items})[first - 1 :: parts]
        config.hook.pytest_deselected(items=[item for item in items if item.path not in files])
        items[:] = [item for item in items if item.path in files]
    reading_smoke = sorted({item.path for item in items if "smoke" in item.fixturenames})
    order = dict.fromkeys(reading_smoke, 2) | dict.fromkeys(reading_smoke[:1], 0)
    items.sort(key=lambda item: order.get(item.path, 1))


@contextmanager
def made_once(folder):
    """Say whether a folder that all workers share is still to be made; others wait meanwhile."""
    finished = folder.with_suffix(".finished")
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        folder.mkdir(exist_ok=True)
        yield not finished.exists()
        finished.touch()


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory, worker_id):
    """Folder of this run of the tests, the same for all workers."""
    folder = tmp_path_factory.getbasetemp()
    return folder if worker_id == "master" else folder.parent


@pytest.fixture(scope="session")
def scene1():
    """Configuration of dataset 3, as the workflow uses it."""
    return load(["dataset=dataset3"])


@pytest.fixture(scope="session")
def pupil():
    """Unobscured pupil with 128 samples across."""
    return annular_pupil(128, 0.0)


@pytest.fixture(scope="session")
def gaussian_stars():
    """300 of 16 × 16 pixels."""
    return gaussians(300, 3, 16, 1.0)


@pytest.fixture(scope="session")
def noise():
    """The paper's noise as calibrated."""
    return NoiseModel(kappa=4.98, background=1e4)


@pytest.fixture(scope="session")
def scene3():
    """Configuration of scene 3, as the workflow uses it."""
    return load(Alignment.choice)


@pytest.fixture(scope="session")
def tracer(scene3):
    """Ray tracer of scene 3."""
    return StateTracer(scene3.telescope, scene3.prescription, scene3.alignment)


@pytest.fixture(scope="session")
def operator(scene3):
    """Propagation to the stamps of scene 3."""
    return AlignmentStamps(scene3.telescope, scene3.optics, scene3.alignment)


@pytest.fixture(scope="session")
def exact_operator(scene3):
    """The same on a finer pupil, in double precision."""
    optics = scene3.optics.model_copy(update={"pupil_samples": [254], "precision": "complex128"})
    return AlignmentStamps(scene3.telescope, optics, scene3.alignment)


@pytest.fixture(scope="session")
def model(tracer):
    """Quadratic model of scene 3's Zernikes."""
    states = design_states()
    return fit_quadratic(states, tracer(states))


@pytest.fixture(scope="session")
def grid(tracer):
    """The 625 states of scene 3 and their ray-traced coefficients."""
    states = grid_states(5)
    return states, tracer(states)


@pytest.fixture(scope="session")
def smoke(shared_folder):
    """Folder of the whole DAG on tiny sizes, made once for all workers, which only read it."""
    folder = shared_folder / "smoke"
    with made_once(folder) as missing:
        if missing:
            with job_server() as programs:
                snakemake(folder, path=f"{programs}{os.pathsep}{PATH}")
            assert (folder / "results/runtime.csv").is_file()
    return folder


@pytest.fixture(scope="session")
def shipped():
    """The model that comes with the package."""
    return load_model()


@pytest.fixture(scope="session")
def network(shipped):
    """The same photometry with a network of random weights."""
    return PsfModel(with_network(shipped.bundle))


@pytest.fixture(scope="session")
def field_psfs(tmp_path_factory):
    """384 noise-free stars of the shipped model's scene, 16 × 16, flux 1."""
    return fresh_psfs(tmp_path_factory.mktemp("field"), 384)


@pytest.fixture
def config_folder(tmp_path, monkeypatch):
    """A copy of the configuration that commands take instead, and that a test may change."""
    shutil.copytree(config_dir(), tmp_path / "config")
    monkeypatch.setenv("PSFDAE_CONFIG", str(tmp_path / "config"))
    clear_caches()
    yield tmp_path / "config"
    clear_caches()


@pytest.fixture(scope="session")
def empty_database(tmp_path_factory):
    """A migrated database without runs; the migrations take seconds."""
    from mlflow import MlflowClient

    path = tmp_path_factory.mktemp("mlflow") / "mlflow.db"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
        MlflowClient(f"sqlite:///{path}").search_experiments(max_results=1)
    return path


@pytest.fixture(scope="session")
def training(shared_folder):
    """A model of a simulated image, trained once for all workers, which only read it."""
    training_files = Training(shared_folder / "training")
    with made_once(training_files.folder) as missing:
        if missing:
            training_files.make()
    return training_files


@pytest.fixture
def site(tmp_path, empty_database, monkeypatch):
    """A results folder with its own copy of the database."""
    from psfdae_paper import tracking

    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    # The stage sets these; setenv makes pytest restore them.
    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "1")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    monkeypatch.setattr(tracking, "make_bundle", lambda *arguments: read_bundle())
    return Site(tmp_path, empty_database)
