"""A convolution whose kernel is trained: the example of "Add your method" (developers.md)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from psfdae.base.rng import stream
from psfdae.base.settings import CheckpointSeconds, Count, Group, dump_deciding
from psfdae.methods.interface import HISTORY, Look, Method, Needs, Storage, TrainingSet

if TYPE_CHECKING:
    import torch


class KernelSettings(Group):
    """Settings: the side of the kernel, and what the training loop asks for."""

    side_px: Literal[3, 5, 7, 9, 11, 13, 15] = 9
    """Side of the kernel, odd."""
    lr: Annotated[float, Field(gt=0)] = 0.02
    """Learning rate, or its maximum for one-cycle."""
    schedule: Literal["onecycle", "constant"] = "onecycle"
    """Course of the learning rate."""
    epochs: Count = 10
    """Passes over the training stars."""
    threads: Count = 1
    """Threads of the training."""
    checkpoint_seconds: CheckpointSeconds = 20.0
    """Minimum time between checkpoints; a new value repeats no job."""


@dataclass(frozen=True)
class Kernel(Method):
    """Trained kernel, and the history of its training."""

    # Label, colour and marker; validation stars only choose the best epoch; an array in the HDF5
    # product and a table beside it, for each reference.
    look = Look("trained kernel", "#aa3377", "v")
    needs = Needs(validation=True)
    groups: ClassVar = {"kernel": KernelSettings}
    storage = Storage({"weights": ("", "kernel")}, diagnostics=(HISTORY,), per_reference=True)

    weights: np.ndarray
    diagnostic_rows: dict[str, list[dict[str, float]]] = field(default_factory=dict)

    @classmethod
    def fit(cls, data: TrainingSet, kernel: KernelSettings) -> Kernel:
        """Train the kernel; a fit that was interrupted goes on from its checkpoint."""
        # Modules of methods must not load torch when they are imported.
        import torch

        from psfdae.methods.networks import training as loop

        def draw_pair(stars: np.ndarray, rng: np.random.Generator) -> tuple[torch.Tensor, ...]:
            """Return new noisy images of stars, and what they should become."""
            images = data.draw(stars, rng)[0], data.references[stars]
            return tuple(torch.from_numpy(np.float32(x))[:, None] for x in images)

        class KernelTraining(loop.Training):
            """Batches, loss, validation error and history; all else is in the loop."""

            def batches(self, epoch: int) -> Iterator[tuple[torch.Tensor, ...]]:
                # A random stream for each epoch: a resumed training draws the same numbers.
                rng = stream(data.seed, "kernel", epoch)
                for stars in np.array_split(rng.permutation(data.fit), self.steps):
                    yield draw_pair(stars, rng)

            def loss(self, batch: tuple[torch.Tensor, ...], step: int) -> torch.Tensor:
                noisy, reference = batch
                squares: torch.Tensor = (self.model(noisy) - reference) ** 2
                return squares.mean()

            @torch.no_grad()
            def validate(self, epoch: int) -> float:
                # The same noise after every epoch.
                rng = stream(data.seed, "kernel", "validation")
                return self.loss(draw_pair(data.validation, rng), 0).item()

            def row(self, epoch: int, rate: float, loss: float, error: float) -> loop.Row:
                # These columns are drawn in curves.png and logged in MLflow.
                times = {"seconds": self.seconds, "cpu_seconds": self.cpu_seconds}
                errors = {"train_mse": loss, "validation_mse": error}
                return {"epoch": epoch, "step": epoch * self.steps, **errors, **times}

        def begin(attempt: int) -> loop.Training:
            layer = torch.nn.Conv2d(1, 1, kernel.side_px, padding="same", bias=False)
            torch.nn.init.dirac_(layer.weight)  # the first output is the noisy image itself
            return KernelTraining(layer, kernel, max(1, len(data.fit) // 64), attempt, "kernel")

        # A checkpoint of other settings or other stars is not resumed.
        decisions: dict[str, Any] = {"kernel": dump_deciding(kernel), "seed": data.seed}
        decisions["noise"] = [data.levels.tolist(), str(data.noise)]
        arrays = data.images, data.references, data.fit, data.validation
        with loop.progress(kernel.epochs) as report:
            assert data.checkpoint is not None
            digest = loop.fingerprint(decisions, *arrays)
            training = loop.train(begin, data.checkpoint, digest, report)
        return cls(training.result["weight"][0, 0].numpy(), {HISTORY: training.history})

    def predict(self, noisy: np.ndarray) -> np.ndarray:
        """Return the images convolved with the kernel, shape (n, d, d)."""
        from scipy.ndimage import correlate

        smooth: np.ndarray = correlate(noisy, self.weights[None], mode="constant")
        return smooth
