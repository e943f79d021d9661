"""Fits of stars in the nodes of the lattice of centres: flux, sky and centre in each pair.

Inputs: stamps with the known quantities of each star (`FieldStamps`), and the `FieldPrior`.
`project_pairs` reduces each pair of a star and a node to projections on the axes of the node, and
products in their orthogonal complement, which are valid for any noise variance (eq. 8). `fit_pairs`
computes the marginal likelihood and the flux in each pair for the noise of the star, with sky and
centre marginalised (eq. 9 to 11). Equations are numbered as on the page docs/field_model.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from psfdae.methods.field.prior import FieldPrior
from psfdae.methods.mixing import FLUX_SIGMA


class FieldStamps(NamedTuple):
    """Stamps of n stars, with the known quantities of each star; see `FieldMixture.measure`.

    Attributes
    ----------
    images : ndarray, shape (n, P)
        Stamps with the sky roughly subtracted, or exactly where `sky_known`.
    noise : ndarray, shape (n,)
        RMS of the noise of a pixel, in the unit of the images.
    terms : ndarray, shape (n, K)
        Terms of the field at the positions of the stars.
    log_prior : ndarray, shape (n, nodes)
        ln of the probability of each node; −inf for impossible nodes.
    flux : ndarray, shape (n,)
        Known fluxes, in the unit of the images; NaN where the flux is measured.
    sky_known : ndarray of bool, shape (n,)
        True where the sky is known and exactly subtracted.
    unit_per_electron : ndarray, shape (n,)
        Value of an electron in the unit of the images, 1/gain; 0 where unknown.
    cell_sigma_px : ndarray, shape (n,)
        σ of a centre about its node, along each axis, in pixels; 0 where the centre is known.
    unit : ndarray, shape (n,)
        Guess F of the flux, in the unit of the images; the fit divides the stars by it.
    position_known : bool
        True if the positions of all stars are known, False if they are all unknown.
    centre : ndarray, shape (n, 2), or None
        (row, column) in pixels from the middle pixel, if all centres are exactly known.
    """

    images: np.ndarray
    noise: np.ndarray
    terms: np.ndarray
    log_prior: np.ndarray
    flux: np.ndarray
    sky_known: np.ndarray
    unit_per_electron: np.ndarray
    cell_sigma_px: np.ndarray
    unit: np.ndarray
    position_known: bool = True
    centre: np.ndarray | None = None

    def select(self, stars: np.ndarray | slice) -> FieldStamps:
        """Return the stamps of some of these stars, by their indices or a mask."""
        return FieldStamps._make(a[stars] if isinstance(a, np.ndarray) else a for a in self)

    def prior_sigma(self) -> np.ndarray:
        """Return the prior σ of t: sky over flux, row and column in pixels, (n, 3) (eq. 6).

        σ of an unknown sky is 1, the whole flux in each pixel; σ of known quantities is 0.
        """
        # In the order of the derivatives of a node: sky, row, column.
        return np.stack([~self.sky_known * 1.0, self.cell_sigma_px, self.cell_sigma_px], axis=1)

    def psfs(self, prior: FieldPrior, k: int, stars: np.ndarray) -> np.ndarray:
        """Return the field's PSFs m, (n, P), for some of the stars in node k (eq. 7)."""
        centre = None if self.centre is None else self.centre[stars]
        return prior.node_psfs(k, self.terms[stars], centre)

    def flux_known(self) -> np.ndarray:
        """Return True where the flux is known, (n,)."""
        return np.asarray(np.isfinite(self.flux) & (self.flux > 0))

    def flux_precision(self) -> np.ndarray:
        """Return 1/τ², the prior precision of the factor a, (n,); τ = 1e-6 for a known flux."""
        return np.asarray(np.where(self.flux_known(), 1e-6, FLUX_SIGMA) ** -2.0)

    def noise_variance(self) -> np.ndarray:
        """Return s = (noise/F)², the noise variance of a pixel at the guessed flux, (n, 1)."""
        return np.asarray(np.square(self.noise / self.unit)[:, None])


