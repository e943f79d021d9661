"""Registered models restore stamps as bundles of the same fits do, in Python and as JSON."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pytest

from image_training import few_draws
from psfdae import load_model
from psfdae.base.files import Column, write_product, write_text
from psfdae.base.version import __version__
from psfdae.methods import fit_files as fits
from psfdae.methods import list_groups, method
from psfdae_paper import tracking
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
    from mlflow.exceptions import MlflowException
    from mlflow.pyfunc.scoring_server import infer_and_parse_data

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

    source = tmp_path / "evaluation/mine/random-realisation.csv"
    write_text(source, "")
    place_of_run = (tmp_path, "trials", "fit", ("dae", "mine", "random", "realisation"))
    bundle_of_fit = partial(tracking.make_bundle, kind, place, stars, "realisation", "mine-dae")
    run = TrackedRun(
        *place_of_run,
        kind.read_config(place),
        fits.own_files(kind, place),
        [place / "history.csv"],
        data=stars,
        bundle=bundle_of_fit,
    )
    database = tmp_path / "mlflow.db"
    database.write_bytes(empty_database.read_bytes())
    track.import_runs([run], "smoke", database, tmp_path / "runs.csv")
    tracking_uri = mlflow.get_tracking_uri()
    mlflow.set_tracking_uri(f"sqlite:///{database}")
    try:
        served = mlflow.pyfunc.load_model("models:/mine-dae@best")
    finally:
        mlflow.set_tracking_uri(tracking_uri)
        monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)

    stamps = np.random.default_rng(5).poisson(2e4 * gaussian_stars[:20] + 1e4).astype(np.float32)
    expected = load_model(packed).predict(stamps).psf
    np.testing.assert_array_equal(served.predict(stamps), expected)
    # As JSON, a stamp is what a served model gets.
    schema, text = served.metadata.get_input_schema(), json.dumps({"inputs": stamps[:1].tolist()})
    (stamp,) = infer_and_parse_data(json.loads(text), schema)
    np.testing.assert_allclose(served.predict(stamp[None]), expected[:1], rtol=1e-5, atol=1e-3)
    assert served.predict(served.input_example).shape == (1, 16, 16)
    folder = database.with_name("mlartifacts")
    (model_file,) = folder.rglob("MLmodel")
    requirements = (model_file.parent / "requirements.txt").read_text().splitlines()
    assert f"psfdae[dae]=={__version__}" in requirements
    # Small: the bundle, and some kilobytes of text about it.
    size = sum(path.stat().st_size for path in model_file.parent.rglob("*") if path.is_file())
    assert 0 < size - packed.stat().st_size < 30_000
    with pytest.raises(MlflowException, match="expected shape"):
        served.predict(stamps[:, :8])
