"""The network of the paper's section 2.2, a denoising autoencoder, and its training.

Ten convolutions with "same" padding and ReLU after each, kernels 9, 7, 5, 3, 1
as the encoder and 1, 3, 5, 7, 9 as the decoder, no pooling; the output has the
size of the input.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import nn
from torch.nn.grad import conv2d_weight

from psfdae.method import TrainingSet
from psfdae.networks.training import DeadNetworkError, Muon, Row, Training, TrainingError, train
from psfdae.networks.weights import channels_last
from psfdae.rng import stream

if TYPE_CHECKING:
    from psfdae.networks.settings import DaeSettings, Train


LINEAR_STARS = 1500
"""Number of training stars that give the start of a network that begins as a linear estimator."""

LINEAR_PX = 24_000
"""Number of random pixels of these stars to which the last layer of such a network is fitted."""

LINEAR_BLOCK = 100
"""Number of stars whose sums for this fit are computed at once, which limits the memory."""

DRAWN = 0.1
"""Part of the random draw in the inner layers of such a network."""

RIDGE = 1e-6
"""Ridge of this fit over the mean diagonal of its normal matrix: a channel may be all zero."""

BLOCK_PX = 4
"""Side of the blocks of pixels that the last layer computes at once."""

MOST_ZERO = 0.5
"""Part of the validation stars without any output above which a network is dead."""


class SingleChannelConv(nn.Conv2d):
    """Convolution to one channel, its kernel of an odd side k and its padding k // 2.

    oneDNN vectorises over output channels and is slow for one. On the CPU, one strided convolution
    computes blocks of output pixels, with a channel for each pixel of a block. The gradients come
    from the transposed convolution, from one channel to many, which is fast.
    """

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (B, C, h, w) to (B, 1, h, w)."""
        if x.device.type != "cpu":
            return super().forward(x)
        found: torch.Tensor = _ToOneChannel.apply(x, self.weight, self.bias)  # type: ignore[no-untyped-call]
        return found


class _ToOneChannel(torch.autograd.Function):
    """Correlation of images (B, C, h, w) with a weight (1, C, s, s), s odd, plus a bias (1,)."""

    @staticmethod
    def forward(
        ctx: Any, x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor
    ) -> torch.Tensor:
        ctx.save_for_backward(x, weight)
        (height, width), side = x.shape[-2:], weight.shape[-1]
        wide = side + BLOCK_PX - 1
        padded = nn.functional.pad(weight[0], (BLOCK_PX - 1,) * 4)
        # Window i of the padded weight is that of pixel BLOCK_PX - 1 - i of a block.
        kernels = padded.unfold(1, wide, 1).unfold(2, wide, 1).flip(1, 2).permute(1, 2, 0, 3, 4)
        if width % BLOCK_PX or height % BLOCK_PX:
            x = nn.functional.pad(x, (0, -width % BLOCK_PX, 0, -height % BLOCK_PX))
        found = nn.functional.conv2d(
            x,
            kernels.flatten(0, 1),
            bias.expand(BLOCK_PX**2),
            stride=BLOCK_PX,
            padding=side // 2,
        )
        return nn.functional.pixel_shuffle(found, BLOCK_PX)[..., :height, :width]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, ...]:
        x, weight = ctx.saved_tensors
        flipped, padding = weight.flip(2, 3).transpose(0, 1), weight.shape[-1] // 2
        by_image = nn.functional.conv2d(grad, flipped, padding=padding)
        by_weight = conv2d_weight(grad, flipped.shape, x, padding=padding)
        return by_image, by_weight.flip(2, 3).transpose(0, 1), grad.sum().view(1)


