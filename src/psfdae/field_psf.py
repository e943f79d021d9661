"""The PSF as a function of the place in the field, from the bright stars of an image.

What a detector shows of a star whose centre lies at u from a pixel is f(u; x, y), pixel included
(Anderson & King 2000, PASP 112, 1360). Here f is a sum of cubic B-splines in u, whose coefficients
are polynomials in the position (x, y). Stars lie at all phases of the pixel grid, hence f is known
between the pixels. Weighted least squares by conjugate gradients alternate with the flux and the
centre of every star (Gauss-Newton). Light is the same at all phases: without that condition,
splines and fluxes could change with the phase against each other. Changes over the field are as
small a part of the wings as of the core, unless the stars say otherwise. Stars that are unlike the
others do not count, and pixels that are brighter or fainter than the model count less: they may
show a neighbour. How far the knots are apart, how far the polynomial goes, and how smooth the
splines are, is what stars that were left out are predicted best with: knots finer than the
structure of stars would follow noise. Where a detector or a plate is not linear, f changes with the
brightness of a star as well, and through lenses and air with its colour: magnitude and its square
are two more terms, and so are those of the colour, if they predict stars that were left out clearly
better.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import isqrt
from typing import NamedTuple

import numpy as np

from psfdae.bright_stars import BrightStars
from psfdae.moments import cubic_splines, windowed_centres
from psfdae.progress import Advance, task

FIT_ROUNDS = 3  # of splines, centres and fluxes; with more, centres follow what splines cannot
CENTRE_STEPS, LEFT_OUT_STEPS = 2, 5  # of Gauss-Newton in a round, and for a star that was left out
WINDOW_PX, WINDOW_ROUNDS, WINDOW_REACH_PX = 1.2, 4, 1.0  # of the first centroids
FARTHEST_PX = 1.5  # of a centre from the brightest pixel
LARGEST_STEP_PX = 0.3  # of Gauss-Newton
SLOPE_PX = 0.02  # for differences
MODEL_ERROR = 0.02  # of a pixel's light, which no polynomial follows
LEAST_ERROR = 1e-5  # of the flux, in any pixel
HIGHER_SMOOTHNESS, RIDGE = 10.0, 10.0  # of terms beyond the constant, times its; 1/flux²
CHANGE, LEAST_CHANGE = 0.5, 1e-5  # of a coefficient over the field, by its mean, and at least
UNLIKE_SIGMA = 3.0  # of a pixel, from which it counts less: it may show a neighbour
UNLIKE_CHI2 = 8.0  # times the median, from which a star does not count
CURVED = 2  # order up to which all are tried: a symmetric field has no slope
STAR_TERMS, STAR_GAIN = 2, 0.02  # of magnitude or colour; part of the error that they save
SMOOTHER, SMOOTHER_BY = 3, 10.0  # steps of the smoothness, each by this factor, that are tried
COARSER, COARSER_BY = 6, 2.0**0.5  # steps of the distance of the knots, likewise
EXPOSURE_CHANGES = (0.005, 0.02, 0.1)  # of a coefficient by that of another exposure, tried
LARGEST_DEFORMATION = 0.3  # usual stretch of a PSF in another exposure; px² of its blur
DEFORMATION_STEPS = 3  # of Gauss-Newton
HIGHER_CHANGE = 0.3  # times this, of terms beyond the constant
FOLDS, ENOUGH_STARS = 5, 300  # left out, of which one fold after the other is predicted
FEW_STARS = 16  # with fewer, their number limits the order of the polynomial
TOLERANCE, ITERATIONS = 1e-4, 150  # of the conjugate gradients
TRIED_TOLERANCE = 3e-3  # of fits that are tried: errors of stars left out hardly change


@dataclass(frozen=True)
class FieldModel:
    """A PSF at every place of a field.

    Attributes
    ----------
    coefficients : ndarray, shape (K, N, N)
        Of the splines, for each of the K terms of the polynomial.
    low, high : ndarray, shape (2,) to (4,)
        Range of x and y, and then of magnitude and colour: the PSF does not change with one that
        has the same ends, or is not there. Beyond a range the PSF is that of its end.
    spacing : float
        Of the knots, in pixels.
    """

    coefficients: np.ndarray
    low: np.ndarray
    high: np.ndarray
    spacing: float

    @property
    def order(self) -> int:
        """Order of the polynomial in the place, which has (order + 1)(order + 2)/2 terms."""
        of_place = len(self.coefficients) - STAR_TERMS * len(self.of_star)
        return (isqrt(8 * of_place + 1) - 3) // 2

    @property
    def of_star(self) -> np.ndarray:
        """Numbers of the coordinates beyond x and y with which the PSF changes."""
        return np.asarray(2 + np.flatnonzero(self.high[2:] > self.low[2:]))

    def terms(self, position: np.ndarray) -> np.ndarray:
        """Terms of the polynomial, shape (n, K).

        At positions (n, 4) of x, y, magnitude and colour, of which the last ones may be left out of
        a model that does not change with them.
        """
        return _terms(position, self.low, self.high, self.order)

    def images(
        self, terms: np.ndarray, centre: np.ndarray, side: int, oversampling: int = 1
    ) -> np.ndarray:
        """The field with the star `centre` (n, 2) (row, column) px off the middle, (n, m, m).

        Pixels are every 1/oversampling, that at m//2 = oversampling · (side//2) is the middle;
        m is side, and one more if oversampled, so that both edges are there. Values are
        those of whole pixels.
        """
        count = side if oversampling == 1 else oversampling * side + 1
        axis = (np.arange(count) - oversampling * (side // 2)) / oversampling
        splines = np.tensordot(terms, self.coefficients, 1)
        return _drawn(splines, axis, centre, self.spacing)

    def on_lattice(
        self, terms: np.ndarray, rows: np.ndarray, columns: np.ndarray, side: int
    ) -> np.ndarray:
        """Return images (n, r c, m, m) of stars at all pairs of rows (r,) and columns (c,)."""
        splines = np.tensordot(terms, self.coefficients, 1)
        axis = np.arange(side) - side // 2
        down, across = (
            cubic_splines(axis - at[:, None], splines.shape[-1], self.spacing)
            for at in (rows, columns)
        )
        half = np.tensordot(splines, across, ((2,), (2,)))  # (n, knots, c, m)
        images = np.tensordot(down, half, ((2,), (1,)))  # (r, m, n, c, m)
        images = images.transpose(2, 0, 3, 1, 4)
        return np.asarray(images.reshape(len(terms), -1, side, side))


class FieldFit(NamedTuple):
    """A model, and what it makes of the stars that it was fitted to."""

    model: FieldModel
    flux: np.ndarray  # (n,), in units of the images'
    centre: np.ndarray  # (n, 2), (row, column) from index s//2
    good: np.ndarray  # (n,) of bool
    residual: np.ndarray  # (n, s, s), of flux 1; 0 where not seen
    redrawn: Sequence[FieldModel] = ()  # what the same stars give with other noise
    parted: Sequence[FieldModel] = ()  # as uncertain as without some stars after the others
    unknown_light: float = 0.0  # in stamps, over the flux: scatter of what is taken for sky


class LeftOut(NamedTuple):
    """Stars that were left out of a fit, with flux, sky and centre fitted to them."""

    coefficients: np.ndarray  # (K, N, N), of the splines of the others
    light: np.ndarray  # (2, n), what looks like sky in their stamps, over the flux, and its σ
    residual: np.ndarray  # (n, d, d), of flux 1
    weight: np.ndarray  # (n, d, d), expected light of pixels that count, else 0


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
    alternating = _Alternating(stars, background, frame_px, stamp_px, spacing, smoothness)
    supported_orders = _supported(orders, stars)
    # Fits: all knots and smoothnesses, all orders, with magnitude and colour in either order, the
    # last one and four more.
    with task(
        "field", 1 + COARSER + SMOOTHER + len(supported_orders) + 3 + 5
    ) as alternating.advance:
        return _best_fit(alternating, supported_orders, len(orders) == 1 or len(stars) < 3, rng)


def _best_fit(
    alternating: _Alternating,
    orders: Sequence[int],
    is_settled: bool,
    rng: np.random.Generator | None,
) -> FieldFit:
    """Return the fit whose order, terms and smoothness predict left-out stars best.

    Parameters
    ----------
    alternating : _Alternating
    orders : sequence of int
        Ascending.
    is_settled : bool
        Nothing is tried: the fit is that of the first order.
    rng : Generator, optional
    """
    if is_settled:
        return alternating.with_errors(alternating.fit(orders[0]), rng)
    alternating.tolerance = TRIED_TOLERANCE
    # Splines first, with a polynomial that follows most of the field: with those that follow noise,
    # no higher order would seem to pay.
    alternating.choose_splines(max((o for o in orders if o <= CURVED), default=orders[0]))
    best_order, least_error = 0, np.inf
    for order in orders:
        error = alternating.crossed_error(alternating.fit(order))
        # A curved field is the rule. Higher orders must pay clearly: noise makes some seem better.
        if error < (1.0 if order <= CURVED else 0.99) * least_error:
            best_order, least_error = order, error
        elif order >= CURVED:
            break
    low, high, greatest = alternating.low, alternating.high, alternating.greatest
    # Magnitude and colour, the one that saves more first: the other may only go along with it.
    untried = [
        coordinate for coordinate in range(len(greatest)) if greatest[coordinate] > high[coordinate]
    ]
    while untried:
        errors = {}
        for coordinate in untried:
            high[coordinate] = greatest[coordinate]
            errors[coordinate] = alternating.crossed_error(alternating.fit(best_order))
            high[coordinate] = low[coordinate]
        gainful = min(untried, key=errors.__getitem__)
        if errors[gainful] >= (1.0 - STAR_GAIN) * least_error:
            break
        high[gainful], least_error = greatest[gainful], errors[gainful]
        untried.remove(gainful)
    alternating.tolerance = TOLERANCE
    return alternating.with_errors(alternating.fit(best_order), rng)


def _supported(orders: Sequence[int], stars: BrightStars) -> list[int]:
    """Return the orders, ascending, that so many stars may support."""
    if not np.isfinite(stars.position).all():
        return [0]
    ascending = sorted(orders)
    if len(stars) >= FEW_STARS or len(orders) == 1:
        return ascending
    # Stars that are left out say too little then: at least three stars for two terms of the
    # polynomial of order o, which has (o + 1)(o + 2)/2.
    return [o for o in ascending if 3 * (o + 1) * (o + 2) <= 4 * len(stars)] or ascending[:1]


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
    sizes = (background, frame_px, stamp_px, prior.spacing, smoothness)
    alternating, fits = _Alternating(stars, *sizes, prior), []
    for alternating.change in EXPOSURE_CHANGES:
        fit = alternating.fit(prior.order)
        fits.append((alternating.crossed_error(fit), fit))
    return min(fits, key=lambda error_and_fit: error_and_fit[0])[1]


class _Alternating:
    """Rounds of a fit to stars, and to what is known of the field from other exposures."""

    change, tolerance = 0.0, TOLERANCE

    def __init__(
        self,
        stars: BrightStars,
        background: float,
        side: int,
        stamp_px: int,
        spacing: float,
        smoothness: float,
        prior: FieldModel | None = None,
    ) -> None:
        self.prior = prior
        self.images, self.measured = stars.framed(side)
        # Pixels around the stamp, of which the sky is the median.
        self.around_px = max(stars.stamps[0].size - stamp_px**2, 1)
        self.noise, self.place = stars.noise, stars.place
        self.photons = np.sqrt(background) / stars.noise  # per unit of flux
        self.stamp_px, self.smoothness = stamp_px, smoothness
        # A = 4πσ² of a Gaussian. A ring has no light in its middle: a window as wide as the radius
        # of all light does, 1.4 σ.
        sigma = float(np.sqrt(np.median(stars.area()) / (4.0 * np.pi)))
        self.window_px = 1.4 * sigma if sigma > 3.0 else WINDOW_PX
        self.axis = np.arange(side) - side // 2.0
        self.in_stamp = np.abs(self.axis + 0.5) < stamp_px / 2
        self.set_knots(knots_of(side, spacing))
        self.advance: Advance = lambda fits: None
        finite_columns = [column[np.isfinite(column)] for column in self.place.T]
        ends = [
            (column.min(), column.max()) if column.size else (0.0, 0.0) for column in finite_columns
        ]
        self.low, self.greatest = np.transpose(ends)
        # Magnitude and colour do not count until they are tried.
        self.high = np.concatenate([self.greatest[:2], self.low[2:]])
        if prior is not None:
            self.low, self.high = prior.low, prior.high

    def set_knots(self, knots: int) -> None:
        """Set the number of knots along each side of the frame."""
        self.knots, self.spacing = knots, spacing_of(len(self.axis), knots)
        bend = np.diff(np.eye(knots), 2, axis=0)
        self.bend = bend.T @ bend

    def choose_splines(self, order: int) -> None:
        """Set knots farther apart, and then smoother splines, as long as each step pays."""
        least_error = self.crossed_error(self.fit(order))
        for _ in range(COARSER):
            finer = self.knots
            self.set_knots(knots_of(len(self.axis), COARSER_BY * self.spacing))
            if (error := self.crossed_error(self.fit(order))) >= least_error:
                self.set_knots(finer)
                break
            least_error = error
        for _ in range(SMOOTHER):
            self.smoothness *= SMOOTHER_BY
            if (error := self.crossed_error(self.fit(order))) >= least_error:
                self.smoothness /= SMOOTHER_BY
                break
            least_error = error

    def fit(self, order: int) -> FieldFit:
        """Fit field, fluxes and centres to all stars by turns, with a polynomial of this order."""
        count = 2 + max(np.flatnonzero(self.high[2:] > self.low[2:]) + 1, default=0)
        low, high = self.low[:count].copy(), self.high[:count].copy()
        terms = _terms(self.place, low, high, order)
        good, flux = np.ones(len(terms), bool), self.images.sum(axis=(1, 2))
        start, window = np.zeros((len(flux), 2)), np.full(len(flux), self.window_px)
        reach = WINDOW_REACH_PX if self.window_px == WINDOW_PX else FARTHEST_PX
        centre = windowed_centres(self.images, start, window, WINDOW_ROUNDS, reach)
        # Weights are those of a star's expected light, first that of the median star. Those of its
        # own pixels would be larger where noise makes them fainter, and light in the wings too
        # little (Humphrey, Liu & Buote 2009, ApJ 693, 822).
        light = np.median(self.images / flux[:, None, None], axis=0)
        robust_weight, noise = np.ones(self.images.shape), self._weight(flux, light)
        splines_of_field: np.ndarray | None = None
        for turn in range(FIT_ROUNDS):
            data = self.images / flux[:, None, None]
            weight = noise * robust_weight
            splines_of_field = self._splines(
                terms, data, weight * good[:, None, None], centre, splines_of_field
            )
            splines = np.tensordot(terms, splines_of_field, 1)
            factor, centre, _ = _adjusted(
                splines, data, weight, centre, self.axis, self.spacing, CENTRE_STEPS
            )
            middle = np.tensordot(terms.mean(axis=0)[None], splines_of_field, 1)
            sides = np.arange(self.stamp_px) - self.stamp_px // 2.0
            total = float(_drawn(middle, sides, np.zeros((1, 2)), self.spacing).sum())
            splines_of_field, flux = splines_of_field / total, flux * factor * total
            splines = np.tensordot(terms, splines_of_field, 1)
            star_images = _drawn(splines, self.axis, centre, self.spacing)
            # Where a star lies on the pixel grid changes no light: without this, fluxes and splines
            # could change with that place against each other.
            inside = star_images[:, self.in_stamp][:, :, self.in_stamp].sum(axis=(1, 2))
            flux, star_images = flux * inside, star_images / inside[:, None, None]
            residual = np.where(self.measured, self.images / flux[:, None, None] - star_images, 0.0)
            noise = self._weight(flux, star_images)
            square = residual**2 * noise
            chi2 = square.sum(axis=(1, 2)) / np.maximum(self.measured.sum(axis=(1, 2)), 1)
            robust_weight = 1.0 / (1.0 + square / UNLIKE_SIGMA**2)
            if turn:
                good = chi2 < UNLIKE_CHI2 * np.median(chi2)
        assert splines_of_field is not None
        self.advance(1)
        model = FieldModel(splines_of_field, low, high, self.spacing)
        return FieldFit(model, flux, centre, good, residual)

    def with_errors(self, fit: FieldFit, rng: np.random.Generator | None) -> FieldFit:
        """The fit with what its stars say of the errors of its model.

        Four other fits, to noise-free stars of the model with new noise, scatter as much as the
        field is uncertain (parametric bootstrap: Efron & Tibshirani 1993, An Introduction to the
        Bootstrap, ch. 6.5). Light that the model does not know is the sky that stars which were
        left out seem to have.
        """
        if rng is None or len(self.noise) < 3:  # of two stars, none can be left out
            return fit
        parts = list(self._left_out(fit))
        light = np.concatenate([part.light for part in parts], axis=1)
        # Delete-group jackknife (Kott 2001, J. Off. Stat. 17, 521): without one of K folds after
        # the other, fields scatter by 1/√(K − 1) of their error, and by more the more a fit of p
        # terms follows its own n stars.
        fields = np.array([part.coefficients for part in parts])
        followed = min(fields.shape[1] / len(self.noise), 1.0)
        fields = (fields - fields.mean(axis=0)) * np.sqrt((len(fields) - 1) * (1.0 - followed))
        parted = [replace(fit.model, coefficients=fit.model.coefficients + f) for f in fields]
        # Noise-free images F m of the stars, and the variance of their pixels: sky and photons.
        stars = fit.model.images(fit.model.terms(self.place), fit.centre, len(self.axis))
        stars = stars * fit.flux[:, None, None]
        variance = np.maximum(stars, 0.0) / self.photons[:, None, None]
        sigma = np.sqrt(variance + self.noise[:, None, None] ** 2)
        images, tolerance, models = self.images, self.tolerance, []
        self.tolerance = TRIED_TOLERANCE
        for _ in range(4):
            self.images = np.where(self.measured, stars + sigma * rng.normal(size=stars.shape), 0.0)
            models.append(self.fit(fit.model.order).model)
        self.images, self.tolerance = images, tolerance
        unknown = excess_scatter(*light)
        return fit._replace(redrawn=tuple(models), parted=tuple(parted), unknown_light=unknown)

    def crossed_error(self, fit: FieldFit) -> float:
        """Geometric mean of the squared errors of stars that were left out, fold by fold.

        Flux, sky and centre of these are fitted to them. Pixels count as the light m in them: by
        Cauchy and Schwarz, the error Σ m δ / Σ m² of a flux by residuals δ is at most that of
        Σ m δ².
        """
        errors = [
            np.log((part.residual**2 * part.weight).sum(axis=(1, 2)) / part.weight.sum(axis=(1, 2)))
            for part in self._left_out(fit)
        ]
        return float(np.exp(np.concatenate(errors).mean()))

    def _left_out(self, fit: FieldFit) -> Iterator[LeftOut]:
        """Yield the stars of one fold after the other, as the others predict them.

        Of many stars, some folds are enough.

        Splines are fitted without them, to the fluxes and centres of the fit.
        """
        terms = fit.model.terms(self.place)
        data = self.images / fit.flux[:, None, None]
        star_images = fit.model.images(terms, fit.centre, len(self.axis))
        weight, noise = self._weight(fit.flux, star_images), self._variance(fit.flux, star_images)
        weight /= 1.0 + fit.residual**2 * weight / UNLIKE_SIGMA**2
        fold, judged_stars = np.arange(len(terms)) % FOLDS, 0
        in_stamp = self.in_stamp
        box = np.ix_(range(len(terms)), in_stamp, in_stamp)
        for left_out in range(FOLDS):
            used = weight * ((fold != left_out) & fit.good)[:, None, None]
            coefficients = self._splines(terms, data, used, fit.centre, fit.model.coefficients)
            judged = np.flatnonzero((fold == left_out) & fit.good)
            if not len(judged):
                continue
            images, is_measured = data[box][judged], self.measured[box][judged].astype(float)
            splines = np.tensordot(terms[judged], coefficients, 1)
            parts = (
                splines,
                images,
                is_measured,
                fit.centre[judged],
                self.axis[in_stamp],
                self.spacing,
            )
            flux, centre, residual = _adjusted(*parts, LEFT_OUT_STEPS, sky=True)
            # The sky b of weighted least squares with the design D of flux, row, column and sky is
            # W x with W = (Dᵀ w D)⁻¹ Dᵀ w. Its error has the noise of the pixels, and that of the
            # median around the star which was subtracted from them.
            design = _design(splines, centre, self.axis[in_stamp], self.spacing, sky=True)
            turned = design * weight[box][judged].reshape(len(judged), 1, -1)
            influence = np.linalg.solve(turned @ design.transpose(0, 2, 1), turned)[:, 3]
            level = (influence * images.reshape(len(judged), -1)).sum(axis=1)
            variance = (influence**2 * noise[box][judged].reshape(len(judged), -1)).sum(axis=1)
            variance += np.pi / 2 * (self.noise / fit.flux)[judged] ** 2 / self.around_px
            light = in_stamp.sum() ** 2 / flux * [level, np.sqrt(variance)]
            yield LeftOut(
                coefficients,
                light,
                residual,
                is_measured * np.maximum(star_images[box][judged], 0.0),
            )
            judged_stars += len(judged)
            if judged_stars >= ENOUGH_STARS:
                break

    def _weight(self, flux: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Return 1/variance of pixels of flux 1, with errors of the model; 0 where not measured.

        `light` is that expected of stars of flux 1, of each (n, s, s) or of all (s, s).
        """
        of_model = MODEL_ERROR * np.maximum(light, 0.0)
        variance = self._variance(flux, light) + of_model**2 + LEAST_ERROR**2
        return np.where(self.measured, 1.0 / variance, 0.0)

    def _variance(self, flux: np.ndarray, light: np.ndarray) -> np.ndarray:
        """Return the variance of pixels of stars of flux 1 by the sky and the star's photons."""
        factor = 1.0 / flux[:, None, None]
        noise, photons = (a[:, None, None] for a in (self.noise, self.photons))
        return np.asarray((noise * factor) ** 2 + np.maximum(light, 0.0) * factor / photons)

    def _deformed(
        self,
        prior: FieldModel,
        terms: np.ndarray,
        data: np.ndarray,
        weight: np.ndarray,
        rows: np.ndarray,
        columns: np.ndarray,
    ) -> np.ndarray:
        """Return splines of another exposure, stretched and blurred as its stars (n, s, s) show it.

        Their fluxes may be wrong: what is proportional to a star says nothing of its shape.
        """

        def in_sigma(splines: np.ndarray) -> np.ndarray:
            image = rows @ np.tensordot(terms, splines, 1) @ columns
            return np.asarray((image * np.sqrt(weight)).reshape(len(terms), -1))

        scaled_data = (np.sqrt(weight) * data).reshape(len(terms), -1)
        coefficients = prior.coefficients
        for _ in range(DEFORMATION_STEPS):
            changes, star = _deformations(coefficients, prior.spacing), in_sigma(coefficients)
            star /= np.linalg.norm(star, axis=1, keepdims=True)
            shapes = np.stack([*map(in_sigma, changes), scaled_data])
            shapes -= (shapes * star).sum(axis=2, keepdims=True) * star
            shapes = shapes.reshape(len(shapes), -1)
            products = shapes @ shapes.T
            normal = products[:-1, :-1] + np.eye(len(changes)) / LARGEST_DEFORMATION**2
            coefficients = coefficients + np.tensordot(
                np.linalg.solve(normal, products[:-1, -1]), changes, 1
            )
        return np.asarray(coefficients)

    def _splines(
        self,
        terms: np.ndarray,
        data: np.ndarray,
        weight: np.ndarray,
        centre: np.ndarray,
        start: np.ndarray | None,
    ) -> np.ndarray:
        """Coefficients (K, N, N) of weighted least squares at given centres."""
        from scipy.sparse.linalg import LinearOperator, cg

        used = weight.any(axis=(1, 2))
        terms, data, weight, centre = terms[used], data[used], weight[used], centre[used]
        shape = (terms.shape[1], self.knots, self.knots)
        rows, columns = (
            cubic_splines(self.axis[None] - centre[:, i, None], self.knots, self.spacing)
            for i in (0, 1)
        )
        columns_t = columns.transpose(0, 2, 1)
        penalty = np.full(shape[0], HIGHER_SMOOTHNESS * self.smoothness)
        penalty[0] = self.smoothness
        penalty = penalty[:, None, None]
        ridge, prior_coefficients = np.full(shape, RIDGE), np.zeros(shape)
        if self.prior is not None:
            prior_coefficients = self._deformed(self.prior, terms, data, weight, rows, columns_t)
            ridge[:] = 1.0 / (self.change * np.abs(prior_coefficients[0]) + LEAST_CHANGE) ** 2
            ridge[1:] /= HIGHER_CHANGE**2
            data = data - rows @ np.tensordot(terms, prior_coefficients, 1) @ columns_t
        elif start is not None:
            ridge[1:] = 1.0 / (CHANGE * np.abs(start[0]) + LEAST_CHANGE) ** 2

        # Normal equations (Σ tᵀ w t + penalty) c = Σ tᵀ w d, solved by conjugate gradients. The
        # gradients stop at a part of 1e-4: single precision is enough for their products.
        single = (terms, data, weight, rows, columns)
        terms, data, weight, rows, columns = (a.astype(np.float32) for a in single)
        rows_t, columns_t = (np.ascontiguousarray(a.transpose(0, 2, 1)) for a in (rows, columns))

        def normal(flat: np.ndarray) -> np.ndarray:
            c = flat.reshape(shape)
            splines = (terms @ c.reshape(shape[0], -1).astype(np.float32)).reshape(-1, *shape[1:])
            image = rows @ splines @ columns_t
            back = (rows_t @ (weight * image) @ columns).reshape(len(terms), -1)
            smooth = penalty * (self.bend @ c + c @ self.bend) + ridge * c
            return np.asarray(((terms.T @ back).reshape(shape) + smooth).ravel())

        projection = (rows_t @ (weight * data) @ columns).reshape(len(terms), -1)
        # Terms of a knot are solved for together: they are far from orthogonal.
        curvature = (rows_t**2 @ weight @ columns**2).reshape(len(terms), -1)
        pairs = (terms[:, :, None] * terms[:, None]).reshape(len(terms), -1)
        blocks = (curvature.T @ pairs).reshape(-1, shape[0], shape[0])
        blocks += (
            np.eye(shape[0]) * (6 * penalty.ravel() + ridge.reshape(shape[0], -1).T)[:, None, :]
        )
        inverse, size = np.linalg.inv(blocks), (int(np.prod(shape)),) * 2

        def nearly(flat: np.ndarray) -> np.ndarray:
            return np.asarray((inverse @ flat.reshape(shape[0], -1).T[..., None])[..., 0].T.ravel())

        change, _ = cg(
            LinearOperator(size, matvec=normal, dtype=float),
            (terms.T @ projection).ravel(),
            None if start is None else (start - prior_coefficients).ravel(),
            rtol=self.tolerance,
            maxiter=ITERATIONS,
            M=LinearOperator(size, matvec=nearly, dtype=float),
        )
        return np.asarray(change).reshape(shape) + prior_coefficients


