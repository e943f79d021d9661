"""Random draws from posteriors of many parameters, by Markov chains around their modes.

Inputs: a function that evaluates posteriors, one that approximates them at a small cost, and the
positions, covariances and masses of the modes of each posterior. Outputs: draws of the parameters,
from which intervals and means are computed. `psfdae.sensing.stars` calls it with one posterior per
star.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from psfdae.base.progress import steps


class Chains(NamedTuple):
    """Settings of the Markov chains of each posterior."""

    number: int = 30
    burn_in: int = 100
    """Steps in which the stride is adapted; their draws are dropped."""
    draws: int = 10
    """Draws of each chain that are returned."""
    thinning: int = 20
    """Steps from one of these draws to the next."""
    acceptance: float = 0.35
    """Fraction of proposals that the stride is adapted to accept."""
    reference_scale: float = 1.3
    """Standard deviation of the reference normal over the standard deviation of its mode."""
    min_effective: float = 0.3
    """Effective fraction of weighted draws below which a posterior is not approximated."""


CHAINS = Chains()

LogPosterior = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function of indices of posteriors (m,) and parameters (m, D): logarithm of the posterior (m,)."""

Approximation = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function of ascending indices of modes (m,) and offsets x (m, D), where parameters are mean + F x
with the covariance F Fᵀ of each mode: approximate logarithm of the posterior (m,)."""

Approximate = Callable[[np.ndarray, Mapping[int, np.ndarray]], Approximation]
"""Function of indices of modes, and of offsets by mode at which it must be accurate, perhaps none,
that returns an approximation near these modes."""

Twin = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function of indices of posteriors (m,) and parameters (m, D): parameters (m, D) with the same
likelihood, and the gain (m,) in the logarithm of the posterior. It is its own inverse."""


def sample_around(
    log_posterior: LogPosterior,
    twin: Twin,
    owner: np.ndarray,
    mean: np.ndarray,
    factor: np.ndarray,
    evidence: np.ndarray,
    rngs: Sequence[np.random.Generator],
    approximate: Approximate | None = None,
) -> np.ndarray:
    """Draw from posteriors around their modes, by parallel Markov chains.

    A proposal mixes the point of a chain with a draw from the reference normal of its mode (Neal
    1999, Bayesian Statistics 6, 475). It is accepted by the ratio of posterior to normal: where
    the posterior is nearly normal, every step is an independent draw. If there is an approximation,
    chains follow it, and the posterior itself is evaluated for the returned draws alone: they are
    drawn again with weights posterior / approximation. Either a draw or its twin is kept, according
    to their probabilities.

    Parameters
    ----------
    log_posterior : LogPosterior
        Logarithm of the posteriors, up to a constant of each.
    twin : Twin
        Map of parameters to other parameters of the same likelihood.
    owner : ndarray of int, shape (M,)
        Posterior of every mode, 0 to n − 1, ascending.
    mean, factor, evidence : ndarray, shapes (M, D), (M, D, D) and (M,)
        Position, a factor F of the covariance F Fᵀ, and logarithm of the mass of every mode.
    rngs : sequence of n Generators
        Random stream of each posterior.
    approximate : Approximate, optional
        Approximation of the posteriors near modes.

    Returns
    -------
    ndarray, shape (n, `CHAINS.number` × `CHAINS.draws`, D)
        Draws of each posterior.
    """
    posteriors, chains, size = len(rngs), CHAINS.number, mean.shape[1]
    # Each mode gets a number of chains in proportion to its mass. Masses are relative to the
    # largest one of the posterior, so that none overflows.
    bounds = np.searchsorted(owner, np.arange(posteriors + 1))
    mass = np.exp(evidence - np.maximum.reduceat(evidence, bounds[:-1])[owner])
    mode = np.concatenate(
        [
            low + choose_evenly(mass[low:high], rng, chains)
            for low, high, rng in zip(bounds, bounds[1:], rngs, strict=False)
        ]
    )
    # Chains of a posterior are neighbours.
    posterior = np.repeat(np.arange(posteriors), chains)

    def follow(
        part: np.ndarray, fit_offsets: Mapping[int, np.ndarray] | None
    ) -> tuple[np.ndarray, np.ndarray, dict[int, np.ndarray]]:
        """Return draws of some posteriors, their effective fraction, and offsets by mode.

        Chains follow an approximation, or without `fit_offsets` the posterior.
        """
        chain = np.flatnonzero(np.isin(posterior, part))
        chain_mode, chain_rngs = mode[chain], [rngs[index] for index in part]
        # Draws of a reference normal are mean + S x with x ~ N(0, 1) and S Sᵀ = scale² covariance.
        scale = CHAINS.reference_scale * factor[chain_mode]

        def to_parameters(offset: np.ndarray) -> np.ndarray:
            return np.asarray(mean[chain_mode] + (scale @ offset[..., None])[..., 0])

        def evaluate(offset: np.ndarray) -> np.ndarray:
            return log_posterior(posterior[chain], to_parameters(offset))

        if approximate is None or fit_offsets is None:
            offsets, _ = run_chains(evaluate, size, chain_rngs)
            return group_by_posterior(to_parameters(offsets), part.size), np.ones(part.size), {}
        approximation = approximate(np.unique(chain_mode), fit_offsets)
        offsets, height = run_chains(
            lambda offset: approximation(chain_mode, CHAINS.reference_scale * offset),
            size,
            chain_rngs,
        )
        # Draws are drawn again with weights w = posterior / approximation. Their effective fraction
        # is (Σ w)² / n Σ w².
        excess = np.array([evaluate(offset) for offset in offsets]) - height
        log_weight = group_by_posterior(excess, part.size)
        weight = np.exp(log_weight - log_weight.max(axis=1, keepdims=True))
        rows = group_by_posterior(to_parameters(offsets), part.size)
        indices = [choose_evenly(*pair) for pair in zip(weight, chain_rngs, strict=True)]
        mode_offsets = {}
        for number in np.unique(chain_mode):
            part_offsets = offsets[:, chain_mode == number].reshape(-1, size)
            earlier_offsets = fit_offsets.get(number, part_offsets[:0])
            mode_offsets[number] = np.concatenate(
                [earlier_offsets, CHAINS.reference_scale * part_offsets]
            )
        effective = weight.mean(axis=1) ** 2 / (weight**2).mean(axis=1)
        return (
            np.take_along_axis(rows, np.array(indices)[..., None], axis=1),
            effective,
            mode_offsets,
        )

    # Where the approximation is poor, chains follow one that is fitted to their draws, too, at most
    # twice; where even this is poor, the posterior.
    draws, effective, offsets = follow(np.arange(posteriors), None if approximate is None else {})
    for is_last in (False, False, True):
        poor = np.flatnonzero(effective < CHAINS.min_effective)
        if poor.size:
            draws[poor], effective[poor], offsets = follow(poor, None if is_last else offsets)
    # The twin replaces a draw with the probability 1/(1 + e^−Δ), with its gain Δ in ln p.
    flat, flat_posterior = draws.reshape(-1, size), np.repeat(np.arange(posteriors), draws.shape[1])
    twin_draws, gain = twin(flat_posterior, flat)
    twin_probability = 1.0 / (1.0 + np.exp(-np.clip(gain, -500.0, 500.0)))
    is_twin = np.concatenate([rng.random(draws.shape[1]) for rng in rngs]) < twin_probability
    return np.where(is_twin[:, None], twin_draws, flat).reshape(draws.shape)


