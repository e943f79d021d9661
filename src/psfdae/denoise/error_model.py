"""Calibrated errors of a fitted method: errors of its PSFs, fluxes and centres.

Inputs: PSFs of stars with their noise over the flux, and which of noise, flux and sky was given.
Outputs: half-widths of intervals that hold 68 and 95 % of the errors. `psfdae.training.calibration`
computes an `ErrorModel` from stars that were held out of the training.

Errors of PSFs are per pixel and per noise level. They are not normally distributed: the rare star
that is unlike all others has far larger errors, and the root mean square then exceeds the
half-width of the interval that holds 68 % of them. Where a method gives a σ of every pixel,
half-widths are in units of this σ, which depends on the star: they scale it to the measured errors.

These half-widths are for known flux and sky. Where flux or sky are estimated, errors are larger,
and errors of bright pixels have another distribution: factors for each case, for the brightest
pixels and for the others, account for this.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from psfdae.denoise.flux_model import FluxModel
from psfdae.image.stamps import Stamps


class Estimated(IntEnum):
    """Case of a star: which of its flux and sky were estimated, because they were not given.

    A star with a given flux and an estimated sky has the errors of the case FLUX_AND_SKY.
    """

    NOTHING = 0
    FLUX = 1
    FLUX_AND_SKY = 2


class ModelErrors(NamedTuple):
    """Standard errors of measured stars due to errors of the PSF model, at any S/N.

    Attributes
    ----------
    flux : float
        Error of the flux over the flux, RMS over the field.
    sky : float
        Error of the sky in a pixel, over the flux.
    centre : float
        Error of the centre along each axis, in pixels.
    fitted_flux : float
        Error of the flux over the flux, RMS over the field, where the PSF is fitted and the sky is
        known from the whole image.
    middle : ndarray, shape (2,)
        Position (x₀, y₀) in the image, in pixels, from which the variance of a flux grows.
    growth : ndarray, shape (4,)
        Coefficients (a, b, c, d): the variance of a flux at the position (x, y) is v = a + b u² +
        c w² + d u² w² times its mean over the field, with u = x − x₀ and w = y − y₀ in pixels. By
        default v is 1 everywhere. Errors of sky and centre grow with the same √v.
    """

    flux: float = 0.0
    sky: float = 0.0
    centre: float = 0.0
    fitted_flux: float = 0.0
    middle: np.ndarray = np.zeros(2)
    growth: np.ndarray = np.eye(4)[0]

    def flux_factor(self, position: np.ndarray) -> np.ndarray:
        """Return √v, (n,): flux errors at positions (x, y), (n, 2), over their RMS over the field.

        1 where the position is not known (NaN).
        """
        # v = (a, b, c, d) · (1, u², w², u² w²).
        u2, w2 = np.square(position - self.middle).T
        terms = np.stack([np.ones(len(position)), u2, w2, u2 * w2])
        return np.where(np.isfinite(u2 + w2), np.sqrt(self.growth @ terms), 1.0)

    def add_to_covariance(
        self, covariance: np.ndarray, flux: np.ndarray, position: np.ndarray
    ) -> np.ndarray:
        """Add the errors of the PSF model to the covariances of measured stars.

        Parameters
        ----------
        covariance : ndarray, shape (n, 4, 4)
            Covariance of flux, sky, row and column, due to noise.
        flux : ndarray, shape (n,)
            Fluxes of the stars; negative ones are taken as 0.
        position : ndarray, shape (n, 2)
            Position (x, y) in the image; NaN where unknown.

        Returns
        -------
        ndarray, shape (n, 4, 4)
            Covariances due to noise and model. The variance of a number that was given stays
            almost 0.
        """
        # Standard errors due to the model: errors of flux and sky are proportional to the flux.
        positive_flux, zeros = np.maximum(flux, 0.0)[:, None], np.zeros((len(flux), 2))
        sigmas = positive_flux * [self.flux, self.sky], zeros + self.centre
        model_sigma = np.concatenate(sigmas, axis=1)
        model_sigma *= self.flux_factor(position)[:, None]
        # A method returns a number that was given with a σ far below any σ due to noise.
        variance = np.maximum(np.einsum("nii->ni", covariance), 0.0)
        limits = positive_flux * 1e-5, positive_flux * 1e-12, zeros + 1e-9
        known_sigma = np.concatenate(limits, axis=1)
        model_sigma[np.sqrt(variance) < known_sigma] = 0.0
        # Errors due to noise and model are independent, and the model's errors of the four numbers
        # are taken to be uncorrelated.
        return np.asarray(covariance + model_sigma[:, :, None] ** 2 * np.eye(4))


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """Errors of a fitted method at S levels of noise, for stamps of d × d pixels.

    Half-widths are in units of the flux, or of σ where the method gives a σ (`Estimate.sigma`).

    Attributes
    ----------
    noise : ndarray, shape (S,)
        Noise nodes, ascending: RMS of the sky noise in a pixel over the flux.
    half_width68 : ndarray, shape (S, d, d)
        Half-width that contains 68.27 % of the errors of a pixel.
    ratio95 : ndarray, shape (S,)
        Factor by which `half_width68` is multiplied to contain 95 % of the errors.
    scale68, scale95 : ndarray, shape (S, 2, 3, 2)
        Factors by which 68 % and 95 % half-widths are larger than for known flux and sky. Axes:
        node; noise given or estimated; the case of `Estimated`; faint or bright pixels
        (`brightest`).
    flux_scale : ndarray, shape (S,)
        Scatter of the flux over its standard error, where flux and sky are estimated.
    distance_limit : float
        99.9 % quantile of the distance of held-out stars (`mahalanobis`).
    outlier_limit : ndarray, shape (S,), or None
        99.9 % quantile of the outlier score of held-out stars, if the method has a score.
    noise_floor : float
        Noise over the flux that is added in quadrature to the noise of a star while its flux is
        measured, but not while it is denoised: errors of the PSF's shape would bias the flux.
    model_errors : ModelErrors
        Errors due to the PSF model, of stars whose flux and centre the method itself fits.
    """

    noise: np.ndarray
    half_width68: np.ndarray
    ratio95: np.ndarray
    scale68: np.ndarray
    scale95: np.ndarray
    flux_scale: np.ndarray
    distance_limit: float
    outlier_limit: np.ndarray | None = None
    noise_floor: float = 0.0
    model_errors: ModelErrors = field(default_factory=ModelErrors)

    @classmethod
    def build_uncalibrated(cls, noise: np.ndarray, half_width68: np.ndarray) -> ErrorModel:
        """Return errors whose factors are 1, and whose distance limit is 0."""
        unit_factor, scale = (
            np.ones(len(noise)),
            np.ones((len(noise), 2, len(Estimated), 2)),
        )
        return cls(noise, half_width68, unit_factor, scale, scale, unit_factor, distance_limit=0.0)

    @staticmethod
    def shapes(nodes: int, stamp_px: int) -> dict[str, tuple[int, ...]]:
        """Return the shapes of all arrays by name, for a number of nodes and the side of stamps."""
        # Node; noise given or estimated; case of flux and sky; faint or bright pixels.
        case_shape = (nodes, 2, len(Estimated), 2)
        return {
            "noise": (nodes,),
            "half_width68": (nodes, stamp_px, stamp_px),
            "ratio95": (nodes,),
            "scale68": case_shape,
            "scale95": case_shape,
            "flux_scale": (nodes,),
            "distance_limit": (),
            "outlier_limit": (nodes,),
            "noise_floor": (),
            "model": (10,),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> ErrorModel:
        """Build the errors from arrays with the names and shapes of `shapes`."""
        values: dict[str, Any] = dict(arrays)
        values |= {name: float(arrays[name]) for name in ("distance_limit", "noise_floor")}
        # The ten numbers of `ModelErrors`; the last six are `middle` and `growth`.
        model_numbers = values.pop("model")
        numbers = dict(zip(ModelErrors._fields, model_numbers[:4].tolist(), strict=False))
        model_errors = ModelErrors(**numbers, middle=model_numbers[4:6], growth=model_numbers[6:])
        return cls(**values, model_errors=model_errors)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all numbers as arrays: maps in float32, others in float64; no array for None."""
        # The reverse of `from_arrays`.
        values = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        values["model"] = np.hstack(values.pop("model_errors"))
        return {
            name: np.asarray(value, np.float32 if name == "half_width68" else np.float64)
            for name, value in values.items()
            if value is not None
        }

    def compute_half_widths(
        self, psf: np.ndarray, sigma: np.ndarray | None, noise: np.ndarray, stars: Stamps
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the half-widths of the errors of PSFs of flux 1, and the scale of flux errors.

        Both depend on which of noise, flux and sky of a star were estimated.

        Parameters
        ----------
        psf : ndarray, shape (n, d, d)
            Denoised PSFs of flux 1; their brightest pixels have their own factors.
        sigma : ndarray, shape (n, d, d), or None
            Standard deviation of each pixel from the method.
        noise : ndarray, shape (n,)
            RMS of the sky noise in a pixel over the flux.
        stars : Stamps
            Given flux, sky and noise; NaN where they were estimated.

        Returns
        -------
        half_width : ndarray, shape (n, d, d)
            Half-width of the interval that holds 68 % of the errors.
        ratio95 : ndarray, shape (n, 2)
            Factor by which it is multiplied to hold 95 %, for faint and for bright pixels.
        flux_scale : ndarray, shape (n,)
            Factor by which the standard error of the flux is multiplied.
        """
        # Errors of stars of known flux and sky, at this noise, in units of the method's σ.
        half_width = interpolate_at_noise(noise, self.noise, self.half_width68)
        if sigma is not None:
            half_width = half_width * sigma
        # The 95 % half-width over the 68 % half-width, at least 1.
        ratio95 = np.maximum(np.interp(noise, self.noise, self.ratio95), 1.0)
        # Factors of the case of each star, for faint and bright pixels, shape (n, 2).
        is_noise_estimated, is_flux_estimated, is_sky_estimated = (
            np.isnan(values) for values in (stars.noise, stars.flux, stars.background)
        )
        case = np.where(is_sky_estimated, Estimated.FLUX_AND_SKY, is_flux_estimated.astype(int))

        def interpolate_case(table: np.ndarray) -> np.ndarray:
            """Interpolate a table of all cases (S, 2, 3, 2) at the noise and case of each star."""
            values = interpolate_at_noise(noise, self.noise, table)
            return np.asarray(values[np.arange(len(noise)), is_noise_estimated.astype(int), case])

        # Each pixel has the factor of its brightness. Half-width of 95 % over the one of 68 %:
        # ratio95 · scale95 / scale68.
        scale68, scale95 = interpolate_case(self.scale68), interpolate_case(self.scale95)
        faint_scale, bright_scale = scale68.T.astype(np.float32)[:, :, None, None]
        half_width = half_width * np.where(brightest(psf), bright_scale, faint_scale)
        # The flux error was calibrated where both flux and sky are estimated.
        flux_scale = np.interp(noise, self.noise, self.flux_scale)
        flux_scale = np.where(is_flux_estimated & is_sky_estimated, flux_scale, 1.0)
        return half_width, ratio95[:, None] * scale95 / scale68, flux_scale

    def is_unlike_training(
        self, noise: np.ndarray, distance: np.ndarray, outlier_score: np.ndarray
    ) -> np.ndarray:
        """Return True for stars beyond the limits of distance or score; all of shape (n,)."""
        # The distance allows for the noise: it has one limit. A score has a limit at each node.
        is_unlike = distance > self.distance_limit
        if self.outlier_limit is not None:
            is_unlike |= outlier_score > np.interp(noise, self.noise, self.outlier_limit)
        return is_unlike


def interpolate_at_noise(noise: np.ndarray, nodes: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Interpolate maps or tables of errors linearly at the noise of each star.

    Interpolation is linear in the noise, not in its logarithm: an error is a floor plus a term that
    is about proportional to the noise. Outside the nodes, the nearest one is used.

    Parameters
    ----------
    noise : ndarray, shape (n,)
        RMS of the sky noise in a pixel over the flux.
    nodes : ndarray, shape (S,)
        Noise at which the maps were measured, ascending.
    maps : ndarray, shape (S, ...)
        Error of each pixel at the nodes, or other numbers, in any unit.

    Returns
    -------
    ndarray, shape (n, ...)
        Maps in their own unit; NaN where the noise is NaN.
    """
    noise = np.asarray(noise, dtype=np.float64)
    # Position among the nodes: the lower node, and the fraction of the way to the upper one.
    position = np.interp(noise, nodes, np.arange(len(nodes), dtype=np.float64))
    lower = np.where(np.isfinite(position), np.minimum(position, len(nodes) - 1), 0).astype(np.intp)
    upper = np.minimum(lower + 1, len(nodes) - 1)
    fraction = (position - lower).astype(maps.dtype).reshape(-1, *[1] * (maps.ndim - 1))
    # (1 − f) · lower map + f · upper map; a noise that is NaN has a fraction that is NaN.
    return np.asarray(maps[lower] * (1 - fraction) + maps[upper] * fraction)


def brightest(psf: np.ndarray) -> np.ndarray:
    """Return a mask of the brightest 8 % (20 of 256) of the pixels of each PSF (n, d, d).

    Errors of these pixels, the core, have other factors than errors of the many faint pixels.
    """
    # The threshold is the faintest of the bright pixels; pixels equal to it are bright, too.
    flat = psf.reshape(len(psf), -1)
    faint_count = flat.shape[1] - max(1, round(20 / 256 * flat.shape[1]))
    return psf >= np.partition(flat, faint_count, axis=1)[:, faint_count, None, None]


def mahalanobis(
    stamps: np.ndarray, noise: np.ndarray, model: FluxModel, components: int
) -> np.ndarray:
    """Return the distance of stars from the training set, along its leading eigenvectors.

    D² = Σ_k (e_kᵀ(x − m))² / (Λ_k + noise²) over the eigenvectors e_k with the largest eigenvalues
    Λ_k and the mean m: the distance of Mahalanobis (1936) with the noise of the star as part of the
    covariance. Without it, every faint star would be far from the mean. D² is about `components`
    for bright and for faint stars.

    Parameters
    ----------
    stamps : ndarray, shape (n, d, d)
        Sky-subtracted stamps of flux 1 with bad pixels filled, framed as the training stars.
    noise : ndarray, shape (n,)
        RMS of the sky noise in a pixel over the flux.
    model : FluxModel
        Mean and eigenvectors of the training stars.
    components : int
        Number of eigenvectors, `BundleInfo.components`.

    Returns
    -------
    ndarray, shape (n,), float64
        Distance D of each star.
    """
    # Scores along the eigenvectors, each over its standard deviation with the star's noise.
    deviations = stamps.reshape(len(stamps), -1) - model.mean
    scores = deviations @ model.basis[:, -components:]
    variance = model.variance[-components:] + np.asarray(noise, dtype=np.float64)[:, None] ** 2
    return np.asarray(np.sqrt((scores**2 / variance).sum(axis=1)))
