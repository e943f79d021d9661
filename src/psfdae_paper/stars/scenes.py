"""Scenes: the wavefronts of the field points of a telescope, and of single stars.

A scene has a grid of field points, a telescope and settings of its wavefront. It gives the
static wavefronts of all fields, and those of stars with random aberrations.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from psfdae.files import Column
from psfdae.optics.pupil import Pupil, SamplingError, annular_pupil
from psfdae.optics.wavefronts import (
    ModalWavefronts,
    WavefrontSource,
    seidel_wavefronts,
    zernike_wavefronts,
)
from psfdae.rng import stream
from psfdae.settings import ConfigError
from psfdae.telescope.aberrations import Seidel
from psfdae.telescope.field import static_zernikes
from psfdae.telescope.settings import OwnTelescope, Telescope
from psfdae_paper.configuration.schema import Config, Grid, Stars
from psfdae_paper.configuration.wavefront import OfTelescope, VonKarman
from psfdae_paper.stars.fields import perturb, relative_field, square_grid
from psfdae_paper.stars.turbulence import SPECTRUM, Footprints, draw_waves, layer_r0

CYCLES_PER_DIAMETER = 60
"""Highest spatial frequency of the turbulence, cycles across the pupil.

Anything finer scatters light beyond ±60 λ/D (±6.8″ at 1 m and 550 nm), outside
every stamp: 0.14 % of the light at D/r0 = 5, lost to the flux normalisation.
"""

SLOPE_SAMPLES = 128
"""Samples across the pupil of the grid on which slopes are measured."""


class TurbulentWavefronts:
    """Turbulent wavefronts, one per direction, on any pupil grid.

    Parameters
    ----------
    footprints : Footprints
    """

    def __init__(self, footprints: Footprints) -> None:
        self.footprints = footprints
        self._slopes: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.footprints)

    def slopes(self) -> np.ndarray:
        """Measure the extreme slopes over the disc, in waves per pupil radius.

        They are differences of neighbouring samples of a grid of `SLOPE_SAMPLES`, times 1.35.
        Obscured samples count, too. The result is kept for the next call.

        Returns
        -------
        ndarray, shape (B, 2, 2)
            [wavefront, axis (x, y), (min, max)].
        """
        if self._slopes is None:
            pupil = annular_pupil(SLOPE_SAMPLES, 0.0, sharpen=False)
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
        if samples < 2 * CYCLES_PER_DIAMETER - 0.5:
            raise SamplingError(
                f"optics.pupil_samples: the turbulence has up to {CYCLES_PER_DIAMETER} cycles "
                f"per diameter, which {samples:.0f} samples would alias; "
                f"the grid needs N = {2 * CYCLES_PER_DIAMETER} or more"
            )
        return self.footprints.opd(index, pupil.axis, dtype)


@dataclass(frozen=True)
class Scene(ABC):
    """Telescope, field points and wavefront settings, from which wavefronts are made.

    The attributes are the configuration groups of the same names.
    """

    grid: Grid
    telescope: Telescope
    wavefront: Seidel | VonKarman | OfTelescope

    @abstractmethod
    def templates(self) -> WavefrontSource:
        """Return the static wavefronts of all fields."""

    def stars(self, stars: Stars, star_field: np.ndarray, seed: int) -> ModalWavefronts:
        """Draw wavefronts of stars with random aberrations.

        Parameters
        ----------
        stars : Stars
            Configuration group with the scale of the aberrations and the name of the set.
        star_field : ndarray of int, shape (n,)
            Field of each star.
        seed : int

        Raises
        ------
        ConfigError
            If the scene has no random aberrations.
        """
        raise ConfigError(
            f"stars.aberration_fraction = {stars.aberration_fraction}: must be 0, stars of this "
            "scene have no random aberrations"
        )


class SeidelScene(Scene):
    """Scene 1: a wide-field telescope with field-dependent Seidel aberrations."""

    wavefront: Seidel

    def templates(self) -> ModalWavefronts:
        """Return the static wavefronts of all fields."""
        field = relative_field(self.grid)
        return seidel_wavefronts(np.tile(self.wavefront.coefficients, (len(field), 1)), field)

    def stars(self, stars: Stars, star_field: np.ndarray, seed: int) -> ModalWavefronts:
        """Draw wavefronts of stars, `star_field` the field of each, (n,)."""
        static = np.tile(self.wavefront.coefficients, (len(star_field), 1))
        rng = stream(seed, "aberration", stars.name)
        seidel = perturb(static, stars.aberration_fraction, rng)
        return seidel_wavefronts(seidel, relative_field(self.grid)[star_field])


class TurbulenceScene(Scene):
    """Scene 2: an ideal telescope behind static von Kármán turbulence, the same for all stars."""

    wavefront: VonKarman

    def templates(self) -> TurbulentWavefronts:
        """Return the static wavefronts of all fields.

        The turbulence depends on nothing but `wavefront` and the telescope's diameter.
        Its r0 holds at the telescope's wavelength, in whose waves the OPD is.

        Raises
        ------
        SamplingError
            If the turbulence is too strong for the highest frequency.
        """
        wavefront, telescope = self.wavefront, self.telescope
        # Phase variance beyond the highest frequency, ∫ 2πf 0.0229 r0^(−5/3) f^(−11/3) df
        # = 1.2 π 0.0229 (r0 f)^(−5/3). It is 0.0014 rad² at D/r0 = 5; 0.1 rad² would scatter
        # a tenth of the light.
        cycles = wavefront.r0_m * CYCLES_PER_DIAMETER / telescope.diameter_m
        omitted_variance = 1.2 * np.pi * SPECTRUM * cycles ** (-5.0 / 3.0)
        if omitted_variance > 0.1:
            raise SamplingError(
                f"wavefront.r0_m = {wavefront.r0_m:g}, telescope.diameter_m = "
                f"{telescope.diameter_m:g}: a phase variance of {omitted_variance:.2g} rad² lies "
                f"beyond {CYCLES_PER_DIAMETER} cycles per diameter (at most 0.1)"
            )
        # Each layer has its own random stream, so that it is the same beside other layers.
        layers = [
            draw_waves(
                wavefront.waves,
                r0,
                wavefront.outer_scale_m,
                CYCLES_PER_DIAMETER / telescope.diameter_m,
                stream(wavefront.seed, "turbulence", layer),
            )
            for layer, r0 in enumerate(layer_r0(wavefront.r0_m, wavefront.layer_strengths))
        ]
        _, angle_deg = square_grid(self.grid.points, self.grid.spacing_deg)
        return TurbulentWavefronts(
            Footprints(
                layers,
                wavefront.layer_heights_m,
                np.deg2rad(angle_deg),
                telescope.diameter_m,
                telescope.obscuration,
                "tilt" if wavefront.remove_tilt else "piston",
            )
        )


class TelescopeScene(Scene):
    """Scene of a user's telescope: Seidel terms, Zernike terms over the field, or a ray trace.

    Everything is in the group `telescope`: aperture, field and static aberrations.
    """

    telescope: OwnTelescope

    def templates(self) -> ModalWavefronts:
        """Return the static wavefronts of all fields.

        Raises
        ------
        RayTracingError
            If the ray trace of a field is vignetted.
        """
        aberrations = self.telescope.aberrations
        if isinstance(aberrations, Seidel):
            return self._seidel(aberrations).templates()
        return zernike_wavefronts(*self._zernikes())

    def stars(self, stars: Stars, star_field: np.ndarray, seed: int) -> ModalWavefronts:
        """Draw wavefronts of stars, `star_field` the field of each, (n,)."""
        aberrations = self.telescope.aberrations
        if isinstance(aberrations, Seidel):
            return self._seidel(aberrations).stars(stars, star_field, seed)
        noll, static = self._zernikes()
        perturbed = perturb(
            static[star_field],
            stars.aberration_fraction,
            stream(seed, "aberration", stars.name),
            aberrations.jitter_waves,
            stream(seed, "aberration jitter", stars.name),
        )
        return zernike_wavefronts(noll, perturbed)

    def _zernikes(self) -> tuple[tuple[int, ...], np.ndarray]:
        """Return the Noll indices and the static coefficients of all fields in waves."""
        _, angle_deg = square_grid(self.grid.points, self.grid.spacing_deg)
        return static_zernikes(self.telescope, angle_deg)

    def _seidel(self, aberrations: Seidel) -> SeidelScene:
        """Return the scene of a telescope that is described by Seidel coefficients."""
        return SeidelScene(self.grid, self.telescope, aberrations)


SCENES: dict[str, type[Scene]] = {
    "seidel": SeidelScene,
    "turbulence": TurbulenceScene,
    "telescope": TelescopeScene,
}
"""Classes of scenes by the name in the configuration."""


def scene_of(config: Config) -> Scene:
    """Return the scene of a stage's configuration."""
    return SCENES[config.scene.name](config.grid, config.telescope, config.wavefront)


def template_wavefronts(config: Config) -> WavefrontSource:
    """Return the static wavefronts of all fields of a stage's scene."""
    return scene_of(config).templates()


def star_wavefronts(config: Config, star_field: np.ndarray) -> ModalWavefronts:
    """Draw wavefronts of stars with random aberrations, `star_field` the field of each."""
    return scene_of(config).stars(config.stars, star_field, config.seed)


def aberration_columns(source: ModalWavefronts) -> dict[str, Column]:
    """Return the stars' random aberrations as columns of a product, in waves."""
    return {
        name: Column(values, "wave", about) for name, (values, about) in source.star_columns.items()
    }
