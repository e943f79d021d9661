"""The Gaussian mixture: without noise, in noise alone, and where stars are few or alike."""

import numpy as np

from psfdae.methods.gmm import GaussianMixture, Gmm
from psfdae.methods.interface import FitError, TrainingSet

EPS = float(np.finfo(np.float32).eps)


def test_limits(bench, record):
    """λ → 0 gives the image, λ → ∞ the mean star; a factor of 10⁴ of λ, none errs more."""
    images = bench.seidel.images
    mixture, truth = fit(bench, images, [8]), images[:40]
    # Stars of the fit: so few span no more than themselves, others would be projected.
    none, quantity = mixture.estimate(truth, 1e-3 * bench.level).psf, "largest change over the peak"
    record.close("λ → 0", quantity, none, truth, 1e-4, over=truth.max())
    mean, without_signal = images.mean(axis=0), mixture.estimate(truth, 1e6 * bench.level).psf
    quantity = "difference from the mean star over its peak"
    record.close("λ → ∞", quantity, without_signal, mean, 100 * EPS, over=mean.max())
    for factor in (1e-2, 1e2):
        noisy = bench.noise.draw(truth, factor * bench.level, bench.stream("mixture"))
        psf = mixture.estimate(noisy, factor * bench.level).psf
        ratio = np.square(psf - truth).mean() / np.square(noisy - truth).mean()
        record.at_most(f"λ × {factor:g}", "MSE over that of the noisy images", ratio, 1.02)


def test_few_and_equal_stars(bench, record):
    """Equal stars, a cluster of one star, more clusters than stars."""
    images = bench.seidel.images[:31]
    noisy = bench.noise.draw(images, bench.level, bench.stream("few"))
    equal = fit(bench, np.repeat(images[:1], 30, axis=0), [1, 4]).estimate(noisy, bench.level).psf
    quantity, peak = "difference of all estimates from the star over its peak", images[0].max()
    record.close("equal stars", quantity, equal, images[0], 100 * EPS, over=peak)
    lonely = images.copy()
    lonely[0] = 0.0
    lonely[0, 0, 0] = 10.0  # so far off that no other cluster pays
    fitted = fit(bench, lonely, [2])
    estimate = fitted.estimate(noisy, bench.level)
    finite = all(np.isfinite(a).all() for a in (estimate.psf, estimate.sigma, estimate.evidence))
    record.equal(
        "a cluster of one star", "finite estimates", finite and fitted.count.min() == 1, True
    )
    with record.refused("more clusters than stars", FitError):
        fit(bench, images, [500])


def test_broken_stars(bench, record):
    """A star without a distance to any cluster: in the training set, and before a fitted one."""
    fitted = fit(bench, bench.seidel.images[:64], [4])
    images, case = bench.seidel.images[:64].copy(), "NaN pixel in a star of the mixture"
    images[3, 4, 5] = np.nan
    with record.refused(f"{case}'s training set", ValueError):
        fit(bench, images, [4])
    with record.refused(case, ValueError):
        fitted.estimate(images, bench.level)


def fit(bench, images, components):
    settings = Gmm(
        stars=None, components=components, shrinkage=[10.0], principal=20, place=1.0, threads=1
    )
    stars = np.arange(len(images))
    levels = np.array([bench.level])
    part = TrainingSet(images, images, stars, stars[:0], levels, bench.noise)
    return GaussianMixture.fit(part, settings)
