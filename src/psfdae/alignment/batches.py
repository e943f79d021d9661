"""What a CNN sees in an epoch: clean, noisy or denoised stamps, and mirror images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from psfdae.alignment.telescope import Mirror
from psfdae.rng import stream
from psfdae.stars.noise import NoiseModel

Batch = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Stamps (B, F, d, d), their states (B, 4) and the weights of their errors (B,)."""

Disturb = Callable[[np.ndarray, np.random.Generator], tuple[np.ndarray, np.ndarray]]
"""From noise-free stamps and a generator to noisy stamps and weights."""


def noisy_states(
    noise: NoiseModel, stamps: np.ndarray, level: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Noisy stamps of states by Poisson's law, shape (n, F, d, d), float32.

    Parameters
    ----------
    noise : NoiseModel
    stamps : ndarray, shape (n, F, d, d)
        Noise-free, each sums to 1.
    level : ndarray, shape (n,)
        Noise level λ of all stamps of a state.
    rng : Generator
    """
    count, fields, side, _ = stamps.shape
    flat = stamps.reshape(-1, side, side)
    return noise.draw(flat, np.repeat(level, fields), rng).reshape(count, fields, side, side)


def gaussian_states(
    noise: NoiseModel, stamps: np.ndarray, level: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """As `noisy_states` with Gaussian noise of the same variance, for training only.

    With 1e4 photons of sky in a pixel the two laws differ by 1 % in skewness,
    and the draw takes a tenth of the time.
    """
    level = np.asarray(level)[:, None, None, None]
    sigma = np.sqrt(noise.variance(stamps, level)).astype(np.float32)
    sigma *= rng.standard_normal(stamps.shape, dtype=np.float32)
    sigma += stamps
    return sigma


@dataclass(frozen=True)
class TrainingStates:
    """States that a CNN is trained on.

    Attributes
    ----------
    states : ndarray, shape (n, 4)
    stamps : ndarray, shape (n, F, d, d)
    weights : ndarray, shape (n,), optional
        Weights of their errors; 1 by default.
    disturb : callable, optional
        Makes noisy stamps, and their weights, anew for every batch.
    """

    states: np.ndarray
    stamps: np.ndarray
    weights: np.ndarray | None = None
    disturb: Disturb | None = None


def epoch_batches(
    data: TrainingStates,
    batch: int,
    seed: int,
    name: str,
    mirrors: Sequence[Mirror] = (),
) -> Callable[[int], Iterator[Batch]]:
    """Batches of an epoch in an order, with mirrors and noise of its own.

    Parameters
    ----------
    data : TrainingStates
    batch : int
        States per batch.
    seed, name : address of the random streams
    mirrors : sequence of Mirror, optional
        Each batch goes through a random one.

    Returns
    -------
    callable
        From the number of an epoch to its batches. A remainder of one state, of
        which batch normalisation could make nothing, is left out.
    """
    count = len(data.states)
    every = np.ones(count) if data.weights is None else data.weights

    def batches(epoch: int) -> Iterator[Batch]:
        rng = stream(seed, "cnn", "epoch", name, epoch)
        order = rng.permutation(count)
        for start in range(0, order.size, batch):
            chosen = order[start : start + batch]
            if chosen.size < 2:
                continue
            images, truth, weight = data.stamps[chosen], data.states[chosen], every[chosen]
            if data.disturb is not None:
                images, weight = data.disturb(images, rng)
            if mirrors:
                mirror = mirrors[rng.integers(len(mirrors))]
                images, truth = mirror.stamps(images), mirror.states(truth)
            yield images, truth, weight

    return batches


def steps_per_epoch(states: int, batch: int) -> int:
    """Batches that `epoch_batches` gives."""
    whole, rest = divmod(states, batch)
    return whole + (rest > 1)


def noise_weights(level: np.ndarray, levels: list[float]) -> np.ndarray:
    """Weights ∝ 1/λ² with mean 1 over the levels of a band, shape (n,)."""
    return np.asarray(level) ** -2.0 / np.mean(np.asarray(levels) ** -2.0)
