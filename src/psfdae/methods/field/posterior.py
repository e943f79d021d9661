"""Posterior of a star under the prior of the stars in its field: a mixture over centres.

Inputs: stamps with the known quantities of each star (`FieldStamps`), and the `FieldPrior`.
Outputs: the `StarPosterior` of PSF, flux, sky and centre. With the model in the docstring of
`psfdae.methods.field.prior`, the steps of `infer_batch` are

1. the matched filter of the mean PSF: a first flux, and the probable nodes (eq. 18);
2. the products of stars and PSFs along the axes of these nodes, for noise of any variance (eq. 8);
3. the fit of the factor a of the flux in each pair of star and node, with sky and offset t
   marginalised (eq. 9 to 11);
4. the weights of the nodes (eq. 12) and a new flux, with which step 3 is repeated once;
5. the moments of the mixture: PSF, its σ, measurements and their covariance (eq. 13 to 17).

Steps 2 and 3 are in `psfdae.methods.field.pairs`. Equations are numbered as on the page
docs/field_model.md.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from psfdae.methods.field.nodes import NodeAxes
from psfdae.methods.field.pairs import FieldStamps, PairFit, Pairs, fit_pairs, project_pairs
from psfdae.methods.field.prior import FieldPrior
from psfdae.methods.mixing import FLUX_SIGMA, mixing_weights


class StarPosterior(NamedTuple):
    """Posterior of n stars, mixed over the nodes (eq. 12 to 17).

    Attributes
    ----------
    log_evidence : ndarray, shape (n,)
        ln of the marginal likelihood of the stamp.
    flux, sky : ndarray, shape (n,)
        Posterior means, in units of the stamps.
    centre : ndarray, shape (n, 2)
        Mean row and column of the centre from the middle pixel, in pixels.
    covariance : ndarray, shape (n, 4, 4)
        Covariance of flux, sky, row and column.
    mahalanobis2 : ndarray, shape (n,)
        Outlier score: squared Mahalanobis distance along the leading axes.
    psf, psf_sigma : ndarray, shape (n, P)
        Posterior mean of the star without noise and sky, of sum 1, and its standard deviation.
    """

    log_evidence: np.ndarray
    flux: np.ndarray
    sky: np.ndarray
    centre: np.ndarray
    covariance: np.ndarray
    mahalanobis2: np.ndarray
    psf: np.ndarray
    psf_sigma: np.ndarray


def log_node_prior(prior: FieldPrior, listed_centre: np.ndarray) -> np.ndarray:
    """Return ln of each node's prior probability, shape (n, nodes) (eq. 19).

    `listed_centre` (n, 2) are centres of a list, NaN where unknown.
    """
    # Without a list: the fraction of a node's cell within ±`centring_px`.
    step, half = prior.step_px, prior.settings.centring_px
    box = np.clip((half + step / 2 - np.abs(prior.places)) / step, 0.0, 1.0).prod(axis=1)
    probability = np.tile(box / box.sum(), (len(listed_centre), 1))
    is_listed = np.isfinite(listed_centre).all(axis=1)
    if is_listed.any() and prior.has_list_error:
        # A normal distribution about the listed centre, with the variance of the list's error plus
        # a node's cell, of sum 1 over the nodes.
        sigma = np.hypot(prior.list_error[1], prior.cell_sigma_px)
        offset_sigma = (prior.places - listed_centre[is_listed, None]) / sigma
        density = np.exp(-0.5 * np.square(offset_sigma).sum(axis=-1))
        total = density.sum(axis=1, keepdims=True)
        density /= np.where(total > 0, total, 1.0)
        # Probability of 5 % that the list, or this entry, is worse than for the training stars.
        probability[is_listed] = 0.05 * probability[is_listed] + 0.95 * density
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(probability / probability.sum(axis=1, keepdims=True)))


def compute_posterior(
    prior: FieldPrior, stars: FieldStamps, position_known: np.ndarray, exact_centre: np.ndarray
) -> StarPosterior:
    """Return the posterior of stars, in batches of stars with the same known quantities.

    Parameters
    ----------
    prior : FieldPrior
        Prior distribution of the stars.
    stars : FieldStamps
        Stars, regardless of exact centres.
    position_known : ndarray of bool, shape (n,)
        True for stars whose terms are the terms at their position.
    exact_centre : ndarray, shape (n, 2)
        Exact centres (row, column) from the middle pixel; NaN where unknown.
    """
    count, pixels = stars.images.shape
    sizes = ((count,),) * 3 + ((count, 2), (count, 4, 4), (count,)) + ((count, pixels),) * 2
    posterior = StarPosterior(*map(np.empty, sizes))
    # Stars with known and unknown centre, and with known and unknown position, in turn.
    centre_known = np.isfinite(exact_centre).all(axis=1)
    for has_centre, has_position in np.ndindex(2, 2):
        rows = np.flatnonzero((centre_known == has_centre) & (position_known == has_position))
        parts = -(-rows.size // prior.limits.stars_at_once)
        for batch in np.array_split(rows, parts) if parts else []:
            batch_stars = stars.select(batch)._replace(position_known=bool(has_position))
            if has_centre:
                # Only the nearest node, which is assumed to be at exactly this centre.
                centre = exact_centre[batch]
                nearest = np.square(prior.places - centre[:, None]).sum(axis=-1).argmin(axis=1)
                is_nearest = np.arange(len(prior.places)) == nearest[:, None]
                batch_stars = batch_stars._replace(
                    centre=centre,
                    log_prior=np.where(is_nearest, 0.0, -np.inf),
                    cell_sigma_px=np.zeros(len(batch)),
                )
            for array, values in zip(posterior, infer_batch(prior, batch_stars), strict=True):
                array[batch] = values
    return posterior


def infer_batch(prior: FieldPrior, stars: FieldStamps) -> StarPosterior:
    """Return the posterior of stars whose positions and centres are all known or all unknown."""
    # Step 1: the matched filter.
    flux, is_nearby, root_area = match_flux(prior, stars)
    # For stars of an S/N below 10, only every second node along both axes is used if more than four
    # of these are probable; such a node represents four. Between nodes two steps (at most a quarter
    # of the FWHM) apart, a star deviates from linear by 1 % of its peak, but its noise is 20 % of
    # the peak or more.
    is_coarse = is_nearby & (np.rint(prior.places / prior.step_px) % 2 == 0).all(axis=1)
    is_faint = (flux < 10.0 * stars.noise * root_area) & (is_coarse.sum(axis=1) > 4)
    is_nearby = np.where(is_faint[:, None], is_coarse, is_nearby)
    stars = stars._replace(
        cell_sigma_px=np.where(is_faint, 2.0, 1.0) * stars.cell_sigma_px,
        log_prior=stars.log_prior + np.where(is_faint, np.log(4.0), 0.0)[:, None],
    )
    # Step 2: stars and PSFs along the axes.
    pairs = project_pairs(prior, stars, is_nearby)
    # The guess of the flux is at least that for an S/N of 1.5: s has to be finite.
    least_flux = 1.5 * stars.noise * root_area
    # The noise over the flux, s, depends on the flux: two rounds of fits with a guessed flux.
    for _ in range(2):
        # Step 3: the fit in each node.
        # The unit is the guess of F, by which the stamps are divided (eq. 6).
        unit = np.where(stars.flux_known(), stars.flux, np.maximum(flux, least_flux))
        stars = stars._replace(unit=unit)
        fit = fit_pairs(prior, stars, pairs)
        # Step 4, weights of the nodes: marginal likelihood times prior (eq. 12).
        log = np.full(is_nearby.shape, -np.inf)
        log[pairs.star, pairs.node] = fit.log_likelihood
        node_weight, evidence = mixing_weights(log + stars.log_prior)
        weight = node_weight[pairs.star, pairs.node]
        flux = unit * np.bincount(pairs.star, weight * fit.factor, len(unit))
        # Nodes of a weight of 0 are not fitted again.
        has_weight = weight > 0
        pairs, weight, fit = pairs.select(has_weight), weight[has_weight], fit.select(has_weight)
    # The density of x is the density of x/F times F^(−P); and the factor (2π)^(−P/2), which
    # log_likelihood leaves out (eq. 12).
    evidence -= stars.images.shape[1] * np.log(np.sqrt(2 * np.pi) * unit)
    # Step 5: the moments of the mixture (eq. 13 to 17). Flux and sky were in units of the guess.
    posterior = mix_posterior(prior, stars, pairs, weight, fit)
    covariance = posterior.covariance
    covariance += photon_covariance(prior, stars, pairs, weight)
    units = np.stack([unit, unit, *np.ones((2, len(unit)))], axis=1)
    return posterior._replace(
        log_evidence=evidence,
        flux=posterior.flux * unit,
        sky=posterior.sky * unit,
        covariance=covariance * units[:, :, None] * units[:, None, :],
    )


def match_flux(prior: FieldPrior, stars: FieldStamps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return fluxes by a matched filter, and the nodes that it finds probable (eq. 18).

    Returns
    -------
    flux : ndarray, shape (n,)
        Flux in the most probable node.
    is_nearby : ndarray of bool, shape (n, nodes)
        Nodes for which the likelihood is computed.
    root_area : ndarray, shape (n,)
        Square root of the noise-equivalent area, in pixels: σ of the flux over σ of a pixel.
    """
    # ln of the likelihood ratio of a star of flux F against none, (F Σxm̄ − ½ F² Σm̄²) / noise²,
    # with the filter m̄. Its maximum is at F = Σxm̄ / Σm̄².
    filters, square = prior.filters
    product = stars.images @ filters.T
    is_known = np.isfinite(stars.flux)[:, None]
    flux = np.where(is_known, stars.flux[:, None], np.maximum(product / square, 0.0))
    gain = flux * product - 0.5 * flux**2 * square
    # Score of a node: ln of its likelihood ratio, plus ln of its prior.
    variance = stars.noise[:, None] ** 2
    score = gain / variance + stars.log_prior
    rows, best_node = np.arange(len(flux)), score.argmax(axis=1)
    # The filter ignores residuals of bright stars: scores are softened as if the S/N in the best
    # node were at most 30. Nodes more than 9 below the best, in ln, have a weight of about e⁻⁹: all
    # together change ln of the evidence by about 1e-3. Their number has limits on both sides.
    best_square = (flux**2 * square)[rows, best_node, None]
    soft_score = gain / (variance + best_square / 30.0**2) + stars.log_prior
    limits = prior.limits.min_nodes, round(prior.limits.max_node_area_px2 / prior.step_px**2)
    fewest, largest = (min(count, score.shape[1]) - 1 for count in limits)
    highest = -np.partition(-soft_score, [fewest, largest], axis=1)
    threshold = np.clip(soft_score.max(axis=1) - 9.0, highest[:, largest], highest[:, fewest])
    is_nearby = np.isfinite(score) & (soft_score >= threshold[:, None])
    is_nearby[rows, best_node] = True
    return flux[rows, best_node], is_nearby, 1.0 / np.sqrt(square[best_node])


