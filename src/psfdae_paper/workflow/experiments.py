"""Files of an experiment: evaluations of its variants, their table and figure."""

from __future__ import annotations

from psfdae.base.settings import ConfigError
from psfdae_paper.configuration.experiment import list_experiments
from psfdae_paper.workflow.datasets import evaluations, stars_file
from psfdae_paper.workflow.run import Run, exit_in_one_line


def experiment_evaluations(run: Run) -> list[str]:
    """Return the evaluations (CSV) of all variants of the experiment."""
    return [csv for variant in run.variants for csv in evaluations(run, variant.name)]


def variant_stars(run: Run) -> list[str]:
    """Return the options of a command with the stars of each variant of the experiment."""
    return [f"--stars {variant.name} {stars_file(run, variant.name)}" for variant in run.variants]


@exit_in_one_line()
def experiment_products(run: Run) -> list[str]:
    """Return all files that the target experiment builds."""
    if not run.experiment:
        names = ", ".join(list_experiments())
        raise ConfigError(f"which experiment? --config name=NAME, one of {names}")
    folder = f"{run.results}/experiments/{run.experiment}"
    return [
        *(f"{folder}/{file}" for file in ("errors.csv", "errors.md", "errors.png")),
        f"{run.results}/mlflow/experiment_{run.experiment}.csv",
    ]
