"""Errors side by side: of two trained networks, of two tables, of seen and of held-out fields."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import resources
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from psfdae.metrics import clustered_mean, clustered_ratio, seed_stderr

if TYPE_CHECKING:
    import pandas as pd

SIGNIFICANT = 3.0
"""A difference of so many standard errors is called one; 1 of 370 is chance."""

NEGLIGIBLE = 0.1
"""Part of the standard error of the test stars below which a difference says nothing. Most of those
are smaller that come from another kind of processor, which rounds differently."""

Scatter = Mapping[tuple[str, str, str], float]
"""Relative scatter of a method's MSE between seeds by dataset, reference and method."""

FITTED = ["dataset", "reference", "method"]
CELL = ["dataset", "split", "reference", "noise_level"]

PAPER_ORDER = ("dae", "pca_som", "noisy")
"""The paper's methods by ascending error, as it concludes."""

SHARES = (0.25, 0.5, 0.75, 1.0)
"""Parts of a training at which the validation errors are shown."""

COLUMNS = [
    *("metric", "method", "noise_level", "first", "second"),
    *("difference", "stderr", "seed_stderr", "sigmas", "verdict"),
]

SMALLER_IS_BETTER = {"mse": True, "ssim": False}
"""Metrics that are compared."""

ABSENT = "–"


@cache
def seed_scatter() -> Scatter:
    """What the target `seeds` has found, `seed_scatter.csv`; what has no row was not measured."""
    import pandas as pd

    with resources.files(__package__).joinpath("seed_scatter.csv").open() as file:
        return dict(pd.read_csv(file, index_col=FITTED)["scatter"])


def config_differences(
    first: Mapping[str, str], second: Mapping[str, str]
) -> list[tuple[str, str, str]]:
    """Settings with their two values where these differ; keys sorted.

    Parameters
    ----------
    first, second : flattened configs, see `psfdae_paper.tracking.flatten`
    """
    keys = sorted(first.keys() | second.keys())
    pairs = [(key, first.get(key, ABSENT), second.get(key, ABSENT)) for key in keys]
    return [pair for pair in pairs if pair[1] != pair[2]]


def training_summary(history: pd.DataFrame) -> dict[str, float]:
    """Length, time and validation errors of a training, by name.

    Parameters
    ----------
    history : DataFrame
        A row per epoch: epoch, train_mse, validation_mse (NaN where not measured), seconds.
    """
    valid = history.dropna(subset=["validation_mse"])
    best = valid.iloc[valid["validation_mse"].argmin()]
    epochs = float(history["epoch"].max())
    summary = {
        "epochs": epochs,
        "seconds": float(history["seconds"].max()),
        "best validation MSE": float(best["validation_mse"]),
        "at epoch": float(best["epoch"]),
    }
    for share in SHARES:
        reached = valid[valid["epoch"] <= share * epochs]
        value = reached["validation_mse"].iloc[-1] if len(reached) else np.nan
        summary[f"validation MSE after {share:.0%}"] = float(value)
    return summary


def same_noisy_stars(first: pd.DataFrame, second: pd.DataFrame) -> bool:
    """Whether two evaluations saw the same noisy images.

    The error of the untouched image is a fingerprint of star and noise: if it agrees
    for every star and level, differences can be taken star by star.

    Parameters
    ----------
    first, second : DataFrame
        Errors per star: method, noise_level, star, field, mse, ssim …
    """
    one, other = (
        table[table["method"] == "noisy"].set_index(["noise_level", "star"])["mse"].sort_index()
        for table in (first, second)
    )
    return one.index.equals(other.index) and bool(np.allclose(one, other, rtol=1e-5, atol=0.0))


