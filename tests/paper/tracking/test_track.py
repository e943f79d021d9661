"""Importing finished runs into MLflow: once, again, changed, and without a server."""

from __future__ import annotations

import hashlib
import os
import shutil
import socket
import sqlite3
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from mlflow.exceptions import MlflowException

from psfdae.base.files import Column, ProductError, write_product, write_text
from psfdae.methods import method
from psfdae_paper import registry, tracking
from psfdae_paper.configuration.estimators import Estimator, list_trained_networks
from psfdae_paper.configuration.experiment import Experiment
from psfdae_paper.stages import experiment as experiment_stage
from psfdae_paper.stages import track
from psfdae_paper.tracking import read_dataset_runs
from tracked_results import ALL, write_config, write_history, write_stars, write_tree

ROOT = Path(__file__).resolve().parents[3]


def test_run_holds_what_the_files_say(site):
    assert site.track() == dict.fromkeys(ALL, "created")
    (dae,), (baseline,), (noisy,) = map(site.runs, ("dae", "pca_som", "noisy"))
    assert (dae.info.run_name, dae.info.status) == ("dae dataset3 random template", "FINISHED")
    # The duration is that of the job, or else of the training.
    durations = [run.info.end_time - run.info.start_time for run in (dae, baseline, noisy)]
    assert durations == [4500, 12500, 0]
    # All settings are shown, of the stars, too, and none that is a result.
    key = {"dataset": "dataset3", "split": "random", "reference": "template", "preset": "smoke"}
    seen = {"seed": "7", "noise.levels": "[0.003]", "parts.train_stars": "30"}
    stars = {"stars.name": "seidel_10pct", "telescope.diameter_m": "1.0"}
    own = {"kind": "dae", "dae.widths": "[4, 4]", "train.lr": "0.001"}
    assert {**key, **seen, **stars, **own}.items() <= dae.data.params.items()
    assert {**key, **seen, **stars, "kind": "noisy"}.items() <= noisy.data.params.items()
    assert baseline.data.params["baseline.components"] == "2"
    assert "attempt" not in dae.data.params and "train.lr" not in noisy.data.params
    means = [run.data.metrics["test_mse_1e-6"] for run in (noisy, baseline, dae)]
    assert means == pytest.approx([10, 20, 30])
    metrics = {"test_mse_1e-6": 30, "test_mse_1e-6/0.003": 30, "test_ssim/0.003": 0.3}
    metrics |= {"test_mse_stderr_1e-6/0.003": 0.1, "best_validation_mse_1e-6": 10}
    metrics |= {"epoch/lr": 1e-3}
    for name, value in metrics.items():
        assert dae.data.metrics[name] == pytest.approx(value)
    points = [(p.step, p.value) for p in site.history(dae, "epoch/train_mse_1e-6")]
    assert points == [pytest.approx(point) for point in [(1, 30), (2, 20), (3, 10)]]
    (dataset_input,) = dae.inputs.dataset_inputs
    digest = hashlib.sha256(site.stars["dataset3"].read_bytes()).hexdigest()
    assert dataset_input.dataset.name == "dataset3" and digest.startswith(
        dataset_input.dataset.digest
    )
    assert "data/seidel/stars.h5" in dataset_input.dataset.source
    assert str(site.results) not in dataset_input.dataset.source
    # Copies of the files lie beside the database, by their names in the results folder.
    artifacts = site.results / "mlartifacts/scene1"
    copies = artifacts / dae.info.run_id / "artifacts"
    names = ("evaluation/dataset3/random-template.csv", "figures/dataset3/curves.png")
    for name in (*names, "dae/dataset3/random-template/history.csv"):
        assert (copies / name).read_bytes() == (site.results / name).read_bytes()
    fit = artifacts / baseline.info.run_id / "artifacts/pca_som/dataset3/random.h5"
    assert fit.read_bytes() == (site.results / "pca_som/dataset3/random.h5").read_bytes()
    # The model is there once, as its bundle.
    assert not list(artifacts.rglob("dae.safetensors"))
    (model,) = artifacts.rglob("*.psf.safetensors")
    assert dae.outputs.model_outputs[0].model_id in model.parts


