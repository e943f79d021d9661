"""Named random streams: every draw of the project comes from one of these."""

from __future__ import annotations

import zlib

import numpy as np


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """Return the independent generator of a purpose, addressed by names.

    The same seed and names give the same numbers on every machine, and a new
    stream does not change the others. Noise, jitter, aberrations, splits and
    network initialisation each have a stream.

    Parameters
    ----------
    seed : int
        Seed of the configuration, ≥ 0.
    *names : str or int
        Address of the stream, for example `("noise", "test", "0.003")`.
    """
    # The CRC-32 of each name, because hashes of Python differ from process to process.
    words = [zlib.crc32(str(name).encode()) for name in names]
    return np.random.default_rng(np.random.SeedSequence([seed, *words]))
