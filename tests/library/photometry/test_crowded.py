"""Photometry of all stars of an image: overlapping stars, hidden ones, and light in wings."""

from __future__ import annotations

import gc
from dataclasses import replace
from itertools import cycle
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from photutils.aperture import CircularAperture
from photutils.psf import PSFPhotometry
from scipy.ndimage import uniform_filter
from scipy.spatial import cKDTree

from command_line import printed, psfdae, refused
from image_training import few_draws
from psfdae import Error, PsfModel, Stars, load_model
from psfdae.base.files import read_product
from psfdae.denoise.bundle import BundleError
from psfdae.image.camera import CameraValue
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation
from psfdae.image.sky import subtract_sky
from psfdae.image.stamps import cut_image
from psfdae.image.trails import find_saturated_cores
from psfdae.photometry import crowded, wings_fit
from psfdae.photometry.crowded import CrowdedPhotometry
from psfdae.photometry.image_photometry import add_unmeasured_rows, measure_zero_point
from psfdae.photometry.photon_noise import add_measured_gain, measure_gain
from psfdae.photometry.wings_fit import (
    StarFluxes,
    around_stars,
    draw_hats,
    draw_wings,
    fit_wings,
    measure_halo,
    subtract_halos,
)
from psfdae.psf.grid import PsfGrid
from psfdae.psf.wings import Wings, choose_wings, compute_prior_profile, outer_shares
from psfdae.training import neighbours
from psfdae.training.neighbours import draw_other_stars
from psfdae_paper.stars.example import add_stamps, write_field

SIZE, SKY, STAMP, FRAME = 330, 200.0, 10, 61
RADIUS = np.geomspace(5, 25, 7)  # of the hat functions of wings
CORE, CORE_PX, WING_PX = 0.94, 1.4, 3.0  # flux of the Gaussian, its σ, and the radius of the wings


def profile(dx, dy):
    """A Gaussian, and wings as those of a Moffat profile of β = 2.5, of flux 1 together."""
    square = dx**2 + dy**2
    core = np.exp(-square / (2 * CORE_PX**2)) / (2 * np.pi * CORE_PX**2)
    wings = 1.5 / (np.pi * WING_PX**2) * (1 + square / WING_PX**2) ** -2.5
    return CORE * core + (1 - CORE) * wings


def stamps(x, y):
    """Stars (n, WIDE, WIDE) at the sub-pixel phases of places; a pixel is 3 × 3 points."""
    axis = (np.arange(FRAME * 3) + 0.5) / 3 - 0.5 - FRAME // 2
    phase = np.stack([y - np.floor(y + 0.5), x - np.floor(x + 0.5)], axis=1)
    light = [profile(*np.meshgrid(axis - px, axis - py)) for py, px in phase]
    return np.array(light).reshape(-1, FRAME, 3, FRAME, 3).mean(axis=(2, 4))


COUNTS = {"train_stars": 50, "test_stars": 12}


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """An image with single stars and pairs, its model of the field, and the true stars."""
    folder, rng = tmp_path_factory.mktemp("crowded"), np.random.default_rng(5)
    axis = np.arange(30.0, SIZE - 20, 32)
    single = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    single += rng.uniform(-3, 3, single.shape)
    flux = 10 ** rng.uniform(3.7, 5.3, len(single))
    paired = np.arange(len(single)) % 5 == 0
    angle = rng.uniform(0, 2 * np.pi, paired.sum())
    companions = single[paired] + 5.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    place = np.concatenate([single, companions])
    light = np.concatenate([flux, 0.5 * flux[paired]])
    pixels = np.full((SIZE, SIZE), SKY)
    add_stamps(pixels, light[:, None, None] * stamps(*place.T), *place.T)
    pixels = rng.poisson(pixels) + rng.normal(0, 3, pixels.shape)
    write_field(folder / "i.fits", folder / "i.csv", pixels, *place.T, GAIN=1.0, RDNOISE=3.0)
    words = ("--catalogue", folder / "i.csv", "--method", "field", "--out", folder / "model")
    settings = ["methods=[noisy,field]", "framing.stamp_px=10", "field.orders=[0]", "field.modes=8"]
    settings += [f"parts.{name}={count}" for name, count in COUNTS.items()]
    with few_draws():
        printed("train", folder / "i.fits", *words, *settings)
    true = Table({"x": place[:, 0], "y": place[:, 1], "flux": light})
    true["pair"] = np.concatenate([paired, np.ones(len(companions), bool)])
    return folder, folder / "model/i.psf.safetensors", true


@pytest.fixture(scope="module")
def phot(sky):
    """The photometry of all stars, which are looked for."""
    folder, path, _ = sky
    observation = open_observation(ImageInput(folder / "i.fits", detect=5.0), STAMP)
    return crowded.photometry(load_model(path), observation, 5.0)


def matched(rows, true):
    """Row of every true star; there is one within a pixel of each."""
    place, target = (np.stack([t["x"], t["y"]], axis=1) for t in (rows, true))
    off, row = cKDTree(place).query(target)
    assert (off < 1.0).mean() > 0.98
    return np.where(off < 1.0, row, -1)


def test_fluxes_are_those_of_the_stars_with_their_wings(sky, phot):
    true = sky[2]
    row = matched(phot.stars, true)
    for kind in (~true["pair"], true["pair"]):
        is_bright = kind & (row >= 0) & (true["flux"] > 1e4)
        ratio = phot.stars["flux"][row[is_bright]] / true["flux"][is_bright]
        error = phot.stars["flux_error"][row[is_bright]] / true["flux"][is_bright]
        assert np.median(ratio) == pytest.approx(1.0, abs=0.004)
        pull = (ratio - np.median(ratio)) / error
        assert 0.5 < (np.abs(pull) < 1).mean() < 0.85
    # The model's own flux has not what lies beyond its stamp, nor what it takes for sky.
    short = np.median(phot.stars["flux_model"][row] / true["flux"])
    assert 0.975 < short < 0.993


