"""The baseline: principal components clustered by a self-organising map.

Star images are mean-subtracted and projected on their first K eigenvectors
(eqs. 2–5 of the paper), a self-organising map clusters the K features (eqs.
6–8), and the mean star image of a cluster is the PSF of all its stars. The
map is MiniSom's.

The paper does not give the noise of its training stars: see `baseline.per_level`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field

from psfdae.base.rng import stream
from psfdae.base.settings import Config, Count, Group, Positive
from psfdae.methods.interface import FitError, Look, Method, Needs, Storage, TrainingSet


class Baseline(Group):
    """PCA features clustered by a self-organising map."""

    per_level: bool = True
    """A fit for each noise level λ, on stars of its noise; else one for mixed λ."""
    components: Count = 20
    """Principal components K."""
    rows: Count = 11
    """Rows of the map."""
    columns: Count = 11
    """Columns of the map."""
    epochs: Count = 10
    """Passes over the training stars, t_max."""
    sigma: Positive = 1.0
    """Initial neighbourhood radius in map nodes."""
    learning_rate: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Initial learning rate of the map."""
    threads: Count = 1
    """Threads of the linear algebra."""


@dataclass(frozen=True)
class PcaFit:
    """One fit, as arrays.

    Attributes
    ----------
    mean : ndarray, shape (P,)
        Mean training image.
    components : ndarray, shape (K, P)
        Eigenvectors, rows.
    nodes : ndarray, shape (M, K)
        Map nodes in feature space; only nodes with training stars.
    psf : ndarray, shape (M, P)
        Mean star image of each node's cluster.
    """

    mean: np.ndarray
    components: np.ndarray
    nodes: np.ndarray
    psf: np.ndarray

    def features(self, images: np.ndarray) -> np.ndarray:
        """Project images (n, d, d) on the components, shape (n, K).

        Raises
        ------
        ValueError
            If an image has a pixel that is not finite: the nearest node is undefined.
        """
        # y = Aᵀ (x − mean), with the eigenvectors as columns of A (eqs. 2–5).
        features: np.ndarray = (images.reshape(len(images), -1) - self.mean) @ self.components.T
        if not (finite := np.isfinite(features).all(axis=1)).all():
            raise ValueError(
                f"images: {np.count_nonzero(~finite)} of {len(images)} have pixels that are not "
                f"finite, the first is number {int(np.argmin(finite))}"
            )
        return features

    def assign(self, images: np.ndarray) -> np.ndarray:
        """Return the nearest node in feature space (eq. 7) of every image, shape (n,).

        Raises ValueError as `features` does.
        """
        # |y − m|² = |m|² − 2 y·m + |y|², without |y|², which is the same for all nodes.
        score = (self.nodes**2).sum(axis=1) - 2.0 * self.features(images) @ self.nodes.T
        return np.asarray(score.argmin(axis=1))

    def predict(self, images: np.ndarray) -> np.ndarray:
        """Return the PSF of every image's node, shape (n, d, d).

        Raises ValueError as `features` does.
        """
        return np.asarray(self.psf[self.assign(images)].reshape(images.shape))


