"""Wavefronts that are refined by the optics, from the proposals of a network.

The stamp p(c) of a star depends on the coefficients c of eight pupil monomials, with tilts that
show the image at its place in the stamp. About an expansion point c⁰ the likelihood of the photons
is a Gaussian of δ = c − c⁰,

    ln L(c⁰ + δ) ≈ ln L(c⁰) + gᵀδ − ½ δᵀMδ,

with the score g and the Fisher information M. The prior is a sum over fields f and offsets o of the
stamp in whole pixels. In each of them, c is linear in the standardised Seidel coefficients,
c = s_fo + D_fᵀ z with z ~ N(0, 1). Product and integral are Gaussians: with e = s_fo − c⁰,

    A = D M Dᵀ + 1,   b = D (g − M e),   ⟨z⟩ = A⁻¹ b,   cov z = A⁻¹,
    ln mass = gᵀe − ½ eᵀMe + ½ bᵀA⁻¹b − ½ ln |A|.

Climbs start along the axis on which a proposal is least certain: images that are nearly the same
have several wavefronts there. A Gaussian is used near its expansion point only. Where much of the
mass is far from all points of a star, the stamp is computed anew there: this climbs to a mode, and
finds other wavefronts that give nearly the same image. A Gaussian belongs to the nearest point, so
that no mass is counted twice. In the end the sums over all fields, offsets and points give the
posterior mean ⟨p⟩ ≈ p + ⟨δ⟩ᵀ∂p, and its variance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple, Self

import numpy as np

from psfdae.base.rows import Rows
from psfdae.optics.derivatives import ImageSampling, SampledStamps, normalise_with_derivatives
from psfdae.optics.pupil import annular_pupil, choose_samples
from psfdae.optics.wavefronts import MONOMIALS, monomial_coefficients, monomial_images
from psfdae.sensing.climbing import (
    Evaluation,
    group_maximum,
    poisson_information,
)
from psfdae.stars.noise import NoiseModel
from psfdae_paper.bounds.modes import rank_in_group
from psfdae_paper.bounds.posterior_network import (
    PosteriorNetwork,
    WavefrontCoordinates,
    WavefrontNetwork,
)
from psfdae_paper.bounds.stamp_model import StampModel


@dataclass(frozen=True)
class SeidelPrior:
    """Prior of the wavefronts of stars in all fields and at all offsets of their stamps.

    Attributes
    ----------
    mean, sd : ndarray, shape (5,)
        Mean and standard deviation of the Seidel coefficients in waves.
    field : ndarray, shape (F, 2)
        Field vectors, equally likely; 1 at the edge on an axis.
    pixel : float
        Width of a pixel in λ/D.
    max_abs_z : float
        Maximum of |z| to which a step leads.
    """

    mean: np.ndarray
    sd: np.ndarray
    field: np.ndarray
    pixel: float
    max_abs_z: ClassVar[float] = 6.0

    @cached_property
    def static(self) -> np.ndarray:
        """Coefficients s_f for z = 0 with the stamp about the chief ray, (F, 8)."""
        return monomial_coefficients(self.mean, self.field)

    @cached_property
    def directions(self) -> np.ndarray:
        """Derivatives D_f of the coefficients by z, (F, 5, 8)."""
        return monomial_coefficients(np.diag(self.sd), self.field[:, None])

    def condition(
        self, point: np.ndarray, score: np.ndarray, information: np.ndarray, fields: np.ndarray
    ) -> Components:
        """Multiply the prior of each field by the likelihood about an expansion point.

        Parameters
        ----------
        point : ndarray, shape (n, 8)
            Expansion points c⁰.
        score, information : ndarray, shapes (n, 8) and (n, 8, 8)
            g and M of the n stars.
        fields : ndarray of int, shape (n, f)
            Fields of each star.
        """
        directions, tilts = self.directions[fields], slice(-2, None)
        # A = D M Dᵀ + 1, with D M of all fields as one product for each star.
        flat_shape = len(point), -1, len(MONOMIALS)
        weighted_directions = (directions.reshape(flat_shape) @ information).reshape(
            directions.shape
        )
        curvature = weighted_directions @ directions.swapaxes(2, 3)
        covariance, log_determinant = invert(curvature + np.eye(directions.shape[2]))
        # e = s − c⁰. A pixel's width is a tilt by half of it in λ/D: tilts that whole pixels leave.
        gap, step = self.static[fields] - point[:, None], 0.5 * self.pixel
        gap[..., tilts] = np.mod(gap[..., tilts], step)
        slope = score[:, None] - gap @ information
        # The two offsets on either side along each axis are tilts t, e − t. Then b = D (g − M e)
        # + D M t, and gᵀe − ½ eᵀMe grows by −tᵀ(g − M e) − ½ tᵀMt.
        tilt = step * np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
        right_side = (directions @ slope[..., None]).swapaxes(2, 3)
        right_side = right_side + tilt @ weighted_directions[..., tilts].swapaxes(2, 3)
        z = right_side @ covariance
        log_mass = 0.5 * ((gap * (score[:, None] + slope)).sum(axis=2) - log_determinant)[..., None]
        log_mass = log_mass - slope[..., tilts] @ tilt.T + 0.5 * (right_side * z).sum(axis=3)
        log_mass -= 0.5 * ((tilt @ information[:, tilts, tilts]) * tilt).sum(axis=2)[:, None]
        gap = np.repeat(gap[:, :, None], len(tilt), axis=2)
        gap[..., tilts] -= tilt
        limited_z = np.clip(z, -self.max_abs_z, self.max_abs_z)
        return Components(log_mass.reshape(len(point), -1), gap, limited_z, directions, covariance)

    def select_fields(self, point: np.ndarray, number: int) -> np.ndarray:
        """Select the fields in which wavefronts are most likely, without regard to their tilts.

        Parameters
        ----------
        point : ndarray, shape (n, 8)
            Coefficients.
        number : int
            Number of fields of each wavefront; all fields if there are fewer.

        Returns
        -------
        ndarray of int, shape (n, min(number, F))
        """
        root, offset, log_determinant = self._field_roots
        terms, number = len(root), min(number, len(self.field))
        # −2 ln density in each field is |R (c − s)|² + ln |covariance|.
        deviation = np.square(point[:, :terms] @ root.reshape(terms, -1) - offset)
        distance = deviation.reshape(len(point), -1, terms).sum(axis=2) + log_determinant
        return np.asarray(np.argpartition(distance, number - 1, axis=1)[:, :number])

    @cached_property
    def _field_roots(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Matrices Rᵀ (6, F, 6) of R (c − s), R s (6 F,), and ln |covariance| (F,)."""
        # Wavefronts from which the fields are selected have errors of a tenth of a wave.
        directions, static = self.directions[..., :-2], self.static[:, :-2]
        terms = static.shape[1]
        covariance = directions.swapaxes(1, 2) @ directions + 0.1**2 * np.eye(terms)
        root = np.linalg.cholesky(np.linalg.inv(covariance))
        offset = (static[:, None] @ root).ravel()
        log_determinant = np.linalg.slogdet(covariance)[1]
        return np.ascontiguousarray(root.swapaxes(0, 1)), offset, log_determinant


