"""What goes into a prediction and what comes out of it, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np

from psfdae.prediction.photometry import Known


@dataclass(frozen=True)
class Stars:
    """Stamps (n, s, s) with their masks, and what is known of each star, shape (n,).

    Attributes
    ----------
    data : ndarray, shape (n, s, s), float32 or float64
        Sky included; finite.
    bad, saturated : ndarray of bool, shape (n, s, s)
    truncated : ndarray of bool, shape (n,)
    known : Known
    gain : ndarray, shape (n,)
        Electrons per unit of the stamps, NaN where unknown.
    """

    data: np.ndarray
    bad: np.ndarray
    saturated: np.ndarray
    truncated: np.ndarray
    known: Known
    gain: np.ndarray

    def __len__(self) -> int:
        return len(self.data)

    def part(self, rows: slice) -> Stars:
        """Some of the stars."""
        own = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "known"}
        return Stars(**own, known=self.known.part(rows))


@dataclass(frozen=True)
class Prediction:
    """PSFs of n stars and what was measured on the way; every star has its row.

    Attributes
    ----------
    psf : ndarray, shape (n, d, d), float32
        Noise-free image of the star without sky, in the unit of the stamps: the PSF
        times the flux. NaN where there is no usable flux (flag NO_FLUX).
    residual : ndarray, shape (n, d, d), float32
        Stamp − sky − `psf`; NaN in pixels that were not used.
    uncertainty : ndarray, shape (n, d, d), float32
        Half-width that holds 68.27 % of the errors of `psf` at this S/N, as found on
        the test stars of the model.
    flux, flux_error : ndarray, shape (n,), float64
        Flux inside the stamp, in the unit of the stamps; the error is NaN where the
        flux was given.
    background, noise : ndarray, shape (n,), float64
        Sky level and RMS of the sky noise in a pixel.
    snr : ndarray, shape (n,), float64
        flux / (noise √A), with the model's noise-equivalent area A.
    chi2 : ndarray, shape (n,), float64
        Mean of (residual / σ)² over the used pixels; σ² is noise² and, if the gain is
        known, the star's own photon noise.
    distance : ndarray, shape (n,), float64
        Mahalanobis distance from the training set (`psfdae.bundle.mahalanobis`).
    fwhm_px, ellipticity, position_angle_deg : ndarray, shape (n,), float64
        Of the PSF (`psfdae.prediction.shapes`).
    shift_x, shift_y : ndarray, shape (n,), int16
        Pixels by which the stamp was moved along columns and rows to centre the star.
    flags : ndarray, shape (n,), uint16
        Sum of `psfdae.prediction.StarFlag`s.
    """

    psf: np.ndarray
    residual: np.ndarray
    uncertainty: np.ndarray
    flux: np.ndarray
    flux_error: np.ndarray
    background: np.ndarray
    noise: np.ndarray
    snr: np.ndarray
    chi2: np.ndarray
    distance: np.ndarray
    fwhm_px: np.ndarray
    ellipticity: np.ndarray
    position_angle_deg: np.ndarray
    shift_x: np.ndarray
    shift_y: np.ndarray
    flags: np.ndarray

    def __len__(self) -> int:
        return len(self.psf)

    def first(self, count: int) -> Self:
        """The same of the first stars."""
        return type(self)(*(getattr(self, f.name)[:count] for f in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """One prediction of the stars of several."""
        if len(parts) == 1:
            return parts[0]
        columns = (np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls))
        return cls(*columns)
