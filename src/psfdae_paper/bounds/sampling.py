"""The posterior mean where a bank is too thin: importance sampling star by star.

What is unknown of a star are its field f, the pixels o from the chief ray to the middle of
its stamp, and the Seidel coefficients c. For one (f, o) the image is smooth in c, so a
mode of the posterior is sought by Gauss–Newton steps from the bank's best matches, and
coefficients are drawn around all modes found, from a mixture of Student's t. The mixture
is adapted to its own draws (`psfdae_paper.bounds.mixture`), and the
draws of all rounds are weighed by prior × likelihood over the density of all rounds
together (Cornuet et al. 2012, Scandinavian Journal of Statistics 39, 798). Draws whose
brightest pixel the simulator would not frame at o have no weight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import product
from typing import NamedTuple, get_args

import numpy as np

from psfdae.optics.derivatives import (
    PointSampling,
    SampledStamps,
    normalise_with_derivatives,
)
from psfdae.optics.propagation import Precision, StampPropagator, in_batches
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.wavefronts import (
    MONOMIALS,
    SEIDEL_TERMS,
    monomial_coefficients,
    monomial_images,
)
from psfdae.sensing.climbing import Peaks, Steps, group_maximum, poisson_information
from psfdae.sensing.climbing import climb as climbed
from psfdae.telescope.settings import Telescope
from psfdae_paper.bounds.mixture import Mixture
from psfdae_paper.bounds.posterior import (
    Bank,
    Likelihood,
    PosteriorSums,
    companions,
    jitters,
    scored,
)
from psfdae_paper.configuration.schema import Framing, Optics
from psfdae_paper.stars.framing import normalise_flux
from psfdae_paper.stars.symmetry import SYMMETRIES

TERMS = len(SEIDEL_TERMS)

PUPIL_SAMPLES = (126, 158, 190, 222, 254, 318, 398, 478, 574, 690, 830, 1000)
"""Pupil samples of draws; the sampling guard decides, as it does for stars.

Stamps differ from those of N = 222 by an MSE of 4e-11 on average and 7e-10 at most.
"""

FARTHEST_Z = 6.0
"""Standardised coefficients beyond ± this have no weight, as they have none in the prior (2e-9);
the tails of the proposals reach beyond what can be sampled."""


class TwinSearch(NamedTuple):
    """Modes that look like those found, in other fields and at other offsets."""

    sources: int = 3
    """Best modes of a star whose twins are sought."""
    offsets: int = 1
    """Offsets that are tried in a field around every source."""
    most: int = 40
    """Twins that are tried in all."""


class Search(NamedTuple):
    """How many modes are sought: few, and more for stars that they do not explain."""

    fields: int = 4
    """Fields with the best matches, in which modes are sought."""
    offsets: int = 3
    """The same in the star's own field, if it is given."""
    poor_fit: float = 3.0
    """Standard deviations of χ² by which a star's best mode must fit worse than the truth would,
    for more modes to be sought. Chance alone makes a few in a thousand, with 2 one in forty."""
    more: int = 16
    """Fields or offsets for those stars."""
    hops: int = 2
    """Rounds in which those that are still not explained are sought all around their best modes."""
    corner: float = 0.5
    """Half the side of the cube, in standardised coefficients, at whose corners a hop begins."""
    stars_at_once: int = 256
    """Whose matches are in memory together."""
    missed: float = 4.0
    """Like `poor_fit`, for a star to count as not explained in the end."""


class Proposals(NamedTuple):
    """Draws around modes."""

    rounds: tuple[float, ...] = (0.2, 0.3, 0.5)
    """Parts of the draws before the mixture is adapted once, twice, and after."""
    own_share: float = 0.25
    """Least part of the draws in the star's own field: all that counts where the field is given."""


TWINS, SEARCH, PROPOSALS = TwinSearch(), Search(), Proposals()

THOROUGH = Search(fields=16, offsets=16, poor_fit=2.0)
"""Search of the error bounds."""

CONJUGATE = np.array([1 - 2 * (name in ("r4", "xx", "xy", "yy")) for name in MONOMIALS])
"""Signs that negate the even part of a wavefront: its image stays the same."""

FARTHEST_EVIDENCE = 50.0
"""Modes whose evidence is this far (in its logarithm) below a star's best are left out.

The evidence is that of a Gaussian, which errs by much along a bent ridge of the posterior: a nearer
limit leaves out modes that the draws then find to hold the mass.
"""

EQUAL_PARTS = 4
"""Equal parts of the draws, whose errors tell whether they are enough."""

CLIMB = Steps(max_drop=FARTHEST_EVIDENCE)

