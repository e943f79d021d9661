"""Stages `evaluate`, `collect`, `held-out` and `paper-tables`: all methods on test stars.

Inputs: the product "stars" and the fitted methods. Outputs: the errors of every star (Parquet),
their means with standard errors (CSV), and denoised images of some stars for figures (product
"restored"). The other stages make tables of the errors.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import make_dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pandas as pd

from psfdae.base.figures import spread_stars
from psfdae.base.files import Column, Product, write_csv, write_parquet, write_product
from psfdae.base.options import File, Folder
from psfdae.base.progress import steps
from psfdae.base.reading import read_table
from psfdae.base.settings import ConfigError, Reference, SplitKind
from psfdae.base.threads import limit_threads
from psfdae.methods import fit_files as fits
from psfdae.methods import method
from psfdae.methods.interface import Method
from psfdae.training.star_sets import noisy_test_images, read_stars, split_stars, training_set
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.methods import list_methods
from psfdae_paper.configuration.schema import Config
from psfdae_paper.evaluation import comparison, readable
from psfdae_paper.evaluation.measure import MeasuredStars, read_tables
from psfdae_paper.evaluation.paper import format_paper_table, paper_table
from psfdae_paper.evaluation.readable import Note
from psfdae_paper.stars.fields import square_grid

READS = (
    *("seed", "noise", "parts", "evaluation", "methods"),
    *dict.fromkeys(group for m in list_methods() if m.storage is None for group in m.groups),
)
"""Groups of the configuration on which the measurements depend, if stored models are given.

