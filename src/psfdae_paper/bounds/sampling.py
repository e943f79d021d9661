"""Importance sampling of a star's posterior, where the bank has too few stars that resemble it.

The input is the modes of the stars' posteriors, the output sums over weighted draws, from which the
posterior mean of each star is computed. Coefficients are drawn around all modes, from a mixture of
Student's t distributions. The mixture is adapted to its own draws (`Modes.adapt`), and the draws of
all rounds are weighted by prior × likelihood over the density of all rounds together (Cornuet et
al. 2012, Scandinavian Journal of Statistics 39, 798). Draws whose brightest pixel the simulator
would not frame at o get weight 0.

The Markov chains of `psfdae.sensing.sampling` cannot replace it: evidence for a bound needs weights
of independent draws, in parts and with an effective size. Nor can it replace the chains: in the
many parameters of a star of unknown position, flux and sky, few draws get all the weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from psfdae_paper.bounds.modes import Knowledge, Modes, Positions
from psfdae_paper.bounds.posterior import PosteriorSums
from psfdae_paper.bounds.stamp_model import StampModel, StarPosteriors


@dataclass(frozen=True)
class Draws(Positions):
    """The n draws of one star, with their propagated stamps.

    Attributes
    ----------
    image : ndarray, shape (n, P), float32
        Stamp of every draw.
    jitter : ndarray of int, shape (n,)
        Centring error, as number in `list_jitters`.
    log_posterior : ndarray, shape (n,)
        Logarithm of prior × likelihood; −∞ for impossible draws.
    """

    image: np.ndarray
    jitter: np.ndarray
    log_posterior: np.ndarray


class SampledPosterior(NamedTuple):
    """Posterior sums over importance samples around modes.

    Attributes
    ----------
    parts : list of PosteriorSums
        Sums in four equal parts, whose errors show whether there are enough draws.
    with_truth : PosteriorSums
        Sums in one part over all modes, including modes that are reached only from the truth. The
        truth is one draw from the posterior, so the difference shows which part of the posterior
        the search misses.
    """

    parts: list[PosteriorSums]
    with_truth: PosteriorSums


def sample_posterior(
    modes: Modes,
    posteriors: StarPosteriors,
    star_field: np.ndarray,
    draws: int,
    rngs: Sequence[np.random.Generator],
    stars_at_once: int = 60,
) -> tuple[SampledPosterior, SampledPosterior]:
    """Draw around the modes, weight the samples and adapt the mixture, in three rounds.

    Stars with a mode that is reached only from the truth are sampled again with this mode.

    Parameters
    ----------
    modes : Modes
        At least one mode for every star, and one in its own field.
    posteriors : StarPosteriors
        Photon counts and likelihood of the n stars, and the model of their stamps.
    star_field : ndarray of int, shape (n,)
        True field of every star; −1 if it is unknown.
    draws : int
        Samples per star in all rounds; every mode gets at least one in each round.
    rngs : sequence of n Generators
        Random generator of each star.
    stars_at_once : int
        Number of stars whose draws are propagated together, to limit the memory.

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
        # A sampler has the modes of its star alone, and the star's own random numbers.
        samplers = [
            _Sampler(
                modes.select(modes.star == star),
                int(star_field[star]),
                posteriors.counts[star],
                rngs[star],
            )
            for star in stars
        ]
        for count in rounds if samplers else ():
            _run_round(samplers, count, posteriors)
        return samplers

    # First around the modes that the search finds. Stars with a mode that is reached only from the
    # truth are sampled again with all modes; their generators continue.
    detected_modes = modes.select(modes.knowledge != Knowledge.TRUTH)
    incomplete_stars = np.unique(modes.star[modes.knowledge == Knowledge.TRUTH])
    rows: list[tuple[PosteriorSums, ...]] = []
    for stars in np.array_split(np.arange(len(rngs)), -(-len(rngs) // stars_at_once)):
        # These stars, then again the stars for which the search has missed a mode.
        samplers = sample(stars, detected_modes)
        resampled_stars = stars[np.isin(stars, incomplete_stars)]
        with_truth = dict(zip(resampled_stars, sample(resampled_stars, modes), strict=True))
        # A row for each star: its parts without and with the field, then both totals.
        for star, sampler in zip(stars, samplers, strict=True):
            totals = with_truth.get(star, sampler).totals(posteriors.model)
            rows.append((*sampler.parts(posteriors.model), *totals))
    *parts, total, total_in_field = (
        PosteriorSums.join(column) for column in zip(*rows, strict=True)
    )
    unknown_field = SampledPosterior(parts[:4], total)
    return unknown_field, SampledPosterior(parts[4:], total_in_field)


def _run_round(samplers: list[_Sampler], count: int, posteriors: StarPosteriors) -> None:
    """Draw once for several stars; their stamps are propagated together."""
    proposals = [sampler.propose(count) for sampler in samplers]
    draws, limit = Positions.join(proposals), posteriors.model.max_abs_z
    # Draws outside the limit get weight 0; they are propagated at the limit.
    stamps = posteriors.model.stamps(np.clip(draws.z, -limit, limit), draws.field, draws.offset)
    stamps = stamps.reshape(len(stamps), -1)
    ends = np.cumsum([position.field.size for position in proposals])[:-1]
    for sampler, position, images in zip(samplers, proposals, np.split(stamps, ends), strict=True):
        sampler.weigh(position, images, posteriors)


class _Sampler:
    """Adaptive importance sampler of one star.

    Parameters
    ----------
    modes : Modes
        Modes of the star, around which the first round is drawn.
    star_field : int
        True field of the star; −1 if it is unknown.
    counts : ndarray, shape (P,)
        Photons in every pixel of the star's stamp, sky included.
    rng : Generator
        Random generator of the star.
    """

    def __init__(
        self, modes: Modes, star_field: int, counts: np.ndarray, rng: np.random.Generator
    ) -> None:
        self.modes, self.star_field, self.counts, self.rng = modes, star_field, counts, rng
        # A field is detected if a mode in it was found without knowledge of the star.
        is_blind = modes.knowledge == Knowledge.NONE
        self.field_is_detected = bool((is_blind & (modes.field == star_field)).any())
        self.mixtures: list[tuple[Modes, np.ndarray]] = []
        """Modes of every round, and the number of draws from each of them."""
        self.rounds: list[Draws] = []

    @property
    def draws(self) -> Draws:
        """Draws of all rounds."""
        return Draws.join(self.rounds)

    def propose(self, count: int) -> Positions:
        """Draw about `count` positions from the mixture, adapted to the earlier draws."""
        if self.rounds:
            self.modes = self.modes.adapt(self.draws, self.log_weight())
        # The density of a draw needs the mixture of its round: it is kept with the number of draws.
        position, number = self.modes.draw(count, self.star_field, self.rng)
        self.mixtures.append((self.modes, number))
        return position

    def weigh(self, position: Positions, images: np.ndarray, posteriors: StarPosteriors) -> None:
        """Add draws with their images (n, P), prior and likelihood."""
        framing, likelihood = posteriors.model.framing, posteriors.likelihood
        # The simulator frames the first of the brightest pixels, equal within `framing.tie`.
        # Its distance from the stamp's middle is the jitter, which has a limit.
        threshold = (1.0 - framing.tie) * images.max(axis=1, keepdims=True)
        pixel = np.stack(np.divmod((images >= threshold).argmax(axis=1), framing.stamp_px), axis=1)
        jitter = pixel - framing.stamp_px // 2
        possible = (np.abs(jitter) <= framing.jitter_px).all(axis=1)
        possible &= (np.abs(position.z) <= posteriors.model.max_abs_z).all(axis=1)
        number = (jitter + framing.jitter_px) @ [2 * framing.jitter_px + 1, 1]
        # ln(prior × likelihood) = Σ n ln(1 + F p/B) − F Σp − |z|²/2, without constants.
        ratio = np.log1p(images * (likelihood.flux / likelihood.background), dtype=np.float64)
        light = likelihood.flux * images.sum(axis=-1, dtype=np.float64)
        log_posterior = (ratio * self.counts).sum(axis=-1) - light
        log_posterior = log_posterior - 0.5 * (position.z**2).sum(axis=-1)
        log_posterior = np.where(possible, log_posterior, -np.inf)
        jitter_number = np.where(possible, number, 0)
        columns = position.field, position.offset, position.z, images, jitter_number
        self.rounds.append(Draws(*columns, log_posterior))

    def log_weight(self) -> np.ndarray:
        """Return ln of prior × likelihood over the density of all rounds' mixtures, shape (n,)."""
        draws = self.draws
        # The density of draws from all rounds together is Σ_modes number × density of the mode.
        with np.errstate(divide="ignore"):
            log_density = [
                np.log(number)[:, None]
                + modes.log_density(draws, modes.compute_squared_distance(draws.z))
                for modes, number in self.mixtures
            ]
        total = np.logaddexp.reduce(np.concatenate(log_density), axis=0)
        return np.asarray(draws.log_posterior - total)

    def parts(self, model: StampModel) -> list[PosteriorSums]:
        """Return sums of four parts without the field, then of four with the field known."""
        in_field = self.draws.field == self.star_field
        # Every fourth draw goes to the same part: all parts have draws of all rounds and modes.
        part = np.arange(in_field.size) % 4
        # Without the field, draws in the true field are used only if the blind search found it.
        blind = ~in_field | self.field_is_detected
        selections = [kind & (part == k) for kind in (blind, in_field) for k in range(4)]
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
            draw_numbers = np.flatnonzero(selection & np.isfinite(log_weight))
            if draw_numbers.size:
                # Weights relative to the largest, as in `PosteriorSums`.
                sums.log_scale[:] = log_weight[draw_numbers].max()
                weight = np.exp(log_weight[draw_numbers] - sums.log_scale)
                # Σw and Σw² give the effective sample size (Σw)²/Σw².
                sums.weight_sum[:] = weight.sum()
                sums.weight_square_sum[:] = (weight**2).sum()
                # Σw p and Σw p², and the weight of each static PSF, by field and centring error.
                images = draws.image[draw_numbers].astype(np.float64)
                sums.image_sum[:] = weight @ images
                sums.image_square_sum[:] = weight @ images**2
                cell = (draws.field[draw_numbers], draws.jitter[draw_numbers])
                np.add.at(sums.template_weight[0], cell, weight)
            parts.append(sums)
        return parts
