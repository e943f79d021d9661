"""Which training is long enough."""

from __future__ import annotations

import numpy as np
import pytest

from psfdae.benchmark.training import knee, pareto, stopping_point


def test_front_holds_what_nothing_beats():
    time = np.array([4.0, 1.0, 2.0, 3.0, 4.0])
    error = np.array([0.5, 1.0, 0.6, 0.7, 0.4])
    assert pareto(time, error).tolist() == [1, 2, 4]


@pytest.mark.parametrize(
    ("gains", "chosen"),
    [
        ([0.5, 0.5, 0.5], 3),  # every doubling pays
        ([0.5, 0.95, 0.95], 1),  # only the first
        ([0.95, 0.6, 0.95], 2),  # a flat stretch may be crossed for a later gain
        ([0.99, 0.99, 0.99], 0),
    ],
)
def test_knee_is_where_doublings_stop_paying(gains, chosen):
    time = 2.0 ** np.arange(4)
    error = np.r_[1.0, np.cumprod(gains)]
    shuffled = np.array([2, 0, 3, 1])
    assert shuffled[knee(time[shuffled], error[shuffled])] == chosen


@pytest.mark.parametrize(
    ("scores", "patience", "stop"),
    [
        ([5, 4, 3, 3.5, 3.2, 3.1, 2], 2, 4),
        ([5, 4, 3, 2], 2, 3),
        ([5, 4, 4.5, 3, 3.1, 3.2, 3.3], 3, 6),
        ([5, 5, 5], 2, 2),
    ],
)
def test_patience_on_a_history(scores, patience, stop):
    assert stopping_point(np.array(scores, float), patience) == stop
