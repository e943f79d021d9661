"""What an image says of settings that neither its header nor its user gives.

Each function ends in a sentence with the advice and what it rests on, or in None where
there is nothing to advise. Nothing is changed by it.
"""

from __future__ import annotations

import numpy as np

from psfdae.image.observation import Observation
from psfdae.image.selection import Candidates, piled_up
from psfdae.image.stamps import cut

LIGHT = 0.985  # of a star, as far as it is seen, that a stamp should hold
SMALLEST_PX = 8  # stamps of a bundle
STEP_PX = 4  # stamps that are so much too wide or too narrow are worth a word
SKY_SIGMA = 3.0  # a sky of fewer σ was probably subtracted


def advice(found: Candidates, observation: Observation, stamp_px: int) -> list[str]:
    """Sentences on saturation, gain and the size of stamps, for a training on `found`."""
    said = [stamp_advice(found, stamp_px)]
    if observation.saturate is None:
        said.append(saturation_advice(found))
    if observation.gain is None:
        said.append(gain_advice(found))
    return [sentence for sentence in said if sentence]


def saturation_advice(found: Candidates) -> str:
    """From where brightest pixels pile up."""
    level = piled_up(found.brightest, found.sky, found.snr * found.noise)
    if not np.isfinite(level):
        return f"saturation: none is seen up to {found.brightest.max():.6g} counts"
    piled, flagged = (int((pixel >= level).sum()) for pixel in (found.brightest, found.highest))
    return (
        f"saturation: the brightest pixels of {piled} stars agree from {level:.6g} counts on, as "
        f"if cut off; {flagged} stamps have such pixels and are not learnt from, --saturate "
        f"{level:.6g} flags these, too"
    )


def gain_advice(found: Candidates) -> str:
    """From sky and its noise, if photons make it: variance = level / gain."""
    sky, noise = float(np.median(found.sky)), float(np.median(found.noise))
    seen = f"gain: the sky is {sky:.4g} counts, its noise {noise:.3g}"
    if not sky > SKY_SIGMA * noise > 0:
        return f"{seen}; it was probably subtracted, and says nothing of the gain"
    return (
        f"{seen}; if photons make it and no bias or sky was subtracted or added, "
        f"--gain {sky / noise**2:.3g} is right"
    )


def stamp_advice(found: Candidates, stamp_px: int) -> str | None:
    """From the light of the median star in squares about its centre, and how many overlap."""
    typical = np.median(found.bright.aligned(), axis=0)[None]
    sides = np.arange(SMALLEST_PX, typical.shape[-1] + 1, 2)
    light = np.array([cut(typical, side).sum() for side in sides]) / typical.sum()
    needed = int(sides[np.argmax(light >= LIGHT)])
    if abs(needed - stamp_px) < STEP_PX:
        return None
    shared = ", ".join(
        f"{100 * overlapping(found.position, side):.0f} % of {side} px"
        for side in (stamp_px, needed)
    )
    return (
        f"stamp size: {100 * LIGHT:g} % of the median star's light are within {needed} px; "
        f"another star of the list stands in {shared}: framing.stamp_px={needed} is worth a trial"
    )


def overlapping(position: np.ndarray, side: int) -> float:
    """Part of the stars (n, 2) in whose stamps another one stands."""
    from scipy.spatial import cKDTree

    known = position[np.isfinite(position).all(axis=1)]
    if len(known) < 2:
        return 0.0
    distance, _ = cKDTree(known).query(known, k=2, p=np.inf)
    return float((distance[:, 1] < 0.5 * side).mean())