def photon_covariance(
    prior: FieldPrior, stars: FieldStamps, pairs: Pairs, weight: np.ndarray
) -> np.ndarray:
    """Return the contribution of photons to the covariance (n, 4, 4) of flux, sky, row and column.

    The likelihood spreads the photon noise of a star evenly over its stamp, but it is where the
    light is. The covariance of an estimate W x, W = (J G⁻¹ Jᵀ)⁻¹ J G⁻¹, grows by W (V − s) Wᵀ if
    the variance of the noise is V and not s (eq. 17).
    """
    count, pixels = stars.images.shape
    covariance = np.zeros((count, 4, 4))
    # One node of each star is enough, the node of the largest weight.
    order = np.lexsort((-weight, pairs.star))
    is_best = np.zeros(len(weight), dtype=bool)
    is_best[order[np.unique(pairs.star[order], return_index=True)[1]]] = True
    is_best &= (stars.unit_per_electron > 0)[pairs.star]
    if not is_best.any():
        return covariance
    # The prior precision of known quantities is added to J G⁻¹ Jᵀ, so that data cannot change them
    # (eq. 17).
    flux_precision = stars.flux_precision()
    flux_precision = np.where(flux_precision > FLUX_SIGMA**-2.0, flux_precision, 0.0)
    nuisance_precision = np.where(stars.prior_sigma() > 0, 0.0, 1e30)
    precision = np.column_stack([flux_precision, nuisance_precision])
    for k, rows in pairs.select(is_best).iterate_nodes():
        star = pairs.star[is_best][rows]
        axes, s = prior.node_axes(k, stars.position_known), stars.noise_variance()[star]
        mean, inverse = stars.psfs(prior, k, star), axes.inverse(s)[:, None]
        # J: derivatives of the image with respect to flux, sky, row and column; J G⁻¹ is J/(λ₀ + s)
        # plus the difference along the axes; W = (J G⁻¹ Jᵀ)⁻¹ J G⁻¹.
        change = np.empty((len(star), 4, pixels))
        change[:, 0], change[:, 1:] = mean, axes.basis[:3]
        along = (change @ axes.basis[3:].T) * (inverse[..., :-1] - inverse[..., -1:])
        filters = inverse[..., -1:] * change + along @ axes.basis[3:]
        information = filters @ change.transpose(0, 2, 1) + precision[star, :, None] * np.eye(4)
        influence = np.linalg.solve(information, filters)
        # V − s in units of F² (eq. 17): (m − mean of m)/(g F); unit_per_electron is 1/g, unit is F.
        excess = (mean - mean.mean(axis=1, keepdims=True)) / stars.unit[star, None]
        excess *= stars.unit_per_electron[star, None]
        covariance[star] = (influence * excess[:, None]) @ influence.transpose(0, 2, 1)
    return covariance


