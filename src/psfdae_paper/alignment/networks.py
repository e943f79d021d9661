"""Networks that estimate a state from the stamps of all fields: the paper's, and a faster one.

The paper's (section 3.3) has five convolutions with batch normalisation and leaky ReLU
after each, and one linear layer. The fields are the channels of the input. Widths, kernels
and strides are not in the paper's text; the configuration names them.

The faster one is a perceptron behind the leading principal components of all stamps together:
states have four numbers, so that a hundred components hold the information of the stamps about
them, and stamps that are always centred need no convolution. Its training takes a seventh of the
time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, pairwise

import numpy as np
import torch
from scipy.linalg import eigh
from torch import nn

from psfdae.base.rng import stream
from psfdae.methods.networks.training import Row, Training
from psfdae.methods.networks.weights import channels_last
from psfdae.stars.noise import NoiseModel, draw_levels
from psfdae_paper.alignment.telescope import Mirror, mirror_symmetries
from psfdae_paper.configuration.alignment import Cnn, NetworkTrain, Perceptron


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
        # Every stride s divides the side of the images by s, rounded up.
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
        self.linear = nn.Linear(channels * side**2, 4)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map scaled stamps (B, fields, d, d) to states (B, 4)."""
        states: torch.Tensor = self.linear(self.features(x).flatten(1))
        return states


