"""Parts of the prediction alone: centring, shapes of PSFs, order and bounds of the stream."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from prediction_stars import observe
from psfdae.own_stars.photometry import FluxModel, Photometer, robust_flux
from psfdae.own_stars.shapes import measure_shapes
from psfdae.own_stars.stamps import SMOOTHED_NOISE, border_pixels, cut, displacement, smoothed
from psfdae.threads import in_order


def test_noise_moves_no_star(field_psfs):
    for level in (3e-3, 1e-2):
        stars = observe(field_psfs, level, seed=4)
        assert displacement(stars.stamps, 1).any(axis=1).mean() < 0.01


def test_smoothing_is_by_a_quarter_a_half_a_quarter_and_repeats_the_edge():
    stamps = np.random.default_rng(0).normal(size=(40, 16, 16))
    kernel = np.outer([1, 2, 1], [1, 2, 1])[None] / 16
    expected = ndimage.convolve(stamps, kernel, mode="nearest")
    assert smoothed(stamps) == pytest.approx(expected, abs=1e-12)
    many = smoothed(np.random.default_rng(1).normal(size=(4000, 16, 16)))
    assert (many[:, 3, 3] - many[:, 9, 9]).std() == pytest.approx(SMOOTHED_NOISE, rel=0.05)


@pytest.fixture(scope="module")
def flux_model(gaussian_stars):
    return FluxModel.fit(gaussian_stars)


def known(count, flux=np.nan, background=np.nan, noise=np.nan):
    given = {"flux": flux, "background": background, "noise": noise}
    return SimpleNamespace(**{name: np.full(count, value) for name, value in given.items()})


@pytest.mark.parametrize("sky_known", [True, False])
def test_flux_is_the_one_of_dense_matrices(gaussian_stars, flux_model, sky_known):
    """F = mᵀQx / mᵀQm with Q = S⁻¹, without its part along the sky where that is unknown."""
    stars, sky, sigma = gaussian_stars[:40].astype(np.float64), 70.0, 8.0
    stamps = 1e3 * stars + sky + np.random.default_rng(5).normal(0, sigma, stars.shape)
    given = known(40, background=sky if sky_known else np.nan, noise=sigma)
    bad = np.zeros(stamps.shape, dtype=bool)
    found = Photometer(flux_model, 48).measure(stamps, bad, np.full(40, sky + 3.0), given)
    covariance = (flux_model.basis * flux_model.variance) @ flux_model.basis.T
    mean, one = flux_model.mean, np.ones(256)
    for star in range(40):
        prior = found.flux[star] ** 2 + sigma**2 / (mean @ mean)
        inverse = np.linalg.inv(prior * covariance + sigma**2 * np.eye(256))
        if not sky_known:
            inverse -= np.outer(inverse @ one, inverse @ one) / (one @ inverse @ one)
        x, information = stamps[star].ravel() - sky, mean @ inverse @ mean
        error = information**-0.5
        assert found.flux_error[star] == pytest.approx(error, rel=0.01)
        assert found.flux[star] == pytest.approx(mean @ inverse @ x / information, abs=0.05 * error)
        left = 0.0 if sky_known else (x.sum() - found.flux[star]) / 256
        assert found.background[star] == pytest.approx(sky + left, abs=1e-3)
        image = (x - left) / found.flux[star]
        assert found.images[star].ravel() == pytest.approx(image, abs=1e-5)


@pytest.mark.parametrize("sigma", [0.1, 1.0, 10.0])
def test_noise_of_bright_and_of_faint_stars_is_that_of_the_sky(gaussian_stars, flux_model, sigma):
    """Signal to noise from 20 to 2000: the light of a star is no noise."""
    stamps = 1e3 * gaussian_stars[:200].astype(np.float64) + 70.0
    stamps += np.random.default_rng(5).normal(0, sigma, stamps.shape)
    bad = np.zeros(stamps.shape, dtype=bool)
    found = Photometer(flux_model, 48).measure(stamps, bad, np.full(200, 72.0), known(200))
    assert found.noise.mean() == pytest.approx(sigma, rel=0.05)


def test_sky_that_is_given_is_believed_in_stamps_with_bad_pixels_too(gaussian_stars, flux_model):
    """Of flux_of(x − b) nothing is left but what the good pixels say at that sky."""
    stamps = 1e3 * gaussian_stars[:20].astype(np.float64)
    stamps += np.random.default_rng(6).normal(0, 8.0, stamps.shape)
    bad = np.zeros(stamps.shape, dtype=bool)
    bad[:, 2:5, 3:9] = True
    for sky in (-4.0, 0.0, 4.0):
        given = known(20, background=sky)
        found = Photometer(flux_model, 48).measure(stamps, bad, np.zeros(20), given)
        alone = robust_flux(np.where(bad, np.nan, stamps - sky), flux_model)
        assert found.flux == pytest.approx(alone.flux, rel=1e-6)
        assert found.flux_error == pytest.approx(alone.error, rel=1e-6)
        assert found.background == pytest.approx(sky, abs=1e-12)


@pytest.mark.parametrize("sky_known", [True, False])
def test_residuals_of_the_border_are_those_of_dense_matrices(gaussian_stars, flux_model, sky_known):
    """Q(x − Fm) over the root of the diagonal of Q, Q as above."""
    photometer, ring = Photometer(flux_model, 48), border_pixels(16)
    sigma, flux = 0.01, np.array([1.1, 0.9, 1.0])
    stars = gaussian_stars[:3].reshape(3, -1).astype(np.float64) + 0.004
    stars += np.random.default_rng(7).normal(0, sigma, stars.shape)
    total = stars.sum(axis=1)
    x = stars - total[:, None] / 256
    leading, variance = flux_model.basis[:, -48:], flux_model.variance[-48:]
    weight = np.tile(1 / (variance + sigma**2), (3, 1))
    found = photometer._border_scores(
        x, x @ leading, total, flux, weight, np.full(3, sigma**2), np.full(3, sky_known)
    )
    inverse = np.linalg.inv((leading * variance) @ leading.T + sigma**2 * np.eye(256))
    if not sky_known:
        beyond = inverse @ np.ones(256)
        inverse -= np.outer(beyond, beyond) / beyond.sum()
    residual = (stars - flux[:, None] * flux_model.mean) @ inverse / np.sqrt(np.diag(inverse))
    assert found == pytest.approx(residual[:, ring], abs=1e-4)


def test_cut_moves_the_middle():
    wide = np.arange(2 * 100).reshape(2, 10, 10)
    found = cut(wide, 6, np.array([[0, 0], [-1, 2]]))
    assert np.array_equal(found[0], wide[0, 2:8, 2:8])
    assert np.array_equal(found[1], wide[1, 1:7, 4:10])


def gaussians(sigma, count=50, ratio=1.0, angle=0.0):
    """Gaussians at random sub-pixel positions, integrated over fine sub-pixels."""
    rng, q = np.random.default_rng(1), 5
    grid = (np.arange(16 * q) + 0.5) / q - 8
    x0, y0 = rng.uniform(-1, 1, (2, count, 1, 1))
    x, y = grid[None, None, :] - x0, grid[None, :, None] - y0
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    fine = np.exp(-0.5 * (u**2 + (v / ratio) ** 2) / sigma**2)
    return fine.reshape(count, 16, q, 16, q).sum(axis=(2, 4))


@pytest.mark.parametrize("fwhm", [2.0, 3.0, 5.0])
def test_width_of_a_gaussian_with_its_pixel(fwhm):
    sigma = fwhm / 2.3548
    shapes = measure_shapes(gaussians(sigma))
    assert shapes.fwhm_px == pytest.approx(2.3548 * np.hypot(sigma, 12**-0.5), rel=0.01)
    assert shapes.ellipticity.max() < 0.02


@pytest.mark.parametrize("degrees", [-60.0, 0.0, 30.0, 89.0])
def test_axes_of_an_ellipse(degrees):
    shapes = measure_shapes(gaussians(2.4, ratio=0.6, angle=np.deg2rad(degrees)))
    major, minor = np.hypot(2.4, 12**-0.5), np.hypot(0.6 * 2.4, 12**-0.5)
    assert shapes.ellipticity == pytest.approx(1 - minor / major, abs=0.01)
    assert shapes.fwhm_px == pytest.approx(2.3548 * (major * minor) ** 0.5, rel=0.01)
    off = (shapes.position_angle_deg - degrees + 90) % 180 - 90
    assert np.abs(off).max() < 0.5


def test_shapes_of_nothing_are_nan_and_of_anything_finite():
    rng = np.random.default_rng(0)
    odd = [np.zeros((16, 16)), -np.ones((16, 16)), np.full((16, 16), np.nan)]
    spikes = [
        np.ones((16, 16)),
        rng.random((16, 16)) ** 8,
        1e30 * np.eye(16),
        np.eye(16)[:1] * np.ones((16, 1)),
    ]
    shapes = measure_shapes(np.stack(odd + spikes))
    assert np.isnan(shapes.fwhm_px[:3]).all()
    for values in vars(shapes).values():
        assert np.isfinite(values[3:]).all()
    assert (shapes.ellipticity[3:] >= 0).all()


def test_stream_keeps_order_and_takes_no_more_than_it_needs():
    taken, lock = [], threading.Lock()

    def items():
        for number in range(50):
            with lock:
                taken.append(number)
            yield number

    results = in_order(lambda n: n * n, items(), 3)
    assert next(results) == (0, 0)
    assert len(taken) <= 5
    assert list(results) == [(n, n * n) for n in range(1, 50)]


def test_stream_raises_what_the_work_raises_and_stops():
    done = []

    def work(number):
        if number == 3:
            raise ZeroDivisionError
        done.append(number)
        return number

    with pytest.raises(ZeroDivisionError):
        list(in_order(work, range(1000), 2))
    assert len(done) < 20
