"""Gaussian mixture fitted to noise-free stars; its posterior mean restores the PSF.

The law is in `psfdae.mixture_law`. Where the images have noise of their own, as bright stars do,
its covariance is taken off S and every XᵀX, and what would be negative is 0.
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
from psfdae.mixing import FLUX_SIGMA
from psfdae.mixture_law import FLAT_VARIANCE, MixtureLaw
from psfdae.noise import NoiseModel
from psfdae.progress import task
from psfdae.rng import stream
from psfdae.settings import Count, Group, Positive

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from psfdae.bundle_info import BundleInfo

STARS_AT_ONCE = 4096
"""Stars that are turned into other axes together; all would take as much memory again."""

LEAST_GAIN = 0.02
"""Part of the error by which more clusters must lower it to be taken."""

MOST_CAREFUL = 512
"""Clusters that k-means++ begins. Of more, it takes ten times as long as a random beginning,
and errs as much."""

Number = TypeVar("Number", bound=float)

NEARLY_LEAST = 1.05
"""Times the least error, below which a search without positions may find a smaller one."""


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
    """A fitted mixture."""

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
        if searched and not judge.size:  # nothing is left out for a choice: some others serve
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
            clusters, positions, shrinkage = cls._chosen(data, learn, judge, sizes, gmm)
        final = cls._clustered(data, data.train[: gmm.stars], clusters, gmm, positions)
        return replace(final, shrinkage=np.array([shrinkage]))

    @classmethod
    def _chosen(
        cls, data: TrainingSet, learn: np.ndarray, judge: np.ndarray, sizes: list[int], gmm: Gmm
    ) -> tuple[int, bool, float]:
        """K, whether the position is used, and ν, by the error on the stars that judge."""
        rng = stream(data.seed, "noise", "gmm validation")
        noisy = [data.noise.draw(data.images[judge], level, rng) for level in data.levels]
        truth, where = data.references[judge], cls._positions_of(data, judge)

        @cache
        def clustered(k: int, positions: bool) -> GaussianMixture:
            return cls._clustered(data, learn, k, gmm, positions)

        @cache
        def error(k: int, nu: float, positions: bool) -> float:
            """Geometric mean over the noise levels."""
            tried = replace(clustered(k, positions), shrinkage=np.array([nu]))
            advance(1)
            pairs = zip(noisy, data.levels, strict=True)
            errors = [np.square(tried.predict(z, s, where) - truth).mean() for z, s in pairs]
            return float(np.exp(np.mean(np.log(errors))))

        def search(k: int, nu: float, positions: bool) -> tuple[float, int, bool, float]:
            """Climb to the best ν, to the best K there, and on to the best ν of fewer clusters.

            More of them take longer, and want the same ν.
            """
            first = k
            nu = climbed(gmm.shrinkage, nu, lambda tried: error(k, tried, positions))
            k = climbed(sizes, k, lambda tried: error(tried, nu, positions), LEAST_GAIN)
            if k < first:
                nu = climbed(gmm.shrinkage, nu, lambda tried: error(k, tried, positions))
            return error(k, nu, positions), k, positions, nu

        with task("mixture", len(sizes) + len(gmm.shrinkage)) as advance:
            best = search(sizes[0], gmm.shrinkage[0], cls.needs.position)
            if cls.needs.position:
                # Positions may be left aside, where stars in other places are worse for it.
                least, k, _, nu = best
                if error(k, nu, False) < NEARLY_LEAST * least:
                    best = min(best, search(k, nu, False))
        _, k, positions, nu = best
        tried: list[tuple[str, float, Sequence[float], Sequence[float]]] = [
            ("K", k, [max(sizes)] if k > 1 else [], sizes),
            ("ν", nu, [min(gmm.shrinkage), max(gmm.shrinkage)], gmm.shrinkage),
        ]
        last = [f"{n} = {v:g}" for n, v, ends, all_ in tried if v in ends and len(all_) > 1]
        print(
            f"{cls.look.label}: K = {k} clusters, ν = {nu:g}"
            + (", without positions" if cls.needs.position > positions else "")
            + (f"; {', '.join(last)}: last that were tried" if last else ""),
            flush=True,
        )
        return best[1:]

    @classmethod
    def _clustered(
        cls, data: TrainingSet, stars: np.ndarray, clusters: int, gmm: Gmm, positions: bool
    ) -> Self:
        """Moments of the clusters of some stars, and how they follow the position if used."""
        same = np.array_equal(data.images[stars], data.references[stars])
        p = cls._positions_of(data, stars).astype(np.float64) * positions
        x = data.images[stars].reshape(stars.size, -1).astype(np.float64)
        cluster = _k_means(x, gmm.place * _standard(p), clusters, gmm.principal, data.seed)
        del x  # before it is there in another order
        order = np.argsort(cluster, kind="stable")
        count = np.unique(cluster, return_counts=True)[1]
        start = np.concatenate([[0], count.cumsum()[:-1]])

        def about_means(a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            a = a.reshape(len(a), math.prod(a.shape[1:])).astype(np.float64)
            mean = np.add.reduceat(a, start) / count[:, None]
            for rows, own in zip(np.split(a, start[1:]), mean, strict=True):
                np.subtract(rows, own, out=rows)
            return mean, a

        (mean_p, p), (mean_x, x) = about_means(p[order]), about_means(data.images[stars[order]])
        mean_y, y = (mean_x, x) if same else about_means(data.references[stars[order]])
        whitening = _whitening(p)
        p = p @ whitening
        slope, slope_y = (p.T @ a / len(a) for a in (x, y))
        parts = [slice(a, a + STARS_AT_ONCE) for a in range(0, len(x), STARS_AT_ONCE)]
        for rows in parts:
            x[rows] -= p[rows] @ slope
            y[rows] -= 0.0 if same else p[rows] @ slope_y  # of the same, it is gone
        scatter = x.T @ x
        if data.own_noise is not None and same and not p.size:
            for a, b, mean in zip(start, start + count, mean_x, strict=True):
                noise = data.own_noise(stars[order[a:b]], mean)
                scatter -= noise
                x[a:b] = _less(x[a:b], noise)
        variance, axes = np.linalg.eigh(scatter / len(x))
        variance, axes = np.maximum(variance[::-1], 0.0), axes[:, ::-1]
        for rows in parts:
            x[rows] = x[rows] @ axes
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
        """Positions of some stars, (n, q)."""
        return data.positions[stars] if cls.needs.position else np.empty((len(stars), 0))

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """A fit from its arrays; the noise is that of the configuration."""
        noise = NoiseModel(config["noise"]["kappa"], config["noise"]["background_photons"])
        named: dict[str, Any] = {**arrays, "deviation": arrays["deviation"].astype(np.float32)}
        return cls(**named, noise=noise)

    def pack(self, stamp_px: int, noise: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Arrays for a bundle; where the references are the images, clusters by their main axes.

        Axes with a variance below `FLAT_VARIANCE` of that of the noise are left out.
        """
        arrays, said = super().pack(stamp_px, noise)
        if len(self.cross) or self.whitening.size:
            return arrays, said
        kept, width = [], self.free_flux()._distinct_count(noise**2)
        for cluster in self._clusters:
            _, size, axis = np.linalg.svd(cluster.residuals[:, :width], full_matrices=False)
            kept.append(
                (size[:, None] * axis)[cluster.residual_factor * size**2 > FLAT_VARIANCE * noise**2]
            )
        arrays["rows"] = np.array([len(rows) for rows in kept])
        arrays["deviation"] = np.vstack(kept).astype(np.float16)
        arrays["deviation_center"] = np.empty((len(arrays["deviation"]), 0))
        return arrays, said

    @classmethod
    def shapes(cls, info: BundleInfo) -> Mapping[str, tuple[int, ...] | None]:
        """Arrays that a bundle keeps; the others follow from these."""
        pixels = info.stamp_px**2
        return dict.fromkeys(cls.stored()) | {"axes": (pixels, pixels), "variance": (pixels,)}

    def conditions(self) -> Iterator[tuple[str, str, ArrayLike]]:
        """Conditions that any fit fulfils: images of the sum 1, without large negative pixels."""
        total, power = self.axes.sum(axis=0), np.square(self.deviation, dtype=np.float64).sum()
        some = stream(0, "gmm", "axes").standard_normal((len(self.axes), 4))
        same = self.axes.T @ (self.axes @ some)  # the product of all takes seconds
        yield "axes", "orthonormal columns", np.abs(same - some) < 1e-2
        yield "variance", "numbers from 0 to 1", (self.variance >= 0) & (self.variance <= 1)
        yield "count", "a star or more in each cluster", self.count >= 1
        whole = self.rows.shape == self.count.shape and self.rows.sum() == len(self.deviation)
        yield "rows", "the rows of the deviations", whole and (self.rows >= 0)
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
        usual = np.log(2 * np.pi * (law._total_variance + s[:, None])).sum(axis=1)
        evidence = np.empty(len(noisy))
        for part, batch in law._batches(noisy, level):
            near = None if near_clusters is None else near_clusters[part]
            _, evidence[part] = law._weights(batch, near)
        return np.asarray(-2.0 * evidence - usual)

    def free_flux(self) -> Self:
        """The law of images whose flux and sky are estimates."""
        return replace(self, flux_sigma=FLUX_SIGMA)

    def flux(self, noisy: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Flux of the star in that by which its image was divided, and clusters that are near.

        The flux is 1 where fluxes are known.
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
        """PSFs, float32; raises as `estimate`."""
        return self._estimate(noisy, level, position, with_sigma=False).psf

    def estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None = None,
        near_clusters: np.ndarray | None = None,
    ) -> Estimate:
        """PSFs, float32, their standard deviation, and the evidence of every image.

        Only `near_clusters` of an image are looked at, shape (n, K) of bool, by default those that
        are nearest by the common covariance.

        Raises
        ------
        ValueError
            If a pixel is not finite.
        """
        return self._estimate(noisy, level, position, with_sigma=True, near_clusters=near_clusters)


