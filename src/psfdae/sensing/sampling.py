"""Random draws from posteriors of many parameters, by Markov chains around their modes.

Inputs: a function that evaluates posteriors, and the positions, covariances and masses of the modes
of each posterior. Outputs: draws of the parameters, from which intervals and means are computed.
`psfdae.sensing.stars` calls it with one posterior per star.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from psfdae.base.progress import steps


class Chains(NamedTuple):
    """Settings of the Markov chains of each posterior."""

    number: int = 4
    steps: int = 1200
    burn_in: int = 120
    """Steps in which the stride is adapted; their draws are dropped."""
    draws: int = 300
    """Draws of a posterior that are returned, evenly spaced."""
    acceptance: float = 0.35
    """Fraction of proposals that the stride is adapted to accept."""
    reference_scale: float = 1.3
    """Standard deviation of the reference normal over the standard deviation of its mode."""


CHAINS = Chains()

LogPosterior = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function of indices of posteriors (m,) and parameters (m, D): logarithm of the posterior (m,)."""

Twin = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function of indices of posteriors (m,) and parameters (m, D): parameters (m, D) with the same
likelihood, and the gain (m,) in the logarithm of the posterior. It is its own inverse."""


def sample_around(
    log_posterior: LogPosterior,
    twin: Twin,
    owner: np.ndarray,
    mean: np.ndarray,
    covariance: np.ndarray,
    evidence: np.ndarray,
    rngs: Sequence[np.random.Generator],
) -> np.ndarray:
    """Draw from posteriors around their modes, by parallel Markov chains.

    A proposal mixes the position of a chain with a draw from the reference normal of its mode (Neal
    1999, Bayesian Statistics 6, 475). It is accepted by the ratio of posterior to normal: where
    the posterior is nearly normal, every step is an independent draw. Either a draw or its twin is
    kept, according to their probabilities.

    Parameters
    ----------
    log_posterior : LogPosterior
        Logarithm of the posteriors, up to a constant of each.
    twin : Twin
        Map of parameters to other parameters of the same likelihood.
    owner : ndarray of int, shape (M,)
        Posterior of every mode, 0 to n − 1, ascending.
    mean, covariance, evidence : ndarray, shapes (M, D), (M, D, D) and (M,)
        Position, covariance and logarithm of the mass of every mode.
    rngs : sequence of n Generators
        Random stream of each posterior.

    Returns
    -------
    ndarray, shape (n, `CHAINS.draws`, D)
        Draws of each posterior, in the order of the steps; chains of a step are neighbours.
    """
    posteriors, chains = len(rngs), CHAINS.number
    # Each chain draws a mode of its posterior, with a probability proportional to its mass. Masses
    # are relative to the largest one of the posterior, so that none overflows.
    bounds = np.searchsorted(owner, np.arange(posteriors + 1))
    mass = np.exp(evidence - np.maximum.reduceat(evidence, bounds[:-1])[owner])
    mode = np.concatenate(
        [
            low + rng.choice(high - low, chains, p=mass[low:high] / mass[low:high].sum())
            for low, high, rng in zip(bounds, bounds[1:], rngs, strict=False)
        ]
    )
    # Chains of a posterior are neighbours.
    posterior = np.repeat(np.arange(posteriors), chains)
    # Draws of a reference normal are mean + L x with x ~ N(0, 1) and L Lᵀ = scale² × covariance.
    mean, factor = mean[mode], CHAINS.reference_scale * np.linalg.cholesky(covariance)[mode]

    def to_parameters(place: np.ndarray) -> np.ndarray:
        return np.asarray(mean + (factor @ place[:, :, None])[:, :, 0])

    def draw_normals() -> np.ndarray:
        # Each posterior has its own stream: its draws do not depend on other posteriors.
        shape = (chains, mean.shape[1])
        return np.concatenate([rng.standard_normal(shape) for rng in rngs])

    def draw_uniform() -> np.ndarray:
        # Above 0, because of the logarithm.
        return np.concatenate([1.0 - rng.random(chains) for rng in rngs])

    # Positions are in units of the reference normal; a chain begins at a draw from its mode.
    place = draw_normals() / CHAINS.reference_scale
    height = log_posterior(posterior, to_parameters(place))
    stride = np.ones(posteriors)
    # All chains of all posteriors advance together.
    draws = []
    for step in steps("draws", range(CHAINS.steps)):
        # Proposal x' = √(1 − s²) x + s ξ with the stride s. The reference normal is invariant under
        # it, so the ratio of posterior to normal decides: ln α = Δ ln p + ½ (|x'|² − |x|²).
        part = stride[posterior][:, None]
        trial = np.sqrt(1.0 - part**2) * place + part * draw_normals()
        trial_height = log_posterior(posterior, to_parameters(trial))
        gain = trial_height - height + 0.5 * ((trial**2).sum(axis=1) - (place**2).sum(axis=1))
        is_accepted = np.log(draw_uniform()) < gain
        place = np.where(is_accepted[:, None], trial, place)
        height = np.where(is_accepted, trial_height, height)
        # During burn-in, ln s changes by 0.3 times the difference from the target acceptance.
        if step < CHAINS.burn_in:
            share = is_accepted.reshape(posteriors, chains).mean(axis=1)
            stride = np.clip(stride * np.exp(0.3 * (share - CHAINS.acceptance)), 0.02, 1.0)
            continue
        # The twin replaces a draw with the probability 1/(1 + e^−Δ), with its gain Δ in ln p.
        parameters = to_parameters(place)
        twin_parameters, gain = twin(posterior, parameters)
        twin_probability = 1.0 / (1.0 + np.exp(-np.clip(gain, -500.0, 500.0)))
        is_twin = (draw_uniform() < twin_probability)[:, None]
        draws.append(np.where(is_twin, twin_parameters, parameters))
    # Sort by posterior and step, and thin to the requested number of draws.
    by_posterior = np.array(draws).reshape(len(draws), posteriors, chains, -1).swapaxes(0, 1)
    flat = by_posterior.reshape(posteriors, -1, by_posterior.shape[-1])
    return flat[:, np.linspace(0, flat.shape[1] - 1, CHAINS.draws).astype(int)]
