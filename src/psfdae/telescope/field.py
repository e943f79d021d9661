"""Aberrations of a telescope over its field: static values, prior, and common parameters.

The aberrations of a star are the coefficients of some terms of its wavefront. Tilts are left out:
they move the star, and its position is only known from its image. The aberrations of all stars
depend on a few numbers of the telescope, such as the decentre of its secondary mirror.

Inputs: the settings of a telescope (`psfdae.telescope.settings`) and field angles of stars.
Outputs: `Terms`, the prior of each single star, and `TelescopeModel`, the numbers that are common
to all stars, with their prior. `psfdae.sensing` measures both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from psfdae.base.errors import require_extra
from psfdae.base.settings import ConfigError
from psfdae.optics.wavefronts import (
    FIRST_NOLL,
    SEIDEL_TERMS,
    PupilModes,
    field_coefficients,
    monomial_coefficients,
    monomial_images,
    noll_to_nm,
    zernike_images,
)
from psfdae.telescope.aberrations import Raytraced, Seidel, Zernike
from psfdae.telescope.settings import OwnTelescope

VISIBLE_SEIDEL_TERMS = SEIDEL_TERMS[:-1]
"""Seidel terms that change the image of a star. Distortion is a tilt: it only moves the star."""


@dataclass(frozen=True)
class Terms:
    """Terms of the wavefronts of n stars, and the prior of their coefficients.

    Attributes
    ----------
    names : tuple of str, length K
        Names of the terms, such as "coma" or "z7".
    modes : PupilModes
        J modes of the pupil.
    to_modes : ndarray, shape (n, K, J)
        Coefficients of the modes, in waves, for a unit of each term at each star.
    mean, sd : ndarray, shape (n, K)
        Mean and standard deviation of the coefficients of each star, in waves.
    is_even : ndarray of bool, shape (K,)
        True for terms that are equal at opposite points of the pupil. A wavefront whose even part
        has the opposite sign has the same image.
    """

    names: tuple[str, ...]
    modes: PupilModes
    to_modes: np.ndarray
    mean: np.ndarray
    sd: np.ndarray
    is_even: np.ndarray


def relative_field(telescope: OwnTelescope, angle_deg: np.ndarray) -> np.ndarray:
    """Return field angles in degrees as field vectors, 1 at the telescope's `field_edge_deg`."""
    # |h| = 1 at the edge on an axis, √2 in a corner of a square field.
    return np.asarray(angle_deg, float) / telescope.field_edge_deg


def static_zernikes(
    telescope: OwnTelescope, angle_deg: np.ndarray
) -> tuple[tuple[int, ...], np.ndarray]:
    """Return the static Zernike coefficients of a telescope without Seidel terms.

    Parameters
    ----------
    telescope : OwnTelescope
        Telescope with Zernike or ray-traced aberrations.
    angle_deg : ndarray, shape (n, 2)
        Field angles (x, y) in degrees.

    Returns
    -------
    noll : tuple of int, length J
        Noll indices.
    coefficients : ndarray, shape (n, J)
        OPD in waves.

    Raises
    ------
    RayTracingError
        If the ray trace of a field is vignetted.
    MissingExtraError
        If the aberrations are ray-traced and batoid is not installed.
    """
    aberrations = telescope.aberrations
    if isinstance(aberrations, Zernike):
        # Polynomials of the field.
        field = relative_field(telescope, angle_deg)
        return aberrations.noll, field_coefficients(aberrations.polynomials, field)
    assert isinstance(aberrations, Raytraced), "Seidel aberrations have no Zernike terms"
    # Ray trace of the telescope of the file.
    noll = tuple(range(FIRST_NOLL, aberrations.highest_zernike + 1))
    defocus_m, misalignment = aberrations.defocus_m, aberrations.misalignment
    return noll, trace_zernikes(telescope, angle_deg, defocus_m, misalignment)


def trace_zernikes(
    telescope: OwnTelescope, angle_deg: np.ndarray, defocus_m: float, misalignment: np.ndarray
) -> np.ndarray:
    """Trace rays of a telescope and return its Zernike coefficients (n, J), an OPD in waves.

    Parameters
    ----------
    telescope : OwnTelescope
        Telescope with a prescription.
    angle_deg : ndarray, shape (n, 2)
        Field angles (x, y) in degrees.
    defocus_m : float
        Distance of the detector behind best focus in metres.
    misalignment : ndarray, shape (4,)
        Decentre x, y in metres and tilt about x, y in radians of the secondary.

    Raises
    ------
    RayTracingError
        If the ray trace of a field is vignetted.
    MissingExtraError
        If batoid is not installed.
    """
    from psfdae.telescope.raytracing import ZernikeTracer, build_optic

    aberrations = telescope.aberrations
    assert isinstance(aberrations, Raytraced)
    # batoid is an extra: the message names the telescope that needs it.
    with require_extra(f"{telescope.name}: a ray trace"):
        optic = build_optic(aberrations.prescription, telescope, defocus_m)
    field_rad, highest = np.deg2rad(angle_deg), aberrations.highest_zernike
    tracer = ZernikeTracer(optic, telescope.wavelength_m, field_rad, highest)
    # The trace is positive where the wavefront leads, an OPD where it lags.
    return np.asarray(-tracer(misalignment[None])[0])


