"""Prior distribution of the stars of a field: PSF at their position, residuals, and centres.

Bright stars determine the PSF at every position in the field (`psfdae.methods.field.spline`). Their
residuals give the covariance by which real stars differ from this model
(`psfdae.methods.field.residuals`). The centre of a star in its stamp is a node of a square lattice
that is finer than a pixel (`psfdae.methods.field.nodes`). In each node, a stamp x of a star of flux
F is (eq. 6)

    x = F (a m + Lᵀ t + e) + noise,   e ~ N(0, C),   t ~ N(0, diag(σ²)),

with the field's PSF m (sum 1) at this position and centre, the factor a ~ N(1, 0.2²) of a guessed
flux, and the three nuisance parameters t: sky over flux, row and column of the centre within the
cell of its node. The rows of L are the derivatives of the image with respect to t. C is the
covariance of the training stars' residuals at this centre, of low rank plus a diagonal.

Equations are numbered as on the page docs/field_model.md, which derives them. Where the position is
unknown, m is the mean over the field, and its variation over the field is part of C. A known centre
is a single node at exactly this position. `psfdae.methods.field.posterior` computes the posterior
of stars under this prior.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from math import isqrt
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from psfdae.base.settings import Count, Fraction, Group, Positive
from psfdae.methods.field.nodes import Node, NodeAxes, Residuals, build_nodes
from psfdae.methods.field.residuals import MARGIN_PX, find_phase, list_phases
from psfdae.methods.field.spline import STAR_TERMS, FieldModel, compute_spacing
from psfdae.stars.noise import NoiseModel


@dataclass(frozen=True)
class PosteriorLimits:
    """Limits of the posterior of a star, which save time and memory with little loss of accuracy.

    Attributes
    ----------
    min_nodes : int
        Minimum number of nodes whose likelihood is computed for a star.
    max_node_area_px2 : float
        Maximum area in px² of the nodes whose likelihood is computed for a star.
    min_axes : int
        Minimum number of principal axes of the residual covariance at each node.
    outlier_axes : int
        Number of leading axes in the outlier score: the others do not distinguish outliers from
        training stars.
    stars_at_once : int
        Maximum number of stars that are processed together, which limits the memory.
    """

    min_nodes: int = 9
    max_node_area_px2: float = 3.0
    min_axes: int = 64
    outlier_axes: int = 12
    stars_at_once: int = 2048


class FieldSettings(Group):
    """Mixture about a model of the field.

    Models that are older than a setting have its default.
    """

    orders: Annotated[list[Annotated[int, Field(ge=0, le=10)]], Field(min_length=1)] = Field(
        [0, 1, 2, 3, 4, 6, 8]
    )
    """Orders of the polynomial in the position, tried upwards until the next one does not improve
    the prediction of left-out stars."""
    spacing_px: Annotated[float, Field(gt=0.1, le=2)] = 0.5
    """Minimum distance of the knots of the field's splines."""
    smoothness: Positive = 100.0
    """Smoothness of the splines: weight of their second differences."""
    step_px: Annotated[float, Field(gt=0, le=1)] = 0.25
    """Maximum distance of two nodes; smaller where stars are undersampled."""
    reach_px: Annotated[float, Field(gt=0, lt=MARGIN_PX)] = 1.75
    """Distance, per axis, of the outermost nodes from the stamp's middle."""
    centring_px: Annotated[float, Field(gt=0, lt=MARGIN_PX)] = 1.5
    """Largest distance, per axis, of centres from the stamp's middle."""
    modes: Count = 40
    """Leading modes of the residuals."""
    diagonal: Fraction = 0.2
    """Fraction of their variance that is assigned to single pixels."""
    threads: Count = 1
    """Threads of the linear algebra."""