def test_best_has_the_smallest_validation_error_on_the_same_stars(site):
    """Test errors choose nothing; other noise makes another task."""

    def best(alias="best-random-template"):
        version = site.client.get_model_version_by_alias("dataset3-dae", alias)
        return site.client.get_run(version.run_id).data.params["train.lr"]

    table = site.results / "evaluation/dataset3/random-template.csv"
    text = table.read_text()
    # Learning rate, validation error and test error of runs one after the other.
    for lr, validation, test, winner in (
        (0.001, 1e-5, "3e-05", "0.001"),
        (0.002, 3e-5, "1e-05", "0.001"),
        (0.003, 5e-6, "9e-05", "0.003"),
    ):
        write_config(site.dae / "config.yaml", lr=lr)
        write_history(site.dae / "history.csv", [(1, 3e-5, validation, 1.5)])
        table.write_text(text.replace("dae,0.003,mse,3e-05", f"dae,0.003,mse,{test}"))
        site.track()
        assert best() == winner
    # No bundle holds a baseline.
    (model,) = site.client.search_registered_models()
    assert model.aliases.keys() == {"best-random-template"}
    # Only runs with the noise of the present results compete.
    tree = yaml.safe_load((site.dae / "config.yaml").read_text())
    tree["train"]["lr"], tree["noise"]["levels"] = 0.004, [0.005]
    (site.dae / "config.yaml").write_text(yaml.safe_dump(tree))
    write_history(site.dae / "history.csv", [(1, 3e-5, 8e-5, 1.5)])
    site.track()
    assert best() == "0.004"
    # Each reference has its own best run, "best" alone is for realisations of a random split.
    shutil.copytree(site.dae, site.dae.with_name("random-realisation"))
    text = table.read_text().replace("template", "realisation")
    table.with_name("random-realisation.csv").write_text(text)
    copy = table.with_name("random-realisation.h5")
    shutil.copy(table.with_suffix(".h5"), copy)
    site.track()
    (model,) = site.client.search_registered_models()
    assert len(set(model.aliases.values())) == len(model.aliases) == 2
    assert best("best") == "0.004"


def test_a_method_without_a_validation_error_has_no_best(site):
    """A method that is fitted to its validation stars says so."""
    for kind in (method("gmm"), method("dae")):
        registry.register(site.client, kind.name, kind)
    models = {model.name: model.description for model in site.client.search_registered_models()}
    assert "no validation error" in models["gmm"] and not models["dae"]
    for name in models:
        site.client.delete_registered_model(name)
    write_history(site.dae / "history.csv", [(1, 3e-5, "nan", 1.5)])
    site.track()
    (model,) = site.client.search_registered_models()
    assert not model.aliases and len(site.client.search_model_versions()) == 1


def test_changed_files_replace_a_run_and_another_config_supersedes_it(site):
    def superseded():
        return {run.info.run_id: run.data.tags["superseded"] for run in site.runs()}

    site.track()
    runs_before = site.rows(), [run.to_dictionary() for run in site.runs()]
    (site.dae / "dae.safetensors").touch()
    assert site.track() == dict.fromkeys(ALL, "unchanged")
    assert (site.rows(), [run.to_dictionary() for run in site.runs()]) == runs_before
    write_history(site.dae / "history.csv", [(1, 5e-5, 4e-5, 2.0), (2, 4e-5, 6e-5, 3.0)])
    assert site.track() == dict.fromkeys(ALL, "unchanged") | {"dae": "updated"}
    (run,) = site.runs()
    points = site.history(run, "epoch/train_mse_1e-6")
    assert [point.value for point in points] == pytest.approx([50, 40])
    (version,) = site.client.search_model_versions()
    first = run.info.run_id
    assert version.run_id == first
    write_config(site.dae / "config.yaml", lr=0.006)
    assert site.track() == dict.fromkeys(ALL, "unchanged") | {"dae": "created"}
    assert superseded().pop(first) == "true" and len(superseded()) == 2
    write_config(site.dae / "config.yaml")
    assert site.track() == dict.fromkeys(ALL, "unchanged")
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
    assert {run.info.status for run in site.runs("dae")} == {"RUNNING"}
    site.track()
    runs = [run for kind in ALL for run in site.runs(kind)]
    assert [run.info.status for run in runs] == ["FINISHED"] * 3
    assert len(site.client.search_model_versions()) == 1


@pytest.mark.parametrize(
    ("create", "name"),
    [("create_registered_model", "dataset3-dae"), ("create_experiment", "scene1")],
)
def test_two_importers_of_a_server_do_not_stop_each_other(site, monkeypatch, create, name):
    """The other importer creates a name just before this one does."""
    from mlflow import MlflowClient

    original, calls = getattr(MlflowClient, create), []

    def create_second(client, *arguments, **options):
        if not calls:
            original(client, *arguments, **options)
        calls.append(arguments[0])
        return original(client, *arguments, **options)

    monkeypatch.setattr(MlflowClient, create, create_second)
    assert site.track() == dict.fromkeys(ALL, "created")
    assert calls[0] == name
    # Any other error of the database is not accepted.
    with pytest.raises(MlflowException, match="Missing value"):
        registry.register(site.client, "", method("dae"))


