"""Scenes: the wavefronts of the field points of a telescope, and of single stars.

Inputs: a grid of field points, a telescope and settings of its wavefront. Outputs: the static
wavefronts of all fields, and the wavefronts of stars with random aberrations. The wavefronts are
Seidel terms (scene 1), turbulence (scene 2), or the telescope's own aberrations.
"""

from __future__ import annotations

import numpy as np

from psfdae.base.files import Column
from psfdae.base.rng import stream
from psfdae.optics.pupil import Pupil, SamplingError, annular_pupil
from psfdae.optics.wavefronts import (
    ModalWavefronts,
    WavefrontSource,
    seidel_wavefronts,
    zernike_wavefronts,
)
from psfdae.telescope.aberrations import Raytraced, Seidel, Zernike
from psfdae.telescope.field import static_zernikes
from psfdae.telescope.settings import OwnTelescope, Telescope
from psfdae_paper.configuration.schema import Config, Grid
from psfdae_paper.configuration.wavefront import VonKarman
from psfdae_paper.stars.fields import perturb, relative_field, square_grid
from psfdae_paper.stars.turbulence import SPECTRUM_FACTOR, Footprints, Removal, draw_waves, layer_r0


class TurbulentWavefronts:
    """Turbulent wavefronts, one per direction, on any pupil grid.

    Parameters
    ----------
    footprints : Footprints
        OPD over the pupil in each direction.

    Attributes
    ----------
    highest_cycles : int
        Highest spatial frequency of the turbulence, cycles across the pupil. Anything finer
        scatters light beyond ±60 λ/D (±6.8″ at 1 m and 550 nm), outside every stamp: 0.14 % of the
        light at D/r0 = 5, lost to the flux normalisation.
    slope_samples : int
        Samples across the pupil of the grid on which slopes are measured.
    """

    highest_cycles = 60
    slope_samples = 128

    def __init__(self, footprints: Footprints) -> None:
        self.footprints = footprints
        self._slopes: np.ndarray | None = None

    def __len__(self) -> int:
        """Return the number of directions."""
        return len(self.footprints)

    def slopes(self) -> np.ndarray:
        """Measure the extreme slopes over the disc, in waves per pupil radius.

        They are differences of neighbouring samples of a grid of `slope_samples`, times 1.35.
        Obscured samples count, too. The result is kept for the next call.

        Returns
        -------
        ndarray, shape (B, 2, 2)
            [wavefront, axis (x, y), (min, max)].
        """
        if self._slopes is None:
            pupil = annular_pupil(self.slope_samples, 0.0, sharpen=False)
            # Slopes along x (array axis 2) and y (axis 1), where both neighbours are lit.
            lit = pupil.amplitude > 0
            lit_pairs = ((2, lit[:, 1:] & lit[:, :-1]), (1, lit[1:] & lit[:-1]))
            slopes = np.empty((len(self), 2, 2))
            for start in range(0, len(self), 32):
                part = np.arange(len(self))[start : start + 32]
                opd = self.opd(part, pupil, np.dtype(np.float32))
                for direction, (array_axis, lit_pair) in enumerate(lit_pairs):
                    slope = np.diff(opd, axis=array_axis)[:, lit_pair] / pupil.spacing
                    slopes[part, direction, 0] = slope.min(axis=1)
                    slopes[part, direction, 1] = slope.max(axis=1)
            # Differences over one sample smooth the peaks. With 512 samples the extremes of a
            # wavefront are 1.10 times as steep on average and 1.30 times at most (600 directions
            # of three seeds, D/r0 = 5).
            self._slopes = 1.35 * slopes
        return self._slopes

    def opd(self, index: np.ndarray, pupil: Pupil, dtype: np.dtype) -> np.ndarray:
        """Return the OPD in waves of the wavefronts `index`, shape (b, M, M).

        Raises
        ------
        SamplingError
            If the grid cannot represent the highest frequency of the turbulence.
        """
        samples = 2.0 / pupil.spacing  # the pupil is 2 radii wide
        min_samples = 2 * self.highest_cycles
        if samples < min_samples - 0.5:
            raise SamplingError(
                f"optics.pupil_samples: the turbulence has up to {self.highest_cycles} cycles "
                f"per diameter, which {samples:.0f} samples would alias; "
                f"the grid needs N = {min_samples} or more"
            )
        return self.footprints.opd(index, pupil.axis, dtype)


def template_wavefronts(config: Config) -> WavefrontSource:
    """Return the static wavefronts of all fields of a scene.

    Parameters
    ----------
    config : Config
        Stage configuration with the groups grid, telescope and wavefront.

    Raises
    ------
    SamplingError
        If turbulence is too strong for the highest frequency.
    RayTracingError
        If the ray trace of a field is vignetted.
    """
    # Scene 2: an ideal telescope behind turbulence.
    if isinstance(config.wavefront, VonKarman):
        return turbulent_wavefronts(config.wavefront, config.telescope, config.grid)
    # Scene 1, or a telescope with Seidel coefficients: they are given at the edge of the field, and
    # scale with the relative field of each point.
    aberrations = _static_aberrations(config)
    if isinstance(aberrations, Seidel):
        field = relative_field(config.grid)
        return seidel_wavefronts(np.tile(aberrations.coefficients, (len(field), 1)), field)
    # A telescope with Zernike terms over its field, or with a prescription whose rays are traced.
    return zernike_wavefronts(*_static_zernikes(config))


