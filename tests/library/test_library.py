"""Calls of Python: stars of an image, a fit, its validation; the command is these calls."""

from __future__ import annotations

import ast
import shutil
import tempfile
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest

import psfdae
from docs_pages import blocks, read
from image_training import FIELD, MIXTURE, SIZES, few_draws
from psfdae.api import PsfModel
from psfdae.methods import method
from psfdae.training.calibration import COVERAGE
from psfdae.training.settings import DATASET_CHOICE, from_words, make_settings, settings_model
from psfdae_paper.configuration.compose import load_stage


@pytest.fixture(scope="module")
def stars(training):
    return psfdae.Stars.from_image(training.image, catalogue=training.catalogue, **SIZES)


def test_the_command_is_the_calls_which_are_silent_and_write_nothing(
    training, stars, tmp_path, monkeypatch, capfd
):
    """Validation stars choose the method for both, if none is stated."""
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    monkeypatch.chdir(tmp_path)
    state = np.random.get_state()[1].copy()  # noqa: NPY002 - that of others must not change
    capfd.readouterr()
    with few_draws():
        model = psfdae.fit(stars, **MIXTURE, **FIELD)
    assert model.info.method == "field"
    assert model.bundle.sha256 == training.model.bundle.sha256
    fits = {"gmm": method("gmm").load(training.out / "gmm.h5")}
    report = psfdae.validate(model, stars, fits)
    page = report.page()
    assert (np.random.get_state()[1] == state).all()  # noqa: NPY002
    printed = capfd.readouterr()
    assert printed.err == "" and all("K = " in line for line in printed.out.splitlines())
    assert not list(tmp_path.iterdir())
    assert str(report) == training.output.splitlines()[-2] and "<table>" in report._repr_html_()
    table = pd.read_csv(training.out / "report.csv")
    assert set(table.method) == {"noisy", "lmmse", "gmm", "field", "mean_psf"}
    assert table.mse.to_numpy() == pytest.approx(np.asarray(report.table["mse"]), rel=1e-5)
    report.save(tmp_path / "same.html")
    assert (tmp_path / "same.html").read_bytes() == training.page.read_bytes() == page.encode()


def test_a_network_is_fitted_without_a_file_for_its_state(stars, tmp_path, monkeypatch):
    """A call gives no file for interrupted trainings; nothing is left of a temporary one."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with few_draws():
        model = psfdae.fit(stars, method="dae", epochs=2, widths=[4] * 9)
    size = model.info.stamp_px
    middle = stars.mean_psf[8:-8, 8:-8]
    assert middle.shape == (size, size) and np.isfinite(model.predict(middle).psf).all()
    assert not list(tmp_path.iterdir())


def test_the_lines_of_the_pages_run(training, tmp_path, monkeypatch):
    """Those of docs/python.md are the same as those of README."""
    body, python_page = (
        blocks(read(page), "python")[0] for page in ("README.md", "docs/python.md")
    )
    statements = [
        [ast.unparse(line) for line in ast.parse(text).body] for text in (body, python_page)
    ]
    assert statements[0] == statements[1]
    for path in (training.image, training.catalogue):
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(psfdae, "fit", partial(psfdae.fit, orders=[0], modes=4))
    monkeypatch.setattr(psfdae.Stars, "from_image", partial(psfdae.Stars.from_image, **SIZES))
    with few_draws():
        exec(compile(body, "README.md", "exec"), {})
    assert psfdae.load_model("image.psf.safetensors").info.method == "field"
    # The calls for a whole image, with this model.
    (whole_image,) = [b for b in blocks(read("docs/python.md"), "python") if "predict_image" in b]
    names = {}
    exec(compile(whole_image, "docs/python.md", "exec"), names)
    assert len(names["prediction"]) == len(names["detected"]) <= len(names["fluxes"])
    assert names["tonight"].info.adapted
    assert "<img" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_held_out_stars_are_not_trained_on(training, stars):
    trained = np.unique(stars.product["field_index"][: SIZES["train_stars"]])
    assert not stars.held_out[trained].any()
    assert training.model.info.training_stars == (~stars.held_out).sum()


def test_errors_of_held_out_stars_are_as_large_as_said(training):
    table = pd.read_csv(training.out / "found.csv")
    assert table.snr.is_monotonic_increasing
    assert not table.lost.any()
    assert (table.flux_bias.abs() < 3 * table.flux_bias_stderr + 0.01).all()
    assert table.flux_pull.between(0.6, 1.7).all()  # of ten stars
    for name in ("flux", "centre", "psf"):
        off, doubt = table[f"{name}_within"] - COVERAGE, 3 * table[f"{name}_within_stderr"]
        assert (off > -doubt - 0.04).all(), name
        # Errors of centres are too large at S/N 50 where 38 stars are trained on: 84 % are within.
        assert (off < doubt + (0.16 if name == "centre" else 0.04)).all(), name


def test_a_model_of_another_image_is_told_the_noise_of_these_stars(training, stars, monkeypatch):
    """Its noise level λ has another κ, and its typical star another size."""
    info = training.model.info
    changed = {"kappa": 2 * info.kappa, "noise_equivalent_px": 1.5 * info.noise_equivalent_px}
    bundle = training.model.bundle
    model = PsfModel(replace(bundle, info=info.model_copy(update=changed)))
    report = psfdae.validate(model, stars)
    assert sorted(report.restored_by_snr) == sorted(set(report.table["snr"]))
    # The figure is of the S/N nearest to 10; the noise in units of κ is what the model is told.
    levels, method_class = [], type(model.method)
    estimate = method_class.estimate
    monkeypatch.setattr(
        method_class,
        "estimate",
        lambda self, noisy, level, *more: (
            levels.append(level) or estimate(self, noisy, level, *more)
        ),
    )
    report.strip()
    shown = min(report.table, key=lambda row: abs(np.log(row["snr"] / 10.0)))
    assert levels == [pytest.approx(shown["noise"] / model.info.kappa)]


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"snr_min": 150.0}, "trained on other stars"), ({"stamp_px": 20}, "stamps of 20 px")],
)
def test_a_model_that_may_have_seen_the_stars_is_refused(training, settings, message):
    second_stars = psfdae.Stars.from_image(training.image, training.catalogue, **SIZES, **settings)
    with pytest.raises(psfdae.Error, match=message):
        psfdae.validate(training.model, second_stars)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s, sky: psfdae.Stars.from_image("none.fits", detect=True), "none.fits"),
        (lambda s, sky: psfdae.Stars.from_image(*sky, snr_mim=3.0), "snr_mim"),
        (lambda s, sky: psfdae.Stars.from_image(np.ones(3)), "2 or 3 dim"),
        (lambda s, sky: psfdae.fit(s, method="field", order=3), "order"),
        (lambda s, sky: psfdae.load_model("mine.yaml"), r"psfdae\.wavefront"),
    ],
)
def test_what_cannot_be_used_is_one_kind_of_error(training, stars, call, message):
    with pytest.raises(psfdae.Error, match=message):
        call(stars, (training.image, training.catalogue))


def test_words_and_files_of_the_configuration_mean_the_same():
    """Defaults stand in classes, and in files where a dataset of the paper has others."""
    groups = tuple(settings_model().model_fields)
    assert make_settings(load_stage(groups, (DATASET_CHOICE,))) == from_words()
    word = "calibration_stars.snr_levels=[5,10]"
    assert from_words([word]).calibration_stars.snr_levels == [5.0, 10.0]
    assert from_words([word, "preset=fast"]).calibration_stars.snr_levels == [5.0, 10.0]
