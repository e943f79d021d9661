"""Stages of scene 3: the quadratic model, sets of states with their stamps, key figures.

Noise is drawn where it is used, as in the other scenes. The clean stamps of the
grid are what the networks are trained on; with other noise they are a test set,
too, beside the set of uniform states.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from psfdae.alignment.stamps import AlignmentStamps
from psfdae.alignment.telescope import (
    QuadraticModel,
    design_states,
    field_points,
    fit_quadratic,
    grid_states,
    uniform_states,
    verify,
    zernike_tracer,
)
from psfdae.belonging import OURS, STATE_STAMPS, STATES, require
from psfdae.files import Column, Product, read_product, write_product, write_text
from psfdae.optics.raytracing import FIRST_NOLL, ZernikeTracer
from psfdae.rng import stream
from psfdae.stages.common import limit_threads

StateSet = Literal["grid", "uniform", "train"]


def model(config: Any, out: Path) -> None:
    """Fit the quadratic model to few ray-traced states and verify it on the grid.

    Parameters
    ----------
    config : stage config (telescope, prescription, alignment)
    out : path of the HDF5 product "alignment_model"

    Raises
    ------
    RayTracingError
        If a field is vignetted.
    ModelError
        If the model differs from ray tracing by more than the tolerance.
    """
    limit_threads(1)
    tracer, design = _tracer(config), design_states()
    fitted = fit_quadratic(design, tracer(design))
    grid = grid_states(config.alignment.grid_levels)
    tolerance = config.alignment.model_tolerance_waves
    residual = verify(fitted, grid, tracer(grid), tolerance)
    columns = {
        "coefficients": Column(
            fitted.coefficients,
            "wave",
            "[field, term, Zernike]; terms 1, 4 numbers of the state, 10 products",
        ),
        "residual": Column(residual, "wave", "[state, field] RMS from ray tracing, on the grid"),
        **_geometry(config),
    }
    write_product(out, "alignment_model", columns, config.model_dump())


def read_model(path: Path, wanted: Any, whose: object = OURS) -> QuadraticModel:
    """The quadratic model of a product "alignment_model".

    Parameters
    ----------
    path : product "alignment_model"
    wanted, whose : what it must be a model of, as in `psfdae.belonging.require`
    """
    product = read_product(path, "alignment_model", ("coefficients",))
    require(path, product.config, STATES, wanted, whose)
    return QuadraticModel(product["coefficients"])


def states(config: Any, kind: StateSet, model_path: Path | None, out: Path) -> None:
    """Simulate the noise-free stamps of a set of states at all fields.

    The grid and the uniform test states are ray-traced. The many states of the
    training set come from the quadratic model if one is given.

    Parameters
    ----------
    config : stage config (seed, telescope, prescription, alignment, optics)
    kind : "grid", "uniform" or "train"
    model_path : path of the product "alignment_model", or None to trace rays
    out : path of the HDF5 product "alignment_states"

    Raises
    ------
    RayTracingError, SamplingError, EnergyError
        If a field is vignetted, the pupil grid too coarse or a stamp too small.
    ProductError
        If the model is that of another telescope or range.
    """
    limit_threads(1)  # batches run side by side, optics.threads of them
    fitted = None if model_path is None else read_model(model_path, config)
    chosen = _choose(config, kind)
    zernikes = fitted(chosen) if fitted else _tracer(config)(chosen)
    operator = AlignmentStamps(config.telescope, config.optics, config.alignment)
    stamps, energy = operator(zernikes)
    columns = {
        "states": Column(chosen, "range", "decentre x, y and tilt x, y of the secondary"),
        "stamps": Column(
            stamps.astype(np.float32, copy=False),
            "1",
            "[state, field, row, column] noise-free, sum 1; rows along +y, columns along +x",
        ),
        "zernikes": Column(zernikes, "wave", "[state, field, Zernike] lead of the wavefront"),
        "energy": Column(energy, "1", "[state, field] light inside the stamp"),
        **_geometry(config),
    }
    write_product(out, "alignment_states", columns, config.model_dump())


def _tracer(config: Any) -> ZernikeTracer:
    return zernike_tracer(config.telescope, config.prescription, config.alignment)


def _choose(config: Any, kind: StateSet) -> np.ndarray:
    alignment = config.alignment
    if kind == "grid":
        return grid_states(alignment.grid_levels)
    count = {"uniform": alignment.test_states, "train": alignment.train_states}[kind]
    return uniform_states(count, stream(config.seed, "alignment", "states", kind))


def _geometry(config: Any) -> dict[str, Column]:
    alignment = config.alignment
    fields = field_points(alignment.field_radius_deg, alignment.field_points)
    noll = np.arange(FIRST_NOLL, alignment.highest_zernike + 1)
    return {
        "fields": Column(fields, "rad", "field angle (x, y)"),
        "noll": Column(noll, "1", "Noll index of every Zernike coefficient"),
        "unit": Column(alignment.unit, "m, m, rad, rad", "range of the state's four numbers"),
    }


def telescope(config: Any, model_path: Path, grid: Path, uniform: Path, out: Path) -> None:
    """Key figures of telescope, model and stamps as a table.

    Parameters
    ----------
    config : stage config (telescope, alignment)
    model_path : product "alignment_model"
    grid, uniform : products "alignment_states"
    out : CSV, columns quantity, value, unit

    Raises
    ------
    ProductError
        If products and configuration do not belong together.
    """
    import pandas as pd

    fitted = read_product(model_path, "alignment_model")
    sets = {
        name: read_product(path, "alignment_states", ("energy", "stamps"))
        for name, path in (("grid", grid), ("uniform", uniform))
    }
    require(model_path, fitted.config, STATES, config)
    for product in sets.values():
        require(product.path, product.config, STATE_STAMPS, config)
    pixel = config.telescope.pixel
    rows = [
        ("pixel", pixel, "lambda/D"),
        ("lambda_over_d", config.telescope.pixel_scale_arcsec / pixel, "arcsec"),
        *_model_figures(fitted),
    ]
    for name, product in sets.items():
        peak = product["stamps"].max(axis=(2, 3))
        rows += [
            (f"energy_least_{name}", product["energy"].min(), "1"),
            (f"energy_mean_{name}", product["energy"].mean(), "1"),
            (f"peak_least_{name}", peak.min(), "1"),
            (f"peak_greatest_{name}", peak.max(), "1"),
            (f"stamps_{name}", product["energy"].size, "1"),
        ]
    table = pd.DataFrame(rows, columns=["quantity", "value", "unit"])
    write_text(out, table.to_csv(index=False, float_format="%.6g"))


def _model_figures(fitted: Product) -> list[tuple[str, float, str]]:
    """How well the model fits, the aligned defocus, how well the states are separated."""
    coefficients, residual, noll = (fitted[k] for k in ("coefficients", "residual", "noll"))
    sensitivity = np.moveaxis(coefficients[:, 1:5], 1, -1).reshape(-1, 4)
    defocus = coefficients[:, 0, noll == 4][:, 0]
    return [
        ("model_rms", float(np.sqrt((residual**2).mean())), "wave"),
        ("model_rms_greatest", float(residual.max()), "wave"),
        ("model_states", float(len(design_states())), "1"),
        ("defocus_centre", float(defocus[0]), "wave"),
        ("defocus_edge", float(defocus[1:].mean()), "wave"),
        ("sensitivity_condition", float(np.linalg.cond(sensitivity)), "1"),
    ]
