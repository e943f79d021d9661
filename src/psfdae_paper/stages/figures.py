"""Stages `figure ...`: PNG figures of data products and tables.

In go products of stars, restored stars or tables; out comes one PNG. The figures themselves are
drawn by functions of `psfdae_paper.evaluation`, which take arrays and tables only.
"""

from __future__ import annotations

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
from psfdae_paper.evaluation.figures import in_field_unit, stamp_energy_map, template_map
from psfdae_paper.evaluation.measure import MeasuredStars, read_tables
from psfdae_paper.evaluation.paper import published
from psfdae_paper.stages.evaluate import Evaluations, Metric
from psfdae_paper.stars.framing import without_margin

Restored = Annotated[File, "Product of the stage evaluate: images of some stars."]
Templates = Annotated[File, "Product of the stage templates."]
Png = Annotated[File, "PNG."]
DatasetName = Annotated[str, "Name in the tables."]
Bounds = Annotated[File, "CSV of the stage bounds."]
Efficiency = Annotated[File, "CSV of the stage efficiency."]


@command("paper figure templates")
def figure_templates(templates: Templates, out: Png) -> None:
    """Draw the static PSFs at their field positions, without the margin for centring errors.

    Each has a square-root scale up to its own maximum.
    """
    product = read_product(templates, "templates", ("psf", "grid", "field"))
    psf = without_margin(product)
    title = (
        f"Static PSFs of scene {product.config['scene']['name']}: {len(psf)} field points, "
        f"stamps of {psf.shape[-1]} × {psf.shape[-1]} px"
    )
    write_png(template_map(psf, product["grid"], product["field"], title), out)


@command("paper figure energy")
def figure_energy(templates: Templates, out: Png) -> None:
    """Draw the light inside the stamp over the field."""
    product = read_product(templates, "templates", ("energy", "grid", "field"))
    stamp_px = product.config["framing"]["stamp_px"]
    write_png(stamp_energy_map(product["energy"], product["grid"], product["field"], stamp_px), out)


@command("paper figure strip")
def figure_strip(
    restored: Restored,
    levels: Annotated[tuple[Annotated[float, AboveZero], ...], {"flag": "--level"}],
    out: Png,
) -> None:
    """Draw test stars before and after restoration.

    A row is a method at a noise level, a column a star; below each stamp stands its MSE × 10⁶. The
    first row is the reference.

    Parameters
    ----------
    levels : sequence of float
        Noise level λ; repeat for more rows.
    """
    product = read_product(restored, "restored")
    dataset, reference = product.config["dataset"], product.config["reference"]
    # Field angles of the stars as titles of the columns.
    angle, unit = in_field_unit(product["field"])
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
        for row in restored_rows(product, level).values():
            rows.append(replace(row, label=f"{row.label}\nλ = {level:g}"))
    write_png(restoration_strip(rows, columns, title), out)


@command("paper figure headline")
def figure_headline(
    restored: Restored,
    level: Annotated[float, AboveZero],
    bounds: Bounds,
    efficiency: Efficiency,
    out: Png,
) -> None:
    """Draw restored stars beside the errors and their bounds.

    At the left are five stars at one noise level, noisy and by every method, with the truth below;
    at the right is the MSE of each method against the noise level, with the bounds.

    Parameters
    ----------
    dataset : str
        Name in the tables.
    level : float
        Noise level λ.
    """
    product = read_product(restored, "restored")
    dataset, truth = product.config["dataset"], product["truth"]
    # Five of the stars, from one side of the field to the other.
    five = np.linspace(0, len(truth) - 1, 5).round().astype(int)
    # Rows of restored stars, one for each method, and below them the truth.
    restored_by_method = restored_rows(product, level, five)
    rows = [
        row if kind.look.restores else replace(row, label=f"{row.label} star")
        for kind, row in restored_by_method.items()
    ]
    rows.append(StripRow("truth", truth[five]))
    # Errors of methods and bounds of the same dataset.
    errors, limits = (rows_of(path, dataset, "realisation") for path in (efficiency, bounds))
    limits = limits[limits.metric == "mse"]
    titles = (f"Test stars of {dataset}, λ = {level:g}", "Error against noise")
    write_png(bound_figures.headline(rows, [*restored_by_method], errors, limits, titles), out)


