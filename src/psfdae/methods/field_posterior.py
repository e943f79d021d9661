"""Posterior of a star, given the law of the stars in its field: a mixture over centres.

In goes a batch of stamps with what is known of each star (`FieldStamps`) and the `FieldLaw`; out
comes the `StarPosterior` of PSF, flux, sky and centre. With the model in the head of
`psfdae.methods.field_law`, the steps of `star_posterior` are

1. the matched filter of the mean PSF: a first flux, and the nodes that are probable (eq. 16);
2. the products of stars and PSFs along the axes of these nodes, for noise of any variance (eq. 6);
3. in each pair of star and node, the fit of the factor a of the flux, with sky and offset t
   marginalised (eq. 7 to 9);
4. the weights of the nodes (eq. 10) and a new flux, from which 3 is repeated once;
5. the moments of the mixture: PSF, its σ, measurements and their covariance (eq. 11 to 15).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from psfdae.methods.field_law import FieldLaw
from psfdae.mixing import FLUX_SIGMA, mixing_weights


class FieldStamps(NamedTuple):
    """Stamps of n stars, with what is known of each star; see `FieldMixture.measure`.

    Attributes
    ----------
    images : ndarray, shape (n, P)
        Stamps with the sky roughly subtracted, or exactly where `sky_known`.
    noise : ndarray, shape (n,)
        RMS of the noise of a pixel.
    terms : ndarray, shape (n, K)
        Terms of the field at the positions of the stars.
    position_known : bool
        The positions of all stars are known; otherwise that of none is.
    log_prior : ndarray, shape (n, nodes)
        ln of the probability of each node; −inf where no centre is.
    centre : ndarray, shape (n, 2), or None
        (row, column) from the middle pixel if the centres are known.
    flux : ndarray, shape (n,)
        Known fluxes; NaN where the flux is measured.
    sky_known : ndarray of bool, shape (n,)
    unit_per_electron : ndarray, shape (n,)
        Value of an electron in units of the images; 0 where unknown.
    cell_sigma_px : ndarray, shape (n,)
        σ of a centre about its node, along each axis, in pixels; 0 where the centre is known.
    unit : ndarray, shape (n,)
        Guess of the flux, by which stars are divided in their fit.
    """

    images: np.ndarray
    noise: np.ndarray
    terms: np.ndarray
    position_known: bool
    log_prior: np.ndarray
    centre: np.ndarray | None
    flux: np.ndarray
    sky_known: np.ndarray
    unit_per_electron: np.ndarray
    cell_sigma_px: np.ndarray
    unit: np.ndarray

    def select(self, stars: np.ndarray | slice) -> FieldStamps:
        """Return the stamps of some of these stars, by their indices or a mask."""
        return FieldStamps._make(a[stars] if isinstance(a, np.ndarray) else a for a in self)

    def prior_sigma(self) -> np.ndarray:
        """Return σ of sky (over flux), row and column before the star is measured, (n, 3).

        A sky that is not known has 1: the whole flux in each pixel. What is known has 0.
        """
        return np.stack([~self.sky_known * 1.0, self.cell_sigma_px, self.cell_sigma_px], axis=1)

    def flux_known(self) -> np.ndarray:
        """Return which fluxes are known, (n,)."""
        return np.asarray(np.isfinite(self.flux) & (self.flux > 0))

    def flux_precision(self) -> np.ndarray:
        """Return 1/τ², the prior precision of the factor a, (n,): of a known flux, τ = 1e-6."""
        return np.asarray(np.where(self.flux_known(), 1e-6, FLUX_SIGMA) ** -2.0)

    def noise_variance(self) -> np.ndarray:
        """Return s, the variance of the noise of a pixel over the guessed flux, (n, 1)."""
        return np.asarray(np.square(self.noise / self.unit)[:, None])


class MatchedFluxes(NamedTuple):
    """First measurement of n stars, by the matched filter of the mean PSF (eq. 16).

    Attributes
    ----------
    flux : ndarray, shape (n,)
        Flux in the most probable node.
    is_nearby : ndarray of bool, shape (n, nodes)
        Nodes of which the likelihood is computed.
    root_area : ndarray, shape (n,)
        Square root of the noise-equivalent area, in pixels: σ of a flux over that of a pixel.
    """

    flux: np.ndarray
    is_nearby: np.ndarray
    root_area: np.ndarray


class Pairs(NamedTuple):
    """Pairs of a star x and a node with its PSF m, N of them, in the order of the nodes.

    Attributes
    ----------
    star, node : ndarray of int, shape (N,)
    along : ndarray, shape (N, 2, m)
        x and m along the axes of the node.
    beyond : ndarray, shape (N, 2, 5)
        Products of x and m with x, m and the three derivatives, beyond the axes.
    """

    star: np.ndarray
    node: np.ndarray
    along: np.ndarray
    beyond: np.ndarray

    def select(self, mask: np.ndarray) -> Pairs:
        """Return the pairs for which a mask is true."""
        return Pairs._make(a[mask] for a in self)

    def by_node(self) -> Iterator[tuple[int, slice]]:
        """Yield the number of each node, and which pairs are with it."""
        nodes, first = np.unique(self.node, return_index=True)
        for k, start, stop in zip(nodes.tolist(), first, [*first[1:], len(self.node)], strict=True):
            yield k, slice(start, stop)


class PairFit(NamedTuple):
    """Fit of N stars x, divided by a guess of their flux, each in one node with its PSF m.

    Attributes
    ----------
    log_likelihood : ndarray, shape (N,)
        ln of the marginal likelihood, without (2π)^(P/2) (eq. 9).
    factor : ndarray, shape (N,)
        Posterior mean of the factor a (eq. 8).
    variance : ndarray, shape (N,)
        Variance of a.
    precision : ndarray, shape (N, 3, 3)
        Inverse covariance Λ of the nuisance parameters t/σ, of known a (eq. 7).
    covariance : ndarray, shape (N, 3, 3)
        Λ⁻¹.
    nuisance : ndarray, shape (N, 2, 3)
        Mean of t/σ in a fit to x and in one to m; that of x − a m is their difference.
    """

    log_likelihood: np.ndarray
    factor: np.ndarray
    variance: np.ndarray
    precision: np.ndarray
    covariance: np.ndarray
    nuisance: np.ndarray

    def select(self, mask: np.ndarray) -> PairFit:
        """Return the fits of the pairs for which a mask is true."""
        return PairFit._make(a[mask] for a in self)


class StarPosterior(NamedTuple):
    """Posterior of n stars, mixed over the nodes (eq. 10 to 15).

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

    @classmethod
    def empty(cls, count: int, pixels: int) -> StarPosterior:
        """Return arrays for so many stars, whose values are still to be set."""
        scalar, image = (count,), (count, pixels)
        shapes = (scalar, scalar, scalar, (count, 2), (count, 4, 4), scalar, image, image)
        return cls(*map(np.empty, shapes))

    def set(self, rows: np.ndarray, posterior: StarPosterior) -> None:
        """Set some rows to the posterior of other stars."""
        for whole, part in zip(self, posterior, strict=True):
            whole[rows] = part