def test_there_are_as_many_stars_as_are_true(sky, phot):
    true = sky[2]
    assert len(phot.stars) == pytest.approx(len(true), abs=0.02 * len(true))
    assert phot.residual.std() == pytest.approx(np.sqrt(SKY + 9), rel=0.15)
    assert abs(np.median(phot.residual)) < 0.5


def test_aperture_corrections(phot):
    for x, y in ((100.0, 100.3), (290.4, 150.0)):
        image = stamps(np.array([x]), np.array([y]))[0]
        middle = np.array([x, y]) - np.floor(np.array([x, y]) + 0.5) + FRAME // 2

        def light(radius, image=image, middle=middle):
            return CircularAperture(middle, radius).do_photometry(image)[0][0]

        for radius in (3.0, 4.0, 8.0, 15.0):
            true = light(phot.radius_px) / light(radius)
            assert phot.aperture_correction(x, y, radius) == pytest.approx(true, rel=0.005)
    assert phot.aperture_correction(150, 150, phot.radius_px) == pytest.approx(1.0, abs=2e-3)
    with pytest.raises(ValueError, match="expected above 0 up to 25"):
        phot.aperture_correction(150, 150, 26)


def test_a_model_knows_the_light_beyond_its_stamps(sky, phot):
    folder, path, true = sky
    model = load_model(path)
    assert model.wings is not None and phot.wings is not None
    # Wings are found in the image, and are no settings of the stars.
    stars = read_product(folder / "model/stars.h5", "stars")
    assert model.info.config["stars"] == stars.config
    light, error = model.wings.light()
    assert light == pytest.approx(phot.wings.light()[0], abs=4 * error + 0.004)
    observation = open_observation(
        ImageInput(folder / "i.fits", catalogue=folder / "i.csv"), STAMP, 2
    )
    ((_, measured),) = model.stream(observation)
    is_single = ~true["pair"] & (true["flux"] > 1e4)
    ratio = measured.flux_total[is_single] / true["flux"][is_single]
    # Wings of few stars have an error of their own.
    assert np.median(ratio) == pytest.approx(1.0, abs=0.006 + 2 * error)
    assert np.median(measured.flux[is_single] / true["flux"][is_single]) < 0.993
    assert (measured.flux_total_error > measured.flux_error).all()
    assert psfdae("psf", path, "--grid", "2x2", "--out", folder / "g.fits").exit_code == 0
    header = fits.getheader(folder / "g.fits")
    assert header["FLUXRAD"] == 2.5 * STAMP
    assert header["INMODEL"] == pytest.approx(1 / (1 + light))
    assert model.aperture_correction(150, 150, 4.0) == pytest.approx(
        phot.aperture_correction(150, 150, 4.0), rel=0.006
    )


@pytest.mark.parametrize(
    "changed",
    [
        {"profile": [10**400] * len(RADIUS)},
        {"covariance": (-np.eye(len(RADIUS))).tolist()},
        {"profile": [1.0] * len(RADIUS)},
        {"outer_share": 0.0},
    ],
)
def test_damaged_wings_are_refused(sky, changed):
    bundle = load_model(sky[1]).bundle
    config = bundle.info.config
    config = config | {"wings": config["wings"] | changed}
    damaged = replace(bundle, info=bundle.info.model_copy(update={"config": config}))
    with pytest.raises(BundleError, match=r"damaged .*wings"):
        PsfModel(damaged)


@pytest.mark.parametrize("level", [0.0, 3.0])
@pytest.mark.parametrize("brightness", [1.0, 1e-3])
def test_wings_are_those_of_bright_stars_or_as_expected(level, brightness):
    """An even light beside them does not count; faint stars leave what is expected of any star."""
    rng = np.random.default_rng(1)
    place, flux = rng.uniform(0, 300, (30, 2)), brightness * 10 ** rng.uniform(4, 5.5, 30)
    outer_part = np.full(30, 0.03)
    true = Wings(RADIUS, np.geomspace(3e-4, 1e-4, len(RADIUS)), np.eye(len(RADIUS)), 0.03)
    stars = StarFluxes(place, flux, outer_part)
    image = level + draw_wings((300, 300), stars, true) + rng.normal(0, 5, (300, 300))
    nothing = np.zeros(image.shape, bool)
    noise = np.full(image.shape, 5.0), nothing
    wings = fit_wings(image, *noise, stars, 10)
    light, error = wings.light()
    if brightness == 1.0:
        assert light == pytest.approx(true.light()[0], abs=4 * error)
        assert error < 0.05 * light
        # Of a sky with structure pixels share what is left; the error knows it.
        wavy = image + 10.0 * np.sin(np.arange(300) / 15)[:, None]
        off, doubt = fit_wings(wavy, *noise, stars, 10).light()
        assert doubt > 4 * error and abs(off - true.light()[0]) < 2 * doubt
    else:
        # (r/h)^-5 has 0.65 of the light between 0.7 h and h, with that of the ring in the stamp.
        assert light == pytest.approx(0.65 * 0.03, abs=0.002)
        assert 0.3 * light < error < 1.5 * light
    # Photometry takes them in place of the wings of the training if the image shows them.
    assert (choose_wings(wings, true) is wings) == (brightness == 1.0)
    assert choose_wings(wings, None) is wings and choose_wings(None, true) is true
    assert fit_wings(image, *noise, stars._replace(flux=np.full(30, np.nan)), 10) is None


def test_the_light_of_wings_is_the_sum_over_pixels():
    wings = Wings(RADIUS, np.linspace(2e-4, 1e-4, len(RADIUS)), np.eye(len(RADIUS)), 1.0)
    star = StarFluxes(np.array([[40.3, 40.1]]), np.ones(1), np.ones(1))
    total = draw_wings((81, 81), star, wings).sum()
    assert wings.light()[0] == pytest.approx(total, rel=5e-3)
    assert wings.light(10.0)[0] < wings.light(20.0)[0] < wings.light()[0]


