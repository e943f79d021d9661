"""Selecting bright stars and making training images of them: sky, centres, stacks, shifts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from psfdae.base.rng import stream
from psfdae.image.sky import sky_around
from psfdae.image.stamps import cut
from psfdae.image.star_criteria import brightest_pixels, find_crowded, misfit, stamp_snr
from psfdae.stars.bright_stars import BrightStars
from psfdae.stars.moments import find_centroids, shift_stamps
from psfdae.stars.noise import NoiseModel, noise_equivalent_px
from psfdae.stars.splits import held_out_fields
from psfdae.training.training_images import compute_bins, make_images, stack_parts, star_grid

FRAMING = SimpleNamespace(stamp_px=16, jitter_px=1)


def gaussians(centre, side=32, sigma=1.5):
    """Round stars of flux 1, centre (row, column) from index side//2; (n, side, side)."""
    axis = np.arange(side) - side // 2
    rows, columns = (axis - np.asarray(centre)[:, i, None] for i in (0, 1))
    light = np.exp(-0.5 * rows[:, :, None] ** 2 / sigma**2 - 0.5 * columns[:, None] ** 2 / sigma**2)
    return light / light.sum(axis=(1, 2), keepdims=True)


def bright_stars(centre, snr=500.0):
    """Stars without noise around the given centres, at random positions of an image."""
    stamps = 1e4 * gaussians(centre)
    count = len(stamps)
    position = np.random.default_rng(4).uniform(0, 1000, (count, 2))
    peak, _ = brightest_pixels(stamps, 3)
    level = np.full(count, snr)
    noise = np.ones(count)
    centre, row, colour = np.asarray(centre), np.arange(count), np.full(count, np.nan)
    return BrightStars(
        stamps, peak, centre, position, 1e4 * noise, noise, level, row, centre, colour
    )


def test_sky_is_that_around_the_star():
    rng = np.random.default_rng(1)
    stamps = rng.normal(200.0, 5.0, (50, 32, 32))
    stamps[:, 12:20, 12:20] += 1e4  # the star
    stamps[::2, 2:5, 2:5] += 500.0  # a neighbour
    bad = np.zeros(stamps.shape, dtype=bool)
    bad[:, 30] = True
    stamps[bad] = 1e6
    level, noise = sky_around(stamps, bad, 16)
    # Of 736 pixels: 5 √(π/2/736) = 0.23 for a median, 4.3 % for a median deviation.
    assert np.abs(level - 200.0).max() < 4 * 0.23
    assert np.abs(noise / 5.0 - 1).max() < 4 * 0.043
    # Without a good pixel both are 0.
    nothing = sky_around(np.zeros((2, 24, 24)), np.ones((2, 24, 24), dtype=bool), 16)
    assert not np.any(nothing)


def test_signal_to_noise_is_that_of_king_s_area():
    star = gaussians([[0.2, -0.3]], side=16)
    noise, flux = 3.0, 20000.0
    rng = np.random.default_rng(2)
    noisy = flux * star + rng.normal(0, noise, (400, 16, 16))
    expected = flux / (noise * np.sqrt(noise_equivalent_px(star[0])))
    measured = stamp_snr(noisy, np.full(400, noise))
    assert measured.mean() == pytest.approx(expected, rel=3e-4)
    assert measured.std() == pytest.approx(1.0, abs=0.15)  # its error is one unit
    assert (stamp_snr(noisy, np.zeros(400)) == 0).all()


def test_area_of_a_star_follows_from_its_signal_to_noise():
    """A = (F / (σ S/N))² is King's 1/Σp², where noise is low."""
    stars, noise = bright_stars([[0.2, 0.4], [0.0, -0.3]]), np.array([0.3, 0.7])
    measured = replace(stars, noise=noise, snr=stamp_snr(stars.stamps, noise))
    area = [noise_equivalent_px(image / image.sum()) for image in stars.stamps]
    assert measured.area() == pytest.approx(area, rel=1e-3)


def test_only_a_bright_neighbour_crowds():
    position = np.array([[0.0, 0.0], [5.0, 0.0], [100.0, 0.0], [106.0, 0.0], [np.nan, 0.0]])
    brightness = np.array([100.0, 1.0, 100.0, 50.0, 1e6])
    verdict = find_crowded(position, brightness, 10.0, 0.02)
    assert verdict.tolist() == [False, True, True, True, False]
    turned = find_crowded(position[::-1], brightness[::-1], 10.0, 0.02)
    assert turned[::-1].tolist() == verdict.tolist()
    assert not find_crowded(np.full((2, 2), np.nan), brightness[:2], 10.0, 0.02).any()


def test_centres_are_found_to_a_hundredth_of_a_pixel():
    centre = np.random.default_rng(3).uniform(-1.4, 1.4, (40, 2))
    stamps = gaussians(centre)
    peak, inside = brightest_pixels(stamps, 3)
    assert inside.all()
    assert brightest_pixels(gaussians([[4.0, 0.0], [3.0, -3.0]]), 3)[1].tolist() == [False, True]
    assert (np.abs(peak - centre) <= 0.5 + 1e-9).all()
    measured = find_centroids(stamps, peak, np.full(40, 1.5), 10, 1.5)
    assert np.abs(measured - centre).max() < 0.01


