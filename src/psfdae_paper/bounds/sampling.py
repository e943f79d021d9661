"""Importance sampling of a star's posterior, where the bank has too few stars that resemble it.

The unknowns of a star are its field f, the offset o in pixels from the chief ray to the middle of
its stamp, and the Seidel coefficients c. For one (f, o) the image is smooth in c, so a
mode of the posterior is sought by Gauss–Newton steps from the bank's best matches, and
coefficients are drawn around all modes, from a mixture of Student's t. The mixture
is adapted to its own draws (`psfdae_paper.bounds.mixture`), and the
draws of all rounds are weighed by prior × likelihood over the density of all rounds
together (Cornuet et al. 2012, Scandinavian Journal of Statistics 39, 798). Draws whose
brightest pixel the simulator would not frame at o have no weight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property, reduce
from itertools import product
from typing import NamedTuple, get_args

import numpy as np

from psfdae.optics.derivatives import PointSampling, SampledStamps, normalise_with_derivatives
from psfdae.optics.propagation import Precision, StampPropagator, in_batches
from psfdae.optics.pupil import annular_pupil
from psfdae.optics.wavefronts import MONOMIALS, SEIDEL_TERMS, monomial_coefficients, monomial_images
from psfdae.sensing.climbing import Peaks, Steps, group_maximum, poisson_information
from psfdae.sensing.climbing import climb as climb_posterior
from psfdae.telescope.settings import Telescope
from psfdae_paper.bounds.mixture import Mixture
from psfdae_paper.bounds.posterior import (
    Bank,
    Likelihood,
    PosteriorSums,
    groups_by_field,
    jitters,
    score_bank,
)
from psfdae_paper.configuration.schema import Framing, Optics
from psfdae_paper.stars.framing import normalise_flux
from psfdae_paper.stars.symmetry import SYMMETRIES

TERMS = len(SEIDEL_TERMS)

MAX_ABS_Z = 6.0
"""Largest standardised coefficient that has any weight.

The prior beyond it is 2e-9. The tails of the proposals reach beyond what can be propagated.
"""

MAX_EVIDENCE_DROP = 50.0
"""Modes whose log-evidence is this far below a star's best are left out.

The evidence is that of a Gaussian, which errs by much along a bent ridge of the posterior: a nearer
limit leaves out modes that the draws then find to hold the mass.
"""

EQUAL_PARTS = 4
"""Equal parts of the draws, whose errors tell whether they are enough."""

STARS_AT_ONCE = 60
"""Stars whose draws are propagated together, to bound the memory."""


class Knowledge(IntEnum):
    """Knowledge about a star that a search for modes uses; each includes those before."""

    NONE = 0
    FIELD = 1
    TRUTH = 2


class Search(NamedTuple):
    """Number of modes that are sought, and when more of them are."""

    fields: int = 4
    """Fields with the best matches, in which modes are sought."""
    offsets: int = 3
    """Offsets with the best matches in the star's own field, if it is known."""
    misfit_sigma: float = 3.0
    """Standard deviations of χ² by which a star's best mode must fit worse than the truth would,
    for more modes to be sought. Chance alone makes a few in a thousand, with 2 one in forty."""