@pytest.mark.parametrize("name", ["position", "flux", "outer_share"])
def test_stars_of_which_something_is_unknown_have_no_wings(name):
    wings = Wings(RADIUS, np.linspace(2e-4, 1e-4, len(RADIUS)), np.eye(len(RADIUS)), 1.0)
    stars = StarFluxes(np.array([[40.3, 40.1], [20.0, 30.0]]), np.ones(2), np.ones(2))
    first = StarFluxes(*(values[:1] for values in stars))
    getattr(stars, name)[1] = np.nan
    light = draw_wings((81, 81), stars, wings)
    assert light.max() > 0 and np.array_equal(light, draw_wings((81, 81), first, wings))


def test_the_outer_share_is_the_light_from_07_to_1_times_half_a_stamp():
    """Of stars in any number, each by its own PSF; NaN where a position is not known."""
    place = np.column_stack([np.arange(1.0, 3002.0), np.full(3001, 5.0)])
    place[[0, 2100], [1, 0]] = np.nan
    side = 20
    y, x = np.indices((side, side)) - side // 2

    def draw(position):
        assert len(position) <= 2048
        return np.full((len(position), side, side), 0.001) * position[:, :1, None]

    radius = np.hypot(x, y)
    pixels = np.count_nonzero((radius >= 0.7 * side / 2) & (radius < side / 2))
    expected = np.where(np.isnan(place).any(axis=1), np.nan, 0.001 * pixels * place[:, 0])
    np.testing.assert_allclose(outer_shares(draw, place), expected, rtol=1e-9)


def test_wings_in_tiles_are_those_of_the_whole_image():
    """Σ p h over all tiles is the light of the wings, also of stars beside a tile or the image."""
    wings = Wings(RADIUS, np.geomspace(3e-4, 1e-4, len(RADIUS)), np.eye(len(RADIUS)), 1.0)
    place = np.array([[20.3, 31.0], [64.0, 2.2], [-9.0, 140.0]])
    stars = StarFluxes(place, np.array([1.0, 2.0, 5.0]), np.ones(3))
    whole, light = draw_wings((150, 190), stars, wings), np.full((150, 190), np.nan)
    empty = 0
    for tile, hats in draw_hats(whole.shape, stars, wings, 32):
        empty += len(hats) == 0
        light[tile] = np.tensordot(wings.profile[: len(hats)], hats, 1)
    assert light == pytest.approx(whole, rel=1e-5, abs=1e-12)
    assert 0 < empty < 30 and not whole[100:, 150:].any()


def test_an_earlier_fit_keeps_its_light_in_another_mean_share():
    """Wings fitted again, on what they leave, stay, also by stars of a wider mean PSF."""
    rng = np.random.default_rng(2)
    place, flux = rng.uniform(0, 200, (20, 2)), 10 ** rng.uniform(4.5, 5.5, 20)
    true = Wings(RADIUS, np.geomspace(3e-4, 1e-4, len(RADIUS)), np.eye(len(RADIUS)), 0.03)
    stars = StarFluxes(place, flux, np.linspace(0.02, 0.06, 20))
    light, none = draw_wings((200, 200), stars, true), np.zeros((200, 200), bool)
    noise, sigma = rng.normal(0, 5, none.shape), np.full(none.shape, 5.0)
    first = fit_wings(light + noise, sigma, none, stars, 10)
    # A few sources that no list has, which an earlier fit leaves out.
    sources = np.where(rng.random(none.shape) < 0.01, 1000.0, 0.0)
    left = light + noise + sources - draw_wings(none.shape, stars, true)
    again = fit_wings(left, sigma, none, stars, 10, true)
    assert again.outer_share == first.outer_share != true.outer_share
    assert draw_wings(none.shape, stars, again) == pytest.approx(light, rel=0.03, abs=1.0)
    assert again.light()[0] == pytest.approx(first.light()[0], abs=3 * first.light()[1])


def test_wings_are_round_up_to_their_end():
    wings = Wings(RADIUS, np.full(len(RADIUS), 1e-4), np.eye(len(RADIUS)), 1.0)
    star = StarFluxes(np.array([[40.0, 40.0]]), np.ones(1), np.ones(1))
    light = draw_wings((81, 81), star, wings)
    assert light[40, 64] > 0.0 == light[40, 66]
    for mirrored in (light[::-1], light[:, ::-1], light.T):
        assert mirrored == pytest.approx(light)


def test_expected_wings_fall_as_the_fifth_power():
    """So does a profile that has the outer share; the stamp lacks its light at 1.5 half sides."""
    r = np.linspace(0.7 * RADIUS[0], RADIUS[0], 2001)
    share = np.trapezoid(2.0 * np.pi * r * 2e-4 * (r / RADIUS[0]) ** -5, r)
    expected, sigma = compute_prior_profile(RADIUS, share)
    top = RADIUS[:-1] / RADIUS[0]
    assert expected[1:] * top**-3 == pytest.approx(2e-4 * top**-5, rel=1e-4)
    assert expected[0] == pytest.approx(2e-4 * 1.5**-5, rel=1e-4)
    assert sigma[1:] == pytest.approx(np.hypot(1e-4, 1e-3 / (2.0 * np.pi * RADIUS[0] ** 2)))


def test_the_part_of_the_flux_in_the_model_has_the_error_of_the_wings():
    wings = Wings(RADIUS, np.full(len(RADIUS), 1e-3), 1e-12 * np.eye(len(RADIUS)), 0.03)
    light, sigma = wings.light()
    part, error = CrowdedPhotometry(*[None] * 4, wings, None).compute_model_share()
    assert part == pytest.approx(1.0 / (1.0 + light)) and light > 0.2
    half_width = 0.5 * (1.0 / (1.0 + light - sigma) - 1.0 / (1.0 + light + sigma))
    assert error == pytest.approx(half_width, rel=1e-3)


