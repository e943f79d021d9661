"""Tables of scene 3: errors and their correlations, ours alone and beside the paper's."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
import pandas as pd

from psfdae.metrics import error_correlation
from psfdae_paper.alignment.fisher import expected_abs_error
from psfdae_paper.configuration.aligners import ALIGNERS
from psfdae_paper.evaluation.paper import published

PARAMETERS = ("decenter_x", "decenter_y", "tilt_x", "tilt_y")
SI_UNITS = ("m", "m", "rad", "rad")

CORRELATED = ("decenter_x-tilt_y", "decenter_y-tilt_y", "tilt_x-tilt_y")
"""The pairs that the paper tabulates."""

TEST_SETS = (
    "Test set `grid`: the very states that the networks were trained on, with new noise; "
    "`uniform`: other states of the same range."
)
"""What the paper's tables beside ours say of their column `test_set`."""

Row = dict[str, object]
"""Of a table, by column."""


def error_rows(key: Mapping[str, object], errors: np.ndarray, unit: np.ndarray) -> list[Row]:
    """Rows of the error table of one method.

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
        One row in units of the range and one in SI units for each parameter. The
        variance of the signed error is about its mean; `variance_abs` is that of
        the absolute error, which is what the paper tabulates.
    """
    absolute = np.abs(errors)
    statistics = {
        "mean_abs_error": absolute.mean(axis=0),
        "bias": errors.mean(axis=0),
        "variance": errors.var(axis=0),
        "variance_abs": absolute.var(axis=0),
    }
    return _in_both_units(key, statistics, unit, len(errors))


def bound_rows(key: Mapping[str, object], covariances: np.ndarray, unit: np.ndarray) -> list[Row]:
    """Rows of the error table that unbiased normal errors at the bound would have.

    Parameters
    ----------
    key, unit : as for `error_rows`
    covariances : ndarray, shape (n, 4, 4)
        Cramér–Rao bounds of the states, in squared units of the range.
    """
    variance = np.diagonal(covariances, axis1=1, axis2=2)
    absolute = expected_abs_error(covariances).mean(axis=0)
    statistics = {
        "mean_abs_error": absolute,
        "bias": np.zeros(4),
        "variance": variance.mean(axis=0),
        "variance_abs": variance.mean(axis=0) - absolute**2,
    }
    return _in_both_units(key, statistics, unit, len(covariances))


def _in_both_units(
    key: Mapping[str, object], statistics: Mapping[str, np.ndarray], unit: np.ndarray, count: int
) -> list[Row]:
    rows: list[Row] = []
    for index, parameter in enumerate(PARAMETERS):
        for name, scale in (("range", 1.0), (SI_UNITS[index], unit[index])):
            power = {"variance": 2, "variance_abs": 2}
            values = {
                column: float(value[index] * scale ** power.get(column, 1))
                for column, value in statistics.items()
            }
            rows.append({**key, "parameter": parameter, **values, "unit": name, "n": count})
    return rows


def correlation_rows(
    key: Mapping[str, object], matrix: np.ndarray, low: np.ndarray, high: np.ndarray
) -> list[Row]:
    """Rows of the correlation table for all pairs of parameters, matrices (4, 4)."""
    return [
        {
            **key,
            "parameter_a": PARAMETERS[a],
            "parameter_b": PARAMETERS[b],
            "correlation": matrix[a, b],
            "ci_low": low[a, b],
            "ci_high": high[a, b],
        }
        for a, b in product(range(4), repeat=2)
    ]


def measured_correlations(key: Mapping[str, object], errors: np.ndarray) -> list[Row]:
    """Correlations of signed errors (n, 4) with 95 % intervals."""
    return correlation_rows(key, *error_correlation(errors))


