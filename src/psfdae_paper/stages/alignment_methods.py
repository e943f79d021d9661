"""Stages of scene 3 that train networks, estimate the states of test sets and bound their errors.

Inputs: products "alignment_states" and "alignment_model". Outputs: a folder for each network, and
the products "alignment_estimates" (networks), "alignment_fit" (maximum likelihood) and
"alignment_bound" (Cramér–Rao), which `psfdae_paper.stages.alignment_results` tabulates and draws.

The networks differ in their training set. The paper's CNN is trained on noise-free stamps of the
grid (it is used as "original" and as "dae"). Those that are not in the paper are trained on noisy
stamps of many states, or on the DAE's output for such stamps. The noise of a test set depends on
seed, set and λ only, so all methods get the same stamps and their differences are paired.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import make_dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click
import numpy as np
import pandas as pd

from psfdae.base.belonging import require, require_origin, write_origin
from psfdae.base.files import Column, Product, as_csv, as_yaml, write_csv, write_product, write_text
from psfdae.base.options import AboveZero, File, Folder
from psfdae.base.progress import steps
from psfdae.base.reading import from_tree, read_yaml
from psfdae.base.rng import stream
from psfdae.base.settings import dump_deciding, parse_settings
from psfdae.base.threads import limit_threads
from psfdae.methods.dae import Dae
from psfdae.methods.fit_files import store
from psfdae.methods.interface import CONFIG, HISTORY, TrainingSet
from psfdae.stars.noise import draw_levels
from psfdae.training.star_sets import noise_model
from psfdae_paper.alignment.emulator import StampEmulator
from psfdae_paper.alignment.likelihood import (
    StateLikelihood,
    StateOptics,
    compute_bounds,
    refit_twins,
)
from psfdae_paper.alignment.stamps import AlignmentStamps
from psfdae_paper.alignment.telescope import mirror_symmetries
from psfdae_paper.configuration.alignment import NETWORKS, Alignment, NetworkTrain
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.estimators import (
    ESTIMATORS,
    Estimator,
    list_estimators,
    list_trained_networks,
)
from psfdae_paper.configuration.schema import Config
from psfdae_paper.stages.alignment import ModelFile, StatesFile, TestSet, read_model, read_states

if TYPE_CHECKING:
    from psfdae_paper.alignment.networks import TrainingStates

NetworkFolders = make_dataclass(
    "NetworkFolders",
    [(name, Annotated[Folder, "Folder of this network."]) for name in list_trained_networks()],
)
"""Options of a command: the folder of each network, by its name."""

Checkpoint = Annotated[File, "File that lets an interrupted training resume."]
TrainingFolder = Annotated[Folder, "Folder for weights, config and history."]
DaeFolder = Annotated[Folder, "Folder of `alignment train-dae`."]


@command("paper alignment train-dae", reads=("seed", "noise", "dae", "dae_train"))
def train_dae(
    config: Config, grid: File, train: File, checkpoint: Checkpoint, out: TrainingFolder
) -> None:
    """Train the DAE on the stamps of the grid.

    It is trained to remove the noise of single stamps, at all noise levels, and is applied to the
    stamps of a state before a network estimates the state.

    The folder receives weights, settings and the error of every epoch. An interrupted training
    resumes from the checkpoint, and ends with the same bytes.

    Parameters
    ----------
    config : Config
        Seed, noise, and settings of the DAE and its training.
    grid : Path
        Product of `alignment states --set grid`.
    train : Path
        Product of `alignment states --set train`; its first states are for validation.
    checkpoint : Path
        File that lets an interrupted training resume.
    out : Path
        Folder for weights, config and history.
    """
    # Both sets must have stamps of the same telescope.
    grid_product = read_states(grid)
    large_product = read_states(train, grid_product.config, grid)
    # The DAE denoises stamps one by one, independently of their state and field.
    # 100 states of the large set choose the best epoch; the DAE is not trained on them.
    training = _single_stamps(grid_product["stamps"])
    validation = _single_stamps(large_product["stamps"][:100])
    images = np.concatenate([training, validation])
    # Input and target are the same stamps: noise is drawn while it trains.
    data = TrainingSet(
        images=images,
        references=images,
        fit=np.arange(len(training)),
        validation=np.arange(len(training), len(images)),
        levels=np.asarray(config.noise.levels),
        noise=noise_model(config),
        seed=config.seed,
        checkpoint=checkpoint,
    )
    store(Dae.fit(data, config.dae, config.dae_train), out, config.model_dump(), grid_product)
    checkpoint.unlink(missing_ok=True)


def network_groups(kind: str = "", **_: object) -> tuple[str, ...]:
    """Return the configuration groups of the training of one network, or of all networks.

    Parameters
    ----------
    kind : str
        Name of the network; empty for all.

    Returns
    -------
    tuple of str
        Names of groups, such as "cnn" and "train_original".
    """
    # Noise, and the settings of a DAE that is applied, only where some network needs them.
    kinds = [kind] if kind else list_trained_networks()
    noise = ["noise"] if any(ESTIMATORS[name].noisy for name in kinds) else []
    dae = ["evaluation"] if any(ESTIMATORS[name].uses_dae for name in kinds) else []
    return ("seed", *noise, *NETWORKS, *(f"train_{name}" for name in kinds), *dae)


@command("paper alignment train-network", reads=network_groups)
def train_network(
    config: Config,
    kind: Annotated[str, click.Choice(list_trained_networks())],
    states: File,
    checkpoint: Checkpoint,
    out: TrainingFolder,
    dae: DaeFolder | None = None,
) -> None:
    """Train a network that estimates states of misalignment.

    Its input is the stamps of all fields of a state, its output the four numbers of the state in
    units of the range. The folder receives weights, settings, and the history of the loss.

    With --dae the stamps are the DAE's output for noisy stamps. An interrupted training resumes
    from its checkpoint if stamps and settings are the same, and ends with the same bytes.

    Parameters
    ----------
    config : Config
        Seed, and settings of the network and its training.
    kind : str
        Clean stamps, noisy stamps, or the DAE's output for noisy stamps.
    states : Path
        Product of `alignment states`: the grid or the large set.
    checkpoint : Path
        File that lets an interrupted training resume.
    out : Path
        Folder for weights, config and history.
    dae : Path, optional
        Folder of `alignment train-dae`. For networks behind the DAE only.
    """
    from psfdae.methods.networks.training import fingerprint, progress, train
    from psfdae.methods.networks.weights import save_weights
    from psfdae_paper.alignment.networks import TrainingStates, make_training

    # Settings and training data of this kind of network.
    if ESTIMATORS[kind].uses_dae != (dae is not None):
        behind_dae = [name for name in list_trained_networks() if ESTIMATORS[name].uses_dae]
        raise click.UsageError(f"--dae goes with --kind {', '.join(behind_dae)}, and only with it")
    # Every network has a group train_NAME.
    settings: NetworkTrain = getattr(config, f"train_{kind}")
    product = read_states(states)
    if dae:
        require_origin(dae, Alignment.stamp_keys, product)
    # Stamps without noise, with noise that is drawn again in every epoch, or the DAE's output.
    data = TrainingStates(product["states"], product["stamps"])
    if ESTIMATORS[kind].noisy:
        data = replace(data, noise=noise_model(config), levels=config.noise.levels)
    if dae and data.noise:
        data = denoise_draws(data, Dae.load(dae, evaluation=config.evaluation), config, kind)
        product.arrays.clear()  # only the product's configuration is still needed
    limit_threads(settings.threads)
    # Settings that describe the network to those who load it; `load_predictor` reads them.
    fields, side = data.stamps.shape[-3], data.stamps.shape[-1]
    network_config = {**config.model_dump(), "fields": fields, "stamp_px": side, "name": kind}
    # Kind of the network, and whether estimates are averaged over mirror images.
    network_config |= {"network": settings.network, "mirrors": settings.mirrors}
    # Group of the network's layers: cnn or perceptron. All attempts start in the same way.
    network = getattr(config, settings.network)
    begin = partial(make_training, network, data, settings, config.seed, kind)
    # A checkpoint is resumed only if settings and stamps are the same.
    with progress(settings.epochs) as report:
        # The fingerprint covers stamps, and all settings that can change the result.
        identity = fingerprint(network_config | dump_deciding(config), data.stamps)
        training = train(lambda _: begin(), checkpoint, identity, report)
    # Weights first: a folder with a configuration is complete.
    save_weights(out / Estimator.weights_file, training.result, network_config)
    write_origin(out, product)
    write_text(out / HISTORY, as_csv(training.history))
    write_text(out / CONFIG, as_yaml(network_config))
    checkpoint.unlink(missing_ok=True)


def denoise_draws(data: TrainingStates, dae: Dae, config: Config, kind: str) -> TrainingStates:
    """Return states with the DAE's output for a few draws of their noise.

    Parameters
    ----------
    data : TrainingStates
        n states with noise-free stamps, and the noise to draw.
    dae : Dae
        Trained DAE.
    config : Config
        Its seed, and the number of draws among the settings of the network's training.
    kind : str
        Name of the network, for its settings and its random stream.

    Returns
    -------
    TrainingStates
        States without noise, with stamps of shape (draws, n, F, d, d).
    """
    from psfdae.methods.networks.training import use_half_precision

    assert data.noise is not None
    # A stream of the network's name: all draws of one network are different.
    rng = stream(config.seed, "cnn", "noise", kind)
    count = getattr(config, f"train_{kind}").noise_draws
    # Each state has one noise level, which is the same in all draws.
    level = draw_levels(np.asarray(data.levels), len(data.states), rng)
    dae_stamps = np.empty((count, *data.stamps.shape), np.float32)
    for draw in dae_stamps:
        # 1000 states at a time limit the memory.
        for start in range(0, len(level), 1000):
            part = slice(start, start + 1000)
            noisy = data.noise.draw(data.stamps[part], level[part], rng)
            # Errors of the states are the same as in single precision (studies/training).
            with use_half_precision():
                draw[part] = denoise(dae, noisy)
    return replace(data, stamps=dae_stamps, noise=None)


def denoise(dae: Dae, stamps: np.ndarray) -> np.ndarray:
    """Apply a trained DAE to stamps (n, F, d, d); it neither clips nor renormalises them.

    Parameters
    ----------
    dae : Dae
        Network of `alignment train-dae`.
    stamps : ndarray, shape (n, F, d, d)
        Noisy stamps of sum 1.

    Returns
    -------
    ndarray, shape (n, F, d, d), float32
    """
    return dae.predict(_single_stamps(stamps)).reshape(stamps.shape)


def _single_stamps(stamps: np.ndarray) -> np.ndarray:
    """Return the stamps of all states and fields (..., d, d) as one list, (n, d, d)."""
    return stamps.reshape(-1, *stamps.shape[-2:])


def draw_test_stamps(config: Config, stamps: np.ndarray, test_set: str, level: float) -> np.ndarray:
    """Draw the stamps of a test set at one λ, (n, F, d, d), float32; unchanged for λ = 0.

    The noise depends on seed, name of the set and λ alone: all methods get the same stamps.

    Parameters
    ----------
    config : Config
        Its seed and the group `noise`.
    stamps : ndarray, shape (n, F, d, d)
        Noise-free stamps.
    test_set : str
        Name of the set, "grid" or "uniform", part of the address of the random stream.
    level : float
        Noise level λ.

    Returns
    -------
    ndarray, shape (n, F, d, d)
        Stamps with photon and sky noise, divided by the flux of the star.
    """
    if level == 0.0:
        return stamps
    # A stream of its own for each set and level.
    rng = stream(config.seed, "alignment", "noise", test_set, f"{level:.6g}")
    return noise_model(config).draw(stamps, level, rng)


def load_predictor(
    folder: Path, states: Product, config: Config, name: str | None = None
) -> Callable[[np.ndarray], np.ndarray]:
    """Load the trained network of a folder, a function from stamps (n, F, d, d) to states (n, 4).

    It estimates the mean over the mirror images of the stamps if the network was trained so.

    Parameters
    ----------
    folder : Path
        Folder of `alignment train-network`.
    states : Product
        States whose stamps the network is to be applied to.
    config : Config
        Its group `evaluation` has the number of threads.
    name : str, optional
        Name that the network must have.

    Returns
    -------
    callable
        Function of stamps (n, F, d, d) that returns states (n, 4), in units of the range.

    Raises
    ------
    ProductError
        If the network was trained on other stamps, has another name, or is damaged.
    """
    import torch

    from psfdae.methods.networks.weights import load_network
    from psfdae_paper.alignment.networks import make_network, predict_states

    # The configuration in the folder must agree with the stamps.
    path = folder / CONFIG
    tree = read_yaml(path)
    _, fields, _, side = states["stamps"].shape
    shape = {"fields": fields, "stamp_px": side}
    require(path, tree, tuple(shape), shape, states.path)
    require_origin(folder, Alignment.stamp_keys, states)
    if name:
        require(path, tree, ("name",), {"name": name}, "the command")
    # Its settings of training and network are checked like those of a user.
    group = f"train_{from_tree(path, tree, 'name')}"
    training = from_tree(path, tree, group, make=partial(parse_settings, NetworkTrain))
    # Class of the settings of its layers.
    kind = NETWORKS[training.network]
    settings = from_tree(path, tree, training.network, make=partial(parse_settings, kind))
    # The number of threads can change the last digits.
    torch.set_num_threads(config.evaluation.threads)
    model = load_network(
        lambda: make_network(settings, fields, side), folder / Estimator.weights_file
    )
    # The field points are a centre and a circle of points; a mirror image permutes these.
    mirrors = mirror_symmetries(fields - 1) if training.mirrors else []
    return partial(predict_states, model, mirrors=mirrors)


@command("paper alignment estimate", reads=("seed", "noise", "evaluation"))
def estimate(
    config: Config,
    test_set: TestSet,
    states: StatesFile,
    dae: DaeFolder,
    networks: NetworkFolders,  # type: ignore[valid-type]  # made at run time
    out: File,
    times: File,
) -> None:
    """Estimate the states of a test set with every network.

    Each method gets the same noisy stamps at every noise level, and without noise.

    The product has the true states, the noise levels, and the estimates by level and method, all in
    units of the range; the table of run times has seconds for the whole set.

    Parameters
    ----------
    config : Config
        Seed, noise and evaluation.
    test_set : str
        Set of the states: the grid that networks are trained on, or uniform states.
    states : Path
        Product of `alignment states`.
    dae : Path
        Folder of `alignment train-dae`.
    networks : NetworkFolders
        Folder of each network, an option of its name.
    out : Path
        HDF5 product with the estimates of all networks.
    times : Path
        CSV that receives the run times.
    """
    limit_threads(config.evaluation.threads)
    product = read_states(states)
    require_origin(dae, Alignment.stamp_keys, product)
    # All networks are loaded before any is timed.
    dae_network = Dae.load(dae, evaluation=config.evaluation)
    predict = {
        name: load_predictor(folder, product, config, name)
        for name, folder in vars(networks).items()
    }
    # The same noisy stamps for all methods, with the time that each takes; λ = 0: without noise.
    levels, methods = [0.0, *config.noise.levels], list_estimators("estimates")
    # Array [λ, method, state, number].
    estimates = np.empty((len(levels), len(methods), *product["states"].shape))
    rows = []
    for row, level in enumerate(steps("noise levels", levels)):
        noisy = draw_test_stamps(config, product["stamps"], test_set, level)
        # The DAE's output, the input of several networks, and its run time.
        start_s = time.perf_counter()
        dae_psf = denoise(dae_network, noisy)
        denoising_seconds = time.perf_counter() - start_s
        # Each network, with the stamps that it was trained for.
        for column, method in enumerate(methods):
            start_s = time.perf_counter()
            estimates[row, column] = predict[method.network](dae_psf if method.uses_dae else noisy)
            # Seconds for all states of the set; the DAE is part of a method that uses it.
            seconds = time.perf_counter() - start_s + denoising_seconds * method.uses_dae
            rows.append((test_set, level, method.name, seconds, len(noisy)))
    about = f"[λ, method, state, number]; {_names(methods)}"
    columns = {"estimates": Column(estimates, "range", about)}
    key = {"test_set": test_set}
    _write_results(out, "alignment_estimates", config, key, product["states"], columns, levels)
    _write_times(times, rows)


def _names(methods: list[Estimator]) -> str:
    """Return the names of methods in the order of an array's axis, for its description."""
    return ", ".join(method.name for method in methods)


