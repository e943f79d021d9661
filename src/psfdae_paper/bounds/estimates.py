"""Posterior means of test stars: over a bank, over importance samples, and the better of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from psfdae.files import Column, Product
from psfdae.metrics import mse
from psfdae.model.star_sets import noisy_test_images, split_stars
from psfdae.rng import stream
from psfdae.settings import ConfigError
from psfdae.telescope.aberrations import Seidel
from psfdae_paper.bounds.posterior import (
    MIRROR_MARGIN,
    Bank,
    Likelihood,
    PosteriorSums,
    companions,
    jittered_templates,
    nested_means,
    posterior_sums,
    segments,
)
from psfdae_paper.bounds.sampling import TRUTH, Modes, Sampled, StampModel, sample
from psfdae_paper.bounds.tight import Evidence
from psfdae_paper.configuration.schema import Config
from psfdae_paper.stars.fields import assign_fields, relative_field
from psfdae_paper.stars.framing import Propagation
from psfdae_paper.stars.scenes import aberration_columns, star_wavefronts, template_wavefronts

SPLIT = "random"
"""The split that is bounded: its test stars lie in all fields."""

HOPELESS_ESS = 2.0
"""A quarter of the bank with a smaller median effective sample size is not extended."""

ENOUGH_ESS = 50.0
"""Effective sample size below which a star gets importance samples of its own.

The error of a mean over so many is 2 % above that of the exact mean.
"""


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
        truth = {name: images[stars] for name, images in self.truth.items()}
        noisy = {level: images[stars] for level, images in self.noisy.items()}
        return BoundedStars(self.star[stars], self.field[stars], truth, noisy)


def bounded_stars(config: Config, product: Product) -> BoundedStars:
    """The first test stars of a product "stars", with the noise of their datasets."""
    test = split_stars(product, SPLIT, config).test
    kept = test[: config.bounds.test_stars]
    return BoundedStars(
        star=kept,
        field=product["field_index"][kept],
        truth={name: product[name][kept] for name in ("realisation", "template")},
        noisy={lvl: noisy_test_images(config, product, kept, lvl) for lvl in config.noise.levels},
    )


@dataclass(frozen=True)
class Estimates:
    """`measures_of`, shape (5, n), of one posterior mean.

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
        """Return estimates of `measures_of` by number of draws, each twice that before."""
        nested = list(sizes.values())
        quarter = nested[-3] if len(nested) > 2 else np.full_like(nested[-1], np.nan)
        return cls(nested[-1], quarter, nested[-1])

    @classmethod
    def oversampled(
        cls,
        parts: list[PosteriorSums],
        helped: PosteriorSums,
        static: np.ndarray,
        stars: BoundedStars,
    ) -> Estimates:
        """Return estimates of importance samples in four parts, and with the truth's modes."""
        measure = partial(measures_of, static=static, stars=stars)
        quarter, _, full = nested_means(parts, measure).values()
        return cls(full, quarter, measure(helped))

    @property
    def ess(self) -> np.ndarray:
        """Effective sample size of every star."""
        size: np.ndarray = self.full[-1]
        return size

    def improved(self, few: np.ndarray, other: Estimates | None) -> tuple[Estimates, int]:
        """Take another estimate of the stars `few` where it has more samples; and for how many."""
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


FINE_SAMPLES = (158, 190)
"""Pupil samples that a bank may use besides `optics.pupil_samples`.

The sampling guard decides as it does for stars. Such stamps of scene 1 differ from
those of N = 222 by an MSE of 4e-11 at most, below any noise of the datasets, and
take half the time.
"""


