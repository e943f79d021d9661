"""Files of the lower bounds of errors, and of the estimates by the optics of the telescope."""

from __future__ import annotations

from psfdae_paper.workflow.datasets import star_set
from psfdae_paper.workflow.run import (
    Run,
    exit_in_one_line,
    list_default_datasets,
    load_dataset_config,
)


def dataset_files(run: Run, ending: str) -> list[str]:
    """Return the bounds of the datasets of the default target.

    The ending is ".csv" for means, "_growth.csv" for banks of several sizes, or ".parquet" for
    single stars.
    """
    for dataset in list_default_datasets(run):
        with exit_in_one_line(f"dataset={dataset}: "):
            load_dataset_config(run, dataset).noise.require_poisson("bounds hold")
    return [f"{run.results}/bounds/{dataset}{ending}" for dataset in list_default_datasets(run)]


def has_bank(run: Run, dataset: str) -> bool:
    """Return True if stars have random aberrations, of which a bank is drawn."""
    # Other stars are their templates: the sum over all of them is exact, without samples.
    return bool(load_dataset_config(run, dataset).stars.aberration_fraction > 0)


def bank_files(run: Run, dataset: str) -> list[str]:
    """Return the bank of simulated stars of a dataset, if it has one."""
    # Datasets with the same stars differ in noise only, and share the bank.
    stars = star_set(run, dataset)
    return [f"{run.results}/bounds/bank/{stars}.h5"] if has_bank(run, dataset) else []


def optics_files(run: Run, dataset: str, ending: str) -> list[str]:
    """Return the errors of the methods that know the telescope, if there is a bank.

    The ending is "csv" for means, or "parquet" for single stars.
    """
    return [f"{run.results}/wavefront/{dataset}.{ending}"] if has_bank(run, dataset) else []


def bound_figures(run: Run, dataset: str) -> list[str]:
    """Return the figures of a dataset's bounds."""
    kinds = ["errors", "efficiency"] + (["growth"] if has_bank(run, dataset) else [])
    return [f"{run.results}/figures/bounds/{dataset}_{kind}.png" for kind in kinds]
