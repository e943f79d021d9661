"""Command line: one command per stage.

Only click is imported at the top; each command imports its stage when it runs.
"""

from __future__ import annotations

import sys
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
        """Run the command; a refusal of ours is a message, a bug stays a traceback."""
        try:
            return super().invoke(ctx)
        except (RuntimeError, ValueError) as error:
            if not type(error).__module__.startswith("psfdae"):
                raise
            click.echo(f"psfdae: {error}", err=True)
            ctx.exit(2)


@click.group(cls=StageGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(psfdae.__version__)
def main() -> None:
    """PSF modelling with a denoising autoencoder, one command per stage.

    OVERRIDES are Hydra overrides, such as dataset=dataset5 train.lr=1e-3; the
    groups and keys are those of the config folder.
    """


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


@main.command()
@click.option("--stage", help="Only the groups that this stage reads.")
@overrides
def config(stage: str | None, overrides: tuple[str, ...]) -> None:
    """Check the configuration and print it, resolved, as YAML."""
    import yaml

    from psfdae.configuration.compose import load, load_stage
    from psfdae.configuration.schema import STAGE_KEYS

    if stage is not None and stage not in STAGE_KEYS:
        raise click.BadParameter(f"{stage!r} is not one of {', '.join(STAGE_KEYS)}")
    checked = load_stage(stage, overrides) if stage else load(overrides)
    click.echo(yaml.safe_dump(checked.model_dump(), sort_keys=False), nl=False)


@main.command()
@out_option("HDF5 product with the static PSF of every field point.")
@overrides
def templates(out: Path, overrides: tuple[str, ...]) -> None:
    """Propagate the static PSF of every field point."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import templates as stage

    stage.run(load_stage("templates", overrides), out)


@main.command()
@input_option("templates", "Product of the stage templates.")
@out_option("HDF5 product with noise-free stars.")
@overrides
def stars(templates: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Simulate noise-free stars with random aberrations."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import stars as stage

    stage.run(load_stage("stars", overrides), templates, out)


@main.command()
@input_option("stars", "Product of the stage stars.")
@split_option
@out_option("HDF5 product with the fitted PCA+SOM.")
@overrides
def baseline(stars: Path, split: str, out: Path, overrides: tuple[str, ...]) -> None:
    """Fit the PCA+SOM baseline."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import baseline as stage

    stage.run(load_stage("baseline", overrides), stars, split, out)


@main.command()
@input_option("stars", "Product of the stage stars.")
@split_option
@reference_option
@click.option(
    "--checkpoint",
    type=FileArgument,
    help="State of an interrupted training.  [default: OUT/checkpoint.pt]",
)
@out_option("Folder for weights, resolved config and history.", FolderArgument)
@overrides
def train(
    stars: Path,
    split: str,
    reference: str,
    checkpoint: Path | None,
    out: Path,
    overrides: tuple[str, ...],
) -> None:
    """Train a denoising autoencoder; resumes from its checkpoint."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import train as stage

    checked = load_stage("train", overrides)
    stage.run(checked, stars, split, reference, out, checkpoint or out / "checkpoint.pt")


@main.command()
@click.option("--dataset", required=True, help="Name that goes into the table.")
@input_option("stars", "Product of the stage stars.")
@input_option("pca-som", "Product of the stage baseline.")
@input_option("dae", "Folder of a trained network.", FolderArgument)
@split_option
@reference_option
@click.option("--per-star", type=FileArgument, required=True, help="Parquet with every star.")
@out_option("CSV with means and standard errors.")
@overrides
def evaluate(
    dataset: str,
    stars: Path,
    pca_som: Path,
    dae: Path,
    split: str,
    reference: str,
    per_star: Path,
    out: Path,
    overrides: tuple[str, ...],
) -> None:
    """Measure every method on the test stars at each noise level."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import evaluate as stage

    checked = load_stage("evaluate", overrides)
    stage.run(checked, dataset, stars, pca_som, dae, split, reference, out, per_star)


@main.command()
@out_option("Tidy CSV.")
@click.argument("evaluations", nargs=-1, type=FileArgument, required=True)
def collect(out: Path, evaluations: tuple[Path, ...]) -> None:
    """Join evaluations into one tidy table."""
    from psfdae.stages.tables import collect as stage

    stage(evaluations, out)


@main.command()
@click.option("--dataset", required=True)
@click.option("--metric", type=click.Choice(["mse", "ssim"]), required=True)
@out_option("CSV; the Markdown goes beside it.")
@click.argument("evaluations", nargs=-1, type=FileArgument, required=True)
def paper_tables(dataset: str, metric: str, out: Path, evaluations: tuple[Path, ...]) -> None:
    """Write one of the paper's tables, ours beside the paper's."""
    from psfdae.stages.tables import paper_tables as stage

    stage(evaluations, dataset, metric, out)


if __name__ == "__main__":
    sys.exit(main())
