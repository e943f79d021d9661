"""Configuration of the knee of the training (`config/knee/points.yaml`)."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from psfdae.configuration.base import Group
from psfdae.configuration.compose import config_dir, load_file

PointName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]+$")]


class Knee(Group):
    """Trainings whose test errors are set against their time."""

    fresh_stars: Annotated[int, Field(ge=2)] = Field(
        description="Other draws, of which the point fresh_realisations is trained"
    )
    points: Annotated[dict[PointName, list[str]], Field(min_length=1)] = Field(
        description="Configuration overrides of each training"
    )


def load_knee() -> Knee:
    """Read and check the file; raises ConfigError."""
    checked: Knee = load_file(Knee, config_dir() / "knee" / "points.yaml")
    return checked
