"""The law of stars of an image: a mixture over sub-pixel centres about a model of the field.

Bright stars give the PSF at every place (`psfdae.field_psf`) and, in what this model
leaves of them, how real stars differ from it. A star's centre c in its stamp is a node of a
square lattice, finer than a pixel. In each node a stamp x of a star of flux F on a sky b is

    x = F (a m + u·∂m + e) + b + noise,   e ~ N(0, C),   u ~ N(0, step²/12),

with the field's PSF m at this place and centre, moved by the part u of a step, and the
covariance C of the training stars' residuals, moved to c. It is of low rank beside a
diagonal, and without flux. F is a guess, the factor a is about 1, and nothing is known of b,
so that sky, centre and residuals are rows of one covariance

    S = D + LᵀL,   D = diagonal + s,   s = (noise/F)²,

a is one unknown of generalised least squares (Aitken 1935, Proc. R. Soc. Edinb. 55, 42), and
the star is what S leaves after noise and sky. Nodes count by their marginal likelihood and
by what is known of the centre. The weighted sum over the nodes is divided by its sum in the
end: a faint star's flux differs between nodes, and so does what it is divided by.

Where no position is known, m is the mean over the field and its variation is in L. A centre
that is known is one node at exactly that place.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from math import isqrt
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from psfdae.field_psf import FieldModel, slopes
from psfdae.lowrank import FLUX_SIGMA, NOISE_STEP, Kept, factorised, mixing_weights
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

LEAST_NODES, MOST_NODES = 9, 48
"""Nodes of which the likelihood is computed; a matched filter finds them."""

FAR, MATCHED_SNR = 12.0, 30.0
"""ln of the filter's likelihood below the best, from which a node is one of the fewest only; and
the S/N up to which that is asked: of brighter stars, the filter does not know the shape."""

WRONG_LIST = 0.05
"""Probability that the list, or its place, is not what it was for the training stars."""

STARS_AT_ONCE = 4096
"""Stars that are restored together."""

OUTLIER_MODES, LEAST_SEEN = 12, 1e-9
"""Leading modes that tell outliers, as the others tell the training stars from all others;
and the least variance of one over that of the noise in it."""

CACHE_BYTES = 200e6
"""Size of the factorisations that are kept for further stars."""


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
        0.5, description="Distance of the knots of the field's splines"
    )
    smoothness: Positive = Field(
        100.0, description="Of the splines: weight of their second differences"
    )
    step_px: Annotated[float, Field(gt=0, le=1)] = Field(0.25, description="Between two nodes")
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
    slope : ndarray, shape (2, P)
        Change of the mean star with row and column of its centre.
    diagonal : ndarray, shape (P,)
    """

    mean: np.ndarray
    total: np.ndarray
    rows: np.ndarray
    spread: np.ndarray
    slope: np.ndarray
    diagonal: np.ndarray


class Factor(NamedTuple):
    """S of a node at a noise variance s: S⁻¹ = diag(inverse) − lowᵀ low.

    Attributes
    ----------
    s : float
    inverse : ndarray, shape (P,)
    seen : ndarray, shape (R + K + 1, P)
        `low` and `solved`.
    means : ndarray, shape (K + 1, K + 1)
        Products of the node's `mean` with `solved`.
    half_det : float
        ½ ln det S.
    latent : ndarray, shape (3, P)
        Rows of the sky and of the centre in units of their standard deviations, which are
        `scale` (3,): 0 where they are known.
    scale : ndarray, shape (3,)
    latent_left : ndarray, shape (3, 3)
        Covariance of these once the star is seen, and a known.
    variance : ndarray, shape (P,)
        The same of the pixels of the star.
    whitening : ndarray, shape (T, T)
        Its solution for the last T of `low` times a star is white if the star is as the others.
    """

    s: float
    inverse: np.ndarray
    seen: np.ndarray
    means: np.ndarray
    half_det: float
    latent: np.ndarray
    scale: np.ndarray
    latent_left: np.ndarray
    variance: np.ndarray
    whitening: np.ndarray

    @property
    def low(self) -> np.ndarray:
        return self.seen[: -len(self.means)]

    @property
    def solved(self) -> np.ndarray:
        """S⁻¹ of the node's `mean`, shape (K + 1, P)."""
        return self.seen[-len(self.means) :]

    def solve(self, rows: np.ndarray, low: np.ndarray | None = None) -> np.ndarray:
        """S⁻¹ of rows (n, P), of which `low` times them (n, R) may be known."""
        low = rows @ self.low.T if low is None else low
        return np.asarray(rows * self.inverse - low @ self.low)


