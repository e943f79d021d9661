"""Stars that the PSF as a filter finds where the models of other stars are subtracted."""

from __future__ import annotations

from contextlib import contextmanager

import numpy as np
import pytest
from scipy.spatial import cKDTree

import psfdae
from psfdae.base import progress
from psfdae.image.image_input import ImageInput
from psfdae.photometry import image_photometry
from psfdae.photometry.image_photometry import measure_all_stars
from psfdae.photometry.matched_filter import find_stars, measure_snr
from psfdae.psf.grid import PsfGrid
from psfdae.psf.wings import outer_shares
from simulated_fields import CAMERA, TrueField, compare, false_share, simulate_field

SIZE = 200
NOBODY = np.array([[-99.0, -99.0]])  # no known star


def gaussian_grid(fwhm, oversampling=4, side=16):
    """A field with one Gaussian PSF."""
    axis = (np.arange(side * oversampling + 1) - side * oversampling // 2) / oversampling
    psf = np.exp(-4 * np.log(2) * (axis**2 + axis[:, None] ** 2) / fwhm**2)
    psf *= oversampling**2 / psf.sum()
    return PsfGrid(np.zeros(1), np.zeros(1), psf[None, None], oversampling)


def lit(grid, place, flux, shape=(SIZE, SIZE)):
    """Light of stars at places (n, 2)."""
    light = np.zeros((shape[0] + 40, shape[1] + 40))
    corner = np.rint(place).astype(int) - 10
    for (column, row), f, star in zip(corner, flux, grid.stamps(place, corner, 21), strict=True):
        light[row + 20 : row + 41, column + 20 : column + 41] += f * star
    return light[20:-20, 20:-20]


@pytest.fixture(scope="module")
def scattered():
    """Positions of 100 stars on a grid, at all phases within a pixel."""
    cells = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0)), axis=-1).reshape(-1, 2)
    return 10.0 + 19.0 * cells + np.random.default_rng(3).uniform(-4, 4, cells.shape)


@pytest.mark.parametrize("fwhm", [1.6, 3.2, 5.0])
@pytest.mark.parametrize("phase", [(0.0, 0.0), (0.5, 0.0), (0.5, 0.5)])
def test_flux_and_snr_are_those_of_a_least_squares_fit(fwhm, phase):
    """F = Σ P r/σ² / Σ P²/σ² and S = F √(Σ P²/σ²), also where the noise differs."""
    rng, grid = np.random.default_rng(1), gaussian_grid(fwhm)
    sigma = rng.uniform(1.0, 3.0, (31, 31))
    residual = rng.normal(0, sigma) + lit(grid, np.array([phase]) + 15, [50.0], (31, 31))
    corner = np.array([[9, 9]])
    phases = 15 + 0.5 * np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
    psf = grid.stamps(phases, np.repeat(corner, 4, axis=0), 13)
    # Most of the scatter is below 1 by a factor: the noise is that of σ.
    maps = (values.astype(np.float32)[None] for values in (residual / sigma, 1.0 / sigma))
    (snr,), (flux,) = measure_snr(*maps, psf[None])
    star = grid.stamps(np.array([phase]) + 15, corner, 13)[0]
    weight = sigma[9:22, 9:22] ** -2.0
    information = (star**2 * weight).sum()
    expected = (star * residual[9:22, 9:22] * weight).sum() / information
    at = 2 * 9 + int(2 * phase[1]), 2 * 9 + int(2 * phase[0])
    assert flux[at] == pytest.approx(expected, rel=1e-4)
    assert snr[at] <= 1.0001 * expected * np.sqrt(information)
    assert snr[at] == pytest.approx(expected * np.sqrt(information), rel=0.3)


@pytest.mark.parametrize("flux", [1e4, 1e6, 1e7, 1e8, 1e10])
def test_nothing_is_found_in_the_light_of_a_star_of_any_brightness(flux):
    """Where the errors of its model make σ so large that single precision rounds 1/σ² to 0."""
    rng, grid, star = np.random.default_rng(4), gaussian_grid(3.2), np.array([[100.3, 99.8]])
    sigma = np.hypot(1.0, 0.03 * lit(grid, star, [flux]))
    residual = rng.normal(0.0, sigma) + lit(grid, np.array([[40.0, 60.5]]), [60.0])
    position, found_flux = find_stars(grid, residual, sigma, star, 6.0, 3.2)
    assert np.hypot(*(position - [40.0, 60.5]).T) == pytest.approx([0.0], abs=0.6)
    assert found_flux == pytest.approx([60.0], rel=0.3)


