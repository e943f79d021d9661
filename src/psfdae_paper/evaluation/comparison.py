"""Comparison of errors: of two trained networks, of two tables, of known and held-out fields.

Inputs: errors by star, or tables of mean errors. Outputs: tables of differences with their standard
errors. Two fits of one setting also differ by their seeds: this scatter was measured once, and is
added to the standard error of the stars.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from importlib import resources
from itertools import combinations

import numpy as np
import pandas as pd

from psfdae.methods.metrics import cluster_mean, cluster_ratio
from psfdae_paper.evaluation.measure import CELL

SIGNIFICANT = 3.0
"""Standard errors beyond which a difference is called significant; 1 of 370 is chance."""

Scatter = Mapping[tuple[str, str, str], float]
"""Relative scatter of a method's MSE between seeds by dataset, reference and method."""

SSIM_SCATTER = 2.2
"""Relative scatter of 1 − SSIM between seeds, divided by the scatter of the MSE: 2.2 in dataset 7,
0.9 in dataset 3 (studies/seed_scatter)."""

FIT_KEYS = ["dataset", "reference", "method"]
"""Columns that identify a fit."""


@cache
def read_seed_scatter() -> Scatter:
    """Read the scatter between seeds that the target `seeds` has measured, `seed_scatter.csv`.

    Fits without a row were not measured.
    """
    # A row for each fit: dataset, reference, method and relative scatter of its MSE.
    with resources.files(__package__).joinpath("seed_scatter.csv").open() as file:
        return dict(pd.read_csv(file, index_col=FIT_KEYS)["scatter"])


def compare_settings(
    first: Mapping[str, str], second: Mapping[str, str]
) -> list[tuple[str, str, str]]:
    """Return the settings that differ, each with both values; keys sorted.

    Parameters
    ----------
    first, second : mapping
        Flattened configurations, see `psfdae.base.settings.leaves`. A dash stands for a
        setting that one of them does not have.
    """
    # Keys of either configuration; equal values are left out.
    keys = sorted(first.keys() | second.keys())
    rows = [(key, first.get(key, "–"), second.get(key, "–")) for key in keys]
    return [row for row in rows if row[1] != row[2]]


def summarise_training(history: pd.DataFrame) -> dict[str, float]:
    """Summarise length, time and validation errors of a training, by name.

    Parameters
    ----------
    history : DataFrame
        A row per epoch: epoch, train_mse, validation_mse (NaN where not measured), seconds.
    """
    # Only some epochs are validated.
    validation_rows = history.dropna(subset=["validation_mse"])
    best_epoch = validation_rows.iloc[validation_rows["validation_mse"].argmin()]
    epochs = float(history["epoch"].max())
    # The network of the smallest validation error is the result.
    summary = {
        "epochs": epochs,
        "seconds": float(history["seconds"].max()),
        "best validation MSE": float(best_epoch["validation_mse"]),
        "at epoch": float(best_epoch["epoch"]),
    }
    # The last validation error within the first quarter, half, … of the training.
    for share in (0.25, 0.5, 0.75, 1.0):
        earlier = validation_rows[validation_rows["epoch"] <= share * epochs]
        value = earlier["validation_mse"].iloc[-1] if len(earlier) else np.nan
        summary[f"validation MSE after {share:.0%}"] = float(value)
    return summary


def share_noisy_stars(first: pd.DataFrame, second: pd.DataFrame) -> bool:
    """Return True if two evaluations used the same noisy images.

    The error of the image that no method has changed is a fingerprint of star and noise: if it
    agrees for every star and level, differences can be taken star by star.

    Parameters
    ----------
    first, second : DataFrame
        Errors per star: method, noise_level, star, field, mse, ssim …
    """
    # Errors of the unchanged image by noise level and star.
    first_mse, second_mse = (
        table[table["method"] == "noisy"].set_index(["noise_level", "star"])["mse"].sort_index()
        for table in (first, second)
    )
    # Equal up to the rounding of another processor.
    same_stars = first_mse.index.equals(second_mse.index)
    return same_stars and bool(np.allclose(first_mse, second_mse, rtol=1e-5, atol=0.0))


