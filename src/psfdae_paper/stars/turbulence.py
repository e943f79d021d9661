"""Von Kármán turbulence, evaluated only where a telescope looks through it.

Each layer is a sum of plane waves with random frequencies (sparse spectrum,
Charnotskii 2013, JOSA A 30, 479 and JOSA A 30, 2455), so no screen is
needed: the waves are known everywhere, and footprints tens of metres apart cost
no more than neighbouring ones. A plane wave is separable, exp(iκ_x x) exp(iκ_y y), hence the
phase on the pupil grid of a direction is one matrix product.

Lengths are in metres, spatial frequencies f in cycles per metre, wave vectors κ = 2πf
(not the κ of the noise), phases in radians at the wavelength at which r0 is given,
OPDs in waves of it, not metres. The spectrum is 0.0229 r0^(−5/3) (f² + 1/L0²)^(−11/6) rad² m².
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import gamma, jv

Removal = Literal["none", "piston", "tilt"]
"""Modes that can be taken out of wavefronts; "tilt" includes the piston."""

SPECTRUM_FACTOR = gamma(11 / 6) ** 2 / (2 * np.pi ** (11 / 3)) * (24 / 5 * gamma(6 / 5)) ** (5 / 6)
"""Factor 0.0229 of the phase spectrum.

