"""Tables of the bounds: rows of every bound, of their growth, and of methods beside them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Set
from typing import TYPE_CHECKING

import numpy as np

from psfdae.files import Product, ProductError
from psfdae.methods import method as method_named
from psfdae.metrics import clustered_mean, mse
from psfdae.model.star_sets import noise_model
from psfdae.optics.wavefronts import monomial_coefficients
from psfdae_paper.bounds.estimates import (
    ENOUGH_ESS,
    SPLIT,
    BoundedStars,
    Estimates,
    sampled,
    stamp_model,
    weighed,
)
from psfdae_paper.bounds.floor import (
    FLOOR_TOLERANCE,
    TOLERANCE,
    Comparison,
    compare,
    local_error,
)
from psfdae_paper.bounds.posterior import (
    Bank,
    Likelihood,
    exact_posterior,
    extrapolate,
    last_change,
)
from psfdae_paper.bounds.tight import FEW, calibration
from psfdae_paper.configuration.schema import Config

if TYPE_CHECKING:
    import pandas as pd

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

GROWTH_COLUMNS = ["dataset", "reference", "method", "noise_level", "draws", "mse", "ess_mean"]
GROWTH_COLUMNS += ["ess_median", "last_change", "limit", "exponent", "fit_rms"]

NEGLIGIBLE_MSE = 1e-9
"""Errors below this are written as 0 where only a few images are possible.

They stem from a handful of doubtful stars or from rounding.
"""

NORMAL_95 = 1.959964
"""Half width of a 95 % confidence interval in standard errors."""


class Tables:
    """Rows of a dataset's tables while they grow."""

    def __init__(self, dataset: str, stars: BoundedStars) -> None:
        self.dataset = dataset
        self.stars = stars
        self.summary: list[dict[str, object]] = []
        self.per_star: list[pd.DataFrame] = []
        self.growth: list[dict[str, object]] = []

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

        key: dict[str, object] = {"dataset": self.dataset, "split": SPLIT, "reference": reference}
        key |= {"method": method, "noise_level": level}
        known = np.isfinite(values["mse"])
        field = self.stars.field[known]
        common: dict[str, object] = {"n": field.size, "missing": int((~known).sum()), **reached}
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


def add_floor(config: Config, product: Product, tables: Tables) -> None:
    """The local lower limit of the error of every star, from the slopes of its stamp."""
    stars, model = tables.stars, stamp_model(config)
    field = model.field[stars.field]
    stamps, derivatives = model.derivatives(
        monomial_coefficients(product["seidel"][stars.star], field),
        monomial_coefficients(np.eye(len(model.sd)), field[:, None]),
        product["peak"][stars.star] - product["jitter"][stars.star],
        product["pupil_samples"][stars.star],
        "complex128",
    )
    for level in config.noise.levels:
        variance = noise_model(config).variance(stamps, level)
        error = local_error(derivatives, model.sd, variance)
        tables.add("realisation", "floor", level, {"mse": error}, tight=False, found="derivatives")


def add_means(
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
            sizes = weighed(larger if given else bank, given, static, stars, level, likelihood)
            _grown(tables, method, level, sizes)
            over_banks[method] = max(sizes), Estimates.over_bank(sizes)
            sparse |= over_banks[method][1].ess < ENOUGH_ESS
        few, over_samples = np.flatnonzero(sparse), {}
        if few.size:
            some = stars.take(few)
            found = sampled(config, bank, drawn["seidel"], product, some, level, likelihood)
            sums = ((found.free, found.free_helped), (found.in_field, found.in_field_helped))
            for method, (parts, helped) in zip(POSTERIOR_MEANS, sums, strict=True):
                over_samples[method] = Estimates.oversampled(parts, helped, static, some)
        for method, (draws, over_bank) in over_banks.items():
            best, chosen = over_bank.improved(few, over_samples.get(method))
            source = {0: "bank", stars.star.size: "samples"}.get(chosen, "both")
            count = config.bounds.star_draws if source == "samples" else draws
            tables.add_mean(method, level, best, source, draws=count, sampled=chosen)
        seconds = time.monotonic() - start
        print(f"λ = {level:g}: {few.size} stars sampled, {seconds:.1f} s", flush=True)


def _grown(tables: Tables, method: str, level: float, sizes: dict[int, np.ndarray]) -> None:
    """Rows of `growth`: `measures_of` of one posterior mean over a bank by number of draws."""
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


def add_exact(config: Config, static: np.ndarray, tables: Tables) -> None:
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


def compared(
    key: Mapping[str, object],
    methods: pd.DataFrame,
    bounded: pd.DataFrame,
    tight: Set[tuple[str, str, str, str]],
) -> Iterator[dict[str, object]]:
    """Rows of one dataset, reference and λ: every method beside every bound it has to respect.

    `tight` has dataset, reference, bound and λ, in six digits, of those that are tight.
    """
    place = f"{key['dataset']}, {key['reference']}, λ = {key['noise_level']:g}"
    for bound in bounded["method"].unique():
        limits = bounded[bounded["method"] == bound]
        sharp = (key["dataset"], key["reference"], bound, f"{key['noise_level']:.6g}") in tight
        for method in methods["method"].unique():
            errors = methods[methods["method"] == method]
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
                paired["mse"].to_numpy(),
                paired["mse_bound"].to_numpy(),
                paired["field"].to_numpy(),
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


def paper_verdict(paper: Comparison, tight: bool) -> str:
    """Return the verdict of a bound, tight or not, on the paper's error, in words."""
    if paper.difference >= 0:
        return "above"
    if not tight:
        return "bound not tight"
    return "below what this scene allows" if paper.beaten else "at the bound"