def predicted_correlations(key: Mapping[str, object], covariances: np.ndarray) -> list[Row]:
    """Correlations that the Fisher matrix predicts, of a state and of all errors together.

    Method `cramer_rao` is the mean over states of each state's correlation; its
    interval holds 95 % of the states. `cramer_rao_pooled` is the correlation of
    errors drawn with these covariances, which states with large errors dominate;
    its interval is that of a sample of as many states. The latter is what
    measured correlations are to be compared with.

    Parameters
    ----------
    key : dict
        test_set and noise_level.
    covariances : ndarray, shape (n, 4, 4)
    """
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    each = covariances / (sigma[:, :, None] * sigma[:, None, :])
    low, high = np.quantile(each, [0.025, 0.975], axis=0)
    rows = correlation_rows({**key, "method": "cramer_rao"}, each.mean(axis=0), low, high)
    mean = covariances.mean(axis=0)
    scale = np.sqrt(np.diag(mean))
    pooled = mean / np.outer(scale, scale)
    half = 1.959964 / np.sqrt(max(len(covariances) - 3, 1))
    with np.errstate(divide="ignore"):
        z = np.arctanh(np.clip(pooled, -1.0, 1.0))
    key = {**key, "method": "cramer_rao_pooled"}
    return rows + correlation_rows(key, pooled, np.tanh(z - half), np.tanh(z + half))


def paper_errors(errors: pd.DataFrame, level: float) -> pd.DataFrame:
    """The paper's error table of one noise level with our rows below.

    Returns
    -------
    DataFrame
        Columns source (paper or psfdae), test_set, method, quantity (mean or
        variance of the absolute error) and one per parameter, in units of the range.
    """
    paper = published("alignment")
    paper = paper[np.isclose(paper.noise_level, level)].assign(source="paper", test_set="")
    paper = paper.rename(columns={"mean_error": "mean"})
    ours = errors[np.isclose(errors.noise_level, level) & (errors.unit == "range")]
    ours = ours.assign(source="psfdae", mean=ours.mean_abs_error, variance=ours.variance_abs)
    columns = ["source", "test_set", "method", "parameter", "mean", "variance"]
    both = pd.concat([paper[columns], ours[columns]], ignore_index=True)
    both = both.melt(columns[:4], var_name="quantity", value_name="value")
    return _wide(both, "parameter", list(PARAMETERS), ["source", "test_set", "method", "quantity"])


def paper_correlations(correlations: pd.DataFrame) -> pd.DataFrame:
    """The paper's correlation table with our rows below.

    Returns
    -------
    DataFrame
        Columns source, test_set, noise_level, method and one per pair.
    """
    paper = published("correlation").assign(source="paper", test_set="")
    ours = correlations.assign(
        source="psfdae", pair=correlations.parameter_a + "-" + correlations.parameter_b
    )
    columns = ["source", "test_set", "noise_level", "method", "pair", "correlation"]
    both = pd.concat([paper[columns], ours.loc[ours.pair.isin(CORRELATED), columns]])
    both = both[both.noise_level > 0].rename(columns={"correlation": "value"})
    return _wide(both, "pair", list(CORRELATED), ["source", "test_set", "noise_level", "method"])


def _wide(table: pd.DataFrame, across: str, order: list[str], index: list[str]) -> pd.DataFrame:
    """One row per index, columns in a given order, methods in the order of the tables."""
    methods = list(ALIGNERS)
    wide = table.pivot(index=index, columns=across, values="value")[order].reset_index()
    wide.columns.name = None
    keys = [wide["method"].map(methods.index) if name == "method" else wide[name] for name in index]
    return wide.iloc[np.lexsort([key.to_numpy() for key in reversed(keys)])].reset_index(drop=True)


def as_markdown(table: pd.DataFrame, title: str, digits: dict[str, str]) -> str:
    """A paper-shaped table as Markdown.

    Parameters
    ----------
    table : DataFrame
    title : str
    digits : dict
        Number format by the value of the column `quantity`; that of the key ""
        for tables without it.
    """
    shown = table.copy()
    kinds = shown["quantity"] if "quantity" in shown else pd.Series("", index=shown.index)
    numbers = [c for c in shown.columns if c in PARAMETERS or c in CORRELATED]
    for column in numbers:
        shown[column] = [
            "" if pd.isna(value) else format(value, digits[kind])
            for value, kind in zip(table[column], kinds, strict=True)
        ]
    printed = {name: each.look.paper[1] for name, each in ALIGNERS.items() if each.look.paper}
    shown["method"] = [
        printed[m] if source == "paper" else ALIGNERS[m].look.label
        for m, source in zip(table["method"], table["source"], strict=True)
    ]
    return f"{title}\n\n{shown.to_markdown(index=False, disable_numparse=True)}\n"