Its last factor is half of Fried's 6.88, by which r0 is defined: D(r) = 6.88 (r/r0)^(5/3).
"""

PER_RING = 8
"""Plane waves in a ring of the frequency plane; their angles are stratified."""


def layer_r0(r0: float, strengths: Sequence[float]) -> np.ndarray:
    """Return Fried's parameter of each layer in metres, r0_l = r0 · s_l^(−3/5).

    `r0` belongs to all layers together, `strengths` are the fractions s_l of each.
    """
    fraction = np.asarray(strengths, float)
    return r0 * fraction ** (-3.0 / 5.0)


@dataclass(frozen=True)
class PlaneWaves:
    """The plane waves of one layer.

    Attributes
    ----------
    frequency : ndarray, shape (K, 2), float64
        (f_x, f_y) in cycles per metre.
    amplitude : ndarray, shape (K,), complex128
        φ(x) = Re Σ amplitude · exp(2πi f·x), in radians.
    """

    frequency: np.ndarray
    amplitude: np.ndarray


def draw_waves(
    count: int, r0: float, outer_scale: float, highest: float, rng: np.random.Generator
) -> PlaneWaves:
    """Draw plane waves whose ensemble has the von Kármán spectrum up to a frequency.

    The frequency plane is cut into rings with log-spaced edges around a disc
    that reaches f = 0. Within a ring the radius is drawn with a density
    proportional to the spectrum (its integral has a closed form) and all waves
    share the ring's power equally: the ensemble's spectrum is exact below
    `highest`, without a cut at low frequencies. Moduli are fixed and phases
    uniform, which leaves less scatter between realisations than Gaussian
    amplitudes; with tens of waves per octave the sum is Gaussian all the same.
    Angles are stratified over a half-turn within a ring, which keeps a single
    realisation isotropic.

    Parameters
    ----------
    count : int
        Number K of waves, a multiple of `PER_RING`, at least two rings.
    r0, outer_scale : float
        In metres.
    highest : float
        Highest frequency in cycles per metre. The variance that is missing
        beyond it is 0.086 (r0 · highest)^(−5/3) rad².
    rng : Generator
        Random stream of the layer.

    Raises
    ------
    ValueError
        If `highest` is not above the innermost disc.
    """
    rings = count // PER_RING
    # Edges of the rings: a disc of radius 1/(2 L0) around f = 0, then equal steps of ln f.
    outer_frequency = 1.0 / outer_scale
    if highest <= 0.5 * outer_frequency:
        raise ValueError(f"highest frequency {highest} must exceed 0.5/L0 = {outer_frequency / 2}")
    edges = np.concatenate([[0.0], np.geomspace(0.5 * outer_frequency, highest, rings)])
    # Variance of each wave: the ring's integral of the spectrum, divided by the ring's waves.
    # ∫ f (f² + f0²)^(−11/6) df = −3/5 (f² + f0²)^(−5/6), with f0 = 1/L0.
    integral = (edges**2 + outer_frequency**2) ** (-5.0 / 6.0)
    ring_integral = integral[:-1] - integral[1:]
    power = 2.0 * np.pi * SPECTRUM_FACTOR * r0 ** (-5.0 / 3.0) * 0.6 * ring_integral / PER_RING
    # Radii by inversion of that integral; a wave's angle lies in its own part of the half-turn.
    radius_draw, angle_draw, phase_draw = rng.random((3, rings, PER_RING))
    drawn_integral = integral[:-1, None] - radius_draw * ring_integral[:, None]
    radius = np.sqrt(np.maximum(drawn_integral ** (-6.0 / 5.0) - outer_frequency**2, 0.0))
    angle = np.pi * (np.arange(PER_RING) + angle_draw) / PER_RING
    frequency = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    # The real part of a·exp(iφ) has the variance |a|²/2.
    amplitude = np.sqrt(2.0 * power)[:, None] * np.exp(2j * np.pi * phase_draw)
    return PlaneWaves(frequency.reshape(-1, 2), amplitude.ravel())


def fit_planes(wavevector: np.ndarray, obscuration: float = 0.0) -> np.ndarray:
    """Fit the least-squares plane p + t_x x + t_y y of waves exp(iκ·x) over the lit pupil.

    In closed form, hence the same for every pupil grid: over the disc of radius
    R, ⟨exp(iκ·x)⟩ = 2J1(κR)/(κR) and ⟨x exp(iκ·x)⟩ = 2i κ_x J2(κR)/κ².

    Parameters
    ----------
    wavevector : ndarray, shape (K, 2)
        (κ_x, κ_y) in radians per pupil radius.
    obscuration : float
        Linear central obscuration ε, 0 ≤ ε < 1.

    Returns
    -------
    ndarray, shape (K, 3), complex128
        p, t_x, t_y; the tilts per pupil radius.
    """
    # The formulas are 0/0 at κ = 0; 1e-6 gives their limits to double precision.
    kappa = np.maximum(np.hypot(*wavevector.T), 1e-6)
    # Integrals over the annulus in units of the disc's area: those over the disc minus those
    # over the obscuration.
    mean, moment = np.zeros_like(kappa), np.zeros_like(kappa)
    for radius, area in ((1.0, 1.0), (obscuration, -(obscuration**2))):
        if area:
            mean += area * 2.0 * jv(1, kappa * radius) / (kappa * radius)
            moment += area * 2.0 * jv(2, kappa * radius) / kappa**2
    # Piston ⟨exp(iκ·x)⟩, tilt ⟨x exp(iκ·x)⟩ / ⟨x²⟩: over the annulus x, y and 1 are orthogonal.
    lit_area = 1.0 - obscuration**2
    second_moment = 0.25 * (1.0 + obscuration**2)  # ⟨x²⟩ over the annulus
    tilt = 1j * wavevector * (moment / lit_area / second_moment)[:, None]
    return np.concatenate([(mean / lit_area)[:, None].astype(complex), tilt], axis=1)


class Footprints:
    """OPD over the pupil in a set of directions through turbulent layers.

    In direction θ the phase at the pupil point x is Σ_l φ_l(x + h_l θ): the
    directions share the waves, so neighbours see the same turbulence wherever
    their footprints overlap.

    Parameters
    ----------
    layers : sequence of PlaneWaves
        Plane waves of each layer, L in all.
    heights : sequence of float
        Height h_l of every layer in metres.
    directions : ndarray, shape (B, 2)
        Small field angles (x, y) in radians.
    diameter : float
        Outer diameter of the pupil in metres.
    obscuration : float
        Linear obscuration of the pupil over which planes are fitted.
    remove : "none", "piston" or "tilt"
        What is taken out of every direction; "tilt" includes the piston.

    Attributes
    ----------
    wavevector : ndarray, shape (K, 2)
        Wave vectors κ of the waves of all layers, in radians per pupil radius.
    coefficients : ndarray, shape (B, K)
        Complex OPD of each wave in waves, in the middle of each footprint.
    planes : ndarray, shape (B, 3)
        Piston and tilts to subtract, in waves and in waves per pupil radius.
    """

    def __init__(
        self,
        layers: Sequence[PlaneWaves],
        heights: Sequence[float],
        directions: np.ndarray,
        diameter: float,
        obscuration: float = 0.0,
        remove: Removal = "tilt",
    ) -> None:
        frequency = np.concatenate([layer.frequency for layer in layers])
        amplitude = np.concatenate([layer.amplitude for layer in layers])
        height = np.repeat(np.asarray(heights, float), [len(w.amplitude) for w in layers])
        # Phase of each wave in the middle of each footprint, in turns: f · h θ, shape (B, K).
        turns = np.asarray(directions, float) @ (frequency * height[:, None]).T
        self.wavevector = np.pi * diameter * frequency  # radians per pupil radius
        # OPD in waves is the phase over 2π.
        self.coefficients = amplitude / (2.0 * np.pi) * np.exp(2j * np.pi * turns)
        # Piston and tilts to subtract from each direction, shape (B, 3); terms that are not removed
        # are 0 here.
        self.planes = (self.coefficients @ fit_planes(self.wavevector, obscuration)).real
        removed_terms = {"none": 0, "piston": 1, "tilt": 3}[remove]
        self.planes[:, removed_terms:] = 0.0
        # Waves above the ground shift with the direction (moving); those at height 0 are common to
        # all.
        self._moving = np.flatnonzero(height != 0.0)
        self._common = np.flatnonzero(height == 0.0)
        self._cache: dict[tuple[bytes, str], tuple[np.ndarray, ...]] = {}

    def __len__(self) -> int:
        """Return the number of directions."""
        return len(self.coefficients)

    def opd(self, index: np.ndarray, axis: np.ndarray, dtype: np.dtype) -> np.ndarray:
        """Return the OPD in waves of the directions `index`.

        Parameters
        ----------
        index : ndarray of int, shape (b,)
            Directions; one that is named several times is computed once.
        axis : ndarray, shape (M,)
            Coordinates in pupil radii along either axis.
        dtype : float32 or float64
            Precision of the products. Single precision costs about 1e-6 waves.

        Returns
        -------
        ndarray, shape (b, M, M)
            Indexed [y, x].
        """
        directions, inverse = np.unique(index, return_inverse=True)
        waves_y, waves_x, common_opd = self._factors(axis, np.dtype(dtype))
        coefficients = self.coefficients[:, self._moving].astype(waves_y.dtype)
        opd = np.empty((directions.size, axis.size, axis.size), dtype)
        # OPD[y, x] = Re Σ_k c_k exp(iκ_y y) exp(iκ_x x), as a product of real matrices; with 4
        # directions at a time, their rows fit the cache of a core.
        for start in range(0, directions.size, 4):
            part = directions[start : start + 4]
            rows = _real_rows(coefficients[part, None, :] * waves_y)
            opd[start : start + 4] = (rows @ waves_x).reshape(part.size, axis.size, -1)
        piston, tilt_x, tilt_y = self.planes[directions].T[:, :, None]
        opd += common_opd
        # The planes carry the tilts of thousands of waves: formed in float64, cast once.
        opd -= (piston + tilt_y * axis).astype(dtype)[:, :, None]
        opd -= (tilt_x * axis).astype(dtype)[:, None, :]
        # No copy if the directions are in ascending order and no one is named twice.
        is_sorted = directions.size == np.size(index) and (directions == index).all()
        return opd if is_sorted else opd[inverse]

    def _factors(self, axis: np.ndarray, dtype: np.dtype) -> tuple[np.ndarray, ...]:
        """Return the factors of the waves on a pupil grid; each grid is computed once.

        Returns
        -------
        waves_y : ndarray, shape (M, K'), complex
            exp(iκ_y y) of the K' waves above the ground.
        waves_x : ndarray, shape (2K', M), real
            Real and imaginary parts of exp(−iκ_x x), interleaved.
        common_opd : ndarray, shape (M, M)
            OPD in waves of the layers at the ground, the same for all directions.
        """
        key = (np.asarray(axis).tobytes(), dtype.str)
        if key not in self._cache:
            kappa = self.wavevector[:, None, :] * axis[None, :, None]
            x, y = np.moveaxis(np.exp(1j * kappa), -1, 0)
            ground_x = self.coefficients[0, self._common, None] * x[self._common]
            common_opd = (y[self._common].T @ ground_x).real
            waves_y = np.ascontiguousarray(y[self._moving].T)
            # Re(a b) = Re a · Re b − Im a · Im b: the conjugate brings the sign.
            waves_x = _real_rows(np.ascontiguousarray(x[self._moving].T.conj())).T
            complex_dtype = np.result_type(dtype, np.complex64)
            self._cache[key] = (
                waves_y.astype(complex_dtype),
                np.ascontiguousarray(waves_x, dtype=dtype),
                common_opd.astype(dtype),
            )
        return self._cache[key]


def _real_rows(array: np.ndarray) -> np.ndarray:
    """Return complex (..., K) as real rows (·, 2K), real and imaginary parts interleaved."""
    real = array.view(array.real.dtype)
    return real.reshape(-1, real.shape[-1])
