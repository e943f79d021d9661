"""The telescope's optics as an estimator: wavefronts that explain a star, and their mean PSF.

It is given what the simulation knows: the telescope, the law of its random aberrations, and flux,
sky and noise level of the star. Modes of the posterior of the star's Seidel coefficients, of its
field and of where its stamp lies are found as for the error bounds
(`psfdae_paper.bounds.sampling`), from a bank of stars of its own; importance samples around them
give the mean. A star that no mode explains gets the PSF of the Gaussian mixture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from psfdae.method import Estimate, FitError, Look, Method, Needs, TrainingSet
from psfdae.methods.gmm import GaussianMixture, Gmm
from psfdae.rng import stream

if TYPE_CHECKING:
    from psfdae_paper.bounds.posterior import Bank, Likelihood, PosteriorSums
    from psfdae_paper.bounds.sampling import Modes, StampModel

BANK_STARS = 32000
"""Of the bank, of which most stars need a part only."""

DRAWS = 150
"""Importance samples of a star."""


@dataclass(frozen=True, eq=False)
class Wavefront(Method):
    """What is known of the telescope and its stars.

    Attributes
    ----------
    bank : Bank
    seidel : ndarray, shape (M, 5)
        Coefficients of the bank's stars in waves.
    model : StampModel
    static : ndarray, shape (F, J, d, d), or None
        Static PSFs at all centring errors, if these are to be found.
    mixture : GaussianMixture
        For stars that no mode explains.
    seed : int
    """

    look = Look("optics of the telescope", "#000000", "*", drawn=False)
    needs = Needs(level=True)
    storage = None
    packing = None
    fallback: ClassVar = GaussianMixture

    bank: Bank
    seidel: np.ndarray
    model: StampModel
    static: np.ndarray | None
    mixture: GaussianMixture
    seed: int

    @classmethod
    def fit(cls, data: TrainingSet) -> Self:
        """Simulate the bank, and fit the mixture.

        Raises
        ------
        FitError
            If the stars are not simulated with random Seidel aberrations.
        """
        from psfdae_paper.bounds.estimates import fresh_stars, stamp_model, static_psfs
        from psfdae_paper.bounds.posterior import Bank
        from psfdae_paper.configuration.compose import part
        from psfdae_paper.configuration.consistency import SIMULATION

        simulated: Mapping[str, Any] = data.simulation
        if simulated.get("scene", {}).get("name") != "seidel":
            raise FitError(f"{cls.name}: needs stars with random Seidel aberrations (scene 1)")
        config = part(SIMULATION, simulated)
        drawn = {name: c.values for name, c in fresh_stars(config, "optics", BANK_STARS).items()}
        sizes = config.grid.points, config.framing.jitter_px
        return cls(
            Bank(drawn["framed"], drawn["field_index"], drawn["peak"], *sizes),
            drawn["seidel"],
            stamp_model(config),
            static_psfs(config) if data.reference == "template" else None,
            cls.fallback.fit(data, Gmm()),
            data.seed,
        )

    def estimate(
        self, noisy: np.ndarray, level: float | np.ndarray, position: np.ndarray | None = None
    ) -> Estimate:
        """PSFs of images of one noise level λ, shape (n, d, d), in the field of `position`."""
        from psfdae_paper.bounds.sampling import SEARCH

        found = np.array(self.mixture.restore(noisy, level, position))
        for start in range(0, len(noisy), SEARCH.stars_at_once):
            block = slice(start, start + SEARCH.stars_at_once)
            where = None if position is None else position[block]
            sums, known = self.posterior(noisy[block], float(np.asarray(level)), where, start)
            mean = sums.mean_image if self.static is None else sums.template(self.static)[0]
            found[block][known] = mean[known].reshape(-1, *noisy.shape[1:])
        return Estimate(found)

    def modes(
        self, noisy: np.ndarray, level: float, position: np.ndarray | None = None
    ) -> tuple[Modes, np.ndarray]:
        """Wavefronts that explain images, and numbers of the stars that none explains.

        Of every mode: field, place of the stamp, standardised coefficients
        (`StampModel.coefficients`) with the Cholesky factor of their covariance, and evidence.
        """
        from psfdae_paper.bounds.sampling import search

        own = None
        if self.needs.position and position is not None:
            own = np.rint(position @ [1, self.bank.points]).astype(int)
        problem = (self.bank, self.seidel, noisy, self.likelihood(level), self.model)
        return search(*problem, own, anywhere=own is None)

    def likelihood(self, level: float) -> Likelihood:
        """Of photons at a noise level λ."""
        from psfdae_paper.bounds.posterior import Likelihood

        middle = self.bank.stamps((self.bank.margin,) * 2)
        return Likelihood.of(self.mixture.noise, level, middle)

    def posterior(
        self, noisy: np.ndarray, level: float, position: np.ndarray | None = None, first: int = 0
    ) -> tuple[PosteriorSums, np.ndarray]:
        """Sums over importance samples of stars, and whether a mode explains each, (n,).

        `first` is the number of the first star, of which the draws depend.
        """
        from psfdae_paper.bounds.sampling import PROPOSALS, sampled_sums

        modes, missed = self.modes(noisy, level, position)
        rounds = [round(share * DRAWS) for share in PROPOSALS.rounds]
        rngs = [
            stream(self.seed, self.name, f"{level:.6g}", first + star) for star in range(len(noisy))
        ]
        anywhere = np.full(len(noisy), -1)
        problem = (modes, noisy, anywhere, self.likelihood(level), self.model)
        sums = sampled_sums(*problem, rounds, rngs).free_helped
        known = sums.total > 0
        known[missed] = False
        return sums, known
