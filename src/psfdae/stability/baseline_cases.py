"""Stress tests of principal components and of the self-organising map."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from psfdae.estimators.pca_som import PcaSom, fit_pca_som
from psfdae.rng import stream
from psfdae.stability.bench import Bench
from psfdae.stability.precision_cases import subspace_angle
from psfdae.stability.rows import Entry, at_most, equal, refused

EPS = float(np.finfo(np.float64).eps)
SMALL_MAP = {"rows": 4, "columns": 4, "epochs": 2, "sigma": 1.0, "learning_rate": 0.5}


def eigenvectors(bench: Bench) -> Iterator[Entry]:
    """Components from the singular values of the data and from its covariance."""
    count = bench.config.baseline.components
    images = _noisy(bench, len(bench.seidel.images))
    flat = images.reshape(len(images), -1).astype(np.float64)
    fitted = _fit(images, count)
    centred = flat - flat.mean(axis=0)
    values, vectors = np.linalg.eigh(centred.T @ centred / len(flat))
    ours, theirs = fitted.components, vectors[:, ::-1][:, :count].T
    values = values[::-1]
    # The covariance squares the condition: rounding relative to its norm, over the gap.
    gap = (values[count - 1] - values[count]) / values[0]
    yield at_most(
        "covariance eigenvectors against SVD",
        "sine of the largest angle between the subspaces",
        subspace_angle(ours, theirs),
        flat.shape[1] * EPS / gap,
    )
    rebuilt = [centred @ rows.T @ rows for rows in (ours, theirs)]
    yield at_most(
        "covariance eigenvectors against SVD",
        "largest difference of the reconstructions over the largest pixel",
        float(np.abs(rebuilt[0] - rebuilt[1]).max() / np.abs(centred).max()),
        flat.shape[1] * EPS / gap,
    )
    excess = ((centred - rebuilt[0]) ** 2).sum() / (len(flat) * values[count:].sum()) - 1
    # Eckart & Young 1936: no other K components leave less.
    yield at_most(
        "covariance eigenvectors against SVD",
        "|residual variance over the sum of the other eigenvalues − 1|",
        float(abs(excess)),
        flat.shape[1] * EPS * values[0] / values[count:].sum(),
    )


def degenerate_stars(bench: Bench) -> Iterator[Entry]:
    """Duplicates, identical stars, too few stars, stars of low rank."""
    count = 8
    images = _noisy(bench, 64).astype(np.float64)
    twice = np.concatenate([images, images])
    doubled = _fit(twice, count)
    first, second = np.split(doubled.assign(twice), 2)
    yield equal("every star twice", "twins in different clusters", int((first != second).sum()), 0)
    yield equal("every star twice", "finite PSFs", bool(np.isfinite(doubled.psf).all()), True)
    yield at_most(
        "every star twice",
        "sine of the angle to the components of single stars",
        subspace_angle(doubled.components, _fit(images, count).components),
        1e-9,
    )
    identical = _fit(np.repeat(images[:1], 30, axis=0), count)
    error = np.abs(identical.predict(images[:1]) - images[0]).max() / np.abs(images[0]).max()
    yield at_most("identical stars", "error of their PSF over its peak", float(error), 30 * EPS)
    yield refused(
        "fewer stars than components", lambda: _fit(images[: count - 1], count), ValueError
    )
    rng = stream(bench.seed, "stability", "rank")
    mixing = rng.random((64, 3))
    low = (mixing @ images[:3].reshape(3, -1)).reshape(images.shape)
    fitted = _fit(low, count)
    flat = low.reshape(len(low), -1)
    centred = flat - fitted.mean
    lost = centred - centred @ fitted.components.T @ fitted.components
    yield at_most(
        "stars of rank 3, more components",
        "largest reconstruction error over the largest pixel",
        float(np.abs(lost).max() / np.abs(flat).max()),
        flat.shape[1] * EPS,
    )
    gram = fitted.components @ fitted.components.T - np.eye(count)
    yield at_most(
        "stars of rank 3, more components",
        "deviation of the components from orthonormal",
        float(np.abs(gram).max()),
        flat.shape[1] * EPS,
    )


def empty_nodes(bench: Bench) -> Iterator[Entry]:
    """A map with far more nodes than stars: nodes that win nothing are left out."""
    images = _noisy(bench, 12)
    fitted = _fit(images, 4, rows=11, columns=11)
    case = "12 stars on a map of 121 nodes"
    yield at_most(case, "nodes kept", len(fitted.psf), len(images))
    winners = np.unique(fitted.assign(images))
    yield equal(case, "kept nodes without a star", len(fitted.psf) - len(winners), 0)
    others = fitted.predict(_noisy(bench, 200))
    yield equal(case, "finite PSFs of other stars", bool(np.isfinite(others).all()), True)
    # Means of the stars of disjoint clusters, weighted by their sizes, are the mean of all.
    sizes = np.bincount(fitted.assign(images), minlength=len(fitted.psf))
    total = (sizes[:, None] * fitted.psf).sum(axis=0) / len(images)
    mean = images.reshape(len(images), -1).mean(axis=0, dtype=np.float64)
    yield at_most(
        case,
        "weighted mean of the PSFs against the mean star, over its peak",
        float(np.abs(total - mean).max() / np.abs(mean).max()),
        len(images) * EPS,
    )


def broken_stars(bench: Bench) -> Iterator[Entry]:
    """Stars without a distance to any node: in the training set, and before a fitted map."""
    images = _noisy(bench, 64).astype(np.float64)
    fitted = _fit(images, 8)
    for label, value in (("NaN", np.nan), ("infinite", np.inf)):
        broken = images.copy()
        broken[3, 4, 5] = value
        case = f"{label} pixel in a star of the baseline"
        yield refused(f"{case}'s training set", lambda b=broken: _fit(b, 8), ValueError)
        yield refused(case, lambda b=broken: fitted.predict(b), ValueError)


def _fit(images: np.ndarray, components: int, **update: int) -> PcaSom:
    return fit_pca_som(images, components, **{**SMALL_MAP, **update}, seed=1)  # type: ignore[arg-type]


def _noisy(bench: Bench, count: int) -> np.ndarray:
    rng = stream(bench.seed, "stability", "baseline")
    return bench.noise.draw(bench.seidel.images[:count], min(bench.config.noise.levels), rng)


CASES = (eigenvectors, degenerate_stars, empty_nodes, broken_stars)
"""All cases of this module."""
