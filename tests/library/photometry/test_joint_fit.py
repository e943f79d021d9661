"""All stars of an image in one fit: exact without noise, honest with it, in any unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.sparse import csc_array

from psfdae.photometry.joint_fit import _normal_matrix, chains, fit_stars, standard_errors
from psfdae.psf.grid import PsfGrid
from psfdae.stars.bright_stars import magnitude

SIGMA_PX, FWHM_PX, BOX_PX = 1.2, 2.83, 7


@pytest.fixture(scope="module")
def psfs():
    """A round Gaussian at the four corners of an image of 120 × 120 px."""
    axis = (np.arange(65) - 32) / 4
    psf = np.exp(-(axis[:, None] ** 2 + axis**2) / (2 * SIGMA_PX**2)) / (2 * np.pi * SIGMA_PX**2)
    return PsfGrid(np.array([0.0, 119.0]), np.array([0.0, 119.0]), np.tile(psf, (2, 2, 1, 1)), 4)


def image_of(psfs, place, flux, size=120):
    """Light of stars on an image without noise."""
    side = psfs.side_px
    image = np.zeros((size + 2 * side,) * 2)
    corner = np.rint(place).astype(int) - side // 2
    stamp = psfs.stamps(place, corner, side)
    for (x, y), light in zip(corner + side, flux[:, None, None] * stamp, strict=True):
        image[y : y + side, x : x + side] += light
    return image[side:-side, side:-side]


def test_psfs_change_with_the_magnitude_as_a_parabola(psfs):
    """The ends hold beyond the three magnitudes, and the middle one without a flux."""
    layer = np.array([-1.0, 0.0, 1.0])
    light = 1.0 + 0.2 * layer - 0.1 * layer**2
    grid = replace(
        psfs,
        psfs=light[:, None, None, None, None] * psfs.psfs,
        magnitudes=magnitude(np.array(1e4)) + 2.0 * layer,
    )
    place, corner = np.full((4, 2), 30.2), np.full((4, 2), 27)
    flux = np.append(1e4 * 10.0 ** (-0.8 * np.array([-2.0, 0.4, 2.0])), np.nan)
    ratio = grid.stamps(place, corner, 7, flux) / psfs.stamps(place, corner, 7)
    expected = np.array([0.7, 1.064, 1.1, 1.0])[:, None, None]
    assert ratio == pytest.approx(expected * np.ones((4, 7, 7)), rel=1e-6)


@pytest.mark.parametrize("unit", [1.0, 1e-18])
def test_stars_that_overlap_are_parted_exactly(psfs, unit):
    """A pair at 0.8 FWHM, a chain of three, and a star at the edge; half a pixel off at first."""
    place = np.array([[30.2, 30], [32.4, 30.4], [60, 60.3], [63, 61], [66.1, 60], [118.6, 40]])
    flux = unit * np.array([1e4, 3e3, 2e4, 500.0, 9e3, 4e3])
    image = image_of(psfs, place, flux)
    start = place + np.random.default_rng(1).uniform(-0.5, 0.5, place.shape)
    error, bad = np.full(image.shape, unit), np.zeros(image.shape, bool)
    fit = fit_stars(psfs, image, error, bad, start, None, BOX_PX, FWHM_PX)
    sigma = np.column_stack([fit.flux_error, fit.position_error])
    off = np.column_stack([fit.flux - flux, fit.position - place])
    assert (np.abs(off) < 0.2 * sigma).all()
    assert fit.flags.tolist() == [0, 0, 0, 0, 0, 1]
    assert fit.light == pytest.approx(image, abs=unit)


def test_a_star_is_fitted_as_if_others_far_away_were_not(psfs):
    """A close pair that takes all steps, a star at rest after few, and both in one image."""
    place = np.array([[30.0, 30.0], [30.9, 30.0], [80.3, 80.4]])
    flux = np.array([300.0, 200.0, 1e5])
    image = image_of(psfs, place, flux)
    image += np.random.default_rng(3).normal(0, 3.0, image.shape)
    start = place + np.array([[-0.6, 0.8], [0.9, -0.7], [0.5, 0.4]])
    pixels = image, np.full(image.shape, 3.0), np.zeros(image.shape, bool)
    fit = fit_stars(psfs, *pixels, start, None, BOX_PX, FWHM_PX)
    for rows in ([0, 1], [2]):
        alone = fit_stars(psfs, *pixels, start[rows], None, BOX_PX, FWHM_PX)
        for name in ("position", "position_error", "flux", "flux_error", "flux_bias"):
            assert getattr(fit, name)[rows] == pytest.approx(getattr(alone, name), rel=1e-5)
        assert fit.flags[rows].tolist() == alone.flags.tolist()


@pytest.mark.parametrize("column", [60.0, 118.6])
def test_the_light_of_a_star_far_from_where_it_was_expected_is_whole(psfs, column):
    """2.5 px: its stamp moves with it, also at the edge of the image."""
    place, flux = np.array([[column, 40.0]]), np.array([1e4])
    image = image_of(psfs, place, flux)
    error, bad = np.ones(image.shape), np.zeros(image.shape, bool)
    fit = fit_stars(psfs, image, error, bad, place - [2.5, 0.0], None, 9, 4.0)
    assert fit.position == pytest.approx(place, abs=1e-3)
    assert fit.light == pytest.approx(image, abs=1e-3 * image.max())
    # The corners of the stamp, too, where the light is below that.
    far = np.abs(np.indices(image.shape)[1] - column) > 6
    assert fit.light[far].sum() == pytest.approx(image[far].sum(), rel=0.05)


def test_errors_are_those_of_the_noise(psfs):
    """150 stars, a third of which overlap: (fitted − true)/σ has the scatter 1, and no bias."""
    rng, sky = np.random.default_rng(4), 100.0
    place, flux = rng.uniform(0, 119, (150, 2)), 10 ** rng.uniform(3, 5, 150)
    light = image_of(psfs, place, flux)
    image, error = rng.poisson(light + sky) - sky, np.sqrt(light + sky)
    start = place + rng.normal(0, 0.2, place.shape)
    fit = fit_stars(psfs, image, error, light < -1, start, None, BOX_PX, FWHM_PX)
    pulls = np.column_stack([fit.flux - flux, fit.position - place])
    pulls /= np.column_stack([fit.flux_error, fit.position_error])
    assert (np.abs(pulls) < 1).mean(axis=0) == pytest.approx([0.68] * 3, abs=0.1)
    assert np.median(pulls, axis=0) == pytest.approx([0.0] * 3, abs=0.25)
    assert np.median(fit.chi2) == pytest.approx(1.0, abs=0.1)
    assert (fit.flags & 8 == 0).mean() > 0.95  # at rest


def test_standard_errors_are_those_of_the_inverse_of_all_stars_that_overlap():
    """Two stars that share light, and one alone: √ of the diagonal of N⁻¹, in the stars' units."""
    rng = np.random.default_rng(2)
    pair, single = (d @ d.T for d in (rng.normal(size=(6, 20)), rng.normal(size=(3, 20))))
    normal, unit = block_diag(pair, single), rng.uniform(0.5, 2.0, (3, 3))
    expected = np.sqrt(np.diag(np.linalg.inv(normal))).reshape(3, 3) / unit
    assert standard_errors(csc_array(normal), unit) == pytest.approx(expected, rel=1e-9)


