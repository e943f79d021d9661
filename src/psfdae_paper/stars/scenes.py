"""Scenes: where the wavefronts of field points and of single stars come from.

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

MOST_LEFT_OUT = 0.1
"""Phase variance in rad² beyond that frequency above which it matters; 0.0014 at D/r0 = 5."""

SLOPE_SAMPLES = 128
"""Samples of the grid on which slopes are measured."""

SLOPE_MARGIN = 1.35
"""Factor on the measured slopes: differences over one sample smooth the peaks.

With 512 samples the extremes of a wavefront are 1.10 times as steep on average
and 1.30 times at most (600 directions of three seeds, D/r0 = 5).
"""

SLOPE_BATCH = 32
"""Wavefronts per batch of the slope measurement."""


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
        """Extreme slopes over the disc, shape (B, 2, 2), in waves per pupil radius.

        [wavefront, axis (x, y), (min, max)] of the differences of neighbouring
        samples on a grid of `SLOPE_SAMPLES`, times `SLOPE_MARGIN`. Obscured
        samples count, too. Measured once, then kept.
        """
        if self._slopes is None:
            pupil = annular_pupil(SLOPE_SAMPLES, 0.0, sharpen=False)
            lit = pupil.amplitude > 0
            pairs = ((2, lit[:, 1:] & lit[:, :-1]), (1, lit[1:] & lit[:-1]))
            slopes = np.empty((len(self), 2, 2))
            for start in range(0, len(self), SLOPE_BATCH):
                part = np.arange(len(self))[start : start + SLOPE_BATCH]
                opd = self.opd(part, pupil, np.dtype(np.float32))
                for number, (axis, both) in enumerate(pairs):
                    step = np.diff(opd, axis=axis)[:, both] / pupil.spacing
                    slopes[part, number, 0] = step.min(axis=1)
                    slopes[part, number, 1] = step.max(axis=1)
            self._slopes = SLOPE_MARGIN * slopes
        return self._slopes

    def opd(self, index: np.ndarray, pupil: Pupil, dtype: np.dtype) -> np.ndarray:
        """OPD in waves of the wavefronts `index`, shape (b, M, M).

        Raises
        ------
        SamplingError
            If the grid cannot represent the highest frequency of the turbulence.
        """
        samples = 2.0 / pupil.spacing
        if samples < 2 * CYCLES_PER_DIAMETER - 0.5:
            raise SamplingError(
                f"optics.pupil_samples: the turbulence holds up to {CYCLES_PER_DIAMETER} cycles "
                f"per diameter, {samples:.0f} samples would alias them: "
                f"at least N = {2 * CYCLES_PER_DIAMETER} would do"
            )
        return self.footprints.opd(index, pupil.axis, dtype)


@dataclass(frozen=True)
class Scene(ABC):
    """Groups `grid`, `telescope` and `wavefront` of a configuration."""

    grid: Grid
    telescope: Telescope
    wavefront: Seidel | VonKarman | OfTelescope

    @abstractmethod
    def templates(self) -> WavefrontSource:
        """Static wavefronts of all fields."""

    def stars(self, stars: Stars, star_field: np.ndarray, seed: int) -> ModalWavefronts:
        """Wavefronts of stars with random aberrations, `star_field` the field of each, (n,).

        Raises
        ------
        ConfigError
            If the scene has none.
        """
        raise ConfigError(
            f"stars.aberration_fraction = {stars.aberration_fraction}: must be 0, no star of this "
            "scene has aberrations of its own"
        )


class SeidelScene(Scene):
    """Scene 1: a wide-field telescope with field-dependent Seidel aberrations."""

    wavefront: Seidel

    def templates(self) -> ModalWavefronts:
        """Static wavefronts of all fields."""
        field = relative_field(self.grid)
        return seidel_wavefronts(np.tile(self.wavefront.coefficients, (len(field), 1)), field)

    def stars(self, stars: Stars, star_field: np.ndarray, seed: int) -> ModalWavefronts:
        """Wavefronts of stars with random aberrations, `star_field` the field of each, (n,)."""
        static = np.tile(self.wavefront.coefficients, (len(star_field), 1))
        rng = stream(seed, "aberration", stars.name)
        seidel = perturb(static, stars.aberration_fraction, rng)
        return seidel_wavefronts(seidel, relative_field(self.grid)[star_field])


class TurbulenceScene(Scene):
    """Scene 2: an ideal telescope behind static von Kármán turbulence; no star has its own."""

    wavefront: VonKarman

    def templates(self) -> TurbulentWavefronts:
        """Static wavefronts of all fields.

        The turbulence depends on nothing but `wavefront` and the telescope's diameter.
        Its r0 holds at the telescope's wavelength, in whose waves the OPD is.

        Raises
        ------
        SamplingError
            If the turbulence is too strong for the highest frequency.
        """
        wavefront, telescope = self.wavefront, self.telescope
        cycles = wavefront.r0_m * CYCLES_PER_DIAMETER / telescope.diameter_m
        left_out = 1.2 * np.pi * SPECTRUM * cycles ** (-5.0 / 3.0)
        if left_out > MOST_LEFT_OUT:
            raise SamplingError(
                f"wavefront.r0_m = {wavefront.r0_m:g}, telescope.diameter_m = "
                f"{telescope.diameter_m:g}: a phase variance of {left_out:.2g} rad² lies beyond "
                f"{CYCLES_PER_DIAMETER} cycles per diameter (at most {MOST_LEFT_OUT})"
            )
        highest = CYCLES_PER_DIAMETER / telescope.diameter_m
        layers = [
            draw_waves(
                wavefront.waves,
                r0,
                wavefront.outer_scale_m,
                highest,
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
    """A telescope of one's own: Seidel terms, Zernike terms over the field, or a ray trace.

    Everything is in the group `telescope`: aperture, field and static aberrations.
    """

    telescope: OwnTelescope

    def templates(self) -> ModalWavefronts:
        """Static wavefronts of all fields.

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
        """Wavefronts of stars with random aberrations, `star_field` the field of each, (n,)."""
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
        """See `static_zernikes`."""
        _, angle_deg = square_grid(self.grid.points, self.grid.spacing_deg)
        return static_zernikes(self.telescope, angle_deg)

    def _seidel(self, aberrations: Seidel) -> SeidelScene:
        return SeidelScene(self.grid, self.telescope, aberrations)


SCENES: dict[str, type[Scene]] = {
    "seidel": SeidelScene,
    "turbulence": TurbulenceScene,
    "telescope": TelescopeScene,
}
"""By name."""


def scene_of(config: Config) -> Scene:
    """The scene of a stage's config."""
    return SCENES[config.scene.name](config.grid, config.telescope, config.wavefront)


def template_wavefronts(config: Config) -> WavefrontSource:
    """Static wavefronts of all fields of a stage's scene."""
    return scene_of(config).templates()


def star_wavefronts(config: Config, star_field: np.ndarray) -> ModalWavefronts:
    """Wavefronts of stars with random aberrations, `star_field` the field of each."""
    return scene_of(config).stars(config.stars, star_field, config.seed)


def drawn_columns(source: ModalWavefronts) -> dict[str, Column]:
    """What the stars' random aberrations were, as products keep it."""
    return {name: Column(values, "wave", about) for name, (values, about) in source.drawn.items()}
