"""Stages `figure ...`: PNG figures of data products and tables.

In go products of stars, fitted methods or tables; out comes one PNG. The figures themselves are
drawn by functions of `psfdae_paper.evaluation`, which take arrays and tables only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd

from psfdae.base.figures import StripRow, restoration_strip, spread_stars, write_png
from psfdae.base.files import Product, ProductError, read_product
from psfdae.base.options import AboveZero, File
from psfdae.base.reading import read_table
from psfdae.base.settings import Reference
from psfdae.base.threads import limit_threads
from psfdae.methods.interface import Method
from psfdae.methods.metrics import mse
from psfdae.model.star_sets import field_positions, noisy_test_images, read_stars, split_stars
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.schema import Config
from psfdae_paper.evaluation import bound_figures, curves
from psfdae_paper.evaluation.drawing import reference_title
from psfdae_paper.evaluation.figures import in_field_unit, stamp_energy_map, template_map
from psfdae_paper.evaluation.measure import MeasuredStars, read_tables
from psfdae_paper.evaluation.paper import published
from psfdae_paper.stages.evaluate import READS, Evaluations, Metric, Models, estimators
from psfdae_paper.stars.fields import square_grid
from psfdae_paper.stars.framing import without_margin

Stars = Annotated[File, "Product of the stage stars."]
Templates = Annotated[File, "Product of the stage templates."]
Png = Annotated[File, "PNG."]
DatasetName = Annotated[str, "Name in the tables."]
Bounds = Annotated[File, "CSV of the stage bounds."]
Efficiency = Annotated[File, "CSV of the stage efficiency."]


@command("figure templates")
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


@command("figure energy")
def figure_energy(templates: Templates, out: Png) -> None:
    """Draw the light inside the stamp over the field."""
    product = read_product(templates, "templates", ("energy", "grid", "field"))
    stamp_px = product.config["framing"]["stamp_px"]
    write_png(stamp_energy_map(product["energy"], product["grid"], product["field"], stamp_px), out)


@command("figure strip", reads=READS)
def figure_strip(
    config: Config,
    dataset: str,
    stars: Stars,
    models: Models,
    reference: Reference = "realisation",
    *,
    levels: Annotated[tuple[Annotated[float, AboveZero], ...], {"flag": "--level"}],
    out: Png,
) -> None:
    """Draw test stars of the split random before and after restoration.

    A row is a method at a noise level, a column a star; below each stamp stands its MSE × 10⁶. The
    first row is the reference. Eight stars spread over the field are shown.

    Parameters
    ----------
    reference : str
        Truth: the star's own noise-free image, or the static PSF of its field.
    dataset : str
        Name that goes into the title.
    levels : sequence of float
        Noise level λ; repeat for more rows.
    """
    # Eight stars side by side fill the width of a page.
    strip_stars = drawn_stars(config, stars, models, reference, 8)
    # Field angles of the stars as titles of the columns.
    angle, unit = in_field_unit(strip_stars.field)
    columns = [f"({x:+.1f}, {y:+.1f})".replace("-", "−") for x, y in angle[strip_stars.selected]]
    title = (
        f"{dataset}: test stars at field angle (x, y) in {unit},\n"
        f"restored and measured {reference_title(reference)}"
    )
    write_png(restoration_strip(strip_stars.rows(config, levels), columns, title), out)


@command("figure headline", reads=READS)
def figure_headline(
    config: Config,
    dataset: str,
    stars: Stars,
    models: Models,
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
    strip_stars = drawn_stars(config, stars, models, "realisation", 5)
    # Rows of restored stars, one for each method, and below them the truth.
    truth, *restored = strip_stars.rows(config, [level])
    # Labels and colours of the methods.
    looks = [estimator.look for estimator in strip_stars.methods.values()]
    rows = [
        replace(row, label=look.label if look.restores else f"{look.label} star")
        for row, look in zip(restored, looks, strict=True)
    ]
    rows.append(replace(truth, label="truth"))
    # Errors of methods and bounds of the same dataset.
    errors, limits = (rows_of(path, dataset, "realisation") for path in (efficiency, bounds))
    limits = limits[limits.metric == "mse"]
    titles = (f"Test stars of {dataset}, λ = {level:g}", "Error against noise")
    methods = list(strip_stars.methods.values())
    write_png(bound_figures.headline(rows, methods, errors, limits, titles), out)


@dataclass(frozen=True)
class DrawnStars:
    """Test stars of the split random, some of which are drawn, and the methods that restore them.

    Attributes
    ----------
    product : Product
        Product "stars".
    reference : str
        The truth: "realisation" or "template".
    methods : dict of Method
        Fitted methods by name.
    test : ndarray of int, shape (n,)
        Test stars.
    field : ndarray, shape (n, 2)
        Their field angles (x, y) in radians.
    selected : ndarray of int, shape (k,)
        Indices into `test` of the stars that are drawn, spread over the field.
    """

    product: Product
    reference: str
    methods: Mapping[str, Method]
    test: np.ndarray
    field: np.ndarray
    selected: np.ndarray

    def rows(self, config: Config, levels: Sequence[float]) -> list[StripRow]:
        """Return rows of stamps: the reference, then the methods by noise level.

        `config` is that of the stage `evaluate`.

        Parameters
        ----------
        config : Config
            That of the stage `evaluate`.
        levels : sequence of float
            Noise levels λ.

        Returns
        -------
        list of StripRow
            Stamps (k, d, d) of flux 1, with their errors.
        """
        stars = self.test[self.selected]
        # The truth of each star that is drawn, and its field position for methods that use it.
        truth, position = self.product[self.reference][stars], field_positions(self.product)[stars]
        rows = [StripRow("reference", truth)]
        if self.reference == "template":
            # Against templates, even the star without noise has an error.
            noise_free = self.product["realisation"][stars]
            rows.append(StripRow("star without\nnoise", noise_free, mse(noise_free, truth)))
        for level in levels:
            noisy = noisy_test_images(config, self.product, stars, level)
            for estimator in self.methods.values():
                look = estimator.look
                images = estimator.estimate(noisy, level, position, with_sigma=False).psf
                label = f"{look.label}\nλ = {level:g}"
                # Images that are not restored have their own colour scale: noise exceeds the PSF.
                rows.append(StripRow(label, images, mse(images, truth), not look.restores))
        return rows


def drawn_stars(
    config: Config, stars: Path, models: Models, reference: Reference, count: int
) -> DrawnStars:
    """Read the stars of a figure, and load or fit the methods that figures show.

    Parameters
    ----------
    config : Config
        That of the stage `evaluate`.
    stars : Path
        Product of the stage stars.
    models : Models
        File or folder of each method that stores a model.
    reference : str
        The truth.
    count : int
        Number of stars to draw.

    Returns
    -------
    DrawnStars
        All test stars of the split, `count` of which are selected.

    Raises
    ------
    ConfigError, ProductError
        If a model is not given, is damaged, or does not belong to the stars.
    """
    limit_threads(config.evaluation.threads)
    product = read_stars(stars, reference)
    methods = estimators(config, product, vars(models), "random", reference, only_drawn=True)
    # Test stars of seen fields, in the order of the file.
    test = split_stars(product, "random", config).test
    # Field angles (x, y) of all field points, of which each star has one.
    grid = product.config["grid"]
    angle_deg = square_grid(grid["points"], grid["spacing_deg"])[1]
    field: np.ndarray = np.deg2rad(angle_deg)[product["field_index"][test]]
    return DrawnStars(product, reference, methods, test, field, spread_stars(field, count))


@command("figure curves")
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


@command("figure errors")
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


@command("figure bounds")
def figure_bounds(dataset: DatasetName, bounds: Bounds, efficiency: Efficiency, out: Png) -> None:
    """Draw the methods' errors above the bounds, against the noise level."""
    tables = (rows_of(efficiency, dataset), rows_of(bounds, dataset))
    write_png(bound_figures.errors_above_bounds(*tables, dataset), out)


@command("figure efficiency")
def figure_efficiency(dataset: DatasetName, efficiency: Efficiency, out: Png) -> None:
    """Draw the methods' efficiency against the noise level."""
    write_png(bound_figures.efficiency_against_noise(rows_of(efficiency, dataset), dataset), out)


@command("figure bank-growth")
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
