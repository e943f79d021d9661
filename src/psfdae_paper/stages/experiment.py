"""Stages `experiment` and `figure experiment`: settings of datasets compared over several seeds.

Inputs: evaluations of all variants of an experiment. Outputs: a table (CSV, Markdown), the
settings and a figure.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import pandas as pd
import yaml

from psfdae.base.figures import write_png
from psfdae.base.files import write_csv, write_text
from psfdae.base.options import File, Folder
from psfdae.base.reading import read_table
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.experiment import load_experiment
from psfdae_paper.evaluation.experiments import (
    NUMBERS,
    ROW,
    compare_settings,
    draw_experiment,
    format_settings,
)
from psfdae_paper.evaluation.measure import MeasuredStars, read_tables


@command("paper experiment")
def experiment(
    name: Annotated[str, {"argument": True}],
    evaluations: Annotated[tuple[File, ...], {"argument": True}],
    overrides: Annotated[tuple[str, ...], {"flag": "--override"}],
    out: Folder,
) -> None:
    """Compare the settings of an experiment: means over seeds, and ratios to the first setting.

    A row of the table is a dataset, split, reference, method, noise level, metric and setting.

    Parameters
    ----------
    name : str
        Name of a file of config/experiment.
    evaluations : sequence of Path
        CSV files of the stage evaluate, of all its variants.
    overrides : sequence of str
        Overrides of the workflow that all variants share, its preset first.
    out : Path
        Folder for errors.csv, errors.md with the MSE of all settings side by side, and
        experiment.yaml with the settings.
    """
    definition = load_experiment(name)
    rows = read_tables(evaluations, MeasuredStars.columns)
    table = compare_settings(rows, definition.variants)
    write_csv(out / "errors.csv", table)
    write_text(out / "errors.md", format_settings(table, name))
    # Unsorted: the first setting is the one that the others are divided by.
    tree = {"given": list(overrides), **definition.model_dump(exclude={"preset"})}
    write_text(out / "experiment.yaml", yaml.safe_dump(tree, sort_keys=False))


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
