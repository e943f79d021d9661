"""Stage `compare`: differences between finished networks or tables of errors, as Markdown.

Inputs: folders of trained networks, of whole runs, or of the run of record. Output: a text that
lists the settings that differ, the trainings, and the errors that differ by more than chance.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from tabulate import tabulate

from psfdae.base.errors import Error
from psfdae.base.files import ProductError, write_text
from psfdae.base.options import File, Folder
from psfdae.base.reading import read_table, read_yaml
from psfdae.methods import method
from psfdae.methods.interface import CONFIG, HISTORY
from psfdae_paper.configuration.command import command
from psfdae_paper.configuration.methods import list_methods
from psfdae_paper.evaluation import comparison
from psfdae_paper.evaluation.comparison import SIGNIFICANT
from psfdae_paper.evaluation.measure import CELL, read_tables
from psfdae_paper.evaluation.record_tables import compare_values, list_tables
from psfdae_paper.tracking import flatten


class ComparisonError(Error, ValueError):
    """The runs or folders that were named cannot be compared."""


@dataclass(frozen=True)
class Run:
    """A trained network with its settings and errors.

    Attributes
    ----------
    name : str
        Folder of the network.
    config : dict
        Flattened configuration.
    history : DataFrame
        Training and validation errors by epoch.
    errors : DataFrame
        Errors per star.
    """

    name: str
    config: dict[str, str]
    history: pd.DataFrame
    errors: pd.DataFrame


@command("paper compare")
def compare(
    runs: Annotated[tuple[Folder, ...], {"argument": True}], out: File | None = None
) -> None:
    """Compare the first of some RUNS with each of the others.

    A run is the folder of a trained network, such as results/dae/dataset3/random-realisation
    or a point of a sweep; of two folders of results, all networks that both have are compared. The
    text has settings that differ, the trainings, and errors with their significance. Where a folder
    has only tables, such as results/reference, the mean errors are compared: which are equal, and
    which differ by more than the scatter between seeds; then the values of all other tables, with
    the scatter of each, but no times.

    Differences are paired star by star where both runs have the same noisy images.

    Parameters
    ----------
    runs : sequence of Path
        Folders of trained networks, or of results; the first one is A.
    out : Path, optional
        File that also receives the Markdown.
    """
    if len(runs) < 2:
        raise ComparisonError("name at least two runs to compare")
    # Folders with tables alone are compared by mean errors, others star by star.
    if all(map(_tables, runs)) and not all(map(_networks, runs)):
        describers = (describe_tables, describe_further_tables)
        blocks = [describe(runs[0], folder) for folder in runs[1:] for describe in describers]
    else:
        groups = ([read_run(*paths) for paths in group] for group in _groups(runs))
        blocks = [describe(group[0], run) for group in groups for run in group[1:]]
    text = "\n\n".join(blocks) + "\n"
    if out is not None:
        write_text(out, text)
    print(text, end="")


def _networks(folder: Path) -> set[Path]:
    """Return the folders of trained networks, relative to a folder of results.

    A network is METHOD/DATASET/SPLIT-REFERENCE, with its configuration in it.
    """
    names = (m.name for m in list_methods() if m.storage and CONFIG in m.storage.files)
    paths = (path for name in names for path in folder.glob(f"{name}/*/*/{CONFIG}"))
    return {path.parent.relative_to(folder) for path in paths}


def _tables(folder: Path) -> list[Path]:
    """Return the tables of mean errors: one per evaluation of a run, or the table of a record."""
    evaluations = sorted(folder.glob("evaluation/*/*.csv"))
    return evaluations or sorted(folder.glob("tables/psf_metrics.csv"))


def _groups(folders: Sequence[Path]) -> list[list[tuple[Path, Path]]]:
    """Return the runs to compare with each other: folder of the network, table of its errors."""
    # Folders of single networks.
    if all((folder / CONFIG).is_file() for folder in folders):
        return [[(folder, find_errors(folder)) for folder in folders]]
    # Whole results: all networks that they have in common, one group for each.
    networks = [_networks(folder) for folder in folders]
    for folder, names in zip(folders, networks, strict=True):
        if not names:
            raise ComparisonError(
                f"{folder}: no {CONFIG}, no METHOD/DATASET/RUN/{CONFIG} and no "
                "tables/psf_metrics.csv in it, hence neither a trained network nor a folder of "
                "results"
            )
    # A network that only one of the results has cannot be compared.
    common = sorted(set.intersection(*networks))
    if not common:
        raise ComparisonError(f"{', '.join(map(str, folders))}: no network in common")
    return [[(folder / name, find_errors(folder / name)) for folder in folders] for name in common]


def find_errors(folder: Path) -> Path:
    """Return the path of the errors per star of a network.

    The table is in the folder of the network, as for points of a sweep, or in the folder of
    evaluations of the workflow.
    """
    table = folder / "evaluation.parquet"
    if table.is_file():
        return table
    # Of the workflow: METHOD/DATASET/RUN and evaluation/DATASET/RUN.parquet.
    absolute = folder.resolve()
    if len(absolute.parents) < 3:
        raise ComparisonError(f"{folder}: no evaluation.parquet in it")
    return absolute.parents[2] / "evaluation" / absolute.parent.name / f"{absolute.name}.parquet"


def read_run(folder: Path, errors: Path) -> Run:
    """Read a network's settings, training history and errors per star; raises ProductError."""
    # Settings and history are in the folder of the network, its errors in the evaluation.
    config = read_yaml(folder / CONFIG)
    columns = ("epoch", "train_mse", "validation_mse", "seconds")
    # Some cells may be empty, hence text that is converted below.
    history = read_table(folder / HISTORY, *columns, dtype=str)
    # A trained network may lack its evaluation.
    if not errors.exists():
        raise ProductError(f"{errors}: no such file; evaluate the run first")
    history = history.apply(pd.to_numeric, errors="coerce")
    return Run(str(folder), flatten(config), history, read_table(errors))


