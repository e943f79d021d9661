"""Importing finished runs into MLflow: once, again, changed, and without a server."""

from __future__ import annotations

import csv
import re
import shutil
import socket
import sqlite3
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml

from psfdae.files import Column, ProductError, write_product
from psfdae_paper.stages import track
from psfdae_paper.tracking import flatten, runs_of_datasets

PNG = b"\x89PNG\r\n\x1a\n"
HISTORY = ((1, 3e-5, "nan", 1.5), (2, 2e-5, 1e-5, 3.0), (3, 1e-5, 2e-5, 4.5))


def write_history(path, rows=HISTORY):
    lines = [f"{epoch},{10 * epoch},0.001,{t},{v},{s}" for epoch, t, v, s in rows]
    path.write_text("\n".join(["epoch,step,lr,train_mse,validation_mse,seconds", *lines, ""]))


def write_config(path, **train):
    tree = {"seed": 7, "dae": {"widths": [4, 4]}, "train": {"lr": 0.001, **train}, "attempt": 1}
    path.write_text(yaml.safe_dump(tree))


def write_tree(results, dataset="dataset3", reference="template"):
    """A results folder as the workflow leaves it, without any training."""
    values = {"a": Column(np.arange(3.0), "1", "values")}
    stars = results / "data/seidel/stars.h5"
    scene = {"seed": 7, "scene": {"experiment": "scene1"}, "telescope": {"diameter_m": 1.0}}
    write_product(stars, "stars", values, scene)
    baseline = {"seed": 7, "baseline": {"components": 2}}
    write_product(results / f"pca_som/{dataset}/random.h5", "pca_som", values, baseline)
    dae = results / f"dae/{dataset}/random-{reference}"
    dae.mkdir(parents=True)
    (dae / "dae.safetensors").write_bytes(b"weights")
    write_history(dae / "history.csv")
    write_config(dae / "config.yaml")
    evaluation = results / f"evaluation/{dataset}/random-{reference}.csv"
    evaluation.parent.mkdir(parents=True)
    rows = ["dataset,split,reference,method,noise_level,metric,value,stderr,n"]
    for i, method in enumerate(("noisy", "pca_som", "dae"), start=1):
        for metric, value in (("mse", i * 1e-5), ("ssim", i / 10)):
            rows.append(f"{dataset},random,{reference},{method},0.003,{metric},{value:g},1e-7,50")
    evaluation.write_text("\n".join([*rows, ""]))
    figures = results / f"figures/{dataset}"
    figures.mkdir(parents=True)
    for name in ("curves", f"random-{reference}_strip", "held_out-template_strip"):
        (figures / f"{name}.png").write_bytes(PNG)
    return {dataset: stars}


class Site:
    """A results folder with its own copy of the database."""

    def __init__(self, root, empty_database):
        self.results = root / "results"
        self.stars = write_tree(self.results)
        self.database = self.results / "mlflow.db"
        self.dae = self.results / "dae/dataset3/random-template"
        self.optics = False
        shutil.copy(empty_database, self.database)

    def track(self):
        """Import everything; actions by kind of run, as the receipt tells."""
        receipt = self.results / "runs.csv"
        stars = tuple(self.stars.items())
        track.track(self.results, "smoke", self.database, receipt, stars, self.optics)
        with receipt.open(newline="") as file:
            return {row["kind"]: row["action"] for row in csv.DictReader(file)}

    def runs(self, kind="dae", view=1):
        from mlflow import MlflowClient

        client = MlflowClient(f"sqlite:///{self.database}")
        experiment = client.get_experiment_by_name("scene1").experiment_id
        return client.search_runs([experiment], f"tags.kind = '{kind}'", run_view_type=view)

    def history(self, run, metric):
        from mlflow import MlflowClient

        client = MlflowClient(f"sqlite:///{self.database}")
        return client.get_metric_history(run.info.run_id, metric)

    def sizes(self):
        """Rows of the tables that must not grow."""
        with sqlite3.connect(self.database) as connection:
            return {
                table: connection.execute(f"select count(*) from {table}").fetchone()[0]
                for table in ("experiments", "runs", "metrics", "params", "tags")
            }


@pytest.fixture
def site(tmp_path, empty_database, monkeypatch):
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    # The stage sets these; setenv makes pytest restore them.
    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "3")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    return Site(tmp_path, empty_database)


