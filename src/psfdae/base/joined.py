"""Commands, methods and settings of other packages, which join by entry points."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any


def joined(topic: str) -> list[EntryPoint]:
    """Return the entry points "psfdae.<topic>" of all packages that are installed."""
    return list(_entry_points().select(group=f"psfdae.{topic}"))


@cache
def _entry_points() -> Any:
    # Read once, because that opens the files of every package of the environment.
    return entry_points()