@dataclass(frozen=True)
class Components(Rows):
    """Posterior of each star as a mixture of Gaussians of δ, over f fields and four offsets.

    Attributes
    ----------
    log_mass : ndarray, shape (n, 4 f)
        Logarithms of the masses; the offsets of a field are neighbours.
    gap : ndarray, shape (n, f, 4, 8)
        e, which is δ for z = 0.
    z : ndarray, shape (n, f, 4, 5)
        Mean of z in each component.
    directions : ndarray, shape (n, f, 5, 8)
        Derivatives D of δ by z in each field.
    covariance : ndarray, shape (n, f, 5, 5)
        Covariance of z in each field.
    """

    log_mass: np.ndarray
    gap: np.ndarray
    z: np.ndarray
    directions: np.ndarray
    covariance: np.ndarray

    @cached_property
    def shift(self) -> np.ndarray:
        """Mean of δ in each component, (n, 4 f, 8)."""
        shift = self.gap + self.z @ self.directions
        return np.asarray(shift.reshape(*self.log_mass.shape, -1))

    @property
    def evidence(self) -> np.ndarray:
        """Logarithm of the total mass of each star, (n,)."""
        return np.asarray(np.logaddexp.reduce(self.log_mass, axis=1))

    @property
    def mode(self) -> np.ndarray:
        """Mean of δ in the component of the largest mass, (n, 8)."""
        star, (field, offset) = np.arange(len(self.z)), np.divmod(self.log_mass.argmax(axis=1), 4)
        z, directions = self.z[star, field, offset], self.directions[star, field]
        return np.asarray(self.gap[star, field, offset] + (z[:, None] @ directions)[:, 0])

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean (n, 8) and covariance (n, 8, 8) of δ under the mixture."""
        weight = np.exp(self.log_mass - self.evidence[:, None])
        mean = np.einsum("nk,nka->na", weight, self.shift)
        # Within the components, and between their means.
        of_field = weight.reshape(len(weight), -1, 4).sum(axis=2)[..., None, None]
        slopes, scatter = (
            array.reshape(len(array), -1, array.shape[-1])
            for array in (self.directions, of_field * self.covariance @ self.directions)
        )
        covariance = slopes.swapaxes(1, 2) @ scatter
        offsets = (self.shift - mean[:, None]) * np.sqrt(weight)[:, :, None]
        return mean, covariance + offsets.swapaxes(1, 2) @ offsets


def invert(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return inverses and logarithms of the determinants of positive definite matrices (..., k, k).

    Gauss–Jordan elimination of all matrices at once: for many small matrices, it takes a tenth of
    the time of a factorisation of each.
    """
    inverse = np.ascontiguousarray(np.moveaxis(matrices, (-2, -1), (0, 1)))
    log_determinant = np.zeros(inverse.shape[2:])
    for p in range(len(inverse)):
        pivot = inverse[p, p].copy()
        log_determinant += np.log(pivot)
        inverse[p, p] = 1.0
        inverse[p] /= pivot
        for row in range(len(inverse)):
            if row != p:
                factor = inverse[row, p].copy()
                inverse[row, p] = 0.0
                inverse[row] -= factor * inverse[p]
    return np.ascontiguousarray(np.moveaxis(inverse, (0, 1), (-2, -1))), log_determinant


