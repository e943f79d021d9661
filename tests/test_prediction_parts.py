"""Parts of the prediction alone: centring, shapes of PSFs, order and bounds of the stream."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from prediction_stars import observe
from psfdae.prediction.centring import displacement, recut
from psfdae.prediction.shapes import measure_shapes
from psfdae.prediction.stream import in_order


def test_noise_moves_no_star(field_psfs):
    for level in (3e-3, 1e-2):
        stars = observe(field_psfs, level, seed=4)
        assert displacement(stars.stamps, 1).any(axis=1).mean() < 0.01


def test_recut_moves_the_middle():
    wide = np.arange(2 * 100).reshape(2, 10, 10)
    cut = recut(wide, np.array([[0, 0], [-1, 2]]), 6)
    assert np.array_equal(cut[0], wide[0, 2:8, 2:8])
    assert np.array_equal(cut[1], wide[1, 1:7, 4:10])


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
