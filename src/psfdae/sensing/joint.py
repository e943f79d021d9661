"""State of the telescope, common to all stars of an image, by one fit.

All stars follow from a few numbers of the telescope (`psfdae.telescope.field.FieldModel`); each
has its own place, flux and sky besides.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from psfdae.optics.pupil import SamplingError
from psfdae.sensing.climbing import Peaks, Steps, climb, poisson, together
from psfdae.sensing.stars import (
    BESIDE,
    FARTHEST_Z,
    POOR_FIT,
    WEAK,
    Modes,
    Search,
    SensingError,
    StarOptics,
    expected_deviance,
)
from psfdae.telescope.field import FieldModel
from psfdae.telescope.raytracing import RayTracingError
from psfdae.telescope.settings import Seeing

MOST_STARS = 500
"""Most stars that take part, the brightest ones; cost grows with their number."""

CLIMB = Steps(most=30, least_gain=0.005, rounding=1e-7)

ROUNDS = 4
"""Rounds in which stars choose the mode nearest to the field, and the field follows them; and in
which stamps are computed anew for a seeing that was found."""

MOST_CHANGE, SEEING_ERROR = 0.5, 2e-3
"""Relative changes of the seeing's FWHM: the most that is allowed, from what is stated and
downwards in a round, and one that needs no other round."""


@dataclass(frozen=True)
class Joint:
    """State of a telescope.

    Attributes
    ----------
    model : FieldModel
    value, error : ndarray, shape (Q,)
        In the units of the model.
    correlation : ndarray, shape (Q, Q)
    probability : float
        Of this state against its twin, whose even aberrations have the other sign.
    twin : ndarray or None, shape (Q,)
        The twin's numbers, if one was found.
    star : ndarray of int, shape (m,)
        Stars that took part.
    deviance, expected, scatter : ndarray, shape (m,)
        Of each, with what is expected of it and its standard deviation.
    """

    model: FieldModel
    value: np.ndarray
    error: np.ndarray
    correlation: np.ndarray
    probability: float
    twin: np.ndarray | None
    star: np.ndarray
    deviance: np.ndarray
    expected: np.ndarray
    scatter: np.ndarray

    @property
    def disagrees(self) -> np.ndarray:
        """True for stars that the state does not explain, (m,)."""
        return self.deviance > self.expected + POOR_FIT * self.scatter


class FieldPosterior:
    """The posterior of the numbers of a field, and of the places, fluxes and skies of its stars.

    Stamps are those of `optics`; where the FWHM of the seeing is among the numbers, they depend on
    it by a straight line about that of `optics`.
    """

    def __init__(
        self, search: Search, model: FieldModel, stars: np.ndarray, optics: StarOptics
    ) -> None:
        self.search, self.model, self.stars, self.optics = search, model, stars, optics
        self.shared = model.sd.size

    def seeing(self, t: np.ndarray) -> float:
        """FWHM of the seeing at standardised numbers t (Q,), in that of `optics`."""
        fwhm = self.model.mean[-1] + self.model.sd[-1] * t[-1]
        return float(fwhm / self._stated.fwhm_arcsec)

    @property
    def _stated(self) -> Seeing:
        assert self.optics.telescope.seeing is not None, "the model has one"
        return self.optics.telescope.seeing

    def refocused(self, t: np.ndarray) -> FieldPosterior:
        """The same with optics of the seeing at standardised numbers t (Q,)."""
        fwhm = max(self.seeing(t), 1.0 - MOST_CHANGE) * self._stated.fwhm_arcsec
        seeing = self._stated.model_copy(update={"fwhm_arcsec": fwhm})
        changed = self.optics.telescope.model_copy(update={"seeing": seeing})
        optics = replace(self.optics, telescope=changed)
        return FieldPosterior(self.search, self.model, self.stars, optics)

    def coefficients(self, t: np.ndarray) -> np.ndarray:
        """Coefficients of the stars (m, K) in waves, of standardised numbers t (Q,)."""
        return np.asarray(self.model.coefficients(self.model.mean + self.model.sd * t)[self.stars])

    def slopes(self, t: np.ndarray) -> np.ndarray:
        """Their derivatives by t, (m, Q, K)."""
        whole = self.model.jacobian(self.model.mean + self.model.sd * t)
        return np.asarray(np.moveaxis(whole * self.model.sd[:, None, None], 0, 1)[self.stars])

    def evaluate(
        self, _: np.ndarray, numbers: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `psfdae.sensing.climbing.Evaluate`; states without an image are impossible."""
        parts = [self._one(each) for each in numbers]
        height, score, information = (np.stack(part) for part in zip(*parts, strict=True))
        return height, score, information

    def deviance(self, numbers: np.ndarray) -> np.ndarray:
        """Deviance of every star, (m,)."""
        return self._images(numbers)[0]

    def _images(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q, optics, photons = self.shared, self.optics, self.search.photons
        own, stars = numbers[q:].reshape(len(self.stars), BESIDE), self.stars
        to_modes = optics.terms.to_modes[stars]
        coefficients = np.einsum("mk,mkj->mj", self.coefficients(numbers[:q]), to_modes)
        directions = np.pad(self.slopes(numbers[:q]) @ to_modes, ((0, 0), (0, 2), (0, 2)))
        directions[:, [-2, -1], [-2, -1]] = 1.0
        modes = np.concatenate([coefficients, own[:, :2]], axis=1)
        stamps, slopes = optics.operator.derivatives(modes, directions)
        stamps = stamps.reshape(len(stars), -1).astype(np.float64)
        slopes = slopes.reshape(len(stars), q + 2, -1).astype(np.float64)
        if self.model.seeing:
            wider = optics.broadening.stamps(modes).reshape(len(stars), -1).astype(np.float64)
            here = self.seeing(numbers[:q])
            stamps = stamps + (here - 1.0) * wider
            slopes[:, q - 1] = self.model.sd[-1] / self._stated.fwhm_arcsec * wider
        return poisson(photons.counts[stars], *self.search.expected(stars, stamps, slopes, own))

    def _one(self, numbers: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        q = self.shared
        try:
            deviance, score, information = self._images(numbers)
        except (RayTracingError, SamplingError):
            return -np.inf, np.zeros(numbers.size), np.eye(numbers.size)
        both = together(score[None], information[None], q)
        score, information = both[0][0], both[1][0]
        score[:q] -= numbers[:q]
        information[range(q), range(q)] += 1.0
        information[range(q, len(score)), range(q, len(score))] += WEAK
        height = -0.5 * (deviance.sum() + (numbers[:q] ** 2).sum())
        return height, score, information


def joint_fit(search: Search, modes: Modes, model: FieldModel) -> Joint:
    """Fit the numbers of a field to the stamps of all its stars.

    Parameters
    ----------
    search : Search
    modes : Modes
        Of the single stars; those that no mode explains take no part.
    model : FieldModel
        Of all stars of the search.

    Raises
    ------
    SensingError
        If there are fewer stars than half the numbers, or no number is free.
    """
    if not model.sd.size:
        raise SensingError("the prior leaves nothing of the telescope free: its widths are 0")
    first = modes.take(modes.first)
    explained = search.explained(first)
    stars = first.star[explained]
    # In units of the sky's noise.
    light = search.flux[stars] * first.numbers[explained, -2] / np.sqrt(search.photons.sky[stars])
    stars = np.sort(stars[np.argsort(-light, kind="stable")[:MOST_STARS]])
    if stars.size * 2 < model.sd.size or not stars.size:
        raise SensingError(
            f"{stars.size} stars that a wavefront explains are too few for "
            f"{model.sd.size} numbers of the telescope"
        )
    kept = modes.take(np.flatnonzero(np.isin(modes.star, stars)))
    field = FieldPosterior(search, model, stars, search.optics)
    ahead = _start(field, kept, np.zeros(field.shared))
    starts = [ahead]
    with suppress(RayTracingError):  # where there is no such telescope
        starts.append(_start(field, kept, _twin(field, ahead[: field.shared])))
    limit = np.full(ahead.size, np.inf)
    limit[: field.shared] = FARTHEST_Z
    if model.seeing:
        limit[field.shared - 1] = MOST_CHANGE * model.mean[-1] / model.sd[-1]
    limit[field.shared :].reshape(-1, BESIDE)[:, :2] = search.optics.reach_px
    peaks = climb(field.evaluate, np.stack(starts), limit, CLIMB)
    for _ in range(ROUNDS if model.seeing else 0):
        best = peaks.parameters[peaks.height.argmax(), : field.shared]
        if abs(field.seeing(best) - 1.0) < SEEING_ERROR:
            break
        field = field.refocused(best)
        peaks = climb(field.evaluate, peaks.parameters, limit, CLIMB)
    return _joint(field, peaks)


def _joint(field: FieldPosterior, peaks: Peaks) -> Joint:
    q, model = field.shared, field.model
    covariance = np.linalg.inv(peaks.information)
    evidence = peaks.height + 0.5 * np.linalg.slogdet(covariance)[1]
    best = int(evidence.argmax())
    t = peaks.parameters[:, :q]
    own = covariance[best, :q, :q]
    sigma = np.sqrt(np.diagonal(own))
    apart = [m for m in range(len(t)) if m != best and np.abs((t[m] - t[best]) / sigma).max() > 1]
    mass = np.exp(evidence - evidence[best])
    total = 1.0 + sum(mass[m] for m in apart)
    expected, scatter = expected_deviance(field.search.photons, field.stars)
    return Joint(
        model,
        model.mean + model.sd * t[best],
        model.sd * sigma,
        own / sigma / sigma[:, None],
        float(1.0 / total),
        model.mean + model.sd * t[apart[0]] if apart else None,
        field.stars,
        field.deviance(peaks.parameters[best]),
        expected,
        scatter,
    )


def _start(field: FieldPosterior, modes: Modes, t: np.ndarray) -> np.ndarray:
    """Numbers of the field and the stars from the stars' own modes, near standardised t (Q,)."""
    terms, k = field.search.optics.terms, field.search.optics.count
    mean, sd = terms.mean[modes.star], terms.sd[modes.star]
    found = mean + sd * modes.numbers[:, :k]
    spread = sd[:, :, None] * modes.covariance[:, :k, :k] * sd[:, None]
    spread = spread + 1e-6 * np.eye(k)
    row = np.searchsorted(field.stars, modes.star)
    for _ in range(ROUNDS):
        gap = found - field.coefficients(t)[row]
        far = np.einsum("mk,mk->m", gap, np.linalg.solve(spread, gap[:, :, None])[:, :, 0])
        chosen = np.lexsort((far, modes.star))
        chosen = chosen[np.flatnonzero(np.diff(modes.star[chosen], prepend=-1))]
        slopes = field.slopes(t)
        weighted = slopes @ np.linalg.inv(spread[chosen])
        information = (weighted @ slopes.swapaxes(1, 2)).sum(axis=0) + np.eye(t.size)
        pull = (weighted @ gap[chosen][:, :, None]).sum(axis=0)[:, 0] - t
        t = np.clip(t + np.linalg.solve(information, pull), -FARTHEST_Z, FARTHEST_Z)
    return np.concatenate([t, modes.numbers[chosen, k:].ravel()])


def _twin(field: FieldPosterior, t: np.ndarray) -> np.ndarray:
    """Standardised numbers whose stars have the even coefficients of t (Q,) negated, nearly."""
    even = field.search.optics.terms.even
    wanted = np.where(even, -1.0, 1.0) * field.coefficients(t)
    back = t
    for _ in range(ROUNDS):
        slopes = field.slopes(back).transpose(1, 0, 2).reshape(t.size, -1)
        gap = (wanted - field.coefficients(back)).ravel()
        back = back + np.linalg.lstsq(slopes.T, gap, rcond=1e-9)[0]
        back = np.clip(back, -FARTHEST_Z, FARTHEST_Z)
    return back
