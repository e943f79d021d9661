"""Field models of several exposures: what few stars of one show, and what stays."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from command_line import printed, psfdae, refused
from image_training import few_draws
from psfdae import PredictionError, Stars, load_model
from psfdae.image.errors import ObservationError
from psfdae.image.image_input import ImageInput
from psfdae.methods.field.search import fit_field
from psfdae.methods.field.spline import deformations
from psfdae.psf.wings import Wings
from psfdae.report.validation import validate
from psfdae.training.exposures import adapt_to_exposures, exposure
from psfdae.training.from_image import collect_stars
from psfdae.training.settings import from_words
from psfdae.training.star_choice import require_one_camera
from psfdae_paper.stars.example import add_stamps, write_field

SIZE, SKY, STAMP = 450, 100.0, 10
FEW_STARS = (
    "methods=[noisy,field]",
    "framing.stamp_px=10",
    "parts.train_stars=150",
    "parts.test_stars=30",
    "field.orders=[2]",
    "field.modes=8",
    "field.step_px=0.5",
)
PLACES = np.stack(np.meshgrid(*[np.linspace(60, 388, 5)] * 2), axis=-1).reshape(-1, 2)


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
    return ImageInput(folder / f"{name}.fits", catalogue=folder / f"{name}.csv")


def trained(*words):
    with few_draws():
        printed("train", *words, *FEW_STARS)


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """A model of an exposure with 160 stars, and another exposure with 10, of 4 % larger PSFs."""
    folder = tmp_path_factory.mktemp("exposures")
    simulated(folder, "rich", 1, 160, 1.0, INSTRUME="CAM ", FILTER="R")
    words = ("--catalogue", folder / "rich.csv", "--out", folder / "m", "--method", "field")
    trained(folder / "rich.fits", *words)
    return (
        folder,
        load_model(folder / "m/rich.psf.safetensors"),
        simulated(folder, "sparse", 2, 10, 1.04, INSTRUME="Cam", FILTER="V"),
    )


def error(model, width):
    """Mean squared error at places, of PSFs of the sum 1 in a stamp."""
    estimate, true = model.psf_at(*PLACES.T, 1), psfs(PLACES, width, STAMP)
    inside = psfs(np.rint(PLACES), width, STAMP).sum(axis=(1, 2), keepdims=True)
    return np.square(estimate - true / inside).mean()


@pytest.fixture(scope="module")
def hundred(sky):
    """Error of the field of 100 stars of the sparse exposure's PSFs, alone."""
    folder, model, _ = sky
    stars = Stars.from_image(
        simulated(folder, "hundred", 3, 100, 1.04).image, folder / "hundred.csv",
        stamp_px=STAMP, train_stars=60, test_stars=10,
    )  # fmt: skip
    bright, field_model = stars.candidates.bright, model.method
    splines = (
        field_model.settings.orders,
        field_model.settings.spacing_px,
        field_model.settings.smoothness,
    )
    single_fit = fit_field(bright, SKY, STAMP + 4, STAMP, *splines).model
    images = single_fit.images(single_fit.terms(PLACES), (PLACES - np.rint(PLACES))[:, ::-1], STAMP)
    inside = psfs(np.rint(PLACES), 1.04, STAMP).sum(axis=(1, 2), keepdims=True)
    return np.square(images - psfs(PLACES, 1.04, STAMP) / inside).mean()


def test_ten_stars_are_as_good_as_a_hundred_with_another_exposure(sky, hundred):
    """Only the field and the list change, and the model says of which one it is made."""
    _, model, sparse = sky
    adapted, line = exposure(model, sparse, "sparse")
    assert error(adapted, 1.04) < min(1.15 * hundred, 0.2 * error(model, 1.04))
    old_weights, new_weights = model.bundle.weights, adapted.bundle.weights
    changed = {key for key in old_weights if not np.array_equal(old_weights[key], new_weights[key])}
    assert changed == {"coefficients", "listed"}
    assert adapted.info.config["stars"]["adapted"] == {"from": model.sha256, "stars": 10}
    assert exposure(model, sparse, "sparse")[0].sha256 == adapted.sha256 != model.sha256
    assert "10 stars of sparse.fits" in line and "FILTER is 'V'" in line


def test_the_command_writes_a_model_that_predict_takes(sky):
    folder, _, _ = sky
    of = (folder / "sparse.fits", "--catalogue", folder / "sparse.csv")
    out, model = folder / "sparse.psf.safetensors", folder / "m/rich.psf.safetensors"
    process = psfdae("adapt", *of, "--model", model, "--out", out)
    assert process.exit_code == 0 and "10 stars of sparse.fits" in process.output, process.output
    assert "sparse.fits, by 10 of its stars" in psfdae("describe", out).output
    assert psfdae("predict", *of, "--model", out, "--out", folder / "p.fits").exit_code == 0
    words = ("--model", out, "--out", folder / "second.psf.safetensors")
    assert "itself adapted to sparse.fits" in refused("adapt", *of, *words)


