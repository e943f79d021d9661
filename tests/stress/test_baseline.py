"""Principal components and the self-organising map."""

import numpy as np
import pytest

from psfdae_paper.methods.pca_som import fit_pca_som
from stress.bench import noisy_stars

pytestmark = pytest.mark.slow
EPS = float(np.finfo(np.float64).eps)
SMALL_MAP = {"rows": 4, "columns": 4, "epochs": 2, "sigma": 1.0, "learning_rate": 0.5, "seed": 1}
COUNT = 8  # components


def test_eigenvectors(bench, record):
    """Components from the singular values of the data leave what those of its covariance leave."""
    count = bench.config.baseline.components
    images = noisy_stars(bench)
    flat = images.reshape(len(images), -1)
    centred = flat - flat.mean(axis=0)
    values = np.linalg.eigvalsh(centred.T @ centred / len(flat))[::-1]
    components, rounding = fit(images, count).components, flat.shape[1] * EPS
    # Eckart & Young 1936: no other K components leave less.
    left = values[count:].sum()
    residual = centred - centred @ components.T @ components
    ratio = (residual**2).sum() / (len(flat) * left)
    case = "covariance eigenvectors against SVD"
    what = "|residual variance over the sum of the other eigenvalues − 1|"
    record.close(case, what, ratio, 1, rounding * values[0] / left)


def test_degenerate_stars(bench, record):
    """Duplicates, identical stars, stars of low rank, a star that is not finite."""
    images = noisy_stars(bench, 64)
    twice = np.concatenate([images, images])
    first, second = np.split(fit(twice, COUNT).assign(twice), 2)
    record.equal("every star twice", "twins in different clusters", (first != second).sum(), 0)
    identical = fit(np.repeat(images[:1], 30, axis=0), COUNT)
    pair, peak = (identical.predict(images[:1]), images[:1]), np.abs(images[0]).max()
    record.close("identical stars", "error of their PSF over its peak", *pair, 30 * EPS, over=peak)
    flat = bench.stream("rank").random((64, 3)) @ images[:3].reshape(3, -1)
    fitted, case = fit(flat.reshape(images.shape), COUNT), "stars of rank 3, more components"
    centred = flat - fitted.mean
    rebuilt, rounding = centred @ fitted.components.T @ fitted.components, flat.shape[1] * EPS
    what, peak = "largest reconstruction error over the largest pixel", np.abs(flat).max()
    record.close(case, what, centred, rebuilt, rounding, over=peak)
    images[3, 4, 5] = np.nan
    with record.refused("NaN pixel in a star of the baseline's training set", ValueError):
        fit(images, COUNT)


def test_empty_nodes(bench, record):
    """A map with far more nodes than stars: nodes that win nothing are left out."""
    images, case = noisy_stars(bench, 12), "12 stars on a map of 121 nodes"
    fitted = fit(images, 4, rows=11, columns=11)
    clusters = fitted.assign(images)
    record.equal(case, "kept nodes without a star", len(fitted.psf) - np.unique(clusters).size, 0)
    # Means of the stars of disjoint clusters, weighted by their sizes, are the mean of all.
    sizes = np.bincount(clusters, minlength=len(fitted.psf))
    mean = images.reshape(len(images), -1).mean(axis=0)
    weighted, peak = (sizes[:, None] * fitted.psf).sum(axis=0) / len(images), np.abs(mean).max()
    what = "weighted mean of the PSFs against the mean star, over its peak"
    record.close(case, what, weighted, mean, len(images) * EPS, over=peak)


def fit(images, components, **update):
    return fit_pca_som(images, components, **{**SMALL_MAP, **update})
