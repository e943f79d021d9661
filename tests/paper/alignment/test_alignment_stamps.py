"""Stamps of scene 3 and their derivatives, against physics and against independent codes."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from psfdae.optics.derivatives import ModalStamps, PeriodSampling, PointSampling
from psfdae.optics.propagation import StampPropagator
from psfdae.optics.pupil import SamplingError, annular_pupil
from psfdae.telescope.raytracing import annulus_points, misalign
from psfdae_paper.alignment.stamps import (
    AlignmentStamps,
    EnergyError,
    centre_modes,
    mean_slope,
)
from psfdae_paper.alignment.telescope import uniform_states

OBSCURATION = 0.42
SHOWN = [((0, 0, 0, 0), 0), ((0.6, -0.3, 0.2, 0.8), 2), ((1, 1, 1, 1), 7)]
"""State and field of three stamps: aligned, astigmatic and comatic, a corner of the range."""


def shown_zernikes(tracer):
    return np.stack([tracer(np.array([s], float))[0, f] for s, f in SHOWN])


def test_mean_slope_of_zernikes_over_the_annulus():
    x, y, weights = annulus_points(36, OBSCURATION)
    modes = [centre_modes(22, OBSCURATION, x + h, y) for h in (1e-5, -1e-5)]
    assert ((modes[0] - modes[1]) / 2e-5) @ weights == pytest.approx(0, abs=1e-8)
    modes = [centre_modes(22, OBSCURATION, x, y + h) for h in (1e-5, -1e-5)]
    assert ((modes[0] - modes[1]) / 2e-5) @ weights == pytest.approx(0, abs=1e-8)
    # Z8 = √8 (3r³ − 2r) cosθ over the full disc: mean slope √8.
    assert mean_slope(8, 0.0) == pytest.approx((np.sqrt(8), 0.0))
    assert mean_slope(7, 0.0) == pytest.approx((0.0, np.sqrt(8)))
    assert mean_slope(9, OBSCURATION) == (0.0, 0.0)


def test_centroid_of_the_whole_image_is_in_the_stamp_s_centre(tracer, scene3):
    """The tolerance is a hundredth of a pixel over the image's period; a longer one is better."""
    zernikes, worst = shown_zernikes(tracer), []
    for samples in (126, 254):
        pupil = annular_pupil(samples, OBSCURATION)
        pixel = 2 / pupil.spacing / samples
        sampling = PeriodSampling(pupil, samples, pixel, "complex128")
        modes = partial(centre_modes, 22, OBSCURATION)
        images = ModalStamps(pupil, modes, sampling, pixel).stamps(zernikes)
        parseval = (pupil.amplitude**2).sum() / pupil.amplitude.sum()
        assert images.sum(axis=(1, 2)) == pytest.approx(parseval, abs=1e-12)
        position = (np.arange(samples) - 0.5 * (samples - 1)) * pixel / scene3.telescope.pixel
        centroids = [images.sum(axis=axis) @ position for axis in (1, 2)]
        worst.append(np.abs(centroids).max())
    assert worst[1] < 0.01
    assert worst[1] < 0.6 * worst[0]


def test_period_sampling_integrates_pixels_exactly(tracer, exact_operator, scene3):
    """The stamp propagator approaches it spectrally as its points increase."""
    zernikes = shown_zernikes(tracer)
    modal = exact_operator.propagation.operator(254)
    pupil = annular_pupil(254, OBSCURATION)
    stamps = modal.stamps(zernikes)
    errors = []
    for extra in (6, 12, 18):
        kernel = StampPropagator(pupil, 16, scene3.telescope.pixel, extra)
        errors.append(np.abs(kernel(modal.opd(zernikes)) - stamps).max() / stamps.max())
    assert errors[0] < 1e-3
    assert errors[1] < 1e-5
    assert errors[2] < 1e-7


@pytest.mark.parametrize("product_cost", [0.0, np.inf])
@pytest.mark.parametrize("kind", [PointSampling, PeriodSampling])
def test_derivatives_by_coefficients_are_differences(kind, product_cost):
    """Both ways are tested: products of polynomials, and each direction by itself."""
    pupil = annular_pupil(48, 0.3)
    sampling = kind(pupil, 8, 2.0, "complex128")
    sampling.product_cost = product_cost
    modal = ModalStamps(pupil, partial(centre_modes, 11, 0.3), sampling, 2.0)
    rng = np.random.default_rng(0)
    coefficients = 0.2 * rng.standard_normal((2, 8))
    stamps, slopes = modal.derivatives(coefficients, np.eye(8)[None])
    assert stamps == pytest.approx(modal.stamps(coefficients), abs=1e-14)
    for mode, step in enumerate(1e-5 * np.eye(8)):
        difference = modal.stamps(coefficients + step) - modal.stamps(coefficients - step)
        assert slopes[:, mode] == pytest.approx(difference / 2e-5, abs=1e-8)
    directions = rng.standard_normal((2, 3, 8))
    along = modal.derivatives(coefficients, directions)[1]
    assert along == pytest.approx(np.einsum("bkj,bjyx->bkyx", directions, slopes), abs=1e-12)


def test_derivatives_by_state_are_differences(model, exact_operator):
    states = uniform_states(1, np.random.default_rng(5))
    stamps, slopes = exact_operator.derivatives(model(states), model.jacobian(states))
    assert stamps == pytest.approx(exact_operator(model(states))[0], abs=1e-14)
    assert slopes.sum(axis=(3, 4)) == pytest.approx(0, abs=1e-12)
    for axis, step in enumerate(1e-4 * np.eye(4)):
        plus, minus = (exact_operator(model(states + s * step))[0] for s in (1, -1))
        assert slopes[:, :, axis] == pytest.approx((plus - minus) / 2e-4, abs=2e-6)