def test_experiment_is_a_parent_run_with_a_child_per_method_and_variant(site):
    """Children have dataset, setting, overrides and seed, and no registered model."""
    definition = Experiment(
        datasets=["dataset3"],
        overrides={"dataset.splits": ["random"]},
        settings={"paper": {}, "low": {"noise.levels": [0.003]}},
        seeds=[7, 8],
    )
    stars = {variant.name: site.results / f"{variant.seed}.h5" for variant in definition.variants}
    for variant in definition.variants:
        write_stars(stars[variant.name], seed=variant.seed)
        copy_variant(site, variant)
    evaluations = [site.results / f"evaluation/{name}/random-template.csv" for name in stars]
    folder = site.results / "experiments/mine"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment_stage, "load_experiment", lambda name: definition)
        experiment_stage.experiment("mine", evaluations, ("preset=smoke",), folder)
    experiment_stage.figure_experiment(folder / "errors.csv", "mine", folder / "errors.png")

    def actions():
        receipt = site.results / "receipt.csv"
        options = {"stars": tuple(stars.items()), "experiment": "mine"}
        track.track(site.results, "smoke", site.database, receipt, **options)
        return pd.read_csv(receipt).action.tolist()

    assert actions() == ["created"] * (1 + 4 * 3)
    assert actions() == ["unchanged"] * (1 + 4 * 3)
    runs = {run.info.run_name: run for run in site.runs("", "experiment_mine")}
    parent = runs.pop("experiment mine")
    assert parent.data.params["settings.low.noise.levels"] == "[0.003]"
    assert parent.data.params["given"] == '["preset=smoke"]'
    child = runs["dae dataset3 low seed=8"].data
    assert child.tags["mlflow.parentRunId"] == parent.info.run_id
    assert child.tags["setting"] == "low"
    assert child.tags["overrides"] == "dataset.splits=[random] noise.levels=[0.003] seed=8"
    assert (child.params["dataset"], child.params["seed"]) == ("dataset3", "8")
    assert child.metrics["test_mse_1e-6"] == pytest.approx(30)
    assert len(runs) == 12 and not site.client.search_registered_models()


def copy_variant(site, variant):
    """Files of dataset 3, as if a variant had them with its seed."""
    stems = ("evaluation/{}", "dae/{}", "pca_som/{}")
    for stem in stems:
        source = site.results / stem.format("dataset3")
        shutil.copytree(source, site.results / stem.format(variant.name))
    table = site.results / f"evaluation/{variant.name}/random-template.csv"
    table.write_text(table.read_text().replace("dataset3", variant.name))
    config = site.results / f"dae/{variant.name}/random-template/config.yaml"
    tree = yaml.safe_load(config.read_text()) | {"seed": variant.seed}
    config.write_text(yaml.safe_dump(tree))
    values = {"a": Column(np.arange(3.0), "1", "values")}
    baseline = {"seed": variant.seed, "baseline": {"components": 2}}
    path = site.results / f"pca_som/{variant.name}/random.h5"
    write_product(path, "pca_som", values, baseline)
    settings = {group: tree[group] for group in ("seed", "noise", "parts", "split", "reference")}
    write_product(
        table.with_suffix(".h5"), "restored", values, settings | {"dataset": variant.name}
    )


def test_unreachable_server_costs_a_message(site, monkeypatch, capsys):
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{server.getsockname()[1]}"
        monkeypatch.setenv("MLFLOW_TRACKING_URI", address)
        assert site.track() == dict.fromkeys(ALL, "not sent")
    out = capsys.readouterr().out
    assert address in out
    assert "Not sent: " + ", ".join(f"{kind} dataset3 random template" for kind in ALL) in out


def test_config_hash_knows_the_stars_but_not_the_attempt(tmp_path):
    stars = write_tree(tmp_path)
    first = read_dataset_runs(tmp_path, stars)[2]
    config, content_hash = first.fit_files[1], first.content_hash
    tree = yaml.safe_load(config.read_text())
    config.write_text(yaml.safe_dump({**tree, "attempt": 2}))
    attempt = read_dataset_runs(tmp_path, stars)[2]
    assert attempt.config_hash == first.config_hash
    assert attempt.content_hash != content_hash
    write_stars(stars["dataset3"], telescope={"diameter_m": 2.0})
    assert read_dataset_runs(tmp_path, stars)[2].config_hash != first.config_hash