def test_models_of_other_pixels_or_without_a_field_are_not_adapted(sky):
    _, model, sparse = sky
    with pytest.raises(PredictionError, match=r"0\.5 arcsec"):
        exposure(model, replace(sparse, pixel_scale_arcsec=0.5), "x")
    with pytest.raises(PredictionError, match="knows the PSF of a star alone"):
        exposure(load_model(), sparse, "x")


def test_without_other_stars_the_field_stays(sky):
    """A star of the exposure changes nothing that it does not show."""
    _, model, sparse = sky
    field = model.method
    observed = Stars.from_image(
        sparse.image.with_name("rich.fits"), sparse.image.with_name("rich.csv"),
        stamp_px=STAMP, train_stars=60, test_stars=10,
    ).candidates.bright  # fmt: skip
    adapted = field.refit_exposure(observed.select(np.arange(8)), SKY)
    off = np.abs(adapted.coefficients - field.coefficients).max() / np.abs(field.coefficients).max()
    assert off < 0.02


def test_deformations_are_the_slopes_of_the_splines():
    """A Gaussian is stretched to 0.5 % of the largest slope, and blurred to 2 %."""
    spacing, sigma = 0.5, 1.4
    axis = (np.arange(41) - 20) * spacing
    x, y = axis, axis[:, None]
    light = np.exp(-(x**2 + y**2) / (2 * sigma**2))
    slopes = [-(x**2), -(y**2), -2 * x * y]
    curves = [x**2 / sigma**2 - 1, y**2 / sigma**2 - 1, x * y / sigma**2]
    analytic = np.stack([a * light / sigma**2 for a in (*slopes, *curves)])
    computed = deformations(light[None], spacing)[:, 0]
    largest = np.abs(analytic).max(axis=(1, 2), keepdims=True)
    off = (np.abs(computed - analytic) / largest).max(axis=(1, 2))
    assert (off < [0.005] * 3 + [0.02] * 3).all()


# Several exposures in one training.

NIGHT = {"rich": (150, 1.0), "poor": (10, 1.04), "empty": (3, 0.98)}
"""Stars of three exposures, and how wide their PSFs are."""


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """A folder with exposures, and their models in another one."""
    folder = tmp_path_factory.mktemp("night")
    for seed, (name, simulation) in enumerate(NIGHT.items()):
        simulated(folder, name, 11 + seed, *simulation, INSTRUME="Cam", FILTER="R")
    images = [folder / f"{name}.fits" for name in NIGHT]
    trained(*images, "--detect", "--out", folder / "m")
    return folder, folder / "m"


@pytest.mark.slow
def test_a_poor_exposure_of_a_night_has_a_field_as_of_a_hundred_stars(night, hundred):
    _, out = night
    models = {name: load_model(out / f"{name}.psf.safetensors") for name in ("all", *NIGHT)}
    assert 0.2 * hundred < error(models["poor"], 1.04) < 1.15 * hundred
    assert error(models["poor"], 1.04) < 0.1 * error(models["all"], 1.04)
    assert 0.2 * hundred < error(models["rich"], 1.0) < 1.15 * hundred
    assert models["empty"].sha256 == models["all"].sha256


def test_predict_takes_the_exposure_s_own_model_from_the_folder(night, tmp_path):
    folder, out = night
    for name in ("rich", "poor"):
        words = (folder / f"{name}.fits", "--detect", "--model", out)
        printed("predict", *words, "--out", tmp_path / f"{name}.fits")
        header = fits.getheader(tmp_path / f"{name}.fits")
        assert header["PSFSHA"] == load_model(out / f"{name}.psf.safetensors").sha256
    second_image = simulated(tmp_path, "other", 1, 5, 1.0).image
    words = (second_image, "--detect", "--model", out, "--out", tmp_path / "x.fits")
    assert "other: 0 models, expected one" in refused("predict", *words)


@pytest.mark.slow
def test_stars_are_chosen_and_held_out_in_each_image_by_itself(night, shipped):
    folder, out = night
    images = [folder / f"{name}.fits" for name in NIGHT]
    settings = {"stamp_px": STAMP, "train_stars": 150, "test_stars": 30}
    stars = Stars.from_image(images, detect=True, **settings)
    first_stars = Stars.from_image(images[0], detect=True, **settings)
    table = Table.read(out / "selection.csv")
    assert [*table["part"][:150]] == [*first_stars.table["part"]]
    bright = stars.candidates.bright
    assert len(set(bright.row)) == len(bright) == len(table) == 163
    held_out, of = stars.held_out, stars.columns["field_index"].values
    assert not {*of[:150]} & set(np.flatnonzero(held_out)) and held_out[150:160].any()
    model = load_model(out / "poor.psf.safetensors")
    with pytest.raises(PredictionError, match="was trained on other stars of this image"):
        validate(model, first_stars)
    # A model without a field is that of each exposure.
    assert adapt_to_exposures(shipped, stars) == dict.fromkeys(NIGHT, shipped)