def mix_posterior(
    prior: FieldPrior, stars: FieldStamps, pairs: Pairs, weight: np.ndarray, fit: PairFit
) -> StarPosterior:
    """Return the posterior of stars, mixed over their nodes by `weight` (eq. 13 to 16).

    Stars are divided by a guess of their flux, which is the unit of flux and sky. The evidence is
    set to 0.
    """
    count, pixels = stars.images.shape
    sigma, star = stars.prior_sigma()[pairs.star], pairs.star
    nuisance, nuisance_slope = fit.nuisance_and_slope(sigma)
    psf, variance, flux, mahalanobis2 = _mix_pixels(prior, stars, pairs, weight, fit)
    # Flux, sky and centre of each pair, and their moments over the nodes. Where the sky is free,
    # the constant (a − Σstar)/P is added to each pixel of the star, so that its flux is a, and
    # subtracted from the sky.
    sky_free = ~stars.sky_known[star]
    sky = nuisance[:, 0] - np.where(sky_free, fit.factor - flux, 0.0) / pixels
    flux = np.where(sky_free, fit.factor, flux)
    # Centre of the node, or the known centre, plus the offset t.
    place = prior.places[pairs.node] if stars.centre is None else stars.centre[star]
    means = np.column_stack([flux, sky, place + nuisance[:, 1:]])
    moments = _second_moments(fit, sigma, nuisance_slope, means)
    first, second, total, mahalanobis2 = (
        _sum_weighted(star, weight, values, count)
        for values in (means, moments, flux, mahalanobis2)
    )
    # The flux of a faint star differs between nodes. Therefore the mixture is divided by its sum at
    # the end, and psf_sigma includes the error of the flux.
    psf_sigma = np.sqrt(variance) / np.abs(total[:, None])
    return StarPosterior(
        log_evidence=np.zeros(count),
        flux=first[:, 0],
        sky=first[:, 1],
        centre=first[:, 2:],
        covariance=second - first[:, :, None] * first[:, None],
        mahalanobis2=mahalanobis2,
        psf=psf / total[:, None],
        psf_sigma=psf_sigma,
    )


