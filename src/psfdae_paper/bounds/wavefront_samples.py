"""Posterior means of stars over importance samples about their refined wavefronts.

About a refined wavefront, a stamp is linear in the coefficients, and the posterior a mixture of
Gaussians of the standardised coefficients z over fields and offsets (`refinement`). Where noise is
high, the posterior is wider than both hold for. Draws of the mixture, with the tails of Student's
t, have exact stamps p_i and weights

    w_i = prior × likelihood / density of the mixture,

and the posterior mean is Σ w_i p_i / Σ w_i. Draws whose brightest pixel the simulator would not
frame at their offset have weight 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple, Self

import numpy as np

from psfdae.base.rng import stream
from psfdae.sensing.climbing import poisson_deviance
from psfdae.stars.noise import NoiseModel
from psfdae_paper.bounds.modes import log_student_density, rank_in_group
from psfdae_paper.bounds.refinement import Expansion, RefinedPsfs, Refiner
from psfdae_paper.bounds.stamp_model import StampModel
from psfdae_paper.stars.framing import normalise_flux


class WavefrontDraws(NamedTuple):
    """D draws of each of n stars.

    Attributes
    ----------
    z : ndarray, shape (n, D, 5)
        Standardised Seidel coefficients.
    point : ndarray, shape (n, D, 8)
        Coefficients of the pupil monomials.
    log_density : ndarray, shape (n, D)
        Logarithm of the density from which they are drawn.
    """

    z: np.ndarray
    point: np.ndarray
    log_density: np.ndarray


@dataclass(frozen=True)
class WavefrontSampler(Refiner):
    """Optics of a telescope that average stamps over samples of refined wavefronts.

    Attributes
    ----------
    jitter_px : int
        Largest centring error in pixels per axis.
    tie : float
        Relative difference up to which pixels are equally bright; the first of them is framed.
    samples : int
        Draws of each star.
    min_effective : float
        Effective sample size below which a star keeps its linear mean.
    freedom : float
        Degrees of freedom of Student's t.
    """

    jitter_px: int
    tie: float
    samples: ClassVar[int] = 32
    min_effective: ClassVar[float] = 4.0
    freedom: ClassVar[float] = 5.0

    @classmethod
    def from_model(cls, model: StampModel, noise: NoiseModel, seed: int) -> Self:
        """Return the sampler of a dataset's stamps with photon noise."""
        optics, framing = vars(Refiner.from_model(model, noise, seed)), model.framing
        return cls(**optics, jitter_px=framing.jitter_px, tie=framing.tie)

    @cached_property
    def deviates(self) -> tuple[np.ndarray, np.ndarray]:
        """Numbers u (D,) from 0 to 1 that select a component, and deviates (D, 5) from its mean.

        All stars have the same numbers, of a Sobol sequence: they fill the space more evenly than
        independent draws, and the result of a star does not depend on the others.
        """
        from scipy.special import chdtri, ndtri
        from scipy.stats import qmc

        terms, rng = len(self.prior.mean), stream(self.seed, "wavefront samples")
        numbers = qmc.Sobol(terms + 2, rng=rng).random(self.samples)
        # Student's t is a normal variable times √(ν/χ²).
        normal = ndtri(numbers[:, 1:-1])
        stretch = np.sqrt(self.freedom / chdtri(self.freedom, numbers[:, -1]))
        return numbers[:, 0], normal * stretch[:, None]

    def average(
        self, star: np.ndarray, expansion: Expansion, counts: np.ndarray, flux: np.ndarray
    ) -> tuple[np.ndarray, RefinedPsfs]:
        """Return the numbers (m,) of stars, and their posterior means over samples."""
        stars, linear = super().average(star, expansion, counts, flux)
        draws = self.draw(np.searchsorted(stars, star), expansion)
        # Draws beyond the limit of |z| cannot be propagated; they have weight 0.
        is_possible = (np.abs(draws.z) <= self.prior.max_abs_z).all(axis=2)
        point = np.where(is_possible[..., None], draws.point, 0.0)
        stamps = normalise_flux(self._operator.stamps(point.reshape(-1, point.shape[2])))[0]
        stamps = stamps.reshape(*is_possible.shape, -1).astype(np.float64)
        is_possible &= self.is_framed(stamps)
        # ln w = ln likelihood + ln prior − ln density.
        mean_counts = flux[stars, None, None] * stamps + self.noise.background
        deviance, _ = poisson_deviance(counts[stars, None], mean_counts)
        square, terms = np.square(draws.z).sum(axis=2), draws.z.shape[2]
        log_weight = -0.5 * (deviance + square + terms * np.log(2.0 * np.pi)) - draws.log_density
        log_weight[~is_possible] = -np.inf
        # Stars with enough samples; the others keep their linear means.
        scale = log_weight.max(axis=1, keepdims=True)
        weight = np.exp(log_weight - np.where(np.isfinite(scale), scale, 0.0))
        total = weight.sum(axis=1)
        is_sampled = total**2 >= self.min_effective * np.square(weight).sum(axis=1)
        is_sampled &= total > 0.0
        weight, stamps = (weight[is_sampled] / total[is_sampled, None])[:, None], stamps[is_sampled]
        # Means Σ w p / Σ w and variances of the stamps; the evidence is the mean weight.
        psf = weight @ stamps
        variance = weight @ np.square(stamps - psf)
        evidence = scale[is_sampled, 0] + np.log(total[is_sampled] / self.samples)
        linear.put(np.flatnonzero(is_sampled), RefinedPsfs(psf[:, 0], variance[:, 0], evidence))
        return stars, linear

    def is_framed(self, stamps: np.ndarray) -> np.ndarray:
        """Return True for stamps (..., P) that the simulator may frame as they are, (...,)."""
        # It frames the first of the brightest pixels with a limited centring error.
        threshold = (1.0 - self.tie) * stamps.max(axis=-1, keepdims=True)
        pixel = np.divmod((stamps >= threshold).argmax(axis=-1), self.stamp_px)
        error = np.stack(pixel) - self.stamp_px // 2
        return np.asarray((np.abs(error) <= self.jitter_px).all(axis=0))

    def draw(self, star: np.ndarray, expansion: Expansion) -> WavefrontDraws:
        """Draw from the mixtures of stars.

        Parameters
        ----------
        star : ndarray of int, shape (m,)
            Star of each expansion, from 0 to n − 1.
        expansion : Expansion
            m expansions with the components that belong to them.
        """
        components, (count, size) = expansion.components, expansion.log_mass.shape
        mean = components.z.reshape(count, size, -1)
        factor = np.linalg.cholesky(components.covariance)
        # Expansions of each star, −1 where it has fewer, and the share of each component.
        rank = rank_in_group(star, np.arange(count))
        rows = np.full((star.max() + 1, rank.max() + 1), -1)
        rows[star, rank] = np.arange(count)
        log_mass = np.where(rows[..., None] >= 0, expansion.log_mass[rows], -np.inf)
        log_mass -= np.logaddexp.reduce(log_mass, axis=(1, 2), keepdims=True)
        # Component of each draw, by the cumulative shares; a star's begin at its own number.
        select, deviates = self.deviates
        first = np.arange(len(rows))[:, None]
        shares = np.cumsum(np.exp(log_mass).reshape(len(rows), -1), axis=1)
        shares = first + shares / shares[:, -1:]
        index = np.searchsorted(shares.ravel(), first + select, side="right")
        column, component = np.divmod(index - first * shares.shape[1], size)
        row, field = rows[first, column], component // 4
        # z = ⟨z⟩ + L u, and its coefficients.
        z = mean[row, component] + (factor[row, field] @ deviates[..., None])[..., 0]
        gap = components.gap.reshape(count, size, -1)[row, component]
        shift = gap + (z[..., None, :] @ components.directions[row, field])[..., 0, :]
        # The density is the sum over a star's components of the draw's field and offset.
        offset = self.count_offsets(expansion)
        drawn_field, drawn_offset = expansion.fields[row, field], offset[row, component]
        log_density = []
        for number in range(rows.shape[1]):
            other = rows[:, number, None]
            is_same_field = expansion.fields[other] == drawn_field[..., None]
            same_field = is_same_field.argmax(axis=2)
            offsets = 4 * same_field[..., None] + np.arange(4)
            is_same = (offset[other[..., None], offsets] == drawn_offset[..., None, :]).all(axis=3)
            same = 4 * same_field + is_same.argmax(axis=2)
            is_present = is_same_field.any(axis=2) & is_same.any(axis=2) & (other >= 0)
            root = factor[other, same_field]
            deviation = np.linalg.solve(root, (z - mean[other, same])[..., None])
            distance, diagonal = np.square(deviation).sum((2, 3)), np.diagonal(root, 0, 2, 3)
            log_determinant = np.log(diagonal).sum(axis=2)
            log_part = log_student_density(distance, log_determinant, z.shape[2], self.freedom)
            log_share = log_mass[first, number, same]
            log_density.append(np.where(is_present, log_share + log_part, -np.inf))
        total = np.logaddexp.reduce(log_density, axis=0)
        return WavefrontDraws(z, expansion.point[row] + shift, total)

    def count_offsets(self, expansion: Expansion) -> np.ndarray:
        """Return the offsets of the stamps along x and y in pixels, (m, 4 f, 2) of integers."""
        gap, tilts = expansion.components.gap, slice(-2, None)
        # The tilts of z = 0 differ from the chief ray's by whole pixels.
        tilt = expansion.point[:, None, None, tilts] + gap[..., tilts]
        tilt = tilt - self.prior.static[expansion.fields][:, :, None, tilts]
        pixels = np.rint(tilt / (0.5 * self.prior.pixel)).astype(int)
        return np.asarray(pixels.reshape(len(gap), -1, 2))
