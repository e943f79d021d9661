"""The telescope's optics as an estimator: wavefronts that explain a star, and their mean PSF.

It is given what the simulation knows: the telescope, the law of its random aberrations, and flux,
sky and noise level of the star. Modes of the posterior of the star's Seidel coefficients, of its
field and of where its stamp lies are found as for the error bounds
(`psfdae_paper.bounds.sampling`), and importance samples around them give the mean, unless enough
stars of a simulated bank are similar. A star that no mode explains gets the PSF of the Gaussian
mixture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from psfdae.method import Estimate, FitError, Look, Method, Needs, TrainingSet
from psfdae.methods.gmm import GaussianMixture, Gmm
from psfdae.rng import stream

if TYPE_CHECKING:
    from psfdae_paper.bounds.posterior import Bank, Likelihood, PosteriorSums
    from psfdae_paper.bounds.sampling import Modes, StampModel
    from psfdae_paper.configuration.schema import Config

BANK_STARS = 32000
"""Of a fit; the target `wavefront` has the bank of the error bounds."""

DRAWS = 100
"""Importance samples of a star."""

PARTS = 8
"""Of the bank, the first of which tells whether all of it would be enough."""


@dataclass(frozen=True, eq=False)
class Wavefront(Method):
    """What is known of the telescope and its stars.

    Attributes
    ----------
    bank : Bank
    seidel : ndarray, shape (M, 5)
        Coefficients of the bank's stars in waves.
    model : StampModel
    static : ndarray, shape (F, J, d, d)
        Static PSFs at all centring errors.
    data : TrainingSet
        From which stars that no mode explains get the Gaussian mixture.
    """

    look = Look("optics of the telescope", "#e69f00", "*", drawn=False)
    needs = Needs(level=True)
    storage = None
    packing = None
    fallback: ClassVar = GaussianMixture

    bank: Bank
    seidel: np.ndarray
    model: StampModel
    static: np.ndarray
    data: TrainingSet

    @classmethod
    def fit(cls, data: TrainingSet) -> Self:
        """Simulate the bank.

        Raises
        ------
        FitError
            If the stars are not simulated with random Seidel aberrations.
        """
        from psfdae_paper.bounds.estimates import fresh_stars
        from psfdae_paper.configuration.compose import part
        from psfdae_paper.configuration.consistency import SIMULATION

        simulated = data.simulation
        if simulated.get("scene", {}).get("name") != "seidel":
            raise FitError(f"{cls.name}: needs stars with random Seidel aberrations (scene 1)")
        config = part(SIMULATION, simulated)
        drawn = fresh_stars(config, "optics", BANK_STARS)
        return cls.with_bank({name: c.values for name, c in drawn.items()}, config, data)

    @classmethod
    def with_bank(cls, drawn: Mapping[str, np.ndarray], config: Config, data: TrainingSet) -> Self:
        """The method with the columns of a bank of stars, as `fresh_stars` draws them."""
        from psfdae_paper.bounds.estimates import stamp_model, static_psfs
        from psfdae_paper.bounds.posterior import Bank

        sizes = config.grid.points, config.framing.jitter_px
        bank = Bank(drawn["framed"], drawn["field_index"], drawn["peak"], *sizes)
        return cls(bank, drawn["seidel"], stamp_model(config), static_psfs(config), data)

    @cached_property
    def mixture(self) -> GaussianMixture:
        """For stars that no mode explains."""
        fitted: GaussianMixture = self.fallback.fit(self.data, Gmm())
        return fitted

    def estimate(
        self, noisy: np.ndarray, level: float | np.ndarray, position: np.ndarray | None = None
    ) -> Estimate:
        """PSFs of images of one noise level λ, shape (n, d, d), in the field of `position`."""
        level = float(np.asarray(level))
        return self.estimated(*self.posterior(noisy, level, position), noisy, level, position)

    def estimated(
        self,
        sums: PosteriorSums,
        explained: np.ndarray,
        noisy: np.ndarray,
        level: float,
        position: np.ndarray | None = None,
    ) -> Estimate:
        """What a `posterior` says of the reference: the same one serves both."""
        mean, variance = sums.mean_image, sums.variance
        if self.data.reference == "template":
            mean, variance = sums.template(self.static)
        psf, sigma = mean.reshape(noisy.shape), np.sqrt(variance).reshape(noisy.shape)
        lost = ~explained
        if lost.any():
            where = None if position is None else position[lost]
            other = self.mixture.estimate(noisy[lost], level, where)
            psf[lost], sigma[lost] = other.psf, other.sigma
        return Estimate(psf, sigma, explained=explained)

    def modes(
        self, noisy: np.ndarray, level: float, position: np.ndarray | None = None
    ) -> tuple[Modes, np.ndarray]:
        """Wavefronts that explain images, and numbers of the stars that none explains.

        Of every mode: field, place of the stamp, standardised coefficients
        (`StampModel.coefficients`) with the Cholesky factor of their covariance, and evidence.
        """
        from psfdae_paper.bounds.sampling import search

        own = self._fields(position)
        problem = (self.bank, self.seidel, noisy, self.likelihood(level), self.model)
        return search(*problem, own, anywhere=own is None)

    def likelihood(self, level: float) -> Likelihood:
        """Of photons at a noise level λ."""
        from psfdae_paper.bounds.posterior import Likelihood

        return Likelihood.of(self.data.noise, level, self._middle)

    @cached_property
    def _middle(self) -> np.ndarray:
        """Mean of the bank's stamps, (1, d, d): the same for all noise levels."""
        mean: np.ndarray = self.bank.stamps((self.bank.margin,) * 2).mean(axis=0, keepdims=True)
        return mean

    def posterior(
        self, noisy: np.ndarray, level: float, position: np.ndarray | None = None
    ) -> tuple[PosteriorSums, np.ndarray]:
        """Weighed samples of images (n, d, d) of one noise level λ, and whether they explain each.

        Where noise is high, enough stars of the bank are similar to an image. The others get
        importance samples around their modes.
        """
        from psfdae_paper.bounds.estimates import ENOUGH_ESS
        from psfdae_paper.bounds.sampling import PROPOSALS, SEARCH, sampled_sums

        sums = self._over_bank(noisy, level, self._fields(position))
        explained = np.ones(len(noisy), bool)
        few = np.flatnonzero(sums.effective_size < ENOUGH_ESS)
        rounds = [round(share * DRAWS) for share in PROPOSALS.rounds]
        for start in range(0, len(few), SEARCH.stars_at_once):
            block = few[start : start + SEARCH.stars_at_once]
            where = None if position is None else position[block]
            modes, missed = self.modes(noisy[block], level, where)
            names = (self.data.seed, self.name, f"{level:.6g}")
            rngs = [stream(*names, int(star)) for star in block]
            problem = (modes, noisy[block], np.full(len(block), -1), self.likelihood(level))
            found = sampled_sums(*problem, self.model, rounds, rngs).free_helped
            sums.put(block, found)
            explained[block[missed]] = False
        return sums, explained & (sums.total > 0)

    def _fields(self, position: np.ndarray | None) -> np.ndarray | None:
        """Numbers of the fields of stars, (n,), if the method is given them."""
        if not self.needs.position or position is None:
            return None
        fields: np.ndarray = np.rint(position @ [1, self.bank.points]).astype(int)
        return fields

    def _over_bank(self, noisy: np.ndarray, level: float, own: np.ndarray | None) -> PosteriorSums:
        """Sums over a part of the bank; over all of it where that promises to be enough."""
        from psfdae_paper.bounds.estimates import ENOUGH_ESS
        from psfdae_paper.bounds.posterior import (
            PosteriorSums,
            companions,
            merge,
            posterior_sums,
        )

        likelihood, fields, shifts = self.likelihood(level), *self.static.shape[:2]
        whole = PosteriorSums.empty(len(noisy), noisy[0].size, fields, shifts)

        def weighed(stars: np.ndarray, drawn: np.ndarray) -> PosteriorSums:
            given = None if own is None else own[stars]
            return posterior_sums(self.bank.take(drawn), noisy[stars], likelihood, own_field=given)

        for group, drawn in companions(len(noisy), own, self.bank):
            size = len(drawn) // PARTS
            part = weighed(group, drawn[:size])
            whole.put(group, part)
            samples = part.effective_size
            rich = (samples < ENOUGH_ESS) & (PARTS * samples >= ENOUGH_ESS)
            if rich.any():
                rest = weighed(group[rich], drawn[size:])
                whole.put(group[rich], merge([part.take(rich), rest]))
        return whole
