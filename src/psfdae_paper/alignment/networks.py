"""Networks from the stamps of all fields to a state: the paper's, and one of ours.

The paper's (section 3.3) has five convolutions with batch normalisation and leaky ReLU
after each, and one linear layer. The fields are the channels of the input. Widths, kernels
and strides are not in the paper's text; the configuration names them.

Ours is a perceptron behind the leading principal components of all stamps together: states
have four numbers, so that a hundred components hold what the stamps say of them, and stamps
that always stand at the same place need no convolution. It learns in a seventh of the time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path

import numpy as np
import torch
from scipy.linalg import eigh
from torch import nn

from psfdae.networks.training import Row, Training
from psfdae.networks.weights import channels_last, with_weights
from psfdae.noise import NoiseModel, mixed_levels
from psfdae.rng import stream
from psfdae_paper.alignment.telescope import Mirror, mirror_symmetries
from psfdae_paper.configuration.alignment import Cnn, NetworkTrain, Perceptron

PARAMETERS = 4
"""Numbers of a state: decentre x, y and tilt x, y in units of the range."""

EXAMPLES = 1500
"""States whose stamps, with their mirror images, tell the principal components."""


class AlignmentCnn(nn.Module):
    """Regression of a state of misalignment from the stamps of all fields.

    Parameters
    ----------
    config : config group `cnn`
        Widths, kernels and strides of the convolutions.
    fields : int
        Stamps per state, the channels of the input.
    stamp_px : int
        Side d of a stamp.
    """

    def __init__(self, config: Cnn, fields: int, stamp_px: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels, side = fields, stamp_px
        for width, kernel, step in zip(config.widths, config.kernels, config.strides, strict=True):
            layers += [
                # Batch normalisation subtracts the mean: a bias would be lost in it.
                nn.Conv2d(channels, width, kernel, step, kernel // 2, bias=False),
                nn.BatchNorm2d(width),
                nn.LeakyReLU(config.leak),
            ]
            channels, side = width, -(-side // step)
        self.features = nn.Sequential(*layers)
        self.linear = nn.Linear(channels * side**2, PARAMETERS)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map scaled stamps (B, fields, d, d) to states (B, 4)."""
        states: torch.Tensor = self.linear(self.features(x).flatten(1))
        return states


