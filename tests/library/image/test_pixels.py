"""Pixels that are not light: bad, blank, overscan, hot, cosmic rays; clipped skies; units."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io import fits
from scipy import ndimage
from scipy.interpolate import RectBivariateSpline
from scipy.spatial import cKDTree

import psfdae
from command_line import refused
from psfdae.api import Stars
from psfdae.image import bad_pixels
from psfdae.image.detection import find_sources
from psfdae.image.errors import ObservationError
from psfdae.image.image_input import ImageInput
from psfdae.image.interpolation import fill_bad, fill_bad_stamps
from psfdae.image.opening import open_observation
from psfdae.image.selection import Verdict, fill_bad_pixels
from psfdae.image.sky import sky_around, subtract_sky
from psfdae.image.sky_level import (
    SkyStructure,
    _smooth_meshes,
    _to_pixels,
    measure_meshes,
    noise_correlation,
    sky_level,
    sky_steps,
)
from psfdae.image.star_criteria import find_pile_up, sharper_than_stars, wider_than_stars
from psfdae.image.trails import add_trails, find_saturated_cores, find_spikes, find_trails
from psfdae.methods.field import FieldMixture
from psfdae.methods.field.fit import FitOptions
from psfdae.photometry import crowded
from psfdae.stars.bright_stars import BrightStars
from psfdae.stars.moments import row_medians
from psfdae.training.fitting import fit_method
from psfdae.training.neighbours import fit_isolated_stars
from small_field import CAMERA, SKY, drawn, moffat, noisy

SIDE = 320


def field(fwhm=2.8, spacing=32):
    """A noisy image of stars on a jittered lattice, their places (n, 2) and fluxes."""
    rng, lattice = np.random.default_rng(1), np.arange(spacing // 2, SIDE, spacing)
    place = np.stack(np.meshgrid(lattice, lattice), axis=-1).reshape(-1, 2)
    place = place + rng.uniform(-4, 4, place.shape)
    flux = 10 ** rng.uniform(4.2, 5.3, len(place))
    return noisy(drawn(moffat(fwhm), place, flux, SIDE), rng), place, flux


@pytest.fixture(scope="module")
def clean():
    return field()


def with_cosmics(image, seed=3, count=40):
    """Hot pixels, and tracks of cosmic rays; which pixels these are."""
    rng, out = np.random.default_rng(seed), image.copy()
    row, column = rng.integers(0, len(image), (2, count))
    out[row, column] += rng.uniform(300, 2e4, count)
    for _ in range(10):
        (y, x), angle = rng.uniform(20, len(image) - 20, 2), rng.uniform(0, np.pi)
        for s in np.arange(0, 10, 0.5):
            out[int(y + s * np.sin(angle)), int(x + s * np.cos(angle))] += rng.uniform(500, 5000)
    return out, out != image


# Cosmic rays and hot pixels.


def find_cosmic_rays(image, saturate=6e4):
    none = np.zeros(image.shape, bool)
    return bad_pixels.find_cosmic_rays(image, none, bad_pixels.pixel_noise(image, none), saturate)


@pytest.mark.parametrize("fwhm", [1.2, 1.6, 2.8, 8.0])
def test_cosmic_rays_are_found_and_stars_are_none(fwhm):
    image = field(fwhm)[0]
    assert not find_cosmic_rays(image).any()
    dirty, true = with_cosmics(image)
    flagged = find_cosmic_rays(dirty)
    assert (flagged & ~true).sum() <= 2
    assert (flagged & true).sum() >= 0.9 * true.sum()


def test_no_star_as_narrow_as_a_pixel_is_a_cosmic_ray():
    assert not find_cosmic_rays(with_cosmics(field(0.5)[0])[0]).any()


def test_a_saturated_star_has_no_cosmic_rays(clean):
    flat = np.minimum(clean[0], 3000.0)
    assert not find_cosmic_rays(flat, 3000.0).any()
    assert not bad_pixels.find_blank_areas(flat, np.zeros(flat.shape, bool), 3000.0)


def test_no_cosmic_ray_is_trained_on_and_their_number_is_said(clean):
    image, place, _ = clean
    dirty, true = with_cosmics(image)
    clean_set = Stars.from_image(image, detect=True, **CAMERA)
    stars = Stars.from_image(dirty, detect=True, **CAMERA)
    distance, _ = cKDTree(place).query(stars.candidates.bright.position)
    assert (distance < 1).all() and len(stars) >= 0.9 * len(clean_set)
    count = np.count_nonzero(find_cosmic_rays(dirty))
    assert abs(count - true.sum()) < 0.1 * true.sum()
    assert f"left out: {count} pixels of cosmic rays and hot pixels" in "\n".join(stars.notes)
    assert "left out" not in "\n".join(clean_set.notes)


def test_a_listed_cosmic_ray_is_flagged_sharp(clean):
    image, place, _ = clean
    dirty = image.copy()
    dirty[150, 165] += 5000.0
    assert np.hypot(*(place - [165, 150]).T).min() > 8
    listed = np.concatenate([place, [[165, 150]]])
    (stamps,) = open_observation(
        ImageInput(dirty, catalogue=listed, origin=0, **CAMERA), 16, 2
    ).chunks(500)
    sharp = (stamps.flags & psfdae.StarFlag.SHARP) > 0
    assert sharp.tolist() == [False] * len(place) + [True]


def test_sources_off_the_locus_of_the_stars_are_sharp():
    area = np.exp(np.random.default_rng(1).normal(3.0, 0.05, 60))
    area[[4, 9]] = 1.0, 5.0
    assert np.flatnonzero(sharper_than_stars(area)).tolist() == [4, 9]
    # Where the PSF changes much over the field, half the area is nothing unusual.
    varied = np.exp(np.linspace(2.0, 4.0, 60))
    assert not sharper_than_stars(varied).any()


def test_galaxies_are_wider_than_the_stars_around_them():
    rng = np.random.default_rng(2)
    place, area = rng.uniform(0, 500, (80, 2)), np.exp(rng.normal(3.4, 0.08, 80))
    area *= 1.0 + np.square(place / 500).sum(axis=1) / 4  # the PSF changes over the field
    assert not wider_than_stars(area, place, np.full(80, 0.05)).any()
    galaxy = np.arange(80) % 2 == 0
    area[galaxy] *= rng.uniform(2.0, 6.0, 40)
    assert (wider_than_stars(area, place, np.full(80, 0.05)) == galaxy).mean() > 0.95


def test_an_image_that_was_cut_off_says_its_saturation(clean):
    unsaid = {key: value for key, value in CAMERA.items() if key != "saturate"}
    image = clean[0].copy()
    image[::40, ::40] = 1e5  # a value for bad pixels is no saturation
    assert (
        open_observation(ImageInput(image, catalogue=clean[1], origin=0, **unsaid), 16).saturate
        is None
    )
    observation = open_observation(
        ImageInput(np.minimum(clean[0], 3000.0), catalogue=clean[1], origin=0, **unsaid), 16
    )
    assert observation.saturate == 3000.0
    assert "exactly the largest value, 3000 counts: taken as saturated" in observation.summary()


@pytest.mark.parametrize("level", [60123.4567, 987.654321])
def test_stars_that_are_cut_off_have_one_brightest_pixel(level):
    """Rounded down to six digits, as it is printed; no level without stars that are cut off."""
    brightness = np.append(np.geomspace(0.1, 0.9, 15), np.geomspace(1.1, 5.0, 15))
    sky, peak = np.full(30, 0.1 * level), 0.9 * level * brightness
    assert find_pile_up(sky + np.minimum(peak, 0.9 * level), sky, brightness) == float(
        f"{level - 0.5 * 10 ** (np.floor(np.log10(level)) - 5):.6g}"
    )
    assert find_pile_up(sky + peak, sky, brightness) == np.inf


# Areas that receive no light.


def illumination(kind):
    """Part of the light that each pixel receives, (SIDE, SIDE)."""
    row, column = np.indices((SIDE, SIDE)) - SIDE / 2.0
    turned = np.maximum(np.abs(0.8 * row + 0.6 * column), np.abs(0.8 * column - 0.6 * row))
    inside_px, softness_px = {
        "circle": (135 - np.hypot(row, column), 3),
        "circle cut by two edges": (200 - np.hypot(row + 70, column + 100), 3),
        "small circle off the centre": (100 - np.hypot(row + 30, column - 20), 1),
        "corner": (260 - np.hypot(row + 100, column + 100), 6),
        "square field stop": (105 - np.maximum(np.abs(row), np.abs(column - 20)), 0.1),
        "turned square": (100 - turned, 1),
        "strip": (row + 90, 3),
    }[kind]
    return 1.0 / (1.0 + np.exp(-np.clip(inside_px / softness_px, -50, 50)))


@pytest.mark.parametrize(("squares", "is_area"), [(3, False), (5, True)])
def test_a_dark_area_has_16_squares_of_8_px_or_more(squares, is_area):
    rng = np.random.default_rng(4)
    image, size = rng.normal(300.0, 10.0, (256, 256)), 8 * squares
    image[64 : 64 + size, 96 : 96 + size] = rng.normal(100.0, 2.0, (size, size))
    found = bad_pixels.find_dark_area(image, np.zeros(image.shape, bool))
    assert (found is not None) == is_area
    if found is not None:
        assert found[0] == pytest.approx(100.0, abs=0.3)
        assert size**2 <= found[1].sum() < 1.3 * size**2  # with its edge


@pytest.mark.parametrize(
    "kind",
    [
        "circle",
        "circle cut by two edges",
        "small circle off the centre",
        "corner",
        "square field stop",
        "turned square",
        "strip",
    ],
)
@pytest.mark.parametrize("sky", [60.0, 1000.0])
def test_outside_of_an_image_circle_nothing_is_exposed(clean, kind, sky):
    """The sky inside is as without the circle."""
    rng, part, bias = np.random.default_rng(4), illumination(kind), 300.0
    stars = drawn(moffat(2.8), clean[1], clean[2], SIDE)
    electrons = rng.poisson(1.5 * part * (stars + sky)) + rng.normal(0, 5, part.shape)
    image = np.rint(electrons / 1.5 + bias).astype(np.float32)
    found = bad_pixels.find_bad_pixels(image, np.zeros(image.shape, bool), [], None)
    assert "not exposed (level 300" in "\n".join(found.notes)
    # All that is dark is left out, and a soft edge; little of what is bright.
    is_bright = part > 0.98
    dimmest, share = (0.5, 0.99) if kind == "corner" else (0.8, 0.998)
    assert (part[~found.mask] > dimmest).mean() > share
    assert found.mask[is_bright].mean() < 0.2
    # Level and noise of the sky are right up to the edge.
    measured = subtract_sky(image, found.mask)
    at = is_bright & ~found.mask
    sigma = np.sqrt(1.5 * sky + 25) / 1.5
    assert np.abs(measured.level - bias - sky)[at].mean() < 0.25 * sigma
    assert 0.9 < np.median(measured.noise[at]) / sigma < 1.15
    # Stars are found, and nothing else; those at the edge, of which a part is cut off, are flagged.
    sources, whole = find_sources(measured, 5.0), ~ndimage.binary_dilation(found.mask, iterations=4)
    place = np.stack([sources["X_IMAGE"], sources["Y_IMAGE"]], axis=1) - 1.0
    true, seen = (p[whole[tuple(np.rint(p).astype(int).T[::-1])]] for p in (clean[1], place))
    assert (cKDTree(place).query(true)[0] < 1.5).mean() > 0.95
    assert (cKDTree(clean[1]).query(seen)[0] > 2.0).sum() <= 1


def test_an_exposed_image_has_no_unexposed_area(clean):
    image, none = clean[0], np.zeros(clean[0].shape, bool)
    row, column = np.indices(image.shape)
    rng = np.random.default_rng(3)
    halo = 1e5 / (1 + np.hypot(row - 150, column - 150) ** 2 / 100)
    skies = {
        "even": 0.0,
        "gradient": 3.0 * column,
        "galaxy on an empty sky": rng.poisson(halo) - 0.0,
        "amplifiers": np.where(column < 160, 0.0, 60.0 + rng.normal(0, 20, image.shape)),
        "four times as long exposed": np.where(row < 160, 0.0, rng.normal(0, 40, image.shape)),
    }
    found = {name: bad_pixels.find_dark_area(image + sky, none) for name, sky in skies.items()}
    assert found == dict.fromkeys(skies)


def test_a_known_structure_of_the_sky_is_used_again():
    """A wave of 64 px in 3 % of an image is too little to be seen, but followed if it is known."""
    row, column = np.indices((704, 704))
    wave = 100.0 * np.sin(2 * np.pi * row / 64)
    wave[(np.maximum(np.abs(row - 256), np.abs(column - 256)) > 64)] = 0.0
    image = SKY + wave + np.random.default_rng(2).normal(0, 15, wave.shape)
    bad, middle = np.zeros(wave.shape, bool), np.s_[220:290, 220:290]
    unknown, known = (
        subtract_sky(image, bad, structure=s) for s in (None, SkyStructure(is_fine=True))
    )
    assert not unknown.structure.is_fine and known.structure.is_fine
    assert (
        np.std((unknown.level - wave)[middle]) > 50.0 > 20.0 > np.std((known.level - wave)[middle])
    )


# Skies with steps, structure, trails, and shared noise.


def test_a_step_of_the_sky_is_sharp_in_its_level(clean):
    image, none = clean[0], np.zeros(clean[0].shape, bool)
    slope = np.linspace(0, 200, SIDE)[None]
    assert not sky_steps(image + slope, none, 0) and not sky_steps(image + slope, none, 1)
    step = np.where(np.arange(SIDE) < 150, 0.0, 40.0)[None]
    fitted = sky_level(image + step, none)
    assert np.abs(fitted.level - SKY - step).max() < 5.0
    assert fitted.notes == ("the sky has a step at column 150: the parts have their own sky",)


@pytest.mark.parametrize("amplitude", [0.0, 50.0])
def test_the_level_follows_a_sky_that_curves_within_a_few_meshes(amplitude):
    """A wave of 300 px and a slope, up to the edges; a flat sky is smoothed over meshes."""
    along_columns, along_rows = np.indices((400, 400)) / 400
    sky = amplitude * (np.sin(8.0 * along_columns + 4.0 * along_rows) + 3.0 * along_rows)
    noise = np.random.default_rng(6).normal(0, 15, sky.shape)
    off = sky_level(sky + noise, np.zeros(sky.shape, bool)).level - sky
    assert off.std() < (6.0 if amplitude else 0.4) and abs(off.mean()) < 1.5


def test_noise_is_from_differences_of_neighbours_in_squares():
    """It does not see a slope; it is infinite where no two good neighbours differ."""
    sigma = np.repeat(np.repeat([[2.0, 5.0], [0.0, 9.0]], 64, axis=0), 64, axis=1)
    image = sigma * np.random.default_rng(5).normal(size=sigma.shape)
    bad = sigma == 9.0
    noise = bad_pixels.pixel_noise(image + 0.01 * np.arange(128)[:, None], bad)
    assert noise[:64] == pytest.approx(sigma[:64], rel=0.06)
    assert np.isinf(noise[64:]).all()
    unusual = np.random.default_rng(6).random(sigma.shape) < 0.3
    spoilt = bad_pixels.pixel_noise(np.where(unusual, 1e4, image), bad | unusual)
    assert spoilt[:64] == pytest.approx(sigma[:64], rel=0.08)


def test_bad_pixels_of_a_stamp_are_filled_from_the_same_stamp():
    rng = np.random.default_rng(4)
    stamps, bad = rng.normal(size=(4, 9, 9)), rng.random((4, 9, 9)) < 0.1
    stamps += 1e3 * np.arange(4)[:, None, None]
    bad[1], bad[2, 0], bad[3, -1] = False, True, True
    filled = fill_bad_stamps(stamps, bad)
    assert (filled[~bad] == stamps[~bad]).all()
    for stamp, is_bad, expected in zip(stamps, bad, filled, strict=True):
        assert fill_bad(stamp, is_bad)[0] == pytest.approx(expected)


@pytest.mark.parametrize(("rows", "is_found"), [(7, False), (8, True), (30, True)])
def test_squares_of_one_value_have_8_px(rows, is_found):
    values = np.random.default_rng(3).normal(size=(50, 60))
    flat = np.zeros(values.shape, bool)
    flat[20 : 20 + rows, 12:20] = True
    is_constant = bad_pixels.find_constant_squares(np.where(flat, 5.0, values))
    assert (is_constant == (flat & is_found)).all()


@pytest.mark.parametrize("shift", range(8))
def test_constant_squares_are_found_anywhere(shift):
    """Inside, and across an edge, beyond which the image repeats its last pixels."""
    values = np.random.default_rng(3).normal(size=(50, 60))
    for area in (
        np.s_[20 + shift : 28 + shift, 12 + 3 * shift : 20 + 3 * shift],
        np.s_[:5, shift:],
    ):
        flat = np.zeros(values.shape, bool)
        flat[area] = True
        is_constant = bad_pixels.find_constant_squares(np.where(flat, 5.0, values))
        assert is_constant.any() and (is_constant <= flat).all()
        assert (is_constant == flat)[8:].all() and is_constant[area][:4, 8:].all()


def test_a_sky_between_meshes_is_a_cubic_spline_through_them():
    """As scipy interpolates it, away from the edges; whole meshes and parts of one."""
    mesh = np.random.default_rng(4).normal(size=(12, 14))
    level = _to_pixels(mesh, (360, 410), 32, 1.0)
    row, column = ((np.arange(n) + 0.5) / 32 - 0.5 for n in level.shape)
    expected = RectBivariateSpline(np.arange(12), np.arange(14), mesh)(row, column)
    inner = np.s_[130:-130, 130:-130]
    assert level[inner] == pytest.approx(expected[inner], abs=0.05)
    assert np.ptp(expected[inner]) > 1.0


def test_a_mesh_far_from_the_plane_of_its_neighbours_takes_their_value():
    row, column = np.indices((6, 7))
    plane = 3.0 * row - 2.0 * column
    for excess in (0.0, 500.0):
        mesh = plane + excess * ((row == 2) & (column == 3))
        assert _smooth_meshes(mesh) == pytest.approx(plane)
    # No direction is special.
    mesh = np.random.default_rng(7).normal(size=(6, 7))
    for turned in (lambda a: a[::-1], lambda a: a[:, ::-1], np.transpose):
        assert _smooth_meshes(turned(mesh)) == pytest.approx(turned(_smooth_meshes(mesh)))


def test_stars_in_the_halo_of_a_bright_star_are_found(clean):
    image, place, _ = clean
    row, column = np.indices(image.shape) - SIDE / 2
    halo = 3000.0 / (1 + np.hypot(row, column) ** 2 / 400)
    sky = subtract_sky(image + halo, np.zeros(image.shape, bool))
    assert "structure within 64 px" in sky.notes[0]
    stars = find_sources(sky, 5.0)
    sources = np.stack([stars["X_IMAGE"], stars["Y_IMAGE"]], axis=1) - 1
    assert (cKDTree(sources).query(place)[0] < 1).mean() > 0.9
    assert (cKDTree(place).query(sources)[0] > 2).sum() < 5


def test_noise_of_neighbours_that_is_shared_is_that_of_their_sum(clean):
    white = np.random.default_rng(5).normal(size=(SIDE, SIDE))
    means = (white[1:, 1:] + white[:-1, 1:] + white[1:, :-1] + white[:-1, :-1]) / 4
    assert noise_correlation(white) == 1.0
    assert abs(noise_correlation(2.0 * means) - 2.0) < 0.15  # σ/2 in a pixel, σ in sums
    assert sky_level(clean[0], np.zeros(clean[0].shape, bool)).notes == ()


UNEVEN = {
    "even": lambda s: 1.0 + 0.0 * s,
    "tumbling": lambda s: 1.0 + 0.7 * np.sin(2 * np.pi * s / 60),
    "slowly tumbling": lambda s: 1.0 + 0.9 * np.sin(2 * np.pi * s / 150),
    "steps": lambda s: np.where(s // 30 % 2 == 0, 1.0, 0.3),
    "flashing": lambda s: 1.0 + 8.0 * (s % 45 < 3),
}


@pytest.mark.parametrize("kind", UNEVEN)
@pytest.mark.parametrize("angle_deg", [22, 90, 140])
def test_trails_are_found_however_uneven(clean, kind, angle_deg):
    image, none = clean[0], np.zeros(clean[0].shape, bool)
    row, column = np.indices(image.shape) - SIDE / 2.0
    sine, cosine = np.sin(np.deg2rad(angle_deg)), np.cos(np.deg2rad(angle_deg))
    across, along = row * cosine - column * sine + 7.0, column * cosine + row * sine
    is_on = np.abs(along) < 130
    image = image + 200 * is_on * UNEVEN[kind](along) * np.exp(-0.5 * (across / 1.2) ** 2)
    mask, count = find_trails(image, none, sky_level(image, none))
    assert count == 1 and mask[(np.abs(across) < 2) & is_on].mean() > 0.95
    # A star at its end may make it longer.
    assert not mask[(np.abs(across) > 12) | (np.abs(along) > 170)].any()


@pytest.mark.parametrize("spacing_px", [9, 12, 20])
@pytest.mark.parametrize("flux", [2e3, 2e5])
def test_stars_in_a_row_are_no_trail(clean, spacing_px, flux):
    """Between them it is dark."""
    along = np.arange(-130, 130, spacing_px)
    place = SIDE / 2 + np.stack([0.9 * along, 0.44 * along], axis=1)
    row = drawn(moffat(2.8), place, np.full(len(along), flux), SIDE)
    for image in (clean[0], clean[0] + row):
        none = np.zeros(image.shape, bool)
        assert find_trails(image, none, sky_level(image, none))[1] == 0


def test_cores_of_saturated_stars_have_4_px_or_more():
    """x, y and radius where they are widest, also with charge along a column; the largest first."""
    is_saturated = np.zeros((60, 70), bool)
    is_saturated[10:12, 20:22] = is_saturated[50, 3:6] = True
    is_saturated[30:35, 40:45] = is_saturated[35:55, 42] = True
    assert find_saturated_cores(is_saturated).tolist() == [[42.0, 32.0, 3.0], [20.5, 10.5, 1.0]]


@pytest.mark.parametrize(
    ("arms", "height", "least"), [(4, 2e3, 60), (6, 2e3, 60), (4, 500, 25), (6, 500, 25)]
)
def test_spikes_of_saturated_stars_are_left_out_and_their_cores_are_not(clean, arms, height, least):
    """Spikes at any angle, and charge along a column, up to a part of the full well.

    Faint spikes are left out where they are brighter than 1.6 σ of a pixel.
    """
    row, column = np.indices(clean[0].shape) - SIDE / 2.0
    spikes = np.zeros(clean[0].shape)
    for angle in 0.3 + 2 * np.pi * np.arange(arms) / arms:
        along, across = (
            column * np.cos(angle) + row * np.sin(angle),
            row * np.cos(angle) - column * np.sin(angle),
        )
        profile = height / (1 + (along / 10) ** 2)
        spikes += (along > 0) * profile * np.exp(-0.5 * (across / 0.8) ** 2)
    star = drawn(moffat(2.8), [[SIDE / 2, SIDE / 2]], [2e7], SIDE, half=60)
    light = np.minimum(clean[0] + star + spikes, 6e4)
    light[(np.abs(column) < 1.5) & (np.abs(row) < 70)] = 5e4
    none = np.zeros(light.shape, bool)
    found = add_trails(light, bad_pixels.BadPixels(none, none, ()), 6e4)
    assert "pixels of spikes of saturated stars" in found.notes[0] and len(found.notes) == 1
    radius = np.hypot(row, column)
    is_column = (np.abs(column) < 1.5) & (np.abs(row) < 65) & (radius > 30)
    is_spike = (spikes > least) & (radius > 30)
    assert found.mask[is_spike].mean() > 0.85 and found.mask[is_column].mean() > 0.85
    assert found.mask[(spikes < 5) & (np.abs(column) > 6)].mean() < 0.05
    assert not found.mask[light == 6e4].any()


@pytest.mark.filterwarnings("error")
def test_large_images_are_searched_in_squares_that_may_have_no_good_pixel():
    rng, side = np.random.default_rng(4), 2000
    image = rng.normal(100.0, 5.0, (side, side)).astype(np.float32)
    row, column = np.indices(image.shape)
    is_trail = np.abs(row - column) < 4
    bad = np.zeros(image.shape, bool)
    bad[100:140, 1000:1040] = True
    image[is_trail] += 30.0
    result = add_trails(image, bad_pixels.BadPixels(bad, bad & False, ()), np.inf)
    assert result.mask[is_trail].mean() > 0.95 and result.mask[bad].all()
    assert result.mask[np.abs(row - column) > 30].mean() < 1.1 * bad.mean()
    assert len(result.notes) == 1 and result.notes[0].endswith("pixels of a satellite trail")


def test_stars_around_saturated_ones_are_no_spikes():
    """In a crowded field, rays pass many stars; hardly any is a spike."""
    rng = np.random.default_rng(3)
    place, flux = rng.uniform(1, SIDE - 2, (900, 2)), 10 ** rng.uniform(2.3, 5.0, 900)
    light = drawn(moffat(2.8), place, flux, SIDE, half=25)
    light += drawn(moffat(2.8), rng.uniform(40, SIDE - 40, (4, 2)), np.full(4, 1e7), SIDE, half=60)
    image, clear = np.minimum(noisy(light, rng), 6e4), np.zeros(light.shape, bool)
    spikes = find_spikes(image, clear, sky_level(image, clear), image >= 6e4)
    assert find_saturated_cores(image >= 6e4)[3, 2] > 2 and spikes.mean() < 0.013


@pytest.mark.parametrize("side", [200, 400])
@pytest.mark.parametrize("length", [48, 80])
def test_a_spike_ends_where_its_light_ends(side, length):
    """In an image of any size, in spite of a gap of 8 px; the mask is 2 px wider than the light."""
    row, column = np.indices((side, side)) - side // 2
    is_lit = (column > 0) & (column < length) & ((column < 32) | (column >= 40))
    image = np.random.default_rng(2).normal(100.0, 1.0, (side, side))
    image += is_lit * 200.0 * np.exp(-0.5 * (row / 0.8) ** 2)
    image[np.hypot(row, column) < 5] = 6e4
    none = np.zeros(image.shape, bool)
    mask = add_trails(image, bad_pixels.BadPixels(none, none, ()), 6e4).mask
    rows, columns = np.nonzero(mask)
    # Light of 200 σ is above noise within 3 px of the middle row, as means of 3 × 3 px see it.
    assert (columns - side // 2).max() == length + 1 and mask[side // 2, side // 2 + 20 :].any()
    assert np.ptp(rows) + 1 == pytest.approx(12, abs=1)


# Bad pixels.


@pytest.mark.parametrize("part", [0.002, 0.01])
def test_bad_pixels_cost_no_stars_and_nan_is_as_a_mask(clean, part):
    image = clean[0]
    mask = np.random.default_rng(1).uniform(size=image.shape) < part
    clean_set = Stars.from_image(image, detect=True, **CAMERA)
    image_counts = {"train_stars": 100, "test_stars": 20}  # images of them
    masked, nan = (
        Stars.from_image(pixels, detect=True, **CAMERA, **option, **image_counts)
        for pixels, option in (
            (np.where(mask, 3e4, image), {"mask": mask.astype(np.uint8)}),
            (np.where(mask, np.nan, image), {}),
        )
    )
    assert len(masked) >= 0.9 * len(clean_set)
    assert f"{mask.sum()} pixels that are masked or have no value" in "\n".join(nan.notes)
    for name, column in masked.columns.items():
        assert np.array_equal(column.values, nan.columns[name].values, equal_nan=True), name
    # What fills a pixel is near what was there: far nearer than the sky is.
    bright, clean_bright = masked.candidates.bright, clean_set.candidates.bright
    _, clean_row = cKDTree(clean_bright.position).query(bright.position)
    true = clean_bright.stamps[clean_row]
    core = np.zeros_like(bright.bad)
    core[:, 13:20, 13:20] = True
    filled = bright.bad & core & (true > 50 * bright.noise[:, None, None])
    ratio = bright.stamps[filled] / true[filled] - 1
    assert filled.sum() >= 5 * part / 0.01 and np.abs(ratio).max() < 0.3
    off = bright.centre - clean_bright.centre[clean_row]
    assert np.abs(off - np.rint(off)).max() < 0.03  # a stamp may be cut about the next pixel


@pytest.mark.slow
def test_bad_pixels_have_no_weight_in_the_field(clean):
    """Nothing that is written into them changes the fit."""
    image, place, _ = clean
    mask = np.random.default_rng(2).uniform(size=image.shape) < 0.005
    clean_field, masked_field = (
        fit_method(Stars.from_image(i, place, mask=m.astype(np.uint8), **CAMERA), FieldMixture)
        for i, m in ((image, np.zeros_like(mask)), (image, mask))
    )
    at = np.array([[160.2, 160.4]])
    difference = masked_field.psf_at(at) - clean_field.psf_at(at)
    # σ of a pixel of the mean of all stars, times that part of it which is left out, and some.
    assert np.abs(difference).max() < 0.002 * clean_field.psf_at(at).max()


def test_a_star_without_a_fifth_of_its_light_is_incomplete(clean):
    image, place, _ = clean
    mask = np.zeros(image.shape, np.uint8)
    column, row = np.rint(place[44]).astype(int)
    mask[row - 1 : row + 2, column - 1 : column + 2] = 1  # over half of the light
    column, row = np.rint(place[45]).astype(int)
    mask[row, column + 2] = 1
    stars = Stars.from_image(image, place, mask=mask, **CAMERA)
    verdict = stars.candidates.verdict
    assert verdict[44] == Verdict.INCOMPLETE and verdict[45] == Verdict.GOOD


def test_completed_stars_are_their_neighbours_scaled():
    """Equal stars of other fluxes: a bad pixel gets what the star has there."""
    rng = np.random.default_rng(3)
    shift = rng.uniform(-0.5, 0.5, (20, 2))
    shape = np.stack([drawn(moffat(3.0), [(16 + x, 16 + y)], [1.0], 32) for y, x in shift])
    flux = rng.uniform(1e4, 1e5, 20)
    light, bad = shape * flux[:, None, None], np.zeros(shape.shape, bool)
    bad[7, 16, 17] = True
    hurt = np.where(bad, 0.0, light)
    zero = np.zeros((20, 2), int)
    position, nan = rng.uniform(0, 300, (20, 2)), np.full((20, 2), np.nan)
    facts = (position, flux, np.full(20, 5.0), flux / 30, np.arange(20), nan, nan[:, 0])
    repaired, missing = fill_bad_pixels(BrightStars(hurt, zero, shift, *facts, bad), 16, 3)
    assert repaired.stamps[7, 16, 17] == pytest.approx(light[7, 16, 17], rel=0.02)
    part = shape[7, 16, 17] / shape[7, 8:24, 8:24].sum()
    assert missing[7] == pytest.approx(part, rel=0.03) and missing.sum() == missing[7]
    assert repaired.cut_frames(20)[1].sum() == 20 * 400 - 1


def test_a_star_with_a_bad_pixel_in_its_core_is_one_source(clean):
    image, place, _ = clean
    bad = np.zeros(image.shape, bool)
    column, row = np.rint(place).astype(int).T
    bad[row, column] = True
    sources = find_sources(subtract_sky(np.where(bad, np.nan, image), bad), 5.0)
    centres = np.stack([sources["X_IMAGE"], sources["Y_IMAGE"]], axis=1) - 1
    distance, index = cKDTree(centres).query(place)
    assert len(centres) == len(place) == len(set(index)) and distance.max() < 0.5


# Areas without data.


@pytest.mark.parametrize("value", [0.0, -32768.0, 300.0])
def test_blank_areas_are_bad_and_said(clean, value):
    image, place, _ = clean
    empty = image.copy()
    empty[:, :60] = value
    empty[100:112, 200:220] = value  # inside
    stars = Stars.from_image(empty, detect=True, **CAMERA)
    count = 60 * SIDE + 12 * 20
    assert f"{count} blank pixels (value {value:g})" in "\n".join(stars.notes)
    assert stars.observation.positions[:, 0].min() > 59
    sky = stars.observation.sky()
    assert np.median(sky.level) == pytest.approx(SKY, rel=0.01)
    target = place[place[:, 0] > 68]
    assert cKDTree(stars.observation.positions).query(target)[0].max() < 8


def test_noise_of_few_counts_has_no_blank_areas():
    rng = np.random.default_rng(5)
    for scatter in (0.2, 0.4, 1.0):
        image = np.rint(rng.normal(100.0, scatter, (256, 256)))
        assert not bad_pixels.find_blank_areas(image, np.zeros(image.shape, bool))
    # Nor has the even sky of an image without noise, where the light of stars ends.
    image = np.full((256, 256), 7.0)
    image[100:132, 100:132] += drawn(moffat(3.0), [(16, 16)], [1e4], 32)
    none = np.zeros(image.shape, bool)
    assert not bad_pixels.find_blank_areas(image, none)
    bad_pixels.refuse_clipped_sky(image, none)


def test_overscan_of_the_header_is_bad_where_the_pixels_confirm_it(clean):
    image = clean[0]
    header = fits.Header({"TRIMSEC": "[1:300,1:320]", "BIASSEC": "[305:320,1:320]"}.items())
    none = np.zeros(image.shape, bool)
    assert not bad_pixels.find_overscan([header], image, none)  # it was trimmed, and this is sky
    rng, frame = np.random.default_rng(6), image.copy()
    frame[:, 300:] = rng.normal(50.0, 4.0, (SIDE, 20))
    ((key, area),) = bad_pixels.find_overscan([header], frame, none)
    assert key == "TRIMSEC" and area[:, 300:].all() and not area[:, :300].any()
    untrimmed = fits.Header({"TRIMSEC": "[51:2098,1:2048]"}.items())
    assert not bad_pixels.find_overscan([untrimmed], frame, none)


# Clipped skies.


def test_a_clipped_sky_is_refused_in_one_line(clean, tmp_path):
    image, place, _ = clean
    clipped = np.clip(np.rint(image - SKY), 0, None)
    path = tmp_path / "clipped.fits"
    fits.writeto(path, clipped.astype(np.uint16))
    message = refused("train", path, "--detect", "--out", tmp_path / "m")
    assert "of the pixels have the least value, 0: the sky was clipped" in message
    assert not (tmp_path / "m").exists()
    with pytest.raises(ObservationError, match="clipped"):
        Stars.from_image(clipped, place)
    for scatter, sky in ((12.0, 0.0), (12.0, -12.0)):
        noise = np.random.default_rng(7).normal(sky, scatter, (256, 256))
        with pytest.raises(bad_pixels.ClippedSkyError, match="least value, 0: the sky"):
            bad_pixels.refuse_clipped_sky(np.maximum(noise, 0), np.zeros(noise.shape, bool))
    photons = np.random.default_rng(8).poisson(1.0, (256, 256)).astype(float)
    bad_pixels.refuse_clipped_sky(photons, np.zeros(photons.shape, bool))


# Units and levels.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("unit", "level", "tolerance"),
    [
        (2.0**-80, 0.0, 0.0),
        (2.0**100, 0.0, 0.0),
        (1e-30, 0.0, FitOptions.tolerance),
        (1e30, 0.0, FitOptions.tolerance),
        (1.0, 1e8, FitOptions.tolerance),
        (1e-30, -1e-20, FitOptions.tolerance),
    ],
)
def test_nothing_depends_on_the_unit_or_the_level(clean, unit, level, tolerance):
    """Other units than powers of 2 round pixels, which may end a fit sooner, at its tolerance."""
    image = clean[0] - SKY
    results = []
    for pixels in (image, image * unit + level):
        stars = Stars.from_image(pixels, detect=True)
        model = fit_isolated_stars(stars)
        results.append((stars, model, crowded.photometry(model, stars.observation, 5.0).stars))
    (first_stars, first, table), (second_stars, second, scaled) = results
    assert (first_stars.candidates.verdict == second_stars.candidates.verdict).all()
    assert second_stars.candidates.bright.position == pytest.approx(
        first_stars.candidates.bright.position
    )
    psf, flux = first.psf_at(160.0, 160.0), np.array(table["flux"])
    limit = 1e-7 + tolerance * psf.max()
    assert second.psf_at(160.0, 160.0) == pytest.approx(psf, abs=limit, rel=0.0)
    off = np.abs(np.array(scaled["flux"]) / unit - flux)
    limits = 0.01 * np.array(table["flux_error"]) + tolerance * np.abs(flux)
    assert np.nanmax(off / limits) < 1.0


@pytest.mark.parametrize(
    ("form", "level"),
    [
        ("array", 1e5),
        ("array", -1e8),
        ("float file", 2e9),
        ("whole counts", 1e12),
        ("scaled", 1e8),
        ("cube", 1e8),
    ],
)
def test_no_level_rounds_the_noise(clean, tmp_path, form, level):
    """Single precision has steps of 8 at 1e8, and of 65,536 at 1e12: σ came out too large."""
    counts, place = np.rint(clean[0]), clean[1]
    counts[:, :3] = -40.0  # blank columns
    camera = {"gain": 1.5, "read_noise": 5.0, "pixel_scale_arcsec": 0.6}
    results = []
    for offset in (0.0, level):
        image, path = counts + offset, tmp_path / f"{offset:g}.fits"
        # A saturation is above 0.
        options = camera | ({"saturate": 4000.0 + offset} if level > 0 else {})
        if form == "cube":
            corner = np.rint(place).astype(int) - 12
            stamps = [image[y : y + 24, x : x + 24] for x, y in corner if min(x, y) >= 0]
            image, options["catalogue"] = np.stack([s for s in stamps if s.size == 576]), None
        elif form == "scaled":
            # Half of a count in 16 bits, above BZERO.
            hdu = fits.PrimaryHDU(np.rint(2.0 * np.clip(counts, -40, 16000) - 3e4).astype("i2"))
            hdu.header["BSCALE"], hdu.header["BZERO"] = 0.5, 1.5e4 + offset
            hdu.writeto(path)
        elif form != "array":
            fits.writeto(path, image.astype("i8" if form == "whole counts" else "f8"))
        if form != "cube":
            options["detect"] = True
        opened = open_observation(
            ImageInput(path if path.exists() else image, **options), 16, margin=4
        )
        (stars,) = opened.chunks(500)
        if form == "cube":
            noise = sky_around(stars.data, stars.bad, 16)
            results.append((opened, stars, noise[0] - offset, noise[1]))
            continue
        background = np.array(opened.detections.table["BACKGROUND"])
        sky = opened.sky()
        assert "960 blank pixels (value" in opened.describe_bad_pixels()[0]
        assert f"{offset - 40:g}" in opened.describe_bad_pixels()[0]
        results.append((opened, stars, background - offset, sky.noise, sky.signal, stars.noise))
    (first, first_stars, *expected), (second, second_stars, *values) = results
    # As exactly as single precision has it without the level, and double precision with it.
    limit = 1e-2 + 4.0 * np.spacing(abs(level))  # σ is 14
    assert first.count == second.count > 50
    for known, value in zip(expected, values, strict=True):
        assert value == pytest.approx(known, rel=1e-5, abs=limit)
    inside = ~first_stars.bad
    assert (inside == ~second_stars.bad).all() and inside.mean() > 0.9
    assert (second_stars.data - level)[inside] == pytest.approx(first_stars.data[inside], abs=limit)
    assert (first_stars.saturated == second_stars.saturated).all()
    assert first_stars.saturated.any() == (level > 0)
    assert not any("single precision" in remark for remark in second.remarks)


def test_a_sky_that_no_level_brings_to_single_precision_is_said(clean):
    """Half of the image is 1e9 above the other; an unexposed area of one value is left out."""
    image, half = np.array(clean[0]), np.s_[:, : SIDE // 2]
    image[half] += 1e9
    with pytest.warns(UserWarning, match="which single precision rounds"):
        opened = open_observation(ImageInput(image, catalogue=clean[1], origin=0), 16)
    assert "times its noise, which single precision rounds" in opened.summary()
    image[half] = 1e9
    opened = open_observation(ImageInput(image, catalogue=clean[1], origin=0), 16)
    assert "single precision" not in opened.summary()


# Pixels far below the sky.


def test_pixels_far_below_the_sky_are_left_out(clean):
    image, place, _ = clean
    deep = image.copy()
    column, row = np.rint(place[44]).astype(int)
    deep[row + 3, column + 2] -= 3000.0
    stars = Stars.from_image(deep, place, **CAMERA)
    bright = stars.candidates.bright
    (index,) = np.flatnonzero(bright.row == 44)
    assert "left out: 1 dead pixels" in "\n".join(stars.notes)
    assert bright.bad[index].sum() == 1
    assert bright.stamps[index][bright.bad[index]] > -5 * bright.noise[index]


def test_a_core_as_wide_as_the_image_has_no_spikes():
    """A level of saturation below the sky makes almost all of an image one core."""
    image = np.random.default_rng(3).normal(100.0, 1.0, (420, 420))
    clean = np.zeros(image.shape, bool)
    assert not add_trails(image, bad_pixels.BadPixels(clean, clean, ()), 90.0).mask.any()


@pytest.mark.parametrize("dtype", ["f4", "f8", ">f4", ">i2", "u2", "i4"])
@pytest.mark.parametrize("level", [0.1, 7.0, 1000.123456])
def test_meshes_of_equal_pixels_have_no_noise(dtype, level):
    """SEP computes in single precision, and gives σ = 1 for pixels without scatter."""
    image = np.full((100, 70), level).astype(dtype)
    mode, sigma = measure_meshes(image, np.zeros(image.shape, bool), 64)
    assert mode == pytest.approx(np.full((2, 2), float(image[0, 0])), rel=1e-6)
    assert not sigma.any()
    # Noise of σ = 1 is none of these.
    noisy_image = image + np.random.default_rng(1).normal(0.0, 1.0, image.shape)
    sigma = measure_meshes(noisy_image, np.zeros(image.shape, bool), 64)[1]
    assert sigma == pytest.approx(np.ones((2, 2)), rel=0.05)


@pytest.mark.parametrize("count", [1, 6, 7])
def test_medians_of_rows_are_those_of_numpy(count):
    values = np.random.default_rng(1).normal(size=(40, count)).astype(np.float32)
    values[np.random.default_rng(2).random(values.shape) < 0.3] = np.nan
    values[0] = np.nan
    with np.errstate(all="ignore"), pytest.warns(RuntimeWarning, match="All-NaN"):
        expected = np.nanmedian(values, axis=1)
    np.testing.assert_array_equal(row_medians(values), expected)
    assert row_medians(values[:0]).shape == (0,)
