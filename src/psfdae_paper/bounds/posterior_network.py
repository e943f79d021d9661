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

For stars with random Seidel aberrations, a second network proposes wavefronts: a mixture of
Gaussians of the eight coefficients of pupil monomials on which a stamp depends
(`WavefrontCoordinates`). Its training begins with the weights of the trained network.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from psfdae.base.rng import stream
from psfdae.methods.interface import Estimate, TrainingSet
from psfdae.methods.networks.training import Muon, Row, Training, use_half_precision
from psfdae.optics.wavefronts import MONOMIALS, monomial_coefficients
from psfdae.stars.noise import NoiseModel
from psfdae_paper.bounds.estimates import simulate_fresh_stars
from psfdae_paper.bounds.posterior import Bank, compute_symmetry_weights, list_jitters
from psfdae_paper.configuration.posterior_network import PosteriorNetworkSettings
from psfdae_paper.configuration.schema import Config
from psfdae_paper.stars.fields import number_fields, relative_field
from psfdae_paper.stars.symmetry import SYMMETRIES

POSITION_TERMS = 9
"""Terms of a polynomial of third order in two coordinates, without the constant."""


# The wavefronts of stars.


class WavefrontCoordinates:
    """Coordinates of the wavefronts that give a stamp, which mirror images permute up to signs.

    A stamp depends on the coefficients of the eight pupil monomials, with tilts that move it from
    the chief ray to its place. The middle is the pixel d // 2, about which stamps are mirrored.
    """

    size = len(MONOMIALS)

    to_coordinates = np.zeros((size, size))
    """Matrix from coefficients (r4, r2x, r2y, xx, xy, yy, x, y), in rows: spherical aberration,
    coma, focus, astigmatism, tilts."""
    to_coordinates[[0, 1, 2, 6, 7], [0, 1, 2, 6, 7]] = 1.0
    to_coordinates[3, [3, 5]] = to_coordinates[5, 4] = 0.5
    to_coordinates[4, [3, 5]] = 0.5, -0.5

    order = np.array([0, 4, 4, 1, 2, 3, 5, 5])
    """Order in which errors of coordinates depend on each other; a pair has the same number."""

    @classmethod
    def encode(cls, coefficients: np.ndarray, pixel: float) -> np.ndarray:
        """Return coordinates (n, 8) of coefficients (n, 8) about the middle of a stamp.

        `pixel` is the width of a pixel in λ/D.
        """
        about_middle = coefficients.copy()
        # From the corner of the stamp's middle to the pixel at d // 2: half a pixel along x and y.
        about_middle[:, -2:] -= 0.25 * pixel
        return np.asarray(about_middle @ cls.to_coordinates.T)

    @classmethod
    def decode(cls, coordinates: np.ndarray, pixel: float) -> np.ndarray:
        """Return the coefficients (..., 8) of coordinates (..., 8), the inverse of `encode`."""
        coefficients = coordinates @ np.linalg.inv(cls.to_coordinates).T
        coefficients[..., -2:] += 0.25 * pixel
        return np.asarray(coefficients)

    @classmethod
    def mirror(cls) -> np.ndarray:
        """Return the matrices (8, 8, 8) that move the coordinates of stars by `SYMMETRIES`."""
        matrices = np.zeros((len(SYMMETRIES), cls.size, cls.size))
        for matrix, symmetry in zip(matrices, SYMMETRIES, strict=True):
            matrix[[0, 3], [0, 3]] = 1.0
            matrix[1:3, 1:3] = matrix[6:, 6:] = symmetry.matrix
            # x² − y² changes its sign with an exchange of x and y, xy with a single flip.
            matrix[4, 4] = 1 - 2 * symmetry.transpose
            matrix[5, 5] = 1 - 2 * (symmetry.flip_rows != symmetry.flip_columns)
        return matrices


# Stars that are drawn without end.


class DrawnStars(NamedTuple):
    """Stamps with the properties that a training uses.

    Attributes
    ----------
    stamps : ndarray, shape (n, P)
        Noise-free stamps of sum 1.
    position : ndarray of int, shape (n, 2)
        Grid indices of their fields.
    wavefront : ndarray, shape (n, 8) or (n, 0)
        `WavefrontCoordinates`; none without random Seidel aberrations.
    """

    stamps: np.ndarray
    position: np.ndarray
    wavefront: np.ndarray


