"""The network of the paper's section 2.2, a denoising autoencoder, and its training.

Ten convolutions with "same" padding and ReLU after each, kernels 9, 7, 5, 3, 1
as the encoder and 1, 3, 5, 7, 9 as the decoder, no pooling; the output has the
size of the input.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import torch
from torch import nn
from torch.nn.grad import conv2d_weight

from psfdae.base.rng import stream
from psfdae.methods.interface import TrainingSet
from psfdae.methods.networks.settings import DaeSettings, Train, image_scale
from psfdae.methods.networks.training import (
    Adam,
    DeadNetworkError,
    Muon,
    Row,
    Training,
    TrainingError,
)
from psfdae.methods.networks.weights import channels_last


class SingleChannelConv(nn.Conv2d):
    """Convolution to one channel, with a kernel of odd side k and the padding k // 2.

    oneDNN vectorises over output channels and is slow for a single one. On the CPU, one strided
    convolution computes blocks of output pixels, with a channel for each pixel of a block.
    Gradients are computed by the transposed convolution, from one channel to many, which is fast.
    """

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (B, C, h, w) to (B, 1, h, w)."""
        if x.device.type != "cpu":
            return super().forward(x)
        # Always float32: the result is the PSF, whose pixels bfloat16 would round by up to 0.2 %.
        with torch.autocast("cpu", enabled=False):
            output: torch.Tensor = _ToOneChannel.apply(x.float(), self.weight, self.bias)  # type: ignore[no-untyped-call]
        return output


class _ToOneChannel(torch.autograd.Function):
    """Correlation of images (B, C, h, w) with a weight (1, C, s, s), s odd, plus a bias (1,)."""

    @staticmethod
    def forward(
        ctx: Any, x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor
    ) -> torch.Tensor:
        ctx.save_for_backward(x, weight)
        (height, width), side = x.shape[-2:], weight.shape[-1]
        # Blocks of 4 x 4 output pixels give 16 channels for vector instructions.
        block = 4
        # All pixels of a block together depend on s + block − 1 pixels along an axis. The kernel of
        # one pixel is the weight, shifted within a window of this side; elsewhere it is 0.
        window_px = side + block - 1
        padded_weight = nn.functional.pad(weight[0], (block - 1,) * 4)
        # Window i of the padded weight belongs to pixel block − 1 − i of a block.
        windows = padded_weight.unfold(1, window_px, 1).unfold(2, window_px, 1).flip(1, 2)
        kernels = windows.permute(1, 2, 0, 3, 4).flatten(0, 1)
        # Zeros complete the last blocks of an image whose side is not a multiple of the block.
        if width % block or height % block:
            x = nn.functional.pad(x, (0, -width % block, 0, -height % block))
        # Every pixel has the same bias.
        blocks = nn.functional.conv2d(
            x, kernels, bias.expand(block**2), stride=block, padding=side // 2
        )
        # From block² channels, one for each pixel of a block, to one channel; zeros are cut off.
        return nn.functional.pixel_shuffle(blocks, block)[..., :height, :width]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, ...]:
        # The adjoint of a correlation with an odd kernel is the correlation with the flipped
        # kernel. The gradient with respect to the weight is the correlation of images and gradient.
        # Both are computed with exchanged channels, from one to many.
        x, weight = ctx.saved_tensors
        flipped_weight, padding = weight.flip(2, 3).transpose(0, 1), weight.shape[-1] // 2
        by_image = nn.functional.conv2d(grad, flipped_weight, padding=padding)
        by_weight = conv2d_weight(grad, flipped_weight.shape, x, padding=padding)
        return by_image, by_weight.flip(2, 3).transpose(0, 1), grad.sum().view(1)


