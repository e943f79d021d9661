"""Stage `bounds`: how good any estimator of a dataset's test stars can be."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from psfdae.belonging import STARS, STATIC, require
from psfdae.bounds.bank import Bank, jittered_templates
from psfdae.bounds.growth import TIGHT, extrapolate, last_change, nested_means, segments
from psfdae.bounds.posterior import Likelihood, PosteriorSums, exact_posterior, posterior_sums
from psfdae.cli import File, command
from psfdae.configuration.schema import Config
from psfdae.configuration.stages import SIMULATION
from psfdae.evaluation.metrics import clustered_mean, mse
from psfdae.files import Product, ProductError, atomic_path, read_product, write_text
from psfdae.reading import read_table
from psfdae.stages.common import (
    limit_threads,
    noise_model,
    noisy_test_images,
    split_stars,
)

if TYPE_CHECKING:
    import pandas as pd

SPLIT = "random"
"""The split that is bounded: its test stars lie in all fields."""

COLUMNS = ["dataset", "split", "reference", "method", "noise_level", "metric", "value"]
COLUMNS += ["stderr", "n", "ci_low", "ci_high", "tight"]

GROWTH_COLUMNS = ["dataset", "reference", "noise_level", "draws", "mse", "ess_mean", "ess_median"]
GROWTH_COLUMNS += ["last_change", "limit", "exponent", "fit_rms"]

HOPELESS_ESS = 2.0
"""A quarter of the bank with a smaller median effective sample size is not extended."""

NEGLIGIBLE_MSE = 1e-9
"""Errors below this are written as 0 where only a few images are possible.

They stem from a handful of doubtful stars or from rounding.
"""

NORMAL_95 = 1.959964
"""Half width of a 95 % confidence interval in standard errors."""


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

    def write(self, out: Path, growth: Path, per_star: Path) -> None:
        """Write the three tables, each atomically."""
        import pandas as pd

        summary = pd.DataFrame(self.summary, columns=COLUMNS)
        write_text(out, summary.to_csv(index=False, float_format="%.8g"))
        sizes = pd.DataFrame(self.growth, columns=GROWTH_COLUMNS)
        write_text(growth, sizes.to_csv(index=False, float_format="%.8g"))
        with atomic_path(per_star) as temporary:
            pd.concat(self.per_star, ignore_index=True).to_parquet(
                temporary, index=False, write_page_checksum=True
            )


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
        _sampled(config, _read_bank(bank, product), static, tables)
    tables.write(out, growth, per_star)


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
    joined = pd.concat(filled, ignore_index=True)
    write_text(out, joined.to_csv(index=False, float_format="%.8g"))


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


def _read_bank(path: Path, stars: Product) -> Bank:
    """The bank of a star set; refused if it was drawn from another simulator than the stars."""
    product = read_product(path, "bank", ("framed", "field_index", "peak"))
    require(path, product.config, STARS, stars.config, stars.path)
    return Bank(
        product["framed"],
        product["field_index"],
        product["peak"],
        product.config["grid"]["points"],
        product.config["framing"]["jitter_px"],
    )


def _floor(config: Config, product: Product, tables: Tables) -> None:
    from psfdae.bounds.floor import local_error, sensitivities
    from psfdae.stars.fields import relative_field

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


def _sampled(config: Config, bank: Bank, static: np.ndarray, tables: Tables) -> None:
    """The posterior mean over a bank, and how it changes with the bank's size."""
    for level in config.noise.levels:
        start = time.monotonic()
        parts, draws = _bank_sums(config, bank, tables.stars, level)
        sizes = nested_means(parts, lambda sums: _errors(sums, static, tables.stars))
        references = tuple(tables.stars.truth)
        for i, reference in enumerate(references):
            errors = [float(values[i].mean()) for values in sizes.values()]
            change = last_change(errors)
            last = sizes[len(parts)]
            values = {"mse": last[i], "ess": last[-1]}
            tables.add(reference, "bayes", level, values, tight=change <= TIGHT)
            key = {"dataset": tables.dataset, "reference": reference, "noise_level": level}
            tables.growth += _growth_rows(key, sizes, i, draws / len(parts))
        seconds = time.monotonic() - start
        print(f"λ = {level:g}: {draws} draws, {seconds:.1f} s", flush=True)


def _bank_sums(
    config: Config, bank: Bank, stars: BoundedStars, level: float
) -> tuple[list[PosteriorSums], int]:
    """Sums over equal parts of the bank, and the number of draws in them.

    A bank that is hopelessly thin for its noise level is left after a quarter.
    """
    cuts = np.array_split(np.arange(len(bank)), segments(len(bank)))
    likelihood = Likelihood.of(noise_model(config), level, bank.stamps((bank.margin,) * 2))
    noisy = stars.noisy[level]
    quarter = max(1, len(cuts) // 4)
    parts = [posterior_sums(bank.take(cut), noisy, likelihood) for cut in cuts[:quarter]]
    sizes = nested_means(parts, lambda sums: sums.effective_size)
    if np.median(sizes[quarter]) >= HOPELESS_ESS:
        parts += [posterior_sums(bank.take(cut), noisy, likelihood) for cut in cuts[quarter:]]
    return parts, sum(cut.size for cut in cuts[: len(parts)])


def _errors(sums: PosteriorSums, static: np.ndarray, stars: BoundedStars) -> np.ndarray:
    """MSE against realisation and template, and effective sample size, shape (3, n)."""
    shape = stars.truth["realisation"].shape
    means = {"realisation": sums.mean_image, "template": sums.mean_template(static)}
    errors = [mse(means[name].reshape(shape), truth) for name, truth in stars.truth.items()]
    return np.stack([*errors, sums.effective_size])


def _growth_rows(
    key: dict[str, Any], sizes: dict[int, np.ndarray], which: int, draws_per_part: float
) -> list[dict[str, Any]]:
    draws = np.rint(draws_per_part * np.array(list(sizes))).astype(int)
    errors = np.array([values[which].mean() for values in sizes.values()])
    limit, exponent, residual = extrapolate(draws, errors)
    fitted = {"limit": limit, "exponent": exponent, "fit_rms": residual}
    change = last_change(errors)
    return [
        {
            **key,
            "draws": count,
            "mse": error,
            "ess_mean": values[-1].mean(),
            "ess_median": np.median(values[-1]),
            "last_change": change,
            **fitted,
        }
        for count, error, values in zip(draws, errors, sizes.values(), strict=True)
    ]


def _exact(config: Config, static: np.ndarray, tables: Tables) -> None:
    """The exact posterior over the templates at all centring errors."""
    stars = tables.stars
    for level in config.noise.levels:
        likelihood = Likelihood.of(noise_model(config), level, static[:, static.shape[1] // 2])
        mean, probability = exact_posterior(stars.noisy[level], static, likelihood)
        error = mse(mean, stars.truth["realisation"])
        if error.mean() < NEGLIGIBLE_MSE:
            error = np.zeros_like(error)
        right = probability[np.arange(stars.field.size), stars.field]
        values = {"mse": error, "p_right": right}
        tables.add("realisation", "bayes", level, values, tight=True)