def test_the_sky_of_a_training_is_that_of_the_typical_star(night):
    """The sky counts in photons: an exposure with another gain counts by its stars."""
    folder, _ = night
    sources = [ImageInput(folder / f"{name}.fits", detect=5.0) for name in ("rich", "poor")]
    sources[1] = replace(sources[1], gain=3.0)
    stars = collect_stars(sources, from_words(["framing.stamp_px=10"]))
    sky = [part.settings.noise.background_photons for part in stars.exposures]
    assert sky[1] == pytest.approx(9 * sky[0], rel=0.05)
    assert stars.settings.noise.background_photons == sky[0] == pytest.approx(SKY + 9, rel=0.05)


def test_several_images_that_belong_to_no_training_are_refused(sky, night, tmp_path):
    folder, out = night
    rich, poor, _ = (folder / f"{name}.fits" for name in NIGHT)
    twin = tmp_path / "rich.fit"
    twin.symlink_to(poor)
    coarse = simulated(tmp_path, "coarse", 1, 3, 1.0).image
    fits.setval(coarse, "CDELT1", value=-2 / 3600)
    fits.setval(coarse, "CDELT2", value=2 / 3600)
    for words, message in (
        ([rich, twin, "--detect"], "rich.fit: its model"),
        ([rich, coarse, "--detect"], "coarse.fits: the pixel scale is 2 arcsec"),
        ([sky[0] / "sparse.fits", rich, "--detect"], "rich.fits: FILTER is 'R'"),
        ([rich, poor, "--catalogue", folder / "rich.csv"], "sky coordinates"),
        ([rich, poor, "--detect", "--out", out], "--overwrite"),
    ):
        assert message in refused("train", "--out", tmp_path / "m", *words, *FEW_STARS)


def test_a_cube_of_stamps_cannot_join_an_image():
    image = SimpleNamespace(path="i.fits", shape=(9, 9))
    cube = SimpleNamespace(path="c.fits", shape=None)
    require_one_camera([cube])
    with pytest.raises(ObservationError, match=r"c\.fits: a cube of stamps"):
        require_one_camera([cube, image])


def test_wings_of_several_images_are_one_profile():
    """Each counts by its error; a profile is by the light in the outer part of the PSF."""
    radius, eye = np.array([5.0, 8.0, 12.0]), np.eye(3)
    wings = Wings(radius, np.array([1e-5, 1e-4, 3e-5]), 1e-12 * eye, 0.02)
    assert Wings.join([wings]).plain() == wings.plain()
    pair = Wings.join([wings, wings])
    assert pair.profile == pytest.approx(wings.profile)
    assert pair.light()[1] == pytest.approx(wings.light()[1] / np.sqrt(2))
    vague = Wings(radius, 3 * wings.profile, 1e-8 * eye, 0.02)
    assert Wings.join([wings, vague]).profile == pytest.approx(wings.profile, rel=1e-3)
    doubled = Wings(radius, 2 * wings.profile, 4e-12 * eye, 0.04)
    light = np.array([0.03])
    joined = Wings.join([wings, doubled]).total_over_flux(light)[0]
    assert joined == pytest.approx(wings.total_over_flux(light)[0])


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ({}, None),
        ({"radius_px": [5.0, 8.0, 20.0]}, "geometric sequence"),
        ({"radius_px": [5.0, 5.0, 5.0]}, "geometric sequence"),
        ({"radius_px": [5.0, 10.0]}, "different lengths"),
        ({"profile": "wide"}, "not numbers"),
        ({"profile": [1e-5, [1e-4, 3e-5]]}, "not numbers"),
        ({"outer_share": None}, "not numbers"),
        ({"outer_share": -0.02}, "fraction of a star"),
        ({"profile": [1.0, 1.0, 1.0]}, "fraction of a star"),
    ],
)
def test_damaged_wings_raise_an_error_that_says_what_is_wrong(damage, message):
    wings = Wings(np.array([5.0, 10.0, 20.0]), np.array([1e-5, 1e-4, 3e-5]), np.eye(3), 0.02)
    plain = wings.plain() | damage
    if message is None:
        assert Wings.from_plain(plain).plain() == plain
        return
    with pytest.raises(ValueError, match=message):
        Wings.from_plain(plain)
