"""Errors of a fitted field: stars that were left out, and other fields that are as likely.

Cross-validation in five folds: the splines are fitted without the stars of one fold after the
other, and flux, sky and centre of these stars are then fitted to them. What is left of them is the
error by which `psfdae.methods.field_search` chooses the options of a fit; what looks like sky in
their stamps is light that the model does not know.

In go a fit and the stars that it was made of; out comes a `FieldUncertainty`, fields that are as
likely as the fitted one. From these follow the error of a flux at each place of the field
(`flux_error_over_field`) and stars as they may really be (`draw_field_stars`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from psfdae.methods.field_fit import FieldFit, FieldFitter, FieldUncertainty
from psfdae.methods.field_law import FieldLaw
from psfdae.methods.field_spline import FieldModel, adjust_stars, image_design


class LeftOut(NamedTuple):
    """Stars that were left out of a fit, with flux, sky and centre fitted to them.

    Attributes
    ----------
    coefficients : ndarray, shape (K, N, N)
        Splines of the fit to the other stars.
    light : ndarray, shape (2, n)
        What looks like sky in their stamps, over the flux, and its σ.
    residual, weight : ndarray, shape (n, d, d)
        Residuals of stars of flux 1; expected light of pixels that were measured, else 0.
    """

    coefficients: np.ndarray
    light: np.ndarray
    residual: np.ndarray
    weight: np.ndarray

    def squared_errors(self) -> np.ndarray:
        """Return the mean squared residual of each star, weighted by the light m in its pixels.

        By Cauchy and Schwarz, the error Σ m δ / Σ m² of a flux by residuals δ is at most that of
        Σ m δ².
        """
        return np.asarray(
            (self.residual**2 * self.weight).sum(axis=(1, 2)) / self.weight.sum(axis=(1, 2))
        )


def left_out_stars(fitter: FieldFitter, fit: FieldFit) -> Iterator[LeftOut]:
    """Yield the stars of one fold after the other, as the others predict them.

    Of many stars, some folds are enough. Splines are fitted without these stars, to the fluxes
    and centres of the fit.
    """
    settings, spacing = fitter.settings, fit.model.spacing
    terms = fit.model.terms(fitter.place)
    data = fitter.images / fit.flux[:, None, None]
    star_images = fit.model.images(terms, fit.centre, len(fitter.axis))
    # Weights of pixels as at the end of the fit, neighbours' pixels less (eq. 3).
    weight = fitter.pixel_weight(fit.flux, star_images)
    noise = fitter.pixel_variance(fit.flux, star_images)
    weight /= 1.0 + fit.residual**2 * weight / settings.outlier_sigma**2
    fold, judged_stars = np.arange(len(terms)) % settings.folds, 0
    # Stars are judged in the stamps that a model restores.
    axis = fitter.axis[fitter.in_stamp]
    box = np.ix_(np.arange(len(terms)), fitter.in_stamp, fitter.in_stamp)
    for left_out in range(settings.folds):
        # Splines without the stars of this fold, from those of the fit.
        used = weight * ((fold != left_out) & fit.good)[:, None, None]
        coefficients = fitter.fit_splines(
            fit.options, terms, data, used, fit.centre, fit.model.coefficients
        )
        judged = np.flatnonzero((fold == left_out) & fit.good)
        if not len(judged):
            continue
        images, is_measured = data[box][judged], fitter.measured[box][judged].astype(float)
        splines = np.tensordot(terms[judged], coefficients, 1)
        # Flux, centre and sky that the star needs under these splines; all pixels count alike.
        start, steps = fit.centre[judged], settings.left_out_steps
        flux, centre, residual = adjust_stars(
            splines, images, is_measured, start, axis, spacing, steps, sky=True
        )
        # The sky b of weighted least squares with the design D of flux, row, column and sky is
        # W x with W = (Dᵀ w D)⁻¹ Dᵀ w. Its error has the noise of the pixels, and that of the
        # median around the star which was subtracted from them.
        design = image_design(splines, centre, axis, spacing, sky=True)
        turned = design * weight[box][judged].reshape(len(judged), 1, -1)
        influence = np.linalg.solve(turned @ design.transpose(0, 2, 1), turned)[:, 3]
        level = (influence * images.reshape(len(judged), -1)).sum(axis=1)
        variance = (influence**2 * noise[box][judged].reshape(len(judged), -1)).sum(axis=1)
        variance += np.pi / 2 * (fitter.noise / fit.flux)[judged] ** 2 / fitter.around_px
        yield LeftOut(
            coefficients=coefficients,
            light=len(axis) ** 2 / flux * [level, np.sqrt(variance)],
            residual=residual,
            weight=is_measured * np.maximum(star_images[box][judged], 0.0),
        )
        judged_stars += len(judged)
        if judged_stars >= settings.enough_stars:
            break


def left_out_error(fitter: FieldFitter, fit: FieldFit) -> float:
    """Return the geometric mean of the squared errors of stars that were left out of a fit.

    Flux, sky and centre of these are fitted to them.
    """
    errors = [np.log(part.squared_errors()) for part in left_out_stars(fitter, fit)]
    return float(np.exp(np.concatenate(errors).mean()))


def field_uncertainty(
    fitter: FieldFitter, fit: FieldFit, rng: np.random.Generator
) -> FieldUncertainty:
    """Return what the stars of a fit say of the errors of its model.

    Four other fits, to noise-free stars of the model with new noise, scatter as much as the
    field is uncertain (parametric bootstrap: Efron & Tibshirani 1993, An Introduction to the
    Bootstrap, ch. 6.5). Light that the model does not know is the sky that stars which were
    left out seem to have.
    """
    # Light that is taken for sky in stars that were left out, and its σ.
    parts = list(left_out_stars(fitter, fit))
    light = np.concatenate([part.light for part in parts], axis=1)
    # Delete-group jackknife (Kott 2001, J. Off. Stat. 17, 521): without one of K folds after
    # the other, fields scatter by 1/√(K − 1) of their error, and by more the more a fit of p
    # terms follows its own n stars.
    fields = np.array([part.coefficients for part in parts])
    followed = min(fields.shape[1] / len(fitter.noise), 1.0)
    fields = (fields - fields.mean(axis=0)) * np.sqrt((len(fields) - 1) * (1.0 - followed))
    parted = [replace(fit.model, coefficients=fit.model.coefficients + f) for f in fields]
    # Noise-free images F m of the stars, and the variance of their pixels: sky and photons.
    stars = fit.model.images(fit.model.terms(fitter.place), fit.centre, len(fitter.axis))
    stars = stars * fit.flux[:, None, None]
    variance = np.maximum(stars, 0.0) / fitter.photons[:, None, None]
    sigma = np.sqrt(variance + fitter.noise[:, None, None] ** 2)
    options = replace(fit.options, tolerance=fitter.settings.compared_tolerance)
    redrawn = []
    for _ in range(4):
        images = np.where(fitter.measured, stars + sigma * rng.normal(size=stars.shape), 0.0)
        redrawn.append(replace(fitter, images=images).fit(options).model)
    return FieldUncertainty(tuple(redrawn), tuple(parted), excess_scatter(*light))


def excess_scatter(values: np.ndarray, sigma: np.ndarray) -> float:
    """Return the likeliest scatter τ of values (n,) about 0 beyond their errors σ (n,).

    Σ (e²/(σ² + τ²) − 1) / (σ² + τ²) = 0 with e² ≤ 9 (σ² + τ²), for outliers; 0 of fewer than five.
    """
    from scipy.optimize import brentq

    def slope(scatter: float) -> float:
        # Slope of ln of the likelihood by τ², with outliers cut at 3 σ.
        total = sigma**2 + scatter**2
        return float(((np.minimum(values**2 / total, 9.0) - 1.0) / total).sum())

    if len(values) < 5 or slope(0.0) <= 0:
        return 0.0
    # Beyond three times the largest value, the slope is negative.
    upper_end = 3.0 * float(np.abs(values).max())
    return float(brentq(slope, 0.0, upper_end))


def draw_field_stars(
    law: FieldLaw, uncertainty: FieldUncertainty, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw noise-free stars of flux 1 at random places of the field and of a pixel.

    Each is of one of the fields that the training stars give with other noise, with a residual of
    the law and light that the field takes for sky: what the fit leaves open is in it.

    Returns
    -------
    images : ndarray, shape (count, d, d)
    position : ndarray, shape (count, 2) to (count, 4)
    centre : ndarray, shape (count, 2)
        (row, column) from pixel (d//2, d//2), in the coordinates of the field's centres.
    """
    # Places over the range of the training stars, and phases over a pixel.
    fields, side = uncertainty.redrawn or (law.model,), law.side
    position = rng.uniform(law.low, law.high, (count, len(law.low)))
    centre = rng.uniform(-0.5, 0.5, (count, 2))
    # The field's image at this place, of one field after the other.
    images = np.empty((count, side, side))
    for number, field in enumerate(fields):
        rows = slice(number, None, len(fields))
        images[rows] = field.images(field.terms(position[rows]), centre[rows], side)
    images /= images.sum(axis=(1, 2), keepdims=True)
    # The residual e ~ N(e₀, C) at the phase of the centre: modes and diagonal (eq. 6).
    for number in range(count):
        offset, modes, variance = law.residuals_at(centre[number])
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
    """Return the standard error, over the flux, of a fit of the PSF to a star on a known sky.

    Of a star m' of another field, the model m finds the flux Σ m m' / Σ m². The variance is the
    sum of two: by fields of other noise, and by fields of other stars, which has what
    neighbours do to their stars, too. Either alone is too small for bright stars
    (`tests/test_stated_errors.py`): no field has what the polynomial cannot follow.

    Parameters
    ----------
    model : FieldModel
    uncertainty : FieldUncertainty
    side : int
        Side of a stamp in pixels.

    Returns
    -------
    error : float
        RMS over the field; 0 for a fit that was read from a file.
    middle : ndarray, shape (2,)
        x and y in the middle of the field; 0 for a fit that was read from a file.
    growth : ndarray, shape (4,)
        Coefficients a, b, c, d of the variance over its mean, a + b u² + c w² + d u² w² at u and w
        from the middle: towards the edge of the field, fewer stars say what the PSF is. They are
        1, 0, 0, 0 for a fit that was read from a file.
    """
    from scipy.optimize import nnls

    # 5 × 5 places over the field; magnitude and colour are in the middle of their range.
    axes = np.linspace(model.low[:2], model.high[:2], 5).T
    place = np.full((25, 4), np.nan)
    place[:, :2] = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)

    def draw_psfs(other: FieldModel) -> np.ndarray:
        images = other.images(other.terms(place), np.zeros((1, 2)), side)
        return np.asarray(images / images.sum(axis=(1, 2), keepdims=True))

    psf = draw_psfs(model)

    def variance(models: Sequence[FieldModel]) -> np.ndarray:
        """Return the mean squared error of the flux at each place, (25,)."""
        # Σ m m' / Σ m² − 1 of each field m', squared and averaged over the fields.
        flux = [(psf * draw_psfs(other)).sum(axis=(1, 2)) for other in models]
        ratio = flux / np.square(psf).sum(axis=(1, 2))
        return np.asarray(np.square(ratio - 1.0).mean(axis=0))

    # Mean over the field by the trapezoidal rule: half of what is at an edge counts.
    samples = [models for models in (uncertainty.redrawn, uncertainty.parted) if models]
    total = np.sum([variance(models) for models in samples], axis=0)
    edge = np.array([0.5, 1.0, 1.0, 1.0, 0.5]) / 4.0
    mean = float(total @ np.outer(edge, edge).ravel()) if samples else 0.0
    if not mean > 0:
        return 0.0, np.zeros(2), np.eye(4)[0]
    # v = a + b u² + c w² + d u² w² by least squares, none below 0: few fields scatter. Units are
    # those of the farthest places, or 1e-6 px² if all are one place, for which nothing grows.
    middle = axes.mean(axis=1)
    u2, w2 = np.square(place[:, :2] - middle).T
    unit = np.maximum(np.square(axes[:, -1] - middle), 1e-6)
    terms = np.stack([np.ones(25), u2 / unit[0], w2 / unit[1], u2 * w2 / unit.prod()], axis=1)
    growth = nnls(terms, total / mean)[0] / [1.0, *unit, unit.prod()]
    return float(np.sqrt(mean)), middle, growth