def compare_evaluations(
    first: pd.DataFrame, second: pd.DataFrame, scatter: Scatter
) -> pd.DataFrame:
    """Compare the mean errors of two evaluations, with the significance of their difference.

    Paired star by star where both saw the same noisy images, else as independent
    samples; standard errors are clustered by field (`cluster_mean`). Two trainings of one
    setting differ by their seeds, too: `seed_stderr`.

    Parameters
    ----------
    first : DataFrame
        Errors per star, as for `share_noisy_stars`, with the columns dataset and reference.
    second : DataFrame
        Errors of the other evaluation, in the same form.
    scatter : mapping
        See `read_seed_scatter`.

    Returns
    -------
    DataFrame
        metric, method, noise_level, first, second, difference (second − first), stderr (of
        the stars), seed_stderr (of both trainings; NaN if not measured), sigmas (the difference
        over both errors, or over stderr where seed_stderr is NaN), verdict: "better", "worse" (the
        second) or "same", for methods and levels that both have.
    """
    # Methods and levels that both evaluations have, in the order of the first one.
    # On the same noisy stars their scatter is common to both, and cancels.
    is_paired = share_noisy_stars(first, second)
    rows = []
    keys = ["method", "noise_level"]
    second_groups = dict(list(second.groupby(keys, sort=False)))
    for key, stars in first.groupby(keys, sort=False):
        for metric in ("mse", "ssim") if key in second_groups else ():
            values = _compare_means(stars, second_groups[key], metric, is_paired, scatter)
            rows.append({"metric": metric, **dict(zip(keys, key, strict=True)), **values})
    columns = [
        *("metric", "method", "noise_level", "first", "second"),
        *("difference", "stderr", "seed_stderr", "sigmas", "verdict"),
    ]
    table = pd.DataFrame(rows, columns=columns)
    return table.sort_values(["metric", "method", "noise_level"], ignore_index=True)


def _compare_means(
    first: pd.DataFrame, second: pd.DataFrame, metric: str, is_paired: bool, scatter: Scatter
) -> dict[str, float | str]:
    """Return a row of `compare_evaluations` for one method and noise level, without its keys."""
    tables = [table.sort_values("star") for table in (first, second)]
    values, fields = ([t[name].to_numpy() for t in tables] for name in (metric, "field"))
    if is_paired:
        # Mean of the differences of the same stars.
        difference, stderr = cluster_mean(values[1] - values[0], fields[0])
    else:
        # Difference of two independent means: their variances add.
        means, errors = zip(*map(cluster_mean, values, fields), strict=True)
        difference, stderr = means[1] - means[0], float(np.hypot(*errors))
    # Scatter of both trainings between seeds; 0 in the significance if it was not measured.
    first_mean, second_mean = (float(v.mean()) for v in values)
    seed_errors = [
        seed_stderr(scatter.get(tuple(table[FIT_KEYS].iloc[0]), np.nan), metric, mean)
        for table, mean in zip(tables, (first_mean, second_mean), strict=True)
    ]
    both_seeds_stderr = float(np.hypot(seed_errors[0], seed_errors[1]))
    # Significance: difference over σ = √(σ_stars² + σ_seeds²).
    error = np.hypot(stderr, np.nan_to_num(both_seeds_stderr))
    sigmas = float(0.0 if difference == 0 else difference / error if error > 0 else np.inf)
    verdict = "same"
    if abs(sigmas) >= SIGNIFICANT:
        # A smaller MSE is better, and a larger SSIM.
        verdict = "better" if (sigmas < 0) == (metric == "mse") else "worse"
    return {
        "first": first_mean,
        "second": second_mean,
        "difference": difference,
        "stderr": stderr,
        "seed_stderr": both_seeds_stderr,
        "sigmas": sigmas,
        "verdict": verdict,
    }


def add_seed_stderr(table: pd.DataFrame, scatter: Scatter) -> pd.DataFrame:
    """Add the column `seed_stderr` to rows of `psf_metrics.csv`; NaN where not measured."""
    rows = zip(*(table[name] for name in (*FIT_KEYS, "metric", "value")), strict=True)
    seed_errors = [
        seed_stderr(scatter.get(tuple(fit), np.nan), metric, value) for *fit, metric, value in rows
    ]
    return table.assign(seed_stderr=seed_errors)


