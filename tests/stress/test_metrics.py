"""Image metrics and error correlations."""

import numpy as np

from psfdae.methods.metrics import all_metrics, ssim
from psfdae_paper.evaluation.alignment_tables import correlate_errors

EPS = float(np.finfo(np.float64).eps)
C1 = 0.01**2  # of SSIM's luminance term (Wang et al. 2004, IEEE Trans. Image Process. 13, 600)


def test_constants(bench, record):
    """Images without structure: SSIM has a closed form, or there is no range."""
    flat, stars = np.ones((3, 16, 16)), bench.seidel.images[:3].astype(np.float64)
    expected = (2 * 1.0 * 0.5 + C1) / (1.0**2 + 0.5**2 + C1)
    case, quantity = "SSIM of constants 1 and 0.5", "difference from the closed form"
    # Variances of constants are differences of squares, rounded, over c2 = 9e-4.
    record.close(case, quantity, ssim(flat, 0.5 * flat, 1.0), expected, 100 * EPS / 9e-4)
    stars[1] = 0.5
    with record.refused("metrics of a constant reference", ValueError):
        all_metrics(stars, stars, 0.66)


def test_units_and_neighbours(bench, record):
    """SSIM depends neither on the unit of images and range nor on a broken star of the batch."""
    truth = bench.seidel.images[:16].astype(np.float64)
    noisy = truth + 0.01 * bench.stream("metrics").standard_normal(truth.shape)
    unit_ssim, unit = ssim(noisy, truth, 0.66), 1e-300
    scaled_ssim = ssim(noisy * unit, truth * unit, 0.66 * unit)
    # Images are divided by the range first, which rounds once.
    case = f"SSIM, images and range in units of {unit:g}"
    record.close(case, "largest difference", scaled_ssim, unit_ssim, 1e3 * EPS)
    noisy[3, 5, 5] = np.nan
    pair = (np.delete(x, 3) for x in (ssim(noisy, truth, 0.66), unit_ssim))
    record.close("star with a NaN", "change of the SSIM of the others", *pair, 1e3 * EPS)


def test_correlations(bench, record):
    """Correlations of constant, opposite and tiny errors."""
    rng = bench.stream("correlation")
    errors = rng.standard_normal((100, 4))
    errors[:, 1], errors[:, 3] = 0.1, -2 * errors[:, 2]
    matrix, *_ = correlate_errors(errors)
    undefined = np.isnan(matrix)
    undefined_count = undefined.sum() if (undefined[1] & undefined[:, 1]).all() else "other rows"
    record.equal("errors without variance", "NaN in their row and column alone", undefined_count, 7)
    change = np.nanmax(np.abs(correlate_errors(errors * 1e-200)[0] - matrix))
    case = "errors in units of 1e-200"
    record.at_most(case, "largest change of a correlation", change, 100 * EPS)
    covered = 0
    for _ in range(400):
        sample = rng.standard_normal((30, 2)) @ np.array([[1.0, 0.6], [0.0, 0.8]])
        _, low, high = correlate_errors(sample)
        covered += low[0, 1] <= 0.6 <= high[0, 1]
    # Binomial: 95 % ± 4 × 1.1 %.
    record.at_most("95 % intervals", "|coverage − 0.95|", abs(covered / 400 - 0.95), 0.044)
