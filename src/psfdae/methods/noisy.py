"""The noisy image itself, as a baseline for all methods."""

from __future__ import annotations

import numpy as np

from psfdae.methods.interface import Look, Method, TrainingSet


class Noisy(Method):
    """The unchanged image."""

    look = Look("noisy", "#4d4d4d", paper=("original_noise", "original-noise"), restores=False)
    storage = None

    @classmethod
    def fit(cls, data: TrainingSet) -> Noisy:
        """Return the method; nothing is fitted."""
        return cls()

    def predict(self, noisy: np.ndarray) -> np.ndarray:
        """Return the images unchanged."""
        return noisy
