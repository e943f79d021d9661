"""`Wings`: light of stars outside the stamps of a model.

The model gives the light of a star inside its stamp, above a sky that is measured in a ring around
the stamp. The other light has one profile for all stars: a star of flux F has

    F s (p_0 h_0 + Σ_k p_k h_k(r))

more in a pixel, with h_0 = 1 in its stamp and 0 elsewhere; outside the stamp, hat functions h_k of
ln r times a power of r, where r is the distance from its centre in pixels; and s the light of the
model's PSF in the outer part of its stamp divided by the mean of all stars: a wider PSF has
brighter wings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from psfdae.base.errors import keyword
from psfdae.image.fits_file import Card


@dataclass(frozen=True)
class Wings:
    """Light of stars outside the stamps of their model.

    Attributes
    ----------
    radius_px : ndarray, shape (K,)
        r_1 … r_K, equidistant in ln r: tops r_1 … r_{K−1} of the K − 1 hat functions, and r_K,
        where the light ends. r_1 is half the side of the stamp.
    profile : ndarray, shape (K,)
        p_0 … p_{K−1}, fractions of the flux in a pixel: p_0 in the stamp, p_k (r_k/r_1)^-3 at r_k.
    covariance : ndarray, shape (K, K)
        Covariance of `profile`.
    outer_share : float
        Mean `outer_shares` of the stars of the fit, for which s = 1.
    outer_part_start : float
        Radius at which the outer part of a stamp begins, as a fraction of half its side.
    steepness : float
        Power of 1/r in the hat functions, as for light scattered by mirrors and air.
    """

    outer_part_start: ClassVar[float] = 0.7
    steepness: ClassVar[float] = 3.0

    radius_px: np.ndarray
    profile: np.ndarray
    covariance: np.ndarray
    outer_share: float

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Self:
        """Build wings from the lists and numbers of `plain`.

        Raises
        ------
        ValueError
            If one is missing or not numeric, if their shapes or radii are wrong, or if their light
            exceeds ten times the star's.
        """
        names = ("radius_px", "profile", "covariance")
        try:
            arrays = {name: np.array(plain[name], dtype=np.float64) for name in names}
            wings = cls(**arrays, outer_share=float(plain["outer_share"]))
        except LookupError as error:
            raise ValueError(f"wings without {error}") from None
        except (TypeError, ValueError, ArithmeticError):
            raise ValueError("wings with values that are not numbers") from None
        radius, count = wings.radius_px, wings.profile.size
        shapes = [a.shape for a in (wings.profile, radius, wings.covariance)]
        if count < 2 or shapes != [(count,), (count,), (count, count)]:
            raise ValueError("wings with arrays of different lengths")
        # No wings reach beyond 100 000 px, or have ten times the light of the star. Hat functions
        # need radii that are equidistant in ln r.
        is_rising = radius[0] > 0 and (np.diff(radius) > 0).all() and radius[-1] < 1e5
        if not (is_rising and np.ptp(np.diff(np.log(radius))) < 1e-6):
            raise ValueError("wings with radii that are not a rising geometric sequence in pixels")
        with np.errstate(all="ignore"):
            light, light_sigma = wings.light()
        has_scale = 0.0 < wings.outer_share < np.inf
        if not (has_scale and abs(light) < 10.0 and np.isfinite(light_sigma)):
            raise ValueError("wings with a light that is not a fraction of a star's")
        return wings

    def plain(self) -> dict[str, Any]:
        """Return all values as lists and numbers, for a bundle."""
        return {name: np.asarray(value).tolist() for name, value in vars(self).items()}

    def scale(self, outer_share: np.ndarray) -> np.ndarray:
        """Return s of stars with these `outer_shares` (n,), 1 where they are not known (NaN)."""
        ratio = np.where(np.isfinite(outer_share), outer_share / self.outer_share, 1.0)
        # Larger factors are not plausible for PSFs of one telescope.
        return np.asarray(np.clip(ratio, 0.3, 3.0))

    def total_over_flux(self, outer_share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ratio of flux_total to flux of stars with these `outer_shares` (n,).

        Returns
        -------
        ratio, error : ndarray, shape (n,)
            The ratio, and its standard error. Half of the change of the wings with the PSF is taken
            as an error.
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
        """Return the light within a radius that the model lacks, and its standard error.

        Both are fractions of the flux of a star with s = 1.
        """
        # Integral over the plane: ∫ 2π r (h_0 p_0 + Σ h_k p_k) dr.
        half = self.radius_px[0]
        r = np.linspace(0.0, min(radius_px, self.radius_px[-1]), 4001)
        # Fraction of a circle of radius r outside the stamp, a square of the half side h:
        # 4/π arccos(h/r), at most 1.
        outside = np.clip(np.arccos(np.minimum(half / np.maximum(r, half), 1.0)) * 4 / np.pi, 0, 1)
        height = np.concatenate([1.0 - outside[None], outside * compute_hats(r, self.radius_px)])
        area = np.trapezoid(2 * np.pi * r * height, r, axis=1)
        return float(self.profile @ area), float(np.sqrt(area @ self.covariance @ area))

    def cards(self) -> list[Card]:
        """Return FITS header cards: the radius of all light, and its fraction in the model."""
        return [
            ("FLUXRAD", float(self.radius_px[-1]), "[pix] all light of a star is within it"),
            ("INMODEL", 1.0 / (1.0 + self.light()[0]), "fraction of it in the model, typical star"),
        ]

    def __repr__(self) -> str:
        return f"Wings({self})"

    def __str__(self) -> str:
        light, error = self.light()
        sentence = (
            f"{100 * light:.2f} ± {100 * error:.2f} % of the flux in the stamp of a typical star, "
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
        # Each profile is rescaled to the mean outer share, because wings are proportional to it.
        # The images are independent: C = Σ w² C_i.
        outer_share = float(weight @ [wings.outer_share for wings in several])
        weight *= [outer_share / wings.outer_share for wings in several]
        profile = np.tensordot(weight, [wings.profile for wings in several], 1)
        covariance = np.tensordot(weight**2, [wings.covariance for wings in several], 1)
        return cls(several[0].radius_px, profile, covariance, outer_share)

    @property
    def is_measured(self) -> bool:
        """True if the error of the light is less than half its prior error, thanks to pixels."""
        sigma = compute_prior_profile(self.radius_px, self.outer_share)[1]
        return self.light()[1] < 0.5 * replace(self, covariance=np.diag(sigma**2)).light()[1]


def choose_wings(wings: Wings | None, trained_wings: Wings | None) -> Wings | None:
    """Return the wings of an image; the wings of the training if the image does not show any."""
    if trained_wings is None or (wings is not None and wings.is_measured):
        return wings
    return trained_wings


def outer_shares(draw: Callable[[np.ndarray], np.ndarray], position: np.ndarray) -> np.ndarray:
    """Return the fractions of the fluxes of n stars that are in the outer part of their stamps.

    The outer part is the ring between 0.7 and 1 times half the side of the stamp.

    Parameters
    ----------
    draw : callable
        Function that returns the PSFs (m, d, d) at m rows of `position`, with its columns.
    position : ndarray, shape (n, 2) to (n, 4)
        x and y in px, magnitude and colour, on which the PSF depends.

    Returns
    -------
    ndarray, shape (n,)
        Fractions; NaN where x, y or the magnitude is not known.
    """
    shares = np.full(len(position), np.nan)
    # At whole pixels, so that the position of a star in its pixel does not change the share.
    position = np.column_stack([np.rint(position[:, :2]), position[:, 2:]])
    rows_with_position = np.flatnonzero(np.isfinite(position[:, :3]).all(axis=1))
    # 2048 stars at a time, to limit the memory of their PSFs.
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
    ring = (radius >= Wings.outer_part_start * side / 2) & (radius < side / 2)
    return np.asarray(psf[..., ring].sum(axis=-1))


def compute_hats(r: np.ndarray, radius_px: np.ndarray) -> np.ndarray:
    """Return h_1 … h_{K−1}, (K − 1, …), at distances r (…) in pixels, for pixels outside the stamp.

    h_k = max(1 − |ln(r/r_1)/ln(r_2/r_1) − (k − 1)|, 0) (r/r_1)^-3: tops are equidistant in ln r.
    """
    # ln(r/r_1), at least 0; tops are at multiples of ln(r_2/r_1).
    radius = radius_px.astype(r.dtype)
    log_radius = np.log(np.maximum(r / radius[0], 1.0))
    top = np.arange(len(radius) - 1, dtype=r.dtype).reshape(-1, *[1] * r.ndim)
    distance = np.abs(log_radius / np.log(radius[1] / radius[0]) - top)
    return np.asarray(np.maximum(1.0 - distance, 0.0) * np.exp(-Wings.steepness * log_radius))


def compute_prior_profile(
    radius_px: np.ndarray, outer_share: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the prior mean of p, before any pixel outside stamps is used, and its σ, (K,).

    Outside a stamp of half side h, the light falls off as a (r/h)^-5, the mean slope of
    Moffat profiles there (Moffat 1969, A&A 3, 455), where a follows from the `outer_share`, the
    light between 0.7 h and h. Its σ is half of a at h and falls as r^-3, as light scattered by
    mirrors and air does (King 1971, PASP 83, 199), with 0.1 % of the star in quadrature; σ of p_0
    is 1.5 % of the star's light, spread over the stamp.
    """
    half = radius_px[0]
    # a: ∫ 2π r (r/h)^-5 dr from 0.7 h to h is 2π h² (0.7^-3 − 1)/3.
    outer_term = Wings.outer_part_start**-3.0 - 1.0
    edge_light = max(outer_share, 0.0) * 3.0 / (2.0 * np.pi * half**2 * outer_term)
    # The light in the ring of the sky, at 1.5 h, was taken for sky, and subtracted in the stamp.
    prior_profile = edge_light * np.append(
        1.5**-5.0, (radius_px[:-1] / half) ** (Wings.steepness - 5.0)
    )
    # σ: a/2, and 0.1 % of the star in quadrature, as ∫ 2π r (r/h)^-3 dr from h on is 2π h².
    sigma = np.hypot(np.full(len(radius_px), 0.5 * edge_light), 1e-3 / (2.0 * np.pi * half**2))
    # The model may have 1.5 % too much or too little light in its stamp.
    sigma[0] = 0.015 / (2.0 * half) ** 2
    return prior_profile, sigma