def test_the_gain_is_seen_in_the_pixels_of_stars(sky):
    """Variance grows with the light of a star by 1/gain; not in an image without photon noise."""
    folder, path, true = sky
    model, observation = (
        load_model(path),
        open_observation(ImageInput(folder / "i.fits", detect=5.0), STAMP),
    )
    unknown = replace(observation, camera=observation.camera | {"gain": CameraValue(None, "")})
    assert add_measured_gain(model, unknown).gain == pytest.approx(1.0, rel=0.25)
    assert add_measured_gain(model, observation) is observation
    place = np.stack([true["x"], true["y"]], axis=1)
    light = np.zeros((SIZE, SIZE))
    add_stamps(light, np.array(true["flux"])[:, None, None] * stamps(*place.T), *place.T)
    noise, good = np.full(light.shape, 15.0), np.zeros(light.shape, bool)
    noisy = light + noise * np.random.default_rng(2).standard_normal(light.shape)
    # There, errors of the model pass for little photon noise at most.
    (weak, _) = measure_gain(model, noisy, noise, good, place) or (np.inf, 0.0)
    assert weak > 4.0
    assert measure_gain(model, noisy, noise, good, place[:9]) is None


def test_models_of_photutils_do_not_mix(sky):
    """Groups are fitted with the model that is asked for, not with that of another field."""
    first = load_model(sky[1])
    weights = first.bundle.weights
    smooth = uniform_filter(weights["coefficients"], (1, 5, 5))
    smooth_w = weights | {"coefficients": smooth}
    smooth_model = type(first)(replace(first.bundle, weights=smooth_w))
    first_grid, second_grid = (model.to_photutils(3, 2) for model in (first, smooth_model))
    x, y = first_grid.grid_xypos[4]
    assert first_grid.data[4] == pytest.approx(first.psf_at(x, y, 2), abs=1e-12)
    rows, columns = np.mgrid[:40, :40]
    image = sum(second_grid.evaluate(columns, rows, 1e3, a, 20.0) for a in (16.0, 21.0))
    start = Table({"x": [16.2, 20.9], "y": [20.1, 19.9], "group_id": [1, 1]})
    # It keeps what it has made of a model until that is collected as garbage.
    gc.disable()
    try:
        fluxes = [
            list(PSFPhotometry(model, 9, aperture_radius=3)(image, init_params=start)["flux_fit"])
            for model in (first_grid, second_grid)
        ]
    finally:
        gc.enable()
    assert fluxes[1] == pytest.approx([1e3, 1e3], rel=0.005)
    assert fluxes[0] != pytest.approx([1e3, 1e3], rel=0.02)


@pytest.mark.parametrize(("oversampling", "limit"), [(2, 2e-3), (4, 1e-4)])
def test_the_light_of_a_grid_is_that_of_photutils(sky, oversampling, limit):
    """Light at the nodes, between and beyond them; none of a star that no stamp holds."""
    model = load_model(sky[1])
    grid, photutils = (
        PsfGrid.sample(model, 4, oversampling),
        model.to_photutils(4, oversampling),
    )
    low, high = photutils.grid_xypos.min(axis=0), photutils.grid_xypos.max(axis=0)
    rng = np.random.default_rng(4)
    place = np.vstack([rng.uniform(low, high, (20, 2)), low, low - 9.3, high + 7.6])
    corner = np.rint(place).astype(int) - 4
    lights = grid.stamps(place, corner, 9)
    for (x, y), (column0, row0), light in zip(place, corner, lights, strict=True):
        rows, columns = np.mgrid[row0 : row0 + 9, column0 : column0 + 9]
        expected = photutils.evaluate(columns, rows, 1.0, x, y)
        assert light == pytest.approx(expected, abs=limit * expected.max())
    assert not grid.stamps(place, corner + 99, 9).any()


def test_derivatives_of_a_grid_are_those_of_its_light(sky):
    grid, step = PsfGrid.sample(load_model(sky[1]), 4, 4), 1e-3
    place = np.array([[grid.columns.mean() + 0.3, grid.rows.mean() - 0.4]])
    corner = np.rint(place).astype(int) - 4
    light, *slopes = grid.stamps_and_slopes(place, corner, 9)[0]
    assert (light == grid.stamps(place, corner, 9)[0]).all()
    for slope, move in zip(slopes, step * np.eye(2), strict=True):
        low, high = (grid.stamps(place + s * move, corner, 9)[0] for s in (-1, 1))
        assert slope == pytest.approx(
            (high - low) / (2 * step), abs=2e-3 * float(np.abs(slope).max())
        )


def test_the_command_and_its_table(sky, tmp_path):
    folder, model, true = sky
    true["mag"] = 24.5 - 2.5 * np.log10(true["flux"])
    true[:40].write(tmp_path / "magnitudes.csv")
    words = ("photometry", folder / "i.fits", "--model", model, "--detect")
    out, residual = tmp_path / "stars.fits", tmp_path / "left.fits"
    options = ("--reference", tmp_path / "magnitudes.csv", "--origin", 0, "--residual", residual)
    printed(*words, "--out", out, *options)
    rows, header = Table.read(out), fits.getheader(out, 1)
    assert header["ZEROPT"] == pytest.approx(24.5, abs=0.01) and header["FLUXRAD"] == 25.0
    assert 0.975 < header["INMODEL"] < 0.995
    row = matched(rows, true)
    assert np.median(rows["mag"][row] - true["mag"]) == pytest.approx(0.0, abs=0.01)
    place = WCS(fits.getheader(folder / "i.fits")).world_to_pixel_values(rows["ra"], rows["dec"])
    assert place == pytest.approx(np.array([rows["x"], rows["y"]]), abs=1e-6)
    assert fits.getdata(residual).shape == (SIZE, SIZE)


def test_stars_of_a_list_are_measured_and_no_others(sky, tmp_path):
    folder, model, true = sky
    rows = Table.read(folder / "i.csv")[:25]
    rows["X_IMAGE"][24] = 5000.0  # off the image
    rows.write(tmp_path / "some.csv")
    words = ("photometry", folder / "i.fits", "--model", model, "--out", tmp_path / "some.ecsv")
    printed(*words, "--catalogue", tmp_path / "some.csv")
    measured = Table.read(tmp_path / "some.ecsv")
    assert (
        len(measured) == 25 and not np.isfinite(measured["flux"][24]) and measured["flags"][24] > 0
    )
    ratio = (measured["flux"] / true["flux"][:25])[:24][~true["pair"][:24]]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("call", [PsfModel.photometry, PsfModel.residual])
