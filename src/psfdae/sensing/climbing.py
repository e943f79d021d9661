"""Maxima of posteriors of Poisson counts, many at once.

Each climb is Fisher scoring: Gauss–Newton steps with the expected information at the current
parameters, damped after Levenberg and Marquardt where a step does not raise the posterior. The
caller computes the expected counts from the aberrations of one star or a whole field, or from the
state of a misaligned telescope.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from psfdae.base import progress
from psfdae.base.rows import Rows

Evaluation = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Logarithm of a posterior or deviance (a,), its slope (a, K), and the information (a, K, K)."""

Evaluate = Callable[[np.ndarray, np.ndarray], Evaluation]
"""Function of indices of starts (a,) and their parameters (a, K) that evaluates the logarithm of
their posterior."""


class Steps(NamedTuple):
    """Settings of a climb: its number of steps, its end and its damping."""

    max_steps: int = 12
    min_gain: float = 0.02
    """Smallest predicted gain in the logarithm of the posterior; a step below it is the last."""
    counted_parameters: int | None = None
    """Number of leading parameters whose gain is compared with `min_gain`; None: all."""
    initial_damping: float = 1e-2
    max_damping: float = 1e6
    """Damping at which a climb is abandoned."""
    relative_rounding: float = 0.0
    """Relative decrease of the posterior in a step that is attributed to rounding."""
    max_drop: float = np.inf
    """Largest distance in ln of the posterior below the best climb of a group. A climb is abandoned
    if it stays farther below even after twice its predicted gain."""
    min_distance: float = 0.0
    """Distance in standard deviations from a higher climb of its group below which a climb joins
    it: it ends with height −∞."""


@dataclass
class Peaks(Rows):
    """Local maxima that the climbs have reached.

    Attributes
    ----------
    parameters : ndarray, shape (M, K)
        Parameters at the end of each climb.
    height : ndarray, shape (M,)
        Logarithm of the posterior, including the predicted gain of the last step if it was taken.
    slope, information : ndarray, shapes (M, K) and (M, K, K)
        Gradient and expected information before the last step.
    evaluations : ndarray of int, shape (M,)
        Number of evaluations of the posterior.
    has_converged : ndarray of bool, shape (M,)
        True if the predicted gain fell below `Steps.min_gain`.
    """

    parameters: np.ndarray
    height: np.ndarray
    slope: np.ndarray
    information: np.ndarray
    evaluations: np.ndarray
    has_converged: np.ndarray

    def laplace(self) -> tuple[np.ndarray, np.ndarray]:
        """Return covariances (M, K, K) and logarithms (M,) of the mass by Laplace's approximation.

        The mass of a peak is its posterior density times √|covariance|; it is 0 where the
        information is not positive definite.
        """
        # ln mass = height + ½ ln det covariance.
        covariance = np.linalg.inv(self.information)
        sign, log_determinant = np.linalg.slogdet(covariance)
        return covariance, np.where(sign > 0, self.height + 0.5 * log_determinant, -np.inf)


def poisson_information(counts: np.ndarray, mean: np.ndarray, slopes: np.ndarray) -> Evaluation:
    """Return deviance (n,), score (n, K) and Fisher information (n, K, K) of Poisson counts.

    Parameters
    ----------
    counts : ndarray, shape (n, P)
        Counts n of the pixels; NaN where a pixel is not used.
    mean : ndarray, shape (n, P)
        Expected counts μ, above 0.
    slopes : ndarray, shape (n, K, P)
        Derivatives of μ with respect to the parameters.
    """
    # Relative excess e = n/μ − 1 of each pixel.
    is_used = np.isfinite(counts)
    excess = np.where(is_used, counts / mean - 1.0, 0.0)
    # Deviance 2 Σ (n ln(n/μ) − (n − μ)). The form μ ((1 + e) ln(1 + e) − e) of its terms avoids
    # cancellation for small e; the limit keeps the logarithm of a pixel without counts finite.
    log_ratio = np.log1p(np.maximum(excess, -1.0 + 1e-12))
    deviance = 2.0 * (mean * ((1.0 + excess) * log_ratio - excess)).sum(axis=-1)
    # Score Σ e ∂μ, and information Σ ∂μ ∂μᵀ / μ.
    weighted_slopes = slopes * np.where(is_used, 1.0 / mean, 0.0)[:, None]
    score = (slopes @ excess[:, :, None])[:, :, 0]
    return deviance, score, weighted_slopes @ slopes.swapaxes(1, 2)


