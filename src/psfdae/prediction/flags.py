"""What can be said against a star; rows are flagged, never dropped."""

from __future__ import annotations

from enum import IntFlag

import numpy as np

from psfdae.stars.flux import Flag


class StarFlag(IntFlag):
    """Flags of a star, which add up; the first four are those of `psfdae.stars.flux`."""

    MASKED = Flag.NONFINITE.value
    OUTLIER = Flag.OUTLIER.value
    FAINT = Flag.FAINT.value
    NO_FLUX = Flag.NO_FLUX.value
    SATURATED = 16
    TRUNCATED = 32
    SNR_LOW = 64
    SNR_HIGH = 128
    OFF_CENTRE = 256
    UNLIKE_TRAINING = 512


MEANING: dict[StarFlag, str] = {
    StarFlag.MASKED: "pixels that are masked, not finite or off the image; replaced",
    StarFlag.OUTLIER: "pixels that no star of the training set can have; replaced",
    StarFlag.FAINT: "flux below three times its error",
    StarFlag.NO_FLUX: "no usable flux: PSF, residual and uncertainty are NaN",
    StarFlag.SATURATED: "saturated pixels; replaced",
    StarFlag.TRUNCATED: "part of the stamp is off the image",
    StarFlag.SNR_LOW: "S/N less than 1/1.25 of the least that the training had",
    StarFlag.SNR_HIGH: "S/N more than 1.25 times the largest that the training had",
    StarFlag.OFF_CENTRE: "brightest pixel farther from the centre than the stamp could be moved",
    StarFlag.UNLIKE_TRAINING: "farther from the training set than 99.9 % of its test stars",
}
"""One line for every flag."""


def raise_flag(flags: np.ndarray, flag: IntFlag, where: np.ndarray) -> None:
    """Add a flag to some stars of `flags`, shape (n,), uint16."""
    flags[where] |= np.uint16(flag)


def names(flags: int) -> str:
    """Names of the flags of a star, joined by "|"; empty for a star without complaint."""
    return "|".join(flag.name or "" for flag in StarFlag if flag & flags)
