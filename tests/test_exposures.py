"""A field model for another exposure: what few stars of it show, and what stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner

from psfdae import PredictionError, PsfModel, load_model
from psfdae.cli import main
from psfdae.field_psf import _deformations, fit_field
from psfdae.image.observation import Source
from psfdae.model.exposures import exposure
from psfdae.model.stars import Stars
from psfdae_paper.stars.example import add_stamps, write_field

SIZE, SKY, STAMP = 700, 100.0, 10
PLACES = np.stack(np.meshgrid(*[np.linspace(60, 640, 5)] * 2), axis=-1).reshape(-1, 2)


def psfs(place, width, side=24):
    """Gaussians whose width changes over the field, at the sub-pixel phases of places."""
    u, v = (2 * place / SIZE - 1).T
    axis = np.arange(side) - side // 2
    phase = place - np.floor(place + 0.5)
    first, second = 1.25 * width * (1 + 0.1 * u), 1.25 * width * (1 - 0.08 * v)
    rows = np.exp(-(((axis - phase[:, 1:]) / second[:, None]) ** 2) / 2)
    columns = np.exp(-(((axis - phase[:, :1]) / first[:, None]) ** 2) / 2)
    return rows[:, :, None] * columns[:, None] / (2 * np.pi * first * second)[:, None, None]


def simulated(folder, name, seed, count, width, **cards):
    rng = np.random.default_rng(seed)
    axis = np.arange(40.0, SIZE - 30, 31)
    place = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    place = rng.permutation(place + rng.uniform(-0.5, 0.5, place.shape))[:count]
    flux = 10 ** rng.uniform(4.0, 4.8, count)
    pixels = np.full((SIZE, SIZE), SKY)
    add_stamps(pixels, flux[:, None, None] * psfs(place, width), *place.T)
    pixels = rng.poisson(pixels) + rng.normal(0, 3, pixels.shape)
    cards = {"GAIN": 1.0} | cards
    write_field(folder / f"{name}.fits", folder / f"{name}.csv", pixels, *place.T, **cards)
    return Source(folder / f"{name}.fits", folder / f"{name}.csv")


def run(*words):
    return CliRunner().invoke(main, [str(word) for word in words])


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """A model of an exposure with 300 stars, and another exposure with 10, of 4 % larger PSFs."""
    folder = tmp_path_factory.mktemp("exposures")
    simulated(folder, "rich", 1, 300, 1.0, INSTRUME="CAM ", FILTER="R")
    few = ("framing.stamp_px=10", "parts.train_stars=150", "parts.test_stars=30")
    words = ("--catalogue", folder / "rich.csv", "--out", folder / "m", "--method", "field")
    done = run("from-stars", folder / "rich.fits", *words, "methods=[noisy,field]", *few)
    assert done.exit_code == 0, done.output
    return (
        folder,
        load_model(folder / "m/rich.psf.safetensors"),
        simulated(folder, "sparse", 2, 10, 1.04, INSTRUME="Cam", FILTER="V"),
    )


def error(model, width):
    """Mean squared error at places, of PSFs of the sum 1 in a stamp."""
    found, true = model.psf_at(*PLACES.T, 1), psfs(PLACES, width, STAMP)
    inside = psfs(np.rint(PLACES), width, STAMP).sum(axis=(1, 2), keepdims=True)
    return np.square(found - true / inside).mean()


def test_ten_stars_are_as_good_as_a_hundred_with_another_exposure(sky):
    folder, model, sparse = sky
    adapted, said = exposure(model, sparse, "sparse")
    assert "10 stars of sparse.fits" in said
    stars = Stars.from_image(
        simulated(folder, "hundred", 3, 100, 1.04).image, folder / "hundred.csv",
        stamp_px=STAMP, train_stars=60, test_stars=10,
    )  # fmt: skip
    bright, own = stars.candidates.bright, model.engine.estimator
    splines = (own.settings.orders, own.settings.spacing_px, own.settings.smoothness)
    alone = fit_field(bright, SKY, STAMP + 4, STAMP, *splines).model
    images = alone.images(alone.terms(PLACES), (PLACES - np.rint(PLACES))[:, ::-1], STAMP)
    inside = psfs(np.rint(PLACES), 1.04, STAMP).sum(axis=(1, 2), keepdims=True)
    hundred = np.square(images - psfs(PLACES, 1.04, STAMP) / inside).mean()
    assert error(adapted, 1.04) < 1.15 * hundred
    assert error(adapted, 1.04) < 0.2 * error(model, 1.04)


def test_only_field_and_list_change_and_provenance_is_said(sky):
    _, model, sparse = sky
    adapted, _ = exposure(model, sparse, "sparse")
    before, after = model.bundle.weights, adapted.bundle.weights
    assert before.keys() == after.keys()
    same = {k for k in before if np.array_equal(before[k], after[k])}
    assert before.keys() - same == {"coefficients", "listed"}
    assert adapted.info.config["stars"]["image"] == "sparse.fits"
    assert adapted.info.config["stars"]["adapted"] == {"from": model.sha256, "stars": 10}
    assert adapted.sha256 != model.sha256 and adapted.name == "sparse"
    again, _ = exposure(model, sparse, "sparse")
    assert again.sha256 == adapted.sha256


def test_another_filter_is_said_and_the_same_is_not(sky):
    folder, model, sparse = sky
    assert model.info.config["stars"]["instrument"] == {"INSTRUME": "CAM", "FILTER": "R"}
    adapted, said = exposure(model, sparse, "sparse")
    assert said.endswith("(FILTER is 'V', the model 'rich' was trained on 'R')")
    assert not adapted.other_instrument({"FILTER": "v", "TELESCOP": "another"})
    of = (folder / "sparse.fits", "--catalogue", folder / "sparse.csv")
    words = (*of, "--model", folder / "m/rich.psf.safetensors", "--out", folder / "v.fits")
    assert "sparse.fits: FILTER is 'V', the model 'rich'" in run("predict", *words).output


def test_the_command_writes_a_model_that_predict_takes(sky):
    folder, _, _ = sky
    of = (folder / "sparse.fits", "--catalogue", folder / "sparse.csv")
    out, model = folder / "sparse.psf.safetensors", folder / "m/rich.psf.safetensors"
    done = run("exposure", *of, "--model", model, "--out", out)
    assert done.exit_code == 0 and "10 stars of sparse.fits" in done.output, done.output
    assert run("exposure", *of, "--model", model, "--out", out).exit_code == 2
    assert "sparse.fits, by 10 of its stars" in run("describe", out).output
    assert "Adapted" not in run("describe", model).output
    card = " ".join(run("describe", out, "--card").output.split())
    assert "adapted to another one, `sparse.fits`" in card and "places without a star" in card
    assert run("predict", *of, "--model", out, "--out", folder / "p.fits").exit_code == 0
    assert error(load_model(out), 1.04) < 0.2 * error(load_model(model), 1.04)
    done = run("exposure", *of, "--model", out, "--out", folder / "second.psf.safetensors")
    assert done.exit_code == 2 and "itself adapted to sparse.fits" in done.output


def test_what_cannot_be_adapted_is_said(sky, tmp_path):
    folder, model, sparse = sky
    with pytest.raises(PredictionError, match=r"0\.5 arcsec"):
        exposure(model, replace(sparse, pixel_scale_arcsec=0.5), "x")
    with pytest.raises(PredictionError, match="knows the PSF of a star alone"):
        exposure(load_model(), sparse, "x")
    silent = model.info.model_copy(update={"config": {"train": model.info.config["train"]}})
    with pytest.raises(PredictionError, match="does not say how its stars were chosen"):
        exposure(PsfModel(replace(model.bundle, info=silent)), sparse, "x")
    few = simulated(tmp_path, "few", 4, 4, 1.0)
    done = run(
        *("exposure", few.image, "--catalogue", tmp_path / "few.csv"),
        *("--model", folder / "m/rich.psf.safetensors", "--out", tmp_path / "x.psf.safetensors"),
    )
    assert done.exit_code == 2 and "4 stars are good enough" in done.output
    assert not (tmp_path / "x.psf.safetensors").exists()


def test_without_other_stars_the_field_stays(sky):
    """A star of the exposure changes nothing that it does not show."""
    _, model, sparse = sky
    field = model.engine.estimator
    observed = Stars.from_image(
        sparse.image.with_name("rich.fits"), sparse.image.with_name("rich.csv"),
        stamp_px=STAMP, train_stars=60, test_stars=10,
    ).candidates.bright  # fmt: skip
    same = field.of_exposure(observed.of(np.arange(8)), SKY)
    off = np.abs(same.coefficients - field.coefficients).max() / np.abs(field.coefficients).max()
    assert off < 0.02


def test_deformations_are_the_slopes_of_the_splines():
    """Of a Gaussian, to 0.5 % of the largest where it is stretched, to 2 % where it is blurred."""
    spacing, sigma = 0.5, 1.4
    axis = (np.arange(41) - 20) * spacing
    x, y = axis, axis[:, None]
    light = np.exp(-(x**2 + y**2) / (2 * sigma**2))
    slopes = [-(x**2), -(y**2), -2 * x * y]
    curves = [x**2 / sigma**2 - 1, y**2 / sigma**2 - 1, x * y / sigma**2]
    wanted = np.stack([a * light / sigma**2 for a in (*slopes, *curves)])
    found = _deformations(light[None], spacing)[:, 0]
    largest = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    off = (np.abs(found - wanted) / largest).max(axis=(1, 2))
    assert (off < [0.005] * 3 + [0.02] * 3).all()
