"""Stages of scene 3 that turn estimates, fits and bounds into tables and figures.

Inputs: the products of `psfdae_paper.stages.alignment_methods`. They are read in one place,
`read_results`, which rejects products of different telescopes, noise or states. Outputs: tables of
errors and of their correlations, compared with the paper's, run times, and figures.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd

from psfdae.base.belonging import require, require_origin
from psfdae.base.figures import write_png
from psfdae.base.files import Product, ProductError, read_product, write_csv
from psfdae.base.options import File, Folder
from psfdae.base.reading import read_table
from psfdae.base.threads import limit_threads
from psfdae.methods.dae import Dae
from psfdae.training.star_sets import noise_model
from psfdae_paper.alignment.likelihood import compute_mean_abs_error
from psfdae_paper.alignment.stamps import AlignmentStamps
from psfdae_paper.alignment.telescope import (
    DEGREES_OF_FREEDOM,
    StateTracer,
    coma_free_decentre,
    design_states,
    fit_quadratic,
)
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.estimators import ESTIMATORS, Estimator, list_estimators
from psfdae_paper.configuration.schema import Config
from psfdae_paper.evaluation import alignment_figures, alignment_tables, readable
from psfdae_paper.evaluation.paper import read_published
from psfdae_paper.evaluation.readable import Note
from psfdae_paper.stages.alignment import StatesFile, read_states
from psfdae_paper.stages.alignment_methods import DaeFolder, denoise, draw_test_stamps

Estimates = Annotated[tuple[File, ...], "Product of `alignment estimate`."]
Fits = Annotated[tuple[File, ...], "Product of `alignment fit`.", {"flag": "--fit"}]
Bounds = Annotated[tuple[File, ...], "Product of `alignment bound`.", {"flag": "--bound"}]
ErrorTable = Annotated[File, "CSV of `alignment tables`."]
Png = Annotated[File, "PNG."]


def read_results(
    estimates: Sequence[Path], fits: Sequence[Path], bounds: Sequence[Path]
) -> Iterator[tuple[dict[str, Any], np.ndarray, np.ndarray, bool]]:
    """Read the results of all methods and noise levels, from products of one test.

    There is one result for each method and noise level, in the order of the products.

    Parameters
    ----------
    estimates, fits, bounds : sequence of Path
        Products of `alignment estimate`, `alignment fit` and `alignment bound`.

    Yields
    ------
    key : dict
        test_set, noise_level and method.
    truth : ndarray, shape (n, 4)
        True states, in units of the range.
    values : ndarray, shape (n, 4) or (n, 4, 4)
        Estimated states or, of a bound, covariances of unbiased estimates.
    is_bound : bool
        Whether `values` are covariances of a bound.

    Raises
    ------
    ProductError
        If products differ in telescope, noise or states.
    """
    for product in read_products(estimates, fits, bounds):
        truth, test_set = product["states"], product.config["test_set"]
        kind = product.kind.removeprefix("alignment_")
        names = [estimator.name for estimator in list_estimators(kind, test_set)]
        # Noise levels, and results as an array [λ, method, state, ...].
        if kind == "bound":
            levels, results = product["levels"], product["covariances"].swapaxes(0, 1)
        elif kind == "fit":
            # A product of maximum-likelihood fits has one noise level.
            levels, results = np.array([product.config["level"]]), product["estimates"][None]
        else:
            # The networks, and the constant estimate of the aligned telescope, which is 0.
            names = ["constant", *names]
            levels = product["levels"]
            results = np.pad(product["estimates"], ((0, 0), (1, 0), (0, 0), (0, 0)))
        for level, by_method in zip(levels, results, strict=True):
            for name, values in zip(names, by_method, strict=True):
                key = {"test_set": test_set, "noise_level": float(level), "method": name}
                yield key, truth, values, kind == "bound"


def read_products(
    estimates: Sequence[Path], fits: Sequence[Path], bounds: Sequence[Path]
) -> list[Product]:
    """Read products, which must agree in telescope, noise and states.

    Parameters
    ----------
    estimates, fits, bounds : sequence of Path
        Products of `alignment estimate`, `alignment fit` and `alignment bound`.

    Returns
    -------
    list of Product
        In this order, each with the column `states`.

    Raises
    ------
    ProductError
        With the first value that differs between two products.
    """
    same_keys = ("noise.kappa", "noise.background_photons", *Alignment.stamp_keys)
    products: list[Product] = []
    for kind, paths in (("estimates", estimates), ("fit", fits), ("bound", bounds)):
        for path in paths:
            product = read_product(path, f"alignment_{kind}", ("states",))
            # Bounds do not depend on drawn noise, and so not on the seed.
            keys = same_keys if kind == "bound" else ("seed", *same_keys)
            # Compare with all products before; sets of the same name must have the same states.
            for reference in products:
                require(path, product.config, keys, reference.config, reference.path)
                if product.config["test_set"] == reference.config["test_set"]:
                    states, truth = _name_states(product), _name_states(reference)
                    require(path, states, tuple(states), truth, reference.path)
            products.append(product)
    return products


def _name_states(product: Product) -> dict[str, object]:
    """Return the number of a product's true states, and each state by its number, for messages."""
    states = product["states"].tolist()
    return {"number of states": len(states)} | {f"state {i}": s for i, s in enumerate(states)}


