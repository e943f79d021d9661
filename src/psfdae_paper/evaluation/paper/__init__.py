"""The paper's published tables as data, and tables of measured errors in the same form.

The CSV files in the folder of this module have the numbers as printed in the paper.
"""

from __future__ import annotations

from importlib import resources

import pandas as pd

from psfdae_paper.configuration.methods import list_methods


def read_paper_names() -> dict[str, str]:
    """Return the names of our methods by their names in the paper's tables."""
    return {m.look.paper[0]: m.name for m in list_methods() if m.look.paper}


def read_published(table: str) -> pd.DataFrame:
    """Read a published table: `psf`, `alignment` or `correlation`."""
    with resources.files(__package__).joinpath(f"tables_{table}.csv").open() as file:
        return pd.read_csv(file)


def paper_table(metrics: pd.DataFrame, dataset: str, metric: str) -> pd.DataFrame:
    """Return one table of the paper: its rows as published, and measured ones by reference.

    Parameters
    ----------
    metrics : DataFrame
        Tidy rows as in `psf_metrics.csv`; only split `random` is used.
    dataset, metric : str
        For example `dataset3`, `mse`.

    Returns
    -------
    DataFrame
        Columns source (paper or psfdae), reference, method, one per noise level.
        Datasets that the paper does not tabulate have rows of psfdae only. Inputs of a method in
        addition to the image follow its label in brackets; for the paper they are unknown.
    """
    # Measured errors of the methods that the paper has, on test stars of all fields.
    labels = {m.name: m.look.paper[1] for m in list_methods() if m.look.paper}
    measured_rows = metrics[
        (metrics.dataset == dataset)
        & (metrics.metric == metric)
        & (metrics.split == "random")
        & metrics.method.isin(list(labels))
    ].assign(source="psfdae")
    # The paper does not name the reference of its values.
    paper = read_published("psf")
    paper = paper[(paper.dataset == dataset) & (paper.metric == metric)].assign(
        source="paper", reference="as published"
    )
    paper["method"] = paper["method"].map(read_paper_names())
    # One row per source, reference and method, in the order of the configuration.
    rows = pd.concat([paper, measured_rows], ignore_index=True)
    rows["method"] = pd.Categorical(rows["method"], list(labels))
    keys = ["source", "reference", "method"]
    table = rows.pivot(index=keys, columns="noise_level", values="value").sort_index().reset_index()
    table["method"] = table["method"].astype(object)
    # Labels of the methods, with their inputs; columns of noise levels as text.
    inputs = table["method"].map({m.name: str(m.needs) for m in list_methods()})
    table["method"] = table["method"].map(labels) + inputs.where(table["source"] == "psfdae", "")
    table.columns = [f"{c:g}" if isinstance(c, float) else c for c in table.columns]
    return table


def format_paper_table(table: pd.DataFrame, metric: str) -> pd.DataFrame:
    """Return a table of `paper_table` as texts, MSE in scientific notation."""
    digits = ".4e" if metric == "mse" else ".4f"
    numbers = table.iloc[:, 3:].map(lambda value: format(value, digits)).add_prefix("λ = ")
    return pd.concat([table.iloc[:, :3], numbers], axis=1)
