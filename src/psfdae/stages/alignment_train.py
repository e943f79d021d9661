"""Stages of scene 3 that train: the DAE on its stamps, and the CNNs that estimate states.

Three CNNs of the same architecture differ in what they are trained on: clean
stamps of the grid (the paper's, used as "original" and as "dae"), noisy stamps
of many states, and the DAE's output for noisy stamps of many states.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from psfdae.belonging import STATE_STAMPS, require, require_origin, write_origin
from psfdae.estimators import CONFIG, HISTORY, TrainingSet
from psfdae.estimators.dae import Dae
from psfdae.files import Product, as_csv, as_yaml, read_product, write_text
from psfdae.rng import stream
from psfdae.stages.common import limit_threads, noise_model
from psfdae.stars.noise import mixed_levels

if TYPE_CHECKING:
    from psfdae.alignment.cnn import TrainingStates

CNN_WEIGHTS = "cnn.safetensors"

VALIDATION_STATES = 100
"""States of the large set that choose the DAE's best epoch; it is not trained on them."""


def train_dae_stamps(config: Any, grid: Path, train: Path, out: Path, checkpoint: Path) -> None:
    """Train the DAE on the stamps of the grid with fresh noise in every epoch.

    Parameters
    ----------
    config : stage config (seed, noise, dae, dae_train)
    grid, train : products "alignment_states"; the first states of `train` validate
    out : folder that receives `dae.safetensors`, `config.yaml`, `history.csv`, and in
        `trained_on.yaml` what the grid says of itself
    checkpoint : file that lets an interrupted training resume

    Raises TrainingError as `train_dae` does, and ProductError if the
    products are of different telescopes or stamps.
    """
    on, validating = _read(grid), _read(train)
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


def train_original(config: Any, grid: Path, out: Path, checkpoint: Path) -> None:
    """Train the paper's CNN on the clean stamps of the grid.

    Parameters
    ----------
    config : stage config (seed, cnn, train_original)
    grid : product "alignment_states"
    out : folder that receives `cnn.safetensors`, `config.yaml`, `history.csv`, and in
        `trained_on.yaml` what the states say of themselves
    checkpoint : file that lets an interrupted training resume

    Raises TrainingError as `psfdae.estimators.training.train` does.
    """
    from psfdae.alignment.cnn import TrainingStates

    product = _read(grid)
    data = TrainingStates(product["states"], product["stamps"])
    _train("original", config, config.train_original, product, data, out, checkpoint)


def train_noise_trained(config: Any, train: Path, out: Path, checkpoint: Path) -> None:
    """Train a CNN on noisy stamps of many states, with fresh noise in every epoch.

    Parameters
    ----------
    config : stage config (seed, noise, cnn, train_noise_trained)
    train : product "alignment_states"
    out, checkpoint : as for `train_original`
    """
    from psfdae.alignment.cnn import TrainingStates

    noise, settings, product = noise_model(config), config.train_noise_trained, _read(train)

    def disturb(stamps: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        level = mixed_levels(np.asarray(config.noise.levels), len(stamps), rng)
        return noise.draw_gaussian(stamps, level, rng), _weights(config, settings, level)

    data = TrainingStates(product["states"], product["stamps"], disturb=disturb)
    _train("noise_trained", config, settings, product, data, out, checkpoint)


def train_dae_retrained(config: Any, train: Path, dae: Path, out: Path, checkpoint: Path) -> None:
    """Train a CNN on what the DAE makes of noisy stamps of many states.

    The DAE takes most of an epoch's time, so that the noise is drawn once.

    Parameters
    ----------
    config : stage config (seed, noise, cnn, train_dae_retrained, evaluation)
    train : product "alignment_states"
    dae : folder of the trained DAE
    out, checkpoint : as for `train_original`

    Raises
    ------
    ProductError
        If the DAE was trained on the stamps of another telescope, or of another size.
    """
    from psfdae.alignment.cnn import TrainingStates

    product = _read(train)
    require_origin(dae, STATE_STAMPS, product)
    states, stamps = product["states"], product["stamps"]
    rng = stream(config.seed, "cnn", "noise", "dae_retrained")
    level = mixed_levels(np.asarray(config.noise.levels), len(states), rng)
    denoised = denoise(dae, config, noise_model(config).draw(stamps, level, rng))
    settings = config.train_dae_retrained
    data = TrainingStates(states, denoised, weights=_weights(config, settings, level))
    _train("dae_retrained", config, settings, product, data, out, checkpoint)


def _weights(config: Any, settings: Any, level: np.ndarray) -> np.ndarray:
    """Weights of states in the loss, (n,)."""
    from psfdae.alignment.cnn import noise_weights

    if not settings.weigh_noise:
        return np.ones(len(level))
    return noise_weights(level, config.noise.levels)


def denoise(dae: Path, config: Any, stamps: np.ndarray) -> np.ndarray:
    """Output of a trained DAE for stamps (n, F, d, d), neither clipped nor renormalised."""
    network = Dae.load(dae, evaluation=config.evaluation)
    return network.predict(_flat(stamps)).reshape(stamps.shape)


def _train(
    name: str,
    config: Any,
    settings: Any,
    product: Product,
    data: TrainingStates,
    out: Path,
    checkpoint: Path,
) -> None:
    """Train one CNN and leave weights, resolved config and history in a folder."""
    from psfdae.alignment.cnn import CnnTraining
    from psfdae.estimators.training import fingerprint, progress, train
    from psfdae.estimators.weights import save_weights

    limit_threads(settings.threads)
    fields, side = data.stamps.shape[1], data.stamps.shape[-1]
    described = {**config.model_dump(), "fields": fields, "stamp_px": side, "name": name}
    described["mirrors"] = settings.mirrors

    def begin(attempt: int) -> CnnTraining:
        return CnnTraining(data, config.cnn, settings, config.seed, name)

    with progress(settings.epochs) as report:
        done = train(begin, checkpoint, fingerprint(described, data.stamps), report)
    save_weights(out / CNN_WEIGHTS, done.result, described)
    write_origin(out, product)
    write_text(out / HISTORY, as_csv(done.history))
    write_text(out / CONFIG, as_yaml(described))
    checkpoint.unlink(missing_ok=True)


def _read(path: Path) -> Product:
    return read_product(path, "alignment_states", ("states", "stamps"))


def _flat(stamps: np.ndarray) -> np.ndarray:
    return stamps.reshape(-1, *stamps.shape[-2:])