def compare_tables(
    first: pd.DataFrame,
    second: pd.DataFrame,
    scatter: Scatter,
    negligible: float,
    ascending: Sequence[str],
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Compare the rows that two tables of mean errors share, and the order of the methods.

    Parameters
    ----------
    first, second : DataFrame
        Rows of `psf_metrics.csv`.
    scatter : mapping
        See `read_seed_scatter`.
    negligible : float
        Part of the test stars' standard error up to which a difference is called rounding.
    ascending : sequence of str
        Methods by ascending error, as the paper has them.

    Returns
    -------
    rows : DataFrame
        The keys, value_first, value_second, numbers of test stars n_first and n_second, and
        verdict: "equal"; "rounding" for differences that are negligible; "within" `SIGNIFICANT`
        standard deviations of the difference of two fits with different seeds; "beyond" that;
        "not measured" for rows that differ, but whose scatter is not known.
    order : DataFrame
        For each column of the paper's tables: True if errors ascend in the order of the paper in
        the `first` and in the `second` table, and if two methods are `exchanged`, by more than the
        scatter in both.
    """
    # Rows that both tables have, with the standard errors of both.
    tables = [add_seed_stderr(table, scatter) for table in (first, second)]
    keys = [*CELL, "method", "metric"]
    columns = [table[[*keys, "value", "stderr", "seed_stderr", "n"]] for table in tables]
    rows = columns[0].merge(columns[1], on=keys, suffixes=("_first", "_second"))
    # The first condition that holds decides, from equal to beyond the scatter.
    difference = (rows.value_second - rows.value_first).abs()
    rounding = negligible * rows[["stderr_first", "stderr_second"]].min(axis=1)
    limit = SIGNIFICANT * np.hypot(rows.seed_stderr_first, rows.seed_stderr_second)
    rows["verdict"] = pd.Series("beyond", rows.index).case_when(
        [
            (difference == 0, "equal"),
            (difference <= rounding, "rounding"),
            (np.isnan(limit), "not measured"),
            (difference <= limit, "within"),
        ]
    )
    rows = rows[[*keys, "value_first", "value_second", "n_first", "n_second", "verdict"]]
    # Signs of the differences between the paper's methods, where both tables have them.
    signs = [_compute_mse_signs(table, ascending) for table in tables]
    signs = [s.reindex(signs[0].index.intersection(signs[1].index)) for s in signs]
    order = {name: (s < 0).all(axis=1) for name, s in zip(("first", "second"), signs, strict=True)}
    order["exchanged"] = (signs[0] * signs[1] < 0).any(axis=1)
    return rows, pd.DataFrame(order)


def _compute_mse_signs(table: pd.DataFrame, methods: Sequence[str]) -> pd.DataFrame:
    """Return the sign of the MSE difference for each pair of methods.

    −1 if the MSE of the pair's first method is smaller, 1 if larger, 0 if the difference is below
    `SIGNIFICANT` times its scatter between seeds.
    """
    # MSE and its scatter by method, of the columns of the paper's tables that have all methods.
    by_method = table[table.metric == "mse"].pivot(index=CELL, columns="method")
    columns = pd.MultiIndex.from_product([["value", "seed_stderr"], methods])
    by_method = by_method.reindex(columns=columns)
    mse, scatter = by_method["value"].dropna(), by_method["seed_stderr"].fillna(0.0)
    signs = {}
    for pair in combinations(methods, 2):
        difference = mse[pair[0]] - mse[pair[1]]
        # Scatter of the difference of two independent fits.
        scatter_of_pair = np.hypot(scatter[pair[0]], scatter[pair[1]])
        is_significant = difference.abs() > SIGNIFICANT * scatter_of_pair
        signs[pair] = np.sign(difference).where(is_significant, 0.0)
    return pd.DataFrame(signs, index=mse.index)


def measure_held_out_ratios(stars: pd.DataFrame) -> pd.DataFrame:
    """Measure how much errors grow if a star's field is not among the training fields.

    The stars that both splits test are compared: they are in held-out fields, and the split
    `random` does not use them for training or validation.

    Parameters
    ----------
    stars : DataFrame
        Errors per star of both splits: dataset, split, reference, method, noise_level,
        star, field, mse.

    Returns
    -------
    DataFrame
        A row for each method and noise level: mean errors, their ratio (held out over random) with
        its standard error clustered by field, numbers of stars and of fields.
    """
    rows, keys = [], [*FIT_KEYS, "noise_level"]
    # Stars that both splits test: their errors differ because the training stars differ.
    random, held_out = (stars[stars.split == name] for name in ("random", "held_out"))
    keys_of_stars = [*keys, "star", "field"]
    pairs = random.merge(held_out, on=keys_of_stars, suffixes=("_random", "_held_out"))
    for key, group in pairs.groupby(keys, sort=False):
        held_out_mse, random_mse = group.mse_held_out.to_numpy(), group.mse_random.to_numpy()
        ratio, stderr = cluster_ratio(held_out_mse, random_mse, group.field.to_numpy())
        means = (random_mse.mean(), held_out_mse.mean())
        rows.append((*key, *means, ratio, stderr, len(group), group.field.nunique()))
    columns = [*keys, "mse_random", "mse_held_out", "ratio", "stderr", "n", "fields"]
    return pd.DataFrame(rows, columns=columns)


def seed_stderr(scatter: float, metric: str, mean: float) -> float:
    """Return the standard deviation of a mean error between seeds of a training.

    Parameters
    ----------
    scatter : float
        Standard deviation of the MSE between seeds, over the MSE; NaN if it was not measured.
    metric : str
        "mse", or an SSIM, of which 1 − SSIM scatters by up to `SSIM_SCATTER` times as much; NaN for
        others.
    mean : float
        Mean of the metric.
    """
    # The scatter is relative to the error: the MSE, or 1 − SSIM.
    if metric.startswith("ssim"):
        return SSIM_SCATTER * scatter * (1.0 - mean)
    return scatter * (mean if metric == "mse" else np.nan)