def test_stars_that_have_no_pixels_are_nan_and_the_others_as_without_them(psfs):
    place = np.array([[30.2, 30.0], [np.nan, 5.0], [80.0, 80.0], [500.0, 3.0]])
    image = image_of(psfs, place[[0, 2]], np.array([1e4, 1e4]))
    bad = np.zeros(image.shape, bool)
    bad[70:90, 70:90] = bad[30, 31] = True
    image[bad] = np.nan
    fit = fit_stars(psfs, image, np.ones(image.shape), bad, place, np.full(4, 9e3), BOX_PX, FWHM_PX)
    assert fit.flux[0] == pytest.approx(1e4, abs=1)
    assert np.isnan(fit.flux[1:]).all() and np.isnan(fit.position_error[1:]).all()
    assert fit.flags.tolist() == [1, 64, 64, 64]


def test_a_star_stays_within_its_range_of_where_it_was_expected(psfs):
    place = np.array([[60.0, 60.0]])
    image = image_of(psfs, place, np.array([1e4]))
    weight_and_mask = np.ones(image.shape), np.zeros(image.shape, bool)
    start, origin = place - [1.5, 0.0], place - [3.0, 0.0]
    fit = fit_stars(psfs, image, *weight_and_mask, start, None, BOX_PX, 2.0, origin)
    assert fit.position[0] == pytest.approx([59.0, 60.0], abs=1e-3) and fit.flags[0] & 32


def test_stars_are_drawn_to_known_places_as_far_as_noise_hides_them(psfs):
    """At S/N 3, places scatter as the list's do; at 300 as those by the pixels alone."""
    rng, sigma = np.random.default_rng(7), 10.0
    axis = np.arange(10.0, 115, 12)
    place = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    place += rng.uniform(-0.5, 0.5, place.shape)
    for snr, most, least in ((3.0, 0.25, 0.0), (300.0, 1.05, 0.95)):
        flux = np.full(len(place), snr * sigma * np.sqrt(4 * np.pi) * SIGMA_PX)
        image = image_of(psfs, place, flux) + rng.normal(0, sigma, (120, 120))
        listed = place + rng.normal(0, 0.1, place.shape)
        rest = np.full(image.shape, sigma), np.zeros(image.shape, bool), listed, None, BOX_PX
        free, drawn = (
            fit_stars(psfs, image, *rest, FWHM_PX, position_prior=known)
            for known in (None, (listed, 0.1))
        )
        ratio = np.std(drawn.position - place) / np.std(free.position - place)
        assert least <= ratio < most
        pulls = (drawn.position - place) / drawn.position_error
        assert np.std(pulls) == pytest.approx(1.0, abs=0.15)
        assert np.mean(drawn.flux / flux) == pytest.approx(1.0, abs=0.15 / snr * 3)


def test_the_normal_matrix_has_1_on_its_diagonal_whatever_the_prior():
    rng, prior = np.random.default_rng(2), np.array([0.0, 3.0, 50.0])
    design, boxes = rng.normal(size=(2, 3, 4, 4)), np.arange(32).reshape(2, 4, 4)
    matrix, unit = _normal_matrix(design, boxes, prior)
    assert matrix.diagonal() == pytest.approx(np.ones(6), rel=2e-6)
    assert unit**2 == pytest.approx(np.square(design).sum(axis=(2, 3)) + prior)


def test_chains_of_neighbours():
    place = np.array([[0.0, 0], [1, 0], [2, 0], [9, 9], [np.nan, 0], [9.5, 9]])
    chain = chains(place, 1.5)
    assert [len(set(chain[rows])) for rows in ([0, 1, 2], [3, 5], [0, 3, 4])] == [1, 1, 3]
