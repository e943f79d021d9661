"""Method `static_posterior`: the exact posterior mean of stars without random aberrations.

Behind static turbulence, a star is the static PSF of its field at one of the centring errors. The
posterior mean is a sum over all of them, weighted by the likelihood of the photons: two products of
matrices and a softmax between them, a network whose weights need no training. It needs the
simulation of the stars, which only select the fields.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from psfdae.methods.interface import Estimate, FitError, Look, Needs, TrainingSet
from psfdae.stars.noise import NoiseModel
from psfdae_paper.methods import PhotonMethod
from psfdae_paper.stars.fields import number_fields


@dataclass(frozen=True, eq=False)
class StaticPosterior(PhotonMethod):
    """Sum over the static PSFs of a telescope.

    Attributes
    ----------
    static : ndarray, shape (F, J, d, d)
        Static PSFs of the fields of the training stars, at all J centring errors.
    noise : NoiseModel
        Photon noise of the images.
    """

    look = Look("sum over static PSFs", "#999933", "P", is_drawn=False)
    needs = Needs(level=True)
    storage = None
    packing = None

    static: np.ndarray
    noise: NoiseModel

    @classmethod
    def fit(cls, data: TrainingSet) -> Self:
        """Propagate the static PSFs of the training stars' fields.

        Raises
        ------
        FitError
            If the stars are not simulated without random aberrations.
        """
        from psfdae_paper.bounds.estimates import propagate_static_psfs
        from psfdae_paper.configuration.compose import part
        from psfdae_paper.configuration.consistency import SIMULATION

        if data.simulation.get("scene", {}).get("name") != "turbulence":
            raise FitError(f"{cls.name}: needs stars without random aberrations (scene 2)")
        config = part(SIMULATION, data.simulation)
        numbers = number_fields(data.positions[data.train], config.grid.points)
        return cls(propagate_static_psfs(config)[np.unique(numbers)], data.noise)

    def estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None = None,
        with_sigma: bool = True,
    ) -> Estimate:
        """Return posterior means, and posterior standard deviations, the same for all pixels."""
        from psfdae_paper.bounds.posterior import Likelihood, compute_exact_posterior

        levels = np.broadcast_to(np.asarray(level, np.float64), len(noisy))
        psf, sigma = np.empty((2, *noisy.shape))
        # Counts are relative to the mean static PSF without centring error.
        middle = self.static[:, self.static.shape[1] // 2]
        for value in np.unique(levels):
            stars = levels == value
            likelihood = Likelihood.from_noise(self.noise, float(value), middle)
            mean, variance, _ = compute_exact_posterior(noisy[stars], self.static, likelihood)
            psf[stars], sigma[stars] = mean, np.sqrt(variance)[:, None, None]
        return Estimate(psf, sigma)
