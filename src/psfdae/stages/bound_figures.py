"""Stages `figure bounds`, `figure efficiency` and `figure bank-growth`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from psfdae.cli import File, command
from psfdae.files import ProductError
from psfdae.reading import read_table

if TYPE_CHECKING:
    import pandas as pd

DatasetName = Annotated[str, "Name in the tables."]
Png = Annotated[File, "PNG."]


@command("figure bounds")
def figure_bounds(
    dataset: DatasetName,
    bounds: Annotated[File, "CSV of the stage bounds."],
    efficiency: Annotated[File, "CSV of the stage efficiency."],
    out: Png,
) -> None:
    """Draw the methods' errors above the bounds."""
    from psfdae.evaluation.bound_figures import errors_above_bounds
    from psfdae.stages.figures import write_png

    tables = (_rows_of(efficiency, dataset), _rows_of(bounds, dataset))
    write_png(errors_above_bounds(*tables, dataset), out)


@command("figure efficiency")
def figure_efficiency(
    dataset: DatasetName,
    efficiency: Annotated[File, "CSV of the stage efficiency."],
    out: Png,
) -> None:
    """Draw the methods' efficiency against the noise level."""
    from psfdae.evaluation.bound_figures import efficiency_against_noise
    from psfdae.stages.figures import write_png

    write_png(efficiency_against_noise(_rows_of(efficiency, dataset), dataset), out)


@command("figure bank-growth")
def figure_bank_growth(
    dataset: DatasetName,
    growth: Annotated[File, "CSV of the stage bounds: error by size of the bank."],
    out: Png,
) -> None:
    """Draw the posterior mean's error against the size of the bank."""
    from psfdae.evaluation.bound_figures import bank_growth
    from psfdae.stages.figures import write_png

    write_png(bank_growth(_rows_of(growth, dataset), dataset), out)


def _rows_of(path: Path, dataset: str) -> pd.DataFrame:
    table = read_table(path)
    rows = table[table.dataset == dataset]
    if rows.empty:
        raise ProductError(f"{path}: no rows of {dataset}")
    return rows
