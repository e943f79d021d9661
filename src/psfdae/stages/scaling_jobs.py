"""What the stage `scaling` measures; each function runs in a process of its own.

Arguments and results are what JSON carries.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np

from psfdae.benchmark.isolated import forget_peak, peak_mb
from psfdae.configuration.compose import part, stage_tree
from psfdae.files import Column, read_product, write_product

SPLIT, REFERENCE = "random", "realisation"
PER_STAR = ("realisation", "template", "field_index")


def repeat_stars(stars: str, count: int, out: str) -> None:
    """Write as many stars as asked for by repeating those of a product.

    What the stages cost does not depend on what the stars look like.
    """
    product = read_product(stars, "stars", (*PER_STAR, "grid"))
    rows = np.arange(count) % len(product["field_index"])
    columns = {name: Column(product[name][rows], "1", "repeated") for name in PER_STAR}
    columns["grid"] = Column(product["grid"], "1", "as of the product that is repeated")
    write_product(out, "stars", columns, product.config)


def make_templates(config: dict[str, Any], out: str) -> None:
    """Run the stage `templates`."""
    from psfdae.stages import templates

    templates.templates(_checked("templates", config), Path(out))


def simulate(config: dict[str, Any], templates: str, out: str) -> dict[str, float]:
    """Run the stage `stars`; costs as of `_measure`."""
    from psfdae.stages import stars

    checked = _checked("stars", config)
    return _measure(lambda: stars.stars(checked, Path(templates), Path(out)), Path(out))


def predict(config: dict[str, Any], dae: str, stars: str, out: str) -> dict[str, float]:
    """Read stars piece by piece, predict and write their PSFs; costs as of `_measure`."""
    import h5py

    from psfdae.estimators.dae import Dae
    from psfdae.files import Empty, stream_product
    from psfdae.models.dae import image_scale, predict_stream

    evaluation = _checked("evaluate", config).evaluation

    def run() -> None:
        network = Dae.load(Path(dae), evaluation=evaluation)
        with h5py.File(stars) as file:
            images = file["realisation"]
            columns = {"psf": Empty(images.shape, np.float32, "1", "predicted PSF")}
            factor = image_scale(network.settings.scale, images.shape[-1])
            with stream_product(out, "psf", columns, {}) as data:
                for part, psf in predict_stream(network.network, images, factor):
                    data["psf"][part] = psf

    return _measure(run, Path(out))


def baseline(config: dict[str, Any], stars: str, out: str) -> dict[str, float]:
    """Run the stage `baseline`; costs as of `_measure`."""
    from psfdae.stages.fit import baseline as stage

    checked = _checked("baseline", config)
    return _measure(lambda: stage(checked, Path(stars), SPLIT, out=Path(out)), Path(out))


def train(config: dict[str, Any], stars: str, out: str) -> dict[str, float]:
    """Run the stage `train`; costs as of `_measure`."""
    from psfdae.stages.fit import train as stage

    checked, folder = _checked("train", config), Path(out)
    checkpoint = folder.with_suffix(".pt")
    return _measure(
        lambda: stage(checked, Path(stars), SPLIT, REFERENCE, checkpoint, out=folder), folder
    )


def evaluate(
    config: dict[str, Any], stars: str, pca_som: str, dae: str, out: str
) -> dict[str, float]:
    """Run the stage `evaluate`; costs as of `_measure`."""
    from psfdae.stages.evaluate import Models
    from psfdae.stages.evaluate import evaluate as stage

    checked, folder = _checked("evaluate", config), Path(out)
    given = (Path(stars), Models(pca_som=Path(pca_som), dae=Path(dae)), SPLIT, REFERENCE)
    outputs = {"per_star": folder / "per_star.parquet", "out": folder / "summary.csv"}
    return _measure(lambda: stage(checked, "measured", *given, **outputs), folder)


def _checked(stage: str, config: dict[str, Any]) -> Any:
    return part(stage, stage_tree(stage, config))


def _measure(run: Callable[[], None], out: Path) -> dict[str, float]:
    """Time, largest memory of the process and disk of a call.

    Returns
    -------
    dict
        time_s, cpu_s, peak_mb (10⁶ bytes, with interpreter and libraries), disk_mb.
    """
    forget_peak()
    start, start_cpu = perf_counter(), process_time()
    run()
    seconds, cpu = perf_counter() - start, process_time() - start_cpu
    files = [path for path in out.rglob("*") if path.is_file()] if out.is_dir() else [out]
    return {
        "time_s": seconds,
        "cpu_s": cpu,
        "peak_mb": peak_mb() * 2**20 / 1e6,
        "disk_mb": sum(path.stat().st_size for path in files) / 1e6,
    }
