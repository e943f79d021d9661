"""The fit of the PSF over the field with the options that predict left-out stars best.

How far the knots are apart, how far the polynomial goes, and how smooth the splines are
(`FitOptions`), is what stars that were left out are predicted best with: knots finer than the
structure of stars would follow noise. Where a detector or a plate is not linear, the PSF changes
with the brightness of a star as well, and through lenses and air with its colour: magnitude and its
square are two more terms, and so are those of the colour, if they predict stars that were left out
clearly better.

`fit_field` fits the stars of an image, and `refit_field` those of another exposure of its field;
out comes a `FieldFit`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from psfdae.bright_stars import BrightStars
from psfdae.methods.field_fit import FieldFit, FieldFitter, FitOptions, FitSettings
from psfdae.methods.field_spline import FieldModel, knots_of, spacing_of
from psfdae.progress import task

COMPARED_TOLERANCE = 3e-3
"""`FitOptions.tolerance` of fits that are only compared."""


def fit_field(
    stars: BrightStars,
    background: float,
    frame_px: int,
    stamp_px: int,
    orders: Sequence[int],
    spacing: float,
    smoothness: float,
    rng: np.random.Generator | None = None,
) -> FieldFit:
    """Fit coarser knots, orders of the polynomial, and stronger smoothing, as long as it pays.

    It pays if stars that are left out are predicted better. With the best order, terms of the
    magnitude and then of the colour are tried.

    Parameters
    ----------
    stars : BrightStars
        Only order 0 is fitted if a position is not known.
    background : float
        Photons of the sky in a pixel.
    frame_px, stamp_px : int
        Side of what is fitted, and of the stamps in which stars have flux 1 and are predicted.
    orders : sequence of int
        Of one alone nothing is tried.
    spacing : float
        Of the knots, in pixels, at least.
    smoothness : float
        Least weight of the squared second differences of the coefficients, 1/flux².
    rng : Generator, optional
        Source of the noise with which the fit is repeated for `FieldFit.redrawn`; without it the
        errors of the field are not measured.
    """
    fitter, few_stars = FieldFitter.of(stars, background, frame_px, stamp_px), FitSettings.few_stars
    supported = sorted(orders)
    if not np.isfinite(stars.position).all():
        supported = [0]
    elif len(stars) < few_stars and len(orders) > 1:
        # Stars that are left out say too little then: at least three stars for two terms of the
        # polynomial of order o, which has (o + 1)(o + 2)/2.
        terms_supported = [o for o in supported if 3 * (o + 1) * (o + 2) <= 4 * len(stars)]
        supported = terms_supported or supported[:1]
    options = FitOptions(knots_of(frame_px, spacing), smoothness, supported[0])
    # Number of fits at most: ten of knots and smoothnesses, all orders, with magnitude and colour
    # in either order, the last one and four more.
    with task("field", 10 + len(supported) + 3 + 5) as advance:
        fitter = replace(fitter, advance=advance)
        if len(orders) > 1 and len(stars) >= 3:
            options = _best_options(fitter, options, supported)
        return with_errors(fitter, fitter.fit(options), rng)


def _best_options(fitter: FieldFitter, options: FitOptions, orders: Sequence[int]) -> FitOptions:
    """Return the options with which left-out stars are predicted best.

    Parameters
    ----------
    fitter : FieldFitter
    options : FitOptions
        Those with which the search starts: the closest knots, and the least smoothness.
    orders : sequence of int
        Ascending.
    """

    def error_of(options: FitOptions) -> float:
        return left_out_error(fitter, fitter.fit(options))

    final_tolerance = options.tolerance
    # Splines first, with a polynomial that follows most of the field: with those that follow noise,
    # no higher order would seem to pay. Orders up to 2 are all tried: a symmetric field has no
    # slope.
    curved = 2
    start = max((o for o in orders if o <= curved), default=orders[0])
    options = replace(options, order=start, tolerance=COMPARED_TOLERANCE)
    least_error = error_of(options)
    # Knots √2 farther apart, at most six times, and then splines ten times as smooth, at most three
    # times.
    frame_px = len(fitter.axis)
    for steps, coarser, smoother in ((6, 2.0**0.5, 1.0), (3, 1.0, 10.0)):
        for _ in range(steps):
            spacing = coarser * spacing_of(frame_px, options.knots)
            step = replace(
                options,
                knots=knots_of(frame_px, spacing),
                smoothness=smoother * options.smoothness,
            )
            if (error := error_of(step)) >= least_error:
                break
            options, least_error = step, error
    best_order, least_error = 0, np.inf
    for order in orders:
        error = error_of(replace(options, order=order))
        # A curved field is the rule. Higher orders must pay clearly: noise makes some seem better.
        if error < (1.0 if order <= curved else 0.99) * least_error:
            best_order, least_error = order, error
        elif order >= curved:
            break
    options = replace(options, order=best_order)
    # Magnitude and colour, the one that saves more first: the other may only go along with it.
    # Each must save 2 % of the error.
    untried = [c for c in range(2, len(fitter.high)) if fitter.high[c] > fitter.low[c]]
    while untried:
        steps_by_error = [
            (error_of(step), step)
            for c in untried
            if (step := replace(options, star_terms=(*options.star_terms, c)))
        ]
        error, step = min(steps_by_error, key=lambda error_and_step: error_and_step[0])
        if error >= 0.98 * least_error:
            break
        options, least_error = step, error
        untried.remove(step.star_terms[-1])
    return replace(options, tolerance=final_tolerance)


def refit_field(
    prior: FieldModel,
    stars: BrightStars,
    background: float,
    frame_px: int,
    stamp_px: int,
    smoothness: float,
) -> FieldFit:
    """Fit another exposure of a field, of which its stars show how it differs from `prior`.

    Stars that are left out say how much it may. Other parameters are those of `fit_field`, to
    which the stars of the prior came in the same frames.
    """
    fitter = replace(
        FieldFitter.of(stars, background, frame_px, stamp_px),
        prior=prior,
        low=prior.low,
        high=prior.high,
    )
    knots, star_terms = knots_of(frame_px, prior.spacing), tuple(prior.of_star.tolist())
    options = FitOptions(knots, smoothness, prior.order, star_terms)
    fits = [fitter.fit(replace(options, change=change)) for change in (0.005, 0.02, 0.1)]
    return min(fits, key=partial(left_out_error, fitter))


def left_out_error(fitter: FieldFitter, fit: FieldFit) -> float:
    """Return the geometric mean of the squared errors of stars that were left out of a fit.

    Flux, sky and centre of these are fitted to them.
    """
    errors = [np.log(part.squared_errors()) for part in fitter.left_out(fit)]
    return float(np.exp(np.concatenate(errors).mean()))


def with_errors(fitter: FieldFitter, fit: FieldFit, rng: np.random.Generator | None) -> FieldFit:
    """Return the fit with what its stars say of the errors of its model.

    Four other fits, to noise-free stars of the model with new noise, scatter as much as the
    field is uncertain (parametric bootstrap: Efron & Tibshirani 1993, An Introduction to the
    Bootstrap, ch. 6.5). Light that the model does not know is the sky that stars which were
    left out seem to have.
    """
    if rng is None or len(fitter.noise) < 3:  # of two stars, none can be left out
        return fit
    parts = list(fitter.left_out(fit))
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
    options, models = replace(fit.options, tolerance=COMPARED_TOLERANCE), []
    for _ in range(4):
        images = np.where(fitter.measured, stars + sigma * rng.normal(size=stars.shape), 0.0)
        models.append(replace(fitter, images=images).fit(options).model)
    unknown = excess_scatter(*light)
    return fit._replace(redrawn=tuple(models), parted=tuple(parted), unknown_light=unknown)


def excess_scatter(values: np.ndarray, sigma: np.ndarray) -> float:
    """Return the likeliest scatter τ of values (n,) about 0 beyond their errors σ (n,).

    Σ (e²/(σ² + τ²) − 1) / (σ² + τ²) = 0 with e² ≤ 9 (σ² + τ²), for outliers; 0 of fewer than five.
    """
    from scipy.optimize import brentq

    def slope(scatter: float) -> float:
        total = sigma**2 + scatter**2
        return float(((np.minimum(values**2 / total, 9.0) - 1.0) / total).sum())

    if len(values) < 5 or slope(0.0) <= 0:
        return 0.0
    upper_end = 3.0 * float(np.abs(values).max())
    return float(brentq(slope, 0.0, upper_end))