class AlignmentPerceptron(nn.Module):
    """The same behind principal components; parameters as for `AlignmentCnn`."""

    mean: torch.Tensor
    axes: torch.Tensor

    def __init__(self, config: Perceptron, fields: int, stamp_px: int) -> None:
        super().__init__()
        pixels = fields * stamp_px**2
        self.register_buffer("mean", torch.zeros(pixels))
        self.register_buffer("axes", torch.zeros(pixels, config.components))
        sizes = [config.components, *config.widths]
        layers = [(nn.Linear(*pair), nn.SiLU()) for pair in pairwise(sizes)]
        self.features = nn.Sequential(*chain.from_iterable(layers))
        self.linear = nn.Linear(sizes[-1], PARAMETERS)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map scaled stamps (B, fields, d, d) to states (B, 4)."""
        return self.state_of(self.components(x))

    def components(self, x: torch.Tensor) -> torch.Tensor:
        """Principal components (B, K) of scaled stamps."""
        return (x.flatten(1) - self.mean) @ self.axes

    def state_of(self, components: torch.Tensor) -> torch.Tensor:
        """States (B, 4) of principal components."""
        states: torch.Tensor = self.linear(self.features(components))
        return states

    def look_at(self, clean: torch.Tensor, seen: torch.Tensor) -> None:
        """Take the components of noise-free stamps, scaled to variance 1 of those that are seen.

        Both are scaled, shape (n, fields, d, d).
        """
        flat = clean.flatten(1)
        self.mean.copy_(flat.mean(dim=0))
        flat = flat - self.mean
        count = self.axes.shape[1]
        # In double precision: pixels that a DAE leaves empty make the matrix singular.
        products, last = (flat.T @ flat).double().numpy(), flat.shape[1] - 1
        leading = eigh(products, subset_by_index=[last + 1 - count, last], overwrite_a=True)[1]
        axes = torch.from_numpy(leading[:, ::-1].astype(np.float32))
        del flat, products  # seen takes as much memory
        spread = ((seen.flatten(1) - self.mean) @ axes).std(dim=0)
        self.axes.copy_(axes / spread.clamp_min(torch.finfo(spread.dtype).tiny))


Network = AlignmentCnn | AlignmentPerceptron


def empty_network(config: Cnn | Perceptron, fields: int, stamp_px: int) -> Network:
    """The network of a configuration, its weights still to come."""
    if isinstance(config, Cnn):
        return AlignmentCnn(config, fields, stamp_px)
    return AlignmentPerceptron(config, fields, stamp_px)


def build_network(
    config: Cnn | Perceptron, fields: int, stamp_px: int, generator: torch.Generator
) -> Network:
    """A fresh network whose weights come from `generator` alone.

    Inner layers draw N(0, 2/fan_in) (He et al. 2015), the last one PyTorch's uniform
    ±1/√fan_in; its bias is 0, the middle of the range.
    """
    model = channels_last(empty_network(config, fields, stamp_px))
    leak = getattr(config, "leak", 0.0)
    with torch.no_grad():
        for layer in model.features:
            if isinstance(layer, nn.Conv2d | nn.Linear):
                nn.init.kaiming_normal_(
                    layer.weight, a=leak, nonlinearity="leaky_relu", generator=generator
                )
            if isinstance(layer, nn.Linear):
                layer.bias.zero_()
        bound = float(model.linear.in_features) ** -0.5
        model.linear.weight.uniform_(-bound, bound, generator=generator)
        model.linear.bias.zero_()
    return model


def load_network(config: Cnn | Perceptron, fields: int, stamp_px: int, weights: Path) -> Network:
    """Network of a configuration with weights from a file; raises ProductError."""
    return with_weights(lambda: empty_network(config, fields, stamp_px), weights)


def _scaled(stamps: np.ndarray) -> torch.Tensor:
    """Flux-normalised stamps as the network sees them, with a mean of 1."""
    images = torch.from_numpy(np.ascontiguousarray(stamps, np.float32))
    own = images.to(memory_format=torch.channels_last, copy=True)
    return own.mul_(float(stamps.shape[-1] ** 2))


@torch.inference_mode()
def predict_states(
    model: nn.Module, stamps: np.ndarray, batch: int = 256, mirrors: Sequence[Mirror] = ()
) -> np.ndarray:
    """States of flux-normalised stamps (n, fields, d, d), shape (n, 4), float64.

    With mirrors the mean of the estimates from all mirror images of the stamps.
    """
    model.eval()
    if mirrors:
        # The inverse of an orthogonal matrix is its transpose.
        each = [predict_states(model, m.stamps(stamps), batch) @ m.state for m in mirrors]
        mean: np.ndarray = np.mean(each, axis=0)
        return mean
    parts = [
        model(_scaled(stamps[start : start + batch])).numpy()
        for start in range(0, len(stamps), batch)
    ]
    return np.concatenate(parts).astype(np.float64)


@dataclass(frozen=True)
class MixedNoise:
    """Noise of random levels λ of a band, by the faster law."""

    noise: NoiseModel
    levels: np.ndarray

    def __call__(self, stamps: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Noisy stamps of states, of one level each."""
        return self.noise.draw_gaussian(stamps, mixed_levels(self.levels, len(stamps), rng), rng)


@dataclass(frozen=True)
class TrainingStates:
    """States that a network is trained on.

    Attributes
    ----------
    states : ndarray, shape (n, 4)
    stamps : ndarray, shape (n, F, d, d) or (D, n, F, d, d)
        Of D draws of a noise, every field shows one at random.
    noise : MixedNoise, optional
        Is drawn anew for every batch.
    """

    states: np.ndarray
    stamps: np.ndarray
    noise: MixedNoise | None = None


