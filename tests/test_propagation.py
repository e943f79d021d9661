"""The propagation kernel against physics and against independent codes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import j0, j1

from psfdae.optics.derivatives import ModalStamps, PeriodSampling, PointSampling
from psfdae.optics.propagation import StampPropagator, image_points
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
    found = [kernel(np.repeat(opd, len(part), axis=0), part)[:, 0, 0] for part in parts]
    return np.concatenate(found) / pixel**2


def test_pixel_scale_in_diffraction_units(scene1):
    assert scene1.telescope.pixel == pytest.approx(0.88148, rel=1e-5)


@pytest.mark.parametrize("obscuration", [0.0, 0.3])
def test_airy_pattern_along_a_radius(obscuration):
    pupil = annular_pupil(256, obscuration)
    radius = 0.05 * np.arange(81)
    row = brightness(pupil, flat(pupil), np.stack([0 * radius, radius], axis=1))
    v = np.pi * radius[1:]
    e = obscuration
    amplitude = (2 * j1(v) / v - e**2 * 2 * j1(e * v) / (e * v if e else 1)) / (1 - e**2)
    assert row[1:] / row[0] == pytest.approx(amplitude**2, abs=1e-6)


@pytest.mark.parametrize("samples", [96, 158, 398])
@pytest.mark.parametrize("operator", ["propagator", "points", "period"])
def test_airy_encircled_energy(samples, operator):
    """In the dark rings, where pixels cannot blur the circle, on coarse and on fine grids."""
    pupil, side, pixel = annular_pupil(samples, 0.0), 140, 0.05
    if operator == "propagator":
        image = StampPropagator(pupil, side, pixel)(flat(pupil))[0]
    else:
        sampling = (
            PointSampling(pupil, side, pixel, "complex128")
            if operator == "points"
            else PeriodSampling(pupil, side, pixel, "complex128")
        )
        image = ModalStamps(pupil, monomial_images, sampling, pixel).stamps(0 * COMATIC[None])[0]
    centre = (np.arange(side) - (side - 1) / 2) * pixel
    radius = np.hypot(centre[:, None], centre)
    for inside in (1.2197, 2.2331, 3.2383):
        expected = 1 - j0(np.pi * inside) ** 2 - j1(np.pi * inside) ** 2
        assert image[radius < inside].sum() == pytest.approx(expected, abs=5e-5)


@pytest.mark.parametrize("backend", ["numpy", "torch"])
def test_parseval_light_is_conserved(backend):
    pupil = annular_pupil(64, 0.3)
    period = 2 / pupil.spacing
    kernel = StampPropagator(pupil, 64, period / 64, extra=24, backend=backend)
    total = kernel(opd_of(0.3 * COMATIC, pupil)).sum() * pupil.amplitude.sum()
    assert total == pytest.approx((pupil.amplitude**2).sum(), rel=1e-10)


@pytest.mark.parametrize("tilt", [0.8, -1.7])
def test_tilt_moves_the_image_along_its_own_sign(tilt):
    pupil = annular_pupil(64, 0.2)
    opd = tilt * np.broadcast_to(pupil.axis[None, :], (1, 66, 66))
    kernel = StampPropagator(pupil, 65, 0.2)
    image = kernel(opd)[0]
    row, column = np.unravel_index(image.argmax(), image.shape)
    assert row == 32
    assert (column - 32) * 0.2 == pytest.approx(2 * tilt, abs=0.11)


def test_offset_looks_at_that_place(pupil):
    opd = opd_of(0.2 * COMATIC, pupil)
    wide = StampPropagator(pupil, 32, 0.7, extra=24)(opd)[0]
    moved = StampPropagator(pupil, 8, 0.7, extra=24)(opd, np.array([[5, -3]]))[0]
    assert moved == pytest.approx(wide[12 + 5 : 20 + 5, 12 - 3 : 20 - 3], abs=1e-12)


@pytest.mark.parametrize(
    ("side", "pixel"), [(1, 1e-3), (1, 7.3), (2, 0.05), (7, 0.88), (16, 0.88), (24, 1.6), (64, 3.0)]
)
def test_points_integrate_every_wave_that_an_intensity_holds(pupil, side, pixel):
    """Up to the longest distance in the pupil; two more points gain about one digit."""
    centres = (np.arange(side // 2, side) - 0.5 * (side - 1)) * pixel
    wave = 2 * np.pi * np.linspace(0, 0.5 * (pupil.axis.size - 1) * pupil.spacing, 997)[:, None]
    width = pixel * np.sinc(wave / (2 * np.pi) * pixel)
    errors = []
    for extra in (6, 8, 12):
        points, even, odd = image_points(pupil, side, pixel, extra)
        assert len(points) <= 0.5 * (4.1 * 0.5 * side * pixel + extra) + 1
        assert (np.diff(points) > 0).all()
        assert 0 < points[0] < points[-1] < 0.5 * side * pixel
        off = [
            part(wave * points) @ weights - part(wave * centres) * width
            for part, weights in ((np.cos, even), (np.sin, odd))
        ]
        errors.append(np.sqrt(np.mean(np.square(off))) / pixel)
    assert errors[0] < 5e-4
    assert errors[1] < 1e-4
    assert errors[2] < 3e-6


@pytest.mark.parametrize("backend", ["numpy", "torch"])
@pytest.mark.parametrize(("samples", "side"), [(40, 12), (41, 12), (40, 7), (41, 7), (40, 1)])
def test_halves_add_up_to_the_plain_sum(samples, side, backend):
    """Even and odd grids and stamps, whose middle sample or pixel is its own mirror."""
    pupil = annular_pupil(samples, 0.3)
    size = pupil.axis.size
    opd = np.random.default_rng(3).normal(size=(2, size, size))
    offset = np.array([[0, 0], [3, -2]])
    sampling, plain = PointSampling(pupil, side, 0.88, "complex128"), []
    half = image_points(pupil, side, 0.88)[0]
    points = np.concatenate([-half[::-1], half])
    for wavefront, (row, column) in zip(opd, 0.88 * offset, strict=True):
        field = pupil.amplitude * np.exp(2j * np.pi * wavefront)
        down, along = (
            np.exp(-1j * np.pi * np.outer(points + at, pupil.axis)) for at in (row, column)
        )
        plain.append(sampling.pixels @ np.abs(down @ field @ along.T) ** 2 @ sampling.pixels.T)
    total = (2 / pupil.spacing) ** 2 * pupil.amplitude.sum()
    found = StampPropagator(pupil, side, 0.88, backend=backend)(opd, offset)
    assert found == pytest.approx(np.array(plain) / total, rel=1e-10, abs=1e-15)


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


def test_against_the_transfer_function_method(pupil):
    opd = opd_of(0.4 * COMATIC, pupil)[0]
    ours = StampPropagator(pupil, 16, 0.88, extra=24)(opd[None])[0]
    exact = autocorrelation_stamp(pupil, opd, 16, 0.88)
    assert np.abs(ours - exact).max() / exact.max() < 1e-12


def poppy_fraunhofer(element, samples, pixel, side):
    import astropy.units as u
    import poppy

    system = poppy.OpticalSystem(npix=samples, oversample=1, pupil_diameter=1.0 * u.m)
    system.add_pupil(element)
    system.add_detector(pixelscale=pixel * 550e-9 / ARCSEC, fov_pixels=side)
    return system.calc_psf(wavelength=550e-9)[0].data


def poppy_fresnel(element, samples, pixel, side):
    """Full Fresnel propagation to the focus of a lens, which buys nothing in focus."""
    import astropy.units as u
    import poppy

    focal = 10.0 * u.m
    wave = poppy.FresnelWavefront(0.5 * u.m, wavelength=550e-9, npix=samples, oversample=4)
    wave *= element
    wave *= poppy.QuadraticLens(focal)
    wave.propagate_fresnel(focal)
    middle = slice((wave.intensity.shape[0] - side + 1) // 2, None)
    return wave.intensity[middle, middle][:side, :side]


@pytest.mark.parametrize(
    ("propagate", "pixel"), [(poppy_fraunhofer, 0.05 * ARCSEC / 550e-9), (poppy_fresnel, 0.25)]
)
def test_against_poppy(propagate, pixel):
    """poppy counts phase the other way, so its images are rotated by 180°."""
    import astropy.units as u
    import poppy

    samples, side = 128, 33
    amplitude = annular_pupil(samples, 0.3, sharpen=False).amplitude[1:-1, 1:-1]
    pupil = Pupil(amplitude, pupil_axis(samples))
    opd = opd_of(0.2 * COMATIC, pupil)
    element = poppy.ArrayOpticalElement(
        transmission=amplitude,
        opd=opd[0] * 550e-9,
        pixelscale=(1.0 / samples) * u.m / u.pixel,
        name="pupil",
    )
    rotated = propagate(element, samples, pixel, side)[::-1, ::-1]
    seen = np.random.default_rng(0).integers(8, side - 8, (60, 2))
    seen[0] = np.unravel_index(rotated.argmax(), rotated.shape)
    ours = brightness(pupil, opd, (seen - side // 2) * pixel)
    theirs = rotated[tuple(seen.T)]
    assert np.abs(ours / ours[0] - theirs / theirs[0]).max() < 1e-6


def test_unknown_backend_is_named(pupil):
    with pytest.raises(ValueError, match=r"optics\.backend = 'jax'"):
        StampPropagator(pupil, 16, 0.88, backend="jax")


def test_pupil_without_symmetry_is_refused(pupil):
    lopsided = pupil.amplitude.copy()
    lopsided[: len(lopsided) // 4] = 0.0
    with pytest.raises(ValueError, match="halves above and below the chief ray differ"):
        StampPropagator(Pupil(lopsided, pupil.axis), 16, 0.88)
