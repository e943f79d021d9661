"""Stages of scene 3 that turn estimates, fits and bounds into tables and figures."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypedDict

import numpy as np

from psfdae.belonging import require, require_origin
from psfdae.figures import write_png
from psfdae.files import Product, ProductError, read_product, write_csv, write_text
from psfdae.model.star_sets import noise_model
from psfdae.options import File, Folder
from psfdae.reading import read_table
from psfdae.threads import limit_threads
from psfdae_paper.alignment.fisher import coma_free_decentre, expected_abs_error
from psfdae_paper.alignment.stamps import AlignmentStamps
from psfdae_paper.alignment.telescope import design_states, fit_quadratic, zernike_tracer
from psfdae_paper.configuration.aligners import (
    ALIGNERS,
    BOUNDS,
    ESTIMATORS,
    FITTED,
    LEARNED,
    Aligner,
    methods_of_set,
)
from psfdae_paper.configuration.alignment import CHOICE, STAMP_KEYS
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.schema import Config
from psfdae_paper.stages.alignment import StatesFile
from psfdae_paper.stages.alignment_methods import DaeFolder, denoise, noisy_test_states

if TYPE_CHECKING:
    import pandas as pd

Estimates = Annotated[tuple[File, ...], "Product of `alignment estimate`."]
Fits = Annotated[tuple[File, ...], "Product of `alignment fit`.", {"flag": "--fit"}]
Bounds = Annotated[tuple[File, ...], "Product of `alignment bound`.", {"flag": "--bound"}]
ErrorTable = Annotated[File, "CSV of `alignment tables`."]

POSITIONS = np.linspace(-1.5, 1.5, 61)
"""Multiples of the state in the twin figure; −1 is the twin."""

SHOWN_STATES = 2
TWIN_TILT = (0.20, 0.25)
"""Tilts x, y of the state of the twin figure; its decentre cancels the constant coma."""

DRAWN = [method.name for method in ESTIMATORS if not method.unknown_flux]

Png = Annotated[File, "PNG."]


class Key(TypedDict):
    """Whose errors, and on what."""

    test_set: str
    noise_level: float
    method: str


def read_errors(
    estimates: Sequence[Path], fits: Sequence[Path]
) -> Iterator[tuple[Key, np.ndarray, np.ndarray]]:
    """Key, true states and estimates, (n, 4) each."""
    for path in estimates:
        product = read_product(path, "alignment_estimates")
        truth, test_set = product["states"], product.config["test_set"]
        for row, level in enumerate(product["levels"]):
            key = Key(test_set=test_set, noise_level=float(level), method="constant")
            yield key, truth, np.zeros_like(truth)
            for column, method in enumerate(LEARNED):
                yield {**key, "method": method.name}, truth, product["estimates"][row, column]
    for path in fits:
        product = read_product(path, "alignment_fit", ("states", "estimates"))
        test_set = product.config["test_set"]
        level = product.config["level"]
        for method, found in zip(
            methods_of_set(FITTED, test_set), product["estimates"], strict=True
        ):
            key = Key(test_set=test_set, noise_level=level, method=method.name)
            yield key, product["states"], found


def read_bounds(bounds: Sequence[Path]) -> Iterator[tuple[Key, np.ndarray, np.ndarray]]:
    """Key, true states (n, 4) and covariances (n, 4, 4)."""
    for path in bounds:
        product = read_product(path, "alignment_bound", ("states", "levels", "covariances"))
        test_set = product.config["test_set"]
        for method, levels in zip(
            methods_of_set(BOUNDS, test_set), product["covariances"], strict=True
        ):
            for level, covariances in zip(product["levels"], levels, strict=True):
                key = Key(test_set=test_set, noise_level=float(level), method=method.name)
                yield key, product["states"], covariances


SAME_TEST = ("noise.kappa", "noise.background_photons", *STAMP_KEYS)
"""What products of one test agree in; estimates and fits in the seed of the noise, too."""


def require_one_test(
    estimates: Sequence[Path], fits: Sequence[Path], bounds: Sequence[Path]
) -> None:
    """Refuse estimates, fits and bounds that are not of the same telescope, noise and states."""
    earlier: list[Product] = []
    for kind, paths in (("estimates", estimates), ("fit", fits), ("bound", bounds)):
        for path in paths:
            product = read_product(path, f"alignment_{kind}", ("states",))
            for other in earlier:
                keys = SAME_TEST if kind == "bound" else ("seed", *SAME_TEST)
                require(path, product.config, keys, other.config, other.path)
                _require_states(product, other)
            earlier.append(product)


def _require_states(product: Product, other: Product) -> None:
    ours, theirs = product["states"], other["states"]
    if product.config["test_set"] != other.config["test_set"] or np.array_equal(ours, theirs):
        return
    what, here, there = "number of states", len(ours), len(theirs)
    if here == there:
        row = int((ours != theirs).any(axis=1).argmax())
        what, here, there = f"state {row}", ours[row].tolist(), theirs[row].tolist()
    raise ProductError(f"{product.path}: {what} = {here}, but {other.path} has {there}")


@command("alignment tables")
def tables(
    states: StatesFile,
    estimates: Estimates,
    fits: Fits,
    bounds: Bounds,
    errors: Annotated[File, "CSV that receives the errors."],
    correlation: Annotated[File, "CSV that receives their correlations."],
) -> None:
    """Tabulate errors and their correlations."""
    import pandas as pd

    from psfdae_paper.evaluation import alignment_tables as rows

    require_one_test(estimates, fits, bounds)
    product = read_product(states, "alignment_states", ("unit",))
    for path in bounds:
        made = read_product(path, "alignment_bound", ()).config
        require(path, made, STAMP_KEYS, product.config, states)
    unit = product["unit"]
    found: dict[Path, list[rows.Row]] = {errors: [], correlation: []}
    for key, truth, estimate in read_errors(estimates, fits):
        found[errors] += rows.error_rows(key, estimate - truth, unit)
        if key["method"] != "constant":
            found[correlation] += rows.measured_correlations(key, estimate - truth)
    for key, _, covariances in read_bounds(bounds):
        found[errors] += rows.bound_rows(key, covariances, unit)
        if key["method"] == "cramer_rao":
            found[correlation] += rows.predicted_correlations(key, covariances)
    order = list(ALIGNERS)
    for path, table in found.items():
        frame = pd.DataFrame(table).sort_values(
            ["test_set", "noise_level", "method"],
            key=lambda c: c.map(order.index) if c.name == "method" else c,
            kind="stable",
        )
        write_csv(path, frame)


@command("alignment paper-tables")
def paper_tables(
    errors: ErrorTable,
    correlation: ErrorTable,
    out: Annotated[Folder, "Folder for CSV and Markdown files."],
) -> None:
    """Set the paper's tables beside ours."""
    from psfdae_paper.evaluation import alignment_tables as rows
    from psfdae_paper.evaluation.paper import published

    def write(name: str, table: pd.DataFrame, title: str, digits: dict[str, str]) -> None:
        path = out / f"alignment_paper_{name}.csv"
        write_csv(path, table, digits=6)
        text = rows.as_markdown(table, f"{title}. {rows.TEST_SETS}", digits)
        write_text(path.with_suffix(".md"), text)

    ours = read_table(errors)
    for level in sorted(published("alignment").noise_level.unique()):
        if not np.isclose(ours.noise_level, level).any():
            raise ProductError(f"{errors}: no rows of noise level {level:g}")
        title = f"Absolute errors in units of the range, λ = {level:g}"
        digits = {"mean": ".4f", "variance": ".2e"}
        write(f"{level:g}", rows.paper_errors(ours, level), title, digits)
    table = rows.paper_correlations(read_table(correlation))
    write("correlation", table, "Correlations of signed errors", {"": ".3f"})


