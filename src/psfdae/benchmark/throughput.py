"""Stars per second of the network, in torch and in onnxruntime.

Speed does not depend on the values of the weights, so random networks do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from psfdae.rng import stream

BATCHES = (1, 16, 64, 256, 1024)

LEAST_S = 0.03
"""A timing calls as often as it takes to last this long."""

MOST_S = 5.0
"""No further repeats after this time, once there are `LEAST_REPEATS`."""

LEAST_REPEATS = 3


def rates(call: Callable[[], Any], stars: int, repeats: int) -> dict[str, float]:
    """Median, lowest and highest number of stars per second of repeated timings.

    Parameters
    ----------
    call : callable
        Processes `stars` stars; called once before the first timing.
    stars : int
    repeats : int
        Timings, fewer if they take long.

    Returns
    -------
    dict
        repeats, stars_per_s, stars_per_s_low, stars_per_s_high.
    """
    call()
    start = perf_counter()
    call()
    calls = max(1, round(LEAST_S / max(perf_counter() - start, 1e-9)))
    found: list[float] = []
    begin = perf_counter()
    while len(found) < repeats:
        if len(found) >= LEAST_REPEATS and perf_counter() - begin > MOST_S:
            break
        start = perf_counter()
        for _ in range(calls):
            call()
        found.append(calls * stars / (perf_counter() - start))
    return {
        "repeats": len(found),
        "stars_per_s": float(np.median(found)),
        "stars_per_s_low": min(found),
        "stars_per_s_high": max(found),
    }


def random_network(kernels: Sequence[int], width: int):  # type: ignore[no-untyped-def]
    """A network of one width with random weights."""
    import torch

    from psfdae.models.dae import build_dae

    generator = torch.Generator()
    generator.manual_seed(width)
    return build_dae(kernels, [width] * (len(kernels) - 1), "he", generator)


def export_networks(
    kernels: Sequence[int], scale: str, widths: Sequence[int], stamps: Sequence[int], folder: str
) -> None:
    """Export random networks to `onnx_path` of every width and stamp; runs in a process."""
    from psfdae.models.dae import image_scale
    from psfdae.models.export import export_onnx

    for width in widths:
        for stamp_px in stamps:
            factor = image_scale(scale, stamp_px)  # type: ignore[arg-type]
            path = onnx_path(folder, width, stamp_px)
            export_onnx(random_network(kernels, width), factor, stamp_px, path)


def onnx_path(folder: str | Path, width: int, stamp_px: int) -> Path:
    """Name of an exported network."""
    return Path(folder) / f"width{width}_stamp{stamp_px}.onnx"


def time_torch(
    kernels: Sequence[int],
    scale: str,
    widths: Sequence[int],
    stamps: Sequence[int],
    batches: Sequence[int],
    threads: int,
    repeats: int,
) -> list[dict[str, Any]]:
    """Time `predict` over widths, stamps and batches; runs in a process of its own."""
    import torch

    from psfdae.models.dae import image_scale, predict

    torch.set_num_threads(threads)
    table = []
    for width in widths:
        model = random_network(kernels, width)
        for stamp_px in stamps:
            factor = image_scale(scale, stamp_px)  # type: ignore[arg-type]

            key = {"engine": "torch", "width": width, "stamp_px": stamp_px, "threads": threads}

            def apply(images: np.ndarray, model: Any = model, factor: float = factor) -> np.ndarray:
                return predict(model, images, factor, len(images))

            table += _over_batches(apply, key, batches, repeats)
    return table


def time_onnxruntime(
    folder: str,
    widths: Sequence[int],
    stamps: Sequence[int],
    batches: Sequence[int],
    threads: int,
    repeats: int,
) -> list[dict[str, Any]]:
    """Time exported networks in onnxruntime, without torch; runs in a process of its own."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    table = []
    for width in widths:
        for stamp_px in stamps:
            key = {"engine": "onnxruntime", "width": width, "stamp_px": stamp_px}
            key["threads"] = threads
            session = onnxruntime.InferenceSession(
                str(onnx_path(folder, width, stamp_px)),
                options,
                providers=["CPUExecutionProvider"],
            )

            def apply(images: np.ndarray, session: Any = session) -> np.ndarray:
                return session.run(None, {"images": images})[0]

            table += _over_batches(apply, key, batches, repeats)
            del session
    return table


def _over_batches(
    apply: Callable[[np.ndarray], np.ndarray],
    key: dict[str, Any],
    batches: Sequence[int],
    repeats: int,
) -> list[dict[str, Any]]:
    table = []
    for batch in batches:
        side = key["stamp_px"]
        noise = stream(0, "throughput").normal(0.0, 0.005, (batch, side, side))
        images = (noise + side**-2.0).astype(np.float32)
        measured = rates(lambda images=images: apply(images), batch, repeats)
        table.append({**key, "batch": batch, **measured})
    return table
