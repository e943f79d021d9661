"""Fluxes of noisy and of broken stars."""

from __future__ import annotations

import numpy as np
import pytest

from psfdae.own_stars import photometry as module
from psfdae.own_stars.photometry import FluxModel, robust_flux
from psfdae.own_stars.stamps import StarFlag as Flag


@pytest.fixture(scope="module")
def model(gaussian_stars):
    return FluxModel.fit(gaussian_stars[:200])


@pytest.fixture(scope="module")
def stars(gaussian_stars):
    return gaussian_stars[200:]


@pytest.fixture
def noisy(stars, noise):
    return noise.draw(stars, 1e-3, np.random.default_rng(1)).astype(np.float64)


def rms(values):
    return np.sqrt(np.mean(values**2))


def broken(noisy, change):
    """The batch with its star 3 changed."""
    batch = noisy.copy()
    change(batch[3])
    return batch


def set_pixel(row, column, value):
    def change(star):
        star[row, column] = value

    return change


def fill(value):
    def change(star):
        star[:] = value

    return change


def test_faint_stars_are_measured_far_better_than_by_their_sum(stars, model, noise):
    """With PSFs that hardly vary, nearly as well as if each PSF were known."""
    images = noise.draw(stars, 5e-3, np.random.default_rng(0))
    estimate = robust_flux(images, model)
    spread = 1 / np.sqrt((stars.astype(np.float64) ** 2).sum(axis=(1, 2)))
    limit = rms(noise.kappa * 5e-3 * spread)
    assert 0.8 * limit < rms(estimate.flux - 1) < 1.6 * limit
    assert rms(estimate.flux - 1) < 0.6 * rms(images.sum(axis=(1, 2)) - 1)


def test_bright_stars_are_measured_as_well_as_by_their_sum(stars, model, noise):
    images = noise.draw(stars, 1e-5, np.random.default_rng(0))
    robust, by_sum = robust_flux(images, model).flux - 1, images.sum(axis=(1, 2)) - 1
    assert rms(robust) < 1.3 * rms(by_sum)


def test_stated_error_is_the_scatter(stars, model, noise):
    images = noise.draw(np.tile(stars, (10, 1, 1)), 2e-3, np.random.default_rng(0))
    estimate = robust_flux(images, model)
    assert rms((estimate.flux - 1) / estimate.error) == pytest.approx(1.0, abs=0.2)
    assert np.mean(estimate.flux - 1) == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(
    ("change", "flags"),
    [
        (set_pixel(4, 9, np.nan), Flag.MASKED),
        (set_pixel(8, 8, np.inf), Flag.MASKED),
        (set_pixel(3, 3, 50.0), Flag.OUTLIER),
        (set_pixel(8, 8, 50.0), Flag.OUTLIER),
        (set_pixel(8, 8, 1e300), Flag.OUTLIER),
        (set_pixel(8, 7, -0.5), Flag.OUTLIER),
        (set_pixel(slice(2, 5), slice(2, 5), 9.0), Flag.OUTLIER),
        (set_pixel(5, slice(None), np.nan), Flag.MASKED),
    ],
)
def test_bad_pixels_are_marked_and_repaired(noisy, stars, model, noise, change, flags):
    clean = robust_flux(noisy, model)
    estimate = robust_flux(broken(noisy, change), model)
    assert estimate.flags[3] == flags
    assert abs(estimate.flux[3] - clean.flux[3]) < 2 * estimate.error[3]
    wrong = estimate.images[3] != noisy[3]
    assert wrong.any()
    # What is put in is closer to the truth than a measured pixel would be, on average.
    assert rms((estimate.images[3] - stars[3])[wrong]) < 2 * noise.kappa * 1e-3


@pytest.mark.parametrize(
    ("change", "flags"),
    [
        (fill(0.0), Flag.NO_FLUX),
        (fill(4.2), Flag.NO_FLUX),
        (fill(np.nan), Flag.NO_FLUX | Flag.MASKED),
        (set_pixel(slice(0, 9), slice(None), np.inf), Flag.NO_FLUX | Flag.MASKED),
    ],
)
def test_hopeless_stars_give_a_zero_image(noisy, model, change, flags):
    estimate = robust_flux(broken(noisy, change), model)
    assert estimate.flags[3] == flags
    assert np.isnan(estimate.flux[3])
    assert not estimate.images[3].any()


def test_negative_star_has_a_flux_that_is_no_use(noisy, model):
    estimate = robust_flux(broken(noisy, lambda star: np.negative(star, star)), model)
    assert estimate.flags[3] & Flag.NO_FLUX
    assert estimate.flux[3] < 0


@pytest.mark.parametrize(
    "change", [fill(np.nan), fill(0.0), set_pixel(8, 8, 1e30), set_pixel(1, slice(None), np.inf)]
)
def test_neighbours_do_not_notice(noisy, model, change):
    before = robust_flux(noisy, model)
    after = robust_flux(broken(noisy, change), model)
    others = np.delete(np.arange(len(noisy)), 3)
    assert np.isfinite(after.images).all()
    assert np.array_equal(after.images[others], before.images[others])
    assert np.array_equal(after.flux[others], before.flux[others])
    assert np.array_equal(after.flags[others], before.flags[others])


