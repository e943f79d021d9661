"""Commands, methods and settings of other packages, by entry points."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any


def joined(what: str) -> list[EntryPoint]:
    """Entry points "psfdae.<what>" of all packages that are installed."""
    return list(_all().select(group=f"psfdae.{what}"))


@cache
def _all() -> Any:
    """Read once: the files of every package of the environment are opened for it."""
    return entry_points()