class AlignmentPerceptron(nn.Module):
    """Regression of a state from principal components; parameters as for `AlignmentCnn`.

    Attributes
    ----------
    mean : Tensor, shape (fields · d²,)
        Mean of the scaled stamps.
    axes : Tensor, shape (fields · d², K)
        Principal axes, scaled so that components have variance 1.
    """

    mean: torch.Tensor
    axes: torch.Tensor

    def __init__(self, config: Perceptron, fields: int, stamp_px: int) -> None:
        super().__init__()
        # Buffers belong to the stored network, but no training changes them.
        pixels = fields * stamp_px**2
        self.register_buffer("mean", torch.zeros(pixels))
        self.register_buffer("axes", torch.zeros(pixels, config.components))
        sizes = [config.components, *config.widths]
        layers = [(nn.Linear(*pair), nn.SiLU()) for pair in pairwise(sizes)]
        self.features = nn.Sequential(*chain.from_iterable(layers))
        self.linear = nn.Linear(sizes[-1], 4)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map scaled stamps (B, fields, d, d) to states (B, 4)."""
        return self.states(self.components(x))

    def components(self, x: torch.Tensor) -> torch.Tensor:
        """Return the principal components (B, K) of scaled stamps."""
        return (x.flatten(1) - self.mean) @ self.axes

    def states(self, components: torch.Tensor) -> torch.Tensor:
        """Map principal components (B, K) to states (B, 4)."""
        states: torch.Tensor = self.linear(self.features(components))
        return states

    def fit_components(self, clean: torch.Tensor) -> None:
        """Fit the principal axes to stamps, whose components get variance 1.

        Parameters
        ----------
        clean : Tensor, shape (n, fields, d, d)
            Scaled stamps without noise; their values are used up.
        """
        # Deviations from the mean stamps, all fields of a state in one row.
        flat = clean.flatten(1)
        self.mean.copy_(flat.mean(dim=0))
        flat -= self.mean
        count = self.axes.shape[1]
        # Leading eigenvectors of the covariance. In double precision: pixels that a DAE leaves
        # empty make the matrix singular.
        products, last = (flat.T @ flat).double().numpy(), flat.shape[1] - 1
        leading = eigh(products, subset_by_index=[last + 1 - count, last], overwrite_a=True)[1]
        # The largest eigenvalues are last.
        axes = torch.from_numpy(leading[:, ::-1].astype(np.float32))
        # An axis divided by the standard deviation of its component gives it the variance 1.
        spread = (flat @ axes).std(dim=0)
        self.axes.copy_(axes / spread.clamp_min(torch.finfo(spread.dtype).tiny))


Network = AlignmentCnn | AlignmentPerceptron


def make_network(config: Cnn | Perceptron, fields: int, stamp_px: int) -> Network:
    """Make the network of a configuration, before it has its weights.

    Parameters
    ----------
    config : config group `cnn` or `perceptron`
        Its class decides the kind of network.
    fields, stamp_px : int
        Stamps of a state, and their side.
    """
    if isinstance(config, Cnn):
        return AlignmentCnn(config, fields, stamp_px)
    return AlignmentPerceptron(config, fields, stamp_px)


def build_network(
    config: Cnn | Perceptron, fields: int, stamp_px: int, generator: torch.Generator
) -> Network:
    """Make a fresh network whose weights come from `generator` alone.

    Inner layers draw N(0, 2/fan_in) (He et al. 2015), the last one PyTorch's uniform
    ±1/√fan_in; its bias is 0, the middle of the range.

    Parameters
    ----------
    config : Cnn or Perceptron
        Settings of the layers; the class decides the kind of network.
    fields : int
        Stamps per state.
    stamp_px : int
        Side d of a stamp.
    generator : torch.Generator
        Source of the initial weights.
    """
    # The gain of He's rule depends on the slope of the rectifier below 0.
    model = channels_last(make_network(config, fields, stamp_px))
    leak = getattr(config, "leak", 0.0)
    with torch.no_grad():
        for layer in model.features:
            if isinstance(layer, nn.Conv2d | nn.Linear):
                nn.init.kaiming_normal_(
                    layer.weight, a=leak, nonlinearity="leaky_relu", generator=generator
                )
            if isinstance(layer, nn.Linear):
                layer.bias.zero_()
        # The last layer begins near the middle of the range.
        bound = float(model.linear.in_features) ** -0.5
        model.linear.weight.uniform_(-bound, bound, generator=generator)
        model.linear.bias.zero_()
    return model


def scale_stamps(stamps: np.ndarray) -> torch.Tensor:
    """Scale flux-normalised stamps to a mean of 1, as the networks receive them."""
    images = torch.from_numpy(np.ascontiguousarray(stamps, np.float32))
    # A copy: it is scaled in place.
    images = images.to(memory_format=torch.channels_last, copy=True)
    return images.mul_(float(stamps.shape[-1] ** 2))


@torch.inference_mode()
def predict_states(
    model: nn.Module, stamps: np.ndarray, batch: int = 256, mirrors: Sequence[Mirror] = ()
) -> np.ndarray:
    """Estimate the states of flux-normalised stamps.

    Parameters
    ----------
    model : Module
        Trained network.
    stamps : ndarray, shape (n, fields, d, d)
        Stamps of sum 1.
    batch : int
        States that are estimated together.
    mirrors : sequence of Mirror
        If any are given, the mean of the estimates from all these mirror images is returned.

    Returns
    -------
    ndarray, shape (n, 4), float64
    """
    model.eval()
    # A mirrored telescope has the mirrored state: estimates are mirrored back and averaged.
    if mirrors:
        # The inverse of an orthogonal matrix is its transpose.
        estimates = [
            predict_states(model, m.stamps(stamps), batch) @ m.state_matrix for m in mirrors
        ]
        return np.asarray(np.mean(estimates, axis=0))
    # Batches bound the memory.
    states = np.empty((len(stamps), 4))
    for part in (slice(start, start + batch) for start in range(0, len(stamps), batch)):
        states[part] = model(scale_stamps(stamps[part])).numpy()
    return states


@dataclass(frozen=True)
class TrainingStates:
    """States on which a network is trained, and the noise of their stamps.

    Attributes
    ----------
    states : ndarray, shape (n, 4)
        States in units of the range.
    stamps : ndarray, shape (n, F, d, d) or (D, n, F, d, d)
        Stamps, or D draws of their noise; a random draw is used for every field.
    noise : NoiseModel, optional
        Noise that is drawn again for every batch.
    levels : sequence of float
        Noise levels λ; each state of a batch has a random one.
    """

    states: np.ndarray
    stamps: np.ndarray
    noise: NoiseModel | None = None
    levels: Sequence[float] = ()

    def add_noise(self, stamps: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Add noise of random levels to stamps, if there is noise.

        It is drawn from a normal distribution, which is faster than Poisson counts.
        """
        if self.noise is None:
            return stamps
        # A level for each state, the same for its stamps at all fields.
        levels = draw_levels(np.asarray(self.levels), len(stamps), rng)
        return self.noise.draw_gaussian(stamps, levels, rng)