@dataclass(frozen=True)
class PcaSom(Method):
    """Fits of the baseline for one noise band.

    Attributes
    ----------
    level : ndarray, shape (L,)
        Noise level λ of each fit, ascending; 0 of a single one for all levels.
    fits : tuple of PcaFit
        Fit of each level.
    """

    look = Look("PCA+SOM", "#d55e00", "s", paper=("pca", "PCA"))
    needs = Needs(level=True, minutes=20)
    storage = Storage(
        arrays={
            "level": ("1", "noise level λ of each fit; 0: one for all"),
            "mean": ("1", "mean training image of each fit"),
            "components": ("1", "eigenvectors of each fit, rows"),
            "nodes": ("1", "map nodes of all fits in feature space"),
            "psf": ("1", "mean star image of each node's cluster"),
            "owner": ("1", "number of each node's fit"),
        },
        rule="baseline",
    )
    packing = None
    groups: ClassVar = {"baseline": Baseline}

    level: np.ndarray
    fits: tuple[PcaFit, ...]

    @classmethod
    def check(cls, config: Config) -> None:
        """Raise ValueError if there are more components than pixels or training stars."""
        components, side = config.baseline.components, config.framing.stamp_px
        train_stars = config.parts.train_stars
        for name, limit in (("framing.stamp_px²", side**2), ("parts.train_stars", train_stars)):
            if components > limit:
                raise ValueError(
                    f"baseline.components = {components}: must be at most {name} = {limit}"
                )

    @classmethod
    def fit(cls, data: TrainingSet, baseline: Baseline) -> PcaSom:
        """Fit noisy images of the training stars, level by level or at mixed λ.

        Raises
        ------
        FitError
            If there are fewer stars than components.
        """
        # Fits with and without validation stars draw their noise from different streams.
        validation = "" if data.validation.size else " validation"
        if baseline.components > data.train.size:
            raise FitError(
                f"baseline.components = {baseline.components}: must be at most "
                f"{data.train.size}, the number of training stars"
                f"{' that are not used for validation' if validation else ''}"
            )
        # One fit for each noise level, or a single one for noise of all levels, marked by level 0.
        seed = int(stream(data.seed, "baseline", "map").integers(2**31))
        level = np.sort(data.levels) if baseline.per_level else np.zeros(1)
        images = _draw_noisy_images(data, level, f"baseline{validation}")
        return cls(level, tuple(fit_pca_som(noisy, baseline, seed) for noisy in images))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of all fits."""
        # Arrays of equal shapes are stacked. Fits may differ in the number of nodes: these arrays
        # are joined, and `owner` is the number of each node's fit.
        return {
            "level": self.level,
            "mean": np.stack([fit.mean for fit in self.fits]),
            "components": np.stack([fit.components for fit in self.fits]),
            "nodes": np.concatenate([fit.nodes for fit in self.fits]),
            "psf": np.concatenate([fit.psf for fit in self.fits]),
            "owner": np.repeat(np.arange(len(self.fits)), [len(fit.nodes) for fit in self.fits]),
        }

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """Make the fits from the arrays of `to_arrays`."""
        fits = []
        for number, (mean, components) in enumerate(
            zip(arrays["mean"], arrays["components"], strict=True)
        ):
            # `owner` is the number of each node's fit.
            is_own = arrays["owner"] == number
            fits.append(PcaFit(mean, components, arrays["nodes"][is_own], arrays["psf"][is_own]))
        return cls(arrays["level"], tuple(fits))

    def predict(self, images: np.ndarray, level: float | np.ndarray) -> np.ndarray:
        """Predict the PSF of every image by the fit of the nearest λ on a logarithmic scale.

        Parameters
        ----------
        images : ndarray, shape (n, d, d)
            Noisy stars of sum 1.
        level : float or ndarray, shape (n,)
            Noise level λ.

        Returns
        -------
        ndarray, shape (n, d, d)

        Raises
        ------
        ValueError
            If an image has a pixel that is not finite.
        """
        # Geometric means of neighbouring levels separate the ranges of the fits.
        borders = np.sqrt(self.level[1:] * self.level[:-1])
        nearest = np.broadcast_to(np.searchsorted(borders, level), len(images))
        psf = np.empty(images.shape)
        for i in np.unique(nearest):
            psf[nearest == i] = self.fits[i].predict(images[nearest == i])
        return psf


def _draw_noisy_images(data: TrainingSet, levels: np.ndarray, name: str) -> Iterator[np.ndarray]:
    """Draw noisy images of the training stars for each fit; level 0 mixes all levels."""
    for level in levels:
        if level:
            rng = stream(data.seed, "noise", name, f"{level:.6g}")
            yield data.noise.draw(data.images[data.train], level, rng)
        else:
            yield data.draw(data.train, stream(data.seed, "noise", name))[0]


def fit_pca_som(images: np.ndarray, settings: Baseline, seed: int) -> PcaFit:
    """Fit the baseline on noisy star images of one level, or of mixed ones.

    Nodes without training stars, which have no mean image, are left out of the fitted
    map: a test star is assigned to the nearest of the other nodes.

    Parameters
    ----------
    images : ndarray, shape (n, d, d)
        Noisy training stars of sum 1.
    settings : Baseline
        Number of components K, at most min(n, d²), and the training of the map.
    seed : int
        Seed of the map's initial weights and of the order of stars.
    """
    flat = images.reshape(len(images), -1).astype(np.float64)
    # Coefficients of the stars along the principal axes, on which the map is trained.
    mean, axes = principal_axes(flat, settings.components)
    features = flat @ axes.T - mean @ axes.T
    nodes = train_map(features, settings, seed)
    # Cluster of each star, and the mean image of each cluster that has stars.
    whole_map = PcaFit(mean, axes, nodes, np.empty((len(nodes), flat.shape[1])))
    winner = whole_map.assign(images)
    count = np.bincount(winner, minlength=len(nodes))
    total = np.zeros((len(nodes), flat.shape[1]))
    np.add.at(total, winner, flat)
    has_stars = count > 0
    return PcaFit(mean, axes, nodes[has_stars], total[has_stars] / count[has_stars, None])


def principal_axes(x: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute the mean of rows, and the leading eigenvectors of their covariance.

    Parameters
    ----------
    x : ndarray, shape (n, P)
        Samples, one per row.
    count : int
        Number of eigenvectors.

    Returns
    -------
    mean : ndarray, shape (P,)
    axes : ndarray, shape (count, P)
        From the largest eigenvalue on. The sign of an eigenvector is arbitrary: here its
        largest element is positive.
    """
    mean = x.mean(axis=0)
    # n times the covariance is Xᵀ X − n mean meanᵀ.
    # `eigh` sorts eigenvalues in ascending order.
    axes = np.linalg.eigh(x.T @ x - len(x) * np.outer(mean, mean))[1][:, : -count - 1 : -1].T
    largest = np.take_along_axis(axes, np.abs(axes).argmax(axis=1)[:, None], axis=1)
    return mean, axes * np.sign(largest)