@command("paper alignment tables")
def tables(
    states: StatesFile,
    estimates: Estimates,
    fits: Fits,
    bounds: Bounds,
    errors: File,
    correlation: File,
) -> None:
    """Tabulate errors and their correlations.

    A row of the errors has the mean absolute error, the bias and the variance of a method in one
    of the four numbers of a state, at one noise level; rows of the Cramér-Rao bound have expected
    values.

    Errors are in units of the range, and in metres and radians. Rows of correlations have the
    measured coefficient of each pair of numbers, or the coefficient that the bound predicts.

    Parameters
    ----------
    states : Path
        Product of `alignment states`, for the range of the four numbers.
    estimates : sequence of Path
        Product of `alignment estimate`.
    fits : sequence of Path
        Product of `alignment fit`.
    bounds : sequence of Path
        Product of `alignment bound`.
    errors : Path
        CSV that receives the errors.
    correlation : Path
        CSV that receives their correlations.
    """
    product = read_product(states, "alignment_states", ("unit",))
    for path in bounds:
        # A bound must belong to the telescope whose states are tabulated.
        bound_config = read_product(path, "alignment_bound", ()).config
        require(path, bound_config, Alignment.stamp_keys, product.config, states)
    unit = product["unit"]
    # Measured errors, and errors of unbiased estimates at the bound.
    error_rows: list[alignment_tables.Row] = []
    correlation_rows: list[alignment_tables.Row] = []
    for key, truth, values, is_bound in read_results(estimates, fits, bounds):
        if is_bound:
            error_rows += alignment_tables.tabulate_bounds(key, values, unit)
            # Correlations are predicted by the bound with flux and position known.
            if key["method"] == "cramer_rao":
                correlation_rows += alignment_tables.tabulate_bound_correlations(key, values)
        else:
            error = values - truth
            error_rows += alignment_tables.tabulate_errors(key, error, unit)
            if key["method"] != "constant":
                correlations = alignment_tables.correlate_errors(error)
                correlation_rows += alignment_tables.tabulate_correlations(key, *correlations)
    # Rows by test set, noise level, and the order in which methods are listed.
    for path, rows in ((errors, error_rows), (correlation, correlation_rows)):
        frame = pd.DataFrame(rows)
        frame["method"] = pd.Categorical(frame["method"], list(ESTIMATORS))
        # A stable sort keeps the order of the parameters.
        write_csv(path, frame.sort_values(["test_set", "noise_level", "method"], kind="stable"))


@command("paper alignment paper-tables")
def alignment_paper_tables(
    errors: ErrorTable, correlation: ErrorTable, out: Folder, page: File, note: Note = ""
) -> None:
    """Compare measured errors with the paper's tables.

    One table for each noise level of the paper, and one of correlations, as CSV, Markdown and
    LaTeX, and all of them as a page for readers.

    Files are named alignment_paper_LEVEL and alignment_paper_correlation, with errors in units of
    the range. It is an error if a noise level of the paper was not measured.

    Parameters
    ----------
    errors : Path
        CSV of `alignment tables` with the errors.
    correlation : Path
        CSV of `alignment tables` with their correlations.
    out : Path
        Folder of the tables.
    page : Path
        HTML page with all tables.
    note : str
        How the run differs from the paper's.
    """
    test_sets = (
        "Test set grid: the very states that the networks were trained on, with new noise; "
        "uniform: other states of the same range."
    )
    texts = {}

    def add(name: str, table: pd.DataFrame, title: str, digits: dict[str, str]) -> None:
        path = out / f"alignment_paper_{name}.csv"
        write_csv(path, table, digits=6)
        texts[path] = f"{title}. {test_sets}", alignment_tables.format_table(table, digits)

    # One table of errors for each of the paper's noise levels.
    error_table = read_table(errors)
    for level in sorted(read_published("alignment").noise_level.unique()):
        if not np.isclose(error_table.noise_level, level).any():
            raise ProductError(f"{errors}: no rows of noise level {level:g}")
        # Mean and variance of the absolute errors, as in the paper.
        title = f"Absolute errors in units of the range, λ = {level:g}"
        digits = {"mean": ".4f", "variance": ".2e"}
        add(f"{level:g}", alignment_tables.compare_errors(error_table, level), title, digits)
    # Correlations of signed errors between pairs of parameters.
    table = alignment_tables.compare_correlations(read_table(correlation))
    add("correlation", table, "Correlations of signed errors", {"": ".3f"})
    readable.write_tables(texts, page, note)


