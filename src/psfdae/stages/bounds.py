"""Stages `bank`, `bounds` and `efficiency`: the best estimates, and ours beside them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from psfdae.belonging import STARS, STATIC, require
from psfdae.bounds.floor import compare, local_error, sensitivities
from psfdae.bounds.posterior import (
    MIRROR_MARGIN,
    TIGHT,
    Bank,
    Likelihood,
    PosteriorSums,
    exact_posterior,
    extrapolate,
    jittered_templates,
    last_change,
    nested_means,
    posterior_sums,
    segments,
)
from psfdae.cli import File, command
from psfdae.configuration.consistency import SIMULATION
from psfdae.configuration.schema import Config
from psfdae.estimators import method as method_named
from psfdae.evaluation.metrics import clustered_mean, mse
from psfdae.files import (
    Column,
    Product,
    ProductError,
    read_product,
    write_csv,
    write_parquet,
    write_product,
)
from psfdae.reading import read_table
from psfdae.rng import stream
from psfdae.stages.common import (
    drawn_columns,
    limit_threads,
    noise_model,
    noisy_test_images,
    split_stars,
    star_wavefronts,
)
from psfdae.stars.fields import assign_fields, relative_field
from psfdae.stars.framing import Propagation
from psfdae.stars.symmetry import orbit

if TYPE_CHECKING:
    import pandas as pd


SPLIT = "random"
"""The split that is bounded: its test stars lie in all fields."""

COLUMNS = ["dataset", "split", "reference", "method", "noise_level", "metric", "value"]
COLUMNS += ["stderr", "n", "ci_low", "ci_high", "tight"]

EFFICIENCY_COLUMNS = ["dataset", "reference", "noise_level", "method", "bound", "tight", "mse"]
EFFICIENCY_COLUMNS += ["mse_bound", "efficiency", "difference", "stderr", "n", "verdict"]

POSTERIOR_MEANS = {"bayes": False, "bayes_position": True}
"""Bounds that are posterior means, and whether they are told the star's field."""

COLUMN_OF_TABLE = ["dataset", "split", "reference", "noise_level"]
"""What one column of the paper's tables is: methods are compared inside it."""

GROWTH_COLUMNS = ["dataset", "reference", "method", "noise_level", "draws", "mse", "ess_mean"]
GROWTH_COLUMNS += ["ess_median", "last_change", "limit", "exponent", "fit_rms"]

HOPELESS_ESS = 2.0
"""A quarter of the bank with a smaller median effective sample size is not extended."""

NEGLIGIBLE_MSE = 1e-9
"""Errors below this are written as 0 where only a few images are possible.

They stem from a handful of doubtful stars or from rounding.
"""

NORMAL_95 = 1.959964
"""Half width of a 95 % confidence interval in standard errors."""

FINE_RUNGS = (158, 190)
"""Pupil samples that a bank may use besides `optics.pupil_samples`.

The sampling guard decides as it does for stars. Such stamps of scene 1 differ from
those of N = 222 by an MSE of 4e-11 at most, below any noise of the datasets, and
take half the time.
"""


@command("bank", reads=(*SIMULATION, "bounds"))
def bank(
    config: Config,
    out: Annotated[File, "HDF5 product with fresh stars, framed so that they can be mirrored."],
) -> None:
    """Simulate the bank of fresh stars behind the posterior mean."""
    limit_threads(1)  # batches run side by side
    parts = [
        _fresh_stars(config, name, count)
        for name, count in (
            ("bank", config.bounds.bank_stars),
            ("bank_position", config.bounds.position_stars),
        )
    ]
    columns = {
        name: replace(column, values=np.concatenate([part[name].values for part in parts]))
        for name, column in parts[0].items()
    }
    write_product(out, "bank", columns, config.model_dump())