def _write_results(
    path: Path,
    kind: str,
    config: Config,
    key: Mapping[str, object],
    states: np.ndarray,
    columns: Mapping[str, Column],
    levels: Sequence[float] = (),
) -> None:
    """Write the product of a test, with the true states by which products are compared.

    Parameters
    ----------
    path : Path
        HDF5 file.
    kind : str
        Kind of the product, such as "alignment_fit".
    config : Config
        Stage configuration.
    key : mapping
        Test set, which is not part of the configuration, and noise level if there is only one.
    states : ndarray, shape (n, 4)
        True states in units of the range.
    columns : mapping of str to Column
        Results of the methods.
    levels : sequence of float
        Noise levels λ along an axis of the results; empty if there is only one.
    """
    all_columns = {"states": Column(states, "range", "true states")}
    if len(levels):
        all_columns["levels"] = Column(np.array(levels), "1", "noise levels λ")
    write_product(path, kind, {**all_columns, **columns}, {**config.model_dump(), **key})


def _write_times(path: Path, rows: Sequence[tuple[str, float, str, float, int]]) -> None:
    """Write the table of run times.

    Parameters
    ----------
    path : Path
        CSV file.
    rows : sequence of (str, float, str, float, int)
        Test set, noise level, name of the method, seconds and number of states.
    """
    columns = ["test_set", "noise_level", "method", "seconds", "states"]
    table = pd.DataFrame(rows, columns=columns)
    write_csv(path, table, digits=6)


