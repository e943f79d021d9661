"""The denoising autoencoder: a network that is trained to remove the noise of stars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from psfdae.base.files import as_yaml, write_text
from psfdae.base.reading import from_tree, read_yaml
from psfdae.base.settings import Config, Evaluation, dump_deciding
from psfdae.methods.bundle_info import BundleInfo
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
from psfdae.methods.networks.settings import DaeSettings, Train, image_scale
from psfdae.methods.networks.weights import channels_last, load_network, save_weights

if TYPE_CHECKING:
    from psfdae.methods.networks.dae import DaeNetwork

WEIGHTS = "dae.safetensors"


def _build_network(kernels: Sequence[int], widths: Sequence[int]) -> DaeNetwork:
    """Return a network with random weights; torch is imported here, and not with this module."""
    from psfdae.methods.networks.dae import DaeNetwork

    return DaeNetwork(kernels, widths)


class Dae(Method):
    """Network, scale of its images, and history of its training.

    Parameters
    ----------
    network : DaeNetwork
        Trained network.
    scale : "mean", "none" or float
        Scale of images for the network: the setting, or the factor itself.
    attempt : int
        Number of failed starts of the training.
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
        self.diagnostic_rows = {HISTORY: history or []}

    @classmethod
    def continues(cls, config: Config) -> bool:
        """Return True if training on templates starts from the network trained on realisations."""
        return bool(config.train.continued_epochs)

    @classmethod
    def fit(cls, data: TrainingSet, dae: DaeSettings, train: Train) -> Dae:
        """Train, and keep the state with the smallest validation error; resumes if interrupted.

        Raises
        ------
        TrainingError
            As `psfdae.methods.networks.training.train`.
        FitError
            If the network at which it should begin has another shape or scale of images.
        """
        from psfdae.methods.networks import training as loop
        from psfdae.methods.networks.dae import DaeTraining

        # Everything that determines the result: settings, seed, noise, and the stars themselves.
        decisions = {"dae": dump_deciding(dae), "train": dump_deciding(train), "seed": data.seed}
        decisions["noise"] = [data.levels.tolist(), str(data.noise)]
        # Positions are not included: a network uses only the images.
        arrays = [data.images, data.references, data.fit, data.validation]
        # Warm start: the network begins with the weights of a network with the same layers.
        if isinstance(data.start, Dae):
            first = data.start.network
            first_layers = (first.kernels, first.widths, data.start.scale)
            layers = (tuple(dae.kernels), tuple(dae.widths), dae.scale)
            if first_layers != layers:
                raise FitError(
                    f"dae.kernels, dae.widths, dae.scale = {layers}: the network to go on from "
                    f"has {first_layers}"
                )
            # The number of epochs is relative to the first training.
            epochs = max(1, round(train.continued_epochs * train.epochs))
            train = train.model_copy(update={"epochs": epochs})
            arrays += [value.numpy() for value in first.state_dict().values()]
        # A checkpoint of other settings or other data is not resumed.
        digest = loop.fingerprint(decisions, *arrays)
        # The checkpoint is of an interrupted training; the caller removes it after the fit.
        with loop.progress(train.epochs) as report:
            assert data.checkpoint is not None
            # If the network dies, a new training begins, with the number of the attempt.
            begin = partial(DaeTraining, data, dae, train, data.seed)
            training = loop.train(begin, data.checkpoint, digest, report, train.restarts)
        # A new network with the best weights; the network of the training has the last ones.
        network = _build_network(dae.kernels, dae.widths)
        network.load_state_dict(training.result)
        return cls(
            channels_last(network).eval(),
            dae.scale,
            attempt=training.attempt,
            history=training.history,
        )

    def predict(self, noisy: np.ndarray) -> np.ndarray:
        """Return the PSFs, neither clipped nor renormalised, float32."""
        from psfdae.methods.networks.dae import run_network

        return run_network(self.network, noisy, self.factor(noisy.shape[-1]))

    def factor(self, stamp_px: int) -> float:
        """Return the factor from images of sum 1 to inputs of the network."""
        return self.scale if isinstance(self.scale, float) else image_scale(self.scale, stamp_px)

    def save(self, place: Path, config: Mapping[str, Any]) -> None:
        """Write weights, and the resolved configuration with the number of the start."""
        # The configuration is part of the weights' file, too, as metadata.
        save_weights(place / WEIGHTS, self.network.state_dict(), config)
        write_text(place / CONFIG, as_yaml({**config, "attempt": self.attempt}))

    @classmethod
    def load(
        cls, place: Path, reference: str = "realisation", evaluation: Evaluation | None = None
    ) -> Dae:
        """Read a network; the two files must be of the same training."""
        import torch

        from psfdae.base.settings import parse_settings

        config = cls.read_config(place)
        # The shape of the network is in its configuration, its weights are in another file.
        settings = from_tree(
            place / CONFIG,
            config,
            "dae",
            make=lambda tree: parse_settings(DaeSettings, tree),
        )
        # Threads only change the speed.
        if evaluation is not None:
            torch.set_num_threads(evaluation.threads)
        network = load_network(
            lambda: _build_network(settings.kernels, settings.widths), place / WEIGHTS
        )
        return cls(network, settings.scale)

    def export(self, stamp_px: int, noise: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the weights, and the shape of the network."""
        # Contiguous, because networks keep weights in another order (`channels_last`).
        state = self.network.state_dict()
        shape = {"kernels": self.network.kernels, "widths": self.network.widths}
        arrays = {name: value.contiguous().numpy() for name, value in state.items()}
        return arrays, {"dae": shape, "image_scale": self.factor(stamp_px)}

    @classmethod
    def shapes(cls, info: BundleInfo) -> Mapping[str, tuple[int, ...] | None]:
        """Return the shapes of the weights for the architecture of the bundle."""
        return info.dae.shapes() if info.dae else {}

    @classmethod
    def from_bundle(cls, arrays: Mapping[str, np.ndarray], info: BundleInfo) -> Dae:
        """Return the network of a bundle."""
        import torch

        assert info.dae is not None and info.image_scale is not None
        # Copies, because torch would share memory with arrays that may be read-only.
        network = _build_network(info.dae.kernels, info.dae.widths)
        network.load_state_dict({k: torch.from_numpy(v.copy()) for k, v in arrays.items()})
        return cls(channels_last(network).eval(), float(info.image_scale))

    @classmethod
    def read_config(cls, place: Path) -> dict[str, Any]:
        """Return the resolved configuration of the training."""
        return read_yaml(place / CONFIG)
