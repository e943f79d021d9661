"""Named random streams: every draw of the project comes from one of these."""

from __future__ import annotations

import zlib

import numpy as np


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """Independent generator for a purpose, addressed by name.

    The same seed and names give the same numbers on every machine; adding a
    stream never shifts another. Noise, jitter, aberrations, splits and network
    initialisation each have their own.

    Parameters
    ----------
    seed : int
        The config's `seed`, ≥ 0.
    *names : str or int
        Address of the stream, for example `("noise", "test", "0.003")`.
    """
    words = [zlib.crc32(str(name).encode()) for name in names]
    return np.random.default_rng(np.random.SeedSequence([seed, *words]))
