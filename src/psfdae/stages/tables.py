"""Stages `collect` and `paper-tables`: from evaluations to the tables that people read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from psfdae.cli import File, command
from psfdae.files import ProductError, write_text
from psfdae.reading import read_table

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ["dataset", "split", "reference", "method", "noise_level", "metric"]
COLUMNS += ["value", "stderr", "n"]

Evaluations = Annotated[tuple[File, ...], {"argument": True}]
Metric = Literal["mse", "ssim"]


@command("collect")
def collect(evaluations: Evaluations, out: Annotated[File, "Tidy CSV."]) -> None:
    """Join evaluations into one tidy table."""
    write_text(out, read_evaluations(evaluations).to_csv(index=False, float_format="%.8g"))


@command("paper-tables")
def paper_tables(
    dataset: str,
    metric: Metric,
    evaluations: Evaluations,
    out: Annotated[File, "CSV; the Markdown goes beside it."],
) -> None:
    """Write one of the paper's tables, ours beside the paper's."""
    from psfdae.evaluation.paper import as_markdown, paper_table

    table = paper_table(read_evaluations(evaluations), dataset, metric)
    write_text(out, table.to_csv(index=False, float_format="%.6g"))
    write_text(out.with_suffix(".md"), as_markdown(table, dataset, metric))


def read_evaluations(evaluations: Sequence[Path]) -> pd.DataFrame:
    """Join CSV files of the stage `evaluate`; raises ProductError if one has other columns."""
    import pandas as pd

    parts = []
    for path in evaluations:
        part = read_table(path)
        if list(part.columns) != COLUMNS:
            raise ProductError(f"{path}: columns {list(part.columns)}, expected {COLUMNS}")
        parts.append(part)
    return pd.concat(parts, ignore_index=True)
