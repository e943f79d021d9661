"""The training loop of all networks, which can be interrupted and keeps the best state.

Each epoch draws its order, noise levels and noise from its own random stream, so that a training
that resumes after epoch e gives exactly the result of an uninterrupted one.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from inspect import unwrap
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import nn
from torch.optim.lr_scheduler import LambdaLR, LRScheduler, OneCycleLR

from psfdae.base.errors import Error
from psfdae.base.progress import task
from psfdae.methods.interface import FitError
from psfdae.methods.networks.weights import load_checkpoint, save_checkpoint

Row = dict[str, float]
"""Values of one epoch in the history of a training, by the names of their columns."""


class TrainingError(FitError):
    """Failure of a training; the message gives the reason and a remedy."""


class DeadNetworkError(Error, RuntimeError):
    """Zero output for all or most stars; such a network also has a gradient of 0."""


class Adam(torch.optim.Adam):
    """Adam without the decorators of torch's compiler, whose import takes a second."""

    add_param_group = unwrap(torch.optim.Adam.add_param_group)
    zero_grad = unwrap(torch.optim.Adam.zero_grad)
    state_dict = unwrap(torch.optim.Adam.state_dict)
    load_state_dict = unwrap(torch.optim.Adam.load_state_dict)
    step = torch.no_grad()(unwrap(torch.optim.Adam.step))


