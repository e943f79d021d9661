"""Linear minimum-mean-square-error estimator with known noise level: an oracle.

ŷ = ȳ + C_yx (C_xx + N)⁻¹ (x − x̄) with the mean and the (cross-)covariance of the
noise-free training stars and their references, and the covariance N of the noise for the
given λ of the star, which is diagonal unless pixels were interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from psfdae.methods.interface import Look, Method, Needs, TrainingSet
from psfdae.stars.noise import NoiseModel


@dataclass(frozen=True, repr=False)
class LinearMmse(Method):
    """Second moments of a training set.

    Attributes
    ----------
    mean_x, mean_y : ndarray, shape (P,)
        Mean noise-free image and mean reference, P = d² pixels.
    cov_xx : ndarray, shape (P, P)
        Covariance of the noise-free images.
    cov_yx : ndarray, shape (P, P)
        Cross-covariance of references and images.
    noise : NoiseModel
        Noise of the images at a level λ.
    """

    look = Look("linear MMSE", "#009e73", "^", is_drawn=False)
    needs = Needs(level=True)
    storage = None

    mean_x: np.ndarray
    mean_y: np.ndarray
    cov_xx: np.ndarray
    cov_yx: np.ndarray
    noise: NoiseModel

    @classmethod
    def fit(cls, data: TrainingSet) -> LinearMmse:
        """Compute the moments of the training stars."""
        return cls.from_images(data.images[data.train], data.references[data.train], data.noise)

    @classmethod
    def from_images(cls, images: np.ndarray, references: np.ndarray, noise: NoiseModel) -> Self:
        """Compute the moments of noise-free images and references, both of shape (n, d, d)."""
        # Deviations from the mean image and the mean reference, in double precision.
        x = images.reshape(len(images), -1).astype(np.float64)
        y = references.reshape(len(references), -1).astype(np.float64)
        mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
        x -= mean_x
        y -= mean_y
        # C_xx and C_yx.
        return cls(mean_x, mean_y, x.T @ x / len(x), y.T @ x / len(x), noise)

    def predict(self, noisy: np.ndarray, level: float) -> np.ndarray:
        """Return estimates for noisy images of one noise level λ, shape (n, d, d)."""
        # N: the noise of the mean star; then the gain C_yx (C_xx + N)⁻¹, whose transpose is the
        # solution of a linear system, as C_xx + N is symmetric.
        system = self.cov_xx + self.noise.covariance(self.mean_x, level)
        gain = np.linalg.solve(system, self.cov_yx.T).T
        # ŷ = ȳ + gain (x − x̄), an image in each row.
        residual = noisy.reshape(len(noisy), -1) - self.mean_x
        return np.asarray((self.mean_y + residual @ gain.T).reshape(noisy.shape))
