"""Stated errors against the truth of simulated stars."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

import psfdae
from command_line import printed
from psfdae.denoise.error_model import ErrorModel, ModelErrors
from psfdae.denoise.flux_model import FluxModel
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation
from psfdae.image.stamps import StarFlag
from psfdae.methods.field import FieldMixture
from psfdae.methods.field.errors import excess_scatter
from psfdae.methods.interface import Estimate, FitError
from psfdae.photometry.crowded import _psf_doubt, photometry, star_flags
from psfdae.stars.noise import NoiseModel
from psfdae.training.calibration import (
    StarErrors,
    fit_case_scales,
    fit_half_widths,
    fit_model_errors,
    fit_noise_floor,
)
from psfdae.training.fitting import describe_settings, fit_method
from psfdae.training.packing import add_wings, build_uncalibrated
from psfdae.training.star_sets import HeldOutStars
from small_field import GAIN, READ, SKY, noisy

SIZE = 600


class BlindModel:
    """A model that measures no star with a noise floor below `least_floor`."""

    method = SimpleNamespace(finds_flux=True)

    def __init__(self, errors, least_floor):
        self.bundle, self.least_floor = SimpleNamespace(errors=errors), least_floor

    def replace_errors(self, errors):
        return BlindModel(errors, self.least_floor)

    def predict(self, images):
        is_seen = self.bundle.errors.noise_floor >= self.least_floor
        flux = np.full(len(images), 1.0 if is_seen else np.nan)
        return SimpleNamespace(psf=images * flux[:, None, None], flux=flux)


@pytest.mark.parametrize("least_floor", [0.0, 2e-3, np.inf])
def test_a_noise_floor_with_which_no_star_is_measured_is_not_chosen(least_floor):
    """Where none is right, the fit ends with an error, not with a floor."""
    nodes, star = np.array([1e-3, 2e-3, 4e-3, 8e-3]), np.full((1, 16, 16), 1 / 256)
    model = BlindModel(ErrorModel.build_uncalibrated(nodes, np.ones((4, 16, 16))), least_floor)
    unknown = np.zeros((1, 2)), np.zeros(1), np.zeros_like(star)
    stars = HeldOutStars(star, star, NoiseModel(1.0, 1e9), *unknown)
    if np.isfinite(least_floor):
        assert fit_noise_floor(model, stars, 1).noise_floor == least_floor
    else:
        with pytest.raises(FitError, match=r"none of 1 held-out stars .* 0.001, 0.002"):
            fit_noise_floor(model, stars, 1)


@pytest.mark.parametrize("order", ["in turn", "one after the other"])
def test_each_case_of_the_calibration_has_images_of_most_stars(order):
    """24 stars with six images each, in either order: a sixth of the images has 16 stars or so."""
    number = np.arange(144) % 24 if order == "in turn" else np.arange(144) // 6
    position = np.stack([number, np.zeros(144)], axis=1).astype(float)
    images = np.full((144, 16, 16), 1 / 256)
    stars = HeldOutStars(
        images, images, NoiseModel(1.0, 1e9), position, np.zeros(144), np.zeros_like(images)
    )

    class Seen(Exception):
        """Ends the calibration at its first prediction."""

    def predict(stamps, flux, background, noise, position):
        estimated = np.isnan(flux).astype(int) + np.isnan(background)
        seen.update({case: len(set(position[estimated == case, 0])) for case in range(3)})
        raise Seen

    seen, nodes = {}, np.array([1e-3, 2e-3])
    errors = ErrorModel.build_uncalibrated(nodes, np.ones((2, 16, 16)))
    model = SimpleNamespace(
        bundle=SimpleNamespace(errors=errors),
        method=SimpleNamespace(knows_field=True),
        predict=predict,
    )
    with pytest.raises(Seen):
        fit_case_scales(model, stars, 1)
    assert min(seen.values()) >= 12


def test_half_widths_that_are_calibrated_anew_have_no_factors_of_before(monkeypatch):
    """Factors are of the half-widths that they were found with."""
    nodes, widths = np.array([1e-3, 2e-3]), np.ones((2, 16, 16))
    errors = ErrorModel.build_uncalibrated(nodes, widths)
    before = replace(errors, scale68=2 * errors.scale68, scale95=3 * errors.scale95)
    model = SimpleNamespace(
        bundle=SimpleNamespace(errors=before, flux_model=None),
        method=None,
        info=SimpleNamespace(components=1),
    )
    found = StarErrors(nodes, np.ones((2, 5, 16, 16)), np.arange(5), np.ones((2, 5)))
    monkeypatch.setattr(StarErrors, "measure", lambda *arguments: found)
    after, _ = fit_half_widths(model, None, 1)
    assert (after.scale68 == 1).all() and (after.scale95 == 1).all()


def moffat(side, x, y, ux, uy):
    """Moffat star (β = 3, FWHM 2.8 px) of flux 1 in the plane, wider and rounder by its place."""
    axis = (np.arange(3 * side) + 0.5) / 3 - 0.5
    e1, e2, fwhm = 0.08 * ux, 0.08 * uy, 2.8 * (1 + 0.1 * ux * uy)
    u, v = np.meshgrid(axis - x, axis - y)
    u, v = u * (1 + e1) + v * e2, v * (1 - e1) + u * e2
    alpha = fwhm / 2 / np.sqrt(2 ** (1 / 3) - 1)
    star = ((1 + (u * u + v * v) / alpha**2) ** -3.0).reshape(side, 3, side, 3).mean((1, 3))
    return star * 2 * (1 - e1**2 - e2**2) / (np.pi * alpha**2)


def star_at(place, side):
    """A star of flux 1 in a stamp about the pixel of its place."""
    phase = place - np.floor(place + 0.5)
    return moffat(side, *(side // 2 + phase), *(2 * place / SIZE - 1))


def bright_field(seed):
    """Image with 60 stars of S/N 150 to 2500, none near another, and their places."""
    rng, half = np.random.default_rng(seed), 30
    cell = np.stack(np.meshgrid(np.arange(8), np.arange(8)), axis=-1).reshape(-1, 2)[:60]
    place = (cell + rng.uniform(0.3, 0.7, cell.shape)) * SIZE / 8
    light = np.zeros((SIZE + 2 * half,) * 2)
    for at, flux in zip(place, 10 ** rng.uniform(4.3, 5.5, len(place)), strict=True):
        x, y = np.floor(at + 0.5).astype(int)
        light[y : y + 2 * half + 1, x : x + 2 * half + 1] += flux * star_at(at, 2 * half + 1)
    return noisy(light[half:-half, half:-half], rng), place


def fitted(seed):
    """A model of such an image, as `psfdae.fit` makes it, but for the errors of its pixels."""
    image, place = bright_field(seed)
    camera = {"gain": GAIN, "read_noise": READ, "pixel_scale_arcsec": 0.6}
    stars = psfdae.Stars.from_image(image, place, **camera)
    field = fit_method(stars, FieldMixture)
    settings, of_fit = stars.settings, describe_settings(stars, FieldMixture)
    packed, _ = build_uncalibrated(
        field, stars.product, "realisation", settings, of_fit, "field", ""
    )
    model = psfdae.PsfModel(packed)
    model = model.replace_errors(fit_model_errors(model, field, 1))
    wings = photometry(model, stars.observation, 3.0).image_wings
    return psfdae.PsfModel(add_wings(model.bundle, wings))


@pytest.fixture(scope="module")
def models():
    return [fitted(seed) for seed in range(1, 13)]


def within(off, error):
    """Parts of the offsets within one and 1.96 errors."""
    return np.mean(np.abs(off) < error), np.mean(np.abs(off) < 1.96 * error)


@pytest.mark.parametrize("flag", [StarFlag.NO_FLUX, StarFlag.OUTLIER])
def test_a_field_whose_stars_cannot_be_measured_is_an_error_of_one_line(flag):
    """Quantiles of no star do not exist."""

    def draw_stars(count, rng):
        return np.zeros((count, 16, 16)), np.zeros((count, 2)), np.zeros((count, 2))

    def predict(stamps, position):
        return SimpleNamespace(flags=np.full(len(stamps), int(flag)))

    info, bundle = SimpleNamespace(noise_equivalent_px=10.0), SimpleNamespace(errors=None)
    model = SimpleNamespace(info=info, bundle=bundle, predict=predict)
    field = SimpleNamespace(knows_field=True, draw_stars=draw_stars)
    with pytest.raises(psfdae.Error, match="stars drawn from the fitted field"):
        fit_model_errors(model, field, 1)


@pytest.mark.parametrize("stars", [3, 130, 260])
def test_half_widths_of_a_field_are_those_of_all_its_stars(stars):
    """Few stars are drawn several times; of many, none is left out."""
    image, rng = np.eye(3)[None] / 3, np.random.default_rng(1)
    truth, zeros = image.repeat(stars, axis=0), np.zeros((stars, 3, 3))
    held_out = HeldOutStars(
        truth, truth, NoiseModel(1000.0, 1.0), zeros[:, 0, :2], zeros[:, 0, 0], zeros
    )

    def estimate(noisy, level, position):
        return Estimate(noisy, outlier_score=np.zeros(len(noisy)))

    method = SimpleNamespace(knows_field=True, estimate=estimate)
    mean = image.ravel()
    flux_model = FluxModel(mean, np.eye(9), np.full(9, 1e-4), mean, mean)
    errors = StarErrors.measure(held_out, method, flux_model, np.array([1e-3, 1e-2]), 0, rng)
    assert np.unique(errors.star).tolist() == list(range(stars))
    assert errors.error.shape == (2, len(errors.star), 3, 3) and len(errors.star) >= 125


@pytest.mark.slow
@pytest.mark.parametrize("snr", [(5, 20), (20, 50), (50, 200), (200, 1000), (1000, 2000)])
def test_errors_hold_at_every_signal_to_noise(models, snr):
    rng, side, count = np.random.default_rng(2), models[0].stamp_px + 4, 100
    coverage = {}
    for model in models:
        place = rng.uniform(20, SIZE - 20, (count, 2))
        # Flux of a star of S/N r over n = 24 pixels: r² = F² / (F / g + n σ²).
        star_snr = 10 ** rng.uniform(*np.log10(snr), count)
        sky, photons = 24 * (SKY / GAIN + (READ / GAIN) ** 2), star_snr**2 / (2 * GAIN)
        flux = photons + np.sqrt(photons**2 + sky * star_snr**2)
        light = [f * star_at(at, side) for f, at in zip(flux, place, strict=True)]
        stamps = noisy(np.stack(light), rng)
        prediction = model.predict(stamps, position=place, gain=GAIN, margin=2)
        usable = (prediction.flags & psfdae.StarFlag.NO_FLUX) == 0
        assert usable.mean() > 0.98
        centre = side // 2 + place - np.floor(place + 0.5)
        pairs = {
            "flux": (prediction.flux_total - flux, prediction.flux_total_error),
            "sky": (prediction.background - SKY, prediction.background_error),
            "x": (prediction.x_fit - centre[:, 0], prediction.x_error),
            "y": (prediction.y_fit - centre[:, 1], prediction.y_error),
        }
        for name, (off, error) in pairs.items():
            coverage.setdefault(name, []).append(within(off[usable], error[usable]))
    for name, parts in coverage.items():
        within_1_sigma, two = np.mean(parts, axis=0)
        # 1200 stars leave ± 0.014 and 0.006, but bright stars of a model share its error.
        assert 0.61 < within_1_sigma < 0.75, (name, within_1_sigma)
        assert 0.91 < two < 0.985, (name, two)


@pytest.mark.slow
def test_no_errors_of_the_model_where_numbers_are_known(models):
    place = np.full((3, 2), 300.0)
    stamps = 1e5 * np.stack([star_at(at, 16) for at in place]) + SKY
    stated = {"position": place, "noise": 10.0, "background": SKY, "centre": np.zeros((3, 2))}
    prediction = models[0].predict(stamps, fixed=True, **stated)
    assert (prediction.background_error == 0).all()
    assert (prediction.x_error == 0).all()
    errors = models[0].bundle.errors.model_errors
    assert (prediction.flux_error > 1e5 * errors.flux * errors.flux_factor(place)).all()


@pytest.mark.slow
def test_photometry_keeps_the_list_and_states_errors_of_bright_stars(models, tmp_path):
    image, place = bright_field(1)
    models[0].save(tmp_path / "m.psf.safetensors")
    header = {"GAIN": GAIN, "RDNOISE": READ, "PIXSCALE": 0.6, "BUNIT": "electron"}
    fits.writeto(tmp_path / "i.fits", image.astype(np.float32), fits.Header(header.items()))
    names = [f"star {n}" for n in range(60, 0, -1)]
    Table({"id": names, "x": place[:, 0], "y": place[:, 1]}).write(tmp_path / "s.csv")
    words = ["photometry", tmp_path / "i.fits", "--catalogue", tmp_path / "s.csv", "--origin", 0]
    words += ["--model", tmp_path / "m.psf.safetensors", "--out", tmp_path / "p.ecsv"]
    printed(*words)
    rows = Table.read(tmp_path / "p.ecsv")
    assert rows["id"].tolist() == names
    assert (rows["flags"] == 0).mean() > 0.9
    # As one star after the other is measured by `predict`, within the errors of both.
    photometry = next(
        models[0].stream(
            open_observation(ImageInput(tmp_path / "i.fits", catalogue=place), 16, 2), threads=1
        )
    )[1]
    off = np.array(rows["flux"]) - photometry.flux_total
    within_1_sigma, two = within(off, np.hypot(rows["flux_error"], photometry.flux_total_error))
    assert within_1_sigma > 0.6 and two > 0.9
    # No error of a bright star is below that of the model, which grows towards the edge.
    model_error = models[0].flux_error(place)
    assert (rows["flux_error"] > model_error * rows["flux"]).all()
    middle, edge = models[0].flux_error(np.array([[300.0, 300.0], [20.0, 20.0]]))
    assert edge > 1.2 * middle


def test_flags_of_photometry():
    """Stars that are fine, at the edge, saturated, masked, faint, badly fitted, near, and lost."""
    x = np.array([50.0, 1.0, 80.0, 20.0, 20.0, 50.0, 80.0, 82.0, np.nan])
    y = np.array([50.0, 50.0, 80.0, 20.0, 80.0, 20.0, 20.0, 20.0, np.nan])
    flux = np.full(9, 100.0)
    flux[8] = np.nan
    stars = Table({"x": x, "y": y, "flux": flux, "flux_error": np.full(9, 10.0)})
    stars["flux_error"][4] = 50.0
    stars["chi2"] = np.where(np.arange(9) == 5, 30.0, 1.0)
    stars["photutils_flags"] = np.zeros(9, int)
    bad, saturated = np.zeros((2, 100, 100), bool)
    bad[21, 20] = saturated[80, 82] = True
    flags = star_flags(stars, bad, saturated, 5, 3.0)
    of = psfdae.StarFlag
    expected = [0, of.TRUNCATED, of.SATURATED, of.MASKED, of.FAINT, of.POOR_FIT]
    assert flags.tolist() == [*expected, of.BLENDED, of.BLENDED, of.NO_FLUX]
    stars["photutils_flags"][:2] = [32, 8]
    flags = star_flags(stars, bad, saturated, 5, 3.0)
    assert flags[:2].tolist() == [of.OFF_CENTRE, of.TRUNCATED | of.POOR_FIT]


def test_a_star_whose_box_ends_at_the_edge_is_not_truncated():
    """An image of 30 columns and 20 rows, boxes of 5 px."""
    x = np.array([2.0, 15.0, 27.0, 15.0, 1.0, 15.0, 28.0, 15.0])
    y = np.array([10.0, 2.0, 10.0, 17.0, 10.0, 1.0, 10.0, 18.0])
    stars = Table({"x": x, "y": y, "flux": np.full(8, 9.0), "flux_error": np.ones(8)})
    stars["chi2"], stars["photutils_flags"] = np.ones(8), np.zeros(8, int)
    flags = star_flags(stars, *np.zeros((2, 20, 30), bool), 5, 0.5)
    assert flags.tolist() == [0] * 4 + [psfdae.StarFlag.TRUNCATED] * 4


def test_the_doubt_by_the_psf_is_from_stars_within_the_reach_of_their_stamps():
    """1.5 % of a neighbour's light, spread over its stamp, on the noise-equivalent area."""
    place = np.array([[10.0, 10.0], [21.0, 10.0], [34.0, 10.0], [80.0, 10.0], [82.0, 10.0]])
    flux = np.array([100.0, 200.0, 400.0, 300.0, -50.0])
    doubt = _psf_doubt(place, flux, 16, 8.0)
    share = 0.015 * 8.0 / 16**2
    assert doubt == pytest.approx(share * np.array([200.0, 100.0, 0.0, 0.0, 0.0]))


def test_errors_of_fluxes_grow_from_the_middle_of_the_field():
    """v = a + b u² + c w² + d u² w², and the mean over the field where a position is not known."""
    errors = ModelErrors(middle=np.array([100.0, 50.0]), growth=np.array([0.5, 2e-3, 3e-3, 1e-5]))
    place = np.array([[100.0, 50.0], [110.0, 50.0], [100.0, 30.0], [90.0, 70.0], [np.nan, 50.0]])
    variance = [0.5, 0.5 + 0.2, 0.5 + 1.2, 0.5 + 0.2 + 1.2 + 0.4, 1.0]
    assert errors.flux_factor(place) == pytest.approx(np.sqrt(variance))


def test_the_scatter_beyond_errors_is_found_and_0_where_there_is_none():
    rng = np.random.default_rng(3)
    sigma = rng.uniform(0.5, 2.0, 4000)
    assert excess_scatter(np.hypot(sigma, 1.5) * rng.normal(size=4000), sigma) == pytest.approx(
        1.5, rel=0.06
    )
    assert excess_scatter(0.9 * sigma * rng.normal(size=4000), sigma) == 0.0
    assert excess_scatter(np.array([9.0, -9.0, 9.0, -9.0]), np.ones(4)) == 0.0
