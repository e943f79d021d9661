"""Tables of the bounds: rows of every bound, of their growth, and of methods next to them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Set

import numpy as np
import pandas as pd

from psfdae.base.files import Product, ProductError
from psfdae.methods import method as method_named
from psfdae.methods.metrics import cluster_mean, mse
from psfdae.optics.wavefronts import monomial_coefficients
from psfdae.training.star_sets import noise_model
from psfdae_paper.bounds.estimates import (
    ENOUGH_ESS,
    SPLIT,
    BoundedStars,
    Estimates,
    build_stamp_model,
    sample_stars,
    weigh_bank,
)
from psfdae_paper.bounds.floor import Comparison, compute_local_error
from psfdae_paper.bounds.posterior import Bank, Likelihood, compute_exact_posterior, extrapolate
from psfdae_paper.bounds.tight import Evidence, calibration
from psfdae_paper.configuration.schema import Config

POSTERIOR_MEANS = {"bayes": False, "bayes_position": True}
"""Bounds that are posterior means; True if the star's field is known."""


class Tables:
    """Rows of a dataset's tables while they grow.

    Parameters
    ----------
    dataset : str
        Name in the tables.
    stars : BoundedStars
        Test stars whose errors the rows describe.

    Attributes
    ----------
    summary, growth : list of dict
        Rows with `summary_columns`, and with `growth_columns`.
    per_star : list of DataFrame
        Values of every star, a table for each row of the bounds.
    """

    summary_columns = (
        *("dataset", "split", "reference", "method", "noise_level", "metric", "value"),
        *("stderr", "n", "ci_low", "ci_high", "median", "variance", "calibration"),
        *("missing", "missing_stars", "tight", "found", "draws", "sampled"),
        *("ess_median", "ess_low", "last_change", "undetected"),
    )
    growth_columns = (
        *("dataset", "reference", "method", "noise_level", "draws", "mse", "stderr"),
        *("n", "ess_mean", "ess_median", "last_change", "limit", "exponent", "fit_rms"),
    )

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
        source: str,
        **columns: float,
    ) -> None:
        """Add rows of one bound at one noise level.

        Parameters
        ----------
        reference, method : str
            Reference of the errors, and name of the bound.
        level : float
            Noise level λ.
        values : dict of ndarray, shape (n,)
            Metrics of every star. Stars without an estimate, whose `mse` is NaN, are named and left
            out of every mean. The table contains the mean of the posterior variances `variance`.
        tight : bool
            True if the bound is near the minimum possible error.
        source : str
            Samples behind the bound, for the column `found`.
        **columns : float
            Further columns.
        """
        # Columns that all metrics share.
        key: dict[str, object] = {"dataset": self.dataset, "split": SPLIT, "reference": reference}
        key |= {"method": method, "noise_level": level}
        has_estimate = np.isfinite(values["mse"])
        field = self.stars.field[has_estimate]
        common = {
            "n": field.size,
            "missing": int((~has_estimate).sum()),
            **columns,
            "missing_stars": " ".join(map(str, self.stars.star[~has_estimate])),
            "tight": "yes" if tight else "no",
            "found": source,
        }
        # A row for each metric: mean, standard error clustered by field, and confidence interval.
        for metric in [name for name in ("mse", "p_right") if name in values]:
            value = values[metric][has_estimate]
            mean, stderr = cluster_mean(value, field) if value.size else (np.nan, np.nan)
            half = 1.959964 * stderr  # standard errors to either side of a 95 % interval
            row = {"metric": metric, "value": mean, "stderr": stderr}
            row |= {"ci_low": mean - half, "ci_high": mean + half}
            if value.size:
                row["median"] = float(np.median(value))
            if metric == "mse" and "variance" in values and value.size:
                row["variance"] = values["variance"][has_estimate].mean()
            self.summary.append({**key, **row, **common})
        # And all values by star.
        stars = {"star": self.stars.star, "field": self.stars.field}
        self.per_star.append(pd.DataFrame({**key, **stars, **values}))

    def add_mean(
        self, method: str, level: float, estimates: Estimates, source: str, **columns: float
    ) -> None:
        """Add rows of a posterior mean over samples for all references, tight by its evidence."""
        # One set of samples serves both references; each has evidence of its own.
        columns["ess_median"] = float(np.median(estimates.ess))
        for number, reference in enumerate(self.stars.truth):
            # Rows with the evidence as further columns.
            values = estimates.values(number)
            evidence = estimates.evidence(number, self.stars.field)
            row = {**columns, **vars(evidence)}
            self.add(reference, method, level, values, evidence.tight, source, **row)

    def add_growth(self, method: str, level: float, measures: dict[int, np.ndarray]) -> None:
        """Add rows of the errors of a posterior mean over a bank by number of draws.

        `measures` is the result of `weigh_bank`.
        """
        # Errors by number of draws, and the power law a + b M^−c that extrapolates them.
        draws, bank = np.array(list(measures)), Estimates.from_bank(measures)
        for number, reference in enumerate(self.stars.truth):
            # Mean error of each bank with its standard error, clustered by field.
            means = [cluster_mean(values[number], self.stars.field) for values in measures.values()]
            errors, stderr = np.array(means).T
            evidence = bank.evidence(number, self.stars.field)
            limit, exponent, residual = extrapolate(draws, errors)
            if not evidence.tight:
                # Far from convergence the fit extrapolates to anything, down to zero.
                limit = float("nan")
            key: dict[str, object] = {"dataset": self.dataset, "reference": reference}
            key |= {"method": method, "noise_level": level, "n": self.stars.field.size}
            fit = {"limit": limit, "exponent": exponent, "fit_rms": residual}
            fit |= {"last_change": evidence.last_change}
            for count, error, sigma, values in zip(
                draws, errors, stderr, measures.values(), strict=True
            ):
                size = {"draws": count, "mse": error, "stderr": sigma}
                ess = {"ess_mean": values[-1].mean(), "ess_median": np.median(values[-1])}
                self.growth.append({**key, **size, **ess, **fit})


