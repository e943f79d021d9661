"""Commands of scene 3 that train, estimate, fit, tabulate and draw."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from psfdae.cli.alignment import alignment
from psfdae.cli.base import FileArgument, FolderArgument, input_option, out_option, overrides

CHECKPOINT = "File that lets an interrupted training resume."
STATES = "Product of `alignment states`."
MODEL = "Product of `alignment model`."
DAE = "Folder of `alignment train-dae`."

set_option = click.option(
    "--set", "test_set", type=click.Choice(["grid", "uniform"]), required=True
)


def folder_option(name: str, what: str) -> Callable[..., Any]:
    """An option that names an input folder."""
    return input_option(name, what, FolderArgument)


def many_option(name: str, variable: str, what: str) -> Callable[..., Any]:
    """An option for a file that may be given more than once."""
    return click.option(
        f"--{name}", variable, type=FileArgument, multiple=True, required=True, help=what
    )


@alignment.command("train-dae")
@input_option("grid", "Product of `alignment states --set grid`.")
@input_option("train", "Product of `alignment states --set train`: its first states validate.")
@input_option("checkpoint", CHECKPOINT)
@out_option("Folder for weights, config and history.", FolderArgument)
@overrides
def alignment_train_dae(
    grid: Path, train: Path, checkpoint: Path, out: Path, overrides: tuple[str, ...]
) -> None:
    """Train the DAE on the stamps of the grid."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import alignment_train as stage

    config = load_stage("alignment_dae", overrides)
    stage.train_dae_stamps(config, grid, train, out, checkpoint)


@alignment.command("train-cnn")
@click.option(
    "--kind",
    type=click.Choice(["original", "noise_trained", "dae_retrained"]),
    required=True,
    help="Clean stamps, noisy stamps, or the DAE's output for noisy stamps.",
)
@input_option("states", "Product of `alignment states`: the grid or the large set.")
@click.option("--dae", type=FolderArgument, help=DAE + " For dae_retrained only.")
@input_option("checkpoint", CHECKPOINT)
@out_option("Folder for weights, config and history.", FolderArgument)
@overrides
def alignment_train_cnn(
    kind: str,
    states: Path,
    dae: Path | None,
    checkpoint: Path,
    out: Path,
    overrides: tuple[str, ...],
) -> None:
    """Train a CNN that estimates states of misalignment."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import alignment_train as stage

    config = load_stage(f"alignment_{kind}", overrides)
    if (kind == "dae_retrained") != (dae is not None):
        raise click.UsageError("--dae goes with --kind dae_retrained, and only with it")
    if kind == "original":
        stage.train_original(config, states, out, checkpoint)
    elif dae is None:
        stage.train_noise_trained(config, states, out, checkpoint)
    else:
        stage.train_dae_retrained(config, states, dae, out, checkpoint)


@alignment.command("estimate")
@set_option
@input_option("states", STATES)
@folder_option("dae", DAE)
@folder_option("original", "Folder of the CNN of that name.")
@folder_option("noise-trained", "Folder of the CNN of that name.")
@folder_option("dae-retrained", "Folder of the CNN of that name.")
@out_option("HDF5 product with the estimates of all learned methods.")
@input_option("times", "CSV that receives the run times.")
@overrides
def alignment_estimate(
    test_set: str,
    states: Path,
    dae: Path,
    original: Path,
    noise_trained: Path,
    dae_retrained: Path,
    out: Path,
    times: Path,
    overrides: tuple[str, ...],
) -> None:
    """Estimate the states of a test set with every learned method."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import alignment_evaluate as stage

    cnns = {"original": original, "noise_trained": noise_trained, "dae_retrained": dae_retrained}
    config = load_stage("alignment_estimate", overrides)
    stage.estimate(config, test_set, states, dae, cnns, out, times)


@alignment.command("fit")
@set_option
@click.option(
    "--level", type=click.FloatRange(0, min_open=True), required=True, help="Noise level λ."
)
@input_option("states", STATES)
@input_option("model", MODEL)
@folder_option("cnn", "Folder of the CNN that starts the fit.")
@out_option("HDF5 product with the fits.")
@input_option("times", "CSV that receives the run time.")
@overrides
def alignment_fit(
    test_set: str,
    level: float,
    states: Path,
    model: Path,
    cnn: Path,
    out: Path,
    times: Path,
    overrides: tuple[str, ...],
) -> None:
    """Fit the states of a test set by maximum likelihood."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import alignment_evaluate as stage

    config = load_stage("alignment_fit", overrides)
    stage.fit(config, test_set, level, states, model, cnn, out, times)


@alignment.command("bound")
@set_option
@input_option("states", STATES)
@input_option("model", MODEL)
@out_option("HDF5 product with Cramér-Rao bounds.")
@overrides
def alignment_bound(
    test_set: str, states: Path, model: Path, out: Path, overrides: tuple[str, ...]
) -> None:
    """Bound the errors of any unbiased estimate."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import alignment_evaluate as stage

    stage.bound(load_stage("alignment_bound", overrides), test_set, states, model, out)


