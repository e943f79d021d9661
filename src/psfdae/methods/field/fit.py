"""Fit of the PSF over the field to the bright stars of an image, with given options.

Weighted least squares for the splines of `psfdae.methods.field.spline` alternate with the flux and
the centre of every star (Gauss-Newton). The light of a star is the same at all phases of the pixel
grid: without this condition, splines and fluxes could compensate each other as functions of the
phase. A prior makes relative changes over the field as small in the wings as in the core. Stars
unlike the others get no weight, and pixels brighter or fainter than the model less weight, because
they may show a neighbour. `psfdae.methods.field.search` chooses the options by left-out stars
(`psfdae.methods.field.errors`). Equations are numbered as on the page docs/field_model.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np

from psfdae.base.progress import Advance
from psfdae.methods.field.spline import (
    FieldModel,
    adjust_stars,
    compute_relative_light,
    compute_spacing,
    deform_splines,
    draw_splines,
    field_terms,
    solve_splines,
)
from psfdae.stars.bright_stars import BrightStars
from psfdae.stars.moments import cubic_splines, find_centroids, robust_scatter


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit of the field; the search compares fits that differ in one option.

    Attributes
    ----------
    knots : int
        Number of knots along a side of the frame.
    smoothness : float
        Weight of the squared second differences of the coefficients, 1/flux².
    order : int
        Order of the polynomial in x and y.
    star_terms : tuple of int
        Indices of the coordinates after x and y with which the PSF changes: 2 for the magnitude,
        3 for the colour.
    change : float
        Relative standard deviation of a coefficient about its value in another exposure.
    tolerance : float
        Residual at which the conjugate gradients stop in the last round, relative to the right-hand
        side. 3e-4 leaves a χ² that is about 0.3 above its minimum.
    """

    knots: int
    smoothness: float
    order: int
    star_terms: tuple[int, ...] = ()
    change: float = 0.0
    tolerance: float = 3e-4


@dataclass(frozen=True)
class FitSettings:
    """Numbers of the fit that were tuned on simulated fields.

    Attributes
    ----------
    rounds : int
        Rounds of splines, centres and fluxes; with more rounds, centres fit residuals of splines.
    centre_steps, left_out_steps : int
        Gauss-Newton steps of a star in a round, and of a left-out star.
    window_px, window_reach_px, wide_reach_px : float
        Width of the window of the first centroids; their largest shift, and the same for stars that
        are rings, in pixels.
    model_error, min_error : float
        Error of the model that no polynomial follows, as a fraction of a pixel's light; smallest
        error of a pixel as a fraction of the flux.
    outlier_sigma, outlier_chi2 : float
        Residual in σ at which a pixel has half its weight, because it may show a neighbour; ratio
        of χ² to the median above which a star has no weight.
    varying_smoothness : float
        Ratio of the smoothness of terms that vary over the field to that of the constant term.
    ridge : float
        Weight of the squared coefficients in the first round, 1/flux².
    field_change, min_coefficient : float
        Relative standard deviation of a coefficient over the field, and its minimum.
    varying_change : float
        Factor of the change between exposures for terms that vary over the field.
    folds, enough_stars : int
        Groups of stars that are left out in turn; number of predicted stars after which further
        groups are skipped.
    few_stars : int
        Number of stars below which it limits the order of the polynomial.
    compared_tolerance : float
        `FitOptions.tolerance` of fits that are only compared: up to it, errors of left-out stars
        hardly change.
    early_tolerance : float
        Least tolerance of all rounds but the last. With 3e-3, a star whose pixels are off by 3 %
        is not seen among 40 stars.
    """

    rounds: int = 3
    centre_steps: int = 2
    left_out_steps: int = 3
    window_px: float = 1.2
    window_reach_px: float = 1.0
    wide_reach_px: float = 1.5
    model_error: float = 0.02
    min_error: float = 1e-5
    outlier_sigma: float = 3.0
    outlier_chi2: float = 8.0
    varying_smoothness: float = 10.0
    ridge: float = 10.0
    field_change: float = 0.5
    min_coefficient: float = 1e-5
    varying_change: float = 0.3
    folds: int = 5
    enough_stars: int = 300
    few_stars: int = 16
    compared_tolerance: float = 3e-3
    early_tolerance: float = 1e-3


class FieldUncertainty(NamedTuple):
    """Scatter of fields that are as likely as the fitted one; empty for a fit read from a file.

    Attributes
    ----------
    bootstrap : sequence of FieldModel
        Fields of the same stars with other noise.
    jackknife : sequence of FieldModel
        Fields that scatter as much as fits without each group of stars in turn.
    unknown_light : float
        Scatter of the light in stamps that the field mistakes for sky, as a fraction of the flux.
    """

    bootstrap: Sequence[FieldModel] = ()
    jackknife: Sequence[FieldModel] = ()
    unknown_light: float = 0.0


