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

from psfdae.base.progress import task
from psfdae.methods.field_errors import field_uncertainty, left_out_error
from psfdae.methods.field_fit import FieldFit, FieldFitter, FitOptions, FitSettings
from psfdae.methods.field_spline import FieldModel, knots_of, spacing_of
from psfdae.stars.bright_stars import BrightStars


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
        Source of the noise with which the fit is repeated for `FieldFit.uncertainty`; without it
        the errors of the field are not measured.
    """
    fitter, few_stars = FieldFitter.of(stars, background, frame_px, stamp_px), FitSettings.few_stars
    # Orders that the stars support: without positions, the field is one mean PSF.
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
        fit = fitter.fit(options)
        # Of two stars, none can be left out.
        if rng is None or len(stars) < 3:
            return fit
        return fit._replace(uncertainty=field_uncertainty(fitter, fit, rng))


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
    options = replace(options, order=start, tolerance=fitter.settings.compared_tolerance)
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
    # Orders from the lowest on, until the next one does not pay.
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
    # The same terms and knots; three limits of the change are compared (eq. 5).
    knots, star_terms = knots_of(frame_px, prior.spacing), tuple(prior.star_coordinates.tolist())
    options = FitOptions(knots, smoothness, prior.order, star_terms)
    fits = [fitter.fit(replace(options, change=change)) for change in (0.005, 0.02, 0.1)]
    return min(fits, key=partial(left_out_error, fitter))
