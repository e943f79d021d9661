"""Stage `config`: what the configuration says, checked and resolved."""

from __future__ import annotations

from typing import Annotated

import click

from psfdae.cli import Stage, command, found, stage


@command("config")
def config(
    overrides: Annotated[tuple[str, ...], {"argument": True}] = (),
    only: Annotated[
        str | None, "Only the groups that this stage reads.", {"flag": "--stage"}
    ] = None,
) -> None:
    """Check the configuration and print it, resolved, as YAML."""
    import yaml

    from psfdae.configuration.compose import load, load_stage
    from psfdae.configuration.stages import STAGE_KEYS

    if only is None:
        checked = load(overrides)
    elif only.replace("-", "_") in STAGE_KEYS and only not in found():
        checked = load_stage(only.replace("-", "_"), overrides)
    elif only not in found():
        raise click.BadParameter(f"{only!r} is not one of {', '.join(sorted(found()))}")
    else:
        spec: Stage = stage(only).stage  # type: ignore[attr-defined]
        checked = load_stage(spec.reads, overrides, spec.root)  # type: ignore[arg-type]
    click.echo(yaml.safe_dump(checked.model_dump(), sort_keys=False), nl=False)
