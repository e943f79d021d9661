"""Errors side by side, star by star: of two trained networks, of seen and of held-out fields."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from psfdae.evaluation.metrics import clustered_mean, clustered_ratio, seed_stderr

if TYPE_CHECKING:
    import pandas as pd

SIGNIFICANT = 3.0
"""A difference of so many standard errors is called one; 1 of 370 is chance."""

SEED_SCATTER = {"pca_som": 0.012, "dae": 0.022, "gmm": 0.005, "gmm_position": 0.01}
"""Standard deviation of a method's MSE between seeds over that MSE: the largest that the target
`seeds` has found at any noise level (tables/seeds_*.csv of the run of record), rounded up."""

SHARES = (0.25, 0.5, 0.75, 1.0)
"""Parts of a training at which the validation errors are shown."""

COLUMNS = [
    *("metric", "method", "noise_level", "first", "second"),
    *("difference", "stderr", "seed_stderr", "sigmas", "verdict"),
]

SMALLER_IS_BETTER = {"mse": True, "ssim": False}
"""Metrics that are compared."""

ABSENT = "–"


def config_differences(
    first: Mapping[str, str], second: Mapping[str, str]
) -> list[tuple[str, str, str]]:
    """Settings with their two values where these differ; keys sorted.

    Parameters
    ----------
    first, second : flattened configs, see `psfdae.tracking.flatten`
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
    best = valid.loc[valid["validation_mse"].idxmin()]
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


def compare_errors(
    first: pd.DataFrame, second: pd.DataFrame, scatter: Mapping[str, float]
) -> pd.DataFrame:
    """Mean errors of two evaluations and how sure their difference is.

    Paired star by star where both saw the same noisy images, else as independent
    samples; standard errors are clustered by field (`clustered_mean`). Two trainings of one
    setting differ by their seeds, too: `seed_stderr`.

    Parameters
    ----------
    first, second : as for `same_noisy_stars`
    scatter : mapping of method to the scatter of its MSE between seeds, such as `SEED_SCATTER`

    Returns
    -------
    DataFrame
        metric, method, noise_level, first, second, difference (second − first), stderr (of
        the stars), seed_stderr (of both trainings), sigmas (of both errors), verdict:
        "better", "worse" (the second) or "same", for methods and levels that both have.
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
            values = _difference(one, other, metric, paired, scatter.get(str(method), 0.0))
            rows.append({"metric": metric, "method": method, "noise_level": level, **values})
    table = pd.DataFrame(rows, columns=COLUMNS)
    return table.sort_values(["metric", "method", "noise_level"], ignore_index=True)


def _difference(
    one: pd.DataFrame, other: pd.DataFrame, metric: str, paired: bool, scatter: float
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
    seeds = float(np.hypot(*(seed_stderr(scatter, metric, mean) for mean in (first, second))))
    error = np.hypot(stderr, seeds)
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
