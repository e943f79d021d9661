"""The convolutional network of the paper's section 3.3, from nine stamps to a state.

Five convolutions with batch normalisation and leaky ReLU after each, and one
linear layer. The fields are the channels of the input. Widths, kernels and
strides are not in the paper's text; the configuration names them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from psfdae.configuration.alignment import Cnn as CnnConfig
from psfdae.configuration.alignment import CnnTrain
from psfdae.models.checkpoint import load_checkpoint, save_checkpoint
from psfdae.models.weights import with_weights
from psfdae.rng import stream

PARAMETERS = 4
"""Numbers of a state: decentre x, y and tilt x, y in units of the range."""


class CnnTrainingError(RuntimeError):
    """A training of the CNN cannot go on; the message says why and what to change."""


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

    def __init__(self, config: CnnConfig, fields: int, stamp_px: int) -> None:
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
        return self.linear(self.features(x).flatten(1))


def build_cnn(
    config: CnnConfig, fields: int, stamp_px: int, generator: torch.Generator
) -> AlignmentCnn:
    """A fresh network whose weights come from `generator` alone.

    Convolutions draw N(0, 2/fan_in) (He et al. 2015), the linear layer PyTorch's
    uniform ±1/√fan_in; its bias is 0, the middle of the range.
    """
    model = AlignmentCnn(config, fields, stamp_px).to(memory_format=torch.channels_last)
    with torch.no_grad():
        for layer in model.features:
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(
                    layer.weight, a=config.leak, nonlinearity="leaky_relu", generator=generator
                )
        bound = float(model.linear.in_features) ** -0.5
        model.linear.weight.uniform_(-bound, bound, generator=generator)
        model.linear.bias.zero_()
    return model


Batches = Callable[[int], Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]]
"""Stamps (B, fields, d, d), states (B, 4) and weights (B,) of an epoch, batch by batch."""


class CnnTraining:
    """State of one training: network, optimiser, schedule, history.

    Parameters
    ----------
    batches : callable
        Gives the batches of an epoch; stamps are flux-normalised.
    steps : int
        Batches per epoch.
    shape : (fields, d)
    cnn, train : config groups
    seed : int
    name : str
        Of the training; part of the address of its random stream.
    """

    def __init__(
        self,
        batches: Batches,
        steps: int,
        shape: tuple[int, int],
        cnn: CnnConfig,
        train: CnnTrain,
        seed: int,
        name: str,
    ) -> None:
        self.batches, self.train, self.name = batches, train, name
        self.factor = float(shape[1] ** 2)
        generator = torch.Generator()
        generator.manual_seed(int(stream(seed, "cnn", "init", name).integers(2**62)))
        self.model = build_cnn(cnn, *shape, generator)
        self.optimiser = torch.optim.Adam(self.model.parameters(), lr=train.lr)
        self.scheduler = _scheduler(self.optimiser, train, steps)
        self.history: list[dict[str, float]] = []

    def run_epoch(self) -> dict[str, float]:
        """One pass over the states.

        Returns
        -------
        dict
            Row of the history: epoch, lr at its start, loss (weighted mean
            squared error in units of the range), seconds since the start of the training.

        Raises
        ------
        CnnTrainingError
            If the loss is not finite.
        """
        started, epoch = time.monotonic(), len(self.history)
        rate = self.optimiser.param_groups[0]["lr"]
        self.model.train()
        losses = []
        for batch in self.batches(epoch):
            losses.append(self._step(*batch))
            if not np.isfinite(losses[-1]):
                raise CnnTrainingError(
                    f"{self.name}: the loss is {losses[-1]} in epoch {epoch + 1}: "
                    f"lower lr = {self.train.lr}"
                )
        spent = self.history[-1]["seconds"] if self.history else 0.0
        row = {
            "epoch": epoch + 1,
            "lr": rate,
            "loss": float(np.mean(losses)),
            "seconds": round(spent + time.monotonic() - started, 3),
        }
        self.history.append(row)
        return row

    def _step(self, stamps: np.ndarray, states: np.ndarray, weights: np.ndarray) -> float:
        output = self.model(_scaled(stamps, self.factor))
        truth = torch.from_numpy(states.astype(np.float32))
        each = torch.from_numpy(weights.astype(np.float32))[:, None]
        loss = (each * nn.functional.mse_loss(output, truth, reduction="none")).mean()
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self.optimiser.step()
        self.scheduler.step()
        return loss.item()

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs, as tensors and plain values."""
        return {
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "scheduler": self.scheduler.state_dict(),
            "history": self.history,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state`; epochs have streams of their own, so nothing shifts."""
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.scheduler.load_state_dict(state["scheduler"])
        self.history = state["history"]


def train_cnn(
    training: CnnTraining,
    checkpoint: Path,
    fingerprint: str,
    report: Callable[[dict[str, float]], None],
) -> None:
    """Run a training to its end, resuming from a checkpoint if there is one.

    Parameters
    ----------
    training : CnnTraining
    checkpoint : Path
        Where the state is kept while the training runs; the caller removes it once
        the result is safe.
    fingerprint : str
        Identifies configuration and data; a checkpoint of another one is ignored.
    report : called with the history's row after each epoch

    Raises
    ------
    CnnTrainingError
        If the loss is not finite.
    """
    torch.set_num_threads(training.train.threads)
    saved = load_checkpoint(checkpoint, fingerprint)
    if saved:
        training.restore(saved)
    last_saved = time.monotonic()
    while len(training.history) < training.train.epochs:
        report(training.run_epoch())
        if time.monotonic() - last_saved >= training.train.checkpoint_seconds:
            save_checkpoint(checkpoint, fingerprint, training.state())
            last_saved = time.monotonic()
    training.model.eval()


def _scheduler(
    optimiser: torch.optim.Optimizer, train: CnnTrain, steps_per_epoch: int
) -> torch.optim.lr_scheduler.LRScheduler:
    if train.schedule == "onecycle":
        total = max(train.epochs * steps_per_epoch, 2)
        return torch.optim.lr_scheduler.OneCycleLR(optimiser, train.lr, total_steps=total)
    return torch.optim.lr_scheduler.LambdaLR(
        optimiser,
        lambda step: train.decay ** (step // steps_per_epoch // train.decay_epochs),
    )


def _scaled(stamps: np.ndarray, factor: float) -> torch.Tensor:
    images = torch.from_numpy(np.ascontiguousarray(stamps, np.float32)) * factor
    return images.to(memory_format=torch.channels_last)


@torch.inference_mode()
def predict_states(model: AlignmentCnn, stamps: np.ndarray, batch: int = 256) -> np.ndarray:
    """States of flux-normalised stamps (n, fields, d, d), shape (n, 4), float64."""
    model.eval()
    factor = float(stamps.shape[-1] ** 2)
    parts = [
        model(_scaled(stamps[start : start + batch], factor)).numpy()
        for start in range(0, len(stamps), batch)
    ]
    return np.concatenate(parts).astype(np.float64)


def load_cnn(config: CnnConfig, fields: int, stamp_px: int, weights: Path) -> AlignmentCnn:
    """Network of a configuration with weights from a file; ProductError as `load_dae`."""
    return with_weights(lambda: AlignmentCnn(config, fields, stamp_px), weights)