class Kind(NamedTuple):
    """What a factorisation of a node is for."""

    number: int  # of the noise variance
    positioned: bool  # the position is known
    sky: bool  # likewise
    centred: bool  # the centre is exactly known


def factor_of(node: Node, kind: Kind, part_px: float) -> Factor:
    """S of a node, a centre between two nodes being uncertain by `part_px`."""
    from scipy.linalg.blas import dtrsm

    s, pixels = float(np.exp(NOISE_STEP * kind.number)), len(node.diagonal)
    # A sky of the whole flux in each pixel is as good as unknown.
    width = np.array([0.0 if kind.sky else 1.0, *[0.0 if kind.centred else part_px] * 2])
    latent = width[:, None] * np.vstack([np.ones(pixels), node.slope])
    # Leading modes are the last ones: their law is the last block of the factor.
    spread = [] if kind.positioned else [node.spread]
    rows = np.vstack([latent, *spread, node.rows[::-1]])
    d = node.diagonal + s
    low, cholesky, half_det = factorised(d, rows)
    last = cholesky[-OUTLIER_MODES:, -OUTLIER_MODES:]
    solved = node.mean / d - (node.mean @ low.T) @ low
    factor = Factor(
        s=s,
        inverse=1.0 / d,
        seen=np.vstack([low, solved]),
        means=solved @ node.mean.T,
        half_det=half_det + float(0.5 * np.log(d).sum()),
        latent=latent,
        scale=width,
        latent_left=np.eye(3),
        variance=d,
        whitening=np.linalg.cholesky(last.T @ last - (1.0 - LEAST_SEEN) * np.eye(len(last))),
    )
    # The same as I − latent S⁻¹ latentᵀ, which loses all digits for bright stars.
    root = dtrsm(1.0, cholesky, np.eye(len(rows), 3), lower=1)
    left = root.T @ root
    inverse = factor.inverse - np.einsum("ij,ij->j", low, low)  # diagonal of S⁻¹
    sky = width[0] ** 2 * left[0, 0] - 2 * s * width[0] * factor.solve(latent[:1])[0]
    variance = s - s**2 * inverse + sky
    return factor._replace(latent_left=left, variance=np.maximum(variance, 0.0))


class Fit(NamedTuple):
    """Stars x over a guess of their flux, in nodes with their means m."""

    log: np.ndarray  # ln of the likelihood, without (2π)^(P/2)
    factor: np.ndarray  # a
    variance: np.ndarray  # of a


