"""Types of the options of commands."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import click

File = Annotated[Path, click.Path(path_type=Path, dir_okay=False)]

Folder = Annotated[Path, click.Path(path_type=Path, file_okay=False)]

AboveZero = click.FloatRange(min=0, min_open=True)


class NameOrNumber(click.ParamType):  # type: ignore[type-arg]  # click below 8.5 takes none
    """Extension of a FITS file: its number, in plain digits, or its name."""

    name = "text"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> str | int:
        """Return a number for up to six digits, and any other text unchanged."""
        return int(value) if re.fullmatch("[0-9]{1,6}", str(value)) else value


Extension: TypeAlias = Annotated[str | int, NameOrNumber()]
