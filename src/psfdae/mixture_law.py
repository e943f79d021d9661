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
C_k = (X_kᵀX_k + ν S) / (n_k + ν), X_k the deviations of its stars from their mean. The
eigenvectors of C_k do not depend on the noise: along the leading ones C_k + s is diagonal for
every star, and beyond them C_k is taken for even. Where all images have one noise, Woodbury's
identity takes less than eigenvectors. Coordinates are the eigenvectors of S; only in the leading
ones do clusters differ by more than the noise hides.

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
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np

from psfdae.method import Estimate
from psfdae.mixing import mixing_weights
from psfdae.noise import NoiseModel

NOISE_BIN = 2.0
"""Range of ln s of stars for which the same coordinates and axes of a cluster count."""

DET_NODES = 41
"""Of ln s in such a range, between which determinants are interpolated."""

NOISE_STEP = 0.4
"""Step in ln s between stars that share the variance of their pixels over s."""

NEAREST, LEADING = 32, 64
"""Clusters that are looked at, and coordinates in which they are found; the others of 512
hold less than 1 % of the weight."""

OUTLIER_COORDINATES, LEADING_ARRAYS = 40, ("axes", "variance", "mean", "deviation", "slope")
"""Coordinates that tell outliers, and arrays whose last axis they are. More of them find
more outliers that are bright, and fewer that are faint."""

FLAT_VARIANCE = 0.005
"""Variance of a coordinate over s below which all clusters share one normal law."""

LEAST_VARIANCE = 5e-4
"""Variance over s of a cluster's axes; of smaller ones only the mean is known."""

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


class Axes(NamedTuple):
    """Eigenvectors of C_k in the leading w coordinates.

    Attributes
    ----------
    vectors : ndarray, shape (w, w), float32
        Columns, by descending variance.
    variance : ndarray, shape (w,)
        Along them.
    total : float
        Sum of the variances.
    """

    vectors: np.ndarray
    variance: np.ndarray
    total: float