class FieldFit(NamedTuple):
    """Model of the PSF over the field, with flux, centre and residual of each star of its fit.

    Attributes
    ----------
    model : FieldModel
        Splines over the field.
    options : FitOptions
        Options of the fit.
    flux : ndarray, shape (n,)
        Flux of each star in the unit of the images.
    centre : ndarray, shape (n, 2)
        (row, column) from the middle pixel, s//2, of the frame.
    good : ndarray of bool, shape (n,)
        True for stars that are not outliers.
    residual : ndarray, shape (n, s, s)
        Image minus model of a star of flux 1; 0 where a pixel was not measured.
    uncertainty : FieldUncertainty
        Errors of the model, if they were measured.
    """

    model: FieldModel
    options: FitOptions
    flux: np.ndarray
    centre: np.ndarray
    good: np.ndarray
    residual: np.ndarray
    uncertainty: FieldUncertainty = FieldUncertainty()

    def list_error(self, stars: BrightStars) -> np.ndarray:
        """Return median and robust RMS of fitted minus listed centres (row, column), shape (2, 2).

        NaN if fewer than five stars have a centre in the list. The RMS is at least 0.05 px.
        """
        # Both are relative to the middle of the same stamp.
        offset_px = (self.centre + stars.peak - stars.listed)[self.good]
        offset_px = offset_px[np.isfinite(offset_px).all(axis=1)]
        if len(offset_px) < 5:
            return np.full((2, 2), np.nan)
        scatter = np.maximum(robust_scatter(offset_px), 0.05)
        return np.stack([np.median(offset_px, axis=0), scatter])