@pytest.mark.parametrize("place", [(130.0, 61.0), (4.0, 178.0)])
def test_a_search_near_a_star_that_changed_finds_what_a_search_of_all_finds_there(scattered, place):
    """Also at the edge of a tile of 64 px, or of the image."""
    grid, place = gaussian_grid(3.2), np.array([place])
    image = np.random.default_rng(2).normal(0, 1, (SIZE, SIZE))
    image += lit(grid, scattered, np.full(len(scattered), 50.0))
    maps = image, np.ones(image.shape), NOBODY, 4.0, 3.2
    everywhere, flux = find_stars(grid, *maps)
    nearby, nearby_flux = find_stars(grid, *maps, place)
    rows = cKDTree(everywhere).query(nearby)[1]
    assert (nearby == everywhere[rows]).all() and (nearby_flux == flux[rows]).all()
    is_near = np.abs(everywhere - place).max(axis=1) < grid.side_px // 2
    assert is_near.sum() >= 1 and set(np.flatnonzero(is_near)) <= set(rows)
    assert np.abs(nearby - place).max() < 64 + 2 * grid.side_px
    assert not len(find_stars(grid, *maps, np.empty((0, 2)))[0])


@pytest.mark.parametrize("unit", [2.0**-20, 1.0, 2.0**20])
@pytest.mark.parametrize("fwhm", [1.6, 3.2, 8.0])
def test_faint_stars_are_found_and_few_peaks_of_noise(scattered, unit, fwhm):
    """Nearly all stars of S/N 7 are found, with positions and fluxes, in all units of a sky."""
    rng, grid = np.random.default_rng(2), gaussian_grid(fwhm, side=32 if fwhm > 5 else 16)
    flux = 7.0 / np.sqrt(
        np.square(grid.stamps(np.zeros((1, 2)), np.array([[-16, -16]]), 33)[0]).sum()
    )
    scattered = scattered[:: 1 if fwhm < 5 else 7]  # far enough from each other
    light = lit(grid, scattered, np.full(len(scattered), flux))
    image = rng.normal(0, 1, (SIZE, SIZE)) + light
    sigma = np.full(image.shape, unit)
    place, fluxes = find_stars(grid, unit * image, sigma, NOBODY, 4.0, fwhm)
    off, row = cKDTree(place).query(scattered)
    is_found = off < max(1.0, 0.4 * fwhm)
    assert is_found.mean() >= 0.96
    # 4 σ has some 25 peaks in a million pixels for 3.2 px, and four times as many for half of that.
    assert len(place) - is_found.sum() <= 8
    assert np.median(fluxes[row[is_found]]) / unit == pytest.approx(flux, rel=0.08)
    # A star that is known is not found again.
    again, _ = find_stars(grid, unit * image, sigma, place, 4.0, fwhm)
    assert len(again) == 0


def test_a_residual_within_the_error_of_a_model_is_no_star():
    """Beside a bright star, light within 3 % of its model is none; as much beside no star is."""
    grid = gaussian_grid(3.2)
    residual = lit(grid, np.array([[50.2, 50.1], [150.2, 150.4]]), [300.0, 300.0])
    model = lit(grid, np.array([[50.0, 50.0]]), [2e4])
    place, flux = find_stars(grid, residual, np.hypot(1.0, 0.03 * model), NOBODY, 4.0, 3.2)
    assert place == pytest.approx(np.array([[150.0, 150.5]]), abs=0.3)
    assert flux == pytest.approx(300.0, rel=0.05)


@pytest.mark.parametrize("scatter", [2.0, 5.0])
def test_where_the_noise_is_larger_than_sigma_says_fewer_are_found(scatter):
    """Structure in a part of the image makes no stars there: S is over its own scatter."""
    rng, grid = np.random.default_rng(4), gaussian_grid(3.2)
    residual = rng.normal(0, 1, (256, 256))
    residual[:, 128:] *= scatter
    place, _ = find_stars(grid, residual, np.ones(residual.shape), NOBODY, 4.0, 3.2)
    assert len(place) <= 6


