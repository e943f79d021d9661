"""Few stars: as many as there are, stamps that fit them, and stars of any shape."""

import numpy as np
import pytest

import psfdae
from psfdae.base.errors import Error
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation
from psfdae.image.source_size import measure_size
from psfdae.image.stamps import StarFlag
from psfdae.photometry.crowded import photometry
from psfdae.training.calibration import StarErrors
from psfdae.training.settings import from_words
from small_field import GAIN, READ, SKY, image_of, moffat, ring

CAMERA = {"gain": GAIN, "read_noise": READ, "pixel_scale_arcsec": 0.6}


def opened(model, image, place):
    """The stars of an image, for a model."""
    return open_observation(
        ImageInput(image, catalogue=place, **CAMERA), model.stamp_px, model.margin_px
    )


@pytest.fixture(scope="module")
def wide_stars():
    """Stars of a FWHM of 12 px."""
    return image_of(moffat(12.0), np.geomspace(3e5, 3e6, 25), 460, 60, edge=45)


@pytest.fixture(scope="module")
def rings():
    """Stars out of focus."""
    return image_of(ring, np.geomspace(5e4, 1e6, 40), 300, 28)


# As many stars as there are


def test_faint_stars_lower_the_least_signal_to_noise():
    image, place = image_of(moffat(2.8), np.geomspace(8e2, 6e3, 70), 300, 16)
    stars = psfdae.Stars.from_image(image, catalogue=place, **CAMERA)
    least_snr = stars.settings.calibration_stars.snr_min
    assert len(stars) >= 20 and 20 <= least_snr < 100
    assert stars.candidates.bright.snr.min() >= least_snr
    assert max(stars.settings.calibration_stars.list_degraded_snr()) <= least_snr / 2


def test_refusal_names_the_options():
    image, place = image_of(moffat(2.6), np.full(3, 5e4), 160, 25)
    with pytest.raises(Error, match=r"5 are needed.*stars_min=.*snr_min="):
        psfdae.Stars.from_image(image, catalogue=place, stars_min=5, **CAMERA)
    stars = psfdae.Stars.from_image(image, catalogue=place, **CAMERA)
    assert any("error is not known" in note for note in stars.notes)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 5, 12])
def test_model_of_few_stars_measures_fluxes(count):
    flux = np.geomspace(2e5, 3e4, count)
    image, place = image_of(moffat(2.6), flux, 200, 25)
    stars = psfdae.Stars.from_image(image, catalogue=place, **CAMERA)
    model = psfdae.fit(stars, method="field")
    measured = photometry(model, opened(model, image, place), 5.0)
    # 1 % of the light is beyond the stamps, and few stars do not show it.
    assert abs(np.median(np.array(measured.stars["flux"]) / flux - 1)) < 0.015


def test_limit_of_outliers_knows_how_many_stars_it_rests_on():
    """Scores of stars that differ from each other: few of further stars are beyond the limit."""
    rng, outlier_fractions = np.random.default_rng(1), []
    for _ in range(40):
        of_star = rng.chisquare(12, 12)
        star = np.resize(np.arange(12), 600)
        scores = np.stack([of_star[star] * rng.uniform(0.95, 1.05, 600) for _ in range(2)])
        nodes = np.array([0.01, 0.02])
        errors = StarErrors(nodes, np.zeros((2, 600, 2, 2), np.float32), star, scores, scores)
        outlier_fractions.append((rng.chisquare(12, 1000) > errors.outlier_limit()[0]).mean())
    assert np.mean(outlier_fractions) < 0.01 and np.median(outlier_fractions) < 0.005


@pytest.mark.slow
def test_stars_of_one_psf_are_like_the_training():
    image, place = image_of(moffat(2.8), np.geomspace(4e3, 2e5, 70), 340, 18)
    stars = psfdae.Stars.from_image(image, catalogue=place, **CAMERA)
    model = psfdae.fit(stars, method="field")
    (_, prediction), *_ = model.stream(opened(model, image, place), threads=1)
    assert np.mean((prediction.flags & int(StarFlag.UNLIKE_TRAINING)) > 0) <= 0.02


# Stamps that fit the stars


