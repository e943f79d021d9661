"""Fit of the PSF over the field to the bright stars of an image, with given options.

Weighted least squares for the splines of `psfdae.methods.field_spline` alternate with the flux and
the centre of every star (Gauss-Newton). Light is the same at all phases of the pixel grid: without
that condition, splines and fluxes could change with the phase against each other. Changes over the
field are as small a part of the wings as of the core, unless the stars say otherwise. Stars that
are unlike the others do not count, and pixels that are brighter or fainter than the model count
less: they may show a neighbour. `psfdae.methods.field_search` chooses the options, by stars
that were left out (`psfdae.methods.field_errors`). Equations are numbered as on the page
docs/field_model.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from psfdae.base.progress import Advance
from psfdae.methods.field_spline import (
    FieldModel,
    adjust_stars,
    compute_relative_light,
    deform_splines,
    draw_splines,
    field_terms,
    solve_splines,
    spacing_of,
)
from psfdae.stars.bright_stars import BrightStars
from psfdae.stars.moments import cubic_splines, robust_scatter, windowed_centres


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit of the field; the search compares fits that differ in one of these.

    Attributes
    ----------
    knots : int
        Number of knots along a side of the frame.
    smoothness : float
        Weight of the squared second differences of the coefficients, 1/flux².
    order : int
        Order of the polynomial in x and y.
    star_terms : tuple of int
        Numbers of the coordinates beyond x and y with which the PSF changes: 2 for the magnitude,
        3 for the colour.
    change : float
        Standard deviation of a coefficient about that of another exposure, over its value.
    tolerance : float
        Residual at which the conjugate gradients stop (`FitSettings.compared_tolerance`).
    """

    knots: int
    smoothness: float
    order: int
    star_terms: tuple[int, ...] = ()
    change: float = 0.0
    tolerance: float = 1e-4


@dataclass(frozen=True)
class FitSettings:
    """Numbers of the fit that were tuned on simulated fields.

    Attributes
    ----------
    rounds : int
        Rounds of splines, centres and fluxes; with more, centres follow what splines cannot.
    centre_steps, left_out_steps : int
        Gauss-Newton steps of a star in a round, and of a star that was left out.
    window_px, window_reach_px, wide_reach_px : float
        Width of the window of the first centroids, how far these may move, and how far if stars are
        rings, in pixels.
    model_error, min_error : float
        Error of the model over a pixel's light, which no polynomial follows; error of a pixel over
        the flux, at least.
    outlier_sigma, outlier_chi2 : float
        Residual of a pixel in σ from which it counts less, as it may show a neighbour; χ² over the
        median from which a star does not count.
    varying_smoothness : float
        Smoothness of terms beyond the constant, times that of the constant.
    ridge : float
        Weight of the squared coefficients in the first round, 1/flux².
    field_change, min_coefficient : float
        Standard deviation of a coefficient over the field, over its mean; and at least.
    varying_change : float
        Factor of the change between exposures of terms beyond the constant.
    folds, enough_stars : int
        Groups of stars of which one after the other is left out; from so many stars on that were
        predicted, the further groups are not.
    few_stars : int
        With fewer stars, their number limits the order of the polynomial.
    compared_tolerance : float
        `FitOptions.tolerance` of fits that are only compared: up to it, errors of stars left out
        hardly change.
    """

    rounds: int = 3
    centre_steps: int = 2
    left_out_steps: int = 5
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


class FieldUncertainty(NamedTuple):
    """Scatter of fields that are as likely as the fitted one; empty for a fit read from a file.

    Attributes
    ----------
    redrawn : sequence of FieldModel
        Fields that the same stars give with other noise.
    parted : sequence of FieldModel
        Fields that differ as those do that are fitted without one group of stars after the other.
    unknown_light : float
        Scatter of the light in stamps that the field takes for sky, over the flux.
    """

    redrawn: Sequence[FieldModel] = ()
    parted: Sequence[FieldModel] = ()
    unknown_light: float = 0.0


