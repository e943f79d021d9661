"""Registered models restore stamps as `psfdae predict` does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits as fits_files
from click.testing import CliRunner

from psfdae import fits
from psfdae.cli import main
from psfdae.methods import groups_of, method
from psfdae.model.star_sets import read_stars
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.stages import bundle, track
from psfdae_paper.stages.evaluate import Models
from psfdae_paper.stages.fit import fit
from psfdae_paper.tracking import Fit, Run
from test_bundle_stage import STARS, TINY, write_stars

SIZES = [*TINY, "gmm.components=[4]", "gmm.shrinkage=[10]", "gmm.principal=4"]


@pytest.mark.parametrize("name", ["dae", "gmm"])
def test_a_registered_model_restores_as_its_bundle_does(name, tmp_path, monkeypatch):
    import mlflow

    monkeypatch.setenv("MLFLOW_DISABLE_TELEMETRY", "true")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    stars, kind, out = write_stars(tmp_path / "stars.h5", STARS), method(name), tmp_path / "bundle"
    place = tmp_path / fits.named(kind, "fit")
    fit(load_stage(groups_of(name), SIZES), name, stars, out=place)
    config = load_stage(bundle.bundle.stage.settings.reads, SIZES)
    packed = out / "tiny.psf.safetensors"
    bundle.bundle(config, stars, Models(**{name: place}), out=packed)

    files = {f"model/{path.name}": path for path in fits.own_files(kind, place)}
    run = Run(name, "mine", "random", "realisation", "fit", "a fit", "trials", files, {}, 1, {})
    run = replace(run, metrics={"test_mse": 1e-5}, data=stars, fit=Fit(kind, place))
    database = tmp_path / "mlflow.db"
    track.import_runs([run], "smoke", database, tmp_path / "runs.csv")
    before = mlflow.get_tracking_uri()
    mlflow.set_tracking_uri(f"sqlite:///{database}")
    try:
        model = mlflow.pyfunc.load_model(f"models:/mine-{name}@best")
    finally:
        mlflow.set_tracking_uri(before)
    (tensor,) = model.metadata.signature.inputs.inputs
    assert (tensor.shape, tensor.type) == ((-1, 12, 12), np.float32)
    assert model.metadata.signature.outputs == model.metadata.signature.inputs
    assert model.input_example.shape == (1, 12, 12)

    rng, images = np.random.default_rng(5), read_stars(stars)["realisation"][:20]
    stamps = np.concatenate([rng.poisson(2e4 * images + 1e4), model.input_example])
    stamps = stamps.astype(np.float32)
    cube = tmp_path / "stamps.fits"
    header = fits_files.Header({"PIXSCALE": 0.1})
    fits_files.PrimaryHDU(stamps, header).writeto(cube)
    words = ["predict", cube, "--model", packed, "--out", tmp_path / "psfs.fits", "--quiet"]
    words += ["--pixel-scale", 0.1]
    done = CliRunner().invoke(main, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    np.testing.assert_array_equal(
        model.predict(stamps), fits_files.getdata(tmp_path / "psfs.fits", "PSF")
    )
