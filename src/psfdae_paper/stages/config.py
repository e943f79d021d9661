"""Stage `config`: the configuration, checked and resolved.

With overrides such as `dataset=alignment` or `preset=paper`, it prints the whole configuration, or
the groups that one stage reads, as YAML.
"""

from __future__ import annotations

from typing import Annotated, Any

import click
import yaml

from psfdae.commands.cli import command_modules, stage
from psfdae_paper.configuration.command import Groups, command
from psfdae_paper.configuration.compose import load


@command("paper config")
def config(
    overrides: Annotated[tuple[str, ...], {"argument": True}] = (),
    only: Annotated[str | None, {"flag": "--stage"}] = None,
) -> None:
    """Check the configuration and print it, resolved, as YAML.

    A run with the same overrides uses the printed values, defaults included. An error names the
    key and its allowed range.

    Parameters
    ----------
    overrides : sequence of str
        Hydra overrides such as dataset=alignment or noise.kappa=4.98.
    only : str, optional
        Print only the groups that this stage reads.
    """
    if only is None:
        settings = load(overrides)
    else:
        # "alignment model", "alignment_model" and "alignment-model" name the same stage.
        names = {_key(name.removeprefix("paper ")): name for name in command_modules()}
        name = names.get(_key(only))
        reader = _reader(name) if name else None
        if reader is None:
            allowed = sorted(name for name in names.values() if _reader(name) is not None)
            raise click.BadParameter(
                f"{only!r} reads no configuration; stages that do: {', '.join(allowed)}",
                param_hint="--stage",
            )
        # Groups that the stage reads without options; some options add groups.
        settings = Groups(reader.names({}), reader.choice)({}, None, overrides)
    # Keys in the order of the settings classes, as in the documentation.
    click.echo(yaml.safe_dump(settings.model_dump(), sort_keys=False), nl=False)


def _reader(name: str) -> Any:
    """Return what reads the configuration of a command; None if the command has none."""
    return stage(name).stage.settings  # type: ignore[attr-defined]


def _key(name: str) -> str:
    """Return a command's name with underscores instead of spaces and hyphens."""
    return name.replace(" ", "_").replace("-", "_")
