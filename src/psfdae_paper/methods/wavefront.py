"""The telescope's optics as an estimator: wavefronts that explain a star, and their mean PSF.

The telescope, the distribution of its random aberrations, and flux, sky and noise level of the star
are known. The unknowns are the star's Seidel coefficients, its field and the position of its stamp.
Where enough stars of a simulated bank are similar to the star, they give the posterior mean.
Elsewhere the modes of the posterior are searched as for the error bounds
(`psfdae_paper.bounds.mode_search`), and importance samples around them give the mean. A star that
no mode explains gets the PSF of the Gaussian mixture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np

from psfdae.base.rng import stream
from psfdae.methods.gmm import GaussianMixture, Gmm
from psfdae.methods.interface import Estimate, FitError, Look, Needs, TrainingSet
from psfdae_paper.methods import PhotonMethod
from psfdae_paper.stars.fields import number_fields

if TYPE_CHECKING:
    from psfdae_paper.bounds.modes import Modes
    from psfdae_paper.bounds.posterior import Bank, Likelihood, PosteriorSums
    from psfdae_paper.bounds.stamp_model import StampModel
    from psfdae_paper.configuration.schema import Config


@dataclass(frozen=True, eq=False)
class Wavefront(PhotonMethod):
    """Estimator that fits the telescope's wavefront to each star.

    Attributes
    ----------
    bank : Bank
        Simulated stars with random aberrations.
    model : StampModel
        Stamps as a function of coefficients, field and position.
    static : ndarray, shape (F, J, d, d)
        Static PSFs of the F fields at all J centring errors.
    data : TrainingSet
        Training stars of the Gaussian mixture, for stars that no mode explains.
    bank_stars : int
        Stars that a fit simulates for its bank; the target `wavefront` has the bank of the error
        bounds.
    draws_per_star : int
        Importance samples of each star.
    """

    look = Look("optics of the telescope", "#e69f00", "*", is_drawn=False)
    needs = Needs(level=True)
    storage = None
    packing = None
    fallback: ClassVar = GaussianMixture
    bank_stars: ClassVar[int] = 32000
    draws_per_star: ClassVar[int] = 100

    bank: Bank
    model: StampModel
    static: np.ndarray
    data: TrainingSet

    @classmethod
    def fit(cls, data: TrainingSet) -> Self:
        """Simulate a bank of stars of the training stars' telescope.

        Raises
        ------
        FitError
            If the stars are not simulated with random Seidel aberrations.
        """
        from psfdae_paper.bounds.estimates import simulate_fresh_stars
        from psfdae_paper.configuration.compose import part
        from psfdae_paper.configuration.consistency import SIMULATION

        # The bank has the configuration of the training stars under another name, which gives
        # other random streams.
        star_config = data.simulation
        if star_config.get("scene", {}).get("name") != "seidel":
            raise FitError(f"{cls.name}: needs stars with random Seidel aberrations (scene 1)")
        config = part(SIMULATION, star_config)
        columns = simulate_fresh_stars(config, "optics", cls.bank_stars)
        bank = {name: column.values for name, column in columns.items()}
        return cls.from_bank(bank, config, data)

    @classmethod
    def from_bank(
        cls, bank_columns: Mapping[str, np.ndarray], config: Config, data: TrainingSet
    ) -> Self:
        """Make the method from a bank, the columns of `simulate_fresh_stars`."""
        from psfdae_paper.bounds.estimates import build_stamp_model, propagate_static_psfs
        from psfdae_paper.bounds.posterior import Bank

        # The model and the static PSFs belong to the same telescope as the bank.
        bank = Bank.from_columns(bank_columns, config.grid.points, config.framing.jitter_px)
        return cls(bank, build_stamp_model(config), propagate_static_psfs(config), data)

    @cached_property
    def mixture(self) -> GaussianMixture:
        """Gaussian mixture for stars that no mode explains; fitted at its first use."""
        mixture: GaussianMixture = self.fallback.fit(self.data, Gmm())
        return mixture

    def estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None = None,
        with_sigma: bool = True,
    ) -> Estimate:
        """Estimate the PSFs of images (n, d, d) of one noise level λ.

        `position` (n, 2) are the grid indices of their fields, if the method is given them.
        """
        level = float(np.asarray(level))
        posterior = self.posterior(noisy, level, position)
        return self.estimate_from_posterior(*posterior, noisy, level, position)

    def estimate_from_posterior(
        self,
        sums: PosteriorSums,
        is_explained: np.ndarray,
        noisy: np.ndarray,
        level: float,
        position: np.ndarray | None = None,
    ) -> Estimate:
        """Return mean and standard deviation of the reference under a posterior.

        One posterior serves both references: realisations and templates.

        Parameters
        ----------
        sums : PosteriorSums
            Weighted sums over samples of the posterior, as `posterior` returns them.
        is_explained : ndarray of bool, shape (n,)
            True where a mode explains the star.
        noisy : ndarray, shape (n, d, d)
            Noisy stars.
        level : float
            Noise level λ.
        position : ndarray, shape (n, 2), optional
            Grid indices of the stars' fields.
        """
        # Posterior mean Σ w x / Σ w over the samples, and the variance about it; of templates, the
        # weights belong to static PSFs, by field and position.
        mean, variance = sums.mean_image, sums.variance
        if self.data.reference == "template":
            mean, variance = sums.template(self.static)
        psf, sigma = mean.reshape(noisy.shape), np.sqrt(variance).reshape(noisy.shape)
        # Stars without a mode get the estimate of the Gaussian mixture.
        has_no_mode = ~is_explained
        if has_no_mode.any():
            fields = None if position is None else position[has_no_mode]
            fallback = self.mixture.estimate(noisy[has_no_mode], level, fields)
            psf[has_no_mode], sigma[has_no_mode] = fallback.psf, fallback.sigma
        return Estimate(psf, sigma, is_explained=is_explained)

    def modes(
        self, noisy: np.ndarray, level: float, position: np.ndarray | None = None
    ) -> tuple[Modes, np.ndarray]:
        """Search the wavefronts that explain images.

        Returns
        -------
        modes : Modes
            Field, position of the stamp, standardised coefficients (`StampModel.coefficients`)
            with the Cholesky factor of their covariance, and evidence of every mode.
        unexplained : ndarray of int
            Numbers of the stars without a mode.
        """
        from psfdae_paper.bounds.mode_search import search
        from psfdae_paper.bounds.stamp_model import StarPosteriors

        # All fields are searched unless the field of each star is given.
        star_field = self._fields(position)
        likelihood = self.likelihood(level)
        posteriors = StarPosteriors(noisy, likelihood, self.model.coarsen(likelihood))
        return search(self.bank, posteriors, star_field, in_all_fields=star_field is None)

    def likelihood(self, level: float) -> Likelihood:
        """Return the likelihood of photon counts at a noise level λ."""
        from psfdae_paper.bounds.posterior import Likelihood

        return Likelihood.from_noise(self.data.noise, level, self._mean_stamp)

    @cached_property
    def _mean_stamp(self) -> np.ndarray:
        """Mean of the bank's stamps, (1, d, d): the same for all noise levels."""
        return np.asarray(self.bank.stamps((self.bank.margin,) * 2).mean(axis=0, keepdims=True))

    def posterior(
        self, noisy: np.ndarray, level: float, position: np.ndarray | None = None
    ) -> tuple[PosteriorSums, np.ndarray]:
        """Compute weighted samples of the posterior of images (n, d, d) of one noise level λ.

        Where noise is high, enough stars of the bank are similar to an image. The others get
        importance samples around their modes.

        Returns
        -------
        sums : PosteriorSums
            Weighted sums over the samples of each star.
        is_explained : ndarray of bool, shape (n,)
            True where a sample has a positive weight and, if modes were searched, one was found.
        """
        from psfdae_paper.bounds.estimates import ENOUGH_ESS, sum_over_bank
        from psfdae_paper.bounds.sampling import sample_posterior
        from psfdae_paper.bounds.stamp_model import StarPosteriors

        # First by the stars of the bank, whose weights are their likelihoods.
        likelihood = self.likelihood(level)
        sums = sum_over_bank(self.bank, noisy, likelihood, self._fields(position))
        is_explained = np.ones(len(noisy), bool)
        # Stars whose effective number of similar bank stars is too small.
        undersampled_stars = np.flatnonzero(sums.effective_size < ENOUGH_ESS)
        for start in range(0, len(undersampled_stars), 256):  # stars whose matches fit in memory
            block = undersampled_stars[start : start + 256]
            fields = None if position is None else position[block]
            modes, stars_without_mode = self.modes(noisy[block], level, fields)
            # A random stream for each star: its result does not depend on the others.
            names = (self.data.seed, self.name, f"{level:.6g}")
            rngs = [stream(*names, int(star)) for star in block]
            posteriors = StarPosteriors(noisy[block], likelihood, self.model.coarsen(likelihood))
            no_field = np.full(len(block), -1)
            samples, _ = sample_posterior(modes, posteriors, no_field, self.draws_per_star, rngs)
            sums.put(block, samples.with_truth)
            is_explained[block[stars_without_mode]] = False
        return sums, is_explained & (sums.weight_sum > 0)

    def _fields(self, position: np.ndarray | None) -> np.ndarray | None:
        """Return the numbers of the stars' fields, (n,), if the method is given them."""
        if not self.needs.position or position is None:
            return None
        return number_fields(position, self.bank.points)
