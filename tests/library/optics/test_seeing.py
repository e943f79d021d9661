"""Seeing of a telescope of one's own: its profiles, and blurred stamps against convolutions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.signal import fftconvolve
from scipy.special import j0

from psfdae.base.settings import ConfigError
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import SamplingError, annular_pupil
from psfdae.optics.seeing import BlurredPropagator, Profile
from psfdae.optics.wavefronts import zernike_images
from psfdae_paper.configuration.compose import load
from psfdae_paper.stars.framing import Propagation
from psfdae_paper.stars.scenes import template_wavefronts

OWN_TELESCOPE = "dataset=_telescope"
PROFILES = [Profile(4.0), Profile(4.0, 2.5), Profile(4.0, 4.765)]


@pytest.fixture(scope="module")
def obscured():
    return annular_pupil(126, 0.3)


@pytest.fixture(scope="module")
def opd(obscured):
    """Half a wave of coma along x and of astigmatism, one wavefront."""
    terms = zernike_images((6, 8), obscured.axis[None, :], obscured.axis[:, None])
    return (0.5 * terms[0] + 0.5 * terms[1])[None]


def brightness(profile, r):
    """Light per (λ/D)² at r, of sum 1; written down again from the definitions."""
    if profile.beta is None:
        return np.exp2(-((2 * r / profile.fwhm) ** 2)) * 4 * np.log(2) / np.pi / profile.fwhm**2
    a = profile.fwhm / (2 * np.sqrt(2 ** (1 / profile.beta) - 1))
    return (profile.beta - 1) / (np.pi * a**2) * (1 + (r / a) ** 2) ** -profile.beta


@pytest.mark.parametrize("profile", PROFILES)
def test_transfer_function_is_the_profile_s_transform(profile):
    assert brightness(profile, 2.0) == pytest.approx(0.5 * brightness(profile, 0.0))
    wing = brightness(profile, profile.reach) / brightness(profile, 0.0)
    assert wing == pytest.approx(Profile.negligible_wing, rel=1e-6)

    def transform(f):
        def ring(r):
            return 2 * np.pi * r * brightness(profile, r) * j0(2 * np.pi * f * r)

        return sum(quad(ring, r, r + 10, limit=200)[0] for r in range(0, 1000, 10))

    frequency = np.array([0.0, 0.02, 0.1, 0.3])
    expected = [transform(f) for f in frequency]
    assert profile.transfer(frequency) == pytest.approx(expected, abs=2e-6)


def test_without_blur_stamps_are_the_same(obscured, opd):
    """Offsets in both axes, and an even and an odd stamp."""
    offset = np.array([[0.3, -1.2]])
    for side in (16, 5):
        plain = StampPropagator(obscured, side, 1.7, extra=24)(opd, offset)
        for precision, error in (("complex128", 1e-12), ("complex64", 3e-6)):
            sharp = BlurredPropagator(obscured, side, 1.7, Profile(1e-9), precision)
            assert np.abs(sharp(opd, offset) - plain).max() < error * plain.max()


@pytest.mark.parametrize("profile", PROFILES)
def test_blur_is_a_convolution(obscured, opd, profile):
    """Against the image on fine pixels, convolved with the profile and binned."""
    side, pixel, fine = 12, 1.5, 12
    step, wide_px = pixel / fine, 40
    image = StampPropagator(obscured, wide_px * fine, step)(opd)[0]
    place = step * np.arange(1 - wide_px * fine, wide_px * fine)
    kernel = brightness(profile, np.hypot(place[:, None], place)) * step**2
    blurred = fftconvolve(image, kernel, mode="same")
    binned = blurred.reshape(wide_px, fine, wide_px, fine).sum(axis=(1, 3))
    central = slice((wide_px - side) // 2, (wide_px + side) // 2)
    expected = binned[central, central]
    stamp = BlurredPropagator(obscured, side, pixel, profile)(opd)[0]
    assert np.abs(stamp - expected).max() < 2e-3 * expected.max()
    sharp = StampPropagator(obscured, side, pixel)(opd)[0]
    assert np.abs(sharp - expected).max() > 0.5 * expected.max()


def words_of(**seeing):
    """Overrides of a seeing of the example telescope."""
    return [
        OWN_TELESCOPE,
        "grid.points=3",
        *(f"++telescope.seeing.{k}={v}" for k, v in seeing.items()),
    ]


def propagation_of(config):
    source = template_wavefronts(config)
    framing_ = config.framing
    return Propagation(source, config.telescope, config.optics, framing_, framing_.search_px)


def test_seeing_of_the_configuration_is_in_arcsec():
    """0.3 m and 600 nm: λ/D = 0.4125″."""
    blur = load(words_of(kind="moffat", fwhm_arcsec=2, beta=3)).telescope.blur
    assert (blur.fwhm, blur.beta) == (pytest.approx(2 / 0.41253, rel=1e-4), 3)
    assert load(words_of(kind="gaussian", fwhm_arcsec=2)).telescope.blur == Profile(blur.fwhm)


def test_repeated_wings_do_not_reach_the_stamps():
    """The grid that is chosen, against one whose period is much longer."""
    config = load(words_of(kind="moffat", fwhm_arcsec=2, beta=2.5))
    propagation = propagation_of(config)
    assert propagation.samples.max() < 446
    longer = propagation_of(
        config.model_copy(
            update={"optics": config.optics.model_copy(update={"pupil_samples": [638]})}
        )
    )
    fields, offsets = np.array([0, 4]), np.zeros((2, 2))
    stamps, expected = (p.stamps(16, offsets, fields) for p in (propagation, longer))
    assert np.abs(stamps - expected).max() < 3 * Profile.negligible_wing * stamps.max()


def test_framed_stars_are_wider_and_as_bright():
    sharp, _ = propagation_of(load([OWN_TELESCOPE, "grid.points=3"])).frame(32)
    blurred, peak = propagation_of(load(words_of(kind="gaussian", fwhm_arcsec=3))).frame(32)
    assert (blurred.max(axis=(1, 2)) < 0.6 * sharp.max(axis=(1, 2))).all()
    assert blurred.sum(axis=(1, 2)) == pytest.approx(sharp.sum(axis=(1, 2)), abs=0.02)
    assert np.abs(peak).max() < 8


@pytest.mark.parametrize(
    ("seeing", "message"),
    [
        ({"kind": "airy", "fwhm_arcsec": 1}, r"^telescope\.seeing\.kind = 'airy'"),
        ({"kind": "gaussian"}, r"^telescope\.seeing\.fwhm_arcsec: missing"),
        ({"kind": "moffat", "fwhm_arcsec": 1, "beta": 1}, r"seeing\.beta = 1"),
        ({"kind": "gaussian", "fwhm_arcsec": 1, "beta": 3}, "must be absent for kind = gaussian"),
    ],
)
def test_every_mistake_is_named(seeing, message):
    with pytest.raises(ConfigError, match=message):
        load(words_of(**seeing))


def test_seeing_that_no_grid_holds_is_refused():
    with pytest.raises(SamplingError, match=r"^telescope\.seeing\.fwhm_arcsec = 200: .*N ≥ "):
        propagation_of(load(words_of(kind="gaussian", fwhm_arcsec=200)))