@dataclass(frozen=True)
class FieldFitter:
    """Stars to which fields are fitted, and the field of another exposure if there is one.

    Attributes
    ----------
    images : ndarray, shape (n, s, s)
        Stars in frames about their brightest pixel.
    is_valid : ndarray of bool, shape (n, s, s)
        True for measured pixels.
    noise : ndarray, shape (n,)
        RMS of the sky noise in a pixel.
    photons : ndarray, shape (n,)
        Photons per unit of the images, the gain g of each star.
    place : ndarray, shape (n, 4)
        x, y, magnitude and colour; NaN where unknown.
    axis : ndarray, shape (s,)
        Coordinates of the pixels along a side of the frame.
    stamp_px, around_px : int
        Side of the stamps; number of pixels around a stamp whose median is the sky.
    window_px : float
        Width of the window of the first centroids.
    low, high : ndarray, shape (2,) to (4,)
        Range of the coordinates `place`.
    prior : FieldModel or None
        Field of another exposure.
    settings : FitSettings
        Tuned constants of the fit.
    advance : callable
        Function that is called with the number of completed fits.
    """

    images: np.ndarray
    is_valid: np.ndarray
    noise: np.ndarray
    photons: np.ndarray
    place: np.ndarray
    axis: np.ndarray
    stamp_px: int
    around_px: int
    window_px: float
    low: np.ndarray
    high: np.ndarray
    prior: FieldModel | None = None
    settings: FitSettings = FitSettings()
    advance: Advance = lambda fits: None

    @classmethod
    def build(cls, stars: BrightStars, background: float, frame_px: int, stamp_px: int) -> Self:
        """Return the fitter of bright stars; for the parameters see `fit_field`.

        `background` is the number of photons of the sky in a pixel, by which the noise gives the
        gain.
        """
        # Range of each coordinate over the stars; (0, 0) for one that no star has.
        finite_columns = [column[np.isfinite(column)] for column in stars.coordinates.T]
        ends = [
            (column.min(), column.max()) if column.size else (0.0, 0.0) for column in finite_columns
        ]
        low, high = np.transpose(ends)
        images, is_valid = stars.cut_frames(frame_px)
        # σ from the noise-equivalent area of a Gaussian, A = 4πσ². A ring has no light in its
        # middle: it needs a window as wide as the radius of its light, 1.4 σ.
        sigma = float(np.sqrt(np.median(stars.area()) / (4.0 * np.pi)))
        return cls(
            images=images,
            is_valid=is_valid,
            noise=stars.noise,
            photons=np.sqrt(background) / stars.noise,  # σ = √B / g
            place=stars.coordinates,
            axis=np.arange(frame_px) - frame_px // 2.0,
            stamp_px=stamp_px,
            around_px=max(stars.stamps[0].size - stamp_px**2, 1),
            window_px=1.4 * sigma if sigma > 3.0 else FitSettings.window_px,
            low=low,
            high=high,
        )

    @property
    def in_stamp(self) -> np.ndarray:
        """Pixels along a side of the frame that are in the stamp, (s,) of bool."""
        return np.asarray(np.abs(self.axis + 0.5) < self.stamp_px / 2)

    def fit(self, options: FitOptions, start: FieldFit | None = None) -> FieldFit:
        """Fit field, fluxes and centres to all stars in alternation (eq. 2 to 4).

        Parameters
        ----------
        options : FitOptions
            Options of the splines.
        start : FieldFit, optional
            Fit of these stars with any options. The new one starts at its fluxes, centres and
            weights, and takes one round less.
        """
        settings, spacing = self.settings, compute_spacing(len(self.axis), options.knots)
        low, high = self.select_ranges(options.star_terms)
        terms = field_terms(self.place, low, high, options.order)
        coefficients: np.ndarray | None
        if start is None:
            # First fluxes are the light in the frames, centres centroids in a Gaussian window.
            good, flux = np.ones(len(terms), bool), self.images.sum(axis=(1, 2))
            origin, window = np.zeros((len(flux), 2)), np.full(len(flux), self.window_px)
            is_usual = self.window_px == settings.window_px
            reach = settings.window_reach_px if is_usual else settings.wide_reach_px
            centre = find_centroids(self.images, origin, window, 4, reach)
            # Weights w = 1/variance follow from the expected light of a star, first from the median
            # star. Weights from its own pixels would be larger where noise makes them fainter, and
            # would bias the wings (Humphrey, Liu & Buote 2009, ApJ 693, 822).
            light = np.median(self.images / flux[:, None, None], axis=0)
            robust_weight, pixel_weight = np.ones(self.images.shape), self.pixel_weight(flux, light)
            first_round, coefficients = 0, None
        else:
            good, flux, centre = start.good, start.flux, start.centre
            light = self.images / flux[:, None, None] - start.residual
            pixel_weight = self.pixel_weight(flux, light)
            robust_weight = self.robust_weight(start.residual, pixel_weight)
            first_round, coefficients = 1, start.model.coefficients
            if coefficients.shape != (terms.shape[1], options.knots, options.knots):
                coefficients = None
        # Sums of the B-splines over the pixels of a stamp along an axis, of a star in its middle.
        stamp_axis = np.arange(self.stamp_px) - self.stamp_px // 2.0
        middle = cubic_splines(stamp_axis, options.knots, spacing).sum(axis=0)
        # Centres and weights of the last round are still to come: the others need less accuracy.
        early = replace(options, tolerance=max(options.tolerance, settings.early_tolerance))
        for turn in range(first_round, settings.rounds):
            # Splines at given centres and fluxes (eq. 2), then centres and fluxes at given splines
            # (eq. 4).
            data = self.images / flux[:, None, None]
            weight = pixel_weight * robust_weight
            is_last = turn == settings.rounds - 1
            coefficients = self.fit_splines(
                options if is_last else early,
                terms,
                data,
                weight * good[:, None, None],
                centre,
                coefficients,
            )
            splines = np.tensordot(terms, coefficients, 1)
            factor, centre, _ = adjust_stars(
                splines, data, weight, centre, self.axis, spacing, settings.centre_steps
            )
            # The mean star in the middle of its stamp has the sum 1: a common factor is moved from
            # the splines to the fluxes.
            term_light = middle @ coefficients @ middle
            total = float(terms.mean(axis=0) @ term_light)
            coefficients, flux = coefficients / total, flux * factor * total
            splines = splines / total
            star_images = draw_splines(splines, self.axis, centre, spacing)
            # Each star has the sum 1 in the middle of its stamp, and the same light at every phase:
            # otherwise fluxes and splines could compensate each other (eq. 1a).
            relative_light = compute_relative_light(splines, np.zeros(1), centre, spacing)
            relative_light *= (terms @ term_light / total)[:, None, None]
            flux, star_images = flux * relative_light[:, 0, 0], star_images / relative_light
            residual = np.where(self.is_valid, self.images / flux[:, None, None] - star_images, 0.0)
            # Outliers: pixels get less weight, stars with a large χ² none. In the first round, the
            # field is not known well enough to reject stars.
            pixel_weight = self.pixel_weight(flux, star_images)
            robust_weight = self.robust_weight(residual, pixel_weight)
            chi2 = (residual**2 * pixel_weight).sum(axis=(1, 2))
            chi2 /= np.maximum(self.is_valid.sum(axis=(1, 2)), 1)
            if turn:
                good = chi2 < settings.outlier_chi2 * np.median(chi2)
        assert coefficients is not None
        self.advance(1)
        model = FieldModel(coefficients, low, high, spacing)
        return FieldFit(model, options, flux, centre, good, residual)

    def select_ranges(self, star_terms: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return `low` and `high` of x, y and the coordinates with which the PSF changes."""
        # Magnitude and colour, if the PSF does not change with them, get a range of zero width
        # before one with which it does, and are left out otherwise.
        count = max((1, *star_terms)) + 1
        low, high = self.low[:count].copy(), self.high[:count].copy()
        for coordinate in range(2, count):
            if coordinate not in star_terms:
                high[coordinate] = low[coordinate]
        return low, high

    def pixel_weight(self, flux: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Return 1/variance w of pixels of flux 1 (eq. 3); 0 where not measured.

        `light` is the expected light of stars of flux 1, of each (n, s, s) or of all (s, s).
        """
        # The variance of sky and photons, and (0.02 f)² + (10⁻⁵)² of the model's error.
        model_error = self.settings.model_error * np.maximum(light, 0.0)
        variance = self.pixel_variance(flux, light) + model_error**2 + self.settings.min_error**2
        return np.where(self.is_valid, 1.0 / variance, 0.0)

    def robust_weight(self, residual: np.ndarray, pixel_weight: np.ndarray) -> np.ndarray:
        """Return Cauchy's weight 1/(1 + r² w/3²) of pixels with residuals r and weights w."""
        return np.asarray(1.0 / (1.0 + residual**2 * pixel_weight / self.settings.outlier_sigma**2))

    def pixel_variance(self, flux: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Return the variance of pixels of stars of flux 1, due to sky and photons of the star."""
        # (σ/F)² + f / (g F), the first two terms of eq. 3.
        factor = 1.0 / flux[:, None, None]
        noise, photons = (a[:, None, None] for a in (self.noise, self.photons))
        return np.asarray((noise * factor) ** 2 + np.maximum(light, 0.0) * factor / photons)

    def fit_splines(
        self,
        options: FitOptions,
        terms: np.ndarray,
        data: np.ndarray,
        weight: np.ndarray,
        centre: np.ndarray,
        start: np.ndarray | None,
        preconditioners: list[np.ndarray] | None = None,
    ) -> np.ndarray:
        """Return coefficients (K, N, N) of weighted least squares at given centres (eq. 2, 5).

        Parameters
        ----------
        options : FitOptions
            Knots, smoothness and tolerance.
        terms : ndarray, shape (n, K)
            Terms of the field at the positions of the stars.
        data, weight : ndarray, shape (n, s, s)
            Images of flux 1, and weights of their pixels.
        centre : ndarray, shape (n, 2)
            Centres (row, column) from the middle pixel.
        start : ndarray, shape (K, N, N), or None
            Coefficients of the previous round.
        preconditioners : list of ndarray, optional
            See `solve_splines`.
        """
        # Stars without a pixel of positive weight do not contribute.
        has_weight = weight.any(axis=(1, 2))
        terms, data, weight, centre = (a[has_weight] for a in (terms, data, weight, centre))
        shape = (terms.shape[1], options.knots, options.knots)
        spacing, settings = compute_spacing(len(self.axis), options.knots), self.settings
        # B-splines of the rows and columns of each star's frame, at its centre.
        rows, columns = (
            cubic_splines(self.axis[None] - centre[:, i, None], options.knots, spacing)
            for i in (0, 1)
        )
        # Smoothness η_k, ten times as large for terms that vary over the field, and the ridge ρ of
        # the first round.
        penalty = np.full((shape[0], 1, 1), settings.varying_smoothness * options.smoothness)
        penalty[0] = options.smoothness
        ridge, prior_coefficients = np.full(shape, settings.ridge), np.zeros(shape)
        if self.prior is not None:
            # Only the difference from the other exposure is fitted, after a stretch and a blur.
            prior_coefficients = deform_splines(self.prior, terms, data, weight, (rows, columns))
            sigma = options.change * np.abs(prior_coefficients[0]) + settings.min_coefficient
            # ρ: a relative change of the coefficient by `options.change` is one σ.
            ridge[:] = 1.0 / sigma**2
            ridge[1:] /= settings.varying_change**2
            image = rows @ np.tensordot(terms, prior_coefficients, 1) @ columns.transpose(0, 2, 1)
            data = data - image
        elif start is not None:
            # Changes over the field are relative to the mean star of the previous round.
            sigma = settings.field_change * np.abs(start[0]) + settings.min_coefficient
            ridge[1:] = 1.0 / sigma**2
        # Iterations begin at the coefficients of the previous round, here minus the prior ones.
        if start is not None:
            start = start - prior_coefficients
        change = solve_splines(
            terms,
            data,
            weight,
            (rows, columns),
            penalty,
            ridge,
            start,
            options.tolerance,
            preconditioners,
        )
        return change + prior_coefficients
