"""Method `gmm`: a Gaussian mixture of noise-free stars, whose posterior mean restores the PSF.

The mixture is in `psfdae.methods.mixture_law`; here it is fitted and stored. Equations are numbered
as on the page docs/mixture.md. Where the training images have noise of their own, as bright stars
do, its covariance is subtracted from S and every XᵀX, and eigenvalues that would be negative are 0
(eq. 3).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self, TypeVar

import numpy as np
from pydantic import Field

from psfdae.method import (
    Estimate,
    FitError,
    Look,
    Method,
    Needs,
    Packing,
    Storage,
    TrainingSet,
)
from psfdae.methods.mixture_law import FLAT_VARIANCE, MixtureLaw
from psfdae.mixing import FLUX_SIGMA
from psfdae.noise import NoiseModel
from psfdae.progress import task
from psfdae.rng import stream
from psfdae.settings import Count, Group, Positive

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from psfdae.bundle_info import BundleInfo

Number = TypeVar("Number", bound=float)


class Gmm(Group):
    """Mixture of Gaussians; of several values the validation stars choose."""

    stars: Count | None = Field(None, description="Training stars that are learnt from; null: all")
    components: Annotated[list[Count], Field(min_length=1)] = Field(
        [16, 1, 4, 64, 128],
        description="Clusters K among which a search goes, from the first one, as long as it "
        "pays; more than stars are not",
    )
    shrinkage: Annotated[list[Positive], Field(min_length=1)] = Field(
        [10.0, 3.0, 30.0, 100.0],
        description="Stars ν that the covariance of all clusters counts for in each; searched "
        "from the first one, too",
    )
    principal: Count = Field(40, description="Principal components in which stars are clustered")
    place: Positive = Field(
        1.0,
        description="RMS of the field position beside that of the principal components, "
        "for methods that are given it",
    )
    threads: Count = Field(1, description="Threads of the linear algebra")


@dataclass(frozen=True, eq=False)
class GaussianMixture(MixtureLaw, Method):
    """Fitted Gaussian mixture."""

    look = Look("GMM", "#cc79a7", "P")
    needs = Needs(level=True, memory_mb=1200)
    storage = Storage(
        arrays={
            "axes": ("1", "eigenvectors of the covariance within clusters, columns"),
            "variance": ("1", "its eigenvalues"),
            "count": ("1", "stars of each cluster"),
            "rows": ("1", "rows of deviation of each cluster"),
            "mean": ("1", "mean image of each cluster, in the axes"),
            "mean_reference": ("1", "mean reference of each cluster"),
            "deviation": ("1", "images less the mean of their cluster, in the axes"),
            "deviation_reference": ("1", "references less the mean of their cluster"),
            "cross": ("1", "covariance of references and images (in the axes) within clusters"),
            "variance_reference": ("1", "variance of references within clusters"),
            "whitening": ("1", "to positions of unit variance within clusters"),
            "center": ("1", "mean whitened position of each cluster"),
            "deviation_center": ("1", "whitened positions less that of their cluster"),
            "slope": ("1", "common change of images (in the axes) with whitened position"),
            "slope_reference": ("1", "common change of references with whitened position"),
            "shrinkage": ("1", "stars that the common covariance counts for"),
        },
        per_reference=True,
    )
    packing: ClassVar[Packing | None] = Packing(together=8192, padded=False)
    groups: ClassVar = {"gmm": Gmm}
    finds_flux = True

    @classmethod
    def fit(cls, data: TrainingSet, gmm: Gmm) -> Self:
        """Choose K, then ν, on the validation stars, and fit all training stars.

        Raises
        ------
        FitError
            If every K exceeds the number of stars.
        """
        searched = len(gmm.components) * len(gmm.shrinkage) > 1
        learn, judge = (data.fit, data.validation) if searched else (data.train, data.train[:0])
        learn = learn[: gmm.stars]
        if searched and not judge.size:
            # Without validation stars, every tenth training star serves as one.
            judge, learn = learn[::10], np.delete(learn, np.s_[::10])
        sizes = [k for k in gmm.components if k <= learn.size]
        if not sizes:
            raise FitError(
                f"{next(iter(cls.groups))}.components = {gmm.components}: "
                f"must be at most {learn.size}, the number of training stars"
                f"{' without those that choose' if searched else ''}"
            )
        clusters, positions, shrinkage = sizes[0], cls.needs.position, gmm.shrinkage[0]
        if searched:
            clusters, positions, shrinkage = cls._search(data, learn, judge, sizes, gmm)
        final = cls._clustered(data, data.train[: gmm.stars], clusters, gmm, positions)
        return replace(final, shrinkage=np.array([shrinkage]))

    @classmethod
    def _search(
        cls, data: TrainingSet, learn: np.ndarray, judge: np.ndarray, sizes: list[int], gmm: Gmm
    ) -> tuple[int, bool, float]:
        """Return K, whether the position is used, and ν that restore validation stars best.

        Parameters
        ----------
        data : TrainingSet
        learn, judge : ndarray of int
            Indices of the stars that are fitted, and of those on which errors are measured.
        sizes : list of int
            Numbers of clusters K that may be tried; the search starts at the first.
        gmm : Gmm
        """
        rng = stream(data.seed, "noise", "gmm validation")
        noisy = [data.noise.draw(data.images[judge], level, rng) for level in data.levels]
        truth, position = data.references[judge], cls._positions_of(data, judge)

        @cache
        def clustered(k: int, positions: bool) -> GaussianMixture:
            return cls._clustered(data, learn, k, gmm, positions)

        @cache
        def error(k: int, nu: float, positions: bool) -> float:
            """Return the geometric mean of the squared error over the noise levels."""
            mixture = replace(clustered(k, positions), shrinkage=np.array([nu]))
            advance(1)
            pairs = zip(noisy, data.levels, strict=True)
            errors = [np.square(mixture.predict(z, s, position) - truth).mean() for z, s in pairs]
            return float(np.exp(np.mean(np.log(errors))))

        def search(k: int, nu: float, positions: bool) -> tuple[float, int, bool, float]:
            """Climb to the best ν, to the best K there, and on to the best ν of fewer clusters.

            More clusters take longer, and the same ν is best for them: they have to lower the error
            by 2 %.
            """
            first = k
            nu = climbed(gmm.shrinkage, nu, lambda value: error(k, value, positions))
            k = climbed(sizes, k, lambda value: error(value, nu, positions), 0.02)
            if k < first:
                nu = climbed(gmm.shrinkage, nu, lambda value: error(k, value, positions))
            return error(k, nu, positions), k, positions, nu

        with task("mixture", len(sizes) + len(gmm.shrinkage)) as advance:
            result = search(sizes[0], gmm.shrinkage[0], cls.needs.position)
            if cls.needs.position:
                # Positions are left aside if that restores stars in other places better. It is
                # searched only if the error without them is within 5 % of the least one.
                least_error, k, _, nu = result
                if error(k, nu, False) < 1.05 * least_error:
                    result = min(result, search(k, nu, False))
        _, k, positions, nu = result
        # Values at an end of their range: a better one may lie beyond it.
        ranges: list[tuple[str, float, Sequence[float], Sequence[float]]] = [
            ("K", k, [max(sizes)] if k > 1 else [], sizes),
            ("ν", nu, [min(gmm.shrinkage), max(gmm.shrinkage)], gmm.shrinkage),
        ]
        last = [f"{n} = {v:g}" for n, v, ends, values in ranges if v in ends and len(values) > 1]
        print(
            f"{cls.look.label}: K = {k} clusters, ν = {nu:g}"
            + (", without positions" if cls.needs.position > positions else "")
            + (f"; {', '.join(last)}: last that were tried" if last else ""),
            flush=True,
        )
        return result[1:]

    @classmethod
    def _clustered(
        cls, data: TrainingSet, stars: np.ndarray, clusters: int, gmm: Gmm, positions: bool
    ) -> Self:
        """Return the mixture of some stars, whose clusters follow the position if it is used.

        Parameters
        ----------
        data : TrainingSet
        stars : ndarray of int
            Indices of the stars.
        clusters : int
            Number of clusters K.
        gmm : Gmm
        positions : bool
        """
        same = np.array_equal(data.images[stars], data.references[stars])
        p = cls._positions_of(data, stars).astype(np.float64) * positions
        x = data.images[stars].reshape(stars.size, -1).astype(np.float64)
        cluster = _k_means(x, gmm.place * _standard(p), clusters, gmm.principal, data.seed)
        del x  # memory: it is needed again in another order
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

        (mean_p, p), (mean_x, x) = about_means(p[order]), about_means(data.images[stars[order]])
        mean_y, y = (mean_x, x) if same else about_means(data.references[stars[order]])
        # The change with whitened position that is common to all clusters, and the residuals that
        # it leaves (eq. 9). At most 4096 stars at once: all would take as much memory again.
        whitening = _whitening(p)
        p = p @ whitening
        slope, slope_y = (p.T @ a / len(a) for a in (x, y))
        parts = [slice(a, a + 4096) for a in range(0, len(x), 4096)]
        for rows in parts:
            x[rows] -= p[rows] @ slope
            # With y = x, both are one array.
            y[rows] -= 0.0 if same else p[rows] @ slope_y
        # S, less the noise of the images themselves (eq. 3), and its eigenvectors.
        scatter = x.T @ x
        if data.own_noise is not None and same and not p.size:
            for a, b, mean in zip(start, start + count, mean_x, strict=True):
                noise = data.own_noise(stars[order[a:b]], mean)
                scatter -= noise
                x[a:b] = _without_noise(x[a:b], noise)
        variance, axes = np.linalg.eigh(scatter / len(x))
        variance, axes = np.maximum(variance[::-1], 0.0), axes[:, ::-1]
        for rows in parts:
            x[rows] = x[rows] @ axes
        # Without references of their own, their arrays are empty.
        none = np.empty((0, x.shape[1]), np.float32)
        return cls(
            axes=axes.astype(np.float32),
            variance=variance,
            count=count,
            rows=count,
            mean=(mean_x @ axes).astype(np.float32),
            mean_reference=none if same else mean_y.astype(np.float32),
            deviation=x.astype(np.float32),
            deviation_reference=none if same else y.astype(np.float32),
            cross=none if same else (y.T @ x / len(x)).astype(np.float32),
            variance_reference=none[:, 0] if same else np.square(y).mean(axis=0),
            whitening=whitening,
            center=mean_p @ whitening,
            deviation_center=p,
            slope=(slope @ axes).astype(np.float32),
            slope_reference=slope_y.astype(np.float32),
            shrinkage=np.array([gmm.shrinkage[0]]),
            noise=data.noise,
        )

    @classmethod
    def _positions_of(cls, data: TrainingSet, stars: np.ndarray) -> np.ndarray:
        """Return the positions of some stars, (n, q); q = 0 if the method does not use them."""
        return data.positions[stars] if cls.needs.position else np.empty((len(stars), 0))

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """Return a fit from its arrays; the noise is that of the configuration."""
        noise = NoiseModel(config["noise"]["kappa"], config["noise"]["background_photons"])
        named: dict[str, Any] = {**arrays, "deviation": arrays["deviation"].astype(np.float32)}
        return cls(**named, noise=noise)

    def pack(self, stamp_px: int, noise: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the arrays for a bundle, and fields of its `BundleInfo`.

        Where the references are the images, the residuals of a cluster are its main axes: those
        with a variance of at least `FLAT_VARIANCE` times that of the noise.
        """
        arrays, info_fields = super().pack(stamp_px, noise)
        if len(self.cross) or self.whitening.size:
            return arrays, info_fields
        main_axes, width = [], self.free_flux()._distinct_count(noise**2)
        for cluster in self._clusters:
            _, size, axis = np.linalg.svd(cluster.residuals[:, :width], full_matrices=False)
            main_axes.append(
                (size[:, None] * axis)[cluster.residual_factor * size**2 > FLAT_VARIANCE * noise**2]
            )
        arrays["rows"] = np.array([len(rows) for rows in main_axes])
        arrays["deviation"] = np.vstack(main_axes).astype(np.float16)
        arrays["deviation_center"] = np.empty((len(arrays["deviation"]), 0))
        return arrays, info_fields

    @classmethod
    def shapes(cls, info: BundleInfo) -> Mapping[str, tuple[int, ...] | None]:
        """Return the arrays of a bundle with their shapes, None where any shape will do."""
        pixels = info.stamp_px**2
        return dict.fromkeys(cls.stored()) | {"axes": (pixels, pixels), "variance": (pixels,)}

    def conditions(self) -> Iterator[tuple[str, str, ArrayLike]]:
        """Yield the conditions that any fit fulfils: images of sum 1, no large negative pixels.

        Each is the name of an array, what it must have, and whether it has it.
        """
        total, power = self.axes.sum(axis=0), np.square(self.deviation, dtype=np.float64).sum()
        # Aᵀ A v = v for four random vectors v; the product Aᵀ A would take seconds.
        vectors = stream(0, "gmm", "axes").standard_normal((len(self.axes), 4))
        product = self.axes.T @ (self.axes @ vectors)
        yield "axes", "orthonormal columns", np.abs(product - vectors) < 1e-2
        yield "variance", "numbers from 0 to 1", (self.variance >= 0) & (self.variance <= 1)
        yield "count", "a star or more in each cluster", self.count >= 1
        adds_up = self.rows.shape == self.count.shape and self.rows.sum() == len(self.deviation)
        yield "rows", "the rows of the deviations", adds_up and (self.rows >= 0)
        yield "mean", "images of the sum 1", np.abs(self.mean @ total - 1) < 1e-2
        yield "deviation", "images of the sum 1", power <= 4.0 * self.count.sum()
        yield "shrinkage", "a number above 0", self.shrinkage.shape == (1,) and self.shrinkage > 0

    def outlier_score(
        self, noisy: np.ndarray, level: np.ndarray, near_clusters: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the score by the leading `OUTLIER_COORDINATES` (eq. 12 of docs/mixture.md).

        The others hold noise, which is an estimate: their χ² would say that it is wrong.
        """
        law = self._outlier_law
        s = self.noise.variance(np.full(len(noisy), 1.0 / self.axes.shape[0]), np.asarray(level))
        # ln of the density is less where noise is larger: relative to that of the common variances.
        common = np.log(2 * np.pi * (law._total_variance + s[:, None])).sum(axis=1)
        evidence = np.empty(len(noisy))
        for part, batch in law._batches(noisy, level):
            near = None if near_clusters is None else near_clusters[part]
            _, evidence[part] = law._weights(batch, near)
        return np.asarray(-2.0 * evidence - common)

    def free_flux(self) -> Self:
        """Return the mixture for images whose flux and sky are estimates (eq. 10)."""
        return replace(self, flux_sigma=FLUX_SIGMA)

    def flux(self, noisy: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the flux factor a of each image, and which clusters are near, (n, K) (eq. 11).

        The factor is the flux over that by which the image was divided; 1 if fluxes are known.
        """
        flux = np.ones(len(noisy))
        is_near = np.zeros((len(noisy), len(self.count)), bool)
        for part, batch in self._batches(noisy, level):
            weight, _ = self._weights(batch, None)
            is_near[part] = weight > 0
            if self.flux_sigma:
                flux[part] = self._flux(batch, weight)
        return flux, is_near

    def predict(
        self, noisy: np.ndarray, level: float | np.ndarray, position: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the PSFs of `estimate`, which has parameters and errors, but no σ."""
        return self._estimate(noisy, level, position, with_sigma=False).psf

    def estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None = None,
        near_clusters: np.ndarray | None = None,
    ) -> Estimate:
        """Return PSFs, float32, their standard deviation, and the evidence of every image.

        Only `near_clusters` of an image are looked at, shape (n, K) of bool, by default those that
        are nearest by the common covariance.

        Raises
        ------
        ValueError
            If a pixel is not finite.
        """
        return self._estimate(noisy, level, position, with_sigma=True, near_clusters=near_clusters)


def _without_noise(x: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return rows (n, P) whose products are xᵀx less a covariance (P, P), but not negative."""
    variance, axes = np.linalg.eigh(x.T @ x - noise)
    rank = min(x.shape)
    rows = np.zeros_like(x)
    rows[:rank] = (np.sqrt(np.maximum(variance, 0.0)) * axes)[:, ::-1].T[:rank]
    return rows


def _standard(p: np.ndarray) -> np.ndarray:
    """Return columns of zero mean and unit variance; one that does not vary is 0."""
    spread = p.std(axis=0)
    return np.asarray((p - p.mean(axis=0)) / np.where(spread > 0, spread, 1.0))


def _whitening(p: np.ndarray) -> np.ndarray:
    """Return the matrix W (q, q) that gives positions p (n, q) of zero mean unit covariance.

    A direction in which the field does not vary becomes 0.
    """
    variance, axes = np.linalg.eigh(p.T @ p / len(p))
    real = variance > 1e-12 * max(variance.max(initial=0.0), 1e-300)
    return np.asarray(axes * np.where(real, 1.0 / np.sqrt(np.where(real, variance, 1.0)), 0.0))


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
        if summit != start:
            break
    return summit


def _k_means(
    x: np.ndarray, place: np.ndarray, clusters: int, principal: int, seed: int
) -> np.ndarray:
    """Return the cluster of each star, (n,), by k-means in the leading principal components.

    Parameters
    ----------
    x : ndarray, shape (n, P)
    place : ndarray, shape (n, q)
        Positions, which join the components, in units of their RMS.
    clusters, principal : int
        Number of clusters and of principal components.
    seed : int
    """
    from sklearn.cluster import KMeans
    from sklearn.decomposition import PCA

    if clusters == 1:
        return np.zeros(len(x), int)
    components = PCA(min(principal, *x.shape), svd_solver="covariance_eigh").fit_transform(x)
    scale = np.sqrt(np.square(components).sum() / len(x) / max(place.shape[1], 1))
    draw = int(stream(seed, "gmm", "clusters").integers(2**31))
    features = np.hstack([components, scale * place]).astype(np.float32)
    # With more clusters, k-means++ takes ten times as long as a random start, and is no better.
    init = "k-means++" if clusters <= 512 else "random"
    means = KMeans(clusters, init=init, n_init=1, random_state=draw)
    return np.asarray(means.fit(features).labels_)