def describe(first: Run, second: Run) -> str:
    """Return the differences between two runs as Markdown."""
    scatter = comparison.read_seed_scatter()
    errors = comparison.compare_evaluations(first.errors, second.errors, scatter)
    # Difference ± its standard error ± the scatter between seeds, unless that is NaN.
    rows = []
    row: Any
    for row in errors.itertuples(index=False):
        seeds = "" if np.isnan(row.seed_stderr) else f" ± {row.seed_stderr:.2g}"
        difference = f"{row.difference:+.3g} ± {row.stderr:.2g}{seeds}"
        rows.append((*row[:5], difference, row.sigmas, row.verdict))
    headers = ["metric", "method", "λ", "A", "B", "B − A", "standard errors", "B is"]
    # Validation errors of both trainings, and their durations.
    curves = [comparison.summarise_training(run.history) for run in (first, second)]
    # Errors on the same noisy images are paired, which removes most of their scatter.
    is_paired = comparison.share_noisy_stars(first.errors, second.errors)
    pairing = "star by star on the same noisy images" if is_paired else "as independent samples"
    # Numbers of stars among the settings: errors of tiny trials do not compare with a full run.
    settings = comparison.compare_settings(first.config, second.config)
    sizes = [row for row in settings if row[0] in ("parts.train_stars", "parts.test_stars")]
    # Errors to templates and to realisations have different truths.
    references = {run.config.get("reference", "") for run in (first, second)}
    warning = "The runs have different references: their errors are not comparable.\n\n"
    return "\n\n".join(
        [
            f"# {first.name} (A) and {second.name} (B)",
            *warn_about_sizes(sizes),
            "## Settings that differ",
            _table(settings, ["setting", "A", "B"]),
            "## Training",
            _table([(key, curves[0][key], curves[1][key]) for key in curves[0]], ["", "A", "B"]),
            f"## Errors, {pairing}",
            ("" if len(references) == 1 else warning)
            + "B − A ± standard error clustered by field ± scatter between seeds. B is better or "
            f"worse if the difference is {SIGNIFICANT:g} times both together. Where the scatter "
            "was not measured (`snakemake seeds`), it is missing, and the standard error decides.",
            _table(rows, headers),
        ]
    )


def warn_about_sizes(sizes: Iterable[tuple[str, object, object]]) -> list[str]:
    """Return a paragraph of warning if two runs have other numbers of stars; none if equal.

    Parameters
    ----------
    sizes : iterable of tuples
        Name of a number of stars, and its values in both runs.

    Returns
    -------
    list of str
        One paragraph of Markdown, or none.
    """
    differences = [f"{name} {first} (A), {second} (B)" for name, first, second in sizes]
    return [
        "> **NOT COMPARABLE: the runs have different numbers of stars**, as a run of the preset "
        f"smoke and a full run do: {'; '.join(differences)}."
    ][: len(differences)]


