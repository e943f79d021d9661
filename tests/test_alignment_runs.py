"""Networks of scene 3 as MLflow runs."""

from __future__ import annotations

import csv
import shutil

import pytest
import yaml

from psfdae.files import ProductError
from psfdae_paper.stages import track
from psfdae_paper.tracking import WEIGHTS, runs_of_alignment

COLUMNS = ("test_set", "noise_level", "method", "parameter", "mean_abs_error", "bias", "variance")


@pytest.fixture
def results(tmp_path):
    """A results folder as scene 3 leaves it, without any training."""
    for kind, weights in WEIGHTS.items():
        folder = tmp_path / "alignment" / kind
        folder.mkdir(parents=True)
        (folder / weights).write_bytes(kind.encode())
        (folder / "config.yaml").write_text(yaml.safe_dump({"seed": 7, "attempt": 1}))
        (folder / "history.csv").write_text(
            "epoch,lr,loss,seconds\n1,0.001,0.5,2\n2,0.001,0.25,4\n"
        )
    table = tmp_path / "tables/alignment_errors.csv"
    table.parent.mkdir()
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*COLUMNS, "unit"])
        for method in WEIGHTS:
            writer.writerow(["uniform", 0.002, method, "tilt_x", 0.05, 0.01, 0.004, "range"])
            writer.writerow(["uniform", 0.002, method, "tilt_x", 5e-5, 1e-5, 4e-9, "rad"])
    return tmp_path


def test_every_network_has_its_curve_and_its_errors(results):
    records = {run.kind: run for run in runs_of_alignment(results)}
    assert set(records) == set(WEIGHTS)
    for kind, record in records.items():
        values = {(p.name, p.epoch): p.value for p in record.points}
        assert values["loss", 2] == 0.25
        assert values["uniform_tilt_x_mean_abs_error_0.002", 0] == 0.05
        assert values["uniform_tilt_x_bias_0.002", 0] == 0.01
        assert record.end_ms - record.start_ms == 4000
        assert "attempt" not in record.config
        assert record.name == f"alignment {kind}"
    assert len({record.content_hash for record in records.values()}) == len(WEIGHTS)


def test_importing_twice_changes_nothing(results, empty_database, tmp_path):
    receipt = tmp_path / "receipt.csv"
    shutil.copy(empty_database, results / "mlflow.db")
    for action in ("created", "unchanged"):
        track.track(results, "fast", results / "mlflow.db", receipt, alignment=True)
        rows = list(csv.DictReader(receipt.open()))
        assert [row["action"] for row in rows] == [action] * len(WEIGHTS)
        assert {row["experiment"] for row in rows} == {"scene3"}


def test_unfinished_scene_is_refused(results):
    (results / "tables/alignment_errors.csv").unlink()
    with pytest.raises(ProductError, match="snakemake scene3"):
        runs_of_alignment(results)
