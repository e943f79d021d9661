"""Maximum-likelihood fit of a state to the noisy stamps of all fields.

Steps are those of `psfdae.sensing.climbing`, with the Poisson likelihood of stamps. Stamps come
from a function: an emulator takes the fit most of the way, to a maximum that is a part of a
standard error off; the last step uses stamps of the optics that made the data.
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
    """Poisson likelihood of stamps at one noise level λ, which the fit knows."""

    stamps: Stamps
    noise: NoiseModel
    level: float


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
        Parameters in units of the range, K = 4, or more with movable stamps
        (`psfdae_paper.alignment.fisher`); limited to ± `settings.limit`.
    settings : config group `fit`
    """

    def evaluate(
        rows: np.ndarray, parameters: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        stamps, slopes = likelihood.stamps(parameters)
        deviance, score, information = deviance_and_information(
            likelihood.noise, likelihood.level, images[rows], stamps, slopes
        )
        return -0.5 * deviance, score, information

    # A step of s standard errors raises the log-likelihood by s²/2.
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
    likelihood: Likelihood, images: np.ndarray, fit: Peaks, twins: np.ndarray, settings: Fit
) -> tuple[Peaks, np.ndarray]:
    """Fit again from the twins that lie within the limit; take the more likely of both fits.

    Parameters
    ----------
    likelihood, images, settings : as for `fit_states`
    fit : Peaks
        Result of the first fit; left unchanged.
    twins : ndarray, shape (n, K)
        Twins of its states.

    Returns
    -------
    improved : Peaks
        `evaluations` count both fits.
    in_range : ndarray of bool, shape (n,)
        True where the twin was a starting point.
    """
    in_range = (np.abs(twins) <= settings.limit).all(axis=1)
    improved = deepcopy(fit)
    if in_range.any():
        twin_fit = fit_states(likelihood, images[in_range], twins[in_range], settings)
        # Heights are negative: the twin must be higher by more than rounding.
        is_higher = twin_fit.height > fit.height[in_range] * (1.0 - ROUNDING)
        improved.overwrite(np.flatnonzero(in_range)[is_higher], twin_fit, is_higher)
        improved.evaluations[in_range] += twin_fit.evaluations
    return improved, in_range
