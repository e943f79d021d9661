"""The telescope's mirror symmetries: one state and its stamps give eight.

An aligned telescope and its ring of field points look the same in a mirror
through the axis. Its image is the telescope with the mirrored misalignment:
a decentre is a vector; a tilt is the axial vector of a rotation, whose
component along the normal of the mirror stays while the other turns.
Mirrors x → −x, y → −y and x ↔ y generate the group of the square.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np


@dataclass(frozen=True)
class Symmetry:
    """One element of the group, as it acts on states, fields and stamps.

    Attributes
    ----------
    state : ndarray, shape (4, 4)
        Signed permutation of the four numbers of a state.
    fields : ndarray of int, shape (F,)
        The mirrored telescope's stamp at field k is that of field `fields[k]`.
    transpose, flip_rows, flip_columns : bool
        What happens to a stamp, in this order.
    """

    state: np.ndarray
    fields: np.ndarray
    transpose: bool
    flip_rows: bool
    flip_columns: bool

    def states(self, states: np.ndarray) -> np.ndarray:
        """Mirrored states, shape (n, 4)."""
        return states @ self.state.T

    def stamps(self, stamps: np.ndarray) -> np.ndarray:
        """Stamps of the mirrored states, shape (n, F, d, d); rows run along y."""
        out = stamps[:, self.fields]
        if self.transpose:
            out = out.swapaxes(-1, -2)
        if self.flip_rows:
            out = out[..., ::-1, :]
        if self.flip_columns:
            out = out[..., ::-1]
        return out


def mirror_symmetries(points: int) -> list[Symmetry]:
    """The identity and the other symmetries that map the field points on themselves.

    Parameters
    ----------
    points : int
        Points on the circle of `psfdae.stars.alignment_scene.field_points`, the
        first on the x axis.

    Returns
    -------
    list of Symmetry
        Eight, fewer if the number of points is not a multiple of 4.
    """
    angle = 2.0 * np.pi * np.arange(points) / points
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    fields = np.concatenate([np.zeros((1, 2)), ring])
    symmetries = []
    for transpose, flip_y, flip_x in product((False, True), repeat=3):
        # Acts on (x, y): exchange first, then change signs.
        matrix = np.diag([1 - 2 * flip_x, 1 - 2 * flip_y]) @ _exchange(transpose)
        # The mirrored telescope shows at p what the telescope shows at matrix⁻¹ p.
        source = fields @ matrix
        distance = np.linalg.norm(source[:, None] - fields[None], axis=2)
        if distance.min(axis=1).max() > 1e-9:  # a field point maps between two
            continue
        axial = np.linalg.det(matrix) * matrix
        symmetries.append(
            Symmetry(
                state=np.round(np.block([[matrix, np.zeros((2, 2))], [np.zeros((2, 2)), axial]])),
                fields=distance.argmin(axis=1),
                transpose=transpose,
                flip_rows=flip_y,
                flip_columns=flip_x,
            )
        )
    return symmetries


def _exchange(transpose: bool) -> np.ndarray:
    return np.eye(2)[::-1] if transpose else np.eye(2)
