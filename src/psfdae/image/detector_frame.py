"""Position of an image's pixels on the detector by the header, and the offset of two images.

Inputs: the headers of two images. Output: the position of one in the other, in pixels. Programs
write the position under different keys, which count from different zeros, so that the numbers under
a key of one header are compared with the numbers under the same key of the other one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from psfdae.image.fits_file import ImageFile, card_value

BINNING_KEYS = (
    *(("XBINNING", "YBINNING"), ("CCDSUM",), ("CCDBIN1", "CCDBIN2"), ("CCDXBIN", "CCDYBIN")),
    *(("BINX", "BINY"), ("XBIN", "YBIN"), ("BINAXIS1", "BINAXIS2"), ("BINNING",)),
    *(("ESO DET WIN1 BINX", "ESO DET WIN1 BINY"), ("LTM1_1", "LTM2_2")),
)
"""Keys of the binning along x and y; a single key has a text with both."""

ORIGIN_KEYS = {
    ("DETSEC",): (1, 1),
    ("LTV1", "LTV2"): (-1, 0),
    ("XORGSUBF", "YORGSUBF"): (1, 0),
    ("SUBSTRT1", "SUBSTRT2"): (1, 1),
    ("ESO DET WIN1 STRX", "ESO DET WIN1 STRY"): (1, 1),
    ("CCDSEC",): (1, 1),
}
"""Keys of the first pixel in (binned) pixels, with their sign, and their number for the whole
detector; LTV of IRAF counts the other way. The first key that both headers have is used: DETSEC
differs between the chips of a mosaic."""

Frames = Mapping[str, Sequence[float]]
"""Numbers along x and y, by the first key of the cards that have them."""


def detector_frames(image: ImageFile) -> dict[str, list[float]]:
    """Return the numbers along x and y under the first key of each system in a header.

    Sections of the detector are of the whole image, or of its DATASEC or TRIMSEC; they give the
    number of the image's first pixel, and under "DETSEC step" the binning, below 0 if mirrored.
    """

    def numbers(*keys: str) -> list[float]:
        """Return all numbers in the cards of some keys; the image's own header overrides."""
        values = [[card_value(header, key) for header in image.headers] for key in keys]
        texts = [str(next((v for v in value if v is not None), "")) for value in values]
        return [float(number) for number in re.findall(r"-?\d+\.?\d*", " ".join(texts))]

    cards = {keys[0]: numbers(*keys) for keys in (*BINNING_KEYS, *ORIGIN_KEYS)}
    frames = {key: values for key, values in cards.items() if len(values) == 2}
    size_px = np.array(image.shape[:-3:-1])
    for key in ("DETSEC", "CCDSEC"):
        for part in ([1, size_px[0], 1, size_px[1]], numbers("DATASEC"), numbers("TRIMSEC")):
            if len(cards[key]) == len(part) == 4 and key not in frames:
                # Pixels begin … end of the image are pixels first … last of the detector.
                (first, last), (begin, end) = (np.reshape(a, (2, 2)).T for a in (cards[key], part))
                step = (last - first + np.where(first <= last, 1, -1)) / (end - begin + 1)
                if (step % 1 == 0).all() and (end <= size_px).all():
                    frames[f"{key} step"] = step.tolist()
                    frames[key] = ((first - 1) / step + 2 - begin).tolist()
    return frames


def find_offset(
    training_frames: Frames, training_px: np.ndarray, image_frames: Frames, image_px: np.ndarray
) -> np.ndarray | None:
    """Return the position (x, y) of an image's first pixel in another image, of the training.

    A header without a position is taken for the whole detector's, if this image then holds all of
    the other one. None where the headers do not show the offset.

    Parameters
    ----------
    training_frames, image_frames : mapping
        Frames of both, from `detector_frames`.
    training_px, image_px : ndarray, shape (2,)
        Columns and rows.

    Raises
    ------
    ValueError
        If the images are binned differently, or one is mirrored.
    """
    origins = {keys[0]: rule for keys, rule in ORIGIN_KEYS.items()}
    both_frames = training_frames, image_frames
    for key in training_frames.keys() & image_frames.keys() - origins.keys():
        if not np.allclose(training_frames[key], image_frames[key], rtol=1e-3):
            steps = ("×".join(f"{step:g}" for step in f[key]) for f in reversed(both_frames))
            raise ValueError(f"{key} is {', not '.join(steps)}")
    training_keys, image_keys = ([key for key in origins if key in f] for f in both_frames)
    common_keys = [key for key in training_keys if key in image_keys]
    if not common_keys and bool(training_keys) == bool(image_keys):
        return None
    key = [*common_keys, *training_keys, *image_keys][0]
    sign, first_number = origins[key]
    training_start, image_start = (f.get(key, [first_number] * 2) for f in both_frames)
    offset = sign * np.subtract(image_start, training_start)
    # The first and the last pixel of the one lie within the other.
    ends = np.stack([offset, training_px - offset - image_px])
    is_contained = (ends >= 0).all() or (ends <= 0).all()
    return np.asarray(offset) if common_keys or is_contained else None
