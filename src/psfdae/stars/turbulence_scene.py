"""Scene 2: an ideal telescope behind static von Kármán turbulence."""

from __future__ import annotations

from typing import Any

import numpy as np

from psfdae.optics.pupil import Pupil, annular_pupil
from psfdae.optics.sampling import SamplingError
from psfdae.optics.turbulence import SPECTRUM, Footprints, draw_waves, layer_r0
from psfdae.rng import stream
from psfdae.stars.fields import square_grid

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
            batches = range(0, len(self), SLOPE_BATCH)
            everyone = np.arange(len(self))
            measured = [
                _difference_ranges(
                    self.opd(everyone[start : start + SLOPE_BATCH], pupil, np.dtype(np.float32)),
                    pupil,
                )
                for start in batches
            ]
            self._slopes = SLOPE_MARGIN * np.concatenate(measured)
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


def template_wavefronts(config: Any) -> TurbulentWavefronts:
    """Static wavefronts of all fields.

    The turbulence depends on nothing but the group `wavefront` and the
    telescope's diameter. Its r0 holds at the telescope's wavelength, in whose
    waves the OPD is.

    Parameters
    ----------
    config : stage config with `grid`, `telescope` and `wavefront` (von_karman)

    Raises
    ------
    ValueError
        If there is not one height and one strength per layer, or the strengths
        do not add up to 1.
    SamplingError
        If the turbulence is too strong for the highest frequency.
    """
    turbulence, telescope = config.wavefront, config.telescope
    cycles = turbulence.r0_m * CYCLES_PER_DIAMETER / telescope.diameter_m
    left_out = 1.2 * np.pi * SPECTRUM * cycles ** (-5.0 / 3.0)
    if left_out > MOST_LEFT_OUT:
        raise SamplingError(
            f"wavefront.r0_m = {turbulence.r0_m:g}, telescope.diameter_m = "
            f"{telescope.diameter_m:g}: a phase variance of {left_out:.2g} rad² lies beyond "
            f"{CYCLES_PER_DIAMETER} cycles per diameter (at most {MOST_LEFT_OUT})"
        )
    highest = CYCLES_PER_DIAMETER / telescope.diameter_m
    layers = [
        draw_waves(
            turbulence.waves,
            r0,
            turbulence.outer_scale_m,
            highest,
            stream(turbulence.seed, "turbulence", layer),
        )
        for layer, r0 in enumerate(layer_r0(turbulence.r0_m, turbulence.layer_strengths))
    ]
    _, angle_deg = square_grid(config.grid.points, config.grid.spacing_deg)
    return TurbulentWavefronts(
        Footprints(
            layers,
            turbulence.layer_heights_m,
            np.deg2rad(angle_deg),
            telescope.diameter_m,
            telescope.obscuration,
            "tilt" if turbulence.remove_tilt else "piston",
        )
    )


def _difference_ranges(opd: np.ndarray, pupil: Pupil) -> np.ndarray:
    """Smallest and largest difference of lit neighbours per axis (x, y), shape (B, 2, 2)."""
    lit = pupil.amplitude > 0
    pairs = ((2, lit[:, 1:] & lit[:, :-1]), (1, lit[1:] & lit[:-1]))
    steps = [np.diff(opd, axis=axis)[:, both] / pupil.spacing for axis, both in pairs]
    return np.stack(
        [np.stack([step.min(axis=1), step.max(axis=1)], axis=-1) for step in steps], axis=1
    ).astype(np.float64)
