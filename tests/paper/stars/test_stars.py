"""Fields, framing, noise and splits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from psfdae.base.files import Product
from psfdae.base.rng import stream
from psfdae.methods.lmmse import LinearMmse
from psfdae.optics.wavefronts import seidel_wavefronts, zernike_wavefronts
from psfdae.stars.noise import LAWS, NoiseModel, build_noise, draw_levels
from psfdae.stars.splits import (
    draw_jitter,
    draw_phase,
    held_out_fields,
    held_out_split,
    random_split,
)
from psfdae.training.star_sets import noisy_test_images
from psfdae_paper.stars.fields import assign_fields, perturb, relative_field, square_grid
from psfdae_paper.stars.framing import (
    FramingError,
    Propagation,
    brightest_pixel,
    crop_jittered,
)
from psfdae_paper.stars.scenes import template_wavefronts


@pytest.fixture(scope="module")
def templates(scene1):
    """Propagation of the 121 static wavefronts and their brightest pixels."""
    framing = scene1.framing
    propagation = Propagation(
        template_wavefronts(scene1), scene1.telescope, scene1.optics, framing, framing.search_px
    )
    return propagation, propagation.brightest()


def test_streams_are_independent_and_repeatable():
    first = stream(1, "noise", "test").random(4)
    assert (stream(1, "noise", "test").random(4) == first).all()
    assert (stream(1, "noise", "train").random(4) != first).all()
    assert (stream(2, "noise", "test").random(4) != first).all()


def test_every_field_gets_69_or_70_stars():
    counts = np.bincount(assign_fields(8405, 121, stream(1, "field")))
    assert sorted(set(counts)) == [69, 70]
    assert counts.size == 121


def test_jitter_is_uniform_over_nine_positions():
    jitter = draw_jitter(9000, 1, stream(1, "jitter"))
    _, counts = np.unique(jitter, axis=0, return_counts=True)
    assert counts.size == 9
    assert counts == pytest.approx(np.full(9, 1000), abs=5 * np.sqrt(1000))


def test_random_aberrations_have_their_relative_spread():
    static = np.array([0.5, 4.0, 4.196, 1.813, -0.113])
    coefficients = perturb(np.tile(static, (20000, 1)), 0.1, stream(1, "aberration"))
    assert coefficients.mean(axis=0) == pytest.approx(static, rel=4e-3)
    assert coefficients.std(axis=0) == pytest.approx(0.1 * np.abs(static), rel=0.02)
    correlation = np.corrcoef(coefficients.T) - np.eye(5)
    assert np.abs(correlation).max() < 0.03


def test_ties_go_to_the_first_pixel_in_row_order():
    image = np.array([[0.0, 1.0 - 5e-5], [1.0, 0.2]])
    assert brightest_pixel(image, tie=1e-4) == (0, 1)
    assert brightest_pixel(image, tie=1e-5) == (1, 0)


def test_brightest_pixel_lands_at_half_the_stamp_plus_jitter(templates):
    propagation, peak = templates
    assert np.abs(peak + 0.5).max() == pytest.approx(14, abs=1)  # as designed
    stamps, _ = propagation.frame(16, np.array([[1, -1]]))
    assert {brightest_pixel(stamp, 1e-4) for stamp in stamps} == {(9, 7)}


def test_templates_mirror_with_the_field(templates):
    """The field's mirror symmetry y → −y is that of the image."""
    propagation, _ = templates
    stamps = propagation.stamps(64, np.zeros((121, 2), dtype=int)).reshape(11, 11, 64, 64)
    mirrored = stamps[::-1, :, ::-1, :]
    assert np.abs(stamps - mirrored).max() / stamps.max() < 1e-5


def test_search_agrees_with_a_full_search(scene1):
    field = relative_field(scene1.grid)
    seidel = perturb(np.tile(scene1.wavefront.coefficients, (121, 1)), 0.5, stream(5, "x"))
    source = seidel_wavefronts(seidel, field)
    wavefronts = Propagation(source, scene1.telescope, scene1.optics, scene1.framing, 40)
    fine = scene1.optics.model_copy(update={"precision": "complex128"})
    exact = Propagation(source, scene1.telescope, fine, scene1.framing, 40)
    images = exact.stamps(80, np.zeros((121, 2), dtype=int))
    expected = np.array([brightest_pixel(image, 1e-4) for image in images]) - 40
    assert (wavefronts.brightest() == expected).all()


def test_search_image_is_where_the_rays_land(scene1):
    """Tilts move a spot, by (row, column) as (y, x)."""
    tilts = np.array([[0.0, 0.0], [8.0, 0.0], [0.0, -8.0], [-6.0, 3.0]])
    source = zernike_wavefronts((2, 3), tilts)
    wavefronts = Propagation(source, scene1.telescope, scene1.optics, scene1.framing, 40)
    expected = 4.0 * tilts[:, ::-1] / scene1.telescope.pixel
    assert np.abs(wavefronts.brightest() + 0.5 - expected).max() <= 1.0


