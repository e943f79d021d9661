"""Von Kármán turbulence and the wavefronts of scene 2."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import jv

from psfdae.optics.pupil import SamplingError, annular_pupil, pupil_axis
from psfdae.optics.wavefronts import zernike_basis
from psfdae.rng import stream
from psfdae.settings import ConfigError
from psfdae_paper.configuration.compose import load
from psfdae_paper.stars.fields import square_grid
from psfdae_paper.stars.scenes import TurbulenceScene
from psfdae_paper.stars.turbulence import (
    SPECTRUM,
    STRENGTH,
    Footprints,
    draw_waves,
    fitted_planes,
    layer_r0,
    structure_function,
)

R0, L0, HEIGHTS, STRENGTHS = 0.2, 25.0, (0.0, 4000.0, 10000.0), (0.6, 0.25, 0.15)
FLOAT64 = np.dtype(np.float64)


def scene(points=20, **changes):
    """Wavefronts of scene 2; `changes` go to the group `wavefront`."""
    wavefront = {
        "kind": "von_karman",
        "seed": 7,
        "r0_m": R0,
        "outer_scale_m": L0,
        "layer_heights_m": list(HEIGHTS),
        "layer_strengths": list(STRENGTHS),
        "waves": 512,
        "remove_tilt": True,
    }
    return TurbulenceScene(
        SimpleNamespace(points=points, spacing_deg=14 / 60 / 19),
        SimpleNamespace(diameter_m=1.0, obscuration=0.0),
        SimpleNamespace(**(wavefront | changes)),
    ).templates()


def waves(seed, r0=R0, highest=60.0):
    return draw_waves(512, r0, L0, highest, stream(seed, "test"))


def phase_of(waves, position):
    """The plain sum of plane waves in radians at positions (..., 2) in metres."""
    argument = 2 * np.pi * position @ waves.frequency.T
    return np.cos(argument) @ waves.amplitude.real - np.sin(argument) @ waves.amplitude.imag


def disc(axis):
    """Coordinates of the samples inside the unit disc and the mask of them."""
    x, y = np.meshgrid(axis, axis)
    lit = x**2 + y**2 <= 1.0
    return x[lit], y[lit], lit


# --- theory ---------------------------------------------------------------------------


def test_von_karman_relative_to_kolmogorov():
    separation = np.array([0.005, 1.0])
    kolmogorov = 6.88 * (separation / R0) ** (5 / 3)
    ratio = structure_function(separation, R0, L0) / kolmogorov
    assert ratio == pytest.approx([0.91, 0.50], abs=0.005)


def test_limits_of_the_structure_function():
    assert structure_function(np.array([0.0]), R0, L0) == 0
    constants = np.array([2 * STRENGTH, SPECTRUM])
    assert constants == pytest.approx([6.88, 0.0229], rel=2e-3)
    # The approach to Kolmogorov's law is slow: 1 − 1.485 (r/L0)^(1/3).
    slow = 1 - 1.485 * (0.2 / 1e6) ** (1 / 3)
    assert structure_function(0.2, R0, 1e6) == pytest.approx(6.88 * slow, rel=1e-3)
    variance = 2 * np.pi * SPECTRUM * 0.6 * (L0 / R0) ** (5 / 3)
    assert structure_function(20 * L0, R0, L0) == pytest.approx(2 * variance, rel=1e-6)


def test_structure_function_is_the_transform_of_the_spectrum():
    f = np.geomspace(1e-5, 1e4, 400_001)
    spectrum = SPECTRUM * R0 ** (-5 / 3) * (f**2 + 1 / L0**2) ** (-11 / 6)
    for r in (0.03, 1.0):
        integrand = 4 * np.pi * f**2 * spectrum * (1 - jv(0, 2 * np.pi * f * r))
        expected = np.trapezoid(integrand, np.log(f))
        assert structure_function(r, R0, L0) == pytest.approx(expected, rel=1e-3)


def test_layers_add_up_to_r0():
    separation = np.array([0.03, 0.3, 3.0])
    layers = [structure_function(separation, r0, L0) for r0 in layer_r0(R0, STRENGTHS)]
    assert sum(layers) == pytest.approx(structure_function(separation, R0, L0), rel=1e-12)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("layer_strengths=[0.6,0.25,0.1]", "must add up to 1"),
        ("layer_heights_m=[0,4000]", "one for each of the 2 layer_heights_m"),
    ],
)
def test_layers_that_do_not_fit_are_named(override, message):
    with pytest.raises(ConfigError, match=message):
        load(["dataset=dataset7", f"wavefront.{override}"])


@pytest.mark.parametrize("count", [8, 100])
def test_incomplete_rings_are_an_error(count):
    with pytest.raises(ValueError, match="multiple of 8"):
        draw_waves(count, R0, L0, 60.0, stream(1, "test"))


def test_a_highest_frequency_inside_the_innermost_disc_is_an_error():
    with pytest.raises(ValueError, match="must exceed"):
        draw_waves(64, R0, L0, 0.01, stream(1, "test"))


# --- ensemble -------------------------------------------------------------------------


def test_ensemble_structure_function():
    """Full von Kármán law, two-sided; the statistical error is below 1 %."""
    separation = np.array([0.03, 0.1, 0.3, 1.0])
    start = 7.0 * np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 1, 2)
    along_x, along_y = (np.multiply.outer(separation, unit) for unit in np.eye(2))
    points = np.concatenate([np.zeros((1, 2)), along_x, along_y])
    squares = []
    for seed in range(1000):
        phase = phase_of(waves(seed), start + points)
        squares.append(((phase[:, 1:] - phase[:, :1]) ** 2).mean(axis=0).reshape(2, -1))
    ratio = np.array(squares) / structure_function(separation, R0, L0)
    assert ratio.mean(axis=(0, 1)) == pytest.approx(np.ones(4), abs=0.05)
    error = ratio.mean(axis=1).std(axis=0) / np.sqrt(len(ratio))
    assert (error < 0.01).all()
    # Isotropy: along x as along y.
    assert ratio.mean(axis=0) == pytest.approx(np.ones((2, 4)), abs=0.06)


def expected_zernike_variance(n, outer_scale, d_over_r0):
    """Variance of a Zernike coefficient of order n ≥ 1 from its spectrum (Noll 1976)."""
    f = np.geomspace(1e-5, 1e3, 200_001)  # cycles per diameter
    spectrum = SPECTRUM * d_over_r0 ** (5 / 3) * (f**2 + 1 / outer_scale**2) ** (-11 / 6)
    filtered = (n + 1) * (2 * jv(n + 1, np.pi * f) / (np.pi * f)) ** 2
    return np.trapezoid(2 * np.pi * f**2 * spectrum * filtered, np.log(f))


def test_ensemble_zernike_variances():
    """Tilts 0.517 and n = 2 terms 0.986 of Noll's Kolmogorov variances at D = 1 m.

    Sasiela's series for the tilts, 1 − 1.42 (D/L0)^(1/3) + 3.70 (D/L0)², gives 0.520.
    """
    noll = np.array([0.449, 0.0232]) * 5 ** (5 / 3)
    target = np.array([expected_zernike_variance(n, L0, 5.0) for n in (1, 2)])
    assert target / noll == pytest.approx([0.517, 0.986], abs=0.002)

    axis = pupil_axis(32)
    x, y, lit = disc(axis)
    fit = np.linalg.pinv(zernike_basis(15, x, y).T)
    directions = 10.0 * np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2)
    squares = []
    for seed in range(1000):
        # At height 1 a direction is a position: sixteen footprints 10 m apart.
        layer = waves(seed, highest=15.0)
        footprints = Footprints([layer], [1.0], directions, 1.0, remove="piston")
        opd = footprints.opd(np.arange(16), axis, np.dtype(np.float32))
        coefficients = 2 * np.pi * opd[:, lit] @ fit.T
        squares.append((coefficients[:, 1:6] ** 2).mean(axis=0))
    variance = np.mean(squares, axis=0)
    assert variance[:2] == pytest.approx(np.full(2, target[0]), rel=0.05)
    assert variance[2:] == pytest.approx(np.full(3, target[1]), rel=0.05)


def test_difference_between_directions_grows_as_their_footprints_part():
    """⟨(φ_1 − φ_2)²⟩ in the pupil's centre is Σ D_l(h_l θ); the ground layer drops out."""
    angle = np.array([0.0, 1e-5, 1e-4, 1e-3])
    directions = np.stack([angle, np.zeros(4)], axis=1)
    layers = layer_r0(R0, STRENGTHS)
    squares = []
    for seed in range(1500):
        drawn = [draw_waves(128, r0, L0, 60.0, stream(seed, "a", r0)) for r0 in layers]
        footprints = Footprints(drawn, HEIGHTS, directions, 1.0, remove="none")
        phase = 2 * np.pi * footprints.opd(np.arange(4), np.zeros(1), FLOAT64).ravel()
        squares.append((phase - phase[0]) ** 2)
    parts = [structure_function(h * angle, r0, L0) for h, r0 in zip(HEIGHTS, layers, strict=True)]
    mean, error = np.mean(squares, axis=0), np.std(squares, axis=0) / np.sqrt(len(squares))
    assert mean[0] == 0
    assert (np.abs(mean - sum(parts))[1:] < 4 * error[1:]).all()
    assert (error[1:] < 0.05 * mean[1:]).all()
    assert (np.diff(mean) > 0).all()


