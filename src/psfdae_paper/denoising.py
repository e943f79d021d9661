"""Classical denoisers of scikit-image, which know the noise.

All that they learn from other stars is one strength, in units of the noise of a sky pixel: that
with the least error on validation stars at each noise level.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from psfdae.method import Method, Needs, TrainingSet
from psfdae.metrics import mse
from psfdae.noise import NoiseModel
from psfdae.rng import stream

STRENGTHS = tuple(2.0 ** np.arange(-2.0, 2.25, 0.5))
"""That are tried, in units of the noise's standard deviation."""

VALIDATION_STARS = 200
"""Most stars by which the strength is chosen."""


@dataclass(frozen=True)
class Denoiser(Method):
    """A denoiser with the strengths for some noise levels.

    Attributes
    ----------
    level : ndarray, shape (L,)
        Noise levels λ.
    strength : ndarray, shape (L,)
        At each of them, in units of the standard deviation of a sky pixel.
    noise : NoiseModel
    """

    needs = Needs(level=True)
    storage = None
    packing = None

    level: np.ndarray
    strength: np.ndarray
    noise: NoiseModel

    @classmethod
    def fit(cls, data: TrainingSet) -> Self:
        """Strengths with the least error on noisy validation stars."""
        stars = (data.validation if data.validation.size else data.fit)[:VALIDATION_STARS]
        images, references = data.images[stars], data.references[stars]
        rng = stream(data.seed, cls.name, "noise")
        chosen = []
        for level in data.levels:
            noisy = data.noise.draw(images, level, rng)
            sigma = data.noise.kappa * level
            errors = [mse(cls.denoised(noisy, sigma, s), references).mean() for s in STRENGTHS]
            chosen.append(STRENGTHS[int(np.argmin(errors))])
        return cls(np.asarray(data.levels), np.array(chosen), data.noise)

    def predict(self, noisy: np.ndarray, level: float) -> np.ndarray:
        """Images (n, d, d) of one noise level λ, denoised with the strength for the nearest."""
        nearest = np.abs(np.log(self.level / level)).argmin()
        return self.denoised(noisy, self.noise.kappa * level, self.strength[nearest])

    @classmethod
    def denoised(cls, noisy: np.ndarray, sigma: float, strength: float) -> np.ndarray:
        """Images (n, d, d) at a strength; `sigma` is the noise of a sky pixel."""
        # The functions have absolute tolerances, made for images between 0 and 1.
        peak = float(np.abs(noisy).max()) or 1.0
        scaled = noisy.astype(np.float64) / peak
        found = [cls.denoise(image, sigma / peak, strength * sigma / peak) for image in scaled]
        return (peak * np.array(found)).astype(np.float32)

    @staticmethod
    def denoise(image: np.ndarray, sigma: float, strength: float) -> np.ndarray:
        """One image (d, d); both numbers are in its unit."""
        raise NotImplementedError