@command("alignment time-table")
def time_table(
    times: Annotated[tuple[File, ...], "CSV of `alignment estimate` or `alignment fit`."],
    histories: Annotated[
        tuple[str, ...], "A training.", {"flag": "--history", "metavar": "NAME=FILE"}
    ],
    out: Annotated[File, "CSV with the cost of an estimate and of the trainings."],
) -> None:
    """Tabulate what the methods cost."""
    import pandas as pd

    named = (text.partition("=") for text in histories)
    training = {name: float(read_table(Path(path))["seconds"].iloc[-1]) for name, _, path in named}
    table = pd.concat([read_table(path) for path in times], ignore_index=True)
    total = table.groupby("method")[["seconds", "states"]].sum()
    rows = []
    for method in ESTIMATORS:
        seconds, states = total.loc[method.name].to_numpy()
        # With the trainings of all networks that the method needs.
        trained = sum(training[name] for name in (method.network, "dae" * method.denoised) if name)
        rows.append((method.name, seconds / states, int(states), trained))
    columns = ["method", "seconds_per_state", "states", "training_seconds"]
    write_csv(out, pd.DataFrame(rows, columns=columns), digits=4)


@command("alignment figure stamps", reads=("seed", "noise", "evaluation"), choice=CHOICE)
def stamps(config: Config, states: StatesFile, dae: DaeFolder, out: Png) -> None:
    """Draw the nine stamps of a few states before and after the DAE."""
    from psfdae_paper.evaluation.alignment_figures import stamp_rows

    product = read_product(states, "alignment_states", ("states", "stamps"))
    require_origin(dae, STAMP_KEYS, product)
    rows = [("noise-free", product["stamps"][:SHOWN_STATES])]
    for level in config.noise.levels:
        noisy = noisy_test_states(config, product["stamps"], "uniform", level)[:SHOWN_STATES]
        rows += [(f"λ = {level:g}", noisy), ("DAE", denoise(dae, config, noisy))]
    titles = [
        "decentre ({:+.2f}, {:+.2f}), tilt ({:+.2f}, {:+.2f}) of the range".format(*state)
        for state in product["states"][:SHOWN_STATES]
    ]
    write_png(stamp_rows(rows, titles), out)


