"""Evidence that a posterior mean over samples is near the exact one.

The error of the exact posterior mean is the minimum of all estimators: a tight bound. A mean over
too few samples, or over samples that miss a mode, has a larger error, which is not a bound. The
input is errors and variances of n stars, the output `Evidence`. Its property `tight` decides if
the tables call the error a bound, or only an upper limit of the bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from psfdae.methods.metrics import cluster_mean


@dataclass(frozen=True)
class Evidence:
    """Evidence that a posterior mean is near the exact one.

    Attributes
    ----------
    ess_low : float
        Minimum effective sample size, without a fraction `max_sparse` of the stars.
    calibration : float
        Mean squared error minus mean posterior variance in standard errors of this
        difference. For the exact posterior of stars drawn from the prior the two are equal:
        E|p − ⟨p⟩|² is the variance, for every image (e.g. Kay 1993, chapter 10).
    last_change : float
        Relative change of the error by the last fourfold growth of the samples.
    undetected : float
        Part of the error that vanishes if modes are added that are reached only from the truth.
    max_sparse : float
        Largest fraction of the stars that may have fewer samples than needed, or no estimate.
    """

    ess_low: float
    calibration: float
    last_change: float
    undetected: float
    max_sparse: ClassVar[float] = 0.01

    @classmethod
    def from_errors(
        cls,
        mse: np.ndarray,
        variance: np.ndarray,
        ess: np.ndarray,
        field: np.ndarray,
        last_change: float,
        undetected: float,
    ) -> Evidence:
        """Compute the evidence from errors, variances, effective sizes and fields of n stars.

        Stars without an estimate have an `mse` of NaN, and are treated as stars without samples.
        """
        has_estimate = np.isfinite(mse)
        # Effective size that all but the allowed fraction of stars reach; 0 without an estimate.
        ascending_ess = np.sort(np.where(has_estimate, ess, 0.0))
        ess_low = float(ascending_ess[int(cls.max_sparse * ess.size)])
        score = calibration(mse[has_estimate], variance[has_estimate], field[has_estimate])
        return cls(ess_low, score, last_change, undetected)

    @property
    def tight(self) -> bool:
        """True if all of the evidence says that the mean is near the exact one."""
        return (
            self.ess_low >= 10.0
            and abs(self.calibration) <= 2.0  # standard errors
            and self.last_change <= 0.05
            and abs(self.undetected) <= 0.05
        )


def calibration(error: np.ndarray, variance: np.ndarray, field: np.ndarray) -> float:
    """Return the mean of error − variance over its standard error, clustered by field.

    It is 0 if all variances are equal to the errors, and ±∞ without scatter.
    """
    difference = error - variance
    if not difference.any():
        return 0.0
    # Stars of one field are not independent: the standard error is clustered.
    mean, stderr = cluster_mean(difference, field)
    with np.errstate(divide="ignore"):
        return float(np.divide(mean, stderr))
