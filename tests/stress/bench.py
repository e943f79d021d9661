"""Common parts of the stress tests: settings, stars, error budgets, small trainings."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from psfdae.base.rng import stream
from psfdae.denoise.flux_model import FluxModel
from psfdae.denoise.star_flux import Photometer
from psfdae.methods.networks.dae import TrainingSet
from psfdae.methods.networks.settings import image_scale
from psfdae.stars.noise import NoiseModel
from psfdae.stars.splits import draw_jitter
from psfdae.training.packing import leading
from psfdae_paper.stages import stars as stars_stage
from psfdae_paper.stars.fields import assign_fields
from psfdae_paper.stars.framing import Propagation, normalise_flux
from psfdae_paper.stars.scenes import star_wavefronts

THREADS = 2  # of the linear algebra, and trainings side by side
# Smallest noise level λ that the stamps of a scene carry, over all of its datasets.
LEAST_LEVEL = {"seidel": 3e-5, "turbulence": 3e-4}
BUDGET = 0.01  # numerical MSE of a stamp in units of the smallest noise variance that it carries
MODEL_STARS = 1000  # of scene 1's flux model


class Scene(NamedTuple):
    """One scene's configuration and noise-free stars (n, d, d) that sum to 1, float32."""

    config: Any
    images: np.ndarray


@dataclass(frozen=True, eq=False)
class Bench:
    """Input of every case: the configuration of dataset 3, stars, scratch space."""

    config: Any
    seidel: Scene
    turbulence: Scene
    folder: Path

    @property
    def noise(self):
        return NoiseModel(self.config.noise.kappa, self.config.noise.background_photons)

    @property
    def level(self):
        return float(min(self.config.noise.levels))

    def stream(self, *names):
        return stream(self.config.seed, "stability", *names)

    def budget(self, config):
        """Largest numerical MSE that a normalised stamp of a scene may have."""
        return BUDGET * (self.config.noise.kappa * LEAST_LEVEL[config.scene.name]) ** 2

    @cached_property
    def flux_models(self):
        """Flux model of each scene, of stars that are not among the tested ones."""
        # Scene 2 has no random aberrations: there it is the same PSFs, other stars.
        half = self.turbulence.images[: len(self.turbulence.images) // 2]
        fresh = simulate_fresh_stars(self.seidel.config, MODEL_STARS)
        return {"seidel": FluxModel.fit(fresh), "turbulence": FluxModel.fit(half)}

    def test_stars(self, scene="seidel"):
        """Stars that the scene's flux model has not seen, shape (n, d, d)."""
        images = getattr(self, scene).images
        return images if scene == "seidel" else images[len(images) // 2 :]

    @property
    def factor(self):
        return image_scale(self.config.dae.scale, self.seidel.images.shape[-1])

    @cached_property
    def photometer(self):
        """Photometry of scene 1 with what a bundle holds of the flux model."""
        return Photometer(leading(self.flux_models["seidel"], 48), 48)

    def training_set(self, count):
        """The first stars of scene 1 against themselves; one in ten validates."""
        images = self.seidel.images[:count]
        validation_count, levels = max(1, len(images) // 10), np.asarray(self.config.noise.levels)
        parts = np.arange(validation_count, len(images)), np.arange(validation_count)
        return TrainingSet(images, images, *parts, levels, self.noise)


def simulate_fresh_stars(config, count):
    """Noise-free normalised stars of scene 1 from random streams of their own."""
    config = changed(config, stars={"name": "stability"})
    fields, jitter = (stream(config.seed, name, "stability") for name in ("field", "jitter"))
    field = assign_fields(count, config.grid.points**2, fields)
    jitter = draw_jitter(count, config.framing.jitter_px, jitter)
    kernel = propagation(config, star_wavefronts(config, field))
    return normalise_flux(kernel.frame(config.framing.stamp_px, jitter)[0])[0]


def simulated(config, folder):
    """Files of templates and stars of a configuration."""
    templates, stars = folder / "templates.h5", folder / "stars.h5"
    stars_stage.templates(config, templates)
    stars_stage.stars(config, templates, stars)
    return templates, stars


def changed(config, **groups):
    """A configuration with other values in some groups."""
    old = {name: getattr(config, name) for name in groups}
    return config.model_copy(update={k: v.model_copy(update=groups[k]) for k, v in old.items()})


def propagation(config, source, search_px=None, **optics):
    """Propagation of wavefronts, with other values of the group optics."""
    config, search_px = changed(config, optics=optics), search_px or config.stars.search_px
    return Propagation(source, config.telescope, config.optics, config.framing, search_px)


def stamp_mse(stamps, truth):
    """Largest mean squared difference of two sets of stamps of sum 1; NaN if one is NaN."""
    difference = normalise_flux(stamps)[0] - normalise_flux(truth)[0]
    return float((difference**2).mean(axis=(1, 2)).max())
