"""Rejection of bright stars that differ from the PSF at their position, by a fit of the field.

The criteria of `psfdae.image.star_criteria` compare stars with their neighbours. The noise of these
hides small differences: a core that is cut off and resampled, a galaxy in an image of few stars. A
fitted field has hardly any noise.
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
    """Reject bright stars whose residuals about a fitted field are far larger than for the others.

    Fit and rejection are repeated until no star is rejected. The residual of a star is

        d² = Σ p (r² − σ²) / Σ p³

    with the light p of the fitted star of flux 1, the residual r, and the variance σ² of noise and
    photons: the pixels of the core are weighted most, and noise alone makes none.

    Parameters
    ----------
    candidates : Candidates
        Measured stars of one image. All stay if there are fewer than five, or if positions are not
        known, as the PSF of a star cannot be predicted then.
    settings : Settings
        Settings by which the stars were chosen.
    gain : float, optional
        Electrons per count.

    Returns
    -------
    Candidates
        With the verdict `misfit` for the rejected stars.
    """
    bright, side = candidates.bright, settings.framing.stamp_px
    if len(bright) < 5 or not np.isfinite(bright.position).all():
        return candidates
    # Stars that the fit of the method would take, too.
    frame_px = side + 2 * MARGIN_PX
    rows = select_fit_stars(bright.snr, frame_px**2, settings.seed)
    stars, field = bright.select(rows), getattr(settings, "field", None) or FieldSettings()
    photons = stars.sky_photons(gain, settings.noise.background_photons)
    fitter, fit = fit_first_field(stars, photons, frame_px, side, field)
    # Light of the fitted stars, and variance; 0 where nothing was measured.
    light = np.where(fitter.is_valid, fitter.images / fit.flux[:, None, None] - fit.residual, 0.0)
    variance = np.where(fitter.is_valid, fitter.pixel_variance(fit.flux, light), 0.0)
    light, variance, residual = (cut(a, side) for a in (light.clip(0.0), variance, fit.residual))
    # d², and its standard error by noise, as r² has the variance 2 σ⁴.
    norm = (light**3).sum(axis=(1, 2))
    square = (light * (residual**2 - variance)).sum(axis=(1, 2)) / norm
    error = np.sqrt(2.0 * np.square(light * variance).sum(axis=(1, 2))) / norm
    # The brighter half shows how well the field can be known: d of a star may be four times the
    # upper quartile of theirs, or 2 %, beyond noise.
    typical_square = np.percentile(square[stars.snr >= np.median(stars.snr)], 75)
    is_misfit = square > max(16.0 * typical_square, 0.02**2) + 10.0 * error
    if not is_misfit.any():
        return candidates
    verdict = candidates.verdict.copy()
    verdict[stars.row[is_misfit]] = Verdict.MISFIT
    kept_stars = bright.select(np.delete(np.arange(len(bright)), rows[is_misfit]))
    return reject_misfits(replace(candidates, verdict=verdict, bright=kept_stars), settings, gain)
