"""What every configuration model is made of."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

SEARCH = 48.0
"""λ/D around the chief ray within which brightest pixels are searched by default.

Four times the distance of the farthest template of scene 1; a peak that lies
farther out is searched at twice the distance, then refused.
"""

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, lt=1)]
Count = Annotated[int, Field(ge=1)]
# Left out of products: they state the distance in pixels that follows.
SearchDistance = Annotated[float, Field(gt=0, allow_inf_nan=False, exclude=True)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_]+$")]


NEUTRAL = "cannot change a result"
"""Marks a setting of which no byte of a result depends: another value repeats no job."""

CheckpointSeconds = Annotated[float, Field(ge=0), NEUTRAL]


class Group(BaseModel):
    """A config group: immutable, and no key beyond those declared."""

    model_config = ConfigDict(extra="forbid", frozen=True)