class NetworkTraining(Training):
    """Training of a network; order, noise and mirror images are drawn anew in every epoch.

    The history has the mean squared error in units of the range.

    Parameters
    ----------
    data : TrainingStates
    network, settings : config groups
    seed : int
    name : str
        Of the network; part of the address of its random streams.
    """

    settings: NetworkTrain

    def __init__(
        self,
        data: TrainingStates,
        network: Cnn | Perceptron,
        settings: NetworkTrain,
        seed: int,
        name: str,
    ) -> None:
        self.data, self.seed, self.name = data, seed, name
        fields, side = data.stamps.shape[-3], data.stamps.shape[-1]
        self.mirrors = mirror_symmetries(fields - 1) if settings.mirrors else []
        generator = torch.Generator()
        generator.manual_seed(int(stream(seed, "cnn", "init", name).integers(2**62)))
        model = build_network(network, fields, side, generator)
        if isinstance(model, AlignmentPerceptron):
            model.look_at(*self._examples())
        # A remainder of one state, of which batch normalisation could make nothing, is left out.
        whole, rest = divmod(len(data.states), settings.batch)
        super().__init__(
            model,
            settings,
            whole + (rest > 1),
            key=f"train_{name}",
            rate=lambda epoch: settings.decay ** (epoch // settings.decay_epochs),
        )

    def batches(self, epoch: int) -> Iterator[tuple[torch.Tensor, ...]]:
        """Stamps (B, fields, d, d) and states (B, 4)."""
        data = self.data
        rng = stream(self.seed, "cnn", "epoch", self.name, epoch)
        order = rng.permutation(len(data.states))
        for start in range(0, order.size, self.settings.batch)[: self.steps]:
            chosen = order[start : start + self.settings.batch]
            images, truth = self._shown(chosen, rng), data.states[chosen]
            if data.noise is not None:
                images = data.noise(images, rng)
            if self.mirrors:
                mirror = self.mirrors[rng.integers(len(self.mirrors))]
                images, truth = mirror.stamps(images), mirror.states(truth)
            yield _scaled(images), torch.from_numpy(truth.astype(np.float32))

    def _shown(self, chosen: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Stamps of chosen states, in one of the draws if there are several."""
        stamps = self.data.stamps
        if stamps.ndim == 5:
            fields = np.arange(stamps.shape[2])
            draw = rng.integers(len(stamps), size=(chosen.size, fields.size))
            shown: np.ndarray = stamps[draw, chosen[:, None], fields]
        else:
            shown = stamps[chosen]
        return shown

    def _examples(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Stamps in all mirror images, as they are and as the network sees them."""
        rng = stream(self.seed, "cnn", "examples", self.name)
        clean = self._shown(rng.permutation(len(self.data.states))[:EXAMPLES], rng)
        if self.mirrors:
            clean = np.concatenate([mirror.stamps(clean) for mirror in self.mirrors])
        scaled = _scaled(clean)
        if self.data.noise is None:
            return scaled, scaled
        return scaled, _scaled(self.data.noise(clean, rng))

    def loss(self, batch: tuple[torch.Tensor, ...], step: int) -> torch.Tensor:
        """Mean squared error."""
        stamps, states = batch
        return nn.functional.mse_loss(self.model(stamps), states)

    def row(self, epoch: int, rate: float, loss: float, error: float) -> Row:
        """Row of the history; the learning rate is that at the epoch's start."""
        return {"epoch": epoch, "lr": rate, "loss": loss, "seconds": round(self.seconds, 3)}


class PerceptronTraining(NetworkTraining):
    """Training behind principal components, which are computed once, and so is their noise.

    The span of the components of all mirror images is mirrored onto itself, so that mirror images
    are matrix products of components. Noise is normal, with the covariance that it has in the mean
    stamps of all states: a batch draws a number for each component in place of each pixel.
    """

    model: AlignmentPerceptron

    def __init__(
        self,
        data: TrainingStates,
        network: Cnn | Perceptron,
        settings: NetworkTrain,
        seed: int,
        name: str,
    ) -> None:
        super().__init__(data, network, settings, seed, name)
        self.parts = self._parts()
        fields, side = self.data.stamps.shape[-3], self.data.stamps.shape[-1]
        axes = self.model.axes.numpy()
        stamps = axes.T.reshape(-1, fields, side, side)
        # (P x)·a = x·(Pᵀ a): of A T = Pᵀ A the same as P A T = A.
        self.mirrored = [
            np.linalg.lstsq(mirror.stamps(stamps).reshape(len(stamps), -1).T, axes)[0]
            for mirror in self.mirrors
        ]
        self.roots = self._roots()

    def _parts(self) -> np.ndarray:
        """Return the part of each field in the components by draw of its noise, (D, n, F, K)."""
        stamps = self.data.stamps[(None,) * (5 - self.data.stamps.ndim)]
        draws, count, fields, side, _ = stamps.shape
        mean, axes = (
            a.numpy().reshape(fields, side**2, *a.shape[1:])
            for a in (self.model.mean, self.model.axes)
        )
        parts = np.empty((draws, count, fields, axes.shape[-1]), np.float32)
        for draw, field in np.ndindex(draws, fields):
            seen = stamps[draw, :, field].reshape(count, -1) * np.float32(side**2)
            parts[draw, :, field] = (seen - mean[field]) @ axes[field]
        # Of one draw, all fields are always seen together.
        return parts if draws > 1 else parts.sum(axis=2, keepdims=True)

    def _roots(self) -> list[np.ndarray]:
        """R of each λ, shape (K, K), for which RᵀR is the covariance of noise in components."""
        if self.data.noise is None:
            return []
        law, to_mean = self.data.noise.noise, self.data.stamps.shape[-1] ** 2
        mean, axes = (a.double().numpy() for a in (self.model.mean, self.model.axes))
        psf = np.maximum(mean / to_mean, 0.0)
        sigma = [to_mean * np.sqrt(law.variance(psf, level)) for level in self.data.noise.levels]
        # One array in this mode, which numpy's annotations do not know.
        roots = (np.asarray(np.linalg.qr(s[:, None] * axes, mode="r")) for s in sigma)
        return [root.astype(np.float32) for root in roots]

    def batches(self, epoch: int) -> Iterator[tuple[torch.Tensor, ...]]:
        """Components (B, K) and states (B, 4)."""
        draws, _, fields, _ = self.parts.shape
        rng = stream(self.seed, "cnn", "epoch", self.name, epoch)
        order = rng.permutation(len(self.data.states))
        for start in range(0, order.size, self.settings.batch)[: self.steps]:
            chosen = order[start : start + self.settings.batch]
            draw = rng.integers(draws, size=(chosen.size, fields))
            seen = self.parts[draw, chosen[:, None], np.arange(fields)].sum(axis=1)
            truth = self.data.states[chosen]
            if self.mirrors:
                mirror = rng.integers(len(self.mirrors))
                seen, truth = seen @ self.mirrored[mirror], self.mirrors[mirror].states(truth)
            if self.roots:
                white = rng.standard_normal(seen.shape, dtype=np.float32)
                level = rng.integers(len(self.roots), size=chosen.size)
                for own, root in enumerate(self.roots):
                    seen[level == own] += white[level == own] @ root
            yield torch.from_numpy(seen), torch.from_numpy(truth.astype(np.float32))

    def loss(self, batch: tuple[torch.Tensor, ...], step: int) -> torch.Tensor:
        """Mean squared error."""
        components, states = batch
        return nn.functional.mse_loss(self.model.state_of(components), states)


def training_of(
    network: Cnn | Perceptron, data: TrainingStates, settings: NetworkTrain, seed: int, name: str
) -> NetworkTraining:
    """The training of a kind of network; arguments as those of `NetworkTraining`."""
    kind = NetworkTraining if isinstance(network, Cnn) else PerceptronTraining
    return kind(data, network, settings, seed, name)
