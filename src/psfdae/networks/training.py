"""The training loop of every network: resumable, watched, its best state kept.

An epoch draws its order, noise levels and noise from a stream of its own, so a training that
resumes after epoch e continues with exactly the numbers of an uninterrupted one.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import nn
from torch.optim.lr_scheduler import LambdaLR, LRScheduler, OneCycleLR

from psfdae.errors import Error
from psfdae.method import FitError
from psfdae.networks.weights import load_checkpoint, save_checkpoint
from psfdae.progress import task

Row = dict[str, float]
"""An epoch in the history of a training."""

ERRORS = {"train_mse": "train MSE", "validation_mse": "validation MSE", "loss": "loss"}
"""Columns of a history that are shown while a training runs."""

LEARNING = ("model", "optimiser", "scheduler")
REACHED = ("attempt", "seconds", "cpu_seconds", "history", "best_mse", "best_state")
"""Contents of a checkpoint: states of torch's own, and plain values."""


class TrainingError(FitError):
    """A training cannot go on; the message says why and what to change."""


class DeadNetworkError(Error, RuntimeError):
    """All outputs of the network are zero, or most: no gradient will ever revive it."""


class Muon(torch.optim.Adam):
    """Adam; matrices of groups marked `orthogonal` take steps along orthogonal matrices.

    The momentum of a matrix (out, in) is replaced by the nearest semi-orthogonal matrix, by
    five steps of a Newton–Schulz iteration (K. Jordan et al. 2024, "Muon"), scaled so that
    its elements have the RMS of Adam's steps (Liu et al. 2025, arXiv:2502.16982).
    """

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """One step; gradients of the matrices are None afterwards."""
        for group in self.param_groups:
            weights, beta = group["params"] if group.get("orthogonal") else (), group["betas"][0]
            steps = []
            for weight in weights:
                state = self.state[weight]
                if not state:  # Adam wants a step in every state that it restores
                    state |= {"step": torch.tensor(0.0), "momentum": torch.zeros_like(weight)}
                momentum = state["momentum"]
                momentum.lerp_(weight.grad, 1 - beta)
                steps.append(weight.grad.lerp(momentum, beta).flatten(1))
            for weight, step in zip(weights, orthogonal(steps), strict=True):
                scale = 0.2 * max(step.shape) ** 0.5
                weight.add_(step.view_as(weight), alpha=-group["lr"] * scale)
                weight.grad = None
        super().step()