def test_run_holds_what_the_files_say(site):
    before = time.time() * 1000
    assert site.track() == {"dae": "created", "baseline": "created"}
    (dae,), (baseline,) = site.runs("dae"), site.runs("baseline")
    assert dae.info.run_name == "dataset3 random template dae"
    assert dae.info.status == "FINISHED"
    assert abs(dae.info.end_time - before) < 60_000
    assert dae.info.end_time - dae.info.start_time == 4500
    tags = {"dataset": "dataset3", "split": "random", "reference": "template", "preset": "smoke"}
    for run in (dae, baseline):
        assert tags.items() <= run.data.tags.items()
        assert len(run.data.tags["config_hash"]) == 64
        assert run.data.tags["commit"]
    assert dae.data.params["dae.widths"] == "[4, 4]"
    assert dae.data.params["telescope.diameter_m"] == "1.0"
    assert "attempt" not in dae.data.params
    assert baseline.data.params["baseline.components"] == "2"
    assert dae.data.metrics["test_mse_0.003"] == 3e-5
    assert baseline.data.metrics["test_mse_0.003"] == 2e-5
    assert dae.data.metrics["test_ssim_stderr_0.003"] == 1e-7
    assert dae.data.metrics["best_validation_mse"] == 1e-5
    points = site.history(dae, "train_mse")
    assert [(p.step, p.value) for p in points] == [(1, 3e-5), (2, 2e-5), (3, 1e-5)]
    assert [p.timestamp - dae.info.start_time for p in points] == [1500, 3000, 4500]
    assert [p.step for p in site.history(dae, "validation_mse")] == [2, 3]


def test_what_knows_the_optics_is_a_run_without_a_model(site):
    rows = ["dataset,split,reference,method,noise_level,metric,value,stderr,n"]
    for method, value in (("wavefront", 3e-7), ("wavefront_position", 2.5e-7)):
        rows.append(f"dataset3,random,template,{method},0.001,mse,{value},2e-8,420")
    folder = site.results / "wavefront"
    folder.mkdir()
    (folder / "dataset3.csv").write_text("\n".join([*rows, ""]))
    (folder / "dataset3.parquet").write_bytes(b"stars")
    site.optics = True
    assert site.track() == {"wavefront": "created", "wavefront_position": "created"}
    (run,) = site.runs("wavefront_position")
    assert run.data.metrics["bounded_mse_0.001"] == 2.5e-7
    assert run.data.metrics["bounded_mse_stderr_0.001"] == 2e-8
    assert run.data.params["telescope.diameter_m"] == "1.0"
    assert set(site.track().values()) == {"unchanged"}
    (folder / "dataset3.csv").unlink()
    with pytest.raises(ProductError, match=r"dataset3\.csv: missing; run `snakemake wavefront`"):
        site.track()


def test_artifacts_lie_beside_the_database(site):
    site.track()
    folder = site.results / "mlartifacts/scene1" / site.runs()[0].info.run_id / "artifacts"
    found = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert found == {
        *("config.yaml", "history.csv", "evaluation.csv"),
        *("model/dae.safetensors", "model/config.yaml"),
        *("figures/curves.png", "figures/random-template_strip.png"),
    }
    assert not any(p.is_symlink() for p in folder.rglob("*"))
    assert yaml.safe_load((folder / "config.yaml").read_text())["dae"] == {"widths": [4, 4]}


def test_second_import_changes_nothing(site):
    site.track()
    before = site.sizes(), [run.to_dictionary() for run in site.runs()]
    (site.dae / "dae.safetensors").touch()
    assert site.track() == {"dae": "unchanged", "baseline": "unchanged"}
    assert (site.sizes(), [run.to_dictionary() for run in site.runs()]) == before


def test_changed_files_replace_the_run(site):
    site.track()
    write_history(site.dae / "history.csv", [(1, 5e-5, 4e-5, 2.0), (2, 4e-5, 6e-5, 3.0)])
    assert site.track() == {"dae": "updated", "baseline": "unchanged"}
    (run,) = site.runs()
    assert run.data.metrics["train_mse"] == 4e-5
    assert [p.value for p in site.history(run, "train_mse")] == [5e-5, 4e-5]
    assert site.track() == {"dae": "unchanged", "baseline": "unchanged"}


def test_changed_config_is_a_second_run(site):
    site.track()
    old = site.runs()[0].info.run_id
    write_config(site.dae / "config.yaml", lr=0.01)
    assert site.track() == {"dae": "created", "baseline": "unchanged"}
    superseded = {run.info.run_id: run.data.tags["superseded"] for run in site.runs()}
    assert len(superseded) == 2
    assert superseded.pop(old) == "true"
    assert set(superseded.values()) == {"false"}
    write_config(site.dae / "config.yaml")
    assert site.track() == {"dae": "unchanged", "baseline": "unchanged"}
    flags = {run.info.run_id: run.data.tags["superseded"] for run in site.runs()}
    assert flags == {old: "false", next(iter(superseded)): "true"}