@command("paper alignment time-table")
def time_table(
    times: tuple[File, ...],
    histories: Annotated[tuple[str, ...], {"flag": "--history", "metavar": "NAME=FILE"}],
    out: File,
) -> None:
    """Tabulate the run times of the methods.

    A row has the seconds of an estimate, and the seconds of all trainings that the method needs.

    Seconds per estimate are means over all states of all test sets; NAME of --history is the name
    of a network, or dae.

    Parameters
    ----------
    times : sequence of Path
        CSV of `alignment estimate` or `alignment fit`.
    histories : sequence of str
        History of a training, by name of the network.
    out : Path
        CSV with the cost of an estimate and of the trainings.
    """
    # Seconds of each training, from the last row of its history.
    pairs = (text.partition("=") for text in histories)
    training = {name: float(read_table(Path(path))["seconds"].iloc[-1]) for name, _, path in pairs}
    # Seconds and states of each method, over all test sets and noise levels.
    table = pd.concat([read_table(path) for path in times], ignore_index=True)
    # Seconds per state from sums, so that large sets have more weight.
    total = table.groupby("method")[["seconds", "states"]].sum()
    rows = []
    # Time of an estimate, and of the trainings that it needs.
    for method in (a for a in ESTIMATORS.values() if a.network):
        seconds, states = total.loc[method.name].to_numpy()
        # The trainings of all networks that the method needs.
        networks = [method.network, *(["dae"] if method.uses_dae else [])]
        training_seconds = sum(training[name] for name in networks)
        rows.append((method.name, seconds / states, int(states), training_seconds))
    columns = ["method", "seconds_per_state", "states", "training_seconds"]
    write_csv(out, pd.DataFrame(rows, columns=columns), digits=4)


@command("paper alignment figure stamps", reads=("seed", "noise", "evaluation"))
def figure_stamps(config: Config, states: StatesFile, dae: DaeFolder, out: Png) -> None:
    """Draw the nine stamps of a few states before and after the DAE.

    The first two states of the set are shown, without noise and at every noise level.

    They have the same noise as in the tables. The DAE must be trained on stamps of the same
    telescope.
    """
    # The DAE must be trained on stamps of this telescope.
    product = read_states(states)
    require_origin(dae, Alignment.stamp_keys, product)
    network = Dae.load(dae, evaluation=config.evaluation)
    # The first two states, with the noise that they have in the test set.
    rows = [("noise-free", product["stamps"][:2])]
    for level in config.noise.levels:
        # Noise is drawn for the whole set, so that these two have the noise of the tables.
        noisy = draw_test_stamps(config, product["stamps"], "uniform", level)[:2]
        rows += [(f"λ = {level:g}", noisy), ("DAE", denoise(network, noisy))]
    titles = [
        "decentre ({:+.2f}, {:+.2f}), tilt ({:+.2f}, {:+.2f}) of the range".format(*state)
        for state in product["states"][:2]
    ]
    write_png(alignment_figures.draw_stamp_rows(rows, titles), out)