@alignment.command("tables")
@input_option("states", STATES)
@many_option("estimates", "estimates", "Product of `alignment estimate`.")
@many_option("fit", "fits", "Product of `alignment fit`.")
@many_option("bound", "bounds", "Product of `alignment bound`.")
@input_option("errors", "CSV that receives the errors.")
@input_option("correlation", "CSV that receives their correlations.")
def alignment_tables(
    states: Path,
    estimates: tuple[Path, ...],
    fits: tuple[Path, ...],
    bounds: tuple[Path, ...],
    errors: Path,
    correlation: Path,
) -> None:
    """Tabulate errors and their correlations."""
    from psfdae.stages import alignment_tables as stage

    stage.tables(states, estimates, fits, bounds, errors, correlation)


@alignment.command("paper-tables")
@input_option("errors", "CSV of `alignment tables`.")
@input_option("correlation", "CSV of `alignment tables`.")
@out_option("Folder for CSV and Markdown files.", FolderArgument)
def alignment_paper_tables(errors: Path, correlation: Path, out: Path) -> None:
    """Set the paper's tables beside ours."""
    from psfdae.stages import alignment_tables as stage

    stage.paper_tables(errors, correlation, out)


@alignment.command("time-table")
@many_option("times", "times", "CSV of `alignment estimate` or `alignment fit`.")
@click.option(
    "--history", "histories", multiple=True, required=True, metavar="NAME=FILE", help="A training."
)
@out_option("CSV with the cost of an estimate and of the trainings.")
def alignment_time_table(times: tuple[Path, ...], histories: tuple[str, ...], out: Path) -> None:
    """Tabulate what the methods cost."""
    from psfdae.stages import alignment_tables as stage

    named = {name: Path(path) for name, _, path in (text.partition("=") for text in histories)}
    stage.time_table(times, named, out)


@alignment.group("figure")
def alignment_figure() -> None:
    """Draw a figure of scene 3 as PNG."""


@alignment_figure.command("stamps")
@input_option("states", STATES)
@folder_option("dae", DAE)
@out_option("PNG.")
@overrides
def figure_stamps(states: Path, dae: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Draw the nine stamps of a few states before and after the DAE."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import alignment_figures as stage

    stage.stamps(load_stage("alignment_estimate", overrides), states, dae, out)


@alignment_figure.command("predicted")
@input_option("estimates", "Product of `alignment estimate`.")
@many_option("fit", "fits", "Product of `alignment fit` of the same states.")
@out_option("PNG.")
def figure_predicted(estimates: Path, fits: tuple[Path, ...], out: Path) -> None:
    """Draw estimates against the truth."""
    from psfdae.stages import alignment_figures as stage

    stage.predicted(estimates, fits, out)


@alignment_figure.command("errors")
@many_option("estimates", "estimates", "Product of `alignment estimate`.")
@many_option("fit", "fits", "Product of `alignment fit`.")
@many_option("bound", "bounds", "Product of `alignment bound`.")
@out_option("PNG.")
def figure_errors(
    estimates: tuple[Path, ...], fits: tuple[Path, ...], bounds: tuple[Path, ...], out: Path
) -> None:
    """Draw errors against the size of the misalignment."""
    from psfdae.stages import alignment_figures as stage

    stage.errors(estimates, fits, bounds, out)


@alignment_figure.command("twin")
@input_option("table", "CSV that receives the curves.")
@out_option("PNG.")
@overrides
def figure_twin(table: Path, out: Path, overrides: tuple[str, ...]) -> None:
    """Draw a state and its twin, in focus and with the CCD's defocus."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import alignment_figures as stage

    stage.twin(load_stage("alignment_twin", overrides), table, out)


@alignment_figure.command("correlation")
@input_option("correlation", "CSV of `alignment tables`.")
@out_option("PNG.")
def figure_correlation(correlation: Path, out: Path) -> None:
    """Draw measured and predicted correlations of errors beside the paper's."""
    from psfdae.stages import alignment_figures as stage

    stage.correlation(correlation, out)
