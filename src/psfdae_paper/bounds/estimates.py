"""Posterior means of test stars: over a bank, over importance samples, and the better of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from psfdae.base.files import Column, Product
from psfdae.base.rng import stream
from psfdae.base.settings import ConfigError
from psfdae.methods.metrics import mse
from psfdae.telescope.aberrations import Seidel
from psfdae.training.star_sets import noisy_test_images, split_stars
from psfdae_paper.bounds.mode_search import climb, search
from psfdae_paper.bounds.modes import Knowledge, Modes, separate
from psfdae_paper.bounds.posterior import (
    Bank,
    Likelihood,
    PosteriorSums,
    average_nested,
    cut_templates,
    group_by_field,
    list_jitters,
    merge,
    sum_posterior,
)
from psfdae_paper.bounds.sampling import SampledPosterior, sample_posterior
from psfdae_paper.bounds.stamp_model import StampModel, StarPosteriors
from psfdae_paper.bounds.tight import Evidence
from psfdae_paper.configuration.schema import Config
from psfdae_paper.stars.fields import assign_fields, relative_field
from psfdae_paper.stars.framing import Propagation
from psfdae_paper.stars.scenes import aberration_columns, star_wavefronts, template_wavefronts

SPLIT = "random"
"""Split whose errors are bounded: its test stars lie in all fields."""

ENOUGH_ESS = 50.0
"""Effective sample size below which a star gets importance samples of its own.

The error of a mean over so many samples is 2 % larger than the error of the exact mean.
"""


@dataclass(frozen=True)
class BoundedStars:
    """Test stars whose errors are bounded.

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
        """Return the stars with these numbers, in the order given."""
        truth = {name: images[stars] for name, images in self.truth.items()}
        noisy = {level: images[stars] for level, images in self.noisy.items()}
        return BoundedStars(self.star[stars], self.field[stars], truth, noisy)


def read_test_stars(config: Config, product: Product) -> BoundedStars:
    """Read the first test stars of a product "stars", with the noise of their datasets.

    Raises
    ------
    ConfigError
        If the noise is not Poisson noise, whose likelihood the bounds have.
    """
    config.noise.require_poisson("bounds hold")
    # Errors of bounds and methods are compared star by star: stars and noise are the same as in the
    # stage `evaluate`.
    star = split_stars(product, SPLIT, config).test[: config.bounds.test_stars]
    return BoundedStars(
        star=star,
        field=product["field_index"][star],
        truth={name: product[name][star] for name in ("realisation", "template")},
        noisy={lvl: noisy_test_images(config, product, star, lvl) for lvl in config.noise.levels},
    )


