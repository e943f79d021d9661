"""Stress tests of repeatability: seeds, streams, batches, the order of stars."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from psfdae.optics.wavefronts import ModalWavefronts
from psfdae.rng import stream
from psfdae.stability.bench import LEVELS, Bench
from psfdae.stability.rows import Entry, at_most, equal
from psfdae.stages import stars as stars_stage
from psfdae.stages import templates as templates_stage
from psfdae.stages.common import star_wavefronts
from psfdae.stars.scene import Propagation

STARS = 24
"""Stars that are simulated again and again."""


def batches_and_order(bench: Bench) -> Iterator[Entry]:
    """The same stars whatever the batch and whatever their order."""
    config = bench.seidel.config
    rng = stream(bench.seed, "stability", "order")
    fields = rng.integers(config.grid.points**2, size=STARS)
    source = star_wavefronts(config, fields)
    peak, stamps = _simulate(config, source, config.optics.batch)
    # Other shapes of the matrix products add the pupil in another order; a phase of W waves
    # is rounded by 2πW·ε in any case.
    rounding = 2 * np.pi * float(np.abs(source.slopes()).max() * np.finfo(np.float32).eps)
    for batch in (1, 7, STARS):
        other_peak, other = _simulate(config, source, batch)
        case = f"stars in batches of {batch}"
        yield equal(case, "brightest pixels moved", int((other_peak != peak).any(axis=1).sum()), 0)
        change = np.abs(other - stamps).max() / stamps.max()
        yield at_most(case, "largest change over the peak", float(change), rounding)
    order = rng.permutation(STARS)
    shuffled = ModalWavefronts(source.modes, source.coefficients[order])
    other_peak, other = _simulate(config, shuffled, config.optics.batch)
    moved = int((other_peak != peak[order]).any(axis=1).sum())
    yield equal("stars in another order", "brightest pixels moved", moved, 0)
    change = np.abs(other - stamps[order]).max() / stamps.max()
    yield at_most("stars in another order", "largest change over the peak", float(change), rounding)


def streams(bench: Bench) -> Iterator[Entry]:
    """No two random streams of the package are alike."""
    names: list[tuple[str | int, ...]] = [
        *(("noise", part, f"{level:.6g}") for part in ("test", "scan") for level in LEVELS),
        *(("noise", part) for part in ("test", "baseline")),
        *(
            ("noise", "calibrate", dataset, f"{level:.6g}")
            for dataset in ("dataset3", "dataset5", "dataset8")
            for level in LEVELS
        ),
        *(("dae", "epoch", attempt, epoch) for attempt in range(4) for epoch in range(100)),
        *(("dae", "init", attempt) for attempt in range(4)),
        *(("dae", name) for name in ("fixed noise", "validation")),
        *(("split", name) for name in ("random", "held_out")),
        *(("turbulence", layer) for layer in range(3)),
        *(
            (purpose, stars)
            for purpose in ("field", "jitter", "aberration")
            for stars in ("seidel_10pct", "seidel_50pct", "turbulence", "fresh")
        ),
        ("baseline", "map"),
        ("scan", "field"),
    ]
    seeds = (bench.seed, bench.seed + 1)
    first = [int(stream(seed, *name).integers(2**63)) for seed in seeds for name in names]
    alike = sum(a == b for a, b in combinations(first, 2))
    yield equal(f"{len(first)} random streams", "pairs that start alike", alike, 0)
    again = [int(stream(seed, *name).integers(2**63)) for seed in seeds for name in names]
    yield equal(f"{len(first)} random streams", "streams that do not repeat", first != again, False)
    draws = np.stack([stream(bench.seed, *name).standard_normal(1000) for name in names])
    correlation = np.corrcoef(draws) - np.eye(len(draws))
    # Correlations of n independent normal draws scatter by 1/√n; the largest of k by √(2 ln k).
    pairs = len(names) * (len(names) - 1) / 2
    limit = (np.sqrt(2 * np.log(pairs)) + 2) / np.sqrt(draws.shape[1])
    yield at_most(
        f"{len(names)} random streams",
        "largest correlation",
        float(np.abs(correlation).max()),
        limit,
    )


def same_bytes(bench: Bench) -> Iterator[Entry]:
    """The same seed writes the same bytes, another seed others."""
    config = bench.seidel.config
    small = config.model_copy(
        update={
            "grid": config.grid.model_copy(update={"points": 3}),
            "stars": config.stars.model_copy(update={"count": STARS}),
        }
    )
    first, second = (_products(small, bench.folder / name) for name in ("one", "two"))
    for kind in ("templates", "stars"):
        yield equal(f"the same {kind} twice", "same bytes", first[kind] == second[kind], True)
    other = _products(small.model_copy(update={"seed": config.seed + 1}), bench.folder / "three")
    yield equal("stars of another seed", "same bytes", first["stars"] == other["stars"], False)


def _simulate(config: Any, source: ModalWavefronts, batch: int) -> tuple[np.ndarray, np.ndarray]:
    optics = config.optics.model_copy(update={"batch": batch})
    propagation = Propagation(
        source, config.telescope, optics, config.framing, config.stars.search_px
    )
    peak = propagation.brightest()
    return peak, propagation.stamps(config.framing.stamp_px, peak)


def _products(config: Any, folder: Path) -> dict[str, bytes]:
    templates, stars = folder / "templates.h5", folder / "stars.h5"
    templates_stage.templates(config, templates)
    stars_stage.stars(config, templates, stars)
    return {"templates": templates.read_bytes(), "stars": stars.read_bytes()}


CASES = (batches_and_order, streams, same_bytes)
"""All cases of this module."""
