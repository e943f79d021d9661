"""Posterior mean under a mixture of Gaussians that is fitted to noise-free stars.

Noise-free images x and their references y come from clusters k of weight π_k, in each of
which they are jointly normal. The posterior mean of a noisy image z is then a weighted
sum of linear estimators (Zoran & Weiss 2011, ICCV, 479; Yu, Sapiro & Mallat 2012, IEEE
TIP 21, 2481),

    ŷ = Σ w_k [μ_y,k + C_yx,k (C_k + s)⁻¹ (z − μ_k)],   w_k ∝ π_k N(z; μ_k, C_k + s),

with the noise variance s of a pixel: (κλ)², and the star's own photons spread evenly,
which costs less than 1 % of the error. Linear MMSE is the case of one cluster.

All covariances of a cluster of n_k stars are shrunk towards those within all clusters:
C_k = (X_kᵀX_k + ν S) / (n_k + ν), X_k the deviations of its stars from their mean. In the
eigenvectors of S this is a diagonal and a matrix of rank n_k; by Woodbury's identity its
inverse takes matrices of n_k × n_k alone, and no C_k is ever made.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from psfdae.configuration.base import Count, Group, Positive
from psfdae.estimators import Estimate, FitError, Method, TrainingSet
from psfdae.rng import stream
from psfdae.stars.noise import NoiseModel

STEP = 0.1
"""Of ln s between noise variances that share a factorisation; where they differ, it is
that of a prior which is wrong by half of it, and the error grows by the square."""

NEAREST = 64
"""Clusters that are summed over; the others of 512 hold less than 1 % of the weight."""

LEADING = 64
"""Coordinates in which they are found."""

EXACT = 8
"""Noise variances that are so few have factors of their own."""

AT_ONCE = 1024
"""Images that are restored together."""


class Gmm(Group):
    """Mixture of Gaussians; of several values the validation stars choose."""

    components: Annotated[list[Count], Field(min_length=1)] = Field(
        description="Clusters K that are tried; more than stars are not"
    )
    shrinkage: Annotated[list[Positive], Field(min_length=1)] = Field(
        description="Stars ν that the covariance of all clusters counts for in each"
    )
    principal: Count = Field(description="Principal components in which stars are clustered")
    threads: Count = Field(description="Threads of the linear algebra")


@dataclass(frozen=True, eq=False)
class GaussianMixture(Method):
    """A fitted mixture.

    Attributes
    ----------
    axes : ndarray, shape (P, P)
        Eigenvectors of S, columns; P = d² pixels.
    variance : ndarray, shape (P,)
        Eigenvalues of S.
    count : ndarray of int, shape (K,)
        Stars of each cluster.
    mean, mean_reference : ndarray, shape (K, P)
        μ_x in the axes, and μ_y in pixels.
    deviation : ndarray, shape (n, P)
        Stars less their cluster's mean, in the axes, cluster by cluster.
    deviation_reference : ndarray, shape (n, P), or (0, P)
        The same of the references in pixels; none where they are the images.
    cross : ndarray, shape (P, P), or (0, P)
        Covariance within clusters of references (pixels) and images (axes).
    shrinkage : ndarray, shape (1,)
        ν.
    noise : NoiseModel
    """

    label, color, marker = "Gaussian mixture (told λ)", "#cc79a7", "P"
    told_level = True
    per_reference = True
    groups: ClassVar = {"gmm": Gmm}
    arrays: ClassVar = {
        "axes": ("1", "eigenvectors of the covariance within clusters, columns"),
        "variance": ("1", "its eigenvalues"),
        "count": ("1", "stars of each cluster"),
        "mean": ("1", "mean image of each cluster, in the axes"),
        "mean_reference": ("1", "mean reference of each cluster"),
        "deviation": ("1", "images less the mean of their cluster, in the axes"),
        "deviation_reference": ("1", "references less the mean of their cluster"),
        "cross": ("1", "covariance of references and images (in the axes) within clusters"),
        "shrinkage": ("1", "stars that the common covariance counts for"),
    }

    axes: np.ndarray
    variance: np.ndarray
    count: np.ndarray
    mean: np.ndarray
    mean_reference: np.ndarray
    deviation: np.ndarray
    deviation_reference: np.ndarray
    cross: np.ndarray
    shrinkage: np.ndarray
    noise: NoiseModel
    _roots: dict[tuple[int, float], tuple[np.ndarray, float]] = field(
        default_factory=dict, init=False, repr=False
    )

    @classmethod
    def fit(cls, data: TrainingSet, gmm: Gmm) -> GaussianMixture:
        """Choose K and ν on the validation stars, then fit all training stars.

        Raises
        ------
        FitError
            If every K exceeds the number of stars.
        """
        searched = len(gmm.components) * len(gmm.shrinkage) > 1
        learn, judge = (data.fit, data.validation) if searched else (data.train, data.train[:0])
        if searched and not judge.size:  # nothing is left out for a choice: some others serve
            judge, learn = learn[::10], np.delete(learn, np.s_[::10])
        sizes = [k for k in gmm.components if k <= learn.size]
        if not sizes:
            raise FitError(
                f"gmm.components = {gmm.components}: must be at most {learn.size}, the number of "
                "training stars" + " without those that choose" * searched
            )
        best = (np.inf, sizes[0], gmm.shrinkage[0])
        if searched:
            rng = stream(data.seed, "noise", "gmm validation")
            noisy = [data.noise.draw(data.images[judge], level, rng) for level in data.levels]
            for k in sizes:
                tried = cls._clustered(data, learn, k, gmm)
                for shrinkage in gmm.shrinkage:
                    one = replace(tried, shrinkage=np.array([shrinkage]))
                    errors = [
                        np.square(one.predict(z, level) - data.references[judge]).mean()
                        for z, level in zip(noisy, data.levels, strict=True)
                    ]
                    best = min(best, (float(np.log(errors).mean()), k, shrinkage))
        final = cls._clustered(data, data.train, best[1], gmm)
        return replace(final, shrinkage=np.array([best[2]]))

    @classmethod
    def _clustered(
        cls, data: TrainingSet, stars: np.ndarray, clusters: int, gmm: Gmm
    ) -> GaussianMixture:
        """Moments of the clusters of some stars."""
        x, y = (
            a[stars].reshape(stars.size, -1).astype(np.float64)
            for a in (data.images, data.references)
        )
        cluster = _k_means(x, clusters, gmm.principal, data.seed)
        order = np.argsort(cluster, kind="stable")
        x, y = x[order], y[order]
        same = np.array_equal(x, y)
        count = np.unique(cluster, return_counts=True)[1]
        start = np.concatenate([[0], count.cumsum()[:-1]])
        mean_x, mean_y = (np.add.reduceat(a, start) / count[:, None] for a in (x, y))
        x -= np.repeat(mean_x, count, axis=0)
        y -= np.repeat(mean_y, count, axis=0)
        variance, axes = np.linalg.eigh(x.T @ x / len(x))
        variance, axes = np.maximum(variance[::-1], 0.0), axes[:, ::-1]
        x = x @ axes
        none = np.empty((0, x.shape[1]), np.float32)
        return cls(
            axes=axes.astype(np.float32),
            variance=variance,
            count=count,
            mean=(mean_x @ axes).astype(np.float32),
            mean_reference=mean_y.astype(np.float32),
            deviation=x.astype(np.float32),
            deviation_reference=none if same else y.astype(np.float32),
            cross=none if same else (y.T @ x / len(x)).astype(np.float32),
            shrinkage=np.array([gmm.shrinkage[0]]),
            noise=data.noise,
        )

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> GaussianMixture:
        """As of all methods; the noise is that of the configuration."""
        noise = config["noise"]
        return cls(**arrays, noise=NoiseModel(noise["kappa"], noise["background_photons"]))

    def predict(self, noisy: np.ndarray, level: float | np.ndarray) -> np.ndarray:
        """PSFs, float32; raises as `estimate`."""
        return self.estimate(noisy, level).psf

    def estimate(self, noisy: np.ndarray, level: float | np.ndarray) -> Estimate:
        """PSFs, float32, and the evidence of every image.

        Raises
        ------
        ValueError
            If a pixel is not finite.
        """
        flat = noisy.reshape(len(noisy), -1)
        if not np.isfinite(flat).all():
            raise ValueError("noisy images must be finite")
        even = np.full(len(flat), 1.0 / flat.shape[1])
        s = self.noise.variance(even, np.asarray(level, np.float64))
        psf, evidence = np.empty(flat.shape, np.float32), np.empty(len(flat))
        for start in range(0, len(flat), AT_ONCE):
            part = slice(start, start + AT_ONCE)
            psf[part], evidence[part] = self._posterior(flat[part], s[part])
        return Estimate(psf.reshape(noisy.shape), evidence=evidence)

    def _posterior(self, flat: np.ndarray, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Posterior mean and evidence of images (n, P) of noise variance s, shape (n,).

        Sums over clusters are kept relative to the largest weight so far of every star.
        """
        z = (flat @ self.axes).astype(np.float32)
        nodes, node = np.unique(s, return_inverse=True)
        if nodes.size > EXACT:
            nodes, node = np.unique(np.rint(np.log(s) / STEP), return_inverse=True)
            nodes = np.exp(nodes * STEP)
        peak, total = np.full(len(z), -np.inf), np.zeros(len(z))
        gain, psf = np.zeros_like(z), np.zeros_like(z)
        likely = self._likely(z, s)
        for k, (own, within, common, _) in enumerate(map(self._cluster, range(len(self.count)))):
            (stars,) = likely[:, k].nonzero()
            if not stars.size:
                continue
            d = (common * self.variance + s[stars, None]).astype(np.float32)
            r = z[stars] - self.mean[k]
            u = r / d
            inner = u @ own.T
            log = -0.5 * np.einsum("ij,ij->i", r, u, dtype=np.float64)
            for place in np.unique(node[stars]):
                there = node[stars] == place
                root, constant = self._root(k, float(nodes[place]))
                half = inner[there] @ root.T
                inner[there] = half @ root
                log[there] += constant + 0.5 * np.einsum("ij,ij->i", half, half, dtype=np.float64)
            new = np.maximum(peak[stars], log)
            fade, w = np.exp(peak[stars] - new), np.exp(log - new)
            peak[stars], total[stars] = new, fade * total[stars] + w
            fade, w = (a[:, None].astype(np.float32) for a in (fade, w))
            g = u - (inner @ own) / d
            if len(self.cross):
                psf[stars] = fade * psf[stars] + w * (self.mean_reference[k] + inner @ within)
                g *= common
            gain[stars] = fade * gain[stars] + w * g
        gain /= total[:, None]
        evidence = peak + np.log(total) - 0.5 * z.shape[1] * np.log(2 * np.pi)
        if len(self.cross):
            return psf / total[:, None] + gain @ self.cross.T, evidence
        return flat - s[:, None] * (gain @ self.axes.T), evidence

    def _likely(self, z: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Clusters that are nearest by the common covariance, (n, K) of bool."""
        if len(self.count) <= NEAREST:
            return np.ones((len(z), len(self.count)), bool)
        weight = 1.0 / (self.variance[:LEADING] + s[:, None])
        z, mean = (a[:, :LEADING].astype(np.float64) for a in (z, self.mean))
        distance = weight @ (mean**2).T - 2.0 * (z * weight) @ mean.T
        near = np.argpartition(distance, NEAREST, axis=1)[:, :NEAREST]
        likely = np.zeros(distance.shape, bool)
        np.put_along_axis(likely, near, True, axis=1)
        return likely

    def _cluster(self, k: int) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Deviations X_k and Y_k, and the factors of S and of X_kᵀX_k in C_k."""
        stars = slice(int(self.count[:k].sum()), int(self.count[: k + 1].sum()))
        total = float(self.count[k] + self.shrinkage[0])
        common = float(self.shrinkage[0]) / total
        return self.deviation[stars], self.deviation_reference[stars], common, 1.0 / total

    def _root(self, k: int, s: float) -> tuple[np.ndarray, float]:
        """L⁻¹ with L Lᵀ = M, and ln π − ½ ln det(C + s), at a noise variance.

        C + s = D + b XᵀX with the diagonal D, and M = 1/b + X D⁻¹Xᵀ.
        """
        if (k, s) not in self._roots:
            from scipy.linalg import solve_triangular

            own, _, common, b = self._cluster(k)
            x, d = own.astype(np.float64), common * self.variance + s
            lower = np.linalg.cholesky(np.eye(len(x)) / b + (x / d) @ x.T)
            root = solve_triangular(lower, np.eye(len(x)), lower=True).astype(np.float32)
            half_det = np.log(lower.diagonal()).sum() + 0.5 * len(x) * np.log(b)
            constant = np.log(self.count[k] / self.count.sum()) - half_det - 0.5 * np.log(d).sum()
            self._roots[k, s] = root, float(constant)
        return self._roots[k, s]


def _k_means(x: np.ndarray, clusters: int, principal: int, seed: int) -> np.ndarray:
    """Cluster of each star (n, P), by k-means in the leading principal components."""
    from sklearn.cluster import KMeans
    from sklearn.decomposition import PCA

    if clusters == 1:
        return np.zeros(len(x), int)
    found = PCA(min(principal, *x.shape), svd_solver="full").fit_transform(x)
    draw = int(stream(seed, "gmm", "clusters").integers(2**31))
    means = KMeans(clusters, n_init=1, random_state=draw).fit(found.astype(np.float32))
    return np.asarray(means.labels_)
