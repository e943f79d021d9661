"""Fit of the PSF over the field with the options that predict left-out stars best.

The distance of the knots, the order of the polynomial and the smoothness of the splines
(`FitOptions`) are chosen by the prediction of left-out stars: knots finer than the structure of
stars would follow noise. Where a detector or a plate is not linear, the PSF also changes with the
brightness of a star, and through lenses and atmosphere with its colour. Magnitude and its square
are two additional terms if they clearly improve the prediction, and likewise the colour.

`fit_field` fits the stars of an image, and `refit_field` the stars of another exposure of its
field. `fit_first_field` compares no options: it finds stars unlike the others, and the light of
neighbours. All return a `FieldFit`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from psfdae.base.progress import task
from psfdae.methods.field.errors import (
    LeftOut,
    field_uncertainty,
    left_out_error,
    left_out_stars,
)
from psfdae.methods.field.fit import FieldFit, FieldFitter, FitOptions, FitSettings
from psfdae.methods.field.prior import FieldSettings
from psfdae.methods.field.spline import FieldModel, compute_spacing, count_knots
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
    """Fit the field with coarser knots, higher orders and stronger smoothing while they pay.

    They pay if they improve the prediction of left-out stars. With the best order, terms of the
    magnitude and then of the colour are tried.

    Parameters
    ----------
    stars : BrightStars
        Stars of the fit; if any position is unknown, only order 0 is fitted.
    background : float
        Sky in photons per pixel.
    frame_px, stamp_px : int
        Side of the fitted frames, and of the stamps in which stars have flux 1 and are predicted.
    orders : sequence of int
        Orders of the polynomial to try; with a single one, other options are not searched either.
    spacing : float
        Minimum distance of the knots, in pixels.
    smoothness : float
        Minimum weight of the squared second differences of the coefficients, 1/flux².
    rng : Generator, optional
        Source of the noise with which the fit is repeated for `FieldFit.uncertainty`; by default
        the uncertainty is not computed.
    """
    fitter = FieldFitter.build(stars, background, frame_px, stamp_px)
    # Orders that the stars can determine: without positions, the field is one mean PSF.
    usable_orders = sorted(orders)
    if not np.isfinite(stars.position).all():
        usable_orders = [0]
    elif len(stars) < FitSettings.few_stars and len(orders) > 1:
        # Few left-out stars cannot decide: require at least three stars for two terms of the
        # polynomial of order o, which has (o + 1)(o + 2)/2 terms.
        determined_orders = [o for o in usable_orders if 3 * (o + 1) * (o + 2) <= 4 * len(stars)]
        usable_orders = determined_orders or usable_orders[:1]
    options = FitOptions(count_knots(frame_px, spacing), smoothness, usable_orders[0])
    # Largest number of fits: one for the search, ten for knots and smoothness, all orders, three
    # for magnitude and colour, the final one and four for the uncertainty.
    with task("field", 11 + len(usable_orders) + 3 + 5) as advance:
        fitter = replace(fitter, advance=advance)
        if len(orders) > 1 and len(stars) >= 3:
            first_spacing = choose_spacing(stars, spacing)
            options = _search_options(fitter, options, usable_orders, first_spacing)
        fit = fitter.fit(options)
        # Two stars are too few to leave one out.
        if rng is None or len(stars) < 3:
            return fit
        return fit._replace(uncertainty=field_uncertainty(fitter, fit, rng))


def fit_first_field(
    stars: BrightStars, background: float, frame_px: int, stamp_px: int, settings: FieldSettings
) -> tuple[FieldFitter, FieldFit]:
    """Fit the field with one set of options, in a fraction of the time of `fit_field`.

    The polynomial has the highest order, up to 4, of which each of the (o + 1)(o + 2)/2 terms has
    four stars.

    Parameters
    ----------
    stars : BrightStars
        Stars of the fit, all of which have positions.
    background : float
        Sky in photons per pixel.
    frame_px, stamp_px : int
        Side of the fitted frames, and of the stamps in which stars have flux 1.
    settings : FieldSettings
        Minimum distance of the knots, and smoothness.

    Returns
    -------
    fitter : FieldFitter
        The stars in their frames.
    fit : FieldFit
        Model of the field, without its uncertainty.
    """
    fitter = FieldFitter.build(stars, background, frame_px, stamp_px)
    order = max(o for o in range(5) if o == 0 or 2 * (o + 1) * (o + 2) <= len(stars))
    knots = count_knots(frame_px, choose_spacing(stars, settings.spacing_px))
    return fitter, fitter.fit(FitOptions(knots, settings.smoothness, order))


def choose_spacing(stars: BrightStars, spacing: float) -> float:
    """Return a distance of knots that follows most stars, from `spacing` to twice as much."""
    # Cubic splines with knots 0.7 σ apart follow a Gaussian of that σ to 0.2 % of its peak. The
    # noise-equivalent area of a star is A = 4πσ². Rings are finer than that.
    sigma_px = float(np.sqrt(np.median(stars.area()) / (4.0 * np.pi)))
    return float(np.clip(0.7 * sigma_px, spacing, 2.0 * spacing))


class CrossValidation:
    """Cross-validation of options: their predictions of left-out stars, at the centres of one fit.

    Squared errors of the same stars are compared by the mean difference of their logarithms, which
    gives faint and bright stars the same influence.

    Parameters
    ----------
    fitter : FieldFitter
        Stars of the fits.
    fit : FieldFit
        Fit that has their fluxes, centres and weights.
    """

    def __init__(self, fitter: FieldFitter, fit: FieldFit) -> None:
        self.fitter, self.fit = fitter, fit
        self._predictions: dict[FitOptions, tuple[Iterator[LeftOut], list[np.ndarray]]] = {}

    def is_better(self, options: FitOptions, reference: FitOptions, factor: float = 1.0) -> bool:
        """Return True if the squared errors are smaller than with the reference, times a factor.

        The comparison ends after as many folds as show the difference at 3 σ.
        """
        gain = np.empty(0)
        for fold in range(self.fitter.settings.folds):
            errors, reference_errors = (self._fold_errors(o, fold) for o in (options, reference))
            gain = np.append(gain, reference_errors - errors + np.log(factor))
            if len(gain) >= 20 and abs(gain.mean()) > 3.0 * gain.std() / np.sqrt(len(gain)):
                break
        return bool(gain.mean() > 0)

    def find_best(self, steps: Sequence[FitOptions], first: int = 0) -> FitOptions:
        """Return the best of options in their order, from the first on, upwards or else down."""
        index = first
        for direction in (1, -1):
            while 0 <= (number := index + direction) < len(steps) and self.is_better(
                steps[number], steps[index]
            ):
                index = number
            if index != first:
                break
        return steps[index]

    def _fold_errors(self, options: FitOptions, fold: int) -> np.ndarray:
        """Return ln of the squared errors of the stars of a fold; empty after the last fold."""
        if options not in self._predictions:
            self._predictions[options] = left_out_stars(self.fitter, self.fit, options), []
        parts, errors = self._predictions[options]
        while len(errors) <= fold:
            part = next(parts, None)
            errors.append(np.empty(0) if part is None else np.log(part.compute_squared_errors()))
        return errors[fold]


def _search_options(
    fitter: FieldFitter, options: FitOptions, orders: Sequence[int], first_spacing: float
) -> FitOptions:
    """Return the options with which left-out stars are predicted best.

    Parameters
    ----------
    fitter : FieldFitter
        Stars of the fits.
    options : FitOptions
        The smallest distance of knots, and the smallest smoothness.
    orders : sequence of int
        Orders of the polynomial, ascending.
    first_spacing : float
        Distance of knots at which the search begins.
    """
    final_tolerance, finest = options.tolerance, options
    # Splines first, with a polynomial that follows most of the field: with splines that follow
    # noise, higher orders would not seem to pay. Orders up to 2 are all tried, because a symmetric
    # field has no slope.
    curved_order = 2
    first_order = max((o for o in orders if o <= curved_order), default=orders[0])
    options = replace(options, order=first_order, tolerance=fitter.settings.compared_tolerance)
    validation, options = _search_splines(fitter, options, first_spacing)
    # Orders from the lowest to the first one that does not pay.
    order_steps = [replace(options, order=order) for order in orders]
    options = order_steps[0]
    for step in order_steps[1:]:
        # Most fields are curved. Higher orders must pay clearly, because noise may favour them.
        if validation.is_better(step, options, 1.0 if step.order <= curved_order else 0.99):
            options = step
        elif step.order >= curved_order:
            break
    # Magnitude and colour, the better one first, because the other may only be correlated with it.
    # Each must reduce the error by 2 %.
    coordinates = [c for c in range(2, len(fitter.high)) if fitter.high[c] > fitter.low[c]]
    while coordinates:
        steps = [replace(options, star_terms=(*options.star_terms, c)) for c in coordinates]
        step = validation.find_best(steps)
        if not validation.is_better(step, options, 0.98):
            break
        options = step
        coordinates.remove(step.star_terms[-1])
    # A field that follows magnitude or colour may need finer splines than one that does not.
    if options.star_terms:
        options = replace(options, knots=finest.knots, smoothness=finest.smoothness)
        _, options = _search_splines(fitter, options, first_spacing)
    return replace(options, tolerance=final_tolerance)


def _search_splines(
    fitter: FieldFitter, options: FitOptions, first_spacing: float
) -> tuple[CrossValidation, FitOptions]:
    """Search the distance of knots, then the smoothness, that predict left-out stars best.

    Parameters
    ----------
    fitter : FieldFitter
        Stars of the fits.
    options : FitOptions
        The smallest distance of knots, and the smallest smoothness.
    first_spacing : float
        Distance of knots at which the search begins.

    Returns
    -------
    validation : CrossValidation
        Comparison at the centres of a fit with the first distance.
    options : FitOptions
        The best options.
    """
    # Distances of knots in six steps of √2, from the one on that is nearest to the first.
    frame_px, knot_steps = len(fitter.axis), [options]
    for _ in range(6):
        spacing = 2.0**0.5 * compute_spacing(frame_px, knot_steps[-1].knots)
        knot_steps.append(replace(options, knots=count_knots(frame_px, spacing)))
    spacings = np.array([compute_spacing(frame_px, step.knots) for step in knot_steps])
    first = int(np.abs(np.log(spacings / first_spacing)).argmin())
    validation = CrossValidation(fitter, fitter.fit(knot_steps[first]))
    options = validation.find_best(knot_steps, first)
    # Splines ten times as smooth, at most three times.
    return validation, validation.find_best(
        [replace(options, smoothness=10.0**k * options.smoothness) for k in range(4)]
    )


def refit_field(
    prior: FieldModel,
    stars: BrightStars,
    background: float,
    frame_px: int,
    stamp_px: int,
    smoothness: float,
) -> FieldFit:
    """Fit another exposure of a field; its stars determine the difference from `prior`.

    Left-out stars determine the allowed size of the difference. For the other parameters see
    `fit_field`, which fitted the prior to frames of the same size.
    """
    fitter = replace(
        FieldFitter.build(stars, background, frame_px, stamp_px),
        prior=prior,
        low=prior.low,
        high=prior.high,
    )
    # The same terms and knots; three limits of the change are compared (eq. 5).
    knots, star_terms = count_knots(frame_px, prior.spacing), tuple(prior.star_coordinates.tolist())
    options = FitOptions(knots, smoothness, prior.order, star_terms)
    fits = [fitter.fit(replace(options, change=change)) for change in (0.005, 0.02, 0.1)]
    return min(fits, key=partial(left_out_error, fitter))
