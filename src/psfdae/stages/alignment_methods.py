"""Stages of scene 3 that train its networks, estimate the states of test sets, bound the errors.

The CNNs have one architecture and differ in what they are trained on: clean stamps of the
grid (the paper's, used as "original" and as "dae"), noisy stamps of many states, and the
DAE's output for noisy stamps of many states. The noise of a test set depends on seed, set
and λ only, so all methods see the same stamps and their differences are paired.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, make_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import click
import numpy as np

from psfdae.alignment.methods import CNNS, LEARNED, METHODS
from psfdae.alignment.stamps import AlignmentStamps
from psfdae.belonging import STATE_STAMPS, require, require_origin, write_origin
from psfdae.cli import AboveZero, File, Folder, command
from psfdae.configuration.alignment import AlignmentConfig, CnnTrain
from psfdae.estimators import CONFIG, HISTORY, TrainingSet
from psfdae.estimators.dae import Dae
from psfdae.files import (
    Column,
    Product,
    as_csv,
    as_yaml,
    read_product,
    write_csv,
    write_product,
    write_text,
)
from psfdae.reading import from_tree, read_yaml
from psfdae.rng import stream
from psfdae.stages.alignment import ModelFile, StatesFile, TestSet, read_model
from psfdae.stages.common import limit_threads, noise_model

CNN_WEIGHTS = "cnn.safetensors"

VALIDATION_STATES = 100
"""States of the large set that choose the DAE's best epoch; it is not trained on them."""

Checkpoint = Annotated[File, "File that lets an interrupted training resume."]
Trained = Annotated[Folder, "Folder for weights, config and history."]

DENOISED = ", ".join(name for name in CNNS if METHODS[name].denoised)
"""CNNs that are trained on the DAE's output."""

CLEAN = 0.0
"""Noise level of the rows without noise."""

OF_DAE = "Folder of `alignment train-dae`."
DaeFolder = Annotated[Folder, OF_DAE]
CnnFolders = make_dataclass(
    "CnnFolders", [(name, Annotated[Folder, "Folder of the CNN of that name."]) for name in CNNS]
)


@command("alignment train-dae", reads=("seed", "noise", "dae", "dae_train"), root="alignment")
def train_dae(
    config: AlignmentConfig,
    grid: Annotated[File, "Product of `alignment states --set grid`."],
    train: Annotated[File, "Product of `alignment states --set train`: its first states validate."],
    checkpoint: Checkpoint,
    out: Trained,
) -> None:
    """Train the DAE on the stamps of the grid."""
    on, validating = (
        read_product(path, "alignment_states", ("states", "stamps")) for path in (grid, train)
    )
    require(train, validating.config, STATE_STAMPS, on.config, grid)
    fit, validation = _flat(on["stamps"]), _flat(validating["stamps"][:VALIDATION_STATES])
    images = np.concatenate([fit, validation])
    data = TrainingSet(
        images=images,
        references=images,
        fit=np.arange(len(fit)),
        validation=np.arange(len(fit), len(images)),
        levels=np.asarray(config.noise.levels),
        noise=noise_model(config),
        seed=config.seed,
        checkpoint=checkpoint,
    )
    Dae.fit(data, config.dae, config.dae_train).store(out, config.model_dump(), on)
    checkpoint.unlink(missing_ok=True)


def _groups(kind: str = "", **_: Any) -> tuple[str, ...]:
    """Config groups of the training of one CNN, or of all."""
    kinds = [kind] if kind else CNNS
    noise = ["noise"] if any(METHODS[name].noisy for name in kinds) else []
    dae = ["evaluation"] if any(METHODS[name].denoised for name in kinds) else []
    return ("seed", *noise, "cnn", *(f"train_{name}" for name in kinds), *dae)


