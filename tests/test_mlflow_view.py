"""MLflow's database is compared with what was imported; what people add is theirs."""

from __future__ import annotations

import os
import shutil
import sqlite3
from contextlib import closing

import pytest
from click.testing import CliRunner

from psfdae.cli import main
from psfdae.files import atomic_path
from psfdae_paper import mlflow_view
from psfdae_paper.mlflow_view import damage
from psfdae_paper.stages import track
from test_track import write_tree

RECEIPT = "mlflow/dataset3.csv"


@pytest.fixture(scope="module")
def imported(tmp_path_factory, empty_database):
    """Results with digests whose runs are in the database."""
    results = tmp_path_factory.mktemp("imported") / "results"
    stars = write_tree(results)
    (results / ".digests").mkdir()
    # Without a digest they would be read, and these are no weights.
    with atomic_path(results / "dae/dataset3/random-template/dae.safetensors") as path:
        path.write_bytes(b"weights")
    shutil.copy(empty_database, results / "mlflow.db")
    _import(results, stars)
    return results, stars


def _import(results, stars):
    database, receipt = results / "mlflow.db", results / RECEIPT
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        patch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
        track.track(results, "smoke", database, receipt, tuple(stars.items()))


@pytest.fixture
def results(imported, tmp_path):
    return shutil.copytree(imported[0], tmp_path / "results")


def change(results, *statements):
    with closing(sqlite3.connect(results / "mlflow.db")) as database, database:
        for statement in statements:
            assert database.execute(statement).rowcount > 0, statement


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE params SET value = '[4, 5]' WHERE key = 'dae.widths'",
        "UPDATE metrics SET value = 2.5e-5 WHERE key = 'train_mse' AND step = 2",
        "UPDATE metrics SET step = 7 WHERE key = 'train_mse' AND step = 2",
        "UPDATE latest_metrics SET value = 4e-5 WHERE key = 'test_mse_0.003'",
        "UPDATE tags SET value = 'dataset2' WHERE key = 'dataset'",
        "UPDATE runs SET end_time = end_time + 1",
        "UPDATE runs SET artifact_uri = artifact_uri || 'x'",
        "DELETE FROM params WHERE key = 'dae.widths'",
    ],
)
def test_a_run_that_is_another_one_is_noticed(results, statement):
    assert damage(results) == ""
    change(results, statement)
    assert damage(results).startswith("not what was imported (run ")


def test_a_file_of_a_run_that_is_another_one_is_noticed(results):
    found = sorted(results.glob("mlartifacts/*/*/artifacts/**/*.*"))
    assert len(found) > 6
    for path in found:
        whole = path.read_bytes()
        path.write_bytes(bytes([whole[0] ^ 1]) + whole[1:])
        assert damage(results).startswith("not what was imported (run "), path
        path.write_bytes(whole)
    assert damage(results) == ""


def test_damage_that_sqlite_finds(results):
    path = results / "mlflow.db"
    whole = path.read_bytes()
    for place in (3, 40, 101):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 4]) + whole[place + 1 :])
        said = damage(results)
        assert said.startswith("damaged (") or place == 40, place
    path.write_bytes(whole[: len(whole) // 2])
    assert damage(results).startswith("damaged (")
    path.unlink()
    assert damage(results) == "missing"


def test_what_people_do_is_no_damage(results):
    from mlflow import MlflowClient

    client = MlflowClient(f"sqlite:///{results / 'mlflow.db'}")
    experiment = client.get_experiment_by_name("scene1").experiment_id
    one, other = client.search_runs([experiment])
    client.set_tag(one.info.run_id, "mine", "good")
    client.set_tag(one.info.run_id, "mlflow.note.content", "to be looked at")
    client.update_run(one.info.run_id, name="best so far")
    client.rename_experiment(experiment, "another name")
    client.create_experiment("of my own")
    client.delete_run(other.info.run_id)
    assert damage(results) == ""
    gone = f"run_uuid = '{other.info.run_id}'"
    tables = ("tags", "params", "metrics", "latest_metrics", "runs")
    change(results, *(f"DELETE FROM {table} WHERE {gone}" for table in tables))
    assert damage(results) == ""


def test_a_database_in_use_is_no_damage(results, monkeypatch):
    monkeypatch.setattr(mlflow_view, "PATIENCE_S", 0.1)
    with closing(sqlite3.connect(results / "mlflow.db", isolation_level=None)) as database:
        database.execute("BEGIN EXCLUSIVE")
        assert damage(results) == ""


def test_a_damaged_note_counts_as_damage(results):
    noted = results / ".digests/mlflow.db/dataset3.json"
    whole = noted.read_text()
    for old, new in (('"sha256": "', '"sha256": "0'), ('"tags"', '"tagt"'), ("{", "["), ("a", "b")):
        noted.write_text(whole.replace(old, new, 1))
        assert damage(results).startswith("not what was imported ("), new


def test_a_pipe_is_no_view(results):
    """It would be read for ever."""
    (results / "mlflow.db").unlink()
    os.mkfifo(results / "mlflow.db")
    assert damage(results) == "missing"


def test_a_damaged_view_is_set_aside_and_imported_anew(imported, results):
    change(results, "UPDATE params SET value = '[4, 5]' WHERE key = 'dae.widths'")
    done = CliRunner().invoke(main, ["verify", str(results)])
    assert done.stderr.startswith(f"{results / 'mlflow.db'}: not what was imported (run ")
    assert done.stderr.count("\n") == 1
    assert str(results / RECEIPT) in done.stdout.splitlines()
    for name in ("mlflow.db", "mlartifacts", RECEIPT):
        assert not (results / name).exists()
        assert (results / f"{name}.damaged").exists()
    stars = {name: results / path.relative_to(imported[0]) for name, path in imported[1].items()}
    _import(results, stars)
    done = CliRunner().invoke(main, ["verify", str(results)])
    assert (done.stdout, done.stderr) == ("", "")
    change(results, "UPDATE params SET value = '' WHERE key = 'dae.widths' AND value = '[4, 4]'")