def star_posterior(law: FieldLaw, stars: FieldStamps) -> StarPosterior:
    """Return the posterior of stars whose positions, and centres, are all known or all not."""
    # Step 1: the matched filter.
    flux, is_nearby, root_area = _matched_filter(law, stars)
    # Stars of an S/N below 10 are looked at in every second node along both axes if more than
    # four of these are probable: over twice a step of an eighth of the FWHM, what is not linear
    # is 1 % of a star's peak, and the noise is 20 % of it. Such a node counts for four.
    is_coarse = is_nearby & (np.rint(law.places / law.step_px) % 2 == 0).all(axis=1)
    is_faint = (flux < 10.0 * stars.noise * root_area) & (is_coarse.sum(axis=1) > 4)
    is_nearby = np.where(is_faint[:, None], is_coarse, is_nearby)
    stars = stars._replace(
        cell_sigma_px=np.where(is_faint, 2.0, 1.0) * stars.cell_sigma_px,
        log_prior=stars.log_prior + np.where(is_faint, np.log(4.0), 0.0)[:, None],
    )
    # Step 2: stars and PSFs along the axes.
    pairs = _projected(law, stars, is_nearby)
    # A guess of the flux is that of a star of S/N 1.5 at least: s has to stay finite.
    least_flux = 1.5 * stars.noise * root_area
    # The noise over the flux, s, depends on the flux: two rounds of fits with a guessed flux.
    for _ in range(2):
        # Step 3: the fit in each node.
        unit = np.where(stars.flux_known(), stars.flux, np.maximum(flux, least_flux))
        stars = stars._replace(unit=unit)
        fit = _fitted(law, stars, pairs)
        # Step 4, weights of the nodes: marginal likelihood times prior (eq. 10).
        log = np.full(is_nearby.shape, -np.inf)
        log[pairs.star, pairs.node] = fit.log_likelihood
        node_weight, evidence = mixing_weights(log + stars.log_prior)
        weight = node_weight[pairs.star, pairs.node]
        flux = unit * np.bincount(pairs.star, weight * fit.factor, len(unit))
        used = weight > 0
        pairs, weight, fit = pairs.select(used), weight[used], fit.select(used)
    # Density of the stamp in its own unit: (2π)^(−P/2) F^(−P) times that of x/F.
    evidence -= stars.images.shape[1] * np.log(np.sqrt(2 * np.pi) * unit)
    # Step 5: the moments of the mixture. Flux and sky were in units of the guessed flux.
    posterior = _mixed(law, stars, pairs, weight, fit)
    covariance = posterior.covariance
    covariance += _photon_covariance(law, stars, pairs, weight)
    units = np.stack([unit, unit, *np.ones((2, len(unit)))], axis=1)
    return posterior._replace(
        log_evidence=evidence,
        flux=posterior.flux * unit,
        sky=posterior.sky * unit,
        covariance=covariance * units[:, :, None] * units[:, None, :],
    )