@pytest.mark.parametrize(
    ("experiment", "target"),
    [("", "snakemake dataset3"), ("mine", "snakemake experiment --config name=mine")],
)
def test_a_run_without_evaluations_names_a_target_that_there_is(tmp_path, experiment, target):
    """A variant of a dataset, as of an experiment, is no target."""
    stars = (("dataset3", tmp_path / "stars.h5"),)
    options = {"stars": stars, "experiment": experiment}
    with pytest.raises(ProductError, match=f"no evaluations; run `{target}` first"):
        track.track(tmp_path, "fast", tmp_path / "m.db", tmp_path / "runs.csv", **options)


def test_scene_3_and_a_night_are_read_from_their_tables(tmp_path):
    errors = tmp_path / "tables/alignment_errors.csv"
    errors.parent.mkdir()
    shutil.copy(ROOT / "results/reference/tables/alignment_errors.csv", errors)
    for kind in ("dae", *list_trained_networks()):
        folder = tmp_path / "alignment" / kind
        folder.mkdir(parents=True)
        name = "dae.safetensors" if kind == "dae" else Estimator.weights_file
        (folder / name).write_bytes(b"weights")
        (folder / "config.yaml").write_text("seed: 7\nattempt: 1\n")
        write_history(folder / "history.csv")
    runs = {run.key[0]: run for run in tracking.read_alignment_runs(tmp_path)}
    assert runs.keys() == {"dae", *list_trained_networks()}
    table = pd.read_csv(errors).query("test_set == 'grid' and unit == 'range'")
    row = table.query("method == 'original' and noise_level == 0.002 and parameter == 'tilt_y'")
    metrics = runs["original"].metrics
    assert metrics["grid_tilt_y_bias_0.002"] == pytest.approx(row.bias.item())
    assert metrics["grid_tilt_y_mean_abs_error_0.002"] == pytest.approx(row.mean_abs_error.item())
    assert all(file.is_file() for run in runs.values() for file in run.fit_files)
    assert runs["original"].config == {"seed": 7} and len(runs["original"].epochs) == 3

    night = tmp_path / "night/night.csv"
    header = "image,name,time,verdict,reason,stars,zero_point,seeing"
    rows = ["a.fits,a,2026-01-01T00:00:00,poor,clouds,12,25.5,1.5", "b.fits,b,,failed,,,,"]
    write_text(night, "\n".join([header, *rows, ""]))
    write_text(tmp_path / "night/images/a.psf.safetensors", "model")
    (run,) = tracking.read_night_runs(tmp_path)
    assert run.metrics == {"stars": 12, "zero_point": 25.5, "seeing": 1.5}
    assert run.tags == {"verdict": "poor", "reason": "clouds", "time": "2026-01-01T00:00:00"}
    assert (run.name, run.config, run.bundle is None) == ("a", {"image": "a.fits"}, False)


def test_moved_results_still_open(site):
    """Names of files in the database name no folder, so that a program opens a copy of it."""
    site.track()
    with sqlite3.connect(site.database) as connection:
        assert str(site.results) not in "".join(connection.iterdump())
    site.results = site.results.rename(site.results.with_name("moved"))
    site.database = site.results / "mlflow.db"
    site.stars = {"dataset3": site.results / "data/seidel/stars.h5"}
    # In a process of its own, because MLflow remembers where files were. It registers the entry
    # point as MLflow does for an installed package, whose metadata may be older than these sources.
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (entry_point,) = project["entry-points"]["mlflow.artifact_repository"].items()
    code = f"""if True:
        import pkgutil

        import mlflow
        from mlflow.store.artifact import artifact_repository_registry as registry

        scheme, name = {entry_point}
        registry.get_registered_artifact_repositories()[scheme] = pkgutil.resolve_name(name)
        print(mlflow.pyfunc.load_model("models:/dataset3-dae@best-random-template").input_example)
        run, = mlflow.search_runs(experiment_names=["scene1"], filter_string="tags.kind = 'noisy'",
                                  output_format="list")
        uri = run.info.artifact_uri + "/evaluation/dataset3/random-template.csv"
        print(mlflow.artifacts.load_text(uri))
    """
    variables = {**os.environ, "MLFLOW_TRACKING_URI": f"sqlite:///{site.database}"}
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=variables, check=False
    )
    assert run.returncode == 0, run.stderr
    assert "dataset3,random,template,noisy,0.003,mse" in run.stdout
    assert site.track() == dict.fromkeys(ALL, "unchanged")


def test_a_database_of_an_earlier_version_and_a_damaged_one_are_refused(site):
    site.client.create_experiment("scene1", artifact_location=site.results.as_uri())
    with pytest.raises(track.TrackingError, match="earlier version"):
        site.track()
    site.database.write_bytes(b"no database" * 100)
    with pytest.raises(track.TrackingError, match=r"mlflow\.db: .*delete it"):
        site.track()