@pytest.mark.parametrize(
    ("moved", "message"),
    [
        (lambda place: place[:, ::-1], "x and y exchanged"),
        (lambda place: place + np.array([2.0, -3.0]), "a list of another image"),
        (lambda place: place + 1.0, "origin=1"),
    ],
)
def test_a_list_of_another_image_or_origin_is_refused_unless_it_is_accepted(
    sky, call, moved, message
):
    folder, path, true = sky
    place = np.stack([true["x"], true["y"]], axis=1)[~true["pair"]]
    model, image = load_model(path), folder / "i.fits"
    with pytest.raises(Error, match=message):
        call(model, image, catalogue=moved(place))
    call(model, image, catalogue=moved(place), accept_offset=True)


def test_the_halo_of_a_saturated_star_that_no_list_has_is_no_light_of_its_neighbours(sky):
    folder, model, true = sky
    middle = np.array([165.0, 170.0])
    row, column = np.indices((SIZE, SIZE))
    radius = np.hypot(column - middle[0], row - middle[1])
    halo = 2e8 * profile(radius, 0.0)
    image = fits.getdata(folder / "i.fits") + np.random.default_rng(1).poisson(halo)
    place = np.stack([true["x"], true["y"]], axis=1)
    source = ImageInput(np.minimum(image, 6e4), catalogue=place, origin=0, gain=1.0, saturate=6e4)
    phot = crowded.photometry(load_model(model), open_observation(source, STAMP), 5.0)
    distance = np.hypot(*(place - middle).T)
    near = (distance > 12) & (distance < 45) & (phot.stars["flags"] == 0)
    pull = (phot.stars["flux"] - true["flux"]) / phot.stars["flux_error"]
    assert near.sum() >= 4 and (np.abs(pull[near]) < 3.0).all()
    # Where they have 300 and 70 counts in a pixel, less than a tenth is left.
    for ring_px in (12, 16):
        ring = np.abs(radius - ring_px) < 1
        assert abs(np.median(phot.residual[ring])) < 0.1 * np.median(halo[ring])


@pytest.mark.parametrize(("flux", "end_px"), [(1e6, 50), (3e7, 150)])
def test_a_halo_is_the_median_of_rings_and_goes_on_as_a_power_of_the_distance(flux, end_px):
    """A halo r^-3 above noise to 60 or 180 px, off the middle of its core; nothing from 256 px."""
    y, x = np.indices((600, 600), dtype=float)
    radius = np.maximum(np.hypot(x - 300.3, y - 299.6), 1.0)
    truth = flux * radius**-3.0
    image = truth + np.random.default_rng(5).normal(0.0, 1.0, truth.shape)
    none = np.zeros(image.shape, bool)
    halo = measure_halo(image, none, np.ones(image.shape), np.array([300.0, 300.0, 8.0]))
    light = np.zeros(image.shape)
    light[halo.window] = halo.light
    ratio = light / truth
    for near, far, tolerance in ((10, end_px, 0.03), (80, 250, 0.5)):
        ring = ratio[(radius > near) & (radius < far)]
        assert np.median(ring) == pytest.approx(1.0, abs=tolerance)
    assert (light[radius > 257] == 0).all() and (light[radius < 255] > 0).all()


@pytest.mark.parametrize(("middle_px", "has_halo"), [(30.0, True), (150.0, False)])
def test_light_far_from_a_core_is_not_its_halo(middle_px, has_halo):
    """A ring of light 40 px wide around a core, within 64 px of it or outside."""
    y, x = np.indices((500, 500), dtype=float)
    radius = np.hypot(x - 250, y - 250)
    image = 5.0 * (np.abs(radius - middle_px) < 20)
    image += np.random.default_rng(5).normal(0.0, 1.0, image.shape)
    none = np.zeros(image.shape, bool)
    halo = measure_halo(image, none, np.ones(image.shape), np.array([250.0, 250.0, 6.0]))
    assert (halo is not None) == has_halo


def test_read_noise_limits_the_noise_of_the_sky_in_all_fits():
    """Without light, an image of whole counts has no noise of its own."""
    image, none = np.full((128, 128), 50.0), np.zeros((128, 128), bool)
    sky = subtract_sky(image, none, least_noise=3.0)
    stars = StarFluxes(np.array([[64.0, 64.0]]), np.array([1e3]), np.array([0.03]))
    nothing = np.zeros(image.shape)
    no_cores = np.empty((0, 3))
    again = around_stars(image, sky, sky.noise, nothing, stars, 16, None, 1.0, no_cores)[0]
    assert sky.noise.min() == again.noise.min() == pytest.approx(3.0)


@pytest.mark.parametrize("earlier", [None, "wings"])
def test_wings_that_no_star_of_an_image_shows_stay_the_earlier_ones(earlier):
    """Their light was left in the image, which had its sky without it."""
    rng, place = np.random.default_rng(4), np.array([[64.0, 64.0], [30.0, 90.0]])
    wings = earlier and Wings(RADIUS, np.geomspace(3e-4, 1e-4, 7), 1e-9 * np.eye(7), 0.03)
    stars = StarFluxes(place, np.array([3e5, 2e5]), np.full(2, 0.03))
    light, nothing = draw_wings((128, 128), stars, wings), np.zeros((128, 128))
    image = 50.0 + light + rng.normal(0.0, 3.0, light.shape)
    # Galaxies: their middle is far above the models, and above nothing.
    for x, y in place.astype(int):
        image[y - 2 : y + 3, x - 2 : x + 3] += 3e3
    none = nothing > 0
    sky, error = subtract_sky(image, none), np.full(light.shape, 3.0)
    args = image, sky, error, nothing, stars, 10, wings, 0.1, np.empty((0, 3))
    sky, wing_light, wings_after, _ = around_stars(*args)
    assert wings_after is wings
    assert wing_light == pytest.approx(light)
    assert np.median(sky.level) == pytest.approx(50.0, abs=0.3)