@command(
    "paper alignment fit",
    reads=("seed", "telescope", "alignment", "optics", "noise", "fit", "evaluation"),
)
def fit_alignment_method(
    config: Config,
    test_set: TestSet,
    level: Annotated[float, AboveZero],
    states: StatesFile,
    train: File,
    model: ModelFile,
    network: Folder,
    out: File,
    times: File,
) -> None:
    """Fit the states of a test set by maximum likelihood.

    A fit begins at a network's estimate, and again at the twin of the fitted state, which has
    nearly the same stamps in focus. Flux and position of the stars are known; uniform states are
    fitted once more with both unknown.

    The product has, for each fit, the estimates in units of the range, the deviance, how many
    stamps were computed, whether it has converged, and whether the twin was better.

    Parameters
    ----------
    config : Config
        Seed, telescope, alignment, optics, noise, fit and evaluation.
    test_set : str
        Set of the states: the grid that networks are trained on, or uniform states.
    level : float
        Noise level λ.
    states : Path
        Product of `alignment states`.
    train : Path
        Product of `alignment states --set train`: states between which stamps are interpolated.
    model : Path
        Product of `alignment model`.
    network : Path
        Folder of the network whose estimate starts the fit.
    out : Path
        HDF5 product with the fits.
    times : Path
        CSV that receives the run time.
    """
    limit_threads(1)
    # States to fit, states for the emulator, the model of the wavefront, and the network.
    product, large_product = read_states(states, config), read_states(train, config)
    # Zernike coefficients of a state, quadratic in its four numbers.
    wavefronts = read_model(model, product.config, states)
    predict = load_predictor(network, product, config)
    stamps = draw_test_stamps(config, product["stamps"], test_set, level)
    # Columns of the fits, with an entry for each method.
    fits: dict[str, list[np.ndarray]] = defaultdict(list)
    rows, methods = [], list_estimators("fit", test_set)
    operator = partial(AlignmentStamps, config.telescope, config.optics, config.alignment)
    columns: dict[str, Column] = {}
    # The emulator interpolates between the stamps of the large set. The network's estimate starts
    # the first fit.
    start_s = time.perf_counter()
    large_set = large_product["states"], large_product["stamps"]
    emulator = StampEmulator(StateOptics(wavefronts, operator()), *large_set, config.fit)
    # The network's estimate is near enough to the maximum for Levenberg steps.
    start = predict(stamps)
    columns["start"] = Column(start, "range", "estimate of the network")
    for method in steps("fits", methods):
        # Flux and position of the stars are known, or parameters of the fit, too.
        optics = StateOptics(wavefronts, operator(movable=method.unknown_flux), emulator)
        exact = StateLikelihood(optics, noise_model(config), level, stamps)
        # The emulator can compute stars at their given position only.
        fast = exact if method.unknown_flux else replace(exact, stamps=emulator)
        first_fit = fast.maximise(optics.to_parameters(start), config.fit)
        # In focus, a state and its twin have nearly the same stamps: take the better fit.
        best_fit, twin_tried = refit_twins(fast, first_fit, wavefronts, config.fit)
        # The last steps use the exact optics.
        final_fit = best_fit if fast is exact else exact.maximise(best_fit.parameters, config.fit)
        # Zero if all steps were exact.
        last_evaluations = final_fit.evaluations * (fast is not exact)
        rows.append((test_set, level, method.name, time.perf_counter() - start_s, len(stamps)))
        # The next method, which has more parameters, starts from this estimate.
        start = final_fit.parameters[:, :4]
        fits["estimates"].append(start)
        # Deviance −2 ln L, with ln L = 0 for a perfect fit.
        fits["deviance"].append(-2.0 * final_fit.height)
        fits["evaluations"].append(np.array([best_fit.evaluations, last_evaluations]))
        fits["converged"].append(final_fit.has_converged)
        fits["twin_tried"].append(twin_tried)
        fits["twin_won"].append(best_fit.parameters[:, 0] != first_fit.parameters[:, 0])
    # A column for each of them, with its description.
    about = {
        "estimates": f"[method, state, number] maximum of the likelihood; {_names(methods)}",
        "deviance": "twice the log-likelihood missing to a perfect fit",
        "evaluations": "[method, (before, last step), state] stamps and derivatives computed",
        "converged": "ended by the tolerance",
        "twin_tried": "the twin was a starting point, too",
        "twin_won": "and the better one",
    }
    for name, text in about.items():
        unit = "range" if name == "estimates" else "1"
        # Arrays [method, state, …].
        columns[name] = Column(np.array(fits[name]), unit, text)
    key = {"test_set": test_set, "level": level}
    _write_results(out, "alignment_fit", config, key, product["states"], columns)
    _write_times(times, rows)


