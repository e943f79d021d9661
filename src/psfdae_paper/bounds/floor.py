"""Local error floor of a star image whose field, centring and frame are known.

Then only the Seidel coefficients c are unknown. Near their true values the image is
linear in c, p(c + δ) ≈ p + Jδ. As in any linear Gaussian problem, the posterior
covariance of c is (JᵀΣ⁻¹J + P⁻¹)⁻¹ with noise covariance Σ and prior covariance P
(e.g. Kay 1993, Fundamentals of Statistical Signal Processing: Estimation Theory,
chapter 11). It is a local approximation and not a lower limit: where the image is not
linear within the width of the posterior, the posterior mean can have a smaller error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psfdae.methods.metrics import cluster_mean


def compute_local_error(
    derivatives: np.ndarray, prior_sd: np.ndarray, variance: np.ndarray
) -> np.ndarray:
    """Compute tr[J (JᵀΣ⁻¹J + P⁻¹)⁻¹ Jᵀ] / N_pix of every star.

    Coefficients are in units of their prior standard deviations, P = 1, so that a
    term that cannot vary drops out instead of dividing by zero.

    Parameters
    ----------
    derivatives : ndarray, shape (n, K, P)
        Pixels per unit of each coefficient.
    prior_sd : ndarray, shape (K,)
        Prior standard deviations, ≥ 0.
    variance : ndarray, shape (n, P)
        Noise variance of every pixel.

    Returns
    -------
    ndarray, shape (n,)
        Mean squared error per pixel.
    """
    jacobian = derivatives * prior_sd[:, None]
    # Inverse of the posterior covariance, JᵀΣ⁻¹J + 1.
    weighted_jacobian = jacobian / variance[:, None]
    information = weighted_jacobian @ jacobian.swapaxes(1, 2) + np.eye(len(prior_sd))
    # The trace does not change if its factors rotate: tr[(JᵀΣ⁻¹J + 1)⁻¹ JᵀJ].
    square = jacobian @ jacobian.swapaxes(1, 2)
    trace = np.trace(np.linalg.solve(information, square), axis1=1, axis2=2)
    return np.asarray(trace / jacobian.shape[-1])


@dataclass(frozen=True)
class Comparison:
    """An estimator's errors compared with a bound, over the same stars.

    Attributes
    ----------
    mse, bound : float
        Mean squared error of the estimator, and the bound.
    difference, stderr : float
        Mean of their paired difference and its standard error, clustered by field.
    tolerance : float
        Part of the bound by which the estimator may lie below it: its approximation and its noise.
    """

    mse: float
    bound: float
    difference: float
    stderr: float
    tolerance: float = 0.05

    @classmethod
    def from_pairs(
        cls, errors: np.ndarray, bounds: np.ndarray, field: np.ndarray, tolerance: float = tolerance
    ) -> Comparison:
        """Compare squared errors and bounds of the same stars, which lie in `field`, all (n,)."""
        difference, stderr = cluster_mean(errors - bounds, field)
        return cls(float(errors.mean()), float(bounds.mean()), difference, stderr, tolerance)

    @property
    def efficiency(self) -> float:
        """Bound divided by MSE; NaN where either is 0."""
        return self.bound / self.mse if self.bound > 0 and self.mse > 0 else float("nan")

    @property
    def beaten(self) -> bool:
        """True if the estimator is below the bound by more than tolerance and two errors."""
        return self.difference < -(2.0 * self.stderr + self.tolerance * self.bound)