def test_stars_on_bad_pixels_and_edges():
    """A star with one bad pixel is found, and one of which most is bad or off the image is not."""
    grid = gaussian_grid(3.2)
    places = np.array([[40.2, 40.0], [100.0, 100.0], [-2.6, 60.0], [1.0, 120.0]])
    residual, sigma = lit(grid, places, np.full(4, 40.0)), np.ones((SIZE, SIZE))
    sigma[40, 41] = sigma[97:104, 97:104] = np.inf
    residual[~np.isfinite(sigma)] = 1e4
    place, _ = find_stars(grid, residual, sigma, NOBODY, 4.0, 3.2)
    assert place == pytest.approx(places[[0, 3]], abs=0.5)
    # Without a single good pixel there is none.
    assert len(find_stars(grid, residual, np.full(sigma.shape, np.inf), NOBODY, 4.0, 3.2)[0]) == 0


def test_the_threshold_has_a_default_for_each_search(tmp_path):
    """5 σ above the sky and 4 σ in residuals; one that is given is the limit of both."""
    image = np.zeros((9, 9))
    for given, both in (({"detect": True}, None), ({"detect": True, "threshold": 6.0}, 6.0)):
        source = ImageInput(image, **given)
        assert source.given_threshold == both and source.detection_sigma == (both or 5.0)
    assert ImageInput(image, detect=7.0).given_threshold == 7.0
    assert ImageInput(image, threshold=7.0).detection_sigma is None


FWHM_PX = 3.0, 3.65


def test_progress_begins_before_the_image_is_opened(monkeypatch):
    shown = []

    @contextmanager
    def display(name):
        shown.append(name)
        yield lambda fraction, text: None

    def interrupt(*_):
        assert shown == ["photometry"]
        raise KeyboardInterrupt

    monkeypatch.setattr(image_photometry, "open_observation", interrupt)
    with progress.use_display(display), pytest.raises(KeyboardInterrupt):
        measure_all_stars(TrueField(200, FWHM_PX), ImageInput(np.zeros((9, 9)), detect=True))


def test_the_outer_share_of_a_star_is_known_from_its_position_whatever_its_flux():
    """Of the PSF there, as the model draws it; only a position that is not known has none."""
    model, place = TrueField(200, (2.5, 4.5)), np.random.default_rng(3).uniform(20, 180, (9, 2))
    expected = outer_shares(model.draw_on_pixels, place)
    place = np.vstack([place, [np.nan, 5.0]])
    grid = PsfGrid.sample(model)
    for flux in (1e4, -3.0, 0.0, np.nan):
        shares = grid.outer_shares(place, np.full(10, flux), model.stamp_px)
        assert shares[:9] == pytest.approx(expected, rel=0.03) and np.isnan(shares[9])
    assert np.ptp(expected) > 0.3 * expected.mean()


def test_faint_stars_of_a_crowded_field_are_found():
    """Few false ones, which have the flag FAINT; a search of pixels found 4 and 65 %."""
    field = simulate_field(300, 180, FWHM_PX, slope=0.5, seed=5)
    source = ImageInput.build(field.image, {"detect": True, **CAMERA})
    table = measure_all_stars(TrueField(300, FWHM_PX), source).table
    faint, middle, *_ = compare(table, field.stars, (4.0, 7.0, 14.0))
    assert faint["found"] >= 0.7 and middle["found"] >= 0.9
    assert abs(middle["bias"]) < 0.06
    assert false_share(table, field.stars) <= 0.025
    clean = table[table["flags"] == 0]
    assert false_share(clean, field.stars) <= 0.01


@pytest.mark.slow
def test_photometry_of_a_crowded_field_with_a_model_of_its_stars():
    """2000 stars on 1000 × 1000 px, all that is found, in ranges of the S/N of an ideal fit."""
    field = simulate_field(1000, 2000, FWHM_PX, seed=1)
    model = psfdae.fit(psfdae.Stars.from_image(field.image, detect=True, **CAMERA), method="field")
    table = model.photometry(field.image, detect=True, **CAMERA)
    bins = compare(table, field.stars)
    assert bins["found"][0] >= 0.7 and bins["found"][1] >= 0.95 and min(bins["found"][2:]) > 0.99
    assert false_share(table, field.stars) <= 0.025
    assert np.abs(bins["bias"][3:]).max() <= 0.003
    assert bins["scatter"][-1] <= 1.2
    assert min(bins["within"][2:]) >= 0.62 and max(bins["within"][2:]) <= 0.74