def _matched_filter(law: FieldLaw, stars: FieldStamps) -> MatchedFluxes:
    """Return fluxes by a matched filter, and the nodes that are probable by it (eq. 16)."""
    # ln of the likelihood ratio of a star of flux F against none: (F ⟨x,m⟩ − ½ F² ⟨m,m⟩) / s.
    filters, square = law.filters
    product = stars.images @ filters.T
    is_known = np.isfinite(stars.flux)[:, None]
    flux = np.where(is_known, stars.flux[:, None], np.maximum(product / square, 0.0))
    gain = flux * product - 0.5 * flux**2 * square
    variance = stars.noise[:, None] ** 2
    score = gain / variance + stars.log_prior
    rows, best = np.arange(len(flux)), score.argmax(axis=1)
    # The filter does not know the shape of a bright star: its score counts as that of a star
    # of S/N 30. Nodes more than 8 below the best, in ln, would have a weight below e⁻⁸, less
    # than what `mixing_weights` drops; the number of nodes has limits on both sides.
    tempered = gain / (variance + flux**2 * square / 30.0**2) + stars.log_prior
    limits = law.limits.min_nodes, round(law.limits.max_node_area_px2 / law.step_px**2)
    fewest, largest = (min(count, score.shape[1]) - 1 for count in limits)
    ranked = -np.partition(-tempered, [fewest, largest], axis=1)
    threshold = np.clip(tempered.max(axis=1) - 8.0, ranked[:, largest], ranked[:, fewest])
    is_nearby = np.isfinite(score) & (tempered >= threshold[:, None])
    is_nearby[rows, best] = True
    return MatchedFluxes(flux[rows, best], is_nearby, 1.0 / np.sqrt(square[best]))


