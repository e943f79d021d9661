"""The light of stars against their truth: between pixels, and outside of the stamps."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

import psfdae
from psfdae.denoise.field_models import load_field
from psfdae.image.image_input import ImageInput
from psfdae.methods.field import FieldMixture
from psfdae.methods.field.prior import FieldSettings
from psfdae.photometry import crowded
from psfdae.photometry.image_photometry import measure_all_stars
from psfdae.psf.exchange import write_psfex
from psfdae.psf.grid import PsfGrid
from psfdae.psf.photutils_grid import make_photutils_grid
from psfdae.psf.wings import Wings
from psfdae.training import neighbours
from simulated_fields import CAMERA, compare, simulate_field
from small_field import drawn

SKY = 300.0


def moffat(fwhm, beta):
    """Moffat profile of a star by its distance in px, of the light 1."""
    alpha = fwhm / 2 / np.sqrt(2 ** (1 / beta) - 1)
    return lambda r: (beta - 1) / (np.pi * alpha**2) * (1 + (r / alpha) ** 2) ** -beta


def on_grid(count, spacing_px, rng):
    """Positions (count², 2) at random phases, none within half the spacing of another."""
    cell = np.stack(np.meshgrid(np.arange(count), np.arange(count)), axis=-1).reshape(-1, 2)
    return (cell + 0.5) * spacing_px + rng.uniform(-0.25, 0.25, (count**2, 2)) * spacing_px


def distance_from_pixel(place):
    return np.hypot(*(place - np.rint(place)).T)


# Between pixels.


@pytest.fixture(
    scope="module",
    params=[(0.83, 2.8, 0.7), (1.2, 2.8, 0.7), (1.6, 2.8, 0.7), (1.6, 2.8, 0.5), (2.8, 1.8, 0.7)],
    ids="FWHM {0[0]} px, beta {0[1]}, knots {0[2]} px".format,
)
def bright_field(request):
    """Stars of S/N 100 to 1000, their fluxes, the profile, and a fit with knots of a distance."""
    fwhm, beta, knots_px = request.param
    rng, profile = np.random.default_rng(1), moffat(fwhm, beta)
    place, flux = on_grid(14, 24, rng), 10 ** rng.uniform(4.8, 6.0, 196)
    light = drawn(profile, place, flux, 14 * 24, half=25, over=9 if fwhm < 1 else 5)
    flux *= drawn(profile, np.full((1, 2), 25.0), [1.0], 51, half=25).sum()  # no light is farther
    image = (rng.poisson(light + SKY) + rng.normal(0, 3, light.shape)).astype(np.float32)
    camera = {"gain": 1.0, "read_noise": 3.0, "pixel_scale_arcsec": 1.0, "saturate": 1e7}
    stars = psfdae.Stars.from_image(image, place, stamp_px=16, **camera)
    # Nothing is tried: one order alone.
    settings = FieldSettings(orders=[0], spacing_px=knots_px)
    fitted = FieldMixture.fit(stars.training_set(FieldMixture), field=settings)
    return neighbours._Field(fitted.model, fitted.list_offset, 16), stars, flux, profile


def test_psfs_have_the_same_light_at_every_phase(bright_field, tmp_path):
    field, *_, profile = bright_field
    phase = np.random.default_rng(2).uniform(-0.5, 0.5, (60, 2))
    phase = np.concatenate([[[0, 0], [0.499, 0.499], [-0.499, 0.499], [0, 0.499]], phase])
    place = 150 + phase
    # Of wings that cross the edge of a stamp, it has more or less where its star is off the middle.
    middle = np.array([[15.0, 15.0]])
    stamps = [
        drawn(profile, middle + at, [1.0], 31, half=16, over=15)[7:23, 7:23].sum() for at in phase
    ]
    expected = np.array(stamps) / stamps[0]
    tolerance = 1e-3
    assert_allclose(field.draw_on_pixels(place).sum(axis=(1, 2)), expected, atol=tolerance)
    # What photometry, photutils and PSFEx's readers interpolate, to a row at the edge of the PSF.
    tolerance += 16 * profile(8.0)
    grid = PsfGrid.sample(field, 2)
    corner = np.floor(place + 0.5).astype(int) - 8
    assert_allclose(grid.stamps(place, corner, 16).sum(axis=(1, 2)), expected, atol=tolerance)
    y, x = np.mgrid[142:158, 142:158]
    photutils = make_photutils_grid(field, 2, 4)
    sums = [photutils.evaluate(x, y, 1.0, *at).sum() for at in place]
    assert_allclose(sums, expected, atol=tolerance)
    write_psfex(tmp_path / "f.psf", field, 4)
    psfex = load_field(tmp_path / "f.psf").draw_on_pixels(place)
    assert_allclose(psfex.sum(axis=(1, 2)), expected, atol=2 * tolerance)


def test_fluxes_are_as_right_between_pixels_as_on_them(bright_field):
    field, stars, flux, _ = bright_field
    table = crowded.photometry(field, stars.observation, 5.0).stars
    off = distance_from_pixel(stars.observation.positions)
    ratio = np.array(table["flux"]) / flux
    parts = [
        np.median(ratio[(off >= a) & (off < b)]) for a, b in ((0, 0.3), (0.3, 0.45), (0.45, 1))
    ]
    assert np.ptp(parts) < 0.006 and np.mean(parts) == pytest.approx(1.0, abs=0.01), parts


@pytest.mark.slow
def test_undersampled_stars_are_measured_as_well_as_by_an_ideal_fit():
    field = simulate_field(1300, 3000, (1.6, 1.7), seed=4)
    place = np.stack([field.stars["x"], field.stars["y"]], axis=1)
    stars = psfdae.Stars.from_image(field.image, place, **CAMERA)
    table = psfdae.fit(stars, method="field").photometry(field.image, place, **CAMERA)
    flux, flux_error = (np.array(table[name].value) for name in ("flux", "flux_error"))
    for row in compare({**field.stars, "flux": flux, "flux_error": flux_error}, field.stars):
        if row["low"] >= 14:
            assert 0.62 < row["within"] < 0.74, row
        if row["low"] >= 80:
            assert row["scatter"] < 1.2, row
    # At every phase, to the error of a median.
    off, snr = distance_from_pixel(place), np.array(field.stars["snr"])
    scaled = (flux / field.stars["flux"] - 1) * np.minimum(snr, 300)
    for low, high in ((0, 0.2), (0.2, 0.35), (0.35, 0.5), (0.5, 0.8)):
        part = (off >= low) & (off < high) & (snr > 35) & np.isfinite(scaled)
        bias = np.nanmedian((flux / field.stars["flux"] - 1)[part])
        error = 1.25 * np.std(scaled[part]) / np.sqrt(part.sum()) / np.median(snr[part])
        assert abs(bias) < 0.003 + error, (low, bias, error)


# Outside of the stamps.


def plate(saturation, count=9, spacing_px=44, seed=1):
    """Image of stars with halos, its noise that of a plate, and their positions.

    A quarter of their light is in halos of exp(−r/8 px). Counts L are S (1 − exp(−L/S)) for a
    saturation S.
    """
    rng, core = np.random.default_rng(seed), moffat(3.2, 3.0)
    place = on_grid(count, spacing_px, rng)
    flux = 10 ** rng.uniform(4.2, 6.0, len(place))

    def profile(r):
        return 0.75 * core(r) + 0.25 * np.exp(-r / 8.0) / (2 * np.pi * 8.0**2)

    light = drawn(profile, place, flux, count * spacing_px, half=60, over=3)
    counts = saturation * -np.expm1(-light / saturation)
    return (counts + 3000 + rng.normal(0, 40, light.shape)).astype(np.float32), place, flux


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(5e3, id="saturated plate"),
        pytest.param(1e9, id="linear camera", marks=pytest.mark.slow),
    ],
)
def measured_twice(request):
    """Saturation, model, its prediction of stars of its own image, photometry, true fluxes."""
    image, place, flux = plate(request.param)
    camera = {"pixel_scale_arcsec": 1.7}
    model = psfdae.fit(psfdae.Stars.from_image(image, place, **camera), method="field")
    photometry = measure_all_stars(model, ImageInput.build(image, camera | {"catalogue": place}))
    return request.param, model, model.predict_image(image, place, **camera), photometry, flux


def test_light_outside_of_stamps_is_one_number(measured_twice):
    _, model, prediction, photometry, flux = measured_twice
    light, error = model.wings.light()
    image_light, image_error = photometry.star_fit.wings.light()
    assert light > 5 * error
    assert image_light == pytest.approx(light, abs=max(error, image_error))
    assert not any("in the training" in note for note in photometry.notes)
    # Fluxes of both, within their errors, of the faint and of the bright stars.
    table = photometry.table
    off = np.array(table["flux"].value) - prediction.flux_total
    error = np.hypot(table["flux_error"].value, prediction.flux_total_error)
    for part in np.array_split(np.argsort(flux), 3):
        assert np.mean(np.abs(off[part]) < error[part]) > 0.6
        ratio = np.median(np.array(table["flux"].value)[part] / prediction.flux_total[part])
        assert ratio == pytest.approx(1.0, abs=0.04)


def test_photometry_has_the_psf_of_each_magnitude(measured_twice):
    saturation, model, *_ = measured_twice
    is_plate = saturation < 1e5
    assert (model.magnitude_range is not None) == is_plate
    # At a node of the grid, so that nothing but the magnitude is interpolated.
    grid = PsfGrid.sample(model, 2, by_magnitude=True)
    place = np.tile(np.rint(model.grid(2, 2)[0]), (4, 1))
    counts = 10 ** np.array([3.0, 4.5, 5.0, 7.0])
    stamps = grid.stamps(place, place.astype(int) - 8, 16, counts)
    psfs = model.draw_on_pixels(np.column_stack([place, -2.5 * np.log10(counts)]))
    middle = model.stamp_px // 2
    expected = psfs[:, middle - 8 : middle + 8, middle - 8 : middle + 8]
    assert_allclose(stamps, expected, atol=0.01 * expected.max())
    assert (np.ptp(stamps[:, 8, 8]) > 0.1 * stamps[:, 8, 8].mean()) == is_plate


def test_other_wings_than_in_the_training_are_named():
    radius, unit = np.geomspace(8, 40, 7), np.eye(7)
    wings, fewer, other = (
        Wings(radius, np.full(7, p), 1e-12 * unit, 0.05) for p in (1e-4, 0.999e-4, 2e-4)
    )
    assert wings.differs_from(other) and other.differs_from(wings)
    assert not wings.differs_from(fewer)
