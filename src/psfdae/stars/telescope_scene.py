"""A telescope of one's own: Seidel terms, Zernike terms over the field, or a ray trace.

Everything is in the group `telescope`: aperture, field and static aberrations.
"""

from __future__ import annotations

import numpy as np

from psfdae.configuration.schema import Grid, Stars
from psfdae.configuration.telescope import OwnTelescope
from psfdae.configuration.wavefront import OfTelescope
from psfdae.optics.wavefronts import ModalWavefronts, zernike_wavefronts
from psfdae.optics.zernike import field_coefficients
from psfdae.rng import stream
from psfdae.stars import seidel_scene
from psfdae.stars.fields import perturb, relative_field, square_grid


def template_wavefronts(
    grid: Grid, telescope: OwnTelescope, wavefront: OfTelescope
) -> ModalWavefronts:
    """Static wavefronts of all fields.

    Raises
    ------
    RayTracingError
        If the ray trace of a field is vignetted.
    """
    aberrations = telescope.aberrations
    if aberrations.kind == "seidel":
        return seidel_scene.template_wavefronts(grid, telescope, aberrations)
    return zernike_wavefronts(*static_terms(grid, telescope))


def star_wavefronts(
    grid: Grid,
    telescope: OwnTelescope,
    wavefront: OfTelescope,
    stars: Stars,
    star_field: np.ndarray,
    seed: int,
) -> ModalWavefronts:
    """Wavefronts of stars with random aberrations, `star_field` the field of each, (n,)."""
    aberrations = telescope.aberrations
    if aberrations.kind == "seidel":
        return seidel_scene.star_wavefronts(grid, telescope, aberrations, stars, star_field, seed)
    noll, static = static_terms(grid, telescope)
    perturbed = perturb(
        static[star_field],
        stars.aberration_fraction,
        stream(seed, "aberration", stars.name),
        aberrations.jitter_waves,
        stream(seed, "aberration jitter", stars.name),
    )
    return zernike_wavefronts(noll, perturbed)


def static_terms(grid: Grid, telescope: OwnTelescope) -> tuple[tuple[int, ...], np.ndarray]:
    """Noll indices (J of them) and static coefficients of all fields, shape (F, J).

    The coefficients are an OPD in waves.

    Raises
    ------
    RayTracingError
        If the ray trace of a field is vignetted.
    """
    aberrations = telescope.aberrations
    if aberrations.kind == "zernike":
        return aberrations.noll, field_coefficients(aberrations.polynomials, relative_field(grid))
    from psfdae.optics.raytracing import FIRST_NOLL, ZernikeTracer
    from psfdae.stars.prescription import build_optic

    _, angle_deg = square_grid(grid.points, grid.spacing_deg)
    tracer = ZernikeTracer(
        build_optic(aberrations.prescription, telescope, aberrations.defocus_m),
        telescope.wavelength_m,
        np.deg2rad(angle_deg),
        np.zeros(4),
        aberrations.highest_zernike,
    )
    # The trace counts the lead of the wavefront, an OPD its delay.
    traced = -tracer(np.zeros((1, 4)))[0]
    return tuple(range(FIRST_NOLL, aberrations.highest_zernike + 1)), traced
