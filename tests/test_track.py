"""Importing finished runs into MLflow: once, again, changed, and without a server."""

from __future__ import annotations

import csv
import hashlib
import json
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
from psfdae_paper.stages import track, watch
from psfdae_paper.tracking import flatten, runs_of_datasets

TABLES = ("experiments", "experiment_tags", "runs", "metrics", "params", "tags")
TABLES += ("datasets", "inputs", "logged_models", "logged_model_metrics", "logged_model_tags")
TABLES += ("registered_models", "model_versions", "registered_model_aliases")
PNG = b"\x89PNG\r\n\x1a\n"
HISTORY = ((1, 3e-5, "nan", 1.5), (2, 2e-5, 1e-5, 3.0), (3, 1e-5, 2e-5, 4.5))


def write_history(path, rows=HISTORY):
    lines = [f"{epoch},{10 * epoch},0.001,{t},{v},{s}" for epoch, t, v, s in rows]
    path.write_text("\n".join(["epoch,step,lr,train_mse,validation_mse,seconds", *lines, ""]))


def write_config(path, **train):
    noise = {"name": "noise3", "levels": [0.003], "kappa": 4.98, "background_photons": 1e4}
    parts = {"train_stars": 30, "test_stars": 10, "validation_fraction": 0.1}
    tree = {"seed": 7, "noise": noise, "parts": parts, "split": "random", "reference": "template"}
    tree |= {"dae": {"widths": [4, 4]}, "train": {"lr": 0.001, **train}, "attempt": 1}
    path.write_text(yaml.safe_dump(tree))


def write_stars(path, **scene):
    """40 equal stars of 8 × 8 pixels, each in a field of its own."""
    images = np.full((40, 8, 8), 1 / 64, np.float32)
    columns = {
        "realisation": Column(images, "1", "stars"),
        "template": Column(images, "1", "templates"),
        "field_index": Column(np.arange(40), "1", "fields"),
        "grid": Column(np.stack([np.arange(40)] * 2, axis=1), "1", "places"),
    }
    telescope = {"diameter_m": 1.0, "wavelength_m": 5.5e-7, "pixel_scale_arcsec": 0.1}
    tree = {"seed": 7, "scene": {"experiment": "scene1"}, "stars": {"name": "seidel_10pct"}}
    tree |= {"telescope": telescope, "framing": {"jitter_px": 1}}
    write_product(path, "stars", columns, tree | scene)


