"""Registered models restore stamps as bundles of the same fits do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from image_training import few_draws
from psfdae import load_model
from psfdae.base.files import Column, write_product
from psfdae.methods import fit_files as fits
from psfdae.methods import list_groups, method
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.stages import bundle, track
from psfdae_paper.stages.evaluate import Models
from psfdae_paper.stages.fit import fit
from psfdae_paper.tracking import TrackedRun

SIZES = [
    *("parts.train_stars=200", "parts.test_stars=80", "noise.levels=[1e-3,1e-2]"),
    *("dae.kernels=[3,3]", "dae.widths=[4]", "train.epochs=1"),
]


def test_a_registered_model_restores_as_its_bundle_does(
    tmp_path, gaussian_stars, empty_database, monkeypatch
):
    import mlflow

    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    telescope = {"pixel_scale_arcsec": 0.1, "diameter_m": 1.0, "wavelength_m": 5.5e-7}
    columns = {
        "realisation": Column(gaussian_stars, "1", "noise-free image"),
        "field_index": Column(np.arange(300) % 25, "1", "field"),
        "grid": Column(np.stack([np.arange(25) % 5, np.arange(25) // 5], axis=1), "1", "index"),
    }
    stars, kind, packed = tmp_path / "stars.h5", method("dae"), tmp_path / "tiny.psf.safetensors"
    scene = {"telescope": telescope, "framing": {"jitter_px": 1, "subpixel": True}}
    write_product(stars, "stars", columns, scene)
    place = tmp_path / fits.add_suffix(kind, "fit")
    fit(load_stage(list_groups("dae"), SIZES), "dae", stars, out=place)
    config = load_stage(bundle.bundle.stage.settings.reads, SIZES)
    with few_draws():
        bundle.bundle(config, stars, Models(dae=place), out=packed)

    files = {f"model/{path.name}": path for path in fits.own_files(kind, place)}
    run = TrackedRun(
        "dae", "mine", "random", "realisation", "fit", "a fit", "trials", files, {}, stars
    )
    run = replace(run, metrics={"test_mse": 1e-5}, data=stars, fit=(kind, place))
    database = tmp_path / "mlflow.db"
    database.write_bytes(empty_database.read_bytes())
    track.import_runs([run], "smoke", database, tmp_path / "runs.csv")
    tracking_uri = mlflow.get_tracking_uri()
    mlflow.set_tracking_uri(f"sqlite:///{database}")
    try:
        folder = mlflow.artifacts.download_artifacts("models:/mine-dae@best")
    finally:
        mlflow.set_tracking_uri(tracking_uri)

    stamps = np.random.default_rng(5).poisson(2e4 * gaussian_stars[:20] + 1e4).astype(np.float32)
    registered, model = load_model(f"{folder}/mine-dae.psf.safetensors"), load_model(packed)
    np.testing.assert_array_equal(registered.predict(stamps).psf, model.predict(stamps).psf)
