"""Files of the timings: errors against time, and the numbers of stars of some programs."""

from __future__ import annotations

from functools import cache
from typing import Any

from psfdae.methods import fit_files, method
from psfdae_paper.workflow.datasets import scene_names, simulated_datasets
from psfdae_paper.workflow.fits import bundle_file, bundle_files, method_names
from psfdae_paper.workflow.run import (
    Run,
    Wildcards,
    dataset_config,
    exit_in_one_line,
    import_benchmark,
)

PACKED = (("random", "realisation"),)
"""Split and reference of the fits that are packed as bundles."""
POPPY_STARS = 1500


@cache
@exit_in_one_line()
def timed_points() -> Any:
    """Return the datasets, methods and settings whose error is measured against their time."""
    return import_benchmark("costs").load_points()


def timed_dataset() -> str:
    """Return the dataset that most programs measure, the first of `points.yaml`."""
    return str(timed_points().datasets[0])


def cost_tables(run: Run) -> list[str]:
    """Return the tables of all methods and settings whose error is set against their time."""
    points = timed_points()
    return [
        f"{run.results}/costs/{dataset}/{name}-{point}.csv"
        for dataset in points.datasets
        for name in [*method_names(run, dataset), *points.further_methods]
        if name in points.further_methods or method(name).look.restores
        for point in points.overrides(dataset, name)
    ]


def timed_overrides(wildcards: Wildcards) -> tuple[str, ...]:
    """Return the overrides of a timed point of a method."""
    points = timed_points().overrides(wildcards.dataset, wildcards.method)
    return tuple(points[wildcards.point])


def timed_module(name: str) -> str:
    """Return the module of a method, or the program of the denoisers."""
    is_program = name == "denoisers"
    return f"workflow/benchmarks/{name}.py" if is_program else method(name).__module__


@cache
def strictest_dataset(run: Run, scene: str) -> str:
    """Return the dataset of a scene with the least noise and the strongest aberrations."""

    def strictness(dataset: str) -> tuple[float, float]:
        config = dataset_config(run, dataset)
        return (-min(config.noise.levels), config.stars.aberration_fraction)

    datasets = [d for d in simulated_datasets() if dataset_config(run, d).scene.name == scene]
    return max(datasets, key=strictness)


def figures() -> dict[str, str]:
    """Return the figures of the benchmark, with their titles in the report."""
    return {
        **{f"propagation_{scene}": f"error against time, {scene}" for scene in scene_names()},
        "costs": "all methods: error against time",
        "inference": "speed of the network",
        "scaling": "growth of the costs",
    }


def scene_options(figure: str) -> list[str]:
    """Return the option with the scene of a figure, if it shows one."""
    return [f"--scene={scene}" for scene in scene_names() if figure.endswith(f"_{scene}")]


def timed_bundles(run: Run) -> list[str]:
    """Return the bundles of the methods of the timed dataset."""
    return bundle_files(run, timed_dataset(), PACKED)


def timed_bundle(run: Run, name: str) -> str:
    """Return the bundle of a method of the timed dataset."""
    return bundle_file(run, timed_dataset(), *PACKED[0], fit_files.get_bundle_suffix(method(name)))


def timed_choice() -> str:
    """Return the override that chooses the timed dataset."""
    return f"dataset={timed_dataset()}"


def poppy_stars(run: Run) -> int:
    """Return the number of stars for POPPY, which is slow; small presets have small test parts."""
    return min(POPPY_STARS, int(dataset_config(run, timed_dataset()).parts.test_stars))