def build_terms(telescope: OwnTelescope, angle_deg: np.ndarray) -> Terms:
    """Return the terms of stars at field angles (n, 2) in degrees, with the prior of the telescope.

    Raises
    ------
    ConfigError
        If all terms are tilts.
    RayTracingError, MissingExtraError
        As `static_zernikes`.
    """
    # Terms, modes of the pupil and static coefficients, by the kind of the aberrations.
    aberrations = telescope.aberrations
    jitter = 0.0
    if isinstance(aberrations, Seidel):
        # Coefficients of the pupil's monomials for a unit of each visible Seidel term.
        names: tuple[str, ...] = VISIBLE_SEIDEL_TERMS
        field = relative_field(telescope, angle_deg)
        unit = np.eye(len(SEIDEL_TERMS))[: len(names)]
        to_modes = monomial_coefficients(unit, field[:, None])
        modes: PupilModes = monomial_images
        is_even = np.array([name != "coma" for name in names])
        mean = np.tile(aberrations.coefficients[: len(names)], (len(field), 1))
    else:
        jitter = aberrations.jitter_waves
        # Each Zernike polynomial is a term and a mode.
        noll, mean = static_zernikes(telescope, angle_deg)
        visible = [k for k, j in enumerate(noll) if j >= FIRST_NOLL]
        if not visible:
            raise ConfigError(f"{telescope.name}: aberrations.terms: z2 and z3 only move a star")
        noll, mean = tuple(noll[k] for k in visible), mean[:, visible]
        names = tuple(f"z{j}" for j in noll)
        to_modes = np.broadcast_to(np.eye(len(noll)), (len(mean), len(noll), len(noll)))
        modes = partial(zernike_images, noll)
        # Z_j is proportional to cos mφ or sin mφ, equal at opposite points if m is even.
        is_even = np.array([noll_to_nm(j)[1] % 2 == 0 for j in noll])
    # Prior: σ² = (fraction × static coefficient)² + waves². The second part is the same for all
    # stars, by default the star-to-star jitter of the telescope's settings.
    prior = telescope.prior
    waves = jitter if prior.waves is None else prior.waves
    sd = np.hypot(prior.fraction * np.abs(mean), waves)
    return Terms(names, modes, to_modes, mean, sd, is_even)


