"""Importing finished runs into MLflow: once, again, changed, and without a server."""

from __future__ import annotations

import hashlib
import shutil
import socket

import pytest
import yaml

from psfdae_paper.stages import track
from psfdae_paper.tracking import read_dataset_runs
from tracked_results import write_config, write_history, write_stars, write_tree


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
