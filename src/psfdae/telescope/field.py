"""Aberrations of a telescope over its field: static ones, their prior, and what moves them all.

A star's aberrations are the coefficients of some terms. Tilts are none of them: they move the
star, whose place is not known better than its image says.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from psfdae.errors import needed_by
from psfdae.optics.wavefronts import (
    FIRST_NOLL,
    SEIDEL_TERMS,
    Modes,
    field_coefficients,
    monomial_coefficients,
    monomial_images,
    noll_to_nm,
    zernike_images,
)
from psfdae.settings import ConfigError
from psfdae.telescope.aberrations import Raytraced, Seidel, Zernike
from psfdae.telescope.settings import OwnTelescope

SEEN_SEIDEL = SEIDEL_TERMS[:-1]
"""Distortion is a tilt."""

ODD_SEIDEL = ("coma",)


@dataclass(frozen=True)
class Terms:
    """Terms of the wavefront, and coefficients that stars may have.

    Attributes
    ----------
    names : tuple of str, length K
    modes : Modes
        J modes of the pupil.
    to_modes : ndarray, shape (n, K, J)
        Coefficients of the modes, in waves, for a unit of each term at each star.
    mean, sd : ndarray, shape (n, K)
        Prior of each star's coefficients, in waves.
    even : ndarray of bool, shape (K,)
        Terms that are the same at opposite points of the pupil. A wavefront whose even part
        has the other sign has the same image.
    """

    names: tuple[str, ...]
    modes: Modes
    to_modes: np.ndarray
    mean: np.ndarray
    sd: np.ndarray
    even: np.ndarray


def relative(telescope: OwnTelescope, angle_deg: np.ndarray) -> np.ndarray:
    """Field vectors, 1 at the telescope's `field_edge_deg`, of field angles in degrees."""
    return np.asarray(angle_deg, float) / telescope.field_edge_deg


def static_zernikes(
    telescope: OwnTelescope, angle_deg: np.ndarray
) -> tuple[tuple[int, ...], np.ndarray]:
    """Noll indices (J of them) and static coefficients at field angles (n, 2), shape (n, J).

    The coefficients are an OPD in waves.

    Raises
    ------
    RayTracingError
        If the ray trace of a field is vignetted.
    MissingExtraError
        If a ray trace is asked for and batoid is not installed.
    """
    aberrations = telescope.aberrations
    if isinstance(aberrations, Zernike):
        field = relative(telescope, angle_deg)
        return aberrations.noll, field_coefficients(aberrations.polynomials, field)
    assert isinstance(aberrations, Raytraced), "Seidel's terms are no Zernike terms"
    noll = tuple(range(FIRST_NOLL, aberrations.highest_zernike + 1))
    return noll, traced(telescope, angle_deg)


def traced(
    telescope: OwnTelescope,
    angle_deg: np.ndarray,
    defocus_m: float | None = None,
    misalignment: np.ndarray | None = None,
) -> np.ndarray:
    """Zernike coefficients (n, J) of a ray trace, an OPD in waves.

    `defocus_m` and `misalignment` (4,), a decentre x, y in metres and a tilt about x, y in
    radians of the secondary, are the file's by default.
    """
    from psfdae.telescope.raytracing import ZernikeTracer, build_optic, misaligned

    own = telescope.aberrations
    assert isinstance(own, Raytraced)
    defocus_m = own.defocus_m if defocus_m is None else defocus_m
    with needed_by(f"{telescope.name}: a ray trace"):
        optic = build_optic(own.prescription, telescope, defocus_m)
    optic = misaligned(optic, own.misalignment if misalignment is None else misalignment)
    tracer = ZernikeTracer(
        optic, telescope.wavelength_m, np.deg2rad(angle_deg), np.zeros(4), own.highest_zernike
    )
    # The trace counts the lead of the wavefront, an OPD its delay.
    return np.asarray(-tracer(np.zeros((1, 4)))[0])


def terms_of(telescope: OwnTelescope, angle_deg: np.ndarray) -> Terms:
    """Terms of stars at field angles (n, 2) in degrees, with the telescope's prior.

    Raises
    ------
    RayTracingError, MissingExtraError
        As `static_zernikes`.
    """
    prior, aberrations = telescope.prior, telescope.aberrations
    if isinstance(aberrations, Seidel):
        names: tuple[str, ...] = SEEN_SEIDEL
        field = relative(telescope, angle_deg)
        each = np.eye(len(SEIDEL_TERMS))[: len(names)]
        to_modes = monomial_coefficients(each, field[:, None])
        modes, even = monomial_images, np.array([name not in ODD_SEIDEL for name in names])
        mean = np.tile(aberrations.coefficients[: len(names)], (len(field), 1))
    else:
        noll, mean = static_zernikes(telescope, angle_deg)
        seen = [k for k, j in enumerate(noll) if j >= FIRST_NOLL]
        if not seen:
            raise ConfigError(f"{telescope.name}: aberrations.terms: z2 and z3 only move a star")
        noll, mean = tuple(noll[k] for k in seen), mean[:, seen]
        names = tuple(f"z{j}" for j in noll)
        to_modes = np.broadcast_to(np.eye(len(noll)), (len(mean), len(noll), len(noll)))
        modes = partial(zernike_images, noll)
        even = np.array([noll_to_nm(j)[1] % 2 == 0 for j in noll])
    jitter = getattr(aberrations, "jitter_waves", 0.0) if prior.waves is None else prior.waves
    sd = np.hypot(prior.fraction * np.abs(mean), jitter)
    return Terms(names, modes, to_modes, mean, sd, even)