@dataclass(frozen=True)
class Estimates:
    """Errors and variances of one posterior mean, in the rows of `measure_posteriors`.

    Attributes
    ----------
    full, quarter : ndarray, shape (5, n)
        Measures of the mean over all samples, and of the mean over a quarter of them.
    with_truth : ndarray, shape (5, n)
        Measures of the mean over all samples, including samples around modes that are reached
        only from the truth.
    """

    full: np.ndarray
    quarter: np.ndarray
    with_truth: np.ndarray

    @classmethod
    def from_bank(cls, measures: dict[int, np.ndarray]) -> Estimates:
        """Return the estimates of `weigh_bank`, whose numbers of draws double."""
        # A quarter is two doublings before the last; the truth adds nothing to a bank.
        doublings = list(measures.values())
        quarter = doublings[-3] if len(doublings) > 2 else np.full_like(doublings[-1], np.nan)
        return cls(doublings[-1], quarter, doublings[-1])

    @classmethod
    def from_samples(
        cls, samples: SampledPosterior, static: np.ndarray, stars: BoundedStars
    ) -> Estimates:
        """Return the estimates of importance samples, which are in four parts."""
        measure = partial(measure_posteriors, static=static, stars=stars)
        # Four parts give means over a quarter, a half and all of the samples.
        quarter, _, full = average_nested(samples.parts, measure).values()
        return cls(full, quarter, measure(samples.with_truth))

    @property
    def ess(self) -> np.ndarray:
        """Effective sample size of every star."""
        return np.asarray(self.full[-1])

    def replace_sparse(self, stars: np.ndarray, samples: Estimates | None) -> tuple[Estimates, int]:
        """Replace estimates over a bank by importance samples where these are larger.

        Parameters
        ----------
        stars : ndarray of int
            Numbers of the stars that have importance samples.
        samples : Estimates, optional
            Their estimates.

        Returns
        -------
        estimates : Estimates
            Of each star, the estimate with the larger effective sample size.
        replaced : int
            Number of stars whose estimate was replaced.
        """
        if samples is None:
            return self, 0
        # Only where the bank is too thin, and never by fewer samples than it has.
        is_better = (self.ess[stars] < ENOUGH_ESS) & (samples.ess > self.ess[stars])
        # Columns of better stars are replaced in copies.
        measures = {name: values.copy() for name, values in vars(self).items()}
        for name, values in measures.items():
            values[:, stars[is_better]] = getattr(samples, name)[:, is_better]
        return Estimates(**measures), int(is_better.sum())

    def values(self, number: int) -> dict[str, np.ndarray]:
        """Return error and variance of every star by one reference, and the effective size."""
        return {"mse": self.full[number], "variance": self.full[2 + number], "ess": self.ess}

    def evidence(self, number: int, field: np.ndarray) -> Evidence:
        """Collect the evidence that the mean by one reference is near the exact one."""
        return Evidence.from_errors(
            **self.values(number),
            field=field,
            last_change=abs(_relative_change(self.quarter[number], self.full[number])),
            undetected=-_relative_change(self.with_truth[number], self.full[number]),
        )


def _relative_change(errors: np.ndarray, full: np.ndarray) -> float:
    """Return the relative difference of mean errors, over the stars that have both."""
    # Means over the same stars, for which both estimates exist.
    has_both = np.isfinite(errors) & np.isfinite(full)
    if not has_both.any():
        return float("nan")
    return float(errors[has_both].mean() / full[has_both].mean() - 1.0)


def simulate_fresh_stars(
    config: Config, suffix: str, count: int, threads: int = 1
) -> dict[str, Column]:
    """Simulate stars that are not in any product "stars", framed so that they can be mirrored.

    Parameters
    ----------
    config : Config
        Settings with the groups of `consistency.SIMULATION`.
    suffix : str
        Name of the set of stars; each name gives other stars.
    count : int
        Number of stars.
    threads : int
        Threads of the propagation.

    Returns
    -------
    dict of Column
        Framed images, fields, brightest pixels, aberrations and pupil samples of the stars.
    """
    # Another name gives other random streams: the stars are independent of training and test.
    changes = {"name": f"{config.stars.name}_{suffix}", "count": count}
    config = config.model_copy(update={"stars": config.stars.model_copy(update=changes)})
    rng = stream(config.seed, "field", config.stars.name)
    # Fields of the stars, equally many in each, and their random wavefronts.
    star_field = assign_fields(count, config.grid.points**2, rng)
    source = star_wavefronts(config, star_field)
    # Smaller pupil grids than for training stars where the sampling guard allows them: stamps of
    # scene 1 differ from stamps with N = 222 by an MSE of 4e-11 at most, below any noise of the
    # datasets, and take half the time.
    grid_sizes = sorted({158, 190, *config.optics.pupil_samples})
    optics = config.optics.model_copy(update={"pupil_samples": grid_sizes, "threads": threads})
    framing = config.framing
    propagation = Propagation(source, config.telescope, optics, framing, config.stars.search_px)
    # Framed without centring error, with a margin from which all errors and mirror images are cut.
    margin = framing.jitter_px + Bank.mirror_margin
    frames, peak = propagation.frame(framing.stamp_px + 2 * margin)
    return {
        "framed": Column(
            frames.astype(np.float32), "1", "pixel flux as a fraction of the light, with margin"
        ),
        "field_index": Column(star_field, "1", "field of the star"),
        "peak": Column(peak, "pixel", "brightest pixel (row, column) from the chief ray"),
        **aberration_columns(source),
        "pupil_samples": Column(propagation.samples, "1", "pupil samples N"),
    }


