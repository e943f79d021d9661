"""Wavefronts of single stars: the modes of the posterior of each star, and draws from it.

The image of a star depends on the coefficients of its wavefront, its position, its flux and the
sky. Photon counts are Poisson distributed. The coefficients have the prior of the telescope; flux
and sky have a flat prior. Candidates are drawn from the prior and matched to the stamp at whole
pixels, and the best ones are optimised to modes. More candidates are drawn for stars that no mode
explains. A pupil that is equal at opposite points hides the sign of the even part of a wavefront:
the twin of every mode is a start, too, and both are returned with their probabilities.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import ClassVar

import numpy as np

from psfdae.base.errors import Error
from psfdae.base.rng import stream
from psfdae.base.rows import Rows
from psfdae.image.sky import border_median, border_scatter
from psfdae.image.stamps import Stamps
from psfdae.optics.derivatives import PointSampling, SampledStamps, StampsAndSlopes
from psfdae.optics.propagation import Sampling
from psfdae.optics.seeing import BlurredSampling, Broadening
from psfdae.optics.wavefronts import movable_modes
from psfdae.sensing.climbing import (
    Evaluation,
    Steps,
    add_normal_prior,
    climb,
    compute_deviance_limit,
    group_maximum,
    poisson_information,
)
from psfdae.sensing.modes import merge_modes
from psfdae.sensing.quadratic import (
    MAX_PARAMETERS,
    QuadraticPosterior,
    draw_design,
    fit_root,
)
from psfdae.sensing.sampling import sample_around
from psfdae.stars.bright_stars import BrightStars
from psfdae.telescope.field import Terms
from psfdae.telescope.settings import OwnTelescope

PUPIL_SIZES = (48, 64, 80, 96, 126, 158, 190, 222, 254, 318, 398, 478, 638, 830, 1000)
"""Pupil samples to choose from; the sampling guard decides for each wavefront.