def choose_evenly(
    weight: np.ndarray, rng: np.random.Generator, count: int | None = None
) -> np.ndarray:
    """Return `count` indices, ascending, each as often as its share of the weight but for rounding.

    By default as many as there are weights. A random start decides how the shares are rounded, so
    that their means are right.
    """
    share, count = np.cumsum(weight) / weight.sum(), count or len(weight)
    # Rounding may leave the last share below 1.
    points = (np.arange(count) + rng.random()) / count
    return np.minimum(np.searchsorted(share, points), len(weight) - 1)


def group_by_posterior(values: np.ndarray, posteriors: int) -> np.ndarray:
    """Return values (draws, posteriors × chains, ...) as (posteriors, draws × chains, ...)."""
    split = values.reshape(len(values), posteriors, -1, *values.shape[2:]).swapaxes(0, 1)
    return split.reshape(posteriors, -1, *values.shape[2:])


def run_chains(
    evaluate: Callable[[np.ndarray], np.ndarray], size: int, rngs: Sequence[np.random.Generator]
) -> tuple[np.ndarray, np.ndarray]:
    """Return states of chains, and the logarithm of their posterior.

    Parameters
    ----------
    evaluate : callable
        Function of states of all chains of n posteriors, (n × `CHAINS.number`, D), in units of
        reference normals, that returns the logarithm of their posteriors.
    size : int
        Number D of parameters.
    rngs : sequence of n Generators
        Random stream of each posterior.

    Returns
    -------
    states, height : ndarray, shapes (`CHAINS.draws`, n × `CHAINS.number`, D) and without D
    """
    posteriors, chains = len(rngs), CHAINS.number

    def draw_normals() -> np.ndarray:
        # Each posterior has its own stream: its draws do not depend on other posteriors.
        return np.concatenate([rng.standard_normal((chains, size)) for rng in rngs])

    # A chain begins at a draw from its mode, which is narrower than the reference normal.
    state = draw_normals() / CHAINS.reference_scale
    height = evaluate(state)
    stride = np.ones(posteriors)
    # All chains of all posteriors advance together.
    states, heights = [], []
    for step in steps("draws", range(1, CHAINS.burn_in + CHAINS.draws * CHAINS.thinning + 1)):
        # Proposal x' = √(1 − s²) x + s ξ with the stride s. The reference normal is invariant under
        # it, so the ratio of posterior to normal decides: ln α = Δ ln p + ½ (|x'|² − |x|²).
        part = np.repeat(stride, chains)[:, None]
        trial = np.sqrt(1.0 - part**2) * state + part * draw_normals()
        trial_height = evaluate(trial)
        gain = trial_height - height + 0.5 * ((trial**2).sum(axis=1) - (state**2).sum(axis=1))
        # Above 0, because of the logarithm.
        uniform = np.concatenate([1.0 - rng.random(chains) for rng in rngs])
        is_accepted = np.log(uniform) < gain
        state = np.where(is_accepted[:, None], trial, state)
        height = np.where(is_accepted, trial_height, height)
        # During burn-in, ln s changes by 0.3 times the difference from the target acceptance.
        if step <= CHAINS.burn_in:
            share = is_accepted.reshape(posteriors, chains).mean(axis=1)
            stride = np.clip(stride * np.exp(0.3 * (share - CHAINS.acceptance)), 0.02, 1.0)
        elif (step - CHAINS.burn_in) % CHAINS.thinning == 0:
            states.append(state)
            heights.append(height)
    return np.array(states), np.array(heights)