def _projected(law: FieldLaw, stars: FieldStamps, is_nearby: np.ndarray) -> Pairs:
    """Return stars and PSFs along the axes of each nearby node, and products beyond them.

    Products with G⁻¹ are sums over the axes and one term beyond them, for any noise (eq. 6).
    """
    node, star = is_nearby.T.nonzero()
    images, axis_count = stars.images, len(law.node_axes(node[0], stars.position_known).variance)
    pairs = Pairs(star, node, *(np.empty((len(star), 2, columns)) for columns in (axis_count, 5)))
    square = np.square(images).sum(axis=1)
    for k, rows in pairs.by_node():
        derivatives, axes = law.nodes[k].derivatives, law.node_axes(k, stars.position_known)
        image, mean = images[star[rows]], _node_psfs(law, k, stars, star[rows])
        along, beyond = pairs.along[rows], pairs.beyond[rows]
        along[:, 0] = image @ axes.basis[3:].T
        if stars.centre is None:
            along[:, 1] = law.nodes[k].image_weights(stars.terms[star[rows]]) @ axes.images
        else:
            along[:, 1] = mean @ axes.basis[3:].T
        # Products over all pixels, less those along the axes.
        beyond[:, 0, 0] = square[star[rows]]
        beyond[:, 0, 1] = beyond[:, 1, 0] = np.einsum("ij,ij->i", image, mean)
        beyond[:, 1, 1] = np.einsum("ij,ij->i", mean, mean)
        beyond[:, 0, 2:], beyond[:, 1, 2:] = image @ derivatives.T, mean @ derivatives.T
        beyond -= _products(along, along, axes.derivatives)
    return pairs


def _node_psfs(law: FieldLaw, k: int, stars: FieldStamps, rows: np.ndarray) -> np.ndarray:
    """Return the field's PSFs m, (n, P), for some of the stars in node k (eq. 5)."""
    centre = None if stars.centre is None else stars.centre[rows]
    return law.node_psfs(k, stars.terms[rows], centre)


def _fitted(law: FieldLaw, stars: FieldStamps, pairs: Pairs) -> PairFit:
    """Return the fit of stars, divided by their guessed flux, in their nodes (eq. 7 to 9)."""
    count, s = len(pairs.star), stars.noise_variance()[pairs.star]
    scale, sigma = 1.0 / stars.unit[pairs.star, None], stars.prior_sigma()[pairs.star]
    products, precision, log_det = (np.empty((count, *shape)) for shape in ((2, 5), (3, 3), ()))
    # Products ⟨·,·⟩ with G⁻¹, the precision Λ of the nuisance parameters, and ln det G.
    for k, rows in pairs.by_node():
        axes, along = law.node_axes(k, stars.position_known), pairs.along[rows]
        inverse = axes.inverse(s[rows])
        products[rows] = _products(along * inverse[:, None, :-1], along, axes.derivatives)
        products[rows] += inverse[:, -1, None, None] * pairs.beyond[rows]
        precision[rows] = axes.nuisance_precision(s[rows], sigma[rows])
        # `inverse` has one entry for all dimensions beyond the axes; here are the others.
        dimensions = stars.images.shape[1] - inverse.shape[1]
        log_det[rows] = -np.log(inverse).sum(axis=1) - dimensions * np.log(inverse[:, -1])
    products[:, 0] *= scale
    products[:, :, 0] *= scale
    products[:, :, 2:] *= sigma[:, None]
    # Woodbury: S⁻¹ = G⁻¹ − G⁻¹ Lᵀ σ Λ⁻¹ σ L G⁻¹; products with S⁻¹ from now on (eq. 7).
    covariance = np.linalg.inv(precision)
    nuisance = products[:, :, 2:] @ covariance
    products[:, :, :2] -= nuisance @ products[:, :, 2:].transpose(0, 2, 1)
    (xx, xm), (_, mm) = products[:, :, :2].transpose(1, 2, 0)
    # Generalised least squares for a with its prior about 1 (eq. 8): the residual x − m, along
    # m, over the information.
    prior = stars.flux_precision()[pairs.star]
    information, residual = mm + prior, xm - mm
    chi2 = xx - xm - residual - residual**2 / information
    # ln of the marginal likelihood (eq. 9), with ln det S = ln det G + ln det Λ.
    log_det += np.linalg.slogdet(precision)[1]
    log_likelihood = -0.5 * (chi2 + np.log(information / prior) + log_det)
    # The prior about the guessed flux comes from the same stamp: to count it as information
    # would use the star twice. A known flux is information.
    variance = 1.0 / np.where(prior > FLUX_SIGMA**-2.0, information, mm)
    factor = 1.0 + residual / information
    return PairFit(log_likelihood, factor, variance, precision, covariance, nuisance)


