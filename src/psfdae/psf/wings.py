"""`Wings`: light of stars outside the stamps of a model.

The model gives the light of a star within its stamp, above a sky that is measured in a ring around
it. The rest is one profile for all stars: a star of flux F has

    F s (p_0 h_0 + Σ_k p_k h_k(r))

more in a pixel, with h_0 = 1 in its stamp and 0 elsewhere, tents h_k in ln r times a power of r
outside of the stamp, r the distance from its centre, and s the light of the model's PSF in the
outer part of its stamp divided by the mean of all stars: where the PSF is wider, it has more wings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from psfdae.base.errors import keyword
from psfdae.image.fits_file import Card
from psfdae.stars.bright_stars import magnitude


@dataclass(frozen=True)
class Wings:
    """Light of stars beyond what their model knows.

    Attributes
    ----------
    radius_px : ndarray, shape (K,)
        r_1 … r_K: tops of the K − 1 tents, r_1 half the side of the stamp; the light ends at
        r_K.
    profile : ndarray, shape (K,)
        p_0 … p_{K−1}, fractions of the flux in a pixel: p_0 in the stamp, p_k (r_k/r_1)^-3 at r_k.
    covariance : ndarray, shape (K, K)
        Covariance of the numbers p of `profile`.
    outer_share : float
        Mean of the stars' `outer_shares`, for which s = 1.
    outer_part_from : float
        Radius at which the outer part of a stamp begins, as a fraction of half its side.
    steepness : float
        Power of 1/r in the tents, as of light that mirrors and air scatter.
    """

    outer_part_from: ClassVar[float] = 0.7
    steepness: ClassVar[float] = 3.0

    radius_px: np.ndarray
    profile: np.ndarray
    covariance: np.ndarray
    outer_share: float

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """Return wings from the lists and numbers of `plain`.

        Raises
        ------
        ValueError
            If one is missing, they do not fit together, or their light exceeds ten times the
            star's.
        """
        # A number of another type, or one that is missing, is as wrong as one that does not fit.
        names = ("radius_px", "profile", "covariance")
        try:
            arrays = {name: np.array(plain[name], dtype=np.float64) for name in names}
            wings = cls(**arrays, outer_share=float(plain["outer_share"]))
        except (TypeError, LookupError, ArithmeticError) as error:
            raise ValueError(f"wings without {error}") from None
        radius, count = wings.radius_px, wings.profile.size
        shapes = [a.shape for a in (wings.profile, radius, wings.covariance)]
        if count < 2 or shapes != [(count,), (count,), (count, count)]:
            raise ValueError("wings whose numbers do not fit together")
        # No wings reach beyond 100 000 px, or have ten times the light of the star.
        is_rising = radius[0] > 0 and (np.diff(radius) > 0).all() and radius[-1] < 1e5
        with np.errstate(all="ignore"):
            light, light_sigma = wings.light() if is_rising else (np.nan, np.nan)
        is_scaled = 0.0 < wings.outer_share < np.inf
        if not (is_scaled and abs(light) < 10.0 and np.isfinite(light_sigma)):
            raise ValueError("wings whose light is not a fraction of a star's")
        return wings

    def plain(self) -> dict[str, Any]:
        """Return lists and numbers, for a bundle."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}

    def scale(self, outer_share: np.ndarray) -> np.ndarray:
        """Return s of stars with these `outer_shares` (n,), 1 where they are not known (NaN)."""
        ratio = np.where(np.isfinite(outer_share), outer_share / self.outer_share, 1.0)
        # A factor of three in either direction cannot be a PSF of the same telescope.
        return np.asarray(np.clip(ratio, 0.3, 3.0))

    def total_over_flux(self, outer_share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ratio of flux_total to flux of stars with these `outer_shares` (n,).

        Returns
        -------
        ratio, error : ndarray, shape (n,)
            The ratio, and its standard error. Half of the change of wings with the PSF counts as
            an error.
        """
        # 1 + s L, with the errors s σ_L and (s − 1) L / 2.
        scale = self.scale(outer_share)
        light, error = self.light()
        return 1.0 + scale * light, np.hypot(scale * error, 0.5 * (scale - 1.0) * light)

    def differs_from(self, wings: Wings) -> bool:
        """Return True if the light differs by more than 3 σ from the light of these wings."""
        (light, error), (wing_light, wing_error) = self.light(), wings.light()
        return abs(light - wing_light) > 3.0 * float(np.hypot(error, wing_error))

    def light(self, radius_px: float = np.inf) -> tuple[float, float]:
        """Return the light that the model lacks within a radius in px, and its standard error.

        Both are fractions of the flux of a star with s = 1.
        """
        # ∫ 2π r (h_0 p_0 + Σ h_k p_k) dr.
        half = self.radius_px[0]
        r = np.linspace(0.0, min(radius_px, self.radius_px[-1]), 4001)
        # Fraction of a circle outside of the stamp, a square with half the side h:
        # 4/π arccos(h/r), at most 1.
        outside = np.clip(np.arccos(np.minimum(half / np.maximum(r, half), 1.0)) * 4 / np.pi, 0, 1)
        height = np.concatenate([1.0 - outside[None], outside * tents(r, self.radius_px)])
        area = np.trapezoid(2 * np.pi * r * height, r, axis=1)
        return float(self.profile @ area), float(np.sqrt(area @ self.covariance @ area))

    def cards(self) -> list[Card]:
        """Return cards for a FITS header: radius of all light, and part of it in the model."""
        return [
            ("FLUXRAD", float(self.radius_px[-1]), "[pix] all light of a star is within it"),
            ("INMODEL", 1.0 / (1.0 + self.light()[0]), "part of it in the model, usual star"),
        ]

    def __repr__(self) -> str:
        return f"Wings({self})"

    def __str__(self) -> str:
        light, error = self.light()
        sentence = (
            f"{100 * light:.2f} ± {100 * error:.2f} % of the flux in the stamp of a usual star, "
            f"out to {self.radius_px[-1]:.3g} px"
        )
        if light / (1.0 + light) > 0.2:
            sentence += (
                f"; over a fifth of the flux: try wider stamps ({keyword('stamp_px')}), or a list "
                "without sources other than stars"
            )
        return sentence

    @classmethod
    def join(cls, several: Sequence[Wings]) -> Wings:
        """Average the wings of several images with one model, weighted by 1/σ² of their light."""
        weight = np.array([wings.light()[1] ** -2.0 for wings in several])
        weight /= weight.sum()
        # Each profile is rescaled to the mean outer share, to which the p of s = 1 is proportional.
        # The images are independent: C = Σ w² C_i.
        outer_share = float(weight @ [wings.outer_share for wings in several])
        weight *= [outer_share / wings.outer_share for wings in several]
        profile = np.tensordot(weight, [wings.profile for wings in several], 1)
        covariance = np.tensordot(weight**2, [wings.covariance for wings in several], 1)
        return cls(several[0].radius_px, profile, covariance, outer_share)

    @property
    def is_measured(self) -> bool:
        """True if pixels of the image made the error of the light less than half the prior's."""
        sigma = compute_prior_profile(self.radius_px, self.outer_share)[1]
        return self.light()[1] < 0.5 * replace(self, covariance=np.diag(sigma**2)).light()[1]


def choose_wings(wings: Wings | None, trained_wings: Wings | None) -> Wings | None:
    """Return the wings of an image, or of the training if no star of the image shows them."""
    if trained_wings is None or (wings is not None and wings.is_measured):
        return wings
    return trained_wings


def outer_shares(
    draw: Callable[[np.ndarray], np.ndarray], position: np.ndarray, flux: np.ndarray | None = None
) -> np.ndarray:
    """Return the fraction of the flux of n stars in the outer part of their stamps.

    The outer part is between 0.7 times half the side of the stamp and half the side.

    Parameters
    ----------
    draw : callable
        Function that returns PSFs (m, d, d) of m stars at the columns of their position.
    position : ndarray, shape (n, 2) to (n, 4)
        x and y in px, magnitude and colour, on which the PSF depends.
    flux : ndarray, shape (n,), optional
        Fluxes in counts, for a magnitude as third column.

    Returns
    -------
    ndarray, shape (n,)
        NaN where x, y or the magnitude is not known.
    """
    shares = np.full(len(position), np.nan)
    # At whole pixels, so that phases do not change the share.
    position = np.column_stack([np.rint(position[:, :2]), position[:, 2:]])
    if flux is not None:
        position = np.column_stack([position, magnitude(flux)])
    rows_with_position = np.flatnonzero(np.isfinite(position[:, :3]).all(axis=1))
    # Some at a time, so that their PSFs take little memory.
    for first in range(0, len(rows_with_position), 2048):
        part = rows_with_position[first : first + 2048]
        shares[part] = sum_outer_part(draw(position[part]))
    return shares


def sum_outer_part(psf: np.ndarray) -> np.ndarray:
    """Return the sum of the outer part of stamps (…, d, d), each with its star in the middle."""
    # Pixels by their distance from the middle of the stamp.
    side = psf.shape[-1]
    axis = np.arange(side) - side // 2
    radius = np.hypot(axis[:, None], axis)
    ring = (radius >= Wings.outer_part_from * side / 2) & (radius < side / 2)
    return np.asarray(psf[..., ring].sum(axis=-1))


def tents(r: np.ndarray, radius_px: np.ndarray) -> np.ndarray:
    """Return h_1 … h_{K−1} at distances r in pixels, (K − 1, …), as they are outside of the stamp.

    h_k = max(1 − |ln(r/r_1)/ln(r_2/r_1) − (k − 1)|, 0) (r/r_1)^-3: tops are equidistant in ln r.
    """
    # ln(r/r_1), 0 inside of the stamp; tops are at multiples of ln(r_2/r_1).
    radius = radius_px.astype(r.dtype)
    log_radius = np.log(np.maximum(r / radius[0], 1.0))
    top = np.arange(len(radius) - 1, dtype=r.dtype).reshape(-1, *[1] * r.ndim)
    off = np.abs(log_radius / np.log(radius[1] / radius[0]) - top)
    return np.asarray(np.maximum(1.0 - off, 0.0) * np.exp(-Wings.steepness * log_radius))


def compute_prior_profile(
    radius_px: np.ndarray, outer_share: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return what is expected of p before any pixel outside of stamps is seen, and its σ, (K,).

    Outside of a stamp of the half side h, the light falls off as a (r/h)^-5, the mean slope of
    Moffat profiles there (Moffat 1969, A&A 3, 455), where a follows from the `outer_share` of the
    light, between 0.7 h and h. Its σ is half of a at h and falls as r^-3, as light that mirrors and
    air scatter does (King 1971, PASP 83, 199), with 0.1 % of the star in quadrature; σ of p_0 is
    1.5 % of the star's light, spread over the stamp.
    """
    half = radius_px[0]
    # a: ∫ 2π r (r/h)^-5 dr from 0.7 h to h is 2π h² (0.7^-3 − 1)/3.
    outer_term = Wings.outer_part_from**-3.0 - 1.0
    edge_light = max(outer_share, 0.0) * 3.0 / (2.0 * np.pi * half**2 * outer_term)
    # The ring, at 1.5 h, was taken for sky: every pixel of the stamp lacks its light.
    expected_profile = edge_light * np.append(
        1.5**-5.0, (radius_px[:-1] / half) ** (Wings.steepness - 5.0)
    )
    # ∫ 2π r (r/h)^-3 dr from h on is 2π h².
    sigma = np.hypot(np.full(len(radius_px), 0.5 * edge_light), 1e-3 / (2.0 * np.pi * half**2))
    # The model may have 1.5 % too much or too little light in its stamp.
    sigma[0] = 0.015 / (2.0 * half) ** 2
    return expected_profile, sigma
