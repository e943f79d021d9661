"""A telescope of one's own: Seidel terms, Zernike terms over the field, or a ray trace.

Everything is in the group `telescope`: aperture, field and static aberrations.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from psfdae.optics.field_zernikes import field_coefficients
from psfdae.rng import stream
from psfdae.stars.fields import square_grid
from psfdae.stars.seidel_scene import SeidelWavefronts, relative_field
from psfdae.stars.seidel_scene import star_wavefronts as seidel_stars
from psfdae.stars.seidel_scene import template_wavefronts as seidel_templates
from psfdae.stars.zernike_wavefronts import ZernikeWavefronts, perturb_terms

FIRST_TRACED = 4
"""A ray trace refers to the image's centroid: piston and tilts are left out."""

Wavefronts = SeidelWavefronts | ZernikeWavefronts


def template_wavefronts(config: Any) -> Wavefronts:
    """Static wavefronts of all fields.

    Parameters
    ----------
    config : stage config with `grid` and `telescope` (an `OwnTelescope`)

    Raises
    ------
    RayTracingError
        If the ray trace of a field is vignetted.
    """
    if config.telescope.aberrations.kind == "seidel":
        return seidel_templates(_of_scene_1(config))
    return ZernikeWavefronts(*static_terms(config))


def star_wavefronts(config: Any, star_field: np.ndarray) -> Wavefronts:
    """Wavefronts of stars with random aberrations.

    Parameters
    ----------
    config : stage config with `seed`, `grid`, `telescope` and `stars`
    star_field : ndarray of int, shape (n,)
        Field of every star.
    """
    if config.telescope.aberrations.kind == "seidel":
        return seidel_stars(_of_scene_1(config), star_field)
    noll, static = static_terms(config)
    seed, stars = config.seed, config.stars
    perturbed = perturb_terms(
        static[star_field],
        stars.aberration_fraction,
        config.telescope.aberrations.jitter_waves,
        stream(seed, "aberration", stars.name),
        stream(seed, "aberration jitter", stars.name),
    )
    return ZernikeWavefronts(noll, perturbed)


def static_terms(config: Any) -> tuple[tuple[int, ...], np.ndarray]:
    """Noll indices (J of them) and static coefficients of all fields, shape (F, J).

    The coefficients are an OPD in waves.

    Raises
    ------
    RayTracingError
        If the ray trace of a field is vignetted.
    """
    aberrations = config.telescope.aberrations
    if aberrations.kind == "zernike":
        _, field = relative_field(config.grid)
        return aberrations.noll, field_coefficients(aberrations.polynomials, field)
    from psfdae.optics.raytracing import ZernikeTracer

    _, angle_deg = square_grid(config.grid.points, config.grid.spacing_deg)
    tracer = ZernikeTracer(
        aberrations.prescription,
        config.telescope,
        aberrations.defocus_m,
        np.deg2rad(angle_deg),
        np.zeros(4),
        aberrations.highest_zernike,
    )
    # The trace counts the lead of the wavefront, an OPD its delay.
    traced = -tracer(np.zeros((1, 4)))[0, :, FIRST_TRACED - 1 :]
    return tuple(range(FIRST_TRACED, aberrations.highest_zernike + 1)), traced


def _of_scene_1(config: Any) -> Any:
    """The config as scene 1 reads it, whose wavefront is a group of its own."""
    groups = {name: getattr(config, name, None) for name in ("seed", "grid", "stars")}
    return SimpleNamespace(**groups, wavefront=config.telescope.aberrations)
