"""The law of stars of an image: a mixture over sub-pixel centres about a model of the field.

Bright stars give the PSF at every place (`psfdae.field_psf`) and, in what this model
leaves of them, how real stars differ from it. A star's centre c in its stamp is a node of a
square lattice, finer than a pixel. In each node a stamp x of a star of flux F on a sky b is

    x = F (a m + u·∂m + e) + b + noise,   e ~ N(0, C),   u ~ N(0, step²/12),

with the field's PSF m at this place and centre, moved by the part u of a step, and the
covariance C of the training stars' residuals, moved to c. It is of low rank beside a
diagonal, and without flux. F is a guess, the factor a is about 1, and nothing is known of b,
so that sky and centre are rows L beside the residuals:

    S = C + s + LᵀL,   s = (noise/F)².

The eigenvectors of C do not depend on the noise. Along the leading ones of a node, C + s is
diagonal for every star, and beyond them C is taken for even; sky and centre are three unknowns
more (Woodbury's identity). a is one unknown of generalised least squares (Aitken 1935, Proc. R.
Soc. Edinb. 55, 42), and the star is what S leaves after noise and sky. Nodes count by their
marginal likelihood and by what is known of the centre; of faint stars, every second one along both
axes is enough. The weighted sum over the nodes is divided by its sum in the end: a faint star's
flux differs between nodes, and so does what it is divided by.

Where no position is known, m is the mean over the field and its variation is in C. A centre
that is known is one node at exactly that place.
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
"""Pixels around a stamp in which the field and the residuals are known, too."""

KNOWN_FLUX_SIGMA = 1e-6
"""Standard deviation of a flux that is given, over itself."""

FLUX_ROUNDS = 2
"""Times that the flux, and with it the noise over the flux, is estimated anew."""

LEAST_SNR = 1.5
"""Least S/N that a star is taken to have."""

LEAST_NODES, MOST_PX2 = 9, 3.0
"""Nodes of which the likelihood is computed, at least, and the area that they have at most; a
matched filter finds them."""

STEP_FWHM = 0.125
"""Largest step between two nodes over the FWHM: in between, stars change linearly."""

FAR, MATCHED_SNR = 8.0, 30.0
"""Nodes whose likelihood by the filter is further below the best than this, in ln, are looked at
only if they are among the `LEAST_NODES` best: most would have less than `LEAST_WEIGHT`. The filter
does not know the shape of bright stars, so that they count as stars of this S/N."""

COARSE_SNR = 10.0
"""S/N below which a star is looked at in every second node along both axes: over twice a step of
an eighth of the FWHM, what is not linear is 1 % of a star's peak, and the noise at S/N 10 is 20 %
of it."""

WRONG_LIST = 0.05
"""Probability that the list, or its place, is not what it was for the training stars."""

STARS_AT_ONCE = 1024
"""Stars that are restored together."""

OUTLIER_MODES = 12
"""Leading axes that tell outliers, as the others tell the training stars from all others."""

VARIANCE_STEP = 0.1
"""Step in ln of the noise variance between stars whose pixels are equally sure."""

AXES = 96
"""Of the covariance of the residuals in a node."""


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
    """A centre, and what a star looks like there.

    Attributes
    ----------
    mean : ndarray, shape (K + 1, P)
        Images of the field's terms; the mean residual.
    total : ndarray, shape (K,)
        Sums of the former.
    rows : ndarray, shape (r, P)
        Of C.
    spread : ndarray, shape (K, P)
        Rows that the variation over the field adds where the position is not known.
    latent : ndarray, shape (3, P)
        Change of a star of flux 1 with the sky, and with row and column of its centre.
    diagonal : ndarray, shape (P,)
    """

    mean: np.ndarray
    total: np.ndarray
    rows: np.ndarray
    spread: np.ndarray
    latent: np.ndarray
    diagonal: np.ndarray


class Axes(NamedTuple):
    """Leading axes of C in a node; beyond them, C is taken for even.

    Attributes
    ----------
    basis : ndarray, shape (3 + m, P)
        The node's `latent`; then the axes, orthonormal, by descending variance.
    variance : ndarray, shape (m,)
        Along the axes.
    rest : float
        Mean variance beyond them.
    mean, latent : ndarray, shape (K + 1, m) and (3, m)
        Those of the node along the axes.
    products : ndarray, shape (m + 1, 9)
        Of `latent` with each other along each axis, and beyond all.
    """

    basis: np.ndarray
    variance: np.ndarray
    rest: float
    mean: np.ndarray
    latent: np.ndarray
    products: np.ndarray

    def inverse(self, s: np.ndarray) -> np.ndarray:
        """1/(C + s) along the axes and beyond them, (n, m + 1), for noise of variances s (n, 1)."""
        return np.asarray(1.0 / (np.append(self.variance, self.rest) + s))

    def noise_parts(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Part s/(C + s) beyond the axes (n, 1), and by how much it differs along them (n, m)."""
        part = s * self.inverse(s)
        return part[:, -1:], part[:, :-1] - part[:, -1:]

    def certainty(self, s: np.ndarray, width: np.ndarray) -> np.ndarray:
        """Inverse covariance (n, 3, 3) of sky and centre, in their standard deviations (n, 3)."""
        products = (self.inverse(s) @ self.products).reshape(-1, 3, 3)
        return np.asarray(np.eye(3) + products * (width[:, :, None] * width[:, None]))

    def leading(
        self, along: np.ndarray, s: np.ndarray, width: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stars (n, m) along the `OUTLIER_MODES` leading axes alone, with noise of variances s.

        Their χ², (n,); their products with sky, row and column in units of these numbers' standard
        deviations (n, 3), (n, 3); what the axes add to the inverse covariance of these, (n, 3, 3).
        """
        along, scatter = along[:, :OUTLIER_MODES], self.variance[:OUTLIER_MODES] + s
        latent = width[:, :, None] * self.latent[:, :OUTLIER_MODES]
        scaled = latent / scatter[:, None]
        pull = np.einsum("nij,nj->ni", scaled, along)
        return (along**2 / scatter).sum(axis=1), pull, scaled @ latent.transpose(0, 2, 1)

    def pixel_variance(self, s: np.ndarray, width: np.ndarray) -> np.ndarray:
        """Variance (n, P) of a star without noise and sky, of known flux, once it is seen."""
        beyond, along = self.noise_parts(s)
        left = np.linalg.inv(self.certainty(s, width))
        latent, vectors = self.basis[:3], self.basis[3:]
        rows = ((self.latent * along[:, None]).reshape(-1, len(vectors)) @ vectors).reshape(
            len(s), 3, -1
        )
        rows = (rows + beyond[:, None] * latent) * width[:, :, None]
        pull = left @ rows
        noise = s * (1.0 - beyond - along @ vectors**2) + (rows * pull).sum(axis=1)
        noise += width[:, :1] ** 2 * left[:, :1, 0] - 2 * width[:, :1] * pull[:, 0]
        return np.asarray(np.maximum(noise, 0.0))


def axes_of(node: Node, positioned: bool) -> Axes:
    """Axes of a node, for stars whose position is known or is not.

    They are those of C in the space of its rows and of the pixels with the largest diagonal
    (Rayleigh and Ritz).
    """
    rows = node.rows if positioned else np.vstack([node.rows, node.spread])
    pixels = len(node.diagonal)
    kept = min(max(AXES, len(rows)), pixels)
    large = np.argsort(-node.diagonal, kind="stable")[: kept - len(rows)]
    space = np.linalg.qr(np.vstack([rows, np.eye(pixels)[large]]).T)[0]
    along = rows @ space
    variance, turn = np.linalg.eigh((space.T * node.diagonal) @ space + along.T @ along)
    beyond = node.diagonal.sum() + np.square(rows).sum() - variance.sum()
    basis = np.vstack([node.latent, (space @ turn[:, ::-1]).T])
    mean, latent = node.mean @ basis[3:].T, node.latent @ basis[3:].T
    even = node.latent @ node.latent.T - latent @ latent.T
    each = (latent[:, None] * latent).reshape(9, -1).T
    return Axes(
        basis,
        variance[::-1].copy(),
        float(beyond / (pixels - kept)) if kept < pixels else 1.0,
        mean,
        latent,
        np.vstack([each, even.ravel()]),
    )


class Pairs(NamedTuple):
    """Stars in nodes, in order of the nodes: N pairs of a star x and a node with its mean m."""

    star: np.ndarray  # (N,)
    node: np.ndarray  # (N,)
    along: np.ndarray  # (N, 2, m), x and m along the axes
    beyond: np.ndarray  # (N, 2, 5), products of both with x, m and the `latent` rows, beyond them

    def of(self, chosen: np.ndarray) -> Pairs:
        """A part of these pairs, by a mask."""
        return Pairs._make(a[chosen] for a in self)

    def by_node(self) -> Iterator[tuple[int, slice]]:
        """Nodes, and which pairs are of them."""
        nodes, first = np.unique(self.node, return_index=True)
        for k, start, stop in zip(nodes.tolist(), first, [*first[1:], len(self.node)], strict=True):
            yield k, slice(start, stop)


class Fit(NamedTuple):
    """Stars x over a guess of their flux, in nodes with their means m; N pairs.

    Products are those with (C + s)⁻¹, in which sky and centre are not.
    """

    log: np.ndarray  # (N,), ln of the likelihood, without (2π)^(P/2)
    factor: np.ndarray  # (N,), a
    variance: np.ndarray  # (N,), of a
    certain: np.ndarray  # (N, 3, 3), inverse covariance of sky and centre in σ
    left: np.ndarray  # (N, 3, 3), the covariance, once the star is seen
    pull: np.ndarray  # (N, 2, 3), mean of these for x and for m

    def of(self, chosen: np.ndarray) -> Fit:
        """That of a part of the pairs, by a mask."""
        return Fit._make(a[chosen] for a in self)


class Asked(NamedTuple):
    """Stars to restore; see `FieldMixture.measure`."""

    images: np.ndarray  # (n, P), sky roughly off
    noise: np.ndarray  # (n,)
    terms: np.ndarray  # (n, K)
    positioned: bool  # all positions are known, or none is
    prior: np.ndarray  # (n, nodes), ln; −inf where no centre is
    centre: np.ndarray | None  # (n, 2), if it is known
    flux: np.ndarray  # (n,), NaN where to be found
    sky: np.ndarray  # (n,) of bool: the sky is off
    per_photon: np.ndarray  # (n,), unit of the images for an electron; 0 where unknown
    off_node: np.ndarray  # (n,), σ of a centre about its node, per axis, in pixels; 0 where exact

    def of(self, chosen: np.ndarray | slice) -> Asked:
        """A part of these stars, by indices or a mask."""
        return Asked._make(a[chosen] if isinstance(a, np.ndarray) else a for a in self)


@dataclass(frozen=True, eq=False)
class FieldLaw:
    """A field and the residuals of its stars.

    Attributes
    ----------
    coefficients, low, high : ndarray
        Of the `FieldModel`.
    usual, spread : ndarray, shape (K,) and (K, K)
        Mean and covariance of its terms over the training stars.
    offset : ndarray, shape (f², w²)
        Mean residual at the f phases of a pixel along rows and columns, in frames of
        w = d + 2 `MARGIN_PX` pixels whose middle pixel has the star.
    modes : ndarray, shape (f², r, w²)
    diagonal : ndarray, shape (f², w²)
        Variance of the residuals beyond their modes.
    listed : ndarray, shape (2, 2)
        Mean and RMS of fitted less listed centres (row, column), in pixels; NaN if there
        was no list.
    noise : NoiseModel
    settings : FieldSettings
    free : bool
        `estimate` finds flux and sky.
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
    free: bool = False
    _made: dict[tuple[int, bool], Axes] = field(default_factory=dict, init=False, repr=False)

    # The field.

    @cached_property
    def model(self) -> FieldModel:
        """The PSF at every place."""
        coefficients = self.coefficients.astype(np.float64)
        spacing = spacing_of(self.side + 2 * MARGIN_PX, coefficients.shape[-1])
        return FieldModel(coefficients, self.low, self.high, spacing)

    @property
    def order(self) -> int:
        """Order of its polynomial."""
        return self.model.order

    @property
    def side(self) -> int:
        """Side of a stamp in pixels."""
        return isqrt(self.offset.shape[-1]) - 2 * MARGIN_PX

    def _terms(self, position: np.ndarray | None, count: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Terms of the field of each star, and where its position is known, (n,) of bool.

        They are the usual ones where it is not, and so are those of an unknown magnitude or colour.
        A star whose PSF is not known for want of these counts as one of unknown position.
        """
        place = np.full((count if position is None else len(position), 4), np.nan)
        if position is not None:
            place[:, : position.shape[1]] = position
        given, more = np.isfinite(place), self.model.of_star
        positioned = given[:, :2].all(axis=1) | (self.order == 0)
        of_place = len(self.usual) - STAR_TERMS * len(more)
        known = np.hstack(
            [
                np.repeat(positioned[:, None], of_place, axis=1),
                np.repeat(given[:, more], STAR_TERMS, axis=1),
            ]
        )
        positioned = positioned & given[:, more].all(axis=1)
        terms = self.model.terms(np.nan_to_num(place))
        return np.where(known, terms, self.usual), positioned

    # The nodes.

    @cached_property
    def step_px(self) -> float:
        """Between two nodes, for which there are residuals."""
        step, phases = self.settings.step_px, isqrt(len(self.offset))
        return step if len(phases_of(step)) == phases else 1.0 / phases

    @cached_property
    def _axis(self) -> np.ndarray:
        """Nodes along an axis in units of a step."""
        most = round(self.settings.reach_px / self.step_px)
        return np.arange(-most, most + 1)

    @cached_property
    def places(self) -> np.ndarray:
        """Centres (row, column) of the nodes from the stamp's middle pixel, shape (nodes, 2)."""
        row, column = np.meshgrid(self._axis, self._axis, indexing="ij")
        return self.step_px * np.stack([row.ravel(), column.ravel()], axis=1)

    @cached_property
    def _nodes(self) -> list[Node]:
        count, axis = len(self.usual), self.step_px * self._axis
        phases, steps = phases_of(self.step_px), ((SLOPE_PX, 0.0), (0.0, SLOPE_PX))

        def drawn(terms: np.ndarray, row: float = 0.0, column: float = 0.0) -> np.ndarray:
            images = self.model.on_lattice(terms, axis + row, axis + column, self.side)
            return images.reshape(len(terms), len(self.places), -1)

        every, usual = drawn(np.eye(count)), self.usual[None]
        slopes = [
            (drawn(usual, *e) - drawn(usual, -e[0], -e[1]))[0] / (2 * SLOPE_PX) for e in steps
        ]
        field_spread = _root(self.spread.reshape(count, count))
        nodes = []
        for k, place in enumerate(self.places):
            images = every[:, k]
            total = images.sum(axis=1)
            flux = float(self.usual @ total)
            mean = self.usual @ images / flux

            def lit(rows: np.ndarray, mean: np.ndarray = mean, flux: float = flux) -> np.ndarray:
                return np.asarray((rows - rows.sum(axis=-1, keepdims=True) * mean) / flux)

            phase, window = phase_of(place, phases, self.side)
            residuals = np.vstack([self.offset[phase, window], self.modes[phase][:, window]])
            residuals = lit(residuals.astype(np.float64))
            nodes.append(
                Node(
                    mean=np.vstack([images, residuals[:1]]),
                    total=total,
                    rows=residuals[1:],
                    spread=lit(field_spread @ images),
                    latent=np.vstack([np.ones_like(mean), lit(np.stack([s[k] for s in slopes]))]),
                    diagonal=self.diagonal[phase, window].astype(np.float64),
                )
            )
        return nodes

    @cached_property
    def _usual(self) -> tuple[np.ndarray, np.ndarray]:
        """Usual stars of sum 1 in all nodes, less their average, and their squares' sums."""
        parts = np.append(self.usual, 0.0)
        means = np.stack([parts @ node.mean / (self.usual @ node.total) for node in self._nodes])
        means += np.stack([node.mean[-1] for node in self._nodes])
        means -= means.mean(axis=1, keepdims=True)
        return means, np.square(means).sum(axis=1)

    def _parts(self, k: int, stars: Asked, rows: np.ndarray) -> np.ndarray:
        """Coefficients (n, K + 1) of PSFs of sum 1 that the field has in a node, in its `mean`."""
        terms = stars.terms[rows]
        return np.hstack([terms / (terms @ self._nodes[k].total)[:, None], np.ones((len(rows), 1))])

    def _mean(self, k: int, stars: Asked, rows: np.ndarray) -> np.ndarray:
        """PSFs (n, P) of sum 1 that the field has for some stars in a node."""
        node = self._nodes[k]
        if stars.centre is None:
            return np.asarray(self._parts(k, stars, rows) @ node.mean)
        images = self.model.images(stars.terms[rows], stars.centre[rows], self.side)
        images = images.reshape(len(rows), -1)
        return np.asarray(images / images.sum(axis=1, keepdims=True) + node.mean[-1])

    def _axes(self, k: int, positioned: bool) -> Axes:
        """Axes of a node, made once."""
        if (k, positioned) not in self._made:
            self._made[k, positioned] = axes_of(self._nodes[k], positioned)
        return self._made[k, positioned]

    @property
    def off_node_px(self) -> float:
        """σ of a place between two nodes."""
        return float(self.step_px / np.sqrt(12.0))

    # Stars.

    @cached_property
    def _list_offset(self) -> np.ndarray:
        """Offset of the field's centres from those of the training stars' list, shape (2,)."""
        known = len(self.listed) and np.isfinite(self.listed).all()
        return np.asarray(self.listed[0] if known else np.zeros(2))

    def _prior(self, listed: np.ndarray) -> np.ndarray:
        """ln of each node's probability for stars with centres of a list, or NaN, (n, nodes)."""
        step, half = self.step_px, self.settings.centring_px
        box = np.clip((half + step / 2 - np.abs(self.places)) / step, 0.0, 1.0).prod(axis=1)
        prior = np.tile(box / box.sum(), (len(listed), 1))
        near = np.isfinite(listed).all(axis=1)
        if near.any() and len(self.listed) and np.isfinite(self.listed).all():
            sigma = np.hypot(self.listed[1], self.off_node_px)
            off = (self.places - listed[near, None]) / sigma
            there = np.exp(-0.5 * np.square(off).sum(axis=-1))
            total = there.sum(axis=1, keepdims=True)
            there /= np.where(total > 0, total, 1.0)
            prior[near] = WRONG_LIST * prior[near] + (1.0 - WRONG_LIST) * there
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(prior / prior.sum(axis=1, keepdims=True)))

    def _start(self, stars: Asked) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fluxes by the node that fits best, the nodes (n, nodes) to look at, and √A there."""
        means, square = self._usual
        along = stars.images @ means.T
        known = np.isfinite(stars.flux)[:, None]
        flux = np.where(known, stars.flux[:, None], np.maximum(along / square, 0.0))
        gain = flux * along - 0.5 * flux**2 * square
        variance = stars.noise[:, None] ** 2
        score = gain / variance + stars.prior
        rows, best = np.arange(len(flux)), score.argmax(axis=1)
        unclear = gain / (variance + flux**2 * square / MATCHED_SNR**2) + stars.prior
        limits = LEAST_NODES, round(MOST_PX2 / self.step_px**2)
        few, most = (min(count, score.shape[1]) - 1 for count in limits)
        nearest = -np.partition(-unclear, [few, most], axis=1)
        least = np.clip(unclear.max(axis=1) - FAR, nearest[:, most], nearest[:, few])
        near = np.isfinite(score) & (unclear >= least[:, None])
        near[rows, best] = True
        return flux[rows, best], near, 1.0 / np.sqrt(square[best])

    def _paired(self, stars: Asked, near: np.ndarray) -> Pairs:
        """Stars in the nodes (n, nodes) that are to be looked at."""
        node, star = near.T.nonzero()
        images, kept = stars.images, len(self._axes(node[0], stars.positioned).variance)
        pairs = Pairs(star, node, *(np.empty((len(star), 2, count)) for count in (kept, 5)))
        square = np.square(images).sum(axis=1)
        for k, rows in pairs.by_node():
            latent, axes = self._nodes[k].latent, self._axes(k, stars.positioned)
            image, mean = images[star[rows]], self._mean(k, stars, star[rows])
            along, beyond = pairs.along[rows], pairs.beyond[rows]
            along[:, 0] = image @ axes.basis[3:].T
            if stars.centre is None:
                along[:, 1] = self._parts(k, stars, star[rows]) @ axes.mean
            else:
                along[:, 1] = mean @ axes.basis[3:].T
            beyond[:, 0, 0] = square[star[rows]]
            beyond[:, 0, 1] = beyond[:, 1, 0] = np.einsum("ij,ij->i", image, mean)
            beyond[:, 1, 1] = np.einsum("ij,ij->i", mean, mean)
            beyond[:, 0, 2:], beyond[:, 1, 2:] = image @ latent.T, mean @ latent.T
            beyond -= products_of(along, along, axes.latent)
        return pairs

    def _restored(
        self, stars: Asked, guess: np.ndarray, near: np.ndarray, width: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """What stars are (n, 6 + 2P), and the covariance of four of it (n, 4, 4).

        These are evidence, flux, sky, row, column, outlier score, PSF and its σ. The rest is what
        `_start` has for these stars.
        """
        # A faint star is looked at in every second node along both axes, if many are near: what is
        # not linear over twice the step is far below its noise. Such a node counts for four.
        even = near & (np.rint(self.places / self.step_px) % 2 == 0).all(axis=1)
        faint = (guess < COARSE_SNR * stars.noise * width) & (even.sum(axis=1) > 4)
        near = np.where(faint[:, None], even, near)
        stars = stars._replace(
            off_node=np.where(faint, 2.0, 1.0) * stars.off_node,
            prior=stars.prior + np.where(faint, np.log(4.0), 0.0)[:, None],
        )
        known = np.isfinite(stars.flux) & (stars.flux > 0)
        precision = np.where(known, KNOWN_FLUX_SIGMA, FLUX_SIGMA) ** -2.0
        pairs = self._paired(stars, near)
        for _ in range(FLUX_ROUNDS):
            least = LEAST_SNR * stars.noise * width
            flux = np.where(known, stars.flux, np.maximum(guess, least))
            fit = self._fitted(stars, pairs, flux, precision)
            log = np.full(near.shape, -np.inf)
            log[pairs.star, pairs.node] = fit.log
            weight, evidence = mixing_weights(log + stars.prior)
            part = weight[pairs.star, pairs.node]
            guess = flux * np.bincount(pairs.star, part * fit.factor, len(flux))
            used = part > 0
            pairs, part, fit = pairs.of(used), part[used], fit.of(used)
        values, covariance, outlying, psf, sigma = self._summed(stars, pairs, part, fit, flux)
        covariance += self._photon_covariance(stars, pairs, part, flux, precision)
        evidence -= stars.images.shape[1] * np.log(np.sqrt(2 * np.pi) * flux)
        unit = np.stack([flux, flux, *np.ones((2, len(flux)))], axis=1)
        found = np.hstack([evidence[:, None], values * unit, outlying[:, None], psf, sigma])
        return found, covariance * unit[:, :, None] * unit[:, None, :]

    def _width(self, stars: Asked) -> np.ndarray:
        """Standard deviations (n, 3) of sky, row and column before a star is seen; 0 if known."""
        # A sky of the whole flux in each pixel is as good as unknown.
        return np.stack([~stars.sky * 1.0, stars.off_node, stars.off_node], axis=1)

    def _fitted(self, stars: Asked, pairs: Pairs, flux: np.ndarray, precision: np.ndarray) -> Fit:
        """Stars over their guessed flux in nodes: likelihood, and a with its prior."""
        count, s = len(pairs.star), np.square(stars.noise / flux)[pairs.star, None]
        unit, width = 1.0 / flux[pairs.star, None], self._width(stars)[pairs.star]
        products, certain, det = (np.empty((count, *shape)) for shape in ((2, 5), (3, 3), ()))
        for k, rows in pairs.by_node():
            axes, along = self._axes(k, stars.positioned), pairs.along[rows]
            inverse = axes.inverse(s[rows])
            products[rows] = products_of(along * inverse[:, None, :-1], along, axes.latent)
            products[rows] += inverse[:, -1, None, None] * pairs.beyond[rows]
            certain[rows] = axes.certainty(s[rows], width[rows])
            more = stars.images.shape[1] - inverse.shape[1]  # axes as the last one
            det[rows] = -np.log(inverse).sum(axis=1) - more * np.log(inverse[:, -1])
        products[:, 0] *= unit
        products[:, :, 0] *= unit
        products[:, :, 2:] *= width[:, None]
        left = np.linalg.inv(certain)
        pull = products[:, :, 2:] @ left
        products[:, :, :2] -= pull @ products[:, :, 2:].transpose(0, 2, 1)
        (square, along), (_, means) = products[:, :, :2].transpose(1, 2, 0)
        prior = precision[pairs.star]
        information, off = means + prior, along - means
        chi2 = square - along - off - off**2 / information
        det += np.linalg.slogdet(certain)[1]
        log = -0.5 * (chi2 + np.log(information / prior) + det)
        # What was found before says nothing new: it is no part of the error.
        variance = 1.0 / np.where(prior > FLUX_SIGMA**-2.0, information, means)
        return Fit(log, 1.0 + off / information, variance, certain, left, pull)

    def _photon_covariance(
        self,
        stars: Asked,
        pairs: Pairs,
        weight: np.ndarray,
        unit: np.ndarray,
        precision: np.ndarray,
    ) -> np.ndarray:
        """What photons add to the covariance (n, 4, 4) of flux, sky, row and column.

        In the likelihood, a star's photons are spread evenly over its stamp; they are where its
        light is. The errors of an estimate W x, W = (J N⁻¹ Jᵀ)⁻¹ J N⁻¹ with N = C + s, have
        W (V − s) Wᵀ more if the variance of the noise is V.
        """
        count, pixels = stars.images.shape
        found = np.zeros((count, 4, 4))
        # One node of each star is enough: that of the largest weight.
        order = np.lexsort((-weight, pairs.star))
        best = np.zeros(len(weight), dtype=bool)
        best[order[np.unique(pairs.star[order], return_index=True)[1]]] = True
        best &= (stars.per_photon > 0)[pairs.star]
        if not best.any():
            return found
        # A number that is known has a prior that no data move.
        precision = np.where(precision > FLUX_SIGMA**-2.0, precision, 0.0)
        known = np.column_stack([precision, np.where(self._width(stars) > 0, 0.0, 1e30)])
        for k, rows in pairs.of(best).by_node():
            star = pairs.star[best][rows]
            axes, s = self._axes(k, stars.positioned), np.square(stars.noise / unit)[star, None]
            mean, inverse = self._mean(k, stars, star), axes.inverse(s)[:, None]
            # J: the change of the image with flux, sky, row and column; J N⁻¹.
            change = np.empty((len(star), 4, pixels))
            change[:, 0], change[:, 1:] = mean, axes.basis[:3]
            along = (change @ axes.basis[3:].T) * (inverse[..., :-1] - inverse[..., -1:])
            weighted = inverse[..., -1:] * change + along @ axes.basis[3:]
            information = weighted @ change.transpose(0, 2, 1) + known[star, :, None] * np.eye(4)
            influence = np.linalg.solve(information, weighted)
            # V − s of a star of flux F in units of F²: g (m − mean of m) / F.
            more = (mean - mean.mean(axis=1, keepdims=True)) / unit[star, None]
            more *= stars.per_photon[star, None]
            found[star] = (influence * more[:, None]) @ influence.transpose(0, 2, 1)
        return found

    def _summed(
        self, stars: Asked, pairs: Pairs, weight: np.ndarray, fit: Fit, unit: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Mean (n, 4) and covariance of flux, sky, row, column; outlier score; PSF (n, P) and σ.

        Of stars over a guess of their flux, which is the unit of flux and sky. The score is the
        square of Mahalanobis' distance along the leading axes of C, with the noise in them.
        """
        count, pixels = stars.images.shape
        psf, square = np.zeros((2, count, pixels))
        images, s = stars.images / unit[:, None], np.square(stars.noise / unit)[:, None]
        width, star, a = self._width(stars), pairs.star, fit.factor[:, None]
        # Pixels of stars of about the same noise are equally sure.
        step = np.rint(np.log(s) / VARIANCE_STEP)
        kinds = np.column_stack([step, width])
        _, one_of, kind = np.unique(kinds, axis=0, return_index=True, return_inverse=True)
        usual = np.exp(VARIANCE_STEP * step[one_of]), width[one_of]
        width, free = width[star], ~stars.sky[star]
        latent = width * (fit.pull[:, 0] - a * fit.pull[:, 1])
        with_a = -width * fit.pull[:, 1]
        flux, score = np.empty((2, len(star)))
        pull, certain, unsure = np.empty((len(star), 3)), fit.certain, 2 - (stars.flux > 0).all()
        for k, part in pairs.by_node():
            axes, rows = self._axes(k, stars.positioned), star[part]
            beyond, along = axes.noise_parts(s[rows])
            w, even = weight[part, None], free[part, None] / pixels
            image, mean = pairs.along[part].transpose(1, 0, 2)
            left = image / unit[rows, None] - a[part] * mean - latent[part] @ axes.latent
            score[part], pull[part], known = axes.leading(left, s[rows], width[part])
            certain[part] -= known
            # The star without noise and sky, and its change with a where that has a doubt.
            rest = np.stack([latent[part], with_a[part]])[:unsure]
            change = along * (mean + with_a[part] @ axes.latent)
            combined = np.concatenate([beyond * rest, [-along * left, change][:unsure]], axis=2)
            combined[..., 0] -= rest[..., 0]
            one, *changes = combined @ axes.basis
            mean = beyond * self._mean(k, stars, rows)
            one += (1.0 - beyond) * images[rows] + a[part] * mean
            flux[part] = one.sum(axis=1)
            one += even * (a[part] - flux[part, None])  # what is even in the star is sky
            some, which = np.unique(kind[rows], return_inverse=True)
            spread = axes.pixel_variance(*(known[some] for known in usual))[which]
            spread += one**2
            for slope in changes:
                change = slope + mean
                change += even * (1.0 - change.sum(axis=1, keepdims=True))
                spread += fit.variance[part, None] * change**2
            psf[rows] += w * one
            square[rows] += w * spread
        score += (pull * np.linalg.solve(certain, pull[..., None])[..., 0]).sum(axis=1)
        sky = latent[:, 0] - np.where(free, fit.factor - flux, 0.0) / pixels
        flux = np.where(free, fit.factor, flux)
        place = self.places[pairs.node] if stars.centre is None else stars.centre[star]
        measured = np.column_stack([flux, sky, place + latent[:, 1:]])
        with_a = np.hstack([np.ones_like(a), with_a])
        inside = fit.variance[:, None, None] * with_a[:, :, None] * with_a[:, None]
        inside[:, 1:, 1:] += width[:, :, None] * fit.left * width[:, None]
        inside += measured[:, :, None] * measured[:, None]
        first, second, total, score = (
            _weighted_sums(star, weight, values, count)
            for values in (measured, inside, flux, score)
        )
        # Of the star as it is: the doubt about its flux is in its pixels.
        sigma = np.sqrt(np.maximum(square - psf**2, 0.0)) / np.abs(total[:, None])
        covariance = second - first[:, :, None] * first[:, None]
        return first, covariance, score, psf / total[:, None], sigma


def _weighted_sums(
    star: np.ndarray, weight: np.ndarray, values: np.ndarray, count: int
) -> np.ndarray:
    """Weighted sums (count, …) over the pairs of each star of their values (N, …)."""
    columns = values.reshape(len(star), -1).T
    sums = [np.bincount(star, weight * column, count) for column in columns]
    return np.stack(sums, axis=1).reshape(count, *values.shape[1:])


def products_of(weighted: np.ndarray, along: np.ndarray, latent: np.ndarray) -> np.ndarray:
    """Products (n, 2, 5) of two weighted vectors (n, 2, m) with both, and with rows (3, m)."""
    found = np.empty((len(along), 2, 5))
    found[..., :2] = np.einsum("nim,njm->nij", weighted, along)
    found[..., 2:] = (weighted.reshape(-1, weighted.shape[-1]) @ latent.T).reshape(-1, 2, 3)
    return found


def step_of(fwhm_px: float, most_px: float) -> float:
    """Step between two nodes in pixels, a whole part of one if it is not the largest."""
    wanted = STEP_FWHM * fwhm_px
    return most_px if wanted >= most_px else 1.0 / ceil(1.0 / wanted)


def parts_of(rows: np.ndarray) -> list[np.ndarray]:
    """Rows, at most `STARS_AT_ONCE` together."""
    return np.array_split(rows, -(-rows.size // STARS_AT_ONCE)) if rows.size else []


def phases_of(step: float) -> np.ndarray:
    """Parts of a pixel at which nodes lie."""
    place = step * np.arange(-round(MARGIN_PX / step), round(MARGIN_PX / step) + 1)
    return np.unique(np.round(place - np.floor(place + 0.5), 9))


def phase_of(place: np.ndarray, phases: np.ndarray, side: int) -> tuple[int, np.ndarray]:
    """Number of the phase nearest to a centre (row, column), and its stamp's pixels in a frame."""
    whole, phase = _split(place, phases)
    return phase, _window(side, whole)


def _split(place: np.ndarray, phases: np.ndarray) -> tuple[np.ndarray, int]:
    """Whole pixels (row, column) of a node and the number of its phase."""
    whole = np.floor(np.round(place, 9) + 0.5)
    row, column = np.abs((place - whole)[:, None] - phases).argmin(axis=1)
    return whole.astype(int), int(row * len(phases) + column)


def _window(side: int, whole: np.ndarray) -> np.ndarray:
    """Pixels of a frame that are a stamp of a star so many pixels off its middle."""
    rows, columns = (np.arange(side) + MARGIN_PX - w for w in whole)
    return np.asarray((rows[:, None] * (side + 2 * MARGIN_PX) + columns).ravel())


def _root(covariance: np.ndarray) -> np.ndarray:
    """Rows L with LᵀL = covariance, those of directions that do not vary left out."""
    variance, axes = np.linalg.eigh(covariance)
    real = variance > 1e-12 * max(float(variance[-1]), 1e-300)
    return np.asarray((axes * np.sqrt(np.where(real, variance, 0.0)))[:, real].T)