class Muon(Adam):
    """Adam, but the matrices of groups marked `orthogonal` take orthogonalised steps.

    The step of a matrix (out, in) is about the semi-orthogonal matrix nearest to its momentum, from
    five steps of a Newton–Schulz iteration (K. Jordan et al. 2024, "Muon"), scaled so that
    its elements have the RMS of Adam's steps (Liu et al. 2025, arXiv:2502.16982).
    """

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Make one step; gradients of the matrices are None afterwards."""
        for group in self.param_groups:
            if not group.get("orthogonal"):
                continue
            weights, beta = group["params"], group["betas"][0]
            steps = []
            for weight in weights:
                state = self.state[weight]
                if not state:  # Adam's load_state_dict requires a step in every state
                    state |= {"step": torch.tensor(0.0), "momentum": torch.zeros_like(weight)}
                # Nesterov's momentum: m ← β m + (1 − β) g, and the step is along β m + (1 − β) g.
                momentum = state["momentum"]
                momentum.lerp_(weight.grad, 1 - beta)
                steps.append(weight.grad.lerp(momentum, beta).flatten(1))
            # A semi-orthogonal (m, n) matrix has elements of RMS 1/√max(m, n); Adam's steps have
            # about 0.2. Without a gradient, Adam then leaves the matrix unchanged.
            for weight, step in zip(weights, orthogonal(steps), strict=True):
                scale = 0.2 * max(step.shape) ** 0.5
                weight.add_(step.view_as(weight), alpha=-group["lr"] * scale)
                weight.grad = None
        super().step()


def orthogonal(matrices: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """Return approximate semi-orthogonal factors of the polar decompositions of matrices.

    The singular values of the results are between 0.7 and 1.2.

    Parameters
    ----------
    matrices : sequence of torch.Tensor
        Matrices of any shapes.

    Returns
    -------
    list of torch.Tensor
        Matrices of the same shapes.
    """
    if not matrices:
        return []
    # The iteration needs singular values of at most 1, which division by the norm ensures. Tall
    # matrices are transposed.
    unit_matrices = [(m if m.shape[0] <= m.shape[1] else m.T) / (m.norm() + 1e-7) for m in matrices]
    # A Newton–Schulz step is X ← f(G) X with f(G) = a + b G + c G² and the Gram matrix G = X Xᵀ,
    # so that G ← f G f. Only the small Gram matrices are iterated, in one stack and padded to the
    # same size; then each matrix is multiplied once by the product of all f.
    side = max(len(m) for m in unit_matrices)
    gram = torch.stack([nn.functional.pad(m @ m.T, (0, side - len(m)) * 2) for m in unit_matrices])
    identity = torch.eye(side).expand_as(gram)
    product = identity
    for _ in range(5):
        factor = 3.4445 * identity - 4.7750 * gram + 2.0315 * gram @ gram
        product, gram = factor @ product, factor @ gram @ factor
    # Remove the padding, and transpose tall matrices back.
    results = [p[: len(m), : len(m)] @ m for p, m in zip(product, unit_matrices, strict=True)]
    return [r if r.shape == m.shape else r.T for r, m in zip(results, matrices, strict=True)]


class Course(Protocol):
    """Settings that every training has: learning rate and its schedule, epochs, threads."""

    @property
    def lr(self) -> float:
        """Learning rate; for one-cycle its maximum."""

    @property
    def schedule(self) -> str:
        """Schedule of the learning rate, "onecycle" or "constant"."""

    @property
    def epochs(self) -> int:
        """Number of epochs."""

    @property
    def threads(self) -> int:
        """Number of threads."""

    @property
    def checkpoint_seconds(self) -> float:
        """Minimum time between checkpoints in seconds."""


def use_half_precision(is_enabled: bool = True) -> torch.autocast:
    """Return a context in which convolutions and products of matrices use bfloat16 numbers.

    These have the range of float32 and 8 significant bits; weights and sums remain float32. The
    context has an effect if enabled, on processors that are faster then: with AMX, or AMD's with
    AVX-512 BF16. Intel's with AVX-512 BF16 alone take 1.4 times as long (studies/training).
    """
    # Older versions of torch have no function for the capabilities of the processor.
    capabilities: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()
    is_amd = "AMD" in str(capabilities.get("cpu_name"))
    is_faster = capabilities.get("amx_bf16") or (is_amd and capabilities.get("avx512_bf16"))
    return torch.autocast("cpu", torch.bfloat16, enabled=is_enabled and bool(is_faster))


class Training(ABC):
    """Training of one network; a subclass defines its batches, its loss and its history.

    Parameters
    ----------
    model : torch.nn.Module
        The network.
    settings : Course
        Learning rate, number of epochs, and so on.
    steps : int
        Batches per epoch.
    attempt : int
        Number of restarts after a dead network.
    key : str
        Config group of the settings, for messages.
    rate : callable
        Function of the epoch, counted from 0, that returns the learning rate over `settings.lr`;
        not used for one-cycle.

    Attributes
    ----------
    history : list of Row
        A row for each completed epoch.
    seconds, cpu_seconds : float
        Elapsed time and CPU time of these epochs.
    best_mse : float
        Smallest validation error; infinite before the first validation.
    best_state : dict of str to torch.Tensor
        Weights of the network at this error; empty before the first validation.
    """

    grad_clip = float("inf")
    half_precision_start = 0.5
    """Fraction of the epochs after which half precision is used.

    If used in all epochs, it increases errors of the DAE by up to 2 %; if used in the second half
    only, it does not (studies/training).
    """
    state_dicts = ("model", "optimiser", "scheduler")
    """Attributes whose `state_dict` a checkpoint contains."""
    plain_fields: tuple[str, ...] = (
        *("attempt", "seconds", "cpu_seconds", "history", "best_mse", "best_state"),
    )
    """Attributes that a checkpoint contains unchanged."""

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
        self.optimiser = self.make_optimiser(settings.lr)
        # One-cycle: the rate rises to its maximum and falls to nearly 0, step by step.
        self.scheduler: LRScheduler
        if settings.schedule == "onecycle":
            total = max(settings.epochs * steps, 2)  # torch divides by this number minus 1
            self.scheduler = OneCycleLR(
                self.optimiser, settings.lr, total_steps=total, anneal_strategy="linear"
            )
        else:
            self.scheduler = LambdaLR(self.optimiser, lambda step: rate(step // steps))
        self.seconds = self.cpu_seconds = 0.0
        self.history: list[Row] = []
        self.best_mse = float("inf")
        self.best_state: dict[str, torch.Tensor] = {}

    def make_optimiser(self, lr: float) -> torch.optim.Optimizer:
        """Return the optimiser, Adam unless a subclass chooses another one."""
        return Adam(self.model.parameters(), lr=lr, fused=True)

    @abstractmethod
    def batches(self, epoch: int) -> Iterator[tuple[torch.Tensor, ...]]:
        """Yield the batches of an epoch, counted from 0."""

    @abstractmethod
    def loss(self, batch: tuple[torch.Tensor, ...], step: int) -> torch.Tensor:
        """Return the loss of a batch; raise DeadNetworkError if all outputs are zero."""

    @abstractmethod
    def row(self, epoch: int, rate: float, loss: float, error: float) -> Row:
        """Return a row of the history.

        Parameters
        ----------
        epoch : int
            Number of completed epochs.
        rate, loss, error : float
            Learning rate at the epoch's start, mean loss, and result of `validate`.
        """

    def validate(self, epoch: int) -> float:
        """Return the validation error, which selects the best state; NaN if the epoch has none."""
        return float("nan")

    def is_finished(self) -> bool:
        """Return True if all epochs are done."""
        return len(self.history) >= self.settings.epochs

    @property
    def rate(self) -> float:
        """Learning rate of the next step."""
        return float(self.optimiser.param_groups[0]["lr"])

    @property
    def result(self) -> dict[str, torch.Tensor]:
        """Weights with the smallest validation error; the last weights without any validation."""
        return self.best_state or self.model.state_dict()

    def run_epoch(self) -> Row:
        """Train for one pass over the data, and return its row of the history.

        Raises
        ------
        TrainingError
            If the loss or its gradient is not finite.
        DeadNetworkError
            If the outputs of the network are zero.
        """
        # Times are sums over epochs, and part of the state: they continue after an interruption.
        start_time, start_cpu_time = time.monotonic(), time.process_time()
        epoch, rate = len(self.history), self.rate
        losses: list[float] = []
        self.model.train()
        for batch in self.batches(epoch):
            losses.append(self.take_step(batch, epoch * self.steps + len(losses)))
        # The state with the smallest validation error is the result.
        error = self.validate(epoch + 1)
        if error < self.best_mse:
            # A copy, because the next steps change the weights in place.
            self.best_mse = error
            self.best_state = {
                key: value.detach().clone(memory_format=torch.contiguous_format)
                for key, value in self.model.state_dict().items()
            }
        self.seconds += time.monotonic() - start_time
        self.cpu_seconds += time.process_time() - start_cpu_time
        self.history.append(self.row(epoch + 1, rate, float(np.mean(losses)), error))
        return self.history[-1]

    def take_step(self, batch: tuple[torch.Tensor, ...], step: int) -> float:
        """Make a step of the optimiser with a batch, and return the loss before the step."""
        is_late = len(self.history) >= self.half_precision_start * self.settings.epochs
        with use_half_precision(is_late):
            loss = self.loss(batch, step)
        value = self._check_finite("loss", loss, step)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        # Clipping returns the norm before clipping.
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), self.grad_clip)
        self._check_finite("gradient's norm", norm, step)
        # The learning rate changes after every step, not after every epoch.
        self.optimiser.step()
        self.scheduler.step()
        return value

    def _check_finite(self, quantity: str, tensor: torch.Tensor, step: int) -> float:
        """Return the value of a tensor of one element; raise TrainingError if it is not finite."""
        value = tensor.item()
        if not np.isfinite(value):
            raise TrainingError(
                f"the {quantity} is {value} at step {step} (epoch {len(self.history) + 1}): "
                f"lower {self.key}.lr = {self.settings.lr}"
            )
        return value

    def state(self) -> dict[str, Any]:
        """Return the state for `restore`, as tensors and plain values."""
        # The scheduler's state includes the learning rate, the optimiser's state the moments.
        state = {name: getattr(self, name).state_dict() for name in self.state_dicts}
        return state | {name: getattr(self, name) for name in self.plain_fields}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a result of `state`."""
        for name in self.state_dicts:
            getattr(self, name).load_state_dict(state[name])
        for name in self.plain_fields:
            setattr(self, name, state[name])


