"""Noise of images: units, noise maps with pixels without data, whole counts, shared noise."""

from __future__ import annotations

import re

import numpy as np
import pytest
from astropy.io import fits
from scipy import ndimage

import psfdae
from image_training import few_draws
from psfdae.image import opening
from psfdae.image.image_input import ImageInput
from psfdae.image.opening import open_observation
from psfdae.image.sky import subtract_sky
from psfdae.image.sky_level import noise_correlation
from small_field import CAMERA, GAIN, READ, SKY, drawn, field, moffat, table

SCALE = {"pixel_scale_arcsec": CAMERA["pixel_scale_arcsec"]}


@pytest.fixture(scope="module")
def image():
    return field()[0].astype(np.float64)


@pytest.fixture(scope="module")
def options():
    """The star list, and the camera without its counts."""
    return {"catalogue": table(field()[1]), "origin": 0, **SCALE}


@pytest.fixture(scope="module")
def model(image, options):
    with few_draws():
        return psfdae.fit(psfdae.Stars.from_image(image, **options, **camera(1.0)), method="field")


def camera(unit):
    """Gain and saturation of an image of which a count has this value."""
    return {"gain": GAIN / unit, "saturate": CAMERA["saturate"] * unit, "read_noise": READ}


# Units.


def measured(model, image, options, unit):
    """Columns of `predict` and `photometry` in counts, with their flags."""
    options = {**options, **camera(unit)}
    prediction = model.predict_image(image * unit, **options)
    stars = model.photometry(image * unit, **options)
    light = ("flux", "flux_error", "flux_total", "flux_total_error", "noise", "background")
    columns = {name: getattr(prediction, name) / unit for name in light}
    columns |= {name: getattr(prediction, name) for name in ("snr", "x_fit", "chi2", "flags")}
    psf = prediction.psf.astype(np.float64).sum(axis=(1, 2)) / unit
    numbers = {f"fitted {name}": np.array(stars[name]) for name in ("x", "chi2", "flags")}
    numbers |= {f"fitted {name}": np.array(stars[name]) / unit for name in ("flux", "flux_error")}
    return {**columns, **numbers, "psf": psf}


@pytest.fixture(scope="module")
def in_counts(model, image, options):
    return measured(model, image, options, 1.0)


@pytest.mark.parametrize("unit", [1e-30, 1e20, 1e30, 2.0**-100])
def test_results_do_not_depend_on_the_unit(model, image, options, in_counts, unit):
    """All values are the same but for the rounding of single precision; powers of 2 round none."""
    is_exact = np.log2(unit) % 1 == 0
    for name, values in measured(model, image, options, unit).items():
        tolerance = 1e-6 if is_exact else 1e-5 if "flux" in name and "err" not in name else 1e-3
        if "flags" in name:
            assert values.tolist() == in_counts[name].tolist()
        else:
            assert values == pytest.approx(in_counts[name], rel=tolerance, nan_ok=True), name


@pytest.mark.parametrize("unit", [1e-30, 1e30])
def test_detection_and_noise_maps_do_not_depend_on_the_unit(model, image, options, unit):
    detected = psfdae.detect(image)
    scaled = psfdae.detect(image * unit)
    for name in ("flux_iso", "background"):
        assert scaled[name].value / unit == pytest.approx(detected[name].value, rel=1e-5)
    sigma = np.sqrt(image / GAIN + (READ / GAIN) ** 2)
    fluxes, gains = [], []
    for kind, power in (("error", 1), ("variance", 2), ("weight", -2)):
        for factor in (1.0, unit):
            noise_map = {kind: (sigma * factor) ** power}
            stars = model.photometry(image * factor, **options, **noise_map)
            fluxes.append(np.array(stars["flux"]) / factor)
            opened = open_observation(
                ImageInput(image * factor, **options, **noise_map), stamp_px=16
            )
            gains.append(opened.gain * factor)
    assert np.ptp(fluxes, axis=0).max() < 1e-4 * np.max(fluxes)
    assert gains == pytest.approx([GAIN] * len(gains), rel=0.1)


# Noise maps.


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        *(("error", value) for value in (np.nan, np.inf)),
        *(("weight", value) for value in (np.nan, 0.0)),
        *(("variance", value) for value in (np.inf, 0.0)),
    ],
)
def test_a_pixel_without_noise_is_a_bad_pixel(model, image, options, kind, value):
    """Light, errors and wings are those of an image in which this pixel is masked."""
    sigma = np.sqrt(image / GAIN + (READ / GAIN) ** 2)
    noise_map = sigma ** {"error": 1, "variance": 2, "weight": -2}[kind]
    mask = np.zeros(image.shape, bool)
    mask[10, 10] = mask[150:160, 100] = True
    expected = model.photometry(image, **options, **{kind: noise_map}, mask=mask)
    damaged = np.where(mask, value, noise_map)
    stars = model.photometry(image, **options, **{kind: damaged})
    for name in ("flux", "flux_error", "x", "flags"):
        assert np.array(stars[name]) == pytest.approx(np.array(expected[name]), rel=1e-4), name