@dataclass(frozen=True)
class FreshStars:
    """Simulated stars from which stamps at all centring errors and mirror images are cut.

    Attributes
    ----------
    frames : ndarray, shape (M, h²), float32
        Framed stars with a margin.
    field : ndarray of int, shape (M,)
        Field of each star.
    peak : ndarray of int, shape (M, 2)
        Brightest pixel (row, column) from the chief ray.
    seidel : ndarray, shape (M, 5) or (M, 0)
        Seidel coefficients in waves; none for other wavefronts.
    choices : ndarray of int, shape (C, 2)
        Star and symmetry of stamps that are equally likely; some are listed several times.
    pixels : ndarray of int, shape (G, J, P)
        Pixels of a frame that are the stamp at each symmetry and centring error.
    relative_field : ndarray, shape (F, 2)
        Field vectors, 1 at the edge on an axis.
    pixel : float
        Width of a pixel in λ/D.
    """

    frames: np.ndarray
    field: np.ndarray
    peak: np.ndarray
    seidel: np.ndarray
    choices: np.ndarray
    pixels: np.ndarray
    relative_field: np.ndarray
    pixel: float

    @classmethod
    def simulate(
        cls, config: Config, number: int | str, count: int, fields: np.ndarray
    ) -> FreshStars:
        """Simulate a set of stars.

        Parameters
        ----------
        config : Config
            Settings with the groups of `consistency.SIMULATION`.
        number : int or str
            Number or name of the set; each has other stars.
        count : int
            Stars of the set.
        fields : ndarray of bool, shape (F,)
            Fields in which stamps are drawn.
        """
        framing, points = config.framing, config.grid.points
        margin = framing.jitter_px + Bank.mirror_margin
        columns = {
            name: column.values
            for name, column in simulate_fresh_stars(config, f"network{number}", count).items()
        }
        frames, field, peak = (columns[name] for name in ("framed", "field_index", "peak"))
        seidel = columns.get("seidel", np.empty((len(field), 0)))
        times = compute_symmetry_weights(field, peak, points)
        # Mirrored stars are at mirrored fields, which may be left out.
        mirror_field = np.stack([s.field(field, points) for s in SYMMETRIES], axis=1)
        star, symmetry = np.nonzero(times * fields[mirror_field])
        choices = np.stack([star, symmetry], axis=1).repeat(times[star, symmetry], axis=0)
        # Windows of all symmetries and centring errors, as pixels of the flat frame.
        size, side = frames.shape[-1], framing.stamp_px
        index = np.arange(size**2).reshape(size, size)
        pixels = np.empty((len(SYMMETRIES), len(list_jitters(framing.jitter_px)), side**2), int)
        for g, symmetry_of_square in enumerate(SYMMETRIES):
            for j, jitter in enumerate(list_jitters(framing.jitter_px)):
                row, column = symmetry_of_square.window(jitter, margin)
                window = index[row : row + side, column : column + side]
                pixels[g, j] = symmetry_of_square.image(window).ravel()
        flat = frames.reshape(len(frames), -1).astype(np.float32)
        place = relative_field(config.grid), config.telescope.pixel
        return cls(flat, field, peak, seidel, choices, pixels, *place)

    def add(self, other: FreshStars) -> FreshStars:
        """Return the stars of both sets."""
        added_choices = other.choices + np.array([len(self.field), 0])
        return replace(
            self,
            frames=np.concatenate([self.frames, other.frames]),
            field=np.concatenate([self.field, other.field]),
            peak=np.concatenate([self.peak, other.peak]),
            seidel=np.concatenate([self.seidel, other.seidel]),
            choices=np.concatenate([self.choices, added_choices]),
        )

    def draw(self, count: int, rng: np.random.Generator) -> DrawnStars:
        """Draw stamps at random mirror images and centring errors."""
        star, symmetry = self.choices[rng.integers(len(self.choices), size=count)].T
        jitter = rng.integers(self.pixels.shape[1], size=count)
        stamps = np.take_along_axis(self.frames[star], self.pixels[symmetry, jitter], axis=1)
        stamps /= stamps.sum(axis=1, keepdims=True)
        points = round(len(self.relative_field) ** 0.5)
        field, peak = np.empty(count, int), np.empty((count, 2), int)
        for g in range(len(self.pixels)):
            is_mirrored = symmetry == g
            field[is_mirrored] = SYMMETRIES[g].field(self.field[star[is_mirrored]], points)
            peak[is_mirrored] = SYMMETRIES[g].pixel(self.peak[star[is_mirrored]])
        wavefront = np.empty((count, 0))
        if self.seidel.shape[1]:
            # Tilts show the image at the middle of the stamp: columns run along x, rows along y.
            coefficients = monomial_coefficients(self.seidel[star], self.relative_field[field])
            reach = round((self.pixels.shape[1] ** 0.5 - 1) / 2)
            offset = peak - np.array(list_jitters(reach))[jitter]
            coefficients[:, -2:] -= 0.5 * self.pixel * offset[:, ::-1]
            wavefront = WavefrontCoordinates.encode(coefficients, self.pixel)
        return DrawnStars(stamps, np.stack(np.divmod(field, points)[::-1], axis=1), wavefront)