def _photon_covariance(
    law: FieldLaw, stars: FieldStamps, pairs: Pairs, weight: np.ndarray
) -> np.ndarray:
    """Return what photons add to the covariance (n, 4, 4) of flux, sky, row and column.

    In the likelihood, a star's photons are spread evenly over its stamp; they are where its
    light is. The errors of an estimate W x, W = (J G⁻¹ Jᵀ)⁻¹ J G⁻¹, have W (V − s) Wᵀ more if
    the variance of the noise is V (eq. 15).
    """
    count, pixels = stars.images.shape
    covariance = np.zeros((count, 4, 4))
    # One node of each star is enough: that of the largest weight.
    order = np.lexsort((-weight, pairs.star))
    is_best = np.zeros(len(weight), dtype=bool)
    is_best[order[np.unique(pairs.star[order], return_index=True)[1]]] = True
    is_best &= (stars.unit_per_electron > 0)[pairs.star]
    if not is_best.any():
        return covariance
    # Quantities that are known have a prior that no data move.
    flux_precision = stars.flux_precision()
    flux_precision = np.where(flux_precision > FLUX_SIGMA**-2.0, flux_precision, 0.0)
    nuisance_precision = np.where(stars.prior_sigma() > 0, 0.0, 1e30)
    prior = np.column_stack([flux_precision, nuisance_precision])
    for k, rows in pairs.select(is_best).by_node():
        star = pairs.star[is_best][rows]
        axes, s = law.node_axes(k, stars.position_known), stars.noise_variance()[star]
        mean, inverse = _node_psfs(law, k, stars, star), axes.inverse(s)[:, None]
        # J: the change of the image with flux, sky, row and column; J G⁻¹.
        change = np.empty((len(star), 4, pixels))
        change[:, 0], change[:, 1:] = mean, axes.basis[:3]
        along = (change @ axes.basis[3:].T) * (inverse[..., :-1] - inverse[..., -1:])
        weighted = inverse[..., -1:] * change + along @ axes.basis[3:]
        information = weighted @ change.transpose(0, 2, 1) + prior[star, :, None] * np.eye(4)
        influence = np.linalg.solve(information, weighted)
        # V − s of a star of flux F in units of F²: g (m − mean of m) / F.
        excess = (mean - mean.mean(axis=1, keepdims=True)) / stars.unit[star, None]
        excess *= stars.unit_per_electron[star, None]
        covariance[star] = (influence * excess[:, None]) @ influence.transpose(0, 2, 1)
    return covariance


