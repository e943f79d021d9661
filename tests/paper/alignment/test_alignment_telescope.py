"""The telescope of scene 3 by ray tracing: signs, symmetries, refusals, batoid's own results."""

from __future__ import annotations

import numpy as np
import pytest

from psfdae.base.settings import ConfigError
from psfdae.optics.wavefronts import zernike_images
from psfdae.telescope.raytracing import (
    RayTracingError,
    annulus_points,
    build_optic,
    misalign,
)
from psfdae_paper.alignment.telescope import (
    DEGREES_OF_FREEDOM,
    ModelError,
    StateTracer,
    design_states,
    field_points,
    fit_quadratic,
    uniform_states,
    verify,
)
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.compose import load

ARCSEC = np.pi / 180 / 3600


@pytest.fixture(scope="module")
def fields_deg(tracer):
    return np.rad2deg(tracer.field_rad)


def test_focal_ratio_and_spots_of_the_prescription(scene3, tracer):
    from batoid.analysis import drdth, spot

    optic = build_optic(scene3.prescription, scene3.telescope)
    wavelength = scene3.telescope.wavelength_m
    focal = drdth(optic, 0.0, 0.0, wavelength)[0, 0]
    assert focal / scene3.telescope.diameter_m == pytest.approx(5.99, abs=0.005)
    for field in tracer.field_rad:
        x, y = spot(optic, *field, wavelength, nx=32, reference="mean")
        assert np.sqrt(x.var() + y.var()) / focal < 0.05 * ARCSEC


def test_aligned_telescope_is_round_and_out_of_focus(tracer):
    centre = tracer(np.zeros((1, 4)))[0, 0]
    round_terms = np.isin(np.arange(4, 23), [4, 11, 22])
    assert np.abs(centre[~round_terms]).max() < 1e-8
    assert centre[0] == pytest.approx(0.32, abs=0.01)  # the CCD is beyond focus


def linear_response(tracer, name):
    """Change of the coefficients per unit of the range, shape (F, 23), Noll index as column."""
    step = 0.1 * np.eye(4)[DEGREES_OF_FREEDOM.index(name)]
    plus, minus = tracer(np.stack([step, -step]))
    return np.pad((plus - minus) / 0.2, ((0, 0), (4, 0)))


# Noll index: (constant, per degree of f_x, per degree of f_y), waves RMS for 1 mm and 0.1°.
SENSITIVITIES = {
    "decenter_x": {8: (-0.446, 0, 0), 7: (0, 0, 0), 4: (0, -0.212, 0)},
    "decenter_y": {7: (-0.446, 0, 0), 8: (0, 0, 0), 4: (0, 0, -0.212)},
    "tilt_x": {7: (0.650, 0, 0), 4: (0, 0, -0.560), 6: (0, 0, 1.604), 5: (0, -1.60, 0)},
    "tilt_y": {8: (-0.650, 0, 0), 4: (0, 0.560, 0), 6: (0, 1.604, 0), 5: (0, 0, 1.60)},
}


@pytest.mark.parametrize("name", DEGREES_OF_FREEDOM)
def test_signs_and_sizes_of_the_four_degrees_of_freedom(tracer, fields_deg, name):
    response = linear_response(tracer, name)
    for noll, (constant, per_x, per_y) in SENSITIVITIES[name].items():
        expected = constant + fields_deg @ [per_x, per_y]
        assert response[:, noll] == pytest.approx(expected, abs=0.006), noll


def test_batoid_s_own_zernike_fit(tracer):
    """Zernikes are those of a fine square grid; ours needs 96 rays of the annulus."""
    from batoid import zernike

    state = np.array([0.7, -1.0, 0.4, 0.9])
    optic = misalign(tracer.optic, state * tracer.misalignment_range)
    zernikes = tracer(state[None])[0]
    for field in (0, 3, 6):
        expected = zernike(
            optic, *tracer.field_rad[field], 6e-7, nx=96, reference="mean", jmax=22, eps=0.0
        )
        assert zernikes[field] == pytest.approx(expected[4:], abs=2e-6)


