"""Stage of scene 3 that turns estimates, fits and bounds into tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.belonging import STATE_STAMPS, require
from psfdae.files import Product, ProductError, read_product, write_text
from psfdae.reading import read_table

LEARNED = ("original", "dae", "noise_trained", "dae_retrained")
"""Order of the methods in the product "alignment_estimates"."""


def read_errors(
    estimates: Sequence[Path], fits: Sequence[Path]
) -> Iterator[tuple[dict[str, Any], np.ndarray, np.ndarray]]:
    """Key (test_set, noise_level, method), true states and estimates, (n, 4) each.

    Parameters
    ----------
    estimates : products "alignment_estimates"
    fits : products "alignment_fit"
    """
    for path in estimates:
        product = read_product(path, "alignment_estimates")
        truth, test_set = product["states"], product.config["test_set"]
        for row, level in enumerate(product["levels"]):
            key = {"test_set": test_set, "noise_level": float(level)}
            yield {**key, "method": "constant"}, truth, np.zeros_like(truth)
            for column, method in enumerate(LEARNED):
                yield {**key, "method": method}, truth, product["estimates"][row, column]
    for path in fits:
        product = read_product(path, "alignment_fit", ("states", "estimates"))
        key = {"test_set": product.config["test_set"], "noise_level": product.config["level"]}
        yield {**key, "method": "max_likelihood"}, product["states"], product["estimates"]


SAME_TEST = ("noise.kappa", "noise.background_photons", *STATE_STAMPS)
"""What products of one test agree in; estimates and fits in the seed of the noise, too."""


def require_one_test(
    estimates: Sequence[Path], fits: Sequence[Path], bounds: Sequence[Path]
) -> None:
    """Refuse estimates, fits and bounds that are not of the same telescope, noise and states.

    Raises
    ------
    ProductError
        If a product is damaged, or differs from an earlier one.
    """
    earlier: list[Product] = []
    for kind, paths in (("estimates", estimates), ("fit", fits), ("bound", bounds)):
        for path in paths:
            product = read_product(path, f"alignment_{kind}", ("states",))
            for other in earlier:
                keys = SAME_TEST if kind == "bound" else ("seed", *SAME_TEST)
                require(path, product.config, keys, other.config, other.path)
                _require_states(product, other)
            earlier.append(product)


def _require_states(product: Product, other: Product) -> None:
    ours, theirs = product["states"], other["states"]
    if product.config["test_set"] != other.config["test_set"] or np.array_equal(ours, theirs):
        return
    what, here, there = "number of states", len(ours), len(theirs)
    if here == there:
        row = int((ours != theirs).any(axis=1).argmax())
        what, here, there = f"state {row}", ours[row].tolist(), theirs[row].tolist()
    raise ProductError(f"{product.path}: {what} = {here}, but {other.path} has {there}")


def tables(
    states: Path,
    estimates: Sequence[Path],
    fits: Sequence[Path],
    bounds: Sequence[Path],
    errors_out: Path,
    correlation_out: Path,
) -> None:
    """Errors of every method and their correlations.

    Parameters
    ----------
    states : product "alignment_states", for the ranges in SI units
    estimates, fits, bounds : products of all test sets and noise levels
    errors_out : CSV, columns test_set, noise_level, method, parameter,
        mean_abs_error, bias, variance, variance_abs, unit, n
    correlation_out : CSV, columns test_set, noise_level, method, parameter_a,
        parameter_b, correlation, ci_low, ci_high

    Raises
    ------
    ProductError
        If a product is damaged, or they do not belong together.
    """
    import pandas as pd

    from psfdae.evaluation import alignment_tables as rows

    require_one_test(estimates, fits, bounds)
    product = read_product(states, "alignment_states", ("unit",))
    for path in bounds:
        bound = read_product(path, "alignment_bound", ())
        require(path, bound.config, STATE_STAMPS, product.config, states)
    unit = product["unit"]
    errors: list[dict[str, Any]] = []
    correlations: list[dict[str, Any]] = []
    for key, truth, estimate in read_errors(estimates, fits):
        errors += rows.error_rows(key, estimate - truth, unit)
        if key["method"] != "constant":
            correlations += rows.measured_correlations(key, estimate - truth)
    for path in bounds:
        product = read_product(path, "alignment_bound", ("levels", "covariances"))
        for level, covariances in zip(product["levels"], product["covariances"], strict=True):
            key = {"test_set": product.config["test_set"], "noise_level": float(level)}
            errors += rows.bound_rows({**key, "method": "cramer_rao"}, covariances, unit)
            correlations += rows.predicted_correlations(key, covariances)
    for table, path in ((errors, errors_out), (correlations, correlation_out)):
        frame = pd.DataFrame(table)
        order = [*rows.METHOD_LABELS, "cramer_rao_pooled"]
        frame = frame.sort_values(
            ["test_set", "noise_level", "method"],
            key=lambda c: c.map(order.index) if c.name == "method" else c,
            kind="stable",
        )
        write_text(path, frame.to_csv(index=False, float_format="%.8g"))


def paper_tables(errors: Path, correlation: Path, out: Path) -> None:
    """The paper's tables beside ours, CSV and Markdown.

    Parameters
    ----------
    errors, correlation : CSV files of `tables`
    out : folder that receives `alignment_paper_<level>` and
        `alignment_paper_correlation`, each as `.csv` and `.md`

    Raises
    ------
    ProductError
        If the noise levels have no rows.
    """

    from psfdae.evaluation import alignment_tables as rows
    from psfdae.evaluation.paper import published

    ours = read_table(errors)
    for level in sorted(published("alignment").noise_level.unique()):
        if not np.isclose(ours.noise_level, level).any():
            raise ProductError(f"{errors}: no rows of noise level {level:g}")
        table = rows.paper_errors(ours, level)
        title = f"Absolute errors in units of the range, λ = {level:g}"
        digits = {"mean": ".4f", "variance": ".2e"}
        _write(out / f"alignment_paper_{level:g}.csv", table, title, digits)
    table = rows.paper_correlations(read_table(correlation))
    title = "Correlations of signed errors"
    _write(out / "alignment_paper_correlation.csv", table, title, {"": ".3f"})


def _write(path: Path, table: Any, title: str, digits: dict[str, str]) -> None:
    from psfdae.evaluation.alignment_tables import as_markdown

    write_text(path, table.to_csv(index=False, float_format="%.6g"))
    write_text(path.with_suffix(".md"), as_markdown(table, title, digits))


def time_table(times: Sequence[Path], histories: dict[str, Path], out: Path) -> None:
    """What an estimate and a training cost.

    Parameters
    ----------
    times : CSV files of the stages that estimate
    histories : `history.csv` of the trainings dae, original, noise_trained, dae_retrained
    out : CSV, columns method, seconds_per_state, states, training_seconds; the
        mean over test sets and noise levels. The training of a method includes
        those of the networks that it needs.
    """
    import pandas as pd

    training = {
        name: float(read_table(path)["seconds"].iloc[-1]) for name, path in histories.items()
    }
    needs = {
        "original": ("original",),
        "dae": ("original", "dae"),
        "noise_trained": ("noise_trained",),
        "dae_retrained": ("dae", "dae_retrained"),
        "max_likelihood": ("noise_trained",),
    }
    table = pd.concat([read_table(path) for path in times], ignore_index=True)
    total = table.groupby("method")[["seconds", "states"]].sum()
    rows = [
        (
            method,
            total.seconds[method] / total.states[method],
            int(total.states[method]),
            sum(training[name] for name in networks),
        )
        for method, networks in needs.items()
    ]
    columns = ["method", "seconds_per_state", "states", "training_seconds"]
    write_text(out, pd.DataFrame(rows, columns=columns).to_csv(index=False, float_format="%.4g"))