class Spectrum(NamedTuple):
    """(C_k + s)⁻¹ of a cluster for any noise variance s (n, 1) above `Seen.least`, along its axes.

    Attributes
    ----------
    vectors : ndarray, shape (m, a), float32
        Columns V.
    variance : ndarray, shape (a,)
        λ along them.
    rest : float
        Mean variance beyond them in the m coordinates; infinite if there is nothing beyond.
    """

    vectors: np.ndarray
    variance: np.ndarray
    rest: float

    def _inverse(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Along the axes (n, a) and beyond them (n, 1)."""
        variance = self.variance.astype(s.dtype)
        return 1 / (variance + s), 1 / (s.dtype.type(self.rest) + s)

    def solved(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Its product with rows (n, m)."""
        along, beyond = self._inverse(s)
        axes = rows @ self.vectors
        both = np.vstack([along * axes, axes]) @ self.vectors.T
        return np.asarray(both[: len(rows)] + beyond * (rows - both[len(rows) :]))

    def distance(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Its products with rows (n, m) on both sides, (n,)."""
        along, beyond = self._inverse(s)
        squares = np.square(rows @ self.vectors)
        left = np.square(rows).sum(axis=1) - squares.sum(axis=1)
        return np.asarray((squares * along).sum(axis=1) + left * beyond[:, 0])

    def product(self, rows: np.ndarray, one: np.ndarray, s: np.ndarray) -> np.ndarray:
        """Its products with rows (n, m) and another one (m,), (n,)."""
        along, beyond = self._inverse(s)
        axes, of_axes = rows @ self.vectors, one @ self.vectors
        return np.asarray((along * axes) @ of_axes + beyond[:, 0] * (rows @ one - axes @ of_axes))

    def distances(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """As `distance`, of rows (r, m) for every s, (n, r)."""
        along, beyond = self._inverse(s)
        squares = np.square(rows @ self.vectors).T
        return np.asarray(
            along @ squares + beyond * (np.square(rows).sum(axis=1) - squares.sum(axis=0))
        )

    def half_log_det(self, s: np.ndarray) -> np.ndarray:
        """½ ln det(C_k + s) of some s (n,), in the m coordinates."""
        more = len(self.vectors) - len(self.variance)
        along = np.log(self.variance + s[:, None]).sum(axis=1)
        return np.asarray(0.5 * (along + (more * np.log(self.rest + s) if more else 0.0)))


class LowRank(NamedTuple):
    """The same for one noise variance, which takes far less to make (Woodbury's identity).

    Attributes
    ----------
    certain : ndarray, shape (m,)
        D⁻¹, with C_k + s = D + UᵀU and a diagonal D.
    rows : ndarray, shape (r, m), float32
        L⁻¹ U D⁻¹, with L Lᵀ = 1 + U D⁻¹ Uᵀ; (C_k + s)⁻¹ is D⁻¹ less the products of these.
    half_log : float
        ½ ln det(C_k + s).
    """

    certain: np.ndarray
    rows: np.ndarray
    half_log: float

    def solved(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """As `Spectrum`."""
        certain = self.certain.astype(rows.dtype)
        return np.asarray(rows * certain - (rows @ self.rows.T) @ self.rows)

    def distance(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """As `Spectrum`."""
        known = np.square(rows @ self.rows.T).sum(axis=1)
        return np.asarray(np.square(rows) @ self.certain.astype(rows.dtype) - known)

    def product(self, rows: np.ndarray, one: np.ndarray, s: np.ndarray) -> np.ndarray:
        """As `Spectrum`."""
        return np.asarray(rows @ (self.certain * one) - (rows @ self.rows.T) @ (self.rows @ one))

    def distances(self, rows: np.ndarray, s: np.ndarray) -> np.ndarray:
        """As `Spectrum`."""
        known = np.square(rows) @ self.certain - np.square(rows @ self.rows.T).sum(axis=1)
        return np.asarray(np.repeat(known[None], len(s), axis=0))

    def half_log_det(self, s: np.ndarray) -> np.ndarray:
        """As `Spectrum`."""
        return np.full(len(s), self.half_log)


class Seen(NamedTuple):
    """Images of about the same noise.

    Attributes
    ----------
    flat : ndarray, shape (n, P)
    z : ndarray, shape (n, P), float32
        In the axes of S.
    where : ndarray, shape (n, q)
        Positions, whitened.
    s : ndarray, shape (n, 1), float32
    node : ndarray, shape (n,)
        s or what is near it, of which there are few.
    least : float
        Below every s.
    alone : float or None
        The noise variance of all images, if one level was given for all.
    """

    flat: np.ndarray
    z: np.ndarray
    where: np.ndarray
    s: np.ndarray
    node: np.ndarray
    least: float
    alone: float | None


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
    _spectra: dict[tuple[int, int], Axes] = field(default_factory=dict, init=False, repr=False)
    _of_one: dict[tuple[int, float], list[LowRank]] = field(
        default_factory=dict, init=False, repr=False
    )
    _doubts: dict[tuple[int, float, float], np.ndarray] = field(
        default_factory=dict, init=False, repr=False
    )

    def _parts(
        self, noisy: np.ndarray, level: float | np.ndarray, position: np.ndarray | None = None
    ) -> Iterator[tuple[np.ndarray, Seen]]:
        """Images (n, d, d) of about the same noise, and their numbers."""
        flat = noisy.reshape(len(noisy), math.prod(noisy.shape[1:]))
        if not np.isfinite(flat).all():
            raise ValueError("noisy images must be finite")
        where = position @ self.whitening if self.whitening.size else np.empty((len(flat), 0))
        even = np.full(len(flat), 1.0 / flat.shape[1])
        s = self.noise.variance(even, np.asarray(level))
        # Not by how many there are: stars do not influence each other.
        node = np.exp(np.rint(np.log(s) / NOISE_STEP) * NOISE_STEP) if np.ndim(level) else s
        s, node = (np.broadcast_to(a, len(flat)) for a in (s, node))
        alone = None if np.ndim(level) else float(s[0]) if len(s) else None
        range_of = np.floor(np.log(s) / NOISE_BIN)
        for number in np.unique(range_of):
            (stars,) = (range_of == number).nonzero()
            least = float(np.exp(NOISE_BIN * number))
            for part in np.array_split(stars, -(-stars.size // IMAGES_AT_ONCE)):
                images = flat.take(part, axis=0)
                z = (images @ self.axes).astype(np.float32)
                of_noise = s[part, None].astype(np.float32), node[part], least, alone
                yield part, Seen(images, z, where[part], *of_noise)

    def _estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None,
        sure: bool,
        near: np.ndarray | None = None,
    ) -> Estimate:
        """Estimates, from the clusters that are `near`, (n, K) of bool."""
        psf, sigma = (np.empty(noisy.shape, np.float32) for _ in range(2))
        evidence, flux = np.empty((2, len(noisy)))
        for part, seen in self._parts(noisy, level, position):
            weight, evidence[part] = self._weights(seen, None if near is None else near[part])
            own, doubt = self._posterior(seen, weight, sure)
            if self.loose:
                flux[part] = self._flux(seen, weight)
                if not len(self.cross):  # the sky of the image is no part of the star
                    own += ((flux[part] - 1.0) / own.shape[1])[:, None]
            psf[part], sigma[part] = (a.reshape(-1, *noisy.shape[1:]) for a in (own, doubt))
        return Estimate(psf, sigma if sure else None, evidence, flux if self.loose else None)

    def _weights(self, seen: Seen, near: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Weight of each cluster for each image, (n, K), and the images' evidence."""
        weight, evidence = mixing_weights(self._log_densities(seen, near))
        evidence -= 0.5 * seen.z.shape[1] * np.log(2 * np.pi)
        return weight.astype(np.float32), evidence

    def _posterior(
        self, seen: Seen, weight: np.ndarray, sure: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Posterior mean and its σ, (n, P), NaN unless `sure`."""
        same, m = not len(self.cross), self._known(seen.least)
        # Noise of simulated stars may be far above the star, which cancels in second − first².
        sums = np.float32 if seen.alone is None else np.float64
        first, second = np.zeros((2, *seen.flat.shape), sums)
        others = weight @ self.mean[:, m:]  # in the other coordinates
        images = self.axes if same else self.cross
        lead = np.zeros((len(weight), m), np.float32)  # sums over clusters, where no σ is asked
        for k, rows, at, residual, cut in self._pairs(seen, weight > 0, m):
            cluster, w, s = self._clusters[k], weight[rows, k, None], seen.s[rows]
            g = cut.solved(residual, s)
            if at.size:
                others[rows] += w * (at @ cluster.slope[:, m:])
            linear = (-s if same else cluster.common) * g
            one = linear @ images[:, :m].T if sure else np.float32(0.0)
            if not same:
                mean = (g @ cluster.own[:, :m].T) @ cluster.own_reference
                one = one + self.mean_reference[k] + cluster.scale * mean
                one += at @ cluster.slope_reference if at.size else 0.0
            if sure or not same:
                first[rows] += w * one
            if sure:
                doubt = s * self._doubt(k, seen, seen.node[rows])
                second[rows] += w * (doubt + np.square(one, dtype=sums))
            else:
                lead[rows] += w * linear
        if not sure:
            first += lead @ images[:, :m].T
        gain = (seen.z[:, m:] - others) / (self.variance[m:].astype(np.float32) + seen.s)
        sigma = np.sqrt(np.maximum(second - np.square(first), 0.0)) if sure else second + np.nan
        if same:
            first += seen.flat - seen.s * gain @ images[:, m:].T
        else:
            first += gain @ images[:, m:].T
        return first, sigma

    def _flux(self, seen: Seen, weight: np.ndarray) -> np.ndarray:
        """Posterior mean of a, (n,)."""
        flux, m = np.ones(len(weight)), self._known(seen.least)
        others = self.variance[m:].astype(np.float32)
        for k, rows, _, residual, cut in self._pairs(seen, weight > 0, seen.z.shape[1]):
            s, lead, contrast = seen.s[rows], residual[:, :m], self._contrast[k]
            found = cut.product(lead, contrast[:m], s)
            found += (residual[:, m:] / (others + s)) @ contrast[m:]
            flux[rows] += self.loose**2 * weight[rows, k] * found
        return flux

    def _pairs(
        self, seen: Seen, near: np.ndarray, width: int
    ) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray, Spectrum | LowRank]]:
        """Clusters with the images (n, K) of bool that are near.

        Their numbers, positions and leading coordinates less the cluster's, and its (C_k + s)⁻¹.
        """
        leading = np.ascontiguousarray(seen.z[:, :width])
        for k, of in enumerate(np.ascontiguousarray(near.T)):
            (rows,) = of.nonzero()
            if rows.size:
                at = (seen.where[rows] - self.center[k]).astype(np.float32)
                residual = leading.take(rows, axis=0)
                residual -= self.mean[k, :width]
                if at.size:
                    residual -= at @ self._clusters[k].slope[:, :width]
                yield k, rows, at, residual, self._cut(k, seen)

    def _log_densities(self, seen: Seen, near: np.ndarray | None) -> np.ndarray:
        """ln of the probability of images under each cluster that is near, (n, K).

        Without the term of 2π.
        """
        near = self._near(seen) if near is None else near
        log = np.full((len(seen.z), len(self.count)), -np.inf)
        width, m = self._leading(seen.least), self._known(seen.least)
        ln_s = np.log(seen.s[:, 0].astype(np.float64))
        nodes = np.log(seen.least) + np.linspace(0.0, NOISE_BIN, DET_NODES)
        for k, rows, at, residual, cut in self._pairs(seen, near, width):
            cluster, s = self._clusters[k], seen.s[rows]
            far = cut.distance(residual[:, :m], s)
            det = cut.half_log_det(np.exp(nodes))
            if width > m:
                more = self.variance[m:width]
                far += (np.square(residual[:, m:]) / (more + s)).sum(axis=1)
                det += 0.5 * np.log(more + np.exp(nodes)[:, None]).sum(axis=1)
            far = far.astype(np.float64)
            if at.size:
                far += np.square(at @ cluster.spread.T).sum(axis=1)
            constant = np.log(self.count[k] / self.count.sum())
            constant += np.log(cluster.spread.diagonal()).sum()
            log[rows, k] = constant - np.interp(ln_s[rows], nodes, det) - 0.5 * far
        # In the other coordinates all clusters have nearly one law.
        variance = self.variance[width:] + seen.s
        rest = np.square(seen.z[:, width:] - self._middle[width:])
        log -= 0.5 * (rest / variance + np.log(variance)).sum(axis=1, keepdims=True)
        return log

    @cached_property
    def _contrast(self) -> np.ndarray:
        """Mean of each cluster less an even sky of the same sum, in the axes, (K, P)."""
        return np.asarray(self.mean - self.axes.mean(axis=0))

    def _near(self, seen: Seen) -> np.ndarray:
        """Clusters that are nearest by the common covariance, (n, K) of bool."""
        if len(self.count) <= NEAREST:
            return np.ones((len(seen.z), len(self.count)), bool)
        star, mean = (
            (a - p @ self.slope)[:, :LEADING]
            for a, p in ((seen.z, seen.where), (self.mean, self.center))
        )
        certain = 1.0 / (self.variance[:LEADING] + seen.s)
        distance = certain @ np.square(mean).T - 2.0 * (certain * star) @ mean.T
        distance += np.square(self.center).sum(axis=1) - 2.0 * seen.where @ self.center.T
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
            *(own, own_reference, square, slope, slope_reference, spread),
            *(float(nu / total), float(1 / total)),
        )

    def _cut(self, k: int, seen: Seen) -> Spectrum | LowRank:
        """(C_k + s)⁻¹ of a cluster for the noise of some images."""
        s, width = seen.least, self._known(seen.least)
        if seen.alone is not None:
            return self._factors(width, seen.alone)[k]
        axes = self._axes(k, width)
        width, variance = len(axes.variance), axes.variance[axes.variance > LEAST_VARIANCE * s]
        more = width - len(variance)
        rest = (axes.total - variance.sum()) / more if more else np.inf
        return Spectrum(axes.vectors[:, : len(variance)], variance, float(rest))

    def _factors(self, width: int, s: float) -> list[LowRank]:
        """(C_k + s)⁻¹ of all clusters, those with as many rows together; kept for the last s."""
        if found := self._of_one.get((width, s)):
            return found
        made: dict[int, LowRank] = {}
        for size in np.unique([len(cluster.own) for cluster in self._clusters]):
            numbers = [k for k, cluster in enumerate(self._clusters) if len(cluster.own) == size]
            some = [self._clusters[k] for k in numbers]
            common, scale = (np.array([[getattr(c, n)] for c in some]) for n in ("common", "scale"))
            diagonal = common * self.variance[:width] + s
            rows = np.stack([c.own[:, :width] for c in some]) * np.sqrt(scale)[..., None]
            certain = rows / diagonal[:, None]
            lower = np.linalg.cholesky(np.eye(size) + certain @ rows.transpose(0, 2, 1))
            half_log = 0.5 * np.log(diagonal).sum(axis=1)
            half_log += np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
            factors = (np.linalg.inv(lower) @ certain).astype(np.float32)
            made |= dict(zip(numbers, map(LowRank, 1.0 / diagonal, factors, half_log), strict=True))
        self._of_one.clear()
        found = self._of_one[width, s] = [made[k] for k in range(len(self.count))]
        return found

    def _axes(self, k: int, width: int) -> Axes:
        """Axes of C_k, made once."""
        if (k, width) not in self._spectra:
            cluster = self._clusters[k]
            rows = cluster.own[:, :width].astype(np.float64)
            covariance = cluster.scale * (rows.T @ rows)
            covariance[np.diag_indices(width)] += cluster.common * self.variance[:width]
            variance, vectors = np.linalg.eigh(covariance)
            self._spectra[k, width] = Axes(
                np.ascontiguousarray(vectors[:, ::-1], dtype=np.float32),
                np.maximum(variance[::-1], 0.0),
                float(np.trace(covariance)),
            )
        return self._spectra[k, width]

    def _leading(self, s: float) -> int:
        """Coordinates in which clusters differ at a noise variance s.

        That is by the largest variance of all stars along an axis or one after it.
        """
        return int(np.count_nonzero(np.maximum.accumulate(self._total[::-1]) > FLAT_VARIANCE * s))

    def _known(self, s: float) -> int:
        """Leading coordinates in which clusters have covariances of their own."""
        return min(self._leading(s), int(self.deviation.shape[1]))

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

    def _doubt(self, k: int, seen: Seen, node: np.ndarray) -> np.ndarray:
        """Variance over s of the pixels of images (n, P) once they are known, inside a cluster.

        Of those noise variances s (n,), of which few differ.
        """
        nodes, which = np.unique(node, return_inverse=True)
        keys = [(k, seen.alone or seen.least, s) for s in nodes.tolist()]
        if new := [key for key in keys if key not in self._doubts]:
            found = self._doubts_of(k, seen, np.array([s for _, _, s in new]))
            self._doubts.update(zip(new, found, strict=True))
        return np.stack([self._doubts[key] for key in keys])[which]

    def _doubts_of(self, k: int, seen: Seen, s: np.ndarray) -> np.ndarray:
        cluster, m, s = self._clusters[k], self._known(seen.least), s[:, None]
        # Covariance of references with the leading coordinates; images are their own references.
        lead = self.axes[:, :m]
        if len(self.cross):
            lead = cluster.common * self.cross[:, :m]
            lead = lead + cluster.scale * cluster.own_reference.T @ cluster.own[:, :m]
        known = self._cut(k, seen).distances(lead, s)
        known += (1.0 / (self.variance[m:] + s)) @ self._squares[:, m:].T
        if not len(self.cross):
            return np.asarray(np.maximum(1.0 - s * known, 0.0))
        prior = cluster.common * self.variance_reference + cluster.scale * cluster.square
        return np.asarray(np.maximum(prior - known, 0.0) / s)

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
        )
