"""Folder of the configuration, and types that its models share."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from psfdae.settings import ConfigError

SEARCH = 48.0
"""λ/D around the chief ray within which brightest pixels are searched by default.

Four times the distance of the farthest template of scene 1; a peak that lies
farther out is searched at twice the distance, then refused.
"""

# Left out of products: they state the distance in pixels that follows.
SearchDistance = Annotated[float, Field(gt=0, allow_inf_nan=False, exclude=True)]


def _ascending(grid_sizes: list[int]) -> list[int]:
    if sorted(set(grid_sizes)) != grid_sizes:
        raise ValueError(f"{grid_sizes} must be ascending")
    return grid_sizes


PupilSamples = Annotated[
    list[Annotated[int, Field(ge=16, le=8192)]], Field(min_length=1), AfterValidator(_ascending)
]


def config_dir() -> Path:
    """Folder of the configuration tree.

    `PSFDAE_CONFIG` names another one; otherwise it is the copy that an installed
    package has, or `config/` of the source tree.
    """
    return _folder(os.environ.get("PSFDAE_CONFIG", ""))


@cache  # Looking for it takes longer than all else in most calls.
def _folder(named: str) -> Path:
    package = Path(__file__).resolve().parents[1]
    places = (package / "config", package.parents[1] / "config")
    folder = next((place for place in places if place.is_dir()), places[-1])
    folder = Path(named or folder)
    if not (folder / "config.yaml").is_file():
        raise ConfigError(f"{folder}: no config.yaml (set PSFDAE_CONFIG to the config folder)")
    return folder.resolve()