def orthogonal(matrices: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """About the semi-orthogonal factors of polar decompositions; singular values 0.7 … 1.2.

    A step multiplies a matrix by a polynomial of its Gram matrix, and that by its square: the
    small Gram matrices are iterated, all together, and each matrix is multiplied once.
    """
    if not matrices:
        return []
    wide = [(m if m.shape[0] <= m.shape[1] else m.T) / (m.norm() + 1e-7) for m in matrices]
    side = max(len(m) for m in wide)
    gram = torch.stack([nn.functional.pad(m @ m.T, (0, side - len(m)) * 2) for m in wide])
    one = torch.eye(side).expand_as(gram)
    product = one
    for _ in range(5):
        factor = 3.4445 * one - 4.7750 * gram + 2.0315 * gram @ gram
        product, gram = factor @ product, factor @ gram @ factor
    parts = [p[: len(m), : len(m)] @ m for p, m in zip(product, wide, strict=True)]
    return [p if p.shape == m.shape else p.T for p, m in zip(parts, matrices, strict=True)]


class Course(Protocol):
    """Settings of every training: learning rate and its schedule, passes, threads."""

    @property
    def lr(self) -> float: ...
    @property
    def schedule(self) -> str: ...
    @property
    def epochs(self) -> int: ...
    @property
    def threads(self) -> int: ...
    @property
    def checkpoint_seconds(self) -> float: ...


class Training(ABC):
    """One training; a kind of network says what its batches, its loss and its history are.

    Parameters
    ----------
    model, settings
    steps : batches per epoch
    attempt : 0 at first; a restart after a dead network counts up
    key : config group of the settings, for messages
    rate : learning rate of an epoch, counted from 0, over `settings.lr`, where not one-cycle
    """

    grad_clip = float("inf")

    def __init__(
        self,
        model: nn.Module,
        settings: Course,
        steps: int,
        attempt: int = 0,
        key: str = "train",
        rate: Callable[[int], float] = lambda epoch: 1.0,
    ) -> None:
        self.model, self.settings, self.steps = model, settings, steps
        self.attempt, self.key = attempt, key
        self.optimiser = self.begin(settings.lr)
        self.scheduler: LRScheduler
        if settings.schedule == "onecycle":
            total = max(settings.epochs * steps, 2)
            self.scheduler = OneCycleLR(
                self.optimiser, settings.lr, total_steps=total, anneal_strategy="linear"
            )
        else:
            self.scheduler = LambdaLR(self.optimiser, lambda step: rate(step // steps))
        self.seconds = self.cpu_seconds = 0.0
        self.history: list[Row] = []
        self.best_mse = float("inf")
        self.best_state: dict[str, torch.Tensor] = {}

    def begin(self, lr: float) -> torch.optim.Optimizer:
        """The optimiser."""
        return torch.optim.Adam(self.model.parameters(), lr=lr)

    @abstractmethod
    def batches(self, epoch: int) -> Iterator[tuple[torch.Tensor, ...]]:
        """Batches of an epoch, counted from 0."""

    @abstractmethod
    def loss(self, batch: tuple[torch.Tensor, ...], step: int) -> torch.Tensor:
        """Loss of a batch; raises DeadNetworkError."""

    @abstractmethod
    def row(self, epoch: int, rate: float, loss: float, error: float) -> Row:
        """Row of the history: rate at the epoch's start, mean loss, what `validate` gave."""

    def validate(self, epoch: int) -> float:
        """Mean squared error that chooses the best state; NaN where none is due."""
        return float("nan")

    def finished(self) -> bool:
        return len(self.history) >= self.settings.epochs

    @property
    def rate(self) -> float:
        """The present learning rate."""
        return float(self.optimiser.param_groups[0]["lr"])

    @property
    def result(self) -> dict[str, torch.Tensor]:
        """The best state of the network; the last one if nothing validates."""
        return self.best_state or self.model.state_dict()

    def run_epoch(self) -> Row:
        """One pass over the training data; raises TrainingError and DeadNetworkError."""
        started, started_cpu = time.monotonic(), time.process_time()
        epoch, rate = len(self.history), self.rate
        losses: list[float] = []
        self.model.train()
        for batch in self.batches(epoch):
            losses.append(self._step(batch, epoch * self.steps + len(losses)))
        error = self.validate(epoch + 1)
        if error < self.best_mse:
            self.best_mse = error
            self.best_state = {
                key: value.detach().clone(memory_format=torch.contiguous_format)
                for key, value in self.model.state_dict().items()
            }
        self.seconds += time.monotonic() - started
        self.cpu_seconds += time.process_time() - started_cpu
        self.history.append(self.row(epoch + 1, rate, float(np.mean(losses)), error))
        return self.history[-1]

    def _step(self, batch: tuple[torch.Tensor, ...], step: int) -> float:
        loss = self.loss(batch, step)
        value = self._finite("loss", loss.item(), step)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), self.grad_clip)
        self._finite("gradient's norm", norm.item(), step)
        self.optimiser.step()
        self.scheduler.step()
        return value

    def _finite(self, what: str, value: float, step: int) -> float:
        if not np.isfinite(value):
            raise TrainingError(
                f"the {what} is {value} at step {step} (epoch {len(self.history) + 1}): "
                f"lower {self.key}.lr = {self.settings.lr}"
            )
        return value

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs, as tensors and plain values."""
        state = {name: getattr(self, name).state_dict() for name in LEARNING}
        return state | {name: getattr(self, name) for name in REACHED}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`."""
        for name in LEARNING:
            getattr(self, name).load_state_dict(state[name])
        for name in REACHED:
            setattr(self, name, state[name])


def train(
    begin: Callable[[int], Training],
    checkpoint: Path,
    fingerprint: str,
    report: Callable[[Row], None] = lambda row: None,
    restarts: int = 0,
) -> Training:
    """Train, restart if the network dies, resume from a checkpoint if there is one.

    Parameters
    ----------
    begin : callable
        From the number of an attempt to its training.
    checkpoint : Path
        Where the state is kept; the caller removes it once the result is safe.
    fingerprint : str
        Identifies configuration and data; a checkpoint of another one is ignored.
    report : called with the history's row after each epoch
    restarts : attempts after the first

    Raises TrainingError if something is not finite, or if every attempt died.
    """
    saved, listening = load_checkpoint(checkpoint, fingerprint), listener(checkpoint)
    for attempt in range(saved["attempt"] if saved else 0, restarts + 1):
        training = begin(attempt)
        torch.set_num_threads(training.settings.threads)
        if saved:
            training.restore(saved)
            saved = None
        last_saved = time.monotonic()
        try:
            while not training.finished():
                row = training.run_epoch()
                report(row)
                listening(row)
                if time.monotonic() - last_saved >= training.settings.checkpoint_seconds:
                    save_checkpoint(checkpoint, fingerprint, training.state())
                    last_saved = time.monotonic()
            return training
        except DeadNetworkError as death:
            print(f"attempt {attempt}: {death}; starting from another seed", flush=True)
    raise TrainingError(
        f"the network died in all {restarts + 1} attempts: "
        f"lower {training.key}.lr = {training.settings.lr}"
    )


def listener(checkpoint: Path) -> Callable[[Row], None]:
    """Return what is called after each epoch beside the log, or a function that does nothing.

    The environment variable PSFDAE_EPOCHS names it as "module:function": the function takes the
    checkpoint of the training and returns what takes the row of the history.
    """
    module, _, function = os.environ.get("PSFDAE_EPOCHS", "").partition(":")
    if not function:
        return lambda row: None
    # By name: what listens decides no result, so it is no part of the code of a stage.
    heard: Callable[[Row], None] = getattr(import_module(module), function)(checkpoint)
    return heard


def fingerprint(deciding: Mapping[str, Any], *arrays: np.ndarray) -> str:
    """Hash of what a training sees, and of the settings that decide its result."""
    digest = hashlib.sha256(json.dumps(deciding, sort_keys=True).encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


@contextmanager
def progress(epochs: int) -> Iterator[Callable[[Row], None]]:
    """Give the function that a training calls after each epoch: a bar, in a log a line."""
    terminal = sys.stderr.isatty()

    def report(row: Row) -> None:
        # Not every epoch is validated.
        known = {key: name for key, name in ERRORS.items() if np.isfinite(row.get(key, np.nan))}
        errors = [f"{name} {row[key]:.3e}" for key, name in known.items()]
        advance(1)
        if not terminal:
            left = row["seconds"] * (epochs / row["epoch"] - 1)
            time = f"{row['seconds']:.0f} s, about {left:.0f} s left"
            print(f"epoch {row['epoch']:.0f}/{epochs}", *errors, time, sep="  ", flush=True)

    with task("training", epochs) as advance:
        yield report
