"""Stage `efficiency`: every method beside the bounds of its own test stars."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any

from psfdae.bounds.efficiency import compare
from psfdae.cli import File, command
from psfdae.files import ProductError, write_text
from psfdae.reading import read_table

if TYPE_CHECKING:
    import pandas as pd

COLUMNS = ["dataset", "reference", "noise_level", "method", "bound", "tight", "mse", "mse_bound"]
COLUMNS += ["efficiency", "difference", "stderr", "n", "verdict"]

COLUMN_OF_TABLE = ["dataset", "split", "reference", "noise_level"]
"""What one column of the paper's tables is: methods are compared inside it."""


@command("efficiency")
def efficiency(
    bounds: tuple[File, ...],
    bounds_per_star: Annotated[
        tuple[File, ...], "Parquet of the stage bounds; repeat for more datasets."
    ],
    out: Annotated[File, "CSV: every method beside every bound."],
    parts: Annotated[tuple[File, ...], {"argument": True}],
) -> None:
    """Compare methods with the bounds; PARTS are the evaluations' Parquet files.

    They are paired by star; the methods' errors are those of the bounded stars alone.
    The posterior mean is compared with the floor, too. An efficiency is given for the
    floor and where the posterior mean is tight; the verdict is `beaten` if a method's
    error is below such a bound by more than two standard errors of the difference and
    5 % of the bound, otherwise `ok`. Both are empty where a posterior mean is not tight.
    """
    import pandas as pd

    tight = _tight(pd.concat([read_table(path) for path in bounds], ignore_index=True))
    best = pd.concat([pd.read_parquet(path) for path in bounds_per_star], ignore_index=True)
    wanted = [*COLUMN_OF_TABLE, "method", "star", "field", "mse"]
    methods = pd.concat([pd.read_parquet(path, columns=wanted) for path in parts])
    # The posterior mean over a bank is an estimator and must respect the floor.
    methods = pd.concat([methods, best[best.method == "bayes"][wanted]], ignore_index=True)
    by_column = dict(list(methods.groupby(COLUMN_OF_TABLE, sort=False)))
    rows: list[dict[str, Any]] = []
    for key, bounded in best.groupby(COLUMN_OF_TABLE, sort=False):
        found = by_column[key]
        if not (found.method != "bayes").any():
            raise ProductError(f"{', '.join(map(str, key))}: bounded, but no method was evaluated")
        rows += _column(dict(zip(COLUMN_OF_TABLE, key, strict=True)), found, bounded, tight)
    table = pd.DataFrame(rows, columns=COLUMNS)
    write_text(out, table.to_csv(index=False, float_format="%.8g"))


def _tight(bounds: pd.DataFrame) -> set[tuple[Any, ...]]:
    """Dataset, reference and λ of the columns whose posterior mean is tight."""
    rows = bounds[(bounds.method == "bayes") & (bounds.metric == "mse") & (bounds.tight == "yes")]
    return {(row.dataset, row.reference, f"{row.noise_level:.6g}") for row in rows.itertuples()}


def _column(
    key: dict[str, Any], methods: pd.DataFrame, bounded: pd.DataFrame, tight: set[tuple[Any, ...]]
) -> Iterator[dict[str, Any]]:
    """Rows of one dataset, reference and λ: every method beside every bound."""
    for bound, limits in bounded.groupby("method", sort=False):
        sharp = (key["dataset"], key["reference"], f"{key['noise_level']:.6g}") in tight
        for method, errors in methods.groupby("method", sort=False):
            if method == bound:
                continue
            paired = limits.merge(errors, on="star", suffixes=("_bound", ""), validate="1:1")
            if len(paired) < len(limits):
                raise ProductError(
                    f"{key['dataset']}, {key['reference']}, λ = {key['noise_level']:g}: "
                    f"{method} lacks {len(limits) - len(paired)} of the bounded stars"
                )
            moved = paired[paired["field"] != paired["field_bound"]]
            if len(moved):
                star, field, bounded_in = moved[["star", "field", "field_bound"]].iloc[0]
                raise ProductError(
                    f"{key['dataset']}, {key['reference']}, λ = {key['noise_level']:g}: star "
                    f"{star} of {method} lies in field {field}, but that of the bounds in "
                    f"{bounded_in}"
                )
            found = compare(
                paired["mse"].to_numpy(), paired["mse_bound"].to_numpy(), paired["field"].to_numpy()
            )
            judged = bound == "floor" or sharp
            yield {
                **key,
                "method": method,
                "bound": bound,
                "tight": "yes" if bound == "bayes" and sharp else "no",
                "mse": found.mse,
                "mse_bound": found.bound,
                "efficiency": found.efficiency if judged else None,
                "difference": found.difference,
                "stderr": found.stderr,
                "n": len(paired),
                "verdict": ("beaten" if found.beaten else "ok") if judged else None,
            }
