"""Commands that plan runs far past one machine."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import FileArgument, FolderArgument, input_option, main, out_option, overrides


@main.group("scaling")
def scaling() -> None:
    """What 10⁹ stars, 10⁴ PSF models or a sweep of 10⁵ points cost."""


@scaling.command()
@out_option("CSV with time, memory and disk of every stage over the number of stars.")
@overrides
def stages(out: Path, overrides: tuple[str, ...]) -> None:
    """Measure the stages that grow with the number of stars, on one CPU."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import scaling as stage

    stage.stages(load_stage("scaling", overrides), out)


@scaling.command()
@input_option("snakefile", "Of the workflow.")
@click.option(
    "--jobs",
    "counts",
    type=click.IntRange(min=20),
    multiple=True,
    default=(100, 1000, 10000),
    show_default=True,
    help="Size of a DAG, roughly; repeat for more.",
)
@out_option("CSV with the time of dry runs over the number of jobs.")
def dag(snakefile: Path, counts: tuple[int, ...], out: Path) -> None:
    """Time `snakemake --dry-run` of large workflows."""
    from psfdae.stages import scaling as stage

    stage.dag_times(snakefile, counts, out)


@scaling.command()
@input_option("stages", "CSV of `scaling stages`.")
@input_option("dag", "CSV of `scaling dag`.")
@input_option("runtime", "CSV with the cost of every job of a run.")
@input_option("results", "Folder of a finished run, whose files are counted.", FolderArgument)
@click.option("--home", multiple=True, help="A rule that runs beside snakemake; repeat for more.")
@click.option("--walltime-h", type=click.FloatRange(min=0, min_open=True), default=24.0)
@click.option("--memory-gb", type=click.FloatRange(min=0, min_open=True), default=8.0)
@click.option("--storage-tb", type=click.FloatRange(min=0, min_open=True), default=10.0)
@click.option("--files", type=click.IntRange(min=1), default=1_000_000)
@click.option("--limits", type=FileArgument, required=True, help="CSV: what breaks first.")
@out_option("CSV with core-hours, storage and jobs.")
@overrides
def plan(
    stages: Path,
    dag: Path,
    runtime: Path,
    results: Path,
    home: tuple[str, ...],
    walltime_h: float,
    memory_gb: float,
    storage_tb: float,
    files: int,
    limits: Path,
    out: Path,
    overrides: tuple[str, ...],
) -> None:
    """Predict the cost of large runs from what was measured.

    The options give the limits of a cluster: walltime and memory of a job, space and
    number of files on its file system.
    """
    from psfdae.benchmark.cost import Site
    from psfdae.configuration.compose import load_stage
    from psfdae.stages import scaling as stage

    site = Site(walltime_h, memory_gb, storage_tb, files)
    tables = {"stages": stages, "dag": dag, "runtime": runtime}
    stage.plan(load_stage("scaling", overrides), tables, results, home, site, out, limits)
