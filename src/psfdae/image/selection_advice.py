"""Advice on settings that neither the header nor the user gives, from the stars of an image.

Input: the measured stars (`selection`). Output: sentences with the advice and its reasons.
"""

from __future__ import annotations

import numpy as np

from psfdae.base.errors import keyword
from psfdae.image.observation import Observation
from psfdae.image.selection import Candidates
from psfdae.image.stamps import cut
from psfdae.image.star_criteria import find_pile_up, measure_overlap


def advice(candidates: Candidates, observation: Observation, stamp_px: int) -> list[str]:
    """Return sentences on saturation, gain and the size of stamps, for training on stars."""
    sentences = [stamp_advice(candidates, stamp_px)]
    if observation.saturate is None:
        sentences.append(saturation_advice(candidates))
    if observation.gain is None:
        sentences.append(gain_advice(candidates))
    return [sentence for sentence in sentences if sentence]


def saturation_advice(candidates: Candidates) -> str:
    """Return advice on saturation, from the counts at which brightest pixels pile up.

    Stars that are cut off have the same brightest pixel, however bright they are.
    """
    # Counts at which brightest pixels agree; infinite if they do not.
    limit = find_pile_up(candidates.brightest, candidates.sky, candidates.snr * candidates.noise)
    if not np.isfinite(limit):
        return f"saturation: none is seen up to {candidates.brightest.max():.6g} counts"
    star_count = np.count_nonzero(candidates.brightest >= limit)
    stamp_count = np.count_nonzero(candidates.highest >= limit)
    return (
        f"saturation: the brightest pixels of {star_count} stars agree from {limit:.6g} counts on, "
        f"as if cut off; {stamp_count} stamps have such pixels and are not trained on, "
        f"{keyword('saturate', limit)} flags these, too"
    )


def gain_advice(candidates: Candidates) -> str:
    """Return advice on the gain from sky and photon noise: variance = level / gain.

    Photons of a sky of L counts make the noise σ = √(L / gain) counts, hence gain = L / σ².
    """
    sky, noise = float(np.median(candidates.sky)), float(np.median(candidates.noise))
    sky_text = f"gain: the sky is {sky:.4g} counts, its noise {noise:.3g}"
    # A sky of fewer than 3 σ was probably subtracted.
    if not sky > 3.0 * noise > 0:
        return f"{sky_text}; it was probably subtracted, and says nothing of the gain"
    return (
        f"{sky_text}; if photons make it and no bias or sky was subtracted or added, "
        f"{keyword('gain', float(f'{sky / noise**2:.3g}'))} is right"
    )


def stamp_advice(candidates: Candidates, stamp_px: int) -> str | None:
    """Return advice on the size of stamps, from the light of the median star and from overlaps.

    A stamp should hold 98.5 % of a star's visible light; changes below 4 px are not advised.

    Parameters
    ----------
    candidates : Candidates
        The measured stars.
    stamp_px : int
        Current side of the stamps.

    Returns
    -------
    str or None
        None if the stamps are about right.
    """
    # Light of the median star in squares of 8 px, the smallest stamps of a model, and more.
    typical = np.median(candidates.bright.align(), axis=0)[None]
    sides = np.arange(8, typical.shape[-1] + 1, 2)
    light = np.array([cut(typical, side).sum() for side in sides]) / typical.sum()
    # The first side that holds enough light.
    side_px = int(sides[np.argmax(light >= 0.985)])
    if abs(side_px - stamp_px) < 4:
        return None
    # How many stamps of either size have a second star.
    overlap = ", ".join(
        f"{100 * measure_overlap(candidates.position, side):.0f} % of {side} px"
        for side in (stamp_px, side_px)
    )
    return (
        f"stamp size: 98.5 % of the median star's light are within {side_px} px; "
        f"another star of the list stands in {overlap}: {keyword('stamp_px', side_px)} is worth a "
        "trial"
    )