@command("alignment train-cnn", reads=_groups, root="alignment")
def train_cnn(
    config: AlignmentConfig,
    kind: Annotated[
        str, click.Choice(CNNS), "Clean stamps, noisy stamps, or the DAE's output for noisy stamps."
    ],
    states: Annotated[File, "Product of `alignment states`: the grid or the large set."],
    checkpoint: Checkpoint,
    out: Trained,
    dae: Annotated[DaeFolder | None, f"{OF_DAE} For {DENOISED} only."] = None,
) -> None:
    """Train a CNN that estimates states of misalignment."""
    from psfdae.alignment.cnn import CnnTraining, MixedNoise, TrainingStates
    from psfdae.estimators.training import fingerprint, progress, train
    from psfdae.estimators.weights import save_weights

    if METHODS[kind].denoised != (dae is not None):
        raise click.UsageError(f"--dae goes with --kind {DENOISED}, and only with it")
    settings: CnnTrain = getattr(config, f"train_{kind}")
    product = read_product(states, "alignment_states", ("states", "stamps"))
    if dae:
        require_origin(dae, STATE_STAMPS, product)
    data = TrainingStates(product["states"], product["stamps"])
    if METHODS[kind].noisy:
        levels = np.asarray(config.noise.levels)
        data = replace(data, noise=MixedNoise(noise_model(config), levels, settings.weigh_noise))
    if dae and data.noise:
        # The DAE takes most of an epoch's time, so that its noise is drawn once.
        rng = stream(config.seed, "cnn", "noise", kind)
        noisy, weights = data.noise(data.stamps, rng, gaussian=False)
        data = TrainingStates(data.states, denoise(dae, config, noisy), weights)
    limit_threads(settings.threads)
    fields, side = data.stamps.shape[1], data.stamps.shape[-1]
    described = {**config.model_dump(), "fields": fields, "stamp_px": side, "name": kind}
    described["mirrors"] = settings.mirrors

    def begin(attempt: int) -> CnnTraining:
        return CnnTraining(data, config.cnn, settings, config.seed, kind)

    with progress(settings.epochs) as report:
        done = train(begin, checkpoint, fingerprint(described, data.stamps), report)
    save_weights(out / CNN_WEIGHTS, done.result, described)
    write_origin(out, product)
    write_text(out / HISTORY, as_csv(done.history))
    write_text(out / CONFIG, as_yaml(described))
    checkpoint.unlink(missing_ok=True)


def denoise(dae: Path, config: Any, stamps: np.ndarray) -> np.ndarray:
    """Output of a trained DAE for stamps (n, F, d, d), neither clipped nor renormalised."""
    network = Dae.load(dae, evaluation=config.evaluation)
    return network.predict(_flat(stamps)).reshape(stamps.shape)


def _flat(stamps: np.ndarray) -> np.ndarray:
    return stamps.reshape(-1, *stamps.shape[-2:])


def noisy_test_states(config: Any, stamps: np.ndarray, test_set: str, level: float) -> np.ndarray:
    """Stamps of a test set at one λ, shape (n, F, d, d), float32; unchanged for λ = 0."""
    if level == CLEAN:
        return stamps
    rng = stream(config.seed, "alignment", "noise", test_set, f"{level:.6g}")
    return noise_model(config).draw(stamps, level, rng)


def cnn_predictor(folder: Path, config: Any) -> Callable[[np.ndarray], np.ndarray]:
    """The trained CNN of a folder, from stamps (n, F, d, d) to states (n, 4)."""
    import torch

    from psfdae.alignment.cnn import load_cnn, predict_states
    from psfdae.alignment.telescope import mirror_symmetries
    from psfdae.configuration.alignment import Cnn
    from psfdae.configuration.compose import validate

    torch.set_num_threads(config.evaluation.threads)
    path = folder / CONFIG
    described = read_yaml(path)
    fields, side = (from_tree(path, described, key, make=_size) for key in ("fields", "stamp_px"))
    settings = from_tree(path, described, "cnn", make=lambda tree: validate(Cnn, tree))
    model = load_cnn(settings, fields, side, folder / CNN_WEIGHTS)
    mirrors = mirror_symmetries(fields - 1) if from_tree(path, described, "mirrors") else []
    return partial(predict_states, model, batch=config.evaluation.batch, mirrors=mirrors)


def _size(value: Any) -> int:
    if not isinstance(value, int) or not 1 <= value <= 4096:
        raise ValueError(f"{value!r} must be a whole number from 1 to 4096")
    return value


def require_cnn(folder: Path, states: Product, name: str | None = None) -> None:
    """Refuse a CNN that does not belong to states with stamps, or is not the one of a name."""
    _, fields, _, side = states["stamps"].shape
    said, keys = read_yaml(folder / CONFIG), ("fields", "stamp_px")
    require(folder / CONFIG, said, keys, {"fields": fields, "stamp_px": side}, states.path)
    require_origin(folder, STATE_STAMPS, states)
    if name:
        require(folder / CONFIG, said, ("name",), {"name": name}, "the command")


