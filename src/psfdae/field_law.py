"""Posterior of a star, given a model of the PSF over the field: a mixture over sub-pixel centres.

Bright stars give the PSF at every place of the field (`psfdae.field_psf`). What this model leaves
of them gives the covariance by which real stars differ from it. The centre of a star in its stamp
is a node of a square lattice that is finer than a pixel. In each node, a stamp x of a star of flux
F is

    x = F (a m + Lᵀ t + e) + noise,   e ~ N(0, C),   t ~ N(0, diag(σ²)),

with the field's PSF m (sum 1) at this place and centre, the factor a ~ N(1, 0.2²) of a guessed
flux, and the three nuisance parameters t: sky over flux, row and column of the centre within the
cell of its node. The rows of L are the derivatives of the image with respect to these. C is the
covariance of the training stars' residuals at this centre, of low rank beside a diagonal.

Equations are numbered as on the page docs/field_model.md, which derives them. Where no position is
known, m is the mean over the field, and its variation over the field is part of C. A centre that
is known is one node at exactly that place.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from math import ceil, isqrt
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from psfdae.field_psf import SLOPE_PX, STAR_TERMS, FieldModel, spacing_of
from psfdae.mixing import FLUX_SIGMA, mixing_weights
from psfdae.noise import NoiseModel
from psfdae.settings import Count, Fraction, Group, Positive

MARGIN_PX = 2
"""Width in pixels of the margin around a stamp in which field and residuals are known as well."""

MIN_NODES = 9
"""Number of nodes per star of which the likelihood is computed at least."""

MAX_NODE_AREA_PX2 = 3.0
"""Area in px² of the nodes of which the likelihood of one star is computed at most."""

MAX_STEP_FWHM = 0.125
"""Largest distance of two nodes over the FWHM: in between, stars change linearly with it."""

STARS_AT_ONCE = 1024
"""Number of stars that are restored together at most, which limits the memory."""

OUTLIER_AXES = 12
"""Number of leading axes of the residual covariance that enter the outlier score: the others do
not distinguish outliers from training stars."""

AXES = 96
"""Number of principal axes of the residual covariance that are kept at each node, at least."""


class FieldSettings(Group):
    """Mixture about a model of the field.

    Models that were packed before a setting was there have its default.
    """

    orders: Annotated[list[Annotated[int, Field(ge=0, le=10)]], Field(min_length=1)] = Field(
        [0, 1, 2, 3, 4, 6, 8],
        description="Of the polynomial in the position, tried upwards until the next one "
        "predicts stars that were left out no better",
    )
    spacing_px: Annotated[float, Field(gt=0.1, le=2)] = Field(
        0.5, description="Distance of the knots of the field's splines, at least"
    )
    smoothness: Positive = Field(
        100.0, description="Of the splines: weight of their second differences"
    )
    step_px: Annotated[float, Field(gt=0, le=1)] = Field(
        0.25, description="Between two nodes, at most; less where stars are undersampled"
    )
    reach_px: Annotated[float, Field(gt=0, lt=MARGIN_PX)] = Field(
        1.75, description="Distance, per axis, of the outermost nodes from the stamp's middle"
    )
    centring_px: Annotated[float, Field(gt=0, lt=MARGIN_PX)] = Field(
        1.5, description="Distance, per axis, from the middle that centres may have"
    )
    modes: Count = Field(40, description="Leading modes of the residuals")
    diagonal: Fraction = Field(0.2, description="Part of their variance that no mode knows")
    threads: Count = Field(1, description="Threads of the linear algebra")


class Node(NamedTuple):
    """Node of the lattice of centres: a centre, and what stars look like that stand there.

    Attributes
    ----------
    images : ndarray, shape (K + 1, P)
        Image of each of the field's K terms; the mean residual of the training stars.
    image_sums : ndarray, shape (K,)
        Sum of each term's image.
    residual_modes : ndarray, shape (r, P)
        Rows R of the residual covariance C = RᵀR + diag(`diagonal`).
    field_modes : ndarray, shape (K, P)
        Rows that the variation over the field adds to R where a star's position is unknown.
    derivatives : ndarray, shape (3, P)
        Rows of L: change of a star of flux 1 with the sky, and with row and column of its centre.
    diagonal : ndarray, shape (P,)
        Variance of the residuals beyond their modes.
    """

    images: np.ndarray
    image_sums: np.ndarray
    residual_modes: np.ndarray
    field_modes: np.ndarray
    derivatives: np.ndarray
    diagonal: np.ndarray


class NodeAxes(NamedTuple):
    """Principal axes of the residual covariance C in a node; beyond them, C is a multiple of 1.

    With this, G = C + s is diagonal along the axes for stars of every noise variance s (eq. 6).
    Noise variances, shape (n, 1), are those of a pixel of n stars of flux 1. `prior_sigma`, shape
    (n, 3), is the standard deviation of the nuisance parameters before the star is measured.

    Attributes
    ----------
    basis : ndarray, shape (3 + m, P)
        The derivatives of the node; then the m axes V, orthonormal, by descending variance.
    variance : ndarray, shape (m,)
        Variance λ along each axis.
    variance_beyond : float
        Mean variance λ₀ per dimension beyond the axes.
    images : ndarray, shape (K + 1, m)
        Images of the node along the axes.
    derivatives : ndarray, shape (3, m)
        Derivatives of the node along the axes.
    derivative_products : ndarray, shape (m + 1, 9)
        Products of the derivatives with each other, along each axis and beyond all.
    """

    basis: np.ndarray
    variance: np.ndarray
    variance_beyond: float
    images: np.ndarray
    derivatives: np.ndarray
    derivative_products: np.ndarray

    def inverse(self, noise_variance: np.ndarray) -> np.ndarray:
        """Return G⁻¹ along the axes and, last, beyond them, shape (n, m + 1) (eq. 6)."""
        return np.asarray(1.0 / (np.append(self.variance, self.variance_beyond) + noise_variance))

    def noise_fractions(self, noise_variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the fraction s G⁻¹ of a residual that is noise (eq. 11).

        The first array, (n, 1), is the fraction beyond the axes; the second one, (n, m), by how
        much the fraction along each axis differs from it.
        """
        fraction = noise_variance * self.inverse(noise_variance)
        return fraction[:, -1:], fraction[:, :-1] - fraction[:, -1:]

    def nuisance_precision(self, noise_variance: np.ndarray, prior_sigma: np.ndarray) -> np.ndarray:
        """Return Λ = 1 + σ L G⁻¹ Lᵀ σ, the inverse covariance of t/σ, (n, 3, 3) (eq. 7)."""
        products = self.inverse(noise_variance) @ self.derivative_products
        products = products.reshape(-1, 3, 3)
        return np.asarray(np.eye(3) + products * (prior_sigma[:, :, None] * prior_sigma[:, None]))

    def leading_terms(
        self, residual: np.ndarray, noise_variance: np.ndarray, prior_sigma: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what the `OUTLIER_AXES` leading axes alone contribute to a fit (eq. 14).

        Parameters
        ----------
        residual : ndarray, shape (n, m)
            Residuals r of stars along the axes.
        noise_variance : ndarray, shape (n, 1)
        prior_sigma : ndarray, shape (n, 3)

        Returns
        -------
        chi2 : ndarray, shape (n,)
            r G⁻¹ rᵀ.
        gradient : ndarray, shape (n, 3)
            σ L G⁻¹ rᵀ.
        precision : ndarray, shape (n, 3, 3)
            σ L G⁻¹ Lᵀ σ, their part of the inverse covariance of t/σ.
        """
        residual = residual[:, :OUTLIER_AXES]
        total_variance = self.variance[:OUTLIER_AXES] + noise_variance
        derivatives = prior_sigma[:, :, None] * self.derivatives[:, :OUTLIER_AXES]
        weighted = derivatives / total_variance[:, None]
        gradient = np.einsum("nij,nj->ni", weighted, residual)
        chi2 = (residual**2 / total_variance).sum(axis=1)
        return chi2, gradient, weighted @ derivatives.transpose(0, 2, 1)

    def pixel_variance(self, noise_variance: np.ndarray, prior_sigma: np.ndarray) -> np.ndarray:
        """Return the posterior variance of a star's pixels if its flux is known (eq. 12).

        Shape (n, P), of stars of flux 1 without noise and sky.
        """
        beyond, along = self.noise_fractions(noise_variance)
        covariance = np.linalg.inv(self.nuisance_precision(noise_variance, prior_sigma))
        derivatives, axes = self.basis[:3], self.basis[3:]
        # σ L s G⁻¹: how the noise that is subtracted changes with the nuisance parameters.
        rows = ((self.derivatives * along[:, None]).reshape(-1, len(axes)) @ axes).reshape(
            len(noise_variance), 3, -1
        )
        rows = (rows + beyond[:, None] * derivatives) * prior_sigma[:, :, None]
        pull = covariance @ rows
        # diag(C − C G⁻¹ C) = s diag(1 − s G⁻¹); then what the nuisance parameters leave open. The
        # sky itself is no part of the star: its row is σ L s G⁻¹ − σ_sky.
        variance = noise_variance * (1.0 - beyond - along @ axes**2) + (rows * pull).sum(axis=1)
        variance += (
            prior_sigma[:, :1] ** 2 * covariance[:, :1, 0] - 2 * prior_sigma[:, :1] * pull[:, 0]
        )
        return np.asarray(np.maximum(variance, 0.0))


def principal_axes(node: Node, position_known: bool) -> NodeAxes:
    """Return the principal axes of the residual covariance of a node (eq. 6).

    They are those of C within the space that its rows and the pixels of the largest diagonal span
    (method of Rayleigh and Ritz), which needs no eigenvectors of P x P.
    """
    rows = node.residual_modes
    if not position_known:
        rows = np.vstack([rows, node.field_modes])
    pixels = len(node.diagonal)
    axis_count = min(max(AXES, len(rows)), pixels)
    # Orthonormal basis of the space.
    large = np.argsort(-node.diagonal, kind="stable")[: axis_count - len(rows)]
    space = np.linalg.qr(np.vstack([rows, np.eye(pixels)[large]]).T)[0]
    # Eigenvectors of C in this space, and the mean variance that is left outside of it.
    projected = rows @ space
    variance, rotation = np.linalg.eigh((space.T * node.diagonal) @ space + projected.T @ projected)
    beyond = node.diagonal.sum() + np.square(rows).sum() - variance.sum()
    basis = np.vstack([node.derivatives, (space @ rotation[:, ::-1]).T])
    # What every star needs along the axes: images, derivatives and the products of the latter.
    images, derivatives = node.images @ basis[3:].T, node.derivatives @ basis[3:].T
    products_beyond = node.derivatives @ node.derivatives.T - derivatives @ derivatives.T
    products_along = (derivatives[:, None] * derivatives).reshape(9, -1).T
    return NodeAxes(
        basis=basis,
        variance=variance[::-1].copy(),
        variance_beyond=float(beyond / (pixels - axis_count)) if axis_count < pixels else 1.0,
        images=images,
        derivatives=derivatives,
        derivative_products=np.vstack([products_along, products_beyond.ravel()]),
    )


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

    def select(self, stars: np.ndarray | slice) -> FieldStamps:
        """Return the stamps of some of these stars, by their indices or a mask."""
        return FieldStamps._make(a[stars] if isinstance(a, np.ndarray) else a for a in self)

    def prior_sigma(self) -> np.ndarray:
        """Return σ of sky (over flux), row and column before the star is measured, (n, 3).

        A sky that is not known has 1: the whole flux in each pixel. What is known has 0.
        """
        return np.stack([~self.sky_known * 1.0, self.cell_sigma_px, self.cell_sigma_px], axis=1)


class Photometry(NamedTuple):
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
    measurement : ndarray, shape (n, 4)
        Mean of flux, sky, and row and column of the centre from the middle pixel.
    covariance : ndarray, shape (n, 4, 4)
        Covariance of these four.
    mahalanobis2 : ndarray, shape (n,)
        Outlier score: squared Mahalanobis distance along the leading axes.
    psf, psf_sigma : ndarray, shape (n, P)
        Posterior mean of the star without noise and sky, of sum 1, and its standard deviation.
    """

    log_evidence: np.ndarray
    measurement: np.ndarray
    covariance: np.ndarray
    mahalanobis2: np.ndarray
    psf: np.ndarray
    psf_sigma: np.ndarray

    @classmethod
    def empty(cls, count: int, pixels: int) -> StarPosterior:
        """Return arrays for so many stars, whose values are still to be set."""
        shapes: list[tuple[int, ...]] = [(), (4,), (4, 4), (), (pixels,), (pixels,)]
        return cls(*(np.empty((count, *shape)) for shape in shapes))

    def set(self, rows: np.ndarray, posterior: StarPosterior) -> None:
        """Set some rows to the posterior of other stars."""
        for whole, part in zip(self, posterior, strict=True):
            whole[rows] = part


@dataclass(frozen=True, eq=False)
class FieldLaw:
    """Distribution of the stars of an image: the PSF over the field, and residuals about it.

    Attributes
    ----------
    coefficients, low, high : ndarray
        Those of the `FieldModel`.
    usual, spread : ndarray, shape (K,) and (K, K)
        Mean and covariance of the terms of the field over the training stars.
    offset : ndarray, shape (f², w²)
        Mean residual at the f phases of a pixel along rows and columns, in frames of
        w = d + 2 `MARGIN_PX` pixels whose middle pixel has the star.
    modes : ndarray, shape (f², r, w²)
        Principal modes of the residuals in each phase, each times its standard deviation.
    diagonal : ndarray, shape (f², w²)
        Variance of the residuals beyond their modes.
    listed : ndarray, shape (2, 2)
        Mean and RMS of fitted less listed centres (row, column), in pixels; NaN if there
        was no list.
    noise : NoiseModel
    settings : FieldSettings
    measures_flux : bool
        `estimate` measures flux and sky; otherwise the flux is 1 and the sky 0.
    """

    coefficients: np.ndarray
    low: np.ndarray
    high: np.ndarray
    usual: np.ndarray
    spread: np.ndarray
    offset: np.ndarray
    modes: np.ndarray
    diagonal: np.ndarray
    listed: np.ndarray
    noise: NoiseModel
    settings: FieldSettings
    measures_flux: bool = False
    _axes_cache: dict[tuple[int, bool], NodeAxes] = field(
        default_factory=dict, init=False, repr=False
    )

    # The field.

    @cached_property
    def model(self) -> FieldModel:
        """The PSF at every place of the field (eq. 1)."""
        coefficients = self.coefficients.astype(np.float64)
        spacing = spacing_of(self.side + 2 * MARGIN_PX, coefficients.shape[-1])
        return FieldModel(coefficients, self.low, self.high, spacing)

    @property
    def order(self) -> int:
        """Order of the field's polynomial in x and y."""
        return self.model.order

    @property
    def side(self) -> int:
        """Side of a stamp in pixels."""
        return isqrt(self.offset.shape[-1]) - 2 * MARGIN_PX

    def _terms(self, position: np.ndarray | None, count: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Return the terms of the field for each star, and whether its position is known.

        Terms of an unknown position, magnitude or colour are their mean over the training stars. A
        star counts as one of unknown position if anything is unknown that changes its PSF.

        Parameters
        ----------
        position : ndarray, shape (n, 2) to (n, 4), or None
            x, y, magnitude and colour; NaN where unknown. None if nothing is known.
        count : int
            Number of stars n if there are no positions.

        Returns
        -------
        terms : ndarray, shape (n, K)
        position_known : ndarray of bool, shape (n,)
        """
        coordinates = np.full((count if position is None else len(position), 4), np.nan)
        if position is not None:
            coordinates[:, : position.shape[1]] = position
        # Terms of x and y first, then two of each star property that changes the PSF.
        is_known, properties = np.isfinite(coordinates), self.model.of_star
        place_known = is_known[:, :2].all(axis=1) | (self.order == 0)
        place_terms = len(self.usual) - STAR_TERMS * len(properties)
        term_known = np.hstack(
            [
                np.repeat(place_known[:, None], place_terms, axis=1),
                np.repeat(is_known[:, properties], STAR_TERMS, axis=1),
            ]
        )
        position_known = place_known & is_known[:, properties].all(axis=1)
        terms = self.model.terms(np.nan_to_num(coordinates))
        return np.where(term_known, terms, self.usual), position_known

    # The nodes.

    @cached_property
    def step_px(self) -> float:
        """Distance of two nodes in pixels, for which there are residuals."""
        step, phases = self.settings.step_px, isqrt(len(self.offset))
        return step if len(phases_of(step)) == phases else 1.0 / phases

    @cached_property
    def _lattice(self) -> np.ndarray:
        """Coordinates of the nodes along an axis, in units of a step."""
        outermost = round(self.settings.reach_px / self.step_px)
        return np.arange(-outermost, outermost + 1)

    @cached_property
    def places(self) -> np.ndarray:
        """Centres (row, column) of the nodes from the stamp's middle pixel, shape (nodes, 2)."""
        row, column = np.meshgrid(self._lattice, self._lattice, indexing="ij")
        return self.step_px * np.stack([row.ravel(), column.ravel()], axis=1)

    @cached_property
    def _nodes(self) -> list[Node]:
        """All nodes, in the order of `places`."""
        count, axis = len(self.usual), self.step_px * self._lattice
        phases, steps = phases_of(self.step_px), ((SLOPE_PX, 0.0), (0.0, SLOPE_PX))

        def drawn(terms: np.ndarray, row: float = 0.0, column: float = 0.0) -> np.ndarray:
            images = self.model.on_lattice(terms, axis + row, axis + column, self.side)
            return images.reshape(len(terms), len(self.places), -1)

        # Images of each term in all nodes, and central differences of the mean star's image.
        term_images, usual = drawn(np.eye(count)), self.usual[None]
        slopes = [
            (drawn(usual, *e) - drawn(usual, -e[0], -e[1]))[0] / (2 * SLOPE_PX) for e in steps
        ]
        field_modes = _covariance_rows(self.spread.reshape(count, count))
        nodes = []
        for k, place in enumerate(self.places):
            images = term_images[:, k]
            image_sums = images.sum(axis=1)
            flux = float(self.usual @ image_sums)
            mean = self.usual @ images / flux

            # A change of a star whose light in the stamp is kept at 1: (δ − Σδ m) / F.
            def at_constant_flux(
                rows: np.ndarray, mean: np.ndarray = mean, flux: float = flux
            ) -> np.ndarray:
                return np.asarray((rows - rows.sum(axis=-1, keepdims=True) * mean) / flux)

            # Residuals are stored by the phase of a centre in its pixel, in frames that are larger
            # than a stamp: whole pixels of a node's place choose the window.
            phase, window = phase_of(place, phases, self.side)
            residuals = np.vstack([self.offset[phase, window], self.modes[phase][:, window]])
            residuals = at_constant_flux(residuals.astype(np.float64))
            shifts = at_constant_flux(np.stack([s[k] for s in slopes]))
            nodes.append(
                Node(
                    images=np.vstack([images, residuals[:1]]),
                    image_sums=image_sums,
                    residual_modes=residuals[1:],
                    field_modes=at_constant_flux(field_modes @ images),
                    derivatives=np.vstack([np.ones_like(mean), shifts]),
                    diagonal=self.diagonal[phase, window].astype(np.float64),
                )
            )
        return nodes

    @cached_property
    def _filters(self) -> tuple[np.ndarray, np.ndarray]:
        """Matched filters of all nodes, (nodes, P), and the sum of squares of each, (nodes,).

        A filter is the mean star of sum 1 less its average over the stamp, so that a flat sky
        gives nothing.
        """
        parts = np.append(self.usual, 0.0)
        means = np.stack(
            [parts @ node.images / (self.usual @ node.image_sums) for node in self._nodes]
        )
        means += np.stack([node.images[-1] for node in self._nodes])
        means -= means.mean(axis=1, keepdims=True)
        return means, np.square(means).sum(axis=1)

    def _image_weights(self, k: int, stars: FieldStamps, rows: np.ndarray) -> np.ndarray:
        """Return weights (n, K + 1) of the images of node k that add up to PSFs m of sum 1."""
        terms = stars.terms[rows]
        sums = (terms @ self._nodes[k].image_sums)[:, None]
        return np.hstack([terms / sums, np.ones((len(rows), 1))])

    def _mean(self, k: int, stars: FieldStamps, rows: np.ndarray) -> np.ndarray:
        """Return the field's PSFs m, (n, P), of sum 1, for some stars in node k (eq. 5)."""
        node = self._nodes[k]
        if stars.centre is None:
            return np.asarray(self._image_weights(k, stars, rows) @ node.images)
        images = self.model.images(stars.terms[rows], stars.centre[rows], self.side)
        images = images.reshape(len(rows), -1)
        return np.asarray(images / images.sum(axis=1, keepdims=True) + node.images[-1])

    def _axes(self, k: int, position_known: bool) -> NodeAxes:
        """Return the principal axes of node k, which are computed once."""
        if (k, position_known) not in self._axes_cache:
            self._axes_cache[k, position_known] = principal_axes(self._nodes[k], position_known)
        return self._axes_cache[k, position_known]

    @property
    def cell_sigma_px(self) -> float:
        """σ of a centre about its node, along an axis: uniform in a cell of one step."""
        return float(self.step_px / np.sqrt(12.0))

    # The stars.

    @cached_property
    def _list_offset(self) -> np.ndarray:
        """Offset of the field's centres from those of the training stars' list, shape (2,)."""
        known = len(self.listed) and np.isfinite(self.listed).all()
        return np.asarray(self.listed[0] if known else np.zeros(2))

    def _prior(self, listed: np.ndarray) -> np.ndarray:
        """Return ln of each node's prior probability, shape (n, nodes) (eq. 17).

        Parameters
        ----------
        listed : ndarray, shape (n, 2)
            Centres of a list, NaN where there is none.
        """
        # Without a list: the part of a node's cell that is within ±`centring_px`.
        step, half = self.step_px, self.settings.centring_px
        box = np.clip((half + step / 2 - np.abs(self.places)) / step, 0.0, 1.0).prod(axis=1)
        prior = np.tile(box / box.sum(), (len(listed), 1))
        is_listed = np.isfinite(listed).all(axis=1)
        if is_listed.any() and len(self.listed) and np.isfinite(self.listed).all():
            # A normal distribution about the listed place, as wide as the error of the list.
            sigma = np.hypot(self.listed[1], self.cell_sigma_px)
            offset_sigma = (self.places - listed[is_listed, None]) / sigma
            density = np.exp(-0.5 * np.square(offset_sigma).sum(axis=-1))
            total = density.sum(axis=1, keepdims=True)
            density /= np.where(total > 0, total, 1.0)
            # 5 %: the list, or this entry of it, is worse than it was for the training stars.
            prior[is_listed] = 0.05 * prior[is_listed] + 0.95 * density
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(prior / prior.sum(axis=1, keepdims=True)))

    def _matched_filter(self, stars: FieldStamps) -> Photometry:
        """Return fluxes by a matched filter, and the nodes that are probable by it (eq. 16)."""
        # ln of the likelihood ratio of a star of flux F against none: (F ⟨x,m⟩ − ½ F² ⟨m,m⟩) / s.
        filters, square = self._filters
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
        limits = MIN_NODES, round(MAX_NODE_AREA_PX2 / self.step_px**2)
        fewest, largest = (min(count, score.shape[1]) - 1 for count in limits)
        ranked = -np.partition(-tempered, [fewest, largest], axis=1)
        threshold = np.clip(tempered.max(axis=1) - 8.0, ranked[:, largest], ranked[:, fewest])
        is_nearby = np.isfinite(score) & (tempered >= threshold[:, None])
        is_nearby[rows, best] = True
        return Photometry(flux[rows, best], is_nearby, 1.0 / np.sqrt(square[best]))

    def _projected(self, stars: FieldStamps, is_nearby: np.ndarray) -> Pairs:
        """Return stars and PSFs along the axes of each nearby node, and products beyond them.

        Products with G⁻¹ are sums over the axes and one term beyond them, for any noise (eq. 6).
        """
        node, star = is_nearby.T.nonzero()
        images, axis_count = stars.images, len(self._axes(node[0], stars.position_known).variance)
        pairs = Pairs(
            star, node, *(np.empty((len(star), 2, columns)) for columns in (axis_count, 5))
        )
        square = np.square(images).sum(axis=1)
        for k, rows in pairs.by_node():
            derivatives, axes = self._nodes[k].derivatives, self._axes(k, stars.position_known)
            image, mean = images[star[rows]], self._mean(k, stars, star[rows])
            along, beyond = pairs.along[rows], pairs.beyond[rows]
            along[:, 0] = image @ axes.basis[3:].T
            if stars.centre is None:
                along[:, 1] = self._image_weights(k, stars, star[rows]) @ axes.images
            else:
                along[:, 1] = mean @ axes.basis[3:].T
            # Products over all pixels, less those along the axes.
            beyond[:, 0, 0] = square[star[rows]]
            beyond[:, 0, 1] = beyond[:, 1, 0] = np.einsum("ij,ij->i", image, mean)
            beyond[:, 1, 1] = np.einsum("ij,ij->i", mean, mean)
            beyond[:, 0, 2:], beyond[:, 1, 2:] = image @ derivatives.T, mean @ derivatives.T
            beyond -= _products(along, along, axes.derivatives)
        return pairs

    def _posterior(self, stars: FieldStamps) -> StarPosterior:
        """Return the posterior of stars whose positions, and centres, are all known or all not."""
        flux, is_nearby, root_area = self._matched_filter(stars)
        # Stars of an S/N below 10 are looked at in every second node along both axes if more than
        # four of these are probable: over twice a step of an eighth of the FWHM, what is not linear
        # is 1 % of a star's peak, and the noise is 20 % of it. Such a node counts for four.
        is_coarse = is_nearby & (np.rint(self.places / self.step_px) % 2 == 0).all(axis=1)
        is_faint = (flux < 10.0 * stars.noise * root_area) & (is_coarse.sum(axis=1) > 4)
        is_nearby = np.where(is_faint[:, None], is_coarse, is_nearby)
        stars = stars._replace(
            cell_sigma_px=np.where(is_faint, 2.0, 1.0) * stars.cell_sigma_px,
            log_prior=stars.log_prior + np.where(is_faint, np.log(4.0), 0.0)[:, None],
        )
        # 1/τ², the prior precision of the factor a: a known flux has a relative σ of 1e-6.
        flux_known = np.isfinite(stars.flux) & (stars.flux > 0)
        flux_precision = np.where(flux_known, 1e-6, FLUX_SIGMA) ** -2.0
        pairs = self._projected(stars, is_nearby)
        # The noise over the flux, s, depends on the flux: two rounds of fits with a guessed flux.
        for _ in range(2):
            # A guess is that of a star of S/N 1.5 at least: s has to stay finite.
            least_flux = 1.5 * stars.noise * root_area
            unit = np.where(flux_known, stars.flux, np.maximum(flux, least_flux))
            fit = self._fitted(stars, pairs, unit, flux_precision)
            # Weights of the nodes: marginal likelihood times prior (eq. 10).
            log = np.full(is_nearby.shape, -np.inf)
            log[pairs.star, pairs.node] = fit.log_likelihood
            node_weight, evidence = mixing_weights(log + stars.log_prior)
            weight = node_weight[pairs.star, pairs.node]
            flux = unit * np.bincount(pairs.star, weight * fit.factor, len(unit))
            used = weight > 0
            pairs, weight, fit = pairs.select(used), weight[used], fit.select(used)
        # Density of the stamp in its own unit: (2π)^(−P/2) F^(−P) times that of x/F.
        evidence -= stars.images.shape[1] * np.log(np.sqrt(2 * np.pi) * unit)
        posterior = self._mixed(stars, pairs, weight, fit, unit)
        covariance = posterior.covariance
        covariance += self._photon_covariance(stars, pairs, weight, unit, flux_precision)
        # Flux and sky were in units of the guessed flux.
        units = np.stack([unit, unit, *np.ones((2, len(unit)))], axis=1)
        return posterior._replace(
            log_evidence=evidence,
            measurement=posterior.measurement * units,
            covariance=covariance * units[:, :, None] * units[:, None, :],
        )

    def _fitted(
        self, stars: FieldStamps, pairs: Pairs, unit: np.ndarray, flux_precision: np.ndarray
    ) -> PairFit:
        """Return the fit of stars, divided by their guessed flux `unit`, in their nodes."""
        count, s = len(pairs.star), np.square(stars.noise / unit)[pairs.star, None]
        scale, sigma = 1.0 / unit[pairs.star, None], stars.prior_sigma()[pairs.star]
        products, precision, log_det = (np.empty((count, *shape)) for shape in ((2, 5), (3, 3), ()))
        # Products ⟨·,·⟩ with G⁻¹, the precision Λ of the nuisance parameters, and ln det G.
        for k, rows in pairs.by_node():
            axes, along = self._axes(k, stars.position_known), pairs.along[rows]
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
        prior = flux_precision[pairs.star]
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
        self,
        stars: FieldStamps,
        pairs: Pairs,
        weight: np.ndarray,
        unit: np.ndarray,
        flux_precision: np.ndarray,
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
        flux_precision = np.where(flux_precision > FLUX_SIGMA**-2.0, flux_precision, 0.0)
        nuisance_precision = np.where(stars.prior_sigma() > 0, 0.0, 1e30)
        prior = np.column_stack([flux_precision, nuisance_precision])
        for k, rows in pairs.select(is_best).by_node():
            star = pairs.star[is_best][rows]
            axes, s = self._axes(k, stars.position_known), np.square(stars.noise / unit)[star, None]
            mean, inverse = self._mean(k, stars, star), axes.inverse(s)[:, None]
            # J: the change of the image with flux, sky, row and column; J G⁻¹.
            change = np.empty((len(star), 4, pixels))
            change[:, 0], change[:, 1:] = mean, axes.basis[:3]
            along = (change @ axes.basis[3:].T) * (inverse[..., :-1] - inverse[..., -1:])
            weighted = inverse[..., -1:] * change + along @ axes.basis[3:]
            information = weighted @ change.transpose(0, 2, 1) + prior[star, :, None] * np.eye(4)
            influence = np.linalg.solve(information, weighted)
            # V − s of a star of flux F in units of F²: g (m − mean of m) / F.
            excess = (mean - mean.mean(axis=1, keepdims=True)) / unit[star, None]
            excess *= stars.unit_per_electron[star, None]
            covariance[star] = (influence * excess[:, None]) @ influence.transpose(0, 2, 1)
        return covariance

    def _mixed(
        self,
        stars: FieldStamps,
        pairs: Pairs,
        weight: np.ndarray,
        fit: PairFit,
        unit: np.ndarray,
    ) -> StarPosterior:
        """Return the posterior of stars, mixed over their nodes by `weight` (eq. 11 to 14).

        Stars are divided by a guess of their flux, which is the unit of flux and sky. The evidence
        is left at 0.
        """
        count, pixels = stars.images.shape
        psf, square = np.zeros((2, count, pixels))
        images, s = stars.images / unit[:, None], np.square(stars.noise / unit)[:, None]
        sigma, star, factor = stars.prior_sigma(), pairs.star, fit.factor[:, None]
        # The variance of pixels depends on s and σ alone. It is computed once for all stars whose s
        # rounds to the same step of 0.1 in ln, which changes a standard deviation by 2.5 % at most.
        ln_step = 0.1
        noise_step = np.rint(np.log(s) / ln_step)
        classes = np.column_stack([noise_step, sigma])
        _, example, noise_class = np.unique(classes, axis=0, return_index=True, return_inverse=True)
        class_variance, class_sigma = np.exp(ln_step * noise_step[example]), sigma[example]
        # Nuisance parameters t of x − a m, and their derivative with respect to a.
        sigma, sky_free = sigma[star], ~stars.sky_known[star]
        nuisance = sigma * (fit.nuisance[:, 0] - factor * fit.nuisance[:, 1])
        nuisance_slope = -sigma * fit.nuisance[:, 1]
        flux, mahalanobis2 = np.empty((2, len(star)))
        gradient, precision = np.empty((len(star), 3)), fit.precision
        # If every flux is known, nothing has to be differentiated with respect to a.
        derivatives_needed = 2 - (stars.flux > 0).all()
        for k, part in pairs.by_node():
            axes, rows = self._axes(k, stars.position_known), star[part]
            beyond, along = axes.noise_fractions(s[rows])
            w, sky_share = weight[part, None], sky_free[part, None] / pixels
            image, mean = pairs.along[part].transpose(1, 0, 2)
            # Residual r = x − a m − Lᵀ t along the axes, and its score along the leading ones.
            residual = image / unit[rows, None] - factor[part] * mean
            residual = residual - nuisance[part] @ axes.derivatives
            mahalanobis2[part], gradient[part], leading = axes.leading_terms(
                residual, s[rows], sigma[part]
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
            mean = beyond * self._mean(k, stars, rows)
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
            psf[rows] += w * restored
            square[rows] += w * second_moment
        # Squared Mahalanobis distance along the leading axes, with what the other axes leave open
        # of the nuisance parameters (eq. 14).
        mahalanobis2 += (gradient * np.linalg.solve(precision, gradient[..., None])[..., 0]).sum(
            axis=1
        )
        # Flux, sky and centre of each pair, and the moments of these over the nodes.
        sky = nuisance[:, 0] - np.where(sky_free, fit.factor - flux, 0.0) / pixels
        flux = np.where(sky_free, fit.factor, flux)
        place = self.places[pairs.node] if stars.centre is None else stars.centre[star]
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
            measurement=first,
            covariance=second - first[:, :, None] * first[:, None],
            mahalanobis2=mahalanobis2,
            psf=psf / total[:, None],
            psf_sigma=psf_sigma,
        )


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


def node_step(fwhm_px: float, max_step_px: float) -> float:
    """Return the distance of two nodes in pixels for stars of this FWHM.

    It is the largest one allowed, or else 1/n of a pixel with a whole n, so that nodes have few
    phases.
    """
    step = MAX_STEP_FWHM * fwhm_px
    return max_step_px if step >= max_step_px else 1.0 / ceil(1.0 / step)


def batches_of(rows: np.ndarray) -> list[np.ndarray]:
    """Return the rows in parts of at most `STARS_AT_ONCE`."""
    return np.array_split(rows, -(-rows.size // STARS_AT_ONCE)) if rows.size else []


def phases_of(step_px: float) -> np.ndarray:
    """Return the offsets from the centre of a pixel at which nodes lie, in pixels."""
    steps = round(MARGIN_PX / step_px)
    place = step_px * np.arange(-steps, steps + 1)
    return np.unique(np.round(place - np.floor(place + 0.5), 9))


def phase_of(place: np.ndarray, phases: np.ndarray, side: int) -> tuple[int, np.ndarray]:
    """Return where the residuals of stars with a given centre are stored.

    Parameters
    ----------
    place : ndarray, shape (2,)
        Centre (row, column) from the middle pixel of a stamp.
    phases : ndarray
        Offsets of `phases_of`.
    side : int
        Side of the stamp in pixels.

    Returns
    -------
    phase : int
        Number of the phase nearest to the centre.
    window : ndarray of int, shape (side²,)
        Pixels of the frame, which has a star in its middle pixel, that are the stamp.
    """
    whole = np.floor(np.round(place, 9) + 0.5)
    row, column = np.abs((place - whole)[:, None] - phases).argmin(axis=1)
    rows, columns = (np.arange(side) + MARGIN_PX - w for w in whole.astype(int))
    window = (rows[:, None] * (side + 2 * MARGIN_PX) + columns).ravel()
    return int(row * len(phases) + column), np.asarray(window)


def _covariance_rows(covariance: np.ndarray) -> np.ndarray:
    """Return rows R with RᵀR = covariance, without those of directions that do not vary."""
    variance, axes = np.linalg.eigh(covariance)
    varies = variance > 1e-12 * max(float(variance[-1]), 1e-300)
    return np.asarray((axes * np.sqrt(np.where(varies, variance, 0.0)))[:, varies].T)
