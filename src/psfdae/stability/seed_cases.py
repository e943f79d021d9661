"""Stress test of the seed: short trainings that differ in nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.models.dae import TrainingSet, train_dae
from psfdae.rng import stream
from psfdae.stability.bench import Bench
from psfdae.stability.networks import training_set
from psfdae.stability.rows import Entry, at_most, attempt, equal, within

DEATHS = 0.1
"""Part of the trainings that die and start again, as seen at learning rates of 3e-3 to 5e-3."""


@dataclass(frozen=True)
class Job:
    """One training in a process of its own."""

    data: TrainingSet
    dae: Any
    train: Any
    seed: int
    folder: Path


@dataclass(frozen=True)
class Score:
    """How a training ended: error of the kept network, new starts, first weights."""

    validation_mse: float
    restarts: int
    weights: tuple[float, ...]


def seeds(bench: Bench) -> Iterator[Entry]:
    """The final validation error of short trainings from different seeds, and of one again."""
    settings = bench.config.stability
    data = training_set(bench, settings.stars)
    rng = stream(bench.seed, "stability", "seeds")
    chosen = [int(seed) for seed in rng.integers(2**31, size=settings.seeds)]
    *scores, again = _run(bench, data, [*chosen, chosen[0]])
    finished = [score for score in scores if isinstance(score, Score)]
    case = f"{len(chosen)} short trainings"
    yield equal(case, "seeds that end with a network", len(finished), len(chosen))
    restarts = sum(score.restarts for score in finished)
    yield at_most(case, "new starts after a dead network", restarts, _likely_deaths(len(chosen)))
    errors = np.array([score.validation_mse for score in finished])
    # Who has learned nothing about a star answers with the mean star at best.
    truth = data.images[data.validation].astype(np.float64)
    mean_star = data.images[data.fit].mean(axis=0, dtype=np.float64)
    ignorant = float(((truth - mean_star) ** 2).mean())
    yield at_most(case, "largest validation MSE", float(errors.max()), ignorant)
    yield within(
        case,
        "spread of the validation MSE, standard deviation over mean",
        float(errors.std(ddof=1) / errors.mean()),
        1e-6,
        0.5,
    )
    yield equal(case, "equal networks among the seeds", _twins(finished), 0)
    repeated = isinstance(again, Score) and again == scores[0]
    yield equal("the first seed again", "same weights and error", repeated, True)


def train(job: Job) -> Score:
    """Train one network on one thread."""
    result = train_dae(
        job.data,
        job.dae,
        job.train,
        job.seed,
        job.folder / f"{job.seed}.pt",
        "seeds",
    )
    weights = next(iter(result.result.values())).flatten()[:16].tolist()
    best = min(row["validation_mse"] for row in result.history)
    return Score(best, result.attempt, tuple(weights))


def _run(bench: Bench, data: TrainingSet, chosen: list[int]) -> list[Any]:
    """Scores, or the exception of a training that failed, in the order of the seeds."""
    train_config = bench.config.train.model_copy(
        update={
            "epochs": bench.config.stability.epochs,
            "threads": 1,
            "validate_every": 1,
            "checkpoint_seconds": 1e9,
            "patience": 0,
        }
    )
    jobs = [Job(data, bench.config.dae, train_config, seed, bench.folder) for seed in chosen]
    with ProcessPoolExecutor(
        max_workers=bench.config.stability.threads, mp_context=get_context("spawn")
    ) as pool:
        futures = [pool.submit(train, job) for job in jobs]
        return [attempt(future.result) for future in futures]


def _likely_deaths(count: int) -> int:
    """Deaths that one set of trainings in a thousand exceeds."""
    from scipy.stats import binom

    return int(binom.ppf(0.999, count, DEATHS))


def _twins(scores: list[Score]) -> int:
    return len(scores) - len({score.weights for score in scores})


CASES = (seeds,)
"""All cases of this module."""