def describe_tables(first: Path, second: Path) -> str:
    """Return as Markdown the mean errors of two runs that differ by more than seeds do.

    Parameters
    ----------
    first, second : Path
        Folders A and B, each with tables of mean errors.

    Returns
    -------
    str
        Numbers of rows that are equal, within the scatter between seeds, or beyond it (these are
        listed); and whether the order of the paper's methods holds.

    Raises
    ------
    ProductError
        If a table is missing or damaged.
    """
    columns = [*CELL, "method", "metric", "value", "stderr", "n"]
    first_errors, second_errors = (read_tables(_tables(run), columns) for run in (first, second))
    # Another kind of processor rounds differently; nearly all such differences are below a tenth
    # of a standard error. The paper concludes that errors ascend from the DAE to the noisy image.
    negligible, ascending = 0.1, ("dae", "pca_som", "noisy")
    rows, order = comparison.compare_tables(
        first_errors, second_errors, comparison.read_seed_scatter(), negligible, ascending
    )
    # The paper's methods by increasing error, as it names them.
    looks = [method(name).look for name in ascending]
    names = " < ".join(look.paper[1] for look in looks if look.paper)
    verdict_texts = {
        "equal": "are equal to the last digit",
        "rounding": f"differ by less than {negligible:g} of the standard error of the test stars, "
        "as by the rounding of another kind of processor",
        "within": f"differ within the scatter between seeds ({SIGNIFICANT:g} standard deviations "
        "of the difference of two fits)",
        "beyond": "differ by more",
        "not measured": "differ, but their scatter between seeds was not measured",
    }
    # Numbers of rows by verdict; rows that differ are listed.
    lines = [f"# {first} (A) and {second} (B)", ""]
    other_sizes = rows.loc[rows.n_first != rows.n_second, ["n_first", "n_second"]].head(1)
    for warning in warn_about_sizes(("test stars", *row) for row in other_sizes.to_numpy()):
        lines += [warning, ""]
    counts = f"A has {len(first_errors)}, B {len(second_errors)}"
    lines += [f"{len(rows)} mean errors are in both ({counts})."]
    for verdict, text in verdict_texts.items():
        # A line for each verdict, also without rows.
        verdict_rows = rows[rows.verdict == verdict]
        lines += [f"- {len(verdict_rows)} {text}"]
        if verdict in ("beyond", "not measured"):
            lines += [f"  - {line}" for line in _row_lines(verdict_rows)]
    lines += [
        f"- The paper's order by MSE, {names}, holds in {order['first'].sum()} of {len(order)} "
        f"columns of A and in {order['second'].sum()} of B; {order.exchanged.sum()} have two of "
        "them exchanged, beyond the scatter"
    ]
    lines += [f"  - {_cell(key)}" for key in order.index[order.exchanged]]
    return "\n".join(lines)


def describe_further_tables(first: Path, second: Path) -> str:
    """Return as Markdown the tables that differ by more than their scatter, without mean errors.

    Parameters
    ----------
    first, second : Path
        Folders A and B, each with tables.

    Returns
    -------
    str
        A line for each table that differs, with its first values that do.

    Raises
    ------
    ProductError
        If a table is damaged.
    """
    # The mean errors are compared by `describe_tables`, with the scatter between seeds.
    names, other_names = (list_tables(run) - {"tables/psf_metrics.csv"} for run in (first, second))
    tables = {name: compare_values(first, second, name) for name in sorted(names & other_names)}
    lines, shown = [], 4
    for name, values in tables.items():
        # Values that differ, then rows without a counterpart.
        differing = values[values.verdict == "beyond"]
        missing = int((values.verdict == "missing").sum())
        if missing or len(differing):
            counts = f"{len(differing)} of {len(values) - missing} values differ by more than their"
            lone_rows = f"; {missing} rows are in one alone" if missing else ""
            lines += [f"- **{name}**: {counts} scatter{lone_rows}"]
        rows = differing.head(shown).itertuples()
        lines += [f"  - {row.row}: {row.column} {row.first} (A), {row.second} (B)" for row in rows]
        lines += [f"  - and {len(differing) - shown} more"] * (len(differing) > shown)
    equal = sum((values.verdict == "equal").all() for values in tables.values())
    summary = f"{len(tables)} further tables are in both; {equal} are equal to the last digit."
    lone = sorted(other_names - names)
    lines += [f"- Not in A: {', '.join(lone)}"] * bool(lone)
    return "\n".join(["## Further tables", "", summary, *lines])


def _row_lines(rows: pd.DataFrame) -> list[str]:
    """Return a line of text for each dataset, split and reference of a table of errors.

    Parameters
    ----------
    rows : DataFrame
        With dataset, split, reference, method, metric and noise_level.
    """
    lines = []
    for key, cell in rows.groupby(["dataset", "split", "reference"], sort=False):
        # Metrics of a method that differ at the same noise levels are named together.
        metrics: dict[str, list[str]] = {}
        for (name, metric), part in cell.groupby(["method", "metric"], sort=False):
            levels = ", ".join(f"{level:g}" for level in part.noise_level)
            metrics.setdefault(f"{name} at λ = {levels}", []).append(str(metric))
        texts = (f"{name} ({', '.join(names)})" for name, names in metrics.items())
        lines.append(f"{_cell(key)}: {'; '.join(texts)}")
    return lines


def _cell(key: Sequence[Any]) -> str:
    """Return dataset, split, reference and, if given, noise level as text."""
    return ", ".join([*key[:3], *(f"λ = {level:g}" for level in key[3:])])


def _table(rows: Sequence[Sequence[object]], headers: Sequence[str]) -> str:
    """Return a Markdown table, or "None." without rows.

    Parameters
    ----------
    rows : sequence of sequences
        Texts and numbers, the latter with four digits.
    headers : sequence of str
        Name of each column.
    """
    if not rows:
        return "None."
    return tabulate(rows, headers, tablefmt="github", floatfmt=".4g", disable_numparse=[0])
