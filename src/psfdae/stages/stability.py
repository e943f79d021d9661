"""Stage `stability`: stress tests of the whole chain, one table."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

from psfdae.belonging import STARS, require
from psfdae.configuration.compose import part
from psfdae.files import ProductError, read_product
from psfdae.stability.bench import LEAST_LEVEL, Bench, Scene
from psfdae.stability.rows import Point, Row, run_cases, write_table
from psfdae.stages.common import limit_threads


def run(config: Any, stars: Path, turbulence: Path, out: Path, graded: Path) -> list[Row]:
    """Run every case and write both tables, whatever the verdicts.

    Parameters
    ----------
    config : stage config `stability` of a dataset of scene 1
    stars, turbulence : products "stars" of scene 1 and of scene 2
    out : CSV, columns case, quantity, expected, measured, verdict (pass or fail)
    graded : CSV, columns case, stress, error (empty where refused), bound

    Returns
    -------
    list of Row
        The table, for `psfdae.stability.rows.check`.

    Raises
    ------
    ProductError
        If a product is missing, damaged or of the other scene, or the stars of scene 1
        are not those of the configuration.
    """
    import torch

    from psfdae.stability import (
        baseline_cases,
        metric_cases,
        network_cases,
        optics_cases,
        photometry_cases,
        precision_cases,
        repeat_cases,
        seed_cases,
    )

    modules = (
        *(precision_cases, optics_cases, photometry_cases, baseline_cases),
        *(network_cases, seed_cases, metric_cases, repeat_cases),
    )
    require(stars, read_product(stars, "stars", ()).config, STARS, config)
    limit_threads(config.stability.threads)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(
            config,
            _scene(stars, "seidel", config.stability.stars),
            _scene(turbulence, "turbulence", config.stability.stars),
            Path(folder),
        )
        started = time.monotonic()

        def report(name: str) -> None:
            print(f"{time.monotonic() - started:6.1f} s  {name}", flush=True)

        cases = [case for module in modules for case in module.CASES]
        rows, points = run_cases(cases, bench, report)
        report("end")
    write_table(out, rows, Row)
    write_table(graded, points, Point)
    return rows


def _scene(path: Path, name: str, count: int) -> Scene:
    """The first stars of a product with the settings that made them."""
    product = read_product(path, "stars", ("realisation",))
    config = part("stars", product.config)
    if config.scene.name != name:
        raise ProductError(f"{path}: stars of the scene {config.scene.name!r}, expected {name!r}")
    return Scene(config, product["realisation"][:count], LEAST_LEVEL[name])
