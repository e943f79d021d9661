"""The paper's published tables as data, and tables of ours in the same shape."""

from __future__ import annotations

from importlib import resources

import pandas as pd

from psfdae_paper.configuration.methods import registered


def paper_rows() -> dict[str, str]:
    """Rows of the paper's tables and our name of the method."""
    return {kind.look.paper[0]: kind.name for kind in registered() if kind.look.paper}


def published(table: str) -> pd.DataFrame:
    """A published table: `psf`, `alignment` or `correlation`."""
    with resources.files(__package__).joinpath(f"tables_{table}.csv").open() as file:
        return pd.read_csv(file)


def paper_table(metrics: pd.DataFrame, dataset: str, metric: str) -> pd.DataFrame:
    """One table of the paper: its rows as published and ours for each reference.

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
        The paper has no rows for datasets that it does not tabulate. Our methods say in brackets
        what they are given beside the image; of the paper's that is not known.
    """
    labels = {kind.name: kind.look.paper[1] for kind in registered() if kind.look.paper}
    ours = metrics[
        (metrics.dataset == dataset)
        & (metrics.metric == metric)
        & (metrics.split == "random")
        & metrics.method.isin(list(labels))
    ].assign(source="psfdae")
    paper = published("psf")
    paper = paper[(paper.dataset == dataset) & (paper.metric == metric)].assign(
        source="paper", reference="as published"
    )
    paper["method"] = paper["method"].map(paper_rows())
    both = pd.concat([paper, ours], ignore_index=True)
    both["order"] = both["method"].map({method: i for i, method in enumerate(labels)})
    wide = both.pivot(
        index=["source", "reference", "order", "method"], columns="noise_level", values="value"
    )
    wide = wide.reset_index().drop(columns="order")
    given = wide["method"].map({kind.name: str(kind.needs) for kind in registered()})
    wide["method"] = wide["method"].map(labels) + given.where(wide["source"] == "psfdae", "")
    wide.columns = [f"{c:g}" if isinstance(c, float) else c for c in wide.columns]
    return wide


def as_markdown(table: pd.DataFrame, dataset: str, metric: str) -> str:
    """A paper-shaped table as Markdown, errors in scientific notation."""
    digits = ".4e" if metric == "mse" else ".4f"
    shown = table.copy()
    for column in shown.columns[3:]:
        shown[column] = shown[column].map(lambda value: format(value, digits))
    shown.columns = [*shown.columns[:3], *(f"λ = {c}" for c in shown.columns[3:])]
    body = shown.to_markdown(index=False, disable_numparse=True)
    return f"{metric.upper()} of {dataset}, split random\n\n{body}\n"