@dataclass(frozen=True)
class Expansion(Rows):
    """Stamps of wavefronts, the likelihood of photons about them, and the posterior.

    Attributes
    ----------
    point : ndarray, shape (n, 8)
        Coefficients c⁰.
    stamps, slopes : ndarray, shapes (n, P) and (n, 8, P)
        Stamps of sum 1, and their derivatives by c.
    deviance : ndarray, shape (n,)
        −2 ln L(c⁰), relative to the counts themselves.
    components : Components
        Posterior of δ.
    """

    point: np.ndarray
    stamps: np.ndarray
    slopes: np.ndarray
    deviance: np.ndarray
    components: Components

    @property
    def evidence(self) -> np.ndarray:
        """Logarithm of the integral of prior × likelihood, (n,)."""
        return np.asarray(self.components.evidence - 0.5 * self.deviance)

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Return posterior mean and variance of the stamps, (n, P) both."""
        # ⟨p⟩ = p + ⟨δ⟩ᵀ∂p and var p = ∂pᵀ cov(δ) ∂p.
        mean, covariance = self.components.moments()
        psf = self.stamps + (mean[:, None] @ self.slopes)[:, 0]
        return psf, ((covariance @ self.slopes) * self.slopes).sum(axis=1)


class NetworkStarts(NamedTuple):
    """Results of networks from which wavefronts are refined.

    Attributes
    ----------
    points : ndarray, shape (n, K, 8)
        Coefficients of K wavefronts of each star, the most likely first.
    precision : ndarray, shape (n, K, 8, 8)
        Inverse covariances of their errors.
    weight : ndarray, shape (n, K)
        Their probabilities.
    psf, variance : ndarray, shape (n, P)
        PSF of the network, and its variance.
    """

    points: np.ndarray
    precision: np.ndarray
    weight: np.ndarray
    psf: np.ndarray
    variance: np.ndarray

    @classmethod
    def compute(
        cls,
        network: PosteriorNetwork,
        proposer: WavefrontNetwork,
        noisy: np.ndarray,
        level: np.ndarray,
        pixel: float,
    ) -> NetworkStarts:
        """Apply networks to images (n, d, d) of levels (n,); `pixel` is its width in λ/D."""
        estimate, pixels = network.estimate(noisy, level, None), len(network.mean)
        psf, sigma = (
            np.asarray(values, np.float64).reshape(len(noisy), pixels)
            for values in (estimate.psf, estimate.sigma)
        )
        log_weight, wavefront, root = proposer.propose(noisy, level)
        # The precision of coordinates T c is RᵀR, the precision of c is (RT)ᵀRT.
        root = root @ WavefrontCoordinates.to_coordinates
        precision = root.swapaxes(2, 3) @ root
        points = WavefrontCoordinates.decode(wavefront, pixel)
        return cls(points, precision, np.exp(log_weight), psf, sigma**2)

    def spread(
        self, proposals: int, min_weight: float, positions: Sequence[float], width: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return starts along the axis of each proposal on which its error is largest.

        Parameters
        ----------
        proposals : int
            Number of proposals, the most likely ones.
        min_weight : float
            Minimum probability of a proposal, unless it is the most likely one.
        positions : sequence of float
            Positions of the starts on the axis in standard deviations of the proposal.
        width : float
            Standard deviation of a start along the axis over the standard deviation of the
            proposal.

        Returns
        -------
        star : ndarray of int, shape (m,)
            Star of each start.
        point, precision : ndarray, shapes (m, 8) and (m, 8, 8)
            Coefficients, and inverse covariances of their errors.
        """
        is_used = self.weight[:, :proposals] > min_weight
        is_used[:, :1] = True
        star, number = np.nonzero(is_used)
        point, precision = self.points[star, number], self.precision[star, number]
        # The standard deviation along the axis is limited to two waves.
        eigenvalues, axes = np.linalg.eigh(precision + 0.25 * np.eye(point.shape[1]))
        sd, axis = eigenvalues[:, :1] ** -0.5, axes[:, :, 0]
        # A start is as uncertain as its proposal, but along the axis.
        narrow_axis = axis / (width * sd)
        precision = precision + narrow_axis[:, :, None] * narrow_axis[:, None]
        shift = np.multiply.outer(positions, sd * axis)
        points = (point + shift).swapaxes(0, 1).reshape(-1, point.shape[1])
        count = len(positions)
        return np.repeat(star, count), points, np.repeat(precision, count, axis=0)