class Pairs(NamedTuple):
    """N pairs of a star x and a node with its PSF m, in the order of the nodes.

    Attributes
    ----------
    star, node : ndarray of int, shape (N,)
        Indices of the star and the node of each pair.
    along : ndarray, shape (N, 2, m)
        Projections of x and m on the axes of the node.
    products_beyond : ndarray, shape (N, 2, 5)
        Scalar products of x and m with x, m and the three derivatives, in the orthogonal
        complement of the axes.
    """

    star: np.ndarray
    node: np.ndarray
    along: np.ndarray
    products_beyond: np.ndarray

    def select(self, mask: np.ndarray) -> Pairs:
        """Return the pairs for which a mask is True."""
        return Pairs._make(a[mask] for a in self)

    def iterate_nodes(self) -> Iterator[tuple[int, slice]]:
        """Yield the index of each node, and the slice of its pairs."""
        # Pairs of the same node follow each other.
        nodes, first = np.unique(self.node, return_index=True)
        for k, start, stop in zip(nodes.tolist(), first, [*first[1:], len(self.node)], strict=True):
            yield k, slice(start, stop)


class PairFit(NamedTuple):
    """Fit of N stars x, divided by a guess of their flux, each in one node with its PSF m.

    Attributes
    ----------
    log_likelihood : ndarray, shape (N,)
        ln of the marginal likelihood, without the factor (2π)^(−P/2) (eq. 11).
    factor : ndarray, shape (N,)
        Posterior mean of the factor a (eq. 10).
    variance : ndarray, shape (N,)
        Variance of a.
    precision : ndarray, shape (N, 3, 3)
        Inverse covariance Λ of the nuisance parameters t/σ for given a (eq. 9).
    covariance : ndarray, shape (N, 3, 3)
        Λ⁻¹.
    nuisance : ndarray, shape (N, 2, 3)
        Mean of t/σ in a fit to x, and in a fit to m. The mean in a fit to x − a m is the first
        minus a times the second.
    """

    log_likelihood: np.ndarray
    factor: np.ndarray
    variance: np.ndarray
    precision: np.ndarray
    covariance: np.ndarray
    nuisance: np.ndarray

    def nuisance_and_slope(self, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return t of x − a m, (N, 3), and its derivative dt/da, for prior σ (N, 3) (eq. 13)."""
        # t/σ is linear in the data.
        difference = self.nuisance[:, 0] - self.factor[:, None] * self.nuisance[:, 1]
        return sigma * difference, -sigma * self.nuisance[:, 1]

    def select(self, mask: np.ndarray) -> PairFit:
        """Return the fits of the pairs for which a mask is True."""
        return PairFit._make(a[mask] for a in self)


def project_pairs(prior: FieldPrior, stars: FieldStamps, is_nearby: np.ndarray) -> Pairs:
    """Project stars and PSFs on the axes of each nearby node, and on their complement.

    For any noise variance s, a product with G⁻¹ is a sum over the axes (columns of V, variances λ)
    and one term for their orthogonal complement, of variance λ₀ (eq. 8):
    xᵀ G⁻¹ y = Σ (Vᵀx)(Vᵀy)/(λ + s) + (xᵀy − Σ (Vᵀx)(Vᵀy))/(λ₀ + s).

    Parameters
    ----------
    prior : FieldPrior
        Prior distribution of the stars.
    stars : FieldStamps
        Stamps of n stars.
    is_nearby : ndarray of bool, shape (n, nodes)
        True for the nodes at which a star is fitted.
    """
    # Pairs in the order of the nodes; all nodes have the same number of axes.
    node, star = is_nearby.T.nonzero()
    images, axis_count = stars.images, len(prior.node_axes(node[0], stars.position_known).variance)
    pairs = Pairs(star, node, *(np.empty((len(star), 2, columns)) for columns in (axis_count, 5)))
    square = np.square(images).sum(axis=1)
    for k, rows in pairs.iterate_nodes():
        lattice_node, axes = prior.nodes[k], prior.node_axes(k, stars.position_known)
        image = images[star[rows]]
        # x and m along the axes. m is a weighted sum of the node's images, whose projections on the
        # axes (`axes.images`) are stored.
        along, products = pairs.along[rows], pairs.products_beyond[rows]
        along[:, 0] = image @ axes.basis[3:].T
        if stars.centre is None:
            weights = lattice_node.image_weights(stars.terms[star[rows]])
            mean, along[:, 1] = weights @ lattice_node.images, weights @ axes.images
        else:
            mean = stars.psfs(prior, k, star[rows])
            along[:, 1] = mean @ axes.basis[3:].T
        # Products in the complement: products over all pixels minus products along the axes.
        products[:, 0, 0] = square[star[rows]]
        products[:, 0, 1] = products[:, 1, 0] = np.einsum("ij,ij->i", image, mean)
        products[:, 1, 1] = np.einsum("ij,ij->i", mean, mean)
        derivatives = lattice_node.derivatives.T
        products[:, 0, 2:], products[:, 1, 2:] = image @ derivatives, mean @ derivatives
        products -= _products(along, along, axes.derivatives)
    return pairs


def fit_pairs(prior: FieldPrior, stars: FieldStamps, pairs: Pairs) -> PairFit:
    """Fit stars, divided by their guessed fluxes, at their nodes (eq. 9 to 11)."""
    count, s = len(pairs.star), stars.noise_variance()[pairs.star]
    scale, sigma = 1.0 / stars.unit[pairs.star, None], stars.prior_sigma()[pairs.star]
    products, precision, log_det = (np.empty((count, *shape)) for shape in ((2, 5), (3, 3), ()))
    # Products of x and m with x, m and L by G⁻¹, the precision Λ of the nuisance parameters, and
    # ln det G.
    for k, rows in pairs.iterate_nodes():
        axes, along = prior.node_axes(k, stars.position_known), pairs.along[rows]
        inverse = axes.inverse(s[rows])
        products[rows] = _products(along * inverse[:, None, :-1], along, axes.derivatives)
        products[rows] += inverse[:, -1, None, None] * pairs.products_beyond[rows]
        precision[rows] = axes.nuisance_precision(s[rows], sigma[rows])
        # The last entry of `inverse` is 1/(λ₀ + s), for all P − m dimensions of the complement; the
        # sum has one of them, and the others are added here.
        dimensions = stars.images.shape[1] - inverse.shape[1]
        log_det[rows] = -np.log(inverse).sum(axis=1) - dimensions * np.log(inverse[:, -1])
    # From here on, x is divided by F, and the derivatives L are multiplied by σ.
    products[:, 0] *= scale
    products[:, :, 0] *= scale
    products[:, :, 2:] *= sigma[:, None]
    # Woodbury: S⁻¹ = G⁻¹ − G⁻¹ Lᵀ σ Λ⁻¹ σ L G⁻¹; from here on, products are with S⁻¹ (eq. 9).
    covariance = np.linalg.inv(precision)
    nuisance = products[:, :, 2:] @ covariance
    products[:, :, :2] -= nuisance @ products[:, :, 2:].transpose(0, 2, 1)
    (xx, xm), (_, mm) = products[:, :, :2].transpose(1, 2, 0)
    # Generalised least squares for a with a prior of mean 1 (eq. 10): a − 1 is mᵀS⁻¹(x − m) over
    # the information mᵀS⁻¹m + 1/τ².
    flux_precision = stars.flux_precision()[pairs.star]
    information, residual = mm + flux_precision, xm - mm
    chi2 = xx - xm - residual - residual**2 / information
    # ln of the marginal likelihood (eq. 11), with ln det S = ln det G + ln det Λ.
    log_det += np.linalg.slogdet(precision)[1]
    log_likelihood = -0.5 * (chi2 + np.log(information / flux_precision) + log_det)
    # The prior about the guessed flux comes from the same stamp: as information, it would use the
    # star twice. A known flux is information.
    variance = 1.0 / np.where(flux_precision > FLUX_SIGMA**-2.0, information, mm)
    factor = 1.0 + residual / information
    return PairFit(log_likelihood, factor, variance, precision, covariance, nuisance)


def _products(factors: np.ndarray, along: np.ndarray, derivatives: np.ndarray) -> np.ndarray:
    """Return weighted scalar products of x and m with x, m and the derivatives, along axes.

    Parameters
    ----------
    factors, along : ndarray, shape (n, 2, m)
        Projections of x and m on m axes: multiplied by the weight of each axis, and without it.
    derivatives : ndarray, shape (3, m)
        Derivatives of the node along the axes.

    Returns
    -------
    ndarray, shape (n, 2, 5)
        Products of x and m, weighted, with x, m and the three derivatives.
    """
    products = np.empty((len(along), 2, 5))
    products[..., :2] = np.einsum("nim,njm->nij", factors, along)
    # Products with the derivatives of all pairs as one product of matrices.
    flat = factors.reshape(-1, factors.shape[-1])
    products[..., 2:] = (flat @ derivatives.T).reshape(-1, 2, 3)
    return products
