"""The folder of the configuration, and types of keys that several groups have."""

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

SearchDistance = Annotated[float, Field(gt=0, allow_inf_nan=False, exclude=True)]
"""Search distance in λ/D. Products do not contain it, but the distance in pixels that follows."""


def _ascending(grid_sizes: list[int]) -> list[int]:
    """Return grid sizes unchanged; ValueError if they do not ascend.

    The first size that suffices is chosen for each wavefront, which must be the smallest one.
    """
    if sorted(set(grid_sizes)) != grid_sizes:
        raise ValueError(f"{grid_sizes} must be ascending")
    return grid_sizes


PupilSamples = Annotated[
    list[Annotated[int, Field(ge=16, le=8192)]], Field(min_length=1), AfterValidator(_ascending)
]
"""Ascending numbers of samples across the pupil, of which each wavefront uses one."""


def config_dir() -> Path:
    """Return the folder of the configuration tree.

    The environment variable `PSFDAE_CONFIG` names it; otherwise it is the copy that an installed
    package has, or `config/` of the source tree. ConfigError if it has no `config.yaml`.
    """
    return _folder(os.environ.get("PSFDAE_CONFIG", ""))


@cache  # looking for the folder takes longer than all else in most calls
def _folder(environment_value: str) -> Path:
    """Return the folder that an environment variable names, or the package's folder.

    A wheel has a copy of the configuration in the package; in the source tree it is beside `src`.
    """
    package = Path(__file__).resolve().parents[1]
    candidates = (package / "config", package.parents[1] / "config")
    folder = next((path for path in candidates if path.is_dir()), candidates[-1])
    folder = Path(environment_value or folder)
    if not (folder / "config.yaml").is_file():
        raise ConfigError(f"{folder}: no config.yaml (set PSFDAE_CONFIG to the config folder)")
    return folder.resolve()