@dataclass(frozen=True)
class FieldModel:
    """A few numbers of the telescope from which the aberrations of all stars follow.

    Attributes
    ----------
    names, units : tuple of str, length Q
    mean, sd : ndarray, shape (Q,)
        Prior of the numbers.
    coefficients : callable
        From the numbers (Q,) to coefficients of all stars (n, K), in waves.
    seeing : bool
        Whether the last number is the FWHM of the seeing in arcsec, which moves no coefficient.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    mean: np.ndarray
    sd: np.ndarray
    coefficients: Callable[[np.ndarray], np.ndarray]
    seeing: bool = False

    def with_seeing(self, fwhm_arcsec: float, fraction: float) -> FieldModel:
        """This model, and the FWHM of the seeing with a prior of that relative width."""
        return FieldModel(
            (*self.names, "seeing"),
            (*self.units, "arcsec"),
            np.append(self.mean, fwhm_arcsec),
            np.append(self.sd, fraction * fwhm_arcsec),
            lambda numbers: self.coefficients(numbers[:-1]),
            seeing=True,
        )

    def jacobian(self, numbers: np.ndarray) -> np.ndarray:
        """Derivatives of the coefficients, (Q, n, K), by differences of a hundredth of σ."""
        slopes = []
        for axis, step in enumerate(0.01 * self.sd):
            move = np.where(np.arange(self.sd.size) == axis, step, 0.0)
            ahead, behind = (self.coefficients(numbers + sign * move) for sign in (1, -1))
            slopes.append((ahead - behind) / (2.0 * step))
        return np.array(slopes)


def field_model(telescope: OwnTelescope, angle_deg: np.ndarray) -> FieldModel:
    """Return the model of the field that is common to all stars at angles (n, 2).

    Seidel terms: the four coefficients that are no tilt. Zernike terms: the coefficients of their
    polynomials of the field. A ray trace: the detector's defocus, and decentre and tilt of the
    secondary, or without one the place of the optical axis. The FWHM of the seeing is among them
    if the prior leaves it free.
    """
    optics, seeing = _of_the_optics(telescope, angle_deg), telescope.seeing
    if seeing is None or not telescope.prior.seeing:
        return optics
    return optics.with_seeing(seeing.fwhm_arcsec, telescope.prior.seeing)


def _of_the_optics(telescope: OwnTelescope, angle_deg: np.ndarray) -> FieldModel:
    prior, aberrations = telescope.prior, telescope.aberrations
    if isinstance(aberrations, Seidel):
        mean = aberrations.coefficients[: len(SEEN_SEIDEL)]
        sd = np.hypot(prior.fraction * np.abs(mean), prior.waves or 0.0)
        kept = sd > 0
        names = tuple(name for name, k in zip(SEEN_SEIDEL, kept, strict=True) if k)

        def seidel(numbers: np.ndarray) -> np.ndarray:
            whole = mean.copy()
            whole[kept] = numbers
            return np.tile(whole, (len(angle_deg), 1))

        return FieldModel(names, ("wave",) * len(names), mean[kept], sd[kept], seidel)
    if isinstance(aberrations, Zernike):
        return _polynomials(telescope, aberrations, np.asarray(angle_deg, float))
    return _ray_trace(telescope, aberrations, np.asarray(angle_deg, float))


def _polynomials(
    telescope: OwnTelescope, aberrations: Zernike, angle_deg: np.ndarray
) -> FieldModel:
    prior = telescope.prior
    field, noll = relative(telescope, angle_deg), [j for j in aberrations.noll if j >= FIRST_NOLL]
    rows = [(j, name) for j in noll for name in aberrations.terms[f"z{j}"]]
    basis = np.zeros((len(rows), len(field), len(noll)))
    for row, (j, name) in enumerate(rows):
        powers = (name.count("x"), name.count("y")) if name != "constant" else (0, 0)
        basis[row, :, noll.index(j)] = field[:, 0] ** powers[0] * field[:, 1] ** powers[1]
    mean = np.array([aberrations.terms[f"z{j}"][name] for j, name in rows])
    waves = aberrations.jitter_waves if prior.waves is None else prior.waves
    sd = np.hypot(prior.fraction * np.abs(mean), waves)
    kept = sd > 0
    fixed = np.tensordot(mean[~kept], basis[~kept], 1)
    names = tuple(f"z{j}.{name}" for (j, name), k in zip(rows, kept, strict=True) if k)
    return FieldModel(
        names,
        ("wave",) * len(names),
        mean[kept],
        sd[kept],
        lambda numbers: fixed + np.tensordot(numbers, basis[kept], 1),
    )


def _ray_trace(telescope: OwnTelescope, own: Raytraced, angle_deg: np.ndarray) -> FieldModel:
    prior = telescope.prior
    if own.prescription.secondary is not None:
        to_radians = np.array([1.0, 1.0, np.deg2rad(1.0), np.deg2rad(1.0)])
        return FieldModel(
            ("defocus", "decentre_x", "decentre_y", "tilt_x", "tilt_y"),
            ("m", "m", "m", "deg", "deg"),
            np.array([own.defocus_m, *own.decentre_m, *own.tilt_deg]),
            np.array([prior.defocus_m, *[prior.decentre_m] * 2, *[prior.tilt_deg] * 2]),
            lambda numbers: traced(telescope, angle_deg, numbers[0], to_radians * numbers[1:]),
        )
    return FieldModel(
        ("defocus", "axis_x", "axis_y"),
        ("m", "deg", "deg"),
        np.array([own.defocus_m, 0.0, 0.0]),
        np.array([prior.defocus_m, prior.tilt_deg, prior.tilt_deg]),
        lambda numbers: traced(telescope, angle_deg - numbers[1:], numbers[0]),
    )
