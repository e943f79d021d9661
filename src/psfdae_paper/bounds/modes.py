"""Modes of stars' posteriors: their places, widths and masses, and draws around them.

In go places from which modes are sought, or the modes that a search has found; out come distinct
modes of noticeable mass, and draws of places from Student's t around them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import ClassVar, NamedTuple

import numpy as np

from psfdae.sensing.climbing import group_maximum
from psfdae_paper.bounds.mixture import Mixture


class Knowledge(IntEnum):
    """Knowledge about a star that a search for modes uses; each includes those before."""

    NONE = 0
    FIELD = 1
    TRUTH = 2


class Place(NamedTuple):
    """Places of n draws: field (n,), offset (n, 2) in pixels, standardised coefficients (n, 5)."""

    field: np.ndarray
    offset: np.ndarray
    z: np.ndarray


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
    max_drop : float
        Distance of a mode's evidence below a star's best from which on it is left out. The evidence
        is that of a Gaussian, which errs by much along a bent ridge of the posterior: a nearer
        limit leaves out modes that the draws then find to hold the mass.
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
    def at(
        cls,
        star: np.ndarray,
        field: np.ndarray,
        offset: np.ndarray,
        knowledge: np.ndarray,
        z: np.ndarray,
    ) -> Modes:
        """Make places from which modes are sought, with unit scales and no evidence yet."""
        # A climb replaces these unit scales by the inverse of the information.
        scales = np.tile(np.eye(z.shape[1]), (len(z), 1, 1))
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
        # Fields and offsets are discrete: a mode proposes draws of its own place alone.
        is_own = self.field[:, None] == field
        is_own &= (self.offset[:, None] == offset).all(axis=2)
        return np.where(is_own, 0.0, -np.inf)

    def adapted(self, draws: Place, log_weight: np.ndarray) -> Modes:
        """Adapt places, scales and masses to the weights (n,) of all draws of the star."""
        # A mode adapts to the draws in its own field and at its own offset.
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
        # Number of the mode of each draw; modes follow one another.
        mode = np.repeat(np.arange(share.size), number)
        return Place(self.field[mode], self.offset[mode], self.mixture.draw(mode, rng)), number


def largest_of_groups(group: np.ndarray, value: np.ndarray, count: int) -> np.ndarray:
    """Return the numbers of the `count` members of every group that have the largest values."""
    # Sorted by group, the largest first; then the rank of each member within its group.
    order = np.lexsort((-value, group))
    _, first, number = np.unique(group[order], return_index=True, return_counts=True)
    return order[np.arange(order.size) - np.repeat(first, number) < count]


def separate(modes: Modes) -> Modes:
    """Return the modes that have noticeable mass, each once.

    Of modes of a star in the same field and offset that are less than one of their standard
    deviations apart, the best is kept. It is known by the least knowledge that led to any of them.
    """
    # Best log-mass of each star, by the knowledge that led to it.
    best_evidence = group_maximum(modes.evidence, modes.group)
    noticeable = np.flatnonzero(modes.evidence > best_evidence - modes.max_drop)
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
