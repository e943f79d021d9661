"""`Rows`: what dataclasses whose fields are arrays with a row for each item have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import Field, fields
from typing import Any, ClassVar, Self

import numpy as np


class Rows:
    """Base of dataclasses whose fields have a row for each item.

    A field is an array or another such object; for `select` and `split` it may be None.
    """

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def select(self, rows: np.ndarray | slice) -> Self:
        """Return some of the items, selected by indices, a mask or a slice."""
        columns = [getattr(self, field.name) for field in fields(self)]
        return type(self)(*(_select(column, rows) for column in columns))

    def split(self, size: int) -> list[Self]:
        """Return the items in parts of `size`, the last one smaller; no items are one part."""
        count = len(getattr(self, fields(self)[0].name))
        return [self.select(slice(start, start + size)) for start in range(0, max(count, 1), size)]

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
        return cls(*map(_join, columns))


def _join(columns: list[Any]) -> Any:
    """Return arrays or `Rows` one after the other."""
    first = columns[0]
    return type(first).join(columns) if isinstance(first, Rows) else np.concatenate(columns)


def _select(column: Any, rows: np.ndarray | slice) -> Any:
    """Return some rows of an array or of `Rows`; None of None."""
    if column is None:
        return None
    return column.select(rows) if isinstance(column, Rows) else column[rows]