def test_every_stamp_of_the_range_holds_its_light(operator, grid):
    """Corners of the range, where the images are widest, have 0.99 at least."""
    states, zernikes = grid
    corners = (np.abs(states) == 1).all(axis=1)
    stamps, energy = operator(zernikes[corners])
    assert energy.min() >= 0.99
    assert stamps.sum(axis=(2, 3)) == pytest.approx(1, abs=1e-5)


def test_stamps_that_lose_light_or_alias_are_refused(scene3, model):
    corner = model(np.ones((1, 4)))
    small = scene3.alignment.model_copy(update={"stamp_px": 8, "least_energy": 0.9})
    telescope = scene3.telescope.model_copy(update={"pixel_scale_arcsec": 0.25})
    message = r"stamp \d+ holds 0\.\d+ of the light \(alignment\.least_energy = 0\.9\)"
    with pytest.raises(EnergyError, match=message):
        AlignmentStamps(telescope, scene3.optics, small)(corner)
    coarse = scene3.optics.model_copy(update={"pupil_samples": [64, 90]})
    with pytest.raises(SamplingError, match=r"pupil_samples = \[64, 90\]: wavefront \d+ needs N"):
        AlignmentStamps(scene3.telescope, coarse, scene3.alignment)(corner)


def test_chosen_grids_have_two_samples_per_wave_of_the_maps(operator, grid):
    """The slopes that choose N are those of the OPD maps that are propagated."""
    states, zernikes = grid
    steep = zernikes[(np.abs(states) == 1).all(axis=1)].reshape(-1, 19)
    samples = operator.propagation.samples(steep)
    for n in np.unique(samples):
        opd = operator.propagation.operator(int(n)).opd(steep[samples == n])
        lit = annular_pupil(int(n), OBSCURATION).amplitude > 0
        for axis, pairs in ((-1, lit[:, 1:] & lit[:, :-1]), (-2, lit[1:] & lit[:-1])):
            assert np.abs(np.diff(opd, axis=axis))[..., pairs].max() <= 0.5


def test_settings_stay_within_the_error_budget(operator, exact_operator, model, scene3):
    """1 % of the smallest noise variance; within about 1e-3 of the peak as well."""
    budget = 0.01 * (scene3.noise.kappa * min(scene3.noise.levels)) ** 2
    states = uniform_states(4, np.random.default_rng(7))
    (stamps, slopes), (truth, true_slopes) = (
        o.derivatives(model(states), model.jacobian(states)) for o in (operator, exact_operator)
    )
    assert stamps.dtype == slopes.dtype == np.float32
    assert ((stamps - truth) ** 2).mean(axis=(2, 3)).max() < budget
    assert (np.abs(stamps - truth) / truth.max(axis=(2, 3), keepdims=True)).max() < 2e-3
    assert slopes == pytest.approx(true_slopes, abs=5e-3 * np.abs(true_slopes).max())


def huygens_stamp(tracer, state, field, telescope, nodes=14, rays_across=160):
    """Sum over batoid's rays at points of the detector, a stamp by the local plate scale.

    The points lie on a grid of field angles, so the phases of a ray separate:
    the sum that batoid's huygensPSF forms point by point becomes two products.
    """
    import batoid
    from batoid.analysis import drdth

    optic = misalign(tracer.optic, np.array(state) * tracer.misalignment_range)
    theta, wavelength = tracer.field_rad[field], telescope.wavelength_m
    rays = batoid.RayVector.asGrid(
        optic=optic, wavelength=wavelength, theta_x=theta[0], theta_y=theta[1], nx=rays_across
    )
    optic.trace(rays)
    lit = ~rays.vignetted
    centre = rays.r[lit].mean(axis=0)
    start = rays.amplitude(centre, rays.t[0])[lit]
    scale = drdth(optic, *theta, wavelength)
    pixel = np.deg2rad(telescope.pixel_scale_arcsec / 3600)
    inside, weights = 0.5 * pixel * np.array(np.polynomial.legendre.leggauss(nodes))
    angle = ((np.arange(16) - 7.5)[:, None] * pixel + inside).ravel()
    wave_x, wave_y = (np.exp(1j * np.outer(angle, k)) for k in (rays.k[lit][:, :2] @ scale).T)
    intensity = np.abs((wave_y * start) @ wave_x.T) ** 2
    points = centre + np.pad(scale @ [angle[70], angle[90]], (0, 1))
    assert intensity[90, 70] == pytest.approx(
        np.abs(rays[lit].sumAmplitude(points, rays.t[0])) ** 2, rel=1e-3
    )
    weighted = intensity * np.outer(*[np.tile(weights, 16)] * 2)
    stamp = weighted.reshape(16, nodes, 16, nodes).sum(axis=(1, 3))
    return stamp / stamp.sum()


def test_against_batoid_s_huygens_psf(tracer, operator, scene3):
    """No pupil, no Zernikes, no Fourier transform: rays alone; 2 % of the peak at most."""
    stamps = operator(shown_zernikes(tracer))[0]
    for stamp, (state, field) in zip(stamps, SHOWN, strict=True):
        expected = huygens_stamp(tracer, state, field, scene3.telescope)
        assert np.abs(stamp - expected).max() < 0.02 * stamp.max(), (state, field)