def _fresh_stars(config: Config, suffix: str, count: int) -> dict[str, Column]:
    # Another name gives other random streams: no training or test star is in the bank.
    named = {"name": f"{config.stars.name}_{suffix}", "count": count}
    drawn = config.model_copy(update={"stars": config.stars.model_copy(update=named)})
    rng = stream(drawn.seed, "field", drawn.stars.name)
    star_field = assign_fields(count, drawn.grid.points**2, rng)
    source = star_wavefronts(drawn, star_field)
    ladder = sorted({*FINE_RUNGS, *drawn.optics.pupil_samples})
    optics = drawn.optics.model_copy(
        update={"pupil_samples": ladder, "threads": config.bounds.threads}
    )
    framing = drawn.framing
    propagation = Propagation(source, drawn.telescope, optics, framing, drawn.stars.search_px)
    framed, peak = propagation.framed(framing.stamp_px + 2 * (framing.jitter_px + MIRROR_MARGIN))
    return {
        "framed": Column(
            framed.astype(np.float32), "1", "pixel flux as a fraction of the light, with margin"
        ),
        "field_index": Column(star_field, "1", "field of the star"),
        "peak": Column(peak, "pixel", "brightest pixel (row, column) from the chief ray"),
        **drawn_columns(source),
        "pupil_samples": Column(propagation.samples, "1", "pupil samples N"),
    }


@dataclass(frozen=True)
class BoundedStars:
    """The test stars that are bounded.

    Attributes
    ----------
    star, field : ndarray of int, shape (n,)
        Number of the star in the product and its field.
    truth : dict of ndarray, shape (n, d, d)
        Noise-free image by reference.
    noisy : dict of ndarray, shape (n, d, d)
        Noisy image by noise level λ: the very images of the stage `evaluate`.
    """

    star: np.ndarray
    field: np.ndarray
    truth: dict[str, np.ndarray]
    noisy: dict[float, np.ndarray]

    def take(self, stars: np.ndarray) -> BoundedStars:
        """Some of the stars, in the order given."""
        truth, noisy = (
            {key: images[stars] for key, images in kind.items()}
            for kind in (self.truth, self.noisy)
        )
        return BoundedStars(self.star[stars], self.field[stars], truth, noisy)


class Tables:
    """Rows of a dataset's tables while they grow."""

    def __init__(self, dataset: str, stars: BoundedStars) -> None:
        self.dataset = dataset
        self.stars = stars
        self.summary: list[dict[str, Any]] = []
        self.per_star: list[pd.DataFrame] = []
        self.growth: list[dict[str, Any]] = []

    def add(
        self, reference: str, method: str, level: float, values: dict[str, np.ndarray], tight: bool
    ) -> None:
        """Per-star metrics of one bound and noise level; `ess` goes to the Parquet only."""
        import pandas as pd

        key = {"dataset": self.dataset, "split": SPLIT, "reference": reference, "method": method}
        key["noise_level"] = level
        for metric, value in values.items():
            if metric == "ess":
                continue
            mean, stderr = clustered_mean(value, self.stars.field)
            half = NORMAL_95 * stderr
            row = {"metric": metric, "value": mean, "stderr": stderr, "n": value.size}
            row |= {"ci_low": mean - half, "ci_high": mean + half}
            self.summary.append({**key, **row, "tight": "yes" if tight else "no"})
        stars = {"star": self.stars.star, "field": self.stars.field}
        self.per_star.append(pd.DataFrame({**key, **stars, **values}))


