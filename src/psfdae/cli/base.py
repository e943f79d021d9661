"""The command group and the options that its commands share."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from psfdae.cli import main

__all__ = ["FileArgument", "FolderArgument", "main", "name_or_number", "out_option", "overrides"]

FileArgument = click.Path(path_type=Path, dir_okay=False)
FolderArgument = click.Path(path_type=Path, file_okay=False)


def name_or_number(text: str | None) -> str | int | None:
    """An extension: its number, in plain digits, or its name."""
    return int(text) if text is not None and re.fullmatch("[0-9]{1,6}", text) else text


def overrides(function: Callable[..., Any]) -> Callable[..., Any]:
    """The trailing Hydra overrides of a stage."""
    return click.argument("overrides", nargs=-1)(function)


def out_option(what: str, kind: click.Path = FileArgument) -> Callable[..., Any]:
    """The option that names a stage's output."""
    return click.option("--out", type=kind, required=True, help=what)


def input_option(name: str, what: str, kind: click.Path = FileArgument) -> Callable[..., Any]:
    """An option that names a stage's input."""
    return click.option(f"--{name}", type=kind, required=True, help=what)


split_option = click.option(
    "--split", type=click.Choice(["random", "held_out"]), default="random", show_default=True
)
reference_option = click.option(
    "--reference",
    type=click.Choice(["realisation", "template"]),
    default="realisation",
    show_default=True,
)


@main.group()
def figure() -> None:
    """Draw a figure as PNG from finished products."""
