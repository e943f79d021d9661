"""Errors of estimated PSFs on a set of stars, from which all tables of errors are made.

Input: denoised images of some stars. Outputs: rows of the summary (mean and standard error of each
metric), and a table with the errors of every star.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pandas as pd

from psfdae.base.files import Product
from psfdae.base.reading import read_table
from psfdae.methods.interface import Estimate
from psfdae.methods.metrics import quality, summarise_metrics
from psfdae.training.star_sets import field_positions

CELL = ["dataset", "split", "reference", "noise_level"]
"""Columns that identify a column of the paper's tables: methods are compared inside it."""


def read_tables(paths: Sequence[Path], columns: Sequence[str] | None = None) -> pd.DataFrame:
    """Join CSV files.

    Parameters
    ----------
    paths : sequence of Path
        CSV files, at least one.
    columns : sequence of str, optional
        Columns to read from each file; by default all columns of the first.

    Raises
    ------
    ProductError
        If a file is missing or damaged, or lacks a column.
    """
    # All files must have these columns; others are left out.
    first = read_table(paths[0], *(columns or ()))
    columns = list(columns or first.columns)
    tables = [first, *(read_table(path, *columns) for path in paths[1:])]
    # Tables without rows would change the types of columns.
    tables = [table for table in tables if len(table)] or tables[:1]
    return pd.concat([table[columns] for table in tables], ignore_index=True)


@dataclass(frozen=True)
class MeasuredStars:
    """Stars on which estimates are measured; every array has n rows.

    Attributes
    ----------
    star : ndarray of int, shape (n,)
        Index of the star in its product.
    field : ndarray of int, shape (n,)
        Field of the star; standard errors are clustered by field.
    position : ndarray, shape (n, 2)
        Position in the field, as methods are given it.
    truth : ndarray, shape (n, d, d)
        Noise-free image that the estimate is compared with, sum 1.
    columns : tuple of str
        Columns of the summary of `errors`.
    """

    columns: ClassVar = (*CELL[:3], "method", "noise_level", "metric", "value", "stderr", "n")

    star: np.ndarray
    field: np.ndarray
    position: np.ndarray
    truth: np.ndarray

    @classmethod
    def from_product(cls, product: Product, star: np.ndarray, reference: str) -> MeasuredStars:
        """Select stars of a product "stars", with one of its references as the truth."""
        # A method may be given the position; errors are clustered by field.
        field, position = product["field_index"][star], field_positions(product)[star]
        return cls(star, field, position, product[reference][star])

    def errors(
        self, row: Mapping[str, object], estimate: Estimate, data_range: float
    ) -> tuple[list[dict[str, object]], pd.DataFrame]:
        """Measure one method at one noise level.

        Parameters
        ----------
        row : mapping
            The first columns of both tables: those that name dataset, method and noise level.
        estimate : Estimate
            Denoised images of the stars, shape (n, d, d), and their errors if the method has them.
        data_range : float
            Dynamic range of the SSIM.

        Returns
        -------
        summary : list of dict
            A row of `columns` for each metric, with its standard error clustered by field.
        per_star : DataFrame
            `row`, star, field, and a column for each metric.
        """
        # Metrics of every star; their means have standard errors clustered by field.
        metrics = quality(estimate, self.truth, data_range)
        per_star = pd.DataFrame({**row, "star": self.star, "field": self.field, **metrics})
        return summarise_metrics(row, metrics, self.field), per_star