def test_wings_and_sky_settle_in_two_fits(monkeypatch):
    """The light of two turns is the limit of many, to the given part of its error."""
    rng = np.random.default_rng(3)
    shape, count = (400, 400), 150
    flux, place = 10 ** rng.uniform(3, 5, count), rng.uniform(0, 400, (count, 2))
    stars = StarFluxes(place, flux, np.full(count, 0.03))
    true = Wings(RADIUS, np.geomspace(2e-4, 7e-5, len(RADIUS)), np.eye(len(RADIUS)), 0.03)
    image = 300.0 + draw_wings(shape, stars, true) + rng.normal(0.0, 15.0, shape)
    sky, nothing, fits = subtract_sky(image, np.zeros(shape, bool)), np.zeros(shape), []

    def count_fit(*args):
        fits.append(fit_wings(*args))
        return fits[-1]

    monkeypatch.setattr(wings_fit, "fit_wings", count_fit)
    args = image, sky, sky.noise, nothing, stars, 10
    no_cores = np.empty((0, 3))
    wings = around_stars(*args, None, 0.3, no_cores)[2]
    fit_count, limit = len(fits), wings
    for _ in range(3):
        limit = around_stars(*args, limit, 0.01, no_cores)[2]
    light, error = limit.light()
    # The sky takes a part of the wings, which one fit alone does not give back.
    assert abs(fits[0].light()[0] - light) > error
    assert 2 <= fit_count <= 3 and abs(wings.light()[0] - light) < 0.3 * error


@pytest.mark.parametrize("ratio", [(0.64, 0.0), (0.7, -0.3), (0.5, 0.5), (-0.4, 0.0)])
def test_wings_and_sky_settle_where_the_answer_of_the_sky_changes(monkeypatch, ratio):
    """Turns reach the fixed point of F(x), whose slope ρ changes once x is nearer to it.

    A ρ of the first turns that was kept let the following ones diverge: all fluxes were too large
    by many of their errors.
    """
    stars = StarFluxes(np.array([[50.0, 50.0]]), np.array([1e4]), np.array([0.03]))
    unit = Wings(RADIUS, np.geomspace(2e-4, 7e-5, len(RADIUS)), np.eye(len(RADIUS)), 0.03)
    light = unit.light()[0]
    unit = replace(unit, covariance=np.eye(len(RADIUS)) * (light / unit.light()[1]) ** 2)

    def answer(*args):
        # In units of the fixed point, with an error of 1: slope ρ₁ below the knee, ρ₂ from there.
        distance, knee = args[5].light()[0] / light - 1.0, -0.15
        change = ratio[1] * max(distance, knee) + ratio[0] * min(distance - knee, 0.0)
        return replace(unit, profile=unit.profile * (1.0 + change))

    monkeypatch.setattr(wings_fit, "fit_wings", answer)
    image = np.random.default_rng(3).normal(300.0, 15.0, (100, 100))
    sky, nothing = subtract_sky(image, np.zeros(image.shape, bool)), np.zeros(image.shape)
    start = replace(unit, profile=0.6 * unit.profile)
    args = image, sky, sky.noise, nothing, stars, 10, start, 0.02, np.empty((0, 3))
    assert around_stars(*args)[2].light()[0] / light == pytest.approx(1.0, abs=0.04)


@pytest.mark.parametrize("spread", [0.1, 0.5])
def test_wings_that_do_not_settle_have_the_error_of_their_changes(monkeypatch, spread):
    """Answers alternate between two values, whatever the wings that were subtracted."""
    stars = StarFluxes(np.array([[50.0, 50.0]]), np.array([1e4]), np.array([0.03]))
    unit = Wings(RADIUS, np.geomspace(2e-4, 7e-5, len(RADIUS)), 1e-14 * np.eye(len(RADIUS)), 0.03)
    light, error = unit.light()
    assert error < 0.01 * spread * light
    factors = cycle([1.0 + spread, 1.0 - spread])
    answers = []

    def answer(*args):
        answers.append(next(factors))
        return replace(unit, profile=answers[-1] * unit.profile)

    monkeypatch.setattr(wings_fit, "fit_wings", answer)
    image = np.random.default_rng(3).normal(300.0, 15.0, (100, 100))
    sky, nothing = subtract_sky(image, np.zeros(image.shape, bool)), np.zeros(image.shape)
    args = image, sky, sky.noise, nothing, stars, 10, unit, 0.02, np.empty((0, 3))
    _, wing_error = around_stars(*args)[2].light()
    assert len(answers) == 8 and spread * light < wing_error < 4.0 * spread * light


@pytest.mark.parametrize("distance", [9, 60])
def test_wings_of_a_star_on_saturated_cores_without_halos_are_subtracted_once(distance):
    """Nothing is left of them, and they are in the map of the light, for one core or two."""
    place = np.array([[100.0, 100.0], [104.0, 100.0]])
    wings = Wings(RADIUS, np.geomspace(3e-4, 1e-4, len(RADIUS)), np.eye(len(RADIUS)), 0.03)
    stars = StarFluxes(place, np.full(2, 1e3), np.full(2, 0.03))
    light = draw_wings((200, 200), stars, wings)
    is_saturated = np.zeros(light.shape, bool)
    for column in (100, 100 + distance):
        is_saturated[98:103, column - 2 : column + 3] = True
    residual, wing_light = np.zeros_like(light), light.copy()
    cores = find_saturated_cores(is_saturated)
    args = np.zeros(light.shape, bool), np.full(light.shape, 1e3), stars, wings, cores
    assert (subtract_halos(residual, wing_light, *args) == 0.0).all()
    assert np.abs(residual).max() <= 1e-6 * light.max()
    assert np.abs(wing_light - light).max() <= 1e-6 * light.max()


