"""Method `gmm`: a Gaussian mixture of noise-free stars, whose posterior mean is the denoised PSF.

`psfdae.methods.mixture.prior` has the mixture. The class of this module chooses its settings by
validation stars, and fits, applies and stores it. Equations are numbered as on the page
docs/mixture.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field

from psfdae.base.settings import Count, Group, Positive
from psfdae.methods.bundle_info import BundleInfo
from psfdae.methods.interface import (
    Estimate,
    FitError,
    Look,
    Method,
    Needs,
    Packing,
    Storage,
    TrainingSet,
)
from psfdae.methods.mixing import FLUX_SIGMA
from psfdae.methods.mixture.densities import cluster_weights, star_batches
from psfdae.methods.mixture.fit import best_on_validation, k_means, mixture_arrays
from psfdae.methods.mixture.posterior import flux_factor, posterior_mean
from psfdae.methods.mixture.prior import MixturePrior
from psfdae.stars.noise import build_noise


class Gmm(Group):
    """Mixture of Gaussians; validation stars choose among several values of a setting."""

    stars: Count | None = None
    """Number of training stars; null: all."""
    components: Annotated[list[Count], Field(min_length=1)] = Field([16, 1, 4, 64, 128])
    """Numbers of clusters K; the search starts at the first one, and continues while the error
    decreases. Numbers above the number of stars are skipped."""
    shrinkage: Annotated[list[Positive], Field(min_length=1)] = Field([10.0, 3.0, 30.0, 100.0])
    """Weight ν of the common covariance in each cluster, in stars; the search starts at the
    first one."""
    principal: Count = 40
    """Number of principal components in which stars are clustered."""
    place: Positive = 1.0
    """RMS of the field position over the RMS of the principal components, for methods with the
    position as input."""
    threads: Count = 1
    """Threads of the linear algebra."""


@dataclass(frozen=True, eq=False, repr=False)
class GaussianMixture(MixturePrior, Method):
    """Fitted Gaussian mixture.

    Attributes
    ----------
    outlier_coordinates : int
        Number of leading coordinates in the outlier score. More coordinates detect more bright
        outliers and fewer faint ones.
    """

    outlier_coordinates: int = 40

    look = Look("GMM", "#cc79a7", "P", title="Gaussian mixture")
    needs = Needs(level=True, memory_mb=1200)
    assumes_independent_pixels = True
    storage = Storage(
        arrays={
            "axes": ("1", "eigenvectors of the covariance within clusters, columns"),
            "variance": ("1", "its eigenvalues"),
            "count": ("1", "stars of each cluster"),
            "rows": ("1", "rows of deviation of each cluster"),
            "mean": ("1", "mean image of each cluster, in the axes"),
            "mean_reference": ("1", "mean target of each cluster"),
            "deviation": ("1", "images less the mean of their cluster, in the axes"),
            "deviation_reference": ("1", "targets less the mean of their cluster"),
            "cross": ("1", "covariance of targets and images (in the axes) within clusters"),
            "variance_reference": ("1", "variance of targets within clusters"),
            "whitening": ("1", "to positions of unit variance within clusters"),
            "center": ("1", "mean whitened position of each cluster"),
            "deviation_center": ("1", "whitened positions less the mean of their cluster"),
            "slope": ("1", "common change of images (in the axes) with whitened position"),
            "slope_reference": ("1", "common change of targets with whitened position"),
            "shrinkage": ("1", "weight of the common covariance, in stars"),
        },
        per_reference=True,
    )
    packing: ClassVar[Packing | None] = Packing(batch_size=8192, is_padded=False)
    groups: ClassVar = {"gmm": Gmm}
    finds_flux = True

    @classmethod
    def fit(cls, data: TrainingSet, gmm: Gmm) -> Self:
        """Choose K, then ν, by the validation stars, and fit all training stars.

        Raises
        ------
        FitError
            If every K exceeds the number of stars.
        """
        # With a single value of K and of ν, nothing is chosen, and all stars are used for the fit.
        is_search = len(gmm.components) * len(gmm.shrinkage) > 1
        fit_rows, validation = (data.train, data.train[:0])
        if is_search:
            fit_rows, validation = data.fit, data.validation
        fit_rows = fit_rows[: gmm.stars]
        if is_search and not validation.size:
            # Without validation stars, every tenth training star is used as one.
            validation, fit_rows = fit_rows[::10], np.delete(fit_rows, np.s_[::10])
        # A cluster has at least one star.
        sizes = [k for k in gmm.components if k <= fit_rows.size]
        if not sizes:
            raise FitError(
                f"{next(iter(cls.groups))}.components = {gmm.components}: "
                f"must be at most {fit_rows.size}, the number of training stars"
                f"{' without the validation stars' if is_search else ''}"
            )
        # The final mixture is fitted to the validation stars, too.
        k, nu, uses_position = sizes[0], gmm.shrinkage[0], cls.needs.position
        if is_search:
            k, nu, uses_position = best_on_validation(
                lambda k, uses_position: cls.fit_clusters(
                    data, fit_rows, k, gmm.shrinkage[0], uses_position, gmm
                ),
                data,
                validation,
                sizes,
                gmm.shrinkage,
                cls,
            )
        return cls.fit_clusters(data, data.train[: gmm.stars], k, nu, uses_position, gmm)

    @classmethod
    def fit_clusters(
        cls, data: TrainingSet, stars: np.ndarray, k: int, nu: float, uses_position: bool, gmm: Gmm
    ) -> Self:
        """Fit the mixture to some of the stars, with or without their positions.

        Parameters
        ----------
        data : TrainingSet
            Images, targets (`references`) and positions of the stars.
        stars : ndarray of int
            Indices of the stars.
        k : int
            Number of clusters K.
        nu : float
            ν, the weight of the common covariance, as a number of stars.
        uses_position : bool
            True to use the positions; otherwise all stars have the same position.
        gmm : Gmm
            Settings of the clustering.
        """
        # Positions that are not used are 0, so that the arrays have the same shapes.
        p = np.empty((len(stars), 0))
        if cls.needs.position:
            p = data.positions[stars].astype(np.float64) * uses_position
        x = data.images[stars].reshape(stars.size, -1).astype(np.float64)
        cluster = k_means(x, p, k, gmm.principal, gmm.place, data.seed)
        del x  # Free the memory: `mixture_arrays` makes another copy, sorted by cluster.
        # Distributions of the clusters, and ν, which shrinks their covariances when they are used.
        arrays: dict[str, Any] = mixture_arrays(data, stars, p, cluster)
        return cls(**arrays, shrinkage=np.array([nu]), noise=data.noise)

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """Return a fit from its arrays, with the noise settings of the configuration."""
        noise = build_noise(config["noise"])
        # A bundle may have the deviations in half precision.
        fields: dict[str, Any] = {**arrays, "deviation": arrays["deviation"].astype(np.float32)}
        return cls(**fields, noise=noise)

    def export(self, stamp_px: int, noise: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the arrays for a bundle, and fields of its `BundleInfo`.

        If the targets are the images, the residuals of a cluster are replaced by its main axes,
        with a variance of at least `flat_variance` times the noise variance.
        """
        arrays, info_fields = super().export(stamp_px, noise)
        # Residuals of targets and positions belong to individual stars and cannot be replaced.
        if len(self.cross) or self.whitening.size:
            return arrays, info_fields
        # Coordinates below the minimum noise of the bundle are left out.
        main_axes, width = [], self.free_flux().count_distinct(noise**2)
        for cluster in self.clusters:
            # X = U a Vᵀ: the rows a Vᵀ have the same products as X.
            _, size, axis = np.linalg.svd(cluster.residuals[:, :width], full_matrices=False)
            is_main = cluster.residual_factor * size**2 > self.flat_variance * noise**2
            main_axes.append((size[:, None] * axis)[is_main])
        # Half precision rounds a residual by less than one part in 2000.
        arrays["rows"] = np.array([len(rows) for rows in main_axes])
        arrays["deviation"] = np.vstack(main_axes).astype(np.float16)
        arrays["deviation_center"] = np.empty((len(arrays["deviation"]), 0))
        return arrays, info_fields

    @classmethod
    def shapes(cls, info: BundleInfo) -> Mapping[str, tuple[int, ...] | None]:
        """Return the arrays of a bundle with their shapes; None for any shape."""
        # Shapes of the other arrays depend on the numbers of clusters and of their main axes.
        pixels = info.stamp_px**2
        return dict.fromkeys(cls.list_arrays()) | {"axes": (pixels, pixels), "variance": (pixels,)}

    @cached_property
    def outlier_mixture(self) -> Self:
        """The mixture in the leading `outlier_coordinates` alone (eq. 12)."""
        return self.keep_leading(self.outlier_coordinates)

    def outlier_score(
        self, noisy: np.ndarray, level: np.ndarray, near_clusters: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the outlier score in the leading `outlier_coordinates` (eq. 12).

        The other coordinates contain mostly noise, and the error of the estimated noise level would
        dominate their χ².
        """
        mixture = self.outlier_mixture
        # s of each image, as for the weights of the clusters (eq. 1).
        s = self.noise.variance(np.full(len(noisy), 1.0 / self.axes.shape[0]), np.asarray(level))
        # The normalisation of the density depends on the noise: −2 ln of the normalisation with the
        # common variances is subtracted.
        common = np.log(2 * np.pi * (mixture.total_variance + s[:, None])).sum(axis=1)
        # −2 ln Σ_k π_k N(z; μ_k, G_k), of batches of about the same noise.
        evidence = np.empty(len(noisy))
        for part, batch in star_batches(mixture, noisy, level):
            is_near = None if near_clusters is None else near_clusters[part]
            _, evidence[part] = cluster_weights(mixture, batch, is_near)
        return np.asarray(-2.0 * evidence - common)

    def free_flux(self) -> Self:
        """Return the mixture for images whose flux and sky are estimates (eq. 10)."""
        return replace(self, flux_sigma=FLUX_SIGMA)

    def flux(self, noisy: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the flux factor a of each image, and True for near clusters, (n, K) (eq. 11).

        The factor is the flux over the flux by which the image was divided; 1 for known fluxes.
        """
        flux = np.empty(len(noisy))
        is_near = np.zeros((len(noisy), len(self.count)), bool)
        for part, batch in star_batches(self, noisy, level):
            # `estimate` and `outlier_score` may skip clusters of weight 0.
            weight, _ = cluster_weights(self, batch)
            is_near[part] = weight > 0
            flux[part] = flux_factor(self, batch, weight)
        return flux, is_near

    def estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None = None,
        with_sigma: bool = True,
        near_clusters: np.ndarray | None = None,
    ) -> Estimate:
        """Return PSFs and their standard deviations, float32, and the ln evidence of each image.

        `near_clusters`, bool of shape (n, K), is True for the clusters to use; by default these are
        the nearest clusters by the common covariance.

        Raises
        ------
        ValueError
            If a pixel is not finite.
        """
        psf, sigma = (np.empty(noisy.shape, np.float32) for _ in range(2))
        evidence, flux = np.empty((2, len(noisy)))
        for part, batch in star_batches(self, noisy, level, position):
            is_near = None if near_clusters is None else near_clusters[part]
            # Weights of the clusters, then sums over the clusters (eq. 6, 7 and 8).
            weight, evidence[part] = cluster_weights(self, batch, is_near)
            mean, mean_sigma = posterior_mean(self, batch, weight, with_sigma)
            if self.flux_sigma:
                flux[part] = flux_factor(self, batch, weight)
                # The image is a x + (1 − a)/P: its sky (1 − a)/P is not part of the star.
                if self.restores_images:
                    mean += ((flux[part] - 1.0) / mean.shape[1])[:, None]
            psf[part], sigma[part] = (a.reshape(-1, *noisy.shape[1:]) for a in (mean, mean_sigma))
        # The flux is returned only if it was estimated.
        flux_or_none = flux if self.flux_sigma else None
        return Estimate(psf, sigma if with_sigma else None, evidence, flux_or_none)
