"""Wavefronts of single stars: the modes of each star's posterior, and what they say.

A star's image depends on the coefficients of its wavefront's terms, its place, its flux and the
sky. Photons are Poisson; coefficients have the prior of the telescope, the other numbers none.
Candidates drawn from the prior are matched with the stamp at whole pixels, the best ones
lead to modes. As long as none explains the star, more are drawn. A pupil that is
the same at opposite points hides the sign of the even part of a wavefront: the twin of every
mode is a start, too, and both are given with their probabilities.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from psfdae.bright_stars import LEAST_SKY, MOST_SKY
from psfdae.errors import Error
from psfdae.image.stamps import Stamps, border_median, border_scatter
from psfdae.optics.derivatives import PointSampling, SampledStamps, Sampling
from psfdae.optics.seeing import BlurredSampling, Broadening
from psfdae.optics.wavefronts import movable_modes
from psfdae.progress import task
from psfdae.rng import stream
from psfdae.sensing.climbing import Steps, best_of_group, climb, poisson
from psfdae.sensing.sampling import Mixture, sample_around
from psfdae.telescope.field import Terms
from psfdae.telescope.settings import OwnTelescope

BLURRED_SIZE = 48
"""Seeing forgives a coarser grid than `SIZES` begin with. Either errs by less than a thousandth
of the noise of stars of S/N 200."""

SIZES = (64, 80, 96, 126, 158, 190, 222, 254, 318, 398, 478, 638, 830, 1000)
"""Pupil samples to choose from; the sampling guard decides for each wavefront."""

FARTHEST_Z = 6.0
"""Standard deviations of the prior beyond which no coefficient is looked for."""

BESIDE = 4
"""Numbers of a star besides its coefficients: x and y in pixels, flux in that of its start, and
sky in units of the noise."""

UNLIKELY = 12.0
"""Modes whose probability is this far below the best one's, in its logarithm, are left out."""

POOR_FIT = 4.0
"""Standard deviations of χ² from which a star counts as not explained."""

SHIFT_PX = 4
"""Pixels by which candidates are moved to match a stamp."""

LEAST_PIXELS = 0.5
"""Part of the pixels that a star must have."""

LEAST_LEFT = 0.01
"""Lower limit of the expected counts, as a fraction of the sky."""

OUTSIDE = 1e100
"""Fall of the logarithm of the posterior where a star is not near its stamp."""

WEAK = 1e-9
"""Information on flux and sky besides that of the star, so that no matrix is singular."""

STARS_AT_ONCE = 128
"""Stars of 16 × 16 px that are worked on together, to bound the memory."""

CANDIDATES_AT_ONCE = 100
"""Candidates of a star that are evaluated at once."""


class Round(NamedTuple):
    """How many candidates are drawn for a star, and from how many of them modes are sought."""

    candidates: int
    starts: int


ROUNDS = (Round(48, 4), Round(100, 6), Round(400, 12), Round(1000, 12))
"""The later ones for stars that no mode explains, or of which the one before found another."""

LIKELY = 0.01
"""Probability of a mode beside which there may be others."""

CLIMB = Steps(most=25, depth=40.0, rounding=1e-5)


class SensingError(Error, ValueError):
    """Stars, or a telescope, of which no wavefronts can be found."""


