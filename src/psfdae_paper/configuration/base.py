"""The folder of the configuration, and types of keys that several groups have."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import Annotated

from pydantic import Field

from psfdae.base.settings import ConfigError

SearchDistance = Annotated[float, Field(gt=0, allow_inf_nan=False, exclude=True)]
"""Search distance in λ/D. Products do not contain it, but the distance in pixels that follows."""


def get_search_distance(distance: object = None) -> float:
    """Return the distance around the chief ray within which a brightest pixel is searched, in λ/D.

    It is the given distance or, if this is not a positive number, the default.
    """
    if isinstance(distance, int | float) and not isinstance(distance, bool) and distance > 0:
        return distance
    # Four times the distance of the farthest template of scene 1. A peak that lies farther out is
    # searched at twice the distance, then rejected.
    return 48.0


def config_dir() -> Path:
    """Return the folder of the configuration tree.

    The environment variable `PSFDAE_CONFIG` names it; otherwise it is the copy that an installed
    package has, or `config/` of the source tree. ConfigError if `config.yaml` is not in it.
    """
    return _folder(os.environ.get("PSFDAE_CONFIG", ""))


@cache  # looking for the folder takes longer than all else in most calls
def _folder(environment_value: str) -> Path:
    """Return the folder that an environment variable names, or the package's folder.

    A wheel has a copy of the configuration in the package; in the source tree it is next to `src`.
    """
    # The folder psfdae_paper, wherever it is.
    package = Path(__file__).resolve().parents[1]
    # Of an installed package, or of a source tree; the latter is named if there is neither.
    candidates = (package / "config", package.parents[1] / "config")
    folder = next((path for path in candidates if path.is_dir()), candidates[-1])
    folder = Path(environment_value or folder)
    # A folder without it would give errors of Hydra that name no file.
    if not (folder / "config.yaml").is_file():
        raise ConfigError(f"{folder}: no config.yaml (set PSFDAE_CONFIG to the config folder)")
    return folder.resolve()