def add_floor(config: Config, product: Product, tables: Tables) -> None:
    """Add the local error floor of every star, from the slopes of its stamp."""
    # Relative field vectors of the stars, at which the Seidel terms are evaluated.
    stars, model = tables.stars, build_stamp_model(config)
    field = model.field[stars.field]
    # Derivatives of the noise-free stamps, as simulated, by the Seidel coefficients in waves.
    stamps, derivatives = model.derivatives(
        monomial_coefficients(product["seidel"][stars.star], field),
        monomial_coefficients(np.eye(len(model.sd)), field[:, None]),
        product["peak"][stars.star] - product["jitter"][stars.star],
        product["pupil_samples"][stars.star],
        "complex128",
    )
    # The derivatives are the same at all noise levels.
    for level in config.noise.levels:
        variance = noise_model(config).variance(stamps, level)
        error = compute_local_error(derivatives, model.sd, variance)
        tables.add("realisation", "floor", level, {"mse": error}, tight=False, source="derivatives")


def add_means(
    config: Config,
    bank: Bank,
    large_bank: Bank,
    product: Product,
    static: np.ndarray,
    tables: Tables,
) -> None:
    """Add posterior means over a bank, their change with its size, and improved ones.

    Stars for which the bank has too few similar stars get importance samples around their modes.

    Parameters
    ----------
    config : Config
        Settings of the dataset.
    bank : Bank
        Simulated stars for the posterior mean without knowledge of the field.
    large_bank : Bank
        Simulated stars for the posterior mean with the field known. Only few fields can explain a
        star, so that more simulated stars are needed, and weighting them takes little time.
    product : Product
        Product "stars".
    static : ndarray, shape (F, J, d, d)
        Static PSFs at all centring errors.
    tables : Tables
        Tables of the dataset, to which rows are added.
    """
    stars = tables.stars
    for level in config.noise.levels:
        start = time.monotonic()
        stamps = bank.stamps((bank.margin,) * 2)
        likelihood = Likelihood.from_noise(noise_model(config), level, stamps)
        # Both posterior means over the bank.
        over_bank, is_sparse = {}, np.zeros(stars.star.size, bool)
        for method, field_is_known in POSTERIOR_MEANS.items():
            prior = large_bank if field_is_known else bank
            measures = weigh_bank(prior, field_is_known, static, stars, level, likelihood)
            tables.add_growth(method, level, measures)
            over_bank[method] = max(measures), Estimates.from_bank(measures)
            is_sparse |= over_bank[method][1].ess < ENOUGH_ESS
        # Both over importance samples, for stars of which one is sparse.
        sparse, over_samples = np.flatnonzero(is_sparse), {}
        if sparse.size:
            subset = stars.take(sparse)
            posteriors = sample_stars(config, bank, product, subset, level, likelihood)
            for method, samples in zip(POSTERIOR_MEANS, posteriors, strict=True):
                over_samples[method] = Estimates.from_samples(samples, static, subset)
        # The better one for every star.
        for method, (draws, estimates) in over_bank.items():
            result, replacements = estimates.replace_sparse(sparse, over_samples.get(method))
            source = {0: "bank", stars.star.size: "samples"}.get(replacements, "both")
            count = config.bounds.star_draws if source == "samples" else draws
            tables.add_mean(method, level, result, source, draws=count, sampled=replacements)
        seconds = time.monotonic() - start
        print(f"λ = {level:g}: {sparse.size} stars sampled, {seconds:.1f} s", flush=True)


