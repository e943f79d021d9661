"""Posterior mean under a mixture of Gaussians that is fitted to noise-free stars.

Noise-free images x and their references y come from clusters k of weight π_k, in each of
which they are jointly normal. The posterior mean of a noisy image z is then a weighted
sum of linear estimators (Zoran & Weiss 2011, ICCV, 479; Yu, Sapiro & Mallat 2012, IEEE
TIP 21, 2481),

    ŷ = Σ w_k [μ_y,k + C_yx,k (C_k + s)⁻¹ (z − μ_k)],   w_k ∝ π_k N(z; μ_k, C_k + s),

with the noise variance s of a pixel: (κλ)², and the star's own photons spread evenly,
which costs less than 1 % of the error. Linear MMSE is the case of one cluster.

Where the images have noise of their own, as bright stars do, its covariance is taken off
S and every XᵀX, and what would be negative is 0.

All covariances of a cluster of n_k stars are shrunk towards those within all clusters:
C_k = (X_kᵀX_k + ν S) / (n_k + ν), X_k the deviations of its stars from their mean. In the
eigenvectors of S this is a diagonal and a matrix of rank n_k; by Woodbury's identity its
inverse takes matrices of n_k × n_k alone, and no C_k is ever made.

A method that is given where the star stands has two more numbers p in the observed vector,
without noise. Given p, everything above holds again: π_k becomes π_k N(p; p_k, P_k), μ_k
follows p linearly, and X_k are the deviations that p leaves, with two rows more for what
the slope of the cluster differs from that of all.

An image whose flux and sky are estimates is a x + (1 − a)/P with a factor a about 1, for
its sum is 1. Little is known of a; it is one more row of X_k, LOOSE (μ_k − 1/P), and of
Y_k, LOOSE μ_y,k.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from pydantic import Field

from psfdae.method import Estimate, FitError, Method, TrainingSet
from psfdae.noise import NoiseModel
from psfdae.rng import stream
from psfdae.settings import Count, Group, Positive

if TYPE_CHECKING:
    from psfdae.bundle_info import BundleInfo

STEP = 0.4
"""Of ln s between noise variances of single stars, which share a factorisation; s is then
wrong by half of it at most, and the error grows by the square."""

KEPT = 400e6
"""Bytes of factorisations that are kept for further stars."""

NEAREST, LEADING = 32, 64
"""Clusters that are looked at, and coordinates in which they are found; the others of 512
hold less than 1 % of the weight."""

LEAST = 1e-3
"""Weight of a cluster that is summed over."""

LOOSE = 0.2
"""Standard deviation of the flux in that by which an image was divided."""

ROWS = 4096
"""Stars that are turned into other axes at once; all would take as much memory again."""

TELLING, LEADING_ARRAYS = 40, ("axes", "variance", "mean", "deviation", "slope")
"""Coordinates that tell outliers, and arrays whose last axis they are. More of them find
more outliers that are bright, and fewer that are faint."""

FINE = 0.2
"""`STEP` where the density of images counts: an error of s weighs more in it than in their mean."""

FLAT = 0.005
"""Variance of a coordinate, as a part of s, below which all clusters share one normal law."""

PAYS = 0.02
"""Part of the error by which more clusters must lower it."""

CAREFUL = 512
"""Clusters that k-means++ begins. Of more, it takes ten times as long as a random beginning,
and errs as much."""

WORSE = 1.05
"""Times the least error, below which a search without positions may find a smaller one."""

AT_ONCE = 4096
"""Images that are restored together."""


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


class Cluster(NamedTuple):
    """One cluster of a mixture with its covariances (all given the position).

    Attributes
    ----------
    own, own_reference : ndarray, shape (r, P)
        Deviations X_k in the axes and Y_k in pixels, or rows of the same products if these
        are fewer.
    square : ndarray, shape (P,)
        Diagonal of YᵀY.
    slope, slope_reference : ndarray, shape (q, P)
        Change of the means per unit of the position.
    spread : ndarray, shape (q, q)
        Inverse of the Cholesky factor of P_k.
    common, scale : float
        Factors of S and of XᵀX in C_k.
    """

    own: np.ndarray
    own_reference: np.ndarray
    square: np.ndarray
    slope: np.ndarray
    slope_reference: np.ndarray
    spread: np.ndarray
    common: float
    scale: float


class Factor(NamedTuple):
    """(C_k + s)⁻¹ = diag(inverse) − AᵀA, A in the leading m coordinates.

    Attributes
    ----------
    inverse : ndarray, shape (P,)
    low : ndarray, shape (r, m)
        A.
    low_reference : ndarray, shape (r, P)
        What Aᵀ becomes in C_yx (C_k + s)⁻¹, of references that are not the images.
    shared : ndarray, shape (P,)
        Factor of S in C_k, by coordinate.
    constant : float
        ln π_k − ½ ln det(C_k + s) of the determinant in units of 2π.
    """

    inverse: np.ndarray
    low: np.ndarray
    low_reference: np.ndarray
    shared: np.ndarray
    constant: float


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
    rows : ndarray of int, shape (K,)
        Rows of `deviation` of each cluster: its stars, or fewer with the same products.
    mean : ndarray, shape (K, P)
        μ_x in the axes.
    mean_reference : ndarray, shape (K, P), or (0, P)
        μ_y in pixels; none where the references are the images.
    deviation : ndarray, shape (n, P)
        Stars less their cluster's mean, in the axes, cluster by cluster; in a bundle
        the main axes of each, times the root of the sum of squares along them.
    deviation_reference : ndarray, shape (n, P), or (0, P)
        The same of the references in pixels; none where they are the images.
    cross : ndarray, shape (P, P), or (0, P)
        Covariance within clusters of references (pixels) and images (axes).
    variance_reference : ndarray, shape (P,), or (0,)
        Variance of the references within clusters.
    whitening : ndarray, shape (q, q)
        To positions of unit variance within clusters; q = 2 where they are given, else 0.
    center, deviation_center : ndarray, shape (K, q) and (n, q)
        Mean whitened position of each cluster, and each star's deviation from it.
    slope, slope_reference : ndarray, shape (q, P)
        Change with position that is common to all clusters; deviations are without it.
    shrinkage : ndarray, shape (1,)
        ν.
    noise : NoiseModel
    loose : float
        LOOSE, or 0 where fluxes are known.
    step : float
        STEP, or FINE.
    """

    label, color, marker = "GMM", "#cc79a7", "P"
    needs_level = True
    together, padded = 4096, False
    per_reference = True
    groups: ClassVar = {"gmm": Gmm}
    arrays: ClassVar = {
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
    }

    axes: np.ndarray
    variance: np.ndarray
    count: np.ndarray
    rows: np.ndarray
    mean: np.ndarray
    mean_reference: np.ndarray
    deviation: np.ndarray
    deviation_reference: np.ndarray
    cross: np.ndarray
    variance_reference: np.ndarray
    whitening: np.ndarray
    center: np.ndarray
    deviation_center: np.ndarray
    slope: np.ndarray
    slope_reference: np.ndarray
    shrinkage: np.ndarray
    noise: NoiseModel
    loose: float = 0.0
    step: float = STEP
    _nodes: dict[float, dict[int, Factor]] = field(default_factory=dict, init=False, repr=False)

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
        clusters, positions, shrinkage = sizes[0], cls.needs_position, gmm.shrinkage[0]
        if searched:
            clusters, positions, shrinkage = cls._chosen(data, learn, judge, sizes, gmm)
        final = cls._clustered(data, data.train[: gmm.stars], clusters, gmm, positions)
        return replace(final, shrinkage=np.array([shrinkage]))

    def again(self, data: TrainingSet, gmm: Gmm) -> Self:
        """Fit to other stars, with the K, the ν and the use of the position of this one."""
        positions = bool(self.whitening.any())
        one = self._clustered(data, data.train[: gmm.stars], len(self.count), gmm, positions)
        return replace(one, shrinkage=self.shrinkage)

    @classmethod
    def _chosen(
        cls, data: TrainingSet, learn: np.ndarray, judge: np.ndarray, sizes: list[int], gmm: Gmm
    ) -> tuple[int, bool, float]:
        """K, whether the position is used, and ν, by the error on the stars that judge."""
        rng = stream(data.seed, "noise", "gmm validation")
        noisy = [data.noise.draw(data.images[judge], level, rng) for level in data.levels]
        truth, where = data.references[judge], cls._positions_of(data, judge)

        @cache
        def clustered(k: int, positions: bool) -> Self:
            return cls._clustered(data, learn, k, gmm, positions)

        @cache
        def error(k: int, nu: float, positions: bool) -> float:
            """Geometric mean over the noise levels."""
            tried = replace(clustered(k, positions), shrinkage=np.array([nu]))
            pairs = zip(noisy, data.levels, strict=True)
            errors = [np.square(tried.predict(z, s, where) - truth).mean() for z, s in pairs]
            return float(np.exp(np.mean(np.log(errors))))

        def search(k: int, nu: float, positions: bool) -> tuple[float, int, bool, float]:
            """Climb to the best ν, to the best K there, and on to the best ν of fewer clusters.

            More of them take longer, and want the same ν.
            """
            first = k
            nu = climbed(gmm.shrinkage, nu, lambda tried: error(k, tried, positions))
            k = climbed(sizes, k, lambda tried: error(tried, nu, positions), PAYS)
            if k < first:
                nu = climbed(gmm.shrinkage, nu, lambda tried: error(k, tried, positions))
            return error(k, nu, positions), k, positions, nu

        best = search(sizes[0], gmm.shrinkage[0], cls.needs_position)
        if cls.needs_position:
            # Positions may be left aside, where stars in other places are worse for it.
            least, k, _, nu = best
            if error(k, nu, False) < WORSE * least:
                best = min(best, search(k, nu, False))
        _, k, positions, nu = best
        tried = [("K", k, [max(sizes)] if k > 1 else [], sizes)]
        tried += [("ν", nu, [min(gmm.shrinkage), max(gmm.shrinkage)], gmm.shrinkage)]
        last = [f"{n} = {v:g}" for n, v, ends, all_ in tried if v in ends and len(all_) > 1]
        print(
            f"{cls.label}: K = {k} clusters, ν = {nu:g}"
            + (", without positions" if cls.needs_position > positions else "")
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
        parts = [slice(a, a + ROWS) for a in range(0, len(x), ROWS)]
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
        return data.positions[stars] if cls.needs_position else np.empty((len(stars), 0))

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """As `Method.estimate`; the noise is that of the configuration."""
        noise = NoiseModel(config["noise"]["kappa"], config["noise"]["background_photons"])
        rows = arrays["deviation"].astype(np.float32)
        return cls(**{**arrays, "deviation": rows}, noise=noise)

    def pack(self, stamp_px: int, noise: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """As `Method.pack`; where the references are the images, clusters by their main axes.

        Axes with a variance below FLAT of that of the noise are left out.
        """
        arrays, said = super().pack(stamp_px, noise)
        if len(self.cross) or self.whitening.size:
            return arrays, said
        kept, width = [], self.free_flux()._leading(noise**2)
        for cluster in self._clusters:
            _, size, axis = np.linalg.svd(cluster.own[:, :width], full_matrices=False)
            kept.append((size[:, None] * axis)[cluster.scale * size**2 > FLAT * noise**2])
        arrays["rows"] = np.array([len(rows) for rows in kept])
        arrays["deviation"] = np.vstack(kept).astype(np.float16)
        arrays["deviation_center"] = np.empty((len(arrays["deviation"]), 0))
        return arrays, said

    @classmethod
    def shapes(cls, info: BundleInfo) -> Mapping[str, tuple[int, ...] | None]:
        """Arrays that a bundle keeps; the others follow from these."""
        pixels = info.stamp_px**2
        return dict.fromkeys(cls.arrays) | {"axes": (pixels, pixels), "variance": (pixels,)}

    def lawful(self) -> Iterator[tuple[str, str, Any]]:
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

    def strangeness(self, noisy: np.ndarray, level: np.ndarray) -> np.ndarray:
        """As `Method.strangeness`, from the evidence of the leading `TELLING` coordinates.

        The others hold noise, which is an estimate: their χ² would say that it is wrong.
        """
        some = self._telling
        s = self.noise.variance(np.full(len(noisy), 1.0 / self.axes.shape[0]), np.asarray(level))
        usual = np.log(2 * np.pi * (some._total + s[:, None])).sum(axis=1)
        evidence = some._estimate(noisy, level, None, sure=False).evidence
        assert evidence is not None
        return -2.0 * evidence - usual

    @cached_property
    def _telling(self) -> Self:
        """The law of the leading coordinates."""
        none = np.empty((0, 0), np.float32)
        cut = {n: np.ascontiguousarray(getattr(self, n)[..., :TELLING]) for n in LEADING_ARRAYS}
        return replace(
            self, **cut, cross=none, deviation_reference=none, slope_reference=none, step=FINE
        )

    def free_flux(self) -> Self:
        """As that of `Method`."""
        return replace(self, loose=LOOSE)

    def flux(self, noisy: np.ndarray, level: np.ndarray) -> np.ndarray:
        """As that of `Method`."""
        flux = self._estimate(noisy, level, None, sure=False).flux
        return super().flux(noisy, level) if flux is None else flux

    def predict(
        self, noisy: np.ndarray, level: float | np.ndarray, position: np.ndarray | None = None
    ) -> np.ndarray:
        """PSFs, float32; raises as `estimate`."""
        return self._estimate(noisy, level, position, sure=False).psf

    def estimate(
        self, noisy: np.ndarray, level: float | np.ndarray, position: np.ndarray | None = None
    ) -> Estimate:
        """PSFs, float32, their standard deviation, and the evidence of every image.

        Raises
        ------
        ValueError
            If a pixel is not finite.
        """
        return self._estimate(noisy, level, position, sure=True)

    def _estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None,
        sure: bool,
    ) -> Estimate:
        flat = noisy.reshape(len(noisy), math.prod(noisy.shape[1:]))
        if not np.isfinite(flat).all():
            raise ValueError("noisy images must be finite")
        where = position @ self.whitening if self.whitening.size else np.empty((len(flat), 0))
        even = np.full(len(flat), 1.0 / flat.shape[1])
        s = self.noise.variance(even, np.asarray(level))
        if np.ndim(level):  # not by how many there are: stars do not influence each other
            s = np.exp(np.rint(np.log(s) / self.step) * self.step)
        s, node = np.unique(s, return_inverse=True)
        psf, sigma = (np.empty(flat.shape, np.float32) for _ in range(2))
        evidence, flux = np.empty((2, len(flat)))
        for place, variance in enumerate(s):
            (stars,) = (node == place).nonzero()
            for part in np.array_split(stars, -(-stars.size // AT_ONCE)):
                found = self._posterior(flat[part], where[part], float(variance), sure)
                psf[part], sigma[part], evidence[part], flux[part] = found
            for old in list(self._nodes)[: -self._most]:
                self._nodes.pop(old, None)
        shaped = psf.reshape(noisy.shape), sigma.reshape(noisy.shape) if sure else None
        return Estimate(*shaped, evidence, flux if self.loose else None)

    def _posterior(
        self, flat: np.ndarray, where: np.ndarray, s: float, sure: bool
    ) -> tuple[np.ndarray, np.ndarray | float, np.ndarray, np.ndarray]:
        """Posterior mean, its σ, evidence and flux of images (n, P) of variance s."""
        z = (flat @ self.axes).astype(np.float32)
        log = np.full((len(z), len(self.count)), -np.inf)
        near = self._near(z, where, s)
        for k in range(len(self.count)):
            (stars,) = near[:, k].nonzero()
            if stars.size:
                _, residual, half = self._against(k, z[stars], where[stars], s)
                factor = self._factor(k, s)
                off = (where[stars] - self.center[k]) @ self._clusters[k].spread.T
                log[stars, k] = factor.constant - 0.5 * (
                    np.einsum("ij,ij,j->i", residual, residual, factor.inverse, dtype=np.float64)
                    - np.einsum("ij,ij->i", half, half, dtype=np.float64)
                    + np.einsum("ij,ij->i", off, off)
                )
        peak = log.max(axis=1)
        weight = np.exp(log - peak[:, None])
        total = weight.sum(axis=1)
        evidence = peak + np.log(total) - 0.5 * z.shape[1] * np.log(2 * np.pi)
        weight[weight < LEAST * total[:, None]] = 0.0
        weight = (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)
        gain, own = np.zeros_like(z), np.zeros_like(z)
        second = np.zeros(flat.shape) if sure else 0.0
        flux = np.ones(len(z))
        for k in range(len(self.count)):
            (stars,) = weight[:, k].nonzero()
            if not stars.size:
                continue
            w = weight[stars, k, None]
            factor = self._factor(k, s)
            at, residual, half = self._against(k, z[stars], where[stars], s)
            g = residual * factor.inverse
            g[:, : factor.low.shape[1]] -= half @ factor.low
            if self.loose:
                flux[stars] += w[:, 0] * self.loose**2 * (g @ self._contrast[k])
            mean = 0.0
            if len(self.cross):
                g *= factor.shared
                mean = self.mean_reference[k] + half @ factor.low_reference
                mean += at @ self._clusters[k].slope_reference
                own[stars] += w * mean
            gain[stars] += w * g
            if sure:
                one = self._restored(flat[stars], g, mean, s).astype(np.float64)
                second[stars] += w * (self._uncertain(k, s) + one**2)
        psf = self._restored(flat, gain, own, s)
        sigma = np.sqrt(np.maximum(second - psf.astype(np.float64) ** 2, 0.0)) if sure else np.nan
        if not len(self.cross):  # the sky of the image is no part of the star
            psf += ((flux - 1.0) / z.shape[1]).astype(np.float32)[:, None]
        return psf, sigma, evidence, flux

    @cached_property
    def _contrast(self) -> np.ndarray:
        """Mean of each cluster less an even sky of the same sum, in the axes, (K, P)."""
        return np.asarray(self.mean - self.axes.mean(axis=0))

    @cached_property
    def _most(self) -> int:
        """Noise variances whose factorisations are kept."""
        return max(1, int(KEPT // (self.deviation.nbytes + self.deviation_reference.nbytes + 1)))

    def _restored(
        self, flat: np.ndarray, gain: np.ndarray, own: np.ndarray | float, s: float
    ) -> np.ndarray:
        """Images or references from (C + s)⁻¹(z − μ) in the axes."""
        return own + gain @ self.cross.T if len(self.cross) else flat - s * (gain @ self.axes.T)

    def _against(
        self, k: int, z: np.ndarray, where: np.ndarray, s: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position from the cluster's, image less its mean there, and A times that."""
        low = self._factor(k, s).low
        at = (where - self.center[k]).astype(np.float32)
        residual = z - self.mean[k]
        if at.size:
            residual -= at @ self._clusters[k].slope
        return at, residual, residual[:, : low.shape[1]] @ low.T

    def _near(self, z: np.ndarray, where: np.ndarray, s: float) -> np.ndarray:
        """Clusters that are nearest by the common covariance, (n, K) of bool."""
        if len(self.count) <= NEAREST:
            return np.ones((len(z), len(self.count)), bool)
        weight = 1.0 / np.sqrt(self.variance[:LEADING] + s)
        star, mean = (
            np.hstack([(a - p @ self.slope)[:, :LEADING] * weight, p])
            for a, p in ((z, where), (self.mean, self.center))
        )
        distance = np.square(mean).sum(axis=1) - 2.0 * star @ mean.T
        nearest = np.argpartition(distance, NEAREST, axis=1)[:, :NEAREST]
        near = np.zeros(distance.shape, bool)
        np.put_along_axis(near, nearest, True, axis=1)
        return near

    @cached_property
    def _clusters(self) -> list[Cluster]:
        """Each cluster with its own slope, by the same shrinkage as its covariances."""
        ends = self.rows.cumsum()
        return [
            self._cluster(k, slice(b - n, b))
            for k, (b, n) in enumerate(zip(ends, self.rows, strict=True))
        ]

    def _cluster(self, k: int, rows: slice) -> Cluster:
        p = self.deviation_center[rows]
        nu, total = float(self.shrinkage[0]), self.count[k] + float(self.shrinkage[0])
        scatter = p.T @ p + nu * np.eye(p.shape[1])

        def sloped(a: np.ndarray, common: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Deviations without the slope of the cluster, and that slope.

            What it differs from that of all counts as rows of its own, of weight ν.
            """
            if not (p.size and len(a)):
                return a, common
            own = np.linalg.solve(scatter, p.T @ a).astype(np.float32)
            rows = np.vstack([a - p.astype(np.float32) @ own, np.float32(np.sqrt(nu)) * own])
            return rows, common + own

        own, slope = sloped(self.deviation[rows], self.slope)
        own_reference, slope_reference = sloped(
            self.deviation_reference[rows if len(self.cross) else slice(0)], self.slope_reference
        )
        if self.loose:
            weight = np.float32(self.loose * np.sqrt(total))
            own = np.vstack([own, weight * self._contrast[k, : own.shape[1]]])
            if len(own_reference):
                row = weight * self.mean_reference[k]
                own_reference = np.vstack([own_reference, row])
        square = np.square(own_reference).sum(axis=0)
        if len(own) > own.shape[1]:
            rotation, own = np.linalg.qr(own)
            own_reference = rotation.T @ own_reference if len(own_reference) else own_reference
        spread = np.linalg.inv(np.linalg.cholesky(scatter / total))
        return Cluster(
            own, own_reference, square, slope, slope_reference, spread, nu / total, 1 / total
        )

    def _factor(self, k: int, s: float) -> Factor:
        """C_k + s factorised: D + b XᵀX with the diagonal D, and M = 1/b + X D⁻¹Xᵀ = L Lᵀ."""
        node = self._nodes.setdefault(s, {})  # whole, whatever another thread drops
        if k not in node:
            from scipy.linalg.lapack import dtrtrs

            cluster = self._clusters[k]
            leading = min(self._leading(s), cluster.own.shape[1])
            shared = np.ones(len(self.variance))
            shared[:leading] = cluster.common
            d = shared * self.variance + s
            x = cluster.own[:, :leading].astype(np.float64)
            low = np.linalg.cholesky(np.eye(len(x)) / cluster.scale + (x / d[:leading]) @ x.T)
            y = cluster.own_reference
            both = np.hstack([x / d[:leading], y]) if len(y) else x / d[:leading]
            both, _ = dtrtrs(low, both, lower=True)
            half_det = np.log(low.diagonal()).sum() + 0.5 * len(x) * np.log(cluster.scale)
            node[k] = Factor(
                inverse=(1.0 / d).astype(np.float32),
                low=np.ascontiguousarray(both[:, :leading], np.float32),
                low_reference=np.ascontiguousarray(both[:, leading:], np.float32),
                shared=shared.astype(np.float32),
                constant=float(
                    np.log(self.count[k] / self.count.sum())
                    - half_det
                    - 0.5 * np.log(d).sum()
                    + np.log(cluster.spread.diagonal()).sum()
                ),
            )
        return node[k]

    def _leading(self, s: float) -> int:
        """Coordinates in which clusters differ at a noise variance s."""
        return int(np.count_nonzero(self._reaching > FLAT * s))

    @cached_property
    def _reaching(self) -> np.ndarray:
        """Largest variance of all stars along an axis or one after it, the last axis first."""
        return np.maximum.accumulate(self._total[::-1])

    @cached_property
    def _total(self) -> np.ndarray:
        """Variance of all stars along the axes."""
        mean = np.average(self.mean, axis=0, weights=self.count)
        between = np.average(np.square(self.mean - mean), axis=0, weights=self.count)
        loose = np.square(self.loose * self._contrast).max(axis=0)
        return self.variance + between + np.square(self.slope).sum(axis=0) + loose

    def _uncertain(self, k: int, s: float) -> np.ndarray:
        """Variance of each pixel inside a cluster once the image is known, shape (P,)."""
        factor, cluster = self._factor(k, s), self._clusters[k]
        leading = factor.low.shape[1]
        if not len(self.cross):
            known = np.square(self.axes) @ factor.inverse
            known -= np.square(factor.low @ self.axes[:, :leading].T).sum(axis=0)
            return np.maximum(s - s**2 * known, 0.0)
        own, cross = cluster.own_reference, self.cross * factor.shared
        cross[:, :leading] += cluster.scale * own.T @ cluster.own[:, :leading]
        prior = cluster.common * self.variance_reference + cluster.scale * cluster.square
        known = np.square(cross) @ factor.inverse
        known -= np.square(cross[:, :leading] @ factor.low.T).sum(axis=1)
        return np.maximum(prior - known, 0.0)


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
    return (p - p.mean(axis=0)) / np.where(spread > 0, spread, 1.0)


def _whitening(p: np.ndarray) -> np.ndarray:
    """Matrix W (q, q) that gives positions p (n, q) of zero mean unit covariance.

    A direction in which the field does not vary becomes 0.
    """
    variance, axes = np.linalg.eigh(p.T @ p / len(p))
    real = variance > 1e-12 * max(variance.max(initial=0.0), 1e-300)
    return np.asarray(axes * np.where(real, 1.0 / np.sqrt(np.where(real, variance, 1.0)), 0.0))


def climbed(
    values: Sequence[float], start: float, error: Callable[[float], float], pays: float = 0.0
) -> Any:
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
    init = "k-means++" if clusters <= CAREFUL else "random"
    means = KMeans(clusters, init=init, n_init=1, random_state=draw)
    return np.asarray(means.fit(features).labels_)
