"""PSFs of stars in memory: quality, uncertainty, photometry, centring, flags."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prediction_stars import KAPPA, SKY, observe
from psfdae import PredictionError, StarFlag
from psfdae.denoise import denoiser as restoration
from psfdae.denoise.prediction import CUBES
from psfdae.image.stamps import cut, find_unlike_stars
from psfdae.methods.interface import Packing


def rms(values):
    return np.sqrt(np.nanmean(np.square(values)))


def has(result, flag):
    return (result.flags & int(flag)) > 0


def compared(result):
    """Names of all arrays but the stars' numbers."""
    return [name for name in (*result.columns, *CUBES) if name != "id"]


def same(a, b, rows=slice(None)):
    pairs = ((getattr(a, name)[rows], getattr(b, name)[rows]) for name in compared(a))
    return all(np.array_equal(*pair, equal_nan=True) for pair in pairs)


def close(a, b, rows=slice(None), rel=1e-3):
    """The same but for rounding, of which the angle of a round PSF has most.

    A residual is what little is left of hundreds of counts in single precision: to 2e-5 of the
    sky's RMS.
    """
    tolerances = {"position_angle_deg": 50 * rel, "residual": 2e-5 * SKY**0.5}
    for name in compared(a):
        x, y = (np.asarray(getattr(p, name)[rows], np.float64) for p in (a, b))
        tolerance = np.maximum(rel * np.abs(y), tolerances.get(name, 1e-3))
        assert ((np.abs(x - y) <= tolerance) | (np.isnan(x) & np.isnan(y))).all(), name
    return True


@pytest.fixture(scope="module")
def medium(field_psfs):
    """Stars of S/N 23."""
    return observe(field_psfs, 1e-3)


@pytest.fixture(scope="module")
def clean(shipped, medium):
    """Their prediction, nothing given."""
    return shipped.predict(medium.stamps)


@pytest.mark.parametrize("level", [1e-4, 1e-3, 3e-3])
def test_uncertainty_covers_68_per_cent_and_the_flux_error_is_the_scatter(
    shipped, field_psfs, level
):
    stars = observe(field_psfs, level)
    for stated in ({"flux": stars.flux, "background": SKY}, {"background": SKY}, {}):
        result = shipped.predict(stars.stamps, **stated)
        valid = ~has(result, StarFlag.NO_FLUX)
        assert valid.mean() > 0.99
        error = np.abs(result.psf - stars.flux * stars.truth)[valid]
        assert (error <= result.uncertainty[valid]).mean() == pytest.approx(0.68, abs=0.05)
        if "flux" not in stated and level > 1e-4:
            scatter = rms(result.flux - stars.flux)
            assert scatter == pytest.approx(rms(result.flux_error), rel=0.2)
            assert np.nanmean(result.flux / stars.flux) == pytest.approx(1.0, abs=0.05)


def test_errors_are_those_that_the_bundle_states(shipped, field_psfs):
    for row in shipped.info.metrics[3:6]:
        stars = observe(field_psfs, row["noise_level"])
        result = shipped.predict(stars.stamps, flux=stars.flux, background=SKY)
        mse = np.mean((result.psf / stars.flux - stars.truth) ** 2)
        assert mse == pytest.approx(row["mse"], rel=0.15)


def test_estimating_flux_and_sky_costs_less_than_the_noise_does(shipped, medium, clean):
    with_known = shipped.predict(medium.stamps, flux=medium.flux, background=SKY)
    with_known, estimated, noisy = (
        rms(images - medium.truth)
        for images in (
            with_known.psf / medium.flux,
            clean.psf / clean.flux[:, None, None],
            (medium.stamps - SKY) / medium.flux,
        )
    )
    assert with_known < estimated < 1.3 * with_known
    assert estimated < 0.5 * noisy


def test_noise_sky_and_signal_to_noise_are_measured(shipped, medium, clean):
    assert np.mean(clean.noise) == pytest.approx(SKY**0.5, rel=0.05)
    assert np.std(clean.noise / SKY**0.5) < 0.12
    # A constant under a star of known flux would be known to σ/16.
    assert np.mean(clean.background) == pytest.approx(SKY, abs=0.1 * SKY**0.5)
    assert np.std(clean.background) < 0.3 * SKY**0.5
    # That of a filter matched to each star, whatever the PSF of the others is.
    matched = medium.flux * np.sqrt(np.square(medium.truth).sum(axis=(1, 2))) / SKY**0.5
    assert np.median(clean.snr / matched) == pytest.approx(1.0, abs=0.05)