class Asked(NamedTuple):
    """Stars to restore; see `FieldMixture.measure`."""

    images: np.ndarray  # (n, P), sky roughly off
    noise: np.ndarray  # (n,)
    terms: np.ndarray  # (n, K)
    positioned: np.ndarray  # (n,), the position is known
    prior: np.ndarray  # (n, nodes), ln; −inf where no centre is
    centre: np.ndarray | None  # (n, 2), if it is known
    flux: np.ndarray  # (n,), NaN where to be found
    sky: np.ndarray  # (n,) of bool: the sky is off

    def of(self, chosen: np.ndarray | slice) -> Asked:
        """A part of these stars, by indices or a mask."""
        return Asked._make(None if a is None else a[chosen] for a in self)


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
    _factors: Kept[Kind, Factor] = field(default_factory=Kept, init=False, repr=False)

    # The field.

    @cached_property
    def model(self) -> FieldModel:
        """The PSF at every place."""
        coefficients = self.coefficients.astype(np.float64)
        return FieldModel(coefficients, self.low, self.high, self.settings.spacing_px)

    @property
    def order(self) -> int:
        """Order of its polynomial."""
        return self.model.order

    @property
    def side(self) -> int:
        """Side of a stamp in pixels."""
        return isqrt(self.offset.shape[-1]) - 2 * MARGIN_PX

    def _terms(self, position: np.ndarray | None, count: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Terms of the field of each star, the usual ones where no position is known, and where."""
        position = np.full((count, 2), np.nan) if position is None else position
        positioned = np.isfinite(position).all(axis=1) | (len(self.usual) == 1)
        terms = self.model.terms(np.nan_to_num(position))
        return np.where(positioned[:, None], terms, self.usual), positioned

    # The nodes.

    @cached_property
    def _axis(self) -> np.ndarray:
        """Nodes along an axis in units of a step."""
        most = round(self.settings.reach_px / self.settings.step_px)
        return np.arange(-most, most + 1)

    @cached_property
    def places(self) -> np.ndarray:
        """Centres (row, column) of the nodes from the stamp's middle pixel, shape (nodes, 2)."""
        row, column = np.meshgrid(self._axis, self._axis, indexing="ij")
        return self.settings.step_px * np.stack([row.ravel(), column.ravel()], axis=1)

    @cached_property
    def _nodes(self) -> list[Node]:
        count, side = len(self.usual), self.side
        terms, phases = np.eye(count), phases_of(self.settings.step_px)
        field_spread = _root(self.spread.reshape(count, count))
        nodes = []
        for place in self.places:
            centre = np.tile(place, (count, 1))
            images = self.model.images(terms, centre, side).reshape(count, -1)
            total = images.sum(axis=1)
            mean = self.usual @ images / (self.usual @ total)

            def lit(rows: np.ndarray, mean: np.ndarray = mean) -> np.ndarray:  # no flux in them
                return np.asarray(rows - rows.sum(axis=-1, keepdims=True) * mean)

            def draw(at: np.ndarray) -> np.ndarray:
                return self.model.images(self.usual[None], at, side)

            whole, phase = _split(place, phases)
            window = _window(side, whole)
            residuals = np.concatenate([self.offset[phase][None], self.modes[phase]])
            residuals = lit(residuals[:, window].astype(np.float64)) / (self.usual @ total)
            slope = np.concatenate(slopes(draw, place[None])).reshape(2, -1)
            nodes.append(
                Node(
                    mean=np.vstack([images, residuals[:1]]),
                    total=total,
                    rows=residuals[1:],
                    spread=lit(field_spread @ images) / (self.usual @ total),
                    slope=lit(slope) / (self.usual @ total),
                    diagonal=self.diagonal[phase][window].astype(np.float64),
                )
            )
        return nodes

    @cached_property
    def _everywhere(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means of all nodes without their average, their products, and the sums of the terms."""
        means = np.stack(
            [node.mean - node.mean.mean(axis=1, keepdims=True) for node in self._nodes]
        )
        return means, means @ means.transpose(0, 2, 1), np.stack([n.total for n in self._nodes])

    def _parts(self, k: int, stars: Asked, rows: np.ndarray) -> np.ndarray:
        """Coefficients (n, K + 1) of PSFs of sum 1 that the field has in a node, in its `mean`."""
        terms = stars.terms[rows]
        return np.hstack([terms / (terms @ self._nodes[k].total)[:, None], np.ones((len(rows), 1))])

    def _mean(
        self, k: int, factor: Factor, stars: Asked, rows: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """PSFs m (n, P) of sum 1 that the field has for some stars in a node, and S⁻¹ m."""
        node = self._nodes[k]
        if stars.centre is None:
            parts = self._parts(k, stars, rows)
            return parts @ node.mean, parts @ factor.solved
        images = self.model.images(stars.terms[rows], stars.centre[rows], self.side)
        images = images.reshape(len(rows), -1)
        mean = images / images.sum(axis=1, keepdims=True) + node.mean[-1]
        return mean, factor.solve(mean)

    def _factor(self, k: int, kind: Kind) -> Factor:
        """S of a node."""
        return self._factors(kind, k, lambda: factor_of(self._nodes[k], kind, self._part))

    @property
    def _part(self) -> float:
        """σ of a place between two nodes."""
        return float(self.settings.step_px / np.sqrt(12.0))

    # Stars.

    @cached_property
    def _list_offset(self) -> np.ndarray:
        """Offset of the field's centres from those of the training stars' list, shape (2,)."""
        known = len(self.listed) and np.isfinite(self.listed).all()
        return np.asarray(self.listed[0] if known else np.zeros(2))

    def _prior(self, listed: np.ndarray) -> np.ndarray:
        """ln of each node's probability for stars with centres of a list, or NaN, (n, nodes)."""
        step, half = self.settings.step_px, self.settings.centring_px
        box = np.clip((half + step / 2 - np.abs(self.places)) / step, 0.0, 1.0).prod(axis=1)
        prior = np.tile(box / box.sum(), (len(listed), 1))
        near = np.isfinite(listed).all(axis=1)
        if near.any() and len(self.listed) and np.isfinite(self.listed).all():
            sigma = np.hypot(self.listed[1], self._part)
            off = (self.places - listed[near, None]) / sigma
            there = np.exp(-0.5 * np.square(off).sum(axis=-1))
            total = there.sum(axis=1, keepdims=True)
            there /= np.where(total > 0, total, 1.0)
            prior[near] = WRONG_LIST * prior[near] + (1.0 - WRONG_LIST) * there
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(prior / prior.sum(axis=1, keepdims=True)))

    def _start(self, stars: Asked) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fluxes by the node that fits best, the nodes (n, nodes) to look at, and √A there."""
        means, products, totals = self._everywhere
        part = np.concatenate(
            [
                stars.terms[:, None] / (stars.terms @ totals.T)[..., None],
                np.ones((len(stars.terms), len(means), 1)),
            ],
            axis=-1,
        )
        along = (stars.images @ means.reshape(-1, means.shape[-1]).T).reshape(part.shape)
        along = (along * part).sum(axis=-1)
        square = np.einsum("nki,kij,nkj->nk", part, products, part, optimize=True)
        known = np.isfinite(stars.flux)[:, None]
        flux = np.where(known, stars.flux[:, None], np.maximum(along / square, 0.0))
        gain = flux * along - 0.5 * flux**2 * square
        variance = stars.noise[:, None] ** 2
        score = gain / variance + stars.prior
        rows, best = np.arange(len(flux)), score.argmax(axis=1)
        unclear = gain / (variance + flux**2 * square / MATCHED_SNR**2) + stars.prior
        few, most = (min(count, score.shape[1]) - 1 for count in (LEAST_NODES, MOST_NODES))
        nearest = -np.partition(-unclear, [few, most], axis=1)
        least = np.clip(unclear.max(axis=1) - FAR, nearest[:, most], nearest[:, few])
        near = np.isfinite(score) & (unclear >= least[:, None])
        near[rows, best] = True
        return flux[rows, best], near, 1.0 / np.sqrt(square[rows, best])

    def _alike(self, stars: Asked, guess: np.ndarray) -> list[np.ndarray]:
        """Numbers of stars whose kinds of factorisations are kept through all rounds."""
        number = np.log(stars.noise / np.maximum(guess, stars.noise)) * 2 / NOISE_STEP
        _, which = np.unique(number // max(1, self._most - 2), return_inverse=True)
        return [np.flatnonzero(which == index) for index in range(which.max(initial=-1) + 1)]

    def _restored(
        self, stars: Asked, guess: np.ndarray, near: np.ndarray, width: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """What stars are (n, 6 + 2P), and the covariance of four of it (n, 4, 4).

        These are evidence, flux, sky, row, column, outlier score, PSF and its σ. The rest is what
        `_start` has for these stars.
        """
        known = np.isfinite(stars.flux) & (stars.flux > 0)
        precision = np.where(known, KNOWN_FLUX_SIGMA, FLUX_SIGMA) ** -2.0
        for _ in range(FLUX_ROUNDS):
            least = LEAST_SNR * stars.noise * width
            flux = np.where(known, stars.flux, np.maximum(guess, least))
            scaled = stars._replace(images=stars.images / flux[:, None])
            number = np.rint(np.log((stars.noise / flux) ** 2) / NOISE_STEP).astype(int)
            fit = Fit(np.full(near.shape, -np.inf), np.ones(near.shape), np.ones(near.shape))
            for k, kind, rows in self._asked(stars, number, near):
                for all_nodes, found in zip(
                    fit, self._against(k, kind, scaled, rows, precision), strict=True
                ):
                    all_nodes[rows, k] = found
            weight, evidence = mixing_weights(fit.log + stars.prior)
            near = weight > 0
            guess = flux * (weight * fit.factor).sum(axis=1)
        values, covariance, outlying, psf, sigma = self._summed(scaled, number, weight, fit)
        evidence -= scaled.images.shape[1] * np.log(np.sqrt(2 * np.pi) * flux)
        unit = np.stack([flux, flux, *np.ones((2, len(flux)))], axis=1)
        found = np.hstack([evidence[:, None], values * unit, outlying[:, None], psf, sigma])
        return found, covariance * unit[:, :, None] * unit[:, None, :]

    def _asked(
        self, stars: Asked, number: np.ndarray, near: np.ndarray
    ) -> Iterator[tuple[int, Kind, np.ndarray]]:
        """Nodes, kinds of factorisations and the stars that need them."""
        known = np.stack([number, stars.positioned, stars.sky], axis=1)
        kinds, which = np.unique(known, axis=0, return_inverse=True)
        for index, (s, positioned, sky) in enumerate(kinds.tolist()):
            kind = Kind(s, bool(positioned), bool(sky), stars.centre is not None)
            (rows,) = (which.ravel() == index).nonzero()
            for k in near[rows].any(axis=0).nonzero()[0].tolist():
                yield k, kind, rows[near[rows, k]]
            self._factors.trim(self._most)

    @cached_property
    def _most(self) -> int:
        """Kinds whose factorisations are kept."""
        return max(1, int(CACHE_BYTES // sum(8 * node.rows.size for node in self._nodes)))

    def _against(
        self, k: int, kind: Kind, stars: Asked, rows: np.ndarray, precision: np.ndarray
    ) -> Fit:
        """Some stars over their guessed flux in a node: likelihood, and a with its prior."""
        factor, certain, images = self._factor(k, kind), precision[rows], stars.images[rows]
        low, along = np.split(images @ factor.seen.T, [-len(factor.means)], axis=1)
        if stars.centre is None:
            parts = self._parts(k, stars, rows)
            along, means = (np.einsum("ij,ij->i", a, parts) for a in (along, parts @ factor.means))
        else:
            mean, solved = self._mean(k, factor, stars, rows)
            along, means = (np.einsum("ij,ij->i", a, solved) for a in (images, mean))
        chi2 = np.square(images) @ factor.inverse - np.einsum("ij,ij->i", low, low)
        information, left = means + certain, along - means
        chi2 -= along + left + left**2 / information
        log = -0.5 * (chi2 + np.log(information / certain)) - factor.half_det
        # What was found before says nothing new: it is no part of the error.
        variance = 1.0 / np.where(certain > FLUX_SIGMA**-2.0, information, means)
        return Fit(log, 1.0 + left / information, variance)

    def _summed(
        self, stars: Asked, number: np.ndarray, weight: np.ndarray, fit: Fit
    ) -> tuple[np.ndarray, ...]:
        """Mean (n, 4) and covariance of flux, sky, row, column; outlier score; PSF (n, P) and σ.

        Of stars over a guess of their flux, which is the unit of flux and sky. The score is the
        square of Mahalanobis' distance in the leading modes of C, with the noise in them.
        """
        count, pixels = stars.images.shape
        first, second = np.zeros((count, 4)), np.zeros((count, 4, 4))
        star, square, inside = np.zeros((3, count, pixels))
        total = np.zeros((count, 1))
        outlying = np.zeros(count)
        for k, kind, rows in self._asked(stars, number, weight > 0):
            factor, w = self._factor(k, kind), weight[rows, k, None]
            a, variance = fit.factor[rows, k, None], fit.variance[rows, k, None]
            mean, solved = self._mean(k, factor, stars, rows)
            left = stars.images[rows] - a * mean
            low = left @ factor.low.T
            gain = factor.solve(left, low)
            latent, pull = gain @ factor.latent.T, solved @ factor.latent.T
            sky = factor.scale[0] * latent[:, :1]
            one = stars.images[rows] - factor.s * gain - sky
            change = factor.s * solved + factor.scale[0] * pull[:, :1]  # with a
            flux = one.sum(axis=1, keepdims=True)
            if not kind.sky:  # what is even in the star is sky
                more = (a - flux) / pixels
                one, sky, flux = one + more, sky - more, a
                change += (1.0 - change.sum(axis=1, keepdims=True)) / pixels
            white = np.linalg.solve(factor.whitening, low[:, -OUTLIER_MODES:].T)
            outlying[rows] += w[:, 0] * np.square(white).sum(axis=0)
            doubt = w * variance
            star[rows] += w * one
            square[rows] += w * one**2
            inside[rows] += w * factor.variance + doubt * change**2
            total[rows] += w * flux
            place = self.places[k] if stars.centre is None else stars.centre[rows]
            measured = np.hstack([flux, sky, place + factor.scale[1:] * latent[:, 1:]])
            with_a = np.hstack([np.ones_like(flux), -factor.scale * pull])
            alone = np.zeros((4, 4))
            alone[1:, 1:] = factor.scale[:, None] * factor.scale * factor.latent_left
            first[rows] += w * measured
            second[rows] += w[..., None] * (alone + measured[:, :, None] * measured[:, None, :])
            second[rows] += doubt[..., None] * with_a[:, :, None] * with_a[:, None, :]
        psf = star / total
        # Of the star as it is: the doubt about its flux is in its pixels.
        sigma = np.sqrt(np.maximum(square + inside - star**2, 0.0)) / np.abs(total)
        return first, second - first[:, :, None] * first[:, None, :], outlying, psf, sigma


def parts_of(rows: np.ndarray) -> list[np.ndarray]:
    """Rows, at most `STARS_AT_ONCE` together."""
    return np.array_split(rows, -(-rows.size // STARS_AT_ONCE)) if rows.size else []


def phases_of(step: float) -> np.ndarray:
    """Parts of a pixel at which nodes lie."""
    place = step * np.arange(-round(MARGIN_PX / step), round(MARGIN_PX / step) + 1)
    return np.unique(np.round(place - np.floor(place + 0.5), 9))


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