def test_killed_import_is_repaired(site, monkeypatch):
    from mlflow import MlflowClient

    def killed(*arguments, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(MlflowClient, "log_artifacts", killed)
        with pytest.raises(KeyboardInterrupt):
            site.track()
    assert len(site.runs("baseline")) + len(site.runs("dae")) == 1
    site.track()
    assert len(site.runs("baseline")) == len(site.runs("dae")) == 1
    assert all(run.info.status == "FINISHED" for run in site.runs("baseline") + site.runs("dae"))


@pytest.mark.parametrize("refuses", [True, False], ids=["refuses", "silent"])
def test_unreachable_server_costs_a_message(site, monkeypatch, capsys, refuses):
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "1")
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        if not refuses:
            server.listen()
        monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://127.0.0.1:{server.getsockname()[1]}")
        assert site.track() == {"dae": "not sent", "baseline": "not sent"}
    out = capsys.readouterr().out
    assert "http://127.0.0.1" in out
    assert "Not sent: dataset3 random template baseline, dataset3 random template dae" in out
    assert site.sizes()["runs"] == 0


@pytest.mark.parametrize("damage", ["missing", "damaged"])
@pytest.mark.parametrize("name", ["model", "config", "history", "stars", "baseline"])
def test_missing_or_damaged_file_is_named(tmp_path, name, damage):
    stars = write_tree(tmp_path)
    baseline, dae = runs_of_datasets(tmp_path, stars)
    path = {
        "model": dae.files["model/dae.safetensors"],
        "config": dae.files["model/config.yaml"],
        "history": dae.files["history.csv"],
        "stars": stars["dataset3"],
        "baseline": tmp_path / baseline.source,
    }[name]
    if damage == "missing":
        path.unlink()
    else:
        path.write_text("[")
    if (name, damage) == ("model", "damaged"):
        runs_of_datasets(tmp_path, stars)  # weights are copied, not read
        return
    with pytest.raises(ProductError, match=f"^{re.escape(str(path))}: "):
        runs_of_datasets(tmp_path, stars)


def test_dataset_without_evaluation_is_named(tmp_path):
    with pytest.raises(ProductError, match=r"evaluation/dataset5: no evaluations"):
        runs_of_datasets(tmp_path, {"dataset5": tmp_path / "stars.h5"})


def test_unfinished_trainings_and_other_datasets_are_passed_over(tmp_path):
    stars = write_tree(tmp_path)
    (tmp_path / "dae/dataset3/held_out-template").mkdir()
    write_tree(tmp_path, dataset="dataset5")
    runs = runs_of_datasets(tmp_path, stars)
    assert {(run.dataset, run.split) for run in runs} == {("dataset3", "random")}


def test_config_hash_knows_the_stars_but_not_the_attempt(tmp_path):
    stars = write_tree(tmp_path)
    first = runs_of_datasets(tmp_path, stars)[1]
    config = first.files["model/config.yaml"]
    tree = yaml.safe_load(config.read_text())
    config.write_text(yaml.safe_dump({**tree, "attempt": 2}))
    attempt = runs_of_datasets(tmp_path, stars)[1]
    assert attempt.config_hash == first.config_hash
    assert attempt.content_hash != first.content_hash
    scene = {"seed": 7, "scene": {"experiment": "scene1"}, "telescope": {"diameter_m": 2.0}}
    write_product(stars["dataset3"], "stars", {"a": Column(np.ones(2), "1", "")}, scene)
    assert runs_of_datasets(tmp_path, stars)[1].config_hash != first.config_hash


def test_moved_results_are_refused(site):
    site.track()
    site.results = site.results.rename(site.results.with_name("moved"))
    site.database = site.results / "mlflow.db"
    site.stars = {"dataset3": site.results / "data/seidel/stars.h5"}
    with pytest.raises(track.TrackingError, match="moved"):
        site.track()


def test_damaged_database_is_named(site):
    site.database.write_bytes(b"no database" * 100)
    with pytest.raises(track.TrackingError, match=r"mlflow\.db: .*delete it"):
        site.track()


def test_flatten():
    tree = {"a": {"b": 1, "c": {"d": [1, 2]}}, "e": "text", "f": None, "g": True}
    assert flatten(tree) == {"a.b": "1", "a.c.d": "[1, 2]", "e": "text", "f": "null", "g": "true"}


def test_mlflow_is_imported_by_the_import_only():
    code = "import sys, psfdae_paper.stages.track; print('mlflow' in sys.modules)"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "False"
