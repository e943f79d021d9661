"""Scene 1: a wide-field telescope with field-dependent Seidel aberrations."""

from __future__ import annotations

import numpy as np

from psfdae.configuration.schema import Grid, Stars
from psfdae.configuration.telescope import Telescope
from psfdae.configuration.wavefront import Seidel
from psfdae.optics.wavefronts import ModalWavefronts, seidel_wavefronts
from psfdae.rng import stream
from psfdae.stars.fields import perturb, relative_field


def template_wavefronts(grid: Grid, telescope: Telescope, wavefront: Seidel) -> ModalWavefronts:
    """Static wavefronts of all fields."""
    field = relative_field(grid)
    return seidel_wavefronts(np.tile(wavefront.coefficients, (len(field), 1)), field)


def star_wavefronts(
    grid: Grid,
    telescope: Telescope,
    wavefront: Seidel,
    stars: Stars,
    star_field: np.ndarray,
    seed: int,
) -> ModalWavefronts:
    """Wavefronts of stars with random aberrations, `star_field` the field of each, (n,)."""
    static = np.tile(wavefront.coefficients, (len(star_field), 1))
    rng = stream(seed, "aberration", stars.name)
    seidel = perturb(static, stars.aberration_fraction, rng)
    return seidel_wavefronts(seidel, relative_field(grid)[star_field])
