"""The baseline: principal components clustered by a self-organising map.

Star images are mean-subtracted and projected on their first K eigenvectors
(eqs. 2–5 of the paper), a self-organising map clusters the K features (eqs.
6–8), and the mean star image of a cluster is the PSF of all its stars. The
decomposition is scikit-learn's, the map is MiniSom's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PcaSom:
    """A fitted baseline: three arrays that can be stored and applied without a library.

    Attributes
    ----------
    mean : ndarray, shape (P,)
        Mean training image.
    components : ndarray, shape (K, P)
        Eigenvectors, rows.
    nodes : ndarray, shape (M, K)
        Map nodes in feature space; only nodes that won a training star.
    psf : ndarray, shape (M, P)
        Mean star image of each node's cluster.
    """

    mean: np.ndarray
    components: np.ndarray
    nodes: np.ndarray
    psf: np.ndarray

    def assign(self, images: np.ndarray) -> np.ndarray:
        """Winning node (eq. 7) of every image, shape (n,).

        Raises
        ------
        ValueError
            If an image has a pixel that is not finite: it is nearest to no node.
        """
        features = (images.reshape(len(images), -1) - self.mean) @ self.components.T
        if not (finite := np.isfinite(features).all(axis=1)).all():
            raise ValueError(
                f"images: {np.count_nonzero(~finite)} of {len(images)} have pixels that are not "
                f"finite, the first is number {int(np.argmin(finite))}"
            )
        # |y − m|² without the term that is the same for all nodes.
        score = (self.nodes**2).sum(axis=1) - 2.0 * features @ self.nodes.T
        return score.argmin(axis=1)

    def predict(self, images: np.ndarray) -> np.ndarray:
        """PSF of every image, shape (n, d, d); raises as `assign`."""
        return self.psf[self.assign(images)].reshape(images.shape)


def fit_pca_som(
    images: np.ndarray,
    components: int,
    rows: int,
    columns: int,
    epochs: int,
    sigma: float,
    learning_rate: float,
    seed: int,
) -> PcaSom:
    """Fit the baseline on noisy star images.

    Nodes that win no training star have no mean image; they are left out of the
    fitted map, so a test star falls to the nearest node that has one.

    Parameters
    ----------
    images : ndarray, shape (n, d, d)
    components : int
        K, at most min(n, d²).
    rows, columns : int
        Size of the map.
    epochs : int
        Passes over the stars (t_max).
    sigma, learning_rate : float
        Initial values; the neighbourhood radius `sigma` is in nodes.
    seed : int
        Seed of the map's initial weights and of the order of stars.

    Raises
    ------
    ValueError
        If there are fewer images than components.
    """
    from minisom import MiniSom
    from sklearn.decomposition import PCA

    flat = images.reshape(len(images), -1).astype(np.float64)
    if components > min(flat.shape):
        raise ValueError(
            f"baseline.components = {components}: must be at most {min(flat.shape)} "
            f"(stars and pixels: {flat.shape})"
        )
    pca = PCA(components, svd_solver="full").fit(flat)
    # The sign of an eigenvector is free; scikit-learn fixes it, so runs agree.
    features = pca.transform(flat)
    som = MiniSom(
        rows, columns, components, sigma=sigma, learning_rate=learning_rate, random_seed=seed
    )
    som.random_weights_init(features)
    som.train(features, epochs, random_order=True, use_epochs=True)
    nodes = som.get_weights().reshape(-1, components)
    full = PcaSom(pca.mean_, pca.components_, nodes, np.empty((len(nodes), flat.shape[1])))
    winner = full.assign(images)
    count = np.bincount(winner, minlength=len(nodes))
    total = np.zeros((len(nodes), flat.shape[1]))
    np.add.at(total, winner, flat)
    won = count > 0
    return PcaSom(pca.mean_, pca.components_, nodes[won], total[won] / count[won, None])