def test_peak_outside_a_small_window_is_found_by_a_second_search(scene1, templates):
    _, peak = templates
    wide_window, tiny = (
        Propagation(
            template_wavefronts(scene1), scene1.telescope, scene1.optics, scene1.framing, reach
        )
        for reach in (12, 4)
    )
    assert (wide_window.brightest() == peak).all()
    with pytest.raises(FramingError, match="search_px = 4"):
        tiny.brightest()


def test_crop_moves_the_image_by_the_jitter():
    framed = np.zeros((2, 18, 18))
    framed[:, 9, 9] = 1
    cropped = crop_jittered(framed, np.array([[0, 0], [1, -1]]), margin=1)
    assert cropped.shape == (2, 16, 16)
    assert cropped[0, 8, 8] == 1
    assert cropped[1, 9, 7] == 1


@pytest.mark.parametrize("law", ["draw", "draw_gaussian"])
@pytest.mark.parametrize("level", [3e-5, 1e-3, 5e-3])
def test_noise_has_the_paper_s_rms_and_the_star_s_photons(noise, gaussian_stars, level, law):
    psf = np.repeat(gaussian_stars, 8, axis=0)
    levels = np.full(len(psf), level)
    error = getattr(noise, law)(psf, levels, stream(1, "n", str(level))) - psf
    expected = noise.variance(psf, level)
    assert expected.mean() == pytest.approx(
        (4.98 * level) ** 2 + psf.mean() / noise.flux(level), rel=1e-6
    )
    assert error.mean() == pytest.approx(0, abs=5 * np.sqrt(expected.mean() / error.size))
    assert (error**2).mean() == pytest.approx(expected.mean(), rel=0.01)
    # Five standard errors of the variance of bright pixels, where the star's photons count.
    bright = psf > 0.02
    ratio = (error**2 / expected)[bright]
    assert ratio.mean() == pytest.approx(1, abs=5 * np.sqrt(2 / ratio.size))


NOISE = {
    "poisson": {},
    "gaussian": {},
    "detector": {"read_noise_e": 150.0, "gain_e": 200.0},
    "correlated": {"shift_px": 0.3},
}


def noise_of_law(law):
    """The paper's levels by another law."""
    values = {"law": law, "kappa": 4.98, "background_photons": 1e4, **NOISE[law]}
    return build_noise(values)


@pytest.mark.parametrize("draw", ["draw", "draw_gaussian"])
@pytest.mark.parametrize("law", LAWS)
def test_noise_of_every_law_has_its_covariance(gaussian_stars, law, draw):
    """At the same level all laws have the same noise of the sky."""
    noise, level, draws = noise_of_law(law), 3e-4, 6000
    psf = gaussian_stars[0]
    images = np.repeat(psf[None], draws, axis=0)
    error = (
        getattr(noise, draw)(images, level, stream(1, law, draw)).reshape(draws, -1) - psf.ravel()
    )
    expected = noise.covariance(psf.ravel(), level)
    variance = np.diag(expected)
    assert variance == pytest.approx(noise.variance(psf, level).ravel(), rel=1e-6)
    assert variance.min() == pytest.approx((4.98 * level) ** 2, rel=0.02)
    # Covariances of all pairs of pixels, in units of their standard errors.
    correlation = expected / np.sqrt(np.outer(variance, variance))
    unit = error / np.sqrt(variance)
    deviation = (unit.T @ unit / draws - correlation) / np.sqrt((1 + correlation**2) / draws)
    assert np.square(deviation).mean() == pytest.approx(1, abs=0.05)
    assert np.abs(deviation).max() < 6
    assert np.abs(unit.mean(axis=0)).max() < 5 / np.sqrt(draws)
    # The star's photons add noise by every law but one.
    photons = 0.0 if law == "gaussian" else psf.max() / noise.flux(level)
    assert variance.max() == pytest.approx((4.98 * level) ** 2 + photons, rel=1e-6)
    neighbours = correlation[0, 1]
    assert neighbours == pytest.approx(0.21 / 0.58 if law == "correlated" else 0.0)


def test_the_paper_s_noise_is_photons_alone(noise, gaussian_stars):
    """Settings without a law, as of earlier versions, have it, too."""
    flux = np.sqrt(1e4) / (4.98 * 1e-3)
    photons = stream(3, "n").poisson(flux * gaussian_stars + 1e4)
    images = noise_of_law("poisson").draw(gaussian_stars, 1e-3, stream(3, "n"))
    assert images.tobytes() == ((photons - 1e4) / flux).astype(np.float32).tobytes()
    assert build_noise({"kappa": 4.98, "background_photons": 1e4}) == noise
    assert type(noise_of_law("poisson")) is NoiseModel


def test_a_detector_rounds_to_whole_counts(gaussian_stars):
    noise = noise_of_law("detector")
    images = noise.draw(gaussian_stars, 1e-3, stream(4, "n")).astype(np.float64)
    counts = (images * noise.flux(1e-3) + 1e4) / 200.0
    assert np.abs(counts - np.rint(counts)).max() < 1e-3


