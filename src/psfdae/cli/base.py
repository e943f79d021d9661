"""The command group and the options that its commands share."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

import psfdae

FileArgument = click.Path(path_type=Path, dir_okay=False)
FolderArgument = click.Path(path_type=Path, file_okay=False)


class StageGroup(click.Group):
    """Turns the package's own errors into one message and exit code 2."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; a refusal of ours is a message, a bug stays a traceback.

        So is a file that the system does not let us read or write, and a lack of memory.
        """
        try:
            return super().invoke(ctx)
        except OSError as error:
            if error.errno is None:
                raise
            click.echo(f"psfdae: {error}", err=True)
            ctx.exit(2)
        except MemoryError as error:
            click.echo(f"psfdae: not enough memory ({error or 'no more is known'})", err=True)
            ctx.exit(2)
        except (RuntimeError, ValueError) as error:
            # HDF5 reports a full disk as a RuntimeError without a number of its own.
            # So does torch a lack of memory, as its own RuntimeError.
            ours = type(error).__module__.startswith("psfdae")
            if not ours and not re.search("errno = |not enough memory", str(error)):
                raise
            click.echo(f"psfdae: {' '.join(str(error).split()) if not ours else error}", err=True)
            ctx.exit(2)


@click.group(cls=StageGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(psfdae.__version__)
def main() -> None:
    """PSF modelling with a denoising autoencoder, one command per stage.

    OVERRIDES are Hydra overrides, such as dataset=dataset5 train.lr=1e-3; the
    groups and keys are those of the config folder.
    """


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
