"""From Python: stars of an image, a fit, its validation; the command is these calls."""

from __future__ import annotations

import ast
import shutil

import numpy as np
import pandas as pd
import pytest
from astropy.io import fits
from astropy.table import Table
from click.testing import CliRunner

import psfdae
from docs_pages import blocks, read
from psfdae.cli import main
from psfdae.model import packing
from psfdae.model.settings import CHOSEN, from_words, of_config, settings_model
from psfdae_paper.configuration.compose import load_stage
from psfdae_paper.stages import simulate

SIDE = {"side_px": 700, "bright": 60, "faint": 80, "blended": 6, "saturated": 3}
SIZES = {"train_stars": 120, "test_stars": 40}
WORDS = [f"parts.{name}={value}" for name, value in SIZES.items()]
QUICK = {"orders": [0, 1], "modes": 8}
QUICK_WORDS = ["field.orders=[0,1]", "field.modes=8"]


@pytest.fixture(scope="module", autouse=True)
def few_draws():
    """Errors of models are measured on few noisy images."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("NODES", 3), ("LEAST_STARS", 60), ("FEW_STARS", 40)):
            patch.setattr(packing, name, value)
        yield


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """Paths of a small simulated image and of its star list."""
    folder = tmp_path_factory.mktemp("sky")
    paths = folder / "image.fits", folder / "stars.csv"
    simulate.write_example(*paths, seed=5, **SIDE)
    return paths


@pytest.fixture(scope="module")
def stars(sky):
    return psfdae.Stars.from_image(sky[0], catalogue=sky[1], **SIZES)


@pytest.fixture(scope="module")
def model(stars):
    return psfdae.fit(stars, method="field", **QUICK)


def test_the_command_is_the_calls(sky, model, stars, tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    out, page = tmp_path / "model", tmp_path / "page.html"
    words = [str(sky[0]), "--catalogue", str(sky[1]), "--method", "field", "--out", str(out)]
    done = CliRunner().invoke(
        main, ["from-stars", *words, "--report", str(page), *WORDS, *QUICK_WORDS]
    )
    assert done.exit_code == 0, done.output
    by_command = psfdae.load_model(out / "image.psf.safetensors")
    assert by_command.bundle.sha256 == model.bundle.sha256
    report = psfdae.validate(model, stars)
    assert str(report) == done.output.splitlines()[-2]
    table = pd.read_csv(out / "report.csv")
    assert set(table.method) == {"noisy", "lmmse", "field", "mean_psf"}
    wanted = np.asarray(report.table["mse"])
    assert table.mse.to_numpy() == pytest.approx(wanted, rel=1e-5)
    report.save(tmp_path / "same.html")
    assert (tmp_path / "same.html").read_bytes() == page.read_bytes()


def test_calls_are_silent_and_write_nothing(sky, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    state = np.random.get_state()[1].copy()  # noqa: NPY002 - that of others must not change
    few = psfdae.Stars.from_image(sky[0], catalogue=sky[1], **SIZES)
    psfdae.validate(psfdae.fit(few, method="field", **QUICK), few).page()
    assert (np.random.get_state()[1] == state).all()  # noqa: NPY002
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")


def test_an_array_and_a_table_are_an_image_and_its_list(sky, stars):
    image = fits.getdata(sky[0]).astype(np.float32)
    listed = Table.read(sky[1])
    where = np.stack([listed["X_IMAGE"], listed["Y_IMAGE"]], axis=1) - 1.0
    camera = {"gain": 1.6, "saturate": 60000.0, "pixel_scale_arcsec": 1.2}
    for catalogue in (where, listed, listed.to_pandas(), dict(listed)):
        found = psfdae.Stars.from_image(image, catalogue=catalogue, **camera, **SIZES)
        assert len(found) == len(stars) and found.summary() == stars.summary()
        same = found.product["realisation"] == stars.product["realisation"]
        assert same.all()
    detected = psfdae.Stars.from_image(image, detect=True, **camera, **SIZES)
    assert 0.8 < len(detected) / len(stars) < 1.2


def test_a_model_is_saved_and_knows_the_psf_of_any_place(model, tmp_path):
    path = tmp_path / "image.psf.safetensors"
    model.save(path)
    again = psfdae.load_model(path)
    assert again.bundle.sha256 == model.bundle.sha256
    psf = model.psf_at(300.0, 400.0, oversampling=1)
    assert psf.sum() == pytest.approx(1.0, abs=0.02)
    assert (again.psf_at(300.0, 400.0, oversampling=1) == psf).all()


def test_the_lines_of_the_pages_run(sky, tmp_path, monkeypatch):
    """As they stand in README; those of docs/python.md are the same."""
    body, same = (blocks(read(page), "python")[0] for page in ("README.md", "docs/python.md"))
    statements = [[ast.unparse(line) for line in ast.parse(text).body] for text in (body, same)]
    assert statements[0] == statements[1]
    for path in sky:
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    exec(compile(body, "README.md", "exec"), {})
    assert psfdae.load_model("image.psf.safetensors").info.method == "field"
    assert "<img" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_held_out_stars_are_not_learnt_from(stars, model):
    product = stars.product
    seen = np.unique(product["field_index"][: SIZES["train_stars"]])
    assert not stars.held_out[seen].any()
    assert model.info.training_stars == (~stars.held_out).sum()


def test_errors_of_what_is_found_are_as_large_as_said(stars, model):
    found = psfdae.validate(model, stars).found
    assert list(found["snr"]) == sorted(found["snr"])
    assert not found["lost"].any()
    for row in found:
        assert abs(row["flux_bias"]) < 3 * row["flux_bias_stderr"] + 0.01
        assert 0.6 < row["flux_pull"] < 1.7  # of ten stars
        for name in ("flux", "centre", "psf"):
            off = abs(row[f"{name}_within"] - packing.COVERAGE)
            assert off < 3 * row[f"{name}_within_stderr"] + 0.04, name


def test_a_model_that_may_have_seen_the_stars_is_refused(sky, model):
    others = psfdae.Stars.from_image(sky[0], catalogue=sky[1], snr_min=150.0, **SIZES)
    with pytest.raises(psfdae.Error, match="trained on other stars of this image"):
        psfdae.validate(model, others)
    wide = psfdae.Stars.from_image(sky[0], catalogue=sky[1], stamp_px=20, **SIZES)
    with pytest.raises(psfdae.Error, match="stamps of 20 px"):
        psfdae.validate(model, wide)


def test_without_a_method_validation_stars_choose(stars):
    chosen = psfdae.fit(stars, components=[1, 8], shrinkage=[10.0], **QUICK)
    assert chosen.info.method in ("gmm", "field")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s, sky: psfdae.Stars.from_image("none.fits", detect=True), "none.fits: no such"),
        (lambda s, sky: psfdae.Stars.from_image(*sky, snr_mim=3.0), "snr_mim: unknown setting"),
        (lambda s, sky: psfdae.Stars.from_image(*sky, snr_min=-1.0), "snr_min = -1.0"),
        (lambda s, sky: psfdae.Stars.from_image(*sky, snr_min=1e7), "0 stars are good enough"),
        (lambda s, sky: psfdae.Stars.from_image(np.ones(3)), "expected numbers of 2 or 3 dim"),
        (lambda s, sky: psfdae.Stars.from_image(np.ones((9, 9)), np.ones((3, 3))), r"\(n, 2\)"),
        (lambda s, sky: psfdae.fit(s, method="pca_som"), "makes no model of an image"),
        (lambda s, sky: psfdae.fit(s, method="none"), "no method 'none'"),
        (lambda s, sky: psfdae.fit(s, method="field", order=3), "order: unknown setting"),
    ],
)
def test_what_cannot_be_used_is_one_kind_of_error(stars, sky, call, message):
    with pytest.raises(psfdae.Error, match=message):
        call(stars, sky)


def test_words_and_files_of_the_configuration_mean_the_same():
    """Defaults stand in classes, and in files where a dataset of the paper has others."""
    groups = tuple(settings_model().model_fields)
    by_files = of_config(load_stage(groups, (CHOSEN,)))
    by_classes = from_words()
    assert by_files == by_classes
    word = "calibration_stars.snr_levels=[5,10]"
    assert from_words([word]).calibration_stars.snr_levels == [5.0, 10.0]
    assert from_words([word, "train=onecycle"]).calibration_stars.snr_levels == [5.0, 10.0]


def test_a_telescope_in_the_place_of_a_model_gets_a_hint():
    with pytest.raises(psfdae.Error, match="psfdae wavefront INPUT --telescope"):
        psfdae.load_model("mine.yaml")
