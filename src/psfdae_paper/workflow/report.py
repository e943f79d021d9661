"""Answers for the first page of the report (workflow/report/workflow.rst)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from inspect import getdoc
from pathlib import Path
from typing import Protocol

from psfdae.methods import method
from psfdae_paper.configuration.estimators import ESTIMATORS
from psfdae_paper.workflow.fits import method_names
from psfdae_paper.workflow.run import Run, list_default_datasets

HEADLINE_DATASET = "dataset3"
"""The dataset of the headline figure."""


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
    files = [
        file
        for subcategories in categories.values()
        for group in subcategories.values()
        for file in group
        if file.path.match(pattern)
    ]
    # False sorts before True: the headline dataset comes first, then the order of the paths.
    return min(
        files,
        key=lambda file: (HEADLINE_DATASET not in file.path.parts, str(file.path)),
        default=None,
    )


def list_method_summaries(run: Run) -> dict[str, str]:
    """Return the first sentence of the module of each method of the datasets, by its label."""
    # A dictionary keeps the order of tables and drops repeats.
    names = dict.fromkeys(
        n for dataset in list_default_datasets(run) for n in method_names(run, dataset)
    )
    texts = {}
    for kind in map(method, names):
        # The first paragraph of a module's docstring is one sentence.
        text = getdoc(import_module(kind.__module__)) or ""
        texts[kind.look.label] = text.partition("\n\n")[0].replace("\n", " ")
    return texts


def list_estimator_labels() -> list[str]:
    """Return the labels of the methods of scene 3 that estimate states."""
    return [estimator.look.label for estimator in ESTIMATORS.values() if estimator.network]