# --- footprints -----------------------------------------------------------------------


def test_footprints_equal_the_plain_sum_of_waves():
    layers = [waves(seed) for seed in range(3)]
    directions = np.deg2rad(square_grid(3, 0.05)[1])
    axis = pupil_axis(16)
    footprints = Footprints(layers, HEIGHTS, directions, 1.2, remove="none")
    position = 0.6 * np.stack(np.meshgrid(axis, axis), axis=-1)
    for index in (0, 4, 5):
        phase = sum(
            phase_of(layer, position + height * directions[index])
            for layer, height in zip(layers, HEIGHTS, strict=True)
        )
        opd = footprints.opd(np.array([index]), axis, FLOAT64)[0]
        assert np.abs(opd - phase / (2 * np.pi)).max() < 1e-10


def test_a_layer_moves_over_the_pupil_as_height_times_angle():
    shift = 4 * 2 / 32  # four samples, in pupil radii
    directions = np.array([[0.0, 0.0], [shift * 0.5 / 1e4, 0.0]])
    opd = Footprints([waves(1)], [1e4], directions, 1.0, remove="none").opd(
        np.arange(2), pupil_axis(32), FLOAT64
    )
    assert np.abs(opd[1, :, :-4] - opd[0, :, 4:]).max() < 1e-9