# The network.

Matrices = Mapping[str, Sequence[Any]]
"""Matrices of the layers of a network, by kind of layer."""


def list_representations() -> np.ndarray:
    """Return the orthonormal functions on the symmetries that are elements of irreducible matrices.

    Convolutions on the group of a square's symmetries are products of their transforms by these
    functions.

    Returns
    -------
    ndarray, shape (G, G)
        A function in each row: four representations of one dimension, then the four elements of the
        rotations and reflections of the plane, row by row.
    """
    # A reflection changes the sign of the determinant; there is a sign for the transposition, too.
    planes = np.stack([symmetry.matrix for symmetry in SYMMETRIES])
    determinant = np.linalg.det(planes)
    transposition = np.array([1.0 - 2.0 * symmetry.transpose for symmetry in SYMMETRIES])
    scalars = [np.ones(len(planes)), determinant, transposition, determinant * transposition]
    elements = planes.reshape(-1, 4).T * np.sqrt(2.0)
    waves: np.ndarray = np.concatenate([scalars, elements]) / np.sqrt(len(planes))
    return waves


def normalise(features: torch.Tensor) -> torch.Tensor:
    """Divide features (G, n, a) by the root of their mean square for each star."""
    square = features.square().mean(dim=(0, 2), keepdim=True)
    return features * torch.rsqrt(square + 1e-6)


class Proposals(NamedTuple):
    """Mixture of K Gaussians of each star's wavefront, in `WavefrontCoordinates`.

    Prior and image determine some sums of coordinates far better than the coordinates. The
    deviations d of a Gaussian are independent after elimination, as (1 + N) d with a strictly
    triangular N: each one less the part that those before it in `WavefrontCoordinates.order`
    explain.

    Attributes
    ----------
    log_weight : Tensor, shape (n, K)
        Logarithm of the probability of each Gaussian.
    mean : Tensor, shape (n, K, 8)
        Coordinates, standardised in the network.
    log_sd : Tensor, shape (n, K, 8)
        Logarithms of the standard deviations of (1 + N) d.
    couplings : Tensor, shape (n, K, 8, 8)
        Matrix N.
    """

    log_weight: torch.Tensor
    mean: torch.Tensor
    log_sd: torch.Tensor
    couplings: torch.Tensor

    @property
    def root(self) -> torch.Tensor:
        """Matrices R = s⁻¹ (1 + N), (n, K, 8, 8): RᵀR is the inverse covariance."""
        return torch.exp(-self.log_sd)[..., None] * (self.couplings + torch.eye(self.mean.shape[2]))

    def log_density(self, wavefront: torch.Tensor) -> torch.Tensor:
        """Return the log-density (n,) at coordinates (n, 8), without the constant of a Gaussian."""
        # N is strictly triangular: the determinant of R is the product of 1 / s. Products in
        # half precision would lose the sums that an image determines best.
        with torch.autocast("cpu", enabled=False):
            distance = self.root @ (wavefront[:, None] - self.mean)[..., None]
        log_part = self.log_weight - self.log_sd.sum(dim=2) - 0.5 * distance.square().sum((2, 3))
        return torch.logsumexp(log_part, dim=1)


class Outputs(NamedTuple):
    """Results of the network for n stars.

    Attributes
    ----------
    psf, log_sigma : Tensor, shape (n, P)
        Estimates, and the logarithms of their standard deviations.
    """

    psf: torch.Tensor
    log_sigma: torch.Tensor


