"""What the stage `timing` measures; each function runs in a process of its own.

Arguments and results are what JSON carries.
"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from psfdae.benchmark.isolated import forget_peak, peak_mb, resident_mb
from psfdae.configuration.compose import part


def simulate(config: dict[str, Any], templates: str, out: str) -> dict[str, float]:
    """Run the stage `stars`.

    Parameters
    ----------
    config : tree of the stage `stars`
    templates, out : paths of the products

    Returns
    -------
    dict
        time_s, peak_mb above the imported interpreter, disk_mb.
    """
    # Imported before the memory is noted: they are the interpreter's share.
    import h5py  # noqa: F401
    import threadpoolctl  # noqa: F401

    from psfdae.stages import stars
    from psfdae.stages.common import scene_module
    from psfdae.stars import scene  # noqa: F401

    checked = part("stars", config)
    scene_module(checked.scene.name)
    return _measure(lambda: stars.stars(checked, Path(templates), Path(out)), Path(out))


def make_templates(config: dict[str, Any], out: str) -> None:
    """Run the stage `templates`."""
    from psfdae.stages import templates

    templates.templates(part("templates", config), Path(out))


def infer(
    kernels: list[int], widths: list[int], scale: str, threads: int, stars: str, out: str
) -> dict[str, float]:
    """Read stars piece by piece, predict their PSFs, write them piece by piece.

    Parameters
    ----------
    kernels, widths, scale
        The network, with random weights.
    threads : int
    stars : path of a product "stars", whose noise-free images serve as input
    out : path of the HDF5 product "psf"

    Returns
    -------
    dict
        As of `simulate`.
    """
    import h5py
    import torch

    from psfdae.files import Empty, stream_product
    from psfdae.models.dae import build_dae, image_scale, predict_stream

    torch.set_num_threads(threads)
    model = build_dae(kernels, widths, "he", torch.Generator().manual_seed(0))

    def run() -> None:
        with h5py.File(stars) as file:
            images = file["realisation"]
            columns = {"psf": Empty(images.shape, np.float32, "1", "predicted PSF")}
            factor = image_scale(scale, images.shape[-1])  # type: ignore[arg-type]
            with stream_product(out, "psf", columns, {}) as data:
                for part, psf in predict_stream(model, images, factor):
                    data["psf"][part] = psf

    return _measure(run, Path(out))


def _measure(run: Any, out: Path) -> dict[str, float]:
    forget_peak()
    before = resident_mb()
    start = perf_counter()
    run()
    seconds = perf_counter() - start
    return {
        "time_s": seconds,
        # Where the peak cannot be started anew, that of the imports may be the larger one.
        "peak_mb": max(peak_mb() - before, 0.1),
        "disk_mb": out.stat().st_size / 2**20,
    }


def baseline(
    config: dict[str, Any], stars: str, points: list[dict[str, Any]], repeats: int
) -> list[dict[str, Any]]:
    """Fit and test settings of PCA+SOM on the training and test stars of the split random.

    Parameters
    ----------
    config : tree of the stage `baseline`
    stars : path of the product "stars"
    points : settings from `benchmark.baseline.grid_around`
    repeats : timings at most

    Returns
    -------
    list of dict
        The points with their times and errors.
    """
    # Imported before the clock starts.
    import minisom  # noqa: F401
    import sklearn.decomposition  # noqa: F401

    from psfdae.benchmark.baseline import time_point
    from psfdae.rng import stream
    from psfdae.stages.common import (
        limit_threads,
        noise_model,
        noisy_test_images,
        read_stars,
        split_stars,
    )
    from psfdae.stars.noise import mixed_levels

    checked = part("baseline", config)
    settings, seed = checked.baseline, checked.seed
    limit_threads(settings.threads)
    product = read_stars(Path(stars), "template")
    parts = split_stars(product, "random", checked)
    # The draws of the stage `baseline`: the point in use is the very model of the tables.
    rng = stream(seed, "noise", "baseline")
    levels = mixed_levels(np.asarray(checked.noise.levels), parts.train.size, rng)
    train = noise_model(checked).draw(product["realisation"][parts.train], levels, rng)
    clean = product["realisation"][parts.test]
    tests = [noisy_test_images(checked, clean, level) for level in checked.noise.levels]
    truths = {name: product[name][parts.test] for name in ("realisation", "template")}
    common = {
        "sigma": settings.sigma,
        "learning_rate": settings.learning_rate,
        "seed": int(stream(seed, "baseline", "map").integers(2**31)),
    }
    table = []
    for point in points:
        sizes = {key: value for key, value in point.items() if key != "used"}
        measured = time_point(train, tests, truths, {**sizes, **common}, repeats)
        table.append({**point, **measured, "n": int(parts.test.size)})
    return table