@command("paper alignment bound", reads=("telescope", "alignment", "optics", "noise"))
def bound(
    config: Config, test_set: TestSet, states: StatesFile, model: ModelFile, out: File
) -> None:
    """Bound the errors of any unbiased estimate.

    The Cramér-Rao bound is the inverse of the Fisher information that the photons of all stamps
    of a state hold about its four numbers, with flux and position of the stars known and unknown.

    The product has a covariance (4, 4) in units of the range for each bound, noise level and state.

    Parameters
    ----------
    config : Config
        Telescope, alignment, optics and noise.
    test_set : str
        Set of the states: the grid that networks are trained on, or uniform states.
    states : Path
        Product of `alignment states`.
    model : Path
        Product of `alignment model`.
    out : Path
        HDF5 product with Cramér-Rao bounds.
    """
    limit_threads(1)
    # States, the model of their wavefronts, and the noise.
    product = read_states(states, config)
    wavefronts = read_model(model, product.config, states)
    noise, levels, truth = noise_model(config), config.noise.levels, product["states"]
    # Bounds with flux and position of the stars known, or unknown: the stamps are then movable.
    methods = list_estimators("bound", test_set)
    unknown_flux = [method.unknown_flux for method in methods]
    operator = AlignmentStamps(config.telescope, config.optics, config.alignment, any(unknown_flux))
    optics = StateOptics(wavefronts, operator)
    covariances = compute_bounds(optics, noise, levels, truth, unknown_flux)
    about = f"[method, λ, state, number, number] of the bound; {_names(methods)}"
    columns = {"covariances": Column(covariances, "range^2", about)}
    _write_results(out, "alignment_bound", config, {"test_set": test_set}, truth, columns, levels)
