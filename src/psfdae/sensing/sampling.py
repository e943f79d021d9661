"""Random draws around the modes of posteriors: by importance sampling, and by Markov chains.

For posteriors of few parameters, a mixture of Student's t around the modes proposes draws and
adapts to their weights (Cappé et al. 2008, Statistics and Computing 18, 447): every component
takes the weighted mean, scale and mass of its draws. For those of many parameters, Markov chains
start from the modes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import lgamma
from typing import NamedTuple

import numpy as np

from psfdae.progress import steps

FREEDOM = 5.0
"""Degrees of freedom of Student's t; its tails are heavier than those of any normal posterior."""


@dataclass(frozen=True)
class Mixture:
    """Mixture of multivariate Student's t, one component around each mode.

    Attributes
    ----------
    mean : ndarray, shape (M, D)
    factor : ndarray, shape (M, D, D)
        Lower Cholesky factor L of each scale matrix.
    evidence : ndarray, shape (M,)
        Logarithm of the mass of each mode.
    """

    mean: np.ndarray
    factor: np.ndarray
    evidence: np.ndarray

    def squared_distance(self, draws: np.ndarray) -> np.ndarray:
        """Return (x − μ)ᵀ (LLᵀ)⁻¹ (x − μ) of draws x (n, D) from every mode, shape (M, n)."""
        offset = np.linalg.solve(self.factor, (draws - self.mean[:, None]).swapaxes(1, 2))
        return np.asarray((offset**2).sum(axis=1))

    def log_density(self, squared_distance: np.ndarray) -> np.ndarray:
        """Return the log-density of each component at squared distances (M, n).

        With ν degrees of freedom in D dimensions, ln p = ln Γ((ν + D)/2) − ln Γ(ν/2)
        − (D/2) ln(νπ) − ln |L| − (ν + D)/2 ln(1 + distance²/ν).
        """
        terms = self.mean.shape[1]
        log_determinant = np.log(np.diagonal(self.factor, axis1=1, axis2=2)).sum(axis=1)
        constant = lgamma(0.5 * (FREEDOM + terms)) - lgamma(0.5 * FREEDOM)
        constant -= 0.5 * terms * np.log(FREEDOM * np.pi)
        tail = 0.5 * (FREEDOM + terms) * np.log1p(squared_distance / FREEDOM)
        return np.asarray(constant - log_determinant[:, None] - tail)

    def draw(self, mode: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw once around each of the modes `mode` (n,); shape (n, D)."""
        # Student's t is a normal variable times √(ν/χ²).
        normal = rng.standard_normal((mode.size, self.mean.shape[1]))
        stretch = np.sqrt(FREEDOM / rng.chisquare(FREEDOM, mode.size))
        offset = (self.factor[mode] @ (normal * stretch[:, None])[:, :, None])[:, :, 0]
        return np.asarray(self.mean[mode] + offset)

    def adapted(
        self, draws: np.ndarray, log_weight: np.ndarray, log_possible: np.ndarray | float = 0.0
    ) -> Mixture:
        """Return the mixture with means, scales and masses of weighted draws.

        One step of expectation maximisation for Student's t. The mixture is returned as it is if
        no draw is possible.

        Parameters
        ----------
        draws : ndarray, shape (n, D)
        log_weight : ndarray, shape (n,)
            Logarithm of the importance weights.
        log_possible : ndarray, shape (M, n)
            −∞ for draws that a mode cannot have made, otherwise 0.
        """
        if not np.isfinite(log_weight).any():
            return self
        smallest = np.finfo(float).tiny
        squared_distance, terms = self.squared_distance(draws), self.mean.shape[1]
        # Responsibility of each component for each draw, times the weight of the draw.
        log_part = self.log_density(squared_distance) + log_possible + self.evidence[:, None]
        weight = np.exp(log_weight - log_weight.max())
        with np.errstate(invalid="ignore"):
            share = np.exp(log_part - np.logaddexp.reduce(log_part, axis=0))
        share = np.where(np.isfinite(share), share, 0.0) * weight
        mass = share.sum(axis=1)
        # Shrinkage towards the previous component: 10 effective draws, (Σw)²/Σw², move it half
        # way to the estimate from the draws.
        effective = mass**2 / np.maximum((share**2).sum(axis=1), smallest)
        gain = (effective / (effective + 10.0))[:, None]
        # Distant draws weigh (ν + D)/(ν + distance²), as in the maximum-likelihood fit of t.
        share *= (FREEDOM + terms) / (FREEDOM + squared_distance)
        share /= np.maximum(share.sum(axis=1, keepdims=True), smallest)
        mean = self.mean + gain * (share @ draws - self.mean * share.sum(axis=1, keepdims=True))
        offset = draws - mean[:, None]
        scale = (share[:, :, None] * offset).swapaxes(1, 2) @ offset
        gain = gain[..., None]
        scale = gain * scale + (1.0 - gain) * (self.factor @ self.factor.swapaxes(1, 2))
        return Mixture(mean, np.linalg.cholesky(scale), np.log(np.maximum(mass, smallest)))


class Chains(NamedTuple):
    """Settings of the Markov chains of each posterior."""

    number: int = 4
    steps: int = 1200
    burn_in: int = 120
    """Steps in which the stride is adapted, and whose draws are dropped."""
    draws: int = 300
    """Draws of a posterior that are returned, evenly spaced."""
    acceptance: float = 0.35
    """Fraction of proposals that the stride is adapted to accept."""
    reference_scale: float = 1.3
    """Standard deviation of the reference normal, in that of its mode."""


CHAINS = Chains()

LogPosterior = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function of numbers of posteriors (m,) and parameters (m, D): logarithm of the posterior (m,)."""

Twin = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function of numbers of posteriors (m,) and parameters (m, D): the parameters (m, D) of the same
likelihood, and the gain (m,) in the logarithm of the posterior. It is its own inverse."""


def sample_around(
    log_posterior: LogPosterior,
    twin: Twin,
    owner: np.ndarray,
    modes: Mixture,
    rngs: Sequence[np.random.Generator],
) -> np.ndarray:
    """Draw from posteriors around their modes, by Markov chains side by side.

    A proposal mixes the place of a chain with a draw from the reference normal of its mode (Neal
    1999, Bayesian Statistics 6, 475), and is accepted by the ratio of posterior to normal: where
    the posterior is nearly normal, every step is an independent draw. A draw or its twin is kept,
    by their probabilities.

    Parameters
    ----------
    log_posterior : LogPosterior
    twin : Twin
    owner : ndarray of int, shape (M,)
        Posterior of every mode, 0 to n − 1, ascending.
    modes : Mixture
        Modes with the Cholesky factors of their covariance.
    rngs : sequence of n Generators

    Returns
    -------
    ndarray, shape (n, `CHAINS.draws`, D)
    """
    posteriors, chains = len(rngs), CHAINS.number
    # Each chain is given a mode of its posterior, by the masses of the modes.
    bounds = np.searchsorted(owner, np.arange(posteriors + 1))
    mass = np.exp(modes.evidence - np.maximum.reduceat(modes.evidence, bounds[:-1])[owner])
    mode = np.concatenate(
        [
            low + rng.choice(high - low, chains, p=mass[low:high] / mass[low:high].sum())
            for low, high, rng in zip(bounds, bounds[1:], rngs, strict=False)
        ]
    )
    posterior = np.repeat(np.arange(posteriors), chains)
    mean, factor = modes.mean[mode], CHAINS.reference_scale * modes.factor[mode]

    def parameters_of(place: np.ndarray) -> np.ndarray:
        return np.asarray(mean + (factor @ place[:, :, None])[:, :, 0])

    def draw_normals() -> np.ndarray:
        shape = (chains, mean.shape[1])
        return np.concatenate([rng.standard_normal(shape) for rng in rngs])

    def draw_uniform() -> np.ndarray:
        # Above 0, because its logarithm is taken.
        return np.concatenate([1.0 - rng.random(chains) for rng in rngs])

    # Places are in units of the reference normal; a chain begins at a draw from its mode.
    place = draw_normals() / CHAINS.reference_scale
    height = log_posterior(posterior, parameters_of(place))
    stride = np.ones(posteriors)
    draws = []
    for step in steps("draws", range(CHAINS.steps)):
        # Proposal x' = √(1 − s²) x + s ξ with the stride s. It leaves the reference normal as it
        # is, so the ratio of posterior to normal decides: ln α = Δ ln p + ½ (|x'|² − |x|²).
        part = stride[posterior][:, None]
        trial = np.sqrt(1.0 - part**2) * place + part * draw_normals()
        trial_height = log_posterior(posterior, parameters_of(trial))
        gain = trial_height - height + 0.5 * ((trial**2).sum(axis=1) - (place**2).sum(axis=1))
        is_accepted = np.log(draw_uniform()) < gain
        place = np.where(is_accepted[:, None], trial, place)
        height = np.where(is_accepted, trial_height, height)
        # During burn-in, ln s moves by 0.3 times the difference from the acceptance aimed at.
        if step < CHAINS.burn_in:
            share = is_accepted.reshape(posteriors, chains).mean(axis=1)
            stride = np.clip(stride * np.exp(0.3 * (share - CHAINS.acceptance)), 0.02, 1.0)
            continue
        # The twin replaces a draw with the probability 1/(1 + e^−Δ), Δ its gain in ln p.
        parameters = parameters_of(place)
        twin_parameters, gain = twin(posterior, parameters)
        twin_probability = 1.0 / (1.0 + np.exp(-np.clip(gain, -500.0, 500.0)))
        is_twin = (draw_uniform() < twin_probability)[:, None]
        draws.append(np.where(is_twin, twin_parameters, parameters))
    # Order by posterior and step, and thin to the number of draws that is returned.
    by_posterior = np.array(draws).reshape(len(draws), posteriors, chains, -1).swapaxes(0, 1)
    flat = by_posterior.reshape(posteriors, -1, by_posterior.shape[-1])
    return flat[:, np.linspace(0, flat.shape[1] - 1, CHAINS.draws).astype(int)]
