"""Maximum-likelihood fit of a state to the noisy stamps of all fields.

The climb is `psfdae.sensing.climbing`; with the Poisson likelihood of stamps. It knows stamps by a
function: an emulator takes it most of the way, whose maximum is a part of a standard error
off; the last step goes by stamps of the optics that made the data.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass

import numpy as np

from psfdae.noise import NoiseModel
from psfdae.sensing.climbing import Peaks, Steps, climb
from psfdae_paper.alignment.fisher import Stamps, deviance_and_information
from psfdae_paper.alignment.telescope import DEGREES_OF_FREEDOM
from psfdae_paper.configuration.alignment import Fit

ROUNDING = 1e-6
"""Relative rise of the deviance that stamps in single precision may cause."""


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
        return deviance_and_information(self.noise, self.level, images, stamps, slopes)


def fit_states(
    likelihood: Likelihood, images: np.ndarray, start: np.ndarray, settings: Fit
) -> Peaks:
    """Fit states to noisy stamps, each from one starting point.

    A step of at most `settings.tolerance` standard errors of the state is the last. The height of
    the peaks is minus half of the deviance, which is twice the log-likelihood that is missing to
    a perfect fit: about the number of pixels if the model is true.

    Parameters
    ----------
    likelihood : Likelihood
    images : ndarray, shape (n, F, d, d)
        Noisy stamps, normalised by the true flux.
    start : ndarray, shape (n, K)
        In units of the range; limited to ± `settings.limit`, as are all parameters.
    settings : config group `fit`
    """

    def evaluate(some: np.ndarray, states: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        deviance, score, fisher = likelihood.evaluate(images[some], states)
        return -0.5 * deviance, score, fisher

    steps = Steps(
        max_steps=settings.iterations,
        min_gain=0.5 * settings.tolerance**2,
        counted_parameters=len(DEGREES_OF_FREEDOM),
        initial_damping=settings.damping,
        max_damping=np.inf,
        relative_rounding=ROUNDING,
    )
    return climb(evaluate, start, settings.limit, steps)


def refit_twins(
    likelihood: Likelihood, images: np.ndarray, first: Peaks, twins: np.ndarray, settings: Fit
) -> tuple[Peaks, np.ndarray]:
    """Fit again from the twins that lie within the limit; keep what is more likely.

    Parameters
    ----------
    likelihood, images, settings : see `fit_states`
    first : Peaks
    twins : ndarray, shape (n, K)
        Of their states.

    Returns
    -------
    Peaks
        `evaluations` count both fits.
    tried : ndarray of bool, shape (n,)
    """
    tried = (np.abs(twins) <= settings.limit).all(axis=1)
    best = deepcopy(first)
    if tried.any():
        second = fit_states(likelihood, images[tried], twins[tried], settings)
        better = second.height > first.height[tried] * (1.0 - ROUNDING)
        best.overwrite(np.flatnonzero(tried)[better], second, better)
        best.evaluations[tried] += second.evaluations
    return best, tried