@pytest.mark.parametrize(("fwhm", "side"), [(2.0, 16), (2.8, 16), (4.0, 16), (12.0, 64)])
def test_size_of_stars(fwhm, side):
    image, place = image_of(moffat(fwhm), np.geomspace(1e5, 1e6, 20), 400, 55, edge=40)
    size = measure_size(image - SKY, np.zeros(image.shape, bool), place)
    alpha = fwhm / 2 / np.sqrt(2 ** (1 / 3) - 1)
    half_light = 2 * alpha * np.sqrt(np.sqrt(2) - 1)  # 1 − (1 + r²/α²)^-2 = ½
    assert size.fwhm_px == pytest.approx(half_light, rel=0.07, abs=0.4)
    assert size.side(0.95) == side
    light_fraction = 1 - (1 + side**2 / np.pi / alpha**2) ** -2
    assert size.light_within(side) == pytest.approx(light_fraction, abs=0.012)
    # A list may be off by a pixel: the profile is about the centre of the light.
    off = measure_size(image - SKY, np.zeros(image.shape, bool), place + np.array([1.0, -1.0]))
    assert off.fwhm_px == pytest.approx(size.fwhm_px, rel=0.02)


def test_wide_stars_get_wide_stamps_unless_a_size_is_stated(wide_stars):
    image, place = wide_stars
    stars = psfdae.Stars.from_image(image, catalogue=place, **CAMERA)
    side = stars.settings.framing.stamp_px
    assert side in (48, 64)  # 96.5 and 98.5 % of the light
    assert stars.candidates.bright.stamps.shape[-1] >= side + 16
    assert any(f"stamps of {side} px" in note for note in stars.notes)
    assert len(stars) >= 15
    off = stars.candidates.bright.centre - stars.candidates.bright.listed
    assert np.sqrt(np.square(off).mean(axis=0)) == pytest.approx(0.0, abs=0.1)
    stated = psfdae.Stars.from_image(image, catalogue=place, stamp_px=16, **CAMERA)
    assert stated.settings.framing.stamp_px == 16
    # The finest structure of these stars is wider by a factor of two to four than is usual.
    field, usual = stars.settings.field, stated.settings.field
    assert (field.spacing_px, field.step_px) == (2 * usual.spacing_px, 2 * usual.step_px)


def test_stated_size_is_taken_as_it_is():
    assert from_words(["framing.stamp_px=24"]).calibration_stars.light_min == 0.0
    assert from_words(["framing.jitter_px=1"]).calibration_stars.light_min > 0.9
    overrides = ["framing.stamp_px=24", "calibration_stars.light_min=0.9"]
    assert from_words(overrides).calibration_stars.light_min == 0.9


@pytest.mark.parametrize("kind", ["wide_stars", "rings"])
def test_large_stars_are_found_as_one_source_each(kind, request):
    image, place = request.getfixturevalue(kind)
    detected = open_observation(ImageInput(image, detect=5.0), 16).positions
    assert len(detected) == len(place)
    off = np.hypot(*(detected[:, None] - place).T).min(axis=1)
    assert off.max() < 1.5


# Any shape


def test_rings_are_centred_on_their_light(rings):
    image, place = rings
    stars = psfdae.Stars.from_image(image, catalogue=place, **CAMERA)
    assert len(stars) >= 0.8 * len(place)
    bright = stars.candidates.bright
    assert np.abs(bright.centre - bright.listed).max() < 0.3
    assert np.abs(bright.peak).max() <= 1
    assert stars.settings.calibration_stars.centring_px == pytest.approx(10.6, abs=1)
    assert any("smoothed light" in note for note in stars.notes)


@pytest.mark.slow
def test_model_of_rings_measures_fluxes(rings):
    image, place = rings
    stars = psfdae.Stars.from_image(image, catalogue=place, **CAMERA)
    model = psfdae.fit(stars, method="field")
    measured = photometry(model, opened(model, image, place), 5.0)
    total = ring(np.hypot(*np.mgrid[-12:12.01:0.1, -12:12.01:0.1])).sum() * 0.01
    flux = np.geomspace(5e4, 1e6, len(place)) * total
    assert abs(np.median(np.array(measured.stars["flux"]) / flux - 1)) < 0.01