class NetworkTraining(Training):
    """Training of a network; order, noise and mirror images are drawn again in every epoch.

    The history has the mean squared error in units of the range.

    Parameters
    ----------
    data : TrainingStates
        States and their stamps, and the noise to draw.
    network : Cnn or Perceptron
        Settings of the layers.
    settings : NetworkTrain
        Batch size, epochs, learning rate, and whether states are mirrored.
    seed : int
        Seed of the experiment; all random streams derive from it.
    name : str
        Name of the network; part of the address of its random streams.
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
        # Mirror images of the telescope, depending on the settings.
        self.data, self.seed, self.name = data, seed, name
        fields, side = data.stamps.shape[-3], data.stamps.shape[-1]
        self.mirrors = mirror_symmetries(fields - 1) if settings.mirrors else []
        # First weights, and principal components, from streams of the network's name.
        generator = torch.Generator()
        generator.manual_seed(int(stream(seed, "cnn", "init", name).integers(2**62)))
        model = build_network(network, fields, side, generator)
        # A last batch of one state, with which batch normalisation could do nothing, is left out.
        full_batches, remainder = divmod(len(data.states), settings.batch)
        super().__init__(
            model,
            settings,
            full_batches + (remainder > 1),
            key=f"train_{name}",
            rate=lambda epoch: settings.decay ** (epoch // settings.decay_epochs),
        )

    def _shuffle_states(self, rng: np.random.Generator) -> Iterator[np.ndarray]:
        """Yield the numbers of the states of every batch of an epoch, in random order."""
        # A permutation of all states, cut into batches.
        order = rng.permutation(len(self.data.states))
        for start in range(0, order.size, self.settings.batch)[: self.steps]:
            yield order[start : start + self.settings.batch]

    def batches(self, epoch: int) -> Iterator[tuple[torch.Tensor, ...]]:
        """Yield stamps (B, fields, d, d) and states (B, 4) of every batch of an epoch."""
        rng = stream(self.seed, "cnn", "epoch", self.name, epoch)
        for numbers in self._shuffle_states(rng):
            # Noise, then a mirror image: all states of a batch are mirrored alike.
            images, truth = self._draw_stamps(numbers, rng), self.data.states[numbers]
            images = self.data.add_noise(images, rng)
            if self.mirrors:
                mirror = self.mirrors[rng.integers(len(self.mirrors))]
                images, truth = mirror.stamps(images), mirror.states(truth)
            yield scale_stamps(images), torch.from_numpy(truth.astype(np.float32))

    def _draw_stamps(self, numbers: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return stamps of the states with these numbers, of a random draw if there are several."""
        stamps = self.data.stamps
        if stamps.ndim == 4:
            return np.asarray(stamps[numbers])
        # Every field of every state has a draw of its own.
        fields = np.arange(stamps.shape[2])
        draw = rng.integers(len(stamps), size=(numbers.size, fields.size))
        return np.asarray(stamps[draw, numbers[:, None], fields])

    def loss(self, batch: tuple[torch.Tensor, ...], step: int) -> torch.Tensor:
        """Return the mean squared error of a batch."""
        stamps, states = batch
        return nn.functional.mse_loss(self.model(stamps), states)

    def row(self, epoch: int, rate: float, loss: float, error: float) -> Row:
        """Return a row of the history; the learning rate is that at the epoch's start."""
        return {"epoch": epoch, "lr": rate, "loss": loss, "seconds": round(self.seconds, 3)}