def _mixed(
    law: FieldLaw, stars: FieldStamps, pairs: Pairs, weight: np.ndarray, fit: PairFit
) -> StarPosterior:
    """Return the posterior of stars, mixed over their nodes by `weight` (eq. 11 to 14).

    Stars are divided by a guess of their flux, which is the unit of flux and sky. The evidence
    is left at 0.
    """
    count, pixels = stars.images.shape
    sigma, star = stars.prior_sigma()[pairs.star], pairs.star
    # Nuisance parameters t of x − a m, and their derivative with respect to a.
    nuisance = sigma * (fit.nuisance[:, 0] - fit.factor[:, None] * fit.nuisance[:, 1])
    nuisance_slope = -sigma * fit.nuisance[:, 1]
    psf, square, flux, mahalanobis2 = _mixed_pixels(
        law, stars, pairs, weight, fit, nuisance, nuisance_slope
    )
    # Flux, sky and centre of each pair, and the moments of these over the nodes. Where the sky is
    # free, a star has the flux a: what is flat in the rest is sky.
    sky_free = ~stars.sky_known[star]
    sky = nuisance[:, 0] - np.where(sky_free, fit.factor - flux, 0.0) / pixels
    flux = np.where(sky_free, fit.factor, flux)
    place = law.places[pairs.node] if stars.centre is None else stars.centre[star]
    measured = np.column_stack([flux, sky, place + nuisance[:, 1:]])
    moments = _second_moments(fit, sigma, nuisance_slope, measured)
    first, second, total, mahalanobis2 = (
        _weighted_sums(star, weight, values, count)
        for values in (measured, moments, flux, mahalanobis2)
    )
    # A faint star's flux differs between nodes, and so does what it would be divided by: the
    # mixture is divided by its sum in the end. The error of its flux is in its pixels.
    psf_sigma = np.sqrt(np.maximum(square - psf**2, 0.0)) / np.abs(total[:, None])
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


