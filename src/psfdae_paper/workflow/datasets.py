"""Files of datasets and scenes: stars, evaluations, tables, figures, products of a target."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import product
from typing import Any

from psfdae.base.reading import read_yaml
from psfdae.base.settings import ConfigError
from psfdae_paper.configuration.base import config_dir
from psfdae_paper.configuration.compose import hash_groups, list_datasets
from psfdae_paper.configuration.consistency import SIMULATION, STATIC
from psfdae_paper.workflow.fits import bundle_files, histories, method_names
from psfdae_paper.workflow.run import (
    SCENE3,
    Run,
    Wildcards,
    compose_choice,
    exit_in_one_line,
    list_default_datasets,
    load_dataset_config,
    remove_module_name,
)

OWN_STARS = "from_stars"
"""The dataset whose stars come from an image instead of a simulation."""
METRICS = ("ssim", "mse")
TABLE_DATASETS = ("dataset3", "dataset5", "dataset8")
"""The datasets that the paper tabulates; the calibration compares with their rows."""
SHIPPED_DATASET = "field"
"""The stars and the training of the model that comes with the package."""
SCENE_HEADINGS = {
    "scene1": "Scene 1: field-dependent aberrations",
    "scene2": "Scene 2: static turbulence",
    "scene3": "Scene 3: alignment of a mirror",
    "own_telescope": "Own telescopes",
}
"""Headings of the report."""


def list_simulated_datasets() -> list[str]:
    """Return the datasets with simulated stars."""
    return [name for name in list_datasets() if name not in (OWN_STARS, SCENE3)]


def list_datasets_except(names: Iterable[str]) -> list[str]:
    """Return the simulated datasets without a rule of their name among these.

    In another project's workflow, the name of the module and an underscore come before it.
    """
    return sorted(set(list_simulated_datasets()) - remove_module_name(names, "dataset1"))


def list_compared_methods(run: Run) -> list[str]:
    """Return the methods of the example of an image: methods of the datasets and of own stars.

    The command leaves out the methods that take long; here all are compared.
    """
    # One dataset is enough: all simulated ones have the same methods by default.
    datasets = (list_default_datasets(run)[0], OWN_STARS)
    return list(dict.fromkeys(name for d in datasets for name in method_names(run, d)))


@cache
def _owners() -> tuple[dict[str, str], dict[str, str]]:
    """Return the first dataset of each set of stars, and of each scene.

    The files are read without their defaults, which takes a hundredth of the time of their
    composition. A dataset with the stars of another one does not name them itself.
    Datasets of the default target come first, so that a further one does not become the first.
    """
    stars: dict[str, str] = {}
    scenes: dict[str, str] = {}
    defaults = read_yaml(config_dir() / "config.yaml")["workflow"]["datasets"]
    for dataset in dict.fromkeys([*defaults, *list_simulated_datasets()]):
        # A dataset without a file is rejected when it is composed, with a better message.
        path = config_dir() / f"dataset/{dataset}.yaml"
        tree = read_yaml(path) if path.is_file() else {}
        # Stars of an own telescope have the name of their dataset.
        name = (tree.get("stars") or {}).get("name") or dataset
        stars.setdefault(name, dataset)
        # The scene is an entry of Hydra's list of defaults, such as `/scene: seidel`.
        for entry in tree.get("defaults", []):
            if isinstance(entry, dict) and "/scene" in entry:
                scenes.setdefault(entry["/scene"], dataset)
    return stars, scenes


def list_scenes() -> list[str]:
    """Return the names of the scenes of the paper."""
    return sorted(_owners()[1])


@cache
@exit_in_one_line()
def scene_folder(run: Run, dataset: str) -> str:
    """Return the name of the folder of a dataset's static PSFs and stars.

    It is the name of the scene, whose first dataset computes the PSFs for all datasets with the
    same settings. A dataset with other settings has a folder whose name ends in their hash.
    """
    tree = compose_choice(run, f"dataset={dataset}")
    name, digest = tree["scene"]["name"], _hash_static(tree)
    owner = _owners()[1].get(name)
    is_shared = owner and digest == _hash_static(compose_choice(run, f"dataset={owner}"))
    return name if is_shared else f"{name}_{digest[:8]}"


def _hash_static(tree: dict[str, Any]) -> str:
    """Return the hash of the settings that decide the static PSFs."""
    # The position in a pixel belongs to single stars.
    return hash_groups(STATIC, {**tree, "framing": {**tree["framing"], "subpixel": False}})


@cache
@exit_in_one_line()
def star_set(run: Run, dataset: str) -> str:
    """Return the name of a dataset's file of stars.

    It is `stars.name`, if the first dataset with this name has the same settings of the simulation;
    else their hash follows the name.
    """
    tree = compose_choice(run, f"dataset={dataset}")
    name, digest = tree["stars"]["name"], hash_groups(SIMULATION, tree)
    owner = _owners()[0].get(name)
    is_shared = owner and digest == hash_groups(SIMULATION, compose_choice(run, f"dataset={owner}"))
    return name if is_shared else f"{name}_{digest[:8]}"


@cache
def stars_choice(run: Run, stars: str) -> str:
    """Return the override that chooses a dataset by which a file of stars is simulated."""
    return f"dataset={_find_dataset(run, stars, _owners()[0], star_set)}"


@cache
def scene_choice(run: Run, scene: str) -> str:
    """Return the override that chooses a dataset by which static PSFs are computed."""
    return f"dataset={_find_dataset(run, scene, _owners()[1], scene_folder)}"


@exit_in_one_line()
def _find_dataset(
    run: Run, name: str, owners: dict[str, str], name_of: Callable[[Run, str], str]
) -> str:
    """Return the owner of a name, or the first dataset that has it by a function."""
    # Datasets are composed one after the other, only for names with a hash.
    candidates = [*list_simulated_datasets(), *(variant.name for variant in run.variants)]
    matches = (d for d in candidates if name_of(run, d) == name)
    if dataset := owners.get(name) or next(matches, None):
        return dataset
    raise ConfigError(f"{run.results}/data: no dataset has {name}")


def templates_file(run: Run, dataset: str) -> str:
    """Return the static PSFs of a dataset."""
    return f"{run.results}/data/{scene_folder(run, dataset)}/templates.h5"


@cache
def stars_file(run: Run, dataset: str) -> str:
    """Return the stars of a dataset, which datasets with the same simulation share.

    Parameters
    ----------
    run : Run
        Run of the job.
    dataset : str
        Option of the group dataset.
    """
    # A wrong key ends the program with the dataset's name.
    load_dataset_config(run, dataset)
    return f"{run.results}/data/{scene_folder(run, dataset)}/{star_set(run, dataset)}.h5"


def networks(run: Run, dataset: str) -> list[tuple[str, str]]:
    """Return split and reference of each network of a dataset."""
    group = load_dataset_config(run, dataset).dataset
    return list(product(group.splits, group.references))


def evaluations(run: Run, dataset: str, splits: Sequence[str] = ()) -> list[str]:
    """Return the evaluations (CSV) of a dataset, of all its splits unless some are named."""
    return [
        f"{run.results}/evaluation/{dataset}/{split_name}-{reference}.csv"
        for split_name, reference in networks(run, dataset)
        if not splits or split_name in splits
    ]


def star_errors(run: Run, dataset: str, splits: Sequence[str] = ()) -> list[str]:
    """Return the errors of the methods on single test stars (parquet), as `evaluations`."""
    # The stage writes both files of an evaluation, with the same stem.
    files = evaluations(run, dataset, splits)
    return [csv.removesuffix(".csv") + ".parquet" for csv in files]


def paper_tables(run: Run, dataset: str) -> list[str]:
    """Return the paper's tables of a dataset, as CSV and as Markdown."""
    # CSV for programs, Markdown for the report and the pages.
    stems = [f"{run.results}/tables/{dataset}_{metric}" for metric in METRICS]
    return [f"{stem}.{ending}" for stem in stems for ending in ("csv", "md")]


