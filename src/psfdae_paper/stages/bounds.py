"""Stages `bank`, `bounds`, `efficiency`, `paper-rows`: the best estimates, and others beside."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from psfdae.belonging import STARS, STATIC, require
from psfdae.files import (
    Column,
    Product,
    ProductError,
    read_product,
    write_csv,
    write_parquet,
    write_product,
)
from psfdae.methods import method as method_named
from psfdae.metrics import clustered_mean, mse
from psfdae.model.star_sets import noise_model, noisy_test_images, split_stars
from psfdae.options import File
from psfdae.reading import read_table
from psfdae.rng import stream
from psfdae.threads import limit_threads
from psfdae_paper.bounds.floor import (
    FLOOR_TOLERANCE,
    TOLERANCE,
    Comparison,
    compare,
    local_error,
    sensitivities,
)
from psfdae_paper.bounds.posterior import (
    MIRROR_MARGIN,
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
from psfdae_paper.bounds.sampling import TRUTH, Modes, Sampled, StampModel, sample
from psfdae_paper.bounds.tight import FEW, Evidence, calibration
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.consistency import SIMULATION
from psfdae_paper.configuration.schema import Config
from psfdae_paper.stages.common import drawn_columns, star_wavefronts
from psfdae_paper.stars.fields import assign_fields, relative_field
from psfdae_paper.stars.framing import Propagation
from psfdae_paper.stars.symmetry import orbit

if TYPE_CHECKING:
    import pandas as pd


SPLIT = "random"
"""The split that is bounded: its test stars lie in all fields."""

COLUMNS = ["dataset", "split", "reference", "method", "noise_level", "metric", "value"]
COLUMNS += ["stderr", "n", "ci_low", "ci_high", "median", "variance", "calibration"]
COLUMNS += ["missing", "missing_stars", "tight", "found", "draws", "sampled"]
COLUMNS += ["ess_median", "ess_low", "last_change", "undetected"]

EFFICIENCY_COLUMNS = ["dataset", "reference", "noise_level", "method", "bound", "tight", "mse"]
EFFICIENCY_COLUMNS += ["mse_bound", "efficiency", "difference", "stderr", "n", "median"]
EFFICIENCY_COLUMNS += ["median_bound", "variance_bound", "verdict"]

PAPER_COLUMNS = ["dataset", "method", "noise_level", "mse_paper", "mse", "mse_bound", "stderr"]
PAPER_COLUMNS += ["tight", "paper_over_bound", "verdict"]

POSTERIOR_MEANS = {"bayes": False, "bayes_position": True}
"""Bounds that are posterior means, and whether they are given the star's field."""

COLUMN_OF_TABLE = ["dataset", "split", "reference", "noise_level"]
"""What one column of the paper's tables is: methods are compared inside it."""

GROWTH_COLUMNS = ["dataset", "reference", "method", "noise_level", "draws", "mse", "ess_mean"]
GROWTH_COLUMNS += ["ess_median", "last_change", "limit", "exponent", "fit_rms"]

HOPELESS_ESS = 2.0
"""A quarter of the bank with a smaller median effective sample size is not extended."""