@command("alignment figure predicted")
def predicted(
    estimates: Annotated[File, "Product of `alignment estimate`."],
    fits: Annotated[
        tuple[File, ...], "Product of `alignment fit` of the same states.", {"flag": "--fit"}
    ],
    out: Png,
) -> None:
    """Draw estimates against the truth."""
    from psfdae_paper.evaluation.alignment_figures import predicted_against_true

    require_one_test([estimates], fits, [])
    found: dict[str, dict[float, np.ndarray]] = {method: {} for method in DRAWN}
    truth = np.empty(0)
    for key, truth, states in read_errors([estimates], fits):  # noqa: B007
        if key["method"] in found and key["noise_level"] > 0:
            found[key["method"]][key["noise_level"]] = states
    write_png(predicted_against_true(truth, found), out)


@command("alignment figure errors")
def errors(estimates: Estimates, fits: Fits, bounds: Bounds, out: Png) -> None:
    """Draw errors against the size of the misalignment."""
    from psfdae_paper.evaluation.alignment_figures import errors_against_size, size_of

    require_one_test(estimates, fits, bounds)
    curves: dict[float, dict[str, tuple[np.ndarray, np.ndarray]]] = defaultdict(dict)
    for key, truth, states in read_errors(estimates, fits):
        if key["method"] in DRAWN and key["noise_level"] > 0:
            error = np.abs(states - truth).mean(axis=1)
            curves[key["noise_level"]][key["method"]] = (size_of(truth), error)
    count = 0
    for key, truth, covariances in read_bounds(bounds):
        if key["method"] == "cramer_rao":
            error, count = expected_abs_error(covariances).mean(axis=1), len(truth)
            curves[key["noise_level"]]["cramer_rao"] = (size_of(truth), error)
    title = f"Errors against misalignment, {count} uniform states"
    write_png(errors_against_size(curves, title), out)


@command(
    "alignment figure twin",
    reads=("telescope", "prescription", "alignment", "optics", "noise"),
    choice=CHOICE,
)
def twin(config: Config, table: Annotated[File, "CSV that receives the curves."], out: Png) -> None:
    """Draw a state and its twin, in focus and with the CCD's defocus."""
    # The line leads through the state, the aligned telescope and the twin: tilts with the
    # decentres that cancel their field-constant coma.
    import pandas as pd

    from psfdae_paper.evaluation.alignment_figures import twin_ambiguity

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
    write_csv(table, curves, digits=6)
    write_png(twin_ambiguity(curves, shown, state), out)


def _stamps_along(config: Config, defocus_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A state and the ray-traced stamps of its multiples, with the CCD at a defocus."""
    moved = config.alignment.model_copy(update={"defocus_m": defocus_m})
    tracer = zernike_tracer(config.telescope, config.prescription, moved)
    operator = AlignmentStamps(config.telescope, config.optics, moved)
    model = fit_quadratic(design_states(), tracer(design_states()))
    tilt = np.array([TWIN_TILT])
    state = np.concatenate([coma_free_decentre(model, tilt, operator.noll), tilt], axis=1)[0]
    return state, operator(tracer(POSITIONS[:, None] * state))[0]


@command("alignment figure correlation")
def correlation(correlation: ErrorTable, out: Png) -> None:
    """Draw measured and predicted correlations of errors beside the paper's."""
    from psfdae_paper.evaluation.alignment_figures import correlation_matrices
    from psfdae_paper.evaluation.alignment_tables import PARAMETERS
    from psfdae_paper.evaluation.paper import published

    def titled(method: Aligner, rows: pd.DataFrame, whose: str = "") -> tuple[str, np.ndarray]:
        matrix = np.full((4, 4), np.nan)
        own = rows[rows.method == method.name]
        for pair, value in zip(own.pair, own.correlation, strict=True):
            a, b = (PARAMETERS.index(name) for name in pair.split("-"))
            matrix[a, b] = matrix[b, a] = value
        return f"{whose}{method.short}, λ = {level:g}", matrix

    ours, paper = read_table(correlation), published("correlation")
    ours = ours[(ours.test_set == "uniform") & (ours.noise_level > 0)]
    ours = ours.assign(pair=ours.parameter_a + "-" + ours.parameter_b)
    shown = [method for method in ALIGNERS.values() if method.short]
    published_too, more = [m for m in shown if m.look.paper], [m for m in shown if not m.look.paper]
    panels = []
    for level in np.unique(ours.noise_level):
        rows = ours[ours.noise_level == level]
        known = paper[np.isclose(paper.noise_level, level)]
        first = [titled(method, known, "paper, ") for method in published_too]
        first += [titled(method, rows) for method in published_too]
        panels += [first, [titled(method, rows) for method in more]]
    write_png(correlation_matrices(panels), out)