@dataclass(frozen=True, eq=False, repr=False)
class FieldPrior:
    """Distribution of the stars of an image: the PSF over the field, and residuals about it.

    Attributes
    ----------
    coefficients, low, high : ndarray
        Arrays of the `FieldModel`.
    mean_terms, terms_covariance : ndarray, shape (K,) and (K, K)
        Mean and covariance of the terms of the field over the training stars.
    offset : ndarray, shape (f², w²)
        Mean residual at the f phases of a pixel along rows and columns, in frames of
        w = d + 2 `MARGIN_PX` pixels per side with the star in the middle pixel.
    modes : ndarray, shape (f², r, w²)
        Principal modes of the residuals in each phase, each times its standard deviation.
    diagonal : ndarray, shape (f², w²)
        Variance of the residuals in addition to their modes.
    list_error : ndarray, shape (2, 2)
        Mean and RMS of fitted minus listed centres (row, column), in pixels; NaN without a
        list.
    noise : NoiseModel
        Noise of the training.
    settings : FieldSettings
        Settings of the fit, with the distance and reach of the nodes.
    limits : PosteriorLimits
        Limits of time and memory.
    """

    coefficients: np.ndarray
    low: np.ndarray
    high: np.ndarray
    mean_terms: np.ndarray
    terms_covariance: np.ndarray
    offset: np.ndarray
    modes: np.ndarray
    diagonal: np.ndarray
    list_error: np.ndarray
    noise: NoiseModel
    settings: FieldSettings
    limits: PosteriorLimits = PosteriorLimits()
    _axes_cache: dict[tuple[int, bool], NodeAxes] = field(
        default_factory=dict, init=False, repr=False
    )

    # The field.

    @cached_property
    def model(self) -> FieldModel:
        """The PSF at every position in the field (eq. 1)."""
        # Knots cover the frame, a stamp with its margin.
        coefficients = self.coefficients.astype(np.float64)
        spacing = compute_spacing(self.side + 2 * MARGIN_PX, coefficients.shape[-1])
        return FieldModel(coefficients, self.low, self.high, spacing)

    @property
    def order(self) -> int:
        """Order of the field's polynomial in x and y."""
        return self.model.order

    @property
    def side(self) -> int:
        """Side of a stamp in pixels."""
        return isqrt(self.offset.shape[-1]) - 2 * MARGIN_PX

    def terms(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the terms of the field for each star, and whether its position is known.

        Terms of an unknown position, magnitude or colour are their mean over the training stars.
        The position of a star is unknown if any coordinate on which the PSF depends is unknown.

        Parameters
        ----------
        position : ndarray, shape (n, 2) to (n, 4)
            x, y, magnitude and colour; NaN where unknown.

        Returns
        -------
        terms : ndarray, shape (n, K)
            Terms of the polynomial.
        position_known : ndarray of bool, shape (n,)
            True if all coordinates on which the PSF depends are known.
        """
        # Coordinates that are left out are unknown.
        coordinates = np.full((len(position), 4), np.nan)
        coordinates[:, : position.shape[1]] = position
        # Terms of x and y first, then two of each star property that changes the PSF.
        is_known, properties = np.isfinite(coordinates), self.model.star_coordinates
        place_known = is_known[:, :2].all(axis=1) | (self.order == 0)
        property_known = is_known[:, properties]
        place_terms = len(self.mean_terms) - STAR_TERMS * len(properties)
        term_known = np.repeat(
            np.column_stack([place_known, property_known]),
            [place_terms, *[STAR_TERMS] * len(properties)],
            axis=1,
        )
        position_known = place_known & property_known.all(axis=1)
        terms = self.model.terms(np.nan_to_num(coordinates))
        return np.where(term_known, terms, self.mean_terms), position_known

    def psf_at(self, position: np.ndarray, oversampling: int = 1) -> np.ndarray:
        """Return the field's PSFs at positions, drawn by `FieldModel.images`.

        The star is at its sub-pixel phase in the middle pixel. Its flux is the same at every phase
        (eq. 1a), and such that a star in the middle of its pixel has the sum 1 in its stamp. Light
        of the wings may cross the edge of the stamp as the phase changes.

        Parameters
        ----------
        position : ndarray, shape (n, 2) to (n, 4)
            x, y, magnitude and colour, as in the star list of the training; the PSF is the mean
            over coordinates that are NaN.
        oversampling : int
            Values per pixel along each axis, ≥ 1.

        Returns
        -------
        ndarray, shape (n, m, m)
            PSFs; m as in `FieldModel.images`.
        """
        terms = self.terms(position)[0]
        return self.model.psfs(terms, position, self.list_offset, self.side, oversampling)

    def conditions(self) -> Iterator[tuple[str, str, ArrayLike]]:
        """Yield conditions that any fit fulfils: a mean star of sum 1, and smaller residuals.

        Each has the name of an array in files, the condition in words, and whether it is fulfilled.
        """
        terms, mean_terms, spread = len(self.coefficients), self.mean_terms, self.terms_covariance
        mean_star = self.model.images(mean_terms[None], np.zeros((1, 2)), self.side)
        yield "coefficients", "a mean star of the sum 1", abs(mean_star.sum() - 1) < 0.1
        has_shape = self.low.shape == self.high.shape and 2 <= len(self.low) <= 4
        yield "high", "at least low", has_shape and self.low <= self.high
        yield "usual", "terms from -1 to 1", mean_terms.shape == (terms,) and abs(mean_terms) <= 1
        eigenvalue = np.linalg.eigvalsh(spread)[0] if spread.shape == (terms, terms) else -1.0
        yield "spread", "a covariance", (spread == spread.T) & (eigenvalue > -1e-6)
        yield "modes", "squares below 1", np.square(self.modes, dtype=float).sum(axis=1) < 1
        yield "offset", "numbers from -1 to 1", abs(self.offset) <= 1
        yield "diagonal", "numbers from 0 to 1", (self.diagonal > 0) & (self.diagonal < 1)
        yield "listed", "an error above 0, if any", self.list_error[1:] > 0

    def is_outside_range(self, position: np.ndarray) -> np.ndarray:
        """Return True for stars (n, 4) with magnitude or colour outside of the training range."""
        return self.model.is_outside_range(position)

    def facts(self) -> dict[str, str]:
        """Return titles and sentences on the dependence of the PSF on position and star."""
        return self.model.facts()

    # The nodes.

    @cached_property
    def step_px(self) -> float:
        """Distance of two nodes in pixels, the distance of the phases of the residuals."""
        # The setting, or 1/n of a pixel where stars are undersampled (`node_step`); the number of
        # phases of the residuals decides.
        step, phases = self.settings.step_px, isqrt(len(self.offset))
        return step if len(list_phases(step)) == phases else 1.0 / phases

    @property
    def axis_px(self) -> np.ndarray:
        """Coordinates of the nodes along rows and columns, from the stamp's middle pixel, (a,)."""
        outermost = round(self.settings.reach_px / self.step_px)
        return self.step_px * np.arange(-outermost, outermost + 1)

    @cached_property
    def places(self) -> np.ndarray:
        """Centres (row, column) of the nodes from the stamp's middle pixel, shape (nodes, 2)."""
        rows_and_columns = np.meshgrid(self.axis_px, self.axis_px, indexing="ij")
        return np.stack([np.ravel(a) for a in rows_and_columns], axis=1)

    def residuals_at(self, centre: np.ndarray) -> Residuals:
        """Return the residuals of training stars in a stamp whose star has this centre, (2,)."""
        phase, window = find_phase(centre, list_phases(self.step_px), self.side)
        return (
            self.offset[phase, window],
            self.modes[phase][:, window],
            self.diagonal[phase, window],
        )

    @cached_property
    def nodes(self) -> list[Node]:
        """All nodes, in the order of `places`."""
        count, residuals = len(self.mean_terms), map(self.residuals_at, self.places)
        terms = self.mean_terms, self.terms_covariance.reshape(count, count)
        return build_nodes(self.model, self.side, self.axis_px, *terms, residuals)

    @cached_property
    def filters(self) -> tuple[np.ndarray, np.ndarray]:
        """Matched filters m̄ of all nodes, (nodes, P), and the sum of squares of each, (nodes,).

        A filter is the mean star of sum 1 minus its average over the stamp, so that its product
        with a flat sky is 0 (eq. 18).
        """
        # m of the mean terms (eq. 7): the field's PSF, then the mean residual.
        parts = np.append(self.mean_terms, 0.0)
        means = np.stack(
            [parts @ node.images / (self.mean_terms @ node.image_sums) for node in self.nodes]
        )
        means += np.stack([node.images[-1] for node in self.nodes])
        means -= means.mean(axis=1, keepdims=True)
        return means, np.square(means).sum(axis=1)

    def node_psfs(self, k: int, terms: np.ndarray, centre: np.ndarray | None) -> np.ndarray:
        """Return the field's PSFs m, (n, P), of sum 1, for n stars in node k (eq. 7).

        Parameters
        ----------
        k : int
            Index of the node.
        terms : ndarray, shape (n, K)
            Terms of the field at the positions of the stars.
        centre : ndarray, shape (n, 2), or None
            Centres of the stars if they are known; None for the centre of the node.
        """
        node = self.nodes[k]
        # At a known centre, the field is drawn there; residuals are taken from the node.
        if centre is None:
            return np.asarray(node.image_weights(terms) @ node.images)
        images = self.model.images(terms, centre, self.side).reshape(len(terms), -1)
        return np.asarray(images / images.sum(axis=1, keepdims=True) + node.images[-1])

    def node_axes(self, k: int, position_known: bool) -> NodeAxes:
        """Return the principal axes of node k (eq. 8); they are cached.

        Where the position is unknown, C includes the variation over the field.
        """
        # Eigenvectors take far more time than the other computations of a node.
        if (k, position_known) not in self._axes_cache:
            node = self.nodes[k]
            rows = [node.residual_modes, *[node.field_modes] * (not position_known)]
            axes = NodeAxes.from_node(node, np.vstack(rows), self.limits.min_axes)
            self._axes_cache[k, position_known] = axes
        return self._axes_cache[k, position_known]

    @property
    def cell_sigma_px(self) -> float:
        """σ of a centre about its node along an axis, uniform in a cell of one step."""
        # The variance of a uniform distribution of width h is h²/12.
        return float(self.step_px / np.sqrt(12.0))

    # The stars.

    @property
    def has_list_error(self) -> bool:
        """True if the offset and the error of the training stars' list are known."""
        return bool(len(self.list_error) and np.isfinite(self.list_error).all())

    @cached_property
    def list_offset(self) -> np.ndarray:
        """Offset of the field's centres from the training stars' list, shape (2,)."""
        return np.asarray(self.list_error[0] if self.has_list_error else np.zeros(2))
