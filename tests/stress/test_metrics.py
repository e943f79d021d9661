"""Image metrics and error correlations."""

import warnings

import numpy as np

from psfdae.metrics import all_metrics, error_correlation, mse, peak_range, ssim

EPS = float(np.finfo(np.float64).eps)
C1 = 0.01**2  # of SSIM's luminance term (Wang et al. 2004, IEEE Trans. Image Process. 13, 600)


def test_constants(bench, record):
    """Images without structure: SSIM has a closed form, or there is no range."""
    flat, stars = np.ones((3, 16, 16)), bench.seidel.images[:3].astype(np.float64)
    for first, second in ((0.0, 0.0), (0.3, 0.3), (0.0, 0.3), (1.0, 0.5)):
        found = ssim(first * flat, second * flat, 1.0)
        expected = (2 * first * second + C1) / (first**2 + second**2 + C1)
        case = f"SSIM of constants {first:g} and {second:g}"
        # Variances of constants are differences of squares, rounded, over c2 = 9e-4.
        record.close(case, "difference from the closed form", found, expected, 100 * EPS / 9e-4)
    stars[1] = 0.5
    record.equal("peak range of a constant reference", "range", peak_range(stars)[1], 0.0)
    with record.refused("metrics of a constant reference", ValueError):
        all_metrics(stars, stars, 0.66)
    for bad in (0.0, -1.0, np.nan):
        with record.refused(f"SSIM with a data range of {bad:g}", ValueError):
            ssim(stars, stars, bad)
    with record.refused("SSIM of stamps of 6 px", ValueError):
        ssim(stars[:, :6, :6], stars[:, :6, :6], 1.0)


def test_units(bench, record):
    """SSIM does not depend on the unit of images and range."""
    truth, noisy = pair(bench)
    usual = ssim(noisy, truth, 0.66)
    for unit in (1e-300, 1e-30, 1e-12, 1e12, 1e30):
        found = ssim(noisy * unit, truth * unit, 0.66 * unit)
        case = f"SSIM, images and range in units of {unit:g}"
        # Images are divided by the range first, which rounds once.
        record.close(case, "largest difference", found, usual, 1e3 * EPS)
    ratio = mse(noisy * 1e-30, truth * 1e-30) / mse(noisy, truth) / 1e-60
    case, bound = "MSE, images in units of 1e-30", noisy[0].size * EPS
    record.close(case, "largest relative difference", ratio, 1, bound)


def test_neighbours(bench, record):
    """A broken star must not change the metrics of the others in its batch."""
    truth, noisy = pair(bench)
    for value, label in ((np.nan, "NaN"), (np.inf, "infinite"), (1e6, "1e6"), (1e30, "1e30")):
        broken, case = noisy.copy(), f"star with a pixel that is {label}"
        broken[3, 5, 5] = value
        found = (np.delete(ssim(images, truth, 0.66), 3) for images in (broken, noisy))
        record.close(case, "change of the SSIM of the others", *found, 1e3 * EPS)
        found = (np.delete(mse(images, truth), 3) for images in (broken, noisy))
        record.close(case, "change of the MSE of the others", *found, 0.0)


def test_correlations(bench, record):
    """Correlations of constant, equal, opposite, few and tiny errors."""
    rng = bench.stream("correlation")
    errors = rng.standard_normal((100, 4))
    errors[:, 1], errors[:, 3] = 0.1, -2 * errors[:, 2]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        matrix, *_ = error_correlation(errors)
    case, undefined = "errors without variance", np.isnan(matrix)
    record.equal(case, "warnings", len(caught), 0)
    record.equal(case, "row and column are NaN", (undefined[1] & undefined[:, 1]).all(), True)
    record.equal(case, "other entries that are NaN", undefined.sum(), 7)
    record.at_most("opposite errors", "correlation", matrix[2, 3], -1 + 10 * EPS)
    change = np.nanmax(np.abs(error_correlation(errors * 1e-200)[0] - matrix))
    case = "errors in units of 1e-200"
    record.at_most(case, "largest change of a correlation", change, 100 * EPS)
    few, low, _ = error_correlation(errors[:3])
    defined = np.isfinite(few[0, 2]) and np.isnan(low[0, 2])
    record.equal("three samples", "correlation without interval", defined, True)
    errors[0, 0] = np.nan
    with record.refused("errors with a NaN", ValueError):
        error_correlation(errors)
    covered = 0
    for _ in range(400):
        sample = rng.standard_normal((30, 2)) @ np.array([[1.0, 0.6], [0.0, 0.8]])
        _, low, high = error_correlation(sample)
        covered += low[0, 1] <= 0.6 <= high[0, 1]
    # Binomial: 95 % ± 4 × 1.1 %.
    record.at_most("95 % intervals", "|coverage − 0.95|", abs(covered / 400 - 0.95), 0.044)


def pair(bench):
    truth = bench.seidel.images[:16].astype(np.float64)
    return truth, truth + 0.01 * bench.stream("metrics").standard_normal(truth.shape)
