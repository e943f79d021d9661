"""Cost and error of the PCA+SOM baseline over its three sizes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from psfdae.estimators.pca_som import fit_pca_som

COMPONENTS = (5, 10, 20, 40)
MAPS = (7, 11, 15)
EPOCHS = (2, 10, 50)

CHEAP_S = 3.0
"""A fit is repeated as long as its repeats together stay below this time."""


def grid_around(
    components: int, rows: int, columns: int, epochs: int, most_components: int
) -> list[dict[str, Any]]:
    """Settings that differ from the configured ones in one size, and the two extremes.

    Parameters
    ----------
    components, rows, columns, epochs : int
        The configured sizes; their point is marked `used`.
    most_components : int
        Largest K that images and stars allow.

    Returns
    -------
    list of dict
        components, rows, columns, epochs, used.
    """
    used = (components, rows, columns, epochs)
    points = [used]
    points += [(k, rows, columns, epochs) for k in COMPONENTS]
    points += [(components, side, side, epochs) for side in MAPS]
    points += [(components, rows, columns, t) for t in EPOCHS]
    points += [(c[0], m[0], m[0], e[0]) for c, m, e in _extremes()]
    names = ("components", "rows", "columns", "epochs")
    return [
        {**dict(zip(names, point, strict=True)), "used": point == used}
        for point in dict.fromkeys(points)
        if point[0] <= most_components
    ]


def _extremes() -> tuple[tuple[tuple[int, ...], ...], ...]:
    sizes = (COMPONENTS, MAPS, EPOCHS)
    return tuple(s[:1] for s in sizes), tuple(s[-1:] for s in sizes)


def time_point(
    train: np.ndarray,
    tests: Sequence[np.ndarray],
    truths: dict[str, np.ndarray],
    fit: dict[str, Any],
    repeats: int,
) -> dict[str, float]:
    """Fit one setting, apply it, and measure time and error.

    Parameters
    ----------
    train : ndarray, shape (n, d, d)
        Noisy training images.
    tests : sequence of ndarray, shape (t, d, d)
        Noisy test images, one array per noise level.
    truths : mapping of reference to ndarray, shape (t, d, d)
    fit : mapping
        Arguments of `fit_pca_som`.
    repeats : int
        Timings at most; the median is returned.

    Returns
    -------
    dict
        fit_s, predict_stars_per_s, repeats, and mse_<reference>, the mean over
        stars, pixels and noise levels.
    """
    model, fit_s, done = _median_time(lambda: fit_pca_som(train, **fit), repeats)
    estimates, predict_s, _ = _median_time(lambda: [model.predict(x) for x in tests], repeats)
    return {
        "fit_s": fit_s,
        "predict_stars_per_s": sum(len(x) for x in tests) / predict_s,
        "repeats": done,
        **{
            f"mse_{name}": float(np.mean([((e - truth) ** 2).mean() for e in estimates]))
            for name, truth in truths.items()
        },
    }


def _median_time(call: Callable[[], Any], repeats: int) -> tuple[Any, float, int]:
    times: list[float] = []
    result = None
    while not times or (len(times) < repeats and sum(times) + times[0] < CHEAP_S):
        start = perf_counter()
        result = call()
        times.append(perf_counter() - start)
    return result, float(np.median(times)), len(times)
