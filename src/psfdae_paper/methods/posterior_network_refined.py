"""Method `posterior_network_refined`: a network whose wavefronts the optics refine.

The posterior network proposes the wavefront of a star besides its PSF. Gauss–Newton steps on the
stamp of the telescope refine it (`psfdae_paper.bounds.refinement`). Where the image determines the
wavefront, the posterior mean about it has nearly the minimum error; elsewhere the network is
better. The result is a mean of both, weighted by their variances and the misfit of the wavefront.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from psfdae.methods.interface import Estimate, FitError, Look, Needs, Storage, TrainingSet
from psfdae.stars.noise import build_noise
from psfdae_paper.configuration.posterior_network import PosteriorNetworkSettings
from psfdae_paper.methods.posterior_network import PosteriorNetworkMethod

if TYPE_CHECKING:
    from psfdae_paper.bounds.posterior_network import PosteriorNetwork
    from psfdae_paper.bounds.refinement import Combination, Refiner
    from psfdae_paper.configuration.schema import Config


class RefinedPosteriorNetwork(PosteriorNetworkMethod):
    """Trained network, optics of the telescope, and weights of both.

    Parameters
    ----------
    network : PosteriorNetwork
        Trained network.
    refiner : Refiner
        Optics with the prior of the aberrations.
    combination : Combination
        Weights of the refined PSFs, and the factor of the standard deviations.
    history : list of dict
        Course of the training.
    """

    look = Look("refined posterior network", "#332288", "D", is_drawn=False)
    needs = Needs(level=True, validation=True, memory_mb=2000, minutes=60)
    storage = Storage(
        arrays={
            **PosteriorNetworkMethod.list_arrays(),
            "seidel_mean": ("waves", "mean of the Seidel coefficients"),
            "seidel_sd": ("waves", "their standard deviations"),
            "relative_field": ("1", "field vectors, 1 at the edge on an axis"),
            "pixel": ("λ/D", "width of a pixel"),
            "obscuration": ("1", "linear central obscuration of the pupil"),
            "combination": ("1", "factors of the weights of refined PSFs at each level"),
            "combined_scale": ("1", "factor of the combined standard deviations at each level"),
            "combined_ratio95": ("1", "of these, how many hold 95 % of the errors, at each level"),
        },
        diagnostics=PosteriorNetworkMethod.storage.diagnostics,
        per_reference=True,
    )
    assumes_independent_pixels = True
    proposes_wavefronts = True

    def __init__(
        self,
        network: PosteriorNetwork,
        refiner: Refiner,
        combination: Combination,
        history: list[dict[str, Any]] | None = None,
    ) -> None:
        super().__init__(network, history)
        self.refiner, self.combination = refiner, combination

    @classmethod
    def check(cls, config: Config) -> None:
        """Raise ConfigError if it is used with other noise than Poisson noise, its likelihood."""
        if cls.name in config.methods:
            config.noise.require_poisson(f"methods: {cls.name} is")

    @classmethod
    def fit(cls, data: TrainingSet, posterior_network: PosteriorNetworkSettings) -> Self:
        """Train the network, and weigh it against the optics on further simulated stars.

        Raises
        ------
        FitError
            If the stars are not simulated with random Seidel aberrations, or the reference is their
            template.
        """
        from psfdae_paper.bounds.estimates import build_stamp_model
        from psfdae_paper.bounds.refinement import Combination, NetworkStarts, Refiner, SeidelPrior

        if data.simulation and data.simulation["scene"]["name"] != "seidel":
            raise FitError(f"{cls.name}: needs stars with random Seidel aberrations (scene 1)")
        training = cls.train(data, posterior_network)
        model = build_stamp_model(training.config)
        prior = SeidelPrior(model.mean, model.sd, model.field, model.telescope.pixel)
        optics = model.telescope.obscuration, model.framing.stamp_px
        refiner = Refiner(prior, *optics, data.noise)
        network, stars = training.finish(), training.draw_fresh_stars()
        # Every star at every noise level.
        count, levels = len(stars.stamps), np.sort(data.levels)
        truth, level = np.tile(stars.stamps, (len(levels), 1)), np.repeat(levels, count)
        images = truth.reshape(-1, *data.images.shape[1:])
        noisy = data.noise.draw(images, level, training.stream("combination"))
        starts = NetworkStarts.compute(network, noisy, level, prior.pixel)
        posteriors = refiner.refine(noisy, level, starts)
        combination = Combination.fit(level, starts, posteriors, truth)
        return cls(network, refiner, combination, training.history)

    def estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None = None,
        with_sigma: bool = True,
    ) -> Estimate:
        """Return PSFs of sum 1 and the standard deviation of each pixel."""
        from psfdae_paper.bounds.refinement import NetworkStarts

        levels = np.broadcast_to(np.asarray(level, np.float64), len(noisy))
        starts = NetworkStarts.compute(self.network, noisy, levels, self.refiner.prior.pixel)
        posteriors = self.refiner.refine(noisy, levels, starts)
        psf, sigma = self.combination.combine(levels, starts, posteriors)
        return Estimate(psf.reshape(noisy.shape), sigma.reshape(noisy.shape))

    @property
    def calibration(self) -> tuple[np.ndarray, np.ndarray]:
        """Noise levels, and the number of combined standard deviations for 95 % of the errors."""
        return self.combination.levels, self.combination.sigma_ratio95

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of network, optics and weights."""
        prior = self.refiner.prior
        return {
            **self.network.to_arrays(),
            "seidel_mean": prior.mean,
            "seidel_sd": prior.sd,
            "relative_field": prior.field,
            "pixel": np.array([prior.pixel]),
            "obscuration": np.array([self.refiner.obscuration]),
            "combination": self.combination.factors,
            "combined_scale": self.combination.sigma_scale,
            "combined_ratio95": self.combination.sigma_ratio95,
        }

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """Return network and optics with the noise of the configuration."""
        from psfdae_paper.bounds.posterior_network import PosteriorNetwork
        from psfdae_paper.bounds.refinement import Combination, Refiner, SeidelPrior

        noise = build_noise(config["noise"])
        seidel = arrays["seidel_mean"], arrays["seidel_sd"], arrays["relative_field"]
        prior = SeidelPrior(*seidel, float(arrays["pixel"][0]))
        side = round(len(arrays["mean"]) ** 0.5)
        refiner = Refiner(prior, float(arrays["obscuration"][0]), side, noise)
        names = ("levels", "combination", "combined_scale", "combined_ratio95")
        combination = Combination(*(arrays[name] for name in names))
        return cls(PosteriorNetwork(arrays, noise), refiner, combination)
