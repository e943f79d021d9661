"""Stage `config`: the configuration, checked and resolved.

With overrides such as `dataset=alignment` or `preset=paper`, it prints the whole configuration, or
the groups that one stage reads, as YAML.
"""

from __future__ import annotations

from typing import Annotated

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

    A run with the same overrides has the printed values, defaults included. The message for a wrong
    key gives its allowed range.

    Parameters
    ----------
    overrides : sequence of str
        Words of Hydra such as dataset=alignment or noise.kappa=4.98.
    only : str, optional
        Only the groups that this stage reads.
    """
    if only is None:
        settings = load(overrides)
    else:
        # "alignment model", "alignment_model" and "alignment-model" name the same stage.
        names = {_key(name.removeprefix("paper ")): name for name in command_modules()}
        name = names.get(_key(only))
        reader = stage(name).stage.settings if name else None  # type: ignore[attr-defined]
        if reader is None:
            raise click.BadParameter(f"{only!r} is not one of {', '.join(sorted(names.values()))}")
        # Groups of the stage without options; a stage may read more with some of them.
        settings = Groups(reader.names({}), reader.choice)({}, None, overrides)
    # In the order of the classes, as in the documentation.
    click.echo(yaml.safe_dump(settings.model_dump(), sort_keys=False), nl=False)


def _key(name: str) -> str:
    """Return a command's name with underscores."""
    return name.replace(" ", "_").replace("-", "_")
