"""Importing finished runs into MLflow: once, again, changed, and without a server."""

from __future__ import annotations

import csv
import hashlib
import shutil
import socket
import sqlite3

import numpy as np
import pytest
import yaml

from psfdae.base.files import Column, write_product, write_text
from psfdae_paper import registry
from psfdae_paper.stages import track
from psfdae_paper.tracking import read_dataset_runs

TABLES = ("runs", "metrics", "params", "tags", "inputs", "logged_models", "model_versions")
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


def write_tree(results):
    """A results folder as the workflow leaves it, without any training."""
    dataset, reference = "dataset3", "template"
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
    # What Snakemake says of the job.
    write_text(results / "benchmarks/baseline/dataset3/random.tsv", "s\tmax_rss\n12.5\t90\n")
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
        shutil.copy(empty_database, self.database)

    def track(self):
        """Import everything; actions by kind of run, as the receipt tells."""
        receipt = self.results / "runs.csv"
        stars = tuple(self.stars.items())
        track.track(self.results, "smoke", self.database, receipt, stars)
        with receipt.open(newline="") as file:
            return {row["kind"]: row["action"] for row in csv.DictReader(file)}

    @property
    def client(self):
        from mlflow import MlflowClient

        return MlflowClient(f"sqlite:///{self.database}")

    def runs(self, kind="dae", experiment="scene1"):
        number = self.client.get_experiment_by_name(experiment).experiment_id
        query = f"tags.kind = '{kind}'" if experiment == "scene1" else ""
        return self.client.search_runs([number], query)

    def history(self, run, metric):
        return self.client.get_metric_history(run.info.run_id, metric)

    def rows(self):
        """The number of rows of all runs, metrics and models, which an import must not double."""
        with sqlite3.connect(self.database) as connection:
            counts = [connection.execute(f"select count(*) from {table}") for table in TABLES]
            return [count.fetchone()[0] for count in counts]


@pytest.fixture
def site(tmp_path, empty_database, monkeypatch):
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    # The stage sets these; setenv makes pytest restore them.
    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "1")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    monkeypatch.setattr(registry, "make_bundle", lambda *arguments: None)
    monkeypatch.setattr(registry, "write_bundle", lambda bundle, path: path.write_text("bundle"))
    return Site(tmp_path, empty_database)


def test_run_holds_what_the_files_say(site):
    assert site.track() == {"dae": "created", "pca_som": "created"}
    (dae,), (baseline,) = site.runs("dae"), site.runs("pca_som")
    assert (dae.info.run_name, dae.info.status) == ("dae dataset3 random template", "FINISHED")
    # The duration is that of the job, or else of the training.
    durations = [run.info.end_time - run.info.start_time for run in (dae, baseline)]
    assert durations == [4500, 12500]
    # Those settings are shown that differ from the preset's, and those of dataset and method.
    assert dae.data.params == {
        **{"method": "dae", "split": "random", "reference": "template", "seed": "7"},
        **{"dae.widths": "[4, 4]", "train.lr": "0.001"},
        **{"parts.train_stars": "30", "parts.test_stars": "10"},
        **{"stars.name": "seidel_10pct", "noise.name": "noise3", "noise.levels": "[0.003]"},
    }
    assert baseline.data.metrics["test_mse_1e-6"] == pytest.approx(20)
    metrics = {"test_mse_1e-6": 30, "best_validation_mse_1e-6": 10, "epoch/lr": 1e-3}
    metrics |= {"lambda_1e-6/test_ssim": 0.3, "lambda_1e-6/test_mse_stderr_1e-6": 0.1}
    for name, value in metrics.items():
        assert dae.data.metrics[name] == pytest.approx(value)
    for name, expected in (
        ("epoch/train_mse_1e-6", [(1, 30), (2, 20), (3, 10)]),
        ("lambda_1e-6/test_mse_1e-6", [(3000, 30)]),
    ):
        points = [(p.step, p.value) for p in site.history(dae, name)]
        assert points == [pytest.approx(point) for point in expected]
    (dataset_input,) = dae.inputs.dataset_inputs
    digest = hashlib.sha256(site.stars["dataset3"].read_bytes()).hexdigest()
    assert dataset_input.dataset.name == "dataset3" and digest.startswith(
        dataset_input.dataset.digest
    )
    # Copies of the files lie beside the database.
    artifacts = site.results / "mlartifacts/scene1"
    copies = artifacts / dae.info.run_id / "artifacts"
    for name in ("config.yaml", "evaluation.csv", "figures/random-template_strip.png"):
        assert (copies / name).is_file()
    assert not (copies / "figures/held_out-template_strip.png").exists()
    model = f"models/{dae.outputs.model_outputs[0].model_id}/artifacts"
    assert (artifacts / model / "dae.safetensors").read_bytes() == b"weights"


