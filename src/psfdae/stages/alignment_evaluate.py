"""Stages of scene 3 that estimate the states of the test sets, and bound the errors.

The noise of a test set depends on seed, set and λ only, so all methods see the
same stamps and their differences are paired.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.alignment.stamps import AlignmentStamps
from psfdae.belonging import STATE_STAMPS, require, require_origin
from psfdae.estimators import CONFIG
from psfdae.files import Column, Product, read_product, write_product, write_text
from psfdae.reading import from_tree, read_yaml
from psfdae.rng import stream
from psfdae.stages.alignment import read_model
from psfdae.stages.alignment_train import CNN_WEIGHTS, denoise
from psfdae.stages.common import limit_threads, noise_model

LEARNED = ("original", "dae", "noise_trained", "dae_retrained")
"""Methods with a CNN, in the order of the product "alignment_estimates"."""

CLEAN = 0.0
"""Noise level of the rows without noise."""


def noisy_test_states(config: Any, stamps: np.ndarray, test_set: str, level: float) -> np.ndarray:
    """Stamps of a test set at one λ, shape (n, F, d, d), float32; unchanged for λ = 0."""
    if level == CLEAN:
        return stamps
    rng = stream(config.seed, "alignment", "noise", test_set, f"{level:.6g}")
    return noise_model(config).draw(stamps, level, rng)


def cnn_predictor(folder: Path, config: Any) -> Callable[[np.ndarray], np.ndarray]:
    """The trained CNN of a folder as a function from stamps (n, F, d, d) to states (n, 4).

    A CNN that was trained on mirror images sees the stamps in all of them, and
    its estimates are averaged.
    """
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
    batch = config.evaluation.batch

    def predict(stamps: np.ndarray) -> np.ndarray:
        if not mirrors:
            return predict_states(model, stamps, batch)
        # The inverse of an orthogonal matrix is its transpose.
        return np.mean(
            [predict_states(model, m.stamps(stamps), batch) @ m.state for m in mirrors], axis=0
        )

    return predict


def _size(value: Any) -> int:
    if not isinstance(value, int) or not 1 <= value <= 4096:
        raise ValueError(f"{value!r} must be a whole number from 1 to 4096")
    return value


def require_cnn(folder: Path, states: Product, name: str | None = None) -> None:
    """Refuse a CNN that does not belong to states.

    Parameters
    ----------
    folder : of the trained CNN
    states : product "alignment_states" with its stamps
    name : which CNN it must be, if that matters
    """
    _, fields, _, side = states["stamps"].shape
    said, keys = read_yaml(folder / CONFIG), ("fields", "stamp_px")
    require(folder / CONFIG, said, keys, {"fields": fields, "stamp_px": side}, states.path)
    require_origin(folder, STATE_STAMPS, states)
    if name:
        require(folder / CONFIG, said, ("name",), {"name": name}, "the command")


def learned_methods(
    config: Any, dae: Path, cnns: dict[str, Path]
) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """The methods `LEARNED` as functions from stamps to states.

    Parameters
    ----------
    config : stage config with `evaluation`
    dae : folder of the trained DAE
    cnns : folders of the CNNs original, noise_trained and dae_retrained
    """
    original, noise_trained, dae_retrained = (
        cnn_predictor(cnns[name], config) for name in ("original", "noise_trained", "dae_retrained")
    )
    return {
        "original": original,
        "dae": lambda stamps: original(denoise(dae, config, stamps)),
        "noise_trained": noise_trained,
        "dae_retrained": lambda stamps: dae_retrained(denoise(dae, config, stamps)),
    }


def estimate(
    config: Any,
    test_set: str,
    states: Path,
    dae: Path,
    cnns: dict[str, Path],
    out: Path,
    times: Path,
) -> None:
    """Estimate the states of a test set with every learned method.

    Parameters
    ----------
    config : stage config (seed, noise, evaluation)
    test_set : "uniform" or "grid"
    states : product "alignment_states"
    dae : folder of the trained DAE
    cnns : folders of the CNNs original, noise_trained and dae_retrained
    out : product "alignment_estimates"
    times : CSV, columns test_set, noise_level, method, seconds, states

    Raises
    ------
    ProductError
        If a product is damaged, or states and networks do not belong together.
    """
    import pandas as pd

    limit_threads(config.evaluation.threads)
    product = read_product(states, "alignment_states", ("states", "stamps"))
    require_origin(dae, STATE_STAMPS, product)
    for name, folder in cnns.items():
        require_cnn(folder, product, name)
    methods = learned_methods(config, dae, cnns)
    levels = [CLEAN, *config.noise.levels]
    found = np.empty((len(levels), len(LEARNED), *product["states"].shape))
    rows = []
    for row, level in enumerate(levels):
        stamps = noisy_test_states(config, product["stamps"], test_set, level)
        for column, method in enumerate(LEARNED):
            started = time.perf_counter()
            found[row, column] = methods[method](stamps)
            seconds = time.perf_counter() - started
            rows.append((test_set, level, method, seconds, len(stamps)))
    columns = {
        "states": Column(product["states"], "range", "true states"),
        "levels": Column(np.array(levels), "1", "noise levels λ"),
        "estimates": Column(found, "range", f"[λ, method, state, number]; {', '.join(LEARNED)}"),
    }
    write_product(out, "alignment_estimates", columns, _described(config, test_set))
    write_text(times, _times(pd.DataFrame(rows, columns=TIME_COLUMNS)))


TIME_COLUMNS = ["test_set", "noise_level", "method", "seconds", "states"]


def _times(table: Any) -> str:
    return str(table.to_csv(index=False, float_format="%.6g"))


def fit(
    config: Any,
    test_set: str,
    level: float,
    states: Path,
    model: Path,
    cnn: Path,
    out: Path,
    times: Path,
) -> None:
    """Fit the states of a test set by maximum likelihood, starting from a CNN.

    In focus, a state and its twin have nearly the same stamps. Where the twin of
    the first fit lies within the range it is another starting point, and the
    more likely result is kept.

    Parameters
    ----------
    config : stage config (seed, telescope, alignment, optics, noise, fit, evaluation)
    test_set : "uniform" or "grid"
    level : noise level λ, known to the fit
    states : product "alignment_states"
    model : product "alignment_model"
    cnn : folder of the CNN that starts the fit
    out : product "alignment_fit"
    times : CSV, columns test_set, noise_level, method, seconds, states

    Raises
    ------
    ProductError
        If a product is damaged, or inputs and configuration do not belong together.
    """
    import pandas as pd

    from psfdae.alignment.fit import Likelihood, fit_states, refit_twins

    limit_threads(1)
    product = read_product(states, "alignment_states", ("states", "stamps", "noll"))
    require(states, product.config, STATE_STAMPS, config)
    wavefronts = read_model(model, product.config, states)
    require_cnn(cnn, product)
    predict = cnn_predictor(cnn, config)
    stamps = noisy_test_states(config, product["stamps"], test_set, level)
    likelihood = Likelihood(wavefronts, _operator(config), noise_model(config), level)
    started = time.perf_counter()
    start = predict(stamps)
    first = fit_states(likelihood, stamps, start, config.fit)
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
    write_product(out, "alignment_fit", columns, {**_described(config, test_set), "level": level})
    row = (test_set, level, "max_likelihood", seconds, len(stamps))
    write_text(times, _times(pd.DataFrame([row], columns=TIME_COLUMNS)))


def bound(config: Any, test_set: str, states: Path, model: Path, out: Path) -> None:
    """Cramér–Rao bound of every state of a test set.

    Parameters
    ----------
    config : stage config (telescope, alignment, optics, noise)
    test_set : "uniform" or "grid"
    states : product "alignment_states"
    model : product "alignment_model"
    out : product "alignment_bound"

    Raises
    ------
    ProductError
        If a product is damaged, or inputs and configuration do not belong together.
    """
    from psfdae.alignment.fisher import bound_covariances

    limit_threads(1)
    product = read_product(states, "alignment_states", ("states",))
    require(states, product.config, STATE_STAMPS, config)
    wavefronts = read_model(model, product.config, states)
    truth, levels = product["states"], config.noise.levels
    covariances = bound_covariances(
        wavefronts, _operator(config), noise_model(config), levels, truth
    )
    columns = {
        "states": Column(truth, "range", "true states"),
        "levels": Column(np.array(levels), "1", "noise levels λ"),
        "covariances": Column(covariances, "range^2", "[λ, state, number, number] of the bound"),
    }
    write_product(out, "alignment_bound", columns, _described(config, test_set))


def _operator(config: Any) -> AlignmentStamps:
    return AlignmentStamps(config.telescope, config.optics, config.alignment)


def _described(config: Any, test_set: str) -> dict[str, Any]:
    return {**config.model_dump(), "test_set": test_set}
