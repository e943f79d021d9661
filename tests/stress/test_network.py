"""The denoising autoencoder and its training."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context

import numpy as np
import pytest
import torch
from scipy.stats import binom

from psfdae.methods.networks import training as loop
from psfdae.methods.networks.dae import DaeNetwork, DaeTraining, run_network
from psfdae.methods.networks.training import TrainingError
from stress.bench import THREADS

pytestmark = pytest.mark.slow
NARROW = 4  # channels of the networks whose accuracy does not matter
SEEDS, EPOCHS, SHOWN_STARS = 10, 3, 2000  # trainings, their epochs, or more: so many stars in all
DEATHS = 0.1  # part of the trainings that die and start again, seen at rates of 3e-3 to 5e-3
LIVE = "a live network"


@pytest.mark.parametrize(("lr", "clip"), [(0.1, 0.0), (1.0, 0.0), (1.0, 1.0)])
def test_exploding_rate(bench, record, lr, clip):
    """Learning rates far too high: an error, or a network that is alive."""
    settings = short(bench, lr=lr, grad_clip=clip, schedule="constant", epochs=3)
    outcome = fate(bench, bench.training_set(200), settings)
    case = f"learning rate {lr:g}, clipping {clip:g}"
    record.one_of(case, "outcome", outcome, "TrainingError", LIVE)


def test_broken_training(bench, record):
    """Stars that are not finite, stars that are zero, a single star."""
    data, settings = bench.training_set(60), short(bench, batch=30)
    references = data.references.copy()
    references[data.validation[0], 3, 3] = np.nan
    with record.refused("NaN in a star of the part validation", TrainingError):
        train(bench, replace(data, references=references), settings)
    zeros = replace(data, images=0 * data.images, references=0 * data.references)
    outcome = fate(bench, zeros, settings)
    record.one_of("all stars zero", "outcome", outcome, "TrainingError", LIVE)
    single = replace(data, fit=data.fit[:1], validation=data.validation[:1])
    outcome = fate(bench, single, short(bench, batch=1, epochs=3))
    record.one_of("a training set of one star", "outcome", outcome, LIVE)


def test_seeds(bench, record):
    """The final validation error of short trainings that differ in the seed, and of one again."""
    data, batch = bench.training_set(len(bench.seidel.images)), bench.config.train.batch
    settings = short(bench, epochs=max(EPOCHS, SHOWN_STARS // len(data.images)), batch=batch)
    seeds = [int(seed) for seed in bench.stream("seeds").integers(2**31, size=SEEDS)]
    run = partial(score, data, bench.config.dae, settings, bench.folder)
    with ProcessPoolExecutor(THREADS, mp_context=get_context("spawn")) as pool:
        *scores, repeated = pool.map(run, [*seeds, seeds[0]])
    errors, restarts, weights = zip(*scores, strict=True)
    case = f"{SEEDS} short trainings"
    # Deaths that one set of trainings in a thousand exceeds.
    deaths = int(binom.ppf(0.999, SEEDS, DEATHS))
    record.at_most(case, "new starts after a dead network", sum(restarts), deaths)
    # Who has learned nothing about a star answers with the mean star at best.
    mean_star = data.images[data.fit].mean(axis=0, dtype=np.float64)
    ignorant = ((data.images[data.validation].astype(np.float64) - mean_star) ** 2).mean()
    record.at_most(case, "largest validation MSE", max(errors), ignorant)
    quantity = "spread of the validation MSE, standard deviation over mean"
    record.within(case, quantity, np.std(errors, ddof=1) / np.mean(errors), 1e-6, 0.5)
    record.equal(case, "equal networks among the seeds", len(weights) - len(set(weights)), 0)
    record.equal("the first seed again", "same weights and error", repeated == scores[0], True)


def score(data, dae, settings, folder, seed):
    """Validation error, new starts and first weights of a training in a process of its own."""
    begin = partial(DaeTraining, data, dae, settings, seed)
    training = loop.train(begin, folder / f"{seed}.pt", "seeds", restarts=settings.restarts)
    weights = next(iter(training.result.values())).flatten()[:16].tolist()
    return min(row["validation_mse"] for row in training.history), training.attempt, tuple(weights)


def narrow(bench):
    config = bench.config.dae
    return config.model_copy(update={"widths": [NARROW] * len(config.widths)})


def short(bench, **update):
    settings = {"epochs": 2, "batch": 25, "threads": 1, "validate_every": 1}
    settings |= {"checkpoint_seconds": 1e9, "patience": 0, **update}
    return bench.config.train.model_copy(update=settings)


def train(bench, data, settings):
    begin = partial(DaeTraining, data, narrow(bench), settings, 0)
    path = bench.folder / "checkpoint.pt"
    return loop.train(begin, path, "stability", restarts=settings.restarts)


def fate(bench, *settings):
    """Outcome of a training, in words."""
    try:
        outcome = train(bench, *settings)
    except Exception as error:  # which one is the question
        return type(error).__name__
    config = narrow(bench)
    model = DaeNetwork(config.kernels, config.widths)
    model.load_state_dict(outcome.result)
    finite = all(torch.isfinite(value).all() for value in outcome.result.values())
    alive = finite and run_network(model, bench.seidel.images[:20], bench.factor).any()
    return LIVE if alive else "a dead network"
