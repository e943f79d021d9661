"""Tables of scene 3: errors of states and their correlations, measured and published.

Inputs: errors of estimated states (n, 4), or the covariances (n, 4, 4) that bound them. Outputs:
rows of the tables of errors and correlations, and tables that compare them with the paper's.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from psfdae_paper.alignment.likelihood import compute_mean_abs_error
from psfdae_paper.alignment.telescope import DEGREES_OF_FREEDOM
from psfdae_paper.configuration.estimators import ESTIMATORS
from psfdae_paper.evaluation.paper import read_published

Row = dict[str, object]
"""Row of a table: values by column."""

Key = Mapping[str, Any]
"""First columns of a row: test_set, noise_level and method."""


def tabulate_errors(key: Key, errors: np.ndarray, unit: np.ndarray) -> list[Row]:
    """Return the rows of one method in the table of errors.

    Parameters
    ----------
    key : dict
        test_set, noise_level and method.
    errors : ndarray, shape (n, 4)
        Estimate minus truth in units of the range.
    unit : ndarray, shape (4,)
        The range in m, m, rad, rad.

    Returns
    -------
    list of dict
        One row in units of the range and one in SI units for each parameter. `variance` is the
        variance of the signed error, `variance_abs` the variance of the absolute error, which the
        paper tabulates.
    """
    # Statistics over all states, one number for each of the four parameters.
    absolute = np.abs(errors)
    statistics = {
        "mean_abs_error": absolute.mean(axis=0),
        "bias": errors.mean(axis=0),
        "variance": errors.var(axis=0),
        "variance_abs": absolute.var(axis=0),
    }
    return _tabulate_in_both_units(key, statistics, unit, len(errors))


def tabulate_bounds(key: Key, covariances: np.ndarray, unit: np.ndarray) -> list[Row]:
    """Return the rows of the error table that unbiased normal errors at the bound would have.

    Parameters
    ----------
    key : dict
        test_set, noise_level and method.
    covariances : ndarray, shape (n, 4, 4)
        Cramér–Rao bounds of the states, in squared units of the range.
    unit : ndarray, shape (4,)
        The range in m, m, rad, rad.
    """
    # Marginal variance of each parameter, for every state.
    variance = np.diagonal(covariances, axis1=1, axis2=2)
    # ⟨|e|⟩ over all states; the variance of |e| is ⟨e²⟩ − ⟨|e|⟩².
    absolute = compute_mean_abs_error(covariances).mean(axis=0)
    statistics = {
        "mean_abs_error": absolute,
        "bias": np.zeros(4),
        "variance": variance.mean(axis=0),
        "variance_abs": variance.mean(axis=0) - absolute**2,
    }
    return _tabulate_in_both_units(key, statistics, unit, len(covariances))


def _tabulate_in_both_units(
    key: Key, statistics: Mapping[str, np.ndarray], unit: np.ndarray, count: int
) -> list[Row]:
    """Return a row in units of the range and one in SI units for each parameter."""
    rows: list[Row] = []
    # Decentres are lengths, tilts are angles.
    si_units = ("m", "m", "rad", "rad")
    for index, (parameter, si_unit) in enumerate(zip(DEGREES_OF_FREEDOM, si_units, strict=True)):
        for unit_name, scale in (("range", 1.0), (si_unit, unit[index])):
            # Variances scale with the square of the unit.
            values = {
                column: float(value[index] * scale ** (2 if column.startswith("variance") else 1))
                for column, value in statistics.items()
            }
            rows.append({**key, "parameter": parameter, **values, "unit": unit_name, "n": count})
    return rows


def tabulate_correlations(
    key: Key, matrix: np.ndarray, low: np.ndarray, high: np.ndarray
) -> list[Row]:
    """Return the rows of the correlation table for all pairs of parameters.

    `matrix` (4, 4) has the correlations, `low` and `high` (4, 4) the ends of their intervals.
    """
    rows: list[Row] = []
    # All ordered pairs, the diagonal included.
    for a, b in product(range(4), repeat=2):
        pair = {"parameter_a": DEGREES_OF_FREEDOM[a], "parameter_b": DEGREES_OF_FREEDOM[b]}
        interval = {"ci_low": low[a, b], "ci_high": high[a, b]}
        rows.append({**key, **pair, "correlation": matrix[a, b], **interval})
    return rows


def tabulate_bound_correlations(key: Key, covariances: np.ndarray) -> list[Row]:
    """Return correlations that the Fisher matrix predicts, for single and for all states.

    Method `cramer_rao` is the mean over states of each state's correlation; its interval contains
    95 % of the states. `cramer_rao_pooled` is the correlation of errors drawn with these
    covariances, which states with large errors dominate; its interval is Fisher's for a sample of
    as many states. Compare measured correlations with `cramer_rao_pooled`.

    Parameters
    ----------
    key : dict
        test_set and noise_level.
    covariances : ndarray, shape (n, 4, 4)
        Cramér–Rao bounds of the states, in squared units of the range.
    """
    # Correlation C_ij / (σ_i σ_j) of each state.
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    state_correlation = covariances / (sigma[:, :, None] * sigma[:, None, :])
    low, high = np.quantile(state_correlation, [0.025, 0.975], axis=0)
    mean_correlation = state_correlation.mean(axis=0)
    rows = tabulate_correlations({**key, "method": "cramer_rao"}, mean_correlation, low, high)
    # Correlation of the mean covariance, with Fisher's interval: artanh of a correlation of n
    # pairs is normal with the standard deviation 1/√(n − 3).
    mean_covariance = covariances.mean(axis=0)
    pooled_sigma = np.sqrt(np.diag(mean_covariance))
    pooled_correlation = mean_covariance / np.outer(pooled_sigma, pooled_sigma)
    within_one = np.clip(pooled_correlation, -1.0, 1.0)
    low, high = compute_fisher_interval(within_one, len(covariances), 1.959964)
    key = {**key, "method": "cramer_rao_pooled"}
    return rows + tabulate_correlations(key, pooled_correlation, low, high)


def compare_errors(errors: pd.DataFrame, level: float) -> pd.DataFrame:
    """Return the paper's error table of one noise level, followed by the measured rows.

    Returns
    -------
    DataFrame
        Columns source (paper or psfdae), test_set, method, quantity (mean or
        variance of the absolute error) and one per parameter, in units of the range.
    """
    # The paper's rows and the measured ones get the same columns, in units of the range.
    paper = read_published("alignment")
    paper = paper[np.isclose(paper.noise_level, level)].assign(source="paper", test_set="")
    paper = paper.rename(columns={"mean_error": "mean"})
    measured_rows = errors[np.isclose(errors.noise_level, level) & (errors.unit == "range")]
    measured_rows = measured_rows.assign(
        source="psfdae", mean=measured_rows.mean_abs_error, variance=measured_rows.variance_abs
    )
    columns = ["source", "test_set", "method", "parameter", "mean", "variance"]
    rows = pd.concat([paper[columns], measured_rows[columns]], ignore_index=True)
    # One row for the mean and one for the variance of the absolute error.
    rows = rows.melt(columns[:4], var_name="quantity", value_name="value")
    index = ["source", "test_set", "method", "quantity"]
    return _pivot(rows, "parameter", list(DEGREES_OF_FREEDOM), index)


def compare_correlations(correlations: pd.DataFrame) -> pd.DataFrame:
    """Return the paper's correlation table, followed by the measured rows.

    Returns
    -------
    DataFrame
        Columns source, test_set, noise_level, method and one per pair.
    """
    # Pairs of parameters that the paper has, at levels with noise.
    pairs = [f"{parameter}-tilt_y" for parameter in ("decenter_x", "decenter_y", "tilt_x")]
    paper = read_published("correlation").assign(source="paper", test_set="")
    measured_rows = correlations.assign(
        source="psfdae", pair=correlations.parameter_a + "-" + correlations.parameter_b
    )
    columns = ["source", "test_set", "noise_level", "method", "pair", "correlation"]
    rows = pd.concat([paper[columns], measured_rows.loc[measured_rows.pair.isin(pairs), columns]])
    rows = rows[rows.noise_level > 0].rename(columns={"correlation": "value"})
    index = ["source", "test_set", "noise_level", "method"]
    return _pivot(rows, "pair", pairs, index)


def _pivot(
    rows: pd.DataFrame, column: str, column_order: list[str], index: list[str]
) -> pd.DataFrame:
    """Return a table with one row per index and a column for each value of `column`.

    Rows are sorted by the index, methods in the order of `ESTIMATORS`.
    """
    # A column for each parameter or pair.
    rows = rows.assign(method=pd.Categorical(rows["method"], list(ESTIMATORS)))
    table = rows.pivot(index=index, columns=column, values="value")[column_order]
    return table.sort_index().rename_axis(columns=None).reset_index()


def format_table(table: pd.DataFrame, digits: dict[str, str]) -> pd.DataFrame:
    """Return a table of `compare_errors` or `compare_correlations` as texts.

    Parameters
    ----------
    table : DataFrame
        Four columns of keys, among them source and method, then numbers.
    digits : dict
        Number format by the value of the column `quantity`; the key "" is for tables without it.
    """
    # Numbers as text; a value that was not measured or published is left empty.
    text_table = table.astype(object).where(table.notna(), "")
    keys = text_table.columns[:4]
    text_table[keys] = text_table[keys].map(lambda k: f"{k:g}" if isinstance(k, float) else k)
    quantities = table.get("quantity", pd.Series("", index=table.index))
    for column in table.columns[4:]:
        text_table[column] = [
            "" if pd.isna(value) else format(value, digits[quantity])
            for value, quantity in zip(table[column], quantities, strict=True)
        ]
    # The paper's rows have its own names of the methods.
    looks = zip(table["source"], (ESTIMATORS[name].look for name in table["method"]), strict=True)
    text_table["method"] = [
        look.paper[1] if source == "paper" and look.paper else look.label for source, look in looks
    ]
    return text_table


def compute_fisher_interval(
    correlation: np.ndarray, count: int, quantile: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of Fisher's intervals of correlations of `count` samples.

    z = artanh r is nearly normal with the standard deviation 1/√(n − 3); `quantile` is the half
    width of the interval in standard deviations.
    """
    with np.errstate(divide="ignore"):
        z = np.arctanh(correlation)
    half_width = quantile / np.sqrt(max(count - 3, 1))
    return np.tanh(z - half_width), np.tanh(z + half_width)