def fresh_stars(config: Config, suffix: str, count: int, threads: int = 1) -> dict[str, Column]:
    """Columns of stars that no product "stars" has, framed so that they can be mirrored.

    Parameters
    ----------
    config : config with the groups of `consistency.SIMULATION`
    suffix : str
        Other ones give other stars.
    count, threads : int
    """
    # Another name gives other random streams: no training or test star is among them.
    named = {"name": f"{config.stars.name}_{suffix}", "count": count}
    stars = config.stars.model_copy(update=named)
    drawn = config.model_copy(update={"stars": stars})
    rng = stream(drawn.seed, "field", stars.name)
    star_field = assign_fields(count, drawn.grid.points**2, rng)
    source = star_wavefronts(drawn, star_field)
    grid_sizes = sorted({*FINE_SAMPLES, *drawn.optics.pupil_samples})
    optics = drawn.optics.model_copy(update={"pupil_samples": grid_sizes, "threads": threads})
    framing = drawn.framing
    propagation = Propagation(source, drawn.telescope, optics, framing, stars.search_px)
    framed, peak = propagation.framed(framing.stamp_px + 2 * (framing.jitter_px + MIRROR_MARGIN))
    return {
        "framed": Column(
            framed.astype(np.float32), "1", "pixel flux as a fraction of the light, with margin"
        ),
        "field_index": Column(star_field, "1", "field of the star"),
        "peak": Column(peak, "pixel", "brightest pixel (row, column) from the chief ray"),
        **aberration_columns(source),
        "pupil_samples": Column(propagation.samples, "1", "pupil samples N"),
    }


def static_psfs(config: Config) -> np.ndarray:
    """Static PSFs of all fields at all centring errors, shape (F, J, d, d), as in "templates"."""
    framing = config.framing
    propagation = Propagation(
        template_wavefronts(config), config.telescope, config.optics, framing, framing.search_px
    )
    framed, _ = propagation.framed(framing.stamp_px + 2 * framing.jitter_px)
    return jittered_templates(framed.astype(np.float32), framing.jitter_px)


def stamp_model(config: Config) -> StampModel:
    """Stamps of a dataset's stars as functions of their coefficients.

    Raises
    ------
    ConfigError
        If their aberrations are no Seidel terms.
    """
    if not isinstance(config.wavefront, Seidel):
        raise ConfigError(f"wavefront.kind = {config.wavefront.kind}: must be seidel")
    mean = config.wavefront.coefficients
    spread = config.stars.aberration_fraction * np.abs(mean)
    field = relative_field(config.grid)
    return StampModel(mean, spread, field, config.telescope, config.optics, config.framing)


def sampled(
    config: Config,
    bank: Bank,
    seidel: np.ndarray,
    product: Product,
    stars: BoundedStars,
    level: float,
    likelihood: Likelihood,
) -> Sampled:
    """Importance samples around the best matches of every star, from a stream of its own."""
    model = stamp_model(config)
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


def weighed(
    bank: Bank, given: bool, static: np.ndarray, stars: BoundedStars, level: float, like: Likelihood
) -> dict[int, np.ndarray]:
    """`measures_of` of the posterior mean over a bank, with the field given or not, by its size.

    Every part of the bank has as many draws of every group, and those that are counted are
    the draws in all fields. A bank in which far too few stars are similar at its noise level is
    left after a quarter.
    """
    groups = companions(stars.field.size, stars.field if given else None, bank)
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
        measure = partial(measures_of, static=static, stars=few)
        for size, values in nested_means(part, measure).items():
            total = means.setdefault(size, np.empty((len(values), stars.field.size)))
            total[:, group] = values
    return {round(len(bank) / pieces * size): values for size, values in means.items()}


def measures_of(sums: PosteriorSums, static: np.ndarray, stars: BoundedStars) -> np.ndarray:
    """MSE against realisation and template, variances of both, effective sample size, (5, n)."""
    shape = stars.truth["realisation"].shape
    template, spread = sums.template(static)
    means = {"realisation": sums.mean_image, "template": template}
    errors = [mse(means[name].reshape(shape), truth) for name, truth in stars.truth.items()]
    spreads = [sums.variance.mean(axis=1), spread.mean(axis=1)]
    return np.stack([*errors, *spreads, sums.effective_size])
