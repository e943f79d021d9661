"""Stages of scene 3 that draw."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.alignment.fisher import coma_free_decentre, expected_abs_error
from psfdae.alignment.stamps import AlignmentStamps
from psfdae.alignment.telescope import design_states, fit_quadratic, zernike_tracer
from psfdae.belonging import STATE_STAMPS, require_origin
from psfdae.files import atomic_path, read_product, write_text
from psfdae.reading import read_table
from psfdae.stages.alignment_tables import read_errors, require_one_test
from psfdae.stages.common import limit_threads, noise_model

POSITIONS = np.linspace(-1.5, 1.5, 61)
"""Multiples of the state in the twin figure; −1 is the twin."""

SHOWN_STATES = 2
TWIN_TILT = (0.20, 0.25)
"""Tilts x, y of the state of the twin figure; its decentre cancels the constant coma."""

DRAWN = ("original", "dae", "noise_trained", "dae_retrained", "max_likelihood")
"""Methods that are drawn, in this order."""


def stamps(config: Any, states: Path, dae: Path, out: Path) -> None:
    """Nine stamps of a few test states before and after the DAE.

    Parameters
    ----------
    config : stage config (seed, noise, evaluation)
    states : product "alignment_states"; its first states are drawn
    dae : folder of the trained DAE
    out : PNG
    """
    from psfdae.evaluation.alignment_figures import stamp_rows
    from psfdae.stages.alignment_evaluate import noisy_test_states
    from psfdae.stages.alignment_train import denoise

    product = read_product(states, "alignment_states", ("states", "stamps"))
    require_origin(dae, STATE_STAMPS, product)
    clean = product["stamps"][:SHOWN_STATES]
    rows = [("noise-free", clean)]
    for level in config.noise.levels:
        noisy = noisy_test_states(config, product["stamps"], "uniform", level)[:SHOWN_STATES]
        rows += [(f"λ = {level:g}", noisy), ("DAE", denoise(dae, config, noisy))]
    titles = [
        "decentre ({:+.2f}, {:+.2f}), tilt ({:+.2f}, {:+.2f}) of the range".format(*state)
        for state in product["states"][:SHOWN_STATES]
    ]
    _save(stamp_rows(rows, titles), out)


def predicted(estimates: Path, fits: Sequence[Path], out: Path) -> None:
    """Estimates against the truth.

    Parameters
    ----------
    estimates : product "alignment_estimates"
    fits : products "alignment_fit" of the same states
    out : PNG
    """
    from psfdae.evaluation.alignment_figures import predicted_against_true

    require_one_test([estimates], fits, [])
    found: dict[str, dict[float, np.ndarray]] = {method: {} for method in DRAWN}
    truth = np.empty(0)
    for key, truth, states in read_errors([estimates], fits):  # noqa: B007
        if key["method"] in found and key["noise_level"] > 0:
            found[key["method"]][key["noise_level"]] = states
    _save(predicted_against_true(truth, found), out)


def errors(
    estimates: Sequence[Path], fits: Sequence[Path], bounds: Sequence[Path], out: Path
) -> None:
    """Errors against the size of the misalignment.

    Parameters
    ----------
    estimates, fits, bounds : products of one test set
    out : PNG
    """
    from psfdae.evaluation.alignment_figures import errors_against_size, size_of

    require_one_test(estimates, fits, bounds)
    curves: dict[float, dict[str, Any]] = {}
    for key, truth, states in read_errors(estimates, fits):
        if key["method"] in DRAWN and key["noise_level"] > 0:
            error = np.abs(states - truth).mean(axis=1)
            curves.setdefault(key["noise_level"], {})[key["method"]] = (size_of(truth), error)
    count = 0
    for path in bounds:
        product = read_product(path, "alignment_bound")
        size = size_of(product["states"])
        count = size.size
        for level, covariances in zip(product["levels"], product["covariances"], strict=True):
            error = expected_abs_error(covariances).mean(axis=1)
            curves[float(level)]["cramer_rao"] = (size, error)
    _save(errors_against_size(curves, f"Errors against misalignment, {count} uniform states"), out)


def twin(config: Any, table: Path, out: Path) -> None:
    """A state and its twin, in focus and with the CCD's defocus.

    The line leads through the state, the aligned telescope and the twin: tilts
    with the decentres that cancel their field-constant coma.

    Parameters
    ----------
    config : stage config (telescope, prescription, alignment, optics, noise)
    table : CSV, columns noise_level, defocus_mm, position, chi2
    out : PNG
    """
    import pandas as pd

    from psfdae.evaluation.alignment_figures import twin_ambiguity

    limit_threads(1)
    rows, shown, state = [], [], np.empty(0)
    for defocus in sorted({0.0, config.alignment.defocus_m}):
        state, line = _stamps_along(config, defocus)
        own = line[np.argmin(np.abs(POSITIONS - 1.0))].astype(np.float64)
        opposite = line[np.argmin(np.abs(POSITIONS + 1.0))]
        where = "in focus" if defocus == 0 else f"{1e3 * defocus:g} mm"
        shown += [(f"state\n{where}", own), (f"twin\n{where}", opposite)]
        for level in config.noise.levels:
            variance = noise_model(config).variance(own, level)
            chi2 = ((line - own) ** 2 / variance).sum(axis=(1, 2, 3))
            rows += [
                (level, 1e3 * defocus, position, value)
                for position, value in zip(POSITIONS, chi2, strict=True)
            ]
    curves = pd.DataFrame(rows, columns=["noise_level", "defocus_mm", "position", "chi2"])
    write_text(table, curves.to_csv(index=False, float_format="%.6g"))
    _save(twin_ambiguity(curves, shown, state), out)


def _stamps_along(config: Any, defocus_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A state and the ray-traced stamps of its multiples, with the CCD at a defocus."""
    moved = config.alignment.model_copy(update={"defocus_m": defocus_m})
    tracer = zernike_tracer(config.telescope, config.prescription, moved)
    operator = AlignmentStamps(config.telescope, config.optics, moved)
    model = fit_quadratic(design_states(), tracer(design_states()))
    tilt = np.array([TWIN_TILT])
    state = np.concatenate([coma_free_decentre(model, tilt, operator.noll), tilt], axis=1)[0]
    return state, operator(tracer(POSITIONS[:, None] * state))[0]


