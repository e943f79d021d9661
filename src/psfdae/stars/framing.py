"""Framing: which pixels around the chief ray become the stamp of a star."""

from __future__ import annotations

import numpy as np


class FramingError(ValueError):
    """The brightest pixel of a star cannot be trusted to be in the search window."""


def brightest_pixel(image: np.ndarray, tie: float) -> tuple[int, int]:
    """First pixel in (row, column) order that is within `tie` of the maximum.

    Mirror-symmetric images have two or four equal maxima, and rounding would
    choose between them; the tolerance makes the choice reproducible.

    Parameters
    ----------
    image : ndarray, shape (h, w)
    tie : float
        Relative tolerance below the maximum.
    """
    flat = int(np.argmax(image >= (1.0 - tie) * image.max()))
    row, column = np.unravel_index(flat, image.shape)
    return int(row), int(column)


def crop_jittered(framed: np.ndarray, jitter: np.ndarray, margin: int) -> np.ndarray:
    """Cut stamps out of images that were framed without jitter and with a margin.

    Parameters
    ----------
    framed : ndarray, shape (B, d + 2·margin, d + 2·margin)
        Brightest pixel at index d/2 + margin.
    jitter : ndarray of int, shape (B, 2) or (2,)
        (row, column) by which the brightest pixel moves in the stamp, |jitter| ≤ margin.

    Returns
    -------
    ndarray, shape (B, d, d)
    """
    pixels = np.arange(framed.shape[-1] - 2 * margin)
    start = np.broadcast_to(margin - np.asarray(jitter), (len(framed), 2))[:, :, None] + pixels
    stars = np.arange(len(framed))[:, None, None]
    return framed[stars, start[:, 0, :, None], start[:, 1, None, :]]


def normalise_flux(stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide stamps by their own flux (eq. 8 of the paper).

    Returns
    -------
    normalised : ndarray, shape (..., d, d)
        Stamps that sum to 1.
    flux : ndarray, shape (...)
        The sum inside each stamp.
    """
    flux = stamps.sum(axis=(-2, -1))
    return stamps / flux[..., None, None], flux
