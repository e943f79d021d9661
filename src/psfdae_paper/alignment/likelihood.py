"""Poisson likelihood of the stamps of a state: its Fisher information, its bound, its maximum.

Photon counts are Poisson, n ~ Poisson(F p + B). Their Fisher information about
the state t, per pixel F² ∂p ∂pᵀ / (F p + B), equals the one of a Gaussian with the
variance (κλ)² + p/F, summed over pixels and fields (Kay 1993, chapter 3).

Flux and centroid of a star are unknown. With an operator of movable stamps they
are parameters, too: (n, 4) states become (n, 4 + 3F) parameters. After the
state come three for each stamp in turn: the difference of its flux from 1, and the
position (x, y) of its star in pixels.

Fits follow the steps of `psfdae.sensing.climbing`. An emulator of the optics takes them most of
the way, to within a fraction of a standard error of the maximum; the last step uses the optics
that simulated the data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from psfdae.base.progress import steps
from psfdae.sensing.climbing import (
    Evaluation,
    Peaks,
    Steps,
    climb,
    combine_images,
    poisson_information,
)
from psfdae.stars.noise import NoiseModel
from psfdae_paper.alignment.stamps import AlignmentStamps
from psfdae_paper.alignment.telescope import QuadraticModel, twin_states
from psfdae_paper.configuration.alignment import Fit

StampFunction = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Function of parameters (n, K) that returns stamps and slopes, as `StateOptics` does."""