def _mixed_pixels(
    law: FieldLaw,
    stars: FieldStamps,
    pairs: Pairs,
    weight: np.ndarray,
    fit: PairFit,
    nuisance: np.ndarray,
    nuisance_slope: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return moments of the pixels of stars without noise and sky over their nodes (eq. 11 to 14).

    Parameters
    ----------
    law, stars, pairs, weight, fit
        See `_mixed`.
    nuisance, nuisance_slope : ndarray, shape (N, 3)
        Nuisance parameters t of each pair, and their derivative with respect to a.

    Returns
    -------
    first, second : ndarray, shape (n, P)
        Weighted sums of the pixels over the nodes, and of their second moments (eq. 13).
    flux : ndarray, shape (N,)
        Sum of the pixels of each pair.
    mahalanobis2 : ndarray, shape (N,)
        Squared Mahalanobis distance along the leading axes (eq. 14).
    """
    count, pixels = stars.images.shape
    first, second = np.zeros((2, count, pixels))
    images, s = stars.images / stars.unit[:, None], stars.noise_variance()
    sigma, star, factor = stars.prior_sigma(), pairs.star, fit.factor[:, None]
    # The variance of pixels depends on s and σ alone. It is computed once for all stars whose s
    # rounds to the same step of 0.1 in ln, which changes a standard deviation by 2.5 % at most.
    ln_step = 0.1
    noise_step = np.rint(np.log(s) / ln_step)
    classes = np.column_stack([noise_step, sigma])
    _, example, noise_class = np.unique(classes, axis=0, return_index=True, return_inverse=True)
    class_variance, class_sigma = np.exp(ln_step * noise_step[example]), sigma[example]
    sigma, sky_free = sigma[star], ~stars.sky_known[star]
    flux, mahalanobis2 = np.empty((2, len(star)))
    gradient, precision = np.empty((len(star), 3)), fit.precision
    # If every flux is known, nothing has to be differentiated with respect to a.
    derivatives_needed = 2 - (stars.flux > 0).all()
    for k, part in pairs.by_node():
        axes, rows = law.node_axes(k, stars.position_known), star[part]
        beyond, along = axes.noise_fractions(s[rows])
        w, sky_share = weight[part, None], sky_free[part, None] / pixels
        image, mean = pairs.along[part].transpose(1, 0, 2)
        # Residual r = x − a m − Lᵀ t along the axes, and its score along the leading ones.
        residual = image / stars.unit[rows, None] - factor[part] * mean
        residual = residual - nuisance[part] @ axes.derivatives
        mahalanobis2[part], gradient[part], leading = axes.leading_terms(
            residual, s[rows], sigma[part], law.limits.outlier_axes
        )
        precision[part] -= leading
        # The star without noise and sky, x − t_sky − s G⁻¹ r (eq. 11), and its change with a.
        # Both are sums over the rows of the basis: derivatives, then axes.
        derivative_rows = np.stack([nuisance[part], nuisance_slope[part]])[:derivatives_needed]
        residual_slope = along * (mean + nuisance_slope[part] @ axes.derivatives)
        axis_rows = [-along * residual, residual_slope][:derivatives_needed]
        combined = np.concatenate([beyond * derivative_rows, axis_rows], axis=2)
        combined[..., 0] -= derivative_rows[..., 0]
        restored, *slopes = combined @ axes.basis
        mean = beyond * _node_psfs(law, k, stars, rows)
        restored += (1.0 - beyond) * images[rows] + factor[part] * mean
        flux[part] = restored.sum(axis=1)
        # Where the sky is free, a star has the flux a: what is flat in the rest is sky.
        restored += sky_share * (factor[part] - flux[part, None])
        # Variance of its pixels (eq. 12): inside the node, and by the variance of a.
        used, index = np.unique(noise_class[rows], return_inverse=True)
        second_moment = axes.pixel_variance(class_variance[used], class_sigma[used])[index]
        second_moment += restored**2
        for slope in slopes:
            change = slope + mean
            change += sky_share * (1.0 - change.sum(axis=1, keepdims=True))
            second_moment += fit.variance[part, None] * change**2
        # Moments of the mixture (eq. 13).
        first[rows] += w * restored
        second[rows] += w * second_moment
    # Squared Mahalanobis distance along the leading axes, with what the other axes leave open
    # of the nuisance parameters (eq. 14).
    mahalanobis2 += (gradient * np.linalg.solve(precision, gradient[..., None])[..., 0]).sum(axis=1)
    return first, second, flux, mahalanobis2


def _second_moments(
    fit: PairFit, sigma: np.ndarray, nuisance_slope: np.ndarray, measured: np.ndarray
) -> np.ndarray:
    """Return the mean of z zᵀ, (N, 4, 4), of flux, sky, row and column z in each pair (eq. 13).

    Parameters
    ----------
    fit : PairFit
    sigma, nuisance_slope : ndarray, shape (N, 3)
        Prior σ of the nuisance parameters, and their derivative with respect to a.
    measured : ndarray, shape (N, 4)
        Mean of z.
    """
    # Covariance: that of a, carried on to t by its slope, and that of t at a given a.
    slope = np.hstack([np.ones((len(sigma), 1)), nuisance_slope])
    moments = fit.variance[:, None, None] * slope[:, :, None] * slope[:, None]
    moments[:, 1:, 1:] += sigma[:, :, None] * fit.covariance * sigma[:, None]
    moments += measured[:, :, None] * measured[:, None]
    return np.asarray(moments)


def _weighted_sums(
    star: np.ndarray, weight: np.ndarray, values: np.ndarray, count: int
) -> np.ndarray:
    """Return weighted sums (count, …) of values (N, …) over the pairs of each star."""
    columns = values.reshape(len(star), -1).T
    sums = [np.bincount(star, weight * column, count) for column in columns]
    return np.stack(sums, axis=1).reshape(count, *values.shape[1:])


def _products(weighted: np.ndarray, along: np.ndarray, derivatives: np.ndarray) -> np.ndarray:
    """Return products of two weighted vectors with vectors and derivatives, along axes.

    Parameters
    ----------
    weighted, along : ndarray, shape (n, 2, m)
        x and m along the axes, each axis with a weight, and without.
    derivatives : ndarray, shape (3, m)

    Returns
    -------
    ndarray, shape (n, 2, 5)
        Products of x and m, weighted, with x, m and the three derivatives.
    """
    products = np.empty((len(along), 2, 5))
    products[..., :2] = np.einsum("nim,njm->nij", weighted, along)
    flat = weighted.reshape(-1, weighted.shape[-1])
    products[..., 2:] = (flat @ derivatives.T).reshape(-1, 2, 3)
    return products
