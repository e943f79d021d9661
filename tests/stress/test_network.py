"""The denoising autoencoder and its training."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import count
from multiprocessing import get_context

import numpy as np
import pytest
import torch
from scipy.stats import binom

from psfdae.networks.dae import Dae, DaeTraining, predict, train_dae
from psfdae.networks.training import DeadNetworkError, TrainingError
from psfdae.networks.weights import save_checkpoint
from stress.bench import THREADS, rounding_of
from stress.test_photometry import measured

NARROW = 4  # channels of the networks whose accuracy does not matter
SEEDS, EPOCHS, SEEN = 10, 3, 2000  # trainings, their epochs, or more: so many stars in all
DEATHS = 0.1  # part of the trainings that die and start again, seen at rates of 3e-3 to 5e-3
LIVE = "a live network"


@pytest.mark.slow
def test_forward_pass(bench, record):
    """Broken stars, batches of one, other batch sizes, other numbers of threads."""
    run = partial(predict, bench.network, factor=bench.factor)
    noisy = bench.noise.draw(bench.test_stars()[:40], 1e-3, bench.stream("forward"))
    usual, rounding = run(noisy), rounding_of(bench.config.dae)
    peak, what = float(np.abs(usual).max()), "change of the output over its peak"
    record.at_most("trained network", "stars without output", (~usual.any((1, 2))).sum(), 0)
    for batch in (1, 7):
        output = run(noisy, batch=batch)
        record.close(f"batches of {batch}", what, output, usual, rounding, over=peak)
    torch.set_num_threads(2)
    record.close("2 threads against 1", what, run(noisy), usual, rounding, over=peak)
    torch.set_num_threads(1)
    zero, case = run(np.zeros_like(noisy)), "batch of zeros"
    record.equal(case, "finite output", np.isfinite(zero).all(), True)
    what = "difference between its stars over the peak"
    record.close(case, what, zero, zero[0], rounding, over=peak)
    broken, case = noisy.astype(np.float64), "NaN, infinite, hot and zero stars in a batch"
    broken[3, 4, 5], broken[7], broken[11, 2, 2], broken[13] = np.nan, np.inf, 1e30, 0.0
    output, expected = (run(measured(bench, images).images) for images in (broken, noisy))
    record.equal(case, "finite output", np.isfinite(output).all(), True)
    pair = (np.delete(images, [3, 7, 11, 13], axis=0) for images in (output, expected))
    # A star with outliers of its own is fitted among others: where, rounds it anew.
    record.close(case, "change of the output of the others", *pair, rounding * peak)


def test_dead_network(bench, record):
    """Networks whose last ReLU passes nothing any more."""
    data, looks = bench.training_set(100), short(bench, dead_check_steps=1)
    case, checkpoint = "dead at the first step", bench.folder / "dead.pt"
    training, fresh = (killed(new(bench, data, looks)) for _ in range(2))
    with record.refused(case, DeadNetworkError):
        training.run_epoch()
    save_checkpoint(checkpoint, "stability", fresh.state())
    attempt = train(bench, data, looks, checkpoint=checkpoint).attempt
    record.equal(case, "attempt that came through", attempt, 1)
    late = new(bench, data, short(bench, dead_check_steps=1000))
    late.run_epoch()
    with record.refused("dead between two looks, met by the validation", DeadNetworkError):
        killed(late).run_epoch()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("lr", "clip"), [(0.1, 0.0), (1.0, 0.0), (1.0, 1.0)])
def test_exploding_rate(bench, record, lr, clip, seed):
    """Learning rates far too high: an error, or a network that is alive."""
    settings = short(bench, lr=lr, grad_clip=clip, schedule="constant", epochs=3)
    outcome = fate(bench, bench.training_set(200), settings, seed)
    case = f"learning rate {lr:g}, clipping {clip:g}, seed {seed}"
    record.one_of(case, "outcome", outcome, "TrainingError", LIVE)


def test_broken_training(bench, record):
    """Gradients and stars that are not finite, stars that are zero, a single star."""
    data, settings = bench.training_set(60), short(bench, batch=30)
    for step in (0, 1):
        training, calls = new(bench, data, settings), count()

        def spoil(gradient, step=step, calls=calls):
            return gradient * float("nan") if next(calls) == step else gradient

        training.model.layers[4].weight.register_hook(spoil)
        with record.refused(f"NaN in the gradient of step {step}", TrainingError):
            training.run_epoch()
    for part in ("fit", "validation"):
        references = data.references.copy()
        references[getattr(data, part)[0], 3, 3] = np.nan
        with record.refused(f"NaN in a star of the part {part}", TrainingError):
            train(bench, replace(data, references=references), settings)
    zeros = replace(data, images=0 * data.images, references=0 * data.references)
    outcome = fate(bench, zeros, settings)
    record.one_of("all stars zero", "outcome", outcome, "TrainingError", LIVE)
    single = replace(data, fit=data.fit[:1], validation=data.validation[:1])
    outcome = fate(bench, single, short(bench, batch=1, epochs=3))
    record.one_of("a training set of one star", "outcome", outcome, LIVE)


@pytest.mark.slow
def test_thread_counts(bench, record):
    """A short training on one and on two threads."""
    data = bench.training_set(100)
    one, two = (train(bench, data, short(bench, threads=threads)).history[-1] for threads in (1, 2))
    torch.set_num_threads(1)
    steps, ratio = 2 * -(-len(data.fit) // 25), two["validation_mse"] / one["validation_mse"]
    # Every step adds the rounding of a pass; Adam, which divides by the gradient's own size,
    # may amplify it ten times where the gradient is small.
    bound = 10 * steps * rounding_of(narrow(bench))
    case, what = "training on 2 threads against 1", "relative difference of the validation MSE"
    record.close(case, what, ratio, 1, bound)


@pytest.mark.slow
def test_seeds(bench, record):
    """The final validation error of short trainings that differ in the seed, and of one again."""
    data, batch = bench.training_set(len(bench.seidel.images)), bench.config.train.batch
    settings = short(bench, epochs=max(EPOCHS, SEEN // len(data.images)), batch=batch)
    chosen = [int(seed) for seed in bench.stream("seeds").integers(2**31, size=SEEDS)]
    run = partial(score, data, bench.config.dae, settings, bench.folder)
    with ProcessPoolExecutor(THREADS, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(run, seed) for seed in [*chosen, chosen[0]]]
    *scores, again = (None if f.exception() else f.result() for f in futures)
    errors, restarts, weights = zip(*filter(None, scores), strict=True)
    case = f"{SEEDS} short trainings"
    record.equal(case, "seeds that end with a network", len(errors), SEEDS)
    # Deaths that one set of trainings in a thousand exceeds.
    deaths = int(binom.ppf(0.999, SEEDS, DEATHS))
    record.at_most(case, "new starts after a dead network", sum(restarts), deaths)
    # Who has learned nothing about a star answers with the mean star at best.
    mean_star = data.images[data.fit].mean(axis=0, dtype=np.float64)
    ignorant = ((data.images[data.validation].astype(np.float64) - mean_star) ** 2).mean()
    record.at_most(case, "largest validation MSE", max(errors), ignorant)
    what = "spread of the validation MSE, standard deviation over mean"
    record.within(case, what, np.std(errors, ddof=1) / np.mean(errors), 1e-6, 0.5)
    record.equal(case, "equal networks among the seeds", len(weights) - len(set(weights)), 0)
    repeated = again is not None and again == scores[0]
    record.equal("the first seed again", "same weights and error", repeated, True)


def score(data, dae, settings, folder, seed):
    """Validation error, new starts and first weights of a training in a process of its own."""
    checkpoint = folder / f"{seed}.pt"
    training = train_dae(data, dae, settings, seed, checkpoint, "seeds")
    weights = next(iter(training.result.values())).flatten()[:16].tolist()
    return min(row["validation_mse"] for row in training.history), training.attempt, tuple(weights)


def narrow(bench):
    config = bench.config.dae
    return config.model_copy(update={"widths": [NARROW] * len(config.widths)})


def short(bench, **update):
    settings = {"epochs": 2, "batch": 25, "threads": 1, "validate_every": 1}
    settings |= {"checkpoint_seconds": 1e9, "patience": 0, **update}
    return bench.config.train.model_copy(update=settings)


def new(bench, data, settings):
    return DaeTraining(data, narrow(bench), settings, bench.config.seed)


def killed(training):
    with torch.no_grad():
        training.model.layers[-1].bias.fill_(-1e6)
    return training


def train(bench, data, settings, seed=0, checkpoint=None):
    path = checkpoint or bench.folder / "checkpoint.pt"
    return train_dae(data, narrow(bench), settings, seed, path, "stability")


def fate(bench, *how):
    """What becomes of a training, in words."""
    try:
        outcome = train(bench, *how)
    except Exception as error:  # which one is the question
        return type(error).__name__
    config = narrow(bench)
    model = Dae(config.kernels, config.widths)
    model.load_state_dict(outcome.result)
    finite = all(torch.isfinite(value).all() for value in outcome.result.values())
    alive = finite and predict(model, bench.seidel.images[:20], bench.factor).any()
    return LIVE if alive else "a dead network"
