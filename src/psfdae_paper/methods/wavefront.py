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
    from psfdae_paper.bounds.sampling import StampModel

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
        from psfdae_paper.bounds.posterior import Likelihood
        from psfdae_paper.bounds.sampling import SEARCH

        assert np.ndim(level) == 0, "images of one noise level"
        middle = self.bank.stamps((self.bank.margin,) * 2)
        likelihood = Likelihood.of(self.mixture.noise, float(level), middle)
        own = None
        if self.needs.position and position is not None:
            own = np.rint(position @ [1, self.bank.points]).astype(int)
        found = np.array(self.mixture.restore(noisy, level, position))
        for start in range(0, len(noisy), SEARCH.stars_at_once):
            block = slice(start, start + SEARCH.stars_at_once)
            rngs = [
                stream(self.seed, self.name, f"{level:.6g}", star)
                for star in range(start, min(block.stop, len(noisy)))
            ]
            fields = None if own is None else own[block]
            sums, known = self.posterior(noisy[block], fields, likelihood, rngs)
            mean = sums.mean_image if self.static is None else sums.template(self.static)[0]
            found[block][known] = mean[known].reshape(-1, *noisy.shape[1:])
        return Estimate(found)

    def posterior(
        self,
        noisy: np.ndarray,
        own: np.ndarray | None,
        likelihood: Likelihood,
        rngs: list[np.random.Generator],
    ) -> tuple[PosteriorSums, np.ndarray]:
        """Sums over importance samples of stars, and whether a mode explains each, (n,).

        `own` are the stars' fields (n,) if they are given, `rngs` a generator of each.
        """
        from psfdae_paper.bounds.sampling import PROPOSALS, sampled_sums, search

        modes, missed = search(self.bank, self.seidel, noisy, likelihood, self.model, own)
        rounds = [round(share * DRAWS) for share in PROPOSALS.rounds]
        anywhere = np.full(len(noisy), -1)
        sums = sampled_sums(
            modes, noisy, anywhere, likelihood, self.model, rounds, rngs
        ).free_helped
        known = sums.total > 0
        known[missed] = False
        return sums, known
