"""What every configuration model is made of."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

ARCSEC = np.pi / 180.0 / 3600.0

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, lt=1)]
Count = Annotated[int, Field(ge=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_]+$")]


class Group(BaseModel):
    """A config group: immutable, and no key beyond those declared."""

    model_config = ConfigDict(extra="forbid", frozen=True)