def train(
    begin: Callable[[int], Training],
    checkpoint: Path,
    fingerprint: str,
    report: Callable[[Row], None] = lambda row: None,
    restarts: int = 0,
) -> Training:
    """Train a network; restart if it dies, and resume from a checkpoint if there is one.

    Parameters
    ----------
    begin : callable
        Function that returns the training of an attempt, given its number from 0.
    checkpoint : Path
        File of the state; the caller removes it after writing the result.
    fingerprint : str
        Hash of configuration and data; a checkpoint with another hash is ignored.
    report : callable
        Function that is called with the row of the history after each epoch.
    restarts : int
        Attempts after the first.

    Returns
    -------
    Training
        The finished training.

    Raises
    ------
    TrainingError
        If loss, gradient or validation error is not finite, or if the network died in all attempts.
    """
    # An interrupted training continues in the same attempt.
    saved_state, log_epoch = load_checkpoint(checkpoint, fingerprint), listener(checkpoint)
    for attempt in range(saved_state["attempt"] if saved_state else 0, restarts + 1):
        training = begin(attempt)
        torch.set_num_threads(training.settings.threads)
        if saved_state:
            training.restore(saved_state)
            saved_state = None
        last_saved = time.monotonic()
        try:
            while not training.is_finished():
                row = training.run_epoch()
                report(row)
                log_epoch(row)
                # Writing takes time: at most one checkpoint per interval, after a complete epoch.
                if time.monotonic() - last_saved >= training.settings.checkpoint_seconds:
                    save_checkpoint(checkpoint, fingerprint, training.state())
                    last_saved = time.monotonic()
            return training
        except DeadNetworkError as death:
            # A network with other initial weights and other noise may not die.
            remedy = "; starting from another seed" if attempt < restarts else ""
            print(f"attempt {attempt + 1} of {restarts + 1}: {death}{remedy}", flush=True)
    raise TrainingError(
        f"the network died in all {restarts + 1} attempts: "
        f"lower {training.key}.lr = {training.settings.lr}"
    )