@command("alignment estimate", reads=("seed", "noise", "evaluation"), root="alignment")
def estimate(
    config: AlignmentConfig,
    test_set: TestSet,
    states: StatesFile,
    dae: DaeFolder,
    cnns: CnnFolders,
    out: Annotated[File, "HDF5 product with the estimates of all learned methods."],
    times: Annotated[File, "CSV that receives the run times."],
) -> None:
    """Estimate the states of a test set with every learned method."""
    limit_threads(config.evaluation.threads)
    product = read_product(states, "alignment_states", ("states", "stamps"))
    require_origin(dae, STATE_STAMPS, product)
    folders: dict[str, Path] = asdict(cnns)
    for name, folder in folders.items():
        require_cnn(folder, product, name)
    predict = {name: cnn_predictor(folder, config) for name, folder in folders.items()}
    levels = [CLEAN, *config.noise.levels]
    found = np.empty((len(levels), len(LEARNED), *product["states"].shape))
    rows = []
    for row, level in enumerate(levels):
        noisy = noisy_test_states(config, product["stamps"], test_set, level)
        for column, method in enumerate(LEARNED):
            started = time.perf_counter()
            stamps = denoise(dae, config, noisy) if method.denoised else noisy
            found[row, column] = predict[method.cnn](stamps)
            seconds = time.perf_counter() - started
            rows.append((test_set, level, method.name, seconds, len(stamps)))
    names = ", ".join(method.name for method in LEARNED)
    columns = {
        "states": Column(product["states"], "range", "true states"),
        "levels": Column(np.array(levels), "1", "noise levels λ"),
        "estimates": Column(found, "range", f"[λ, method, state, number]; {names}"),
    }
    described = {**config.model_dump(), "test_set": test_set}
    write_product(out, "alignment_estimates", columns, described)
    _write_times(times, rows)


def _write_times(path: Path, rows: list[tuple[str, float, str, float, int]]) -> None:
    import pandas as pd

    columns = ["test_set", "noise_level", "method", "seconds", "states"]
    table = pd.DataFrame(rows, columns=columns)
    write_csv(path, table, digits=6)


@command(
    "alignment fit",
    reads=("seed", "telescope", "alignment", "optics", "noise", "fit", "evaluation"),
    root="alignment",
)
def fit(
    config: AlignmentConfig,
    test_set: TestSet,
    level: Annotated[float, AboveZero, "Noise level λ."],
    states: StatesFile,
    model: ModelFile,
    cnn: Annotated[Folder, "Folder of the CNN that starts the fit."],
    out: Annotated[File, "HDF5 product with the fits."],
    times: Annotated[File, "CSV that receives the run time."],
) -> None:
    """Fit the states of a test set by maximum likelihood."""
    from psfdae.alignment.fit import Likelihood, fit_states, refit_twins

    limit_threads(1)
    product = read_product(states, "alignment_states", ("states", "stamps", "noll"))
    require(states, product.config, STATE_STAMPS, config)
    wavefronts = read_model(model, product.config, states)
    require_cnn(cnn, product)
    predict = cnn_predictor(cnn, config)
    stamps = noisy_test_states(config, product["stamps"], test_set, level)
    operator = AlignmentStamps(config.telescope, config.optics, config.alignment)
    likelihood = Likelihood(wavefronts, operator, noise_model(config), level)
    started = time.perf_counter()
    start = predict(stamps)
    first = fit_states(likelihood, stamps, start, config.fit)
    # In focus, a state and its twin have nearly the same stamps.
    found, twins = refit_twins(likelihood, stamps, first, product["noll"], config.fit)
    seconds = time.perf_counter() - started
    columns = {
        "states": Column(product["states"], "range", "true states"),
        "estimates": Column(found.states, "range", "maximum of the likelihood"),
        "start": Column(start, "range", "estimate of the CNN"),
        "deviance": Column(
            found.deviance, "1", "twice the log-likelihood missing to a perfect fit"
        ),
        "evaluations": Column(found.evaluations, "1", "stamps and derivatives computed"),
        "converged": Column(found.converged, "1", "ended by the tolerance"),
        "twin_tried": Column(twins, "1", "the twin was a starting point, too"),
        "twin_won": Column(found.states[:, 0] != first.states[:, 0], "1", "and the better one"),
    }
    described = {**config.model_dump(), "test_set": test_set, "level": level}
    write_product(out, "alignment_fit", columns, described)
    _write_times(times, [(test_set, level, "max_likelihood", seconds, len(stamps))])


@command("alignment bound", reads=("telescope", "alignment", "optics", "noise"), root="alignment")
def bound(
    config: AlignmentConfig,
    test_set: TestSet,
    states: StatesFile,
    model: ModelFile,
    out: Annotated[File, "HDF5 product with Cramér-Rao bounds."],
) -> None:
    """Bound the errors of any unbiased estimate."""
    from psfdae.alignment.fisher import bound_covariances

    limit_threads(1)
    product = read_product(states, "alignment_states", ("states",))
    require(states, product.config, STATE_STAMPS, config)
    wavefronts = read_model(model, product.config, states)
    operator = AlignmentStamps(config.telescope, config.optics, config.alignment)
    noise, levels, truth = noise_model(config), config.noise.levels, product["states"]
    covariances = bound_covariances(wavefronts, operator, noise, levels, truth)
    columns = {
        "states": Column(truth, "range", "true states"),
        "levels": Column(np.array(levels), "1", "noise levels λ"),
        "covariances": Column(covariances, "range^2", "[λ, state, number, number] of the bound"),
    }
    described = {**config.model_dump(), "test_set": test_set}
    write_product(out, "alignment_bound", columns, described)
