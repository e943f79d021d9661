"""Draws around modes: weighed ones of few parameters, and Markov chains of many.

Few: mixtures of Student's t that adapt to what their own draws weigh (Cappé et al. 2008,
Statistics and Computing 18, 447): every mode takes their mean, scale and mass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import lgamma
from typing import NamedTuple

import numpy as np

from psfdae.progress import steps

FREEDOM = 5.0
"""Degrees of freedom of Student's t; its tails are heavier than any normal posterior's."""

PRIOR_DRAWS = 10.0
"""Effective draws of a mode that change its place and scale half way to theirs."""

TINY = np.finfo(float).tiny


@dataclass(frozen=True)
class Mixture:
    """Student's t around modes.

    Attributes
    ----------
    mean : ndarray, shape (M, D)
    factor : ndarray, shape (M, D, D)
        Lower Cholesky factor of each scale matrix.
    evidence : ndarray, shape (M,)
        Logarithm of each mode's mass.
    """

    mean: np.ndarray
    factor: np.ndarray
    evidence: np.ndarray

    def distance(self, draws: np.ndarray) -> np.ndarray:
        """Squared distance of draws (n, D) from every mode in scale matrices, shape (M, n)."""
        apart = np.linalg.solve(self.factor, (draws - self.mean[:, None]).swapaxes(1, 2))
        return np.asarray((apart**2).sum(axis=1))

    def log_density(self, distance: np.ndarray) -> np.ndarray:
        """Log-density around every mode at squared distances (M, n)."""
        terms = self.mean.shape[1]
        width = np.log(np.diagonal(self.factor, axis1=1, axis2=2)).sum(axis=1)
        constant = lgamma(0.5 * (FREEDOM + terms)) - lgamma(0.5 * FREEDOM)
        constant -= 0.5 * terms * np.log(FREEDOM * np.pi)
        bend = np.log1p(distance / FREEDOM)
        return np.asarray(constant - width[:, None] - 0.5 * (FREEDOM + terms) * bend)

    def draws(self, mode: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """A draw around each of the modes `mode` (n,), shape (n, D)."""
        normal = rng.standard_normal((mode.size, self.mean.shape[1]))
        tail = np.sqrt(FREEDOM / rng.chisquare(FREEDOM, mode.size))
        moved = (self.factor[mode] @ (normal * tail[:, None])[:, :, None])[:, :, 0]
        return np.asarray(self.mean[mode] + moved)

    def adapted(
        self, draws: np.ndarray, log_weight: np.ndarray, log_elsewhere: np.ndarray | float = 0.0
    ) -> Mixture:
        """Places, scales and masses by what draws (n, D) weigh; as it is if none was possible.

        `log_elsewhere` (M, n) is −∞ for draws that a mode cannot have made.
        """
        if not np.isfinite(log_weight).any():
            return self
        distance, terms = self.distance(draws), self.mean.shape[1]
        log_part = self.log_density(distance) + log_elsewhere + self.evidence[:, None]
        weight = np.exp(log_weight - log_weight.max())
        with np.errstate(invalid="ignore"):
            share = np.exp(log_part - np.logaddexp.reduce(log_part, axis=0))
        share = np.where(np.isfinite(share), share, 0.0) * weight
        mass = share.sum(axis=1)
        known = mass**2 / np.maximum((share**2).sum(axis=1), TINY)
        pull = (known / (known + PRIOR_DRAWS))[:, None]
        share *= (FREEDOM + terms) / (FREEDOM + distance)
        share /= np.maximum(share.sum(axis=1, keepdims=True), TINY)
        mean = self.mean + pull * (share @ draws - self.mean * share.sum(axis=1, keepdims=True))
        apart = draws - mean[:, None]
        scale = (share[:, :, None] * apart).swapaxes(1, 2) @ apart
        pull = pull[..., None]
        scale = pull * scale + (1.0 - pull) * (self.factor @ self.factor.swapaxes(1, 2))
        evidence = np.log(np.maximum(mass, TINY))
        return Mixture(mean, np.linalg.cholesky(scale), evidence)


class Chains(NamedTuple):
    """Markov chains of every posterior."""

    number: int = 4
    steps: int = 1200
    burn_in: int = 120
    """Steps in which the strides are adapted, and that do not count."""
    kept: int = 300
    """Draws of a posterior that are returned, evenly spaced."""
    wanted: float = 0.35
    """Part of the strides that should be taken."""
    wider: float = 1.3
    """Scale of the normal that a chain refers to, in that of its mode."""


CHAINS = Chains()

Height = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function of posteriors' numbers (m,) and parameters (m, D): their logarithms, (m,)."""

