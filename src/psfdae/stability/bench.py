"""What the stress tests share: settings, stars, noise levels, error budgets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.rng import stream
from psfdae.stability.flux import FluxModel
from psfdae.stages.common import star_wavefronts
from psfdae.stars.fields import assign_fields, draw_jitter
from psfdae.stars.framing import normalise_flux
from psfdae.stars.noise import NoiseModel
from psfdae.stars.scene import Propagation

LEVELS = 1e-5 * np.array([3, 5, 7, 9, 30, 50, 70, 90, 100, 200, 300, 500])
"""Noise levels λ of the paper's three bands."""

LEAST_LEVEL = {"seidel": 3e-5, "turbulence": 3e-4}
"""Smallest noise level λ that the stamps of a scene carry, over all of its datasets."""

BUDGET = 0.01
"""Numerical MSE of a stamp in units of the smallest noise variance that it carries."""


MODEL_STARS = 1000
"""Stars that the flux model of scene 1 is fitted to."""


@dataclass(frozen=True)
class Scene:
    """One scene's settings and noise-free stars.

    Attributes
    ----------
    config : config groups scene, telescope, grid, wavefront, stars, framing, optics
    images : ndarray, shape (n, d, d), float32
        Stars that sum to 1.
    least_level : float
        Smallest noise level λ that the scene's stamps carry.
    """

    config: Any
    images: np.ndarray
    least_level: float


@dataclass(frozen=True, eq=False)
class Bench:
    """What every case gets.

    Attributes
    ----------
    config : stage config `stability` of a dataset of scene 1
    seidel, turbulence : Scene
    folder : Path
        Scratch space.
    """

    config: Any
    seidel: Scene
    turbulence: Scene
    folder: Path

    @property
    def noise(self) -> NoiseModel:
        """The noise of the dataset."""
        return NoiseModel(self.config.noise.kappa, self.config.noise.background_photons)

    @property
    def seed(self) -> int:
        """The config's seed."""
        return int(self.config.seed)

    def budget(self, scene: Scene) -> float:
        """Largest numerical MSE that a normalised stamp of a scene may have."""
        return BUDGET * (self.config.noise.kappa * scene.least_level) ** 2

    @cached_property
    def flux_models(self) -> dict[str, FluxModel]:
        """Flux model of each scene, of stars that are not among the tested ones.

        Scene 2 has no random aberrations: there it is the same PSFs, other stars.
        """
        half = len(self.turbulence.images) // 2
        return {
            "seidel": FluxModel.fit(fresh_stars(self.seidel.config, MODEL_STARS)),
            "turbulence": FluxModel.fit(self.turbulence.images[:half]),
        }

    def test_stars(self, scene: str) -> np.ndarray:
        """Stars that the scene's flux model has not seen, shape (n, d, d)."""
        if scene == "seidel":
            return self.seidel.images
        return self.turbulence.images[len(self.turbulence.images) // 2 :]


def fresh_stars(config: Any, count: int) -> np.ndarray:
    """Noise-free normalised stars of scene 1 from random streams of their own."""
    renamed = config.stars.model_copy(update={"name": "stability", "count": count})
    config = config.model_copy(update={"stars": renamed})
    fields = config.grid.points**2
    star_field = assign_fields(count, fields, stream(config.seed, "field", "stability"))
    jitter = draw_jitter(
        count, config.framing.jitter_px, stream(config.seed, "jitter", "stability")
    )
    propagation = Propagation(
        star_wavefronts(config, star_field),
        config.telescope,
        config.optics,
        config.framing,
        config.stars.search_px,
    )
    return normalise_flux(propagation.framed(config.framing.stamp_px, jitter)[0])[0]


def normalised(stamps: np.ndarray) -> np.ndarray:
    """Stamps divided by their sums."""
    return stamps / stamps.sum(axis=(1, 2), keepdims=True)


def stamp_mse(stamps: np.ndarray, truth: np.ndarray) -> float:
    """Largest mean squared difference of two sets of normalised stamps; NaN if one is NaN."""
    return float(((normalised(stamps) - normalised(truth)) ** 2).mean(axis=(1, 2)).max())
