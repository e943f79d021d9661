"""Von Kármán turbulence and the wavefronts of scene 2."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import gamma, jv, kv

from psfdae.base.rng import stream
from psfdae.base.settings import ConfigError
from psfdae.optics.pupil import SamplingError, annular_pupil, pupil_axis
from psfdae.optics.wavefronts import zernike_images
from psfdae_paper.configuration.compose import load
from psfdae_paper.stars.fields import square_grid
from psfdae_paper.stars.scenes import template_wavefronts
from psfdae_paper.stars.turbulence import (
    SPECTRUM_FACTOR,
    Footprints,
    draw_waves,
    fit_planes,
    layer_r0,
)

R0, L0, HEIGHTS, STRENGTHS = 0.2, 25.0, (0.0, 4000.0, 10000.0), (0.6, 0.25, 0.15)
FLOAT64 = np.dtype(np.float64)
HALF_FRIED = (24.0 / 5.0 * gamma(6.0 / 5.0)) ** (5.0 / 6.0)
"""Half of the factor 6.88 of Kolmogorov's structure function."""


def scene(points=20, **changes):
    """Wavefronts of scene 2; `changes` go to the group `wavefront`."""
    words = [f"wavefront.{key}={value}" for key, value in {"seed": 7, **changes}.items()]
    return template_wavefronts(load(["dataset=dataset7", f"grid.points={points}", *words]))


def waves(seed, r0=R0, highest=60.0):
    return draw_waves(512, r0, L0, highest, stream(seed, "test"))


def phase_of(waves, position):
    """The plain sum of plane waves in radians at positions (..., 2) in metres."""
    argument = 2 * np.pi * position @ waves.frequency.T
    return np.cos(argument) @ waves.amplitude.real - np.sin(argument) @ waves.amplitude.imag


def structure_function(separation: np.ndarray, r0: float, outer_scale: float) -> np.ndarray:
    """Return the von Kármán phase structure function D(r) = ⟨[φ(x + r) − φ(x)]²⟩.

    Conan 2000 (thesis, Université de Nice); Lucke & Young 2007, Appl. Opt. 46, 559:
    with u = 2πr/L0,

        D = (L0/r0)^(5/3) 2^(1/6) Γ(11/6) π^(−8/3) [24/5 Γ(6/5)]^(5/6)
            × [Γ(5/6) 2^(−1/6) − u^(5/6) K_(5/6)(u)].

    The bracket cancels for small u: six digits are left at r = 2e-7 L0.

    Metres in, rad² at the wavelength at which r0 is given out.
    """
    u = 2.0 * np.pi * np.asarray(separation, float) / outer_scale
    # K_(5/6) is infinite at 0, where D = 0: any other argument avoids a warning.
    positive = np.where(u > 0, u, 1.0)
    bracket = gamma(5 / 6) / 2 ** (1 / 6) - positive ** (5 / 6) * kv(5 / 6, positive)
    scale = (outer_scale / r0) ** (5 / 3) * 2 ** (1 / 6) * gamma(11 / 6) / np.pi ** (8 / 3)
    return np.where(u > 0, scale * HALF_FRIED * bracket, 0.0)


def disc(axis):
    """Coordinates of the samples inside the unit disc and the mask of them."""
    x, y = np.meshgrid(axis, axis)
    lit = x**2 + y**2 <= 1.0
    return x[lit], y[lit], lit


# --- theory ---------------------------------------------------------------------------


def test_limits_of_the_structure_function():
    """Kolmogorov's law far below the outer scale, twice the variance far above it."""
    constants = np.array([2 * HALF_FRIED, SPECTRUM_FACTOR])
    assert constants == pytest.approx([6.88, 0.0229], rel=2e-3)
    separation = np.array([0.005, 1.0])
    ratio = structure_function(separation, R0, L0) / (6.88 * (separation / R0) ** (5 / 3))
    assert ratio == pytest.approx([0.91, 0.50], abs=0.005)
    # The approach to Kolmogorov's law is slow: 1 − 1.485 (r/L0)^(1/3).
    slow = 1 - 1.485 * (0.2 / 1e6) ** (1 / 3)
    assert structure_function(0.2, R0, 1e6) == pytest.approx(6.88 * slow, rel=1e-3)
    variance = 2 * np.pi * SPECTRUM_FACTOR * 0.6 * (L0 / R0) ** (5 / 3)
    ends = structure_function(np.array([0.0, 20 * L0]), R0, L0)
    assert ends == pytest.approx([0, 2 * variance], rel=1e-6)


def test_structure_function_is_the_transform_of_the_spectrum():
    f = np.geomspace(1e-5, 1e4, 400_001)
    spectrum = SPECTRUM_FACTOR * R0 ** (-5 / 3) * (f**2 + 1 / L0**2) ** (-11 / 6)
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


# --- ensemble -------------------------------------------------------------------------


