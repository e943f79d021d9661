"""Errors of a fitted field: residuals of left-out stars, and other fields that are as likely.

Cross-validation in five folds: the splines are fitted without the stars of each fold in turn, and
flux, sky and centre of these stars are then fitted with the splines fixed. Their residuals are the
error by which `psfdae.methods.field.search` chooses the options of a fit. Apparent sky in their
stamps is light that the model does not contain.

Inputs: a fit and its stars. Outputs: a `FieldUncertainty`, fields that are as likely as the fitted
one. They give the error of a flux at each position in the field (`flux_error_over_field`) and
random stars with the uncertainty of the fit (`draw_field_stars`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from psfdae.methods.field.fit import FieldFit, FieldFitter, FieldUncertainty, FitOptions
from psfdae.methods.field.prior import FieldPrior
from psfdae.methods.field.spline import (
    FieldModel,
    adjust_stars,
    compute_spacing,
    draw_splines,
    field_terms,
    image_design,
)


class LeftOut(NamedTuple):
    """Stars that were left out of a fit, with their own fitted flux, sky and centre.

    Attributes
    ----------
    coefficients : ndarray, shape (K, N, N)
        Splines of the fit to the other stars.
    light : ndarray, shape (2, n)
        Apparent sky in their stamps over the flux, and its σ.
    residual, weight : ndarray, shape (n, d, d)
        Residuals of stars of flux 1; expected light of measured pixels, 0 for other pixels.
    """

    coefficients: np.ndarray
    light: np.ndarray
    residual: np.ndarray
    weight: np.ndarray

    def compute_squared_errors(self) -> np.ndarray:
        """Return the mean squared residual of each star, weighted by the light m in its pixels.

        By the inequality of Cauchy and Schwarz, Σ m δ² limits the error Σ m δ / Σ m² of a flux due
        to residuals δ.
        """
        # Σ m δ² / Σ m of each star.
        return np.asarray(
            (self.residual**2 * self.weight).sum(axis=(1, 2)) / self.weight.sum(axis=(1, 2))
        )


def left_out_stars(
    fitter: FieldFitter, fit: FieldFit, options: FitOptions | None = None
) -> Iterator[LeftOut]:
    """Yield the stars of each fold in turn, with the prediction from the other stars.

    Some of the folds are enough if there are many stars. Splines are fitted without the stars of
    the fold, at the fluxes and centres of the fit.

    Parameters
    ----------
    fitter : FieldFitter
        Stars of the fit.
    fit : FieldFit
        Fit that has their fluxes, centres and weights.
    options : FitOptions, optional
        Options of the splines that are fitted; by default the options of the fit. All options are
        compared on the same stars, of the same weights.
    """
    settings, model = fitter.settings, fit.model
    terms, coefficients = model.terms(fitter.place), model.coefficients
    data = fitter.images / fit.flux[:, None, None]
    star_images = model.images(terms, fit.centre, len(fitter.axis))
    # Weights of pixels as at the end of the fit, lower for pixels of neighbours (eq. 3).
    weight = fitter.pixel_weight(fit.flux, star_images)
    noise = fitter.pixel_variance(fit.flux, star_images)
    weight *= fitter.robust_weight(fit.residual, weight)
    good_weight = weight * fit.good[:, None, None]
    # Splines begin at the splines of the fit, or of other options fitted to all stars.
    if options is None:
        options = fit.options
    else:
        ranges = fitter.select_ranges(options.star_terms)
        terms = field_terms(fitter.place, *ranges, options.order)
        coefficients = fitter.fit_splines(options, terms, data, good_weight, fit.centre, None)
        fitter.advance(1)
    spacing = compute_spacing(len(fitter.axis), options.knots)
    fold, judged_stars = np.arange(len(terms)) % settings.folds, 0
    preconditioners: list[np.ndarray] = []
    # Errors are computed in the stamps that a model restores.
    axis = fitter.axis[fitter.in_stamp]
    box = np.ix_(np.arange(len(terms)), fitter.in_stamp, fitter.in_stamp)
    for left_out in range(settings.folds):
        rows = np.flatnonzero((fold == left_out) & fit.good)
        if not len(rows):
            continue
        # Splines without the stars of this fold.
        fold_weight = good_weight * (fold != left_out)[:, None, None]
        fold_coefficients = fitter.fit_splines(
            options, terms, data, fold_weight, fit.centre, coefficients, preconditioners
        )
        images, is_valid = data[box][rows], fitter.is_valid[box][rows].astype(float)
        splines = np.tensordot(terms[rows], fold_coefficients, 1)
        # Flux, centre and sky of the stars for these splines; all pixels have the same weight.
        start, steps = fit.centre[rows], settings.left_out_steps
        flux, centre, sky = adjust_stars(
            splines, images, is_valid, start, axis, spacing, steps, sky=True
        )
        predicted_images = draw_splines(splines, axis, centre, spacing)
        # The sky b of weighted least squares with the design D of flux, row, column and sky is
        # W x with W = (Dᵀ w D)⁻¹ Dᵀ w. Its error contains the noise of the pixels and the error of
        # the median around the star, which was subtracted from them.
        design = image_design(splines, centre, axis, spacing, sky=True)
        adjoint = design * weight[box][rows].reshape(len(rows), 1, -1)
        influence = np.linalg.solve(adjoint @ design.transpose(0, 2, 1), adjoint)[:, 3]
        level = (influence * images.reshape(len(rows), -1)).sum(axis=1)
        variance = (influence**2 * noise[box][rows].reshape(len(rows), -1)).sum(axis=1)
        variance += np.pi / 2 * (fitter.noise / fit.flux)[rows] ** 2 / fitter.around_px
        yield LeftOut(
            coefficients=fold_coefficients,
            light=len(axis) ** 2 / flux * [level, np.sqrt(variance)],
            residual=(images - sky[:, None, None]) / flux[:, None, None] - predicted_images,
            weight=is_valid * np.maximum(star_images[box][rows], 0.0),
        )
        judged_stars += len(rows)
        if judged_stars >= settings.enough_stars:
            break


def left_out_error(fitter: FieldFitter, fit: FieldFit) -> float:
    """Return the geometric mean of the squared errors of stars that were left out of a fit.

    Flux, sky and centre of these stars are fitted.
    """
    # The geometric mean gives faint and bright stars the same influence.
    errors = [np.log(part.compute_squared_errors()) for part in left_out_stars(fitter, fit)]
    return float(np.exp(np.concatenate(errors).mean()))


def field_uncertainty(
    fitter: FieldFitter, fit: FieldFit, rng: np.random.Generator
) -> FieldUncertainty:
    """Return the uncertainty of the model of a fit.

    Four other fits, to noise-free stars of the model with new noise, scatter by the error of
    the field (parametric bootstrap: Efron & Tibshirani 1993, An Introduction to the Bootstrap,
    ch. 6.5). Light that the model does not contain appears as sky in left-out stars.
    """
    # Light that is mistaken for sky in left-out stars, and its σ. Only differences of fields are
    # used, which need less accuracy than the field.
    settings = fitter.settings
    less_accurate = replace(fit.options, tolerance=settings.early_tolerance)
    parts = list(left_out_stars(fitter, fit._replace(options=less_accurate)))
    light = np.concatenate([part.light for part in parts], axis=1)
    # Delete-group jackknife (Kott 2001, J. Off. Stat. 17, 521): without each of K folds in turn,
    # fields scatter by 1/√(K − 1) of their error. The scatter is larger where a fit of p terms
    # follows its own n stars, hence the factor 1 − p/n.
    fields = np.array([part.coefficients for part in parts])
    fitted_share = min(fields.shape[1] / len(fitter.noise), 1.0)
    fields = (fields - fields.mean(axis=0)) * np.sqrt((len(fields) - 1) * (1.0 - fitted_share))
    jackknife = [replace(fit.model, coefficients=fit.model.coefficients + f) for f in fields]
    # Noise-free images F m of the stars, and the variance of their pixels: sky and photons.
    stars = fit.model.images(fit.model.terms(fitter.place), fit.centre, len(fitter.axis))
    sigma = np.sqrt(fitter.pixel_variance(fit.flux, stars))
    options = replace(fit.options, tolerance=settings.compared_tolerance)
    bootstrap, all_good = [], np.ones_like(fit.good)
    for _ in range(4):
        # The fits start at the truth.
        noise = np.where(fitter.is_valid, sigma * rng.normal(size=stars.shape), 0.0)
        start = fit._replace(good=all_good, residual=noise)
        images = np.where(fitter.is_valid, stars, 0.0) + noise
        noisy_fitter = replace(fitter, images=images * fit.flux[:, None, None])
        bootstrap.append(noisy_fitter.fit(options, start).model)
    return FieldUncertainty(tuple(bootstrap), tuple(jackknife), excess_scatter(*light))


def excess_scatter(values: np.ndarray, sigma: np.ndarray) -> float:
    """Return the most probable scatter τ of values (n,) about 0 in excess of their errors σ (n,).

    It solves Σ (e²/(σ² + τ²) − 1) / (σ² + τ²) = 0, where e² ≤ 9 (σ² + τ²) limits outliers. The
    result is 0 for fewer than five values.
    """
    from scipy.optimize import brentq

    def slope(scatter: float) -> float:
        # Derivative of ln likelihood with respect to τ², with outliers cut at 3 σ.
        total = sigma**2 + scatter**2
        return float(((np.minimum(values**2 / total, 9.0) - 1.0) / total).sum())

    if len(values) < 5 or slope(0.0) <= 0:
        return 0.0
    # Above three times the largest value, the slope is negative.
    upper_end = 3.0 * float(np.abs(values).max())
    return float(brentq(slope, 0.0, upper_end))


def draw_field_stars(
    prior: FieldPrior, uncertainty: FieldUncertainty, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw noise-free stars of flux 1 at random positions in the field and in a pixel.

    Each is drawn from one of the bootstrap fields, with a residual of the prior and with light that
    the field mistakes for sky. The scatter of the stars therefore contains the errors of the fit.

    Returns
    -------
    images : ndarray, shape (count, d, d)
        Stars of sum 1.
    position : ndarray, shape (count, 2) to (count, 4)
        x, y, magnitude and colour, uniform over the range of the training stars.
    centre : ndarray, shape (count, 2)
        (row, column) from pixel (d//2, d//2), in the coordinates of the field's centres.
    """
    # Positions over the range of the training stars, and phases over a pixel.
    fields, side = uncertainty.bootstrap or (prior.model,), prior.side
    position = rng.uniform(prior.low, prior.high, (count, len(prior.low)))
    centre = rng.uniform(-0.5, 0.5, (count, 2))
    # Images of the stars, which take the fields in turn.
    images = np.empty((count, side, side))
    for number, field in enumerate(fields):
        rows = slice(number, None, len(fields))
        images[rows] = field.images(field.terms(position[rows]), centre[rows], side)
    images /= images.sum(axis=(1, 2), keepdims=True)
    # The residual e ~ N(e₀, C) at the phase of the centre: modes and diagonal (eq. 6).
    for number in range(count):
        offset, modes, variance = prior.residuals_at(centre[number])
        residual = offset + rng.normal(size=len(modes)) @ modes
        residual = residual + rng.normal(size=len(variance)) * np.sqrt(variance)
        images[number] += residual.reshape(side, side)
    # Light that looks like sky.
    images += uncertainty.unknown_light * rng.normal(size=(count, 1, 1)) / side**2
    images /= images.sum(axis=(1, 2), keepdims=True)
    return images, position, centre