def knots_of(frame_px: int, spacing: float) -> int:
    """Return the number of knots along a side of a frame, the outermost ½ pixel beyond its edge."""
    return max(round((frame_px + 1) / spacing), 3) + 1


def spacing_of(frame_px: int, knots: int) -> float:
    """Return the distance of so many knots in pixels."""
    return (frame_px + 1) / (knots - 1)


def _deformations(coefficients: np.ndarray, spacing: float) -> np.ndarray:
    """Return changes of splines (K, N, N) by stretching and blurring them, along three axes each.

    Shape (6, K, N, N): a change of one is that of r → r (1 − a), or of a² added to the variance.
    """
    place = (np.arange(coefficients.shape[-1]) - (coefficients.shape[-1] - 1) / 2) * spacing

    def slope(values: np.ndarray, axis: int) -> np.ndarray:
        """Return the slope of a polynomial through five knots."""
        one_apart, two_apart = (
            np.roll(values, -k, axis) - np.roll(values, k, axis) for k in (1, 2)
        )
        return np.asarray((8.0 * one_apart - two_apart) / (12.0 * spacing))

    along_y, along_x = (slope(coefficients, axis) for axis in (1, 2))
    yy, xy, xx = slope(along_y, 1), slope(along_y, 2), slope(along_x, 2)
    x, y = place, place[:, None]
    stretched = (x * along_x, y * along_y, x * along_y + y * along_x)
    return np.stack([*stretched, xx, yy, xy])