class DaeNetwork(nn.Module):
    """Denoising autoencoder on single-channel images.

    Parameters
    ----------
    kernels : sequence of int
        Odd kernel sizes of the L convolutions.
    widths : sequence of int
        Channels between them, L − 1 values.
    """

    def __init__(self, kernels: Sequence[int], widths: Sequence[int]) -> None:
        super().__init__()
        self.kernels, self.widths = tuple(kernels), tuple(widths)
        self.layers = nn.ModuleList()
        # One input and one output channel; the padding keeps the side of the images.
        channels = pairwise([1, *widths, 1])
        for (inputs, outputs), kernel in zip(channels, kernels, strict=True):
            layer_class = nn.Conv2d if outputs > 1 else SingleChannelConv
            self.layers.append(layer_class(inputs, outputs, kernel, padding=kernel // 2))

    @property
    def convolutions(self) -> list[nn.Conv2d]:
        """Layers as convolutions; torch's list has the type of any modules."""
        return [layer for layer in self.layers if isinstance(layer, nn.Conv2d)]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map scaled star images (B, 1, d, d) to scaled PSFs of the same shape."""
        # ReLU after the last layer, too: a PSF is not negative.
        for layer in self.layers:
            x = torch.relu(layer(x))
        return x


def build_dae(
    kernels: Sequence[int],
    widths: Sequence[int],
    init: Literal["linear", "he", "default"],
    generator: torch.Generator,
) -> DaeNetwork:
    """Return a new network with random weights from `generator`.

    Parameters
    ----------
    kernels, widths : sequences of int
        Kernel sizes and channels, as in `DaeNetwork`.
    init : "linear", "he" or "default"
        "he" and "linear" draw N(0, 2/fan_in) with zero biases (He et al. 2015, arXiv:1502.01852);
        `begin_linear` then changes the latter. "default" is PyTorch's uniform distribution
        between ±1/√fan_in for weights and biases.
    generator : torch.Generator
        Source of all random numbers.

    Returns
    -------
    DaeNetwork
        Network whose weights are in the order in memory that makes convolutions fastest.
    """
    model = channels_last(DaeNetwork(kernels, widths))
    # In the order of the layers, weights before biases, because the draws depend on it.
    with torch.no_grad():
        for layer in model.layers:
            weight, bias = layer.parameters()
            if init == "default":
                # fan_in: number of inputs of a layer that contribute to one output.
                bound = float(weight[0].numel()) ** -0.5
                weight.uniform_(-bound, bound, generator=generator)
                bias.uniform_(-bound, bound, generator=generator)
            else:
                # ReLU halves the mean square of its input, hence the 2 in 2/fan_in.
                nn.init.kaiming_normal_(weight, nonlinearity="relu", generator=generator)
                bias.zero_()
    return model


@torch.no_grad()
def begin_linear(
    model: DaeNetwork,
    noisy: np.ndarray,
    references: np.ndarray,
    weight: np.ndarray,
    pixels: np.ndarray,
) -> None:
    """Initialise a random network as nearly the best linear estimator that its kernels allow.

    A training then needs fewer epochs than with random weights. The first layer projects on the
    pixel itself and on the leading eigenpatches of the stars, each with both signs, because the
    ReLU keeps only the positive part: v = ReLU(v) − ReLU(−v). Inner layers copy each channel, plus
    a tenth of the random weights, so that their channels differ. The last layer is the least
    squares solution for the references.

    Parameters
    ----------
    model : DaeNetwork
        Network of `build_dae`; its weights are changed in place.
    noisy, references : ndarray, shape (n, d, d)
        Images in the scale of the network, and the noise-free images that are its targets.
    weight : ndarray, shape (n,)
        Weight of each star in the sum of squares.
    pixels : ndarray of int, shape (n, m)
        Pixels of each star in the sum of squares, counted along its rows.

    Raises
    ------
    TrainingError
        If an image or reference is not finite.
    """
    # Checked before any product, because one NaN would spread to all weights.
    if not (np.isfinite(noisy).all() and np.isfinite(references).all()):
        raise TrainingError("training stars that are not finite")
    first, *inner_layers, _ = model.convolutions
    images = torch.from_numpy(noisy[:, None])
    # Eigenvectors of Σ p pᵀ over all patches p of the size of the kernel, the leading one first.
    # The patches have no name, so that only one copy of them is in memory at a time.
    side = first.kernel_size[0]
    flat = nn.functional.unfold(images, side, padding=side // 2).transpose(1, 2).flatten(0, 1)
    eigenpatches = torch.linalg.eigh(flat.T @ flat).eigenvectors.flip(1)
    del flat
    # Pairs of kernels with opposite signs: the pixel itself, then eigenpatches while channels last.
    identity = torch.zeros_like(eigenpatches[:, :1])
    identity[len(identity) // 2] = 1.0
    patches = torch.cat([identity, eigenpatches], dim=1).T[: len(first.weight) // 2]
    kernels = torch.stack([patches, -patches], dim=1).flatten(0, 1)
    first.weight[: len(kernels)] = kernels.view(-1, 1, *first.kernel_size)
    # Each channel is copied by a 1 in the middle of its kernel, added to a tenth of the draw.
    for layer in inner_layers:
        layer.weight *= 0.1
        middle = layer.kernel_size[0] // 2
        for channel in range(min(layer.in_channels, layer.out_channels)):
            layer.weight[channel, channel, middle, middle] += 1.0
    # For given other layers, the last layer is the solution of a linear system.
    fit_last_layer(model, images, references.reshape(len(references), -1), weight, pixels)


def fit_last_layer(
    model: DaeNetwork,
    images: torch.Tensor,
    references: np.ndarray,
    weight: np.ndarray,
    pixels: np.ndarray,
) -> None:
    """Fit the weights and the bias of the last layer to the references by least squares.

    Minimises Σ w (aᵀ x − y)² over the chosen pixels of all stars: x are the inputs of the last
    layer for a pixel and a 1 for the bias, y is the reference, and w the weight of the star.

    Parameters
    ----------
    model : DaeNetwork
        Network whose other layers are set; the last one is changed in place.
    images : torch.Tensor, shape (n, 1, d, d)
        Images in the scale of the network.
    references : ndarray, shape (n, d²)
        Noise-free images.
    weight, pixels : ndarray
        As in `begin_linear`.
    """
    *leading_layers, last = model.convolutions
    (last_weight, bias), side = last.parameters(), last.kernel_size[0]
    # Normal equations (Σ w x xᵀ) a = Σ w x y. Rows are multiplied by √w.
    size = last_weight.numel() + 1
    normal_matrix = torch.zeros(size, size, dtype=torch.float64)
    normal_vector = torch.zeros(size).double()
    root = torch.from_numpy(np.sqrt(weight / weight.mean()).astype(np.float32))[:, None]
    # In blocks of 100 stars, because patches take much memory.
    for start in range(0, len(images), 100):
        block = slice(start, start + 100)
        x = images[block].to(memory_format=torch.channels_last)
        for layer in leading_layers:
            x = torch.relu(layer(x))
        # Patches about all pixels, then only about the chosen pixels, with 1 for the bias.
        x = nn.functional.pad(x, (side // 2,) * 4).unfold(2, side, 1).unfold(3, side, 1)
        row, column = np.divmod(pixels[block], x.shape[3])
        x = x[np.arange(len(x))[:, None], :, row, column].flatten(2)
        x = torch.cat([x, torch.ones_like(x[:, :, :1])], dim=2) * root[block, :, None]
        x = x.flatten(0, 1)
        y = torch.from_numpy(np.take_along_axis(references[block], pixels[block], axis=1))
        y = y * root[block]
        normal_matrix += (x.T @ x).double()
        normal_vector += (x.T @ y.flatten()).double()
    # A small ridge, because the matrix is singular if a channel is zero for all stars.
    ridge = 1e-6 * normal_matrix.diagonal().mean()
    normal_matrix += ridge * torch.eye(size, dtype=torch.float64)
    solution = torch.linalg.solve(normal_matrix, normal_vector).float()
    # The last number of the solution belongs to the 1 of every row: it is the bias.
    last_weight.copy_(solution[:-1].view_as(last_weight))
    bias.copy_(solution[-1:])


def middle_px(stamp_px: int, part: float, reference: str) -> int:
    """Return the side of the middle of stamps that a training uses, in px.

    Most of a star's light is there, and a convolution can be trained on it except for the border.
    The side is even for even stamps and odd for odd ones, so that the middle is the same.

    Parameters
    ----------
    stamp_px : int
        Side of the stamps.
    part : float
        Index of the epoch, from 0, over the number of epochs with the middle only.
    reference : str
        "realisation": half of the side at first, growing to whole stamps at part = 1. A "template"
        depends on more of the stamp: three quarters of the side, and whole stamps from part = 2/3.
    """
    # Fraction of the side that is used.
    if reference == "realisation":
        middle = 0.5 + 0.5 * min(part, 1.0) ** 2
    else:
        middle = 0.75 if part < 2 / 3 else 1.0
    # The same number of pixels is cut off at both edges: the brightest pixel stays in the middle.
    return stamp_px - 2 * round(0.5 * (1.0 - middle) * stamp_px)


@torch.inference_mode()
def run_network(
    model: DaeNetwork, noisy: np.ndarray, factor: float, batch: int | None = None
) -> np.ndarray:
    """Estimate the PSFs of noisy star images.

    Parameters
    ----------
    model : DaeNetwork
        The network.
    noisy : ndarray, shape (n, d, d)
        Flux-normalised images.
    factor : float
        Result of `image_scale`.
    batch : int, optional
        Images per forward pass; by default 2^18 numbers (1 MB) between two layers, which fit into a
        core's cache.

    Returns
    -------
    ndarray, shape (n, d, d), float32
        PSFs of about sum 1, neither clipped nor renormalised.
    """
    # Small batches, such as 64 images of 16 × 16 pixels with 16 channels: batches of a thousand,
    # which do not fit into the cache, take up to twice the time (docs/results.md).
    batch = batch or max(1, 2**18 // (max(model.widths) * noisy.shape[-1] ** 2))
    model.eval()
    psf = np.empty(noisy.shape, dtype=np.float32)
    for start in range(0, len(noisy), batch):
        images = torch.from_numpy(np.ascontiguousarray(noisy[start : start + batch], np.float32))
        network_images = (images[:, None] * factor).to(memory_format=torch.channels_last)
        psf[start : start + batch] = (model(network_images)[:, 0] / factor).numpy()
    return psf


class DaeTraining(Training):
    """Training on noisy images, with new noise in every epoch or the same noise in all epochs.

    It may begin with the middle of the stamps, where an epoch takes less time. The history
    has MSEs of flux-normalised images, without the weights of the loss: `train_mse` of the pixels
    that the epoch trains on, a square of `side_px` pixels a side, and `validation_mse` of whole
    stamps. Another attempt uses other initial weights and noise.

    Parameters
    ----------
    data : TrainingSet
        Stars with their references, and the network of a warm start if there is one.
    dae : DaeSettings
        Shape of the network and its initial weights.
    settings : Train
        Course of the training.
    seed : int
        Seed of all random streams.
    attempt : int
        Number of restarts after a dead network.
    """

    model: DaeNetwork
    settings: Train
    linear_px = 24_000
    """Number of random pixels in the fit of the last layer of a linear start."""

    def __init__(
        self, data: TrainingSet, dae: DaeSettings, settings: Train, seed: int, attempt: int = 0
    ) -> None:
        self.data, self.seed = data, seed
        # The last digits of the linear start depend on the number of threads, too.
        torch.set_num_threads(settings.threads)
        self.factor = image_scale(dae.scale, data.images.shape[-1])
        # Initial weights: random, from a fit to realisations, or nearly a linear estimator.
        generator = torch.Generator()
        generator.manual_seed(int(stream(seed, "dae", "init", attempt).integers(2**62)))
        model = build_dae(dae.kernels, dae.widths, dae.init, generator)
        if data.start is not None:
            start: Any = data.start  # a `psfdae.methods.dae.Dae`, of a layer above this one
            model.load_state_dict(start.network.state_dict())
        elif dae.init == "linear":
            # 1500 noisy stars, and about `linear_px` random pixels of them, are enough for the
            # start of a training.
            rng = stream(seed, "dae", "linear", attempt)
            stars = rng.permutation(data.fit)[:1500]
            noisy, level = data.draw(stars, rng)
            pixels = np.tile(np.arange(noisy[0].size), (stars.size, 1))
            begin_linear(
                model,
                noisy * np.float32(self.factor),
                data.references[stars] * np.float32(self.factor),
                level**-settings.level_weight,
                rng.permuted(pixels, axis=1)[:, : -(-self.linear_px // stars.size)],
            )
        # The last batch of an epoch may be smaller.
        super().__init__(model, settings, -(-data.fit.size // settings.batch), attempt)
        self.grad_clip = settings.grad_clip or self.grad_clip
        # Unweighted errors of the batches of an epoch, and the side of the stamps in it.
        self.batch_errors: list[torch.Tensor] = []
        self.side_px = data.images.shape[-1]
        # One noisy image of every star for all epochs, with the setting "fixed".
        self.constant_draw: tuple[np.ndarray, ...] | None = None
        if settings.noise == "fixed":
            stars = np.arange(len(data.images))
            self.constant_draw = data.draw(stars, stream(seed, "dae", "fixed noise"))

    def make_optimiser(self, lr: float) -> torch.optim.Optimizer:
        """Return the optimiser: Muon for the weights of the inner layers, Adam for the others.

        With the setting "adam", Adam is used for all weights. Muon is meant for the matrices
        between hidden layers, not for the first and the last layer (K. Jordan et al. 2024).
        """
        if self.settings.optimiser == "adam":
            return Adam(self.model.parameters(), lr=lr, fused=True)
        matrices = [layer.weight for layer in self.model.convolutions[1:-1]]
        # By identity, because "in" would compare the values of tensors.
        by_adam = [p for p in self.model.parameters() if all(p is not w for w in matrices)]
        # Adam for the first and the last layer, and for all biases.
        groups: list[dict[str, Any]] = [
            {"params": by_adam},
            {"params": matrices, "orthogonal": True},
        ]
        return Muon(groups, lr=lr, fused=True)

    def batches(self, epoch: int) -> Iterator[tuple[torch.Tensor, ...]]:
        """Yield the batches of an epoch, of B stars each.

        Yields
        ------
        noisy, reference : torch.Tensor, shape (B, 1, d, d)
            Noisy and noise-free images in the scale of the network, or the middle of them.
        weight : torch.Tensor, shape (B, 1, 1, 1)
            Weight of each star's squared error, 1/λ^p of its noise level λ over the mean of 1/λ^p
            over all levels.
        """
        rng = stream(self.seed, "dae", "epoch", self.attempt, epoch)
        # Pixels that are cut off along each edge of the stamps.
        side = self.data.images.shape[-1]
        crop_epochs = int(self.settings.crop_epochs * self.settings.epochs)
        part = epoch / crop_epochs if crop_epochs else 1.0
        self.side_px, self.batch_errors = middle_px(side, part, self.data.reference), []
        edge = (side - self.side_px) // 2
        # Every star once, in random order.
        order = rng.permutation(self.data.fit)
        for start in range(0, order.size, self.settings.batch):
            stars = order[start : start + self.settings.batch]
            if self.constant_draw is None:
                noisy, level = self.data.draw(stars, rng)
            else:
                noisy, level = (arrays[stars] for arrays in self.constant_draw)
            # Squared errors grow with λ: without weights, the faintest stars would dominate. 1/λ^p
            # is divided by its mean, so that the loss is about as large for any power p.
            power = -self.settings.level_weight
            weight = level**power / np.mean(self.data.levels**power)
            star_weight = torch.from_numpy(weight.astype(np.float32))[:, None, None, None]
            references = self.data.references[stars]
            yield self._tensor(noisy, edge), self._tensor(references, edge), star_weight

    def _tensor(self, images: np.ndarray, edge: int) -> torch.Tensor:
        """Return images (B, d, d) without `edge` pixels on each side, in the network's scale."""
        middle = slice(edge, images.shape[-1] - edge)
        network_images = torch.from_numpy(images[:, middle, middle])[:, None] * self.factor
        return network_images.to(memory_format=torch.channels_last)

    def loss(self, batch: tuple[torch.Tensor, ...], step: int) -> torch.Tensor:
        """Return the weighted mean squared error of a batch.

        Raises
        ------
        DeadNetworkError
            If all outputs are zero, which is checked every `dead_check_steps` steps.
        """
        noisy, target, weight = batch
        output: torch.Tensor = self.model(noisy)
        # Not at every step, because reading the values waits for the computation.
        if step % self.settings.dead_check_steps == 0 and not output.detach().any():
            raise DeadNetworkError(f"all outputs are zero at step {step}")
        # (1/n) Σ w (f(z) − y)² over the pixels of all stars. The history has the mean without
        # weights, which the validation error can be compared with.
        squares = (output - target) ** 2
        self.batch_errors.append(squares.detach().mean())
        return (weight * squares).mean()

    def validate(self, epoch: int) -> float:
        """Return the mean squared error of the validation stars, of sum 1.

        It is computed every `validate_every` epochs and after the last one; NaN after other epochs.
        The noise is the same each time, so that errors of epochs can be compared.

        Raises
        ------
        DeadNetworkError
            If more than half of the outputs are zero.
        TrainingError
            If the error is not finite.
        """
        if epoch % self.settings.validate_every and epoch != self.settings.epochs:
            return float("nan")
        # Every star with several draws of noise, the same draws in all epochs.
        stars = np.tile(self.data.validation, self.settings.validation_draws)
        noisy, _ = self.data.draw(stars, stream(self.seed, "dae", "validation"))
        estimate = run_network(self.model, noisy, self.factor)
        # Outputs of zero have no gradient: further epochs would not revive such a network.
        zero_part = 1.0 - estimate.any(axis=(1, 2)).mean()
        if zero_part > 0.5:
            raise DeadNetworkError(f"{zero_part:.0%} of the outputs are zero after epoch {epoch}")
        error = float(((estimate - self.data.references[stars]) ** 2).mean(dtype=np.float64))
        if not np.isfinite(error):
            raise TrainingError(
                f"the validation error is {error} after epoch {epoch}: "
                f"look for validation stars that are not finite"
            )
        return error

    def row(self, epoch: int, rate: float, loss: float, error: float) -> Row:
        """Return a row of the history, with the learning rate at the start of the epoch."""
        # Images of the network are multiplied by a factor: errors are divided by its square.
        return {
            "epoch": epoch,
            "step": epoch * self.steps,
            "lr": rate,
            "train_mse": torch.stack(self.batch_errors).mean().item() / self.factor**2,
            "validation_mse": error,
            "side_px": self.side_px,
            "seconds": round(self.seconds, 3),
            "cpu_seconds": round(self.cpu_seconds, 3),
        }

    def is_finished(self) -> bool:
        """Return True if all epochs are done, or `patience` validations were not better."""
        scores = [row["validation_mse"] for row in self.history]
        scores = [score for score in scores if np.isfinite(score)]
        # Number of validations since the smallest error; NaN marks epochs without validation.
        stale = len(scores) - 1 - int(np.argmin(scores)) if scores else 0
        return super().is_finished() or 0 < self.settings.patience <= stale
