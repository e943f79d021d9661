"""Modes of stars' posteriors: their positions, widths and masses, and draws around them.

The input is the starting points of a search, or the modes that it has found; the output is distinct
modes of noticeable mass, and draws from Student's t distributions around them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import ClassVar

import numpy as np

from psfdae.base.rows import Rows
from psfdae.sensing.climbing import group_maximum
from psfdae.sensing.modes import merge_modes
from psfdae_paper.bounds.mixture import Mixture


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
    """

    star: np.ndarray
    field: np.ndarray
    offset: np.ndarray
    knowledge: np.ndarray
    z: np.ndarray
    factor: np.ndarray
    evidence: np.ndarray
    max_drop: ClassVar[float] = 50.0

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

    @property
    def mixture(self) -> Mixture:
        """Student's t around the modes."""
        return Mixture(self.z, self.factor, self.evidence)

    def log_density(self, z: np.ndarray, field: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return the log-density of Student's t around every mode at draws (n, 5), (M, n)."""
        mixture = self.mixture
        density = mixture.log_density(mixture.compute_squared_distance(z))
        return np.asarray(density + self._log_support(field, offset))

    def _log_support(self, field: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return 0 for draws in a mode's own field and offset, otherwise −∞, shape (M, n)."""
        # Fields and offsets are discrete: a mode proposes draws at its own field and offset only.
        is_own = self.field[:, None] == field
        is_own &= (self.offset[:, None] == offset).all(axis=2)
        return np.where(is_own, 0.0, -np.inf)

    def adapt(self, draws: Positions, log_weight: np.ndarray) -> Modes:
        """Adapt positions, scales and masses to the weights (n,) of all draws of the star."""
        # A mode adapts to the draws in its own field and at its own offset.
        log_support = self._log_support(draws.field, draws.offset)
        mixture = self.mixture.adapt(draws.z, log_weight, log_support)
        return replace(self, z=mixture.mean, factor=mixture.factor, evidence=mixture.evidence)

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
        return Positions(self.field[mode], self.offset[mode], self.mixture.draw(mode, rng)), number


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
