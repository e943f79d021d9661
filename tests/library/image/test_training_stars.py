"""Models are trained on stars, not on galaxies, damaged stars or other files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

import psfdae
from psfdae.api import Stars
from psfdae.base.errors import Error
from psfdae.image.errors import ObservationError
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation
from psfdae.image.selection import Verdict
from psfdae.image.stamp_cube import has_common_stars
from small_field import GAIN, READ, drawn, moffat, noisy, ring

CAMERA = {"gain": GAIN, "read_noise": READ, "pixel_scale_arcsec": 0.6}
SIZE = 360


def jittered(count, size=SIZE, seed=1, edge=14):
    """Positions (n, 2) on a jittered lattice, in random order."""
    rng, side = np.random.default_rng(seed), int(np.ceil(count**0.5))
    step = (size - 2 * edge) / side
    cell = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    place = edge + (cell + rng.uniform(0.3, 0.7, cell.shape)) * step
    return rng.permutation(place)[:count]


def exponential(scale):
    """Profile of a disc galaxy, of the light 1."""
    return lambda r: np.exp(-r / scale) / (2 * np.pi * scale**2)


def de_vaucouleurs(radius):
    """Profile of an elliptical galaxy with half of its light within a radius, of the light 1."""
    return lambda r: np.exp(-7.669 * (r / radius) ** 0.25) / (0.01059 * radius**2)


def galaxies(place, flux, seed, fwhm):
    """Light of discs and ellipticals of half-light radii of 1.5 to 7 px, behind the PSF."""
    rng, light = np.random.default_rng(seed), np.zeros((SIZE, SIZE))
    for position, total in zip(place, flux, strict=True):
        radius = np.exp(rng.uniform(np.log(1.5), np.log(7.0)))
        kind = exponential(radius / 1.68) if rng.uniform() < 0.5 else de_vaucouleurs(radius)
        light += drawn(kind, [position], [total], SIZE)
    return ndimage.gaussian_filter(light, fwhm / 2.355)


def trained_on(stars, place):
    """Mask of the true stars that are trained on, and the number of other sources."""
    bright = stars.candidates.bright
    if not len(bright):
        return np.zeros(len(place), bool), 0
    distance, nearest = cKDTree(place).query(bright.position)
    is_used = np.zeros(len(place), bool)
    is_used[nearest[distance < 1.5]] = True
    return is_used, int((distance >= 1.5).sum())


# Galaxies.


@pytest.mark.parametrize(("seed", "count", "fwhm"), [(1, 8, 2.1), (2, 15, 2.1), (3, 10, 3.0)])
def test_stars_are_the_narrowest_sources_of_an_image_of_galaxies(seed, count, fwhm):
    place, rng = jittered(count + 60, seed=seed), np.random.default_rng(seed)
    light = drawn(moffat(fwhm), place[:count], np.geomspace(2e4, 3e5, count), SIZE)
    light += galaxies(place[count:], np.exp(rng.uniform(10.0, 12.8, 60)), seed, fwhm)
    stars = Stars.from_image(noisy(light, rng), detect=True, **CAMERA)
    is_used, others = trained_on(stars, place[:count])
    assert is_used.sum() >= 0.8 * count and others <= 1
    assert stars.settings.framing.stamp_px == 16
    extended = np.count_nonzero(stars.candidates.verdict == Verdict.EXTENDED)
    assert extended >= 20


@pytest.mark.parametrize("radius", [4.0, 8.0])
@pytest.mark.parametrize("count", [4, 6, 30])
def test_a_galaxy_among_few_stars_is_not_trained_on(count, radius):
    place = jittered(count + 1, seed=count)
    light = drawn(moffat(2.8), place[1:], np.geomspace(4e4, 3e5, count), SIZE)
    galaxy = drawn(exponential(radius / 1.68), place[:1], [2.5e5], SIZE)
    image = noisy(light + ndimage.gaussian_filter(galaxy, 1.2), np.random.default_rng(1))
    stars = Stars.from_image(image, detect=True, **CAMERA)
    is_used, others = trained_on(stars, place[1:])
    assert is_used.sum() >= count - 1 and others == 0


def shapes(kind, place, flux):
    """Light of stars of a legitimate but unusual shape."""
    if kind == "rings":
        return drawn(ring, place, flux, SIZE)
    if kind == "trailed":
        return sum(
            drawn(moffat(2.5), place + d * np.array([1.0, 0.4]), flux / 5, SIZE)
            for d in (-2, -1, 0, 1, 2)
        )
    if kind == "undersampled":
        return drawn(moffat(0.9), place, flux, SIZE)
    # The FWHM doubles over the field.
    fwhm = 2.2 + 2.2 * place.sum(axis=1) / (2 * SIZE)
    stars = zip(fwhm, place, flux, strict=True)
    return sum(drawn(moffat(width), [at], [total], SIZE) for width, at, total in stars)


@pytest.mark.parametrize("kind", ["rings", "trailed", "undersampled", "changing"])
def test_no_star_of_an_unusual_shape_is_a_galaxy(kind):
    place, flux = jittered(64), np.random.default_rng(2).permutation(np.geomspace(2e4, 4e5, 64))
    image = noisy(shapes(kind, place, flux), np.random.default_rng(3))
    stars = Stars.from_image(image, catalogue=place, **CAMERA)
    verdict = stars.candidates.verdict
    assert not np.isin(verdict, [Verdict.EXTENDED, Verdict.SHARP]).any()
    assert len(stars) >= 0.95 * np.isin(verdict, [Verdict.GOOD, Verdict.MISFIT]).sum()
    assert len(stars) >= 50


# Saturated stars without a level at which pixels are cut off.


@pytest.mark.parametrize(("order", "excess"), [(3, 1.5), (1, 2.0)])
@pytest.mark.parametrize("count", [2, 6])
def test_saturated_stars_of_a_resampled_image_are_not_trained_on(count, order, excess):
    place, rng = jittered(64, seed=count), np.random.default_rng(count)
    flux = np.geomspace(1.2e4, 1.2e5, 64)
    flux[:count] = np.geomspace(excess, 1.6 * excess, count) * 2e5  # the peak is a tenth of this
    image = np.minimum(noisy(drawn(moffat(2.8), place, flux, SIZE), rng), 2e4)
    # Resampled by half a pixel, and divided by a flat: no two pixels are cut off at one value.
    image = ndimage.shift(image, (0.5, 0.5), order=order, mode="nearest")
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE - 0.5
    stars = Stars.from_image(image * (1 + 0.8 * (x * x + y * y)), detect=True, **CAMERA)
    is_used, others = trained_on(stars, place + 0.5)
    assert not is_used[:count].any() and others == 0
    assert is_used[count:].sum() >= 0.9 * (64 - count)


# No star at all.


@pytest.mark.parametrize("sigma_px", [30.0, 40.0, 55.0, 90.0])
@pytest.mark.parametrize("height", [60.0, 600.0])
def test_one_nebula_is_no_star(sigma_px, height):
    y, x = np.mgrid[:300, :300]
    blob = height * np.exp(-((x - 150) ** 2 + (y - 140) ** 2) / 2 / sigma_px**2)
    image = 500 + blob + np.random.default_rng(1).normal(0, 25, blob.shape)
    with pytest.raises(Error, match=r"no star|^array: 0 stars are good") as caught:
        Stars.from_image(image, detect=True, pixel_scale_arcsec=1.0)
    assert "\n" not in str(caught.value) and "centring" not in str(caught.value)


def test_stars_wider_than_seeing_are_said():
    place = jittered(16, edge=40)
    image = noisy(drawn(moffat(14.0), place, np.full(16, 2e6), SIZE), np.random.default_rng(1))
    camera = CAMERA | {"pixel_scale_arcsec": 1.5}
    notes = "\n".join(Stars.from_image(image, catalogue=place, **camera).notes)
    assert "more than seeing makes" in notes
    camera["pixel_scale_arcsec"] = 0.1
    notes = "\n".join(Stars.from_image(image, catalogue=place, **camera).notes)
    assert "half of the light" in notes and "seeing" not in notes


# Cubes.


def planes_of(place, flux, count, side, seed=1, scale=None):
    """Exposures (n, side, side) of the same stars, of which the light may change."""
    rng, light = np.random.default_rng(seed), drawn(moffat(2.8), place, flux, side)
    factor = np.ones(count) if scale is None else scale
    return np.stack([noisy(f * light, rng) for f in factor]).astype(np.float32)


@pytest.mark.parametrize("side", [32, 64, 97])
@pytest.mark.parametrize("count", [5, 90])
@pytest.mark.parametrize("has_middle", [True, False])
def test_a_time_series_is_no_cube_of_stamps(side, count, has_middle):
    place = np.array([[side // 2, side // 2], [5.3, side - 6.1], [0.8 * side, 0.3 * side]])
    place = place[not has_middle :]
    changes = np.random.default_rng(2).uniform(0.7, 1.0, count)  # of the transparency
    cube = planes_of(place, [9e4, 6e4, 2e4][: len(place)], count, side, scale=changes)
    with pytest.raises(ObservationError, match="time series"):
        Stars.from_image(cube, **CAMERA)
    # A list says that each plane is a star.
    assert open_observation(ImageInput(cube, **CAMERA), 16, 4).count == count


@pytest.mark.parametrize("kind", ["different stars", "one star", "rings"])
def test_stamps_of_stars_are_no_time_series(kind):
    rng, cube, profile = np.random.default_rng(4), [], ring if kind == "rings" else moffat(2.8)
    for _ in range(24):
        place = 32 + rng.uniform(-0.5, 0.5, (1, 2))
        if kind == "different stars":  # with neighbours of their own
            place = np.concatenate([place, rng.uniform(0, 63, (3, 2))])
        flux = np.exp(rng.uniform(10.5, 12.5, len(place)))
        cube.append(noisy(drawn(profile, place, flux, 64), rng))
    open_observation(ImageInput(np.array(cube), **CAMERA), 16, 8).check_planes()


@pytest.mark.parametrize("sky", [-3000.0, 0.0, 3000.0])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_pixels_without_a_value_are_no_common_star(sky, value):
    """Also where the sky was subtracted and more: 0 would be far above it."""
    rng = np.random.default_rng(5)
    middle = [np.full((1, 2), 32.0)] * 12
    stamps = np.array([noisy(drawn(moffat(2.8), xy, [5e4], 64), rng) for xy in middle]) + sky
    stamps[:, 8:11, 50:53] = value
    stamps[0] = value
    assert not has_common_stars(stamps, 16)
    stamps[1:] += drawn(moffat(2.8), np.array([[12.0, 40.0]]), [5e4], 64)
    assert has_common_stars(stamps, 16)


@pytest.mark.parametrize("is_shared", [True, False])
def test_masked_pixels_are_no_common_star(is_shared):
    """A hot spot of the camera, which all planes have, in a mask for all or one for each."""
    rng, middle = np.random.default_rng(6), np.full((1, 2), 32.0)
    stamps = np.array([noisy(drawn(moffat(2.8), middle, [5e4], 64), rng) for _ in range(12)])
    stamps += drawn(moffat(2.8), np.array([[12.0, 40.0]]), [5e4], 64)
    mask = np.zeros(stamps.shape[is_shared:], np.uint8)
    mask[..., 34:47, 6:19] = 1
    open_observation(ImageInput(stamps, mask=mask, **CAMERA), 16, 8).check_planes()
    with pytest.raises(ObservationError, match="time series"):
        open_observation(ImageInput(stamps, mask=0 * mask, **CAMERA), 16, 8).check_planes()


@pytest.mark.parametrize("chips", [1, 4])
def test_a_list_of_other_chips_too_is_told_from_one_of_another_image(chips):
    """Half of its stars may be off the image; more need an option, which the message names."""
    place, rng = jittered(40), np.random.default_rng(7)
    image = noisy(drawn(moffat(2.8), place, np.geomspace(2e4, 3e5, 40), SIZE), rng)
    catalogue = np.concatenate([np.add(place, [SIZE * chip, 0]) for chip in range(chips)])
    source = ImageInput(image, catalogue=catalogue, **CAMERA)
    if chips > 1:
        with pytest.raises(ObservationError, match="120 are off the image: on_image=True leaves"):
            open_observation(source, 16).check_list()
    open_observation(replace(source, on_image=True), 16).check_list()
    other_image = replace(source, image=np.roll(image, 23, axis=(0, 1)), on_image=True)
    with pytest.raises(ObservationError, match="a list of another image, or"):
        open_observation(other_image, 16).check_list()


# Colours.


def mosaic(red, blue, seed=1):
    """Undebayered image of a sky and stars of a colour, and the stars' positions."""
    place = jittered(40, seed=seed)
    light = drawn(moffat(2.8), place, np.geomspace(2e4, 3e5, 40), SIZE)
    image = noisy(light, np.random.default_rng(seed)) * 1.0
    return image * np.tile([[red, 1.0], [1.0, blue]], (SIZE // 2, SIZE // 2)), place


@pytest.mark.parametrize("colours", [(0.62, 0.7), (0.9, 0.9), (1.3, 1.1)])
@pytest.mark.parametrize("corner", [0, 1])
def test_an_undebayered_frame_is_seen_in_its_sky(colours, corner):
    image, place = mosaic(*colours)
    image, place = image[corner:], place - [0, corner]
    stars = Stars.from_image(np.round(image), catalogue=place, **CAMERA)
    assert any("undebayered" in note for note in stars.notes)


@pytest.mark.parametrize("kind", ["plain", "columns", "rows"])
def test_levels_of_columns_and_rows_are_no_colours(kind):
    image, place = mosaic(1.0, 1.0)
    image[:, :: 2 if kind == "columns" else SIZE] += 20.0
    image[:: 2 if kind == "rows" else SIZE] += 20.0
    stars = Stars.from_image(image, catalogue=place, **CAMERA)
    assert not any("undebayered" in note for note in stars.notes)


@pytest.mark.parametrize("card", ["BAYERPAT", "COLORTYP", "FILTER"])
@pytest.mark.parametrize("pattern", ["RGGB", "gbrg", "CYGM"])
def test_a_pattern_of_colours_in_the_header_is_refused(tmp_path, card, pattern):
    from astropy.io import fits

    image, place = mosaic(1.0, 1.0)
    path = tmp_path / "mosaic.fits"
    fits.PrimaryHDU(image.astype("f4"), fits.Header({card: pattern})).writeto(path)
    with pytest.raises(ObservationError, match=f"{card} = {pattern.upper()}"):
        psfdae.Stars.from_image(path, catalogue=place, **CAMERA)
