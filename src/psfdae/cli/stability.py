"""Commands of the stress tests."""

from __future__ import annotations

from pathlib import Path

import click

from psfdae.cli.base import FileArgument, figure, input_option, main, out_option, overrides


@main.command()
@input_option("stars", "Product of the stage stars, scene 1.")
@input_option("turbulence", "Product of the stage stars, scene 2.")
@out_option("CSV with every case and its verdict.")
@click.option("--graded", type=FileArgument, required=True, help="CSV of error against stress.")
@click.option("--table-only", is_flag=True, help="Leave failing rows to stability-verdict.")
@overrides
def stability(
    stars: Path,
    turbulence: Path,
    out: Path,
    graded: Path,
    table_only: bool,
    overrides: tuple[str, ...],
) -> None:
    """Stress the whole chain; a failing case is exit code 2, with the table written."""
    from psfdae.configuration.compose import load_stage
    from psfdae.stability.rows import check
    from psfdae.stages import stability as stage

    rows = stage.run(load_stage("stability", overrides), stars, turbulence, out, graded)
    if not table_only:
        check(rows)


@main.command()
@click.argument("table", type=FileArgument)
def stability_verdict(table: Path) -> None:
    """Exit with code 2 and the failing rows if a stress test failed."""
    from psfdae.stages import stability_report as stage

    click.echo(f"all {stage.verdict(table)} rows pass")


@figure.command("stability")
@input_option("graded", "CSV of error against stress.")
@out_option("PNG.")
def figure_stability(graded: Path, out: Path) -> None:
    """Draw error against stress."""
    from psfdae.stages import stability_report as stage

    stage.figure(graded, out)