def test_ensemble_structure_function():
    """Full von Kármán law, two-sided; the statistical error is below 2 %."""
    separation = np.array([0.03, 0.1, 0.3, 1.0])
    start = 7.0 * np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 1, 2)
    along_x, along_y = (np.multiply.outer(separation, unit) for unit in np.eye(2))
    points = np.concatenate([np.zeros((1, 2)), along_x, along_y])
    squares = []
    for seed in range(400):
        phase = phase_of(waves(seed), start + points)
        squares.append(((phase[:, 1:] - phase[:, :1]) ** 2).mean(axis=0).reshape(2, -1))
    ratio = np.array(squares) / structure_function(separation, R0, L0)
    error = ratio.mean(axis=1).std(axis=0) / np.sqrt(len(ratio))
    assert (error < 0.016).all()
    assert ratio.mean(axis=(0, 1)) == pytest.approx(np.ones(4), abs=0.05)
    # Isotropy: along x as along y.
    assert ratio.mean(axis=0) == pytest.approx(np.ones((2, 4)), abs=0.07)


def test_footprints_have_noll_s_variances():
    """Tilts 0.517 and n = 2 terms 0.986 of those of Kolmogorov's law, at D = 1 m, L0 = 25 m.

    Sasiela's series for the tilts, 1 − 1.42 (D/L0)^(1/3) + 3.70 (D/L0)², gives 0.520.
    """
    expected = 5 ** (5 / 3) * np.array([0.449 * 0.517] * 2 + [0.0232 * 0.986] * 3)
    axis = pupil_axis(32)
    x, y, lit = disc(axis)
    fit = np.linalg.pinv(zernike_images(range(1, 16), x, y).T)
    directions = 10.0 * np.stack(np.meshgrid(np.arange(4), np.arange(4)), axis=-1).reshape(-1, 2)
    squares = []
    for seed in range(300):
        # At height 1 a direction is a position: sixteen footprints 10 m apart.
        layer = waves(seed, highest=15.0)
        footprints = Footprints([layer], [1.0], directions, 1.0, remove="piston")
        opd = footprints.opd(np.arange(16), axis, np.dtype(np.float32))
        coefficients = 2 * np.pi * opd[:, lit] @ fit.T
        squares.append((coefficients[:, 1:6] ** 2).mean(axis=0))
    variance, error = np.mean(squares, axis=0), np.std(squares, axis=0) / np.sqrt(len(squares))
    assert (error < 0.03 * expected).all()
    # Four standard errors, and the rounding of the numbers above.
    assert (np.abs(variance - expected) < 4 * error + 0.003 * expected).all()


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


def test_planes_in_closed_form_agree_with_a_fit():
    axis = pupil_axis(400)
    x, y, _ = disc(axis)
    lit = np.hypot(x, y) >= 0.4
    x, y = x[lit], y[lit]
    wavevector = np.array([[1e-9, 0.0], [0.3, -0.2], [2.0, 3.0], [-12.0, 5.0]])
    plane = np.stack([np.ones_like(x), x, y], axis=1)
    fitted, *_ = np.linalg.lstsq(plane, np.exp(1j * np.stack([x, y], axis=1) @ wavevector.T))
    assert np.abs(fit_planes(wavevector, 0.4) - fitted.T).max() < 2e-3


# --- scene ----------------------------------------------------------------------------


def test_tilt_is_removed_on_every_grid(pupil):
    source = scene(points=4)
    tilted = scene(points=4, remove_tilt=False)
    for size in (pupil, annular_pupil(201, 0.0)):
        x, y, lit = disc(size.axis)
        plane = np.linalg.pinv(np.stack([np.ones_like(x), x, y], axis=1))
        opd = source.opd(np.arange(16), size, FLOAT64)
        tilt = opd[:, lit] @ plane.T
        # The disc's pixels are not quite the disc: 0.01 waves of its 0.2 RMS.
        assert np.abs(tilt).max() < 0.02
        full = tilted.opd(np.arange(16), size, FLOAT64) - opd
        assert np.abs((full[:, lit] @ plane.T)[:, 1:]).max() > 0.3
        assert np.abs(full - full[:, :1] - full[:, :, :1] + full[:, :1, :1]).max() < 1e-10


def test_same_seed_same_bytes_and_another_seed_differs(pupil):
    index = np.arange(3)
    first, repeated, with_other_seed = (
        scene(seed=seed).opd(index, pupil, FLOAT64) for seed in (7, 7, 8)
    )
    assert first.tobytes() == repeated.tobytes()
    assert np.abs(first - with_other_seed).max() > 0.1


def test_any_order_of_directions_and_single_precision(pupil):
    source = scene()
    index = np.array([399, 7, 7, 0, 210])
    opd = source.opd(index, pupil, np.dtype(np.float32))
    assert opd.shape == (5, 130, 130)
    assert opd.dtype == np.float32
    assert (opd[1] == opd[2]).all()
    exact = np.concatenate([source.opd(index[k : k + 1], pupil, FLOAT64) for k in range(5)])
    assert np.abs(opd - exact).max() < 1e-4


def test_slopes_bound_the_finite_differences():
    source = scene(points=5)
    slopes = source.slopes()
    grid = annular_pupil(320, 0.0, sharpen=False)
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