def compare_errors(first: pd.DataFrame, second: pd.DataFrame, scatter: Scatter) -> pd.DataFrame:
    """Mean errors of two evaluations and how sure their difference is.

    Paired star by star where both saw the same noisy images, else as independent
    samples; standard errors are clustered by field (`clustered_mean`). Two trainings of one
    setting differ by their seeds, too: `seed_stderr`.

    Parameters
    ----------
    first, second : as for `same_noisy_stars`, with dataset and reference
    scatter : as of `seed_scatter`

    Returns
    -------
    DataFrame
        metric, method, noise_level, first, second, difference (second − first), stderr (of
        the stars), seed_stderr (of both trainings; NaN if not measured), sigmas (of both
        errors, or of that of the stars alone), verdict: "better", "worse" (the second) or
        "same", for methods and levels that both have.
    """
    import pandas as pd

    paired = same_noisy_stars(first, second)
    rows = []
    keys = ["method", "noise_level"]
    groups = {key: table for key, table in second.groupby(keys, sort=False)}
    for (method, level), one in first.groupby(keys, sort=False):
        other = groups.get((method, level))
        if other is None:
            continue
        for metric in SMALLER_IS_BETTER:
            values = _difference(one, other, metric, paired, scatter)
            rows.append({"metric": metric, "method": method, "noise_level": level, **values})
    table = pd.DataFrame(rows, columns=COLUMNS)
    return table.sort_values(["metric", "method", "noise_level"], ignore_index=True)


def _difference(
    one: pd.DataFrame, other: pd.DataFrame, metric: str, paired: bool, scatter: Scatter
) -> dict[str, float | str]:
    if paired:
        one, other = (table.sort_values("star") for table in (one, other))
        change = other[metric].to_numpy() - one[metric].to_numpy()
        difference, stderr = clustered_mean(change, one["field"].to_numpy())
    else:
        means = [
            clustered_mean(table[metric].to_numpy(), table["field"].to_numpy())
            for table in (one, other)
        ]
        difference = means[1][0] - means[0][0]
        stderr = float(np.hypot(means[0][1], means[1][1]))
    first, second = (float(table[metric].mean()) for table in (one, other))
    fitted = (tuple(table[FITTED].iloc[0]) for table in (one, other))
    each = zip(fitted, (first, second), strict=True)
    scatters = [seed_stderr(scatter.get(f, np.nan), metric, m) for f, m in each]
    seeds = float(np.hypot(scatters[0], scatters[1]))
    error = np.hypot(stderr, np.nan_to_num(seeds))
    sigmas = 0.0 if difference == 0 else difference / error if error > 0 else np.inf
    return {
        "first": first,
        "second": second,
        "difference": difference,
        "stderr": stderr,
        "seed_stderr": seeds,
        "sigmas": float(sigmas),
        "verdict": _verdict(float(sigmas), SMALLER_IS_BETTER[metric]),
    }


def _verdict(sigmas: float, smaller_is_better: bool) -> str:
    if not abs(sigmas) >= SIGNIFICANT:
        return "same"
    return "better" if (sigmas < 0) == smaller_is_better else "worse"


def with_seed_stderr(table: pd.DataFrame, scatter: Scatter) -> pd.DataFrame:
    """Rows as of `psf_metrics.csv` with the column `seed_stderr`; NaN where not measured."""
    rows = zip(*(table[name] for name in (*FITTED, "metric", "value")), strict=True)
    found = [seed_stderr(scatter.get(tuple(f), np.nan), metric, v) for *f, metric, v in rows]
    return table.assign(seed_stderr=found)


