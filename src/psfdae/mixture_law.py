"""The law of stars of a Gaussian mixture, and the posterior mean under it.

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
its sum is 1. Little is known of a; it is one more row of X_k, σ_a (μ_k − 1/P), and of
Y_k, σ_a μ_y,k with σ_a = `FLUX_SIGMA`.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, NamedTuple, Self

import numpy as np

from psfdae.lowrank import NOISE_STEP, Kept, factorised, mixing_weights
from psfdae.method import Estimate
from psfdae.noise import NoiseModel

FINE_NOISE_STEP = 0.2
"""`NOISE_STEP` where the density of images counts: an error of s weighs more in it than in their
mean."""

CACHE_BYTES = 400e6
"""Size of the factorisations that are kept for further stars."""

NEAREST, LEADING = 32, 64
"""Clusters that are looked at, and coordinates in which they are found; the others of 512
hold less than 1 % of the weight."""

OUTLIER_COORDINATES, LEADING_ARRAYS = 40, ("axes", "variance", "mean", "deviation", "slope")
"""Coordinates that tell outliers, and arrays whose last axis they are. More of them find
more outliers that are bright, and fewer that are faint."""

FEW_ROWS = 64
"""Rows of a cluster up to which its factorisation takes no time by itself."""

FLAT_VARIANCE = 0.005
"""Variance of a coordinate over s below which all clusters share one normal law."""

IMAGES_AT_ONCE = 4096
"""Images that are restored together."""


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
class MixtureLaw:
    """A mixture of normal laws of stars and of their references.

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
        Standard deviation of a, or 0 where fluxes are known.
    step : float
        Between noise variances that share a factorisation, in ln s.
    """

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
    step: float = NOISE_STEP
    _factors: Kept[float, Factor] = field(default_factory=Kept, init=False, repr=False)
    _insides: Kept[float, np.ndarray] = field(default_factory=Kept, init=False, repr=False)

    def _estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None,
        sure: bool,
        near: np.ndarray | None = None,
    ) -> tuple[Estimate, np.ndarray]:
        """Estimates, and the weight of each cluster for each image, (n, K).

        Those that are not `near`, (n, K) of bool, have none.
        """
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
        weight = np.empty((len(flat), len(self.count)), np.float32)
        for place, variance in enumerate(s):
            (stars,) = (node == place).nonzero()
            for part in np.array_split(stars, -(-stars.size // IMAGES_AT_ONCE)):
                own = None if near is None else near[part]
                found = self._posterior(flat[part], where[part], float(variance), sure, own)
                psf[part], sigma[part], evidence[part], flux[part], weight[part] = found
            for kept in (self._factors, self._insides):
                kept.trim(self._most)
        shaped = psf.reshape(noisy.shape), sigma.reshape(noisy.shape) if sure else None
        return Estimate(*shaped, evidence, flux if self.loose else None), weight

    def _posterior(
        self,
        flat: np.ndarray,
        where: np.ndarray,
        s: float,
        sure: bool,
        near: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray | float, np.ndarray, np.ndarray, np.ndarray]:
        """Posterior mean, its σ, evidence, flux and weights of images (n, P) of variance s."""
        z = (flat @ self.axes).astype(np.float32)
        log = self._log_densities(z, where, s, near)
        weights, evidence = mixing_weights(log)
        evidence -= 0.5 * z.shape[1] * np.log(2 * np.pi)
        weight = weights.astype(np.float32)
        gain, own = np.zeros_like(z), np.zeros_like(z)
        second = np.zeros(flat.shape if sure else 0)
        flux = np.ones(len(z))
        for k in range(len(self.count)):
            (stars,) = weight[:, k].nonzero()
            if not stars.size:
                continue
            w = weight[stars, k, None]
            factor = self._factor(k, s)
            at, residual, half = self._against(k, factor, z[stars], where[stars])
            g = residual * factor.inverse
            g[:, : factor.low.shape[1]] -= half @ factor.low
            if self.loose:
                flux[stars] += w[:, 0] * self.loose**2 * (g @ self._contrast[k])
            mean = 0.0
            if len(self.cross):
                g *= factor.shared
                mean = self.mean_reference[k] + half @ factor.low_reference
                if at.size:
                    mean += at @ self._clusters[k].slope_reference
                own[stars] += w * mean
            gain[stars] += w * g
            if sure:
                one = self._restored(flat[stars], g, mean, s).astype(np.float64)
                inside = self._insides(s, k, partial(self._uncertain, k, s))
                second[stars] += w * (inside + one**2)
        psf = self._restored(flat, gain, own, s)
        sigma = np.sqrt(np.maximum(second - psf.astype(np.float64) ** 2, 0.0)) if sure else np.nan
        if not len(self.cross):  # the sky of the image is no part of the star
            psf += ((flux - 1.0) / z.shape[1]).astype(np.float32)[:, None]
        return psf, sigma, evidence, flux, weight

    def _log_densities(
        self, z: np.ndarray, where: np.ndarray, s: float, near: np.ndarray | None
    ) -> np.ndarray:
        """ln of the probability of images in the axes under each cluster that is near, (n, K).

        Without the term of 2π.
        """
        near = self._near(z, where, s) if near is None else near
        log = np.full((len(z), len(self.count)), -np.inf)
        leading = self._leading(s)
        self._factorise(np.flatnonzero(near.any(axis=0)), s)
        for k in range(len(self.count)):
            (stars,) = near[:, k].nonzero()
            if stars.size:
                factor = self._factor(k, s)
                _, residual, half = self._against(k, factor, z[stars, :leading], where[stars])
                far = np.square(residual) @ factor.inverse[:leading] - np.square(half).sum(axis=1)
                far = far.astype(np.float64)
                if where.shape[1]:
                    off = (where[stars] - self.center[k]) @ self._clusters[k].spread.T
                    far += np.square(off).sum(axis=1)
                log[stars, k] = factor.constant - 0.5 * far
        # In the other coordinates all clusters have nearly one law.
        rest = np.square(z[:, leading:] - self._middle[leading:])
        log -= 0.5 * (rest @ (1.0 / (self.variance[leading:] + s)))[:, None]
        return log

    @cached_property
    def _contrast(self) -> np.ndarray:
        """Mean of each cluster less an even sky of the same sum, in the axes, (K, P)."""
        return np.asarray(self.mean - self.axes.mean(axis=0))

    @cached_property
    def _most(self) -> int:
        """Noise variances whose factorisations are kept."""
        return max(
            1, int(CACHE_BYTES // (self.deviation.nbytes + self.deviation_reference.nbytes + 1))
        )

    def _restored(
        self, flat: np.ndarray, gain: np.ndarray, own: np.ndarray | float, s: float
    ) -> np.ndarray:
        """Images or references from (C + s)⁻¹(z − μ) in the axes."""
        return np.asarray(
            own + gain @ self.cross.T if len(self.cross) else flat - s * (gain @ self.axes.T)
        )

    def _against(
        self, k: int, factor: Factor, z: np.ndarray, where: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position from the cluster's, image less its mean there, and A times that.

        The image z has all coordinates or the leading ones.
        """
        low = factor.low
        at = (where - self.center[k]).astype(np.float32)
        width = z.shape[1]
        residual = z - self.mean[k, :width]
        if at.size:
            residual -= at @ self._clusters[k].slope[:, :width]
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
        p, nu, total = self.deviation_center, float(self.shrinkage[0]), self.count + self.shrinkage
        ends = self.rows.cumsum()
        parts = [slice(b - n, b) for b, n in zip(ends, self.rows, strict=True)]
        scatter = np.array([p[rows].T @ p[rows] for rows in parts]) + nu * np.eye(p.shape[1])
        inverse = np.linalg.inv(scatter)
        spread = np.linalg.inv(np.linalg.cholesky(scatter / total[:, None, None]))
        return [self._cluster(k, rows, inverse[k], spread[k]) for k, rows in enumerate(parts)]

    def _cluster(self, k: int, rows: slice, inverse: np.ndarray, spread: np.ndarray) -> Cluster:
        """`inverse` is that of the positions' scatter, (q, q), and ν."""
        p = self.deviation_center[rows]
        nu, total = float(self.shrinkage[0]), self.count[k] + float(self.shrinkage[0])

        def sloped(a: np.ndarray, common: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Deviations without the slope of the cluster, and that slope.

            What it differs from that of all counts as rows of its own, of weight ν.
            """
            if not (p.size and len(a)):
                return a, common
            own = (inverse @ (p.T @ a)).astype(np.float32)
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
        return Cluster(
            own, own_reference, square, slope, slope_reference, spread, nu / total, 1 / total
        )

    def _factor(self, k: int, s: float) -> Factor:
        """C_k + s factorised."""
        return self._factors(s, k, lambda: self._factored([k], s)[0])

    def _factorise(self, some: np.ndarray, s: float) -> None:
        """C_k + s of some clusters factorised, those with as many rows and stars together."""
        alike = defaultdict(list)
        for k in self._factors.missing(s, some):
            alike[self.rows[k], self.count[k]].append(k)
        for own in alike.values():
            for k, factor in zip(own, self._factored(own, s), strict=True):
                self._factors(s, k, partial(lambda made: made, factor))

    def _factored(self, alike: Sequence[int], s: float) -> list[Factor]:
        """Factors of clusters with as many rows and stars."""
        clusters = [self._clusters[k] for k in alike]
        first = clusters[0]
        leading = min(self._leading(s), first.own.shape[1])
        shared = np.ones(len(self.variance))
        shared[:leading] = first.common
        d = shared * self.variance + s
        rows = np.stack([c.own[:, :leading] for c in clusters]).astype(np.float64)
        y = np.stack([c.own_reference for c in clusters]) if len(self.cross) else None
        if rows.shape[1] > FEW_ROWS and len(alike) == 1:
            rows, y = rows[0], None if y is None else y[0]
        found = factorised(d[:leading], rows, first.scale, y)
        same = (1.0 / d).astype(np.float32), shared.astype(np.float32)
        half, log_d = np.atleast_1d(found.half_det), np.log(d).sum()
        low = found.low.reshape(len(alike), len(first.own), -1).astype(np.float32)
        return [
            Factor(
                inverse=same[0],
                low=np.ascontiguousarray(low[i, :, :leading]),
                low_reference=np.ascontiguousarray(low[i, :, leading:]),
                shared=same[1],
                constant=float(
                    np.log(self.count[k] / self.count.sum())
                    - half[i]
                    - 0.5 * log_d
                    + np.log(clusters[i].spread.diagonal()).sum()
                ),
            )
            for i, k in enumerate(alike)
        ]

    def _leading(self, s: float) -> int:
        """Coordinates in which clusters differ at a noise variance s.

        That is by the largest variance of all stars along an axis or one after it.
        """
        return int(np.count_nonzero(np.maximum.accumulate(self._total[::-1]) > FLAT_VARIANCE * s))

    @cached_property
    def _middle(self) -> np.ndarray:
        """Mean of all stars in the axes, (P,)."""
        return np.asarray(np.average(self.mean, axis=0, weights=self.count))

    @cached_property
    def _total(self) -> np.ndarray:
        """Variance of all stars along the axes."""
        between = np.average(np.square(self.mean - self._middle), axis=0, weights=self.count)
        loose = np.square(self.loose * self._contrast).max(axis=0)
        return np.asarray(self.variance + between + np.square(self.slope).sum(axis=0) + loose)

    def _uncertain(self, k: int, s: float) -> np.ndarray:
        """Variance of each pixel inside a cluster once the image is known, shape (P,)."""
        factor, cluster = self._factor(k, s), self._clusters[k]
        m = factor.low.shape[1]
        if not len(self.cross):
            known = self._squares @ factor.inverse
            known -= np.square(factor.low @ self.axes[:, :m].T).sum(axis=0)
            return np.asarray(np.maximum(s - s**2 * known, 0.0))
        own, cross = cluster.own_reference, self.cross[:, :m] * factor.shared[:m]
        cross += cluster.scale * own.T @ cluster.own[:, :m]
        prior = cluster.common * self.variance_reference + cluster.scale * cluster.square
        known = np.square(cross) @ factor.inverse[:m]
        known += self._squares[:, m:] @ (np.square(factor.shared[m:]) * factor.inverse[m:])
        known -= np.square(cross @ factor.low.T).sum(axis=1)
        return np.asarray(np.maximum(prior - known, 0.0))

    @cached_property
    def _squares(self) -> np.ndarray:
        """Squares of the axes in pixels, or of the covariances with references, (P, P)."""
        return np.asarray(np.square(self.cross if len(self.cross) else self.axes))

    @cached_property
    def _telling(self) -> Self:
        """The law of the leading coordinates."""
        none = np.empty((0, 0), np.float32)
        cut: dict[str, Any] = {
            n: np.ascontiguousarray(getattr(self, n)[..., :OUTLIER_COORDINATES])
            for n in LEADING_ARRAYS
        }
        return replace(
            self,
            **cut,
            cross=none,
            deviation_reference=none,
            slope_reference=none,
            step=FINE_NOISE_STEP,
        )
