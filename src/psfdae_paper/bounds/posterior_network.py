"""A network that maps noisy stamps to the posterior mean of their PSFs, and its training.

The minimiser of the squared error is the posterior mean, so that a network that is trained on
enough simulated stars tends to the estimate of the error bounds, at the time of a few products of
matrices. Stars have no end: every epoch simulates further wavefronts, and every batch draws mirror
images, centring errors and noise anew.

The network corrects the linear estimate of least mean squared error. In the eigenvectors of the
covariance of noise-free stamps, with variances v and a noise variance s², this estimate is

    y = m + v / (v + s²) (x − m)

of an image x and the mean m, with the variance r² = v s² / (v + s²). The input of the network is
(x − m) / √(v + s²), and it adds r times its output to y. Both have a variance of about 1 at every
noise level. As the sum of all stamps is 1, the sum of all estimates is 1, too.

A telescope of rotational symmetry has mirrored stars at mirrored positions. The layers commute with
these mirror images (group convolutions, Cohen & Welling 2016, ICML 48, 2990): every hidden
feature exists once for each symmetry, with the same weights.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from psfdae.base.rng import stream
from psfdae.methods.interface import TrainingSet
from psfdae.methods.networks.training import Adam, Muon, Row, Training, use_half_precision
from psfdae.stars.noise import NoiseModel
from psfdae_paper.bounds.estimates import simulate_fresh_stars
from psfdae_paper.bounds.posterior import Bank, compute_symmetry_weights, list_jitters
from psfdae_paper.configuration.posterior_network import PosteriorNetworkSettings
from psfdae_paper.configuration.schema import Config
from psfdae_paper.configuration.wavefront import VonKarman
from psfdae_paper.stars.framing import Propagation
from psfdae_paper.stars.scenes import template_wavefronts
from psfdae_paper.stars.symmetry import SYMMETRIES, Symmetry

POSITION_TERMS = 9
"""Terms of a polynomial of third order in two coordinates, without the constant."""


def list_symmetries(config: Config) -> tuple[Symmetry, ...]:
    """Return the symmetries of a scene: of a square, or the identity alone for turbulence."""
    return SYMMETRIES[:1] if isinstance(config.wavefront, VonKarman) else SYMMETRIES


# Stars that are drawn without end.


@dataclass(frozen=True)
class FreshStars:
    """Simulated stars from which stamps at all centring errors and mirror images are cut.

    Attributes
    ----------
    frames : ndarray, shape (M, h²), float32
        Framed stars with a margin.
    field : ndarray of int, shape (M,)
        Field of each star.
    choices : ndarray of int, shape (C, 2)
        Star and symmetry of stamps that are equally likely; some are listed several times.
    pixels : ndarray of int, shape (G, J, P)
        Pixels of a frame that are the stamp at each symmetry and centring error.
    points : int
        Field points along a side.
    """

    frames: np.ndarray
    field: np.ndarray
    choices: np.ndarray
    pixels: np.ndarray
    points: int

    @classmethod
    def simulate(cls, config: Config, number: int, count: int, fields: np.ndarray) -> FreshStars:
        """Simulate a set of stars.

        Parameters
        ----------
        config : Config
            Settings with the groups of `consistency.SIMULATION`.
        number : int
            Number of the set; each has other stars.
        count : int
            Stars of the set. Turbulence has one star for each field.
        fields : ndarray of bool, shape (F,)
            Fields in which stamps are drawn.
        """
        framing, points = config.framing, config.grid.points
        margin = framing.jitter_px + Bank.mirror_margin
        symmetries = list_symmetries(config)
        if len(symmetries) > 1:
            columns = simulate_fresh_stars(config, f"network{number}", count)
            frames, field = columns["framed"].values, columns["field_index"].values
            times = compute_symmetry_weights(field, columns["peak"].values, points)
        else:
            # Static PSFs: nothing of a star is random but its field, centring error and noise.
            source = template_wavefronts(config)
            optics = (config.telescope, config.optics, framing, framing.search_px)
            frames = Propagation(source, *optics).frame(framing.stamp_px + 2 * margin)[0]
            field = np.arange(len(frames))
            times = np.ones((len(frames), 1), int)
        # Mirrored stars are at mirrored fields, which may be left out.
        mirrored = np.stack([s.field(field, points) for s in symmetries], axis=1)
        star, symmetry = np.nonzero(times * fields[mirrored])
        choices = np.stack([star, symmetry], axis=1).repeat(times[star, symmetry], axis=0)
        # Windows of all symmetries and centring errors, as pixels of the flat frame.
        size, side = frames.shape[-1], framing.stamp_px
        index = np.arange(size**2).reshape(size, size)
        pixels = np.empty((len(symmetries), len(list_jitters(framing.jitter_px)), side**2), int)
        for g, symmetry_of_square in enumerate(symmetries):
            for j, jitter in enumerate(list_jitters(framing.jitter_px)):
                row, column = symmetry_of_square.window(jitter, margin)
                window = index[row : row + side, column : column + side]
                pixels[g, j] = symmetry_of_square.image(window).ravel()
        flat = frames.reshape(len(frames), -1).astype(np.float32)
        return cls(flat, field, choices, pixels, points)

    def add(self, other: FreshStars) -> FreshStars:
        """Return the stars of both sets."""
        return FreshStars(
            np.concatenate([self.frames, other.frames]),
            np.concatenate([self.field, other.field]),
            np.concatenate([self.choices, other.choices + np.array([len(self.field), 0])]),
            self.pixels,
            self.points,
        )

    def draw(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw stamps (n, P) of sum 1 and the grid indices (n, 2) of their fields."""
        star, symmetry = self.choices[rng.integers(len(self.choices), size=count)].T
        jitter = rng.integers(self.pixels.shape[1], size=count)
        stamps = np.take_along_axis(self.frames[star], self.pixels[symmetry, jitter], axis=1)
        stamps /= stamps.sum(axis=1, keepdims=True)
        field = np.empty(count, int)
        for g in range(len(self.pixels)):
            is_mirrored = symmetry == g
            field[is_mirrored] = SYMMETRIES[g].field(self.field[star[is_mirrored]], self.points)
        return stamps, np.stack(np.divmod(field, self.points)[::-1], axis=1)