def star_wavefronts(config: Config, star_field: np.ndarray) -> ModalWavefronts:
    """Draw wavefronts of stars with random aberrations around the static ones of their fields.

    Parameters
    ----------
    config : Config
        Stage configuration with the groups seed, grid, telescope, wavefront and stars.
    star_field : ndarray of int, shape (n,)
        Field of each star.
    """
    stars = config.stars
    # Every coefficient times (1 + fraction · N(0, 1)); streams bear the name of the set of stars.
    fraction, factors = stars.aberration_fraction, stream(config.seed, "aberration", stars.name)
    aberrations = _static_aberrations(config)
    if isinstance(aberrations, Seidel):
        static = np.tile(aberrations.coefficients, (len(star_field), 1))
        field = relative_field(config.grid)[star_field]
        return seidel_wavefronts(perturb(static, fraction, factors), field)
    # The jitter also moves terms that vanish at a field, such as focus on the axis.
    noll, static = _static_zernikes(config)
    shifts = stream(config.seed, "aberration jitter", stars.name)
    coefficients = perturb(static[star_field], fraction, factors, aberrations.jitter_waves, shifts)
    return zernike_wavefronts(noll, coefficients)


def _static_aberrations(config: Config) -> Seidel | Zernike | Raytraced:
    """Return the static aberrations: of the scene, or of the telescope if it has its own."""
    if isinstance(config.wavefront, Seidel):
        return config.wavefront
    assert isinstance(config.telescope, OwnTelescope)
    return config.telescope.aberrations


def _static_zernikes(config: Config) -> tuple[tuple[int, ...], np.ndarray]:
    """Return the Noll indices and the static coefficients (F, J) of all fields in waves."""
    assert isinstance(config.telescope, OwnTelescope)
    _, angle_deg = square_grid(config.grid.points, config.grid.spacing_deg)
    return static_zernikes(config.telescope, angle_deg)


def turbulent_wavefronts(
    wavefront: VonKarman, telescope: Telescope, grid: Grid
) -> TurbulentWavefronts:
    """Return static von Kármán turbulence over the field, the same for all stars.

    The turbulence depends on nothing but `wavefront` and the telescope's diameter. Its r0 holds at
    the telescope's wavelength, in whose waves the OPD is.

    Raises
    ------
    SamplingError
        If the turbulence is too strong for the highest frequency.
    """
    # Phase variance beyond the highest frequency, ∫ 2πf 0.0229 r0^(−5/3) f^(−11/3) df
    # = 1.2 π 0.0229 (r0 f)^(−5/3). It is 0.0014 rad² at D/r0 = 5; 0.1 rad² would scatter
    # a tenth of the light.
    highest_cycles = TurbulentWavefronts.highest_cycles
    cycles = wavefront.r0_m * highest_cycles / telescope.diameter_m
    omitted_variance = 1.2 * np.pi * SPECTRUM_FACTOR * cycles ** (-5.0 / 3.0)
    if omitted_variance > 0.1:
        raise SamplingError(
            f"wavefront.r0_m = {wavefront.r0_m:g}, telescope.diameter_m = "
            f"{telescope.diameter_m:g}: a phase variance of {omitted_variance:.2g} rad² lies "
            f"beyond {highest_cycles} cycles per diameter (at most 0.1)"
        )
    # Each layer has its own random stream, so that it does not depend on the other layers.
    highest = highest_cycles / telescope.diameter_m
    layers = [
        draw_waves(
            *(wavefront.waves, r0, wavefront.outer_scale_m, highest),
            stream(wavefront.seed, "turbulence", layer),
        )
        for layer, r0 in enumerate(layer_r0(wavefront.r0_m, wavefront.layer_strengths))
    ]
    # Directions of the field points in radians; stamps follow the tilt unless it is removed.
    directions = np.deg2rad(square_grid(grid.points, grid.spacing_deg)[1])
    remove: Removal = "tilt" if wavefront.remove_tilt else "piston"
    aperture = (telescope.diameter_m, telescope.obscuration)
    heights = wavefront.layer_heights_m
    return TurbulentWavefronts(Footprints(layers, heights, directions, *aperture, remove))


def aberration_columns(source: ModalWavefronts) -> dict[str, Column]:
    """Return the stars' random aberrations as columns of a product, in waves."""
    return {
        name: Column(values, "wave", about) for name, (values, about) in source.star_columns.items()
    }