def add_normal_prior(
    likelihood: Evaluation, parameters: np.ndarray, precision: np.ndarray
) -> Evaluation:
    """Return the posterior of parameters whose priors are normal about 0, with its derivatives.

    Parameters
    ----------
    likelihood : Evaluation
        Deviance (n,), score (n, K) and information (n, K, K), as of `poisson_information`.
    parameters : ndarray, shape (n, K)
        Parameters x at which the likelihood was evaluated.
    precision : ndarray, shape (K,)
        Inverse variance 1/σ² of each prior; 0 where it is flat.

    Returns
    -------
    height, slope, information : ndarray, shapes (n,), (n, K) and (n, K, K)
        Logarithm of the posterior, its slope, and its expected information.
    """
    # ln p = −½ (deviance + Σ x²/σ²), slope = score − x/σ², information + 1/σ². A tiny information
    # under a flat prior keeps all matrices regular.
    deviance, score, information = likelihood
    height = -0.5 * (deviance + (precision * parameters**2).sum(axis=1))
    information = information + np.diag(np.maximum(precision, 1e-9))
    return height, score - precision * parameters, information


def compute_deviance_limit(pixels: np.ndarray | int, sigma: float = 4.0) -> np.ndarray:
    """Return the χ² or deviance above which a model image does not explain a star.

    For the true image both have the mean P and the variance 2P of P pixels; the limit is `sigma`
    standard deviations above the mean.
    """
    return np.asarray(pixels + sigma * np.sqrt(2.0 * pixels))