@pytest.mark.parametrize("values", [np.nan, 0.0, np.inf])
def test_a_map_without_a_value_is_refused_in_one_line(image, options, values):
    with pytest.raises(psfdae.Error, match="a map of σ without a finite value above 0"):
        psfdae.Stars.from_image(image, **options, error=np.full(image.shape, values))


@pytest.mark.parametrize(("name", "power"), [("ERR", 1), ("VAR", 2)])
def test_extensions_with_pixels_without_noise(model, image, options, tmp_path, name, power):
    """A pipeline's file has NaN, 0 and negative variances in a few pixels."""
    noise_map = np.sqrt(image / GAIN + (READ / GAIN) ** 2) ** power
    noise_map[10, 10], noise_map[20, 30], noise_map[200, 40:50] = np.nan, 0.0, -1.0
    quality = np.zeros(image.shape, np.int16)
    layers = {"SCI": image, name: noise_map, "DQ": quality}
    hdus = [fits.ImageHDU(values, name=key) for key, values in layers.items()]
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(tmp_path / "image.fits")
    stars = model.photometry(tmp_path / "image.fits", **options)
    mask = ~(noise_map > 0)
    expected = model.photometry(
        image, **options, mask=mask, error=np.where(mask, 1, np.abs(noise_map)) ** (1 / power)
    )
    assert np.array(stars["flux"]) == pytest.approx(np.array(expected["flux"]), rel=1e-4)
    observation = psfdae.Stars.from_image(tmp_path / "image.fits", **options).observation
    assert f"{name} as {'σ' if power == 1 else 'σ²'} (bad pixels: 12)" in observation.summary()


def test_a_region_of_weight_0_is_left_out(model, image, options):
    weight = np.ones(image.shape)
    weight[:, :100] = 0.0
    stars = model.photometry(image, **options, weight=weight)
    covered = options["catalogue"]["x"] > 110
    whole = model.photometry(image, **options)
    assert np.isfinite(stars["flux"][covered]).all()
    ratio = np.array(stars["flux"][covered]) / np.array(whole["flux"][covered])
    assert np.median(ratio) == pytest.approx(1.0, abs=3e-3)
    assert (np.array(stars["flags"])[options["catalogue"]["x"] < 90] > 0).all()


# Whole counts.


@pytest.mark.parametrize("sigma", [2.0, 1.0, 0.5, 0.3])
@pytest.mark.parametrize("unit", [1.0, 1 / 65535])
def test_whole_counts_have_the_noise_of_the_sky_and_of_rounding(options, image, sigma, unit):
    """σ² + 1/12 count², and the level, of skies that are rounded at many phases."""
    scale = sigma / np.sqrt(SKY / GAIN + (READ / GAIN) ** 2)
    drift = np.linspace(0.0, 1.0, image.shape[1])
    whole = np.round(image * scale + drift) * unit
    observation = open_observation(ImageInput(whole, **options), stamp_px=16, margin=8)
    sky, expected = observation.sky(), unit * np.hypot(sigma, 12**-0.5)
    assert np.median(sky.noise) == pytest.approx(expected, rel=0.2)
    level = sky.level - unit * (SKY * scale + drift)
    assert abs(np.median(level)) < 0.1 * expected and level.std() < 0.25 * expected
    noise = next(observation.chunks(observation.count)).noise
    assert np.nanmedian(noise) == pytest.approx(expected, rel=0.2)


def test_stars_of_whole_counts_are_used_and_measured(image, options):
    """A sky noise of half a count: as many stars and as much light as in many counts."""
    scale = 0.5 / np.sqrt(SKY / GAIN + (READ / GAIN) ** 2)
    counts = {**options, "gain": GAIN / scale, "read_noise": READ}
    stars = psfdae.Stars.from_image(np.round(image * scale), **counts)
    reference = psfdae.Stars.from_image(image, **options, gain=GAIN, read_noise=READ)
    good, expected_good = ((s.table["verdict"] == "good").sum() for s in (stars, reference))
    assert good >= 0.9 * expected_good
    ratio = np.array(stars.table["snr"]) / np.array(reference.table["snr"])
    assert np.nanmedian(ratio) == pytest.approx(0.5 / np.hypot(0.5, 12**-0.5), rel=0.15)


@pytest.mark.parametrize("photons", [4.0, 1.0, 0.5])
def test_photons_of_a_faint_sky_have_poisson_noise(photons):
    counts = np.random.default_rng(5).poisson(photons, (300, 300)).astype(np.float64)
    sky = subtract_sky(counts, np.zeros(counts.shape, bool))
    assert np.median(sky.noise) == pytest.approx(np.sqrt(photons), rel=0.15)


