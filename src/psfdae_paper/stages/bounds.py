"""Stages `bank`, `bounds`, `optics`, `efficiency`, `paper-rows`: bounds of the error of estimates.

They simulate stars, bound the error of any estimate of the test stars, and compare the errors of
methods with these bounds.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Annotated

import numpy as np
import pandas as pd

from psfdae.base.belonging import STARS, STATIC, require
from psfdae.base.files import ProductError, read_product, write_csv, write_parquet, write_product
from psfdae.base.options import File
from psfdae.base.progress import steps
from psfdae.base.reading import read_table
from psfdae.base.threads import limit_threads
from psfdae.training.star_sets import field_positions, training_set
from psfdae_paper.bounds import tables
from psfdae_paper.bounds.estimates import SPLIT, read_test_stars, simulate_fresh_stars
from psfdae_paper.bounds.floor import Comparison
from psfdae_paper.bounds.posterior import Bank, cut_templates
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.consistency import SIMULATION
from psfdae_paper.configuration.schema import Config
from psfdae_paper.evaluation.measure import CELL, MeasuredStars, read_tables
from psfdae_paper.evaluation.paper import read_paper_names, read_published
from psfdae_paper.methods.wavefront import Wavefront
from psfdae_paper.methods.wavefront_position import PlacedWavefront

BANK_COLUMNS = ("framed", "field_index", "peak", "seidel")
"""Columns of the product "bank" that the bounds use."""


@command("paper bank", reads=(*SIMULATION, "bounds"))
def bank(config: Config, out: File) -> None:
    """Simulate the bank of fresh stars behind the posterior mean.

    They are new draws of the simulator of the test stars, with a margin, so that one propagated
    star represents all eight of its mirror images and rotations.

    The product has the framed stars, the number of each star's field, its brightest pixel and the
    Seidel coefficients. All bounds use its first bounds.bank_stars; bounds of methods that are
    given the field use the others, too.

    Parameters
    ----------
    config : Config
        Settings of the simulation and of the bounds.
    out : Path
        HDF5 product with fresh stars, framed so that they can be mirrored.
    """
    limit_threads(1)  # batches run in parallel
    # Two draws of the simulator, one after the other: the second has its own random streams.
    parts = [
        simulate_fresh_stars(config, name, count, config.bounds.threads)
        for name, count in (
            ("bank", config.bounds.bank_stars),
            ("bank_position", config.bounds.position_stars),
        )
    ]
    # Columns of both draws, one below the other; each has the same units.
    columns = {
        name: replace(column, values=np.concatenate([part[name].values for part in parts]))
        for name, column in parts[0].items()
    }
    write_product(out, "bank", columns, config.model_dump())


@command("paper bounds", reads=(*SIMULATION, "noise", "parts", "bounds"))
def bounds(
    config: Config,
    dataset: str,
    stars: File,
    templates: File,
    growth: File,
    per_star: File,
    out: File,
    bank: File | None = None,
) -> None:
    """Bound the error that any estimator can reach on the test stars.

    The posterior mean over the simulator's stars has the minimum mean squared error; a column says
    where the bank is large enough for it. The local floor is the error if field and centring are
    known.

    There are three tables: the bounds with their standard errors, by noise level and reference; the
    error for banks of growing size, which shows whether the bank is large enough; and the squared
    error of every star.

    Parameters
    ----------
    config : Config
        Settings of the simulation, noise, parts and bounds.
    dataset : str
        Name in the tables.
    stars : Path
        Product of the stage stars.
    templates : Path
        Product of the stage templates.
    growth : Path
        CSV: error by size of the bank.
    per_star : Path
        Parquet with every star.
    out : Path
        CSV with the bounds.
    bank : Path, optional
        Product of the stage bank; needed where stars have random aberrations.
    """
    # Test stars, and templates with every centring error.
    limit_threads(config.bounds.threads)
    product = read_product(stars, "stars")
    require(stars, product.config, STARS, config)
    template_product = read_product(templates, "templates", ("psf",))
    require(templates, template_product.config, STATIC, config)
    # The static PSFs with all centring errors that a star may have.
    static = cut_templates(template_product["psf"], config.framing.jitter_px)
    # All bounds of a dataset add their rows to these tables.
    bound = tables.Tables(dataset, read_test_stars(config, product))
    # Without random aberrations a star is one of the templates, and the bound is exact.
    if config.stars.aberration_fraction == 0:
        tables.add_exact(config, static, bound)
    elif bank is None:
        raise ProductError(f"{stars}: the stars have random aberrations, a bank is needed")
    else:
        # The floor: field and centring error are known, the random aberrations are not.
        tables.add_floor(config, product, bound)
        bank_product = read_product(bank, "bank", BANK_COLUMNS)
        require(bank, bank_product.config, STARS, product.config, stars)
        settings = bank_product.config
        # Points along a side of the field, and the largest centring error.
        sizes = (settings["grid"]["points"], settings["framing"]["jitter_px"])
        # Only bounds for a given field use the stars after the first `bank_stars`.
        large_bank = Bank.from_columns(bank_product.arrays, *sizes)
        count, fields = settings["bounds"]["bank_stars"], large_bank.points**2
        if count < fields:
            raise ProductError(
                f"{bank}: bounds.bank_stars = {count}, must be at least {fields}, "
                "a star for every field"
            )
        small_bank = large_bank.take(np.arange(count))
        tables.add_means(config, small_bank, large_bank, product, static, bound)
    write_csv(out, pd.DataFrame(bound.summary, columns=bound.summary_columns))
    write_csv(growth, pd.DataFrame(bound.growth, columns=bound.growth_columns))
    write_parquet(per_star, pd.concat(bound.per_star, ignore_index=True))


@command("paper optics", reads=(*SIMULATION, "noise", "parts", "bounds", "evaluation"))
def optics(
    config: Config, dataset: str, stars: File, bank: File, per_star: File, out: File
) -> None:
    """Measure the methods that are given the telescope, on the test stars of the bounds.

    They estimate the wavefront of each star; one of them is also given its position.

    The table has the columns of `evaluate`. These methods know more than any other, and show how
    near an estimate of a single star comes to the bound.

    Parameters
    ----------
    config : Config
        Settings of the simulation, noise, parts, bounds and evaluation.
    dataset : str
        Name in the tables.
    stars : Path
        Product of the stage stars.
    bank : Path
        Product of the stage bank.
    per_star : Path
        Parquet with every star.
    out : Path
        CSV with means and standard errors.
    """
    limit_threads(1)
    product = read_product(stars, "stars")
    require(stars, product.config, STARS, config)
    bank_product = read_product(bank, "bank", BANK_COLUMNS)
    require(bank, bank_product.config, STARS, product.config, stars)
    test_stars = read_test_stars(config, product)
    # Field position of each bounded star, which one of the methods is given.
    position = field_positions(product)[test_stars.star]
    # Without, then with the position of the star in the field.
    summary, stars_table = [], []
    for method in (Wavefront, PlacedWavefront):
        data = {r: training_set(config, method, product, SPLIT, r) for r in test_stars.truth}
        # The posterior does not depend on the reference: it is computed once for all references.
        first = method.from_bank(bank_product.arrays, config, next(iter(data.values())))
        estimators = {reference: replace(first, data=data[reference]) for reference in data}
        for level, noisy in steps("noise levels", test_stars.noisy.items()):
            # Time for the log: the posterior takes most of it.
            start = time.monotonic()
            posterior = first.posterior(noisy, level, position)
            for reference, estimator in estimators.items():
                # Both references have the same posterior, and images of their own.
                estimate = estimator.estimate_from_posterior(*posterior, noisy, level, position)
                truth = test_stars.truth[reference]
                stars_of_truth = MeasuredStars(test_stars.star, test_stars.field, position, truth)
                row: dict[str, object] = {"dataset": dataset, "split": SPLIT}
                row |= {"reference": reference, "method": method.name, "noise_level": level}
                rows, table = stars_of_truth.errors(row, estimate, config.evaluation.data_range)
                summary += rows
                stars_table.append(table)
            print(f"{method.name}, λ = {level:g}: {time.monotonic() - start:.1f} s", flush=True)
    write_csv(out, pd.DataFrame(summary))
    write_parquet(per_star, pd.concat(stars_table, ignore_index=True))


@command("paper collect-bounds")
def collect_bounds(out: File, parts: Annotated[tuple[File, ...], {"argument": True}]) -> None:
    """Join the tables of several datasets' bounds; all must have the columns of the first.

    PARTS are CSV files of the stage bounds, or of the stage optics; the rows keep their order.

    Parameters
    ----------
    out : Path
        CSV.
    parts : sequence of Path
        CSV files of the stage bounds, or of the stage optics.
    """
    write_csv(out, read_tables(parts))


@command("paper efficiency")
def efficiency(
    bounds: tuple[File, ...],
    bounds_per_star: tuple[File, ...],
    out: File,
    parts: Annotated[tuple[File, ...], {"argument": True}],
) -> None:
    """Compare methods with the bounds; PARTS are the evaluations' Parquet files.

    They are paired by star; only errors of the bounded stars are used. Methods that are given the
    star's field have a posterior mean of their own; all methods, and the posterior means, are
    compared with the floor. An efficiency is given for the floor and where the posterior mean is
    tight; the verdict is `beaten` if a method's error is below such a bound by more than two
    standard errors of the difference and 5 % of the bound (20 % for the floor, which is not a
    strict lower limit), otherwise `ok`. Both are empty where a posterior mean is not tight. Stars
    without a posterior mean are left out on both sides; both are also empty where these are more
    than 1 %.

    Parameters
    ----------
    bounds : sequence of Path
        CSV of the stage bounds; repeat for more datasets.
    bounds_per_star : sequence of Path
        Parquet of the stage bounds; repeat for more datasets.
    out : Path
        CSV with each method at each bound.
    parts : sequence of Path
        Parquet files of the stage evaluate.
    """
    # Keys of the posterior means that are tight.
    limits = read_tables(bounds)
    is_mean_mse = limits.method.isin(tables.POSTERIOR_MEANS) & (limits.metric == "mse")
    tight_rows = limits[is_mean_mse & (limits.tight == "yes")]
    levels = map("{:.6g}".format, tight_rows.noise_level)
    tight = {*zip(tight_rows.dataset, tight_rows.reference, tight_rows.method, levels, strict=True)}
    # Errors of methods by star, in groups that are columns of the paper's tables. The posterior
    # mean over a bank is an estimator, too: its error must be above the floor. Bounds are paired
    # with errors star by star, so that their common scatter cancels.
    bound_stars = pd.concat([read_table(path) for path in bounds_per_star], ignore_index=True)
    columns = [*CELL, "method", "star", "field", "mse"]
    methods = pd.concat([read_table(path, columns=columns) for path in parts])
    means = bound_stars[bound_stars.method.isin(tables.POSTERIOR_MEANS)][columns]
    methods = pd.concat([methods, means], ignore_index=True)
    # A cell is a dataset, split, reference and noise level.
    by_cell = dict(list(methods.groupby(CELL, sort=False)))
    rows: list[dict[str, object]] = []
    for key, bound in bound_stars.groupby(CELL, sort=False):
        # A cell that was bounded must have been evaluated.
        errors = by_cell[key]
        if errors.method.isin(tables.POSTERIOR_MEANS).all():
            raise ProductError(f"{', '.join(map(str, key))}: bounded, but no method was evaluated")
        rows += tables.compare_methods(dict(zip(CELL, key, strict=True)), errors, bound, tight)
    write_csv(out, pd.DataFrame(rows).drop(columns="split"))


@command("paper paper-rows")
def paper_rows_table(bounds: File, efficiency: File, out: File) -> None:
    """Compare the paper's errors with the posterior mean of the simulated scenes.

    The reference is the realisation. Measured errors and the bound are means over the bounded
    stars; `stderr` is the standard error of the bound. The paper's error is `below what this scene
    allows` if it is below a tight bound as in the stage efficiency. A bound that is not tight is
    above the minimum error: an error below it proves nothing.

    A row is a method at a noise level of a dataset: the paper's error, the error of this run, the
    bound with its standard error, whether it is tight, the paper's error over the bound, and the
    verdict.

    Parameters
    ----------
    bounds : Path
        CSV of the bounds of all datasets.
    efficiency : Path
        CSV of the stage efficiency.
    out : Path
        CSV with the paper's errors, measured errors and bounds.
    """
    key = ["dataset", "noise_level"]
    # The paper's errors under the names of the methods here.
    paper = read_published("psf").query("metric == 'mse'").replace({"method": read_paper_names()})
    measured_rows = read_table(efficiency).query("bound == 'bayes' and reference == 'realisation'")
    limits = read_table(bounds).query(
        "method == 'bayes' and reference == 'realisation' and metric == 'mse'"
    )
    table = paper[[*key, "method", "value"]].rename(columns={"value": "mse_paper"})
    # Only rows that the paper and this run both have.
    table = table.merge(measured_rows[[*key, "method", "mse"]], on=[*key, "method"])
    table = table.merge(
        limits[[*key, "value", "stderr", "tight"]].rename(columns={"value": "mse_bound"}), on=key
    )
    # Above zero, the paper's error is above the bound.
    difference = table.mse_paper - table.mse_bound
    values = zip(table.mse_paper, table.mse_bound, difference, table.stderr, strict=True)
    comparisons = [Comparison(*row) for row in values]
    table["paper_over_bound"] = [1 / comparison.efficiency for comparison in comparisons]
    table["verdict"] = list(map(tables.judge_paper, comparisons, table.tight == "yes"))
    columns = ["dataset", "method", "noise_level", "mse_paper", "mse", "mse_bound", "stderr"]
    write_csv(out, table[[*columns, "tight", "paper_over_bound", "verdict"]])
