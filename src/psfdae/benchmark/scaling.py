"""How a cost grows: power laws, their uncertainty, and what they predict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PowerLaw:
    """y = scale · x^exponent.

    Attributes
    ----------
    scale, exponent : float
    stderr : float
        Standard error of the exponent; NaN for two points, which leave nothing to judge by.
    """

    scale: float
    exponent: float
    stderr: float

    def __call__(self, x: float) -> float:
        """Value at x."""
        return float(self.scale * x**self.exponent)

    def reaches(self, limit: float) -> float:
        """x at which y is `limit`; infinite if it never is, or beyond what a float holds."""
        if self.exponent <= 0:
            return 0.0 if limit <= self.scale else np.inf
        with np.errstate(over="ignore"):
            return float(np.exp(np.log(limit / self.scale) / self.exponent))


def fit_power_law(x: np.ndarray, y: np.ndarray) -> PowerLaw:
    """Least squares of log y over log x.

    Parameters
    ----------
    x, y : ndarray, shape (n,)
        Positive, at least two different x.

    Raises
    ------
    ValueError
        If a value is not positive or there are fewer than two different x.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    if np.unique(x).size < 2 or not (x > 0).all() or not (y > 0).all():
        raise ValueError(f"no power law through x = {x.tolist()}, y = {y.tolist()}")
    u, v = np.log(x), np.log(y)
    spread = ((u - u.mean()) ** 2).sum()
    exponent = ((u - u.mean()) * (v - v.mean())).sum() / spread
    residual = v - v.mean() - exponent * (u - u.mean())
    free = x.size - 2
    stderr = np.sqrt((residual**2).sum() / free / spread) if free else np.nan
    return PowerLaw(float(np.exp(v.mean() - exponent * u.mean())), float(exponent), float(stderr))
