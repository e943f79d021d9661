"""Stages `figure ...`: PNG figures of data products and tables.

Each stage reads products or tables and writes one PNG. The figures themselves are drawn by
functions of `psfdae_paper.evaluation`, which take arrays and tables only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd

from psfdae.base.figures import StripRow, restoration_strip, write_png
from psfdae.base.files import Product, ProductError, read_product
from psfdae.base.options import AboveZero, File
from psfdae.base.reading import read_table
from psfdae.methods import method
from psfdae.methods.interface import Method
from psfdae.methods.metrics import mse
from psfdae_paper.configuration.command import command
from psfdae_paper.evaluation import bound_figures, curves
from psfdae_paper.evaluation.drawing import reference_title
from psfdae_paper.evaluation.figures import draw_energy, draw_templates, to_field_unit
from psfdae_paper.evaluation.measure import MeasuredStars, read_tables
from psfdae_paper.evaluation.paper import read_published
from psfdae_paper.evaluation.readable import Note
from psfdae_paper.stages.evaluate import Evaluations, Metric
from psfdae_paper.stars.framing import cut_margin

RestoredStars = Annotated[File, "Product of the stage evaluate: images of some stars."]
Templates = Annotated[File, "Product of the stage templates."]
Png = Annotated[File, "PNG."]
DatasetName = Annotated[str, "Name in the tables."]
Bounds = Annotated[File, "CSV of the stage bounds."]
Efficiency = Annotated[File, "CSV of the stage efficiency."]

ROW_KEYS = ("dataset", "reference", "method", "noise_level")
BOUND_COLUMNS = (*ROW_KEYS, "metric", "value", "stderr", "n", "ci_low", "ci_high", "tight")
EFFICIENCY_COLUMNS = (*ROW_KEYS, "bound", "mse", "stderr", "efficiency", "n")
GROWTH_COLUMNS = (*ROW_KEYS, "draws", "mse", "stderr", "limit", "n")
"""Columns of tables that figures draw."""


@command("paper figure templates")
def figure_templates(templates: Templates, out: Png) -> None:
    """Draw the static PSFs at their field positions, without the margin for centring errors.

    Each has a square-root scale up to its own maximum.
    """
    product = read_product(templates, "templates", ("psf", "grid", "field"))
    psf = cut_margin(product)
    title = (
        f"Static PSFs of scene {product.config['scene']['name']}: {len(psf)} field points, "
        f"stamps of {psf.shape[-1]} × {psf.shape[-1]} px"
    )
    write_png(draw_templates(psf, product["grid"], product["field"], title), out)


@command("paper figure energy")
def figure_energy(templates: Templates, out: Png) -> None:
    """Draw the light inside the stamp over the field."""
    product = read_product(templates, "templates", ("energy", "grid", "field"))
    stamp_px = product.config["framing"]["stamp_px"]
    write_png(draw_energy(product["energy"], product["grid"], product["field"], stamp_px), out)


@command("paper figure strip")
def figure_strip(
    restored: RestoredStars,
    levels: Annotated[tuple[Annotated[float, AboveZero], ...], {"flag": "--level"}],
    out: Png,
) -> None:
    """Draw test stars before and after denoising.

    A row is a method at a noise level, a column a star, with the MSE × 10⁶ below each stamp. The
    first row is the reference.

    Parameters
    ----------
    restored : Path
        Product of the stage evaluate: images of some stars.
    levels : sequence of float
        Noise level λ; repeat for more rows.
    out : Path
        PNG.
    """
    product = read_product(restored, "restored")
    dataset, reference = product.config["dataset"], product.config["reference"]
    # Field angles of the stars as titles of the columns.
    angle, unit = to_field_unit(product["field"])
    columns = [f"({x:+.1f}, {y:+.1f})".replace("-", "−") for x, y in angle]
    title = (
        f"{dataset}: test stars at field angle (x, y) in {unit},\n"
        f"restored and measured {reference_title(reference)}"
    )
    truth, noise_free = product["truth"], product["noise_free"]
    rows = [StripRow("reference", truth)]
    if reference == "template":
        # Against templates, even the star without noise has an error.
        rows.append(StripRow("star without\nnoise", noise_free, mse(noise_free, truth)))
    # All methods at the first noise level, then all at the next.
    for level in levels:
        for row in make_strip_rows(product, level).values():
            rows.append(replace(row, label=f"{row.label}\nλ = {level:g}"))
    write_png(restoration_strip(rows, columns, title), out)


@command("paper figure headline")
def figure_headline(
    restored: RestoredStars,
    level: Annotated[float, AboveZero],
    bounds: Bounds,
    efficiency: Efficiency,
    out: Png,
) -> None:
    """Draw denoised stars, and errors with their bounds.

    At the left are five stars at one noise level, noisy and by every method, with the truth below;
    at the right is the MSE of each method against the noise level, with the bounds.

    Parameters
    ----------
    restored : Path
        Product of the stage evaluate: images of some stars.
    level : float
        Noise level λ.
    bounds : Path
        CSV of the stage bounds.
    efficiency : Path
        CSV of the stage efficiency.
    out : Path
        PNG.
    """
    product = read_product(restored, "restored")
    dataset, truth = product.config["dataset"], product["truth"]
    # Five of the stars, from one side of the field to the other.
    five = np.linspace(0, len(truth) - 1, 5).round().astype(int)
    # Rows of denoised stars, one for each method, and below them the truth.
    restored_by_method = make_strip_rows(product, level, five)
    rows = [
        row if kind.look.restores else replace(row, label=f"{row.label} star")
        for kind, row in restored_by_method.items()
    ]
    rows.append(StripRow("truth", truth[five]))
    # Errors of methods and bounds of the same dataset.
    errors = read_rows(efficiency, EFFICIENCY_COLUMNS, dataset, "realisation")
    limits = read_rows(bounds, BOUND_COLUMNS, dataset, "realisation")
    limits = limits[limits.metric == "mse"]
    count = limits["n"].max()
    titles = (f"Test stars of {dataset}, λ = {level:g}", f"Error against noise, {count} test stars")
    write_png(bound_figures.draw_headline(rows, [*restored_by_method], errors, limits, titles), out)


def make_strip_rows(
    product: Product, level: float, stars: slice | np.ndarray = slice(None)
) -> dict[type[Method], StripRow]:
    """Return a row of denoised stamps at a noise level for each method that is drawn.

    Parameters
    ----------
    product : Product
        Product "restored".
    level : float
        Noise level λ, one of the product's.
    stars : slice or ndarray of int
        Stars of the product, by default all.

    Returns
    -------
    dict of StripRow
        By class of the method: its label, and stamps (n, d, d) of flux 1 with their errors.

    Raises
    ------
    ProductError
        If the product lacks this noise level.
    """
    # Levels from two files may differ in the last bit.
    (indices,) = np.isclose(product["levels"], level, rtol=1e-5).nonzero()
    if not indices.size:
        raise ProductError(f"{product.path}: no stars of λ = {level:g}")
    rows, truth = {}, product["truth"][stars]
    # One method after the other, in the order of the product.
    for name, images in zip(
        product.config["methods"], product["restored"][indices[0]], strict=True
    ):
        kind = method(name)
        # Noisy images have their own colour scale: noise exceeds the PSF.
        if kind.look.is_drawn:
            errors, is_noisy = mse(images[stars], truth), not kind.look.restores
            rows[kind] = StripRow(kind.look.label, images[stars], errors, is_noisy)
    return rows


@command("paper figure curves")
def figure_curves(
    labels: Annotated[tuple[str, ...], {"flag": "--label"}],
    histories: Annotated[tuple[File, ...], {"argument": True}],
    out: Png,
) -> None:
    """Draw training and validation error of networks against the optimiser's steps.

    HISTORIES are tables of trainings, with the columns step, train_mse and validation_mse.

    Parameters
    ----------
    labels : sequence of str
        One per history, in order.
    histories : sequence of Path
        CSV files.
    out : Path
        PNG.
    """
    # Each history needs a label, and the columns that are drawn.
    if len(histories) != len(labels):
        raise ProductError(f"{len(histories)} histories, but {len(labels)} labels")
    columns = ("step", "train_mse", "validation_mse")
    tables = {
        label: read_table(path, *columns) for path, label in zip(histories, labels, strict=True)
    }
    write_png(curves.draw_training_curves(tables, "Training of the denoising autoencoders"), out)


@command("paper figure errors")
def figure_errors(
    dataset: str, evaluations: Evaluations, out: tuple[tuple[Metric, File], ...], note: Note = ""
) -> None:
    """Draw metrics against the noise level, with the paper's points.

    Each metric is a figure. It is an error if the tables lack the dataset.

    Parameters
    ----------
    dataset : str
        Name in the tables.
    evaluations : sequence of Path
        CSV files of the stage evaluate.
    out : sequence of pairs
        Metric and its PNG; repeat for more.
    note : str
        Line below the title: how the run differs from the paper's.
    """
    metrics = read_tables(evaluations, MeasuredStars.columns)
    for metric, path in out:
        # An empty figure would hide that a table lacks the dataset.
        if not ((metrics.dataset == dataset) & (metrics.metric == metric)).any():
            names = ", ".join(str(path) for path in evaluations)
            raise ProductError(f"{names}: no rows of {dataset}, {metric}")
        write_png(curves.draw_errors(metrics, read_published("psf"), dataset, metric, note), path)


@command("paper figure bounds")
def figure_bounds(dataset: DatasetName, bounds: Bounds, efficiency: Efficiency, out: Png) -> None:
    """Draw the methods' errors above the bounds, against the noise level."""
    errors = read_rows(efficiency, EFFICIENCY_COLUMNS, dataset)
    limits = read_rows(bounds, BOUND_COLUMNS, dataset)
    write_png(bound_figures.draw_bounds(errors, limits, dataset), out)


