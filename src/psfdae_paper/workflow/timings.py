"""Files of the timings: errors against time, and the numbers of stars of some programs."""

from __future__ import annotations

from functools import cache
from typing import Any

from psfdae.methods import fit_files, method
from psfdae_paper.workflow.datasets import list_scenes, list_simulated_datasets, scene_folder
from psfdae_paper.workflow.fits import bundle_file, bundle_files, method_names
from psfdae_paper.workflow.run import (
    Run,
    Wildcards,
    exit_in_one_line,
    import_benchmark,
    load_dataset_config,
)

BUNDLE_FITS = (("random", "realisation"),)
"""Split and reference of the fits that are packed as bundles."""
POPPY_STARS = 1500


@cache
@exit_in_one_line()
def load_timing_points() -> Any:
    """Return the datasets, methods and settings whose error is measured against their time."""
    # The points are a file of the benchmarks, not of the configuration: only they read it.
    return import_benchmark("costs").load_points()


def get_timing_dataset() -> str:
    """Return the dataset that most programs measure, the first of `points.yaml`."""
    return str(load_timing_points().datasets[0])


def cost_tables(run: Run) -> list[str]:
    """Return the tables of all methods and settings whose error is set against their time."""
    # Methods that do not denoise are left out, unless the file lists them as further methods.
    points = load_timing_points()
    return [
        path
        for dataset in points.datasets
        for name in [*method_names(run, dataset), *points.further_methods]
        if name in points.further_methods or method(name).look.restores
        for path in _list_cost_tables(run, dataset, name)
    ]


def cost_tables_on_request(run: Run) -> list[str]:
    """Return the tables of methods that are timed on request, such as networks."""
    return [
        path
        for dataset, names in load_timing_points().on_request.items()
        for name in names
        for path in _list_cost_tables(run, dataset, name)
    ]


def _list_cost_tables(run: Run, dataset: str, name: str) -> list[str]:
    """Return the tables of a method of a dataset, one for each of its settings."""
    points = load_timing_points().overrides(dataset, name)
    return [f"{run.results}/costs/{dataset}/{name}-{point}.csv" for point in points]


def get_point_overrides(wildcards: Wildcards) -> tuple[str, ...]:
    """Return the overrides of a timed point of a method."""
    points = load_timing_points().overrides(wildcards.dataset, wildcards.method)
    return tuple(points[wildcards.point])


def get_timing_module(name: str) -> str:
    """Return the module of a method, or the program of the denoisers."""
    # The denoisers of other packages are wrapped in a benchmark, not registered as methods.
    is_program = name == "denoisers"
    return f"workflow/benchmarks/{name}.py" if is_program else method(name).__module__


@cache
def strictest_dataset(run: Run, scene: str) -> str:
    """Return the dataset of a scene with the least noise and the strongest aberrations."""

    def strictness(dataset: str) -> tuple[float, float]:
        config = load_dataset_config(run, dataset)
        return (-min(config.noise.levels), config.stars.aberration_fraction)

    # Optics that are accurate enough for this dataset are accurate enough for the whole scene.
    datasets = [d for d in list_simulated_datasets() if scene_folder(run, d) == scene]
    return max(datasets, key=strictness)


def figures() -> dict[str, str]:
    """Return the figures of the benchmark, with their titles in the report."""
    # The optics have a figure for each scene, as their pupils and wavefronts differ.
    return {
        **{f"propagation_{scene}": f"error against time, {scene}" for scene in list_scenes()},
        "costs": "all methods: error against time",
        "inference": "speed of the network",
        "scaling": "growth of the costs",
    }


def scene_options(figure: str) -> list[str]:
    """Return the option with the scene of a figure, if it shows one."""
    return [f"--scene={scene}" for scene in list_scenes() if figure.endswith(f"_{scene}")]


def list_timing_bundles(run: Run) -> list[str]:
    """Return the bundles of the methods of the timed dataset."""
    return bundle_files(run, get_timing_dataset(), BUNDLE_FITS)


def get_timing_bundle(run: Run, name: str) -> str:
    """Return the bundle of a method of the timed dataset."""
    return bundle_file(
        run, get_timing_dataset(), *BUNDLE_FITS[0], fit_files.get_bundle_suffix(method(name))
    )


def choose_timing_dataset() -> str:
    """Return the override that chooses the timed dataset."""
    return f"dataset={get_timing_dataset()}"


def poppy_stars(run: Run) -> int:
    """Return the number of stars for POPPY, which is slow; small presets have small test parts."""
    return min(POPPY_STARS, int(load_dataset_config(run, get_timing_dataset()).parts.test_stars))
