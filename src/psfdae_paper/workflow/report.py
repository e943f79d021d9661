"""Identity of a run, its differences from the paper, and answers for the report's first page.

The first page is workflow/report/workflow.rst.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from inspect import getdoc
from itertools import chain
from pathlib import Path
from typing import Protocol

from psfdae.base.reading import read_table, read_yaml
from psfdae.base.settings import as_literal, dump_deciding, leaves
from psfdae.methods import method
from psfdae_paper.configuration.estimators import ESTIMATORS
from psfdae_paper.workflow.fits import method_names
from psfdae_paper.workflow.run import SCENE3, Run, list_default_datasets, load_dataset_config

HEADLINE_DATASET = "dataset3"
"""The dataset of the headline figure."""

DATA = {
    *("seed", "scene", "telescope", "grid", "wavefront", "stars", "framing", "optics"),
    *("noise", "parts", "prescription", "alignment"),
}
"""Groups of the configuration that decide the stars of a dataset, or the states of scene 3."""

Differences = dict[str, list[str]]
"""Settings that differ from the paper's by what they decide, "data" or "training"."""


def describe_run(run: Run) -> dict[str, str]:
    """Return preset, overrides, commit, date and machine of a run, by these names."""
    # The record of the last run that finished in this folder.
    path = Path(run.results, "run.yaml")
    record = read_yaml(path) if path.is_file() else {}
    missing = "not recorded: no run has finished in this folder"
    return {
        "preset": run.preset,
        "overrides": shlex.join(run.overrides[1:]) or "none",
        **{key: str(record.get(key, missing)) for key in ("commit", "date", "machine")},
    }


@cache
def find_differences(run: Run, dataset: str) -> Differences:
    """Return how the settings of a dataset differ from the preset `paper` without overrides.

    Parameters
    ----------
    run : Run
        The run.
    dataset : str
        Option of the group dataset; or variant of an experiment, compared with its dataset.

    Returns
    -------
    dict
        Texts such as "train.epochs = 8 instead of 100", the shortest first. Settings that no result
        depends on, and settings of methods that the dataset does not have, are left out.
    """
    # The same dataset with the paper's settings.
    base = {variant.name: variant.dataset for variant in run.variants}.get(dataset, dataset)
    paper_run = Run("paper", ("preset=paper",), run.results)
    values, paper_values = (
        dict(leaves(dump_deciding(load_dataset_config(*choice))))
        for choice in ((run, dataset), (paper_run, base))
    )
    # Scene 3 has only groups of its own; other datasets also have groups of targets on request.
    groups = {key.partition(".")[0] for key in values}
    if dataset != SCENE3:
        names = method_names(run, dataset)
        groups &= DATA.union(*(method(name).groups for name in names))
    texts: Differences = {"data": [], "training": []}
    for key, value in values.items():
        group = key.partition(".")[0]
        if group in groups - {"workflow", "dataset"} and value != paper_values.get(key):
            # Values as a user writes them, such as null.
            text = f"{key} = {as_literal(value)}"
            text += (
                f" instead of {as_literal(paper_values[key])}"
                if key in paper_values
                else ", not in paper"
            )
            texts["data" if group in DATA else "training"].append(text)
    # Single numbers before long lists.
    return {kind: sorted(differences, key=len) for kind, differences in texts.items()}


def describe_differences(run: Run, dataset: str) -> str:
    """Return a line on the differences of `find_differences`; empty without any.

    The first difference of data and of training stands for all.
    """
    parts = [
        f"not the paper's {kind}: {texts[0]}" + f" and {len(texts) - 1} more" * (len(texts) > 1)
        for kind, texts in find_differences(run, dataset).items()
        if texts
    ]
    text = "; ".join(parts)
    return text[:1].upper() + text[1:]


def list_warnings(run: Run) -> list[str]:
    """Return lines that name datasets of a run and say how they differ from the paper."""
    # Datasets with the same differences share a line.
    groups: dict[str, list[str]] = {}
    for dataset in (*list_default_datasets(run), SCENE3):
        if text := describe_differences(run, dataset):
            groups.setdefault(text, []).append("scene 3" if dataset == SCENE3 else dataset)
    return [f"{', '.join(names)}: {text}" for text, names in groups.items()]


def describe_training(run: Run, dataset: str) -> str:
    """Return the numbers of stars and noise levels of a dataset's trainings, in words."""
    config = load_dataset_config(run, dataset)
    parts = config.parts
    return (
        f"{parts.train_stars} stars of the split random, of which "
        f"{parts.validation_fraction:.0%} validate, at {len(config.noise.levels)} noise levels"
    )


def list_table_rows(run: Run, dataset: str) -> list[list[str]]:
    """Return the MSE of the paper's methods and of ours, × 10⁶, with headings; empty without.

    Parameters
    ----------
    run : Run
        The run.
    dataset : str
        Dataset of the table.
    """
    path = Path(run.results, f"tables/{dataset}_mse.csv")
    if not path.is_file():
        return []
    table = read_table(path, "source", "reference", "method")
    # Three columns of texts come before the noise levels.
    heading = [*table.columns[:3], *(f"λ = {level}" for level in table.columns[3:])]
    rows = [[*row[:3], *(f"{1e6 * x:.4g}" for x in row[3:])] for row in table.to_numpy()]
    return [heading, *rows]


class ReportFile(Protocol):
    """File of the report."""

    path: Path


def find_headline_file(
    categories: Mapping[str, Mapping[str, Sequence[ReportFile]]], pattern: str
) -> ReportFile | None:
    """Return the file of the report that matches a pattern, of `HEADLINE_DATASET` if possible.

    Snakemake's own list of files has only one of each name.
    """
    # Snakemake groups the files of a report by category and subcategory.
    groups = chain.from_iterable(category.values() for category in categories.values())
    files = [file for file in chain.from_iterable(groups) if file.path.match(pattern)]
    # False sorts before True: the headline dataset comes first, then the order of the paths.
    files.sort(key=lambda file: (HEADLINE_DATASET not in file.path.parts, str(file.path)))
    return files[0] if files else None


def list_method_summaries(run: Run) -> dict[str, str]:
    """Return the first sentence of the module of each method of the datasets, by its label."""
    # A dictionary keeps the order of tables and drops repeats.
    names = chain.from_iterable(method_names(run, d) for d in list_default_datasets(run))
    texts = {}
    for kind in map(method, dict.fromkeys(names)):
        # The first paragraph of a module's docstring is one sentence.
        text = getdoc(import_module(kind.__module__)) or ""
        texts[kind.look.label] = text.partition("\n\n")[0].replace("\n", " ")
    return texts


def list_estimator_labels() -> list[str]:
    """Return the labels of the methods of scene 3 that estimate states."""
    return [estimator.look.label for estimator in ESTIMATORS.values() if estimator.network]
