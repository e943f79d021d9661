"""Stress tests of image metrics and of error correlations."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import numpy as np

from psfdae.evaluation.correlation import error_correlation
from psfdae.evaluation.metrics import all_metrics, mse, peak_range, ssim
from psfdae.rng import stream
from psfdae.stability.bench import Bench
from psfdae.stability.rows import Entry, at_most, equal, refused

EPS = float(np.finfo(np.float64).eps)
K1 = 0.01
"""Constant of SSIM's luminance term (Wang et al. 2004, IEEE Trans. Image Process. 13, 600)."""


def constant_images(bench: Bench) -> Iterator[Entry]:
    """SSIM of images without structure, against its closed form."""
    flat = np.ones((3, 16, 16))
    for first, second in ((0.0, 0.0), (0.3, 0.3), (0.0, 0.3), (1.0, 0.5)):
        c1 = K1**2
        expected = (2 * first * second + c1) / (first**2 + second**2 + c1)
        measured = ssim(first * flat, second * flat, 1.0)
        yield at_most(
            f"SSIM of constants {first:g} and {second:g}",
            "difference from the closed form",
            float(np.abs(measured - expected).max()),
            # Variances of constants are differences of squares, rounded, over c2 = 9e-4.
            100 * EPS / 9e-4,
        )
    stars = bench.seidel.images[:3].astype(np.float64)
    stars[1] = 0.5
    yield equal("peak range of a constant reference", "range", peak_range(stars)[1], 0.0)
    yield refused(
        "metrics of a constant reference", lambda: all_metrics(stars, stars, 0.66), ValueError
    )
    for bad in (0.0, -1.0, np.nan):
        yield refused(
            f"SSIM with a data range of {bad:g}", lambda r=bad: ssim(stars, stars, r), ValueError
        )
    yield refused(
        "SSIM of stamps of 6 px", lambda: ssim(flat[:, :6, :6], flat[:, :6, :6], 1.0), ValueError
    )


def tiny_ranges(bench: Bench) -> Iterator[Entry]:
    """SSIM does not depend on the unit of images and range."""
    truth, noisy = _pair(bench)
    usual = ssim(noisy, truth, 0.66)
    for unit in (1e-300, 1e-30, 1e-12, 1e12, 1e30):
        scaled = ssim(noisy * unit, truth * unit, 0.66 * unit)
        yield at_most(
            f"SSIM, images and range in units of {unit:g}",
            "largest difference",
            float(np.abs(scaled - usual).max()),
            # Images are divided by the range first, which rounds once.
            1e3 * EPS,
        )
    errors = mse(noisy * 1e-30, truth * 1e-30) / mse(noisy, truth)
    yield at_most(
        "MSE, images in units of 1e-30",
        "largest relative difference",
        float(np.abs(errors / 1e-60 - 1).max()),
        noisy[0].size * EPS,
    )


def neighbours(bench: Bench) -> Iterator[Entry]:
    """A broken star must not change the metrics of the others in its batch."""
    truth, noisy = _pair(bench)
    usual = ssim(noisy, truth, 0.66)
    others = np.delete(np.arange(len(truth)), 3)
    for label, value in (("NaN", np.nan), ("infinite", np.inf), ("1e6", 1e6), ("1e30", 1e30)):
        broken = noisy.copy()
        broken[3, 5, 5] = value
        change = np.abs(ssim(broken, truth, 0.66) - usual)[others]
        yield at_most(
            f"star with a pixel that is {label}",
            "change of the SSIM of the others",
            float(change.max()),
            1e3 * EPS,
        )
        moved = np.abs(mse(broken, truth) - mse(noisy, truth))[others]
        yield at_most(
            f"star with a pixel that is {label}",
            "change of the MSE of the others",
            float(moved.max()),
            0.0,
        )


def correlations(bench: Bench) -> Iterator[Entry]:
    """Correlations of constant, equal, opposite, few and tiny errors."""
    rng = stream(bench.seed, "stability", "correlation")
    errors = rng.standard_normal((100, 4))
    errors[:, 1] = 0.1
    errors[:, 3] = -2 * errors[:, 2]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        matrix, low, high = error_correlation(errors)
    yield equal("errors without variance", "warnings", len(caught), 0)
    undefined = np.isnan(matrix[1]).all() and np.isnan(matrix[:, 1]).all()
    yield equal("errors without variance", "row and column are NaN", bool(undefined), True)
    yield equal(
        "errors without variance", "other entries that are NaN", int(np.isnan(matrix).sum()), 7
    )
    yield at_most("opposite errors", "correlation", float(matrix[2, 3]), -1 + 10 * EPS)
    tiny, _, _ = error_correlation(errors * 1e-200)
    yield at_most(
        "errors in units of 1e-200",
        "largest change of a correlation",
        float(np.nanmax(np.abs(tiny - matrix))),
        100 * EPS,
    )
    few, few_low, _ = error_correlation(errors[:3])
    defined = np.isfinite(few[0, 2]) and np.isnan(few_low[0, 2])
    yield equal("three samples", "correlation without interval", bool(defined), True)
    errors[0, 0] = np.nan
    yield refused("errors with a NaN", lambda: error_correlation(errors), ValueError)
    covered = 0
    for _ in range(400):
        pair = rng.standard_normal((30, 2)) @ np.array([[1.0, 0.6], [0.0, 0.8]])
        _, low, high = error_correlation(pair)
        covered += bool(low[0, 1] <= 0.6 <= high[0, 1])
    # Binomial: 95 % ± 4 × 1.1 %.
    yield at_most("95 % intervals", "|coverage − 0.95|", abs(covered / 400 - 0.95), 0.044)


def _pair(bench: Bench) -> tuple[np.ndarray, np.ndarray]:
    rng = stream(bench.seed, "stability", "metrics")
    truth = bench.seidel.images[:16].astype(np.float64)
    return truth, truth + 0.01 * rng.standard_normal(truth.shape)


CASES = (constant_images, tiny_ranges, neighbours, correlations)
"""All cases of this module."""
