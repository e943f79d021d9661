"""Random streams."""

from itertools import combinations, product

import numpy as np

from psfdae.base.rng import stream


def test_streams(bench, record):
    """No two random streams of the package are alike."""
    levels = [f"{level:.6g}" for level in np.geomspace(3e-5, 5e-3, 12)]
    datasets, sets = ("dataset3", "dataset5", "dataset8"), ("seidel_10pct", "seidel_50pct")
    names = [
        *product(["noise"], ("test", "scan"), levels),
        *product(["noise"], ("test", "baseline")),
        *product(["noise"], ["calibrate"], datasets, levels),
        *product(["dae"], ["epoch"], range(4), range(100)),
        *product(["dae"], ["init"], range(4)),
        *product(["dae"], ("fixed noise", "validation")),
        *product(["split"], ("random", "held_out")),
        *product(["turbulence"], range(3)),
        *product(("field", "jitter", "aberration"), (*sets, "turbulence", "fresh")),
        *(("baseline", "map"), ("scan", "field")),
    ]
    seed = bench.config.seed
    every = [(s, *name) for s in (seed, seed + 1) for name in names]
    first = [int(stream(*name).integers(2**63)) for name in every]
    case, equal_pairs = (
        f"{len(first)} random streams",
        sum(a == b for a, b in combinations(first, 2)),
    )
    record.equal(case, "pairs that start alike", equal_pairs, 0)
    draws = np.stack([stream(seed, *name).standard_normal(1000) for name in names])
    largest = np.abs(np.corrcoef(draws) - np.eye(len(draws))).max()
    # Correlations of n independent normal draws scatter by 1/√n; the largest of k by √(2 ln k).
    pairs = len(names) * (len(names) - 1) / 2
    limit = (np.sqrt(2 * np.log(pairs)) + 2) / np.sqrt(draws.shape[1])
    record.at_most(f"{len(names)} random streams", "largest correlation", largest, limit)