def _terms(position: np.ndarray, low: np.ndarray, high: np.ndarray, order: int) -> np.ndarray:
    """Return monomials x^a y^b, a + b ≤ order, of positions scaled to ±1, shape (n, K).

    Powers of other coordinates whose range has two ends are the last terms. What is not known is
    taken for the middle of its range.
    """
    width = np.where(high > low, high - low, 1.0)
    scaled = np.clip(2.0 * (position[:, : len(low)] - low) / width - 1.0, -1.0, 1.0)
    scaled = np.nan_to_num(scaled)
    x, y, *star_columns = scaled.T
    powers = [(a, total - a) for total in range(order + 1) for a in range(total, -1, -1)]
    terms = [x**a * y**b for a, b in powers]
    counted = (column for column, ends in zip(star_columns, (high > low)[2:], strict=True) if ends)
    terms += [column**power for column in counted for power in range(1, STAR_TERMS + 1)]
    return np.stack(terms, axis=1)


def _drawn(splines: np.ndarray, axis: np.ndarray, centre: np.ndarray, spacing: float) -> np.ndarray:
    """Return images (n, m, m) on an axis (m,) of coefficients (n, N, N) with centres (n, 2)."""
    rows, columns = (
        cubic_splines(axis[None] - centre[:, i, None], splines.shape[-1], spacing) for i in (0, 1)
    )
    return np.asarray(rows @ splines @ columns.transpose(0, 2, 1))


