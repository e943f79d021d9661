"""Method `field`: a model of the PSF over the field, and the posterior of stars given this model.

The distribution of the stars is in `psfdae.methods.field_law`, and the posterior of a star in
`psfdae.methods.field_posterior`; here the distribution is fitted to bright stars, stored, and
applied to stamps. The mathematics is on the page docs/field_model.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np

from psfdae.base.errors import call
from psfdae.base.rng import stream
from psfdae.methods.field_errors import draw_field_stars, flux_error_over_field
from psfdae.methods.field_fit import FieldFit, FieldUncertainty
from psfdae.methods.field_law import FieldLaw, FieldSettings
from psfdae.methods.field_nodes import node_step
from psfdae.methods.field_pairs import FieldStamps
from psfdae.methods.field_posterior import log_node_prior, posterior_of_stamps
from psfdae.methods.field_residuals import MARGIN_PX, residual_covariance
from psfdae.methods.field_search import fit_field, refit_field
from psfdae.methods.interface import (
    Estimate,
    FitError,
    Look,
    Measured,
    Method,
    Needs,
    Packing,
    Storage,
    TrainingSet,
)
from psfdae.stars.bright_stars import BrightStars
from psfdae.stars.moments import measure_shapes
from psfdae.stars.noise import NoiseModel


@dataclass(frozen=True, eq=False, repr=False)
class FieldMixture(FieldLaw, Method):
    """Fitted model of a field, with the residuals of its stars.

    Attributes
    ----------
    uncertainty : FieldUncertainty
        Fields that are as likely as this one; none of a fit that was stored.
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
    attributes: ClassVar = {"usual": "mean_terms", "spread": "terms_covariance"}
    """Attributes of arrays that have another name in files."""
    packing = Packing(together=4096, padded=False)
    knows_field = True
    groups: ClassVar = {"field": FieldSettings}

    @classmethod
    def fit(cls, data: TrainingSet, field: FieldSettings) -> Self:
        """Fit the field to the training stars, and the covariance of what it leaves of them.

        Parameters
        ----------
        data : TrainingSet
        field : FieldSettings

        Raises
        ------
        FitError
            If there are no bright stars of an image.
        """
        if data.bright is None:
            raise FitError(
                "it learns from the bright stars of an image: "
                + call("psfdae.Stars.from_image", "psfdae train")
            )
        # The field is fitted in frames with a margin, so that residuals can be moved by 2 px.
        bright, side = data.bright.of(np.unique(data.star[data.train])), data.images.shape[-1]
        sizes, splines = (side + 2 * MARGIN_PX, side), (field.spacing_px, field.smoothness)
        rng = stream(data.seed, "noise", "field")
        bright = bright.of(stars_of_fit(bright.snr, sizes[0] ** 2, data.seed))
        fit = fit_field(bright, data.noise.background, *sizes, field.orders, *splines, rng)
        arrays = fitted_arrays(fit, bright, side, field)
        return cls(**arrays, noise=data.noise, settings=field, uncertainty=fit.uncertainty)

    def of_exposure(self, bright: BrightStars, background: float) -> Self:
        """Return this model for another exposure of the same field, refitted to its bright stars.

        The residuals of stars about the field stay those of the training, and so does the error of
        the star list if too few stars show that of the new one.

        Parameters
        ----------
        bright : BrightStars
        background : float
            Photons of the sky in a pixel.
        """
        # Few stars say how the field differs from that of the training (eq. 5).
        sizes = (self.side + 2 * MARGIN_PX, self.side, self.settings.smoothness)
        fit = refit_field(self.model, bright, background, *sizes)
        listed = fit.list_error(bright)
        return replace(
            self,
            coefficients=fit.model.coefficients.astype(np.float32),
            listed=listed if np.isfinite(listed).all() else self.listed,
        )

    @classmethod
    def restored(
        cls, arrays: Mapping[str, np.ndarray], config: Mapping[str, Any], reference: str
    ) -> Self:
        """Return the method of a bundle; noise and settings are those of the configuration.

        Settings that this release does not know are ignored: they affect the fit alone.
        """
        noise = NoiseModel(config["noise"]["kappa"], config["noise"]["background_photons"])
        # Modes may be in half precision; two arrays have older names in files.
        named: dict[str, Any] = {cls.attributes.get(n, n): array for n, array in arrays.items()}
        named["modes"] = arrays["modes"].astype(np.float32)
        supported = {k: v for k, v in config["field"].items() if k in FieldSettings.model_fields}
        settings = FieldSettings.model_validate(supported)
        return cls(**named, noise=noise, settings=settings)

    def stored_arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of a fit by their names in files."""
        return {name: getattr(self, self.attributes.get(name, name)) for name in self.stored()}

    def pack(self, stamp_px: int, noise: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the arrays for a bundle, and fields of its `BundleInfo`.

        Large stamps have fewer modes, in half precision; the variance of the others joins the
        diagonal.
        """
        arrays, info_fields = super().pack(stamp_px, noise)
        # Modes have two bytes a number, and 3 MB at most.
        phases, mode_count, pixels = self.modes.shape
        packed_count = min(mode_count, max(1, int(3e6 // (2 * phases * pixels))))
        arrays["diagonal"] = self.diagonal + np.square(self.modes[:, packed_count:]).sum(axis=1)
        arrays["modes"] = self.modes[:, :packed_count].astype(np.float16)
        # Bundles hold finite numbers: without a star list, its error is left out.
        arrays["listed"] = self.listed if self.has_list_error else np.empty((0, 2))
        return arrays, info_fields

    def draw_stars(
        self, count: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw noise-free stars of flux 1 at random places of the field and of a pixel.

        Returns images (n, d, d), positions (n, 2) to (n, 4), and centres (row, column) in a list;
        see `psfdae.methods.field_errors.draw_field_stars`.
        """
        images, position, centre = draw_field_stars(self, self.uncertainty, count, rng)
        return images, position, centre - self.list_offset

    def fitted_flux_error(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the error of a flux on a known sky, and how its variance grows over the field.

        See `psfdae.methods.field_errors.flux_error_over_field`.
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
        level : float or ndarray, shape (n,)
            Noise level λ.
        position : ndarray, shape (n, 2) to (n, 4), optional
            NaN where unknown.
        with_sigma : bool
            The standard deviations are there in either case: they cost little.

        Raises
        ------
        ValueError
            If a pixel is not finite.
        """
        count, pixels = len(noisy), noisy[0].size
        # A star's photons count as if they were spread evenly over the stamp.
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
            In any unit; the sky may be roughly subtracted.
        noise : ndarray, shape (n,)
            RMS of a pixel, all photons spread evenly.
        position : ndarray, shape (n, 2) to (n, 4), optional
            (x, y) in the field, magnitude and colour; NaN where unknown.
        centre : ndarray, shape (n, 2), optional
            (row, column) in a star list, from pixel (d//2, d//2); NaN where there is none.
        fixed : bool or ndarray of bool, shape (n,)
            The listed centres of these stars are exact.
        flux, sky : ndarray, shape (n,), optional
            Known values; NaN where they are to be measured.
        gain : ndarray, shape (n,), optional
            Electrons per unit of the stamps, by which the errors have the star's photons where they
            are; NaN where unknown.

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
        # Centres of the list in the coordinates of the field's centres; those that are exact.
        listed = (np.full((count, 2), np.nan) if centre is None else centre) + self.list_offset
        exact = np.where(np.broadcast_to(fixed, count)[:, None], listed, np.nan)
        sky_level = np.nan_to_num(sky)
        stars = FieldStamps(
            images=images - sky_level[:, None],
            noise=np.broadcast_to(noise, count),
            terms=terms,
            log_prior=log_node_prior(self, listed),
            flux=flux,
            sky_known=np.isfinite(sky),
            unit_per_electron=np.zeros(count) if gain is None else np.nan_to_num(1.0 / gain),
            cell_sigma_px=np.full(count, self.cell_sigma_px),
            unit=np.ones(count),
        )
        posterior = posterior_of_stamps(self, stars, position_known, exact)
        # Sky as it was in the stamps, and centres in the coordinates of the list.
        measured = Measured(
            flux=posterior.flux,
            background=posterior.sky + sky_level,
            centre=posterior.centre - self.list_offset,
            covariance=posterior.covariance,
        )
        return Estimate(
            psf=posterior.psf.reshape(stamps.shape).astype(np.float32),
            sigma=posterior.psf_sigma.reshape(stamps.shape).astype(np.float32),
            evidence=posterior.log_evidence,
            measured=measured,
            outlier_score=posterior.mahalanobis2,
        )


def stars_of_fit(
    snr: np.ndarray, frame_pixels: int, seed: int, most_pixels: float = 2e6
) -> np.ndarray:
    """Return the rows of the stars that a field is fitted to: all, unless their frames are large.

    Time and memory of a fit grow with the pixels of all stars. Where stars are well sampled, some
    hundred of them determine the field as well as thousands. They are drawn with chances that grow
    with their S/N, so that each part of the field and each magnitude has some.

    Parameters
    ----------
    snr : ndarray, shape (n,)
    frame_pixels : int
        Pixels of the frame of a star.
    seed : int
    most_pixels : float
        Pixels of all frames together, of which the fit takes about 1 GB.
    """
    count = int(most_pixels / frame_pixels)
    if len(snr) <= count:
        return np.arange(len(snr))
    chance = np.maximum(snr, 1.0)
    rng = stream(seed, "stars of the fit", "field")
    return np.sort(rng.choice(len(snr), count, replace=False, p=chance / chance.sum()))


def fitted_arrays(
    fit: FieldFit, bright: BrightStars, side: int, settings: FieldSettings
) -> dict[str, Any]:
    """Return the arrays of a `FieldLaw` that follow from a fit of the field.

    Parameters
    ----------
    fit : FieldFit
    bright : BrightStars
        Stars of the fit.
    side : int
        Side of a stamp in pixels.
    settings : FieldSettings
    """
    # Mean star and variation over the field are those of the stars that count.
    used = bright.of(fit.good)
    terms = fit.model.terms(used.place)
    mean_terms = terms.mean(axis=0)
    # Nodes are closer together where the mean star is narrow.
    mean_star = fit.model.images(mean_terms[None], np.zeros((1, 2)), side)
    step_px = node_step(float(measure_shapes(mean_star).fwhm_px[0]), settings.step_px)
    residual, centre, flux = (a[fit.good] for a in (fit.residual, fit.centre, fit.flux))
    shape = settings.modes, settings.diagonal
    offset, modes, diagonal = residual_covariance(
        residual, centre, used.noise / flux, step_px, *shape
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
        "listed": fit.list_error(bright),
    }