def listener(checkpoint: Path) -> Callable[[Row], None]:
    """Return a function that logs each epoch, such as to MLflow; by default it has no effect.

    The environment variable PSFDAE_EPOCHS names a function as "module:function". This function
    takes the path of the checkpoint and returns a function of the row of each epoch.
    """
    module, _, function = os.environ.get("PSFDAE_EPOCHS", "").partition(":")
    if not function:
        return lambda row: None
    # Imported by name: a log does not change results, and so its code must not be part of the hash
    # by which the workflow repeats trainings.
    log_epoch: Callable[[Row], None] = getattr(import_module(module), function)(checkpoint)
    return log_epoch


def fingerprint(settings: Mapping[str, Any], *arrays: np.ndarray) -> str:
    """Return the SHA-256 of the data and settings that determine the result of a training."""
    # Settings as JSON with sorted keys, arrays as bytes.
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


@contextmanager
def progress(epochs: int) -> Iterator[Callable[[Row], None]]:
    """Show a progress bar; yield the function that a training calls with the row of each epoch."""
    headings = {"train_mse": "train MSE", "validation_mse": "validation MSE", "loss": "loss"}

    def report(row: Row) -> None:
        # Not every epoch has a validation, and networks have different losses.
        errors = [
            f"{heading} {row[key]:.3e}"
            for key, heading in headings.items()
            if np.isfinite(row.get(key, np.nan))
        ]
        advance(1, "  ".join([f"epoch {row['epoch']:.0f}/{epochs}", *errors]))

    with task("training", epochs) as advance:
        yield report