@dataclass(frozen=True, eq=False)
class StarOptics:
    """Stamps of stars with given terms, as functions of their numbers.

    Attributes
    ----------
    telescope : OwnTelescope
    terms : Terms
        Of n stars.
    stamp_px : int
    """

    telescope: OwnTelescope
    terms: Terms
    stamp_px: int

    @property
    def count(self) -> int:
        """Coefficients K of a star."""
        return len(self.terms.names)

    @property
    def reach_px(self) -> float:
        """Distance along x and y from the middle of a stamp within which its star is."""
        return 0.5 * self.stamp_px + SHIFT_PX

    @cached_property
    def operator(self) -> SampledStamps:
        """Propagation to stamps."""
        return self.propagation(self.stamp_px)

    @cached_property
    def broadening(self) -> SampledStamps:
        """Propagation to the stamps' derivatives by the logarithm of the seeing's FWHM."""
        return self.propagation(self.stamp_px, broadening=True)

    def propagation(
        self, stamp_px: int, oversampling: int = 1, *, broadening: bool = False
    ) -> SampledStamps:
        """Propagation to stamps of another size, with several values per pixel and axis."""
        telescope = self.telescope
        pixel = telescope.pixel
        blur = telescope.blur
        sampling: Callable[..., Sampling] = PointSampling
        if blur is not None:
            profile = Broadening(blur) if broadening else blur
            sampling = partial(BlurredSampling, profile=profile)
        return SampledStamps(
            telescope.obscuration,
            partial(movable_modes, self.terms.modes, pixel),
            partial(sampling, stamp_px=stamp_px, pixel=pixel / oversampling, precision="complex64"),
            stamp_px,
            pixel / oversampling,
            SIZES if blur is None else (BLURRED_SIZE, *SIZES),
            reach=blur.reach if blur is not None else 0.0,
            batch=64,
        )

    def coefficients(self, star: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Coefficients in waves, (m, K), of standardised ones z (m, K) of stars (m,)."""
        return np.asarray(self.terms.mean[star] + self.terms.sd[star] * z)

    def modes(self, star: np.ndarray, z: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Coefficients of the pupil's modes (m, J + 2); `place` (m, 2) is x, y in pixels."""
        waves = np.einsum("mk,mkj->mj", self.coefficients(star, z), self.terms.to_modes[star])
        return np.concatenate([waves, place], axis=1)

    def derivatives(
        self, star: np.ndarray, z: np.ndarray, place: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Stamps of light 1, (m, P), and slopes by z and place, (m, K + 2, P)."""
        directions = self.terms.sd[star][:, :, None] * self.terms.to_modes[star]
        directions = np.pad(directions, ((0, 0), (0, 2), (0, 2)))
        directions[:, [-2, -1], [-2, -1]] = 1.0
        stamps, slopes = self.operator.derivatives(self.modes(star, z, place), directions)
        flat = (len(star), -1)
        return (
            stamps.reshape(flat).astype(np.float64),
            slopes.reshape(*slopes.shape[:2], -1).astype(np.float64),
        )

    def twins(self, star: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Standardised coefficients (m, K) with the even terms negated; ∞ where one is fixed."""
        mean, sd = self.terms.mean[star], self.terms.sd[star]
        with np.errstate(divide="ignore", invalid="ignore"):
            negated = np.where(sd > 0, -z - 2.0 * mean / sd, np.where(mean == 0, z, np.inf))
        return np.where(self.terms.even, negated, z)


@dataclass(frozen=True)
class Photons:
    """Stamps in electrons whose noise is Poisson's.

    Attributes
    ----------
    counts : ndarray, shape (n, P)
        Sky included; NaN where a pixel is not used.
    sky : ndarray, shape (n,)
        Counts per pixel that have the noise of the sky, read noise included.
    gain, level, noise : ndarray, shape (n,)
        Electrons per unit of the stamps, and the sky and its noise in that unit.
    """

    counts: np.ndarray
    sky: np.ndarray
    gain: np.ndarray
    level: np.ndarray
    noise: np.ndarray

    @classmethod
    def of(cls, stamps: Stamps) -> Photons:
        """Return photons of stamps in counts; without a gain, the sky's noise alone counts."""
        data = stamps.data.astype(np.float64)
        level = border_median(data, stamps.bad)
        level = np.where(np.isfinite(stamps.background), stamps.background, level)
        scatter = border_scatter(data, stamps.bad)
        noise = np.where(np.isfinite(stamps.noise), stamps.noise, scatter)
        noise = np.where(noise > 0, noise, np.nan)
        gain = np.where(np.isfinite(stamps.gain), stamps.gain, MOST_SKY**0.5 / noise)
        sky = np.clip((gain * noise) ** 2, LEAST_SKY, MOST_SKY)
        counts = gain[:, None, None] * (data - level[:, None, None]) + sky[:, None, None]
        counts = np.where(stamps.bad | stamps.saturated, np.nan, counts).reshape(len(data), -1)
        return cls(counts, sky, gain, level, noise)

    @property
    def usable(self) -> np.ndarray:
        """Stars with enough pixels and a noise, (n,)."""
        return np.asarray(
            (np.isfinite(self.counts).mean(axis=1) >= LEAST_PIXELS) & np.isfinite(self.noise)
        )


@dataclass(frozen=True)
class Modes:
    """Modes of stars' posteriors, M in all, in the order of the stars, the best of each first.

    Attributes
    ----------
    star : ndarray of int, shape (M,)
    numbers : ndarray, shape (M, K + 4)
        Standardised coefficients, place (x, y) from the middle of the stamp in pixels, flux and
        sky in the units of `Search.flux` and of the noise.
    covariance : ndarray, shape (M, K + 4, K + 4)
    evidence : ndarray, shape (M,)
        Logarithm of the mode's mass.
    deviance : ndarray, shape (M,)
        Twice the log-likelihood that is missing to a perfect fit.
    """

    star: np.ndarray
    numbers: np.ndarray
    covariance: np.ndarray
    evidence: np.ndarray
    deviance: np.ndarray

    def take(self, modes: np.ndarray) -> Modes:
        """Some of the modes, in the order given."""
        return Modes(*(values[modes] for values in vars(self).values()))

    @property
    def probability(self) -> np.ndarray:
        """Part of its star's mass that every mode has, (M,)."""
        mass = np.exp(self.evidence - best_of_group(self.evidence, self.star))
        return np.asarray(mass / np.bincount(self.star, mass)[self.star])

    @property
    def first(self) -> np.ndarray:
        """Number of each star's best mode."""
        return np.flatnonzero(np.diff(self.star, prepend=-1))


def expected_deviance(photons: Photons, star: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the deviance of the true image, of some stars."""
    pixels = np.isfinite(photons.counts[star]).sum(axis=1)
    return pixels, np.sqrt(2.0 * pixels)


class Search:
    """The modes of the stars of some stamps.

    Parameters
    ----------
    optics : StarOptics
    photons : Photons
    seed : int
        Of the candidates.
    """

    def __init__(self, optics: StarOptics, photons: Photons, seed: int) -> None:
        self.optics, self.photons, self.seed = optics, photons, seed
        self.flux = np.ones(len(photons.counts))
        wide = optics.stamp_px + 2 * SHIFT_PX
        self._wide = optics.propagation(wide)

    def modes(self) -> Modes:
        """Modes of all stars, those without usable pixels left out.

        Raises
        ------
        SensingError
            If no star has enough usable pixels.
        """
        usable = np.flatnonzero(self.photons.usable)
        if not usable.size:
            raise SensingError("no star has enough usable pixels")
        return joined([self._modes(part) for part in self._blocks(usable)])

    def _modes(self, missing: np.ndarray) -> Modes:
        """Modes of some stars."""
        found: Modes | None = None
        k, known = self.optics.count, np.ones(len(self.flux), int)
        for number, each in enumerate(ROUNDS):
            if not missing.size:
                break
            starts = [self.matched(star, number, each) for star in missing]
            star = np.repeat(missing, [len(start) for start in starts])
            fresh = self.climbed(star, np.concatenate(starts))
            twins = fresh.numbers.copy()
            twins[:, :k] = self.optics.twins(fresh.star, twins[:, :k])
            reachable = (np.abs(twins[:, :k]) <= FARTHEST_Z).all(axis=1)
            if reachable.any():
                fresh = joined([fresh, self.climbed(fresh.star[reachable], twins[reachable])])
            found = separate(fresh if found is None else joined([found, fresh]))
            first = found.take(found.first)
            # Where a round has found another mode, there may be more.
            likely = np.bincount(found.star, found.probability > LIKELY, known.size)
            more = (likely[first.star] > known[first.star]) | ~self.explained(first)
            missing, known = np.intersect1d(missing, first.star[more]), likely
        assert found is not None, "some stars"
        return found

    def explained(self, modes: Modes) -> np.ndarray:
        """Whether modes fit as well as the true image nearly always does."""
        mean, scatter = expected_deviance(self.photons, modes.star)
        return modes.deviance <= mean + POOR_FIT * scatter

    def matched(self, star: int, number: int, size: Round) -> np.ndarray:
        """Starts of a star, (at most `starts`, K + 4): its best candidates, each at its place."""
        optics, count = self.optics, size.candidates
        rng = stream(self.seed, "wavefront", int(star), number)
        z = np.clip(rng.standard_normal((count, optics.count)), -FARTHEST_Z, FARTHEST_Z)
        if number == 0:
            z[0] = 0.0
        seen = self.photons.counts[star] - self.photons.sky[star]
        used = np.isfinite(seen)
        parts = [
            self._gains(star, part, seen[used] - seen[used].mean(), used)
            for part in np.split(z, range(CANDIDATES_AT_ONCE, count, CANDIDATES_AT_ONCE))
        ]
        flux, gain = (np.concatenate(values) for values in zip(*parts, strict=True))
        shifts = 2 * SHIFT_PX + 1
        value = gain - 0.5 * (z**2).sum(axis=1, keepdims=True)
        place = value.argmax(axis=1)
        best = np.argsort(-value.max(axis=1), kind="stable")[: size.starts]
        if number == 0:
            top = flux[best[0], place[best[0]]]
            self.flux[star] = max(top, np.sqrt(self.photons.sky[star]))
        row, column = np.divmod(place[best], shifts)
        # A window that starts later shows the star earlier.
        numbers = [z[best], SHIFT_PX - np.stack([column, row], axis=1)]
        part = flux[best, place[best]] / self.flux[star]
        numbers.append(np.stack([np.maximum(part, 0.01), np.zeros(best.size)], axis=1))
        return np.concatenate(numbers, axis=1)

    def _gains(
        self, star: int, z: np.ndarray, seen: np.ndarray, used: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Flux of candidates z (c, K) at all shifts, and what it gains in log-likelihood, (c, S).

        `seen` are the counts of the pixels (P,) that are `used`, their mean taken out.
        """
        side, nowhere = self.optics.stamp_px, np.zeros((len(z), 2))
        modes = self.optics.modes(np.full(len(z), star), z, nowhere)
        wide = self._wide.stamps(modes).astype(np.float64)
        windows = np.lib.stride_tricks.sliding_window_view(wide, (side, side), axis=(1, 2))
        light = windows.reshape(-1, side**2)[:, used]
        light -= light.mean(axis=1, keepdims=True)
        product = light @ seen
        flux = product / np.maximum((light**2).sum(axis=1), np.finfo(float).tiny)
        gain = np.where(flux > 0, flux * product, 0.0) / (2.0 * self.photons.sky[star])
        return flux.reshape(len(z), -1), gain.reshape(len(z), -1)

    def climbed(self, star: np.ndarray, start: np.ndarray) -> Modes:
        """Modes that starts (M, K + 4) of stars (M,) lead to."""
        optics, photons = self.optics, self.photons
        k = optics.count
        limit = np.array([FARTHEST_Z] * k + [optics.reach_px] * 2 + [np.inf] * 2)

        def evaluate(
            some: np.ndarray, numbers: np.ndarray
        ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            advance(1)
            members = star[some]
            stamps, slopes = optics.derivatives(members, numbers[:, :k], numbers[:, k : k + 2])
            mean, slopes = self.expected(members, stamps, slopes, numbers[:, k:])
            deviance, score, information = poisson(photons.counts[members], mean, slopes)
            z = numbers[:, :k]
            score[:, :k] -= z
            information[:, range(k), range(k)] += 1.0
            score[:, k : k + 2] -= numbers[:, k : k + 2] / optics.stamp_px**2
            information[:, range(k, k + 2), range(k, k + 2)] += 1.0 / optics.stamp_px**2
            information[:, range(k + 2, k + BESIDE), range(k + 2, k + BESIDE)] += WEAK
            return -0.5 * (deviance + self.penalty(numbers)), score, information

        with task("modes", CLIMB.most + 1) as advance:
            peaks = climb(evaluate, start, limit, CLIMB, star)
        covariance = np.linalg.inv(peaks.information)
        sign, width = np.linalg.slogdet(covariance)
        evidence = np.where(sign > 0, peaks.height + 0.5 * width, -np.inf)
        deviance = -2.0 * peaks.height - self.penalty(peaks.parameters)
        return Modes(star, peaks.parameters, covariance, evidence, deviance)

    def sampled(self, modes: Modes) -> np.ndarray:
        """Draws (m, `CHAINS.kept`, K + 4) from the posteriors of the stars that have modes."""
        blocks = self._blocks(modes.star[modes.first])
        parts = [modes.take(np.flatnonzero(np.isin(modes.star, part))) for part in blocks]
        return np.concatenate([self._sampled(part) for part in parts])

    def _blocks(self, stars: np.ndarray) -> list[np.ndarray]:
        size = max(1, int(STARS_AT_ONCE * (16 / self.optics.stamp_px) ** 2))
        return np.split(stars, range(size, stars.size, size))

    def _sampled(self, modes: Modes) -> np.ndarray:
        stars, k = modes.star[modes.first], self.optics.count

        def twin(member: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            z = numbers[:, :k]
            there = self.optics.twins(stars[member], z)
            gain = 0.5 * ((z**2).sum(axis=1) - (there**2).sum(axis=1))
            gain = np.where((np.abs(there) <= FARTHEST_Z).all(axis=1), gain, -np.inf)
            return np.concatenate([there, numbers[:, k:]], axis=1), gain

        return sample_around(
            lambda member, numbers: self._height(stars[member], numbers),
            twin,
            np.searchsorted(stars, modes.star),
            Mixture(modes.numbers, np.linalg.cholesky(modes.covariance), modes.evidence),
            [stream(self.seed, "wavefront draws", int(star)) for star in stars],
        )

    def _height(self, star: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Logarithm of the posterior at numbers (m, K + 4) of stars (m,)."""
        optics, k = self.optics, self.optics.count
        z = np.clip(numbers[:, :k], -FARTHEST_Z, FARTHEST_Z)
        place = np.clip(numbers[:, k : k + 2], -optics.reach_px, optics.reach_px)
        modes = optics.modes(star, z, place)
        stamps = optics.operator.stamps(modes).reshape(len(star), -1).astype(np.float64)
        none = np.empty((len(star), 0, stamps.shape[1]))
        mean, none = self.expected(star, stamps, none, numbers[:, k:])
        deviance = poisson(self.photons.counts[star], mean, none)[0]
        height = -0.5 * (deviance + self.penalty(numbers))
        within = (np.abs(numbers[:, k : k + 2]) <= optics.reach_px).all(axis=1)
        return np.where(within, height, -OUTSIDE)

    def penalty(self, numbers: np.ndarray) -> np.ndarray:
        """−2 ln of the prior of numbers (m, K + 4): of coefficients, and a wide one of places."""
        k = self.optics.count
        own = (numbers[:, :k] ** 2).sum(axis=1)
        place = numbers[:, k : k + 2] / self.optics.stamp_px
        return np.asarray(own + (place**2).sum(axis=1))

    def expected(
        self, star: np.ndarray, stamps: np.ndarray, slopes: np.ndarray, own: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Expected counts (m, P), no pixel below `LEAST_LEFT`, and their slopes (m, k + 2, P).

        Parameters
        ----------
        star : ndarray of int, shape (m,)
        stamps, slopes : ndarray, shapes (m, P) and (m, k, P)
            Of light 1, and by whatever numbers.
        own : ndarray, shape (m, 4)
            Place, flux and sky of each star.
        """
        flux, sky = self.flux[star, None], self.photons.sky[star, None]
        of_sky = np.broadcast_to(np.sqrt(sky), stamps.shape)
        mean = flux * own[:, 2:3] * stamps + sky + of_sky * own[:, 3:]
        slopes = slopes * (flux * own[:, 2:3])[:, None]
        slopes = np.concatenate([slopes, (flux * stamps)[:, None], of_sky[:, None]], axis=1)
        return np.maximum(mean, LEAST_LEFT * sky), slopes


def joined(parts: list[Modes]) -> Modes:
    """Modes of several searches."""
    return Modes(*(np.concatenate([getattr(p, name) for p in parts]) for name in vars(parts[0])))


def separate(modes: Modes) -> Modes:
    """Modes that are likely, each once, by star and from the best on."""
    near = modes.evidence > best_of_group(modes.evidence, modes.star) - UNLIKELY
    kept: dict[int, list[int]] = {}
    order = np.lexsort((-modes.evidence, modes.star))
    for m in order[near[order]]:
        others = kept.setdefault(int(modes.star[m]), [])
        for k in others:
            apart = modes.numbers[m] - modes.numbers[k]
            if apart @ np.linalg.solve(modes.covariance[k], apart) < 1.0:
                break
        else:
            others.append(int(m))
    return modes.take(np.array([m for members in kept.values() for m in members], int))