def test_a_linear_estimator_knows_correlated_noise(gaussian_stars):
    """Its error is the one that follows from the covariances, and less than by variances alone."""
    noise, level = noise_of_law("correlated"), 3e-3
    stars = np.repeat(gaussian_stars, 20, axis=0)
    noisy = noise.draw(stars, level, stream(5, "n"))
    fit = LinearMmse.from_images(gaussian_stars, gaussian_stars, noise)
    white = LinearMmse.from_images(gaussian_stars, gaussian_stars, noise_of_law("poisson"))
    error, white_error = (np.square(m.predict(noisy, level) - stars).mean() for m in (fit, white))
    system = fit.cov_xx + noise.covariance(fit.mean_x, level)
    expected = np.trace(fit.cov_xx - fit.cov_yx @ np.linalg.solve(system, fit.cov_yx.T))
    assert error == pytest.approx(expected / stars[0].size, rel=0.05)
    assert 1.05 < white_error / error < 5


def test_noise_is_that_of_the_star_in_every_split_and_independent_between_sets(
    scene1, gaussian_stars
):
    def noise_of(name, test, level=0.003):
        product = Product(Path("s.h5"), {"stars": {"name": name}}, {"realisation": gaussian_stars})
        return noisy_test_images(scene1, product, np.array(test), level) - gaussian_stars[test]

    set_noise, second_set_noise = (
        noise_of("seidel_10pct", [3, 7, 8]),
        noise_of("seidel_50pct", [3, 7, 8]),
    )
    assert (noise_of("seidel_10pct", [8, 250, 3])[[2, 0]] == set_noise[[0, 2]]).all()
    fainter_noise = noise_of("seidel_10pct", [3, 7, 8], 0.005)
    for noise in (second_set_noise, fainter_noise):
        correlation = np.corrcoef(set_noise.ravel(), noise.ravel())[0, 1]
        assert abs(correlation) < 4 / np.sqrt(set_noise.size)


def test_every_level_of_a_band_is_drawn_as_often():
    levels = np.array([3e-4, 5e-4, 7e-4, 9e-4])
    star_levels = draw_levels(levels, 40000, stream(1, "levels"))
    values, counts = np.unique(star_levels, return_counts=True)
    assert (values == levels).all()
    assert counts == pytest.approx(np.full(4, 10000), abs=5 * np.sqrt(10000))


def test_random_split_sizes_and_separation():
    split = random_split(8405, 6724, 1681, 0.1, seed=4)
    assert (split.fit.size, split.validation.size, split.test.size) == (6052, 672, 1681)
    everyone = np.concatenate([split.fit, split.validation, split.test])
    assert np.unique(everyone).size == 8405
    assert (split.train == np.sort(np.concatenate([split.fit, split.validation]))).all()


@pytest.mark.parametrize(("points", "held_out_count"), [(11, 24), (20, 80)])
def test_held_out_split_never_shares_a_field(points, held_out_count):
    grid, _ = square_grid(points, 1.0)
    fields = len(grid)
    star_field = assign_fields(20 * fields, fields, stream(1, "field"))
    assert held_out_fields(grid).sum() == held_out_count
    split = held_out_split(star_field, grid, 0.1, seed=1)
    parts = [set(star_field[part]) for part in (split.fit, split.validation, split.test)]
    assert sum(map(len, parts)) == len(set.union(*parts)) == fields
    assert len(parts[2]) == held_out_count
    assert split.fit.size + split.validation.size + split.test.size == star_field.size


def test_threads_change_nothing_and_batches_a_rounding(scene1):
    source = template_wavefronts(scene1)
    results = []
    for batch, threads in ((8, 2), (8, 1), (5, 3)):
        optics = scene1.optics.model_copy(update={"batch": batch, "threads": threads})
        propagation = Propagation(source, scene1.telescope, optics, scene1.framing, 24)
        peak = propagation.brightest()
        results.append((peak, propagation.stamps(16, peak)))
    (peak, stamps), (one_peak, one_thread), (other_peak, other_batch) = results
    assert (peak == one_peak).all()
    assert (stamps == one_thread).all()
    assert (peak == other_peak).all()
    assert other_batch == pytest.approx(stamps, abs=1e-5 * stamps.max())


def test_subpixel_phase_moves_the_grid_and_keeps_the_frame(scene1, templates):
    """A grid moved by half a pixel twice is the grid moved by one; the peak stays in place."""
    propagation, peak = templates
    phase = draw_phase(len(peak), stream(1, "phase"))
    assert np.abs(phase).max() <= 0.5
    half_step = propagation.brightest(phase_px=phase)
    assert np.abs(half_step - peak).max() <= 1 + np.abs(peak).max()
    stamps = propagation.stamps(16, half_step + phase)
    brightest = stamps.reshape(len(stamps), -1).max(axis=1)
    assert (stamps[:, 8, 8] >= (1 - 2 * scene1.framing.tie) * brightest).all()
    full_step = propagation.brightest(phase_px=np.ones_like(phase))
    assert (full_step == peak - 1).all()
