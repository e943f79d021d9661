"""Joint fit of the numbers of a telescope to the stars of an image.

The aberrations of all stars depend on a few numbers of the telescope
(`psfdae.telescope.field.TelescopeModel`); in addition, each star has its own position, flux and
sky.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from psfdae.base.types import Table
from psfdae.optics.derivatives import SampledStamps
from psfdae.optics.pupil import SamplingError
from psfdae.sensing.climbing import (
    Evaluation,
    Peaks,
    Steps,
    add_normal_prior,
    climb,
    combine_images,
    poisson_information,
)
from psfdae.sensing.modes import compute_squared_distance
from psfdae.sensing.stars import MAX_Z, SensingError, StarModes, StarOptics, WavefrontSearch
from psfdae.telescope.field import TelescopeModel
from psfdae.telescope.raytracing import RayTracingError
from psfdae.telescope.settings import Seeing


@dataclass(frozen=True)
class Joint:
    """Fitted numbers of a telescope, with their standard errors.

    Attributes
    ----------
    model : TelescopeModel
        Names, units and prior of the numbers.
    value, error : ndarray, shape (Q,)
        Numbers of the telescope and their standard errors, in the units of the model.
    correlation : ndarray, shape (Q, Q)
        Correlation of the errors.
    probability : float
        Posterior probability of these numbers, 0 … 1; the rest is the probability of their twin,
        whose even aberrations have the opposite sign.
    twin : ndarray or None, shape (Q,)
        Numbers of the twin, if there is one.
    star : ndarray of int, shape (m,)
        Indices of the stars in the fit, in the order of the search.
    disagrees : ndarray of bool, shape (m,)
        True for stars that the numbers do not explain: their deviance exceeds the limit.
    """

    model: TelescopeModel
    value: np.ndarray
    error: np.ndarray
    correlation: np.ndarray
    probability: float
    twin: np.ndarray | None
    star: np.ndarray
    disagrees: np.ndarray

    @property
    def table(self) -> Table:
        """Table with a row for each number: name, unit, prior, fitted value, errors, correlation.

        `correlation` (Q,) is the correlation of the error with the errors of all numbers.
        """
        from astropy.table import Table

        columns = {
            "name": np.array(self.model.names, "U20"),
            "unit": np.array(self.model.units, "U8"),
            "prior": self.model.mean,
            "prior_error": self.model.sd,
            "value": self.value,
            "error": self.error,
            "correlation": self.correlation,
        }
        return Table(columns)


@dataclass(frozen=True, eq=False)
class TelescopePosterior:
    """Posterior of the numbers of a telescope, and of the position, flux and sky of each star.

    Its parameters are the Q standardised numbers t of the telescope, (number − prior mean)/prior σ,
    whose prior is normal with σ = 1, then four for each star: position (x, y) from the middle of
    the stamp in pixels, flux in units of `search.flux`, and sky above its measured level B in
    units of its noise √B in a pixel. If the FWHM of the seeing is one of the numbers, stamps are
    linear in it about the seeing of `optics`.

    Attributes
    ----------
    search : WavefrontSearch
        Search that has the counts and fluxes of all stars.
    model : TelescopeModel
        Model of all stars of the search.
    star : ndarray of int, shape (m,)
        Indices of the stars in the fit, in the order of the search.
    optics : StarOptics
        Optics with the seeing about which stamps are linear; the optics of `search` keep the seeing
        of the first round.
    """

    search: WavefrontSearch
    model: TelescopeModel
    star: np.ndarray
    optics: StarOptics
    max_seeing_change: ClassVar[float] = 0.5
    """Largest relative change of the FWHM of the seeing from its prior mean, and the largest
    decrease in one round of `fit_telescope`."""

    @property
    def number_count(self) -> int:
        """Number Q of numbers of the telescope."""
        return self.model.sd.size

    @cached_property
    def broadening(self) -> SampledStamps:
        """Propagation to the derivatives of stamps with respect to ln FWHM of the seeing."""
        return self.optics.propagation(self.optics.stamp_px, broadening=True)

    @property
    def seeing(self) -> Seeing:
        """Seeing of `optics`; only for a model that has the FWHM of the seeing as a number."""
        assert self.optics.telescope.seeing is not None
        return self.optics.telescope.seeing

    def relative_seeing(self, t: np.ndarray) -> float:
        """Return the FWHM of the seeing at standardised numbers t (Q,), relative to `optics`."""
        # The FWHM is the last number of the model.
        fwhm = self.model.mean[-1] + self.model.sd[-1] * t[-1]
        return float(fwhm / self.seeing.fwhm_arcsec)

    def replace_seeing(self, t: np.ndarray) -> TelescopePosterior:
        """Return the posterior whose optics have the seeing at standardised numbers t (Q,).

        The FWHM decreases by at most `max_seeing_change`, relative to the present optics.
        """
        fwhm = max(self.relative_seeing(t), 1.0 - self.max_seeing_change) * self.seeing.fwhm_arcsec
        # The same telescope with another seeing.
        seeing = self.seeing.model_copy(update={"fwhm_arcsec": fwhm})
        telescope = self.optics.telescope.model_copy(update={"seeing": seeing})
        return replace(self, optics=replace(self.optics, telescope=telescope))

    def coefficients(self, t: np.ndarray) -> np.ndarray:
        """Return the aberrations of the stars, (m, K) in waves, at standardised numbers t (Q,)."""
        return np.asarray(self.model.coefficients(self.model.mean + self.model.sd * t)[self.star])

    def slopes(self, t: np.ndarray) -> np.ndarray:
        """Return the derivatives of the coefficients with respect to t, (m, Q, K), in waves."""
        # ∂c/∂t = σ ∂c/∂number, from [number, star, coefficient] to [star, number, coefficient].
        jacobian = self.model.jacobian(self.model.mean + self.model.sd * t)
        return np.asarray(np.moveaxis(jacobian * self.model.sd[:, None, None], 0, 1)[self.star])

    def evaluate(self, _: np.ndarray, parameters: np.ndarray) -> Evaluation:
        """Evaluate the posterior, as an `Evaluate` of `psfdae.sensing.climbing.climb`.

        The first argument, the indices of the starts, is not used. A telescope through which rays
        cannot pass, or whose wavefronts are too steep for all pupil grids, has a height of −∞.

        Parameters
        ----------
        parameters : ndarray, shape (a, N)
            N = Q + 4 m: the numbers of the telescope, then four for each star.

        Returns
        -------
        height, score, information : ndarray, shapes (a,), (a, N) and (a, N, N)
            ln of the posterior, its gradient, and its expected information, prior included.
        """
        q, (count, size) = self.number_count, parameters.shape
        # Parameters for which no image can be computed keep a height of −∞.
        height, score = np.full(count, -np.inf), np.zeros((count, size))
        information = np.tile(np.eye(size), (count, 1, 1))
        # Normal prior of the numbers, flat priors of positions, fluxes and skies.
        precision = np.repeat([1.0, 0.0], [q, size - q])
        for row, values in enumerate(parameters):
            with suppress(RayTracingError, SamplingError):
                deviance, star_score, star_information = self.evaluate_stars(values)
                # The numbers are shared by all stars; the four parameters of each star have rows of
                # their own.
                totals = combine_images(star_score[None], star_information[None], q)
                likelihood = deviance.sum(keepdims=True), *totals
                posterior = add_normal_prior(likelihood, values[None], precision)
                (height[row],), (score[row],), (information[row],) = posterior
        return height, score, information

    def evaluate_stars(self, parameters: np.ndarray) -> Evaluation:
        """Evaluate each star separately at `parameters` (Q + 4 m,), without the prior.

        Returns
        -------
        deviance, score, information : ndarray, shapes (m,), (m, Q + 4), (m, Q + 4, Q + 4)
            Derivatives are with respect to the Q numbers and the four parameters of the star.
        """
        q, optics = self.number_count, self.optics
        t, star_parameters = parameters[:q], parameters[q:].reshape(len(self.star), 4)
        position_px = star_parameters[:, :2]
        # Stamps (m, d²) and their derivatives (m, Q + 2, d²) with respect to t and the position, by
        # the coefficients of the pupil's modes (a basis; these are not the peaks in `StarModes`).
        modes = optics.mode_coefficients(self.star, self.coefficients(t), position_px)
        directions = self.slopes(t) @ optics.terms.to_modes[self.star]
        stamps, slopes = optics.derivatives(modes, directions)
        if self.model.has_seeing:
            # p(w) = p(1) + (w − 1) ∂p/∂ln w about w = 1, the relative FWHM of the seeing.
            broadening_slope = self.broadening.stamps(modes).reshape(len(self.star), -1)
            broadening_slope = broadening_slope.astype(np.float64)
            stamps = stamps + (self.relative_seeing(t) - 1.0) * broadening_slope
            slopes[:, q - 1] = self.model.sd[-1] / self.seeing.fwhm_arcsec * broadening_slope
        expected_counts = self.search.predict_counts(self.star, stamps, slopes, star_parameters)
        return poisson_information(self.search.photons.counts[self.star], *expected_counts)


def fit_telescope(search: WavefrontSearch, modes: StarModes, model: TelescopeModel) -> Joint:
    """Fit the numbers of a telescope to the stamps of its stars.

    The fit uses the stars that a mode explains; of more than 500, those of the highest flux over
    sky noise.

    Parameters
    ----------
    search : WavefrontSearch
        Search that has the counts and fluxes of all stars.
    modes : StarModes
        Modes of the individual stars; stars that no mode explains are not used.
    model : TelescopeModel
        Model of all stars of the search.

    Returns
    -------
    Joint
        Numbers of the most probable peak of the posterior.

    Raises
    ------
    SensingError
        If the prior fixes all numbers, or there are fewer stars than half the numbers.
    """
    if not model.sd.size:
        raise SensingError("the prior fixes all numbers of the telescope: there is nothing to fit")
    # The 500 explained stars of the highest flux over sky noise; the computing time grows with
    # their number.
    optics, best_modes = search.optics, modes.best_modes
    best_modes = best_modes.select(search.is_explained(best_modes))
    stars = best_modes.star
    # Flux is the last but one parameter of a mode, in units of `search.flux`.
    flux_over_noise = search.flux[stars] * best_modes.parameters[:, -2]
    flux_over_noise = flux_over_noise / np.sqrt(search.photons.sky_counts[stars])
    stars = np.sort(stars[np.argsort(-flux_over_noise, kind="stable")[:500]])
    if stars.size * 2 < model.sd.size or not stars.size:
        raise SensingError(
            f"{stars.size} stars that a wavefront explains are too few for "
            f"{model.sd.size} numbers of the telescope"
        )
    modes = modes.select_stars(stars)
    posterior = TelescopePosterior(search, model, stars, optics)
    # Two starts: near the prior mean, and near the twin of the first start, unless rays cannot pass
    # the twin.
    q = posterior.number_count
    starts = [start_near(posterior, modes, np.zeros(q))]
    with suppress(RayTracingError):
        starts.append(start_near(posterior, modes, twin_numbers(posterior, starts[0][:q])))
    # Limits of the numbers, and of the positions of the stars.
    limit = np.full(starts[0].size, np.inf)
    limit[:q] = MAX_Z
    if model.has_seeing:
        limit[q - 1] = posterior.max_seeing_change * model.mean[-1] / model.sd[-1]
    limit[q:].reshape(-1, 4)[:, :2] = optics.reach_px
    steps = Steps(max_steps=30, min_gain=0.005, relative_rounding=1e-7)
    peaks = climb(posterior.evaluate, np.stack(starts), limit, steps)
    # Stamps are linearised in the seeing: they are computed again at the fitted FWHM until it
    # changes by less than 0.2 %, at most four times.
    for _ in range(4 if model.has_seeing else 0):
        t = peaks.parameters[peaks.height.argmax(), :q]
        if abs(posterior.relative_seeing(t) - 1.0) < 2e-3:
            break
        posterior = posterior.replace_seeing(t)
        peaks = climb(posterior.evaluate, peaks.parameters, limit, steps)
    return summarise_peaks(posterior, peaks)


def summarise_peaks(posterior: TelescopePosterior, peaks: Peaks) -> Joint:
    """Return the most probable numbers with their errors, and their twin if there is another peak.

    Parameters
    ----------
    posterior : TelescopePosterior
        Posterior of the numbers.
    peaks : Peaks
        Maxima reached from both starts; they may coincide.
    """
    model, star = posterior.model, posterior.star
    t = peaks.parameters[:, : posterior.number_count]
    covariance, log_evidence = peaks.laplace()
    best_peak = int(log_evidence.argmax())
    number_covariance = covariance[best_peak, : t.shape[1], : t.shape[1]]
    sigma = np.sqrt(np.diagonal(number_covariance))
    # A peak farther than a standard error from the best one in any number is a twin; the others are
    # the same peak.
    twins = np.flatnonzero(np.abs((t - t[best_peak]) / sigma).max(axis=1) > 1)
    # Evidence relative to the evidence of the best peak.
    relative_evidence = np.exp(log_evidence - log_evidence[best_peak])
    deviance = posterior.evaluate_stars(peaks.parameters[best_peak])[0]
    return Joint(
        model,
        value=model.mean + model.sd * t[best_peak],
        error=model.sd * sigma,
        correlation=number_covariance / sigma / sigma[:, None],
        probability=float(1.0 / (1.0 + relative_evidence[twins].sum())),
        twin=model.mean + model.sd * t[twins[0]] if twins.size else None,
        star=star,
        disagrees=deviance > posterior.search.photons.deviance_limit[star],
    )


def start_near(posterior: TelescopePosterior, modes: StarModes, t: np.ndarray) -> np.ndarray:
    """Return parameters near t (Q,) that agree with the modes of the individual stars.

    In each round the mode nearest to the telescope is chosen for every star, and the numbers are
    fitted to the chosen modes, weighted by their inverse covariance.

    Parameters
    ----------
    posterior : TelescopePosterior
        Posterior of the numbers.
    modes : StarModes
        All modes of the stars of the posterior.
    t : ndarray, shape (Q,)
        Standardised numbers from which the first round starts.

    Returns
    -------
    ndarray, shape (Q + 4 m,)
        Standardised numbers of the telescope, then position, flux and sky of the chosen mode of
        each star.
    """
    # Coefficients of all modes in waves, with their covariance. Its diagonal is increased by 1e-6
    # waves², because the variance of coefficients that the prior fixes is 0.
    optics = posterior.search.optics
    count, sd = optics.coefficient_count, optics.terms.sd[modes.star]
    mode_coefficients = optics.coefficients(modes.star, modes.parameters[:, :count])
    covariance = sd[:, :, None] * modes.covariance[:, :count, :count] * sd[:, None]
    covariance = covariance + 1e-6 * np.eye(count)
    # Row of the star of each mode in the posterior.
    row = np.searchsorted(posterior.star, modes.star)
    # Four rounds: another mode of a star may become the nearest as the numbers change.
    for _ in range(4):
        # Squared Mahalanobis distance of each mode; in this order, the first mode of each star is
        # the nearest.
        residual = mode_coefficients - posterior.coefficients(t)[row]
        distance2 = compute_squared_distance(residual[:, None], covariance)[:, 0]
        order = np.lexsort((distance2, modes.star))
        nearest = order[np.flatnonzero(np.diff(modes.star[order], prepend=-1))]
        # Gauss–Newton step of the numbers, with their prior.
        slopes = posterior.slopes(t)
        weighted_slopes = slopes @ np.linalg.inv(covariance[nearest])
        information = (weighted_slopes @ slopes.swapaxes(1, 2)).sum(axis=0) + np.eye(t.size)
        score = (weighted_slopes @ residual[nearest][:, :, None]).sum(axis=0)[:, 0] - t
        t = np.clip(t + np.linalg.solve(information, score), -MAX_Z, MAX_Z)
    return np.concatenate([t, modes.parameters[nearest, count:].ravel()])


def twin_numbers(posterior: TelescopePosterior, t: np.ndarray) -> np.ndarray:
    """Return standardised numbers of the twin of t (Q,), whose even coefficients are negated.

    Even terms have the same value at opposite points of the pupil. The numbers are a least-squares
    solution by Gauss–Newton steps, because often no telescope has exactly these coefficients.
    """
    is_even = posterior.search.optics.terms.is_even
    # Target coefficients of the twin; coefficients of odd terms do not change.
    target = np.where(is_even, -1.0, 1.0) * posterior.coefficients(t)
    # Few steps are enough: coefficients are linear in the numbers, or nearly so.
    for _ in range(4):
        # Each coefficient of each star is an equation for the numbers. Singular values below 1e-9
        # of the largest belong to combinations of numbers that change no coefficient.
        slopes = posterior.slopes(t).transpose(1, 0, 2).reshape(t.size, -1)
        residual = (target - posterior.coefficients(t)).ravel()
        t = np.clip(t + np.linalg.lstsq(slopes.T, residual, rcond=1e-9)[0], -MAX_Z, MAX_Z)
    return t