# The network.

Matrices = Mapping[str, Sequence[Any]]
"""Matrices of the layers of a network, by kind of layer."""


def list_representations(symmetries: Sequence[Symmetry]) -> np.ndarray:
    """Return the orthonormal functions on a group that are elements of irreducible matrices.

    Convolutions on the group are products of their transforms by these functions.

    Parameters
    ----------
    symmetries : sequence of Symmetry
        The identity alone, or all eight symmetries of a square.

    Returns
    -------
    ndarray, shape (G, G)
        A function in each row: representations of one dimension, then the four elements of the
        rotations and reflections of the plane, row by row.
    """
    if len(symmetries) == 1:
        return np.ones((1, 1))
    # A reflection changes the sign of the determinant; there is a sign for the transposition, too.
    planes = np.stack([symmetry.matrix for symmetry in symmetries])
    determinant = np.linalg.det(planes)
    transposition = np.array([1.0 - 2.0 * symmetry.transpose for symmetry in symmetries])
    scalars = [np.ones(len(planes)), determinant, transposition, determinant * transposition]
    elements = planes.reshape(-1, 4).T * np.sqrt(2.0)
    waves: np.ndarray = np.concatenate([scalars, elements]) / np.sqrt(len(planes))
    return waves


def normalise(features: torch.Tensor) -> torch.Tensor:
    """Divide features (G, n, a) by the root of their mean square for each star."""
    square = features.square().mean(dim=(0, 2), keepdim=True)
    return features * torch.rsqrt(square + 1e-6)