@dataclass(frozen=True)
class TelescopeModel:
    """Numbers of a telescope that determine the aberrations of all stars.

    Attributes
    ----------
    names, units : tuple of str, length Q
        Names of the numbers, such as "decentre_x", and their units.
    mean, sd : ndarray, shape (Q,)
        Mean and standard deviation of the prior of the numbers.
    coefficients : callable
        Function of the numbers (Q,) that returns coefficients of all stars (n, K), in waves.
    has_seeing : bool
        True if the last number is the FWHM of the seeing in arcsec; no coefficient depends on it.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    mean: np.ndarray
    sd: np.ndarray
    coefficients: Callable[[np.ndarray], np.ndarray]
    has_seeing: bool = False

    def jacobian(self, numbers: np.ndarray) -> np.ndarray:
        """Return the derivatives of the coefficients at `numbers` (Q,), shape (Q, n, K).

        They are central differences over ± a hundredth of the prior's σ.
        """
        slopes = []
        for axis, step in enumerate(0.01 * self.sd):
            # (c(q + δ) − c(q − δ)) / 2δ, one number at a time.
            shift = np.where(np.arange(self.sd.size) == axis, step, 0.0)
            change = self.coefficients(numbers + shift) - self.coefficients(numbers - shift)
            slopes.append(change / (2.0 * step))
        return np.array(slopes)


def model_telescope(telescope: OwnTelescope, angle_deg: np.ndarray) -> TelescopeModel:
    """Return the model of a telescope that is common to all stars at field angles (n, 2).

    Its numbers depend on the kind of the aberrations:

    - Seidel terms: the coefficients, without distortion, which is a tilt;
    - Zernike terms: the coefficients of their polynomials of the field;
    - ray trace: defocus of the detector, decentre and tilt of the secondary; without a secondary
      the position of the optical axis in place of the last two.

    The FWHM of the seeing is the last number if the prior leaves it free.

    Parameters
    ----------
    telescope : OwnTelescope
        Telescope with its aberrations and their prior.
    angle_deg : ndarray, shape (n, 2)
        Field angles (x, y) of the stars in degrees.
    """
    # Each kind of aberrations has its own numbers and their prior.
    angle_deg = np.asarray(angle_deg, float)
    prior, aberrations, seeing = telescope.prior, telescope.aberrations, telescope.seeing
    if isinstance(aberrations, Seidel):
        # Seidel coefficients are the same for all stars: row k of the basis is a unit of term k.
        count = len(VISIBLE_SEIDEL_TERMS)
        basis = np.broadcast_to(np.eye(count)[:, None], (count, len(angle_deg), count))
        # Distortion, the last term, is left out: it only moves stars.
        mean, waves = aberrations.coefficients[:count], prior.waves or 0.0
        model = _linear_model(VISIBLE_SEIDEL_TERMS, mean, basis, prior.fraction, waves)
    elif isinstance(aberrations, Zernike):
        # A row of the basis is a product of powers of the field, in the column of its Zernike term.
        field = relative_field(telescope, angle_deg)
        noll = [j for j in aberrations.noll if j >= FIRST_NOLL]
        rows = [(j, power) for j in noll for power in aberrations.terms[f"z{j}"]]
        basis = np.zeros((len(rows), len(field), len(noll)))
        for row, (j, power) in enumerate(rows):
            x, y = (field[:, axis] ** power.count(letter) for axis, letter in enumerate("xy"))
            basis[row, :, noll.index(j)] = x * y
        # Each power of the field is a number whose prior is centred on its value in the file.
        mean = np.array([aberrations.terms[f"z{j}"][power] for j, power in rows])
        waves = aberrations.jitter_waves if prior.waves is None else prior.waves
        names = tuple(f"z{j}.{power}" for j, power in rows)
        model = _linear_model(names, mean, basis, prior.fraction, waves)
    else:
        model = _ray_traced_model(telescope, aberrations, angle_deg)
    # The FWHM of the seeing is added if the prior leaves it free. No coefficient depends on it:
    # `psfdae.sensing.joint` computes its effect on stamps.
    if seeing is None or not prior.seeing:
        return model
    return TelescopeModel(
        (*model.names, "seeing"),
        (*model.units, "arcsec"),
        np.append(model.mean, seeing.fwhm_arcsec),
        np.append(model.sd, prior.seeing * seeing.fwhm_arcsec),
        lambda numbers: model.coefficients(numbers[:-1]),
        has_seeing=True,
    )


def _linear_model(
    names: tuple[str, ...], mean: np.ndarray, basis: np.ndarray, fraction: float, waves: float
) -> TelescopeModel:
    """Return the model of coefficients Σ_q number_q basis_q; numbers with σ = 0 are constant.

    Parameters
    ----------
    names : tuple of str, length Q
        Names of the numbers.
    mean : ndarray, shape (Q,)
        Mean of their prior, in waves.
    basis : ndarray, shape (Q, n, K)
        Coefficients of the stars for a unit of each number.
    fraction, waves : float
        Standard deviation of the numbers: relative to the mean, and in waves, in quadrature.
    """
    # Prior of the numbers. Numbers without a width contribute a constant to the coefficients.
    sd = np.hypot(fraction * np.abs(mean), waves)
    is_free = sd > 0
    constant_part = np.tensordot(mean[~is_free], basis[~is_free], 1)
    names = tuple(names[index] for index in np.flatnonzero(is_free))
    return TelescopeModel(
        names,
        ("wave",) * len(names),
        mean[is_free],
        sd[is_free],
        lambda numbers: constant_part + np.tensordot(numbers, basis[is_free], 1),
    )


def _ray_traced_model(
    telescope: OwnTelescope, aberrations: Raytraced, angle_deg: np.ndarray
) -> TelescopeModel:
    """Return the model of a ray-traced telescope: defocus, and secondary or optical axis.

    The coefficients of all stars are traced anew for each set of numbers.
    """
    prior, defocus_m = telescope.prior, aberrations.defocus_m
    if aberrations.prescription.secondary is not None:
        # Misalignments are in metres and radians, numbers in metres and degrees.
        units = np.array([1.0, 1.0, np.deg2rad(1.0), np.deg2rad(1.0)])
        return TelescopeModel(
            ("defocus", "decentre_x", "decentre_y", "tilt_x", "tilt_y"),
            ("m", "m", "m", "deg", "deg"),
            np.array([defocus_m, *aberrations.decentre_m, *aberrations.tilt_deg]),
            np.array([prior.defocus_m, *[prior.decentre_m] * 2, *[prior.tilt_deg] * 2]),
            lambda numbers: trace_zernikes(telescope, angle_deg, numbers[0], units * numbers[1:]),
        )
    # Without a secondary, the optical axis may be off the middle of the field.
    # A star is traced at its angle from the axis; no element can be misaligned.
    zero = np.zeros(4)
    return TelescopeModel(
        ("defocus", "axis_x", "axis_y"),
        ("m", "deg", "deg"),
        np.array([defocus_m, 0.0, 0.0]),
        np.array([prior.defocus_m, prior.tilt_deg, prior.tilt_deg]),
        lambda numbers: trace_zernikes(telescope, angle_deg - numbers[1:], numbers[0], zero),
    )
