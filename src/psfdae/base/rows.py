"""`Rows`: what dataclasses whose fields are arrays with a row for each item have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import Field, fields
from typing import Any, ClassVar, Self

import numpy as np


class Rows:
    """Base of dataclasses whose fields are all arrays with a row for each item."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def select(self, rows: np.ndarray | slice) -> Self:
        """Return some of the items, selected by indices, a mask or a slice."""
        return type(self)(*(getattr(self, field.name)[rows] for field in fields(self)))

    def put(self, rows: np.ndarray, replacement: Self) -> None:
        """Replace the items at these indices; the arrays are changed in place."""
        for field in fields(self):
            getattr(self, field.name)[rows] = getattr(replacement, field.name)

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Return the items of several objects, one after the other."""
        if len(parts) == 1:
            return parts[0]
        columns = ([getattr(part, field.name) for part in parts] for field in fields(cls))
        return cls(*map(np.concatenate, columns))
