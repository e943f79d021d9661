"""Stages `stability-verdict` and `figure stability`: what the stress tests say."""

from __future__ import annotations

from pathlib import Path

from psfdae.files import ProductError
from psfdae.reading import read_table
from psfdae.stability.rows import check, read_rows


def verdict(table: Path) -> int:
    """Number of rows of a table that all pass.

    Raises
    ------
    StabilityError
        If a row fails; names them all.
    """
    rows = read_rows(table)
    check(rows)
    return len(rows)


def figure(graded: Path, out: Path) -> None:
    """Draw the graded stress tests.

    Parameters
    ----------
    graded : CSV of the stage `stability`
    out : path of the PNG

    Raises
    ------
    ProductError
        If the file lacks columns or rows.
    """

    from psfdae.stability.figure import graded_stress
    from psfdae.stages.figures import write_png

    table = read_table(graded)
    if list(table.columns) != ["case", "stress", "error", "bound"] or table.empty:
        raise ProductError(f"{graded}: not a table of graded stress tests")
    write_png(graded_stress(table), out)
