"""Nodes of the lattice of centres: images and residuals of stars with a given centre.

The centre of a star in its stamp is a node of a square lattice that is finer than a pixel. A `Node`
has the images of the field's terms at this centre, their derivatives, and the residuals of the
training stars shifted to it. `NodeAxes` are the principal axes of the residual covariance C of a
node: along them, G = C + s is diagonal for stars of any noise variance s. Equations are numbered as
on the page docs/field_model.md.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import ceil
from typing import NamedTuple

import numpy as np

from psfdae.methods.field.spline import FieldModel

Residuals = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Mean (P,), modes (r, P) and remaining variance (P,) of the residuals of stars with one centre."""


class Node(NamedTuple):
    """Node of the lattice of centres: images and residuals of stars with this centre.

    Attributes
    ----------
    images : ndarray, shape (K + 1, P)
        Images M_k of the field's K terms, then the mean residual e₀ of the training stars.
    image_sums : ndarray, shape (K,)
        Sum ΣM_k of each term's image.
    residual_modes : ndarray, shape (r, P)
        Rows R of the residual covariance C = RᵀR + diag(`diagonal`).
    field_modes : ndarray, shape (K, P)
        Rows that the variation over the field adds to R where the position is unknown.
    derivatives : ndarray, shape (3, P)
        Rows of L: derivatives of a star of flux 1 with respect to sky, row and column.
    diagonal : ndarray, shape (P,)
        Variance of the residuals in addition to their modes.
    """

    images: np.ndarray
    image_sums: np.ndarray
    residual_modes: np.ndarray
    field_modes: np.ndarray
    derivatives: np.ndarray
    diagonal: np.ndarray

    def image_weights(self, terms: np.ndarray) -> np.ndarray:
        """Return weights (n, K + 1) of the images that add up to PSFs m (eq. 7).

        `terms` (n, K) are the terms of the field at the positions of n stars.
        """
        # p_k / Σ_k p_k ΣM_k for the terms, 1 for the mean residual.
        weights = np.ones((len(terms), len(self.images)))
        weights[:, :-1] = terms / (terms @ self.image_sums)[:, None]
        return weights


def node_step(fwhm_px: float, max_step_px: float, max_step_fwhm: float = 0.125) -> float:
    """Return the distance of two nodes in pixels for stars of this FWHM.

    It is `max_step_px`, or else 1/n of a pixel with an integer n, so that nodes have few phases. Up
    to a fraction `max_step_fwhm` of the FWHM, stars change linearly between two nodes.
    """
    step = max_step_fwhm * fwhm_px
    return max_step_px if step >= max_step_px else 1.0 / ceil(1.0 / step)


def build_nodes(
    model: FieldModel,
    side: int,
    axis_px: np.ndarray,
    mean_terms: np.ndarray,
    terms_covariance: np.ndarray,
    residuals: Iterable[Residuals],
) -> list[Node]:
    """Return the nodes of a lattice, row by row.

    Parameters
    ----------
    model : FieldModel
        PSF over the field.
    side : int
        Side of a stamp in pixels; P = side² pixels.
    axis_px : ndarray, shape (a,)
        Coordinates of the nodes along rows and columns, from the stamp's middle pixel.
    mean_terms : ndarray, shape (K,)
        Mean of the field's terms over the training stars.
    terms_covariance : ndarray, shape (K, K)
        Their covariance.
    residuals : iterable of Residuals
        Residuals of the training stars at each of the a² nodes.
    """

    def draw_lattice(terms: np.ndarray, row: float = 0.0, column: float = 0.0) -> np.ndarray:
        images = model.draw_lattice(terms, axis_px + row, axis_px + column, side)
        return images.reshape(len(terms), axis_px.size**2, -1)

    def keep_light_constant(rows: np.ndarray, mean: np.ndarray, flux: float) -> np.ndarray:
        # Change of f/F by a change δ of the image f with the light F = Σf in the stamp:
        # d(f/F) = (δ − Σδ m) / F with m = f/F.
        return np.asarray((rows - rows.sum(axis=-1, keepdims=True) * mean) / flux)

    # Images of each term in all nodes, and central differences of the mean star's image over
    # ± 0.02 px.
    term_images, mean_row, step = draw_lattice(np.eye(len(mean_terms))), mean_terms[None], 0.02
    slopes = [
        (draw_lattice(mean_row, *e) - draw_lattice(mean_row, -e[0], -e[1]))[0] / (2 * step)
        for e in ((step, 0.0), (0.0, step))
    ]
    # Rows T with TᵀT = Cov p, without directions that do not vary: T M are the changes of the image
    # with the position.
    variance, axes = np.linalg.eigh(terms_covariance)
    varies = variance > 1e-12 * max(float(variance[-1]), 1e-300)
    term_modes = np.asarray((axes * np.sqrt(np.where(varies, variance, 0.0)))[:, varies].T)
    nodes = []
    for k, (offset, modes, diagonal) in enumerate(residuals):
        # The mean star in this node, of sum 1, its residuals and its derivatives.
        images = term_images[:, k]
        image_sums = images.sum(axis=1)
        flux = float(mean_terms @ image_sums)
        mean = mean_terms @ images / flux
        residual = keep_light_constant(np.vstack([offset, modes]).astype(np.float64), mean, flux)
        shifts = keep_light_constant(np.stack([slope[k] for slope in slopes]), mean, flux)
        node = Node(
            images=np.vstack([images, residual[:1]]),
            image_sums=image_sums,
            residual_modes=residual[1:],
            field_modes=keep_light_constant(term_modes @ images, mean, flux),
            derivatives=np.vstack([np.ones_like(mean), shifts]),
            diagonal=diagonal.astype(np.float64),
        )
        nodes.append(node)
    return nodes


