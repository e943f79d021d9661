"""The propagation kernel against physics and against independent codes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import j0, j1

from psfdae.optics.derivatives import (
    ImageSampling,
    ModalStamps,
    PeriodSampling,
    PointSampling,
)
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import Pupil, annular_pupil, pupil_axis
from psfdae.optics.wavefronts import monomial_coefficients, monomial_images

ARCSEC = np.pi / 180 / 3600
COMATIC = monomial_coefficients(np.array([0.5, 4.0, 4.196, 1.813, -0.113]), np.array([0.6, 0.4]))


def opd_of(coefficients, pupil):
    images = monomial_images(pupil.axis[None, :], pupil.axis[:, None])
    return np.tensordot(np.atleast_2d(coefficients), images, axes=1)


def flat(pupil):
    return np.zeros((1, pupil.axis.size, pupil.axis.size))


def brightness(pupil, opd, place):
    """Intensity at places (n, 2), (row, column) in λ/D: pixels so small that they sample it."""
    pixel = 1e-3
    kernel = StampPropagator(pupil, 1, pixel)
    parts = np.array_split(np.asarray(place) / pixel, max(1, len(place) // 8))
    light = [kernel(np.repeat(opd, len(part), axis=0), part)[:, 0, 0] for part in parts]
    return np.concatenate(light) / pixel**2


def test_pixel_scale_in_diffraction_units(scene1):
    assert scene1.telescope.pixel == pytest.approx(0.88148, rel=1e-5)


def test_airy_pattern_of_an_obscured_pupil_along_a_radius():
    e = 0.3
    pupil = annular_pupil(256, e)
    radius = 0.05 * np.arange(81)
    row = brightness(pupil, flat(pupil), np.stack([0 * radius, radius], axis=1))
    v = np.pi * radius[1:]
    amplitude = (2 * j1(v) / v - e**2 * 2 * j1(e * v) / (e * v)) / (1 - e**2)
    assert row[1:] / row[0] == pytest.approx(amplitude**2, abs=1e-6)


@pytest.mark.parametrize("samples", [96, 398])
@pytest.mark.parametrize("operator", [None, PointSampling, PeriodSampling])
def test_airy_encircled_energy(samples, operator):
    """Compare the dark rings, where pixels cannot blur the circle, on coarse and on fine grids."""
    pupil, side, pixel = annular_pupil(samples, 0.0), 140, 0.05
    if operator is None:
        image = StampPropagator(pupil, side, pixel)(flat(pupil))[0]
    else:
        sampling = operator(pupil, side, pixel, "complex128")
        modal = ModalStamps(pupil, monomial_images, sampling, pixel)
        image = modal.derivatives(0 * COMATIC[None], np.zeros((1, 0, 8)))[0][0]
    centre = (np.arange(side) - (side - 1) / 2) * pixel
    radius = np.hypot(centre[:, None], centre)
    for inside in (1.2197, 2.2331, 3.2383):
        expected = 1 - j0(np.pi * inside) ** 2 - j1(np.pi * inside) ** 2
        assert image[radius < inside].sum() == pytest.approx(expected, abs=5e-5)


@pytest.mark.parametrize("samples", [48, 144])
def test_derivatives_from_the_image_are_those_of_propagated_products(samples):
    pupil, pixel = annular_pupil(samples, 0.3), 0.88
    coefficients = np.stack([0.2 * COMATIC, -0.1 * COMATIC])
    (stamps, slopes), (same_stamps, from_image) = (
        ModalStamps(pupil, monomial_images, kind(pupil, 16, pixel, "complex64"), pixel).derivatives(
            coefficients, np.eye(8)[None]
        )
        for kind in (PointSampling, ImageSampling)
    )
    assert same_stamps == pytest.approx(stamps, abs=1e-6 * float(stamps.max()))
    error = np.linalg.norm((from_image - slopes).reshape(2, 8, -1), axis=2)
    assert (error < 3e-4 * np.linalg.norm(slopes.reshape(2, 8, -1), axis=2)).all()


@pytest.mark.parametrize("backend", ["numpy", "torch"])
def test_parseval_light_is_conserved(backend):
    pupil = annular_pupil(64, 0.3)
    period = 2 / pupil.spacing
    kernel = StampPropagator(pupil, 64, period / 64, extra=24, backend=backend)
    total = kernel(opd_of(0.3 * COMATIC, pupil)).sum() * pupil.amplitude.sum()
    assert total == pytest.approx((pupil.amplitude**2).sum(), rel=1e-10)


def test_offset_looks_at_that_place(pupil):
    opd = opd_of(0.2 * COMATIC, pupil)
    wide_stamp = StampPropagator(pupil, 32, 0.7, extra=24)(opd)[0]
    offset_stamp = StampPropagator(pupil, 8, 0.7, extra=24)(opd, np.array([[5, -3]]))[0]
    assert offset_stamp == pytest.approx(wide_stamp[12 + 5 : 20 + 5, 12 - 3 : 20 - 3], abs=1e-12)


@pytest.mark.parametrize("backend", ["numpy", "torch"])
def test_stamps_do_not_depend_on_the_batches_before(pupil, backend):
    """Scratch space is kept between batches of any size."""
    opd = opd_of(np.linspace(0.1, 0.5, 5)[:, None] * COMATIC, pupil)
    kernel = StampPropagator(pupil, 16, 0.88, backend=backend)
    alone = [kernel(waves[None])[0] for waves in opd]
    assert kernel(opd) == pytest.approx(np.array(alone), abs=1e-15)
    assert kernel(opd[3:4])[0].tobytes() == alone[3].tobytes()


def test_backends_and_precisions_agree(pupil):
    opd = opd_of(np.stack([0.2 * COMATIC, 0.4 * COMATIC]), pupil)
    offset = np.array([[3, -2], [0, 7]])
    exact = StampPropagator(pupil, 16, 0.88)(opd, offset)
    peak = exact.max(axis=(1, 2), keepdims=True)
    for backend in ("numpy", "torch"):
        for precision, tolerance in (("complex128", 1e-12), ("complex64", 2e-5)):
            kernel = StampPropagator(pupil, 16, 0.88, 6, precision, backend)
            assert np.abs((kernel(opd, offset) - exact) / peak).max() < tolerance


def autocorrelation_stamp(pupil, opd, stamp_px, pixel):
    """Pixel-integrated stamp by the optical transfer function: exact, and another route.

    The intensity is a trigonometric polynomial whose coefficients are the pupil's
    autocorrelation; integrating over a pixel multiplies them by sinc functions.
    """
    n = pupil.axis.size
    field = pupil.amplitude * np.exp(2j * np.pi * opd)
    spectrum = np.fft.fft2(field, (2 * n, 2 * n))
    lags = np.fft.fftfreq(2 * n, 1 / (2 * n)) * pupil.spacing / 2
    transfer = np.fft.ifft2(np.abs(spectrum) ** 2)
    window = np.sinc(lags * pixel)
    centre = (np.arange(stamp_px) - (stamp_px - 1) / 2) * pixel
    # Symmetric autocorrelation: the sign of the lag is that of the exponent.
    phase = np.exp(-2j * np.pi * np.outer(centre, lags)) * window
    image = (phase @ transfer @ phase.T).real
    return image * (pixel * pupil.spacing / 2) ** 2 / pupil.amplitude.sum()


@pytest.mark.parametrize("backend", ["numpy", "torch"])
@pytest.mark.parametrize(("samples", "side"), [(128, 16), (41, 7), (40, 1)])
def test_against_the_transfer_function_method(samples, side, backend):
    """Even and odd grids and stamps, whose middle sample or pixel is its own mirror."""
    pupil = annular_pupil(samples, 0.3)
    opd = opd_of(0.4 * COMATIC, pupil)[0]
    stamp = StampPropagator(pupil, side, 0.88, extra=24, backend=backend)(opd[None])[0]
    exact = autocorrelation_stamp(pupil, opd, side, 0.88)
    assert np.abs(stamp - exact).max() / exact.max() < 1e-12


def test_against_poppy():
    """poppy counts phase the other way, so its images are rotated by 180°."""
    import astropy.units as u
    import poppy

    samples, side, pixel = 128, 33, 0.05 * ARCSEC / 550e-9
    amplitude = annular_pupil(samples, 0.3, sharpen=False).amplitude[1:-1, 1:-1]
    pupil = Pupil(amplitude, pupil_axis(samples))
    opd = opd_of(0.2 * COMATIC, pupil)
    element = poppy.ArrayOpticalElement(
        transmission=amplitude,
        opd=opd[0] * 550e-9,
        pixelscale=(1.0 / samples) * u.m / u.pixel,
        name="pupil",
    )
    system = poppy.OpticalSystem(npix=samples, oversample=1, pupil_diameter=1.0 * u.m)
    system.add_pupil(element)
    system.add_detector(pixelscale=pixel * 550e-9 / ARCSEC, fov_pixels=side)
    rotated = system.calc_psf(wavelength=550e-9)[0].data[::-1, ::-1]
    places = np.random.default_rng(0).integers(8, side - 8, (60, 2))
    places[0] = np.unravel_index(rotated.argmax(), rotated.shape)
    profile = brightness(pupil, opd, (places - side // 2) * pixel)
    expected = rotated[tuple(places.T)]
    assert np.abs(profile / profile[0] - expected / expected[0]).max() < 1e-6


def test_pupil_without_symmetry_and_unknown_backend_are_refused(pupil):
    lopsided = pupil.amplitude.copy()
    lopsided[: len(lopsided) // 4] = 0.0
    with pytest.raises(ValueError, match="halves above and below"):
        StampPropagator(Pupil(lopsided, pupil.axis), 16, 0.88)
    with pytest.raises(ValueError, match=r"optics\.backend = 'jax'"):
        StampPropagator(pupil, 16, 0.88, backend="jax")
