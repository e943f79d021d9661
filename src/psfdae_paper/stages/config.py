"""Stages `config` and `alignment config`: what the configuration says, checked and resolved."""

from __future__ import annotations

from typing import Annotated, Literal

import click

from psfdae.cli import found, stage
from psfdae_paper.configuration.command import command

Overrides = Annotated[tuple[str, ...], {"argument": True}]
Only = Annotated[str | None, "Only the groups that this stage reads.", {"flag": "--stage"}]


@command("config")
def config(overrides: Overrides = (), only: Only = None) -> None:
    """Check the configuration and print it, resolved, as YAML."""
    _print("config", overrides, only)


@command("alignment config")
def alignment_config(only: Only = None, overrides: Overrides = ()) -> None:
    """Check the configuration of scene 3 and print it, resolved, as YAML."""
    _print("alignment", overrides, only)


def _print(
    root: Literal["config", "alignment"], overrides: tuple[str, ...], only: str | None
) -> None:
    import yaml

    from psfdae_paper.configuration.compose import load, load_stage

    stages = {_key(name): name for name in found()}
    reader = stage(stages[_key(only)]).stage.settings if only and _key(only) in stages else None
    if only is None:
        checked = load(overrides, root)
    elif reader is not None and reader.root == root:
        checked = load_stage(reader.of({}), overrides, root)
    else:
        names = [name for name in found() if name.startswith("alignment ") == (root != "config")]
        raise click.BadParameter(f"{only!r} is not one of {', '.join(sorted(names))}")
    click.echo(yaml.safe_dump(checked.model_dump(), sort_keys=False), nl=False)


def _key(name: str) -> str:
    return name.replace(" ", "_").replace("-", "_")