def test_flux_of_bright_stars_is_found_with_more_noise_than_there_is(shipped, field_psfs):
    """A shape that the model does not know would pass for flux and for no noise."""
    without_floor = shipped.replace_errors(replace(shipped.bundle.errors, noise_floor=0.0))
    stars = observe(field_psfs, 3e-5)
    result, plain = (m.predict(stars.stamps) for m in (shipped, without_floor))
    assert rms(result.flux / stars.flux - 1) < 0.7 * rms(plain.flux / stars.flux - 1)
    assert result.noise.min() > 0.8 * SKY**0.5
    assert (result.flags > 0).mean() < 0.02


def test_residual_is_what_is_left_of_the_stamp(medium, clean):
    residual = medium.stamps - clean.background[:, None, None] - clean.psf
    np.testing.assert_allclose(clean.residual, residual, rtol=0, atol=1e-2)
    assert np.median(clean.chi2) == pytest.approx(1.0, abs=0.15)


def test_a_residual_far_above_the_noise_is_flagged(shipped, field_psfs, monkeypatch):
    """Stars with a companion, and a limit among their χ²."""
    double = field_psfs[:60] + 0.3 * np.roll(field_psfs[:60], (3, 4), (1, 2))
    flux = np.geomspace(1e4, 1e6, 60)[:, None, None]
    stamps = np.random.default_rng(4).poisson(flux * double + 100.0).astype(np.float32)
    monkeypatch.setattr(restoration, "MAX_CHI2", 2.0)
    result = shipped.predict(stamps, gain=1.0, noise=10.0)
    poor = has(result, StarFlag.POOR_FIT)
    assert (poor == (result.chi2 > 2.0)).all() and 5 < poor.sum() < 55
    no_gain = shipped.predict(stamps, noise=10.0)  # the gain: fewer photons are expected
    assert has(no_gain, StarFlag.POOR_FIT).sum() >= poor.sum()


@pytest.mark.parametrize("sigma", [None, 2.0])
def test_chi2_of_noise_is_1_whatever_part_of_it_a_star_follows(sigma):
    """A pixel is left the part k = 1 − u²/s of its noise, if that of the star is known to u."""
    rng, psf = np.random.default_rng(3), np.full((4000, 6, 6), 9.0)
    noise, gain = np.full(4000, 3.0), np.full(4000, 1.0)
    part = 1.0 if sigma is None else 1.0 - sigma**2 / 18.0
    residual = np.sqrt(18.0 * part) * rng.normal(size=psf.shape)
    residual[:, 0] = np.nan
    flux_sigma = None if sigma is None else np.full(psf.shape, sigma)
    chi2 = restoration.compute_reduced_chi2(residual, psf, flux_sigma, noise, gain)
    assert chi2.mean() == pytest.approx(1.0, abs=0.01)
    residual[:] = np.nan
    assert np.isnan(restoration.compute_reduced_chi2(residual, psf, flux_sigma, noise, gain)).all()


def test_photons_of_the_star_belong_to_chi2_if_the_gain_is_known(shipped, field_psfs):
    stars = observe(field_psfs, 1e-4)
    no_gain = shipped.predict(stars.stamps, noise=SKY**0.5)
    counted = shipped.predict(stars.stamps, noise=SKY**0.5, gain=1.0)
    assert (counted.chi2 < no_gain.chi2).all()
    assert counted.flux_error == pytest.approx(np.hypot(no_gain.flux_error, no_gain.flux**0.5))


@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_any_unit_gives_the_same_psf(shipped, medium, clean, unit):
    result = shipped.predict(medium.stamps[:100].astype(np.float64) * unit)
    np.testing.assert_allclose(result.psf / unit, clean.psf[:100], rtol=1e-3, atol=1e-2)
    assert result.snr == pytest.approx(clean.snr[:100], rel=1e-3)
    assert np.mean(result.flags == clean.flags[:100]) > 0.99


@pytest.mark.parametrize(("name", "rel"), [("shipped", 1e-3), ("network", 1e-4)])
def test_result_depends_neither_on_threads_nor_on_company(name, rel, medium, request):
    model = request.getfixturevalue(name)
    clean = model.predict(medium.stamps)
    assert len(medium.stamps) > Packing().batch_size
    assert same(model.predict(medium.stamps, threads=2), clean)
    order = np.random.default_rng(0).permutation(len(medium.stamps))
    for rows in (slice(300, 301), order):
        picked = clean.of(rows)
        assert close(model.predict(medium.stamps[rows]), picked, rel=rel)
    assert model.predict(medium.stamps[300]).psf.shape == (1, 16, 16)


