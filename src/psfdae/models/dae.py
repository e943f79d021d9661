"""The denoising autoencoder of the paper's section 2.2.

Ten convolutions with "same" padding and ReLU after each, kernels 9, 7, 5, 3, 1
as the encoder and 1, 3, 5, 7, 9 as the decoder, no pooling; the output has the
size of the input.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Literal, Protocol

import numpy as np
import torch
from torch import nn


class ArraySource(Protocol):
    """Whatever gives rows of an array by slicing."""

    def __len__(self) -> int: ...

    def __getitem__(self, rows: slice) -> np.ndarray: ...


class SingleChannelConv(nn.Conv2d):
    """Convolution to one channel, computed as a transposed convolution.

    The two are the same sum: correlating with a kernel is scattering with the
    flipped one. oneDNN vectorises over output channels and is slow for one; the
    matrix-product path of the transposed convolution takes half the time (a
    tenth of a training step at width 16).
    """

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (B, C, h, w) to (B, 1, h, w)."""
        if x.device.type != "cpu":
            return super().forward(x)
        flipped = self.weight.flip(2, 3).transpose(0, 1)
        return torch.ops.aten.slow_conv_transpose2d(
            x, flipped, self.kernel_size, self.bias, [1, 1], self.padding, [0, 0], [1, 1]
        )


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
        channels = [1, *widths, 1]
        self.layers = nn.ModuleList(
            (nn.Conv2d if outer > 1 else SingleChannelConv)(
                inner, outer, kernel, padding=kernel // 2
            )
            for (inner, outer), kernel in zip(pairwise(channels), kernels, strict=True)
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map scaled star images (B, 1, d, d) to scaled PSFs of the same shape."""
        for layer in self.layers:
            x = torch.relu(layer(x))
        return x


def build_dae(
    kernels: Sequence[int],
    widths: Sequence[int],
    init: Literal["he", "default"],
    generator: torch.Generator,
) -> Dae:
    """A fresh network whose weights come from `generator` alone.

    `he` draws N(0, 2/fan_in) with zero biases (He et al. 2015); `default` is
    PyTorch's uniform ±1/√fan_in for weights and biases.
    """
    model = Dae(kernels, widths).to(memory_format=torch.channels_last)
    with torch.no_grad():
        for layer in model.layers:
            if init == "he":
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu", generator=generator)
                layer.bias.zero_()
            else:
                bound = float(layer.weight[0].numel()) ** -0.5
                layer.weight.uniform_(-bound, bound, generator=generator)
                layer.bias.uniform_(-bound, bound, generator=generator)
    return model


def image_scale(scale: Literal["mean", "none"], stamp_px: int) -> float:
    """Factor between flux-normalised images (sum 1) and what the network sees."""
    return float(stamp_px**2) if scale == "mean" else 1.0


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


def predict_stream(
    model: Dae, noisy: ArraySource, factor: float, rows: int = 1024, batch: int = 64
) -> Iterator[tuple[slice, np.ndarray]]:
    """PSFs of noisy star images, a piece at a time.

    Parameters
    ----------
    model, factor, batch
        As for `predict`.
    noisy : array, memory map or HDF5 dataset, shape (n, d, d)
        Flux-normalised images, of which only `rows` are in memory at a time.
    rows : int
        Stars per piece.

    Yields
    ------
    rows : slice
    psf : ndarray, shape (rows, d, d), float32
    """
    for start in range(0, len(noisy), rows):
        part = slice(start, min(start + rows, len(noisy)))
        yield part, predict(model, noisy[part], factor, batch)
