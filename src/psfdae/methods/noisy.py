"""No method at all: the noisy image itself, which all others have to beat."""

from __future__ import annotations

import numpy as np

from psfdae.methods.interface import Look, Method, TrainingSet


class Noisy(Method):
    """The image as it is."""

    look = Look("noisy", "#4d4d4d", paper=("original_noise", "original-noise"), restores=False)
    storage = None

    @classmethod
    def fit(cls, data: TrainingSet) -> Noisy:
        """There is nothing to learn."""
        return cls()

    def predict(self, noisy: np.ndarray) -> np.ndarray:
        """The images."""
        return noisy
