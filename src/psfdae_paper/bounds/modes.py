"""Modes of stars' posteriors: their positions, widths and masses, and draws around them.

The input is the starting points of a search, or the modes that it has found; the output is distinct
modes of noticeable mass, and draws from Student's t distributions around them. These adapt to the
weights of their draws (Cappé et al. 2008, Statistics and Computing 18, 447): every mode takes the
weighted mean, scale and mass of its draws.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from math import lgamma
from typing import ClassVar

import numpy as np

from psfdae.base.rows import Rows
from psfdae.sensing.climbing import group_maximum
from psfdae.sensing.modes import merge_modes


class Knowledge(IntEnum):
    """Knowledge about a star that a search for modes uses; each includes those before."""

    NONE = 0
    FIELD = 1
    TRUTH = 2


@dataclass(frozen=True)
class Positions(Rows):
    """Positions of n draws: field (n,), offset (n, 2) in pixels, coefficients z (n, 5)."""

    field: np.ndarray
    offset: np.ndarray
    z: np.ndarray


@dataclass(frozen=True)
class Modes(Rows):
    """The M modes of stars' posteriors, or starting points (f, o, z) of a search for modes.

    Attributes
    ----------
    star, field : ndarray of int, shape (M,)
        Number of the star, and its field in this mode.
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
    max_drop : float
        Modes whose evidence is lower than a star's maximum by more than this are left out. The
        evidence assumes a Gaussian, a poor approximation along a bent ridge of the posterior: a
        smaller limit would leave out modes that have much mass.
    freedom : float
        Degrees of freedom ν of Student's t, whose tails are heavier than the tails of any normal
        posterior.
    """

    star: np.ndarray
    field: np.ndarray
    offset: np.ndarray
    knowledge: np.ndarray
    z: np.ndarray
    factor: np.ndarray
    evidence: np.ndarray
    max_drop: ClassVar[float] = 50.0
    freedom: ClassVar[float] = 5.0

    @classmethod
    def make_starts(
        cls,
        star: np.ndarray,
        field: np.ndarray,
        offset: np.ndarray,
        knowledge: np.ndarray,
        z: np.ndarray,
    ) -> Modes:
        """Return starting points of a search for modes, with unit scales and evidence 0."""
        # A climb replaces these unit scales by the inverse of the information.
        scales = np.tile(np.eye(z.shape[1]), (len(z), 1, 1))
        return cls(star, field, offset, knowledge, z, scales, np.zeros(len(z)))

    @property
    def group(self) -> np.ndarray:
        """Group number of each mode by star and knowledge, (M,)."""
        return np.asarray(len(Knowledge) * self.star + self.knowledge)

    def compute_squared_distance(self, z: np.ndarray) -> np.ndarray:
        """Return (x − μ)ᵀ (LLᵀ)⁻¹ (x − μ) of draws x (n, 5) from every mode, shape (M, n)."""
        # With L u = x − μ the squared distance is |u|².
        offset = np.linalg.solve(self.factor, (z - self.z[:, None]).swapaxes(1, 2))
        return np.asarray((offset**2).sum(axis=1))

    def log_density(self, draws: Positions, squared_distance: np.ndarray) -> np.ndarray:
        """Return the log-density of Student's t around every mode at draws, (M, n).

        With ν degrees of freedom in D dimensions, ln p = ln Γ((ν + D)/2) − ln Γ(ν/2)
        − (D/2) ln(νπ) − ln |L| − (ν + D)/2 ln(1 + distance²/ν).
        """
        terms = self.z.shape[1]
        # ln |L| of a triangular matrix is the sum over its diagonal.
        log_determinant = np.log(np.diagonal(self.factor, axis1=1, axis2=2)).sum(axis=1)
        constant = lgamma(0.5 * (self.freedom + terms)) - lgamma(0.5 * self.freedom)
        constant -= 0.5 * terms * np.log(self.freedom * np.pi)
        tail = 0.5 * (self.freedom + terms) * np.log1p(squared_distance / self.freedom)
        # Fields and offsets are discrete: a mode proposes draws at its own field and offset only.
        is_own = self.field[:, None] == draws.field
        is_own &= (self.offset[:, None] == draws.offset).all(axis=2)
        return np.where(is_own, constant - log_determinant[:, None] - tail, -np.inf)

    def adapt(self, draws: Positions, log_weight: np.ndarray) -> Modes:
        """Adapt positions, scales and masses to the weights (n,) of all draws of the star.

        One step of expectation maximisation for Student's t. The modes are returned unchanged if
        all draws are impossible.
        """
        if not np.isfinite(log_weight).any():
            return self
        smallest = np.finfo(float).tiny
        squared_distance, terms = self.compute_squared_distance(draws.z), self.z.shape[1]
        # Responsibility of each mode for each draw, times the weight of the draw.
        log_part = self.log_density(draws, squared_distance) + self.evidence[:, None]
        weight = np.exp(log_weight - log_weight.max())
        with np.errstate(invalid="ignore"):
            share = np.exp(log_part - np.logaddexp.reduce(log_part, axis=0))
        share = np.where(np.isfinite(share), share, 0.0) * weight
        mass = share.sum(axis=1)
        # Shrinkage towards the previous mode: 10 effective draws, (Σw)²/Σw², move it half way to
        # the estimate from the draws.
        effective = mass**2 / np.maximum((share**2).sum(axis=1), smallest)
        gain = (effective / (effective + 10.0))[:, None]
        # Distant draws weigh (ν + D)/(ν + distance²), as in the maximum-likelihood fit of t.
        share *= (self.freedom + terms) / (self.freedom + squared_distance)
        share /= np.maximum(share.sum(axis=1, keepdims=True), smallest)
        # Weighted mean and scale matrix of the draws, as far as they are trusted.
        mean = self.z + gain * (share @ draws.z - self.z * share.sum(axis=1, keepdims=True))
        offset = draws.z - mean[:, None]
        scale = (share[:, :, None] * offset).swapaxes(1, 2) @ offset
        gain = gain[..., None]
        scale = gain * scale + (1.0 - gain) * (self.factor @ self.factor.swapaxes(1, 2))
        evidence = np.log(np.maximum(mass, smallest))
        return replace(self, z=mean, factor=np.linalg.cholesky(scale), evidence=evidence)

    def draw(
        self, count: int, star_field: int, rng: np.random.Generator
    ) -> tuple[Positions, np.ndarray]:
        """Draw about `count` positions around one star's modes.

        Parameters
        ----------
        count : int
            Number of draws, rounded up in every mode.
        star_field : int
            The star's true field.
        rng : Generator
            Random generator of the star.

        Returns
        -------
        positions : Positions
            Fields, offsets and coefficients of the draws.
        number : ndarray of int, shape (M,)
            Number of draws from each mode.
        """
        # 90 % in proportion to the modes' masses, 10 % in equal shares: masses are estimates.
        share = np.exp(self.evidence - self.evidence.max())
        share = 0.9 * share / share.sum() + 0.1 / share.size
        # At least a quarter in the star's own field: if the field is known, only these are used.
        in_field = self.field == star_field
        shortage = 0.25 - share[in_field].sum()
        # All shares shrink by the shortage, which is given to the modes in the field.
        if shortage > 0 and in_field.any():
            mass = np.exp(self.evidence[in_field] - self.evidence[in_field].max()) + 0.1
            share *= 1.0 - shortage
            share[in_field] += shortage * mass / mass.sum()
        # Rounded up, so that every mode has a draw, whose weight may show that its mass is larger.
        number = np.ceil(share * count).astype(int)
        # Number of the mode of each draw; modes follow one another.
        mode = np.repeat(np.arange(share.size), number)
        # Student's t is a normal variable times √(ν/χ²).
        normal = rng.standard_normal((mode.size, self.z.shape[1]))
        stretch = np.sqrt(self.freedom / rng.chisquare(self.freedom, mode.size))
        z = self.z[mode] + (self.factor[mode] @ (normal * stretch[:, None])[:, :, None])[:, :, 0]
        return Positions(self.field[mode], self.offset[mode], z), number


def rank_in_group(group: np.ndarray, key: np.ndarray) -> np.ndarray:
    """Return the rank of each member among its group in ascending order of a key, all (M,)."""
    # Sorted by group, then by key; the rank is the distance from the group's first member.
    order = np.lexsort((key, group))
    _, first, number = np.unique(group[order], return_index=True, return_counts=True)
    rank = np.empty(order.size, int)
    rank[order] = np.arange(order.size) - np.repeat(first, number)
    return rank


def select_largest(group: np.ndarray, value: np.ndarray, count: int) -> np.ndarray:
    """Return the numbers of the `count` members of every group that have the largest values."""
    # Sorted by group, the largest first.
    order = np.lexsort((-value, group))
    return order[rank_in_group(group, -value)[order] < count]


def separate(modes: Modes) -> Modes:
    """Return the modes that have noticeable mass, each once.

    Modes of a star in the same field and at the same offset that are less than one standard
    deviation apart are merged: the best is kept, with the least knowledge of any of them.
    """
    # Best log-mass of each star, by the knowledge that led to it.
    best_evidence = group_maximum(modes.evidence, modes.group)
    modes = modes.select(modes.evidence > best_evidence - modes.max_drop)
    # Only modes of a star in the same field and at the same offset can be the same.
    cell = np.column_stack([modes.star, modes.field, modes.offset])
    cell_number = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    covariance = modes.factor @ modes.factor.swapaxes(1, 2)
    maximum = merge_modes(modes.z, covariance, modes.evidence, cell_number)
    knowledge = modes.knowledge.copy()
    np.minimum.at(knowledge, maximum, modes.knowledge)
    return replace(modes, knowledge=knowledge).select(np.unique(maximum))
