"""Maximum-likelihood fit of a state to the noisy stamps of all fields.

Fisher scoring: Gauss–Newton steps with the Fisher matrix of the current state,
damped after Levenberg where a step does not raise the likelihood. With the
variance (κλ)² + p/F its fixed point is the maximum of the Poisson likelihood.

It knows stamps by a function: an emulator takes it most of the way, whose maximum is a part
of a standard error off; the last step goes by stamps of the optics that made the data.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass

import numpy as np

from psfdae.noise import NoiseModel
from psfdae_paper.alignment.fisher import Stamps, score_and_information
from psfdae_paper.configuration.alignment import Fit

ROUNDING = 1e-6
"""Relative rise of the deviance that stamps in single precision may cause."""

DAMPING_FACTOR = 10.0
"""By which the damping falls after a good step and grows after a bad one."""


@dataclass(frozen=True)
class Likelihood:
    """Poisson likelihood of stamps at one noise level λ, known to the fit."""

    stamps: Stamps
    noise: NoiseModel
    level: float

    def evaluate(
        self, images: np.ndarray, states: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Deviance (n,), score (n, K) and Fisher matrix (n, K, K) at states (n, K).

        `images`, shape (n, F, d, d), are noisy and normalised by the true flux. K is 4,
        or more with movable stamps (`psfdae_paper.alignment.fisher`).
        """
        stamps, slopes = self.stamps(states)
        expected, observed = stamps.astype(np.float64), images.astype(np.float64)
        variance = self.noise.variance(expected, self.level)
        score, fisher = score_and_information(observed - expected, slopes, variance)
        # 2 Σ (n ln(n/μ) − (n − μ)) with n = F x + B and μ = F p + B,
        flux, background = self.noise.flux(self.level), self.noise.background
        mean = flux * expected + background
        excess = flux * (observed - expected) / mean
        # of which each term is μ ((1 + e) ln(1 + e) − e), without cancellation.
        logarithm = np.log1p(np.maximum(excess, -1.0 + 1e-12))
        deviance = 2.0 * (mean * ((1.0 + excess) * logarithm - excess)).sum(axis=(1, 2, 3))
        return deviance, score, fisher


@dataclass
class Fits:
    """Fits of states of misalignment, where they stand.

    Attributes
    ----------
    states : ndarray, shape (n, K)
        In units of the range; after the four what else is free (`psfdae_paper.alignment.fisher`).
    deviance : ndarray, shape (n,)
        Twice the log-likelihood that is missing to a perfect fit; about the
        number of pixels if the model is true.
    score, fisher : ndarray, shapes (n, K) and (n, K, K)
        Slope and information of the log-likelihood before the last step.
    evaluations : ndarray of int, shape (n,)
        How often stamps and derivatives were computed.
    converged : ndarray of bool, shape (n,)
    """

    states: np.ndarray
    deviance: np.ndarray
    score: np.ndarray
    fisher: np.ndarray
    evaluations: np.ndarray
    converged: np.ndarray

    def take(self, own: np.ndarray, others: Fits, theirs: np.ndarray) -> None:
        """Put the results `theirs` of other fits in place of those at `own`."""
        for name in ("states", "deviance", "score", "fisher", "converged"):
            getattr(self, name)[own] = getattr(others, name)[theirs]


def fit_states(
    likelihood: Likelihood, images: np.ndarray, start: np.ndarray, settings: Fit
) -> Fits:
    """Fit states to noisy stamps, each from one starting point.

    A step of at most `settings.tolerance` standard errors of the state is the last: it is taken,
    and its gain is what the score and the Fisher matrix say, without another look.

    Parameters
    ----------
    likelihood : Likelihood
    images : ndarray, shape (n, F, d, d)
        Noisy stamps, normalised by the true flux.
    start : ndarray, shape (n, K)
        In units of the range; limited to ± `settings.limit`, as are all parameters.
    settings : config group `fit`
    """
    count, limit = len(start), settings.limit
    states = np.clip(np.asarray(start, np.float64), -limit, limit)
    now = Fits(
        states, *likelihood.evaluate(images, states), np.ones(count, int), np.zeros(count, bool)
    )
    damping = np.full(count, settings.damping)
    for _ in range(settings.iterations):
        active = np.flatnonzero(~now.converged)
        # What damping makes small says nothing about how far the maximum is.
        whole = _damped_step(now, active, np.zeros(active.size), limit)
        fisher = now.fisher[active]
        gain = np.einsum("nk,nk->n", whole, 2.0 * now.score[active])
        gain -= np.einsum("nk,nkl,nl->n", whole, fisher, whole)
        # Standard errors of the state, whatever else is free.
        own = np.linalg.inv(np.linalg.inv(fisher)[:, :4, :4])
        size = np.einsum("nk,nkl,nl->n", whole[:, :4], own, whole[:, :4])
        last = size <= settings.tolerance**2
        now.states[active[last]] += whole[last]
        now.deviance[active[last]] -= gain[last]
        now.converged[active] = last
        active = active[~last]
        if not active.size:
            break
        states = now.states[active] + _damped_step(now, active, damping[active], limit)
        proposed = Fits(
            states,
            *likelihood.evaluate(images[active], states),
            np.ones(active.size, int),
            np.zeros(active.size, bool),
        )
        better = proposed.deviance <= now.deviance[active] * (1.0 + ROUNDING)
        now.take(active[better], proposed, better)
        now.evaluations[active] += 1
        damping[active] *= np.where(better, 1.0 / DAMPING_FACTOR, DAMPING_FACTOR)
    return now


def _damped_step(now: Fits, active: np.ndarray, damping: np.ndarray, limit: float) -> np.ndarray:
    """Steps of the active fits, cut at the limit; numbers held there leave the equations."""
    states, score, fisher = now.states[active], now.score[active], now.fisher[active].copy()
    held = ((states >= limit) & (score > 0)) | ((states <= -limit) & (score < 0))
    diagonal = np.arange(states.shape[1])
    fisher[:, diagonal, diagonal] *= 1.0 + damping[:, None]
    fisher[held[:, :, None] | held[:, None, :]] = 0.0
    fisher[:, diagonal, diagonal] += held
    step = np.linalg.solve(fisher, np.where(held, 0.0, score)[:, :, None])[:, :, 0]
    return np.clip(states + step, -limit, limit) - states


def refit_twins(
    likelihood: Likelihood, images: np.ndarray, first: Fits, twins: np.ndarray, settings: Fit
) -> tuple[Fits, np.ndarray]:
    """Fit again from the twins that lie within the limit; keep what is more likely.

    Parameters
    ----------
    likelihood, images, settings : see `fit_states`
    first : Fits
    twins : ndarray, shape (n, K)
        Of their states.

    Returns
    -------
    Fits
        `evaluations` count both fits.
    tried : ndarray of bool, shape (n,)
    """
    tried = (np.abs(twins) <= settings.limit).all(axis=1)
    best = deepcopy(first)
    if tried.any():
        second = fit_states(likelihood, images[tried], twins[tried], settings)
        better = second.deviance < first.deviance[tried] * (1.0 - ROUNDING)
        best.take(np.flatnonzero(tried)[better], second, better)
        best.evaluations[tried] += second.evaluations
    return best, tried
