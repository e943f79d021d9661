"""Training of the denoising autoencoder: resumable, watched, with fresh or fixed noise.

Every epoch draws its order, noise levels and noise from a stream of its own, so
a training that resumes after epoch e continues with exactly the numbers that an
uninterrupted one would have used.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from psfdae.configuration.schema import Dae as DaeConfig
from psfdae.configuration.schema import Train
from psfdae.models.checkpoint import load_checkpoint, save_checkpoint
from psfdae.models.dae import Dae, build_dae, image_scale, predict
from psfdae.models.weights import with_weights
from psfdae.rng import stream
from psfdae.stars.noise import NoiseModel, mixed_levels


class TrainingError(RuntimeError):
    """A training cannot go on; the message says why and what to change."""


class DeadNetworkError(RuntimeError):
    """All outputs of the network are zero: no gradient will ever revive it."""


@dataclass(frozen=True)
class TrainingSet:
    """Noise-free stars of one dataset and what is to be estimated from them.

    Attributes
    ----------
    images, references : ndarray, shape (n, d, d), float32
    fit, validation : ndarray of int
        Star indices.
    levels : ndarray, shape (L,)
        Noise levels λ that are mixed.
    noise : NoiseModel
    """

    images: np.ndarray
    references: np.ndarray
    fit: np.ndarray
    validation: np.ndarray
    levels: np.ndarray
    noise: NoiseModel

    def draw(self, stars: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Noisy images of `stars`, each at a random level."""
        return self.noise.draw(self.images[stars], mixed_levels(self.levels, stars.size, rng), rng)


