"""Stages `experiment` and `figure experiment`: settings of datasets compared over several seeds.

Inputs: evaluations of all variants of an experiment. Outputs: a table (CSV, Markdown) and a figure.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import pandas as pd

from psfdae.base.figures import write_png
from psfdae.base.files import write_csv, write_text
from psfdae.base.options import File
from psfdae.base.reading import read_table
from psfdae_paper.configuration.command import command
from psfdae_paper.evaluation.experiments import (
    NUMBERS,
    ROW,
    Variant,
    compare_settings,
    draw_experiment,
    format_settings,
)
from psfdae_paper.evaluation.measure import MeasuredStars, read_tables


@command("paper experiment")
def experiment(
    evaluations: Annotated[tuple[File, ...], {"argument": True}],
    variant: tuple[tuple[str, str, str, int], ...],
    markdown: File,
    out: File,
) -> None:
    """Compare the settings of an experiment: means over seeds, and ratios to the first setting.

    A row of the table is a dataset, split, reference, method, noise level, metric and setting.

    Parameters
    ----------
    evaluations : sequence of Path
        CSV files of the stage evaluate, of all variants.
    variant : sequence of tuples
        Name in the evaluations, dataset, setting and seed; repeat for more.
    markdown : Path
        Markdown file with the MSE of all settings side by side.
    out : Path
        CSV.
    """
    variants = [Variant(*words) for words in variant]
    table = compare_settings(read_tables(evaluations, MeasuredStars.columns), variants)
    write_csv(out, table)
    write_text(markdown, format_settings(table, out.parent.name))


@command("paper figure experiment")
def figure_experiment(table: Annotated[Path, {"argument": True}], name: str, out: File) -> None:
    """Draw the MSE of the settings of an experiment against the noise level.

    Parameters
    ----------
    table : Path
        CSV of the stage experiment.
    name : str
        Name of the experiment.
    out : Path
        PNG.
    """
    rows: pd.DataFrame = read_table(table, *ROW, "setting", *NUMBERS)
    write_png(draw_experiment(rows, name), out)