class Dae(nn.Module):
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
        channels = [1, *widths, 1]
        self.layers = nn.ModuleList(
            (nn.Conv2d if outer > 1 else SingleChannelConv)(
                inner, outer, kernel, padding=kernel // 2
            )
            for (inner, outer), kernel in zip(pairwise(channels), kernels, strict=True)
        )

    @property
    def convolutions(self) -> list[nn.Conv2d]:
        """The layers; torch's list holds modules of any kind."""
        return [layer for layer in self.layers if isinstance(layer, nn.Conv2d)]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map scaled star images (B, 1, d, d) to scaled PSFs of the same shape."""
        for layer in self.layers:
            x = torch.relu(layer(x))
        return x


def build_dae(
    kernels: Sequence[int],
    widths: Sequence[int],
    init: Literal["linear", "he", "default"],
    generator: torch.Generator,
) -> Dae:
    """A fresh network whose weights come from `generator` alone.

    `he` and `linear` draw N(0, 2/fan_in) with zero biases (He et al. 2015), `linear` for
    `begin_linear` to go on; `default` is PyTorch's uniform ±1/√fan_in for weights and biases.
    """
    model = channels_last(Dae(kernels, widths))
    with torch.no_grad():
        for layer in model.layers:
            weight, bias = layer.parameters()
            if init == "default":
                bound = float(weight[0].numel()) ** -0.5
                weight.uniform_(-bound, bound, generator=generator)
                bias.uniform_(-bound, bound, generator=generator)
            else:
                nn.init.kaiming_normal_(weight, nonlinearity="relu", generator=generator)
                bias.zero_()
    return model


@torch.no_grad()
def begin_linear(
    model: Dae, noisy: np.ndarray, references: np.ndarray, weight: np.ndarray, pixels: np.ndarray
) -> None:
    """Turn a freshly drawn network into a linear estimator, about the best of its kernels.

    The first layer looks at the pixel itself and at the leading eigenpatches of the stars, each
    with both signs, so that nothing is lost in the ReLU. Inner layers hand each channel on, with
    a little of what they drew. The last layer is least squares from there to the references.

    Parameters
    ----------
    model : Dae
        As `build_dae` gives it.
    noisy, references : ndarray, shape (n, d, d)
        Images as the network sees them, and what is to come of them.
    weight : ndarray, shape (n,)
        Of each star in the sum of squares.
    pixels : ndarray of int, shape (n, m)
        Pixels of each star, counted along its rows, that the sum of squares takes.

    Raises
    ------
    TrainingError
        If an image or reference is not finite.
    """
    if not (np.isfinite(noisy).all() and np.isfinite(references).all()):
        raise TrainingError("training stars that are not finite")
    first, *inner, _ = model.convolutions
    images = torch.from_numpy(noisy[:, None])
    axes = _eigenpatches(images, first.kernel_size[0])
    own = torch.zeros_like(axes[:, :1])
    own[len(own) // 2] = 1.0
    pairs = torch.cat([own, axes], dim=1).T[: len(first.weight) // 2]
    seen = torch.stack([pairs, -pairs], dim=1).flatten(0, 1)
    first.weight[: len(seen)] = seen.view(-1, 1, *first.kernel_size)
    for layer in inner:
        layer.weight *= DRAWN
        middle = layer.kernel_size[0] // 2
        for channel in range(min(layer.in_channels, layer.out_channels)):
            layer.weight[channel, channel, middle, middle] += 1.0
    _fit_last_layer(model, images, references.reshape(len(references), -1), weight, pixels)


def _fit_last_layer(
    model: Dae,
    images: torch.Tensor,
    references: np.ndarray,
    weight: np.ndarray,
    pixels: np.ndarray,
) -> None:
    """Least squares from what the last layer sees of images (n, 1, d, d) to references (n, d²)."""
    *others, last = model.convolutions
    (final, bias), side = last.parameters(), last.kernel_size[0]
    size = final.numel() + 1
    normal, right = torch.zeros(size, size, dtype=torch.float64), torch.zeros(size).double()
    root = torch.from_numpy(np.sqrt(weight / weight.mean()).astype(np.float32))[:, None]
    for start in range(0, len(images), LINEAR_BLOCK):
        block = slice(start, start + LINEAR_BLOCK)
        x = images[block].to(memory_format=torch.channels_last)
        for layer in others:
            x = torch.relu(layer(x))
        x = nn.functional.pad(x, (side // 2,) * 4).unfold(2, side, 1).unfold(3, side, 1)
        row, column = np.divmod(pixels[block], x.shape[3])
        x = x[np.arange(len(x))[:, None], :, row, column].flatten(2)
        x = torch.cat([x, torch.ones_like(x[:, :, :1])], dim=2) * root[block, :, None]
        x = x.flatten(0, 1)
        y = torch.from_numpy(np.take_along_axis(references[block], pixels[block], axis=1))
        y = y * root[block]
        normal += (x.T @ x).double()
        right += (x.T @ y.flatten()).double()
    normal += RIDGE * normal.diagonal().mean() * torch.eye(size, dtype=torch.float64)
    solved = torch.linalg.solve(normal, right).float()
    final.copy_(solved[:-1].view_as(final))
    bias.copy_(solved[-1:])


def _eigenpatches(images: torch.Tensor, side: int) -> torch.Tensor:
    """Eigenvectors, columns, of the products of what a kernel sees, the leading one first."""
    # Without names, so that only one copy of the patches is there at the end.
    flat = nn.functional.unfold(images, side, padding=side // 2).transpose(1, 2).flatten(0, 1)
    axes: torch.Tensor = torch.linalg.eigh(flat.T @ flat).eigenvectors
    return axes.flip(1)


def image_scale(scale: Literal["mean", "none"], stamp_px: int) -> float:
    """Factor between flux-normalised images (sum 1) and what the network sees."""
    return float(stamp_px**2) if scale == "mean" else 1.0


def middle_px(stamp_px: int, part: float, reference: str) -> int:
    """Side of the middle of stamps that a training sees, as even or odd as theirs.

    Most of a star's light is there, and all that a convolution has to learn but the border.

    Parameters
    ----------
    stamp_px : int
        Side of the stamps.
    part : float
        Number of the epoch, from 0, over that of the epochs that see the middle alone.
    reference : str
        "realisation": half of the side at first, then more and more, and whole stamps from 1 on. A
        "template" depends on more of the stamp: three quarters of the side, and whole stamps from
        2/3 on.
    """
    if reference == "realisation":
        middle = 0.5 + 0.5 * min(part, 1.0) ** 2
    else:
        middle = 0.75 if part < 2 / 3 else 1.0
    return stamp_px - 2 * round(0.5 * (1.0 - middle) * stamp_px)


@torch.inference_mode()
def predict(model: Dae, noisy: np.ndarray, factor: float, batch: int = 256) -> np.ndarray:
    """PSFs of noisy star images.

    Parameters
    ----------
    model : Dae
    noisy : ndarray, shape (n, d, d)
        Flux-normalised images.
    factor : float
        Result of `image_scale`.
    batch : int
        Images per forward pass.

    Returns
    -------
    ndarray, shape (n, d, d), float32
        Neither clipped nor renormalised.
    """
    model.eval()
    out = np.empty(noisy.shape, dtype=np.float32)
    for start in range(0, len(noisy), batch):
        images = torch.from_numpy(np.ascontiguousarray(noisy[start : start + batch], np.float32))
        scaled = (images[:, None] * factor).to(memory_format=torch.channels_last)
        out[start : start + batch] = (model(scaled)[:, 0] / factor).numpy()
    return out


class DaeTraining(Training):
    """Training on noisy images, with noise that is drawn anew in every epoch, or once.

    It may begin with the middle of the stamps, where an epoch takes less time. The history
    has MSEs of flux-normalised images. Another attempt draws other weights and other noise.
    """

    model: Dae
    settings: Train

    def __init__(
        self, data: TrainingSet, dae: DaeSettings, settings: Train, seed: int, attempt: int = 0
    ) -> None:
        self.data, self.seed = data, seed
        torch.set_num_threads(settings.threads)  # of the linear start, too, and its last digits
        self.factor = image_scale(dae.scale, data.images.shape[-1])
        generator = torch.Generator()
        generator.manual_seed(int(stream(seed, "dae", "init", attempt).integers(2**62)))
        model = build_dae(dae.kernels, dae.widths, dae.init, generator)
        if data.start is not None:
            start: Any = data.start  # a `psfdae.methods.dae.Dae`, of a layer above this one
            model.load_state_dict(start.network.state_dict())
        elif dae.init == "linear":
            rng = stream(seed, "dae", "linear", attempt)
            stars = rng.permutation(data.fit)[:LINEAR_STARS]
            noisy, level = data.draw(stars, rng)
            everywhere = np.tile(np.arange(noisy[0].size), (stars.size, 1))
            begin_linear(
                model,
                noisy * np.float32(self.factor),
                data.references[stars] * np.float32(self.factor),
                level**-settings.level_weight,
                rng.permuted(everywhere, axis=1)[:, : -(-LINEAR_PX // stars.size)],
            )
        super().__init__(model, settings, -(-data.fit.size // settings.batch), attempt)
        self.grad_clip = settings.grad_clip or self.grad_clip
        self.fixed: tuple[np.ndarray, ...] | None = None
        if settings.noise == "fixed":
            stars = np.arange(len(data.images))
            self.fixed = data.draw(stars, stream(seed, "dae", "fixed noise"))

    def begin(self, lr: float) -> torch.optim.Optimizer:
        """Muon for the weights of the inner layers, Adam for the others; or Adam for all."""
        if self.settings.optimiser == "adam":
            return torch.optim.Adam(self.model.parameters(), lr=lr, fused=True)
        inner = [layer.weight for layer in self.model.convolutions[1:-1]]
        others = [p for p in self.model.parameters() if all(p is not w for w in inner)]
        groups: list[dict[str, Any]] = [{"params": others}, {"params": inner, "orthogonal": True}]
        return Muon(groups, lr=lr, fused=True)

    def batches(self, epoch: int) -> Iterator[tuple[torch.Tensor, ...]]:
        """Noisy images and what is to come of them, (B, 1, d, d) as the network sees them.

        The third is the weight of each star's error, (B, 1, 1, 1), of mean 1 over the levels.
        """
        rng = stream(self.seed, "dae", "epoch", self.attempt, epoch)
        side = self.data.images.shape[-1]
        cropped = int(self.settings.crop_epochs * self.settings.epochs)
        part = epoch / cropped if cropped else 1.0
        edge = (side - middle_px(side, part, self.data.reference)) // 2
        order = rng.permutation(self.data.fit)
        for start in range(0, order.size, self.settings.batch):
            stars = order[start : start + self.settings.batch]
            if self.fixed is None:
                noisy, level = self.data.draw(stars, rng)
            else:
                noisy, level = (fixed[stars] for fixed in self.fixed)
            power = -self.settings.level_weight
            weight = level**power / np.mean(self.data.levels**power)
            weighted = torch.from_numpy(weight.astype(np.float32))[:, None, None, None]
            references = self.data.references[stars]
            yield self._tensor(noisy, edge), self._tensor(references, edge), weighted

    def _tensor(self, images: np.ndarray, edge: int) -> torch.Tensor:
        inner = slice(edge, images.shape[-1] - edge)
        scaled = torch.from_numpy(images[:, inner, inner])[:, None] * self.factor
        return scaled.to(memory_format=torch.channels_last)

    def loss(self, batch: tuple[torch.Tensor, ...], step: int) -> torch.Tensor:
        """Mean squared error, weighted by star."""
        noisy, target, weight = batch
        output: torch.Tensor = self.model(noisy)
        if step % self.settings.dead_check_steps == 0 and not output.detach().any():
            raise DeadNetworkError(f"all outputs are zero at step {step}")
        return (weight * (output - target) ** 2).mean()

    def validate(self, epoch: int) -> float:
        """Mean squared error of the validation stars every few epochs and after the last."""
        if epoch % self.settings.validate_every and epoch != self.settings.epochs:
            return float("nan")
        stars = np.tile(self.data.validation, self.settings.validation_draws)
        noisy, _ = self.data.draw(stars, stream(self.seed, "dae", "validation"))
        estimate = predict(self.model, noisy, self.factor)
        zero = 1.0 - estimate.any(axis=(1, 2)).mean()
        if zero > MOST_ZERO:
            raise DeadNetworkError(f"{zero:.0%} of the outputs are zero after epoch {epoch}")
        error = float(((estimate - self.data.references[stars]) ** 2).mean(dtype=np.float64))
        if not np.isfinite(error):
            raise TrainingError(
                f"the validation error is {error} after epoch {epoch}: "
                f"look for validation stars that are not finite"
            )
        return error

    def row(self, epoch: int, rate: float, loss: float, error: float) -> Row:
        """Row of the history; the learning rate is that at the epoch's end."""
        return {
            "epoch": epoch,
            "step": epoch * self.steps,
            "lr": self.rate,
            "train_mse": loss / self.factor**2,
            "validation_mse": error,
            "seconds": round(self.seconds, 3),
            "cpu_seconds": round(self.cpu_seconds, 3),
        }

    def finished(self) -> bool:
        """All epochs are done, or `patience` validations brought nothing better."""
        scores = [row["validation_mse"] for row in self.history]
        scores = [score for score in scores if np.isfinite(score)]
        stale = len(scores) - 1 - int(np.argmin(scores)) if scores else 0
        return super().finished() or 0 < self.settings.patience <= stale


def train_dae(
    data: TrainingSet,
    dae: DaeSettings,
    settings: Train,
    seed: int,
    checkpoint: Path,
    fingerprint: str,
    report: Callable[[Row], None] = lambda row: None,
) -> Training:
    """A trained denoising autoencoder: `result`, `history`, `attempt` of the training.

    Parameters and errors are those of `train`.
    """

    def begin(attempt: int) -> Training:
        return DaeTraining(data, dae, settings, seed, attempt)

    return train(begin, checkpoint, fingerprint, report, settings.restarts)
