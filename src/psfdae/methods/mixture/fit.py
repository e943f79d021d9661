"""Fit of a Gaussian mixture to stars: clusters, stored arrays, and search of K and ν.

Equations are numbered as on the page docs/mixture.md. Where the training images have their own
noise, as bright stars do, its covariance is subtracted from S and every XᵀX, and negative
eigenvalues are set to 0 (eq. 3).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, TypeVar

import numpy as np

from psfdae.base.progress import task
from psfdae.base.rng import stream
from psfdae.methods.interface import Method, TrainingSet

Number = TypeVar("Number", bound=float)


def k_means(
    x: np.ndarray, position: np.ndarray, clusters: int, principal: int, place: float, seed: int
) -> np.ndarray:
    """Return the cluster of each star, (n,), by k-means in the leading principal components.

    Parameters
    ----------
    x : ndarray, shape (n, P)
        Noise-free images.
    position : ndarray, shape (n, q)
        Positions, which are additional features; q may be 0.
    clusters, principal : int
        Number of clusters and of principal components.
    place : float
        RMS of the positions over the RMS of the components.
    seed : int
        Seed of the initial clusters, ≥ 0.
    """
    from sklearn.cluster import KMeans
    from sklearn.decomposition import PCA

    if clusters == 1:
        return np.zeros(len(x), int)
    # Positions of zero mean and unit variance; a constant coordinate becomes 0.
    spread = position.std(axis=0)
    standard = (position - position.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    # The RMS of the positions is `place` times the RMS of all components together.
    components = PCA(min(principal, *x.shape), svd_solver="covariance_eigh").fit_transform(x)
    scale = np.sqrt(np.square(components).sum() / len(x) / max(position.shape[1], 1))
    features = np.hstack([components, scale * (place * standard)]).astype(np.float32)
    # The seed of scikit-learn is a number, drawn from a named stream.
    draw = int(stream(seed, "gmm", "clusters").integers(2**31))
    # With more clusters, k-means++ takes ten times as long as a random start and is not better.
    init = "k-means++" if clusters <= 512 else "random"
    means = KMeans(clusters, init=init, n_init=1, random_state=draw)
    return np.asarray(means.fit(features).labels_)


def whitening_matrix(p: np.ndarray) -> np.ndarray:
    """Return the matrix W (q, q) that gives positions p (n, q) of zero mean unit covariance.

    A direction in which the field does not vary becomes 0.
    """
    # W = V / √λ with the eigenvectors V and eigenvalues λ of the covariance.
    variance, axes = np.linalg.eigh(p.T @ p / len(p))
    varies = variance > 1e-12 * max(variance.max(initial=0.0), 1e-300)
    return np.asarray(axes * np.where(varies, 1.0 / np.sqrt(np.where(varies, variance, 1.0)), 0.0))


def rows_without_noise(x: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return rows (n, P) with the products xᵀx minus noise (P, P), not negative (eq. 3)."""
    # xᵀx − N = V λ Vᵀ has the rows √λ Vᵀ, of which at most min(n, P) are needed.
    variance, axes = np.linalg.eigh(x.T @ x - noise)
    rank = min(x.shape)
    rows = np.zeros_like(x)
    rows[:rank] = (np.sqrt(np.maximum(variance, 0.0)) * axes)[:, ::-1].T[:rank]
    return rows