@pytest.mark.parametrize("kind", [">f4", ">i2", list])
def test_numbers_of_any_type_and_byte_order_are_taken_and_left_alone(shipped, medium, clean, kind):
    stamps = medium.stamps[:9]
    values = stamps.tolist() if kind is list else stamps.astype(kind)
    psf = shipped.predict(values).psf
    assert psf == pytest.approx(clean.psf[:9], rel=1e-4, abs=1e-2)
    assert psf.dtype == np.float32
    assert np.array_equal(values, stamps.astype(kind) if kind is not list else stamps)


def put(value, *place):
    def change(stamp):
        stamp[place or ...] = value

    return change


BROKEN = {
    "a NaN": (StarFlag.MASKED, put(np.nan, 4, 9)),
    "a dead row": (StarFlag.MASKED, put(np.nan, 5)),
    "all NaN": (StarFlag.MASKED | StarFlag.NO_FLUX, put(np.nan)),
    "a huge pixel": (StarFlag.OUTLIER, put(3e38, 8, 8)),
    "a constant": (StarFlag.NO_FLUX, put(SKY)),
    "negative": (StarFlag.NO_FLUX, lambda stamp: np.subtract(2 * SKY, stamp, stamp)),
    "far off centre": (StarFlag.OFF_CENTRE, lambda stamp: put(np.roll(stamp, 5, 0))(stamp)),
}


@pytest.mark.parametrize(("name", "is_alike"), [("shipped", close), ("network", same)])
def test_broken_stamps_are_flagged_and_their_neighbours_do_not_notice(
    name, is_alike, medium, request
):
    model, stamps = request.getfixturevalue(name), medium.stamps.copy()
    for stamp, (_, change) in zip(stamps, BROKEN.values(), strict=False):
        change(stamp)
    result = model.predict(stamps)
    for row, (kind, (flag, _)) in enumerate(BROKEN.items()):
        assert (result.flags[row] & int(flag)) == int(flag), kind
    dark = has(result, StarFlag.NO_FLUX)
    assert np.isnan(result.psf[dark]).all()
    assert np.isfinite(result.psf[~dark]).all()
    assert np.isfinite(result.uncertainty[~dark]).all()
    assert is_alike(result, model.predict(medium.stamps), slice(len(BROKEN), None))


def test_masked_and_saturated_pixels_are_repaired_and_left_out(shipped, medium, clean):
    bad = np.zeros(medium.stamps.shape, dtype=bool)
    bad[:, 3, 4] = bad[:, 12, 7] = True
    bad[0, :12] = True  # more than half of a star
    spoilt = medium.stamps.copy()
    spoilt[bad] = 6e4
    masked = shipped.predict(spoilt, bad=bad)
    saturated = shipped.predict(spoilt, saturated=bad)
    assert has(masked, StarFlag.MASKED).all()
    assert not has(masked, StarFlag.SATURATED).any()
    assert has(saturated, StarFlag.SATURATED).all()
    assert has(masked, StarFlag.NO_FLUX)[0] and np.isnan(masked.psf[0]).all()
    assert np.isnan(masked.residual[bad]).all()
    assert np.isfinite(masked.residual[~bad]).mean() > 0.99
    assert np.array_equal(masked.psf, saturated.psf, equal_nan=True)
    truth = medium.flux * medium.truth
    assert rms(masked.psf - truth) < 1.2 * rms(clean.psf - truth)
    assert np.nanmedian(masked.noise) == pytest.approx(np.median(clean.noise), rel=0.05)


def test_given_values_are_used_and_missing_ones_estimated(shipped, medium, clean):
    flux = np.full(len(medium.stamps), np.nan)
    flux[::2] = medium.flux
    result = shipped.predict(medium.stamps, flux=flux, noise=123.0)
    assert (result.flux[::2] == medium.flux).all()
    assert np.isnan(result.flux_error[::2]).all()
    assert np.isfinite(result.flux_error[1::2]).all()
    assert (result.noise == 123.0).all()
    sky = shipped.predict(medium.stamps, background=SKY + 1.0)
    assert (sky.background == SKY + 1.0).all()
    assert rms(sky.flux / medium.flux - 1) < rms(clean.flux / medium.flux - 1)
    dark = shipped.predict(medium.stamps[:2], flux=np.array([0.0, -5.0]))
    assert has(dark, StarFlag.NO_FLUX).all()