@pytest.mark.parametrize("unit", [1e-300, 1e-30, 1e30, 1e300])
def test_unit_does_not_matter(noisy, model, unit):
    before = robust_flux(noisy, model)
    after = robust_flux(noisy * unit, model)
    assert after.flux / unit == pytest.approx(before.flux, rel=1e-12)
    assert after.images / unit == pytest.approx(before.images, rel=1e-12)
    assert np.array_equal(after.flags, before.flags)


def test_sky_without_a_star_is_marked(model):
    sky = np.random.default_rng(0).normal(size=(400, 16, 16))
    estimate = robust_flux(sky, model)
    marked = (estimate.flags & (Flag.NO_FLUX | Flag.FAINT)) > 0
    # A flux of three times its error happens by chance once in 740 stars.
    assert marked.mean() > 0.98
    assert np.isfinite(estimate.images).all()


def test_good_stars_carry_no_flag(stars, model, noise):
    for level in (3e-5, 1e-3):
        images = noise.draw(stars, level, np.random.default_rng(0))
        assert (robust_flux(images, model).flags > 0).mean() < 0.03


def test_inputs_are_left_alone(noisy, model):
    batch = broken(noisy, set_pixel(8, 8, np.nan))
    before = batch.copy()
    robust_flux(batch, model)
    assert np.array_equal(batch, before, equal_nan=True)


def test_training_stars_may_have_any_flux(stars, model):
    scale = np.random.default_rng(0).uniform(0.1, 1e4, size=(len(stars), 1, 1))
    plain, scaled = FluxModel.fit(stars), FluxModel.fit(stars.astype(np.float64) * scale)
    for name in ("mean", "variance", "low", "high"):
        assert getattr(scaled, name) == pytest.approx(getattr(plain, name), rel=1e-5, abs=1e-8)


@pytest.mark.parametrize(("factor", "flags"), [(1.3, 0), (1.8, Flag.OUTLIER)])
def test_pixels_may_leave_the_range_of_the_training_by_half(stars, model, noise, factor, flags):
    batch = noise.draw(stars, 1e-5, np.random.default_rng(1)).astype(np.float64)
    pixel = model.high.argmax()
    batch[3].flat[pixel] = factor * model.high[pixel]
    assert robust_flux(batch, model).flags[3] == flags


def test_noise_of_a_noise_free_star_is_a_millionth_of_its_median_pixel(model):
    images = np.array([1.0, 300.0])[:, None, None] * model.mean.reshape(16, 16)
    assert robust_flux(images, model).noise == pytest.approx(
        1e-6 * np.median(images, axis=(1, 2)), rel=1e-3
    )


def test_one_fit_is_the_one_of_dense_matrices(stars, model):
    """Flux, error, leave-one-out residuals and repaired pixels of the formulae over used pixels."""
    rng = np.random.default_rng(1)
    x = 2.0 * stars[:4].reshape(4, -1).astype(np.float64) + rng.normal(0, 0.01, (4, 256))
    used = rng.random((4, 256)) > np.array([0.0, 0.01, 0.2, 0.4])[:, None]
    prior, sigma = np.array([4.0, 3.0, 5.0, 4.0]), np.array([0.01, 0.02, 0.01, 0.005])
    found = module._generalised_least_squares(x, used, prior, sigma, model)
    covariance = (model.basis * model.variance) @ model.basis.T
    for star, (flux, error, score, repaired) in enumerate(zip(*found, strict=True)):
        whole = prior[star] * covariance + sigma[star] ** 2 * np.eye(256)
        kept, lost = np.flatnonzero(used[star]), np.flatnonzero(~used[star])
        inverse = np.linalg.inv(whole[np.ix_(kept, kept)])
        mean = model.mean[kept]
        information = mean @ inverse @ mean
        assert flux == pytest.approx(mean @ inverse @ x[star, kept] / information, rel=1e-6)
        assert error == pytest.approx(information**-0.5, rel=1e-6)
        residual = inverse @ (x[star, kept] - flux * mean)
        assert score[kept] == pytest.approx(
            np.abs(residual) / np.sqrt(np.diag(inverse)), rel=1e-5, abs=1e-8
        )
        filled = flux * model.mean[lost] + whole[np.ix_(lost, kept)] @ residual
        assert repaired[kept] == pytest.approx(x[star, kept], abs=0)
        assert repaired[lost] == pytest.approx(filled, rel=1e-5, abs=1e-8)


def test_model_refuses_stars_without_flux_and_stamps_of_another_size(stars, model):
    with pytest.raises(ValueError, match="finite and of positive sum"):
        FluxModel.fit(np.concatenate([stars[:5], 0 * stars[:1]]))
    with pytest.raises(ValueError, match="stamps of 196 px, but the flux model has 256"):
        robust_flux(stars[:, 1:-1, 1:-1], model)