def compare_tables(
    first: pd.DataFrame, second: pd.DataFrame, scatter: Scatter
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Rows that two tables of mean errors both have, and the order of the paper's methods.

    Parameters
    ----------
    first, second : DataFrame
        Rows as of `psf_metrics.csv`.
    scatter : as of `seed_scatter`

    Returns
    -------
    rows : DataFrame
        The keys, value_first, value_second, and verdict: "equal"; "rounding" of differences
        that are `NEGLIGIBLE`; "within" `SIGNIFICANT` standard deviations of the difference of
        two fits with different seeds; "beyond" that; "not measured" of rows that differ, but
        whose scatter is not known.
    order : DataFrame
        By column of the tables: whether errors ascend as in `PAPER_ORDER` in the `first` and in
        the `second`, and whether two methods are `exchanged`, by more than the scatter in both.
    """
    import pandas as pd

    both = [with_seed_stderr(table, scatter) for table in (first, second)]
    keys = [*CELL, "method", "metric"]
    kept = [table[[*keys, "value", "stderr", "seed_stderr"]] for table in both]
    rows = kept[0].merge(kept[1], on=keys, suffixes=("_first", "_second"))
    gap = (rows.value_second - rows.value_first).abs()
    rounding = NEGLIGIBLE * rows[["stderr_first", "stderr_second"]].min(axis=1)
    allowed = SIGNIFICANT * np.hypot(rows.seed_stderr_first, rows.seed_stderr_second)
    rows["verdict"] = pd.Series("beyond", rows.index).case_when(
        [
            (gap == 0, "equal"),
            (gap <= rounding, "rounding"),
            (np.isnan(allowed), "not measured"),
            (gap <= allowed, "within"),
        ]
    )
    rows = rows[[*keys, "value_first", "value_second", "verdict"]]
    signs = [_signs(table) for table in both]
    signs = [s.reindex(signs[0].index.intersection(signs[1].index)) for s in signs]
    order = {name: (s < 0).all(axis=1) for name, s in zip(("first", "second"), signs, strict=True)}
    order["exchanged"] = (signs[0] * signs[1] < 0).any(axis=1)
    return rows, pd.DataFrame(order)


def _signs(table: pd.DataFrame) -> pd.DataFrame:
    """Of each pair of `PAPER_ORDER`: −1 if the first one's MSE is less, 1 if more, 0 if equal.

    Equal are errors that differ by less than `SIGNIFICANT` times their scatter between seeds.
    """
    import pandas as pd

    wide = table[table.metric == "mse"].pivot(index=CELL, columns="method")
    wide = wide.reindex(columns=pd.MultiIndex.from_product([["value", "seed_stderr"], PAPER_ORDER]))
    value, scatter = wide["value"].dropna(), wide["seed_stderr"].fillna(0.0)
    signs = {}
    for one, other in combinations(PAPER_ORDER, 2):
        gap = value[one] - value[other]
        sure = gap.abs() > SIGNIFICANT * np.hypot(scatter[one], scatter[other])
        signs[one, other] = np.sign(gap).where(sure, 0.0)
    return pd.DataFrame(signs, index=value.index)


HELD_OUT_COLUMNS = ["dataset", "reference", "method", "noise_level", "mse_random", "mse_held_out"]
HELD_OUT_COLUMNS += ["ratio", "stderr", "n", "fields"]


def held_out_ratios(stars: pd.DataFrame) -> pd.DataFrame:
    """What it costs that a star's field was not seen in training, on the very same stars.

    These are the stars that both splits test: they stand in held-out fields, and the split
    `random` neither fits nor validates with them.

    Parameters
    ----------
    stars : DataFrame
        Errors per star of both splits: dataset, split, reference, method, noise_level,
        star, field, mse.

    Returns
    -------
    DataFrame
        `HELD_OUT_COLUMNS`: mean errors, their ratio (held out over random) with its
        standard error clustered by field, numbers of stars and of fields.
    """
    import pandas as pd

    rows = []
    keys = HELD_OUT_COLUMNS[:4]
    for key, errors in stars.groupby(keys, sort=False):
        seen, unseen = (errors[errors.split == split] for split in ("random", "held_out"))
        both = seen.merge(unseen, on=["star", "field"], suffixes=("_random", "_held_out"))
        if len(both):
            pair = both.mse_held_out.to_numpy(), both.mse_random.to_numpy()
            ratio, stderr = clustered_ratio(*pair, both.field.to_numpy())
            means = (pair[1].mean(), pair[0].mean())
            rows.append((*key, *means, ratio, stderr, len(both), both.field.nunique()))
    return pd.DataFrame(rows, columns=HELD_OUT_COLUMNS)
