"""Modes of posteriors of Poisson counts, many at once.

Fisher scoring: Gauss–Newton steps with the expected information of the current parameters,
damped after Levenberg and Marquardt where a step does not raise the posterior. What the counts
are expected to be is the caller's: one star's aberrations, those of a whole field, or the state
of a misaligned telescope.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

Evaluate = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Function of the numbers of some starts, (a,), and their parameters, (a, K): logarithm of the
posterior (a,), its slope (a, K), and the expected information with that of the prior (a, K, K)."""

DAMPING_FACTOR = 10.0
"""Levenberg–Marquardt damping factor, down after a good step and up after a bad one."""


class Steps(NamedTuple):
    """When a climb ends, and how carefully it starts."""

    most: int = 12
    least_gain: float = 0.02
    """Least gain in the logarithm of the posterior: a step that promises less is the last one."""
    decisive: int | None = None
    """First so many parameters, of which alone that gain is counted, whatever the others are."""
    first_damping: float = 1e-2
    most_damping: float = 1e6
    """Damping at which a climb is given up."""
    rounding: float = 0.0
    """Relative fall of the posterior that rounding may cause."""
    depth: float = np.inf
    """A climb is given up where even twice the promised gain leaves it this far below the best
    of its group."""


STEPS = Steps()


@dataclass
class Peaks:
    """Local maxima that the climbs have found.

    Attributes
    ----------
    parameters : ndarray, shape (M, K)
    height : ndarray, shape (M,)
        Logarithm of the posterior; with what the last step promised, where that was taken.
    slope, information : ndarray, shapes (M, K) and (M, K, K)
        Before the last step.
    evaluations : ndarray of int, shape (M,)
    converged : ndarray of bool, shape (M,)
    """

    parameters: np.ndarray
    height: np.ndarray
    slope: np.ndarray
    information: np.ndarray
    evaluations: np.ndarray = field(default_factory=lambda: np.empty(0, int))
    converged: np.ndarray = field(default_factory=lambda: np.empty(0, bool))

    def take(self, own: np.ndarray, others: Peaks, theirs: np.ndarray) -> None:
        """Put the results `theirs` of other climbs in place of those at `own`."""
        for name in ("parameters", "height", "slope", "information", "converged"):
            getattr(self, name)[own] = getattr(others, name)[theirs]