class FieldFit(NamedTuple):
    """Model of the PSF over the field, with flux, centre and residual of each star of its fit.

    Attributes
    ----------
    model : FieldModel
    options : FitOptions
        Those of the fit.
    flux : ndarray, shape (n,)
        In the unit of the images.
    centre : ndarray, shape (n, 2)
        (row, column) from index s//2.
    good : ndarray of bool, shape (n,)
        Stars that count.
    residual : ndarray, shape (n, s, s)
        Image less model of a star of flux 1; 0 where a pixel was not measured.
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
        """Return median and robust RMS of fitted less listed centres (row, column), shape (2, 2).

        NaN if fewer than five stars have a listed centre. The RMS is at least 0.05 px.
        """
        offset_px = (self.centre + stars.peak - stars.listed)[self.good]
        offset_px = offset_px[np.isfinite(offset_px).all(axis=1)]
        if len(offset_px) < 5:
            return np.full((2, 2), np.nan)
        scatter = np.maximum(robust_scatter(offset_px), 0.05)
        return np.stack([np.median(offset_px, axis=0), scatter])


@dataclass(frozen=True)
class FieldFitter:
    """Stars to which fields are fitted, and what is known of the field from other exposures.

    Attributes
    ----------
    images : ndarray, shape (n, s, s)
        Stars in frames about their brightest pixel.
    measured : ndarray of bool, shape (n, s, s)
    noise : ndarray, shape (n,)
        RMS of a pixel by the sky.
    photons : ndarray, shape (n,)
        Photons per unit of the images.
    place : ndarray, shape (n, 4)
        x, y, magnitude and colour.
    axis : ndarray, shape (s,)
        Coordinates of the pixels along a side of the frame.
    stamp_px, around_px : int
        Side of the stamps; number of pixels around a stamp, of which the sky is the median.
    window_px : float
        Width of the window of the first centroids.
    low, high : ndarray, shape (2,) to (4,)
        Range of the place.
    prior : FieldModel or None
        Field of another exposure.
    settings : FitSettings
    advance : callable
        Called with the number of fits that are done.
    """

    images: np.ndarray
    measured: np.ndarray
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
    def of(cls, stars: BrightStars, background: float, frame_px: int, stamp_px: int) -> FieldFitter:
        """Return the fitter of bright stars; for the parameters see `fit_field`."""
        # Range of each coordinate over the stars; (0, 0) for one that no star has.
        finite_columns = [column[np.isfinite(column)] for column in stars.place.T]
        ends = [
            (column.min(), column.max()) if column.size else (0.0, 0.0) for column in finite_columns
        ]
        low, high = np.transpose(ends)
        images, measured = stars.framed(frame_px)
        # A = 4πσ² of a Gaussian. A ring has no light in its middle: a window as wide as the radius
        # of all light does, 1.4 σ.
        sigma = float(np.sqrt(np.median(stars.area()) / (4.0 * np.pi)))
        return cls(
            images=images,
            measured=measured,
            noise=stars.noise,
            photons=np.sqrt(background) / stars.noise,
            place=stars.place,
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

    def fit(self, options: FitOptions) -> FieldFit:
        """Fit field, fluxes and centres to all stars by turns (eq. 2 to 4)."""
        settings, spacing = self.settings, spacing_of(len(self.axis), options.knots)
        # Coordinates that do not count have a range of no width; those at the end are left out.
        count = max((1, *options.star_terms)) + 1
        low, high = self.low[:count].copy(), self.high[:count].copy()
        for coordinate in range(2, count):
            if coordinate not in options.star_terms:
                high[coordinate] = low[coordinate]
        terms = field_terms(self.place, low, high, options.order)
        # First fluxes are the light in the frames, first centres centroids in a Gaussian window.
        good, flux = np.ones(len(terms), bool), self.images.sum(axis=(1, 2))
        start, window = np.zeros((len(flux), 2)), np.full(len(flux), self.window_px)
        is_usual = self.window_px == settings.window_px
        reach = settings.window_reach_px if is_usual else settings.wide_reach_px
        centre = windowed_centres(self.images, start, window, 4, reach)
        # Weights are those of a star's expected light, first that of the median star. Those of its
        # own pixels would be larger where noise makes them fainter, and light in the wings too
        # little (Humphrey, Liu & Buote 2009, ApJ 693, 822).
        light = np.median(self.images / flux[:, None, None], axis=0)
        robust_weight, noise = np.ones(self.images.shape), self.pixel_weight(flux, light)
        coefficients: np.ndarray | None = None
        for turn in range(settings.rounds):
            # Splines at given centres and fluxes (eq. 2), then centres and fluxes at given splines
            # (eq. 4).
            data = self.images / flux[:, None, None]
            weight = noise * robust_weight
            coefficients = self.fit_splines(
                options, terms, data, weight * good[:, None, None], centre, coefficients
            )
            splines = np.tensordot(terms, coefficients, 1)
            factor, centre, _ = adjust_stars(
                splines, data, weight, centre, self.axis, spacing, settings.centre_steps
            )
            # The mean star in the middle of its stamp has the sum 1: a factor of all splines is one
            # of all fluxes.
            middle = np.tensordot(terms.mean(axis=0)[None], coefficients, 1)
            sides = np.arange(self.stamp_px) - self.stamp_px // 2.0
            total = float(draw_splines(middle, sides, np.zeros((1, 2)), spacing).sum())
            coefficients, flux = coefficients / total, flux * factor * total
            splines = np.tensordot(terms, coefficients, 1)
            star_images = draw_splines(splines, self.axis, centre, spacing)
            # Each star has the sum 1 in the middle of its stamp, and as much light at every phase:
            # fluxes and splines could change with position and phase against each other (eq. 1a).
            in_middle = draw_splines(splines, sides, np.zeros((1, 2)), spacing)
            light = compute_relative_light(splines, np.zeros(1), centre, spacing)
            light *= in_middle.sum(axis=(1, 2), keepdims=True)
            flux, star_images = flux * light[:, 0, 0], star_images / light
            residual = np.where(self.measured, self.images / flux[:, None, None] - star_images, 0.0)
            # Outliers: pixels count less (Cauchy's weight), stars of a large χ² not at all. In the
            # first round, the field is not known well enough to tell stars.
            noise = self.pixel_weight(flux, star_images)
            square = residual**2 * noise
            chi2 = square.sum(axis=(1, 2)) / np.maximum(self.measured.sum(axis=(1, 2)), 1)
            robust_weight = 1.0 / (1.0 + square / settings.outlier_sigma**2)
            if turn:
                good = chi2 < settings.outlier_chi2 * np.median(chi2)
        assert coefficients is not None
        self.advance(1)
        model = FieldModel(coefficients, low, high, spacing)
        return FieldFit(model, options, flux, centre, good, residual)

    def pixel_weight(self, flux: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Return 1/variance w of pixels of flux 1 (eq. 3); 0 where not measured.

        `light` is that expected of stars of flux 1, of each (n, s, s) or of all (s, s).
        """
        # Noise, and the error (0.02 f)² + (10⁻⁵)² of the model.
        model_error = self.settings.model_error * np.maximum(light, 0.0)
        variance = self.pixel_variance(flux, light) + model_error**2 + self.settings.min_error**2
        return np.where(self.measured, 1.0 / variance, 0.0)

    def pixel_variance(self, flux: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Return the variance of pixels of stars of flux 1 by the sky and the star's photons."""
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
    ) -> np.ndarray:
        """Return coefficients (K, N, N) of weighted least squares at given centres (eq. 2, 5).

        Parameters
        ----------
        options : FitOptions
        terms : ndarray, shape (n, K)
        data, weight : ndarray, shape (n, s, s)
            Images of flux 1, and weights of their pixels.
        centre : ndarray, shape (n, 2)
        start : ndarray, shape (K, N, N), or None
            Coefficients of the round before.
        """
        # Stars without a pixel that counts add nothing.
        used = weight.any(axis=(1, 2))
        terms, data, weight, centre = terms[used], data[used], weight[used], centre[used]
        shape = (terms.shape[1], options.knots, options.knots)
        spacing, settings = spacing_of(len(self.axis), options.knots), self.settings
        # B-splines of the rows and columns of each star's frame, at its centre.
        rows, columns = (
            cubic_splines(self.axis[None] - centre[:, i, None], options.knots, spacing)
            for i in (0, 1)
        )
        # Smoothness η_k, ten times as large beyond the constant term, and the ridge ρ of the first
        # round.
        penalty = np.full((shape[0], 1, 1), settings.varying_smoothness * options.smoothness)
        penalty[0] = options.smoothness
        ridge, prior_coefficients = np.full(shape, settings.ridge), np.zeros(shape)
        if self.prior is not None:
            # Only the difference to the other exposure is fitted, after its stretch and blur.
            prior_coefficients = deform_splines(self.prior, terms, data, weight, (rows, columns))
            change = options.change * np.abs(prior_coefficients[0]) + settings.min_coefficient
            # ρ: a change by `options.change` of the coefficient is one σ.
            ridge[:] = 1.0 / change**2
            ridge[1:] /= settings.varying_change**2
            image = rows @ np.tensordot(terms, prior_coefficients, 1) @ columns.transpose(0, 2, 1)
            data = data - image
        elif start is not None:
            # Changes over the field are a part of the mean star of the round before.
            change = settings.field_change * np.abs(start[0]) + settings.min_coefficient
            ridge[1:] = 1.0 / change**2
        # Iterations begin at the coefficients of the round before.
        if start is not None:
            start = start - prior_coefficients
        change = solve_splines(
            terms, data, weight, (rows, columns), penalty, ridge, start, options.tolerance
        )
        return change + prior_coefficients
