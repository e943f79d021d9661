"""A bank of simulated stars: the prior of the test stars, as a sample."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from psfdae.bounds.symmetry import SYMMETRIES, weights
from psfdae.stars.framing import crop_jittered, normalise_flux

MIRROR_MARGIN = 1
"""Pixels beyond the jitter that a flipped stamp needs (`Symmetry.window`)."""


@dataclass(frozen=True)
class Bank:
    """Propagated stars from which those at other jitters and mirrored fields are cut.

    Attributes
    ----------
    framed : ndarray, shape (M, d + 2m, d + 2m), float32
        Intensities, brightest pixel at index d/2 + m, m = `jitter_px` + 1.
    field : ndarray of int, shape (M,)
        Field of every star, ix + P·iy.
    peak : ndarray of int, shape (M, 2)
        Brightest pixel (row, column) from the chief ray.
    points : int
        Field points P along a side.
    jitter_px : int
        Largest centring error in pixels per axis.
    """

    framed: np.ndarray
    field: np.ndarray
    peak: np.ndarray
    points: int
    jitter_px: int

    def __len__(self) -> int:
        return len(self.framed)

    @property
    def margin(self) -> int:
        """Pixels m on either side of the stamp."""
        return self.jitter_px + MIRROR_MARGIN

    @property
    def stamp_px(self) -> int:
        """Side d of a stamp."""
        return self.framed.shape[-1] - 2 * self.margin

    def take(self, stars: np.ndarray) -> Bank:
        """Some of the stars, in the order given."""
        part = (self.framed[stars], self.field[stars], self.peak[stars])
        return Bank(*part, self.points, self.jitter_px)

    def stamps(self, window: tuple[int, int]) -> np.ndarray:
        """Stamps cut at a window (first row, first column), sum 1, shape (M, d, d), float64."""
        row, column = window
        side = self.stamp_px
        cut = self.framed[:, row : row + side, column : column + side].astype(np.float64)
        return normalise_flux(cut)[0]

    def log_weights(self) -> np.ndarray:
        """Logarithm of `symmetry.weights`, −∞ for zero, shape (M, 8)."""
        with np.errstate(divide="ignore"):
            return np.log(weights(self.field, self.peak, self.points))


def jitters(jitter_px: int) -> list[tuple[int, int]]:
    """All centring errors (row, column) of up to `jitter_px` pixels per axis."""
    steps = range(-jitter_px, jitter_px + 1)
    return list(product(steps, steps))


def windows(jitter_px: int) -> dict[tuple[int, int], list[tuple[int, int]]]:
    """Which stamps share a window: (row, column) → list of (symmetry, jitter) numbers."""
    margin = jitter_px + MIRROR_MARGIN
    found: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for s, symmetry in enumerate(SYMMETRIES):
        for j, jitter in enumerate(jitters(jitter_px)):
            found.setdefault(symmetry.window(jitter, margin), []).append((s, j))
    return found


def jittered_templates(framed: np.ndarray, jitter_px: int) -> np.ndarray:
    """Static PSFs at all centring errors, as the stage `stars` cuts them.

    Parameters
    ----------
    framed : ndarray, shape (F, d + 2·jitter_px, d + 2·jitter_px)
        Array `psf` of the product "templates".

    Returns
    -------
    ndarray, shape (F, J, d, d), float32
        Sum 1; order of `jitters`.
    """
    stamps = [
        normalise_flux(
            crop_jittered(
                framed.astype(np.float64), np.tile(jitter, (len(framed), 1)), margin=jitter_px
            )
        )[0]
        for jitter in jitters(jitter_px)
    ]
    return np.stack(stamps, axis=1).astype(np.float32)