def test_a_blend_is_a_misfit_although_the_psf_varies():
    rng = np.random.default_rng(6)
    position = rng.uniform(0, 1000, (80, 2))
    width = 1.3 + 0.6 * position[:, 0] / 1000
    stars = np.concatenate([gaussians([[0, 0]], 16, sigma=s) for s in width])
    stars += rng.normal(0, 3e-4, stars.shape)
    stars[10] += 0.3 * gaussians([[0, 5.0]], 16)[0]
    stars[20, 3, 12] += 0.02  # a cosmic ray
    score = misfit(stars, position, np.full(80, 3e-4))
    *single_scores, third, _, _ = np.sort(score)
    assert set(np.argsort(score)[-2:]) == {10, 20}
    assert score[[10, 20]].min() > 4.0 * third
    assert max(single_scores) < 2.5  # at most one good star is lost, at the edge of the field
    unknown = misfit(stars, np.full((80, 2), np.nan), np.full(80, 3e-4))
    assert set(np.argsort(unknown)[-2:]) == {10, 20}


# Images


@pytest.mark.parametrize("count", [47, 195, 300])
def test_every_fifth_star_is_held_out_evenly_over_the_field(count):
    position = np.random.default_rng(count).uniform(0, 2000, (count, 2))
    grid = star_grid(position)
    assert len(np.unique(grid, axis=0)) == count
    is_held_out = held_out_fields(grid)
    assert is_held_out.mean() == pytest.approx(0.2, abs=0.05)
    quarter = compute_bins(position, 2)
    assert (np.bincount(quarter[is_held_out], minlength=4) > 0).all()
    order = np.random.default_rng(0).permutation(count)
    assert (star_grid(position[order]) == grid[order]).all()


def test_a_moved_star_is_the_star_rendered_there():
    rng = np.random.default_rng(7)
    centre, shift = rng.uniform(-0.5, 0.5, (2, 30, 2))
    error = shift_stamps(gaussians(centre), shift) - gaussians(centre + shift)
    assert np.square(error).mean() < 1e-8 * gaussians(centre).max() ** 2 / 0.01
    assert np.square(error).mean() < 1e-8


def test_stacks_are_weighted_by_signal_to_noise():
    aligned = np.stack([np.full((4, 4), v) for v in (1.0, 4.0, 10.0)])
    stacked = stack_parts(aligned, np.array([2.0, 1.0, 1.0]), np.array([0, 0, 2]), 4)
    assert stacked[:, 0, 0] == pytest.approx([2.0, 4.0, 10.0, 4.0])


def test_images_are_framed_normalised_and_moved_only_where_asked():
    centre = np.random.default_rng(8).uniform(-0.5, 0.5, (10, 2))
    stars = bright_stars(centre)
    template = gaussians(np.zeros((10, 2)))
    star = np.repeat(np.arange(10), 40)
    subpixel = np.tile([False, True], 200)
    realisation, images, jitter, _ = make_images(
        stars, template, star, FRAMING, subpixel, stream(1, "test")
    )
    assert realisation.sum(axis=(1, 2)) == pytest.approx(1.0, abs=1e-5)
    peak = np.stack(np.divmod(realisation.reshape(400, -1).argmax(axis=1), 16), axis=1)
    assert (peak - 8 == jitter).all()
    assert set(map(tuple, jitter)) == {(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)}
    # A star that is not moved is a plain piece of the image.
    for image in np.flatnonzero(~subpixel)[::9]:
        image_star = star[image]
        offset = stars.peak[image_star] - jitter[image]
        piece = cut(stars.stamps[image_star : image_star + 1], 16, offset[None])[0]
        assert realisation[image] == pytest.approx(piece / piece.sum(), abs=1e-7)
    # The others lie anywhere in their pixel, and so do their templates.
    place = find_centroids(realisation.astype(float), jitter, np.full(400, 1.5), 10, 1.5)
    phase = (place - jitter)[subpixel]
    assert np.abs(phase.mean(axis=0)).max() < 4 * np.sqrt(1 / 12 / 200)
    assert phase.std(axis=0) == pytest.approx(np.sqrt(1 / 12), rel=0.1)
    moved_centre = find_centroids(images.astype(float), jitter, np.full(400, 1.5), 10, 1.5)
    assert np.abs(moved_centre - place).max() < 0.03


def test_a_neighbour_s_saturated_rest_makes_no_negative_rates():
    """Splines that move a star ring beside it; the least sky of a new noise is enough for all."""
    stars = bright_stars(np.zeros((1, 2)))
    stars.stamps[0, 16 - 10, 16 + 4] = 5 * stars.flux[0]  # just beyond the stamp
    stars.noise[:] = 1e-3 * stars.flux
    star = np.zeros(40, dtype=int)
    images, *_ = make_images(
        stars, gaussians(np.zeros((1, 2))), star, FRAMING, star == 0, stream(1, "test")
    )
    assert images.min() < -3e-3
    noise, level = NoiseModel(1.0, BrightStars.min_sky), 1e-3
    off = noise.draw(images, level, stream(2, "test")) - images
    assert np.square(off).mean() == pytest.approx(noise.variance(images, level).mean(), rel=0.1)
