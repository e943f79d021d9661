"""When a posterior mean over samples is taken for the exact one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psfdae.metrics import clustered_mean

CHANGE = 0.05
"""Largest relative change of the error by the last fourfold growth of the samples."""

UNDETECTED = 0.05
"""Largest relative change of the error by modes that only the truth leads to."""

LEAST_ESS, FEW = 10.0, 0.01
"""Least effective sample size, and the fraction of the stars that may have less or no estimate."""

STANDARD_ERRORS = 2.0
"""Standard errors by which mean squared error and posterior variance may differ."""


@dataclass(frozen=True)
class Evidence:
    """Evidence that a posterior mean is near the exact one.

    Attributes
    ----------
    ess_low : float
        Effective sample size that all but `FEW` of the stars have at least.
    calibration : float
        Mean squared error minus mean posterior variance in standard errors of this
        difference. For the exact posterior of stars drawn from the prior the two are equal:
        E|p − ⟨p⟩|² is the variance, for every image (e.g. Kay 1993, chapter 10).
    last_change : float
        Relative change of the error by the last fourfold growth of the samples.
    undetected : float
        Part of the error that vanishes if modes are added that only the truth leads to.
    """

    ess_low: float
    calibration: float
    last_change: float
    undetected: float

    @classmethod
    def of(
        cls,
        mse: np.ndarray,
        variance: np.ndarray,
        ess: np.ndarray,
        field: np.ndarray,
        last_change: float,
        undetected: float,
    ) -> Evidence:
        """Evidence from squared errors, posterior variances, sizes and fields of stars (n,).

        Stars without an estimate have an `mse` of NaN.
        """
        known = np.isfinite(mse)
        low = float(np.sort(np.where(known, ess, 0.0))[int(FEW * ess.size)])
        deviation = calibration(mse[known], variance[known], field[known])
        return cls(low, deviation, last_change, undetected)

    @property
    def tight(self) -> bool:
        """Whether all of it says so."""
        return (
            self.ess_low >= LEAST_ESS
            and abs(self.calibration) <= STANDARD_ERRORS
            and self.last_change <= CHANGE
            and abs(self.undetected) <= UNDETECTED
        )


def calibration(error: np.ndarray, variance: np.ndarray, field: np.ndarray) -> float:
    """Mean of error − variance over its standard error, clustered by field; 0 if all agree."""
    difference = error - variance
    if not difference.any():
        return 0.0
    mean, stderr = clustered_mean(difference, field)
    with np.errstate(divide="ignore"):
        return float(np.divide(mean, stderr))