def propagate_static_psfs(config: Config) -> np.ndarray:
    """Propagate static PSFs of all fields at all centring errors, (F, J, d, d), as "templates"."""
    framing = config.framing
    propagation = Propagation(
        template_wavefronts(config), config.telescope, config.optics, framing, framing.search_px
    )
    # Framed with a margin of the largest centring error; then cut at every error.
    frames, _ = propagation.frame(framing.stamp_px + 2 * framing.jitter_px)
    return cut_templates(frames.astype(np.float32), framing.jitter_px)


def build_stamp_model(config: Config) -> StampModel:
    """Build the model of a dataset's stamps as functions of their Seidel coefficients.

    Raises
    ------
    ConfigError
        If the aberrations are not Seidel terms.
    """
    if not isinstance(config.wavefront, Seidel):
        raise ConfigError(f"wavefront.kind = {config.wavefront.kind}: must be seidel")
    # The standard deviation of each coefficient is a fraction of its mean.
    mean = config.wavefront.coefficients
    sd = config.stars.aberration_fraction * np.abs(mean)
    field = relative_field(config.grid)
    return StampModel(mean, sd, field, config.telescope, config.optics, config.framing)


def get_true_modes(model: StampModel, product: Product, stars: BoundedStars) -> Modes:
    """Return the true field, offset and coefficients of the stars of a product."""
    count = stars.star.size
    return Modes.make_starts(
        np.arange(count),
        stars.field,
        # The middle of a stamp is the framed pixel less the centring error.
        product["peak"][stars.star] - product["jitter"][stars.star],
        np.full(count, Knowledge.TRUTH),
        model.standardise(product["seidel"][stars.star]),
    )


def sample_stars(
    config: Config,
    bank: Bank,
    product: Product,
    stars: BoundedStars,
    level: float,
    likelihood: Likelihood,
) -> tuple[SampledPosterior, SampledPosterior]:
    """Draw importance samples around the modes of every star, from a stream of its own.

    The samples are returned for an unknown and for a known field.
    """
    model = build_stamp_model(config).coarsen(likelihood)
    posteriors = StarPosteriors(stars.noisy[level], likelihood, model)
    # Bounds need every mode: more starts than in a method, and more for doubtful stars.
    modes, _ = search(bank, posteriors, stars.field, fields=16, offsets=16, misfit_sigma=1.0)
    true_modes = climb(get_true_modes(posteriors.model, product, stars), posteriors)
    modes = separate(Modes.join([modes, true_modes]))
    # A star's draws do not depend on the other stars: each has a stream by its number.
    names = ("bounds", config.stars.name, f"{level:.6g}")
    rngs = [stream(config.seed, *names, int(star)) for star in stars.star]
    return sample_posterior(modes, posteriors, stars.field, config.bounds.star_draws, rngs)