def metric_options(wildcards: Wildcards, output: Any) -> list[str]:
    """Return the options of a command that makes a file of each metric."""
    return [f"--out {metric} {output[metric]}" for metric in METRICS]


def shown_levels(run: Run, dataset: str) -> list[float]:
    """Return the noise levels λ of the figure of denoised stars.

    These are the levels `dataset.shown_levels` that the noise band has, or its extremes.
    """
    config = load_dataset_config(run, dataset)
    band = config.noise.levels
    # Overrides may change the band so that the levels of the figure are outside it.
    band_levels = [level for level in config.dataset.shown_levels if level in band]
    return band_levels or sorted({min(band), max(band)})


def report_category(run: Run, wildcards: Wildcards) -> str:
    """Return the heading of a figure in the report: its scene."""
    # Figures of templates belong to a scene, all others to a dataset: rules have either wildcard.
    experiment: str
    if "scene" in wildcards.keys():  # type: ignore[operator]  # noqa: SIM118 (a named list)
        choice = scene_choice(run, wildcards.scene)
        experiment = compose_choice(run, choice)["scene"]["experiment"]
    else:
        experiment = load_dataset_config(run, wildcards.dataset).scene.experiment
    return SCENE_HEADINGS.get(experiment, experiment)


def has_own_telescope(run: Run, dataset: str) -> bool:
    """Return True if a dataset has a telescope with aberrations of its own."""
    return bool(load_dataset_config(run, dataset).scene.name == "telescope")


def figures(run: Run, dataset: str) -> list[str]:
    """Return the figures of a dataset and of its scene, or of its own telescope."""
    config, folder = load_dataset_config(run, dataset), f"{run.results}/figures"
    # Own telescopes are not in the paper: one figure of their field replaces two of the scene.
    if has_own_telescope(run, dataset):
        fields = [f"telescope/{dataset}"]
    else:
        fields = [f"{scene_folder(run, dataset)}/{name}" for name in ("templates", "energy")]
    return [
        *(f"{folder}/{field}.png" for field in fields),
        *([f"{folder}/{dataset}/curves.png"] if histories(run, dataset) else []),
        *(f"{folder}/{dataset}/errors_{metric}.png" for metric in METRICS),
        *(f"{folder}/{dataset}/strip_{r}.png" for r in config.dataset.references),
    ]


def products(run: Run, dataset: str) -> list[str]:
    """Return all files that the target of a dataset builds."""
    # Models of own telescopes are for use on images; models of the paper are packed on request.
    # Model files have errors for Poisson noise only.
    is_poisson = load_dataset_config(run, dataset).noise.law == "poisson"
    has_bundles = has_own_telescope(run, dataset) and is_poisson
    return [
        *(bundle_files(run, dataset, networks(run, dataset)) if has_bundles else []),
        *evaluations(run, dataset),
        *paper_tables(run, dataset),
        *figures(run, dataset),
        f"{run.results}/mlflow/{dataset}.csv",
    ]


def default_products(run: Run, experiment: str = "") -> list[str]:
    """Return all files of the datasets of the default target, or of one scene among them."""
    return [
        file
        for dataset in list_default_datasets(run)
        if not experiment or load_dataset_config(run, dataset).scene.experiment == experiment
        for file in products(run, dataset)
    ]