The first one is only for stars in seeing, where a coarser grid is enough. In both cases the error
is below a thousandth of the noise of stars of S/N 200.
"""

MAX_Z = 6.0
"""Largest deviation of a coefficient from its prior mean in the search, in standard deviations."""


class SensingError(Error, ValueError):
    """Error of stars, or of a telescope, that do not allow a measurement of wavefronts."""


@dataclass(frozen=True, eq=False)
class StarOptics:
    """Propagation from the parameters of stars to their stamps.

    Attributes
    ----------
    telescope : OwnTelescope
        Telescope with its pupil, pixels and seeing.
    terms : Terms
        Aberrations of n stars, K coefficients each.
    stamp_px : int
        Side d of a stamp; P = d² pixels.
    """

    telescope: OwnTelescope
    terms: Terms
    stamp_px: int
    search_px: ClassVar[int] = 4
    """Pixels by which candidates are shifted along x and y to match a stamp."""

    @property
    def coefficient_count(self) -> int:
        """Number K of coefficients of a star."""
        return len(self.terms.names)

    @property
    def reach_px(self) -> float:
        """Largest distance of a star along x and y from the middle of its stamp."""
        return 0.5 * self.stamp_px + self.search_px

    @cached_property
    def operator(self) -> SampledStamps:
        """Propagation to stamps."""
        return self.propagation(self.stamp_px)

    def propagation(
        self, stamp_px: int, oversampling: int = 1, *, broadening: bool = False
    ) -> SampledStamps:
        """Return the propagation to stamps, with `oversampling` values per pixel and axis.

        With `broadening`, stamps are derivatives with respect to the logarithm of the FWHM of the
        seeing.
        """
        telescope, blur = self.telescope, self.telescope.blur
        # Points of the image without blur, the whole period of the image for blurred stamps.
        pixel = telescope.pixel / oversampling
        sampling: Callable[..., Sampling] = PointSampling
        if blur is not None:
            profile = Broadening(blur) if broadening else blur
            sampling = partial(BlurredSampling, profile=profile)
        return SampledStamps(
            telescope.obscuration,
            # Two additional modes move the star by a pixel of the telescope along x and y.
            partial(movable_modes, self.terms.modes, telescope.pixel),
            sampling,
            stamp_px,
            pixel,
            "complex64",
            PUPIL_SIZES[1:] if blur is None else PUPIL_SIZES,
            reach=blur.reach if blur is not None else 0.0,
            batch=64,
        )

    def coefficients(self, star: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return coefficients in waves, (m, K), of standardised ones z (m, K) of stars (m,)."""
        return np.asarray(self.terms.mean[star] + self.terms.sd[star] * z)

    def mode_coefficients(
        self, star: np.ndarray, coefficients: np.ndarray, position_px: np.ndarray
    ) -> np.ndarray:
        """Return the coefficients (m, J + 2) of the pupil's modes, tilts included.

        Parameters
        ----------
        star : ndarray of int, shape (m,)
            Index of the star of each row.
        coefficients : ndarray, shape (m, K)
            Coefficients of the terms in waves.
        position_px : ndarray, shape (m, 2)
            Position (x, y) of the star from the middle of the stamp.
        """
        # Terms are linear in the modes; the matrix depends on the field angle of the star.
        waves = np.einsum("mk,mkj->mj", coefficients, self.terms.to_modes[star])
        return np.concatenate([waves, position_px], axis=1)

    def derivatives(self, modes: np.ndarray, directions: np.ndarray) -> StampsAndSlopes:
        """Return stamps of light 1, (m, P), and their derivatives, (m, k + 2, P).

        Parameters
        ----------
        modes : ndarray, shape (m, J + 2)
            Result of `mode_coefficients`.
        directions : ndarray, shape (m, k, J)
            Derivatives of the modes with respect to k parameters; the position (x, y) is added.
        """
        # Two additional parameters, the coefficients of the last two modes.
        directions = np.pad(directions, ((0, 0), (0, 2), (0, 2)))
        directions[:, [-2, -1], [-2, -1]] = 1.0
        stamps, slopes = self.operator.derivatives(modes, directions)
        # Double precision for the comparison with counts.
        slopes = slopes.reshape(*slopes.shape[:2], -1).astype(np.float64)
        return stamps.reshape(len(modes), -1).astype(np.float64), slopes

    def twins(self, star: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return standardised coefficients (m, K) whose even terms are negated in waves.

        A coefficient without twin, because the prior fixes it, becomes ∞.
        """
        mean, sd = self.terms.mean[star], self.terms.sd[star]
        # −(mean + sd z) = mean + sd z' for z' = −z − 2 mean/sd.
        with np.errstate(divide="ignore", invalid="ignore"):
            negated_z = np.where(sd > 0, -z - 2.0 * mean / sd, np.where(mean == 0, z, np.inf))
        return np.where(self.terms.is_even, negated_z, z)


@dataclass(frozen=True)
class Photons:
    """Stamps in electrons, with Poisson noise.

    Attributes
    ----------
    counts : ndarray, shape (n, P)
        Electrons, with sky; NaN where a pixel is not used.
    sky_counts : ndarray, shape (n,)
        Electrons per pixel whose Poisson noise equals the noise of the sky with the read noise.
    gain : ndarray, shape (n,)
        Electrons per unit of the stamps.
    sky_level, sky_noise : ndarray, shape (n,)
        Sky and RMS of its noise in a pixel, in the unit of the stamps.
    """

    counts: np.ndarray
    sky_counts: np.ndarray
    gain: np.ndarray
    sky_level: np.ndarray
    sky_noise: np.ndarray

    @classmethod
    def from_stamps(cls, stamps: Stamps) -> Photons:
        """Convert stamps to electrons; without a gain, only the noise of the sky is used."""
        # Sky and noise as given, or else from the border of the stamp.
        data = stamps.data.astype(np.float64)
        border = border_median(data, stamps.bad)
        level = np.where(np.isfinite(stamps.background), stamps.background, border)
        scatter = border_scatter(data, stamps.bad)
        noise = np.where(np.isfinite(stamps.noise), stamps.noise, scatter)
        noise = np.where(noise > 0, noise, np.nan)
        # The default gain is so large that the photon noise of the star is negligible compared with
        # the sky noise. N electrons have the variance N: the sky counts are (gain · noise)².
        gain = np.where(np.isfinite(stamps.gain), stamps.gain, BrightStars.max_sky**0.5 / noise)
        sky = np.clip((gain * noise) ** 2, BrightStars.min_sky, BrightStars.max_sky)
        # Counts of star and sky; bad or saturated pixels are not used.
        counts = gain[:, None, None] * (data - level[:, None, None]) + sky[:, None, None]
        counts = np.where(stamps.bad | stamps.saturated, np.nan, counts).reshape(len(data), -1)
        return cls(counts, sky, gain, level, noise)

    @property
    def pixels(self) -> np.ndarray:
        """Number of used pixels of each star, (n,), the mean deviance of the true image."""
        return np.asarray(np.isfinite(self.counts).sum(axis=1))

    @property
    def deviance_limit(self) -> np.ndarray:
        """Deviance above which a model image does not explain a star, (n,)."""
        return compute_deviance_limit(self.pixels)

    @property
    def usable(self) -> np.ndarray:
        """True for stars with at least half of their pixels and a known noise, (n,)."""
        return np.asarray((self.pixels >= 0.5 * self.counts.shape[1]) & np.isfinite(self.sky_noise))


@dataclass(frozen=True)
class StarModes(Rows):
    """Modes of the posteriors of stars, M in all, sorted by star, the best mode first.

    Attributes
    ----------
    star : ndarray of int, shape (M,)
        Index of the star of each mode.
    parameters : ndarray, shape (M, K + 4)
        Standardised coefficients, position (x, y) from the middle of the stamp in pixels, flux and
        sky in the units of `WavefrontSearch.flux` and of the sky noise.
    covariance : ndarray, shape (M, K + 4, K + 4)
        Covariance of the parameters in the mode.
    evidence : ndarray, shape (M,)
        Logarithm of the mass of the mode.
    deviance : ndarray, shape (M,)
        Twice the difference in log-likelihood from a perfect fit.
    """

    star: np.ndarray
    parameters: np.ndarray
    covariance: np.ndarray
    evidence: np.ndarray
    deviance: np.ndarray

    def select_stars(self, stars: np.ndarray) -> StarModes:
        """Return the modes of some stars."""
        return self.select(np.isin(self.star, stars))

    @property
    def best_modes(self) -> StarModes:
        """Best mode of each star."""
        return self.select(np.flatnonzero(np.diff(self.star, prepend=-1)))

    def find_maxima(self) -> np.ndarray:
        """Return the index of the best mode at the maximum of each mode, (M,)."""
        return merge_modes(self.parameters, self.covariance, self.evidence, self.star)

    @property
    def probability(self) -> np.ndarray:
        """Fraction of the mass of the posterior of its star in each mode, (M,)."""
        # Masses relative to the best mode of the star, so that they do not all underflow.
        mass = np.exp(self.evidence - group_maximum(self.evidence, self.star))
        return np.asarray(mass / np.bincount(self.star, mass)[self.star])


class WavefrontSearch:
    """Search for the modes of the posteriors of stars.

    Parameters
    ----------
    optics : StarOptics
        Propagation to the stamps of the stars.
    photons : Photons
        Counts of the stamps.
    seed : int
        Seed of the candidates and of the draws.

    Attributes
    ----------
    flux : ndarray, shape (n,)
        Flux of the best candidate of each star in electrons, the unit of fluxes.
    """

    stars_at_once: ClassVar[int] = 128
    """Number of stars of 16 × 16 px that are processed together, to limit the memory."""

    def __init__(self, optics: StarOptics, photons: Photons, seed: int) -> None:
        self.optics, self.photons, self.seed = optics, photons, seed
        self.flux = np.ones(len(photons.counts))
        # Stamps that are large enough to be shifted by whole pixels.
        self._wide_operator = optics.propagation(optics.stamp_px + 2 * optics.search_px)

    def find_modes(self) -> StarModes:
        """Find the modes of all stars that have enough usable pixels.

        Raises
        ------
        SensingError
            If no star has enough usable pixels.
        """
        usable = np.flatnonzero(self.photons.usable)
        if not usable.size:
            raise SensingError("no star has enough usable pixels")
        return StarModes.join([self._find_block(block) for block in self._blocks(usable)])

    def draw_parameters(self, modes: StarModes) -> np.ndarray:
        """Draw (m, `CHAINS.draws`, K + 4) parameters from the posteriors of stars with modes."""
        blocks = self._blocks(modes.best_modes.star)
        return np.concatenate([self._draw_block(modes.select_stars(block)) for block in blocks])

    @property
    def prior_precision(self) -> np.ndarray:
        """Inverse variance of the prior of a star's parameters, (K + 4,).

        Coefficients are normal with σ = 1; the position has a wide prior, σ = side of the stamp,
        flux and sky a flat one.
        """
        k, position_precision = self.optics.coefficient_count, self.optics.stamp_px**-2.0
        return np.array([1.0] * k + [position_precision] * 2 + [0.0] * 2)

    def is_explained(self, modes: StarModes) -> np.ndarray:
        """Return True for modes with a deviance that is usual for the true image."""
        return np.asarray(modes.deviance <= self.photons.deviance_limit[modes.star])

    def _blocks(self, stars: np.ndarray) -> list[np.ndarray]:
        # Memory grows with the number of pixels.
        size = max(1, int(self.stars_at_once * (16 / self.optics.stamp_px) ** 2))
        return np.split(stars, range(size, stars.size, size))

    def _find_block(self, stars: np.ndarray) -> StarModes:
        """Find the modes of some stars, with as many rounds of candidates as each star needs."""
        count = self.optics.coefficient_count
        modes: list[StarModes] = []
        likely_modes = np.ones(len(self.flux), int)
        # Number of candidates drawn for a star in each round, and of climbs from the best of them.
        rounds = ((48, 4), (100, 6), (400, 12), (1000, 12))
        for number, sizes in enumerate(rounds):
            if not stars.size:
                break
            # Climbs from the candidates that match best.
            starts = [self._match_candidates(star, number, *sizes) for star in stars]
            members = np.repeat(stars, [len(start) for start in starts])
            fresh = self._climb(members, np.concatenate(starts))
            # Climbs from the twins of new maxima, where the prior permits them.
            all_modes = StarModes.join([*modes, fresh])
            maximum, first = all_modes.find_maxima(), all_modes.star.size - fresh.star.size
            new_modes = all_modes.select(np.setdiff1d(maximum[first:], maximum[:first]))
            twins = new_modes.parameters.copy()
            twins[:, :count] = self.optics.twins(new_modes.star, twins[:, :count])
            is_reachable = (np.abs(twins[:, :count]) <= MAX_Z).all(axis=1)
            if is_reachable.any():
                twin_modes = self._climb(new_modes.star[is_reachable], twins[is_reachable])
                all_modes = StarModes.join([all_modes, twin_modes])
            modes = [separate_modes(all_modes)]
            # The next round is for stars that are not explained, and for stars with an additional
            # mode of a probability above 1 %: there may be more.
            best_modes = modes[0].best_modes
            is_likely = modes[0].probability > 0.01
            likely_before = likely_modes
            likely_modes = np.bincount(modes[0].star, is_likely, likely_before.size)
            has_more = likely_modes[best_modes.star] > likely_before[best_modes.star]
            needs_more = has_more | ~self.is_explained(best_modes)
            stars = np.intersect1d(stars, best_modes.star[needs_more])
        return modes[0]

    def _match_candidates(self, star: int, number: int, candidates: int, starts: int) -> np.ndarray:
        """Return the best candidates of a star in a round as starts, (at most `starts`, K + 4)."""
        optics = self.optics
        # Candidates from the prior; the very first one is the prior mean.
        rng = stream(self.seed, "wavefront", int(star), number)
        z = rng.standard_normal((candidates, optics.coefficient_count))
        z = np.clip(z, -MAX_Z, MAX_Z)
        if number == 0:
            z[0] = 0.0
        # Match at most 100 of them at once, to limit the memory. The logarithm of the posterior is
        # the gain in log-likelihood minus ½|z|²; each candidate takes its best shift.
        parts = [self._match(star, part) for part in np.split(z, range(100, len(z), 100))]
        flux, gain = (np.concatenate(values) for values in zip(*parts, strict=True))
        value = gain - 0.5 * (z**2).sum(axis=1, keepdims=True)
        shift = value.argmax(axis=1)
        best_rows = np.argsort(-value.max(axis=1), kind="stable")[:starts]
        if number == 0:
            # Unit of flux, at least the noise of a pixel.
            first_flux = flux[best_rows[0], shift[best_rows[0]]]
            self.flux[star] = max(first_flux, np.sqrt(self.photons.sky_counts[star]))
        # There are 2 · search_px + 1 shifts along each axis. A window that begins at a higher index
        # of the wide stamp shows the star at a lower index.
        row, column = np.divmod(shift[best_rows], 2 * optics.search_px + 1)
        position = optics.search_px - np.stack([column, row], axis=1)
        relative_flux = np.maximum(flux[best_rows, shift[best_rows]] / self.flux[star], 0.01)
        return np.column_stack([z[best_rows], position, relative_flux, np.zeros(best_rows.size)])

    def _match(self, star: int, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Fit the flux of candidates z (c, K) at S shifts; return it and its gain, (c, S).

        The gain is the increase in log-likelihood over a model without star, with a free sky.
        """
        # Light of the star minus its mean, because the sky is free.
        optics, side = self.optics, self.optics.stamp_px
        light = self.photons.counts[star] - self.photons.sky_counts[star]
        is_used = np.isfinite(light)
        light = np.where(is_used, light - light[is_used].mean(), 0.0)
        # The star, and its used pixels, at each of the S shifts in a wider image, (2, S, P).
        shifts, wide_px = 2 * optics.search_px + 1, side + 2 * optics.search_px
        shift_images = np.zeros((2, shifts, shifts, wide_px, wide_px))
        windows = np.lib.stride_tricks.sliding_window_view(
            shift_images, (side, side), axis=(3, 4), writeable=True
        )
        windows = np.einsum("nijijab->nijab", windows)
        windows[0], windows[1] = light.reshape(side, side), is_used.reshape(side, side)
        star_at, used_at = shift_images.reshape(2, shifts**2, wide_px**2).swapaxes(1, 2)
        stars = np.full(len(z), star)
        coefficients = optics.coefficients(stars, z)
        modes = optics.mode_coefficients(stars, coefficients, np.zeros((len(z), 2)))
        images = self._wide_operator.stamps(modes).reshape(len(z), -1).astype(np.float64)
        # Least squares: flux = p·d/p·p, and χ² falls by flux p·d/σ², with σ² the sky's counts. The
        # image p of a candidate is without its mean over the n used pixels: Σ p² − (Σ p)²/n.
        product, total = images @ star_at, images @ used_at
        power = images**2 @ used_at - total**2 / is_used.sum()
        flux = product / np.maximum(power, np.finfo(float).tiny)
        gain = np.where(flux > 0, flux * product, 0.0) / (2.0 * self.photons.sky_counts[star])
        return flux, gain

    def _climb(self, star: np.ndarray, start: np.ndarray) -> StarModes:
        """Climb from starts (M, K + 4) of stars (M,) to modes."""
        optics, photons, k = self.optics, self.photons, self.optics.coefficient_count
        limit = np.array([MAX_Z] * k + [optics.reach_px] * 2 + [np.inf] * 2)

        def evaluate(members: np.ndarray, parameters: np.ndarray) -> Evaluation:
            stars, z, position = star[members], parameters[:, :k], parameters[:, k : k + 2]
            # Poisson likelihood of the counts.
            modes = optics.mode_coefficients(stars, optics.coefficients(stars, z), position)
            directions = optics.terms.sd[stars][:, :, None] * optics.terms.to_modes[stars]
            stamps, slopes = optics.derivatives(modes, directions)
            mean, slopes = self.predict_counts(stars, stamps, slopes, parameters[:, k:])
            likelihood = poisson_information(photons.counts[stars], mean, slopes)
            return add_normal_prior(likelihood, parameters, self.prior_precision)

        steps = Steps(max_steps=25, max_drop=40.0, relative_rounding=1e-5, min_distance=0.3)
        peaks = climb(evaluate, start, limit, steps, star)
        # Height = −½ (deviance + Σ x²/σ²).
        deviance = -2.0 * peaks.height - peaks.parameters**2 @ self.prior_precision
        modes = StarModes(star, peaks.parameters, *peaks.laplace(), deviance)
        return modes.select(np.isfinite(peaks.height))

    def _draw_block(self, modes: StarModes) -> np.ndarray:
        """Draw from the posteriors of all stars of the modes."""
        stars, optics, k = modes.best_modes.star, self.optics, self.optics.coefficient_count

        def twin(member: np.ndarray, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            # Twins have the same likelihood: ln p differs by the prior, −½|z|².
            z = parameters[:, :k]
            twin_z = optics.twins(stars[member], z)
            gain = 0.5 * ((z**2).sum(axis=1) - (twin_z**2).sum(axis=1))
            gain = np.where((np.abs(twin_z) <= MAX_Z).all(axis=1), gain, -np.inf)
            return np.concatenate([twin_z, parameters[:, k:]], axis=1), gain

        def compute_stamps(star: np.ndarray, parameters: np.ndarray) -> np.ndarray:
            # Outside of the limits, the image at the limit is used.
            position = np.clip(parameters[:, k : k + 2], -optics.reach_px, optics.reach_px)
            coefficients = optics.coefficients(star, np.clip(parameters[:, :k], -MAX_Z, MAX_Z))
            modes = optics.mode_coefficients(star, coefficients, position)
            return optics.operator.stamps(modes).reshape(len(star), -1).astype(np.float64)

        def log_posterior(member: np.ndarray, parameters: np.ndarray) -> np.ndarray:
            star, stamps = stars[member], compute_stamps(stars[member], parameters)
            # Only the likelihood; derivatives are not needed.
            no_slopes = np.empty((len(star), 0, stamps.shape[1]))
            mean, no_slopes = self.predict_counts(star, stamps, no_slopes, parameters[:, k:])
            deviance = poisson_information(self.photons.counts[star], mean, no_slopes)[0]
            height = -0.5 * (deviance + parameters**2 @ self.prior_precision)
            # A star far from its stamp is impossible; a finite value keeps differences finite.
            is_near = (np.abs(parameters[:, k : k + 2]) <= optics.reach_px).all(axis=1)
            return np.where(is_near, height, -1e100)

        def approximate(
            numbers: np.ndarray, fit_offsets: Mapping[int, np.ndarray]
        ) -> QuadraticPosterior:
            # Images at the same offsets from all modes, and at the offsets that are given.
            design = draw_design(k + 2, stream(self.seed, "wavefront design"))
            roots = {}
            for number in numbers:
                offset = design
                if number in fit_offsets:
                    offset = np.concatenate([design, fit_offsets[number][:, : k + 2]])
                star, shape = modes.star[number], factor[number, : k + 2, : k + 2]
                at = modes.parameters[number, : k + 2] + offset @ shape.T
                roots[number] = fit_root(
                    offset,
                    compute_stamps(np.full(len(at), star), at),
                    self.photons.counts[star],
                    self.flux[star],
                    self.photons.sky_counts[star],
                    modes.parameters[number, k + 2],
                )
            return QuadraticPosterior(modes.parameters, factor, self.prior_precision, roots)

        # A random stream for each star: its draws do not depend on other stars.
        owner = np.searchsorted(stars, modes.star)
        rngs = [stream(self.seed, "wavefront draws", int(star)) for star in stars]
        factor = np.linalg.cholesky(modes.covariance)
        mixture = modes.parameters, factor, modes.evidence
        approximation = approximate if k + 2 <= MAX_PARAMETERS else None
        return sample_around(log_posterior, twin, owner, *mixture, rngs, approximation)

    def predict_counts(
        self, star: np.ndarray, stamps: np.ndarray, slopes: np.ndarray, star_parameters: np.ndarray
    ) -> StampsAndSlopes:
        """Return expected counts (m, P), and their derivatives (m, k + 2, P).

        Two derivatives are added: with respect to flux and sky.

        Parameters
        ----------
        star : ndarray of int, shape (m,)
            Index of the star of each row.
        stamps, slopes : ndarray, shapes (m, P) and (m, k, P)
            Stamps of light 1 and their derivatives with respect to k parameters.
        star_parameters : ndarray, shape (m, 4)
            Position (x, y), flux and sky of each star, in the units of `StarModes`.
        """
        # μ = F f p + B + √B s, with the unit of flux F, the flux f and the sky s.
        # The derivatives with respect to flux and sky are F p and √B.
        flux, sky = self.flux[star, None], self.photons.sky_counts[star, None]
        sky_slope = np.broadcast_to(np.sqrt(sky), stamps.shape)
        mean = flux * star_parameters[:, 2:3] * stamps + sky + sky_slope * star_parameters[:, 3:]
        slopes = slopes * (flux * star_parameters[:, 2:3])[:, None]
        slopes = np.concatenate([slopes, (flux * stamps)[:, None], sky_slope[:, None]], axis=1)
        # At least a hundredth of the sky in each pixel, because counts are divided by their mean.
        return np.maximum(mean, 0.01 * sky), slopes


def separate_modes(modes: StarModes) -> StarModes:
    """Return the likely modes without duplicates, sorted by star, the best mode first.

    Modes whose evidence is 12 below the best one of their star (6e-6 of its mass) are dropped.
    """
    is_likely = modes.evidence > group_maximum(modes.evidence, modes.star) - 12.0
    modes = modes.select(is_likely)
    # One mode for each maximum.
    modes = modes.select(np.unique(modes.find_maxima()))
    return modes.select(np.lexsort((-modes.evidence, modes.star)))