class Training:
    """State of one training: network, optimiser, schedule, best state, history.

    Parameters
    ----------
    data : TrainingSet
    dae, train : config groups
    seed : int
    attempt : int
        0 at first; a restart after a dead network counts up and so gets other
        weights and other noise.
    """

    def __init__(
        self, data: TrainingSet, dae: DaeConfig, train: Train, seed: int, attempt: int
    ) -> None:
        self.data = data
        self.train = train
        self.seed = seed
        self.attempt = attempt
        self.factor = image_scale(dae.scale, data.images.shape[-1])
        generator = torch.Generator()
        generator.manual_seed(int(stream(seed, "dae", "init", attempt).integers(2**62)))
        self.model = build_dae(dae.kernels, dae.widths, dae.init, generator)
        self.optimiser = torch.optim.Adam(self.model.parameters(), lr=train.lr)
        self.steps_per_epoch = -(-data.fit.size // train.batch)
        self.fixed = self._fixed_images() if train.noise == "fixed" else None
        self.scheduler = self._make_scheduler()
        self.epoch = 0
        self.seconds = self.cpu_seconds = 0.0
        self.history: list[dict[str, float]] = []
        self.best_mse = float("inf")
        self.best_state: dict[str, torch.Tensor] = {}

    def _make_scheduler(self) -> torch.optim.lr_scheduler.LRScheduler:
        if self.train.schedule == "onecycle":
            total = self.train.epochs * self.steps_per_epoch
            return torch.optim.lr_scheduler.OneCycleLR(
                self.optimiser, self.train.lr, total_steps=max(total, 2)
            )
        return torch.optim.lr_scheduler.ConstantLR(self.optimiser, factor=1.0)

    def run_epoch(self, tick: Callable[[], None]) -> dict[str, float]:
        """One pass over the training stars, then validation where it is due.

        Returns
        -------
        dict
            Row of the history: epoch, step, lr, train_mse, validation_mse (NaN
            where not due), seconds, cpu_seconds. Errors are of flux-normalised images.

        Raises
        ------
        TrainingError
            If the loss or the gradient is not finite.
        DeadNetworkError
            If the network has died.
        """
        started, started_cpu = time.monotonic(), time.process_time()
        rng = stream(self.seed, "dae", "epoch", self.attempt, self.epoch)
        losses = []
        self.model.train()
        for noisy, target in self._batches(rng):
            losses.append(
                self._step(noisy, target, self.epoch * self.steps_per_epoch + len(losses))
            )
            tick()
        self.epoch += 1
        due = self.epoch % self.train.validate_every == 0 or self.epoch == self.train.epochs
        validation = self._validate() if due else float("nan")
        self.seconds += time.monotonic() - started
        self.cpu_seconds += time.process_time() - started_cpu
        row = {
            "epoch": self.epoch,
            "step": self.epoch * self.steps_per_epoch,
            "lr": self.optimiser.param_groups[0]["lr"],
            "train_mse": float(np.mean(losses)) / self.factor**2,
            "validation_mse": validation,
            "seconds": round(self.seconds, 3),
            "cpu_seconds": round(self.cpu_seconds, 3),
        }
        self.history.append(row)
        return row

    def _batches(self, rng: np.random.Generator) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        order = rng.permutation(self.data.fit)
        for start in range(0, order.size, self.train.batch):
            stars = order[start : start + self.train.batch]
            noisy = self.data.draw(stars, rng) if self.fixed is None else self.fixed[stars]
            yield self._tensor(noisy), self._tensor(self.data.references[stars])

    def _fixed_images(self) -> np.ndarray:
        """One noisy image of every star, for all epochs; only those of `fit` are used."""
        rng = stream(self.seed, "dae", "fixed noise")
        return self.data.draw(np.arange(len(self.data.images)), rng)

    def _tensor(self, images: np.ndarray) -> torch.Tensor:
        scaled = torch.from_numpy(images)[:, None] * self.factor
        return scaled.to(memory_format=torch.channels_last)

    def _step(self, noisy: torch.Tensor, target: torch.Tensor, step: int) -> float:
        output = self.model(noisy)
        loss = torch.nn.functional.mse_loss(output, target)
        value = loss.item()
        if not np.isfinite(value):
            raise TrainingError(
                f"the loss is {value} at step {step} (epoch {self.epoch + 1}): "
                f"lower train.lr = {self.train.lr} or train.grad_clip = {self.train.grad_clip}"
            )
        if step % self.train.dead_check_steps == 0 and not output.detach().any():
            raise DeadNetworkError(f"all outputs are zero at step {step}")
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        limit = self.train.grad_clip or float("inf")
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), limit).item()
        if not np.isfinite(norm):
            raise TrainingError(
                f"the gradient's norm is {norm} at step {step} (epoch {self.epoch + 1}): "
                f"lower train.lr = {self.train.lr}"
            )
        self.optimiser.step()
        self.scheduler.step()
        return value

    def _validate(self) -> float:
        stars = np.tile(self.data.validation, self.train.validation_draws)
        noisy = self.data.draw(stars, stream(self.seed, "dae", "validation"))
        estimate = predict(self.model, noisy, self.factor)
        if not estimate.any():
            raise DeadNetworkError(f"all outputs are zero after epoch {self.epoch}")
        error = float(((estimate - self.data.references[stars]) ** 2).mean(dtype=np.float64))
        if not np.isfinite(error):
            raise TrainingError(
                f"the validation error is {error} after epoch {self.epoch}: "
                f"look for validation stars that are not finite"
            )
        if error < self.best_mse:
            self.best_mse = error
            self.best_state = {
                key: value.detach().clone(memory_format=torch.contiguous_format)
                for key, value in self.model.state_dict().items()
            }
        return error

    def finished(self) -> bool:
        """All epochs are done, or `patience` validations brought nothing better."""
        scores = [row["validation_mse"] for row in self.history]
        scores = [score for score in scores if np.isfinite(score)]
        stale = len(scores) - 1 - int(np.argmin(scores)) if scores else 0
        return self.epoch >= self.train.epochs or 0 < self.train.patience <= stale

    def state(self) -> dict[str, Any]:
        """Everything that `restore` needs, as tensors and plain values."""
        return {
            "attempt": self.attempt,
            "epoch": self.epoch,
            "seconds": self.seconds,
            "cpu_seconds": self.cpu_seconds,
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "scheduler": self.scheduler.state_dict(),
            "history": self.history,
            "best_mse": self.best_mse,
            "best_state": self.best_state,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a `state`."""
        self.epoch = state["epoch"]
        self.seconds, self.cpu_seconds = state["seconds"], state["cpu_seconds"]
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.scheduler.load_state_dict(state["scheduler"])
        self.history = state["history"]
        self.best_mse = state["best_mse"]
        self.best_state = state["best_state"]


@dataclass(frozen=True)
class TrainingResult:
    """The best validation state and how it was reached."""

    state: dict[str, torch.Tensor]
    history: list[dict[str, float]]
    attempt: int


def train_dae(
    data: TrainingSet,
    dae: DaeConfig,
    train: Train,
    seed: int,
    checkpoint: Path,
    fingerprint: str,
    report: Callable[[dict[str, float]], None],
    tick: Callable[[], None],
) -> TrainingResult:
    """Train, restart if the network dies, resume from a checkpoint if there is one.

    Parameters
    ----------
    data, dae, train, seed : see `Training`
    checkpoint : Path
        Where the state is kept while the training runs; the caller removes it once
        the result is safe.
    fingerprint : str
        Identifies configuration and data; a checkpoint of another one is ignored.
    report : called with the history's row after each epoch
    tick : called after each step

    Raises
    ------
    TrainingError
        On a non-finite loss, or if every restart died.
    """
    torch.set_num_threads(train.threads)
    saved = load_checkpoint(checkpoint, fingerprint)
    first = saved["attempt"] if saved else 0
    for attempt in range(first, train.restarts + 1):
        training = Training(data, dae, train, seed, attempt)
        if saved:
            training.restore(saved)
            saved = None
        try:
            _run(training, checkpoint, fingerprint, report, tick)
        except DeadNetworkError as death:
            print(f"attempt {attempt}: {death}; starting from another seed", flush=True)
            continue
        return TrainingResult(training.best_state, training.history, attempt)
    raise TrainingError(
        f"the network died in all {train.restarts + 1} attempts: lower train.lr = {train.lr}"
    )


def _run(
    training: Training,
    checkpoint: Path,
    fingerprint: str,
    report: Callable[[dict[str, float]], None],
    tick: Callable[[], None],
) -> None:
    last_saved = time.monotonic()
    while not training.finished():
        report(training.run_epoch(tick))
        if time.monotonic() - last_saved >= training.train.checkpoint_seconds:
            save_checkpoint(checkpoint, fingerprint, training.state())
            last_saved = time.monotonic()


def load_dae(config: DaeConfig, weights: Path) -> Dae:
    """Network of a configuration with weights from a file.

    Raises
    ------
    ProductError
        If the file is damaged, or holds another network's weights.
    """
    return with_weights(lambda: Dae(config.kernels, config.widths), weights)