ENOUGH_ESS = 50.0
"""Effective sample size below which a star gets importance samples of its own.

The error of a mean over so many is 2 % above that of the exact mean.
"""

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
        self,
        reference: str,
        method: str,
        level: float,
        values: dict[str, np.ndarray],
        tight: bool,
        found: str,
        **reached: float,
    ) -> None:
        """Per-star metrics of one bound and noise level.

        `found` says from what. Stars without an estimate, whose `mse` is NaN, are named and left
        out of every mean. Of the posterior variances `variance` the table has the mean;
        `reached` are other columns.
        """
        import pandas as pd

        key = {"dataset": self.dataset, "split": SPLIT, "reference": reference, "method": method}
        key["noise_level"] = level
        known = np.isfinite(values["mse"])
        field = self.stars.field[known]
        common: dict[str, Any] = {"n": field.size, "missing": int((~known).sum()), **reached}
        common["missing_stars"] = " ".join(map(str, self.stars.star[~known]))
        common |= {"tight": "yes" if tight else "no", "found": found}
        for metric in [name for name in ("mse", "p_right") if name in values]:
            value = values[metric][known]
            mean, stderr = clustered_mean(value, field) if value.size else (np.nan, np.nan)
            half = NORMAL_95 * stderr
            row = {"metric": metric, "value": mean, "stderr": stderr}
            row |= {"ci_low": mean - half, "ci_high": mean + half}
            if value.size:
                row["median"] = float(np.median(value))
            if metric == "mse" and "variance" in values and value.size:
                row["variance"] = values["variance"][known].mean()
            self.summary.append({**key, **row, **common})
        stars = {"star": self.stars.star, "field": self.stars.field}
        self.per_star.append(pd.DataFrame({**key, **stars, **values}))

    def add_mean(
        self, method: str, level: float, estimates: Estimates, found: str, **reached: float
    ) -> None:
        """The same of a posterior mean over samples for all references, tight by its evidence."""
        reached["ess_median"] = float(np.median(estimates.ess))
        for number, reference in enumerate(self.stars.truth):
            values = estimates.values(number)
            evidence = estimates.evidence(number, self.stars.field)
            found_by = {**reached, **vars(evidence)}
            self.add(reference, method, level, values, evidence.tight, found, **found_by)


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
        drawn = read_product(bank, "bank", ("framed", "field_index", "peak", "seidel"))
        require(bank, drawn.config, STARS, product.config, stars)
        sizes = (drawn.config["grid"]["points"], drawn.config["framing"]["jitter_px"])
        everything = Bank(drawn["framed"], drawn["field_index"], drawn["peak"], *sizes)
        count, fields = drawn.config["bounds"]["bank_stars"], everything.points**2
        if count < fields:
            raise ProductError(
                f"{bank}: bounds.bank_stars = {count}, must be at least {fields}, "
                "a star for every field"
            )
        _over_bank(
            config, everything.take(np.arange(count)), everything, drawn, product, static, tables
        )
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
    kept = test[: config.bounds.test_stars]
    return BoundedStars(
        star=kept,
        field=product["field_index"][kept],
        truth={name: product[name][kept] for name in ("realisation", "template")},
        noisy={lvl: noisy_test_images(config, product, kept, lvl) for lvl in config.noise.levels},
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
        tables.add("realisation", "floor", level, {"mse": error}, tight=False, found="derivatives")


def _over_bank(
    config: Config,
    bank: Bank,
    larger: Bank,
    drawn: Product,
    product: Product,
    static: np.ndarray,
    tables: Tables,
) -> None:
    """Posterior means over a bank, how they change with its size, and better ones.

    In a single field the larger bank is needed, and in a moment weighed. Stars for which a bank
    has too few similar stars get importance samples around their own matches.
    """
    stars = tables.stars
    for level in config.noise.levels:
        start = time.monotonic()
        likelihood = Likelihood.of(noise_model(config), level, bank.stamps((bank.margin,) * 2))
        over_banks, sparse = {}, np.zeros(stars.star.size, bool)
        for method, given in POSTERIOR_MEANS.items():
            draws = larger if given else bank
            sizes = _weighed(draws, given, static, stars, level, likelihood)
            _grown(tables, method, level, sizes)
            over_banks[method] = max(sizes), Estimates.over_bank(sizes)
            sparse |= over_banks[method][1].ess < ENOUGH_ESS
        few, sampled = np.flatnonzero(sparse), {}
        if few.size:
            some = stars.take(few)
            found = _samples(config, bank, drawn["seidel"], product, some, level, likelihood)
            sums = ((found.free, found.free_helped), (found.in_field, found.in_field_helped))
            for method, (parts, helped) in zip(POSTERIOR_MEANS, sums, strict=True):
                sampled[method] = Estimates.over_samples(parts, helped, static, some)
        for method, (draws, over_bank) in over_banks.items():
            best, chosen = over_bank.improved(few, sampled.get(method))
            source = {0: "bank", stars.star.size: "samples"}.get(chosen, "both")
            count = config.bounds.star_draws if source == "samples" else draws
            tables.add_mean(method, level, best, source, draws=count, sampled=chosen)
        seconds = time.monotonic() - start
        print(f"λ = {level:g}: {few.size} stars sampled, {seconds:.1f} s", flush=True)


@dataclass(frozen=True)
class Estimates:
    """`_measures`, shape (5, n), of one posterior mean.

    Attributes
    ----------
    full, quarter : ndarray, shape (5, n)
        Of all samples, and of a quarter of them.
    helped : ndarray, shape (5, n)
        Of all samples and those around modes that only the truth leads to.
    """

    full: np.ndarray
    quarter: np.ndarray
    helped: np.ndarray

    @classmethod
    def over_bank(cls, sizes: dict[int, np.ndarray]) -> Estimates:
        """From `_measures` by number of draws, each twice that before."""
        nested = list(sizes.values())
        quarter = nested[-3] if len(nested) > 2 else np.full_like(nested[-1], np.nan)
        return cls(nested[-1], quarter, nested[-1])

    @classmethod
    def over_samples(
        cls,
        parts: list[PosteriorSums],
        helped: PosteriorSums,
        static: np.ndarray,
        stars: BoundedStars,
    ) -> Estimates:
        """From sums over importance samples in four parts, and those with the truth's modes."""
        measure = partial(_measures, static=static, stars=stars)
        quarter, _, full = nested_means(parts, measure).values()
        return cls(full, quarter, measure(helped))

    @property
    def ess(self) -> np.ndarray:
        """Effective sample size of every star."""
        return self.full[-1]

    def improved(self, few: np.ndarray, other: Estimates | None) -> tuple[Estimates, int]:
        """With another one of the stars `few` where it has more samples, and for how many."""
        if other is None:
            return self, 0
        better = (self.ess[few] < ENOUGH_ESS) & (other.ess > self.ess[few])
        changed = {name: values.copy() for name, values in vars(self).items()}
        for name, values in changed.items():
            values[:, few[better]] = getattr(other, name)[:, better]
        return Estimates(**changed), int(better.sum())

    def values(self, number: int) -> dict[str, np.ndarray]:
        """Error and variance of every star by one reference, and the effective sample size."""
        return {"mse": self.full[number], "variance": self.full[2 + number], "ess": self.ess}

    def evidence(self, number: int, field: np.ndarray) -> Evidence:
        """Whether the mean of one reference is near the exact one."""
        return Evidence.of(
            **self.values(number),
            field=field,
            last_change=abs(_change(self.quarter[number], self.full[number])),
            undetected=-_change(self.helped[number], self.full[number]),
        )


def _change(errors: np.ndarray, full: np.ndarray) -> float:
    """Relative difference of mean errors, over the stars that have both."""
    known = np.isfinite(errors) & np.isfinite(full)
    return float(errors[known].mean() / full[known].mean() - 1.0) if known.any() else np.nan


def _grown(tables: Tables, method: str, level: float, sizes: dict[int, np.ndarray]) -> None:
    """Rows of `growth`: `_measures` of one posterior mean over a bank by number of draws."""
    draws, bank = np.array(list(sizes)), Estimates.over_bank(sizes)
    for number, reference in enumerate(tables.stars.truth):
        errors = np.array([measures[number].mean() for measures in sizes.values()])
        limit, exponent, residual = extrapolate(draws, errors)
        if not bank.evidence(number, tables.stars.field).tight:
            # Far from convergence the fit extrapolates to anything, down to zero.
            limit = float("nan")
        tables.growth += [
            {
                "dataset": tables.dataset,
                "reference": reference,
                "method": method,
                "noise_level": level,
                "draws": count,
                "mse": error,
                "ess_mean": measures[-1].mean(),
                "ess_median": np.median(measures[-1]),
                "last_change": last_change(errors),
                "limit": limit,
                "exponent": exponent,
                "fit_rms": residual,
            }
            for count, error, measures in zip(draws, errors, sizes.values(), strict=True)
        ]


def _samples(
    config: Config,
    bank: Bank,
    seidel: np.ndarray,
    product: Product,
    stars: BoundedStars,
    level: float,
    likelihood: Likelihood,
) -> Sampled:
    """Importance samples around the best matches of every star, from a stream of its own."""
    mean = np.array(config.wavefront.coefficients)
    spread = config.stars.aberration_fraction * np.abs(mean)
    field = relative_field(config.grid)
    model = StampModel(mean, spread, field, config.telescope, config.optics, config.framing)
    names = ("bounds", config.stars.name, f"{level:.6g}")
    rngs = [stream(config.seed, *names, int(star)) for star in stars.star]
    noisy, draws = stars.noisy[level], config.bounds.star_draws
    count = stars.star.size
    truth = Modes.at(
        np.arange(count),
        stars.field,
        product["peak"][stars.star] - product["jitter"][stars.star],
        np.full(count, TRUTH),
        model.standardised(product["seidel"][stars.star]),
    )
    return sample(bank, seidel, noisy, truth, likelihood, model, draws, rngs)


def _anywhere(stars: BoundedStars, bank: Bank) -> list[tuple[np.ndarray, np.ndarray]]:
    """Test stars and the draws that they are weighed with: all with all."""
    return [(np.arange(stars.field.size), np.arange(len(bank)))]


def _in_the_field(stars: BoundedStars, bank: Bank) -> list[tuple[np.ndarray, np.ndarray]]:
    """The same for draws that the symmetries take to each star's own field.

    Fields that are mirror images of each other share theirs.
    """
    ours, theirs = orbit(stars.field, bank.points), orbit(bank.field, bank.points)
    return [(np.flatnonzero(ours == o), np.flatnonzero(theirs == o)) for o in np.unique(ours)]


def _weighed(
    bank: Bank, given: bool, static: np.ndarray, stars: BoundedStars, level: float, like: Likelihood
) -> dict[int, np.ndarray]:
    """`_measures` of the posterior mean over a bank, with the field given or not, by its size.

    Every part of the bank has as many draws of every group, and those that are counted are
    the draws in all fields. A bank in which far too few stars are similar at its noise level is
    left after a quarter.
    """
    groups = _in_the_field(stars, bank) if given else _anywhere(stars, bank)
    pieces = segments(min(draws.size for _, draws in groups))
    quarter = max(1, pieces // 4)
    several = [(stars.take(group), np.array_split(draws, pieces)) for group, draws in groups]

    def weigh(first: int, end: int) -> list[list[PosteriorSums]]:
        return [
            [
                posterior_sums(
                    *(bank.take(cut), few.noisy[level], like),
                    own_field=few.field if given else None,
                )
                for cut in cuts[first:end]
            ]
            for few, cuts in several
        ]

    parts = weigh(0, quarter)
    sizes = [nested_means(part, lambda sums: sums.effective_size)[quarter] for part in parts]
    if np.median(np.concatenate(sizes)) >= HOPELESS_ESS:
        parts = [old + new for old, new in zip(parts, weigh(quarter, pieces), strict=True)]
    means: dict[int, np.ndarray] = {}
    for (group, _), (few, _), part in zip(groups, several, parts, strict=True):
        measure = partial(_measures, static=static, stars=few)
        for size, values in nested_means(part, measure).items():
            total = means.setdefault(size, np.empty((len(values), stars.field.size)))
            total[:, group] = values
    return {round(len(bank) / pieces * size): values for size, values in means.items()}


def _measures(sums: PosteriorSums, static: np.ndarray, stars: BoundedStars) -> np.ndarray:
    """MSE against realisation and template, variances of both, effective sample size, (5, n)."""
    shape = stars.truth["realisation"].shape
    template, spread = sums.template(static)
    means = {"realisation": sums.mean_image, "template": template}
    errors = [mse(means[name].reshape(shape), truth) for name, truth in stars.truth.items()]
    return np.stack([*errors, sums.variance_image, spread, sums.effective_size])


def _exact(config: Config, static: np.ndarray, tables: Tables) -> None:
    """The exact posterior over the templates at all centring errors."""
    stars = tables.stars
    for level in config.noise.levels:
        likelihood = Likelihood.of(noise_model(config), level, static[:, static.shape[1] // 2])
        for method, given_field in POSTERIOR_MEANS.items():
            known = stars.field if given_field else None
            mean, variance, probability = exact_posterior(
                stars.noisy[level], static, likelihood, known
            )
            error = mse(mean, stars.truth["realisation"])
            if error.mean() < NEGLIGIBLE_MSE:
                error, variance = np.zeros_like(error), np.zeros_like(error)
            values = {"mse": error, "variance": variance}
            if not given_field:
                values["p_right"] = probability[np.arange(stars.field.size), stars.field]
            score = calibration(error, variance, stars.field)
            tables.add("realisation", method, level, values, True, "sum", calibration=score)


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
    Methods that are given the star's field have a posterior mean of their own; all are
    compared with the floor, and so are the posterior means. An efficiency is given for the
    floor and where the posterior mean is tight; the verdict is `beaten` if a method's error
    is below such a bound by more than two standard errors of the difference and 5 % of the
    bound (of the floor, which is no lower limit, 20 %), otherwise `ok`. Both are empty where a
    posterior mean is not tight. Stars without a posterior mean are left out on both sides; both
    are empty, too, where these are more than 1 %.
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
                or POSTERIOR_MEANS[bound] != method_named(method).needs.position
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
            estimated = paired.mse_bound.notna()
            if method in POSTERIOR_MEANS:
                estimated &= paired.mse.notna()
            judged = (bound == "floor" or sharp) and (~estimated).mean() <= FEW
            paired = paired[estimated]
            found = compare(
                *(paired[column].to_numpy() for column in ("mse", "mse_bound", "field")),
                FLOOR_TOLERANCE if bound == "floor" else TOLERANCE,
            )
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
                "median": paired.mse.median(),
                "median_bound": paired.mse_bound.median(),
                "variance_bound": paired.variance.mean(),
                "verdict": ("beaten" if found.beaten else "ok") if judged else None,
            }


@command("paper-rows")
def beside_the_paper(
    bounds: Annotated[File, "CSV of the bounds of all datasets."],
    efficiency: Annotated[File, "CSV of the stage efficiency."],
    out: Annotated[File, "CSV: the paper's errors, ours and the least possible ones."],
) -> None:
    """Set the paper's errors beside the posterior mean of our scenes, reference realisation.

    Ours and the bound are means over the bounded stars; `stderr` is that of the bound. The
    paper's error is `below what this scene allows` if it is below a tight bound as in the stage
    efficiency. A bound that is not tight is above the least possible error: an error below it
    proves nothing.
    """
    from psfdae_paper.evaluation.paper import paper_rows, published

    column = ["dataset", "noise_level"]
    paper = published("psf").query("metric == 'mse'").replace({"method": paper_rows()})
    ours = read_table(efficiency).query("bound == 'bayes' and reference == 'realisation'")
    limits = read_table(bounds).query(
        "method == 'bayes' and reference == 'realisation' and metric == 'mse'"
    )
    table = paper[[*column, "method", "value"]].rename(columns={"value": "mse_paper"})
    table = table.merge(ours[[*column, "method", "mse"]], on=[*column, "method"])
    table = table.merge(
        limits[[*column, "value", "stderr", "tight"]].rename(columns={"value": "mse_bound"}),
        on=column,
    )
    found = [
        Comparison(row.mse_paper, row.mse_bound, row.mse_paper - row.mse_bound, row.stderr)
        for row in table.itertuples()
    ]
    table["paper_over_bound"] = [1 / each.efficiency for each in found]
    table["verdict"] = list(map(_paper_verdict, found, table.tight == "yes"))
    write_csv(out, table[PAPER_COLUMNS])


def _paper_verdict(paper: Comparison, tight: bool) -> str:
    if paper.difference >= 0:
        return "above"
    if not tight:
        return "bound not tight"
    return "below what this scene allows" if paper.beaten else "at the bound"