def flux_error_over_field(
    model: FieldModel, uncertainty: FieldUncertainty, side: int
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the relative error of the flux of a star on a known sky, due to errors of the field.

    For a star m' of another field, the model m gives the flux Σ m m' / Σ m². The variance is the
    sum of two parts: fields with other noise, and fields of other stars, which include the effect
    of neighbours. Each part alone is too small for bright stars (`test_stated_errors.py`), because
    none of the fields contains structure that the polynomial cannot follow.

    Parameters
    ----------
    model : FieldModel
        Fitted field.
    uncertainty : FieldUncertainty
        Fields that are as likely.
    side : int
        Side of a stamp in pixels.

    Returns
    -------
    error : float
        RMS over the field; 0 for a fit that was read from a file.
    middle : ndarray, shape (2,)
        x and y in the middle of the field; 0 for a fit that was read from a file.
    growth : ndarray, shape (4,)
        Coefficients a, b, c, d of the variance over its mean, a + b u² + c w² + d u² w², at the
        distances u and w from the middle along x and y: towards the edge of the field, fewer stars
        determine the PSF. They are 1, 0, 0, 0 for a fit that was read from a file.
    """
    from scipy.optimize import nnls

    # 5 × 5 positions over the field; magnitude and colour are in the middle of their range.
    axes = np.linspace(model.low[:2], model.high[:2], 5).T
    place = np.full((25, 4), np.nan)
    place[:, :2] = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)

    def draw_psfs(field_model: FieldModel) -> np.ndarray:
        images = field_model.images(field_model.terms(place), np.zeros((1, 2)), side)
        return np.asarray(images / images.sum(axis=(1, 2), keepdims=True))

    psf = draw_psfs(model)

    def variance(models: Sequence[FieldModel]) -> np.ndarray:
        """Return the mean squared error of the flux at each position, (25,)."""
        # Σ m m' / Σ m² − 1 of each field m', squared and averaged over the fields.
        flux = [(psf * draw_psfs(field_model)).sum(axis=(1, 2)) for field_model in models]
        ratio = flux / np.square(psf).sum(axis=(1, 2))
        return np.asarray(np.square(ratio - 1.0).mean(axis=0))

    # Mean over the field by the trapezoidal rule: positions at an edge have half the weight.
    samples = [models for models in (uncertainty.bootstrap, uncertainty.jackknife) if models]
    total = np.sum([variance(models) for models in samples], axis=0)
    edge = np.array([0.5, 1.0, 1.0, 1.0, 0.5]) / 4.0
    mean = float(total @ np.outer(edge, edge).ravel()) if samples else 0.0
    if not mean > 0:
        return 0.0, np.zeros(2), np.eye(4)[0]
    # v = a + b u² + c w² + d u² w² by non-negative least squares, because the fields are few. u²
    # and w² are relative to the farthest positions, or to 1e-6 px² if all positions are the same.
    middle = axes.mean(axis=1)
    u2, w2 = np.square(place[:, :2] - middle).T
    unit = np.maximum(np.square(axes[:, -1] - middle), 1e-6)
    terms = np.stack([np.ones(25), u2 / unit[0], w2 / unit[1], u2 * w2 / unit.prod()], axis=1)
    growth = nnls(terms, total / mean)[0] / [1.0, *unit, unit.prod()]
    return float(np.sqrt(mean)), middle, growth