@command("bounds", reads=(*SIMULATION, "noise", "parts", "bounds"))
def bounds(
    config: Config,
    dataset: Annotated[str, "Name in the tables."],
    stars: Annotated[File, "Product of the stage stars."],
    templates: Annotated[File, "Product of the stage templates."],
    growth: Annotated[File, "CSV: error by size of the bank."],
    per_star: Annotated[File, "Parquet with every star."],
    out: Annotated[File, "CSV with the bounds."],
    bank: Annotated[
        File | None, "Product of the stage bank; needed where stars have random aberrations."
    ] = None,
) -> None:
    """Bound the error that any estimator can reach on the test stars."""
    import pandas as pd

    limit_threads(config.bounds.threads)
    product = read_product(stars, "stars")
    framed = read_product(templates, "templates", ("psf",))
    require(stars, product.config, STARS, config)
    require(templates, framed.config, STATIC, config)
    static = jittered_templates(framed["psf"], config.framing.jitter_px)
    tables = Tables(dataset, _test_stars(config, product))
    if config.stars.aberration_fraction == 0:
        _exact(config, static, tables)
    elif bank is None:
        raise ProductError(f"{stars}: the stars have random aberrations, a bank is needed")
    else:
        _floor(config, product, tables)
        drawn = read_product(bank, "bank", ("framed", "field_index", "peak"))
        require(bank, drawn.config, STARS, product.config, stars)
        sizes = (drawn.config["grid"]["points"], drawn.config["framing"]["jitter_px"])
        sample = Bank(drawn["framed"], drawn["field_index"], drawn["peak"], *sizes)
        count, fields = drawn.config["bounds"]["bank_stars"], sample.points**2
        if count < fields:
            raise ProductError(
                f"{bank}: bounds.bank_stars = {count}, must be at least {fields}, "
                "a star for every field"
            )
        _sampled(config, sample.take(np.arange(count)), sample, static, tables)
    write_csv(out, pd.DataFrame(tables.summary, columns=COLUMNS))
    write_csv(growth, pd.DataFrame(tables.growth, columns=GROWTH_COLUMNS))
    write_parquet(per_star, pd.concat(tables.per_star, ignore_index=True))


@command("collect-bounds")
def collect_bounds(
    out: Annotated[File, "CSV."], parts: Annotated[tuple[File, ...], {"argument": True}]
) -> None:
    """Join the tables of several datasets' bounds."""
    import pandas as pd

    frames = [read_table(path) for path in parts]
    for path, frame in zip(parts, frames, strict=True):
        if list(frame.columns) != list(frames[0].columns):
            raise ProductError(f"{path}: columns {list(frame.columns)}, unlike {parts[0]}")
    filled = [frame for frame in frames if len(frame)] or frames[:1]
    write_csv(out, pd.concat(filled, ignore_index=True))


def _test_stars(config: Config, product: Product) -> BoundedStars:
    test = split_stars(product, SPLIT, config).test
    first = slice(0, config.bounds.test_stars)
    kept = test[first]
    # The noise is drawn for all test stars, as the stage `evaluate` does, then cut.
    images = product["realisation"][test]
    return BoundedStars(
        star=kept,
        field=product["field_index"][kept],
        truth={name: product[name][kept] for name in ("realisation", "template")},
        noisy={lvl: noisy_test_images(config, images, lvl)[first] for lvl in config.noise.levels},
    )


def _floor(config: Config, product: Product, tables: Tables) -> None:
    stars = tables.stars
    field = relative_field(config.grid)
    stamps, derivatives = sensitivities(
        product["seidel"][stars.star],
        field[stars.field],
        product["peak"][stars.star] - product["jitter"][stars.star],
        product["pupil_samples"][stars.star],
        config.telescope,
        config.optics,
        config.framing.stamp_px,
    )
    spread = config.stars.aberration_fraction * np.abs(config.wavefront.coefficients)
    for level in config.noise.levels:
        variance = noise_model(config).variance(stamps, level)
        error = local_error(derivatives, spread, variance)
        tables.add("realisation", "floor", level, {"mse": error}, tight=False)


def _sampled(config: Config, bank: Bank, larger: Bank, static: np.ndarray, tables: Tables) -> None:
    """Posterior means over a bank, and how they change with its size.

    In a single field the larger one is needed, and in a moment weighed.
    """
    for level in config.noise.levels:
        likelihood = Likelihood.of(noise_model(config), level, bank.stamps((bank.margin,) * 2))
        for method, told in POSTERIOR_MEANS.items():
            start = time.monotonic()
            measured, drawn = (_told_the_field, larger) if told else (_anywhere, bank)
            sizes = measured(drawn, static, tables.stars, level, likelihood)
            _tabulate(tables, method, level, sizes)
            seconds = time.monotonic() - start
            print(f"λ = {level:g}, {method}: {max(sizes)} draws, {seconds:.1f} s", flush=True)