@pytest.mark.parametrize(("end", "factor"), [("LOW", 0.6), ("HIGH", 2.0)])
def test_sn_outside_the_training_is_flagged(shipped, field_psfs, end, factor):
    """The filter is matched to each star; the S/N of faint stars scatters by an eighth."""
    info, psf = shipped.info, field_psfs[:50]
    snr = factor * (info.snr_min if end == "LOW" else info.snr_max)
    level = np.sqrt(np.square(psf).sum(axis=(1, 2), keepdims=True)) / (snr * KAPPA)
    stars = observe(psf, level)
    flux = stars.flux[:, 0, 0]
    result = shipped.predict(stars.stamps, flux=flux, background=SKY, noise=SKY**0.5)
    assert has(result, StarFlag[f"SNR_{end}"]).mean() >= (0.95 if end == "LOW" else 1.0)


def test_a_star_beside_the_middle_is_moved_there(shipped, field_psfs):
    frames = np.zeros((64, 22, 22))
    frames[:, 3:19, 3:19] = field_psfs[:64]
    shifted_px = np.roll(frames, (-2, 2), axis=(1, 2))
    stars = observe(np.stack([frames, shifted_px]).reshape(-1, 22, 22), 3e-4)
    result = shipped.predict(stars.stamps, margin=3)
    straight, shifted = result.shift_x[:64], result.shift_x[64:]
    assert (straight == 0).mean() > 0.98
    # Those that the jitter had moved the other way lie within it still.
    assert set(np.unique(shifted)) <= {0, 1, 2, 3}
    assert (shifted >= 2).mean() > 0.5
    is_moved = shifted != 0
    offset = np.stack([result.shift_y[64:], shifted], axis=1)
    error = result.psf[64:] - stars.flux * cut(shifted_px, 16, offset)
    assert rms(error[is_moved]) < 1.3 * rms(result.psf[:64] - stars.flux * cut(frames, 16))
    too_far = shipped.predict(stars.stamps[64:], margin=3).flags & int(StarFlag.OFF_CENTRE)
    assert (too_far > 0).mean() < 0.05


def test_what_is_no_single_star_of_this_telescope_is_flagged(shipped, field_psfs, clean):
    unlike_flags = StarFlag.UNLIKE_TRAINING | StarFlag.OUTLIER | StarFlag.OFF_CENTRE
    neighbour = np.zeros_like(field_psfs)
    neighbour[:, 6:, :-6] = field_psfs[:, :-6, 6:]
    doubles = shipped.predict(observe(field_psfs + neighbour, 3e-4).stamps)
    assert has(doubles, unlike_flags).mean() > 0.8
    spike = np.zeros((50, 16, 16))
    spike[:, 8, 8] = 1.0
    assert has(shipped.predict(observe(spike, 1e-3).stamps), unlike_flags).all()
    assert has(clean, unlike_flags).mean() < 0.02


def test_a_neighbour_does_not_make_a_star_unlike_the_training():
    """An image of the training itself has stars beside brighter ones; a turned one has others."""
    unlike, neighbour = StarFlag.UNLIKE_TRAINING, StarFlag.OFF_CENTRE
    flags = [0, unlike, unlike | neighbour, neighbour, unlike | StarFlag.OUTLIER | StarFlag.FAINT]
    is_unlike = find_unlike_stars(np.array([int(flag) for flag in flags], np.uint16))
    assert is_unlike.tolist() == [False, True, False, False, True]


def test_a_model_without_a_field_has_no_range_of_magnitudes(shipped):
    """As for every model whose PSF does not change with the magnitude: None, no error."""
    assert not shipped.method.knows_field
    assert shipped.magnitude_range is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stamps": np.zeros((3, 24, 24))}, "3×24×24.* n×16×16"),
        ({"margin": 2}, "n×20×20"),
        ({"stamps": np.zeros((3, 16, 16), complex)}, "complex128"),
        ({"saturated": np.zeros((2, 16, 16))}, r"saturated .*\(2, 16, 16\)"),
        ({"noise": "many"}, "noise"),
        ({"noise": -1.0}, "noise: expected numbers of at least 0"),
        ({"gain": 0.0}, "gain: expected numbers above 0"),
        ({"flux": np.ones(2)}, r"flux of shape \(2,\), expected one number, or .* 3 stamps"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_numbers(shipped, arguments, message):
    with pytest.raises(PredictionError, match=message):
        shipped.predict(**{"stamps": np.zeros((3, 16, 16)), **arguments})