class PerceptronTraining(NetworkTraining):
    """Training on principal components, which are computed once, and so is their noise.

    The span of the components of all mirror images is mirrored onto itself, so that mirror images
    are matrix products of components. Noise is normal, with the covariance that it has in the mean
    stamps of all states: a batch draws a number for each component instead of each pixel.
    """

    model: AlignmentPerceptron

    def fit_components(self) -> None:
        """Fit the network's principal axes to the stamps; the training begins with this."""
        # 1500 states in all mirror images are enough to find the principal components.
        rng = stream(self.seed, "cnn", "examples", self.name)
        clean = self._draw_stamps(rng.permutation(len(self.data.states))[:1500], rng)
        if self.mirrors:
            clean = np.concatenate([mirror.stamps(clean) for mirror in self.mirrors])
        self.model.fit_components(scale_stamps(clean))
        # Variance 1 with noise, whose variance in component k is the mean of (RᵀR)_kk over all λ.
        noise_variance = [np.square(root).sum(axis=0) for root in self.roots] or [np.zeros(1)]
        self.model.axes /= torch.from_numpy(np.sqrt(1.0 + np.mean(noise_variance, axis=0))).float()
        del self.roots  # computed with the axes before they were scaled

    @cached_property
    def parts(self) -> np.ndarray:
        """Part of each field in the components, by draw of its noise, shape (D, n, F, K).

        Components are sums over all fields: with one draw, F = 1 and the sum is taken once.
        """
        # Without draws of noise there is one draw, the stamps themselves.
        stamps = self.data.stamps[(None,) * (5 - self.data.stamps.ndim)]
        draws, count, fields, side, _ = stamps.shape
        mean, axes = (
            buffer.numpy().reshape(fields, side**2, *buffer.shape[1:])
            for buffer in (self.model.mean, self.model.axes)
        )
        # (x_f − mean_f)·axes_f of every field f; the sum over fields are the components.
        parts = np.empty((draws, count, fields, axes.shape[-1]), np.float32)
        for draw, field in np.ndindex(draws, fields):
            scaled_stamps = stamps[draw, :, field].reshape(count, -1) * np.float32(side**2)
            parts[draw, :, field] = (scaled_stamps - mean[field]) @ axes[field]
        return parts if draws > 1 else parts.sum(axis=2, keepdims=True)

    @cached_property
    def mirror_matrices(self) -> list[np.ndarray]:
        """Matrix T of each mirror, shape (K, K): from components to components of mirrored stamps.

        With a mirror P of stamps x and axes A, (P x)·A = x·(Pᵀ A). T solves Pᵀ A = A T, which is
        the same as A = P A T.
        """
        # Axes as images, mirrored as stamps are, and the combination of axes that they are.
        fields, side = self.data.stamps.shape[-3], self.data.stamps.shape[-1]
        axes = self.model.axes.numpy()
        stamps = axes.T.reshape(-1, fields, side, side)
        return [
            np.linalg.lstsq(mirror.stamps(stamps).reshape(len(stamps), -1).T, axes)[0]
            for mirror in self.mirrors
        ]

    @cached_property
    def roots(self) -> list[np.ndarray]:
        """R of each λ, shape (K, K), for which RᵀR is the covariance of noise in components."""
        if self.data.noise is None:
            return []
        # Standard deviation of every pixel of the mean stamps, in their scale of mean 1.
        noise, to_mean = self.data.noise, self.data.stamps.shape[-1] ** 2
        mean, axes = (a.double().numpy() for a in (self.model.mean, self.model.axes))
        psf = np.maximum(mean / to_mean, 0.0)
        sigma = [to_mean * np.sqrt(noise.variance(psf, level)) for level in self.data.levels]
        # With σ A = Q R the covariance is Aᵀ σ² A = RᵀR. One array in this mode, which numpy's
        # annotations do not know.
        roots = (np.asarray(np.linalg.qr(s[:, None] * axes, mode="r")) for s in sigma)
        return [root.astype(np.float32) for root in roots]

    def batches(self, epoch: int) -> Iterator[tuple[torch.Tensor, ...]]:
        """Yield components (B, K) and states (B, 4) of every batch of an epoch."""
        draws, _, fields, _ = self.parts.shape
        rng = stream(self.seed, "cnn", "epoch", self.name, epoch)
        for numbers in self._shuffle_states(rng):
            # As in the base class: a draw for every field, then a mirror image of the batch.
            draw = rng.integers(draws, size=(numbers.size, fields))
            components = self.parts[draw, numbers[:, None], np.arange(fields)].sum(axis=1)
            truth = self.data.states[numbers]
            if self.mirrors:
                mirror = rng.integers(len(self.mirrors))
                components = components @ self.mirror_matrices[mirror]
                truth = self.mirrors[mirror].states(truth)
            # Every state has the noise of one λ: white numbers times the root of its covariance.
            if self.roots:
                white = rng.standard_normal(components.shape, dtype=np.float32)
                level = rng.integers(len(self.roots), size=numbers.size)
                for number, root in enumerate(self.roots):
                    components[level == number] += white[level == number] @ root
            yield torch.from_numpy(components), torch.from_numpy(truth.astype(np.float32))

    def loss(self, batch: tuple[torch.Tensor, ...], step: int) -> torch.Tensor:
        """Return the mean squared error of a batch."""
        components, states = batch
        return nn.functional.mse_loss(self.model.states(components), states)


def make_training(
    network: Cnn | Perceptron, data: TrainingStates, settings: NetworkTrain, seed: int, name: str
) -> NetworkTraining:
    """Make the training of a kind of network; arguments as for `NetworkTraining`.

    Perceptrons are trained on principal components, CNNs on stamps.
    """
    if isinstance(network, Cnn):
        return NetworkTraining(data, network, settings, seed, name)
    training = PerceptronTraining(data, network, settings, seed, name)
    training.fit_components()
    return training
