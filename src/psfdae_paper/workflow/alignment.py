"""Files of scene 3: states of misalignment, networks that estimate them, and fits."""

from __future__ import annotations

from psfdae_paper.configuration.estimators import ESTIMATORS
from psfdae_paper.configuration.schema import Config
from psfdae_paper.workflow.run import SCENE3, Run, load_dataset_config

TEST_SETS = ("uniform", "grid")
PAPER_TABLES = ("0.002", "0.005", "correlation")
"""Tables that the paper prints: errors at two noise levels, and correlations."""


def load_alignment_config(run: Run) -> Config:
    """Return the checked configuration of scene 3; a wrong key ends the program."""
    return load_dataset_config(run, SCENE3)


def training_states(run: Run, network: str) -> str:
    """Return the states on which a network is trained."""
    return f"{run.results}/data/alignment/{ESTIMATORS[network].states}.h5"


def network_dae(run: Run, network: str) -> list[str]:
    """Return the weights of the DAE, if a network is trained on its output."""
    # An empty list adds no input to the rule, which trains networks with and without the DAE.
    weights = f"{run.results}/alignment/dae/dae.safetensors"
    return [weights] if ESTIMATORS[network].uses_dae else []


def network_files(run: Run, name: str, weights: str) -> dict[str, str]:
    """Return the files of a training by the names of a rule's outputs.

    Parameters
    ----------
    run : Run
        Run of the training.
    name : str
        Network, or "dae".
    weights : str
        Name of the file with the weights.
    """
    folder = f"{run.results}/alignment/{name}"
    files = ("config.yaml", "trained_on.yaml", "history.csv")
    # Outputs have the names of their files, so that a rule can address each of them.
    paths = {file.partition(".")[0]: f"{folder}/{file}" for file in files}
    return {"weights": f"{folder}/{weights}", **paths}


def likelihood_network(run: Run) -> str:
    """Return the weights of the network at whose estimates the fits start."""
    return f"{run.results}/alignment/{ESTIMATORS['max_likelihood'].network}/network.safetensors"


def fit_files(run: Run, *test_sets: str, ending: str = ".h5") -> list[str]:
    """Return the fits of test sets at all noise levels; their times have the ending _times.csv."""
    # A job for each noise level: fits of single states are slow, and levels are independent.
    levels = [f"{level:g}" for level in load_alignment_config(run).noise.levels]
    folder = f"{run.results}/alignment/fits"
    return [f"{folder}/{name}_{level}{ending}" for name in test_sets for level in levels]
