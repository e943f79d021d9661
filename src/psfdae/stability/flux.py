"""Fluxes and images of stamps as the stress tests take them; `predict` uses a Photometer."""

from __future__ import annotations

from dataclasses import replace
from enum import IntFlag

import numpy as np

from psfdae.own_stars.photometry import (
    CLIP,
    MARGIN,
    SLACK,
    FluxEstimate,
    FluxModel,
    robust_flux,
)

__all__ = ["CLIP", "MARGIN", "SLACK", "Flag", "FluxModel", "normalise_images"]
__all__ += ["normalise_robustly", "robust_flux", "sum_flux"]


class Flag(IntFlag):
    """What is wrong with a star; flags add up."""

    NONFINITE = 1
    OUTLIER = 2
    FAINT = 4
    NO_FLUX = 8


def sum_flux(images: np.ndarray) -> np.ndarray:
    """Sum of every stamp (eq. 8), shape (n,), float64; NaN where a pixel is not finite."""
    flat = images.reshape(len(images), -1).astype(np.float64)
    finite = np.isfinite(flat)
    return np.where(finite.all(axis=1), np.where(finite, flat, 0.0).sum(axis=1), np.nan)


def normalise_images(images: np.ndarray, flux: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Images divided by their flux, defined for every input, and flags of those that are not."""
    finite = np.isfinite(images)
    good = np.isfinite(flux) & (flux > 0)
    divisor = np.where(good, flux, 1.0)[:, None, None]
    with np.errstate(over="ignore"):
        normalised = (np.where(finite, images, 0.0) / divisor).astype(np.float32)
    good &= np.isfinite(normalised).all(axis=(1, 2))
    normalised[~good] = 0.0
    flags = np.where(finite.all(axis=(1, 2)), 0, Flag.NONFINITE) | np.where(good, 0, Flag.NO_FLUX)
    return normalised, flags.astype(np.uint8)


def normalise_robustly(images: np.ndarray, model: FluxModel) -> tuple[np.ndarray, FluxEstimate]:
    """What the network should see of real stamps: repaired and divided by a robust flux."""
    estimate = robust_flux(images, model)
    usable = (estimate.flags & Flag.NO_FLUX) == 0
    normalised, flags = normalise_images(estimate.images, np.where(usable, estimate.flux, np.nan))
    return normalised, replace(estimate, flags=estimate.flags | flags)
