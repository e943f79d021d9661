"""Commands of scene 3, the alignment of a secondary mirror."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import FileArgument, input_option, main, out_option, overrides


@main.group()
def alignment() -> None:
    """Scene 3: alignment of a secondary mirror (config/alignment.yaml)."""


@alignment.command("config")
@click.option("--stage", help="Only the groups that this stage reads.")
@overrides
def alignment_config(stage: str | None, overrides: tuple[str, ...]) -> None:
    """Check the configuration of scene 3 and print it, resolved, as YAML."""
    import yaml

    from psfdae.configuration.alignment import ALIGNMENT_STAGE_KEYS
    from psfdae.configuration.compose import load, load_stage

    if stage is not None and stage not in ALIGNMENT_STAGE_KEYS:
        raise click.BadParameter(f"{stage!r} is not one of {', '.join(ALIGNMENT_STAGE_KEYS)}")
    checked = load_stage(stage, overrides) if stage else load(overrides, "alignment")
    click.echo(yaml.safe_dump(checked.model_dump(), sort_keys=False), nl=False)


@alignment.command("model")
@out_option("HDF5 product with the quadratic model of the wavefront.")
@overrides
def alignment_model(out: Path, overrides: tuple[str, ...]) -> None:
    """Fit the quadratic model to few ray-traced states, verify it on the grid."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import alignment as stage

    stage.model(load_stage("alignment_model", overrides), out)


@alignment.command("states")
@click.option("--set", "kind", type=click.Choice(["grid", "uniform", "train"]), required=True)
@click.option(
    "--model",
    type=FileArgument,
    help="Product of `alignment model`: take wavefronts from it instead of tracing rays.",
)
@out_option("HDF5 product with states and their noise-free stamps.")
@overrides
def alignment_states(kind: str, model: Path | None, out: Path, overrides: tuple[str, ...]) -> None:
    """Simulate the noise-free stamps of a set of states."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import alignment as stage

    stage.states(load_stage("alignment_states", overrides), kind, model, out)


@alignment.command("telescope")
@input_option("model", "Product of `alignment model`.")
@input_option("grid", "Product of `alignment states --set grid`.")
@input_option("uniform", "Product of `alignment states --set uniform`.")
@out_option("CSV with key figures.")
@overrides
def alignment_telescope(
    model: Path, grid: Path, uniform: Path, out: Path, overrides: tuple[str, ...]
) -> None:
    """Tabulate key figures of telescope, model and stamps."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import alignment as stage

    stage.telescope(load_stage("alignment_telescope", overrides), model, grid, uniform, out)
