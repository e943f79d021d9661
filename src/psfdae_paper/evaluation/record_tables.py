"""Comparison of all tables of two runs: rows by their keys, values by their scatter.

Inputs: tables as CSV in the folders of two runs. Outputs: a verdict on each value. Each table of
the run of record has its keys here, and the standard error of each value. Times and memory belong
to a machine, and are not compared.
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

from psfdae.base.reading import read_table
from psfdae_paper.evaluation.comparison import SIGNIFICANT

Scatter = Mapping[str, str | float]
"""Standard error of a value by the name of its column, or a pattern of names: an expression of the
table's columns, or a fraction of the value. Texts must be equal."""

DIGITS, FIT, ROUNDING = 1e-3, 0.05, 0.2
"""Fractions by which values scatter: computed without random numbers; of a training or a draw of
stars; and of errors near the rounding of the processor, which have the same order of magnitude."""

ABSOLUTE = "0.01"
"""Standard error of fractions and correlations, which may be near 0 or 1."""

STARS = "dataset split reference noise_level method metric"
TABLES: dict[str, tuple[str, Scatter]] = {
    # Methods on test stars.
    "*/psf_metrics.csv": (STARS, {"value": FIT, "stderr": FIT}),
    "tables/psf_optics.csv": (STARS, {"value": "stderr"}),
    "tables/psf_held_out.csv": ("dataset reference method noise_level", {"ratio": "stderr"}),
    "tables/dataset?_*.csv": ("source reference method", {"*": FIT}),
    "tables/seed_scatter.csv": ("dataset reference method", {"scatter": ROUNDING}),
    # Bounds.
    "tables/psf_bounds.csv": (STARS, {"value": "stderr", "median": FIT, "tight": 0, "found": 0}),
    "tables/psf_bounds_growth.csv": (
        "dataset reference method noise_level draws",
        {"mse": FIT, "limit": FIT, "last_change": FIT},
    ),
    "tables/psf_efficiency.csv": (
        "dataset reference noise_level method bound",
        {"difference": "stderr", "mse": FIT, "mse_bound": FIT, "efficiency": FIT, "verdict": 0},
    ),
    "tables/paper_rows.csv": (
        "dataset method noise_level",
        {"mse_paper": 0, "mse_bound": "stderr", "mse": FIT, "verdict": 0},
    ),
    # Scene 3.
    "tables/alignment_errors.csv": (
        "test_set noise_level method parameter unit",
        {
            # Of the states and of the training, which was not repeated with other seeds.
            "mean_abs_error": "sqrt(variance_abs / n + (0.05 * mean_abs_error) ** 2)",
            "bias": "sqrt(variance / n + (0.05 * mean_abs_error) ** 2)",
            "variance": "variance * sqrt(2 / n + 0.01)",
        },
    ),
    "tables/alignment_correlation.csv": (
        "test_set noise_level method parameter_a parameter_b",
        {"correlation": "(ci_high - ci_low) / 3.92"},
    ),
    "tables/alignment_paper_correlation.csv": (
        "source test_set noise_level method",
        {"*": ABSOLUTE},
    ),
    "tables/alignment_paper_*.csv": ("source test_set method quantity", {"*": FIT}),
    "tables/alignment_telescope.csv": ("quantity unit", {"value": DIGITS}),
    "tables/alignment_twin.csv": ("noise_level defocus_mm position", {"chi2": FIT}),
    "tables/alignment_time.csv": ("method", {"states": 0}),
    # Models on images.
    "tables/from_stars_selection.csv": ("id", {"x": 0.02, "y": 0.02, "snr": FIT, "verdict": 0}),
    "tables/from_stars.csv": (
        "snr method",
        {"mse": "mse_stderr", "ssim": ABSOLUTE},
    ),
    "tables/predict_coverage.csv": (
        "bundle method noise_level pixels",
        {"coverage*": ABSOLUTE},
    ),
    "tables/predict_poppy.csv": (
        "bundle method noise_level",
        {
            "mse_given": "stderr_given",
            "mse_estimated": "stderr_estimated",
            "mse_table": FIT,
            "coverage*": ABSOLUTE,
            "met": 0,
        },
    ),
    "tables/predict_strange.csv": (
        "noise_level kind measure",
        {"found": "sqrt((found * (1 - found) + 0.01) / stars)"},
    ),
    "tables/predict_throughput.csv": ("stamps stamp_px threads", {"met": 0}),
    # Stress tests.
    "tables/stability.csv": ("case quantity", {"measured": ROUNDING, "verdict": 0}),
    "tables/stability_graded.csv": ("case stress", {"error": ROUNDING, "bound": DIGITS}),
    # Calibration.
    "calibration/fit.csv": ("quantity unit", {"fitted": DIGITS, "configured": 0}),
    "calibration/columns.csv": ("dataset noise_level", {"fitted": 0, "*": DIGITS}),
    "calibration/degeneracy.csv": ("r0_m", {"*": DIGITS}),
    "calibration/scales.csv": ("experiment r0_m pixel_scale_arcsec", {"*": DIGITS}),
    # Benchmarks: their errors.
    "tables/benchmark_convergence.csv": (
        "scene aberration samples points",
        {"mse": ROUNDING, "budget": DIGITS},
    ),
    "tables/benchmark_costs.csv": ("dataset method point settings", {"mse": FIT}),
    "tables/benchmark_propagation.csv": (
        "scene aberration method samples points precision backend threads batch processes",
        {"mse": ROUNDING, "error_peak": ROUNDING, "within_budget": 0},
    ),
    "tables/benchmark_peers.csv": (
        "scene aberration method samples points precision threads processes",
        {"mse": ROUNDING, "within_budget": 0},
    ),
    "tables/benchmark_scaling.csv": ("what against stars stamp_px", {"disk_mb": ROUNDING}),
    "tables/scaling_stages.csv": ("stage stars epochs", {"disk_mb": ROUNDING}),
    "tables/benchmark_inference.csv": ("width stamp_px threads batch", {}),
    "tables/benchmark_machine.csv": ("scene item", {}),
    "runtime.csv": ("rule wildcards", {}),
    # Sweeps.
    "sweeps/*/summary.csv": ("point", {"status": 0, "validation_*": FIT, "test_*": FIT}),
    "sweeps/*/cost.csv": ("point", {}),
}
"""Columns that are the keys of the rows of a table, separated by spaces, and scatter of values."""

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
    for pattern, (keys, scatter) in TABLES.items():
        if fnmatch(name, pattern):
            return keys.split(), scatter
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
        sigma = numbers.eval(rule) if isinstance(rule, str) else rule * numbers[column]
        # A value without its own standard error scatters as of a fit.
        sigmas[column] = pd.Series(sigma, rows.index).fillna(FIT * numbers[column]).fillna(0.0)
    return pd.DataFrame(sigmas, rows.index)