Methods that store no model are fitted by the stage, and their settings are among these groups.
"""

FIT_PATH_TYPES = {m.name: Folder if m.storage.files else File for m in list_methods() if m.storage}
"""Type of the path of each method that stores a model: its folder or file."""

Models = make_dataclass(
    "Models",
    [
        (name, Annotated[path_type | None, f"Result of `psfdae paper fit {name}`."], None)
        for name, path_type in FIT_PATH_TYPES.items()
    ],
    namespace={"__doc__": "Fits of the methods."},
)
"""Options with the model of each method that stores one, by its name."""


@command("paper evaluate", reads=READS)
def evaluate(
    config: Config,
    dataset: str,
    stars: File,
    models: Models,  # type: ignore[valid-type]  # made at run time
    split: SplitKind = "random",
    reference: Reference = "realisation",
    *,
    per_star: File,
    restored: File,
    out: File,
) -> None:
    """Measure every method on the test stars at each noise level.

    Metrics are the MSE per pixel and the SSIM against the reference. All methods get the same noisy
    images; standard errors are clustered by field, because stars of a field have similar PSFs.

    Every method of the list `methods` needs its model, except methods without a file, which are
    fitted here.
    The table has a row for each method, noise level and metric; the Parquet file has one for each
    star, with its field and all metrics. The product has the images of stars spread over the field.

    Parameters
    ----------
    config : Config
        Seed, noise, parts, evaluation, methods, and settings of methods without a file.
    models : Models
        Folder or file of each method that stores one, an option of its name.
    split : str
        Split whose test stars are measured.
    reference : str
        Truth: the star's own noise-free image, or the static PSF of its field.
    dataset : str
        Name in the table.
    stars : Path
        Product of the stage stars.
    per_star : Path
        Parquet with every star.
    restored : Path
        HDF5 product with the images of eight stars, for figures.
    out : Path
        CSV with means and standard errors.
    """
    # All methods, and the test stars with their truth.
    limit_threads(config.evaluation.threads)
    product = read_stars(stars, reference)
    # Methods that store a model are loaded; the others are fitted to the training stars.
    methods = estimators(config, product, vars(models), split, reference)
    # Test stars, which are not used in any fit.
    test = split_stars(product, split, config).test
    test_stars = MeasuredStars.from_product(product, test, reference)
    key = {"dataset": dataset, "split": split, "reference": reference}
    summary, stars_table, images = [], [], []
    # Eight stars side by side fill the width of a page.
    shown = spread_stars(test_stars.position, 8)
    for level in steps("noise levels", config.noise.levels):
        # The same noisy images for all methods: their errors are compared star by star.
        noisy = noisy_test_images(config, product, test, level)
        for name, estimator in steps("methods", methods.items()):
            estimate = estimator.estimate(noisy, level, test_stars.position)
            row = {**key, "method": name, "noise_level": level}
            rows, per_star_rows = test_stars.errors(row, estimate, config.evaluation.data_range)
            summary += rows
            stars_table.append(per_star_rows)
            images.append(estimate.psf[shown])
    # Means with standard errors, every star, and the stars of figures.
    write_csv(out, pd.DataFrame(summary))
    write_parquet(per_star, pd.concat(stars_table, ignore_index=True))
    # Field angle (x, y) of each star, one of the field points.
    grid = product.config["grid"]
    angle_deg = square_grid(grid["points"], grid["spacing_deg"])[1][test_stars.field[shown]]
    shape = (len(config.noise.levels), len(methods), *images[0].shape)
    about = f"[λ, method, star, row, column]; {', '.join(methods)}"
    columns = {
        "field": Column(np.deg2rad(angle_deg), "rad", "field angle (x, y) of each star"),
        "levels": Column(np.array(config.noise.levels), "1", "noise levels λ"),
        "truth": Column(test_stars.truth[shown], "1", "what estimates are compared with"),
        "noise_free": Column(product["realisation"][test[shown]], "1", "stars without noise"),
        "restored": Column(np.reshape(images, shape), "1", about),
    }
    write_product(restored, "restored", columns, {**config.model_dump(), **key})


def estimators(
    config: Config, stars: Product, models: Mapping[str, Path | None], split: str, reference: str
) -> dict[str, Method]:
    """Load or fit the methods of a configuration, for the test stars of a split.

    Parameters
    ----------
    config : Config
        Stage configuration (seed, noise, parts, evaluation, methods).
    stars : Product
        Product "stars".
    models : mapping
        File or folder of each method that stores a model.
    split, reference : str
        Split and reference of the test stars.

    Returns
    -------
    dict
        Fitted method by name.

    Raises
    ------
    ConfigError
        If a model is not given.
    ProductError
        If a model is damaged, or does not belong to the stars.
    """
    classes = [*map(method, config.methods)]
    # Check all models before any method is loaded or fitted.
    paths: dict[str, Path] = {}
    for method_class in classes:
        name = method_class.name
        if method_class.storage:
            path = models.get(name)
            if path is None:
                raise ConfigError(f"--{name.replace('_', '-')} is missing: it is in methods")
            fits.require_fit(method_class, path, stars, config, split, reference)
            paths[name] = path
    # Methods without a file are fitted here.
    methods: dict[str, Method] = {}
    for method_class in classes:
        name = method_class.name
        if name in paths:
            methods[name] = method_class.load(paths[name], reference, config.evaluation)
        else:
            data = training_set(config, method_class, stars, split, reference)
            methods[name] = method_class.fit(data, **method_class.settings(config))
    return methods


Evaluations = Annotated[tuple[File, ...], {"argument": True}]
Metric = Literal["mse", "ssim"]


@command("paper collect")
def collect(evaluations: Evaluations, out: File) -> None:
    """Join evaluations into one tidy table, with the scatter of each method between seeds.

    The scatter, where it was measured, is the scatter of repeated fits with other random numbers.

    Columns are dataset, split, reference, method, noise_level, metric, value, stderr, seed_stderr
    and n, the number of stars.

    Parameters
    ----------
    evaluations : sequence of Path
        CSV files of the stage evaluate.
    out : Path
        Tidy CSV.
    """
    # The standard error of a mean over stars does not include the scatter between seeds.
    table = comparison.add_seed_stderr(
        read_tables(evaluations, MeasuredStars.columns), comparison.read_seed_scatter()
    )
    write_csv(out, table[[*MeasuredStars.columns[:-1], "seed_stderr", "n"]])


@command("paper held-out")
def held_out(per_star: Annotated[tuple[File, ...], {"argument": True}], out: File) -> None:
    """Compare errors in held-out fields with those in training fields, star by star.

    PER_STAR are the evaluations' Parquet files of both splits.

    A row is a method at a noise level: the ratio of the errors of the same stars, with their fields
    held out and not, with its standard error. Above 1, the method is worse in held-out fields.

    Parameters
    ----------
    per_star : sequence of Path
        Parquet files of the stage evaluate, of both splits.
    out : Path
        CSV with ratios of errors, on the stars that both splits test.
    """
    columns = [*comparison.FIT_KEYS, "noise_level", "split", "star", "field", "mse"]
    # Errors in the same fields, as seen in training and as held out.
    parts = [read_table(path, columns=columns) for path in per_star]
    write_csv(out, comparison.measure_held_out_ratios(pd.concat(parts)))


@command("paper paper-tables")
def paper_tables(
    dataset: str,
    evaluations: Evaluations,
    out: tuple[tuple[Metric, File], ...],
    page: File,
    note: Note = "",
) -> None:
    """Write the paper's tables, with published and measured errors.

    Rows are methods, columns noise levels; measured errors are given for each reference.

    Each table is written as CSV, and in the same folder as Markdown and LaTeX; all of them together
    are a page for readers.

    Parameters
    ----------
    dataset : str
        Name in the tables.
    evaluations : sequence of Path
        CSV files of the stage evaluate.
    out : sequence of pairs
        Metric and its CSV; repeat for more.
    page : Path
        HTML page with all tables.
    note : str
        How the run differs from the paper's.
    """
    measured_rows = read_tables(evaluations, MeasuredStars.columns)
    tables = {}
    for metric, path in out:
        # Numbers for programs, texts for readers.
        table = paper_table(measured_rows, dataset, metric)
        write_csv(path, table, 6)
        title = f"{metric.upper()} of {dataset}, split random"
        tables[path] = title, format_paper_table(table, metric)
    readable.write_tables(tables, page, note)


@command("paper methods-table")
def methods_table(
    metrics: Annotated[File, {"argument": True}],
    out: tuple[tuple[Metric, File], ...],
    page: File,
    note: Note = "",
) -> None:
    """Write the errors of all methods side by side, with the paper's.

    METRICS is the CSV of the stage collect. A row is a dataset, split, reference and noise level, a
    column a method; MSE are in millionths, with standard errors of the stars and of the seeds, as
    far as the latter were measured.

    Parameters
    ----------
    metrics : Path
        CSV of the stage collect.
    out : sequence of pairs
        Metric and its Markdown file, beside which the LaTeX is written; repeat for more.
    page : Path
        HTML page with all tables.
    note : str
        How the run differs from the paper's.
    """
    rows = read_table(metrics, *MeasuredStars.columns[:-1], "seed_stderr")
    units, tables = {"mse": "MSE × 10⁶", "ssim": "SSIM"}, {}
    for metric, path in out:
        title = f"{units[metric]} of all methods, ± standard error"
        tables[path] = title, readable.tabulate_methods(rows, metric)
    readable.write_tables(tables, page, note)
