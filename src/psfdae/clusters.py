"""Principal axes of images, and clusters of stars by k-means.

The results are those of scikit-learn's `PCA` and `KMeans`, whose import alone takes longer than
most fits of a mixture.
"""

from __future__ import annotations

import numpy as np

POINTS_AT_ONCE = 256
"""Points whose distances to all centres fit into a processor's cache together."""

MOST_ROUNDS, TOLERANCE = 300, 1e-4
"""Of k-means: it ends where the squares of all centres' shifts add up to less than this part of
the mean variance of a coordinate."""


def principal_axes(x: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean of rows (n, P), and the leading eigenvectors (count, P) of their covariance.

    The largest element of each is positive.
    """
    mean = x.mean(axis=0)
    axes = np.linalg.eigh(x.T @ x - len(x) * np.outer(mean, mean))[1][:, : -count - 1 : -1].T
    largest = np.take_along_axis(axes, np.abs(axes).argmax(axis=1)[:, None], axis=1)
    return mean, axes * np.sign(largest)


def k_means(points: np.ndarray, clusters: int, seed: int, careful: bool = True) -> np.ndarray:
    """Number of the cluster of each point (n, q).

    Lloyd's rounds (1982, IEEE Trans. Inf. Theory 28, 129) begin with points that k-means++
    chooses (Arthur & Vassilvitskii 2007, SODA, 1027), or with any if that is not `careful`.
    """
    rng = np.random.RandomState(seed)  # scikit-learn's draws
    least = TOLERANCE * np.var(points.astype(np.float32), axis=0).mean()
    x = (points - points.mean(axis=0)).astype(np.float32)
    even = np.full(len(x), np.float32(1.0 / len(x)))  # given, it decides how points are drawn
    if careful:
        chosen = _spread(x, clusters, even, rng)
    else:
        chosen = rng.choice(len(x), clusters, replace=False, p=even)
    centre, own = x[chosen], np.full(len(x), -1)
    for _ in range(MOST_ROUNDS):
        before, own = own, _nearest(x, centre)
        moved = _means(x, own, centre)
        shift = np.square(moved - centre).sum()
        centre = moved
        if np.array_equal(own, before):
            return own
        if shift <= least:
            break
    return _nearest(x, centre)


def _spread(x: np.ndarray, count: int, even: np.ndarray, rng: np.random.RandomState) -> np.ndarray:
    """Points that k-means++ chooses: of a few that it draws, the one that gains most.

    Points are drawn in proportion to the squares of their distances from those before.
    """
    wide, weight = x.astype(np.float64), np.ones((len(x), 1), np.float32)
    norm = np.square(wide).sum(axis=1)

    def squares(some: np.ndarray) -> np.ndarray:
        """Squared distances of all points from some, (len(some), n)."""
        distance = norm[some, None] - (2.0 * wide[some]) @ wide.T
        distance += norm
        return np.asarray(np.maximum(distance, 0.0), np.float32)

    trials = 2 + int(np.log(count))
    chosen = np.empty(count, int)
    chosen[0] = rng.choice(len(x), p=even)
    (least,) = squares(chosen[:1])
    total = least @ weight
    for number in range(1, count):
        drawn = np.searchsorted(least.cumsum(), rng.uniform(size=trials) * total)
        drawn = np.minimum(drawn, len(x) - 1)
        tried = squares(drawn)
        np.minimum(tried, least, out=tried)
        totals = tried @ weight
        best = totals.argmin()
        chosen[number], least, total = drawn[best], tried[best], totals[best]
    return chosen


def _nearest(x: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Number of the centre (K, q) that is nearest to each point (n, q)."""
    # |x − c|² without the term that is the same for all centres.
    square, twice = np.einsum("kq,kq->k", centre, centre), (-2.0 * centre).T  # rounds as theirs
    parts = range(0, len(x), POINTS_AT_ONCE)
    found = [(x[a : a + POINTS_AT_ONCE] @ twice + square).argmin(axis=1) for a in parts]
    return np.concatenate(found)


def _means(x: np.ndarray, own: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Means (K, q) of the clusters; an empty one takes the point that is farthest from its own."""
    total, count = np.zeros_like(centre), np.bincount(own, minlength=len(centre))
    filled = np.flatnonzero(count)
    start = np.concatenate([[0], count[filled].cumsum()[:-1]])
    total[filled] = np.add.reduceat(x[own.argsort(kind="stable")], start)
    (empty,) = np.nonzero(count == 0)
    away = np.square(x - centre[own]).sum(axis=1) if empty.size else np.zeros(0)
    if away.any():
        far = away.argpartition(-empty.size)[: -empty.size - 1 : -1]
        for point, new in zip(far, empty, strict=True):
            total[own[point]] -= x[point]
            total[new] = x[point]
            count[own[point]] -= 1
            count[new] = 1
    mean = total * (np.float32(1.0) / np.maximum(count, 1).astype(np.float32))[:, None]
    most = count.argmax()
    for lost in np.flatnonzero(count == 0):  # its only point was taken: as scikit-learn does
        mean[lost] = total[most] if lost < most else mean[most]
    return np.asarray(mean)
