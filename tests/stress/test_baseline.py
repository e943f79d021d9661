"""Principal components and the self-organising map."""

import numpy as np
import pytest

from psfdae_paper.methods.pca_som import fit_pca_som
from stress.bench import subspace_angle

EPS = float(np.finfo(np.float64).eps)
SMALL_MAP = {"rows": 4, "columns": 4, "epochs": 2, "sigma": 1.0, "learning_rate": 0.5, "seed": 1}
COUNT = 8  # components


@pytest.mark.slow
def test_eigenvectors(bench, record):
    """Components from the singular values of the data and from its covariance."""
    count = bench.config.baseline.components
    images = noisy_stars(bench, len(bench.seidel.images))
    flat = images.reshape(len(images), -1).astype(np.float64)
    centred = flat - flat.mean(axis=0)
    values, vectors = np.linalg.eigh(centred.T @ centred / len(flat))
    ours, theirs = fit(images, count).components, vectors[:, ::-1][:, :count].T
    values, rounding = values[::-1], flat.shape[1] * EPS
    # The covariance squares the condition: rounding relative to its norm, over the gap.
    bound = rounding / ((values[count - 1] - values[count]) / values[0])
    case, angle = "covariance eigenvectors against SVD", subspace_angle(ours, theirs)
    record.at_most(case, "sine of the largest angle between the subspaces", angle, bound)
    rebuilt = [centred @ rows.T @ rows for rows in (ours, theirs)]
    what = "largest difference of the reconstructions over the largest pixel"
    record.close(case, what, *rebuilt, bound, over=np.abs(centred).max())
    # Eckart & Young 1936: no other K components leave less.
    left = values[count:].sum()
    ratio = ((centred - rebuilt[0]) ** 2).sum() / (len(flat) * left)
    what = "|residual variance over the sum of the other eigenvalues − 1|"
    record.close(case, what, ratio, 1, rounding * values[0] / left)


def test_degenerate_stars(bench, record):
    """Duplicates, identical stars, too few stars, stars of low rank."""
    images = noisy_stars(bench, 64).astype(np.float64)
    twice, case = np.concatenate([images, images]), "every star twice"
    doubled = fit(twice, COUNT)
    first, second = np.split(doubled.assign(twice), 2)
    record.equal(case, "twins in different clusters", (first != second).sum(), 0)
    record.equal(case, "finite PSFs", np.isfinite(doubled.psf).all(), True)
    angle = subspace_angle(doubled.components, fit(images, COUNT).components)
    record.at_most(case, "sine of the angle to the components of single stars", angle, 1e-9)
    identical = fit(np.repeat(images[:1], 30, axis=0), COUNT)
    pair, peak = (identical.predict(images[:1]), images[:1]), np.abs(images[0]).max()
    record.close("identical stars", "error of their PSF over its peak", *pair, 30 * EPS, over=peak)
    with record.refused("fewer stars than components", ValueError):
        fit(images[: COUNT - 1], COUNT)
    flat = bench.stream("rank").random((64, 3)) @ images[:3].reshape(3, -1)
    fitted, case = fit(flat.reshape(images.shape), COUNT), "stars of rank 3, more components"
    centred = flat - fitted.mean
    rebuilt, rounding = centred @ fitted.components.T @ fitted.components, flat.shape[1] * EPS
    what, peak = "largest reconstruction error over the largest pixel", np.abs(flat).max()
    record.close(case, what, centred, rebuilt, rounding, over=peak)
    gram, unit = fitted.components @ fitted.components.T, np.eye(COUNT)
    record.close(case, "deviation of the components from orthonormal", gram, unit, rounding)


def test_empty_nodes(bench, record):
    """A map with far more nodes than stars: nodes that win nothing are left out."""
    images, case = noisy_stars(bench, 12), "12 stars on a map of 121 nodes"
    fitted = fit(images, 4, rows=11, columns=11)
    record.at_most(case, "nodes kept", len(fitted.psf), len(images))
    clusters = fitted.assign(images)
    record.equal(case, "kept nodes without a star", len(fitted.psf) - np.unique(clusters).size, 0)
    others = fitted.predict(noisy_stars(bench, 200))
    record.equal(case, "finite PSFs of other stars", np.isfinite(others).all(), True)
    # Means of the stars of disjoint clusters, weighted by their sizes, are the mean of all.
    sizes = np.bincount(clusters, minlength=len(fitted.psf))
    mean = images.reshape(len(images), -1).mean(axis=0, dtype=np.float64)
    weighted, peak = (sizes[:, None] * fitted.psf).sum(axis=0) / len(images), np.abs(mean).max()
    what = "weighted mean of the PSFs against the mean star, over its peak"
    record.close(case, what, weighted, mean, len(images) * EPS, over=peak)


def test_broken_stars(bench, record):
    """A star without a distance to any node: in the training set, and before a fitted map."""
    fitted = fit(noisy_stars(bench, 64).astype(np.float64), COUNT)
    for label, value in (("NaN", np.nan), ("infinite", np.inf)):
        images, case = noisy_stars(bench, 64), f"{label} pixel in a star of the baseline"
        images[3, 4, 5] = value
        with record.refused(f"{case}'s training set", ValueError):
            fit(images, COUNT)
        with record.refused(case, ValueError):
            fitted.predict(images)


def fit(images, components, **update):
    return fit_pca_som(images, components, **{**SMALL_MAP, **update})


def noisy_stars(bench, count):
    return bench.noise.draw(bench.seidel.images[:count], bench.level, bench.stream("baseline"))
