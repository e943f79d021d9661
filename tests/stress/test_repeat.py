"""Repeatability: seeds, streams, batches, the order of stars."""

from itertools import combinations, product

import numpy as np
import pytest

from psfdae.optics.wavefronts import ModalWavefronts
from psfdae.rng import stream
from psfdae_paper.stars.scenes import star_wavefronts
from stress.bench import changed, propagation, simulated

STARS = 24  # that are simulated again and again


@pytest.mark.slow
def test_batches_and_order(bench, record):
    """The same stars whatever the batch and whatever their order."""
    config, rng = bench.seidel.config, bench.stream("order")
    fields = rng.integers(config.grid.points**2, size=STARS)
    source, order = star_wavefronts(config, fields), rng.permutation(STARS)
    shuffled = ModalWavefronts(source.modes, source.coefficients[order])
    images = images_of(config, source, config.optics.batch)
    # Other shapes of the matrix products add the pupil in another order; a phase of W waves
    # is rounded by 2πW·ε in any case.
    rounding = 2 * np.pi * float(np.abs(source.slopes()).max() * np.finfo(np.float32).eps)
    for case, wavefronts, batch, place in (
        ("stars in batches of 7", source, 7, np.arange(STARS)),
        ("stars in another order", shuffled, config.optics.batch, order),
    ):
        stamps, what = images_of(config, wavefronts, batch), "largest change over the peak"
        record.close(case, what, stamps, images[place], rounding, over=images.max())


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
    case, alike = f"{len(first)} random streams", sum(a == b for a, b in combinations(first, 2))
    record.equal(case, "pairs that start alike", alike, 0)
    draws = np.stack([stream(seed, *name).standard_normal(1000) for name in names])
    largest = np.abs(np.corrcoef(draws) - np.eye(len(draws))).max()
    # Correlations of n independent normal draws scatter by 1/√n; the largest of k by √(2 ln k).
    pairs = len(names) * (len(names) - 1) / 2
    limit = (np.sqrt(2 * np.log(pairs)) + 2) / np.sqrt(draws.shape[1])
    record.at_most(f"{len(names)} random streams", "largest correlation", largest, limit)


@pytest.mark.slow
def test_same_bytes(bench, record):
    """The same seed writes the same bytes."""
    config = changed(bench.seidel.config, grid={"points": 3}, stars={"count": STARS})
    stars = (simulated(config, bench.folder / name)[1] for name in ("one", "two"))
    first, second = (path.read_bytes() for path in stars)
    record.equal("the same stars twice", "same bytes", first == second, True)


def images_of(config, source, batch):
    kernel = propagation(config, source, batch=batch)
    return kernel.stamps(config.framing.stamp_px, kernel.brightest())