def test_planes_in_closed_form_agree_with_a_fit():
    axis = pupil_axis(400)
    x, y, _ = disc(axis)
    lit = np.hypot(x, y) >= 0.4
    x, y = x[lit], y[lit]
    wavevector = np.array([[1e-9, 0.0], [0.3, -0.2], [2.0, 3.0], [-12.0, 5.0]])
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    fitted, *_ = np.linalg.lstsq(plane, np.exp(1j * np.stack([x, y], axis=1) @ wavevector.T))
    assert np.abs(fitted_planes(wavevector, 0.4) - fitted.T).max() < 2e-3


# --- scene ----------------------------------------------------------------------------


def test_tilt_is_removed_on_every_grid(pupil):
    source = scene(points=4)
    kept = scene(points=4, remove_tilt=False)
    for size in (pupil, annular_pupil(201, 0.0)):
        x, y, lit = disc(size.axis)
        plane = np.linalg.pinv(np.stack([np.ones_like(x), x, y], axis=1))
        opd = source.opd(np.arange(16), size, FLOAT64)
        tilt = opd[:, lit] @ plane.T
        # The disc's pixels are not quite the disc: 0.01 waves of its 0.2 RMS.
        assert np.abs(tilt).max() < 0.02
        full = kept.opd(np.arange(16), size, FLOAT64) - opd
        assert np.abs((full[:, lit] @ plane.T)[:, 1:]).max() > 0.3
        assert np.abs(full - full[:, :1] - full[:, :, :1] + full[:, :1, :1]).max() < 1e-10


def test_same_seed_same_bytes_and_another_seed_differs(pupil):
    index = np.arange(3)
    first, again, other = (scene(seed=seed).opd(index, pupil, FLOAT64) for seed in (7, 7, 8))
    assert first.tobytes() == again.tobytes()
    assert np.abs(first - other).max() > 0.1


def test_opd_scales_with_r0_and_nothing_else_changes(pupil):
    index = np.arange(3)
    coarse, fine = (scene(r0_m=r0).opd(index, pupil, FLOAT64) for r0 in (R0, R0 / 2))
    assert fine == pytest.approx(2 ** (5 / 6) * coarse, abs=1e-10)


def test_any_order_of_directions_and_single_precision(pupil):
    source = scene()
    index = np.array([399, 7, 7, 0, 210])
    opd = source.opd(index, pupil, np.dtype(np.float32))
    assert opd.shape == (5, 130, 130)
    assert opd.dtype == np.float32
    assert (opd[1] == opd[2]).all()
    exact = np.concatenate([source.opd(index[k : k + 1], pupil, FLOAT64) for k in range(5)])
    assert np.abs(opd - exact).max() < 1e-4


def test_residual_variance_over_the_scene(pupil):
    """Noll's 0.134 (D/r0)^(5/3) rad² without tilts, 0.985 of it with L0 = 25 m."""
    source = scene()
    _, _, lit = disc(pupil.axis)
    opd = source.opd(np.arange(0, 400, 7), pupil, np.dtype(np.float32))[:, lit]
    expected = 0.985 * 0.134 * 5 ** (5 / 3) / (2 * np.pi) ** 2
    # The ground layer is one footprint for all: a single draw of 0.6 of the strength.
    assert len(source) == 400
    assert opd.var(axis=1).mean() == pytest.approx(expected, rel=0.5)


@pytest.mark.parametrize("samples", [128, 320])
def test_slopes_bound_the_finite_differences(samples):
    source = scene(points=5)
    slopes = source.slopes()
    grid = annular_pupil(samples, 0.0, sharpen=False)
    _, _, lit = disc(grid.axis)
    opd = source.opd(np.arange(25), grid, FLOAT64) / grid.spacing
    for axis, step in ((0, np.diff(opd, axis=2)[:, :-1]), (1, np.diff(opd, axis=1)[:, :, :-1])):
        inside = step[:, (lit[:-1, :-1] & lit[1:, :-1] & lit[:-1, 1:])]
        assert (inside.min(axis=1) >= slopes[:, axis, 0]).all()
        assert (inside.max(axis=1) <= slopes[:, axis, 1]).all()
        # … and not by far: the guard must not ask for a needlessly fine grid.
        assert (slopes[:, axis, 1] <= 1.6 * inside.max(axis=1)).all()


def test_a_grid_that_would_alias_the_turbulence_is_refused():
    source = scene(points=2)
    with pytest.raises(SamplingError, match="N = 120"):
        source.opd(np.arange(1), annular_pupil(96, 0.0), FLOAT64)