@dataclass(frozen=True)
class RefinedPsfs(Rows):
    """Posterior means of n stars about their refined wavefronts.

    Attributes
    ----------
    psf, variance : ndarray, shape (n, P)
        Mean and variance of the noise-free stamp.
    evidence : ndarray, shape (n,)
        Logarithm of the integral of prior × likelihood about the wavefronts, relative to the
        likelihood of a star with the counts of the image.
    """

    psf: np.ndarray
    variance: np.ndarray
    evidence: np.ndarray


@dataclass(frozen=True)
class Refiner:
    """Optics of a telescope that refine proposals of wavefronts.

    Attributes
    ----------
    prior : SeidelPrior
        Distribution of the wavefronts.
    obscuration : float
        Linear central obscuration of the pupil.
    stamp_px : int
        Pixels d along a side.
    noise : NoiseModel
        Photon noise of the images.
    jitter_px : int
        Largest centring error of a stamp in pixels per axis.
    proposals : int
        Maximum number of proposals from which a star's climbs start.
    min_weight : float
        Minimum probability of a proposal.
    positions : tuple of float
        Positions of the starts along the axis of a proposal, in standard deviations.
    width : float
        Standard deviation of a start along this axis over the standard deviation of the proposal.
    damping : float
        Factor of the inverse covariances of starts, by which the first step is damped.
    max_wavefronts : int
        Maximum number of starts that are refined.
    max_gap : float
        Difference in the logarithm of the evidence of first expansions, below which a start is
        refined.
    max_steps : int
        Maximum number of successive expansions, at least two.
    linear_waves : float
        RMS of the difference of two wavefronts in waves, up to which an expansion about one of them
        is used at the other.
    min_far_mass : float
        Part of a star's mass that is farther from all expansion points, above which another
        expansion is made.
    fields_kept : int
        Fields that an expansion considers, the most likely ones.
    batch : int
        Stars that are refined together.
    """

    prior: SeidelPrior
    obscuration: float
    stamp_px: int
    noise: NoiseModel
    jitter_px: int
    proposals: ClassVar[int] = 3
    min_weight: ClassVar[float] = 0.02
    positions: ClassVar[tuple[float, ...]] = (-1.5, 0.0, 1.5)
    width: ClassVar[float] = 0.6
    damping: ClassVar[float] = 0.25
    max_wavefronts: ClassVar[int] = 4
    max_gap: ClassVar[float] = 6.0
    max_steps: ClassVar[int] = 4
    linear_waves: ClassVar[float] = 0.1
    min_far_mass: ClassVar[float] = 0.05
    fields_kept: ClassVar[int] = 32
    batch: ClassVar[int] = 64
    sampling: ClassVar[float] = 0.85
    """Factor of the pupil samples that `SampledStamps` would choose."""
    pupil_samples: ClassVar[tuple[int, ...]] = (
        *(32, 40, 48, 56, 64, 72, 80, 88, 96, 108, 120, 132, 144, 158),
        *(190, 222, 254, 318, 398, 478, 574, 690, 830, 1000),
    )
    """Pupil grids, of which a wavefront uses the smallest one with enough samples."""

    @classmethod
    def from_model(cls, model: StampModel, noise: NoiseModel) -> Self:
        """Return the optics of a dataset's stamps with photon noise."""
        prior = SeidelPrior(model.mean, model.sd, model.field, model.telescope.pixel)
        framing = model.framing
        return cls(prior, model.telescope.obscuration, framing.stamp_px, noise, framing.jitter_px)

    @cached_property
    def _operator(self) -> SampledStamps:
        """Propagator of stamps and their derivatives."""
        return SampledStamps(
            self.obscuration,
            monomial_images,
            ImageSampling,
            self.stamp_px,
            self.prior.pixel,
            "complex64",
            self.pupil_samples,
            batch=32 * len(MONOMIALS),
        )

    def measure(
        self, point: np.ndarray, counts: np.ndarray, flux: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, Evaluation]:
        """Propagate the stamps of n wavefronts, and compare them with photons.

        Parameters
        ----------
        point : ndarray, shape (n, 8)
            Coefficients c⁰.
        counts : ndarray, shape (n, P)
            Photons in every pixel, sky included.
        flux : ndarray, shape (n,)
            Photons F of each star.

        Returns
        -------
        stamps, slopes : ndarray, shapes (n, P) and (n, 8, P)
            Stamps of sum 1, and their derivatives by c.
        likelihood : Evaluation
            −2 ln L(c⁰), g and M.
        """
        axes = np.broadcast_to(np.eye(len(MONOMIALS)), (len(point), *[len(MONOMIALS)] * 2))
        # The count of samples holds for the steepest slopes, which few rays have.
        samples = np.ceil(self.sampling * self._operator.samples(point)).astype(int)
        samples = choose_samples(samples, self.pupil_samples)
        raw = self._operator.derivatives(point, axes, samples=samples)
        stamps, slopes, _ = normalise_with_derivatives(*raw)
        stamps = stamps.reshape(len(point), -1).astype(np.float64)
        slopes = slopes.reshape(len(point), len(MONOMIALS), -1).astype(np.float64)
        # Poisson likelihood of the counts, of mean F p + B.
        mean_counts = flux[:, None] * stamps + self.noise.background
        likelihood = poisson_information(counts, mean_counts, flux[:, None, None] * slopes)
        return stamps, slopes, likelihood

    def expand(self, point: np.ndarray, counts: np.ndarray, flux: np.ndarray) -> Expansion:
        """Expand posteriors about wavefronts, in the most likely fields; see `measure`."""
        stamps, slopes, (deviance, score, information) = self.measure(point, counts, flux)
        fields = self.prior.select_fields(point, self.fields_kept)
        components = self.prior.condition(point, score, information, fields)
        return Expansion(point, stamps, slopes, deviance, components)

    def refine(self, noisy: np.ndarray, level: np.ndarray, starts: NetworkStarts) -> RefinedPsfs:
        """Return the posterior means of images (n, d, d) of levels (n,) about their wavefronts."""
        count, pixels = len(noisy), self.stamp_px**2
        flux = self.noise.flux(level)
        # Counts are whole numbers: rounding undoes the loss of the images' single precision.
        images = noisy.reshape(count, pixels).astype(np.float64)
        counts = np.rint(flux[:, None] * images) + self.noise.background
        psf, variance = np.zeros((2, count, pixels))
        results = RefinedPsfs(psf, variance, np.full(count, -np.inf))
        # Nearly the same images have wavefronts along an axis, between which no step leads.
        spread = self.proposals, self.min_weight, self.positions, self.width
        for first in range(0, count, self.batch):
            part = NetworkStarts(*(column[first : first + self.batch] for column in starts))
            star, point, precision = part.spread(*spread)
            star, point = self.begin(star + first, point, self.damping * precision, counts, flux)
            star, expansion = self.follow(star, point, counts, flux)
            results.put(*self.average(star, expansion))
        return results

    def begin(
        self,
        star: np.ndarray,
        point: np.ndarray,
        damping: np.ndarray,
        counts: np.ndarray,
        flux: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Make a first, damped step from each start, and select the wavefronts to refine.

        Parameters
        ----------
        star : ndarray of int, shape (n,)
            Stars of the starts.
        point, damping : ndarray, shapes (n, 8) and (n, 8, 8)
            Coefficients, and inverse covariances that limit a step.
        counts, flux : ndarray, shapes (N, P) and (N,)
            Photons of all stars; see `measure`.

        Returns
        -------
        star, point : ndarray, shapes (m,) and (m, 8)
            Stars and coefficients of distinct wavefronts, the best of a star first.
        """
        *_, (deviance, score, information) = self.measure(point, counts[star], flux[star])
        fields = self.prior.select_fields(point, self.fields_kept)
        components = self.prior.condition(point, score, information + damping, fields)
        # Integral of prior × likelihood × damping; steps lead to the largest component.
        evidence, point = components.evidence - 0.5 * deviance, point + components.mode
        order = np.lexsort((-evidence, star))
        star, evidence, point = star[order], evidence[order], point[order]
        # Near a better wavefront of the star no other one is needed, nor with much less evidence.
        is_used = self.find_distinct(star, point)
        is_used &= group_maximum(evidence, star) - evidence <= self.max_gap
        star, point = star[is_used], point[is_used]
        is_best = rank_in_group(star, np.arange(len(star))) < self.max_wavefronts
        return star[is_best], point[is_best]

    @staticmethod
    def average(star: np.ndarray, expansion: Expansion) -> tuple[np.ndarray, RefinedPsfs]:
        """Return the numbers (m,) of stars, and the posterior means of the results of `follow`."""
        # Means over the wavefronts of a star, with their posterior probabilities.
        stars, number = np.unique(star, return_inverse=True)
        evidence = np.full(len(stars), -np.inf)
        np.logaddexp.at(evidence, number, expansion.evidence)
        weight = np.exp(expansion.evidence - evidence[number])[:, None]
        mean, scatter = expansion.moments()
        psf, variance = np.zeros((2, len(stars), mean.shape[1]))
        np.add.at(psf, number, weight * mean)
        np.add.at(variance, number, weight * (scatter + (mean - psf[number]) ** 2))
        return stars, RefinedPsfs(psf, variance, evidence)

    def measure_misfit(self, posteriors: RefinedPsfs) -> np.ndarray:
        """Return scores (n,) that are large for stars that the telescope does not give.

        A score is −2 ln of the evidence, plus the square of the significance with which the
        brightest pixel is farther from the middle than a centring error.
        """
        # Brightest pixels among those that a star is centred on, and among the others.
        distance = np.abs(np.arange(self.stamp_px) - self.stamp_px // 2)
        is_middle = np.maximum.outer(distance, distance).ravel() <= self.jitter_px
        star = np.arange(len(posteriors.psf))
        central_pixel, distant_pixel = (
            (star, np.where(is_part, posteriors.psf, -np.inf).argmax(axis=1))
            for is_part in (is_middle, ~is_middle)
        )
        excess = posteriors.psf[distant_pixel] - posteriors.psf[central_pixel]
        variance = posteriors.variance[distant_pixel] + posteriors.variance[central_pixel]
        return np.asarray(np.maximum(excess, 0.0) ** 2 / variance - 2.0 * posteriors.evidence)

    @cached_property
    def root(self) -> np.ndarray:
        """Matrix R, (8, 8): |c R| is the RMS in waves of the wavefront of coefficients c."""
        # Covariances of the monomials over the pupil: piston changes no image.
        pupil = annular_pupil(64, self.obscuration)
        images = monomial_images(pupil.axis, pupil.axis[:, None]).reshape(len(MONOMIALS), -1)
        light = pupil.amplitude.ravel() / pupil.amplitude.sum()
        deviation = images - (images @ light)[:, None]
        return np.asarray(np.linalg.cholesky((light * deviation) @ deviation.T))

    def find_distinct(self, star: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Return False for wavefronts (n, 8) near an earlier one of the same star, shape (n,)."""
        coordinates, is_distinct = point @ self.root, np.ones(len(star), bool)
        for partner in list_partners(star):
            distance = np.linalg.norm(coordinates[partner] - coordinates, axis=1)
            is_distinct &= (partner >= np.arange(len(star))) | (distance > self.linear_waves)
        return is_distinct

    def follow(
        self,
        star: np.ndarray,
        point: np.ndarray,
        counts: np.ndarray,
        flux: np.ndarray,
    ) -> tuple[np.ndarray, Expansion]:
        """Expand posteriors about wavefronts, and where these expansions find other wavefronts.

        Parameters
        ----------
        star, point : ndarray, shapes (n,) and (n, 8)
            Results of `begin`.
        counts, flux : ndarray, shapes (N, P) and (N,)
            Photons of all stars; see `begin`.

        Returns
        -------
        star : ndarray of int, shape (m,)
            Stars of the expansions.
        expansion : Expansion
            Expansions with the components that belong to them.
        """
        stars, expansion = star, self.expand(point, counts[star], flux[star])
        for _ in range(2, self.max_steps):
            components, distance = self.assign(stars, expansion)
            # Mass of the components that are far from all expansion points.
            log_mass = components.log_mass - 0.5 * expansion.deviance[:, None]
            far_log_mass = np.where(distance > self.linear_waves, log_mass, -np.inf)
            log_total, log_far_total = np.full((2, len(counts)), -np.inf)
            np.logaddexp.at(log_total, stars, np.logaddexp.reduce(log_mass, axis=1))
            np.logaddexp.at(log_far_total, stars, np.logaddexp.reduce(far_log_mass, axis=1))
            # The next point of a star is the largest of them.
            largest = far_log_mass.max(axis=1)
            is_next = (largest == group_maximum(largest, stars)) & (largest > -np.inf)
            is_next &= log_far_total[stars] > log_total[stars] + np.log(self.min_far_mass)
            if not is_next.any():
                break
            rows, component = np.flatnonzero(is_next), far_log_mass[is_next].argmax(axis=1)
            point = expansion.point[rows] + expansion.components.shift[rows, component]
            star = stars[rows]
            new = self.expand(point, counts[star], flux[star])
            stars, expansion = np.concatenate([stars, star]), Expansion.join([expansion, new])
        components, _ = self.assign(stars, expansion)
        # Other points may have all components of an expansion.
        has_mass = np.isfinite(components.log_mass).any(axis=1)
        return stars[has_mass], replace(expansion, components=components).select(has_mass)

    def assign(self, star: np.ndarray, expansion: Expansion) -> tuple[Components, np.ndarray]:
        """Give every component to an expansion whose point is near its mean, and to no other.

        Returns
        -------
        components : Components
            Components of each expansion, of mass 0 where they belong to another one.
        distance : ndarray, shape (n, 4 f)
            Distance of the means from the own points, in waves.
        """
        components, half_deviance = expansion.components, 0.5 * expansion.deviance[:, None]
        shift, coordinates = components.shift, expansion.point @ self.root
        distance, log_mass = np.linalg.norm(shift @ self.root, axis=2), components.log_mass.copy()
        comparisons = []
        for partner in list_partners(star):
            # |δ + g|² < |δ|² for the gap g from the partner's point to the own one.
            gap = coordinates - coordinates[partner]
            excess = 2.0 * (shift @ (gap @ self.root.T)[:, :, None])[:, :, 0]
            comparisons.append((partner, excess < -np.square(gap).sum(axis=1, keepdims=True)))
        # Later expansions take all components that are nearer to them.
        for partner, is_nearer in comparisons:
            log_mass[is_nearer & (partner > np.arange(len(star)))[:, None]] = -np.inf
        # Earlier ones do where they have mass close to their points: no component is lost.
        close = np.where(distance < self.linear_waves, log_mass - half_deviance, -np.inf)
        limit = close.max(axis=1) + self.max_gap
        for partner, is_nearer in comparisons:
            is_given = log_mass - half_deviance < limit[partner, None]
            is_given &= (partner < np.arange(len(star)))[:, None]
            log_mass[is_nearer & is_given] = -np.inf
        return replace(components, log_mass=log_mass), distance


def list_partners(group: np.ndarray) -> Iterator[np.ndarray]:
    """Yield for each member (n,) the numbers of all other members of its group, one after another.

    A member of a smaller group is its own partner as soon as there are no others left.
    """
    order = np.argsort(group, kind="stable")
    _, first, number, size = np.unique(
        group[order], return_index=True, return_inverse=True, return_counts=True
    )
    first, size = first[number], size[number]
    rank = np.arange(len(group)) - first
    for step in range(1, size.max(initial=1)):
        partner = np.empty(len(group), int)
        partner[order] = order[first + (rank + np.where(step < size, step, 0)) % size]
        yield partner


@dataclass(frozen=True)
class Combination:
    """Weights of refined PSFs in their means with the PSFs of a network, by noise level.

    The weight of a star is w = 1 / (1 + exp(−k·x)) with x = (1, ln(V_n/V_r), ln(Δ²/V_n)): V_n and
    V_r are the variances of network and refined wavefront, and Δ is the difference of both PSFs.

    Attributes
    ----------
    levels : ndarray, shape (L,)
        Noise levels λ, ascending.
    factors : ndarray, shape (L, 3)
        Factors k at each level.
    sigma_scale, sigma_ratio95 : ndarray, shape (L,)
        Factor of the standard deviations at each level, and how many of them contain 95 % of the
        errors.
    """

    levels: np.ndarray
    factors: np.ndarray
    sigma_scale: np.ndarray
    sigma_ratio95: np.ndarray

    @classmethod
    def fit(
        cls, level: np.ndarray, starts: NetworkStarts, posteriors: RefinedPsfs, truth: np.ndarray
    ) -> Combination:
        """Minimise the mean squared error of stars at each of their levels, and calibrate σ.

        Parameters
        ----------
        level : ndarray, shape (n,)
            Noise level of each star.
        starts, posteriors : NetworkStarts, RefinedPsfs
            Their estimates by the network and by the optics.
        truth : ndarray, shape (n, P)
            Noise-free stamps.
        """
        from scipy.optimize import minimize

        # |m + w (r − m) − p|² = |m − p|² − 2 w (r − m)·(p − m) + w² |r − m|².
        change = posteriors.psf - starts.psf
        projection = (change * (truth - starts.psf)).sum(axis=1)
        square = (change**2).sum(axis=1)
        levels, features, factors = np.unique(level), cls.describe(starts, posteriors), []
        for value in levels:
            rows = np.flatnonzero(level == value)

            def loss(k: np.ndarray, rows: np.ndarray = rows) -> float:
                weight = compute_sigmoid(features[rows] @ k)
                gain = 2.0 * weight * projection[rows] - weight**2 * square[rows]
                # Factors of stars that differ little from each other stay finite.
                return float(-gain.mean() / square[rows].mean() + 1e-4 * (k @ k))

            start = np.array([0.0, 1.0, -1.0])
            factors.append(minimize(loss, start, method="Nelder-Mead").x)
        weights = cls(levels, np.array(factors), *np.ones((2, len(levels))))
        # The factors of σ by which it holds 68 % and 95 % of the errors.
        psf, sigma = weights.combine(level, starts, posteriors)
        ratio = np.abs(psf - truth) / sigma
        scale68, scale95 = np.array(
            [np.quantile(ratio[level == value], [0.682689, 0.95]) for value in levels]
        ).T
        return replace(weights, sigma_scale=scale68, sigma_ratio95=scale95 / scale68)

    @staticmethod
    def describe(starts: NetworkStarts, posteriors: RefinedPsfs) -> np.ndarray:
        """Return the variables x (n, 3) of the weights."""
        network_variance, refined_variance, difference = (
            np.maximum(values.mean(axis=1), np.finfo(float).tiny)
            for values in (
                starts.variance,
                posteriors.variance,
                (posteriors.psf - starts.psf) ** 2,
            )
        )
        ratios = network_variance / refined_variance, difference / network_variance
        return np.stack([np.ones(len(difference)), *np.log(ratios)], axis=1)

    def combine(
        self, level: np.ndarray, starts: NetworkStarts, posteriors: RefinedPsfs
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the means of both PSFs (n, P) at levels (n,), and their standard deviations."""
        # Values between levels are interpolated in ln λ.
        columns = np.column_stack([self.factors, self.sigma_scale]).T
        values = [np.interp(np.log(level), np.log(self.levels), column) for column in columns]
        *factors, scale = values
        features = self.describe(starts, posteriors)
        weight = compute_sigmoid((features * np.stack(factors, axis=1)).sum(axis=1))[:, None]
        change = posteriors.psf - starts.psf
        # Variance of a mixture of both, with the square of their difference.
        variance = (1.0 - weight) * starts.variance
        variance += weight * (posteriors.variance + (1.0 - weight) * change**2)
        return starts.psf + weight * change, scale[:, None] * np.sqrt(variance)


def compute_sigmoid(x: np.ndarray) -> np.ndarray:
    """Return 1 / (1 + exp(−x))."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * x)))