class FeatureNetwork(nn.Module):
    """Residual group convolutions from images to features; see the module.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        Statistics of `measure_statistics`, as buffers, and the weights by name.
    noise : NoiseModel
        Noise of the images.
    """

    statistics: tuple[str, ...] = ("mean", "axes", "variance", "levels")
    weights: tuple[str, ...] = ("input", "input_level", "expand", "expand_level", "reduce")
    mean: torch.Tensor
    axes: torch.Tensor
    variance: torch.Tensor
    levels: torch.Tensor
    input: nn.Parameter
    input_level: nn.Parameter
    expand: nn.ParameterList
    expand_level: nn.ParameterList
    reduce: nn.ParameterList

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
        side = round(len(arrays["mean"]) ** 0.5)
        index = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
        images = [symmetry.image(index)[:side, :side] for symmetry in SYMMETRIES]
        self.filters = torch.from_numpy(np.stack([image.ravel() for image in images]))
        self.waves = torch.from_numpy(list_representations().astype(np.float32))

    def transform_filters(self, weight: torch.Tensor) -> torch.Tensor:
        """Return filters (G, b, P) of stamps, by representation, of filters (b, (d + 1)²)."""
        return torch.einsum("rg,bgp->rbp", self.waves, weight[:, self.filters])

    def transform_kernels(self, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the matrices of a group convolution with weights (b, G, a), by representation.

        Returns
        -------
        scalars : Tensor, shape (4, a, b)
            Matrices of the representations of one dimension.
        pairs : Tensor, shape (2a, 2b)
            Matrix of both rows of the representation of two dimensions.
        """
        # A convolution is a product of the transforms; waves are orthonormal, the matrices of a
        # representation are √(G / its dimension) times as large.
        _, group, width = weight.shape
        kernels = torch.einsum("rg,bga->rab", self.waves, weight) * group**0.5
        scalars, elements = kernels.split(4)
        # Rows are features (l, a), columns (j, b), of the matrix element (j, l).
        pairs = (elements / 2**0.5).unflatten(0, (2, 2)).permute(1, 2, 0, 3)
        return scalars, pairs.reshape(2 * width, -1)

    def convolve(
        self, features: torch.Tensor, matrices: tuple[torch.Tensor, torch.Tensor]
    ) -> torch.Tensor:
        """Map features (G, n, a), by representation, to features (G, n, b)."""
        stars = features.shape[1]
        scalars = features[:4] @ matrices[0]
        # Features (i, j) of both rows i of the matrices have the same weights.
        rows = features[4:].unflatten(0, (2, 2)).transpose(1, 2).reshape(2 * stars, -1)
        pairs = (rows @ matrices[1]).view(2, stars, 2, -1).transpose(1, 2).flatten(0, 1)
        return torch.cat([scalars, pairs])

    def matrices(self) -> Matrices:
        """Return the matrices of all layers."""
        return {
            # The input is given in the eigenvectors.
            "input": [self.transform_filters(self.input).flatten(0, 1) @ self.axes],
            "expand": [self.transform_kernels(weight) for weight in self.expand],
            "reduce": [self.transform_kernels(weight) for weight in self.reduce],
        }

    def encode_level(self, level: torch.Tensor) -> torch.Tensor:
        """Return features (n, 4) of noise levels: powers of ln λ, scaled to ±1 in training."""
        low, high = self.levels.log().aminmax()
        half = torch.clamp((high - low) / 2, min=1e-3)
        scaled = torch.clamp((level.log() - (low + high) / 2) / half, -1.0, 1.0)
        return torch.stack([scaled**power for power in range(4)], dim=1)

    def compute_variance(self, level: torch.Tensor) -> torch.Tensor:
        """Return the noise variance (n, 1) at levels (n,), with the photons of the mean star."""
        photons = self.noise.kappa / self.noise.background**0.5 / len(self.mean)
        variance: torch.Tensor = (self.noise.kappa * level) ** 2 + photons * level
        return variance[:, None]

    def compute_features(
        self,
        inputs: torch.Tensor,
        level: torch.Tensor,
        matrices: Matrices,
        constant: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Return features (G, n, width), by representation.

        Parameters
        ----------
        inputs : Tensor, shape (n, P)
            Images in the eigenvectors, over √(v + s²).
        level : Tensor, shape (n,)
            Noise levels λ.
        matrices : mapping
            Result of `matrices`.
        constant : Tensor, shape (G, n, width), optional
            Term that is added to the first features.
        """
        with use_half_precision():
            levels = self.encode_level(level)
            # The level is the same for all symmetries.
            features = functional.linear(inputs, matrices["input"][0])
            features = features.unflatten(1, (len(SYMMETRIES), -1)).transpose(0, 1).contiguous()
            of_level = functional.linear(levels, self.input_level)[None]
            features = features + self.waves.sum(dim=1)[:, None, None] * of_level
            if constant is not None:
                features = features + constant
            for expand, reduce, of_level in zip(
                matrices["expand"], matrices["reduce"], self.expand_level, strict=True
            ):
                inner = self.convolve(normalise(features), expand)
                # The activation function acts on the features of all symmetries.
                mirrored = (self.waves.T @ inner.flatten(1)).view_as(inner)
                mirrored = functional.gelu(mirrored + functional.linear(levels, of_level))
                inner = (self.waves @ mirrored.flatten(1)).view_as(inner)
                features = features + self.convolve(inner, reduce)
            return normalise(features)

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


class PosteriorNetwork(FeatureNetwork):
    """Network that corrects the linear estimate of PSFs; see the module."""

    statistics = (*FeatureNetwork.statistics, "sigma_scale", "sigma_ratio95", "points")
    weights = (*FeatureNetwork.weights, "input_position", "output", "output_sigma")
    sigma_scale: torch.Tensor
    sigma_ratio95: torch.Tensor
    points: torch.Tensor
    input_position: nn.Parameter
    output: nn.Parameter
    output_sigma: nn.Parameter

    @classmethod
    def build(
        cls,
        statistics: Mapping[str, np.ndarray],
        settings: PosteriorNetworkSettings,
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
        noise : NoiseModel
            Noise of the images.
        uses_position : bool
            Whether the position in the field is an input.
        rng : Generator
            Source of the weights.
        """
        group, pixels = len(SYMMETRIES), (round(len(statistics["mean"]) ** 0.5) + 1) ** 2
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

    def matrices(self) -> Matrices:
        """Return the matrices of all layers; the correction is given in the eigenvectors."""
        last, of_sigma = (
            self.transform_filters(weight).flatten(0, 1)
            for weight in (self.output, self.output_sigma)
        )
        return {**super().matrices(), "output": [torch.cat([last @ self.axes, of_sigma], dim=1)]}

    def encode_position(self, position: torch.Tensor) -> torch.Tensor:
        """Return polynomials (n, G, 9) of the mirrored grid indices (n, 2)."""
        middle = torch.clamp((self.points - 1) / 2, min=0.5)
        matrices = torch.from_numpy(np.stack([s.matrix for s in SYMMETRIES]))
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
    ) -> Outputs:
        """Map noisy images (n, P) of levels (n,) to estimates.

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
        matrices = matrices or self.matrices()
        # The linear estimate and its standard deviation.
        noise = self.compute_variance(level)
        total, deviation = self.variance + noise, (noisy - self.mean) @ self.axes
        linear, spread = self.variance / total * deviation, (self.variance * noise / total).sqrt()
        constant = None
        if position is not None and self.input_position.numel():
            terms = functional.linear(self.encode_position(position), self.input_position)
            constant = torch.einsum("rg,ngc->rnc", self.waves, terms)
        features = self.compute_features(deviation / total.sqrt(), level, matrices, constant)
        with use_half_precision():
            outputs = features.transpose(0, 1).flatten(1) @ matrices["output"][0]
        correction, log_ratio = outputs.float().chunk(2, dim=1)
        # σ of a pixel is a multiple of the RMS error of the linear estimate.
        log_scale = 0.5 * spread.square().mean(dim=1, keepdim=True).log()
        return Outputs(
            self.mean + (linear + spread * correction) @ self.axes.T, log_ratio + log_scale
        )

    @torch.inference_mode()
    def estimate(
        self, noisy: np.ndarray, level: np.ndarray, position: np.ndarray | None, batch: int = 256
    ) -> Estimate:
        """Return estimates of images (n, d, d) of levels (n,), with calibrated σ."""
        matrices, (psf, sigma) = self.matrices(), np.empty((2, *noisy.shape), np.float32)
        for start in range(0, len(noisy), batch):
            part = slice(start, start + batch)
            inputs = [noisy[part].reshape(len(noisy[part]), -1), level[part]]
            inputs += [] if position is None else [position[part]]
            tensors = [torch.from_numpy(np.asarray(values, np.float32)) for values in inputs]
            outputs = self(*tensors, *[None] * (3 - len(tensors)), matrices)
            shape = noisy[part].shape
            psf[part] = outputs.psf.view(shape).numpy()
            sigma[part] = outputs.log_sigma.exp().view(shape).numpy()
        scale = np.interp(np.log(level), np.log(self.levels.numpy()), self.sigma_scale.numpy())
        return Estimate(psf, sigma * scale[:, None, None].astype(np.float32))


class WavefrontNetwork(FeatureNetwork):
    """Network that proposes wavefronts of stars with random Seidel aberrations."""

    statistics = (*FeatureNetwork.statistics, "coordinate_mean", "coordinate_sd")
    weights = (*FeatureNetwork.weights, "output")
    gaussians = 8
    """Gaussians of the mixture of wavefronts."""
    order = WavefrontCoordinates.order
    coupling_elements = np.flatnonzero(order[:, None] > order)
    """Elements of the matrices N that are not 0, in the flat matrices."""
    coordinate_mean: torch.Tensor
    coordinate_sd: torch.Tensor
    output: nn.Parameter

    def __init__(self, arrays: Mapping[str, np.ndarray], noise: NoiseModel) -> None:
        super().__init__(arrays, noise)
        mirrors = WavefrontCoordinates.mirror()
        self.mirrors = torch.from_numpy(mirrors.astype(np.float32))

    @classmethod
    def begin(
        cls, network: FeatureNetwork, wavefront: np.ndarray, rng: np.random.Generator
    ) -> WavefrontNetwork:
        """Return a network with the features of another network.

        Parameters
        ----------
        network : FeatureNetwork
            Trained network.
        wavefront : ndarray, shape (n, 8)
            Coordinates of stars, whose mean and standard deviations become the units.
        rng : Generator
            Source of the weights of the last layer.
        """
        # By symmetry, only spherical aberration and focus have a mean, and x and y the same
        # scatter.
        mean, sd = wavefront.mean(axis=0), wavefront.std(axis=0)
        mean[[1, 2, 4, 5, 6, 7]] = 0.0
        for pair in ([1, 2], [6, 7]):
            sd[pair] = np.sqrt(np.square(sd[pair]).mean())
        # Small weights, but different for each Gaussian.
        width = len(network.input_level)
        outputs = 1 + 2 * WavefrontCoordinates.size + len(cls.coupling_elements)
        shape = cls.gaussians, outputs, width
        layer = 0.1 * rng.standard_normal(shape) / np.sqrt(width)
        arrays = {
            **network.to_arrays(),
            "coordinate_mean": mean,
            # Coordinates that do not vary are standardised to 0.
            "coordinate_sd": np.maximum(sd, 1e-3),
            "output": layer,
        }
        return cls(arrays, network.noise)

    def forward(
        self, noisy: torch.Tensor, level: torch.Tensor, matrices: Matrices | None = None
    ) -> Proposals:
        """Map noisy images (n, P) of levels (n,) to wavefronts; see `PosteriorNetwork.forward`."""
        total = self.variance + self.compute_variance(level)
        inputs = ((noisy - self.mean) @ self.axes) / total.sqrt()
        features = self.compute_features(inputs, level, matrices or self.matrices())
        # The feature of a symmetry g has seen the star that g moves to the image.
        with torch.autocast("cpu", enabled=False):
            views = torch.einsum("rg,rnw->gnw", self.waves, features.float())
            return self.average(torch.einsum("gnw,kvw->gnkv", views, self.output))

    def average(self, values: torch.Tensor) -> Proposals:
        """Return the means over the symmetries of proposals (G, n, K, ·), each as it has seen."""
        size, group = WavefrontCoordinates.size, len(SYMMETRIES)
        parts = [1, size, size, len(self.coupling_elements)]
        logits, mean, log_sd, elements = values.split(parts, dim=3)
        couplings = values.new_zeros(*values.shape[:3], size**2)
        couplings[..., torch.from_numpy(self.coupling_elements)] = elements
        couplings = couplings.unflatten(3, (size, size))
        # Wavefronts are moved as the stars that the symmetries have seen.
        mirrors = self.mirrors[:, None, None]
        return Proposals(
            logits.mean(dim=0).squeeze(2).log_softmax(dim=1),
            torch.einsum("gab,gnkb->nka", self.mirrors, mean) / group,
            torch.einsum("gab,gnkb->nka", self.mirrors.abs(), log_sd) / group,
            (mirrors @ couplings @ mirrors.mT).mean(dim=0),
        )

    @torch.inference_mode()
    def propose(
        self, noisy: np.ndarray, level: np.ndarray, batch: int = 256
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the wavefronts of images (n, d, d) of levels (n,), the most likely first.

        Returns
        -------
        log_weight : ndarray, shape (n, K)
            Logarithms of their probabilities.
        mean : ndarray, shape (n, K, 8)
            Coordinates in waves.
        root : ndarray, shape (n, K, 8, 8)
            Matrices R, of which RᵀR are the inverse covariances.
        """
        matrices, size = self.matrices(), WavefrontCoordinates.size
        shape = len(noisy), self.gaussians
        log_weight, mean, root = (np.empty((*shape, *[size] * rank)) for rank in range(3))
        for start in range(0, len(noisy), batch):
            part = slice(start, start + batch)
            inputs = noisy[part].reshape(len(noisy[part]), -1), level[part]
            tensors = [torch.from_numpy(np.asarray(values, np.float32)) for values in inputs]
            proposals = self(*tensors, matrices)
            log_weight[part] = proposals.log_weight.numpy()
            # Within the range of wavefronts that can be propagated.
            scaled_mean = proposals.mean.clamp(-4.0, 4.0)
            mean[part] = (scaled_mean * self.coordinate_sd + self.coordinate_mean).numpy()
            root[part] = (proposals.root / self.coordinate_sd).numpy()
        stars, order = np.arange(len(noisy))[:, None], np.argsort(-log_weight, axis=1)
        return log_weight[stars, order], mean[stars, order], root[stars, order]


def measure_statistics(stars: DrawnStars, levels: np.ndarray, points: int) -> dict[str, np.ndarray]:
    """Return the buffers of a network: mean, eigenvectors and variances of stamps; and others.

    Parameters
    ----------
    stars : DrawnStars
        Noise-free stars.
    levels : ndarray, shape (L,)
        Noise levels of the training.
    points : int
        Field points along a side.
    """
    mean = stars.stamps.mean(axis=0, dtype=np.float64)
    deviation = stars.stamps - mean
    variance, axes = np.linalg.eigh(deviation.T @ deviation / len(deviation))
    return {
        "mean": mean,
        "axes": axes,
        # Rounding leaves no variance below 0, nor of the sum of a stamp, which is always 1.
        "variance": np.maximum(variance, 1e-16),
        "levels": np.sort(levels),
        "sigma_scale": np.ones(len(levels)),
        "sigma_ratio95": np.full(len(levels), 1.96),
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
    first_epoch = 0
    """Number of the first epoch, by which random streams and sets of stars are named."""

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
        self.stars, self.sets = FreshStars.simulate(config, 0, settings.stars, self.fields), 1
        # Mean squared error at each noise level, over the latest steps.
        self.level_errors = [float("nan")] * len(data.levels)
        stamps = self.stars.draw(20_000, self.stream("statistics"))
        model = self.build(stamps, settings, uses_position)
        super().__init__(model, settings, settings.steps, attempt, key="posterior_network")

    def build(
        self, stars: DrawnStars, settings: PosteriorNetworkSettings, uses_position: bool
    ) -> nn.Module:
        """Return a network with the statistics of stars, and random weights."""
        statistics = measure_statistics(stars, self.data.levels, self.config.grid.points)
        rng = self.stream("init")
        return PosteriorNetwork.build(statistics, settings, self.data.noise, uses_position, rng)

    def stream(self, *names: str | int) -> np.random.Generator:
        """Return the random stream of a purpose."""
        return stream(self.data.seed, "posterior network", *names)

    def make_optimiser(self, lr: float) -> torch.optim.Optimizer:
        """Return the optimiser: Muon for the kernels between hidden features, else Adam."""
        inner = [*self.model.expand, *self.model.reduce]
        others = [p for p in self.model.parameters() if all(p is not w for w in inner)]
        groups: list[dict[str, Any]] = [{"params": others}, {"params": inner, "orthogonal": True}]
        return Muon(groups, lr=lr, fused=True)

    def batches(self, epoch: int) -> Iterator[tuple[torch.Tensor, ...]]:
        """Yield stamps, noisy images, their levels' numbers, positions and wavefronts."""
        epoch += self.first_epoch
        # One further set of stars for each epoch; a training that resumes simulates all of them.
        while self.sets <= epoch:
            new = FreshStars.simulate(self.config, self.sets, self.settings.stars, self.fields)
            self.stars, self.sets = self.stars.add(new), self.sets + 1
        rng, levels = self.stream("epoch", epoch), self.data.levels
        for _ in range(self.steps):
            stamps, position, wavefront = self.stars.draw(self.settings.batch, rng)
            number = rng.integers(len(levels), size=len(stamps))
            # Laws with correlated pixels need images.
            images = stamps.reshape(-1, *self.data.images.shape[1:])
            noisy = self.data.noise.draw_gaussian(images, levels[number], rng)
            noisy, places = noisy.reshape(stamps.shape), (position, wavefront)
            arrays = (stamps, noisy, number, *(values.astype(np.float32) for values in places))
            yield tuple(map(torch.from_numpy, arrays))

    def loss(self, batch: tuple[torch.Tensor, ...], step: int) -> torch.Tensor:
        """Return the mean over stars of the squared error over the latest errors of its level.

        All noise levels have the same weight in this way. The logarithm of the probability of the
        errors by a normal distribution of the network's σ is added.
        """
        stamps, noisy, number, position, _ = batch
        psf, log_sigma = self.model(noisy, self.levels[number], position)
        square = (psf - stamps) ** 2
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

    @property
    def levels(self) -> torch.Tensor:
        """Noise levels (L,) of the training."""
        return torch.from_numpy(self.data.levels.astype(np.float32))

    def validate(self, epoch: int) -> float:
        """Return the geometric mean over the noise levels of the validation stars' MSE."""
        return float(np.exp(np.mean(np.log([*self.measure_validation()]))))

    def measure_validation(self) -> Iterator[float]:
        """Yield the MSE of the validation stars at each level, with the same noise every time."""
        stars = self.data.validation
        truth, rng = self.data.images[stars], self.stream("validation")
        for level in np.sort(self.data.levels):
            noisy = self.data.noise.draw(truth, level, rng)
            levels = np.full(len(stars), level)
            psf = self.model.estimate(noisy, levels, self.data.positions[stars]).psf
            yield float(np.square(psf - truth).mean(dtype=np.float64))

    def finish(self) -> PosteriorNetwork:
        """Return the network with the best weights, and with calibrated standard deviations."""
        self.model.load_state_dict(self.result)
        scale68, scale95 = self.calibrate_sigma()
        self.model.sigma_scale[:] = torch.from_numpy(scale68)
        self.model.sigma_ratio95[:] = torch.from_numpy(scale95 / scale68)
        return self.model

    def draw_fresh_stars(self) -> DrawnStars:
        """Draw stamps of stars that the training has not used.

        As many stars as of an epoch are simulated, and each is drawn twice on average.
        """
        count = self.settings.stars
        fresh = FreshStars.simulate(self.config, "calibration", count, self.fields)
        return fresh.draw(2 * count, self.stream("calibration"))

    def calibrate_sigma(self) -> np.ndarray:
        """Return the factors (2, L) of σ by which it holds 68 % and 95 % of the errors of stars.

        The errors of a posterior of several wavefronts are not normal.
        """
        stars = self.draw_fresh_stars()
        truth = stars.stamps.reshape(-1, *self.data.images.shape[1:])
        scales, rng = [], self.stream("calibration", "noise")
        for level in np.sort(self.data.levels):
            noisy = self.data.noise.draw(truth, level, rng)
            estimate = self.model.estimate(noisy, np.full(len(truth), level), stars.position)
            ratio = np.abs(estimate.psf - truth) / estimate.sigma
            scales.append(np.quantile(ratio, [0.682689, 0.95]))
        return np.array(scales).T

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


class WavefrontTraining(PosteriorNetworkTraining):
    """Training of a network that proposes wavefronts, from the features of a trained network.

    Parameters
    ----------
    data, config, settings
        See `PosteriorNetworkTraining`.
    network : PosteriorNetwork
        Network of an earlier training with these settings, whose epochs this one continues, with
        further stars and other noise.
    attempt : int
        Not used: these networks do not die.
    """

    model: WavefrontNetwork  # type: ignore[assignment]

    def __init__(
        self,
        data: TrainingSet,
        config: Config,
        settings: PosteriorNetworkSettings,
        network: PosteriorNetwork,
        attempt: int = 0,
    ) -> None:
        self.network, self.first_epoch = network, settings.epochs
        super().__init__(data, config, settings, uses_position=False, attempt=attempt)

    def build(
        self, stars: DrawnStars, settings: PosteriorNetworkSettings, uses_position: bool
    ) -> nn.Module:
        """Return a network with the features of the earlier one."""
        return WavefrontNetwork.begin(self.network, stars.wavefront, self.stream("wavefront"))

    def loss(self, batch: tuple[torch.Tensor, ...], step: int) -> torch.Tensor:
        """Return the mean over stars of −ln of the probability of their wavefronts."""
        _, noisy, number, _, wavefront = batch
        scaled_wavefront = (wavefront - self.model.coordinate_mean) / self.model.coordinate_sd
        proposals = self.model(noisy, self.levels[number])
        loss: torch.Tensor = -proposals.log_density(scaled_wavefront).mean()
        return loss

    def validate(self, epoch: int) -> float:
        """Return NaN: the last weights are used."""
        return float("nan")