def correlate_errors(errors: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Pearson correlations of signed errors with 95 % intervals from Fisher's z.

    z = artanh r is nearly normal with the standard error 1/√(n − 3) for
    independent, jointly normal errors (Fisher 1921, Metron 1, 3).

    Parameters
    ----------
    errors : ndarray, shape (n, k)
        One row per sample, one column per parameter, any unit.

    Returns
    -------
    matrix, low, high : ndarray, shape (k, k)
        Correlations and the ends of their intervals; 1 on the diagonal. A column
        without variance correlates with nothing: its row and column are NaN,
        diagonal included, and no warning is given. With fewer than four samples
        the intervals are NaN off the diagonal.

    Raises
    ------
    ValueError
        If there are no samples, or an error is not finite.
    """
    errors = np.asarray(errors, np.float64)
    if not errors.size or not np.isfinite(errors).all():
        raise ValueError(f"errors of shape {errors.shape}: must be at least one and all finite")
    count = len(errors)
    varies = np.ptp(errors, axis=0) > 0
    # In units of the largest deviation, so that no square under- or overflows.
    deviation = errors - errors.mean(axis=0)
    deviation = deviation / np.where(varies, np.abs(deviation).max(axis=0), 1.0)
    # Cosine of the angle between the deviations of two parameters: Pearson's r.
    length = np.where(varies, np.sqrt((deviation**2).sum(axis=0)), 1.0)
    matrix = np.clip((deviation / length).T @ (deviation / length), -1.0, 1.0)
    np.fill_diagonal(matrix, 1.0)
    # The interval, 1.96 σ to either side, is undefined for fewer than four samples.
    low, high = compute_fisher_interval(matrix, count, 1.959963984540054)
    if count < 4:
        off_diagonal = ~np.eye(len(matrix), dtype=bool)
        low[off_diagonal] = high[off_diagonal] = np.nan
    for array in (matrix, low, high):
        array[~varies, :] = array[:, ~varies] = np.nan
    return matrix, low, high