@pytest.mark.parametrize(
    ("light", "middle", "stretch"),
    [(2e7, (100.4, 119.6), 1.0), (2e8, (185.3, 289.6), 1.0), (2e8, (60.0, 60.0), 1.08)],
)
def test_errors_of_stars_on_a_halo_include_the_error_of_the_halo(sky, light, middle, stretch):
    """Faint stars on all sides: a middle between pixels, at an edge, beside listed stars; ovals."""
    folder, model, true = sky
    rng = np.random.default_rng(7)
    place, flux = np.stack([true["x"], true["y"]], axis=1), np.array(true["flux"])
    for angle in np.arange(0, 32 * np.pi, 0.3):
        distance = rng.uniform(12, 45)
        new = middle + distance * np.array([np.cos(angle), np.sin(angle)])
        if np.hypot(*(place - new).T).min() > 9 and (abs(new - SIZE / 2) < SIZE / 2 - 8).all():
            place, flux = np.vstack([place, new]), np.append(flux, 10 ** rng.uniform(3.2, 3.8))
    row, column = np.indices((SIZE, SIZE))
    radius = np.hypot(stretch * (column - middle[0]), (row - middle[1]) / stretch)
    added = light * profile(radius, 0.0)
    faint = slice(len(true), None)
    add_stamps(added, flux[faint, None, None] * stamps(*place[faint].T), *place[faint].T)
    image = np.minimum(fits.getdata(folder / "i.fits") + rng.poisson(added), 6e4)
    source = ImageInput(image, catalogue=place, origin=0, gain=1.0, saturate=6e4)
    rows = crowded.photometry(load_model(model), open_observation(source, STAMP)).stars[faint]
    pull = ((rows["flux"] - flux[faint]) / rows["flux_error"])[rows["flags"] == 0]
    assert len(pull) > 0.6 * len(rows) > 12
    assert 0.7 < np.sqrt(np.mean(pull**2)) < 1.25 and np.abs(pull).max() < 3.5
    assert 0.6 < np.mean(np.abs(pull) < 1) < 0.85
    # Of stars at 20 to 45 px, errors are still useful.
    distance = np.hypot(*(place[faint] - middle).T)
    relative_error = (rows["flux_error"] / flux[faint])[distance > 20]
    assert np.median(relative_error) < 0.07


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["x.txt"], "x.txt"),
        (["o.csv", "--zero-point", "25", "--reference", "near.csv"], "--zero-point"),
        (["o.csv", "--reference", "far.csv"], "0 of its stars"),
        (["o.csv", "--residual", "o.csv"], "o.csv"),
    ],
)
def test_what_cannot_be_measured_is_refused_in_one_line(
    sky, tmp_path, monkeypatch, options, message
):
    folder, model, _ = sky
    monkeypatch.chdir(tmp_path)
    for name, place in (("near.csv", [100.0, 150.0]), ("far.csv", [1.0, 2.0])):
        Table({"x": place, "y": place, "mag": [10.0, 11.0]}).write(name)
    words = ("photometry", folder / "i.fits", "--model", model, "--catalogue", "near.csv")
    assert message in refused(*words, "--origin", 0, "--out", *options)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["far.csv", "near.csv"]


def test_rows_that_cannot_be_measured_are_nan_and_flagged_among_the_others():
    measured = Table({"id": [1, 2], "x": [1.5, 2.5], "y": [1.0, 2.0], "flux": [10.0, 20.0]})
    measured["flags"], measured["group"] = np.array([0, 4], np.uint16), [1, 2]
    place = np.array([[1.0, 1.0], [np.nan, 7.0], [2.0, 2.0]])
    flags = np.array([0, 0, 32], np.uint16)
    observation = SimpleNamespace(positions=place, stars=SimpleNamespace(id=[5, 6, 7], flags=flags))
    rows = add_unmeasured_rows(measured, observation, np.array([False, True, False]))
    assert rows["id"].tolist() == [5, 6, 7] and rows["flags"].tolist() == [0, 8, 36]
    np.testing.assert_array_equal(rows["x"], [1.5, np.nan, 2.5])
    np.testing.assert_array_equal(rows["y"], [1.0, 7.0, 2.0])
    np.testing.assert_array_equal(rows["flux"], [10.0, np.nan, 20.0])
    assert rows["group"].tolist() == [1, 0, 2]


