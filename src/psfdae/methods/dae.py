"""The denoising autoencoder: a network that learns from noisy stars to give noise-free ones."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from psfdae.base.files import as_yaml, write_text
from psfdae.base.reading import from_tree, read_yaml
from psfdae.base.settings import Config, deciding
from psfdae.methods.interface import (
    CONFIG,
    HISTORY,
    FitError,
    Look,
    Method,
    Needs,
    Packing,
    Storage,
    TrainingSet,
)
from psfdae.methods.networks.settings import DaeSettings, Train

if TYPE_CHECKING:
    from psfdae.base.settings import Evaluation
    from psfdae.methods.bundle_info import BundleInfo
    from psfdae.methods.networks.dae import DaeNetwork

WEIGHTS = "dae.safetensors"


class Dae(Method):
    """A network, the factor of its images, and how it was trained.

    Parameters
    ----------
    network : DaeNetwork
    scale : "mean", "none" or float
        Of images for the network: as the setting, or the factor itself.
    attempt : int
        Starts of the training before the one that succeeded.
    history : list of dict
        Course of the training.
    """

    look = Look("DAE", "#0072b2", "D", paper=("dae", "DAE"), title="denoising autoencoder")
    needs = Needs(validation=True, memory_mb=1800, minutes=60)
    storage = Storage(
        files=(WEIGHTS, CONFIG),
        diagnostics=(HISTORY,),
        per_reference=True,
        rule="train",
    )
    packing = Packing(suffix="")
    groups: ClassVar = {"dae": DaeSettings, "train": Train}

    def __init__(
        self,
        network: DaeNetwork,
        scale: Literal["mean", "none"] | float,
        attempt: int = 0,
        history: list[dict[str, Any]] | None = None,
    ) -> None:
        self.network, self.scale, self.attempt = network, scale, attempt
        self.diagnosed = {HISTORY: history or []}

    @classmethod
    def continues(cls, config: Config) -> bool:
        """Return True if training on templates starts from the network trained on realisations."""
        return bool(config.train.continued_epochs)

    @classmethod
    def fit(cls, data: TrainingSet, dae: DaeSettings, train: Train) -> Dae:
        """Train, and keep the state with the least validation error; resumes if interrupted.

        Raises
        ------
        TrainingError
            As `psfdae.methods.networks.training.train`.
        FitError
            If it is to go on from a network of another shape or scale of images.
        """
        from psfdae.methods.networks import training as loop
        from psfdae.methods.networks.dae import DaeNetwork, DaeTraining
        from psfdae.methods.networks.weights import channels_last

        # All that decides the result: settings, seed, noise, and the stars themselves.
        described = {"dae": deciding(dae), "train": deciding(train), "seed": data.seed}
        described["noise"] = [data.levels.tolist(), data.noise.kappa, data.noise.background]
        # Positions are not among them: a network sees the images alone.
        arrays = [data.images, data.references, data.fit, data.validation]
        # Warm start: the network begins with the weights of one of the same layers.
        if isinstance(data.start, Dae):
            first = data.start.network
            first_layers = (first.kernels, first.widths, data.start.scale)
            layers = (tuple(dae.kernels), tuple(dae.widths), dae.scale)
            if first_layers != layers:
                raise FitError(
                    f"dae.kernels, dae.widths, dae.scale = {layers}: the network to go on from "
                    f"has {first_layers}"
                )
            # Its training is a part or a multiple of the first one.
            epochs = max(1, round(train.continued_epochs * train.epochs))
            train = train.model_copy(update={"epochs": epochs})
            arrays += [value.numpy() for value in first.state_dict().values()]
        # A checkpoint of other settings or other data is not resumed.
        digest = loop.fingerprint(described, *arrays)
        # The checkpoint is of an interrupted training; the caller removes it after the fit.
        with loop.progress(train.epochs) as report:
            assert data.checkpoint is not None
            # A training whose network dies starts anew, with the number of the attempt.
            begin = partial(DaeTraining, data, dae, train, data.seed)
            training = loop.train(begin, data.checkpoint, digest, report, train.restarts)
        # A network of its own with the best weights; that of the training has the last ones.
        network = DaeNetwork(dae.kernels, dae.widths)
        network.load_state_dict(training.result)
        return cls(
            channels_last(network).eval(),
            dae.scale,
            attempt=training.attempt,
            history=training.history,
        )

    def predict(self, noisy: np.ndarray) -> np.ndarray:
        """PSFs, neither clipped nor renormalised, float32."""
        from psfdae.methods.networks.dae import run_network

        return run_network(self.network, noisy, self.factor(noisy.shape[-1]))

    def factor(self, stamp_px: int) -> float:
        """Return the factor from images of sum 1 to those that the network sees."""
        from psfdae.methods.networks.dae import image_scale

        return self.scale if isinstance(self.scale, float) else image_scale(self.scale, stamp_px)

    def save(self, place: Path, described: Mapping[str, Any]) -> None:
        """Write weights, and the resolved configuration with the number of the start."""
        from psfdae.methods.networks.weights import save_weights

        # The configuration is part of the weights' file, too, as metadata.
        save_weights(place / WEIGHTS, self.network.state_dict(), described)
        write_text(place / CONFIG, as_yaml({**described, "attempt": self.attempt}))

    @classmethod
    def load(
        cls, place: Path, reference: str = "realisation", evaluation: Evaluation | None = None
    ) -> Dae:
        """Read a network; the two files must be of the same training."""
        import torch

        from psfdae.base.settings import parse_settings
        from psfdae.methods.networks.dae import DaeNetwork
        from psfdae.methods.networks.weights import with_weights

        described = cls.described(place)
        # The shape of the network is in its configuration, its weights are beside it.
        settings = from_tree(
            place / CONFIG,
            described,
            "dae",
            make=lambda tree: parse_settings(DaeSettings, tree),
        )
        # Threads change the speed alone.
        if evaluation is not None:
            torch.set_num_threads(evaluation.threads)
        network = with_weights(
            lambda: DaeNetwork(settings.kernels, settings.widths), place / WEIGHTS
        )
        return cls(network, settings.scale)

    def pack(self, stamp_px: int, noise: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Weights, and the network's shape."""
        # Contiguous, because networks keep weights in an order of their own (`channels_last`).
        state = self.network.state_dict()
        shape = {"kernels": self.network.kernels, "widths": self.network.widths}
        arrays = {name: value.contiguous().numpy() for name, value in state.items()}
        return arrays, {"dae": shape, "image_scale": self.factor(stamp_px)}

    @classmethod
    def shapes(cls, info: BundleInfo) -> Mapping[str, tuple[int, ...] | None]:
        """Shapes of the weights, by the architecture that the bundle states."""
        return info.dae.shapes() if info.dae else {}

    @classmethod
    def unpack(cls, arrays: Mapping[str, np.ndarray], info: BundleInfo) -> Dae:
        """The network of a bundle."""
        import torch

        from psfdae.methods.networks.dae import DaeNetwork
        from psfdae.methods.networks.weights import channels_last

        assert info.dae is not None and info.image_scale is not None
        # Copies, because torch would share memory with arrays that may be read-only.
        network = DaeNetwork(info.dae.kernels, info.dae.widths)
        network.load_state_dict({k: torch.from_numpy(v.copy()) for k, v in arrays.items()})
        return cls(channels_last(network).eval(), float(info.image_scale))

    @classmethod
    def described(cls, place: Path) -> dict[str, Any]:
        """The resolved configuration of the training."""
        return read_yaml(place / CONFIG)