def test_best_is_the_version_that_errs_least_of_the_present_results(site):
    def best():
        version = site.client.get_model_version_by_alias("dataset3-dae", "best")
        return site.client.get_run(version.run_id).data

    site.track()
    # No bundle holds a baseline.
    assert len(site.client.search_registered_models()) == 1
    assert best().metrics["test_mse_1e-6"] == pytest.approx(30)
    write_config(site.dae / "config.yaml", lr=0.01)  # errs as much, and is the present one
    site.track()
    assert best().params["train.lr"] == "0.01"
    shutil.copytree(site.dae, site.dae.with_name("random-realisation"))
    table = site.results / "evaluation/dataset3/random-template.csv"
    text = table.read_text().replace("template", "realisation").replace("3e-05", "4e-05")
    table.with_name("random-realisation.csv").write_text(text)
    site.track()  # errors to templates do not compete with errors to realisations
    assert best().tags["reference"] == "realisation"


def test_changed_files_replace_a_run_and_another_config_supersedes_it(site):
    def superseded():
        return {run.info.run_id: run.data.tags["superseded"] for run in site.runs()}

    site.track()
    runs_before = site.rows(), [run.to_dictionary() for run in site.runs()]
    (site.dae / "dae.safetensors").touch()
    assert site.track() == {"dae": "unchanged", "pca_som": "unchanged"}
    assert (site.rows(), [run.to_dictionary() for run in site.runs()]) == runs_before
    write_history(site.dae / "history.csv", [(1, 5e-5, 4e-5, 2.0), (2, 4e-5, 6e-5, 3.0)])
    assert site.track() == {"dae": "updated", "pca_som": "unchanged"}
    (run,) = site.runs()
    assert [p.value for p in site.history(run, "epoch/train_mse_1e-6")] == pytest.approx([50, 40])
    (version,) = site.client.search_model_versions()
    first = run.info.run_id
    assert version.run_id == first
    write_config(site.dae / "config.yaml", lr=0.006)
    assert site.track() == {"dae": "created", "pca_som": "unchanged"}
    assert superseded().pop(first) == "true" and len(superseded()) == 2
    write_config(site.dae / "config.yaml")
    assert site.track() == {"dae": "unchanged", "pca_som": "unchanged"}
    assert superseded().pop(first) == "false"
    assert sorted(superseded().values()) == ["false", "true"]


def test_killed_import_is_repaired(site, monkeypatch):
    from mlflow import MlflowClient

    def killed(*arguments, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(MlflowClient, "log_model_artifacts", killed)
        with pytest.raises(KeyboardInterrupt):
            site.track()
    assert len(site.runs("pca_som")) + len(site.runs("dae")) == 1
    site.track()
    runs = site.runs("pca_som") + site.runs("dae")
    assert [run.info.status for run in runs] == ["FINISHED", "FINISHED"]
    assert len(site.client.search_model_versions()) == 1


def test_unreachable_server_costs_a_message(site, monkeypatch, capsys):
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{server.getsockname()[1]}"
        monkeypatch.setenv("MLFLOW_TRACKING_URI", address)
        assert site.track() == {"dae": "not sent", "pca_som": "not sent"}
    out = capsys.readouterr().out
    assert address in out
    assert "pca_som dataset3 random template, dae dataset3 random template" in out


def test_config_hash_knows_the_stars_but_not_the_attempt(tmp_path):
    stars = write_tree(tmp_path)
    _, first = read_dataset_runs(tmp_path, stars)
    config, content_hash = first.files["model/config.yaml"], first.content_hash
    tree = yaml.safe_load(config.read_text())
    config.write_text(yaml.safe_dump({**tree, "attempt": 2}))
    attempt = read_dataset_runs(tmp_path, stars)[1]
    assert attempt.config_hash == first.config_hash
    assert attempt.content_hash != content_hash
    write_stars(stars["dataset3"], telescope={"diameter_m": 2.0})
    assert read_dataset_runs(tmp_path, stars)[1].config_hash != first.config_hash


def test_moved_results_and_a_damaged_database_are_refused(site):
    site.track()
    site.results = site.results.rename(site.results.with_name("moved"))
    site.database = site.results / "mlflow.db"
    site.stars = {"dataset3": site.results / "data/seidel/stars.h5"}
    with pytest.raises(track.TrackingError, match="moved"):
        site.track()
    site.database.write_bytes(b"no database" * 100)
    with pytest.raises(track.TrackingError, match=r"mlflow\.db: .*delete it"):
        site.track()
