"""Method `posterior_network_refined`: a network whose wavefronts the optics refine.

A second network, which continues the training of the posterior network, proposes wavefronts of a
star. Gauss–Newton steps on the stamp of the telescope refine them
(`psfdae_paper.bounds.refinement`). Where the image determines the
wavefront, the posterior mean about it has nearly the minimum error; elsewhere the network is
better. The result is a mean of both, weighted by their variances and the misfit of the wavefront.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from psfdae.methods.interface import Estimate, FitError, Look, Needs, Storage, TrainingSet
from psfdae.stars.noise import build_noise
from psfdae_paper.configuration.posterior_network import PosteriorNetworkSettings
from psfdae_paper.methods import PhotonMethod
from psfdae_paper.methods.posterior_network import PosteriorNetworkMethod

if TYPE_CHECKING:
    from psfdae_paper.bounds.posterior_network import PosteriorNetwork, WavefrontNetwork
    from psfdae_paper.bounds.refinement import (
        Combination,
        NetworkStarts,
        RefinedPsfs,
        Refiner,
    )


PROPOSER = {
    **{
        name: PosteriorNetworkMethod.list_arrays()[name]
        for name in ("input", "input_level", "expand", "expand_level", "reduce")
    },
    "coordinate_mean": ("waves", "mean of the coordinates of wavefronts"),
    "coordinate_sd": ("waves", "their standard deviations"),
    "output": ("1", "weights of mixtures of wavefronts"),
}
"""Arrays of the network of wavefronts alone; their names in files begin with `wavefront_`."""


class RefinedPosteriorNetwork(PhotonMethod, PosteriorNetworkMethod):
    """Trained network, optics of the telescope, and weights of both.

    Parameters
    ----------
    network : PosteriorNetwork
        Trained network of PSFs.
    proposer : WavefrontNetwork
        Trained network of wavefronts.
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
            **{f"wavefront_{name}": fact for name, fact in PROPOSER.items()},
            "seidel_mean": ("waves", "mean of the Seidel coefficients"),
            "seidel_sd": ("waves", "their standard deviations"),
            "relative_field": ("1", "field vectors, 1 at the edge on an axis"),
            "pixel": ("λ/D", "width of a pixel"),
            "obscuration": ("1", "linear central obscuration of the pupil"),
            "jitter_px": ("pixel", "largest centring error of a stamp per axis"),
            "combination": ("1", "factors of the weights of refined PSFs at each level"),
            "combined_scale": ("1", "factor of the combined standard deviations at each level"),
            "combined_ratio95": ("1", "of these, how many hold 95 % of the errors, at each level"),
        },
        diagnostics=PosteriorNetworkMethod.storage.diagnostics,
        per_reference=True,
    )

    def __init__(
        self,
        network: PosteriorNetwork,
        proposer: WavefrontNetwork,
        refiner: Refiner,
        combination: Combination,
        history: list[dict[str, Any]] | None = None,
    ) -> None:
        super().__init__(network, history)
        self.proposer, self.refiner, self.combination = proposer, refiner, combination

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
        from psfdae_paper.bounds.posterior_network import WavefrontTraining
        from psfdae_paper.bounds.refinement import Combination, Refiner

        if data.simulation and data.simulation["scene"]["name"] != "seidel":
            raise FitError(f"{cls.name}: needs stars with random Seidel aberrations (scene 1)")
        training = cls.train(data, posterior_network)
        network, history = training.finish(), training.history
        # The second training has a checkpoint beside the one of the first; the caller removes both
        # after writing the fit.
        begin = partial(WavefrontTraining, data, training.config, posterior_network, network)
        assert data.checkpoint is not None
        checkpoint = data.checkpoint.with_suffix(".wavefront.pt")
        proposer_training = cls.run(begin, data, posterior_network, checkpoint)
        # Its epochs and times follow the first training.
        latest = {key: history[-1][key] for key in ("epoch", "step", "seconds", "cpu_seconds")}
        for row in proposer_training.history:
            history.append({key: value + latest.get(key, 0) for key, value in row.items()})
        refiner = Refiner.from_model(build_stamp_model(training.config), data.noise)
        stars = training.draw_fresh_stars()
        # Every star at every noise level.
        count, levels = len(stars.stamps), np.sort(data.levels)
        truth, level = np.tile(stars.stamps, (len(levels), 1)), np.repeat(levels, count)
        images = truth.reshape(-1, *data.images.shape[1:])
        noisy = data.noise.draw(images, level, training.stream("combination"))
        # The combination is fitted to the results of the networks and of the optics.
        blank = Combination(levels, *np.zeros((3, len(levels))))
        refined = cls(network, proposer_training.model, refiner, blank, history)
        refined.combination = Combination.fit(level, *refined.refine(noisy, level), truth)
        return refined

    def refine(self, noisy: np.ndarray, level: np.ndarray) -> tuple[NetworkStarts, RefinedPsfs]:
        """Return the results of the networks, and of the optics, for images (n, d, d)."""
        from psfdae_paper.bounds.refinement import NetworkStarts

        pixel = self.refiner.prior.pixel
        starts = NetworkStarts.compute(self.network, self.proposer, noisy, level, pixel)
        return starts, self.refiner.refine(noisy, level, starts)

    def estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None = None,
        with_sigma: bool = True,
    ) -> Estimate:
        """Return PSFs of sum 1 and the standard deviation of each pixel."""
        levels = np.broadcast_to(np.asarray(level, np.float64), len(noisy))
        starts, refined = self.refine(noisy, levels)
        psf, sigma = self.combination.combine(levels, starts, refined)
        images = psf.reshape(noisy.shape), sigma.reshape(noisy.shape)
        return Estimate(*images, outlier_score=self.refiner.measure_misfit(refined))

    @property
    def calibration(self) -> tuple[np.ndarray, np.ndarray]:
        """Noise levels, and the number of combined standard deviations for 95 % of the errors."""
        return self.combination.levels, self.combination.sigma_ratio95

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of network, optics and weights."""
        prior, proposer = self.refiner.prior, self.proposer.to_arrays()
        return {
            **self.network.to_arrays(),
            **{f"wavefront_{name}": proposer[name] for name in PROPOSER},
            "seidel_mean": prior.mean,
            "seidel_sd": prior.sd,
            "relative_field": prior.field,
            "pixel": np.array([prior.pixel]),
            "obscuration": np.array([self.refiner.obscuration]),
            "jitter_px": np.array([self.refiner.jitter_px]),
            "combination": self.combination.factors,
            "combined_scale": self.combination.sigma_scale,
            "combined_ratio95": self.combination.sigma_ratio95,
        }

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """Return network and optics with the noise of the configuration."""
        from psfdae_paper.bounds.posterior_network import PosteriorNetwork, WavefrontNetwork
        from psfdae_paper.bounds.refinement import Combination, Refiner, SeidelPrior

        noise = build_noise(config["noise"])
        seidel = arrays["seidel_mean"], arrays["seidel_sd"], arrays["relative_field"]
        prior = SeidelPrior(*seidel, float(arrays["pixel"][0]))
        side = round(len(arrays["mean"]) ** 0.5)
        obscuration, jitter_px = (arrays[name].item() for name in ("obscuration", "jitter_px"))
        refiner = Refiner(prior, obscuration, side, noise, jitter_px)
        names = ("levels", "combination", "combined_scale", "combined_ratio95")
        combination = Combination(*(arrays[name] for name in names))
        proposer = {**arrays, **{name: arrays[f"wavefront_{name}"] for name in PROPOSER}}
        networks = PosteriorNetwork(arrays, noise), WavefrontNetwork(proposer, noise)
        return cls(*networks, refiner, combination)