# Noise that pixels share.


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("offset", [0.4, 0.7])
def test_offsets_of_rows_or_columns_are_in_the_noise_of_stars(axis, offset):
    """Weighted sums of pixels scatter by the given σ of the sky times √Σ p²."""
    rng = np.random.default_rng(4)
    shape = (1, 300) if axis else (300, 1)
    noise = rng.normal(0, 10.0, (300, 300)) + rng.normal(0, 10.0 * offset, shape)
    sky = subtract_sky(200.0 + noise, np.zeros(noise.shape, bool))
    assert sky.correlation > 1.0
    assert sky.structure[:2] == ([], [])
    # A PSF with a FWHM of 3 px on many noises: Σ p n over Σ p² is the flux of a star.
    kernel = np.exp(-0.5 * (np.arange(-8, 9) / (3.0 / 2.355)) ** 2)
    psf = np.outer(kernel, kernel) / kernel.sum() ** 2
    sums = ndimage.convolve(noise, psf)[10:-10, 10:-10] / np.square(psf).sum()
    expected = np.median(sky.noise) / np.sqrt(np.square(psf).sum())
    assert sums.std() == pytest.approx(expected, rel=0.15)


SHARED = {
    "none": lambda noise, rng: noise,
    "two by two pixels": lambda noise, rng: 2.0 * ndimage.uniform_filter(noise, 2),
    "a seeing disc": lambda noise, rng: 2.8 * ndimage.gaussian_filter(noise, 0.8),
    "rows": lambda noise, rng: noise + 0.7 * rng.normal(size=(len(noise), 1)),
    "columns": lambda noise, rng: noise + 0.7 * rng.normal(size=(1, len(noise))),
}
"""Noise that pixels share, of about 1 in a pixel, from independent noise (h, w)."""


@pytest.mark.parametrize("kind", SHARED)
def test_errors_of_predictions_include_noise_that_pixels_share(model, image, kind):
    """Two thirds of faint fluxes are within their errors; χ² is that of pixels, and stays 1."""
    axis, rng = np.arange(16.0, len(image) - 16, 20), np.random.default_rng(3)
    place = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    place = place + rng.uniform(-1, 1, place.shape)
    light = drawn(lambda r: np.exp(-(r**2) / 3.38) / 10.62, place, np.full(len(place), 2e3), 300)
    pulls = []
    for _ in range(2):
        noise = SHARED[kind](rng.normal(size=image.shape), rng)
        stars = {"catalogue": place, "origin": 0, **SCALE}
        found = model.predict_image(SKY + light + 14 * noise, **stars)
        pulls.append((found.flux - np.median(found.flux)) / found.flux_error)
        assert ("pixels share their noise" in "".join(found.notes)) == (kind != "none")
        assert np.median(found.chi2) == pytest.approx(1.0, abs=0.1)
        # Errors of centres, which depend on differences of pixels, are not too small.
        off = found.x_fit - place[:, 0]
        assert np.mean(np.abs(off - np.median(off)) < found.x_error) > 0.62
    assert 0.62 < np.mean(np.abs(pulls) < 1) < 0.74


@pytest.mark.parametrize("kind", SHARED)
@pytest.mark.parametrize("map_kind", [None, "error", "weight"])
@pytest.mark.parametrize("is_detected", [True, False])
def test_each_property_is_said_once(image, kind, map_kind, is_detected):
    """Sentences of the camera, the sky and the layers do not repeat each other."""
    axis, rng = np.arange(16.0, len(image) - 16, 20), np.random.default_rng(3)
    place = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    light = drawn(moffat(2.8), place, np.full(len(place), 2e4), 300)
    pixels = SKY + light + 14 * SHARED[kind](rng.normal(size=image.shape), rng)
    options = {} if map_kind is None else {map_kind: np.ones(image.shape)}
    options |= {"detect": True} if is_detected else {"catalogue": place, "origin": 0}
    observation = open_observation(ImageInput(pixels, **options, **SCALE), 16)
    kinds = [re.sub(r"[-+\d.,]+", "#", remark)[:60] for remark in observation.remarks]
    assert len(set(kinds)) == len(kinds)
    assert sum("pixels share their noise" in k for k in kinds) == (kind != "none")


@pytest.mark.parametrize("kind", ["none", "two by two pixels"])
def test_predictions_include_shared_noise_that_the_sky_alone_shows(monkeypatch, image, kind):
    """The sample by which a camera is checked is small, and may show none."""
    monkeypatch.setattr(opening, "check_camera", lambda _, camera: (dict(camera), [], 1.0))
    axis, rng = np.arange(16.0, len(image) - 16, 20), np.random.default_rng(3)
    place = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    light = drawn(moffat(2.8), place, np.full(len(place), 2e4), 300)
    pixels = SKY + light + 14 * SHARED[kind](rng.normal(size=image.shape), rng)
    observation = open_observation(ImageInput(pixels, detect=True, **SCALE), 16)
    correlation = next(observation.chunks(9)).noise_correlation
    is_said = any("errors include it" in remark for remark in observation.remarks)
    assert is_said == (kind != "none") == bool(correlation.min() > 1.5)
    assert correlation == pytest.approx(observation.sky().correlation)


def test_faint_sources_are_not_noise_that_pixels_share():
    rng = np.random.default_rng(6)
    image = rng.normal(0, 10.0, (300, 300))
    place, flux = rng.uniform(5, 295, (400, 2)), rng.exponential(150.0, 400)
    image += drawn(moffat(2.8), place, flux, 300)
    assert noise_correlation(image / 10.0) < 1.1