def poisson(
    counts: np.ndarray, expected: np.ndarray, slopes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Deviance (n,), score (n, K) and Fisher information (n, K, K) of Poisson counts.

    Parameters
    ----------
    counts : ndarray, shape (n, P)
        NaN where a pixel is not used.
    expected : ndarray, shape (n, P)
        Mean of the counts, above 0.
    slopes : ndarray, shape (n, K, P)
        Its derivatives.
    """
    used = np.isfinite(counts)
    excess = np.where(used, counts / expected - 1.0, 0.0)
    # 2 Σ (n ln(n/μ) − (n − μ)), each term μ ((1 + e) ln(1 + e) − e), without cancellation.
    logarithm = np.log1p(np.maximum(excess, -1.0 + 1e-12))
    deviance = 2.0 * (expected * ((1.0 + excess) * logarithm - excess)).sum(axis=-1)
    weighted = slopes * np.where(used, 1.0 / expected, 0.0)[:, None]
    score = (slopes @ excess[:, :, None])[:, :, 0]
    return deviance, score, weighted @ slopes.swapaxes(1, 2)


def together(
    score: np.ndarray, information: np.ndarray, shared: int
) -> tuple[np.ndarray, np.ndarray]:
    """Score (n, K) and information (n, K, K) of images that share their first parameters.

    Parameters
    ----------
    score, information : ndarray, shapes (n, F, k) and (n, F, k, k)
        Of F images, by the k parameters of each.
    shared : int
        Number s of the first that are common; K = s + F (k − s): after them, the others of each
        image in turn.
    """
    count, images, k = score.shape
    own = k - shared
    size = shared + images * own
    all_scores, joint = np.zeros((count, size)), np.zeros((count, size, size))
    for image in range(images):
        first = shared + image * own
        place = np.r_[0:shared, first : first + own]
        all_scores[:, place] += score[:, image]
        joint[:, place[:, None], place] += information[:, image]
    return all_scores, joint


def climb(
    evaluate: Evaluate,
    start: np.ndarray,
    limit: np.ndarray | float = np.inf,
    steps: Steps = STEPS,
    group: np.ndarray | None = None,
) -> Peaks:
    """Follow starts to the modes of their posteriors.

    A whole step that promises little is the last: it is taken, and its gain is what slope and
    information say, without another look.

    Parameters
    ----------
    evaluate : Evaluate
    start : ndarray, shape (M, K)
    limit : float or ndarray, shape (K,)
        Parameters stay within ± this.
    steps : Steps
    group : ndarray of int, shape (M,), optional
        Starts of one posterior, of which those far below the best are given up.
    """
    start = np.clip(np.asarray(start, np.float64), -limit, limit)
    active, trial = np.arange(len(start)), start
    now = Peaks(start.copy(), *evaluate(active, trial))
    now.evaluations = np.ones(len(start), int)
    now.converged = np.zeros(len(start), bool)
    damping = np.full(len(start), steps.first_damping)
    gain = np.full(len(start), np.inf)
    for _ in range(steps.most):
        # What damping makes small says nothing about how far the maximum is.
        whole = _step(now, active, np.zeros(active.size), limit)
        gain[active] = np.einsum("nk,nk->n", whole, now.slope[active])
        gain[active] -= 0.5 * np.einsum("nk,nkl,nl->n", whole, now.information[active], whole)
        promise = gain[active]
        if steps.decisive is not None:
            own = slice(steps.decisive)
            marginal = np.linalg.inv(np.linalg.inv(now.information[active])[:, own, own])
            promise = 0.5 * np.einsum("nk,nkl,nl->n", whole[:, own], marginal, whole[:, own])
        last = promise <= steps.least_gain
        done = active[last]
        now.parameters[done] += whole[last]
        now.height[done] += gain[done]
        now.converged[done] = True
        going = ~now.converged & (damping < steps.most_damping)
        if group is not None:
            going &= now.height + 2.0 * gain > best_of_group(now.height, group) - steps.depth
        active = np.flatnonzero(going)
        if not active.size:
            break
        trial = now.parameters[active] + _step(now, active, damping[active], limit)
        tried = Peaks(trial, *evaluate(active, trial), converged=now.converged[active])
        better = tried.height >= now.height[active] - steps.rounding * np.abs(now.height[active])
        now.take(active[better], tried, better)
        now.evaluations[active] += 1
        damping[active] *= np.where(better, 1.0 / DAMPING_FACTOR, DAMPING_FACTOR)
    return now


def _step(
    now: Peaks, active: np.ndarray, damping: np.ndarray, limit: np.ndarray | float
) -> np.ndarray:
    """Damped steps, cut at the limit; parameters held there leave the equations."""
    parameters, slope = now.parameters[active], now.slope[active]
    information = now.information[active].copy()
    held = ((parameters >= limit) & (slope > 0)) | ((parameters <= -limit) & (slope < 0))
    diagonal = np.arange(parameters.shape[1])
    information[:, diagonal, diagonal] *= 1.0 + damping[:, None]
    information[held[:, :, None] | held[:, None, :]] = 0.0
    information[:, diagonal, diagonal] += held
    step = np.linalg.solve(information, np.where(held, 0.0, slope)[:, :, None])[:, :, 0]
    return np.asarray(np.clip(parameters + step, -limit, limit) - parameters)


def best_of_group(height: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Greatest height in each one's group, shape (M,)."""
    best = np.full(group.max() + 1, -np.inf)
    np.maximum.at(best, group, height)
    return np.asarray(best[group])