class PosteriorNetwork(nn.Module):
    """Residual network of group convolutions; see the module.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        Statistics of `measure_statistics`, as buffers, and the weights by name.
    noise : NoiseModel
        Noise of the images.
    """

    statistics = ("mean", "axes", "variance", "levels", "sigma_scale", "points")
    weights = (
        *("input", "input_level", "input_position", "expand", "expand_level", "reduce"),
        *("output", "output_sigma"),
    )
    mean: torch.Tensor
    axes: torch.Tensor
    variance: torch.Tensor
    levels: torch.Tensor
    sigma_scale: torch.Tensor
    points: torch.Tensor
    input: nn.Parameter
    input_level: nn.Parameter
    input_position: nn.Parameter
    expand: nn.ParameterList
    expand_level: nn.ParameterList
    reduce: nn.ParameterList
    output: nn.Parameter
    output_sigma: nn.Parameter

    def __init__(self, arrays: Mapping[str, np.ndarray], noise: NoiseModel) -> None:
        super().__init__()
        self.noise = noise
        for name in self.statistics:
            self.register_buffer(name, torch.from_numpy(arrays[name].astype(np.float32)))
        # Blocks have parameters of their own, as the optimiser treats each matrix by itself.
        for name in self.weights:
            weight = torch.from_numpy(arrays[name].astype(np.float32))
            is_stacked = name in ("expand", "expand_level", "reduce")
            parameters = nn.ParameterList([*weight]) if is_stacked else nn.Parameter(weight)
            setattr(self, name, parameters)
        # Pixels of the mirror images of a frame of d + 1 pixels, whose middle is the pixel d // 2
        # of the stamp: an image that is mirrored about this pixel stays in the frame.
        self.symmetries = SYMMETRIES[: arrays["expand"].shape[2]]
        side = round(len(arrays["mean"]) ** 0.5)
        index = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
        images = [symmetry.image(index)[:side, :side] for symmetry in self.symmetries]
        self.filters = torch.from_numpy(np.stack([image.ravel() for image in images]))
        self.waves = torch.from_numpy(list_representations(self.symmetries).astype(np.float32))

    @classmethod
    def build(
        cls,
        statistics: Mapping[str, np.ndarray],
        settings: PosteriorNetworkSettings,
        symmetries: int,
        noise: NoiseModel,
        uses_position: bool,
        rng: np.random.Generator,
    ) -> PosteriorNetwork:
        """Build a network that begins as the linear estimate: its last layers are zero.

        Parameters
        ----------
        statistics : mapping of str to ndarray
            Arrays of `measure_statistics`.
        settings : PosteriorNetworkSettings
            Sizes of the layers.
        symmetries : int
            Number of symmetries, 1 or 8.
        noise : NoiseModel
            Noise of the images.
        uses_position : bool
            Whether the position in the field is an input.
        rng : Generator
            Source of the weights.
        """
        group, pixels = symmetries, (round(len(statistics["mean"]) ** 0.5) + 1) ** 2
        width, hidden, blocks = settings.width // group, settings.hidden // group, settings.blocks

        def draw(*shape: int, inputs: int) -> np.ndarray:
            return np.asarray(rng.standard_normal(shape) / np.sqrt(inputs))

        weights = {
            "input": draw(width, pixels, inputs=pixels),
            "input_level": draw(width, 4, inputs=4),
            "input_position": draw(width, POSITION_TERMS * uses_position, inputs=POSITION_TERMS),
            "expand": draw(blocks, hidden, group, width, inputs=group * width),
            "expand_level": draw(blocks, hidden, 4, inputs=4),
            "reduce": np.zeros((blocks, width, group, hidden)),
            "output": np.zeros((width, pixels)),
            "output_sigma": np.zeros((width, pixels)),
        }
        return cls({**statistics, **weights}, noise)

    @property
    def scalars(self) -> int:
        """Number of representations of one dimension; the others form one of two dimensions."""
        return min(len(self.symmetries), 4)

    def transform_filters(self, weight: torch.Tensor) -> torch.Tensor:
        """Return filters (G, b, P) of stamps, by representation, of filters (b, (d + 1)²)."""
        return torch.einsum("rg,bgp->rbp", self.waves, weight[:, self.filters])

    def transform_kernels(self, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the matrices of a group convolution with weights (b, G, a), by representation.

        Returns
        -------
        scalars : Tensor, shape (1 or 4, a, b)
            Matrices of the representations of one dimension.
        pairs : Tensor, shape (2a, 2b)
            Matrix of both rows of the representation of two dimensions; empty without it.
        """
        # A convolution is a product of the transforms; waves are orthonormal, the matrices of a
        # representation are √(G / its dimension) times as large.
        _, group, width = weight.shape
        kernels = torch.einsum("rg,bga->rab", self.waves, weight) * group**0.5
        scalars, elements = kernels.tensor_split([self.scalars])
        if not len(elements):
            return scalars, elements
        # Rows are features (l, a), columns (j, b), of the matrix element (j, l).
        pairs = (elements / 2**0.5).unflatten(0, (2, 2)).permute(1, 2, 0, 3)
        return scalars, pairs.reshape(2 * width, -1)

    def convolve(
        self, features: torch.Tensor, matrices: tuple[torch.Tensor, torch.Tensor]
    ) -> torch.Tensor:
        """Map features (G, n, a), by representation, to features (G, n, b)."""
        n, stars = self.scalars, features.shape[1]
        scalars = features[:n] @ matrices[0]
        if len(features) == n:
            return scalars
        # Features (i, j) of both rows i of the matrices have the same weights.
        rows = features[n:].unflatten(0, (2, 2)).transpose(1, 2).reshape(2 * stars, -1)
        pairs = (rows @ matrices[1]).view(2, stars, 2, -1).transpose(1, 2).flatten(0, 1)
        return torch.cat([scalars, pairs])

    def matrices(self) -> Matrices:
        """Return the matrices of all layers."""
        first, last, of_sigma = (
            self.transform_filters(weight).flatten(0, 1)
            for weight in (self.input, self.output, self.output_sigma)
        )
        return {
            # Input and correction are given in the eigenvectors.
            "input": [first @ self.axes],
            "expand": [self.transform_kernels(weight) for weight in self.expand],
            "reduce": [self.transform_kernels(weight) for weight in self.reduce],
            "output": [torch.cat([last @ self.axes, of_sigma], dim=1)],
        }

    def encode_level(self, level: torch.Tensor) -> torch.Tensor:
        """Return features (n, 4) of noise levels: powers of ln λ, scaled to ±1 in training."""
        low, high = self.levels.log().aminmax()
        half = torch.clamp((high - low) / 2, min=1e-3)
        scaled = torch.clamp((level.log() - (low + high) / 2) / half, -1.0, 1.0)
        return torch.stack([scaled**power for power in range(4)], dim=1)

    def encode_position(self, position: torch.Tensor) -> torch.Tensor:
        """Return polynomials (n, G, 9) of the mirrored grid indices (n, 2)."""
        middle = torch.clamp((self.points - 1) / 2, min=0.5)
        matrices = torch.from_numpy(np.stack([s.matrix for s in self.symmetries]))
        # The feature of a symmetry g has the position that g moves to the position of the star.
        x, y = torch.einsum("nj,gji->ign", position / middle - 1.0, matrices.to(position))
        terms = [x**i * y ** (order - i) for order in (1, 2, 3) for i in range(order + 1)]
        return torch.stack(terms, dim=2).transpose(0, 1)

    def forward(
        self,
        noisy: torch.Tensor,
        level: torch.Tensor,
        position: torch.Tensor | None,
        matrices: Matrices | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Map noisy images (n, P) of levels (n,) to estimates and the logarithm of their σ.

        Parameters
        ----------
        noisy : Tensor, shape (n, P)
            Images of flux 1, without sky.
        level : Tensor, shape (n,)
            Noise levels λ.
        position : Tensor, shape (n, 2), optional
            Grid indices, for a network with the position as input.
        matrices : mapping, optional
            Result of `matrices`.
        """
        matrices, group = matrices or self.matrices(), len(self.symmetries)
        # The linear estimate and its standard deviation; noise of the mean star's photons included.
        photons = self.noise.kappa / np.sqrt(self.noise.background) / noisy.shape[1]
        noise = ((self.noise.kappa * level) ** 2 + photons * level)[:, None]
        total = self.variance + noise
        deviation = (noisy - self.mean) @ self.axes
        linear, spread = self.variance / total * deviation, (self.variance * noise / total).sqrt()
        with use_half_precision():
            levels = self.encode_level(level)
            # Features (G, n, width) by representation; the level is the same for all symmetries.
            features = functional.linear(deviation / total.sqrt(), matrices["input"][0])
            features = features.unflatten(1, (group, -1)).transpose(0, 1).contiguous()
            constant = functional.linear(levels, self.input_level)[None]
            features = features + self.waves.sum(dim=1)[:, None, None] * constant
            if position is not None and self.input_position.numel():
                terms = functional.linear(self.encode_position(position), self.input_position)
                features = features + torch.einsum("rg,ngc->rnc", self.waves, terms.float())
            for expand, reduce, of_level in zip(
                matrices["expand"], matrices["reduce"], self.expand_level, strict=True
            ):
                inner = self.convolve(normalise(features), expand)
                # The activation function acts on the features of all symmetries.
                mirrored = (self.waves.T @ inner.flatten(1)).view_as(inner)
                mirrored = functional.gelu(mirrored + functional.linear(levels, of_level))
                inner = (self.waves @ mirrored.flatten(1)).view_as(inner)
                features = features + self.convolve(inner, reduce)
            features = normalise(features).transpose(0, 1).flatten(1)
            outputs = features @ matrices["output"][0]
        correction, log_ratio = outputs.float().chunk(2, dim=1)
        estimate = self.mean + (linear + spread * correction) @ self.axes.T
        # σ of a pixel is a multiple of the RMS error of the linear estimate.
        return estimate, log_ratio + 0.5 * spread.square().mean(dim=1, keepdim=True).log()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the statistics and the weights by name."""
        arrays = {name: getattr(self, name) for name in (*self.statistics, *self.weights)}
        return {
            name: (torch.stack([*value]) if isinstance(value, nn.ParameterList) else value)
            .detach()
            .numpy()
            .copy()
            for name, value in arrays.items()
        }

    @torch.inference_mode()
    def estimate(
        self, noisy: np.ndarray, level: np.ndarray, position: np.ndarray | None, batch: int = 256
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return PSFs and their calibrated σ, both (n, d, d), float32, of images (n, d, d)."""
        psf, sigma = (np.empty(noisy.shape, np.float32) for _ in range(2))
        matrices = self.matrices()
        scale = np.interp(np.log(level), np.log(self.levels.numpy()), self.sigma_scale.numpy())
        for start in range(0, len(noisy), batch):
            part = slice(start, start + batch)
            inputs = [noisy[part].reshape(len(noisy[part]), -1), level[part]]
            inputs += [] if position is None else [position[part]]
            tensors = [torch.from_numpy(np.asarray(values, np.float32)) for values in inputs]
            mean, log_sigma = self(*tensors, *[None] * (3 - len(tensors)), matrices)
            psf[part] = mean.numpy().reshape(psf[part].shape)
            sigma[part] = log_sigma.exp().numpy().reshape(psf[part].shape)
        return psf, sigma * scale[:, None, None].astype(np.float32)


def number_fields(position: np.ndarray, points: int) -> np.ndarray:
    """Return the numbers ix + P iy of fields, (n,), by their grid indices (ix, iy), (n, 2)."""
    fields: np.ndarray = np.rint(position @ [1, points]).astype(int)
    return fields


def measure_statistics(
    stamps: np.ndarray, levels: np.ndarray, points: int
) -> dict[str, np.ndarray]:
    """Return the buffers of a network: mean, eigenvectors and variances of stamps; and others.

    Parameters
    ----------
    stamps : ndarray, shape (n, P)
        Noise-free stamps.
    levels : ndarray, shape (L,)
        Noise levels of the training.
    points : int
        Field points along a side.
    """
    mean = stamps.mean(axis=0, dtype=np.float64)
    deviation = stamps - mean
    variance, axes = np.linalg.eigh(deviation.T @ deviation / len(stamps))
    return {
        "mean": mean,
        "axes": axes,
        # Rounding leaves no variance below 0, nor of the sum of a stamp, which is always 1.
        "variance": np.maximum(variance, 1e-16),
        "levels": np.sort(levels),
        "sigma_scale": np.ones(len(levels)),
        "points": np.array([points]),
    }


class PosteriorNetworkTraining(Training):
    """Training on stars that are simulated while it lasts.

    Parameters
    ----------
    data : TrainingSet
        Noise, seed, and validation stars; its positions are the fields in which stars are drawn.
    config : Config
        Settings of the simulation.
    settings : PosteriorNetworkSettings
        Sizes of the network and course of the training.
    uses_position : bool
        Whether the position in the field is an input.
    attempt : int
        Not used: these networks do not die.
    """

    model: PosteriorNetwork
    settings: PosteriorNetworkSettings
    plain_fields: tuple[str, ...] = (*Training.plain_fields, "level_errors")
    grad_clip = 1.0
    half_precision_start = 0.0
    sigma_weight = 0.1

    def __init__(
        self,
        data: TrainingSet,
        config: Config,
        settings: PosteriorNetworkSettings,
        uses_position: bool,
        attempt: int = 0,
    ) -> None:
        self.data, self.config = data, config
        self.fields = np.zeros(config.grid.points**2, bool)
        self.fields[number_fields(data.positions[data.train], config.grid.points)] = True
        # Statistics of the first stars, and random weights.
        self.stars = FreshStars.simulate(config, 0, settings.stars, self.fields)
        stamps, _ = self.stars.draw(20_000, self.stream("statistics"))
        symmetries, points = len(list_symmetries(config)), config.grid.points
        model = PosteriorNetwork.build(
            measure_statistics(stamps, data.levels, points),
            *(settings, symmetries, data.noise, uses_position, self.stream("init")),
        )
        # Mean squared error at each noise level, over the latest steps.
        self.level_errors = [float("nan")] * len(data.levels)
        self.sets = 1
        super().__init__(model, settings, settings.steps, attempt, key="posterior_network")

    def stream(self, *names: str | int) -> np.random.Generator:
        """Return the random stream of a purpose."""
        return stream(self.data.seed, "posterior network", *names)

    def begin(self, lr: float) -> torch.optim.Optimizer:
        """Return the optimiser: Muon for the kernels between hidden features, else Adam.

        Without symmetries, the kernels are large matrices, of which Muon's iteration takes several
        times as long as the rest of a step.
        """
        if len(self.model.symmetries) == 1:
            return Adam(self.model.parameters(), lr=lr, fused=True)
        inner = [*self.model.expand, *self.model.reduce]
        others = [p for p in self.model.parameters() if all(p is not w for w in inner)]
        groups: list[dict[str, Any]] = [{"params": others}, {"params": inner, "orthogonal": True}]
        return Muon(groups, lr=lr, fused=True)

    def batches(self, epoch: int) -> Iterator[tuple[torch.Tensor, ...]]:
        """Yield stamps, noisy images, their levels' numbers and their positions."""
        # One further set of stars for each epoch; a training that resumes simulates all of them.
        while self.sets <= epoch and len(self.model.symmetries) > 1:
            new = FreshStars.simulate(self.config, self.sets, self.settings.stars, self.fields)
            self.stars, self.sets = self.stars.add(new), self.sets + 1
        rng, levels = self.stream("epoch", epoch), self.data.levels
        for _ in range(self.steps):
            stamps, position = self.stars.draw(self.settings.batch, rng)
            number = rng.integers(len(levels), size=len(stamps))
            # Laws with correlated pixels need images.
            images = stamps.reshape(-1, *self.data.images.shape[1:])
            noisy = self.data.noise.draw_gaussian(images, levels[number], rng)
            arrays = (stamps, noisy.reshape(stamps.shape), number, position.astype(np.float32))
            yield tuple(map(torch.from_numpy, arrays))

    def loss(self, batch: tuple[torch.Tensor, ...], step: int) -> torch.Tensor:
        """Return the mean over stars of the squared error over the latest errors of its level.

        All noise levels have the same weight in this way. The logarithm of the probability of the
        errors by a normal distribution of the network's σ is added.
        """
        stamps, noisy, number, position = batch
        level = torch.from_numpy(self.data.levels.astype(np.float32))[number]
        estimate, log_sigma = self.model(noisy, level, position)
        square = (estimate - stamps) ** 2
        errors = square.mean(dim=1)
        for n, latest in enumerate(self.level_errors):
            is_level = number == n
            if is_level.any():
                mean = float(errors.detach()[is_level].mean())
                self.level_errors[n] = mean if np.isnan(latest) else 0.98 * latest + 0.02 * mean
        weight = 1.0 / torch.tensor(self.level_errors)[number]
        improbability = log_sigma + 0.5 * square.detach() * torch.exp(-2.0 * log_sigma)
        loss: torch.Tensor = (weight * errors).mean() + self.sigma_weight * improbability.mean()
        return loss

    def validate(self, epoch: int) -> float:
        """Return the geometric mean over the noise levels of the validation stars' MSE."""
        return float(np.exp(np.mean(np.log([*self.measure_validation()]))))

    def measure_validation(self) -> Iterator[float]:
        """Yield the MSE of the validation stars at each level, with the same noise every time."""
        for truth, psf, _ in self.restore_validation():
            yield float(np.square(psf - truth).mean(dtype=np.float64))

    def restore_validation(self) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield truth, PSF and σ of the validation stars at each noise level."""
        stars = self.data.validation
        truth, rng = self.data.images[stars], self.stream("validation")
        for level in np.sort(self.data.levels):
            noisy = self.data.noise.draw(truth, level, rng)
            yield (
                truth,
                *self.model.estimate(noisy, np.full(len(stars), level), self.data.positions[stars]),
            )

    def finish(self) -> PosteriorNetwork:
        """Return the network with the best weights, and with calibrated standard deviations."""
        self.model.load_state_dict(self.result)
        self.model.sigma_scale[:] = torch.from_numpy(self.calibrate_sigma())
        return self.model

    def calibrate_sigma(self) -> np.ndarray:
        """Return the factor of σ at each level by which it holds 68 % of the validation errors."""
        ratios = [np.abs(psf - truth) / sigma for truth, psf, sigma in self.restore_validation()]
        return np.array([np.quantile(ratio, 0.682689) for ratio in ratios])

    def row(self, epoch: int, rate: float, loss: float, error: float) -> Row:
        """Return a row of the history."""
        return {
            "epoch": epoch,
            "step": epoch * self.steps,
            "lr": rate,
            "loss": loss,
            "validation_mse": error,
            "seconds": round(self.seconds, 3),
            "cpu_seconds": round(self.cpu_seconds, 3),
        }
