"""Method `field`: a model of the PSF over the field, and the posterior of stars under this model.

The distribution of the stars is in `psfdae.methods.field.prior`, and the posterior of a
star in `psfdae.methods.field.posterior`. The class of this module fits the distribution to bright
stars, stores it and applies it to stamps. The mathematics is on the page docs/field_model.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np

from psfdae.base.errors import call
from psfdae.base.rng import stream
from psfdae.methods.field.errors import draw_field_stars, flux_error_over_field
from psfdae.methods.field.fit import FieldFit, FieldUncertainty
from psfdae.methods.field.nodes import node_step
from psfdae.methods.field.pairs import FieldStamps
from psfdae.methods.field.posterior import compute_posterior, log_node_prior
from psfdae.methods.field.prior import FieldPrior, FieldSettings
from psfdae.methods.field.residuals import MARGIN_PX, residual_covariance
from psfdae.methods.field.search import fit_field, refit_field
from psfdae.methods.interface import (
    Estimate,
    FitError,
    Look,
    Measurements,
    Method,
    Needs,
    Packing,
    Storage,
    TrainingSet,
)
from psfdae.stars.bright_stars import BrightStars
from psfdae.stars.moments import measure_shapes
from psfdae.stars.noise import build_noise


@dataclass(frozen=True, eq=False, repr=False)
class FieldMixture(FieldPrior, Method):
    """Fitted model of a field, with the residuals of its stars.

    Attributes
    ----------
    uncertainty : FieldUncertainty
        Fields that are as likely as this one; empty for a fit that was read from a file.
    measures_flux : bool
        `estimate` measures flux and sky; otherwise the flux is 1 and the sky 0.
    """

    uncertainty: FieldUncertainty = field(default_factory=FieldUncertainty)
    measures_flux: bool = False

    look = Look("field", "#117733", "D", title="field model")
    needs = Needs(level=True, position=True)
    storage = Storage(
        arrays={
            "coefficients": ("1", "splines of the field for each term of its polynomial"),
            "low": ("pixel", "least x, y; magnitude and colour if the PSF changes with them"),
            "high": ("pixel", "greatest, likewise"),
            "usual": ("1", "mean of the terms"),
            "spread": ("1", "their covariance"),
            "offset": ("1", "mean residual by phase"),
            "modes": ("1", "modes of the residuals by phase"),
            "diagonal": ("1", "variance of the residuals beyond their modes"),
            "listed": ("pixel", "mean and RMS of fitted less listed centres (row, column)"),
        },
        per_reference=True,
    )
    attributes: ClassVar = dict(usual="mean_terms", spread="terms_covariance", listed="list_error")
    """Names of attributes by the older names of their arrays in files."""
    packing = Packing(batch_size=4096, is_padded=False)
    knows_field = True
    assumes_independent_pixels = True
    groups: ClassVar = {"field": FieldSettings}

    @classmethod
    def fit(cls, data: TrainingSet, field: FieldSettings) -> Self:
        """Fit the field to the training stars, and the covariance of their residuals.

        Parameters
        ----------
        data : TrainingSet
            Training set with bright stars of an image.
        field : FieldSettings
            Settings of the field, its splines and its residuals.

        Raises
        ------
        FitError
            If there are no bright stars of an image.
        """
        if data.bright is None:
            raise FitError(
                "it is trained on the bright stars of an image: "
                + call("psfdae.Stars.from_image", "psfdae train")
            )
        # The field is fitted in frames with a margin, so that residuals can be shifted by 2 px.
        bright, side = data.bright.select(np.unique(data.star[data.train])), data.images.shape[-1]
        sizes, splines = (side + 2 * MARGIN_PX, side), (field.spacing_px, field.smoothness)
        rng = stream(data.seed, "noise", "field")
        bright = bright.select(select_fit_stars(bright.snr, sizes[0] ** 2, data.seed))
        fit = fit_field(bright, data.noise.background, *sizes, field.orders, *splines, rng)
        arrays = compute_arrays(fit, bright, side, field)
        return cls(**arrays, noise=data.noise, settings=field, uncertainty=fit.uncertainty)

    def refit_exposure(self, bright: BrightStars, background: float) -> Self:
        """Return this model for another exposure of the same field, refitted to its bright stars.

        The residuals of the training stars are kept. The error of their star list is kept, too, if
        the new stars are too few to measure the error of their list.

        Parameters
        ----------
        bright : BrightStars
            Bright stars of the other exposure.
        background : float
            Sky in photons per pixel, > 0.
        """
        # Few stars determine the difference from the field of the training (eq. 5).
        sizes = (self.side + 2 * MARGIN_PX, self.side, self.settings.smoothness)
        fit = refit_field(self.model, bright, background, *sizes)
        list_error = fit.list_error(bright)
        return replace(
            self,
            coefficients=fit.model.coefficients.astype(np.float32),
            list_error=list_error if np.isfinite(list_error).all() else self.list_error,
        )

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """Return the method of a bundle; the configuration has its noise and settings.

        Settings that this release does not know are ignored: they only affect the fit.
        """
        noise = build_noise(config["noise"])
        # Modes may be in half precision; three arrays have older names in files.
        fields: dict[str, Any] = {cls.attributes.get(n, n): array for n, array in arrays.items()}
        fields["modes"] = arrays["modes"].astype(np.float32)
        values = {k: v for k, v in config["field"].items() if k in FieldSettings.model_fields}
        settings = FieldSettings.model_validate(values)
        return cls(**fields, noise=noise, settings=settings)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of a fit by their names in files."""
        return {name: getattr(self, self.attributes.get(name, name)) for name in self.list_arrays()}

    def export(self, stamp_px: int, noise: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the arrays for a bundle, and fields of its `BundleInfo`.

        Bundles of large stamps have fewer modes, in half precision; the variance of the other modes
        is added to the diagonal.
        """
        arrays, info_fields = super().export(stamp_px, noise)
        # Modes take two bytes per number, and at most 3 MB.
        phases, mode_count, pixels = self.modes.shape
        packed_count = min(mode_count, max(1, int(3e6 // (2 * phases * pixels))))
        arrays["diagonal"] = self.diagonal + np.square(self.modes[:, packed_count:]).sum(axis=1)
        arrays["modes"] = self.modes[:, :packed_count].astype(np.float16)
        # Bundles hold finite numbers: without a star list, its error is left out.
        arrays["listed"] = self.list_error if self.has_list_error else np.empty((0, 2))
        return arrays, info_fields

    def draw_stars(
        self, count: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw noise-free stars of flux 1 at random positions in the field and in a pixel.

        Returns images (n, d, d), positions (n, 2) to (n, 4), and centres (row, column) in a list;
        see `psfdae.methods.field.errors.draw_field_stars`.
        """
        images, position, centre = draw_field_stars(self, self.uncertainty, count, rng)
        return images, position, centre - self.list_offset

    def estimate_flux_error(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the error of a flux on a known sky, and the growth of its variance over the field.

        See `psfdae.methods.field.errors.flux_error_over_field`.
        """
        return flux_error_over_field(self.model, self.uncertainty, self.side)

    def free_flux(self) -> Self:
        """Return the form of this method that measures flux and sky."""
        return replace(self, measures_flux=True)

    def estimate(
        self,
        noisy: np.ndarray,
        level: float | np.ndarray,
        position: np.ndarray | None = None,
        with_sigma: bool = True,
    ) -> Estimate:
        """Return PSFs, their standard deviation, and the evidence of every image.

        The images have flux 1 and no sky, unless this is the form of `free_flux`, which measures
        both.

        Parameters
        ----------
        noisy : ndarray, shape (n, d, d)
            Images of stars with noise.
        level : float or ndarray, shape (n,)
            Noise level λ.
        position : ndarray, shape (n, 2) to (n, 4), optional
            Coordinates x, y, magnitude and colour in the field; NaN where unknown.
        with_sigma : bool
            Ignored: standard deviations take little time and are always returned.

        Raises
        ------
        ValueError
            If a pixel is not finite.
        """
        count, pixels = len(noisy), noisy[0].size
        # Noise of the star's photons as if they were spread evenly over the stamp.
        even_star = np.full(count, 1.0 / pixels)
        noise = np.sqrt(self.noise.variance(even_star, np.asarray(level)))
        flux = None if self.measures_flux else np.ones(count)
        sky = None if self.measures_flux else np.zeros(count)
        return self.measure(noisy, noise, position, flux=flux, sky=sky)

    def measure(
        self,
        stamps: np.ndarray,
        noise: np.ndarray,
        position: np.ndarray | None = None,
        centre: np.ndarray | None = None,
        fixed: bool | np.ndarray = False,
        flux: np.ndarray | None = None,
        sky: np.ndarray | None = None,
        gain: np.ndarray | None = None,
    ) -> Estimate:
        """Return the posterior of PSF, flux, sky and centre of every star.

        Parameters
        ----------
        stamps : ndarray, shape (n, d, d)
            Images in any unit; the sky may be roughly subtracted.
        noise : ndarray, shape (n,)
            RMS noise of a pixel, with all photons spread evenly over the stamp.
        position : ndarray, shape (n, 2) to (n, 4), optional
            (x, y) in the field, magnitude and colour; NaN where unknown.
        centre : ndarray, shape (n, 2), optional
            (row, column) in a star list, from pixel (d//2, d//2); NaN where unknown.
        fixed : bool or ndarray of bool, shape (n,)
            True where the centre of the list is exact.
        flux, sky : ndarray, shape (n,), optional
            Known values; NaN where they are to be measured.
        gain : ndarray, shape (n,), optional
            Electrons per unit of the stamps, with which errors include the true distribution of the
            star's photons; NaN where unknown.

        Raises
        ------
        ValueError
            If a pixel is not finite, or the stamps have another size.
        """
        count = len(stamps)
        images = np.asarray(stamps, np.float64).reshape(count, -1)
        if images.shape[1] != self.side**2:
            raise ValueError(f"stamps of {images.shape[1]} px, expected {self.side**2}")
        if not np.isfinite(images).all():
            raise ValueError("stamps must be finite")
        unknown = np.full(count, np.nan)
        flux, sky = (unknown if a is None else a for a in (flux, sky))
        terms, position_known = self.terms(unknown[:, None] if position is None else position)
        # Centres of the list in the coordinates of the field, and the exact ones among them.
        list_px = (np.full((count, 2), np.nan) if centre is None else centre) + self.list_offset
        exact = np.where(np.broadcast_to(fixed, count)[:, None], list_px, np.nan)
        sky_level = np.nan_to_num(sky)
        stars = FieldStamps(
            images=images - sky_level[:, None],
            noise=np.broadcast_to(noise, count),
            terms=terms,
            log_prior=log_node_prior(self, list_px),
            flux=flux,
            sky_known=np.isfinite(sky),
            unit_per_electron=np.zeros(count) if gain is None else np.nan_to_num(1.0 / gain),
            cell_sigma_px=np.full(count, self.cell_sigma_px),
            unit=np.ones(count),
        )
        posterior = compute_posterior(self, stars, position_known, exact)
        # Sky of the original stamps, and centres in the coordinates of the list.
        measurements = Measurements(
            flux=posterior.flux,
            background=posterior.sky + sky_level,
            centre=posterior.centre - self.list_offset,
            covariance=posterior.covariance,
        )
        return Estimate(
            psf=posterior.psf.reshape(stamps.shape).astype(np.float32),
            sigma=posterior.psf_sigma.reshape(stamps.shape).astype(np.float32),
            evidence=posterior.log_evidence,
            measurements=measurements,
            outlier_score=posterior.mahalanobis2,
        )


def select_fit_stars(
    snr: np.ndarray, frame_pixels: int, seed: int, most_pixels: float = 2e6
) -> np.ndarray:
    """Return the indices of the stars for a fit of the field: all, unless their frames are large.

    Time and memory of a fit are proportional to the pixels of all stars. Where stars are well
    sampled, some hundred stars determine the field as well as thousands. They are drawn with a
    probability proportional to their S/N, from all parts of the field and all magnitudes.

    Parameters
    ----------
    snr : ndarray, shape (n,)
        S/N of the stars.
    frame_pixels : int
        Number of pixels in the frame of a star.
    seed : int
        Seed of the draw, ≥ 0.
    most_pixels : float
        Largest number of pixels in all frames, for which a fit takes about 1 GB.
    """
    count = int(most_pixels / frame_pixels)
    if len(snr) <= count:
        return np.arange(len(snr))
    chance = np.maximum(snr, 1.0)
    rng = stream(seed, "stars of the fit", "field")
    return np.sort(rng.choice(len(snr), count, replace=False, p=chance / chance.sum()))


def compute_arrays(
    fit: FieldFit, bright: BrightStars, side: int, settings: FieldSettings
) -> dict[str, Any]:
    """Compute the arrays of a `FieldPrior` from a fit of the field.

    Parameters
    ----------
    fit : FieldFit
        Model, residuals and centres of the fit.
    bright : BrightStars
        Stars of the fit.
    side : int
        Side of a stamp in pixels.
    settings : FieldSettings
        Settings of nodes and residuals.
    """
    # Mean star and variation over the field, from the stars that are not outliers.
    used_stars = bright.select(fit.good)
    terms = fit.model.terms(used_stars.coordinates)
    mean_terms = terms.mean(axis=0)
    # Nodes are closer together where the mean star is narrow.
    mean_star = fit.model.images(mean_terms[None], np.zeros((1, 2)), side)
    step_px = node_step(float(measure_shapes(mean_star).fwhm_px[0]), settings.step_px)
    residual, centre, flux = (a[fit.good] for a in (fit.residual, fit.centre, fit.flux))
    shape = settings.modes, settings.diagonal
    offset, modes, diagonal = residual_covariance(
        residual, centre, used_stars.noise / flux, step_px, *shape
    )
    return {
        "coefficients": fit.model.coefficients.astype(np.float32),
        "low": fit.model.low,
        "high": fit.model.high,
        "mean_terms": mean_terms,
        "terms_covariance": np.cov(terms.T, bias=True).reshape(len(mean_terms), -1),
        "offset": offset.astype(np.float32),
        "modes": modes.astype(np.float32),
        "diagonal": diagonal.astype(np.float32),
        "list_error": fit.list_error(bright),
    }
