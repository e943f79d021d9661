"""Entry points by which other packages add commands, methods and settings."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any


def find_entry_points(topic: str) -> list[EntryPoint]:
    """Return the entry points "psfdae.<topic>" of all packages that are installed."""
    return list(_entry_points().select(group=f"psfdae.{topic}"))


@cache
def _entry_points() -> Any:
    # Cached, because it reads the metadata of every package of the environment.
    return entry_points()