@command("paper alignment figure predicted")
def figure_predicted(
    estimates: File, fits: Annotated[tuple[File, ...], {"flag": "--fit"}], out: Png
) -> None:
    """Draw estimates against the truth, for each method, number of a state and noise level.

    A row of panels is a method, a column a number of the state, both axes in units of the range;
    points on the diagonal are exact. Bounds and fits with unknown flux are left out.

    Parameters
    ----------
    estimates : Path
        Product of `alignment estimate`.
    fits : sequence of Path
        Product of `alignment fit` of the same states.
    out : Path
        PNG.
    """
    # Estimated states of each method and noise level.
    by_method: dict[str, dict[float, np.ndarray]] = {
        name: {} for name, estimator in ESTIMATORS.items() if estimator.is_drawn
    }
    for key, truth, states, _ in read_results([estimates], fits, []):  # noqa: B007
        if key["method"] in by_method and key["noise_level"] > 0:
            by_method[key["method"]][key["noise_level"]] = states
    # All products have the same states, so that the last truth belongs to all.
    write_png(alignment_figures.draw_predictions(truth, by_method), out)


@command("paper alignment figure errors")
def figure_errors(estimates: Estimates, fits: Fits, bounds: Bounds, out: Png) -> None:
    """Draw errors against the size of the misalignment, with the Cramér-Rao bound.

    The error of a state is the mean of the absolute errors of its four numbers.

    A panel is a noise level, and a curve a mean over states of about the same size, all in units of
    the range. The bound assumes normal errors, whose mean modulus is σ √(2/π).
    """
    # Mean error of the four numbers of each state, measured and of an unbiased estimate.
    curves: dict[float, dict[str, np.ndarray]] = defaultdict(dict)
    for key, truth, values, is_bound in read_results(estimates, fits, bounds):
        is_shown = ESTIMATORS[key["method"]].is_drawn or key["method"] == "cramer_rao"
        if key["noise_level"] > 0 and is_shown:
            # A bound gives the variance: E|x| = σ √(2/π) for a normal error.
            error = compute_mean_abs_error(values) if is_bound else np.abs(values - truth)
            curves[key["noise_level"]][key["method"]] = error.mean(axis=1)
    write_png(alignment_figures.draw_errors_by_size(truth, curves), out)


@command("paper alignment figure costs")
def figure_costs(errors: ErrorTable, times: File, out: Png) -> None:
    """Draw errors over the Cramér-Rao bound against the time of training and of an estimate.

    Errors are of uniform states; of estimates with unknown flux, the bound has unknown flux, too.

    Parameters
    ----------
    errors : Path
        CSV of `alignment tables` with the errors.
    times : Path
        CSV of `alignment time-table`.
    out : Path
        PNG.
    """
    write_png(alignment_figures.draw_costs(read_table(errors), read_table(times)), out)


@command(
    "paper alignment figure twin",
    reads=("telescope", "prescription", "alignment", "optics", "noise"),
)
def figure_twin(config: Config, table: File, out: Png) -> None:
    """Draw how far a state and its twin differ in their stamps, at several positions of the CCD.

    The distance is √χ² between the stamps of a state and of its multiples; the multiple −1 is its
    twin. It is drawn for all multiples in focus and at the CCD's defocus; for the twin at further
    positions of the CCD, up to twice this defocus.

    The table has a row for each noise level, defocus and multiple. The stamps of the state, and
    their differences from the twin's, are shown below the curves.

    Parameters
    ----------
    config : Config
        Telescope, prescription, alignment, optics and noise.
    table : Path
        CSV that receives the curves.
    out : Path
        PNG.
    """
    # Multiples of a state form a line through the state, the aligned telescope and the twin. The
    # decentre of the state cancels the field-constant coma of its tilt.
    limit_threads(1)
    multiples, own_defocus = np.linspace(-1.5, 1.5, 61), config.alignment.defocus_m
    rows, pairs, state = [], [], np.empty(0)
    # Positions of the CCD from the focus to twice its own, which is the middle one.
    for defocus in np.unique(own_defocus * np.linspace(0.0, 2.0, 9)):
        has_curve = defocus in (0.0, own_defocus)
        factors = multiples if has_curve else np.array([-1.0, 1.0])
        state, line_stamps = _trace_multiples(config, defocus, factors)
        # The multiple 1 is the state, −1 its twin.
        state_stamps = line_stamps[np.argmin(np.abs(factors - 1.0))].astype(np.float64)
        difference = line_stamps - state_stamps
        if has_curve:
            focus = "in focus" if defocus == 0 else f"{1e3 * defocus:g} mm"
            variance = noise_model(config).variance(state_stamps, config.noise.levels[0])
            twin_difference = difference[np.argmin(np.abs(factors + 1.0))] / np.sqrt(variance)
            pairs.append((focus, state_stamps, twin_difference))
        else:
            factors, difference = factors[:1], difference[:1]
        # χ² = Σ (difference)² / variance over all pixels of all stamps, for each multiple.
        for level in config.noise.levels:
            variance = noise_model(config).variance(state_stamps, level)
            chi2 = (difference**2 / variance).sum(axis=(1, 2, 3))
            rows += [
                (level, 1e3 * defocus, multiple, value)
                for multiple, value in zip(factors, chi2, strict=True)
            ]
    curves = pd.DataFrame(rows, columns=["noise_level", "defocus_mm", "position", "chi2"])
    write_csv(table, curves, digits=6)
    write_png(alignment_figures.draw_twins(curves, pairs, state), out)


