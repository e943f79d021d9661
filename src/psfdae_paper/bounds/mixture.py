"""Mixture of Student's t that proposes draws of a star's coefficients around its modes.

It adapts to the weights of its draws (Cappé et al. 2008, Statistics and Computing 18, 447): every
component takes the weighted mean, scale and mass of its draws.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import lgamma
from typing import ClassVar

import numpy as np


@dataclass(frozen=True)
class Mixture:
    """Mixture of multivariate Student's t, one component around each mode.

    Attributes
    ----------
    mean : ndarray, shape (M, D)
        Centre of each component.
    factor : ndarray, shape (M, D, D)
        Lower Cholesky factor L of each scale matrix.
    evidence : ndarray, shape (M,)
        Logarithm of the mass of each mode.
    freedom : float
        Degrees of freedom ν; the tails are heavier than the tails of any normal posterior.
    """

    mean: np.ndarray
    factor: np.ndarray
    evidence: np.ndarray
    freedom: ClassVar[float] = 5.0

    def compute_squared_distance(self, draws: np.ndarray) -> np.ndarray:
        """Return (x − μ)ᵀ (LLᵀ)⁻¹ (x − μ) of draws x (n, D) from every mode, shape (M, n)."""
        # With L u = x − μ the squared distance is |u|².
        offset = np.linalg.solve(self.factor, (draws - self.mean[:, None]).swapaxes(1, 2))
        return np.asarray((offset**2).sum(axis=1))

    def log_density(self, squared_distance: np.ndarray) -> np.ndarray:
        """Return the log-density of each component at squared distances (M, n).

        With ν degrees of freedom in D dimensions, ln p = ln Γ((ν + D)/2) − ln Γ(ν/2)
        − (D/2) ln(νπ) − ln |L| − (ν + D)/2 ln(1 + distance²/ν).
        """
        terms = self.mean.shape[1]
        # ln |L| of a triangular matrix is the sum over its diagonal.
        log_determinant = np.log(np.diagonal(self.factor, axis1=1, axis2=2)).sum(axis=1)
        constant = lgamma(0.5 * (self.freedom + terms)) - lgamma(0.5 * self.freedom)
        constant -= 0.5 * terms * np.log(self.freedom * np.pi)
        tail = 0.5 * (self.freedom + terms) * np.log1p(squared_distance / self.freedom)
        return np.asarray(constant - log_determinant[:, None] - tail)

    def draw(self, mode: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw once around each of the modes `mode` (n,); shape (n, D)."""
        # Student's t is a normal variable times √(ν/χ²).
        normal = rng.standard_normal((mode.size, self.mean.shape[1]))
        stretch = np.sqrt(self.freedom / rng.chisquare(self.freedom, mode.size))
        offset = (self.factor[mode] @ (normal * stretch[:, None])[:, :, None])[:, :, 0]
        return np.asarray(self.mean[mode] + offset)

    def adapt(
        self, draws: np.ndarray, log_weight: np.ndarray, log_possible: np.ndarray | float = 0.0
    ) -> Mixture:
        """Return the mixture with means, scales and masses of weighted draws.

        One step of expectation maximisation for Student's t. The mixture is returned unchanged if
        all draws are impossible.

        Parameters
        ----------
        draws : ndarray, shape (n, D)
            Coefficients of every draw.
        log_weight : ndarray, shape (n,)
            Logarithm of the importance weights.
        log_possible : ndarray, shape (M, n)
            −∞ for draws that a mode cannot have made, otherwise 0.
        """
        if not np.isfinite(log_weight).any():
            return self
        smallest = np.finfo(float).tiny
        squared_distance, terms = self.compute_squared_distance(draws), self.mean.shape[1]
        # Responsibility of each component for each draw, times the weight of the draw.
        log_part = self.log_density(squared_distance) + log_possible + self.evidence[:, None]
        weight = np.exp(log_weight - log_weight.max())
        with np.errstate(invalid="ignore"):
            share = np.exp(log_part - np.logaddexp.reduce(log_part, axis=0))
        share = np.where(np.isfinite(share), share, 0.0) * weight
        mass = share.sum(axis=1)
        # Shrinkage towards the previous component: 10 effective draws, (Σw)²/Σw², move it half
        # way to the estimate from the draws.
        effective = mass**2 / np.maximum((share**2).sum(axis=1), smallest)
        gain = (effective / (effective + 10.0))[:, None]
        # Distant draws weigh (ν + D)/(ν + distance²), as in the maximum-likelihood fit of t.
        share *= (self.freedom + terms) / (self.freedom + squared_distance)
        share /= np.maximum(share.sum(axis=1, keepdims=True), smallest)
        # Weighted mean and scale matrix of the draws, as far as they are trusted.
        mean = self.mean + gain * (share @ draws - self.mean * share.sum(axis=1, keepdims=True))
        offset = draws - mean[:, None]
        scale = (share[:, :, None] * offset).swapaxes(1, 2) @ offset
        gain = gain[..., None]
        scale = gain * scale + (1.0 - gain) * (self.factor @ self.factor.swapaxes(1, 2))
        return Mixture(mean, np.linalg.cholesky(scale), np.log(np.maximum(mass, smallest)))