def _adjusted(
    splines: np.ndarray,
    data: np.ndarray,
    weight: np.ndarray,
    centre: np.ndarray,
    axis: np.ndarray,
    spacing: float,
    steps: int,
    sky: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit flux, centre (n, 2) and, if asked for, sky of stars by Gauss–Newton steps.

    Returns
    -------
    flux : ndarray, shape (n,)
    centre : ndarray, shape (n, 2)
    residual : ndarray, shape (n, s, s)
        In units of the flux.
    """
    count, flat = len(data), data.reshape(len(data), -1, 1)
    for _ in range(steps):
        design = _design(splines, centre, axis, spacing, sky)
        weighted = design * weight.reshape(count, 1, -1)
        parameters = np.linalg.solve(weighted @ design.transpose(0, 2, 1), weighted @ flat)[..., 0]
        flux = parameters[:, 0]
        move = np.clip(parameters[:, 1:3] / flux[:, None], -LARGEST_STEP_PX, LARGEST_STEP_PX)
        centre = np.clip(centre + move, -FARTHEST_PX, FARTHEST_PX)
    level = parameters[:, 3, None, None] if sky else 0.0
    star_images = _drawn(splines, axis, centre, spacing)
    return flux, centre, (data - level) / flux[:, None, None] - star_images


def _design(
    splines: np.ndarray, centre: np.ndarray, axis: np.ndarray, spacing: float, sky: bool
) -> np.ndarray:
    """Return the change of images (n, 3 or 4, P) with flux, row, column and, if asked, sky."""
    # An image is R c Cᵀ, with the B-splines R of its rows and C of its columns; their slopes R' and
    # C' give its changes −R' c Cᵀ and −R c C'ᵀ as the centre moves.
    place, knots = axis - centre[..., None], splines.shape[-1]
    rows, columns = cubic_splines(place, knots, spacing).swapaxes(0, 1)
    down, across = cubic_splines(place, knots, spacing, slope=True).swapaxes(0, 1)
    along = splines @ columns.transpose(0, 2, 1)
    image_across = rows @ splines @ across.transpose(0, 2, 1)
    parts = [rows @ along, -down @ along, -image_across]
    parts += [np.ones_like(image_across)] * sky
    return np.stack(parts, axis=1).reshape(len(centre), len(parts), -1)


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
