"""Rejection of bright stars that differ from the PSF at their position, which is fitted.

The criteria of `psfdae.image.star_criteria` compare stars with their neighbours, whose noise hides
small differences: a core that was clipped and then resampled, or a galaxy in an image of few stars.
The PSF of a fitted field has hardly any noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from psfdae.image.selection import Candidates, Verdict
from psfdae.image.stamps import cut
from psfdae.methods.field import select_fit_stars
from psfdae.methods.field.prior import FieldSettings
from psfdae.methods.field.residuals import MARGIN_PX
from psfdae.methods.field.search import fit_first_field
from psfdae.training.settings import Settings


def reject_misfits(candidates: Candidates, settings: Settings, gain: float | None) -> Candidates:
    """Reject bright stars whose residuals about a fitted field are far larger than typical.

    Fit and rejection are repeated until fewer than one star in a hundred are rejected. The residual
    of a star is

        d² = Σ p (r² − σ²) / Σ p³

    summed over pixels, with the fitted PSF p of flux 1, the residual r over the flux, and the
    variance σ² of sky noise and photon noise. The core has the largest weights; d is the relative
    error of a PSF (1 + d) p, and the expectation of d² is 0 for noise alone.

    Parameters
    ----------
    candidates : Candidates
        Measured stars of one image. None is rejected if there are fewer than five, or if a position
        is unknown, because the PSF there cannot be predicted.
    settings : Settings
        Settings of the training, by which the stars were chosen.
    gain : float, optional
        Electrons per count.

    Returns
    -------
    Candidates
        The candidates, with the verdict `MISFIT` for rejected stars, which are no longer bright.
    """
    bright, side = candidates.bright, settings.framing.stamp_px
    if len(bright) < 5 or not np.isfinite(bright.position).all():
        return candidates
    # The stars to which the field method would be fitted. Other methods' settings lack its group.
    frame_px = side + 2 * MARGIN_PX
    rows = select_fit_stars(bright.snr, frame_px**2, settings.seed)
    stars, field = bright.select(rows), getattr(settings, "field", None) or FieldSettings()
    photons = stars.sky_photons(gain, settings.noise.background_photons)
    fitter, fit = fit_first_field(stars, photons, frame_px, side, field)
    # p = (image − residual) / flux and σ² of each star; 0 in pixels that were not measured.
    psf = np.where(fitter.is_valid, fitter.images / fit.flux[:, None, None] - fit.residual, 0.0)
    variance = np.where(fitter.is_valid, fitter.pixel_variance(fit.flux, psf), 0.0)
    psf, variance, residual = (cut(a, side) for a in (psf.clip(0.0), variance, fit.residual))
    # d², and its standard error due to noise: the variance of r² is 2 σ⁴.
    norm = (psf**3).sum(axis=(1, 2))
    d_square = (psf * (residual**2 - variance)).sum(axis=(1, 2)) / norm
    d_square_error = np.sqrt(2.0 * np.square(psf * variance).sum(axis=(1, 2))) / norm
    # The brighter half shows how well the fit can follow the PSF. With the upper quartile q of d²
    # of these stars, a star is rejected if d² > max(16 q, (2 %)²) + 10 σ, with σ the error of d².
    typical_d_square = np.percentile(d_square[stars.snr >= np.median(stars.snr)], 75)
    is_misfit = d_square > max(16.0 * typical_d_square, 0.02**2) + 10.0 * d_square_error
    if not is_misfit.any():
        return candidates
    verdict = candidates.verdict.copy()
    verdict[stars.row[is_misfit]] = Verdict.MISFIT
    kept_stars = bright.select(np.delete(np.arange(len(bright)), rows[is_misfit]))
    kept_candidates = replace(candidates, verdict=verdict, bright=kept_stars)
    # A fit without these stars would hardly differ, if they are fewer than one in a hundred.
    is_settled = np.count_nonzero(is_misfit) < 0.01 * len(stars)
    return kept_candidates if is_settled else reject_misfits(kept_candidates, settings, gain)