Twin = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""The same, to the parameters (m, D) that have the same likelihood, and the gain (m,) in the
logarithm of the posterior; the twin's twin is where one started."""


def sample_around(
    height: Height,
    twin: Twin,
    owner: np.ndarray,
    modes: Mixture,
    rngs: Sequence[np.random.Generator],
) -> np.ndarray:
    """Draws from posteriors around their modes, by Markov chains side by side.

    A stride mixes the place with a draw from the normal of the chain's mode (Neal 1999, Bayesian
    Statistics 6, 475), and is taken by the ratio of posterior to normal there and here: where the
    posterior is nearly normal, every stride is a new draw. A draw or its twin is kept, by their
    probabilities.

    Parameters
    ----------
    height : Height
    twin : Twin
    owner : ndarray of int, shape (M,)
        Posterior of every mode, 0 to n − 1, ascending.
    modes : Mixture
        `factor` are Cholesky factors of the covariance.
    rngs : sequence of n Generators

    Returns
    -------
    ndarray, shape (n, `CHAINS.kept`, D)
    """
    posteriors, size = len(rngs), CHAINS.number
    start = np.searchsorted(owner, np.arange(posteriors + 1))
    mass = np.exp(modes.evidence - np.maximum.reduceat(modes.evidence, start[:-1])[owner])
    mode = np.concatenate(
        [
            a + rng.choice(b - a, size, p=mass[a:b] / mass[a:b].sum())
            for a, b, rng in zip(start, start[1:], rngs, strict=False)
        ]
    )
    whose = np.repeat(np.arange(posteriors), size)
    mean, factor = modes.mean[mode], CHAINS.wider * modes.factor[mode]

    def drawn(shape: tuple[int, ...]) -> np.ndarray:
        return np.concatenate([rng.standard_normal((size, *shape)) for rng in rngs])

    def moved(normal: np.ndarray) -> np.ndarray:
        return np.asarray((factor @ normal[:, :, None])[:, :, 0])

    # Places in scales of the normal: a chain begins at a draw from its mode.
    place = drawn(mean.shape[1:]) / CHAINS.wider
    tall = height(whose, mean + moved(place))
    stride = np.ones(posteriors)
    kept = []
    for step in steps("draws", range(CHAINS.steps)):
        part = stride[whose][:, None]
        trial = np.sqrt(1.0 - part**2) * place + part * drawn(mean.shape[1:])
        new = height(whose, mean + moved(trial))
        gain = new - tall + 0.5 * ((trial**2).sum(axis=1) - (place**2).sum(axis=1))
        taken = np.log(drawn_uniform(rngs, size)) < gain
        place, tall = np.where(taken[:, None], trial, place), np.where(taken, new, tall)
        if step < CHAINS.burn_in:
            share = taken.reshape(posteriors, size).mean(axis=1)
            stride = np.clip(stride * np.exp(0.3 * (share - CHAINS.wanted)), 0.02, 1.0)
            continue
        here = mean + moved(place)
        there, gain = twin(whose, here)
        chance = 1.0 / (1.0 + np.exp(-np.clip(gain, -500.0, 500.0)))
        kept.append(np.where((drawn_uniform(rngs, size) < chance)[:, None], there, here))
    every = np.array(kept).reshape(len(kept), posteriors, size, -1).swapaxes(0, 1)
    flat = every.reshape(posteriors, -1, every.shape[-1])
    return flat[:, np.linspace(0, flat.shape[1] - 1, CHAINS.kept).astype(int)]


def drawn_uniform(rngs: Sequence[np.random.Generator], count: int) -> np.ndarray:
    """Uniform numbers, `count` of each generator, above 0."""
    return np.concatenate([1.0 - rng.random(count) for rng in rngs])
