"""The network as an ONNX file, for programs that have no torch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import nn

from psfdae.estimators.dae_network import Dae, predict
from psfdae.files import atomic_path
from psfdae.rng import stream

TOLERANCE = 1e-5
"""Largest difference between the exported and the original network, of the peak."""

CHECKED_BATCHES = (1, 7)


class ExportError(RuntimeError):
    """The network cannot be exported, or the exported one computes something else."""


class _Exported(nn.Module):
    """Star images in, PSFs out, with standard convolutions that share the weights."""

    def __init__(self, model: Dae, factor: float) -> None:
        super().__init__()
        self.factor = factor
        self.layers = nn.ModuleList(_plain(layer) for layer in model.layers)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        x = images[:, None] * self.factor
        for layer in self.layers:
            x = torch.relu(layer(x))
        return x[:, 0] / self.factor


def _plain(layer: nn.Conv2d) -> nn.Conv2d:
    """The convolution without its fast path, which has no ONNX operator."""
    plain = nn.Conv2d(
        layer.in_channels, layer.out_channels, layer.kernel_size, padding=layer.padding
    )
    plain.weight, plain.bias = layer.weight, layer.bias
    return plain


def export_onnx(model: Dae, factor: float, stamp_px: int, path: Path) -> None:
    """Write a network as ONNX and check it against torch.

    The file takes `images`, float32 of shape (stars, d, d), flux-normalised, and
    gives `psf` of the same shape and unit; the scale factor is part of it and the
    number of stars is free.

    Parameters
    ----------
    model : Dae
    factor : float
        Result of `image_scale`.
    stamp_px : int
        Side d of the stamps.
    path : path of the ONNX file

    Raises
    ------
    ExportError
        If onnx, onnxscript or onnxruntime is missing, or if the file's PSFs of
        random stars differ from torch's by more than `TOLERANCE` of the peak. No
        file is left then.
    """
    try:
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ExportError(f"{error}: the extra 'dev' holds what the export needs") from error
    model.eval()
    # Two stars: a batch of one would be taken for a constant.
    example = torch.zeros(2, stamp_px, stamp_px)
    with atomic_path(path) as temporary:
        torch.onnx.export(
            _Exported(model, factor).eval(),
            (example,),
            temporary,
            input_names=["images"],
            output_names=["psf"],
            dynamo=True,
            dynamic_shapes={"images": {0: torch.export.Dim("stars", min=1)}},
            external_data=False,
            verbose=False,
        )
        _check(model, factor, stamp_px, temporary)


def _check(model: Dae, factor: float, stamp_px: int, path: Path) -> None:
    for batch in CHECKED_BATCHES:
        images = random_stars(batch, stamp_px)
        expected = predict(model, images, factor)
        found = session(path, threads=1).run(None, {"images": images})[0]
        worst = float(np.abs(found - expected).max(initial=0.0))
        peak = float(np.abs(expected).max(initial=0.0))
        if found.shape != expected.shape or not worst <= TOLERANCE * peak:
            raise ExportError(
                f"{path.name}: a batch of {batch} differs from torch by {worst:.3g} "
                f"(peak {peak:.3g}, at most {TOLERANCE} of it)"
            )


def session(path: Path, threads: int):  # type: ignore[no-untyped-def]
    """An onnxruntime session on the CPU whose operators use this many threads."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def random_stars(count: int, stamp_px: int) -> np.ndarray:
    """Noisy Gaussian stars that sum to about 1, shape (count, d, d), float32."""
    rng = stream(0, "random_stars", count, stamp_px)
    grid = np.arange(stamp_px) - 0.5 * stamp_px
    centre = rng.uniform(-1.0, 1.0, (2, count, 1, 1))
    width = rng.uniform(0.8, 2.5, (count, 1, 1))
    r2 = (grid[:, None] - centre[0]) ** 2 + (grid - centre[1]) ** 2
    images = np.exp(-0.5 * r2 / width**2)
    images /= images.sum(axis=(1, 2), keepdims=True)
    return (images + rng.normal(0.0, 0.005, images.shape)).astype(np.float32)
