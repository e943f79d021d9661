"""Stages `figure bounds`, `figure efficiency` and `figure bank-growth`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from psfdae.files import ProductError
from psfdae.reading import read_table

if TYPE_CHECKING:
    import pandas as pd


def errors(bounds_csv: Path, efficiency_csv: Path, dataset: str, out: Path) -> None:
    """Draw the errors of a dataset's methods above the bounds.

    Parameters
    ----------
    bounds_csv : CSV of the stage `bounds`, of one or of all datasets
    efficiency_csv : CSV of the stage `efficiency`
    dataset : what to draw
    out : path of the PNG

    Raises
    ------
    ProductError
        If the tables have no such rows.
    """
    from psfdae.evaluation.bound_figures import errors_above_bounds
    from psfdae.stages.figures import write_png

    tables = (_rows_of(efficiency_csv, dataset), _rows_of(bounds_csv, dataset))
    write_png(errors_above_bounds(*tables, dataset), out)


def efficiency(efficiency_csv: Path, dataset: str, out: Path) -> None:
    """Draw the efficiency of a dataset's methods; raises as `errors`."""
    from psfdae.evaluation.bound_figures import efficiency_against_noise
    from psfdae.stages.figures import write_png

    write_png(efficiency_against_noise(_rows_of(efficiency_csv, dataset), dataset), out)


def growth(growth_csv: Path, dataset: str, out: Path) -> None:
    """Draw the posterior mean's error against the bank's size; raises as `errors`."""
    from psfdae.evaluation.bound_figures import bank_growth
    from psfdae.stages.figures import write_png

    write_png(bank_growth(_rows_of(growth_csv, dataset), dataset), out)


def _rows_of(path: Path, dataset: str) -> pd.DataFrame:

    table = read_table(path)
    rows = table[table.dataset == dataset]
    if rows.empty:
        raise ProductError(f"{path}: no rows of {dataset}")
    return rows
