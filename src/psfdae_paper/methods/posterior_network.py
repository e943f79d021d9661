"""Method `posterior_network`: a network that is trained on simulated stars without end.

It estimates the posterior mean of the noise-free star, the estimate of the error bounds, and the
standard deviation of each pixel. It needs the simulation of the stars, not the stars themselves:
these only select the fields, and calibrate the standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar, cast

import numpy as np

from psfdae.base.settings import dump_deciding
from psfdae.methods.interface import (
    HISTORY,
    Estimate,
    FitError,
    Look,
    Method,
    Needs,
    Storage,
    TrainingSet,
)
from psfdae.stars.noise import build_noise
from psfdae_paper.configuration.posterior_network import PosteriorNetworkSettings

if TYPE_CHECKING:
    from psfdae_paper.bounds.posterior_network import PosteriorNetwork, PosteriorNetworkTraining

Trained = TypeVar("Trained", bound="PosteriorNetworkTraining")


class PosteriorNetworkMethod(Method):
    """Trained network, and the history of its training.

    Parameters
    ----------
    network : PosteriorNetwork
        Trained network.
    history : list of dict
        Course of the training.
    """

    look = Look("posterior network", "#117733", "h", is_drawn=False)
    needs = Needs(level=True, validation=True, memory_mb=2000, minutes=60)
    storage = Storage(
        arrays={
            "mean": ("1", "mean stamp"),
            "axes": ("1", "eigenvectors of the covariance of stamps, columns"),
            "variance": ("1", "its eigenvalues"),
            "levels": ("1", "noise levels of the training"),
            "sigma_scale": ("1", "factor of the standard deviations at each level"),
            "sigma_ratio95": (
                "1",
                "standard deviations that hold 95 % of the errors, at each level",
            ),
            "points": ("1", "field points along a side"),
            "input": ("1", "filters of the first layer"),
            "input_level": ("1", "weights of the noise level in the first layer"),
            "input_position": ("1", "weights of the position in the first layer"),
            "expand": ("1", "weights of the first layer of each block"),
            "expand_level": ("1", "weights of the noise level in each block"),
            "reduce": ("1", "weights of the second layer of each block"),
            "output": ("1", "filters of the PSF"),
            "output_sigma": ("1", "filters of the logarithm of the standard deviation"),
        },
        diagnostics=(HISTORY,),
        per_reference=True,
    )
    groups: ClassVar = {"posterior_network": PosteriorNetworkSettings}

    def __init__(
        self, network: PosteriorNetwork, history: list[dict[str, Any]] | None = None
    ) -> None:
        self.network = network
        self.diagnostic_rows = {HISTORY: history or []}

    @classmethod
    def fit(cls, data: TrainingSet, posterior_network: PosteriorNetworkSettings) -> Self:
        """Train on stars of the simulation that made the training stars; raises as `train`."""
        training = cls.train(data, posterior_network)
        return cls(training.finish(), training.history)

    @classmethod
    def train(
        cls, data: TrainingSet, posterior_network: PosteriorNetworkSettings
    ) -> PosteriorNetworkTraining:
        """Run the training of the network.

        Raises
        ------
        FitError
            If the stars are not simulated with random aberrations, or the reference is their
            template.
        """
        from psfdae_paper.bounds.posterior_network import PosteriorNetworkTraining
        from psfdae_paper.configuration.compose import part
        from psfdae_paper.configuration.consistency import SIMULATION
        from psfdae_paper.configuration.wavefront import VonKarman

        if not data.simulation:
            raise FitError(f"{cls.name}: needs stars of a simulation, these come from an image")
        if data.reference != "realisation":
            raise FitError(f"{cls.name}: needs reference=realisation, not {data.reference}")
        config = part(SIMULATION, data.simulation)
        if isinstance(config.wavefront, VonKarman):
            raise FitError(
                f"{cls.name}: needs stars with random aberrations; method static_posterior knows"
                " the static PSFs of turbulence"
            )
        begin = partial(
            PosteriorNetworkTraining, data, config, posterior_network, cls.needs.position
        )
        assert data.checkpoint is not None
        return cls.run(begin, data, posterior_network, data.checkpoint)

    @classmethod
    def run(
        cls,
        begin: Callable[[int], Trained],
        data: TrainingSet,
        settings: PosteriorNetworkSettings,
        checkpoint: Path,
    ) -> Trained:
        """Run a training, from its checkpoint if it has the same settings and data."""
        from psfdae.methods.networks import training as loop

        # Everything that determines the result.
        decisions = {
            "settings": dump_deciding(settings),
            "simulation": dict(data.simulation),
            "name": cls.name,
            "noise": [data.levels.tolist(), str(data.noise)],
        }
        digest = loop.fingerprint(decisions, data.images, data.validation, data.positions)
        with loop.progress(settings.epochs) as report:
            return cast("Trained", loop.train(begin, checkpoint, digest, report))

    def estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None = None,
        with_sigma: bool = True,
    ) -> Estimate:
        """Return PSFs of sum 1 and the standard deviation of each pixel."""
        levels = np.broadcast_to(np.asarray(level, np.float64), len(noisy))
        place = position if self.needs.position else None
        estimate = self.network.estimate(noisy, levels, place)
        return Estimate(estimate.psf, estimate.sigma)

    @property
    def calibration(self) -> tuple[np.ndarray, np.ndarray]:
        """Noise levels (L,), and the number of standard deviations for 95 % of the errors, (L,)."""
        return self.network.levels.numpy(), self.network.sigma_ratio95.numpy()

    def facts(self) -> Mapping[str, str]:
        """Return the half-widths of intervals that contain 95 % of the errors of fresh stars."""
        widths = zip(*self.calibration, strict=True)
        return {"95 % of the errors": ", ".join(f"{w:.2f} σ at λ = {v:g}" for v, w in widths)}

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the statistics and the weights of the network."""
        return self.network.to_arrays()

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """Return the network with the noise of the configuration."""
        from psfdae_paper.bounds.posterior_network import PosteriorNetwork

        return cls(PosteriorNetwork(arrays, build_noise(config["noise"])))