def mixture_arrays(
    data: TrainingSet, stars: np.ndarray, p: np.ndarray, cluster: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the arrays of the mixture of some stars, named as in `MixturePrior`, without ν.

    Parameters
    ----------
    data : TrainingSet
        Images and references of the stars, and the noise of the images.
    stars : ndarray of int, shape (n,)
        Indices of the stars.
    p : ndarray, shape (n, q)
        Their positions; q = 0 if positions are not used.
    cluster : ndarray of int, shape (n,)
        Their clusters, from 0 on; each has a star.
    """
    # Stars in the order of their clusters.
    order = np.argsort(cluster, kind="stable")
    count = np.unique(cluster, return_counts=True)[1]
    start = np.concatenate([[0], count.cumsum()[:-1]])

    def about_means(a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean of each cluster, and the residuals about it."""
        a = a.reshape(len(a), math.prod(a.shape[1:])).astype(np.float64)
        mean = np.add.reduceat(a, start) / count[:, None]
        for rows, cluster_mean in zip(np.split(a, start[1:]), mean, strict=True):
            np.subtract(rows, cluster_mean, out=rows)
        return mean, a

    # Residuals of positions, images and references; one array if the references are the images.
    no_references = np.array_equal(data.images[stars], data.references[stars])
    (mean_p, p), (mean_x, x) = about_means(p[order]), about_means(data.images[stars[order]])
    mean_y, y = (mean_x, x) if no_references else about_means(data.references[stars[order]])
    # The common change of all clusters with whitened position is subtracted from the residuals
    # (eq. 9). At most 4096 stars at once, because all would double the memory.
    whitening = whitening_matrix(p)
    p = p @ whitening
    slope, slope_y = (p.T @ a / len(a) for a in (x, y))
    parts = [slice(a, a + 4096) for a in range(0, len(x), 4096)]
    for rows in parts:
        x[rows] -= p[rows] @ slope
        y[rows] -= 0.0 if no_references else p[rows] @ slope_y
    # S, minus the noise of the images themselves (eq. 3), and its eigenvectors.
    scatter = x.T @ x
    if data.own_noise is not None and no_references and not p.size:
        for a, b, mean in zip(start, start + count, mean_x, strict=True):
            noise = data.own_noise(stars[order[a:b]], mean)
            scatter -= noise
            x[a:b] = rows_without_noise(x[a:b], noise)
    variance, axes = np.linalg.eigh(scatter / len(x))
    # By descending variance; the subtraction of noise must not make it negative.
    variance, axes = np.maximum(variance[::-1], 0.0), axes[:, ::-1]
    # Coordinates: the images along the eigenvectors.
    for rows in parts:
        x[rows] = x[rows] @ axes
    # In single precision, as the images. Arrays of references are empty if these are the images.
    none = np.empty((0, x.shape[1]), np.float32)
    return {
        "axes": axes.astype(np.float32),
        "variance": variance,
        "count": count,
        "rows": count,
        "mean": (mean_x @ axes).astype(np.float32),
        "mean_reference": none if no_references else mean_y.astype(np.float32),
        "deviation": x.astype(np.float32),
        "deviation_reference": none if no_references else y.astype(np.float32),
        "cross": none if no_references else (y.T @ x / len(x)).astype(np.float32),
        "variance_reference": none[:, 0] if no_references else np.square(y).mean(axis=0),
        "whitening": whitening,
        "center": mean_p @ whitening,
        "deviation_center": p,
        "slope": (slope @ axes).astype(np.float32),
        "slope_reference": slope_y.astype(np.float32),
    }


def climb(
    values: Sequence[Number], start: Number, error: Callable[[Number], float], pays: float = 0.0
) -> Number:
    """Climb from `start` over sorted values, upwards or else downwards, while the error falls.

    Parameters
    ----------
    values : sequence of numbers
        Values of a setting, in any order.
    start : number
        One of the values.
    error : callable
        Function that returns the error for a value.
    pays : float
        Fraction by which an upward step must lower the error.
    """
    ascending = sorted(values)
    place = ascending.index(start)
    for path, gain in ((ascending[place:], pays), (ascending[place::-1], 0.0)):
        summit = start
        for value in path[1:]:
            if error(value) >= (1.0 - gain) * error(summit):
                break
            summit = value
        # Downwards only if no upward step was better.
        if summit != start:
            break
    return summit


def best_mixture(
    error: Callable[[int, float, bool], float],
    sizes: Sequence[int],
    shrinkages: Sequence[float],
    given_position: bool,
) -> tuple[int, float, bool]:
    """Return the number of clusters K, ν, and whether the position is used, of the least error.

    Parameters
    ----------
    error : callable
        Function of K, ν, and whether the position is used, that returns the error of the mixture.
    sizes, shrinkages : sequence
        Values of K and ν; the search starts at the first ones.
    given_position : bool
        True if positions are known; they need not be used.
    """

    def search(k: int, nu: float, uses_position: bool) -> tuple[float, int, bool, float]:
        """Climb to the best ν, to the best K for it, and again to the best ν if K is smaller.

        More clusters take more time, and have the same best ν: they must lower the error by 2 %.
        """
        first = k
        nu = climb(shrinkages, nu, lambda value: error(k, value, uses_position))
        k = climb(sizes, k, lambda value: error(value, nu, uses_position), pays=0.02)
        if k < first:
            nu = climb(shrinkages, nu, lambda value: error(k, value, uses_position))
        return error(k, nu, uses_position), k, uses_position, nu

    result = _, k, _, nu = search(sizes[0], shrinkages[0], given_position)
    # Positions are not used if stars at other positions are restored better without them. This is
    # only searched if the error at the first K, whose mixtures take the least time, is less than
    # 5 % larger without them.
    if given_position and error(sizes[0], nu, False) < 1.05 * error(sizes[0], nu, True):
        result = min(result, search(k, nu, False))
    _, k, uses_position, nu = result
    return k, nu, uses_position


def best_on_validation(
    mixture: Callable[[int, bool], Any],
    data: TrainingSet,
    judge: np.ndarray,
    sizes: Sequence[int],
    shrinkages: Sequence[float],
    method_class: type[Method],
) -> tuple[int, float, bool]:
    """Return K, ν, and whether the position is used, that restore validation stars best.

    Parameters
    ----------
    mixture : callable
        Function of K and whether the position is used, that fits a mixture.
    data : TrainingSet
        Images and references of all stars.
    judge : ndarray of int
        Indices of the validation stars, to which no mixture is fitted.
    sizes, shrinkages : sequence
        Values of K and ν; the search starts at the first ones.
    method_class : type
        Class of the mixtures.
    """
    # The same noise for all mixtures, so that their errors can be compared. If there are more than
    # two λ, the smallest and the largest are left out.
    rng, levels = stream(data.seed, "noise", "gmm validation"), np.sort(data.levels)
    levels = levels[1:-1] if len(levels) > 2 else levels
    noisy = [data.noise.draw(data.images[judge], level, rng) for level in levels]
    truth, given_position = data.references[judge], method_class.needs.position
    position = data.positions[judge] if given_position else None

    cached_mixture = cache(mixture)

    @cache
    def error(k: int, nu: float, uses_position: bool) -> float:
        """Return the geometric mean of the squared error at these noise levels."""
        # Another ν changes only one array of a mixture.
        trial = replace(cached_mixture(k, uses_position), shrinkage=np.array([nu]))
        advance(1)
        errors = [
            np.square(trial.estimate(images, level, position, False).psf - truth).mean()
            for images, level in zip(noisy, levels, strict=True)
        ]
        return float(np.exp(np.mean(np.log(errors))))

    with task("mixture", len(sizes) + len(shrinkages)) as advance:
        k, nu, uses_position = best_mixture(error, sizes, shrinkages, given_position)
    # Values at an end of their range are reported, because a better one may be outside.
    last = [f"K = {k}"] * (len(sizes) > 1 and 1 < k == max(sizes))
    last += [f"ν = {nu:g}"] * (len(shrinkages) > 1 and nu in (min(shrinkages), max(shrinkages)))
    print(
        f"{method_class.look.title}: K = {k} clusters, ν = {nu:g}"
        + (", without positions" if given_position > uses_position else "")
        + (f"; {', '.join(last)}: last that were tried" if last else ""),
        flush=True,
    )
    return k, nu, uses_position
