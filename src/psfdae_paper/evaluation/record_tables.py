"""Comparison of all tables of two runs: rows by their keys, values by their scatter.

Inputs: tables as CSV in the folders of two runs. Outputs: a verdict on each value. The file
record_tables.yaml has the keys of each table of the run of record, and the standard errors of its
values. Times and memory belong to a machine, and are not compared.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from fnmatch import fnmatch
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pandas.errors import UndefinedVariableError

from psfdae.base.reading import read_table, read_yaml
from psfdae_paper.evaluation.comparison import SIGNIFICANT

Scatter = Mapping[str, str | float]
"""Standard error of a value by the name of its column, or a pattern of names: an expression of the
table's columns, or a fraction of the value. Texts must be equal."""

TABLES: dict[str, dict[str, Any]] = read_yaml(Path(__file__).with_suffix(".yaml"))["tables"]
"""Keys of the rows of a table, and scatter of its values, by a pattern of file names."""

FIT = 0.05
"""Fraction by which a value scatters that depends on a training or a draw of stars."""

MACHINE = re.compile(r"(.*_)?(s|ms|mb|seconds|time|speedup)(_.*)?")
"""Columns of tables without an entry that are times or memory."""


def list_tables(folder: Path) -> set[str]:
    """Return the names of the tables of a run that a record has, relative to its folder."""
    patterns = ("tables/*.csv", "calibration/*.csv", "sweeps/*/*.csv", "paper/tables/*.csv")
    paths = (path for pattern in (*patterns, "runtime.csv") for path in folder.glob(pattern))
    return {path.relative_to(folder).as_posix() for path in paths}


def find_rule(name: str, table: pd.DataFrame) -> tuple[list[str], Scatter]:
    """Return the keys of a table and the scatter of its values.

    Parameters
    ----------
    name : str
        Name of the table relative to the folder of the run.
    table : DataFrame
        The table as texts. Without an entry in `TABLES`, texts and noise levels are its keys, and
        all other values scatter as of a fit, except times and memory.
    """
    for pattern, rule in TABLES.items():
        if fnmatch(name, pattern):
            # The axes of a sweep are between the name of the point and its status.
            columns, row = [*table.columns], rule["row"]
            axes = columns[1 : columns.index("status")] if row == "axes" else row
            return axes, rule["scatter"]
    numbers = _to_numbers(table)
    text_columns = [c for c in table.columns if c == "noise_level" or numbers[c].isna().all()]
    values = [c for c in table.columns.difference(text_columns) if not MACHINE.fullmatch(c)]
    return text_columns, dict.fromkeys(values, FIT)


def compare_values(first: Path, second: Path, name: str) -> pd.DataFrame:
    """Compare each value of a table that two runs have.

    Parameters
    ----------
    first, second : Path
        Folders of the runs.
    name : str
        Name of the table relative to both.

    Returns
    -------
    DataFrame
        A row for each value: the `row` of the table by its keys, the `column`, values `first` and
        `second` as texts, and the `verdict`: "equal"; "within" `SIGNIFICANT` standard errors of
        the difference; "beyond" that; or "missing", of rows that only one of the tables has.

    Raises
    ------
    ProductError
        If a table is damaged, or lacks one of its keys.
    """
    options: dict[str, Any] = {"dtype": str, "keep_default_na": False}
    keys, scatter = find_rule(name, read_table(second / name, **options))
    texts = [read_table(run / name, *keys, **options) for run in (first, second)]
    for table, key in product(texts, keys):
        # The same number may be written as 0 and as 0.0.
        numbers = pd.to_numeric(table[key], errors="coerce")
        table[key] = table[key].mask(numbers.notna(), numbers.map("{:.9g}".format))
    # Rows of a table of numbers alone have equal keys.
    if not keys:
        keys, texts = ["row"], [table.assign(row="") for table in texts]
    # Of equal keys, the first rows belong together, then the second ones.
    rows = [t.assign(copy=t.groupby(keys).cumcount()).set_index([*keys, "copy"]) for t in texts]
    common = rows[0].index.intersection(rows[1].index)
    lone = rows[0].index.symmetric_difference(rows[1].index)
    names = rows[0].columns.intersection(rows[1].columns)
    columns = [c for c in names if any(fnmatch(c, pattern) for pattern in scatter)]
    old, new = (table.loc[common] for table in rows)
    # 3 σ of the difference of two independent values; 0 if texts differ.
    sigma, new_sigma = (_compute_scatter(table, scatter)[columns] for table in (old, new))
    limit = SIGNIFICANT * np.sqrt(sigma**2 + new_sigma**2)
    difference = (_to_numbers(new[columns]) - _to_numbers(old[columns])).abs()
    is_equal = (old[columns] == new[columns]) | (difference == 0)
    verdict = np.where(is_equal, "equal", np.where(difference <= limit, "within", "beyond"))
    values = {
        "row": np.repeat(_name_rows(common), len(columns)),
        "column": columns * len(common),
        "first": old[columns].to_numpy().ravel(),
        "second": new[columns].to_numpy().ravel(),
        "verdict": verdict.ravel(),
    }
    missing = {"row": _name_rows(lone), "column": "", "first": "", "second": ""}
    tables = [pd.DataFrame(values), pd.DataFrame({**missing, "verdict": "missing"})]
    return pd.concat(tables, ignore_index=True)


def _name_rows(index: pd.Index) -> list[str]:
    """Return the keys of rows as texts; the last level of the index is a number."""
    return [", ".join(str(part) for part in key[:-1] if part != "") for key in index]


def _to_numbers(table: pd.DataFrame) -> pd.DataFrame:
    """Return the numbers of a table of texts, NaN for all other texts."""
    numbers = {c: pd.to_numeric(table[c], errors="coerce") for c in table.columns}
    return pd.DataFrame(numbers, table.index)


def _compute_scatter(rows: pd.DataFrame, scatter: Scatter) -> pd.DataFrame:
    """Return the standard errors of all values of a table, 0 for texts; its index are its keys."""
    # An expression may have a key.
    numbers = _to_numbers(rows.reset_index()).set_axis(rows.index)
    sigmas = {}
    for column in rows.columns:
        rule = next((s for pattern, s in scatter.items() if fnmatch(column, pattern)), 0)
        try:
            sigma = numbers.eval(rule) if isinstance(rule, str) else rule * numbers[column]
        except UndefinedVariableError:  # tables of other versions lack columns
            sigma = np.nan
        # A value without its own standard error scatters as of a fit.
        sigmas[column] = pd.Series(sigma, rows.index).fillna(FIT * numbers[column]).fillna(0.0)
    return pd.DataFrame(sigmas, rows.index)