def add_exact(config: Config, static: np.ndarray, tables: Tables) -> None:
    """Add the exact posterior mean over the templates at all centring errors.

    Parameters
    ----------
    config : Config
        Settings of the dataset.
    static : ndarray, shape (F, J, d, d)
        Static PSFs at all centring errors: all images that stars without aberrations can have.
    tables : Tables
        Tables of the dataset, to which rows are added.
    """
    stars = tables.stars
    for level in config.noise.levels:
        # Counts are relative to the mean static PSF without centring error.
        stamps = static[:, static.shape[1] // 2]
        likelihood = Likelihood.from_noise(noise_model(config), level, stamps)
        for method, field_is_known in POSTERIOR_MEANS.items():
            field = stars.field if field_is_known else None
            posterior = compute_exact_posterior(stars.noisy[level], static, likelihood, field)
            mean, variance, probability = posterior
            error = mse(mean, stars.truth["realisation"])
            # Smaller errors are rounding, or a few doubtful stars: only few images are possible.
            if error.mean() < 1e-9:
                error, variance = np.zeros_like(error), np.zeros_like(error)
            values = {"mse": error, "variance": variance}
            if not field_is_known:
                # Posterior probability of the star's own field.
                values["p_right"] = probability[np.arange(stars.field.size), stars.field]
            score = calibration(error, variance, stars.field)
            tables.add("realisation", method, level, values, True, "sum", calibration=score)


def compare_methods(
    key: Mapping[str, object],
    methods: pd.DataFrame,
    bounds: pd.DataFrame,
    tight: Set[tuple[str, str, str, str]],
) -> Iterator[dict[str, object]]:
    """Compare every method with every bound that applies to it.

    Parameters
    ----------
    key : mapping
        Columns of one dataset, reference and noise level λ.
    methods, bounds : DataFrame
        Errors of methods, and bounds, by star.
    tight : set of tuples
        Dataset, reference, bound and λ, in six digits, of the bounds that are tight.

    Yields
    ------
    dict
        Row of the table of efficiencies.
    """
    cell = f"{key['dataset']}, {key['reference']}, λ = {key['noise_level']:g}"
    for bound in bounds["method"].unique():
        # Values of this bound by star; its summary shows if it is tight.
        limits, is_floor = bounds[bounds["method"] == bound], bound == "floor"
        level = f"{key['noise_level']:.6g}"
        is_tight = (key["dataset"], key["reference"], bound, level) in tight
        for method in methods["method"].unique():
            errors = methods[methods["method"] == method]
            # A posterior mean bounds methods with the same knowledge of the field; the floor
            # bounds all methods and both posterior means.
            if not is_floor and (
                method in POSTERIOR_MEANS
                or POSTERIOR_MEANS[bound] != method_named(method).needs.position
            ):
                continue
            # Errors and bounds of the same stars, which must lie in the same fields.
            pairs = limits.merge(errors, on="star", suffixes=("_bound", ""), validate="1:1")
            if len(pairs) < len(limits):
                missing = len(limits) - len(pairs)
                raise ProductError(f"{cell}: {method} lacks {missing} of the bounded stars")
            mismatches = pairs[pairs["field"] != pairs["field_bound"]]
            if len(mismatches):
                star, field, bound_field = mismatches[["star", "field", "field_bound"]].iloc[0]
                raise ProductError(
                    f"{cell}: star {star} of {method} lies in field {field}, "
                    f"but in field {bound_field} in the bounds"
                )
            # Stars without a posterior mean are left out; with more than 1 % of them there is not
            # enough evidence for a verdict.
            has_both = pairs.mse_bound.notna()
            if method in POSTERIOR_MEANS:
                has_both &= pairs.mse.notna()
            is_judged = (is_floor or is_tight) and (~has_both).mean() <= Evidence.max_sparse
            pairs = pairs[has_both]
            comparison = Comparison.from_pairs(
                pairs["mse"].to_numpy(),
                pairs["mse_bound"].to_numpy(),
                pairs["field"].to_numpy(),
                # The floor is an approximation that the posterior mean itself may undercut by 15 %.
                0.2 if is_floor else Comparison.tolerance,
            )
            yield {
                **key,
                "method": method,
                "bound": bound,
                "tight": "yes" if is_tight else "no",
                "mse": comparison.mse,
                "mse_bound": comparison.bound,
                "efficiency": comparison.efficiency if is_judged else None,
                "difference": comparison.difference,
                "stderr": comparison.stderr,
                "n": len(pairs),
                "median": pairs.mse.median(),
                "median_bound": pairs.mse_bound.median(),
                "variance_bound": pairs.variance.mean(),
                "verdict": ("beaten" if comparison.beaten else "ok") if is_judged else None,
            }


def judge_paper(paper: Comparison, tight: bool) -> str:
    """Return the verdict of a bound, tight or not, on the paper's error, in words."""
    # Only a tight bound can show that an error is smaller than possible.
    if paper.difference >= 0:
        return "above"
    if not tight:
        return "bound not tight"
    return "below what this scene allows" if paper.beaten else "at the bound"
