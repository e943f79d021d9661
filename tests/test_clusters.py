"""Principal axes, k-means and the self-organising map against the packages that have them, too."""

from __future__ import annotations

import numpy as np
import pytest
from minisom import MiniSom
from sklearn.cluster import KMeans
from sklearn.decomposition import PCA
from sklearn.metrics import adjusted_rand_score

from psfdae.clusters import k_means, principal_axes
from psfdae_paper.methods.pca_som import self_organised


@pytest.fixture(scope="module")
def points():
    """Points about 30 places, more along some axes than along others."""
    rng = np.random.default_rng(0)
    places = rng.normal(size=(30, 6)) * [5, 4, 3, 2, 1, 0.5]
    return places[rng.integers(30, size=900)] + rng.normal(size=(900, 6))


def test_principal_axes_are_scikit_learn_s(points):
    mean, axes = principal_axes(points + 7.0, 4)
    theirs = PCA(4, svd_solver="full").fit(points + 7.0)
    assert mean == pytest.approx(theirs.mean_)
    assert axes == pytest.approx(theirs.components_, abs=1e-9)


@pytest.mark.parametrize(("clusters", "careful"), [(2, True), (30, True), (200, True), (60, False)])
def test_clusters_are_scikit_learn_s(points, clusters, careful):
    """The same draws lead to the same clusters; rounding may move a point between two."""
    init = "k-means++" if careful else "random"
    theirs = KMeans(clusters, init=init, n_init=1, random_state=5).fit(points.astype(np.float32))
    own = k_means(points, clusters, 5, careful)
    assert np.mean(own == theirs.labels_) > 0.99
    means = np.array([points[own == k].mean(axis=0) for k in range(clusters)])
    assert np.square(points - means[own]).sum() == pytest.approx(theirs.inertia_, rel=1e-3)


def test_empty_clusters_are_filled_as_scikit_learn_does(points):
    """Of points that are there three times, many centres that are drawn are the same."""
    three = np.repeat(points[:200], 3, axis=0)
    theirs = KMeans(150, init="random", n_init=1, random_state=5).fit(three.astype(np.float32))
    own = k_means(three, 150, 5, careful=False)
    assert len(np.unique(own)) == 150  # in another order, where distances are equal
    assert adjusted_rand_score(own, theirs.labels_) > 0.9


@pytest.mark.parametrize("careful", [True, False])
def test_equal_points_share_a_cluster_even_if_there_are_more_clusters(points, careful):
    few = np.repeat(points[:3], 5, axis=0)
    own = k_means(few, 7, 1, careful).reshape(3, 5)
    assert (own == own[:, :1]).all()
    assert len(np.unique(own)) == 3


def test_the_map_is_minisom_s_to_the_last_bit(points):
    given = dict(sigma=1.2, learning_rate=0.5)
    theirs = MiniSom(5, 4, 6, random_seed=3, **given)
    theirs.random_weights_init(points)
    theirs.train(points, 3, random_order=True, use_epochs=True)
    own = self_organised(points, (5, 4), 3, seed=3, **given)
    assert (own == theirs.get_weights().reshape(20, 6)).all()
