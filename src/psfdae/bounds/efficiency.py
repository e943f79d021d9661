"""How close an estimator comes to a bound, star by star."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psfdae.evaluation.metrics import clustered_mean

TOLERANCE = 0.05
"""Part of a bound by which an estimator may lie below it: its approximation and its noise."""

STANDARD_ERRORS = 2.0
"""Standard errors of the paired difference by which it may lie below it besides."""


@dataclass(frozen=True)
class Comparison:
    """An estimator's errors beside a bound, over the same stars.

    Attributes
    ----------
    mse, bound : float
        Mean squared error of the estimator, and the bound.
    difference, stderr : float
        Mean of their paired difference and its standard error, clustered by field.
    """

    mse: float
    bound: float
    difference: float
    stderr: float

    @property
    def efficiency(self) -> float:
        """Bound divided by MSE; NaN where the bound is 0."""
        return self.bound / self.mse if self.bound > 0 and self.mse > 0 else float("nan")

    @property
    def beaten(self) -> bool:
        """Whether the estimator is below the bound by more than the tolerance."""
        return self.difference < -(STANDARD_ERRORS * self.stderr + TOLERANCE * self.bound)


def compare(errors: np.ndarray, bounds: np.ndarray, field: np.ndarray) -> Comparison:
    """Compare an estimator with a bound.

    Parameters
    ----------
    errors, bounds : ndarray, shape (n,)
        Squared error and bound of every star.
    field : ndarray of int, shape (n,)
        Field of every star.
    """
    difference, stderr = clustered_mean(errors - bounds, field)
    return Comparison(float(errors.mean()), float(bounds.mean()), difference, stderr)