def _mix_pixels(
    prior: FieldPrior, stars: FieldStamps, pairs: Pairs, weight: np.ndarray, fit: PairFit
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return moments of the pixels of stars without noise and sky over their nodes (eq. 13 to 16).

    For the parameters see `mix_posterior`.

    Returns
    -------
    psf, variance : ndarray, shape (n, P)
        Mean of star_k over the nodes, and mean of Var_k + star_k² minus its square (eq. 15).
    flux : ndarray, shape (N,)
        Sum of the pixels of each of N pairs, before the constant for a free sky is added.
    mahalanobis2 : ndarray, shape (N,)
        Squared Mahalanobis distance along the leading axes (eq. 16).
    """
    # Single precision is enough for differences of a star from its image, which are of the size of
    # the noise: moments are taken about the image.
    count, pixels = stars.images.shape
    first, second = np.zeros((2, count, pixels), np.float32)
    flux, mahalanobis2 = np.empty((2, len(pairs.star)))
    # Stars of a flux of about 1.
    images, s = stars.images / stars.unit[:, None], stars.noise_variance()
    single_images, image_sum = images.astype(np.float32), images.sum(axis=1)
    noise_classes = NoiseClasses.from_noise(s, stars.prior_sigma())
    star, factor = pairs.star, fit.factor[:, None]
    single_factor, single_weight, variance = (
        values[:, None].astype(np.float32) for values in (fit.factor, weight, fit.variance)
    )
    sigma, sky_free = stars.prior_sigma()[star], ~stars.sky_known[star]
    nuisance, nuisance_slope = fit.nuisance_and_slope(sigma)
    gradient, precision = np.empty((len(star), 3)), fit.precision
    # Two sets of rows: the star and its derivative by a. One set if every flux is known.
    row_sets = 2 - (stars.flux > 0).all()
    for k, part in pairs.iterate_nodes():
        axes, stars_here = prior.node_axes(k, stars.position_known), star[part]
        image, mean = pairs.along[part].transpose(1, 0, 2)
        # Residual r = x − a m − Lᵀ t along the axes, and its score along the leading axes.
        residual = image / stars.unit[stars_here, None] - factor[part] * mean
        residual = residual - nuisance[part] @ axes.derivatives
        mahalanobis2[part], gradient[part], leading = axes.leading_terms(
            residual, s[stars_here], sigma[part], prior.limits.outlier_axes
        )
        # Λ − Λ₁₂ from here on (eq. 16); this overwrites fit.precision, which is not used again.
        precision[part] -= leading
        # The star without noise and sky, and its derivative by a (eq. 13): t and −r, and their
        # derivatives.
        residual_slope = mean + nuisance_slope[part] @ axes.derivatives
        nuisance_rows = np.stack([nuisance[part], nuisance_slope[part]])[:row_sets]
        residual_rows = np.stack([-residual, residual_slope])[:row_sets]
        fraction, along_less_beyond = axes.noise_fractions(s[stars_here])
        corrections = _corrections(axes, nuisance_rows, residual_rows, fraction, along_less_beyond)
        fraction = fraction.astype(np.float32)
        mean_beyond = fraction * stars.psfs(prior, k, stars_here).astype(np.float32)
        difference = corrections[0]
        difference += single_factor[part] * mean_beyond
        difference -= fraction * single_images[stars_here]
        flux[part] = image_sum[stars_here] + difference.sum(axis=1)
        # Where the sky is free, (a − Σstar)/P is added to each pixel; `mix_posterior` subtracts it
        # from the sky. The derivative is treated likewise, so that its sum is 1.
        flat_share = (sky_free[part, None] / pixels).astype(np.float32)
        difference += flat_share * (factor[part] - flux[part, None]).astype(np.float32)
        # Second moment of the pixels (eq. 14): inside the node, and due to the variance of a.
        second_moment = noise_classes.pixel_variance(axes, stars_here)
        second_moment += difference**2
        for correction in corrections[1:]:
            change = correction + mean_beyond
            change += flat_share * (1.0 - change.sum(axis=1, keepdims=True))
            second_moment += variance[part] * change**2
        # Moments of the mixture (eq. 15).
        first[stars_here] += single_weight[part] * difference
        second[stars_here] += single_weight[part] * second_moment
    # D² = rᵀG⁻¹r + γᵀ(Λ − Λ₁₂)⁻¹γ (eq. 16): (Λ − Λ₁₂)⁻¹ is the covariance of t/σ without the
    # leading axes.
    mahalanobis2 += (gradient * np.linalg.solve(precision, gradient[..., None])[..., 0]).sum(axis=1)
    return images + first, np.maximum(second - first**2, 0.0), flux, mahalanobis2


class NoiseClasses(NamedTuple):
    """Noise variances between which the variance of the pixels of n stars is interpolated.

    The variance inside a node depends only on s and σ (eq. 14).

    Attributes
    ----------
    ends : ndarray of int, shape (2, n)
        Indices of the classes below and above each star.
    fraction : ndarray, shape (n, 1), float32
        Weight of the class above.
    variance : ndarray, shape (C, 1)
        s of each class.
    sigma : ndarray, shape (C, 3)
        Prior σ of the nuisance parameters of each class.
    """

    ends: np.ndarray
    fraction: np.ndarray
    variance: np.ndarray
    sigma: np.ndarray

    @classmethod
    def from_noise(cls, s: np.ndarray, sigma: np.ndarray) -> NoiseClasses:
        """Return the classes of stars by their s, (n, 1), and prior σ, (n, 3)."""
        # Steps of 0.5 in ln s, between which a variance is linear to 1 %.
        ln_step = 0.5
        place = np.log(s) / ln_step
        below = np.floor(place)
        fraction = (place - below).astype(np.float32)
        knots = np.column_stack([np.vstack([below, below + 1.0]), np.tile(sigma, (2, 1))])
        classes, ends = np.unique(knots, axis=0, return_inverse=True)
        # Stars of few noise levels are classes themselves.
        levels, number = np.unique(np.column_stack([s, sigma]), axis=0, return_inverse=True)
        if len(levels) <= len(classes):
            ends, no_step = np.stack([number.ravel()] * 2), np.zeros_like(fraction)
            return cls(ends, no_step, levels[:, :1], levels[:, 1:])
        return cls(ends.reshape(2, -1), fraction, np.exp(ln_step * classes[:, :1]), classes[:, 1:])

    def pixel_variance(self, axes: NodeAxes, stars: np.ndarray) -> np.ndarray:
        """Return the variance (n, P) of the pixels of the stars with these indices in a node.

        It is in single precision.
        """
        # Once for each class that occurs.
        classes, index = np.unique(self.ends[:, stars], return_inverse=True)
        variance = axes.pixel_variance(self.variance[classes], self.sigma[classes])
        below, above = variance.astype(np.float32)[index.reshape(2, -1)]
        return np.asarray(below + self.fraction[stars] * (above - below))


def _corrections(
    axes: NodeAxes,
    nuisance: np.ndarray,
    residual: np.ndarray,
    fraction: np.ndarray,
    along_less_beyond: np.ndarray,
) -> np.ndarray:
    """Return corrections that remove noise and sky from stars in a node.

    They are −t_sky − s G⁻¹ r with r = x − a m − Lᵀ t (eq. 13), without the part s G⁻¹ (x − a m)
    beyond the axes, as sums over the rows of the basis: derivatives, then axes.

    Parameters
    ----------
    axes : NodeAxes
        Axes of the node.
    nuisance : ndarray, shape (R, n, 3)
        t of each star; R is 1, or 2 with the derivatives by a.
    residual : ndarray, shape (R, n, m)
        −r along the axes.
    fraction, along_less_beyond : ndarray, shape (n, 1) and (n, m)
        s G⁻¹ beyond the axes, and its difference along each axis (`NodeAxes.noise_fractions`).

    Returns
    -------
    ndarray, shape (R, n, P), float32
        Corrections of the pixels.
    """
    # Weights of the rows of the basis; the first row is the sky.
    weights = np.concatenate([fraction * nuisance, along_less_beyond * residual], axis=2)
    weights[..., 0] -= nuisance[..., 0]
    return np.asarray(weights.astype(np.float32) @ axes.basis.astype(np.float32))


def _second_moments(
    fit: PairFit, sigma: np.ndarray, nuisance_slope: np.ndarray, means: np.ndarray
) -> np.ndarray:
    """Return the mean of z zᵀ, (N, 4, 4), of flux, sky, row and column z in each pair (eq. 15).

    Parameters
    ----------
    fit : PairFit
        Fits of the N pairs.
    sigma, nuisance_slope : ndarray, shape (N, 3)
        Prior σ of the nuisance parameters, and their derivative with respect to a.
    means : ndarray, shape (N, 4)
        Mean of z.
    """
    # Covariance: the variance of a, propagated to t by its slope, and the covariance of t given a.
    slope = np.hstack([np.ones((len(sigma), 1)), nuisance_slope])
    moments = fit.variance[:, None, None] * slope[:, :, None] * slope[:, None]
    moments[:, 1:, 1:] += sigma[:, :, None] * fit.covariance * sigma[:, None]
    moments += means[:, :, None] * means[:, None]
    return np.asarray(moments)


def _sum_weighted(
    star: np.ndarray, weight: np.ndarray, values: np.ndarray, count: int
) -> np.ndarray:
    """Return weighted sums (count, …) of values (N, …) over the pairs of each star."""
    # A weighted histogram of the stars' indices for each column of the values.
    columns = values.reshape(len(star), -1).T
    sums = [np.bincount(star, weight * column, count) for column in columns]
    return np.stack(sums, axis=1).reshape(count, *values.shape[1:])