def write_tree(results, dataset="dataset3", reference="template"):
    """A results folder as the workflow leaves it, without any training."""
    values = {"a": Column(np.arange(3.0), "1", "values")}
    stars = results / "data/seidel/stars.h5"
    write_stars(stars)
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

    def runs(self, kind="dae", where=None):
        from mlflow import MlflowClient

        client = MlflowClient(f"sqlite:///{self.database}")
        experiment = client.get_experiment_by_name("scene1").experiment_id
        return client.search_runs([experiment], where or f"tags.kind = '{kind}'")

    def versions(self):
        from mlflow import MlflowClient

        return list(MlflowClient(f"sqlite:///{self.database}").search_model_versions())

    def history(self, run, metric):
        from mlflow import MlflowClient

        client = MlflowClient(f"sqlite:///{self.database}")
        return client.get_metric_history(run.info.run_id, metric)

    def sizes(self):
        """Rows of the tables that must not grow."""
        with sqlite3.connect(self.database) as connection:
            return {
                table: connection.execute(f"select count(*) from {table}").fetchone()[0]
                for table in TABLES
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
    assert baseline.data.params["baseline.components"] == "2"
    assert dae.data.metrics["test_mse_0.003"] == 3e-5
    assert baseline.data.metrics["test_mse_0.003"] == 2e-5
    assert dae.data.metrics["test_ssim_stderr_0.003"] == 1e-7
    assert dae.data.metrics["best_validation_mse"] == 1e-5
    points = site.history(dae, "train_mse")
    assert [(p.step, p.value) for p in points] == [(1, 3e-5), (2, 2e-5), (3, 1e-5)]
    assert [p.timestamp - dae.info.start_time for p in points] == [1500, 3000, 4500]
    assert [p.step for p in site.history(dae, "validation_mse")] == [2, 3]


def test_settings_that_tell_no_run_from_others_are_not_shown(site):
    """Those of the preset for the dataset; files have all, and a hash tells them apart."""
    site.track()
    own = {"method": "dae", "split": "random", "reference": "template"}
    changed = {"seed": "7", "dae.widths": "[4, 4]", "train.lr": "0.001"}
    changed |= {"parts.train_stars": "30", "parts.test_stars": "10"}
    of_dataset = {"stars.name": "seidel_10pct", "noise.name": "noise3", "noise.levels": "[0.003]"}
    (dae,) = site.runs()
    assert dae.data.params == {**own, **changed, **of_dataset}
    write_config(site.dae / "config.yaml", lr=0.006)  # the preset's
    site.track()
    (now,) = (run for run in site.runs() if run.data.tags["superseded"] == "false")
    assert "train.lr" not in now.data.params
    assert now.data.tags["config_hash"] != dae.data.tags["config_hash"]


def test_data_are_an_input_with_digest_and_schema(site):
    site.track()
    (dae,) = site.runs()
    (given,) = dae.inputs.dataset_inputs
    data = given.dataset
    assert (data.name, data.source_type) == ("dataset3", "local")
    digest = hashlib.sha256(site.stars["dataset3"].read_bytes()).hexdigest()
    assert digest.startswith(data.digest)
    features = json.loads(json.loads(data.schema)["mlflow_tensorspec"]["features"])
    shapes = {feature["name"]: feature["tensor-spec"]["shape"] for feature in features}
    assert shapes["realisation"] == [-1, 8, 8]
    assert {tag.key: tag.value for tag in given.tags} == {"mlflow.data.context": "training"}


def test_model_has_its_metrics_and_is_a_version_of_the_dataset_and_method(site):
    from mlflow import MlflowClient

    site.track()
    client = MlflowClient(f"sqlite:///{site.database}")
    (dae,), (baseline,) = site.runs("dae"), site.runs("baseline")
    for run in (dae, baseline):
        (output,) = run.outputs.model_outputs
        model = client.get_logged_model(output.model_id)
        assert (model.status, model.source_run_id) == ("READY", run.info.run_id)
        metrics = {metric.key: metric for metric in model.metrics}
        assert metrics["test_mse"].value == run.data.metrics["test_mse"]
        assert metrics["test_mse"].dataset_name == "dataset3"
        assert "train_mse" not in metrics
    # No bundle holds a baseline.
    (registered,) = client.search_registered_models()
    assert registered.name == "dataset3-dae"
    version = client.get_model_version_by_alias("dataset3-dae", "best")
    assert version.run_id == dae.info.run_id
    assert version.tags == {"split": "random", "reference": "template", "test_mse": "3e-05"}


def test_best_is_the_version_that_errs_least_of_the_present_results(site):
    from mlflow import MlflowClient

    def best():
        client = MlflowClient(f"sqlite:///{site.database}")
        version = client.get_model_version_by_alias("dataset3-dae", "best")
        return client.get_run(version.run_id).data

    site.track()
    write_config(site.dae / "config.yaml", lr=0.01)  # errs as much, and is the present one
    site.track()
    assert best().params["train.lr"] == "0.01"
    other = site.dae.with_name("random-realisation")
    shutil.copytree(site.dae, other)
    table = site.results / "evaluation/dataset3/random-template.csv"
    text = table.read_text().replace("template", "realisation").replace("3e-05", "4e-05")
    table.with_name("random-realisation.csv").write_text(text)
    site.track()  # errors to templates do not compete with errors to realisations
    assert best().tags["reference"] == "realisation"


def test_page_opens_on_tables_that_compare(site):
    from mlflow import MlflowClient

    site.track()
    experiment = MlflowClient(f"sqlite:///{site.database}").get_experiment_by_name("scene1")
    assert experiment.tags["mlflow.experimentKind"] == "custom_model_development"
    views = dict(watch.views_in(site.database))
    assert list(views) == ["scene1, all runs", "  dataset3"]
    for place in views.values():
        assert place in experiment.tags["mlflow.note.content"]
        assert "workflowType=machine_learning" in place
    view = json.loads(experiment.tags["mlflow.sharedViewState.dataset3"])
    assert view["searchFilter"] == "tags.superseded = 'false' and tags.dataset = 'dataset3'"
    assert view["orderByKey"] == "metrics.`test_mse`"
    assert {"metrics.`test_mse`", "metrics.`test_mse_0.003`"} <= set(view["selectedColumns"])
    found = site.runs(where=view["searchFilter"])
    assert {run.data.tags["kind"] for run in found} == {"dae", "baseline"}


def test_a_description_that_somebody_has_written_stays(site):
    from mlflow import MlflowClient

    site.track()
    client = MlflowClient(f"sqlite:///{site.database}")
    experiment = client.get_experiment_by_name("scene1")
    assert experiment.tags["mlflow.note.content"].startswith("Scene 1: ")
    client.set_experiment_tag(experiment.experiment_id, "mlflow.note.content", "mine")
    site.track()
    assert client.get_experiment_by_name("scene1").tags["mlflow.note.content"] == "mine"


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
    assert run.data.params["stars.name"] == "seidel_10pct"
    assert set(site.track().values()) == {"unchanged"}
    (folder / "dataset3.csv").unlink()
    with pytest.raises(ProductError, match=r"dataset3\.csv: missing; run `snakemake wavefront`"):
        site.track()


def test_artifacts_lie_beside_the_database(site):
    site.track()
    (run,), experiment = site.runs(), site.results / "mlartifacts/scene1"
    folder = experiment / run.info.run_id / "artifacts"
    model = experiment / "models" / run.outputs.model_outputs[0].model_id / "artifacts"
    found, of_model = (
        {p.relative_to(place).as_posix() for p in place.rglob("*") if p.is_file()}
        for place in (folder, model)
    )
    assert found == {
        *("config.yaml", "history.csv", "evaluation.csv"),
        *("figures/curves.png", "figures/random-template_strip.png"),
    }
    assert of_model == {
        *("MLmodel", "input_example.json"),
        *("data/dae.safetensors", "data/config.yaml", "data/stars.h5"),
    }
    assert not any(p.is_symlink() for p in experiment.rglob("*"))
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
    assert [version.run_id for version in site.versions()] == [run.info.run_id]
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


@pytest.mark.parametrize("step", ["log_artifacts", "log_model_artifacts", "set_terminated"])
def test_killed_import_is_repaired(site, monkeypatch, step):
    from mlflow import MlflowClient

    def killed(*arguments, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(MlflowClient, step, killed)
        with pytest.raises(KeyboardInterrupt):
            site.track()
    assert len(site.runs("baseline")) + len(site.runs("dae")) == 1
    site.track()
    assert len(site.runs("baseline")) == len(site.runs("dae")) == 1
    assert all(run.info.status == "FINISHED" for run in site.runs("baseline") + site.runs("dae"))
    assert len(site.versions()) == 1


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
    write_stars(stars["dataset3"], telescope={"diameter_m": 2.0})
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