@command("paper figure efficiency")
def figure_efficiency(dataset: DatasetName, efficiency: Efficiency, out: Png) -> None:
    """Draw the methods' efficiency against the noise level."""
    rows = read_rows(efficiency, EFFICIENCY_COLUMNS, dataset)
    write_png(bound_figures.draw_efficiency(rows, dataset), out)


@command("paper figure bank-growth")
def figure_bank_growth(dataset: DatasetName, growth: File, out: Png) -> None:
    """Draw the posterior mean's error against the size of the bank.

    Parameters
    ----------
    dataset : str
        Name in the tables.
    growth : Path
        CSV of the stage bounds: error by size of the bank.
    out : Path
        PNG.
    """
    rows = read_rows(growth, GROWTH_COLUMNS, dataset)
    write_png(bound_figures.draw_bank_growth(rows, dataset), out)


def read_rows(
    path: Path, columns: Sequence[str], dataset: str, reference: str | None = None
) -> pd.DataFrame:
    """Read the rows of a dataset, and of a reference if one is given.

    Parameters
    ----------
    path : Path
        CSV.
    columns : sequence of str
        Columns that it must have.
    dataset : str
        Name in the table.
    reference : str, optional
        "realisation" or "template".

    Returns
    -------
    DataFrame
        At least one row.

    Raises
    ------
    ProductError
        If the table lacks such rows, or a column.
    """
    table = read_table(path, *columns)
    rows = table[table.dataset == dataset]
    if reference is not None:
        rows = rows[rows.reference == reference]
    if rows.empty:
        raise ProductError(f"{path}: no rows of {', '.join(filter(None, (dataset, reference)))}")
    return rows
