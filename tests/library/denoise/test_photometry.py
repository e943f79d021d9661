"""Fluxes of noisy and of broken stars; centring, and shapes of PSFs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from prediction_stars import observe
from psfdae.base.rows import Rows
from psfdae.denoise import flux_model as module
from psfdae.denoise.denoiser import FieldDenoiser
from psfdae.denoise.error_model import ErrorModel
from psfdae.denoise.flux_model import FluxModel, robust_flux
from psfdae.denoise.leading_modes import LeadingModes, compute_clipped_rms
from psfdae.denoise.star_flux import Photometer
from psfdae.image.sky import border_pixels
from psfdae.image.stamps import StarFlag, cut, displacement, smooth_stamps
from psfdae.psf.wings import Wings
from psfdae.stars import moments
from psfdae.stars.moments import measure_shapes
from psfdae_paper.stars.example import FieldRecipe, star_images

MASKED, OUTLIER, FAINT, NO_FLUX = StarFlag(1), StarFlag(2), StarFlag(4), StarFlag(8)


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


# Flux


@pytest.mark.parametrize(
    ("value", "place", "flags"),
    [
        (np.inf, (8, 8), MASKED),
        (np.nan, (5,), MASKED),
        (50.0, (8, 8), OUTLIER),
        (1e300, (8, 8), OUTLIER),
        (-0.5, (8, 7), OUTLIER),
        (9.0, (slice(2, 5), slice(2, 5)), OUTLIER),
    ],
)
def test_bad_pixels_are_marked_and_repaired(noisy, stars, model, noise, value, place, flags):
    broken = noisy.copy()
    broken[3][place] = value
    clean, estimate = robust_flux(noisy, model), robust_flux(broken, model)
    assert estimate.flags[3] == flags
    assert abs(estimate.flux[3] - clean.flux[3]) < 2 * estimate.flux_error[3]
    is_repaired = estimate.images[3] != noisy[3]
    assert is_repaired.any()
    # What is put in is closer to the truth than a measured pixel would be, on average.
    assert rms((estimate.images[3] - stars[3])[is_repaired]) < 2 * noise.kappa * 1e-3


def test_sky_without_a_star_is_marked_and_good_stars_are_not(stars, model, noise):
    sky = np.random.default_rng(0).normal(size=(400, 16, 16))
    # A flux of three times its error happens by chance once in 740 stars.
    assert ((robust_flux(sky, model).flags & (NO_FLUX | FAINT)) > 0).mean() > 0.98
    for level in (3e-5, 1e-3):
        images = noise.draw(stars, level, np.random.default_rng(0))
        assert (robust_flux(images, model).flags > 0).mean() < 0.03


@pytest.mark.parametrize(("factor", "flags"), [(1.3, 0), (1.8, OUTLIER)])
def test_pixels_may_leave_the_range_of_the_training_by_half(stars, model, noise, factor, flags):
    batch = noise.draw(stars, 1e-5, np.random.default_rng(1)).astype(np.float64)
    pixel = model.high.argmax()
    batch[3].flat[pixel] = factor * model.high[pixel]
    assert robust_flux(batch, model).flags[3] == flags


@pytest.mark.parametrize("modes", [256, 40])
def test_one_fit_is_the_one_of_dense_matrices(stars, model, modes):
    """Flux, error, leave-one-out residuals and repaired pixels of the formulae over used pixels.

    Few modes leave out directions, which have one variance.
    """
    other = model.variance[-modes:].min() if modes < 256 else 0.0
    leading = {"basis": model.basis[:, -modes:], "variance": model.variance[-modes:]}
    model = replace(model, **leading, other_variance=other)
    rng = np.random.default_rng(1)
    x = 2.0 * stars[:4].reshape(4, -1).astype(np.float64) + rng.normal(0, 0.01, (4, 256))
    used = rng.random((4, 256)) > np.array([0.0, 0.01, 0.2, 0.4])[:, None]
    prior, sigma = np.array([4.0, 3.0, 5.0, 4.0]), np.array([0.01, 0.02, 0.01, 0.005])
    results = module.solve_least_squares(x, used, prior, sigma, model)
    covariance = (model.basis * (model.variance - other)) @ model.basis.T + other * np.eye(256)
    for star, (flux, error, score, repaired) in enumerate(zip(*results, strict=True)):
        total = prior[star] * covariance + sigma[star] ** 2 * np.eye(256)
        used_px, bad_px = np.flatnonzero(used[star]), np.flatnonzero(~used[star])
        inverse = np.linalg.inv(total[np.ix_(used_px, used_px)])
        mean = model.mean[used_px]
        information = mean @ inverse @ mean
        assert flux == pytest.approx(mean @ inverse @ x[star, used_px] / information, rel=1e-6)
        assert error == pytest.approx(information**-0.5, rel=1e-6)
        residual = inverse @ (x[star, used_px] - flux * mean)
        expected = np.abs(residual) / np.sqrt(np.diag(inverse))
        assert score[used_px] == pytest.approx(expected, rel=1e-5, abs=1e-8)
        filled = flux * model.mean[bad_px] + total[np.ix_(bad_px, used_px)] @ residual
        assert repaired[used_px] == pytest.approx(x[star, used_px], abs=0)
        assert repaired[bad_px] == pytest.approx(filled, rel=1e-5, abs=1e-8)


def test_model_of_stars_of_any_flux_refuses_those_without_and_stamps_of_another_size(stars, model):
    scale = np.random.default_rng(0).uniform(0.1, 1e4, size=(len(stars), 1, 1))
    plain, scaled = FluxModel.fit(stars), FluxModel.fit(stars.astype(np.float64) * scale)
    for name in ("mean", "variance", "low", "high"):
        assert getattr(scaled, name) == pytest.approx(getattr(plain, name), rel=1e-5, abs=1e-8)
    with pytest.raises(ValueError, match="positive sum"):
        FluxModel.fit(np.concatenate([stars[:5], 0 * stars[:1]]))
    with pytest.raises(ValueError, match="196 px"):
        robust_flux(stars[:, 1:-1, 1:-1], model)


# Many stars at once


@pytest.fixture(scope="module")
def whole_model(gaussian_stars):
    return FluxModel.fit(gaussian_stars)


@dataclass(frozen=True)
class Given(Rows):
    """The given values of stars that `Photometer` reads."""

    flux: np.ndarray
    background: np.ndarray
    noise: np.ndarray

    def __len__(self):
        return len(self.flux)


def measure(model, stamps, start, bad=False, **stated):
    """Photometry of stamps of which some is known."""
    unknown = dict.fromkeys(("flux", "background", "noise"), np.nan)
    values = {name: np.full(len(stamps), value) for name, value in (unknown | stated).items()}
    bad = np.zeros(stamps.shape, dtype=bool) | bad
    start = np.full(len(stamps), start)
    return Photometer(model, 48).measure(stamps, bad, start, Given(**values))


@pytest.mark.parametrize("sky_known", [True, False])
def test_flux_is_the_one_of_dense_matrices(gaussian_stars, whole_model, sky_known):
    """F = mᵀQx / mᵀQm with Q = S⁻¹, without its part along the sky where that is unknown."""
    stars, sky, sigma = gaussian_stars[:10].astype(np.float64), 70.0, 8.0
    stamps = 1e3 * stars + sky + np.random.default_rng(5).normal(0, sigma, stars.shape)
    stated = {"noise": sigma} | ({"background": sky} if sky_known else {})
    phot = measure(whole_model, stamps, sky + 3.0, **stated)
    covariance = (whole_model.basis * whole_model.variance) @ whole_model.basis.T
    mean, flat_sky = whole_model.mean, np.ones(256)
    for star in range(10):
        prior = phot.flux[star] ** 2 + sigma**2 / (mean @ mean)
        inverse = np.linalg.inv(prior * covariance + sigma**2 * np.eye(256))
        if not sky_known:
            inverse -= np.outer(inverse @ flat_sky, inverse @ flat_sky) / (
                flat_sky @ inverse @ flat_sky
            )
        x, information = stamps[star].ravel() - sky, mean @ inverse @ mean
        error = information**-0.5
        assert phot.flux_error[star] == pytest.approx(error, rel=0.01)
        assert phot.flux[star] == pytest.approx(mean @ inverse @ x / information, abs=0.05 * error)
        sky_error = 0.0 if sky_known else (x.sum() - phot.flux[star]) / 256
        assert phot.background[star] == pytest.approx(sky + sky_error, abs=1e-3)
        image = (x - sky_error) / phot.flux[star]
        assert phot.images[star].ravel() == pytest.approx(image, abs=1e-5)


@pytest.mark.parametrize("sigma", [0.1, 10.0])
def test_noise_of_bright_and_of_faint_stars_is_that_of_the_sky(gaussian_stars, whole_model, sigma):
    """Signal to noise from 20 to 2000: the light of a star is no noise."""
    stamps = 1e3 * gaussian_stars[:200].astype(np.float64) + 70.0
    stamps += np.random.default_rng(5).normal(0, sigma, stamps.shape)
    assert measure(whole_model, stamps, 72.0).noise.mean() == pytest.approx(sigma, rel=0.05)


@pytest.mark.parametrize("sky", [0.0, 4.0])
def test_sky_that_is_given_is_believed_in_stamps_with_bad_pixels(gaussian_stars, whole_model, sky):
    """The flux of x − b is what the good pixels say at that sky, and nothing else."""
    stamps = 1e3 * gaussian_stars[:20].astype(np.float64)
    stamps += np.random.default_rng(6).normal(0, 8.0, stamps.shape)
    bad = np.zeros(stamps.shape, dtype=bool)
    bad[:, 2:5, 3:9] = True
    phot = measure(whole_model, stamps, 0.0, bad, background=sky)
    masked = robust_flux(np.where(bad, np.nan, stamps - sky), whole_model)
    assert phot.flux == pytest.approx(masked.flux, rel=1e-6)
    assert phot.flux_error == pytest.approx(masked.flux_error, rel=1e-6)
    assert phot.background == pytest.approx(sky, abs=1e-12)


def test_stars_as_bright_as_their_error_are_fitted_and_flagged_as_with_care(
    gaussian_stars, whole_model
):
    """Flux below its error is none, below three times it is faint, whichever solver is asked."""
    flux = np.linspace(-1.0, 4.0, 300)[:, None, None]
    stamps = 10.0 * flux * gaussian_stars + np.random.default_rng(8).normal(0, 1, (300, 16, 16))
    phot = measure(whole_model, stamps, 0.0)
    ratio = phot.flux / phot.flux_error
    assert (ratio < 1).sum() > 50 and ((ratio > 1) & (ratio < 2)).sum() > 20
    assert np.array_equal((phot.flags & NO_FLUX) > 0, ~(ratio > 1))
    assert np.array_equal((phot.flags & FAINT) > 0, (ratio > 1) & (ratio < 3))
    assert (phot.images[ratio < 1] == 0).all()
    dense = robust_flux(stamps, whole_model.with_free_sky)
    careful = ratio < 2
    assert phot.flux[careful] == pytest.approx(dense.flux[careful], rel=1e-6)
    assert phot.flux_error[careful] == pytest.approx(dense.flux_error[careful], rel=1e-6)


def test_another_flux_of_the_same_light_is_another_sky(gaussian_stars, whole_model):
    rng = np.random.default_rng(9)
    stamps = 1e3 * gaussian_stars[:20] + 70.0 + rng.normal(0, 3.0, (20, 16, 16))
    phot = measure(whole_model, stamps, 72.0)
    factor = rng.uniform(0.5, 2.0, 20)
    rescaled = phot.scale_flux(factor)

    def light(measured):
        sky = measured.background[:, None, None]
        return measured.flux[:, None, None] * measured.images + sky

    assert rescaled.flux == pytest.approx(factor * phot.flux)
    assert rescaled.images.sum(axis=(1, 2)) == pytest.approx(phot.images.sum(axis=(1, 2)), abs=1e-4)
    assert light(rescaled) == pytest.approx(light(phot), abs=1e-3)


@pytest.mark.parametrize("sky_known", [True, False])
def test_residuals_of_the_border_are_those_of_dense_matrices(
    gaussian_stars, whole_model, sky_known
):
    """Q(x − Fm) over the root of the diagonal of Q, Q as above."""
    sigma, flux = 0.01, np.array([1.1, 0.9, 1.0])
    stars = gaussian_stars[:3].reshape(3, -1).astype(np.float64) + 0.004
    stars += np.random.default_rng(7).normal(0, sigma, stars.shape)
    total = stars.sum(axis=1)
    x = stars - total[:, None] / 256
    leading, variance = whole_model.basis[:, -48:], whole_model.variance[-48:]
    weight = np.tile(1 / (variance + sigma**2), (3, 1))
    scores = LeadingModes(whole_model, 48).border_scores(
        x, x @ leading, total, flux, weight, np.full(3, sigma**2), np.full(3, sky_known)
    )
    inverse = np.linalg.inv((leading * variance) @ leading.T + sigma**2 * np.eye(256))
    if not sky_known:
        column = inverse @ np.ones(256)
        inverse -= np.outer(column, column) / column.sum()
    residual = (stars - flux[:, None] * whole_model.mean) @ inverse / np.sqrt(np.diag(inverse))
    assert scores == pytest.approx(residual[:, border_pixels(16)], abs=1e-4)


def test_root_mean_square_of_scores_is_without_outliers_and_without_nan():
    """1 for a normal variable; a row of NaN counts as 1."""
    score = np.random.default_rng(9).normal(size=(3, 20_000))
    score[0, :100], score[1, ::2], score[2] = 50.0, np.nan, np.nan
    assert compute_clipped_rms(score) == pytest.approx([1.0, 1.0, 1.0], abs=0.02)
    assert compute_clipped_rms(score)[2] == 1.0


# Centring


def test_noise_moves_no_star(field_psfs):
    stars = observe(field_psfs, 1e-2, seed=4)
    assert displacement(stars.stamps, 1).any(axis=1).mean() < 0.01


def test_filled_pixels_do_not_count_as_noise(shipped):
    """They would make its estimate small: noise would move stars, and skies would seem wrong."""
    rng, size = np.random.default_rng(6), (200, shipped.stamp_px, shipped.stamp_px)
    stamps, bad = rng.normal(100.0, 1.0, size), np.zeros(size, bool)
    border = np.unravel_index(border_pixels(size[-1]), size[1:])
    bad[:, border[0][::2], border[1][::2]] = bad[:, border[0][1::4], border[1][1::4]] = True
    filled = np.where(bad, 100.0, stamps)
    assert displacement(filled, 1).any(axis=1).mean() > 0.1
    assert not displacement(filled, 1, bad=bad).any()
    # The given sky is right; another one, 20 σ away, is not.
    for sky, is_off in ((100.0, False), (120.0, True)):
        flags = shipped.predict(stamps, background=np.full(200, sky), bad=bad).flags
        assert ((flags & StarFlag.SKY_OFF > 0) == is_off).all()


def test_intervals_of_95_percent_contain_those_of_68_percent():
    noise, unit = np.array([0.01, 0.1]), np.ones((2, 8, 8))
    errors = replace(ErrorModel.build_uncalibrated(noise, unit), ratio95=np.array([0.5, 2.0]))
    given = SimpleNamespace(noise=np.ones(3), flux=np.ones(3), background=np.zeros(3))
    psf = np.full((3, 8, 8), 1 / 64)
    _, ratio95, _ = errors.compute_half_widths(psf, None, np.array([0.01, 0.07, 0.1]), given)
    assert ratio95[:, 0] == pytest.approx([1.0, 1.5, 2.0])


def test_light_outside_stamps_is_by_the_psf_at_listed_magnitude_and_colour():
    """The outer light of this PSF is 0.01 times magnitude and colour, or the magnitude by flux."""

    def psf_at(position):
        share = 0.01 * np.nan_to_num(position[:, 2:]).sum(axis=1)
        psf = np.zeros((len(position), 8, 8))
        psf[:, 4, 4], psf[:, 4, 7] = 1.0 - share, share
        return psf

    wings = Wings(np.array([4.0, 8.0, 16.0]), np.array([0.0, 1e-3, 1e-4]), np.eye(3), 0.03)
    denoiser = object.__new__(FieldDenoiser)
    denoiser.method, denoiser.wings = SimpleNamespace(psf_at=psf_at), wings
    count, flux = 4, np.full(4, 10**-1.2)  # of magnitude 3
    stars = SimpleNamespace(
        x=np.full(count, 50.0),
        y=np.full(count, 60.0),
        magnitude=np.array([np.nan, 1.0, 1.0, np.nan]),
        colour=np.array([np.nan, np.nan, 0.5, 0.5]),
        background=np.zeros(count),
    )
    photometry = SimpleNamespace(flux=flux, background=np.zeros(count))
    total = denoiser._total_fluxes(stars, photometry, np.zeros(count))["flux_total"]
    expected = wings.total_over_flux(np.array([0.03, 0.01, 0.015, 0.035]))[0]
    assert total / flux == pytest.approx(expected, rel=1e-9)


def test_smoothing_is_by_a_quarter_a_half_a_quarter_and_repeats_the_edge():
    stamps = np.random.default_rng(0).normal(size=(40, 16, 16))
    kernel = np.outer([1, 2, 1], [1, 2, 1])[None] / 16
    expected = ndimage.convolve(stamps, kernel, mode="nearest")
    assert smooth_stamps(stamps) == pytest.approx(expected, abs=1e-12)
    smooth = smooth_stamps(np.random.default_rng(1).normal(size=(4000, 16, 16)))
    assert (smooth[:, 3, 3] - smooth[:, 9, 9]).std() == pytest.approx(np.sqrt(2) * 6 / 16, rel=0.05)


def test_cut_moves_the_middle_and_repeats_the_edge():
    frames = np.arange(2 * 100).reshape(2, 10, 10)
    assert np.array_equal(cut(frames, 6), frames[:, 2:8, 2:8])
    moved_px = cut(frames, 6, np.array([[0, 0], [-1, 2]]))
    assert np.array_equal(moved_px[0], frames[0, 2:8, 2:8])
    assert np.array_equal(moved_px[1], frames[1, 1:7, 4:10])
    off_edge = cut(frames, 6, np.array([[4, 0], [0, 0]]))[0]
    assert (off_edge[4:] == frames[0, 9, 2:8]).all()


# Shapes


def gaussians(sigma, ratio, angle, count=50):
    """Gaussians at random sub-pixel positions, integrated over fine sub-pixels."""
    rng, q = np.random.default_rng(1), 5
    grid = (np.arange(16 * q) + 0.5) / q - 8
    x0, y0 = rng.uniform(-1, 1, (2, count, 1, 1))
    x, y = grid[None, None, :] - x0, grid[None, :, None] - y0
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    fine = np.exp(-0.5 * (u**2 + (v / ratio) ** 2) / sigma**2)
    return fine.reshape(count, 16, q, 16, q).sum(axis=(2, 4))


@pytest.mark.parametrize(
    ("sigma", "ratio", "degrees"),
    [(0.85, 1.0, 0.0), (2.1, 1.0, 0.0), (2.4, 0.6, -60.0)],
)
def test_width_and_axes_of_a_gaussian_with_its_pixel(sigma, ratio, degrees):
    shapes = measure_shapes(gaussians(sigma, ratio=ratio, angle=np.deg2rad(degrees)))
    major, minor = np.hypot(sigma, 12**-0.5), np.hypot(ratio * sigma, 12**-0.5)
    assert shapes.fwhm_px == pytest.approx(2.3548 * (major * minor) ** 0.5, rel=0.01)
    assert shapes.ellipticity == pytest.approx(1 - minor / major, abs=0.02 if ratio == 1 else 0.01)
    off = (shapes.position_angle_deg - degrees + 90) % 180 - 90
    assert ratio == 1 or np.abs(off).max() < 0.5


@pytest.mark.parametrize("defocus", [0.0, 0.8, 1.5])
def test_the_shape_of_an_aberrated_star_is_where_its_weight_rests(defocus):
    """300 plain updates move it less than 3e-4 of the width, also of the ring of a star."""
    recipe = replace(FieldRecipe(), defocus_waves=defocus, seeing_px=1.2)
    psf = star_images(recipe, np.random.default_rng(2).uniform(0, 1500, (40, 2)))
    shapes, update = measure_shapes(psf), moments._update_gaussian
    gaussian = np.array([np.zeros(40), np.zeros(40), *moments._adaptive_moments(psf)])
    row, column = (axis.ravel() - 15.5 for axis in np.indices((32, 32)))
    terms = np.stack([np.ones(1024), column, row, column**2, column * row, row**2])
    for _ in range(300):
        gaussian = update(gaussian, psf.reshape(40, -1), terms.astype(np.float32), 32)
    xx, xy, yy = gaussian[2:]
    assert shapes.fwhm_px == pytest.approx(2.35482 * (xx * yy - xy**2) ** 0.25, rel=3e-4)


def test_shapes_of_nothing_are_nan_and_of_anything_finite():
    square = np.ones((16, 16))
    skewed = np.random.default_rng(0).random((16, 16)) ** 8
    spikes = [square, skewed, 1e30 * np.eye(16), np.eye(16)[:1] * square]
    shapes = measure_shapes(np.stack([0 * square, -square, np.nan * square, *spikes]))
    assert np.isnan(shapes.fwhm_px[:3]).all()
    for values in vars(shapes).values():
        assert np.isfinite(values[3:]).all()
    assert (shapes.ellipticity[3:] >= 0).all()