class NodeAxes(NamedTuple):
    """Principal axes of the residual covariance C in a node; beyond them, C is a multiple of 1.

    G = C + s is therefore diagonal along the axes for stars of every noise variance s (eq. 8).
    Noise variances, shape (n, 1), are the variances of a pixel of n stars of flux 1. `prior_sigma`,
    shape (n, 3), is the prior standard deviation of the nuisance parameters.

    Attributes
    ----------
    basis : ndarray, shape (3 + m, P)
        Derivatives of the node, then the m axes V, orthonormal, by descending variance.
    variance : ndarray, shape (m,)
        Variance λ along each axis.
    variance_beyond : float
        Mean variance λ₀ per dimension beyond the axes.
    images : ndarray, shape (K + 1, m)
        Images of the node along the axes.
    derivatives : ndarray, shape (3, m)
        Derivatives of the node along the axes.
    derivative_products : ndarray, shape (m + 1, 9)
        Products of the derivatives with each other, along each axis and beyond all axes.
    """

    basis: np.ndarray
    variance: np.ndarray
    variance_beyond: float
    images: np.ndarray
    derivatives: np.ndarray
    derivative_products: np.ndarray

    @classmethod
    def from_node(cls, node: Node, rows: np.ndarray, min_axes: int) -> NodeAxes:
        """Return the principal axes of C = RᵀR + diag(D), D the node's diagonal (eq. 8).

        They are the axes of C in the space spanned by its rows and the pixels of the largest
        diagonal (method of Rayleigh and Ritz), without eigenvectors of a P x P matrix.

        Parameters
        ----------
        node : Node
            Node with the diagonal D and the derivatives.
        rows : ndarray, shape (r, P)
            R: the node's modes of the residuals, and modes of the field if the position is unknown.
        min_axes : int
            Minimum number of axes; there are never fewer axes than rows.
        """
        # Orthonormal basis of the space: unit vectors of the pixels of the largest diagonal, and
        # the rows without these pixels, made orthonormal.
        diagonal, derivatives, pixels = node.diagonal, node.derivatives, len(node.diagonal)
        axis_count = min(max(min_axes, len(rows)), pixels)
        order = np.argsort(-diagonal, kind="stable")
        large, others = np.split(order, [axis_count - len(rows)])
        space = np.zeros((pixels, axis_count))
        space[large, np.arange(len(large))] = 1.0
        space[others, len(large) :] = np.linalg.qr(rows[:, others].T)[0]
        # Eigenvectors of C in this space, and the mean variance outside of it.
        in_space = rows @ space
        variance, rotation = np.linalg.eigh((space.T * diagonal) @ space + in_space.T @ in_space)
        sum_beyond = diagonal.sum() + np.square(rows).sum() - variance.sum()
        basis = np.vstack([derivatives, (space @ rotation[:, ::-1]).T])
        # Products of the derivatives, which every star needs: over all pixels minus along the axes.
        along = derivatives @ basis[3:].T
        products_along = (along[:, None] * along).reshape(9, -1).T
        products_beyond = derivatives @ derivatives.T - along @ along.T
        return cls(
            basis=basis,
            variance=variance[::-1].copy(),
            variance_beyond=float(sum_beyond / (pixels - axis_count))
            if axis_count < pixels
            else 1.0,
            images=node.images @ basis[3:].T,
            derivatives=along,
            derivative_products=np.vstack([products_along, products_beyond.ravel()]),
        )

    def inverse(self, noise_variance: np.ndarray) -> np.ndarray:
        """Return G⁻¹ along the axes and, last, beyond them, shape (n, m + 1) (eq. 8)."""
        return np.asarray(1.0 / (np.append(self.variance, self.variance_beyond) + noise_variance))

    def noise_fractions(self, noise_variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the fraction s G⁻¹ of a residual that is noise (eq. 13).

        The first array, (n, 1), is the fraction beyond the axes; the second one, (n, m), is the
        difference of the fraction along each axis from it.
        """
        # s G⁻¹ along the axes and, last, beyond them.
        fraction = noise_variance * self.inverse(noise_variance)
        return fraction[:, -1:], fraction[:, :-1] - fraction[:, -1:]

    def nuisance_precision(self, noise_variance: np.ndarray, prior_sigma: np.ndarray) -> np.ndarray:
        """Return Λ = 1 + σ L G⁻¹ Lᵀ σ, the inverse covariance of t/σ, (n, 3, 3) (eq. 9)."""
        # L G⁻¹ Lᵀ: products of the derivatives along each axis and beyond, weighted by G⁻¹ there.
        products = self.inverse(noise_variance) @ self.derivative_products
        products = products.reshape(-1, 3, 3)
        return np.asarray(np.eye(3) + products * (prior_sigma[:, :, None] * prior_sigma[:, None]))

    def leading_terms(
        self, residual: np.ndarray, noise_variance: np.ndarray, prior_sigma: np.ndarray, count: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the contributions of the leading axes to a fit (eq. 16).

        Parameters
        ----------
        residual : ndarray, shape (n, m)
            Residuals r of stars along the axes.
        noise_variance : ndarray, shape (n, 1)
            Noise variance s of a pixel, of stars of flux 1.
        prior_sigma : ndarray, shape (n, 3)
            Prior σ of the nuisance parameters.
        count : int
            Number of leading axes.

        Returns
        -------
        chi2 : ndarray, shape (n,)
            r G⁻¹ rᵀ.
        gradient : ndarray, shape (n, 3)
            σ L G⁻¹ rᵀ.
        precision : ndarray, shape (n, 3, 3)
            σ L G⁻¹ Lᵀ σ, the contribution to the inverse covariance of t/σ.
        """
        # G along the leading axes is diagonal: λ + s.
        residual = residual[:, :count]
        total_variance = self.variance[:count] + noise_variance
        derivatives = prior_sigma[:, :, None] * self.derivatives[:, :count]
        # σ L G⁻¹, and its products with the residual and with L σ.
        weighted_derivatives = derivatives / total_variance[:, None]
        gradient = np.einsum("nij,nj->ni", weighted_derivatives, residual)
        chi2 = (residual**2 / total_variance).sum(axis=1)
        return chi2, gradient, weighted_derivatives @ derivatives.transpose(0, 2, 1)

    def pixel_variance(self, noise_variance: np.ndarray, prior_sigma: np.ndarray) -> np.ndarray:
        """Return the posterior variance of a star's pixels if its flux is known (eq. 14).

        Shape (n, P), of stars of flux 1 without noise and sky.
        """
        fraction_beyond, fraction = self.noise_fractions(noise_variance)
        # Λ⁻¹: the covariance of the nuisance parameters over their prior σ.
        covariance = np.linalg.inv(self.nuisance_precision(noise_variance, prior_sigma))
        derivatives, axes = self.basis[:3], self.basis[3:]
        # σ L s G⁻¹: derivatives of the subtracted noise with respect to the nuisance parameters.
        rows = ((self.derivatives * fraction[:, None]).reshape(-1, len(axes)) @ axes).reshape(
            len(noise_variance), 3, -1
        )
        rows = (rows + fraction_beyond[:, None] * derivatives) * prior_sigma[:, :, None]
        pull = covariance @ rows
        # diag(C − C G⁻¹ C) = s diag(1 − s G⁻¹); then diag(Hᵀ Λ⁻¹ H), due to the uncertainty of the
        # nuisance parameters. The sky is not part of the star: its row of H is σ L s G⁻¹ − σ_sky,
        # and the square with it is written out.
        variance = noise_variance * (1.0 - fraction_beyond - fraction @ axes**2) + (
            rows * pull
        ).sum(axis=1)
        variance += (
            prior_sigma[:, :1] ** 2 * covariance[:, :1, 0] - 2 * prior_sigma[:, :1] * pull[:, 0]
        )
        return np.asarray(np.maximum(variance, 0.0))