def _less(x: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Rows (n, P) whose products xᵀx are less by a covariance (P, P), but in no direction < 0."""
    variance, axes = np.linalg.eigh(x.T @ x - noise)
    most = min(x.shape)
    rows = np.zeros_like(x)
    rows[:most] = (np.sqrt(np.maximum(variance, 0.0)) * axes)[:, ::-1].T[:most]
    return rows


def _standard(p: np.ndarray) -> np.ndarray:
    """Columns of zero mean and unit variance; one that does not vary is 0."""
    spread = p.std(axis=0)
    return np.asarray((p - p.mean(axis=0)) / np.where(spread > 0, spread, 1.0))


def _whitening(p: np.ndarray) -> np.ndarray:
    """Matrix W (q, q) that gives positions p (n, q) of zero mean unit covariance.

    A direction in which the field does not vary becomes 0.
    """
    variance, axes = np.linalg.eigh(p.T @ p / len(p))
    real = variance > 1e-12 * max(variance.max(initial=0.0), 1e-300)
    return np.asarray(axes * np.where(real, 1.0 / np.sqrt(np.where(real, variance, 1.0)), 0.0))


def climbed(
    values: Sequence[Number], start: Number, error: Callable[[Number], float], pays: float = 0.0
) -> Number:
    """Where steps from one of some values, up or else down, no longer lower the error.

    A step up must lower it by more than the part `pays`.
    """
    ascending = sorted(values)
    place = ascending.index(start)
    for way, least in ((ascending[place:], pays), (ascending[place::-1], 0.0)):
        best = start
        for value in way[1:]:
            if error(value) >= (1.0 - least) * error(best):
                break
            best = value
        if best != start:
            break
    return best


def _k_means(
    x: np.ndarray, place: np.ndarray, clusters: int, principal: int, seed: int
) -> np.ndarray:
    """Cluster of each star (n, P), by k-means in the leading principal components.

    `place`, shape (n, q), joins them, in units of their RMS.
    """
    from sklearn.cluster import KMeans
    from sklearn.decomposition import PCA

    if clusters == 1:
        return np.zeros(len(x), int)
    found = PCA(min(principal, *x.shape), svd_solver="covariance_eigh").fit_transform(x)
    scale = np.sqrt(np.square(found).sum() / len(x) / max(place.shape[1], 1))
    draw = int(stream(seed, "gmm", "clusters").integers(2**31))
    features = np.hstack([found, scale * place]).astype(np.float32)
    init = "k-means++" if clusters <= MOST_CAREFUL else "random"
    means = KMeans(clusters, init=init, n_init=1, random_state=draw)
    return np.asarray(means.fit(features).labels_)