def combine_images(
    score: np.ndarray, information: np.ndarray, shared_count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Add up score and information of images that share their first parameters.

    Parameters
    ----------
    score, information : ndarray, shapes (n, F, k) and (n, F, k, k)
        Score and information of F images with respect to the k parameters of each.
    shared_count : int
        Number s of leading parameters that all images have in common.

    Returns
    -------
    score, information : ndarray, shapes (n, K) and (n, K, K)
        K = s + F (k − s): the common parameters, then the own parameters of each image in turn.
    """
    count, images, k = score.shape
    size = shared_count + images * (k - shared_count)
    # Likelihoods multiply: scores and informations of independent images add up.
    total_score = np.zeros((count, size))
    total_information = np.zeros((count, size, size))
    for image in range(images):
        # Columns of this image's parameters among all.
        first = shared_count + image * (k - shared_count)
        columns = np.r_[0:shared_count, first : first + k - shared_count]
        total_score[:, columns] += score[:, image]
        total_information[:, columns[:, None], columns] += information[:, image]
    return total_score, total_information


def climb(
    evaluate: Evaluate,
    start: np.ndarray,
    limit: np.ndarray | float,
    steps: Steps,
    group: np.ndarray | None = None,
) -> Peaks:
    """Climb from starts to the maxima of their posteriors.

    An undamped step with a small predicted gain is the last one. It is taken without another
    evaluation: its gain follows from slope and information.

    Parameters
    ----------
    evaluate : Evaluate
        Logarithm of the posterior, its slope and its expected information.
    start : ndarray, shape (M, K)
        Parameters at which the climbs begin.
    limit : float or ndarray, shape (K,)
        Parameters stay within ± this.
    steps : Steps
        Number of steps, criteria of the end, and damping.
    group : ndarray of int, shape (M,), optional
        Index of the posterior of each start; climbs far below the best of their group are
        abandoned.
    """
    # All climbs begin together; a climb that has arrived or is abandoned leaves `active`.
    start = np.clip(np.asarray(start, np.float64), -limit, limit)
    active = np.arange(len(start))
    evaluations = np.ones(len(start), int)
    peaks = Peaks(start.copy(), *evaluate(active, start), evaluations, np.zeros(len(start), bool))
    damping = np.full(len(start), steps.initial_damping)
    gain = np.full(len(start), np.inf)
    for _ in progress.steps("maxima of the posterior", range(steps.max_steps)):
        # Predicted gain sᵀg − ½ sᵀIs of the undamped step s. A damped step is small whatever the
        # distance of the maximum.
        step = _compute_damped_step(peaks, active, np.zeros(active.size), limit)
        gain[active] = np.einsum("nk,nk->n", step, peaks.slope[active])
        gain[active] -= 0.5 * np.einsum("nk,nkl,nl->n", step, peaks.information[active], step)
        promise = gain[active]
        # If only the leading parameters count, the others are marginalised: the information on the
        # leading ones is the inverse of their block of the covariance.
        if steps.counted_parameters is not None:
            leading = slice(steps.counted_parameters)
            covariance = np.linalg.inv(peaks.information[active])[:, leading, leading]
            step_counted, marginal = step[:, leading], np.linalg.inv(covariance)
            promise = 0.5 * np.einsum("nk,nkl,nl->n", step_counted, marginal, step_counted)
        # The last step of climbs that have arrived.
        is_last = promise <= steps.min_gain
        last_rows = active[is_last]
        peaks.parameters[last_rows] += step[is_last]
        peaks.height[last_rows] += gain[last_rows]
        peaks.has_converged[last_rows] = True
        # Climbs that continue.
        goes_on = ~peaks.has_converged & (damping < steps.max_damping)
        if group is not None:
            lowest = group_maximum(peaks.height, group) - steps.max_drop
            goes_on &= peaks.height + 2.0 * gain > lowest
            if steps.min_distance:
                is_joining = _find_joining(peaks, group, goes_on, steps.min_distance)
                peaks.height[is_joining], goes_on = -np.inf, goes_on & ~is_joining
        active = np.flatnonzero(goes_on)
        if not active.size:
            break
        # A damped step is kept if it raises the posterior. The damping falls by a factor of 10
        # after a good step and rises by as much after a bad one, but at least to 0.3: a smaller
        # damping would hardly shorten the step that has failed.
        parameters = peaks.parameters[active]
        parameters = parameters + _compute_damped_step(peaks, active, damping[active], limit)
        peaks.evaluations[active] += 1
        state = peaks.evaluations[active], peaks.has_converged[active]
        trial = Peaks(parameters, *evaluate(active, parameters), *state)
        tolerance = steps.relative_rounding * np.abs(peaks.height[active])
        is_improved = trial.height >= peaks.height[active] - tolerance
        peaks.put(active[is_improved], trial.select(is_improved))
        larger_damping = np.maximum(10.0 * damping[active], 0.3)
        damping[active] = np.where(is_improved, damping[active] / 10.0, larger_damping)
    return peaks


def _find_joining(
    peaks: Peaks, group: np.ndarray, is_active: np.ndarray, min_distance: float
) -> np.ndarray:
    """Return True for active climbs that are near a higher one, active or at its end; all (M,)."""
    # Pairs of a climb and a higher one of its group.
    height, lower = peaks.height, np.flatnonzero(is_active)
    is_pair = (group[lower, None] == group) & (height[lower, None] < height)
    first, higher = np.nonzero(is_pair & (is_active | peaks.has_converged))
    # Squared Mahalanobis distance gᵀ I g with the information of the higher one.
    gap = peaks.parameters[lower[first]] - peaks.parameters[higher]
    distance = np.einsum("nk,nkl,nl->n", gap, peaks.information[higher], gap)
    is_joining = np.zeros(len(group), bool)
    is_joining[lower[first[distance < min_distance**2]]] = True
    return is_joining


def _compute_damped_step(
    peaks: Peaks, active: np.ndarray, damping: np.ndarray, limit: np.ndarray | float
) -> np.ndarray:
    """Return the steps (a, K) of the peaks `active` with a damping (a,), within the limit.

    A step s solves (I + damping · diag I) s = g with the information I and the slope g.
    """
    parameters, slope = peaks.parameters[active], peaks.slope[active]
    information = peaks.information[active].copy()
    diagonal = np.arange(parameters.shape[1])
    information[:, diagonal, diagonal] *= 1.0 + damping[:, None]
    # A parameter at its limit that would exceed it is removed from the equations.
    is_fixed = ((parameters >= limit) & (slope > 0)) | ((parameters <= -limit) & (slope < 0))
    information[is_fixed[:, :, None] | is_fixed[:, None, :]] = 0.0
    information[:, diagonal, diagonal] += is_fixed
    # Its row and column are taken from the unit matrix: its step is 0.
    step = np.linalg.solve(information, np.where(is_fixed, 0.0, slope)[:, :, None])[:, :, 0]
    return np.asarray(np.clip(parameters + step, -limit, limit) - parameters)


def group_maximum(height: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return for each member the greatest height in its group; all of shape (M,)."""
    highest = np.full(group.max() + 1, -np.inf)
    np.maximum.at(highest, group, height)
    return np.asarray(highest[group])
