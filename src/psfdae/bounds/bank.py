"""A bank of simulated stars: the prior of the test stars, as a sample."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from psfdae.stars.framing import crop_jittered, normalise_flux
from psfdae.stars.symmetry import SYMMETRIES

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

    def take(self, stars: np.ndarray) -> Bank:
        """Some of the stars, in the order given."""
        part = (self.framed[stars], self.field[stars], self.peak[stars])
        return Bank(*part, self.points, self.jitter_px)

    def stamps(self, window: tuple[int, int]) -> np.ndarray:
        """Stamps cut at a window (first row, first column), sum 1, shape (M, d, d), float64."""
        row, column = window
        side = self.framed.shape[-1] - 2 * self.margin
        # A slice: the same place in all stars needs no list of pixels for each.
        cut = self.framed[:, row : row + side, column : column + side]
        return normalise_flux(cut.astype(np.float64))[0]

    def log_weights(self) -> np.ndarray:
        """Logarithm of `weights`, −∞ for zero, shape (M, 8)."""
        with np.errstate(divide="ignore"):
            return np.log(weights(self.field, self.peak, self.points))


def weights(field: np.ndarray, peak: np.ndarray, points: int) -> np.ndarray:
    """How often each symmetry of each star counts so that all fields stay equally likely.

    At a field point on a mirror axis two symmetries (in the centre all eight) lead
    to the same star, with its equal maxima exchanged. Only the one that frames the
    first maximum in (row, column) order is right; it counts for all of them.

    Parameters
    ----------
    field : ndarray of int, shape (M,)
        Field of every star, ix + P·iy.
    peak : ndarray of int, shape (M, 2)
        The star's framed pixel (row, column) from the chief ray.
    points : int
        Field points P along a side.

    Returns
    -------
    ndarray of int, shape (M, 8)
        Zero, or the number of symmetries that lead to the same field; rows sum to 8.
    """
    target = np.stack([s.field(field, points) for s in SYMMETRIES], axis=1)
    pixel = np.stack([s.pixel(peak) for s in SYMMETRIES], axis=1)
    reach = 2 * int(np.abs(peak).max()) + 3
    order = (pixel[..., 0] * reach + pixel[..., 1]) * len(SYMMETRIES) + np.arange(len(SYMMETRIES))
    same = target[:, :, None] == target[:, None, :]
    first = np.where(same, order[:, None, :], np.iinfo(order.dtype).max).min(axis=2)
    return np.where(order == first, same.sum(axis=2), 0)


def jitters(jitter_px: int) -> list[tuple[int, int]]:
    """All centring errors (row, column) of up to `jitter_px` pixels per axis."""
    return list(product(range(-jitter_px, jitter_px + 1), repeat=2))


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
    framed = framed.astype(np.float64)
    cuts = [crop_jittered(framed, np.array(jitter), jitter_px) for jitter in jitters(jitter_px)]
    return np.stack([normalise_flux(cut)[0] for cut in cuts], axis=1).astype(np.float32)
