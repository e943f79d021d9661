"""Law of the stars of a field: the PSF at their place, residuals about it, and their centres.

Bright stars give the PSF at every place of the field (`psfdae.methods.field_spline`). What this
model leaves of them gives the covariance by which real stars differ from it. The centre of a star
in its stamp is a node of a square lattice that is finer than a pixel. In each node, a stamp x of a
star of flux F is

    x = F (a m + Lᵀ t + e) + noise,   e ~ N(0, C),   t ~ N(0, diag(σ²)),

with the field's PSF m (sum 1) at this place and centre, the factor a ~ N(1, 0.2²) of a guessed
flux, and the three nuisance parameters t: sky over flux, row and column of the centre within the
cell of its node. The rows of L are the derivatives of the image with respect to these. C is the
covariance of the training stars' residuals at this centre, of low rank beside a diagonal.

Equations are numbered as on the page docs/field_model.md, which derives them. Where no position is
known, m is the mean over the field, and its variation over the field is part of C. A centre that
is known is one node at exactly that place. The posterior of stars by this law is in
`psfdae.methods.field_posterior`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from math import ceil, isqrt
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from psfdae.methods.field_spline import SLOPE_PX, STAR_TERMS, FieldModel, spacing_of
from psfdae.methods.gaussians import NodeAxes
from psfdae.noise import NoiseModel
from psfdae.settings import Count, Fraction, Group, Positive

MARGIN_PX = 2
"""Width in pixels of the margin around a stamp in which field and residuals are known as well."""


@dataclass(frozen=True)
class PosteriorLimits:
    """Limits of the posterior of a star, which save time and memory where more hardly counts.

    Attributes
    ----------
    min_nodes : int
        Number of nodes per star of which the likelihood is computed at least.
    max_node_area_px2 : float
        Area in px² of the nodes of which the likelihood of one star is computed at most.
    min_axes : int
        Number of principal axes of the residual covariance that are kept at each node, at least.
    outlier_axes : int
        Number of leading axes that enter the outlier score: the others do not distinguish outliers
        from training stars.
    stars_at_once : int
        Number of stars that are restored together at most, which limits the memory.
    """

    min_nodes: int = 9
    max_node_area_px2: float = 3.0
    min_axes: int = 96
    outlier_axes: int = 12
    stars_at_once: int = 1024


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

    def image_weights(self, terms: np.ndarray) -> np.ndarray:
        """Return weights (n, K + 1) of the images that add up to PSFs m of sum 1.

        `terms` are those of the field at the positions of n stars, (n, K).
        """
        sums = (terms @ self.image_sums)[:, None]
        return np.hstack([terms / sums, np.ones((len(terms), 1))])


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
    limits : PosteriorLimits
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
    limits: PosteriorLimits = PosteriorLimits()
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

    def terms(self, position: np.ndarray | None, count: int = 0) -> tuple[np.ndarray, np.ndarray]:
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
    def nodes(self) -> list[Node]:
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
    def filters(self) -> tuple[np.ndarray, np.ndarray]:
        """Matched filters of all nodes, (nodes, P), and the sum of squares of each, (nodes,).

        A filter is the mean star of sum 1 less its average over the stamp, so that a flat sky
        gives nothing.
        """
        parts = np.append(self.usual, 0.0)
        means = np.stack(
            [parts @ node.images / (self.usual @ node.image_sums) for node in self.nodes]
        )
        means += np.stack([node.images[-1] for node in self.nodes])
        means -= means.mean(axis=1, keepdims=True)
        return means, np.square(means).sum(axis=1)

    def node_psfs(self, k: int, terms: np.ndarray, centre: np.ndarray | None) -> np.ndarray:
        """Return the field's PSFs m, (n, P), of sum 1, for n stars in node k (eq. 5).

        Parameters
        ----------
        k : int
        terms : ndarray, shape (n, K)
            Terms of the field at the positions of the stars.
        centre : ndarray, shape (n, 2), or None
            Centres of the stars if they are known; otherwise that of the node is theirs.
        """
        node = self.nodes[k]
        if centre is None:
            return np.asarray(node.image_weights(terms) @ node.images)
        images = self.model.images(terms, centre, self.side).reshape(len(terms), -1)
        return np.asarray(images / images.sum(axis=1, keepdims=True) + node.images[-1])

    def node_axes(self, k: int, position_known: bool) -> NodeAxes:
        """Return the principal axes of node k (eq. 6), which are computed once.

        Where no position is known, C has the variation over the field as well.
        """
        if (k, position_known) not in self._axes_cache:
            node = self.nodes[k]
            rows = (
                [node.residual_modes] if position_known else [node.residual_modes, node.field_modes]
            )
            self._axes_cache[k, position_known] = NodeAxes.of(
                np.vstack(rows), node.diagonal, node.derivatives, node.images, self.limits.min_axes
            )
        return self._axes_cache[k, position_known]

    @property
    def cell_sigma_px(self) -> float:
        """σ of a centre about its node, along an axis: uniform in a cell of one step."""
        return float(self.step_px / np.sqrt(12.0))

    # The stars.

    @cached_property
    def list_offset(self) -> np.ndarray:
        """Offset of the field's centres from those of the training stars' list, shape (2,)."""
        known = len(self.listed) and np.isfinite(self.listed).all()
        return np.asarray(self.listed[0] if known else np.zeros(2))

    def log_prior(self, listed: np.ndarray) -> np.ndarray:
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


def node_step(fwhm_px: float, max_step_px: float, max_step_fwhm: float = 0.125) -> float:
    """Return the distance of two nodes in pixels for stars of this FWHM.

    It is the largest one allowed, or else 1/n of a pixel with a whole n, so that nodes have few
    phases. Up to `max_step_fwhm` of the FWHM, stars change linearly between two nodes.
    """
    step = max_step_fwhm * fwhm_px
    return max_step_px if step >= max_step_px else 1.0 / ceil(1.0 / step)


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