def _tabulate(tables: Tables, method: str, level: float, sizes: dict[int, np.ndarray]) -> None:
    """Rows of one posterior mean, whose `_errors` are given by number of draws."""
    draws, last = np.array(list(sizes)), sizes[max(sizes)]
    for i, reference in enumerate(tables.stars.truth):
        errors = np.array([values[i].mean() for values in sizes.values()])
        change = last_change(errors)
        values = {"mse": last[i], "ess": last[-1]}
        tables.add(reference, method, level, values, tight=change <= TIGHT)
        limit, exponent, residual = extrapolate(draws, errors)
        tables.growth += [
            {
                "dataset": tables.dataset,
                "reference": reference,
                "method": method,
                "noise_level": level,
                "draws": count,
                "mse": error,
                "ess_mean": values[-1].mean(),
                "ess_median": np.median(values[-1]),
                "last_change": change,
                "limit": limit,
                "exponent": exponent,
                "fit_rms": residual,
            }
            for count, error, values in zip(draws, errors, sizes.values(), strict=True)
        ]


def _anywhere(
    bank: Bank, static: np.ndarray, stars: BoundedStars, level: float, likelihood: Likelihood
) -> dict[int, np.ndarray]:
    """`_errors` of the posterior mean over all fields, by number of draws.

    A bank that is hopelessly thin for its noise level is left after a quarter.
    """
    cuts = np.array_split(np.arange(len(bank)), segments(len(bank)))
    noisy = stars.noisy[level]
    quarter = max(1, len(cuts) // 4)
    parts = [posterior_sums(bank.take(cut), noisy, likelihood) for cut in cuts[:quarter]]
    sizes = nested_means(parts, lambda sums: sums.effective_size)
    if np.median(sizes[quarter]) >= HOPELESS_ESS:
        parts += [posterior_sums(bank.take(cut), noisy, likelihood) for cut in cuts[quarter:]]
    draws = sum(cut.size for cut in cuts[: len(parts)])
    means = nested_means(parts, partial(_errors, static=static, stars=stars))
    return {round(draws / len(parts) * size): values for size, values in means.items()}


def _told_the_field(
    bank: Bank, static: np.ndarray, stars: BoundedStars, level: float, likelihood: Likelihood
) -> dict[int, np.ndarray]:
    """The same over the draws that the symmetries take to each star's own field.

    Fields that are mirror images of each other share theirs. Every part of the bank has
    as many of them, and the draws that are counted are those of the bank in all fields.
    """
    ours, theirs = orbit(stars.field, bank.points), orbit(bank.field, bank.points)
    groups = [(np.flatnonzero(ours == o), np.flatnonzero(theirs == o)) for o in np.unique(ours)]
    pieces = segments(min(draws.size for _, draws in groups))
    means: dict[int, np.ndarray] = {}
    for group, draws in groups:
        few = stars.take(group)
        weigh = partial(
            posterior_sums, noisy=few.noisy[level], likelihood=likelihood, told=few.field
        )
        parts = [weigh(bank.take(cut)) for cut in np.array_split(draws, pieces)]
        measure = partial(_errors, static=static, stars=few)
        for size, values in nested_means(parts, measure).items():
            total = means.setdefault(size, np.empty((len(values), stars.field.size)))
            total[:, group] = values
    return {round(len(bank) / pieces * size): values for size, values in means.items()}


def _errors(sums: PosteriorSums, static: np.ndarray, stars: BoundedStars) -> np.ndarray:
    """MSE against realisation and template, and effective sample size, shape (3, n)."""
    shape = stars.truth["realisation"].shape
    means = {"realisation": sums.mean_image, "template": sums.mean_template(static)}
    errors = [mse(means[name].reshape(shape), truth) for name, truth in stars.truth.items()]
    return np.stack([*errors, sums.effective_size])


def _exact(config: Config, static: np.ndarray, tables: Tables) -> None:
    """The exact posterior over the templates at all centring errors."""
    stars = tables.stars
    for level in config.noise.levels:
        likelihood = Likelihood.of(noise_model(config), level, static[:, static.shape[1] // 2])
        for method, told in POSTERIOR_MEANS.items():
            known = stars.field if told else None
            mean, probability = exact_posterior(stars.noisy[level], static, likelihood, known)
            error = mse(mean, stars.truth["realisation"])
            if error.mean() < NEGLIGIBLE_MSE:
                error = np.zeros_like(error)
            values = {"mse": error}
            if not told:
                values["p_right"] = probability[np.arange(stars.field.size), stars.field]
            tables.add("realisation", method, level, values, tight=True)


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
    Methods that are told the star's field have a posterior mean of their own; all are
    compared with the floor, and so are the posterior means. An efficiency is given for the
    floor and where the posterior mean is tight; the verdict is `beaten` if a method's error
    is below such a bound by more than two standard errors of the difference and 5 % of the
    bound, otherwise `ok`. Both are empty where a posterior mean is not tight.
    """
    import pandas as pd

    limits = pd.concat([read_table(path) for path in bounds], ignore_index=True)
    sure = limits.method.isin(POSTERIOR_MEANS) & (limits.metric == "mse") & (limits.tight == "yes")
    tight = {
        (row.dataset, row.reference, row.method, f"{row.noise_level:.6g}")
        for row in limits[sure].itertuples()
    }
    best = pd.concat([pd.read_parquet(path) for path in bounds_per_star], ignore_index=True)
    wanted = [*COLUMN_OF_TABLE, "method", "star", "field", "mse"]
    methods = pd.concat([pd.read_parquet(path, columns=wanted) for path in parts])
    # The posterior mean over a bank is an estimator and must respect the floor.
    means = best[best.method.isin(POSTERIOR_MEANS)][wanted]
    methods = pd.concat([methods, means], ignore_index=True)
    by_column = dict(list(methods.groupby(COLUMN_OF_TABLE, sort=False)))
    rows: list[dict[str, Any]] = []
    for key, bounded in best.groupby(COLUMN_OF_TABLE, sort=False):
        found = by_column[key]
        if found.method.isin(POSTERIOR_MEANS).all():
            raise ProductError(f"{', '.join(map(str, key))}: bounded, but no method was evaluated")
        rows += _column(dict(zip(COLUMN_OF_TABLE, key, strict=True)), found, bounded, tight)
    write_csv(out, pd.DataFrame(rows, columns=EFFICIENCY_COLUMNS))


def _column(
    key: dict[str, Any], methods: pd.DataFrame, bounded: pd.DataFrame, tight: set[tuple[Any, ...]]
) -> Iterator[dict[str, Any]]:
    """Rows of one dataset, reference and λ: every method beside every bound it has to respect."""
    place = f"{key['dataset']}, {key['reference']}, λ = {key['noise_level']:g}"
    for bound, limits in bounded.groupby("method", sort=False):
        sharp = (key["dataset"], key["reference"], bound, f"{key['noise_level']:.6g}") in tight
        for method, errors in methods.groupby("method", sort=False):
            if bound != "floor" and (
                method in POSTERIOR_MEANS
                or POSTERIOR_MEANS[bound] != method_named(method).told_position
            ):
                continue
            paired = limits.merge(errors, on="star", suffixes=("_bound", ""), validate="1:1")
            if len(paired) < len(limits):
                missing = len(limits) - len(paired)
                raise ProductError(f"{place}: {method} lacks {missing} of the bounded stars")
            moved = paired[paired["field"] != paired["field_bound"]]
            if len(moved):
                star, field, bounded_in = moved[["star", "field", "field_bound"]].iloc[0]
                raise ProductError(
                    f"{place}: star {star} of {method} lies in field {field}, "
                    f"but that of the bounds in {bounded_in}"
                )
            found = compare(
                paired["mse"].to_numpy(), paired["mse_bound"].to_numpy(), paired["field"].to_numpy()
            )
            judged = bound == "floor" or sharp
            yield {
                **key,
                "method": method,
                "bound": bound,
                "tight": "yes" if sharp else "no",
                "mse": found.mse,
                "mse_bound": found.bound,
                "efficiency": found.efficiency if judged else None,
                "difference": found.difference,
                "stderr": found.stderr,
                "n": len(paired),
                "verdict": ("beaten" if found.beaten else "ok") if judged else None,
            }
