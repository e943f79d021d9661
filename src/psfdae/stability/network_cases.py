"""Stress tests of the denoising autoencoder and of its training."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from psfdae.models.dae import Dae, DaeTraining, TrainingSet, image_scale, predict, train_dae
from psfdae.models.training import DeadNetworkError, Training, TrainingError
from psfdae.models.weights import save_checkpoint
from psfdae.rng import stream
from psfdae.stability.bench import Bench
from psfdae.stability.flux import normalise_robustly
from psfdae.stability.networks import rounding_of, trained_network, training_set
from psfdae.stability.rows import Entry, at_most, attempt, equal, one_of, refused

NARROW = 4
"""Channels of the networks whose accuracy does not matter."""

FINGERPRINT = "stability"


def forward_pass(bench: Bench) -> Iterator[Entry]:
    """Broken stars, batches of one, other batch sizes, other numbers of threads."""
    model, factor = trained_network(bench), _factor(bench)
    rng = stream(bench.seed, "stability", "forward")
    noisy = bench.noise.draw(bench.test_stars("seidel")[:40], 1e-3, rng)
    with _threads(1):
        usual = predict(model, noisy, factor)
    peak = float(np.abs(usual).max())
    yield at_most("trained network", "stars without output", int((~usual.any((1, 2))).sum()), 0)
    rounding = rounding_of(bench.config.dae)
    for batch in (1, 7):
        change = np.abs(predict(model, noisy, factor, batch) - usual).max() / peak
        yield at_most(f"batches of {batch}", "change of the output over its peak", change, rounding)
    with _threads(2):
        change = np.abs(predict(model, noisy, factor) - usual).max() / peak
    yield at_most("2 threads against 1", "change of the output over its peak", change, rounding)
    zero = predict(model, np.zeros_like(noisy), factor)
    yield equal("batch of zeros", "finite output", bool(np.isfinite(zero).all()), True)
    spread = np.abs(zero - zero[0]).max() / peak
    yield at_most("batch of zeros", "difference between its stars over the peak", spread, rounding)
    broken = noisy.astype(np.float64)
    broken[3, 4, 5], broken[7], broken[11, 2, 2], broken[13] = np.nan, np.inf, 1e30, 0.0
    others = np.delete(np.arange(len(noisy)), [3, 7, 11, 13])
    images, _ = normalise_robustly(broken, bench.flux_models["seidel"])
    clean, _ = normalise_robustly(noisy, bench.flux_models["seidel"])
    output, expected = predict(model, images, factor), predict(model, clean, factor)
    case = "NaN, infinite, hot and zero stars in a batch"
    yield equal(case, "finite output", bool(np.isfinite(output).all()), True)
    change = np.abs(output - expected)[others].max()
    yield at_most(case, "change of the output of the others", change, 0.0)


def dead_networks(bench: Bench) -> Iterator[Entry]:
    """Networks whose last ReLU passes nothing any more."""
    data = training_set(bench, 100)
    config = _narrow(bench)
    settings = _short(bench, dead_check_steps=1)
    training = DaeTraining(data, config, settings, bench.seed, 0)
    _kill(training.model)
    yield refused("dead at the first step", training.run_epoch, DeadNetworkError)
    fresh = DaeTraining(data, config, settings, bench.seed, 0)
    _kill(fresh.model)
    checkpoint = bench.folder / "dead.pt"
    save_checkpoint(checkpoint, FINGERPRINT, fresh.state())
    outcome = attempt(lambda: _train(bench, data, settings, checkpoint=checkpoint))
    restarted = outcome.attempt if isinstance(outcome, Training) else repr(outcome)
    yield equal("dead at the first step", "attempt that came through", restarted, 1)
    late = DaeTraining(data, config, _short(bench, dead_check_steps=1000), bench.seed, 0)
    late.run_epoch()
    _kill(late.model)
    yield refused(
        "dead between two looks, met by the validation",
        late.run_epoch,
        DeadNetworkError,
    )


def exploding_rates(bench: Bench) -> Iterator[Entry]:
    """Learning rates far too high: an error, or a network that is alive."""
    data = training_set(bench, 200)
    for lr, clip in ((0.1, 0.0), (1.0, 0.0), (1.0, 1.0)):
        for seed in range(3):
            settings = _short(bench, lr=lr, grad_clip=clip, schedule="constant", epochs=3)
            outcome = attempt(lambda s=settings, k=seed: _train(bench, data, s, seed=k))
            yield one_of(
                f"learning rate {lr:g}, clipping {clip:g}, seed {seed}",
                "outcome",
                _fate(bench, data, outcome),
                ("TrainingError", "a live network"),
            )


def broken_training(bench: Bench) -> Iterator[Entry]:
    """Non-finite gradients and stars, zero stars, and a single star."""
    data = training_set(bench, 60)
    settings = _short(bench, batch=30, epochs=2)
    for step in (0, 1):
        training = DaeTraining(data, _narrow(bench), settings, bench.seed, 0)
        _spoil_gradient(training, step)
        yield refused(
            f"NaN in the gradient of step {step}",
            training.run_epoch,
            TrainingError,
        )
    for part in ("fit", "validation"):
        references = data.references.copy()
        references[getattr(data, part)[0], 3, 3] = np.nan
        bad = replace(data, references=references)
        yield refused(
            f"NaN in a star of the part {part}",
            lambda b=bad: _train(bench, b, settings),
            TrainingError,
        )
    zeros = replace(data, images=0 * data.images, references=0 * data.references)
    outcome = attempt(lambda: _train(bench, zeros, settings))
    yield one_of(
        "all stars zero",
        "outcome",
        _fate(bench, data, outcome),
        ("TrainingError", "a live network"),
    )
    single = replace(data, fit=data.fit[:1], validation=data.validation[:1])
    outcome = attempt(lambda: _train(bench, single, _short(bench, batch=1, epochs=3)))
    yield equal(
        "a training set of one star", "outcome", _fate(bench, data, outcome), "a live network"
    )


def thread_counts(bench: Bench) -> Iterator[Entry]:
    """A short training on one and on two threads."""
    data = training_set(bench, 100)
    scores = []
    for threads in (1, 2):
        with _threads(threads):
            outcome = _train(bench, data, _short(bench, threads=threads))
        scores.append(outcome.history[-1]["validation_mse"])
    steps = 2 * -(-len(data.fit) // 25)
    # Every step adds the rounding of a pass; Adam, which divides by the gradient's own size,
    # may amplify it ten times where the gradient is small.
    yield at_most(
        "training on 2 threads against 1",
        "relative difference of the validation MSE",
        abs(scores[1] / scores[0] - 1),
        10 * steps * rounding_of(_narrow(bench)),
    )


def _narrow(bench: Bench) -> Any:
    config = bench.config.dae
    return config.model_copy(update={"widths": [NARROW] * len(config.widths)})


def _short(bench: Bench, **update: Any) -> Any:
    settings = {"epochs": 2, "batch": 25, "threads": 1, "validate_every": 1}
    settings |= {"checkpoint_seconds": 1e9, "patience": 0, **update}
    return bench.config.train.model_copy(update=settings)


def _train(
    bench: Bench, data: TrainingSet, settings: Any, seed: int = 0, checkpoint: Any = None
) -> Training:
    path = checkpoint or bench.folder / "checkpoint.pt"
    return train_dae(data, _narrow(bench), settings, seed, path, FINGERPRINT)


def _fate(bench: Bench, data: TrainingSet, outcome: Any) -> str:
    """What became of a training, in words."""
    if isinstance(outcome, Exception):
        return type(outcome).__name__
    if not outcome.result:
        return "no network"
    if not all(bool(torch.isfinite(value).all()) for value in outcome.result.values()):
        return "a network that is not finite"
    config = _narrow(bench)
    model = Dae(config.kernels, config.widths)
    model.load_state_dict(outcome.result)
    alive = predict(model, data.images[:20], _factor(bench)).any()
    return "a live network" if alive else "a dead network"


def _factor(bench: Bench) -> float:
    return image_scale(bench.config.dae.scale, bench.seidel.images.shape[-1])


def _kill(model: Dae) -> None:
    with torch.no_grad():
        model.layers[-1].bias.fill_(-1e6)  # type: ignore[union-attr, operator]


def _spoil_gradient(training: Training, step: int) -> None:
    """Make one weight's gradient NaN at the given step of the first epoch."""
    calls = iter(range(1_000_000))

    def spoil(gradient: torch.Tensor) -> torch.Tensor:
        return gradient * float("nan") if next(calls) == step else gradient

    training.model.layers[4].weight.register_hook(spoil)  # type: ignore[union-attr, operator]


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """Use this many torch threads inside a block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


CASES = (forward_pass, dead_networks, exploding_rates, broken_training, thread_counts)
"""All cases of this module."""