CLIMB_PX = 1.5
"""Standard deviation in pixels of where a stamp may lie while matches are recentred."""

STARS_AT_ONCE = 60
"""Stars whose draws are propagated together, to bound the memory."""


@dataclass(frozen=True)
class StampModel:
    """Stamps as functions of standardised coefficients z, c = mean + sd z, with z ~ N(0, 1).

    Attributes
    ----------
    mean, sd : ndarray, shape (5,)
        Prior of the coefficients in waves (`psfdae_paper.stars.fields.perturb`).
    field : ndarray, shape (F, 2)
        Relative field vectors.
    telescope, optics, framing : config groups
    """

    mean: np.ndarray
    sd: np.ndarray
    field: np.ndarray
    telescope: Telescope
    optics: Optics
    framing: Framing

    def standardised(self, seidel: np.ndarray) -> np.ndarray:
        """z of coefficients in waves, both (n, 5); 0 where they cannot vary."""
        varies = self.sd > 0
        return np.where(varies, (seidel - self.mean) / np.where(varies, self.sd, 1.0), 0.0)

    def coefficients(self, z: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Monomial coefficients in waves, shape (n, 8), of z (n, 5) at fields (n,)."""
        return monomial_coefficients(self.mean + self.sd * z, self.field[field])

    def stamps(self, z: np.ndarray, field: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Stamps of sum 1 around pixels `offset` (n, 2) from the chief ray, (n, d, d), float32."""
        side, pixel = self.framing.stamp_px, self.telescope.pixel
        coefficients = self.coefficients(z, field).astype(np.float32)
        out = np.empty((len(z), side, side), np.float32)

        def prepare(samples: int) -> Callable[[np.ndarray], None]:
            pupil = annular_pupil(samples, self.telescope.obscuration)
            images = monomial_images(pupil.axis[None, :], pupil.axis[:, None])
            modes = images.reshape(len(images), -1).astype(np.float32)
            kernel = StampPropagator(pupil, side, pixel, precision="complex64")

            def propagate(draw: np.ndarray) -> None:
                opd = (coefficients[draw] @ modes).reshape(-1, *images.shape[1:])
                out[draw] = normalise_flux(kernel(opd, offset[draw]))[0]

            return propagate

        samples = self._operators["complex64"].samples(coefficients, offset)
        in_batches(samples, self.optics.batch, 1, prepare)
        return out

    def directions(self, field: np.ndarray) -> np.ndarray:
        """Return the change of the monomials' coefficients by z at fields (n,), shape (n, 5, 8)."""
        return monomial_coefficients(np.diag(self.sd), self.field[field][:, None])

    def derivatives(
        self,
        coefficients: np.ndarray,
        directions: np.ndarray,
        offset: np.ndarray,
        samples: np.ndarray | None = None,
        precision: Precision = "complex64",
    ) -> tuple[np.ndarray, np.ndarray]:
        """Stamps in float64, (n, P), and derivatives (n, K, P) along `directions`, (n, K, 8).

        `samples` (n,) are pupil samples; by default as many as the stamps need.
        """
        stamps, slopes, _ = normalise_with_derivatives(
            *self._operators[precision].derivatives(coefficients, directions, offset, samples)
        )
        count = len(offset)
        return (
            stamps.reshape(count, -1).astype(np.float64),
            slopes.reshape(*directions.shape[:2], -1).astype(np.float64),
        )

    def information(
        self, stamps: np.ndarray, derivatives: np.ndarray, likelihood: Likelihood
    ) -> np.ndarray:
        """Expected Fisher information of the parameters of `derivatives`, shape (n, K, K)."""
        light = likelihood.flux * derivatives
        mean = likelihood.flux * stamps + likelihood.background
        return (light / mean[:, None]) @ light.swapaxes(1, 2)

    @cached_property
    def _operators(self) -> dict[Precision, SampledStamps]:
        return {
            precision: SampledStamps(
                self.telescope.obscuration,
                monomial_images,
                PointSampling,
                self.framing.stamp_px,
                self.telescope.pixel,
                precision,
                sorted({*PUPIL_SAMPLES, *self.optics.pupil_samples}),
                batch=TERMS * self.optics.batch,
            )
            for precision in get_args(Precision)
        }


NOTHING, FIELD, TRUTH = range(3)
"""Knowledge of the search for modes; a later one includes those before."""


@dataclass(frozen=True)
class Modes:
    """Places (f, o, z) of stars' posteriors, M in all, and what is known there.

    Attributes
    ----------
    star, field : ndarray of int, shape (M,)
    offset : ndarray of int, shape (M, 2)
        Middle of the stamp (row, column) from the chief ray, in pixels.
    given : ndarray of int, shape (M,)
        What had to be given for the mode to be found: NOTHING, FIELD or TRUTH.
    z : ndarray, shape (M, 5)
        Standardised coefficients.
    factor : ndarray, shape (M, 5, 5)
        Lower Cholesky factor of their scale matrix.
    evidence : ndarray, shape (M,)
        Logarithm of the mode's mass.
    """

    star: np.ndarray
    field: np.ndarray
    offset: np.ndarray
    given: np.ndarray
    z: np.ndarray
    factor: np.ndarray
    evidence: np.ndarray

    @classmethod
    def at(
        cls,
        star: np.ndarray,
        field: np.ndarray,
        offset: np.ndarray,
        given: np.ndarray,
        z: np.ndarray,
    ) -> Modes:
        """Places from which modes are sought: nothing is known there yet."""
        known = (np.tile(np.eye(TERMS), (len(z), 1, 1)), np.zeros(len(z)))
        return cls(star, field, offset, given, z, *known)

    def take(self, modes: np.ndarray) -> Modes:
        """Some of the modes, in the order given."""
        return Modes(*(values[modes] for values in vars(self).values()))

    def __add__(self, other: Modes) -> Modes:
        """These modes, then others."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Modes(*(np.concatenate(pair) for pair in pairs))

    @property
    def group(self) -> np.ndarray:
        """The same number for modes of a star that were found with as much given, (M,)."""
        number: np.ndarray = (TRUTH + 1) * self.star + self.given
        return number

    @property
    def mixture(self) -> Mixture:
        """Student's t around the modes."""
        return Mixture(self.z, self.factor, self.evidence)

    def log_density(self, z: np.ndarray, field: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Log-density of Student's t around every mode, shape (M, n), of draws (n, 5)."""
        mixture = self.mixture
        density: np.ndarray = mixture.log_density(mixture.squared_distance(z)) + self._elsewhere(
            field, offset
        )
        return density

    def _elsewhere(self, field: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """−∞ for draws of another field or offset, otherwise 0, shape (M, n)."""
        same = self.field[:, None] == field
        same &= (self.offset[:, None] == offset).all(axis=2)
        return np.where(same, 0.0, -np.inf)

    def adapted(self, draws: Draws, log_weight: np.ndarray) -> Modes:
        """Places, scales and masses of the modes by what all draws of the star weigh."""
        elsewhere = self._elsewhere(draws.field, draws.offset)
        found = self.mixture.adapted(draws.z, log_weight, elsewhere)
        return replace(self, z=found.mean, factor=found.factor, evidence=found.evidence)

    def draws(self, count: int, own: int, rng: np.random.Generator) -> tuple[Draws, np.ndarray]:
        """About `count` draws around one star's modes and their number from each mode, (M,)."""
        share = np.exp(self.evidence - self.evidence.max())
        share = 0.9 * share / share.sum() + 0.1 / share.size
        own_field = self.field == own
        # Where the field is given, these alone count.
        missing = PROPOSALS.own_share - share[own_field].sum()
        if missing > 0 and own_field.any():
            inside = np.exp(self.evidence[own_field] - self.evidence[own_field].max()) + 0.1
            share *= 1.0 - missing
            share[own_field] += missing * inside / inside.sum()
        number = np.ceil(share * count).astype(int)
        mode = np.repeat(np.arange(share.size), number)
        return Draws(self.field[mode], self.offset[mode], self.mixture.draw(mode, rng)), number


def sample(
    bank: Bank,
    seidel: np.ndarray,
    noisy: np.ndarray,
    truth: Modes,
    likelihood: Likelihood,
    model: StampModel,
    draws: int,
    rngs: Sequence[np.random.Generator],
) -> Sampled:
    """Matches, modes, their twins, and `draws` samples a star around them.

    Stars that no mode explains get more starts: all offsets around their best modes and matches.

    Parameters
    ----------
    bank : Bank
    seidel : ndarray, shape (M, 5)
        Coefficients of the bank's stars in waves.
    truth : Modes
        Where each of the stars was simulated.
    noisy, likelihood, model, rngs : as for `sampled_sums`
    draws : int
    """
    found, _ = search(bank, seidel, noisy, likelihood, model, truth.field, effort=THOROUGH)
    counts = likelihood.counts(noisy)
    modes = _separate(found + climb(truth, counts, likelihood, model))
    rounds = [round(share * draws) for share in PROPOSALS.rounds]
    return sampled_sums(modes, noisy, truth.field, likelihood, model, rounds, rngs)


def search(
    bank: Bank,
    seidel: np.ndarray,
    noisy: np.ndarray,
    likelihood: Likelihood,
    model: StampModel,
    own: np.ndarray | None = None,
    anywhere: bool = True,
    effort: Search | None = None,
) -> tuple[Modes, np.ndarray]:
    """Modes of stars of which nothing is known, or their fields.

    Climbs begin at the bank's best matches, as they are and recentred. Stars that no mode explains
    get more of them, and then starts all around their best modes.

    Parameters
    ----------
    bank : Bank
    seidel : ndarray, shape (M, 5)
        Coefficients of the bank's stars in waves.
    noisy : ndarray, shape (n, d, d)
    likelihood : Likelihood
    model : StampModel
    own : ndarray of int, shape (n,), optional
        Fields of the stars, in which modes are sought, too.
    anywhere : bool
        Whether modes are sought in all fields.
    effort : Search, optional
        By default `SEARCH`.

    Returns
    -------
    modes : Modes
        At least one for every star.
    missed : ndarray of int
        Stars that none of them explains (`unexplained`).
    """
    effort = effort or SEARCH
    problem = (likelihood.counts(noisy), likelihood, model)

    def matched(stars: np.ndarray, fields: int, offsets: int) -> Modes:
        given = None if own is None else own[stars]
        groups = companions(stars.size, None if anywhere else given, bank)
        found = []
        for group, drawn in groups:
            some = stars[group]
            sample = (bank.take(drawn), seidel[drawn], noisy[some], likelihood, model)
            theirs = None if given is None else given[group]
            best = best_matches(*sample, fields if anywhere else 0, offsets, theirs)
            found.append(replace(best, star=some[best.star]))
        return reduce(Modes.__add__, found)

    matches = matched(np.arange(len(noisy)), effort.fields, effort.offsets)
    modes = climb(matches + recentred(matches, *problem), *problem)
    missed = unexplained(modes, *problem, effort.poor_fit)
    if missed.size:
        matches = matched(missed, effort.more, effort.more)
        modes = climb(modes + matches + recentred(matches, *problem), *problem)
        missed = unexplained(modes, *problem, effort.poor_fit)
    for _ in range(effort.hops):
        if not missed.size:
            break
        modes = climb(modes + recentred(corners(modes, missed), *problem), *problem)
        missed = unexplained(modes, *problem, effort.poor_fit)
    if anywhere:
        modes = climb(modes + twins(modes, likelihood, model), *problem)
    return modes, unexplained(modes, *problem, effort.missed)


@dataclass(frozen=True)
class Draws:
    """Draws of one star: field (n,), offset (n, 2) and standardised coefficients (n, 5)."""

    field: np.ndarray
    offset: np.ndarray
    z: np.ndarray


def best_matches(
    bank: Bank,
    seidel: np.ndarray,
    noisy: np.ndarray,
    likelihood: Likelihood,
    model: StampModel,
    fields: int,
    offsets: int,
    own: np.ndarray | None,
) -> Modes:
    """The best star of the bank in each of the best `fields` of every image.

    With the field given, the best at each of so many `offsets` in the stars' `own` fields, (n,),
    are added. Mirrored stars keep their coefficients. `evidence` is the log-likelihood up to a
    constant.

    Parameters
    ----------
    bank : Bank
    seidel : ndarray, shape (M, 5)
        Coefficients of the bank's stars in waves.
    noisy : ndarray, shape (n, d, d)
    likelihood : Likelihood
    model : StampModel
    """
    shifts = np.array(jitters(bank.jitter_px))
    shape = (len(noisy), bank.points**2, len(SYMMETRIES) * len(shifts))
    best, which = np.full(shape, -np.inf), np.zeros(shape, int)
    for part in scored(bank, noisy, likelihood):
        start = np.flatnonzero(np.diff(part.field, prepend=-1))
        for at, end in zip(start, [*start[1:], part.field.size], strict=True):
            place = (slice(None), part.field[at], part.symmetry * len(shifts) + part.jitter)
            top = part.scores[:, at:end].argmax(axis=1) + at
            value = part.scores[np.arange(len(noisy)), top]
            better = value > best[place]
            best[place] = np.where(better, value, best[place])
            which[place] = np.where(better, part.star[top], which[place])
    peaks = np.stack([s.pixel(bank.peak) for s in SYMMETRIES], axis=1)
    middle = (peaks[:, :, None] - shifts).reshape(len(bank), -1, 2)
    rows = []
    for star, scores in enumerate(best):
        top = np.argsort(-scores.max(axis=1), kind="stable")[:fields]
        rows += [(star, field, scores[field].argmax(), NOTHING) for field in top]
        if own is None:
            continue
        mine = own[star]
        seen: set[tuple[int, ...]] = set()
        for column in np.argsort(-scores[mine], kind="stable"):
            offset = tuple(middle[which[star, mine, column], column])
            if np.isfinite(scores[mine, column]) and offset not in seen and len(seen) < offsets:
                seen.add(offset)
                rows.append((star, mine, column, FIELD))
    star, field, place, given = np.array(rows).T
    chosen = which[star, field, place]
    starts = Modes.at(star, field, middle[chosen, place], given, model.standardised(seidel[chosen]))
    return replace(starts, evidence=best[star, field, place])


def log_posterior(
    stamps: np.ndarray, z: np.ndarray, counts: np.ndarray, likelihood: Likelihood
) -> np.ndarray:
    """Σ n ln(1 + F p/B) − F Σp − |z|²/2 of stamps and counts (n, P), without constants."""
    ratio = np.log1p(stamps * (likelihood.flux / likelihood.background), dtype=np.float64)
    light = likelihood.flux * stamps.sum(axis=-1, dtype=np.float64)
    height: np.ndarray = (ratio * counts).sum(axis=-1) - light - 0.5 * (z**2).sum(axis=-1)
    return height


def climb(modes: Modes, counts: np.ndarray, likelihood: Likelihood, model: StampModel) -> Modes:
    """Follow matches to the modes of the posterior by damped Gauss–Newton steps.

    A match is given up when even twice the gain that the next step promises leaves it far
    below the best one; of those that meet, one is kept.

    Parameters
    ----------
    modes : Modes
        Where to start.
    counts : ndarray, shape (n, P)
        Photons in every pixel of every star.
    likelihood : Likelihood
    model : StampModel
    """

    peaks = _climbed(modes, counts, likelihood, model, np.empty((0, len(MONOMIALS))))
    factor = np.linalg.cholesky(np.linalg.inv(peaks.information))
    evidence = peaks.height + np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    return _separate(replace(modes, z=peaks.parameters, factor=factor, evidence=evidence))


def recentred(modes: Modes, counts: np.ndarray, likelihood: Likelihood, model: StampModel) -> Modes:
    """Refine modes with a free stamp offset, rounded to whole pixels.

    In whole pixels, a stamp that is one beside its place leads to another mode, mostly a wrong one.
    Parameters are those of `climb`.
    """
    shift = CLIMB_PX * _tilt(model, np.eye(2))
    peaks = _climbed(modes, counts, likelihood, model, shift)
    moved = np.rint(CLIMB_PX * peaks.parameters[:, TERMS:]).astype(int)
    z = peaks.parameters[:, :TERMS]
    return Modes.at(modes.star, modes.field, modes.offset - moved, modes.given, z)


def _tilt(model: StampModel, shift_px: np.ndarray) -> np.ndarray:
    """Monomials' coefficients (n, 8) that move a stamp by pixels (row, column), (n, 2).

    A pixel is a tilt by half its width in λ/D (`StampPropagator`).
    """
    tilt = np.zeros((len(shift_px), len(MONOMIALS)))
    tilt[:, -2:] = 0.5 * model.telescope.pixel * shift_px[:, ::-1]
    return tilt


def _climbed(
    modes: Modes,
    counts: np.ndarray,
    likelihood: Likelihood,
    model: StampModel,
    more: np.ndarray,
) -> Peaks:
    """Maxima over z and coefficients of further directions `more` (K, 8), normal like z."""

    def evaluate(some: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        field = modes.field[some]
        coefficients = model.coefficients(z[:, :TERMS], field) + z[:, TERMS:] @ more
        directions = np.concatenate(
            [model.directions(field), np.tile(more, (some.size, 1, 1))], axis=1
        )
        stamps, slopes = model.derivatives(coefficients, directions, modes.offset[some])
        mean = likelihood.flux * stamps + likelihood.background
        deviance, score, information = poisson_information(
            counts[modes.star[some]], mean, likelihood.flux * slopes
        )
        height = -0.5 * (deviance + (z**2).sum(axis=1))
        return height, score - z, information + np.eye(z.shape[1])

    start = np.hstack([modes.z, np.zeros((len(modes.z), len(more)))])
    return climbed(evaluate, start, FARTHEST_Z, CLIMB, modes.group)


def unexplained(
    modes: Modes,
    counts: np.ndarray,
    likelihood: Likelihood,
    model: StampModel,
    deviations: float,
) -> np.ndarray:
    """Stars with an image that their best mode does not explain, without or with the field given.

    χ² of the right mode has the mean P and the variance 2P for P pixels; they are those where it
    is larger by so many standard `deviations`.

    Parameters
    ----------
    modes, counts, likelihood, model : as for `climb`, whose results the modes are
    """
    best = modes.take(_first(2 * modes.star + modes.given, modes.evidence, 1))
    stamps = model.stamps(best.z, best.field, best.offset).reshape(len(best.star), -1)
    expected = likelihood.flux * stamps.astype(np.float64) + likelihood.background
    misfit = ((counts[best.star] - expected) ** 2 / expected).sum(axis=1)
    pixels = counts.shape[1]
    return np.unique(best.star[misfit > pixels + deviations * np.sqrt(2.0 * pixels)])


def corners(modes: Modes, stars: np.ndarray) -> Modes:
    """Places all around the best modes of some stars, without and with the field given.

    So for stars whose climbs have ended in local maxima: a climb from beside one mostly ends
    elsewhere.
    """
    best = modes.take(_first(2 * modes.star + modes.given, modes.evidence, 1))
    some = np.flatnonzero(np.isin(best.star, stars))
    signs = np.array(list(product((-1.0, 1.0), repeat=TERMS)))
    source = best.take(np.repeat(some, len(signs)))
    z = source.z + SEARCH.corner * np.tile(signs, (some.size, 1))
    return Modes.at(source.star, source.field, source.offset, source.given, z)


def twins(modes: Modes, likelihood: Likelihood, model: StampModel) -> Modes:
    """Return other fields and offsets of every star that give nearly the same image.

    An image depends on eight coefficients of pupil monomials, of which the offset of the
    stamp changes the tilts; in every field they are another function of the five Seidel
    coefficients. Fields in one direction from the axis can give exactly the same image, and
    so does the wavefront with its even part negated. Around the best modes the likelihood is
    taken as a Gaussian of the eight; its product with the prior of every field and offset is
    a Gaussian, too, whose mass decides which are returned.

    Parameters
    ----------
    modes : Modes
        Results of `climb`; those found without the field are used.
    likelihood : Likelihood
    model : StampModel
    """
    blind = modes.take(np.flatnonzero(modes.given == NOTHING))
    source = blind.take(_first(blind.star, blind.evidence, TWINS.sources))
    middle = model.coefficients(source.z, source.field)
    each = np.tile(np.eye(len(MONOMIALS)), (len(middle), 1, 1))
    stamps, jacobian = model.derivatives(middle, each, source.offset)
    metric = model.information(stamps, jacobian, likelihood)
    width = np.log(np.diagonal(source.factor, axis1=1, axis2=2)).sum(axis=1)
    height = source.evidence - width + 0.5 * (source.z**2).sum(axis=1)
    fields = np.arange(len(model.field))
    static = model.coefficients(np.zeros((fields.size, TERMS)), fields)
    directions = model.directions(fields)
    shifts = np.array(jitters(1))
    tilt = _tilt(model, shifts)
    places: dict[tuple[int, ...], tuple[float, np.ndarray]] = {}
    for m, star in enumerate(source.star):
        for sign in (np.ones(len(MONOMIALS)), CONJUGATE):
            gap = sign * middle[m] + tilt - static[:, None]
            value, z = _projected(sign[:, None] * metric[m] * sign, directions, gap)
            value += height[m]
            for f, k in zip(*np.nonzero(value > value.max() - FARTHEST_EVIDENCE), strict=True):
                key = (star, f, *(source.offset[m] + shifts[k]))
                if key not in places or value[f, k] > places[key][0]:
                    places[key] = (value[f, k], z[f, k])
    keys = np.array(list(places))
    value, z = (np.array(column) for column in zip(*places.values(), strict=True))
    # A few offsets of every field, then the best of them: no field crowds out another.
    fields_of = keys[:, 0] * len(model.field) + keys[:, 1]
    kept = _first(fields_of, value, TWINS.offsets)
    kept = kept[_first(keys[kept, 0], value[kept], TWINS.most)]
    keys = keys[kept]
    given = np.full(len(keys), NOTHING)
    return Modes.at(keys[:, 0], keys[:, 1], keys[:, 2:], given, z[kept])


def _first(group: np.ndarray, value: np.ndarray, count: int) -> np.ndarray:
    """The `count` members of every group that have the largest values."""
    order = np.lexsort((-value, group))
    _, first, number = np.unique(group[order], return_index=True, return_counts=True)
    return order[np.arange(order.size) - np.repeat(first, number) < count]


def _projected(
    metric: np.ndarray, directions: np.ndarray, gap: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Best z (F, V, 5) and log-mass (F, V) of exp(−½ rᵀ M r − ½|z|²), r = gap − z·directions.

    `metric` M is (8, 8), `directions` (F, 5, 8), `gap` (F, V, 8).
    """
    weighted = directions @ metric
    curvature = weighted @ directions.swapaxes(1, 2) + np.eye(TERMS)
    z = np.linalg.solve(curvature, weighted @ gap.swapaxes(1, 2)).swapaxes(1, 2)
    rest = gap - z @ directions
    loss = ((rest @ metric) * rest).sum(axis=2) + (z**2).sum(axis=2)
    return -0.5 * (loss + np.linalg.slogdet(curvature)[1][:, None]), z


def _separate(modes: Modes) -> Modes:
    """Modes with any mass, each once."""
    best = group_maximum(modes.evidence, modes.group)
    near = np.flatnonzero(modes.evidence > best - FARTHEST_EVIDENCE)
    kept: dict[tuple[int, ...], list[int]] = {}
    given = modes.given.copy()
    for m in near[np.argsort(-modes.evidence[near], kind="stable")]:
        others = kept.setdefault((modes.star[m], modes.field[m], *modes.offset[m]), [])
        for k in others:
            apart = np.linalg.solve(modes.factor[k], modes.z[m] - modes.z[k])
            if apart @ apart < 1.0:
                given[k] = min(given[k], given[m])
                break
        else:
            others.append(int(m))
    return replace(modes, given=given).take(np.sort(np.concatenate(list(kept.values()))))


@dataclass(frozen=True)
class Sampled:
    """Posterior sums over importance samples around modes.

    Attributes
    ----------
    free, in_field : list of PosteriorSums
        In `EQUAL_PARTS` equal parts: over the fields that were found, and over the own one for who
        is given the field.
    free_helped, in_field_helped : PosteriorSums
        The same in one part with all modes found with more given, those climbed from the truth
        among them. The truth is one draw from the posterior, so what the search does not detect
        of the posterior shows in the difference.
    """

    free: list[PosteriorSums]
    in_field: list[PosteriorSums]
    free_helped: PosteriorSums
    in_field_helped: PosteriorSums


def sampled_sums(
    modes: Modes,
    noisy: np.ndarray,
    own: np.ndarray,
    likelihood: Likelihood,
    model: StampModel,
    rounds: Sequence[int],
    rngs: Sequence[np.random.Generator],
) -> Sampled:
    """Draw around modes, weigh the samples and adapt the mixture, for several rounds.

    Stars with a mode that only the truth leads to are sampled again with it.

    Parameters
    ----------
    modes : Modes
        At least one for every star, and one in its own field.
    noisy : ndarray, shape (n, d, d)
        Noisy images of one noise level.
    own : ndarray of int, shape (n,)
        Field of every image.
    likelihood : Likelihood
    model : StampModel
    rounds : sequence of int
        Samples a star in every round; every mode has one at least.
    rngs : sequence of n Generators
    """
    counts = likelihood.counts(noisy)

    def sampled(stars: np.ndarray, modes: Modes) -> list[_Sampler]:
        samplers = [
            _Sampler(modes.take(np.flatnonzero(modes.star == s)), int(own[s]), counts[s], rngs[s])
            for s in stars
        ]
        for count in rounds if samplers else ():
            _draw(samplers, count, likelihood, model)
        return samplers

    found = modes.take(np.flatnonzero(modes.given != TRUTH))
    undetected = np.unique(modes.star[modes.given == TRUTH])
    kinds: list[tuple[PosteriorSums, ...]] = []
    for stars in np.array_split(np.arange(len(noisy)), -(-len(noisy) // STARS_AT_ONCE)):
        samplers = sampled(stars, found)
        lost = stars[np.isin(stars, undetected)]
        again = dict(zip(lost, sampled(lost, modes), strict=True))
        for star, sampler in zip(stars, samplers, strict=True):
            kinds.append((*sampler.parts(model), *again.get(star, sampler).whole(model)))
    *halves, free, in_field = (PosteriorSums.stack(kind) for kind in zip(*kinds, strict=True))
    return Sampled(halves[:EQUAL_PARTS], halves[EQUAL_PARTS:], free, in_field)


def _draw(samplers: list[_Sampler], count: int, likelihood: Likelihood, model: StampModel) -> None:
    """One round of several stars, their draws propagated together."""
    fresh = [sampler.propose(count) for sampler in samplers]
    together = (
        np.concatenate([getattr(d, key) for d in fresh]) for key in ("z", "field", "offset")
    )
    z, *places = together
    stamps = model.stamps(np.clip(z, -FARTHEST_Z, FARTHEST_Z), *places)
    stamps = stamps.reshape(len(stamps), -1)
    ends = np.cumsum([draws.field.size for draws in fresh])[:-1]
    for sampler, draws, images in zip(samplers, fresh, np.split(stamps, ends), strict=True):
        sampler.weigh(draws, images, likelihood, model.framing)


class _Sampler:
    """Draws of one star, while the mixture is adapted."""

    def __init__(
        self, modes: Modes, own: int, counts: np.ndarray, rng: np.random.Generator
    ) -> None:
        self.modes, self.own, self.counts, self.rng = modes, own, counts, rng
        self.found_own = bool(((modes.given == NOTHING) & (modes.field == own)).any())
        self.mixtures: list[tuple[Modes, np.ndarray]] = []
        self.draws = Draws(np.empty(0, int), np.empty((0, 2), int), np.empty((0, TERMS)))
        self.images = np.empty((0, counts.size), np.float32)
        self.height, self.jitter = np.empty(0), np.empty(0, int)

    def propose(self, count: int) -> Draws:
        if self.mixtures:
            self.modes = self.modes.adapted(self.draws, self.log_weight())
        draws, number = self.modes.draws(count, self.own, self.rng)
        self.mixtures.append((self.modes, number))
        return draws

    def weigh(
        self, draws: Draws, images: np.ndarray, likelihood: Likelihood, framing: Framing
    ) -> None:
        least = (1.0 - framing.tie) * images.max(axis=1, keepdims=True)
        pixel = np.stack(np.divmod((images >= least).argmax(axis=1), framing.stamp_px), axis=1)
        jitter = pixel - framing.stamp_px // 2
        possible = (np.abs(jitter) <= framing.jitter_px).all(axis=1)
        possible &= (np.abs(draws.z) <= FARTHEST_Z).all(axis=1)
        height = log_posterior(images, draws.z, self.counts, likelihood)
        place = (jitter + framing.jitter_px) @ [2 * framing.jitter_px + 1, 1]
        self.draws = Draws(
            *(np.concatenate([getattr(self.draws, k), getattr(draws, k)]) for k in vars(draws))
        )
        self.images = np.concatenate([self.images, images])
        self.height = np.append(self.height, np.where(possible, height, -np.inf))
        self.jitter = np.append(self.jitter, np.where(possible, place, 0))

    def log_weight(self) -> np.ndarray:
        """Prior × likelihood over the density of all rounds' mixtures, shape (n,)."""
        with np.errstate(divide="ignore"):
            parts = [
                np.log(number)[:, None]
                + modes.log_density(self.draws.z, self.draws.field, self.draws.offset)
                for modes, number in self.mixtures
            ]
        weight: np.ndarray = self.height - np.logaddexp.reduce(np.concatenate(parts), axis=0)
        return weight

    def parts(self, model: StampModel) -> list[PosteriorSums]:
        """Sums of every part without the field, then of every part with the field given."""
        own, part = self.draws.field == self.own, np.arange(self.height.size) % EQUAL_PARTS
        blind = ~own | self.found_own
        kinds = [kind & (part == k) for kind in (blind, own) for k in range(EQUAL_PARTS)]
        return self._sums(kinds, model)

    def whole(self, model: StampModel) -> list[PosteriorSums]:
        """Sums over all draws, and over those in the own field."""
        own = self.draws.field == self.own
        return self._sums([np.ones(own.size, bool), own], model)

    def _sums(self, kinds: Sequence[np.ndarray], model: StampModel) -> list[PosteriorSums]:
        log_weight = self.log_weight()
        fields, shifts = len(model.field), (2 * model.framing.jitter_px + 1) ** 2
        return [
            self._over(np.flatnonzero(kind & np.isfinite(log_weight)), log_weight, fields, shifts)
            for kind in kinds
        ]

    def _over(
        self, draws: np.ndarray, log_weight: np.ndarray, fields: int, shifts: int
    ) -> PosteriorSums:
        sums = PosteriorSums.empty(1, self.counts.size, fields, shifts)
        if draws.size:
            sums.peak[:] = log_weight[draws].max()
            weight = np.exp(log_weight[draws] - sums.peak)
            sums.total[:] = weight.sum()
            sums.square[:] = (weight**2).sum()
            images = self.images[draws].astype(np.float64)
            sums.image[:] = weight @ images
            sums.power[:] = weight @ images**2
            np.add.at(sums.share[0], (self.draws.field[draws], self.jitter[draws]), weight)
        return sums