def test_weights_of_the_annulus_integrate_zernike_products():
    """Means of Z_j² over the annulus agree with a fine midpoint sum."""
    x, y, weights = annulus_points(22, 0.42)
    noll = range(1, 23)
    basis = zernike_images(noll, x, y)
    radius = np.sqrt(0.42**2 + (1 - 0.42**2) * (np.arange(400) + 0.5) / 400)
    angle = 2 * np.pi * np.arange(64) / 64
    fine = zernike_images(noll, np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)))
    assert weights.sum() == pytest.approx(1, abs=1e-12)
    assert (basis**2) @ weights == pytest.approx((fine**2).mean(axis=(1, 2)), rel=1e-3)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ([0, 0, 1.2, 0], r"state 1: tilt_x = 1\.2 of the range \(0\.12°\)"),
        ([0, 0, 0, np.nan], r"state 1: tilt_y = nan"),
    ],
)
def test_state_outside_the_range_is_refused(tracer, state, message):
    ends = np.ones(4) * (1 + 1e-12)
    assert tracer(ends[None]).shape == (1, 9, 19)
    with pytest.raises(RayTracingError, match=message):
        tracer(np.array([ends, state]))


def test_vignetted_field_is_refused():
    config = load([*Alignment.choice, "alignment.field_radius_deg=0.7"])
    message = r"state 0, field \(0\.7, 0\)°: \d+ of 132 rays are vignetted; 8 of 9 fields are"
    with pytest.raises(RayTracingError, match=message):
        StateTracer(config.telescope, config.prescription, config.alignment)(np.zeros((1, 4)))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("prescription.lenses.l1.back_vertex_m=-0.48", r"prescription\.lenses\.l1: thickness"),
        ("~prescription.secondary.conic", r"prescription\.secondary\.conic: missing"),
        ("alignment.stamp_px=15", r"alignment\.stamp_px = 15: .*multiple of 2"),
        ("optics.pupil_samples=[158,126]", r"pupil_samples: \[158, 126\] must be ascending"),
        ("cnn.kernels=[3,3,4,3,3]", r"cnn: kernels = .* must be odd"),
    ],
)
def test_wrong_configuration_is_named(override, message):
    with pytest.raises(ConfigError, match=message):
        load([*Alignment.choice, override])


def test_nine_fields_are_the_centre_and_a_circle():
    degrees = np.rad2deg(field_points(0.5, 8))
    assert degrees[0] == pytest.approx([0, 0])
    assert degrees[1] == pytest.approx([0.5, 0])
    assert degrees[3] == pytest.approx([0, 0.5])
    assert np.hypot(*degrees[1:].T) == pytest.approx(0.5)


def test_quadratic_model_reproduces_ray_tracing(model, grid, tracer):
    """25 states of the fit, 600 others of the grid, uniform ones: 5e-4 waves RMS at most."""
    states, zernikes = grid
    assert states.shape == (625, 4)
    assert verify(model, states, zernikes, 5e-4).shape == (625, 9)
    uniform = uniform_states(100, np.random.default_rng(1))
    residual = verify(model, uniform, tracer(uniform), 5e-4)
    assert np.sqrt((residual**2).mean()) < 2e-4


def test_a_model_of_too_few_terms_or_states_is_refused(model, tracer):
    states = design_states()[:9]
    zernikes = tracer(states)
    coefficients = model.coefficients.copy()
    coefficients[:, 5:] = 0
    with pytest.raises(ModelError, match=r"0\.\d+ waves RMS .*\(at most 0\.0005\)"):
        verify(type(model)(coefficients), states, zernikes, 5e-4)
    with pytest.raises(ModelError, match=r"9 states determine 9 of the 15"):
        fit_quadratic(states, zernikes)


def test_jacobian_of_the_model_is_that_of_the_rays(model, tracer):
    states = uniform_states(3, np.random.default_rng(2)) * 0.9
    jacobian = model.jacobian(states)
    assert jacobian.shape == (3, 9, 4, 19)
    for axis, step in enumerate(0.05 * np.eye(4)):
        plus, minus = (tracer(states + s * step) for s in (1, -1))
        assert jacobian[:, :, axis] == pytest.approx((plus - minus) / 0.1, abs=1e-3)