def weigh_bank(
    bank: Bank,
    field_is_known: bool,
    static: np.ndarray,
    stars: BoundedStars,
    level: float,
    likelihood: Likelihood,
) -> dict[int, np.ndarray]:
    """Measure the posterior means over a bank, and over halves, quarters … of it.

    Parameters
    ----------
    bank : Bank
        M simulated stars, samples of the prior.
    field_is_known : bool
        True for the posterior given the star's field.
    static : ndarray, shape (F, J, d, d)
        Static PSFs at all centring errors.
    stars : BoundedStars
        Test stars with their noisy images.
    level : float
        Noise level λ.
    likelihood : Likelihood
        Likelihood at that level.

    Returns
    -------
    dict of int to ndarray, shape (5, n)
        `measure_posteriors` by number of draws in all fields, ascending. All parts of the bank have
        the same number of draws of every group of fields.
    """
    groups = group_by_field(stars.star.size, stars.field if field_is_known else None, bank)
    # Equal parts of the bank: the largest power of two up to 16 and the size of a group.
    pieces = 1 << (min(16, *(members.size for _, members in groups)).bit_length() - 1)
    quarter = max(1, pieces // 4)
    subsets = [(stars.take(group), np.array_split(members, pieces)) for group, members in groups]

    def weigh(subset: BoundedStars, cuts: list[np.ndarray]) -> list[PosteriorSums]:
        # Sums over each part of the bank; parts are merged to banks of all sizes.
        field = subset.field if field_is_known else None
        return [
            sum_posterior(bank.take(numbers), subset.noisy[level], likelihood, star_field=field)
            for numbers in cuts
        ]

    # A quarter first. Where it has an effective sample size below 2 in the median, the rest of the
    # bank would not be enough either.
    parts = [weigh(subset, cuts[:quarter]) for subset, cuts in subsets]
    sizes = [average_nested(part, lambda sums: sums.effective_size)[quarter] for part in parts]
    if np.median(np.concatenate(sizes)) >= 2.0:
        for part, (subset, cuts) in zip(parts, subsets, strict=True):
            part.extend(weigh(subset, cuts[quarter:]))
    # Each group has the columns of its stars.
    measures: dict[int, np.ndarray] = {}
    for (group, _), (subset, _), part in zip(groups, subsets, parts, strict=True):
        measure = partial(measure_posteriors, static=static, stars=subset)
        for size, values in average_nested(part, measure).items():
            draws = round(len(bank) / pieces * size)
            measures.setdefault(draws, np.empty((len(values), stars.star.size)))[:, group] = values
    return measures


def sum_over_bank(
    bank: Bank, noisy: np.ndarray, likelihood: Likelihood, star_field: np.ndarray | None
) -> PosteriorSums:
    """Sum over an eighth of a bank, and over all of it where this is likely to be enough.

    Parameters
    ----------
    bank : Bank
        Simulated stars, samples of the prior.
    noisy : ndarray, shape (n, d, d)
        Noisy stars.
    likelihood : Likelihood
        Likelihood at their noise level.
    star_field : ndarray of int, shape (n,), or None
        Number of each star's field, if it is known.
    """
    shifts = len(list_jitters(bank.jitter_px))
    sums = PosteriorSums.empty(len(noisy), noisy[0].size, bank.points**2, shifts)

    def weigh(stars: np.ndarray, bank_stars: np.ndarray) -> PosteriorSums:
        field = None if star_field is None else star_field[stars]
        return sum_posterior(bank.take(bank_stars), noisy[stars], likelihood, star_field=field)

    # Stars whose field is known are compared with the bank's stars of this field and of its mirror
    # images.
    for stars, bank_stars in group_by_field(len(noisy), star_field, bank):
        eighth = len(bank_stars) // 8
        first_sums = weigh(stars, bank_stars[:eighth])
        sums.put(stars, first_sums)
        # The effective sample size grows in proportion to the bank: the whole bank is used for
        # stars with too few samples of an eighth of it, and enough of all of it.
        size = first_sums.effective_size
        promising = (size < ENOUGH_ESS) & (8 * size >= ENOUGH_ESS)
        if promising.any():
            further_sums = weigh(stars[promising], bank_stars[eighth:])
            sums.put(stars[promising], merge([first_sums.select(promising), further_sums]))
    return sums


def measure_posteriors(sums: PosteriorSums, static: np.ndarray, stars: BoundedStars) -> np.ndarray:
    """Measure posterior means of stars against the truth.

    Returns
    -------
    ndarray, shape (5, n)
        MSE against realisation and template, posterior variances of both, effective sample size.
    """
    # Posterior means of the noise-free image and of the static PSF.
    shape = stars.truth["realisation"].shape
    template, template_variance = sums.template(static)
    means = {"realisation": sums.mean_image, "template": template}
    errors = [mse(means[name].reshape(shape), truth) for name, truth in stars.truth.items()]
    variances = [sums.variance.mean(axis=1), template_variance.mean(axis=1)]
    return np.stack([*errors, *variances, sums.effective_size])
