"""What stages share: scene, threads, stars, their parts and their noise."""

from __future__ import annotations

from typing import Any

import numpy as np

from psfdae.files import Column


def scene_of(config: Any) -> Any:
    """The scene of a stage's config."""
    from psfdae_paper.stars.scenes import SCENES

    return SCENES[config.scene.name](config.grid, config.telescope, config.wavefront)


def template_wavefronts(config: Any) -> Any:
    """Static wavefronts of all fields of a stage's scene."""
    return scene_of(config).templates()


def star_wavefronts(config: Any, star_field: np.ndarray) -> Any:
    """Wavefronts of stars with random aberrations, `star_field` the field of each."""
    return scene_of(config).stars(config.stars, star_field, config.seed)


def drawn_columns(source: Any) -> dict[str, Column]:
    """What the stars' random aberrations were, as products keep it."""
    return {name: Column(values, "wave", about) for name, (values, about) in source.drawn.items()}