def restored_rows(
    product: Product, level: float, stars: slice | np.ndarray = slice(None)
) -> dict[type[Method], StripRow]:
    """Return a row of restored stamps at a noise level for each method that is drawn.

    Parameters
    ----------
    product : Product
        Product "restored".
    level : float
        Noise level λ, one of the product's.
    stars : slice or ndarray of int
        Stars of the product, by default all.

    Raises
    ------
    ProductError
        If the product has no stars of this noise level.

    Returns
    -------
    dict of StripRow
        By class of the method: its label, and stamps (n, d, d) of flux 1 with their errors.
    """
    # Levels from two files may differ in the last bit.
    (is_level,) = np.isclose(product["levels"], level, rtol=1e-5).nonzero()
    if not is_level.size:
        raise ProductError(f"{product.path}: no stars of λ = {level:g}")
    rows, truth = {}, product["truth"][stars]
    # One method after the other, in the order in which they have restored the stars.
    for name, images in zip(
        product.config["methods"], product["restored"][is_level[0]], strict=True
    ):
        kind = method(name)
        # Images that are not restored have their own colour scale: noise exceeds the PSF.
        if kind.look.drawn:
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
    """
    # Each history needs a label, and the columns that are drawn.
    if len(histories) != len(labels):
        raise ProductError(f"{len(histories)} histories, but {len(labels)} labels")
    tables = {}
    for path, label in zip(histories, labels, strict=True):
        tables[label] = read_table(path)
        missing = {"step", "train_mse", "validation_mse"} - set(tables[label].columns)
        if missing:
            raise ProductError(f"{path}: no column {min(missing)!r}")
    write_png(curves.training_curves(tables, "Training of the denoising autoencoders"), out)


@command("paper figure errors")
def figure_errors(
    dataset: str, evaluations: Evaluations, out: tuple[tuple[Metric, File], ...]
) -> None:
    """Draw metrics against the noise level, with the paper's points.

    Each metric is a figure; it is refused if the tables have no row of the dataset.

    Parameters
    ----------
    dataset : str
        Name in the tables.
    out : sequence of pairs
        Metric and its PNG; repeat for more.
    """
    metrics = read_tables(evaluations, MeasuredStars.columns)
    for metric, path in out:
        # An empty figure would hide that a table lacks the dataset.
        if not ((metrics.dataset == dataset) & (metrics.metric == metric)).any():
            names = ", ".join(str(path) for path in evaluations)
            raise ProductError(f"{names}: no rows of {dataset}, {metric}")
        write_png(curves.error_against_noise(metrics, published("psf"), dataset, metric), path)


@command("paper figure bounds")
def figure_bounds(dataset: DatasetName, bounds: Bounds, efficiency: Efficiency, out: Png) -> None:
    """Draw the methods' errors above the bounds, against the noise level."""
    tables = (rows_of(efficiency, dataset), rows_of(bounds, dataset))
    write_png(bound_figures.errors_above_bounds(*tables, dataset), out)


@command("paper figure efficiency")
def figure_efficiency(dataset: DatasetName, efficiency: Efficiency, out: Png) -> None:
    """Draw the methods' efficiency against the noise level."""
    write_png(bound_figures.efficiency_against_noise(rows_of(efficiency, dataset), dataset), out)


@command("paper figure bank-growth")
def figure_bank_growth(dataset: DatasetName, growth: File, out: Png) -> None:
    """Draw the posterior mean's error against the size of the bank.

    Parameters
    ----------
    growth : Path
        CSV of the stage bounds: error by size of the bank.
    """
    write_png(bound_figures.bank_growth(rows_of(growth, dataset), dataset), out)


def rows_of(path: Path, dataset: str, reference: str | None = None) -> pd.DataFrame:
    """Read the rows of a dataset, and of a reference if one is given.

    ProductError if there are none.

    Parameters
    ----------
    path : Path
        CSV with the column dataset.
    dataset : str
        Name in the table.
    reference : str, optional
        "realisation" or "template".

    Returns
    -------
    DataFrame
        At least one row.
    """
    table = read_table(path)
    rows = table[table.dataset == dataset]
    if reference is not None:
        rows = rows[rows.reference == reference]
    if rows.empty:
        raise ProductError(f"{path}: no rows of {', '.join(filter(None, (dataset, reference)))}")
    return rows