def test_light_of_others_leaves_each_star_alone(sky, phot):
    """Stars of pairs, without what their neighbours add: within the noise and 3 % of their peak."""
    folder, _, true = sky
    place = np.stack([true["x"], true["y"]], axis=1)
    pairs = np.flatnonzero(true["pair"])
    pixels = fits.getdata(folder / "i.fits").astype(float) - SKY
    cut = (pixels, pixels.shape, *place.T, STAMP, 2)
    data = cut_image(*cut)[0]
    light = draw_other_stars(phot, place)(slice(None), STAMP, 2)
    middle = slice(FRAME // 2 - STAMP // 2 - 2, FRAME // 2 + STAMP // 2 + 2)
    own_light = np.array(true["flux"])[:, None, None] * stamps(*place.T)[:, middle, middle]
    doubt = np.sqrt(SKY + np.abs(data)) * 4 + 0.03 * own_light.max(axis=(1, 2), keepdims=True)
    off, raw_off = (np.abs(a - own_light)[pairs] > doubt[pairs] for a in (data - light, data))
    assert off.mean() < 0.01 and raw_off.mean() > 0.05


def stars_of(sky, **settings):
    options = {"stamp_px": STAMP, **COUNTS, **settings}
    return Stars.from_image(sky[0] / "i.fits", sky[0] / "i.csv", **options)


def test_stars_are_kept_whose_neighbours_can_be_subtracted(sky, monkeypatch):
    """Stars of pairs are good where many are crowded, and as alike as single ones."""
    raw = stars_of(sky)
    level = float(np.quantile(fits.getdata(sky[0] / "i.fits"), 0.9998))
    saturated = stars_of(sky, saturate=level).candidates.verdict == "saturated"
    monkeypatch.setattr("psfdae.training.from_image.is_crowded", lambda _: True)
    clean = stars_of(sky, saturate=level)
    # Those are still seen without their neighbours.
    assert saturated.any() and (clean.candidates.verdict[saturated] == "saturated").all()
    paired = np.array(sky[2]["pair"])
    assert paired[raw.candidates.bright.row].mean() < 0.02
    assert paired[clean.candidates.bright.row].mean() > 0.2 and len(clean) > 1.2 * len(raw)
    bright = clean.candidates.bright
    single, images = ~paired[bright.row], bright.align()
    ratio = bright.flux / np.array(sky[2]["flux"])[bright.row]
    # The light in the stamp of a star without neighbours, from which nothing was subtracted.
    alone = raw.candidates.bright
    alone_ratio = np.median(alone.flux / np.array(sky[2]["flux"])[alone.row])
    for part in (single, ~single):
        assert np.median(ratio[part]) == pytest.approx(alone_ratio, abs=0.003)
        assert ratio[part].std() == pytest.approx(0.011, abs=0.003)
    means = [images[part].mean(axis=0) for part in (single, ~single)]
    assert np.abs(means[0] - means[1]).max() < 0.01 * means[0].max()


def test_the_second_choice_of_stars_has_the_given_limit_on_neighbours(sky, monkeypatch):
    """Stars that were accepted in spite of brighter neighbours are measured twice."""
    stars, limits = stars_of(sky), []
    accepted = stars.settings.calibration_stars.model_copy(update={"neighbour_ratio": 0.5})
    settings = stars.settings.model_copy(update={"calibration_stars": accepted})

    def collect(observation, calibration, framing, isolation_px):
        limits.append(calibration.neighbour_ratio)
        return stars.candidates

    nothing = SimpleNamespace(stars=[])
    monkeypatch.setattr(crowded, "photometry", lambda *_, **__: nothing)
    monkeypatch.setattr(neighbours, "draw_other_stars", lambda *_: None)
    monkeypatch.setattr(neighbours, "collect", collect)
    chosen = neighbours.subtract_neighbours(replace(stars, settings=settings), 0.05)
    assert limits == [0.05, 0.05]
    assert chosen.settings.calibration_stars.neighbour_ratio == 0.05


def test_of_two_stars_that_move_to_one_place_one_is_kept():
    """The listed one, or of two that were found in residuals the brighter one."""
    place = np.array([[10.0, 10.0], [30.0, 30.0], [10.3, 10.0], [50.0, 50.0], [50.2, 50.0]])
    flux = np.array([100.0, 50.0, 500.0, 20.0, 30.0])
    assert sorted(crowded.find_duplicates(place, flux, 2, 1.0)) == [2, 3]
    swapped = crowded.find_duplicates(place[[0, 1, 2, 4, 3]], flux[[0, 1, 2, 4, 3]], 2, 1.0)
    assert sorted(swapped) == [2, 4]
    assert crowded.find_duplicates(place, flux, 2, 0.1).size == 0


def test_a_list_is_as_accurate_as_where_its_bright_stars_are():
    """Shifted by 0.4, −0.2 px, with a scatter of 0.5 px; none from few stars, or wild ones."""
    rng, count, fwhm = np.random.default_rng(3), 400, 1.5
    origin = 10.0 * np.stack(np.divmod(np.arange(count), 20), axis=1)
    place = origin + rng.normal([0.4, -0.2], 0.5, origin.shape)
    flux_error = np.where(np.arange(count) < 300, 1.0, 40.0)
    place[300:] += 2.0  # faint stars, which noise has moved
    fit = SimpleNamespace(
        position=place,
        flux=np.full(count, 100.0),
        flux_error=flux_error,
        flags=np.zeros(count, int),
    )
    expected, error_px = crowded.locate_listed_stars(fit, origin, fwhm)
    assert expected - origin == pytest.approx(np.tile([0.4, -0.2], (count, 1)), abs=0.1)
    assert error_px == pytest.approx(0.5, rel=0.15)
    fit.position = origin.copy()
    assert crowded.locate_listed_stars(fit, origin, fwhm)[1] == pytest.approx(0.375)
    fit.position = origin + rng.normal(0, 2.0, origin.shape)
    assert crowded.locate_listed_stars(fit, origin, fwhm) is None
    fit.flags[9:] = 1
    assert crowded.locate_listed_stars(fit, origin, fwhm) is None


@pytest.mark.parametrize("call", [PsfModel.photometry, PsfModel.adapt, PsfModel.predict_image])
def test_a_message_on_the_pixel_scale_names_it_as_assumed(sky, call):
    folder, path, true = sky
    place, bundle = np.stack([true["x"], true["y"]], axis=1), load_model(path).bundle
    info = bundle.info.model_copy(update={"pixel_scale_arcsec": 2.0})
    model = PsfModel(replace(bundle, info=info))
    # Pixels of 1 arcsec are assumed where neither WCS nor header has a scale.
    message = r"scale assumed, pixel_scale_arcsec= sets it.*pixels of 1 arcsec"
    with pytest.raises(Error, match=message):
        call(model, fits.getdata(folder / "i.fits"), catalogue=place, gain=1.0)


def test_the_zero_point_is_a_median_with_its_standard_error():
    """Errors of 400 draws of 41 stars; a third of the reference stars have no magnitude."""
    rng, positions = np.random.default_rng(5), np.arange(120.0).reshape(60, 2) * 10
    stars = Table({"x": positions[:, 0], "y": positions[:, 1], "flux": np.full(60, 100.0)})
    fit = SimpleNamespace(stars=stars, model=SimpleNamespace(fwhm_px=lambda: 3.0))
    magnitude = np.repeat([99.0, -99.0, np.nan, 999.0, 15.0], [5, 5, 5, 4, 41])
    pulls = []
    for _ in range(400):
        noisy = magnitude + rng.normal(0.0, 0.05, 60)
        value, scatter, note = measure_zero_point(fit, positions, noisy, "r")
        error = float(note.split("±")[1].split()[0])
        pulls.append((value - 20.0) / error)
        assert "(41 stars of r)" in note and 0.02 < scatter < 0.1
    assert np.std(pulls) == pytest.approx(1.0, abs=0.15) and abs(np.mean(pulls)) < 0.2
