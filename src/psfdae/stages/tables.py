"""Stages `collect` and `paper-tables`: from evaluations to the tables that people read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from psfdae.files import ProductError, write_text
from psfdae.reading import read_table


def collect(evaluations: Sequence[Path], out: Path) -> None:
    """Join the evaluations of datasets, splits and references into one tidy CSV.

    Raises
    ------
    ProductError
        If an evaluation lacks columns.
    """
    write_text(out, read_evaluations(evaluations).to_csv(index=False, float_format="%.8g"))


def paper_tables(evaluations: Sequence[Path], dataset: str, metric: str, out: Path) -> None:
    """One table of the paper beside ours, as CSV and as Markdown with the same stem.

    Parameters
    ----------
    evaluations : CSV files of the stage `evaluate`
    dataset, metric : which table
    out : path of the CSV
    """
    from psfdae.evaluation.paper import as_markdown, paper_table

    table = paper_table(read_evaluations(evaluations), dataset, metric)
    write_text(out, table.to_csv(index=False, float_format="%.6g"))
    write_text(out.with_suffix(".md"), as_markdown(table, dataset, metric))


def read_evaluations(evaluations: Sequence[Path]):  # type: ignore[no-untyped-def]
    """Join CSV files of the stage `evaluate`.

    Raises
    ------
    ProductError
        If a file has other columns.
    """
    import pandas as pd

    columns = ["dataset", "split", "reference", "method", "noise_level", "metric"]
    columns += ["value", "stderr", "n"]
    parts = []
    for path in evaluations:
        part = read_table(path)
        if list(part.columns) != columns:
            raise ProductError(f"{path}: columns {list(part.columns)}, expected {columns}")
        parts.append(part)
    return pd.concat(parts, ignore_index=True)
