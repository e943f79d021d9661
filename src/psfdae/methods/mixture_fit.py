"""Fit of a Gaussian mixture to stars: their clusters, what is stored of them, and the search.

Equations are numbered as on the page docs/mixture.md. Where the training images have noise of their
own, as bright stars do, its covariance is subtracted from S and every XᵀX, and eigenvalues that
would be negative are 0 (eq. 3).
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
    position : ndarray, shape (n, q)
        Positions, which join the components.
    clusters, principal : int
        Number of clusters and of principal components.
    place : float
        RMS of the positions over that of the components.
    seed : int
    """
    from sklearn.cluster import KMeans
    from sklearn.decomposition import PCA

    if clusters == 1:
        return np.zeros(len(x), int)
    # Positions of zero mean and unit variance; what does not vary is 0.
    spread = position.std(axis=0)
    standard = (position - position.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    # The positions weigh `place` times as much as all components together.
    components = PCA(min(principal, *x.shape), svd_solver="covariance_eigh").fit_transform(x)
    scale = np.sqrt(np.square(components).sum() / len(x) / max(position.shape[1], 1))
    features = np.hstack([components, scale * (place * standard)]).astype(np.float32)
    # scikit-learn takes a number as seed.
    draw = int(stream(seed, "gmm", "clusters").integers(2**31))
    # With more clusters, k-means++ takes ten times as long as a random start, and is no better.
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
    """Return rows (n, P) whose products are xᵀx less that of noise (P, P), not negative (eq. 3)."""
    # xᵀx − N = V λ Vᵀ has the rows √λ Vᵀ, of which no more than min(n, P) can be needed.
    variance, axes = np.linalg.eigh(x.T @ x - noise)
    rank = min(x.shape)
    rows = np.zeros_like(x)
    rows[:rank] = (np.sqrt(np.maximum(variance, 0.0)) * axes)[:, ::-1].T[:rank]
    return rows


def mixture_arrays(
    data: TrainingSet, stars: np.ndarray, p: np.ndarray, cluster: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the arrays of the mixture of some stars, as `MixtureLaw` names them, but for ν.

    Parameters
    ----------
    data : TrainingSet
    stars : ndarray of int, shape (n,)
        Indices of the stars.
    p : ndarray, shape (n, q)
        Their positions; q = 0 if they are not used.
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

    # Residuals of positions, images and references; where these are the images, they are one array.
    no_references = np.array_equal(data.images[stars], data.references[stars])
    (mean_p, p), (mean_x, x) = about_means(p[order]), about_means(data.images[stars[order]])
    mean_y, y = (mean_x, x) if no_references else about_means(data.references[stars[order]])
    # The change with whitened position that is common to all clusters, and the residuals that it
    # leaves (eq. 9). At most 4096 stars at once: all would take as much memory again.
    whitening = whitening_matrix(p)
    p = p @ whitening
    slope, slope_y = (p.T @ a / len(a) for a in (x, y))
    parts = [slice(a, a + 4096) for a in range(0, len(x), 4096)]
    for rows in parts:
        x[rows] -= p[rows] @ slope
        y[rows] -= 0.0 if no_references else p[rows] @ slope_y
    # S, less the noise of the images themselves (eq. 3), and its eigenvectors.
    scatter = x.T @ x
    if data.own_noise is not None and no_references and not p.size:
        for a, b, mean in zip(start, start + count, mean_x, strict=True):
            noise = data.own_noise(stars[order[a:b]], mean)
            scatter -= noise
            x[a:b] = rows_without_noise(x[a:b], noise)
    variance, axes = np.linalg.eigh(scatter / len(x))
    # By descending variance, which the noise that is subtracted must not make negative.
    variance, axes = np.maximum(variance[::-1], 0.0), axes[:, ::-1]
    # Coordinates: the images along the eigenvectors.
    for rows in parts:
        x[rows] = x[rows] @ axes
    # In single precision, as images are. Without references of their own, their arrays are empty.
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


def climbed(
    values: Sequence[Number], start: Number, error: Callable[[Number], float], pays: float = 0.0
) -> Number:
    """Hill-climb from `start` over sorted values, up or else down, while the error falls.

    Parameters
    ----------
    values : sequence of numbers
    start : number
        One of the values.
    error : callable
        Error of a value.
    pays : float
        Part by which a step up must lower the error.
    """
    ascending = sorted(values)
    place = ascending.index(start)
    for path, gain in ((ascending[place:], pays), (ascending[place::-1], 0.0)):
        summit = start
        for value in path[1:]:
            if error(value) >= (1.0 - gain) * error(summit):
                break
            summit = value
        # Downwards only where no step up was better.
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
        Error of a mixture with K, ν, and with the position used or not.
    sizes, shrinkages : sequence
        Values of K and ν; the search starts at the first ones.
    given_position : bool
        Positions are given, and may be left aside.
    """

    def search(k: int, nu: float, used: bool) -> tuple[float, int, bool, float]:
        """Climb to the best ν, to the best K there, and on to the best ν of fewer clusters.

        More clusters take longer, and the same ν is best for them: they have to lower the error by
        2 %.
        """
        first = k
        nu = climbed(shrinkages, nu, lambda value: error(k, value, used))
        k = climbed(sizes, k, lambda value: error(value, nu, used), pays=0.02)
        if k < first:
            nu = climbed(shrinkages, nu, lambda value: error(k, value, used))
        return error(k, nu, used), k, used, nu

    result = _, k, _, nu = search(sizes[0], shrinkages[0], given_position)
    # Positions are left aside if that restores stars in other places better. This is searched only
    # if the first K, whose mixtures take the least time, does not err 5 % more without them.
    if given_position and error(sizes[0], nu, False) < 1.05 * error(sizes[0], nu, True):
        result = min(result, search(k, nu, False))
    _, k, used, nu = result
    return k, nu, used


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
        Fits a mixture with K clusters, and with the position used or not.
    data : TrainingSet
    judge : ndarray of int
        Indices of the validation stars, from which no mixture learns.
    sizes, shrinkages : sequence
        Values of K and ν that may be tried; the search starts at the first ones.
    method_class : type
        Class of the mixtures.
    """
    # The same noise for all mixtures, so that their errors can be compared. Of many λ, those
    # between the least and the greatest stand for all.
    rng, levels = stream(data.seed, "noise", "gmm validation"), np.sort(data.levels)
    levels = levels[1:-1] if len(levels) > 2 else levels
    noisy = [data.noise.draw(data.images[judge], level, rng) for level in levels]
    truth, given_position = data.references[judge], method_class.needs.position
    position = data.positions[judge] if given_position else None

    cached_mixture = cache(mixture)

    @cache
    def error(k: int, nu: float, used: bool) -> float:
        """Return the geometric mean of the squared error at these noise levels."""
        # Another ν changes no array of a mixture but one.
        fitted = replace(cached_mixture(k, used), shrinkage=np.array([nu]))
        advance(1)
        errors = [
            np.square(fitted.estimate(images, level, position, False).psf - truth).mean()
            for images, level in zip(noisy, levels, strict=True)
        ]
        return float(np.exp(np.mean(np.log(errors))))

    with task("mixture", len(sizes) + len(shrinkages)) as advance:
        k, nu, used = best_mixture(error, sizes, shrinkages, given_position)
    # Values at an end of their range: a better one may lie beyond it. One cluster is the fewest.
    last = [f"K = {k}"] * (len(sizes) > 1 and 1 < k == max(sizes))
    last += [f"ν = {nu:g}"] * (len(shrinkages) > 1 and nu in (min(shrinkages), max(shrinkages)))
    print(
        f"{method_class.look.title}: K = {k} clusters, ν = {nu:g}"
        + (", without positions" if given_position > used else "")
        + (f"; {', '.join(last)}: last that were tried" if last else ""),
        flush=True,
    )
    return k, nu, used