def correlation(table: Path, out: Path) -> None:
    """Measured and predicted correlations beside the paper's.

    Parameters
    ----------
    table : CSV `alignment_correlation.csv`
    out : PNG
    """

    from psfdae.evaluation.alignment_figures import correlation_matrices
    from psfdae.evaluation.paper import published

    ours, paper = read_table(table), published("correlation")
    ours = ours[(ours.test_set == "uniform") & (ours.noise_level > 0)]
    panels = []
    for level, rows in ours.groupby("noise_level"):
        known = paper[np.isclose(paper.noise_level, level)]
        first = [
            (f"paper, {m}, λ = {level:g}", _paper_matrix(known, m)) for m in ("original", "dae")
        ]
        first += [(f"{m}, λ = {level:g}", _matrix(rows, m)) for m in ("original", "dae")]
        second = [
            (f"{name}, λ = {level:g}", _matrix(rows, method))
            for method, name in (
                ("noise_trained", "noise-trained"),
                ("dae_retrained", "DAE, retrained"),
                ("max_likelihood", "max. likelihood"),
                ("cramer_rao_pooled", "Fisher"),
            )
        ]
        panels += [first, second]
    _save(correlation_matrices(panels), out)


def _matrix(rows: Any, method: str) -> np.ndarray:
    return rows[rows.method == method]["correlation"].to_numpy().reshape(4, 4)


def _paper_matrix(rows: Any, method: str) -> np.ndarray:
    from psfdae.evaluation.alignment_tables import PARAMETERS

    matrix = np.full((4, 4), np.nan)
    for row in rows[rows.method == method].itertuples():
        a, b = (PARAMETERS.index(name) for name in row.pair.split("-"))
        matrix[a, b] = matrix[b, a] = row.correlation
    return matrix


def _save(figure: Any, out: Path) -> None:
    with atomic_path(out) as temporary:
        figure.savefig(temporary, format="png")