def _trace_multiples(
    config: Config, defocus_m: float, multiples: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ray-trace the stamps of multiples of a state whose decentre cancels the coma of its tilt.

    Parameters
    ----------
    config : Config
        Stage configuration of `alignment figure twin`.
    defocus_m : float
        Distance of the CCD behind best focus, in metres.
    multiples : ndarray, shape (n,)
        Factors of the state.

    Returns
    -------
    state : ndarray, shape (4,)
        The state in units of the range.
    stamps : ndarray, shape (len(multiples), F, d, d)
        Stamps of multiples of the state, with the CCD at a defocus of `defocus_m` metres.
    """
    # The telescope with another defocus, its wavefront, and its stamps.
    settings = config.alignment.model_copy(update={"defocus_m": defocus_m})
    tracer = StateTracer(config.telescope, config.prescription, settings)
    operator = AlignmentStamps(config.telescope, config.optics, settings)
    model = fit_quadratic(design_states(), tracer(design_states()))
    # A moderate misalignment inside the range, for which the twin is inside, too.
    tilt = np.array([(0.20, 0.25)])  # x, y in units of the range
    state = np.concatenate([coma_free_decentre(model, tilt), tilt], axis=1)[0]
    return state, operator(tracer(multiples[:, None] * state))[0]


@command("paper alignment figure correlation")
def figure_correlation(correlation: ErrorTable, out: Png, note: Note = "") -> None:
    """Draw measured and predicted correlations of errors, and the paper's.

    A panel is the matrix of the correlations between the four numbers of a state.

    Pairs that the paper does not print are empty. Only uniform states with noise are shown, for
    methods with a short title.
    """

    def panel(method: Estimator, rows: pd.DataFrame, source: str = "") -> tuple[str, np.ndarray]:
        """Return title and symmetric matrix of a method, from rows of pairs of parameters."""
        # Pairs that the paper does not print stay empty.
        matrix = np.full((4, 4), np.nan)
        # A row has one pair of parameters; the matrix is symmetric.
        pairs = rows[rows.method == method.name]
        for pair, value in zip(pairs.pair, pairs.correlation, strict=True):
            a, b = (DEGREES_OF_FREEDOM.index(name) for name in pair.split("-"))
            matrix[a, b] = matrix[b, a] = value
        return f"{source}{method.short}, λ = {level:g}", matrix

    # Correlations of uniform states with noise, and the paper's; both as rows of pairs.
    table, paper = read_table(correlation), read_published("correlation")
    table = table[(table.test_set == "uniform") & (table.noise_level > 0)]
    table = table.assign(pair=table.parameter_a + "-" + table.parameter_b)
    methods = [method for method in ESTIMATORS.values() if method.short]
    # Methods with a short name have a panel; methods of the paper also one with its values.
    in_paper = [method for method in methods if method.look.paper]
    not_in_paper = [method for method in methods if not method.look.paper]
    panels = []
    for level in np.unique(table.noise_level):
        rows = table[table.noise_level == level]
        paper_rows = paper[np.isclose(paper.noise_level, level)]
        # Methods of the paper, as published and measured, above the other ones.
        upper = [panel(method, paper_rows, "paper, ") for method in in_paper]
        upper += [panel(method, rows) for method in in_paper]
        panels += [upper, [panel(method, rows) for method in not_in_paper]]
    # Intervals of all drawn correlations but those of a number with itself; the Fisher matrix
    # predicts without scatter.
    has_interval = table.method.isin([x.name for x in methods if x.name != "cramer_rao"])
    has_interval &= table.parameter_a != table.parameter_b
    half_width = float(0.5 * (table.ci_high - table.ci_low)[has_interval].max())
    write_png(alignment_figures.draw_correlations(panels, half_width, note), out)
