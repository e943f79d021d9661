"""Principal axes and the self-organising map of the baseline beside the packages that have them."""

from __future__ import annotations

import numpy as np
import pytest
from minisom import MiniSom
from sklearn.decomposition import PCA

from psfdae_paper.methods.pca_som import Baseline, principal_axes, train_map


@pytest.fixture(scope="module")
def points():
    """Points about 30 places, more along some axes than along others."""
    rng = np.random.default_rng(0)
    places = rng.normal(size=(30, 6)) * [5, 4, 3, 2, 1, 0.5]
    return places[rng.integers(30, size=900)] + rng.normal(size=(900, 6))


def test_principal_axes_are_scikit_learn_s(points):
    mean, axes = principal_axes(points + 7.0, 4)
    expected = PCA(4, svd_solver="full").fit(points + 7.0)
    assert mean == pytest.approx(expected.mean_)
    assert axes == pytest.approx(expected.components_, abs=1e-9)


def test_the_map_is_minisom_s_to_the_last_bit(points):
    settings = dict(sigma=1.2, learning_rate=0.5)
    minisom = MiniSom(5, 4, 6, random_seed=3, **settings)
    minisom.random_weights_init(points)
    minisom.train(points, 3, random_order=True, use_epochs=True)
    nodes = train_map(points, Baseline(rows=5, columns=4, epochs=3, **settings), seed=3)
    assert (nodes == minisom.get_weights().reshape(20, 6)).all()