@dataclass(frozen=True)
class StateOptics:
    """Optics of scene 3: from the parameters of states to stamps and their derivatives.

    Attributes
    ----------
    model : QuadraticModel
        Zernike coefficients of a state at all fields.
    operator : AlignmentStamps
        Propagation from Zernike coefficients to centred stamps.
    emulator : StampFunction, optional
        Source of the derivatives by the state, for stars in the centre of their stamps.
    """

    model: QuadraticModel
    operator: AlignmentStamps
    emulator: StampFunction | None = None

    def to_parameters(self, states: np.ndarray) -> np.ndarray:
        """Complete states (n, 4) to parameters, with flux 1 and the star in the stamp's centre."""
        # Three zeros for each stamp: flux 1 + 0, position (0, 0).
        count = 3 * len(self.model.coefficients) * self.operator.movable
        return np.pad(states, ((0, 0), (0, count)))

    def __call__(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the stamps of parameters, and their derivatives.

        Parameters
        ----------
        parameters : ndarray, shape (n, 4) or (n, 4 + 3F)
            States in units of the range; if stamps are movable, followed by the difference of the
            flux from 1 and the position (x, y) in pixels of each of the F stamps.

        Returns
        -------
        stamps : ndarray, shape (n, F, d, d)
        slopes : ndarray, shape (n, F, k, d, d)
            Derivatives by the k parameters of each stamp: the four of the state and, if stamps
            are movable, the stamp's own three.
        """
        # The quadratic model gives Zernike coefficients z_f of every field, and ∂z_f/∂t.
        states, star_parameters = parameters[:, :4], parameters[:, 4:]
        zernikes, directions = self.model(states), self.model.jacobian(states)
        # An emulator gives the slopes by the state: the optics need no directions for them.
        if self.emulator is not None:
            directions = directions[:, :, :0]
        if self.operator.movable:
            # The position of the star is two more coefficients of the wavefront.
            star_parameters = star_parameters.reshape(*zernikes.shape[:2], 3)
            zernikes = np.concatenate([zernikes, star_parameters[:, :, 1:]], axis=2)
            directions = np.pad(directions, ((0, 0), (0, 0), (0, 0), (0, 2)))
        shapes, slopes = self.operator.derivatives(zernikes, directions)
        if self.emulator is not None:
            slopes = np.concatenate([self.emulator(states)[1], slopes], axis=2)
        if not self.operator.movable:
            return shapes, slopes
        # A stamp is flux × shape: its derivative by the flux is the shape, the others are
        # multiplied by the flux.
        flux = 1.0 + star_parameters[:, :, :1, None]
        slopes = np.concatenate([slopes[:, :, :4], shapes[:, :, None], slopes[:, :, 4:]], axis=2)
        slopes[:, :, [0, 1, 2, 3, 5, 6]] *= flux[:, :, None]
        return flux * shapes, slopes


def compute_deviance(
    noise: NoiseModel, level: float, images: np.ndarray, stamps: np.ndarray, slopes: np.ndarray
) -> Evaluation:
    """Compute the deviance of noisy stamps from expected ones, and its derivatives.

    Parameters
    ----------
    noise : NoiseModel
        Photon noise of star and sky.
    level : float
        Noise level λ.
    images : ndarray, shape (n, F, d, d)
        Observed stamps, normalised by the true flux.
    images, stamps : ndarray, shape (n, F, d, d)
        Observed and expected stamps, normalised by the true flux.
    stamps : ndarray, shape (n, F, d, d)
        Expected stamps, normalised by the true flux.
    slopes : ndarray, shape (n, F, k, d, d)
        Derivatives by the parameters of each stamp: the first four are shared by all.

    Returns
    -------
    deviance : ndarray, shape (n,)
    score : ndarray, shape (n, K)
        Slope of the log-likelihood by all K parameters.
    information : ndarray, shape (n, K, K)
        Fisher matrix.
    """
    # The level λ decides the flux F of the stars, in photons; the sky B is the same at all levels.
    count, fields, k = slopes.shape[:3]
    flux, sky = noise.flux(level), noise.background
    # Counts F p + B of every stamp by itself.
    observed_counts, expected_counts = (
        flux * array.reshape(count * fields, -1).astype(np.float64) + sky
        for array in (images, stamps)
    )
    slopes = flux * slopes.reshape(count * fields, k, -1).astype(np.float64)
    deviance, score, information = poisson_information(observed_counts, expected_counts, slopes)
    # Photons of different fields are independent: their information about the state adds up.
    information = information.reshape(count, fields, k, k)
    score, information = combine_images(score.reshape(count, fields, k), information, 4)
    return deviance.reshape(count, fields).sum(axis=1), score, information


def compute_bounds(
    optics: StateOptics,
    noise: NoiseModel,
    levels: list[float],
    states: np.ndarray,
    unknown_flux: Sequence[bool],
) -> np.ndarray:
    """Compute Cramér–Rao bounds on the covariance of any unbiased estimate of states (n, 4).

    Parameters
    ----------
    optics : StateOptics
        Optics, which give stamps and their derivatives.
    noise : NoiseModel
        Photon noise of star and sky.
    levels : list of float
        Noise levels λ, L in all.
    states : ndarray, shape (n, 4)
        True states, in units of the range.
    unknown_flux : sequence of bool
        A bound each: True if flux and position of the stars are unknown, for which the stamps of
        `optics` must be movable.

    Returns
    -------
    ndarray, shape (len(unknown_flux), L, n, 4, 4)
        Covariances in squared units of the range.
    """
    # Stamps and slopes of a state serve all levels and both bounds. Those of 64 states are in
    # memory together.
    covariances = np.empty((len(unknown_flux), len(levels), len(states), 4, 4))
    for start in steps("bounds of states", range(0, len(states), 64)):
        part = slice(start, start + 64)
        stamps, slopes = optics(optics.to_parameters(states[part]))
        for bound, level in np.ndindex(covariances.shape[:2]):
            # The inverse of the Fisher matrix by all parameters; its part for the state is the
            # bound with the others unknown.
            by_parameters = slopes if unknown_flux[bound] else slopes[:, :, :4]
            information = compute_deviance(noise, levels[level], stamps, stamps, by_parameters)[2]
            covariances[bound, level, part] = np.linalg.inv(information)[:, :4, :4]
    return covariances


def compute_mean_abs_error(covariances: np.ndarray) -> np.ndarray:
    """Return the mean absolute error of normal errors, √(2/π) σ, (..., K, K) to (..., K)."""
    # ⟨|e|⟩ = ∫ |e| N(e; 0, σ²) de.
    sigma = np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
    return np.asarray(np.sqrt(2.0 / np.pi) * sigma)


@dataclass(frozen=True)
class StateLikelihood:
    """Poisson likelihood of noisy stamps at one noise level λ, which the fit knows.

    Attributes
    ----------
    stamps : StampFunction
        Expected stamps and their derivatives as a function of the parameters.
    noise : NoiseModel
        Photon noise of star and sky.
    level : float
        Noise level λ.
    images : ndarray, shape (n, F, d, d)
        Noisy stamps of n states, normalised by the true flux.
    """

    stamps: StampFunction
    noise: NoiseModel
    level: float
    images: np.ndarray

    def evaluate(self, rows: np.ndarray, parameters: np.ndarray) -> Evaluation:
        """Evaluate the log-likelihood of some states, as `psfdae.sensing.climbing.Evaluate`."""
        deviance, score, information = compute_deviance(
            self.noise, self.level, self.images[rows], *self.stamps(parameters)
        )
        return -0.5 * deviance, score, information

    def maximise(self, start: np.ndarray, settings: Fit) -> Peaks:
        """Fit the states to their stamps, each from one starting point.

        The fit ends with a step of at most `settings.tolerance` standard errors of the state.

        Parameters
        ----------
        start : ndarray, shape (n, K)
            Parameters in units of the range, K = 4, or more with movable stamps; limited to
            ± `settings.limit`.
        settings : Fit
            Group `fit`: tolerance, limit, largest number of steps and initial damping.

        Returns
        -------
        Peaks
            Heights are minus half of the deviance, which is twice the log-likelihood that is
            missing to a perfect fit: about the number of pixels if the model is true.
        """
        # A step of s standard errors of the state's four numbers raises the log-likelihood by
        # s²/2. Stamps in single precision round the deviance to 1e-6 of itself.
        steps = Steps(
            max_steps=settings.iterations,
            min_gain=0.5 * settings.tolerance**2,
            counted_parameters=4,
            initial_damping=settings.damping,
            max_damping=np.inf,
            relative_rounding=1e-6,
        )
        return climb(self.evaluate, start, settings.limit, steps)


def refit_twins(
    likelihood: StateLikelihood, fit: Peaks, model: QuadraticModel, settings: Fit
) -> tuple[Peaks, np.ndarray]:
    """Fit again from the twins of fitted states, and select the more likely of both fits.

    In focus, a state and its twin have nearly the same stamps.

    Parameters
    ----------
    likelihood : StateLikelihood
        Likelihood of the stamps of all n states.
    fit : Peaks
        Result of the first fit; left unchanged.
    model : QuadraticModel
        Model of the wavefront, from which the twins follow.
    settings : Fit
        Group `fit`, as for the first fit.

    Returns
    -------
    best_fit : Peaks
        `evaluations` count both fits.
    in_range : ndarray of bool, shape (n,)
        True where the twin lies within the limit, and so was a starting point.
    """
    # The fit cannot reach twins outside the limit.
    twins = twin_states(model, fit.parameters)
    in_range = (np.abs(twins) <= settings.limit).all(axis=1)
    best_fit = deepcopy(fit)
    if in_range.any():
        twin_likelihood = replace(likelihood, images=likelihood.images[in_range])
        twin_fit = twin_likelihood.maximise(twins[in_range], settings)
        # Heights are negative: the twin must be higher by more than the rounding of the deviance.
        is_higher = twin_fit.height > fit.height[in_range] * (1.0 - 1e-6)
        best_fit.put(np.flatnonzero(in_range)[is_higher], twin_fit.select(is_higher))
        best_fit.evaluations[in_range] = fit.evaluations[in_range] + twin_fit.evaluations
    return best_fit, in_range