def train_map(features: np.ndarray, settings: Baseline, seed: int) -> np.ndarray:
    """Train a self-organising map on features (n, K); parameters as for `fit_pca_som`.

    The nodes are MiniSom's to the last bit, in less time. Two things are computed only once: the
    neighbourhood function of each winner, which changes from epoch to epoch only, and the
    differences between a star and the nodes, which determine both the winner and the update.

    Returns
    -------
    ndarray, shape (M, K)
    """
    from minisom import MiniSom

    class Map(MiniSom):  # type: ignore[misc]  # it has no types
        def winner(self, x: np.ndarray) -> int:
            # Nearest node (eq. 7).
            np.subtract(x, nodes, out=difference)
            return int(np.vecdot(difference, difference).argmin())

        def update(self, x: np.ndarray, win: int, t: int, max_iteration: int) -> None:
            # m ← m + η h (y − m) with the neighbourhood function h of the winner.
            np.multiply(difference, rates(t)[win], out=difference)
            np.add(nodes, difference, out=nodes)

    @cache
    def rates(epoch: int) -> list[np.ndarray]:
        """Return η h, the rates of all nodes (M, 1), for each possible winner."""
        # MiniSom's asymptotic decay of learning rate and radius.
        decay = 1.0 + epoch / (settings.epochs / 2)
        radius, rate = settings.sigma / decay, settings.learning_rate / decay
        return [
            (rate * som.neighborhood(node, radius)).reshape(-1, 1) for node in np.ndindex(shape)
        ]

    shape = (settings.rows, settings.columns)
    initial = {"sigma": settings.sigma, "learning_rate": settings.learning_rate}
    som = Map(*shape, features.shape[1], **initial, random_seed=seed)
    som.random_weights_init(features)
    # A view of the map's weights: MiniSom's training changes the array that is returned.
    nodes: np.ndarray = som.get_weights().reshape(-1, features.shape[1])
    difference = np.empty_like(nodes)
    som.train(features, settings.epochs, random_order=True, use_epochs=True)
    return nodes
