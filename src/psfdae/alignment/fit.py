"""Maximum-likelihood fit of a state to the noisy stamps of all fields.

Fisher scoring: Gauss–Newton steps with the Fisher matrix of the current state,
damped after Levenberg where a step does not raise the likelihood. With the
variance (κλ)² + p/F its fixed point is the maximum of the Poisson likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from psfdae.alignment.fisher import by_parameter, twin_states
from psfdae.alignment.stamps import AlignmentStamps
from psfdae.alignment.telescope import QuadraticModel
from psfdae.configuration.alignment import Fit
from psfdae.stars.noise import NoiseModel

ROUNDING = 1e-6
"""Relative rise of the deviance that stamps in single precision may cause."""

DAMPING_FACTOR = 10.0
"""By which the damping falls after a good step and grows after a bad one."""


@dataclass(frozen=True)
class FitResult:
    """Fitted states of misalignment.

    Attributes
    ----------
    states : ndarray, shape (n, 4)
        In units of the range.
    deviance : ndarray, shape (n,)
        Twice the log-likelihood that is missing to a perfect fit; about the
        number of pixels if the model is true.
    evaluations : ndarray of int, shape (n,)
        How often stamps and derivatives were computed.
    converged : ndarray of bool, shape (n,)
    """

    states: np.ndarray
    deviance: np.ndarray
    evaluations: np.ndarray
    converged: np.ndarray


@dataclass(frozen=True)
class Likelihood:
    """Poisson likelihood of stamps at one noise level.

    Attributes
    ----------
    model, operator : wavefronts and stamps of the telescope
    noise : NoiseModel
    level : float
        Noise level λ, known to the fit.
    """

    model: QuadraticModel
    operator: AlignmentStamps
    noise: NoiseModel
    level: float

    def evaluate(
        self, images: np.ndarray, states: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Deviance (n,), score (n, 4) and Fisher matrix (n, 4, 4) at states.

        Parameters
        ----------
        images : ndarray, shape (n, F, d, d)
            Noisy, normalised by the true flux.
        states : ndarray, shape (n, 4)
        """
        stamps, derivatives = self.operator.derivatives(
            self.model(states), self.model.jacobian(states)
        )
        slopes = by_parameter(derivatives)
        expected = stamps.reshape(len(states), -1).astype(np.float64)
        observed = images.reshape(len(states), -1).astype(np.float64)
        weighted = slopes / self.noise.variance(expected, self.level)[:, None]
        score = (weighted @ (observed - expected)[:, :, None])[:, :, 0]
        fisher = weighted @ slopes.swapaxes(1, 2)
        return self._deviance(observed, expected), score, fisher

    def _deviance(self, observed: np.ndarray, expected: np.ndarray) -> np.ndarray:
        """2 Σ (n ln(n/μ) − (n − μ)) with n = F x + B and μ = F p + B."""
        flux, background = self.noise.flux(self.level), self.noise.background
        mean = flux * expected + background
        excess = flux * (observed - expected) / mean
        # n ln(n/μ) − (n − μ) = μ ((1 + e) ln(1 + e) − e), without cancellation.
        logarithm = np.log1p(np.maximum(excess, -1.0 + 1e-12))
        return 2.0 * (mean * ((1.0 + excess) * logarithm - excess)).sum(axis=1)


@dataclass
class _Progress:
    """Where every fit stands."""

    states: np.ndarray
    deviance: np.ndarray
    score: np.ndarray
    fisher: np.ndarray
    damping: np.ndarray
    evaluations: np.ndarray
    converged: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.converged = np.zeros(len(self.states), bool)


def fit_states(
    likelihood: Likelihood,
    images: np.ndarray,
    start: np.ndarray,
    settings: Fit,
) -> FitResult:
    """Fit states to noisy stamps, each from one starting point.

    Parameters
    ----------
    likelihood : Likelihood
    images : ndarray, shape (n, F, d, d)
        Noisy stamps, normalised by the true flux.
    start : ndarray, shape (n, 4)
        In units of the range; limited to ± `settings.limit`, as are all states.
    settings : config group `fit`
    """
    states = np.clip(np.asarray(start, np.float64), -settings.limit, settings.limit)
    now = _Progress(
        states,
        *likelihood.evaluate(images, states),
        np.full(len(states), settings.damping),
        np.ones(len(states), int),
    )
    for _ in range(settings.iterations):
        active = np.flatnonzero(~now.converged)
        if not active.size:
            break
        _iterate(now, active, likelihood, images, settings)
    return FitResult(now.states, now.deviance, now.evaluations, now.converged)


def _iterate(
    now: _Progress,
    active: np.ndarray,
    likelihood: Likelihood,
    images: np.ndarray,
    settings: Fit,
) -> None:
    """One damped step of the fits that have not converged."""
    step = _damped_step(now, active, settings.limit)
    size = np.sqrt(np.einsum("nk,nkl,nl->n", step, now.fisher[active], step))
    proposed = now.states[active] + step
    deviance, score, fisher = likelihood.evaluate(images[active], proposed)
    now.evaluations[active] += 1
    better = deviance <= now.deviance[active] * (1.0 + ROUNDING)
    accepted = active[better]
    now.states[accepted] = proposed[better]
    now.deviance[accepted] = deviance[better]
    now.score[accepted] = score[better]
    now.fisher[accepted] = fisher[better]
    now.damping[active] *= np.where(better, 1.0 / DAMPING_FACTOR, DAMPING_FACTOR)
    # A step of a small part of the standard error changes nothing that matters.
    now.converged[active] = size <= settings.tolerance


def _damped_step(now: _Progress, active: np.ndarray, limit: float) -> np.ndarray:
    """Steps of the active fits, cut at the limit; numbers held there leave the equations."""
    states, score, fisher = now.states[active], now.score[active], now.fisher[active].copy()
    held = ((states >= limit) & (score > 0)) | ((states <= -limit) & (score < 0))
    diagonal = np.arange(states.shape[1])
    fisher[:, diagonal, diagonal] *= 1.0 + now.damping[active, None]
    fisher[held[:, :, None] | held[:, None, :]] = 0.0
    fisher[:, diagonal, diagonal] += held
    step = np.linalg.solve(fisher, np.where(held, 0.0, score)[:, :, None])[:, :, 0]
    return np.clip(states + step, -limit, limit) - states


def refit_twins(
    likelihood: Likelihood, images: np.ndarray, first: FitResult, noll: np.ndarray, settings: Fit
) -> tuple[FitResult, np.ndarray]:
    """Fit again from the twins that lie within the limit; keep what is more likely.

    Parameters
    ----------
    likelihood, images, settings : see `fit_states`
    first : FitResult
        Fits whose twins are tried.
    noll : ndarray of int
        Noll indices of the model's coefficients.

    Returns
    -------
    FitResult
        `evaluations` count both fits.
    tried : ndarray of bool, shape (n,)
    """
    twins = twin_states(likelihood.model, first.states, noll)
    tried = (np.abs(twins) <= settings.limit).all(axis=1)
    if not tried.any():
        return first, tried
    second = fit_states(likelihood, images[tried], twins[tried], settings)
    better = second.deviance < first.deviance[tried] * (1.0 - ROUNDING)
    rows = np.flatnonzero(tried)[better]
    states, deviance, converged = (
        array.copy() for array in (first.states, first.deviance, first.converged)
    )
    states[rows], deviance[rows] = second.states[better], second.deviance[better]
    converged[rows] = second.converged[better]
    evaluations = first.evaluations.copy()
    evaluations[tried] += second.evaluations
    return FitResult(states, deviance, evaluations, converged), tried
