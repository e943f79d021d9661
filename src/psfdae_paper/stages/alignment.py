"""Stages of scene 3: quadratic model of the wavefront, states with their stamps, key figures.

Input: the configuration of telescope, prescription and states. Outputs: the products
"alignment_model" and "alignment_states", which all other stages of the scene read, and a table of
key figures.

Products have noise-free stamps; noise is drawn by the stages that need it. The stamps of the grid
are the training set of the networks and, with other noise, one of two test sets. The other test set
has uniform states.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd

from psfdae.base.belonging import require
from psfdae.base.files import Column, Product, read_product, write_csv, write_product
from psfdae.base.options import File
from psfdae.base.rng import stream
from psfdae.base.settings import Group
from psfdae.base.threads import limit_threads
from psfdae.optics.wavefronts import FIRST_NOLL
from psfdae_paper.alignment.stamps import AlignmentStamps
from psfdae_paper.alignment.telescope import (
    QuadraticModel,
    StateTracer,
    design_states,
    field_points,
    fit_quadratic,
    grid_states,
    uniform_states,
    verify,
)
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.schema import Config

ModelFile = Annotated[File, "Product of `alignment model`."]
StatesFile = Annotated[File, "Product of `alignment states`."]
TestSet = Annotated[Literal["grid", "uniform"], {"flag": "--set"}]


@command("paper alignment model", reads=("telescope", "prescription", "alignment"))
def model(config: Config, out: File) -> None:
    """Fit the quadratic model to few ray-traced states, verify it on the grid.

    Rays through the misaligned telescope give the Zernike coefficients at all fields. They are
    fitted as quadratic functions of the four numbers of a state: 25 states determine the model,
    and all states of the grid test it. It is an error if the model is off by more than
    alignment.model_tolerance_waves anywhere.

    The product has the coefficients in waves for each field, and the RMS residual from ray tracing
    for each state of the grid and field.

    Parameters
    ----------
    config : Config
        Telescope, prescription and alignment.
    out : Path
        HDF5 product with the quadratic model of the wavefront.
    """
    # Few small arrays: threads would not help.
    limit_threads(1)
    # 25 states of a central composite design determine all terms of the model.
    tracer = StateTracer(config.telescope, config.prescription, config.alignment)
    design = design_states()
    quadratic = fit_quadratic(design, tracer(design))
    # The grid, with other states, tests it: no wavefront may differ by more than the tolerance.
    grid = grid_states(config.alignment.grid_levels)
    residual = verify(quadratic, grid, tracer(grid), config.alignment.model_tolerance_waves)
    # The product has the residual, too: it is the model's error.
    columns = {
        "coefficients": Column(
            quadratic.coefficients,
            "wave",
            "[field, term, Zernike]; terms 1, 4 numbers of the state, 10 products",
        ),
        "residual": Column(residual, "wave", "[state, field] RMS from ray tracing, on the grid"),
        **_geometry(config),
    }
    write_product(out, "alignment_model", columns, config.model_dump())


def read_model(
    path: Path, expected_config: Mapping[str, Any] | Group, owner: object = "the configuration"
) -> QuadraticModel:
    """Read the quadratic model of a product.

    Parameters
    ----------
    path : Path
        HDF5 product of `alignment model`.
    expected_config : mapping or Group
        Configuration with which the telescope and states of the product must agree.
    owner : object
        Name of that configuration's file, for error messages.

    Returns
    -------
    QuadraticModel
        Function of states (n, 4), in units of their range, to Zernike coefficients (n, F, Z) in
        waves at the F fields.

    Raises
    ------
    ProductError
        If the product is missing or damaged, or does not agree.
    """
    # The wavefront of a state depends on the telescope's optics and on the range of the states.
    product = read_product(path, "alignment_model", ("coefficients",))
    require(path, product.config, Alignment.wavefront_keys, expected_config, owner)
    return QuadraticModel(product["coefficients"])


def read_states(
    path: Path,
    expected_config: Mapping[str, Any] | Group | None = None,
    owner: object = "the configuration",
) -> Product:
    """Read the columns `states` and `stamps` of a product of `alignment states`.

    Parameters
    ----------
    path : Path
        HDF5 product of `alignment states`.
    expected_config : mapping or Group, optional
        Configuration with which telescope, range and stamps of the product must agree.
    owner : object
        Name of that configuration's file, for error messages.

    Returns
    -------
    Product
        `states` (n, 4) in units of the range; `stamps` (n, F, d, d), noise-free, each of sum 1.

    Raises
    ------
    ProductError
        If the product is missing or damaged, or does not agree.
    """
    product = read_product(path, "alignment_states", ("states", "stamps"))
    if expected_config is not None:
        require(path, product.config, Alignment.stamp_keys, expected_config, owner)
    return product


@command("paper alignment states", reads=Alignment.state_groups)
def states(
    config: Config,
    kind: Annotated[Literal["grid", "uniform", "train"], {"flag": "--set"}],
    out: File,
    model: File | None = None,
) -> None:
    """Simulate the noise-free stamps of a set of states.

    The set is the grid of the paper, the uniform states of the independent test, or the many
    uniform states that networks are trained on. Each state has a stamp at every field, centred on
    its centroid, of light 1.

    Wavefronts come from traced rays or, with --model, from the quadratic model, which takes less
    time. The product also has the Zernike coefficients in waves, and the light inside each stamp.

    Parameters
    ----------
    config : Config
        Telescope, prescription, alignment and optics.
    kind : str
        Set of states: the paper's grid, uniform states for the test, or many for the training.
    out : Path
        HDF5 product with states and their noise-free stamps.
    model : Path, optional
        Product of `alignment model`: take wavefronts from it instead of tracing rays.
    """
    limit_threads(1)  # optics.threads batches run in parallel
    alignment = config.alignment
    quadratic = None if model is None else read_model(model, config)
    # The grid is fixed; other states are random, from a stream of the set's name.
    if kind == "grid":
        state_set = grid_states(alignment.grid_levels)
    else:
        count = alignment.test_states if kind == "uniform" else alignment.train_states
        state_set = uniform_states(count, stream(config.seed, "alignment", "states", kind))
    # Wavefronts by the quadratic model, or by rays; then stamps of all fields.
    wavefronts = quadratic or StateTracer(config.telescope, config.prescription, alignment)
    zernikes = wavefronts(state_set)
    stamps, energy = AlignmentStamps(config.telescope, config.optics, alignment)(zernikes)
    columns = {
        "states": Column(state_set, "range", "decentre x, y and tilt x, y of the secondary"),
        "stamps": Column(
            stamps.astype(np.float32, copy=False),
            "1",
            "[state, field, row, column] noise-free, sum 1; rows along +y, columns along +x",
        ),
        "zernikes": Column(zernikes, "wave", "[state, field, Zernike] lead of the wavefront"),
        "energy": Column(energy, "1", "[state, field] light inside the stamp"),
        # Axes of the arrays: fields, Zernike terms, units of the state.
        **_geometry(config),
    }
    write_product(out, "alignment_states", columns, config.model_dump())


def _geometry(config: Config) -> dict[str, Column]:
    """Return the columns that explain the axes of arrays.

    They are field angles in radians, Noll indices of the Zernike coefficients, and the range of
    the four numbers of a state in metres and radians.

    Returns
    -------
    dict of Column
        `fields` (F, 2), `noll` (Z,) and `unit` (4,).
    """
    alignment = config.alignment
    fields = field_points(alignment.field_radius_deg, alignment.field_points)
    # Noll's numbering of the Zernike polynomials; piston and tilt do not blur a centred stamp.
    noll = np.arange(FIRST_NOLL, alignment.highest_zernike + 1)
    return {
        "fields": Column(fields, "rad", "field angle (x, y)"),
        "noll": Column(noll, "1", "Noll index of every Zernike coefficient"),
        "unit": Column(alignment.unit, "m, m, rad, rad", "range of the state's four numbers"),
    }


@command("paper alignment telescope", reads=("telescope", "alignment"))
def telescope(config: Config, model: ModelFile, grid: File, uniform: File, out: File) -> None:
    """Tabulate key figures of telescope, model and stamps.

    The figures are the error of the model, the defocus of the telescope, the condition number of
    the four numbers of a state in the images, and the light inside the stamps.

    A row has a quantity, its value and its unit. Products of another telescope are rejected.

    Parameters
    ----------
    config : Config
        Telescope and alignment, with which all products must agree.
    model : Path
        Product of `alignment model`.
    grid : Path
        Product of `alignment states --set grid`.
    uniform : Path
        Product of `alignment states --set uniform`.
    out : Path
        CSV with key figures.
    """
    # The model and the two test sets must belong to the configured telescope.
    quadratic = read_product(model, "alignment_model")
    require(model, quadratic.config, Alignment.wavefront_keys, config)
    sets = {"grid": read_states(grid, config), "uniform": read_states(uniform, config)}
    # Arrays [field, term, Zernike], [state, field], [Zernike].
    coefficients, residual, noll = (quadratic[k] for k in ("coefficients", "residual", "noll"))
    # Linear terms as a matrix from the four numbers of a state to all Zernike terms of all fields:
    # its condition number measures how well states can be separated.
    sensitivity = np.moveaxis(coefficients[:, 1:5], 1, -1).reshape(-1, 4)
    # Defocus (Noll 4) of the aligned telescope in each field; the first field is the centre.
    defocus = coefficients[:, 0, noll == 4][:, 0]
    # Width of a pixel in λ/D: up to 1/2 an image is sampled without aliasing.
    pixel = config.telescope.pixel
    rows = [
        ("pixel", pixel, "lambda/D"),
        ("lambda_over_d", config.telescope.pixel_scale_arcsec / pixel, "arcsec"),
        ("model_rms", np.sqrt((residual**2).mean()), "wave"),
        ("model_rms_greatest", residual.max(), "wave"),
        ("model_states", len(design_states()), "1"),
        ("defocus_centre", defocus[0], "wave"),
        ("defocus_edge", defocus[1:].mean(), "wave"),
        ("sensitivity_condition", np.linalg.cond(sensitivity), "1"),
    ]
    # Light inside the stamps, and their brightest pixels, both as fractions of the light.
    for name, product in sets.items():
        energy, peak = product["energy"], product["stamps"].max(axis=(2, 3))
        rows += [
            (f"energy_least_{name}", energy.min(), "1"),
            (f"energy_mean_{name}", energy.mean(), "1"),
            (f"peak_least_{name}", peak.min(), "1"),
            (f"peak_greatest_{name}", peak.max(), "1"),
            (f"stamps_{name}", energy.size, "1"),
        ]
    # One row for each quantity, with its unit.
    table = pd.DataFrame(rows, columns=["quantity", "value", "unit"])
    write_csv(out, table, digits=6)