SEARCH = Search()


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
        """Return z of coefficients in waves, both (n, 5); 0 where they cannot vary."""
        # z = (c − mean) / sd
        varies = self.sd > 0
        return np.where(varies, (seidel - self.mean) / np.where(varies, self.sd, 1.0), 0.0)

    def coefficients(self, z: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Return monomial coefficients in waves, shape (n, 8), of z (n, 5) at fields (n,)."""
        return monomial_coefficients(self.mean + self.sd * z, self.field[field])

    def directions(self, field: np.ndarray) -> np.ndarray:
        """Return the change of the monomials' coefficients by z at fields (n,), shape (n, 5, 8)."""
        return monomial_coefficients(np.diag(self.sd), self.field[field][:, None])

    def stamps(self, z: np.ndarray, field: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Propagate stamps of sum 1 in single precision.

        Parameters
        ----------
        z : ndarray, shape (n, 5)
            Standardised coefficients.
        field : ndarray of int, shape (n,)
        offset : ndarray, shape (n, 2)
            Middle of the stamp (row, column) from the chief ray, in pixels.

        Returns
        -------
        ndarray, shape (n, d, d), float32
        """
        side, pixel = self.framing.stamp_px, self.telescope.pixel
        coefficients = self.coefficients(z, field).astype(np.float32)
        stamps = np.empty((len(z), side, side), np.float32)

        def prepare(samples: int) -> Callable[[np.ndarray], None]:
            # The OPD is a sum of monomials over the pupil, Σ c_j M_j.
            pupil = annular_pupil(samples, self.telescope.obscuration)
            images = monomial_images(pupil.axis[None, :], pupil.axis[:, None])
            modes = images.reshape(len(images), -1).astype(np.float32)
            kernel = StampPropagator(pupil, side, pixel, precision="complex64")

            def propagate(draw: np.ndarray) -> None:
                opd = (coefficients[draw] @ modes).reshape(-1, *images.shape[1:])
                # Light beyond the stamp is lost: the sum is made 1 again, as for all stamps.
                stamps[draw] = normalise_flux(kernel(opd, offset[draw]))[0]

            return propagate

        # Draws that need the same pupil grid are propagated together.
        samples = self._operators["complex64"].samples(coefficients, offset)
        in_batches(samples, self.optics.batch, 1, prepare)
        return stamps

    def derivatives(
        self,
        coefficients: np.ndarray,
        directions: np.ndarray,
        offset: np.ndarray,
        samples: np.ndarray | None = None,
        precision: Precision = "complex64",
    ) -> tuple[np.ndarray, np.ndarray]:
        """Propagate stamps of sum 1 and their derivatives, both in float64.

        Parameters
        ----------
        coefficients : ndarray, shape (n, 8)
            Coefficients of the monomials in waves.
        directions : ndarray, shape (n, K, 8)
            Change of the coefficients by each of K parameters.
        offset : ndarray, shape (n, 2)
            Middle of the stamp (row, column) from the chief ray, in pixels.
        samples : ndarray of int, shape (n,), optional
            Pupil samples; by default as many as the stamps need.
        precision : str
            Precision of the propagation.

        Returns
        -------
        stamps : ndarray, shape (n, P)
        derivatives : ndarray, shape (n, K, P)
        """
        # The sum of a stamp depends on the parameters, too: normalising changes the derivatives.
        raw = self._operators[precision].derivatives(coefficients, directions, offset, samples)
        stamps, slopes, _ = normalise_with_derivatives(*raw)
        return (
            stamps.reshape(len(offset), -1).astype(np.float64),
            slopes.reshape(*directions.shape[:2], -1).astype(np.float64),
        )

    @cached_property
    def _operators(self) -> dict[Precision, SampledStamps]:
        """Propagators by precision, on the smallest pupil grid that the sampling guard allows."""
        # Stamps differ from those of N = 222 by an MSE of 4e-11 on average and 7e-10 at most.
        pupil_samples = {126, 158, 190, 222, 254, 318, 398, 478, 574, 690, 830, 1000}
        return {
            precision: SampledStamps(
                self.telescope.obscuration,
                monomial_images,
                PointSampling,
                self.framing.stamp_px,
                self.telescope.pixel,
                precision,
                sorted(pupil_samples | {*self.optics.pupil_samples}),
                batch=TERMS * self.optics.batch,
            )
            for precision in get_args(Precision)
        }


@dataclass(frozen=True)
class StarPosteriors:
    """Posteriors of the aberrations of n stars, given their photons.

    Attributes
    ----------
    counts : ndarray, shape (n, P)
        Photons in every pixel, sky included.
    likelihood : Likelihood
        Likelihood at the stars' noise level.
    model : StampModel
        Prior of the aberrations, and the stamps that they give.
    """

    counts: np.ndarray
    likelihood: Likelihood
    model: StampModel


@dataclass(frozen=True)
class Modes:
    """Modes of stars' posteriors, M in all, or places (f, o, z) from which they are sought.

    Attributes
    ----------
    star, field : ndarray of int, shape (M,)
    offset : ndarray of int, shape (M, 2)
        Middle of the stamp (row, column) from the chief ray, in pixels.
    knowledge : ndarray of int, shape (M,)
        `Knowledge` without which the search would not have found the mode.
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
    knowledge: np.ndarray
    z: np.ndarray
    factor: np.ndarray
    evidence: np.ndarray

    @classmethod
    def at(
        cls,
        star: np.ndarray,
        field: np.ndarray,
        offset: np.ndarray,
        knowledge: np.ndarray,
        z: np.ndarray,
    ) -> Modes:
        """Make places from which modes are sought, with unit scales and no evidence yet."""
        scales = np.tile(np.eye(TERMS), (len(z), 1, 1))
        return cls(star, field, offset, knowledge, z, scales, np.zeros(len(z)))

    def take(self, modes: np.ndarray) -> Modes:
        """Return the modes with these numbers, in the order given."""
        return Modes(*(values[modes] for values in vars(self).values()))

    def __add__(self, added: Modes) -> Modes:
        """Return these modes, then the added ones."""
        # All attributes are arrays with a row for every mode.
        pairs = zip(vars(self).values(), vars(added).values(), strict=True)
        return Modes(*(np.concatenate(pair) for pair in pairs))

    @property
    def group(self) -> np.ndarray:
        """Group number of each mode by star and knowledge, (M,)."""
        return np.asarray(len(Knowledge) * self.star + self.knowledge)

    @property
    def best_of_group(self) -> Modes:
        """Best mode of every star, without and with its field known."""
        return self.take(largest_of_groups(self.group, self.evidence, 1))

    @property
    def mixture(self) -> Mixture:
        """Student's t around the modes."""
        return Mixture(self.z, self.factor, self.evidence)

    def log_density(self, z: np.ndarray, field: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return the log-density of Student's t around every mode at draws (n, 5), (M, n)."""
        mixture = self.mixture
        density = mixture.log_density(mixture.squared_distance(z))
        return np.asarray(density + self._log_support(field, offset))

    def _log_support(self, field: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return 0 for draws in a mode's own field and offset, otherwise −∞, shape (M, n)."""
        is_own = self.field[:, None] == field
        is_own &= (self.offset[:, None] == offset).all(axis=2)
        return np.where(is_own, 0.0, -np.inf)

    def adapted(self, draws: Draws, log_weight: np.ndarray) -> Modes:
        """Adapt places, scales and masses to the weights (n,) of all draws of the star."""
        log_support = self._log_support(draws.field, draws.offset)
        mixture = self.mixture.adapted(draws.z, log_weight, log_support)
        return replace(self, z=mixture.mean, factor=mixture.factor, evidence=mixture.evidence)

    def draw(
        self, count: int, star_field: int, rng: np.random.Generator
    ) -> tuple[Place, np.ndarray]:
        """Draw about `count` places around one star's modes.

        Parameters
        ----------
        count : int
            Number of draws, but for rounding up in every mode.
        star_field : int
            The star's true field.
        rng : Generator

        Returns
        -------
        place : Place
        number : ndarray of int, shape (M,)
            Number of draws from each mode.
        """
        # In proportion to the modes' masses, but a tenth in equal shares: masses are estimates.
        share = np.exp(self.evidence - self.evidence.max())
        share = 0.9 * share / share.sum() + 0.1 / share.size
        # A quarter at least in the star's own field: where the field is known, these alone count.
        in_field = self.field == star_field
        shortage = 0.25 - share[in_field].sum()
        # The shares of all modes shrink, and what that frees goes to the modes in the field.
        if shortage > 0 and in_field.any():
            mass = np.exp(self.evidence[in_field] - self.evidence[in_field].max()) + 0.1
            share *= 1.0 - shortage
            share[in_field] += shortage * mass / mass.sum()
        # Rounded up, so that every mode has a draw, whose weight may show that its mass is larger.
        number = np.ceil(share * count).astype(int)
        mode = np.repeat(np.arange(share.size), number)
        return Place(self.field[mode], self.offset[mode], self.mixture.draw(mode, rng)), number


def largest_of_groups(group: np.ndarray, value: np.ndarray, count: int) -> np.ndarray:
    """Return the numbers of the `count` members of every group that have the largest values."""
    # Sorted by group, the largest first; then the rank of each member within its group.
    order = np.lexsort((-value, group))
    _, first, number = np.unique(group[order], return_index=True, return_counts=True)
    return order[np.arange(order.size) - np.repeat(first, number) < count]


def search(
    bank: Bank,
    noisy: np.ndarray,
    likelihood: Likelihood,
    model: StampModel,
    star_field: np.ndarray | None = None,
    in_all_fields: bool = True,
    effort: Search | None = None,
) -> tuple[Modes, np.ndarray]:
    """Search the modes of stars, without knowledge of them or with their fields known.

    Climbs begin at the bank's best matches, as they are and recentred. Stars that no mode explains
    get more of them, and then starts all around their best modes.

    Parameters
    ----------
    bank : Bank
    noisy : ndarray, shape (n, d, d)
    likelihood : Likelihood
    model : StampModel
    star_field : ndarray of int, shape (n,), optional
        Fields of the stars, in which modes are sought, too.
    in_all_fields : bool
        True if modes are sought in all fields.
    effort : Search, optional
        By default `SEARCH`.

    Returns
    -------
    modes : Modes
        At least one for every star.
    missed : ndarray of int
        Stars that none of the modes explains (`unexplained`).
    """
    effort = effort or SEARCH
    posteriors = StarPosteriors(likelihood.counts(noisy), likelihood, model)

    def match(stars: np.ndarray, fields: int, offsets: int) -> Modes:
        """Return the best matches of the stars with these numbers."""
        fields_of_stars = None if star_field is None else star_field[stars]
        group_fields = None if in_all_fields else fields_of_stars
        matches = []
        for group, members in groups_by_field(stars.size, group_fields, bank):
            in_group = best_matches(
                bank.take(members),
                noisy[stars[group]],
                likelihood,
                model,
                fields if in_all_fields else 0,
                offsets,
                None if fields_of_stars is None else fields_of_stars[group],
            )
            matches.append(replace(in_group, star=stars[group][in_group.star]))
        return reduce(Modes.__add__, matches)

    # First from a few matches of every star.
    matches = match(np.arange(len(noisy)), effort.fields, effort.offsets)
    modes = climb(matches + recentre(matches, posteriors), posteriors)
    missed = unexplained(modes, posteriors, effort.misfit_sigma)
    # Then from 16 fields or offsets of those that the modes do not explain.
    if missed.size:
        matches = match(missed, 16, 16)
        modes = climb(modes + matches + recentre(matches, posteriors), posteriors)
        missed = unexplained(modes, posteriors, effort.misfit_sigma)
    # Then all around the best modes of those that are still not explained; two rounds.
    for _ in range(2):
        if missed.size:
            starts = recentre(corners(modes, missed), posteriors)
            modes = climb(modes + starts, posteriors)
            missed = unexplained(modes, posteriors, effort.misfit_sigma)
    # Last in other fields and at other offsets that give nearly the same image as the best modes.
    if in_all_fields:
        modes = climb(modes + find_twins(modes, likelihood, model), posteriors)
    # χ² four standard deviations above its mean: the star has no mode that explains it.
    return modes, unexplained(modes, posteriors, 4.0)


def best_matches(
    bank: Bank,
    noisy: np.ndarray,
    likelihood: Likelihood,
    model: StampModel,
    fields: int,
    offsets: int,
    star_field: np.ndarray | None,
) -> Modes:
    """Find the best star of the bank in each of the best `fields` of every image.

    If the stars' fields are known, the best at each of so many `offsets` in its own field
    is added for every star. Mirrored stars keep their coefficients.

    Parameters
    ----------
    bank : Bank
    noisy : ndarray, shape (n, d, d)
    likelihood : Likelihood
    model : StampModel
    fields, offsets : int
    star_field : ndarray of int, shape (n,), optional
    """
    # Best score, and star of the bank that has it, by image, field and frame (symmetry, jitter).
    shifts = np.array(jitters(bank.jitter_px))
    shape = (len(noisy), bank.points**2, len(SYMMETRIES) * len(shifts))
    best_score, best_star = np.full(shape, -np.inf), np.zeros(shape, int)
    for part in score_bank(bank, noisy, likelihood):
        # Stars of the same field are adjacent: the best one of each run, for every image.
        start = np.flatnonzero(np.diff(part.field, prepend=-1))
        for first, end in zip(start, [*start[1:], part.field.size], strict=True):
            cell = (slice(None), part.field[first], part.symmetry * len(shifts) + part.jitter)
            top = part.scores[:, first:end].argmax(axis=1) + first
            score = part.scores[np.arange(len(noisy)), top]
            best_star[cell] = np.where(score > best_score[cell], part.star[top], best_star[cell])
            best_score[cell] = np.maximum(score, best_score[cell])
    # The middle of the stamp is the framed pixel less the jitter, after each symmetry.
    peaks = np.stack([s.pixel(bank.peak) for s in SYMMETRIES], axis=1)
    middle = (peaks[:, :, None] - shifts).reshape(len(bank), -1, 2)
    rows = []
    for star, scores in enumerate(best_score):
        # Without knowledge of the field, the best frame in each of the best fields.
        best_fields = np.argsort(-scores.max(axis=1), kind="stable")[:fields]
        rows += [(star, field, scores[field].argmax(), Knowledge.NONE) for field in best_fields]
        if star_field is None:
            continue
        # In the star's own field, the best frame at each offset.
        field = star_field[star]
        used: set[tuple[int, ...]] = set()
        for frame in np.argsort(-scores[field], kind="stable"):
            offset = tuple(middle[best_star[star, field, frame], frame])
            if np.isfinite(scores[field, frame]) and offset not in used and len(used) < offsets:
                used.add(offset)
                rows.append((star, field, frame, Knowledge.FIELD))
    star, field, frame, knowledge = np.array(rows).T
    match = best_star[star, field, frame]
    z = model.standardised(bank.seidel[match])
    return Modes.at(star, field, middle[match, frame], knowledge, z)


def climb(modes: Modes, posteriors: StarPosteriors) -> Modes:
    """Follow matches to the modes of the posterior by damped Gauss–Newton steps.

    A match is given up when even twice the gain that the next step promises leaves it far
    below the best one; of those that meet, one is kept. The evidence of a mode is the mass of the
    Gaussian with its height and curvature, up to a constant: ln height + ½ ln det(covariance).

    Parameters
    ----------
    modes : Modes
        Starts of the climbs.
    posteriors : StarPosteriors
    """
    # At the mode, the covariance of z is the inverse of information + 1 (that of the prior). With
    # its Cholesky factor L, ½ ln det(covariance) = Σ ln L_kk.
    peaks = _climb_along(modes, posteriors, np.empty((0, len(MONOMIALS))))
    factor = np.linalg.cholesky(np.linalg.inv(peaks.information))
    evidence = peaks.height + np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
    return separate(replace(modes, z=peaks.parameters, factor=factor, evidence=evidence))


def recentre(modes: Modes, posteriors: StarPosteriors) -> Modes:
    """Refine modes with a free stamp offset, rounded to whole pixels.

    A stamp that is a pixel beside its place leads to another mode, mostly a wrong one, from which
    steps of whole pixels do not lead back.
    """
    # Prior of the shift along rows and columns: normal, with this standard deviation.
    shift_sd_px = 1.5
    tilts = shift_sd_px * tilt_coefficients(posteriors.model, np.eye(2))
    # A tilt that moves the image by +u replaces an offset of the stamp by −u.
    parameters = _climb_along(modes, posteriors, tilts).parameters
    shift_px = np.rint(shift_sd_px * parameters[:, TERMS:]).astype(int)
    offset = modes.offset - shift_px
    return Modes.at(modes.star, modes.field, offset, modes.knowledge, parameters[:, :TERMS])


def tilt_coefficients(model: StampModel, shift_px: np.ndarray) -> np.ndarray:
    """Return the monomials' coefficients (n, 8) that move a stamp by pixels (row, column), (n, 2).

    A pixel is a tilt by half its width in λ/D (`StampPropagator`).
    """
    tilt = np.zeros((len(shift_px), len(MONOMIALS)))
    # The last two monomials are x and y; columns run along x and rows along y.
    tilt[:, -2:] = 0.5 * model.telescope.pixel * shift_px[:, ::-1]
    return tilt


def _climb_along(modes: Modes, posteriors: StarPosteriors, added_directions: np.ndarray) -> Peaks:
    """Climb to maxima over z and along more directions of the coefficients.

    Parameters
    ----------
    modes : Modes
        Starts of the climbs.
    posteriors : StarPosteriors
    added_directions : ndarray, shape (K, 8)
        Directions of the monomials' coefficients, with a standard normal prior, as z has.
    """
    likelihood, model = posteriors.likelihood, posteriors.model

    def evaluate(rows: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        # Stamps and their slopes by z and along the added directions.
        field = modes.field[rows]
        coefficients = model.coefficients(z[:, :TERMS], field) + z[:, TERMS:] @ added_directions
        directions = np.concatenate(
            [model.directions(field), np.tile(added_directions, (rows.size, 1, 1))], axis=1
        )
        stamps, slopes = model.derivatives(coefficients, directions, modes.offset[rows])
        # Poisson likelihood times the prior N(0, 1): their logarithms and derivatives add up.
        # ln posterior = −½ (deviance + |z|²), slope = score − z, information + 1.
        counts, expected = posteriors.counts[modes.star[rows]], likelihood.expected(stamps)
        deviance, score, information = poisson_information(
            counts, expected, likelihood.flux * slopes
        )
        height = -0.5 * (deviance + (z**2).sum(axis=1))
        return height, score - z, information + np.eye(z.shape[1])

    start = np.hstack([modes.z, np.zeros((len(modes.z), len(added_directions)))])
    steps = Steps(max_drop=MAX_EVIDENCE_DROP)
    return climb_posterior(evaluate, start, MAX_ABS_Z, steps, modes.group)


def unexplained(modes: Modes, posteriors: StarPosteriors, misfit_sigma: float) -> np.ndarray:
    """List the stars whose best mode does not explain their image, without or with their field.

    For the right mode and P pixels, χ² = Σ (n − μ)²/μ has the mean P and the variance 2P. A star is
    unexplained if its χ² is larger by more than `misfit_sigma` standard deviations.

    Parameters
    ----------
    modes : Modes
        Results of `climb`.
    posteriors : StarPosteriors
    misfit_sigma : float

    Returns
    -------
    ndarray of int
        Numbers of the stars, ascending.
    """
    modes = modes.best_of_group
    stamps = posteriors.model.stamps(modes.z, modes.field, modes.offset).astype(np.float64)
    expected = posteriors.likelihood.expected(stamps.reshape(len(stamps), -1))
    chi2 = ((posteriors.counts[modes.star] - expected) ** 2 / expected).sum(axis=1)
    pixels = expected.shape[1]
    return np.unique(modes.star[chi2 > pixels + misfit_sigma * np.sqrt(2.0 * pixels)])


def corners(modes: Modes, stars: np.ndarray) -> Modes:
    """Place starts all around the best modes of the stars with these numbers.

    They serve stars whose climbs have ended in local maxima: a climb from beside one mostly ends
    elsewhere. Starts are the 2⁵ corners of a cube around the mode, 0.5 away in every coefficient.
    """
    modes = modes.best_of_group
    stuck = np.flatnonzero(np.isin(modes.star, stars))
    # Every stuck mode with every combination of signs.
    signs = np.array(list(product((-1.0, 1.0), repeat=TERMS)))
    start = modes.take(np.repeat(stuck, len(signs)))
    z = start.z + 0.5 * np.tile(signs, (stuck.size, 1))
    return Modes.at(start.star, start.field, start.offset, start.knowledge, z)


def find_twins(modes: Modes, likelihood: Likelihood, model: StampModel) -> Modes:
    """Find other fields and offsets of every star that give nearly the same image.

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

    Returns
    -------
    Modes
        Starts for `climb`, at most 40 of a star.
    """
    # The three best modes of every star, their monomial coefficients m, and the Fisher
    # information F² ∂p ∂pᵀ / (F p + B) of the eight.
    blind = modes.take(np.flatnonzero(modes.knowledge == Knowledge.NONE))
    source = blind.take(largest_of_groups(blind.star, blind.evidence, 3))
    coefficients = model.coefficients(source.z, source.field)
    axes = np.tile(np.eye(len(MONOMIALS)), (len(coefficients), 1, 1))
    stamps, jacobian = model.derivatives(coefficients, axes, source.offset)
    light = likelihood.flux * jacobian
    metric = (light / likelihood.expected(stamps)[:, None]) @ light.swapaxes(1, 2)
    # Log-likelihood at the mode: its evidence without the width of the Gaussian and the prior.
    width = np.log(np.diagonal(source.factor, axis1=1, axis2=2)).sum(axis=1)
    height = source.evidence - width + 0.5 * (source.z**2).sum(axis=1)
    # Every field and every offset of up to a pixel: coefficients for z = 0, and their slopes.
    fields = np.arange(len(model.field))
    static = model.coefficients(np.zeros((fields.size, TERMS)), fields)
    directions = model.directions(fields)
    shifts = np.array(jitters(1))
    tilt = tilt_coefficients(model, shifts)
    # Signs that negate the even part of a wavefront, which leaves its image unchanged.
    even_signs = np.array([1 - 2 * (name in ("r4", "xx", "xy", "yy")) for name in MONOMIALS])
    # Best log-mass and z by star, field and offset.
    places: dict[tuple[int, ...], tuple[float, np.ndarray]] = {}
    for m, star in enumerate(source.star):
        for sign in (np.ones(len(MONOMIALS)), even_signs):
            # Change of the coefficients that every field and offset needs to give this image, and
            # z that comes nearest to it, weighed against the prior.
            gap = sign * coefficients[m] + tilt - static[:, None]
            log_mass, z = _best_coefficients(sign[:, None] * metric[m] * sign, directions, gap)
            log_mass += height[m]
            possible = log_mass > log_mass.max() - MAX_EVIDENCE_DROP
            for f, k in zip(*np.nonzero(possible), strict=True):
                key = (star, f, *(source.offset[m] + shifts[k]))
                if key not in places or log_mass[f, k] > places[key][0]:
                    places[key] = (log_mass[f, k], z[f, k])
    keys = np.array(list(places))
    log_mass, z = (np.array(column) for column in zip(*places.values(), strict=True))
    # The best offset of every field, then the best fields: no field crowds out another.
    star_and_field = keys[:, 0] * fields.size + keys[:, 1]
    twins = largest_of_groups(star_and_field, log_mass, 1)
    twins = twins[largest_of_groups(keys[twins, 0], log_mass[twins], 40)]
    keys = keys[twins]
    knowledge = np.full(twins.size, Knowledge.NONE)
    return Modes.at(keys[:, 0], keys[:, 1], keys[:, 2:], knowledge, z[twins])


def _best_coefficients(
    metric: np.ndarray, directions: np.ndarray, gap: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Maximise the Gaussian exp(−½ rᵀ M r − ½|z|²), r = gap − z·directions, over z.

    Parameters
    ----------
    metric : ndarray, shape (8, 8)
        M, the information of the monomials' coefficients.
    directions : ndarray, shape (F, 5, 8)
        Change of the coefficients by z in every field.
    gap : ndarray, shape (F, V, 8)
        Change that is needed in every field, for V offsets.

    Returns
    -------
    log_mass : ndarray, shape (F, V)
        Logarithm of the Gaussian's integral over z, up to a constant.
    z : ndarray, shape (F, V, 5)
        Place of the maximum.
    """
    # Normal equations (D M Dᵀ + 1) z = D M gap.
    weighted = directions @ metric
    curvature = weighted @ directions.swapaxes(1, 2) + np.eye(TERMS)
    z = np.linalg.solve(curvature, weighted @ gap.swapaxes(1, 2)).swapaxes(1, 2)
    # Integral of the Gaussian: its height at the maximum times det(curvature)^−½.
    residual = gap - z @ directions
    loss = ((residual @ metric) * residual).sum(axis=2) + (z**2).sum(axis=2)
    return -0.5 * (loss + np.linalg.slogdet(curvature)[1][:, None]), z


def separate(modes: Modes) -> Modes:
    """Return the modes that have noticeable mass, each once.

    Of modes of a star in the same field and offset that are less than one of their standard
    deviations apart, the best is kept. It is known by the least knowledge that led to any of them.
    """
    best_evidence = group_maximum(modes.evidence, modes.group)
    noticeable = np.flatnonzero(modes.evidence > best_evidence - MAX_EVIDENCE_DROP)
    distinct: dict[tuple[int, ...], list[int]] = {}
    knowledge = modes.knowledge.copy()
    # From the best mode on, so that a mode meets those that are better.
    for m in noticeable[np.argsort(-modes.evidence[noticeable], kind="stable")]:
        at_place = distinct.setdefault((modes.star[m], modes.field[m], *modes.offset[m]), [])
        for k in at_place:
            # Mahalanobis distance in the covariance L Lᵀ of the better mode.
            distance = np.linalg.solve(modes.factor[k], modes.z[m] - modes.z[k])
            if distance @ distance < 1.0:
                knowledge[k] = min(knowledge[k], knowledge[m])
                break
        else:
            at_place.append(int(m))
    numbers = np.sort(np.concatenate(list(distinct.values())))
    return replace(modes, knowledge=knowledge).take(numbers)


class Place(NamedTuple):
    """Places of n draws: field (n,), offset (n, 2) in pixels, standardised coefficients (n, 5)."""

    field: np.ndarray
    offset: np.ndarray
    z: np.ndarray


class Draws(NamedTuple):
    """Draws of one star, n in all, with what the optics make of them.

    Attributes
    ----------
    field, offset, z : ndarray, shapes (n,), (n, 2) and (n, 5)
        Their `Place`.
    image : ndarray, shape (n, P), float32
        Stamp of every draw.
    jitter : ndarray of int, shape (n,)
        Centring error, as number in `jitters`.
    log_posterior : ndarray, shape (n,)
        Logarithm of prior × likelihood; −∞ for impossible draws.
    """

    field: np.ndarray
    offset: np.ndarray
    z: np.ndarray
    image: np.ndarray
    jitter: np.ndarray
    log_posterior: np.ndarray


class SampledPosterior(NamedTuple):
    """Posterior sums over importance samples around modes.

    Attributes
    ----------
    parts : list of PosteriorSums
        Sums in `EQUAL_PARTS` equal parts.
    with_truth : PosteriorSums
        Sums in one part, with all modes that more knowledge leads to, those climbed from the truth
        among them. The truth is one draw from the posterior, so the difference shows what the
        search does not detect of the posterior.
    """

    parts: list[PosteriorSums]
    with_truth: PosteriorSums


def sample_posterior(
    modes: Modes,
    posteriors: StarPosteriors,
    star_field: np.ndarray,
    draws: int,
    rngs: Sequence[np.random.Generator],
) -> tuple[SampledPosterior, SampledPosterior]:
    """Draw around modes, weigh the samples and adapt the mixture, in three rounds.

    Stars with a mode that only the truth leads to are sampled again with it.

    Parameters
    ----------
    modes : Modes
        At least one for every star, and one in its own field.
    posteriors : StarPosteriors
    star_field : ndarray of int, shape (n,)
        True field of every star; −1 if it is unknown.
    draws : int
        Samples a star in all rounds; every mode has one at least in each round.
    rngs : sequence of n Generators

    Returns
    -------
    unknown_field : SampledPosterior
        Sums over all fields in which the search has found modes.
    known_field : SampledPosterior
        Sums over the star's own field, for estimators that know it.
    """
    # Most of the draws are left for the mixture that has been adapted twice.
    rounds = [round(share * draws) for share in (0.2, 0.3, 0.5)]

    def sample(stars: np.ndarray, modes: Modes) -> list[_Sampler]:
        """Sample the stars with these numbers, their draws propagated together."""
        samplers = [
            _Sampler(
                modes.take(np.flatnonzero(modes.star == star)),
                int(star_field[star]),
                posteriors.counts[star],
                rngs[star],
            )
            for star in stars
        ]
        for count in rounds if samplers else ():
            _run_round(samplers, count, posteriors)
        return samplers

    # First around the modes that a search finds. Stars with a mode that only the truth leads to
    # are sampled again with all modes; the random numbers go on where they were.
    detected = modes.take(np.flatnonzero(modes.knowledge != Knowledge.TRUTH))
    undetected = np.unique(modes.star[modes.knowledge == Knowledge.TRUTH])
    rows: list[tuple[PosteriorSums, ...]] = []
    for stars in np.array_split(np.arange(len(rngs)), -(-len(rngs) // STARS_AT_ONCE)):
        samplers = sample(stars, detected)
        resampled = stars[np.isin(stars, undetected)]
        with_truth = dict(zip(resampled, sample(resampled, modes), strict=True))
        # A row for each star: its parts without and with the field, then both totals.
        for star, sampler in zip(stars, samplers, strict=True):
            totals = with_truth.get(star, sampler).totals(posteriors.model)
            rows.append((*sampler.parts(posteriors.model), *totals))
    *parts, total, total_in_field = (
        PosteriorSums.stack(column) for column in zip(*rows, strict=True)
    )
    unknown_field = SampledPosterior(parts[:EQUAL_PARTS], total)
    return unknown_field, SampledPosterior(parts[EQUAL_PARTS:], total_in_field)


def _run_round(samplers: list[_Sampler], count: int, posteriors: StarPosteriors) -> None:
    """Draw once for several stars; their stamps are propagated together."""
    places = [sampler.propose(count) for sampler in samplers]
    field, offset, z = (np.concatenate(column) for column in zip(*places, strict=True))
    # Draws beyond the limit have no weight; they are propagated at the limit.
    stamps = posteriors.model.stamps(np.clip(z, -MAX_ABS_Z, MAX_ABS_Z), field, offset)
    stamps = stamps.reshape(len(stamps), -1)
    ends = np.cumsum([place.field.size for place in places])[:-1]
    for sampler, place, images in zip(samplers, places, np.split(stamps, ends), strict=True):
        sampler.weigh(place, images, posteriors)


class _Sampler:
    """Adaptive importance sampler of one star.

    Parameters
    ----------
    modes : Modes
        Modes of the star, around which the first round is drawn.
    star_field : int
        True field of the star; −1 if it is unknown.
    counts : ndarray, shape (P,)
    rng : Generator
    """

    def __init__(
        self, modes: Modes, star_field: int, counts: np.ndarray, rng: np.random.Generator
    ) -> None:
        self.modes, self.star_field, self.counts, self.rng = modes, star_field, counts, rng
        is_blind = modes.knowledge == Knowledge.NONE
        self.field_is_detected = bool((is_blind & (modes.field == star_field)).any())
        self.mixtures: list[tuple[Modes, np.ndarray]] = []
        """Modes of every round, and the number of draws from each of them."""
        self.rounds: list[Draws] = []

    @property
    def draws(self) -> Draws:
        """Draws of all rounds."""
        return Draws(*(np.concatenate(column) for column in zip(*self.rounds, strict=True)))

    def propose(self, count: int) -> Place:
        """Draw about `count` places, from the mixture adapted to the draws before."""
        if self.rounds:
            self.modes = self.modes.adapted(self.draws, self.log_weight())
        place, number = self.modes.draw(count, self.star_field, self.rng)
        self.mixtures.append((self.modes, number))
        return place

    def weigh(self, place: Place, images: np.ndarray, posteriors: StarPosteriors) -> None:
        """Add draws with their images (n, P), prior and likelihood."""
        framing, likelihood = posteriors.model.framing, posteriors.likelihood
        # The simulator frames the first of the brightest pixels, equal within `framing.tie`.
        # Its distance from the stamp's middle is the jitter, which has a limit.
        threshold = (1.0 - framing.tie) * images.max(axis=1, keepdims=True)
        pixel = np.stack(np.divmod((images >= threshold).argmax(axis=1), framing.stamp_px), axis=1)
        jitter = pixel - framing.stamp_px // 2
        possible = (np.abs(jitter) <= framing.jitter_px).all(axis=1)
        possible &= (np.abs(place.z) <= MAX_ABS_Z).all(axis=1)
        number = (jitter + framing.jitter_px) @ [2 * framing.jitter_px + 1, 1]
        # ln(prior × likelihood) = Σ n ln(1 + F p/B) − F Σp − |z|²/2, without constants.
        ratio = np.log1p(images * (likelihood.flux / likelihood.background), dtype=np.float64)
        light = likelihood.flux * images.sum(axis=-1, dtype=np.float64)
        log_posterior = (ratio * self.counts).sum(axis=-1) - light
        log_posterior = log_posterior - 0.5 * (place.z**2).sum(axis=-1)
        log_posterior = np.where(possible, log_posterior, -np.inf)
        self.rounds.append(Draws(*place, images, np.where(possible, number, 0), log_posterior))

    def log_weight(self) -> np.ndarray:
        """Return ln of prior × likelihood over the density of all rounds' mixtures, shape (n,)."""
        draws = self.draws
        # The density of draws from all rounds together is Σ_modes number × density of the mode.
        with np.errstate(divide="ignore"):
            log_density = [
                np.log(number)[:, None] + modes.log_density(draws.z, draws.field, draws.offset)
                for modes, number in self.mixtures
            ]
        total = np.logaddexp.reduce(np.concatenate(log_density), axis=0)
        return np.asarray(draws.log_posterior - total)

    def parts(self, model: StampModel) -> list[PosteriorSums]:
        """Return sums of every part without the field, then of every part with the field known."""
        in_field = self.draws.field == self.star_field
        part = np.arange(in_field.size) % EQUAL_PARTS
        # Without the field, modes in the true field count only if the blind search found one there.
        blind = ~in_field | self.field_is_detected
        selections = [kind & (part == k) for kind in (blind, in_field) for k in range(EQUAL_PARTS)]
        return self._sums(selections, model)

    def totals(self, model: StampModel) -> list[PosteriorSums]:
        """Return sums over all draws, and over those in the star's own field."""
        in_field = self.draws.field == self.star_field
        return self._sums([np.ones(in_field.size, bool), in_field], model)

    def _sums(self, selections: Sequence[np.ndarray], model: StampModel) -> list[PosteriorSums]:
        """Return the sums over each of the selections (n,) of the draws."""
        log_weight, draws = self.log_weight(), self.draws
        shifts = (2 * model.framing.jitter_px + 1) ** 2
        parts = []
        for selection in selections:
            sums = PosteriorSums.empty(1, self.counts.size, len(model.field), shifts)
            used = np.flatnonzero(selection & np.isfinite(log_weight))
            if used.size:
                # Weights relative to the largest, as in `PosteriorSums`.
                sums.log_scale[:] = log_weight[used].max()
                weight = np.exp(log_weight[used] - sums.log_scale)
                sums.weight_sum[:] = weight.sum()
                sums.weight_square_sum[:] = (weight**2).sum()
                images = draws.image[used].astype(np.float64)
                sums.image_sum[:] = weight @ images
                sums.image_square_sum[:] = weight @ images**2
                cell = (draws.field[used], draws.jitter[used])
                np.add.at(sums.template_weight[0], cell, weight)
            parts.append(sums)
        return parts
