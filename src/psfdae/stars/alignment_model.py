"""Zernike coefficients as quadratic functions of a state of misalignment.

Rays are needed for 25 states only; the 15 terms of the fit then give the
wavefront of any state within the range at once, and its exact derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement, product

import numpy as np

PAIRS = tuple(combinations_with_replacement(range(4), 2))
"""Degrees of freedom of the ten products, in their order."""

TERMS = 1 + 4 + len(PAIRS)


class ModelError(RuntimeError):
    """The quadratic model does not reproduce ray tracing."""


def quadratic_terms(states: np.ndarray) -> np.ndarray:
    """1, the four numbers of a state and their ten products, shape (n, 15).

    Parameters
    ----------
    states : ndarray, shape (n, 4)
        In units of the range.
    """
    products = [states[:, a] * states[:, b] for a, b in PAIRS]
    return np.column_stack([np.ones(len(states)), states, *products])


def term_slopes(states: np.ndarray) -> np.ndarray:
    """Derivatives of `quadratic_terms` by the four numbers, shape (n, 4, 15)."""
    slopes = np.zeros((len(states), 4, TERMS))
    for axis in range(4):
        slopes[:, axis, 1 + axis] = 1.0
    for term, (a, b) in enumerate(PAIRS, start=5):
        slopes[:, a, term] += states[:, b]
        slopes[:, b, term] += states[:, a]
    return slopes


def design_states() -> np.ndarray:
    """States for the fit, a central composite design: corners, axes, centre; shape (25, 4)."""
    corners = np.array(list(product((-1.0, 1.0), repeat=4)))
    return np.concatenate([np.zeros((1, 4)), np.eye(4), -np.eye(4), corners])


@dataclass(frozen=True)
class QuadraticModel:
    """Zernike coefficients at a set of fields.

    Attributes
    ----------
    coefficients : ndarray, shape (F, 15, J)
        In waves, for states in units of the range.
    """

    coefficients: np.ndarray

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """Zernike coefficients of states, (n, 4) to (n, F, J), in waves."""
        return np.einsum("nt,ftj->nfj", quadratic_terms(states), self.coefficients)

    def jacobian(self, states: np.ndarray) -> np.ndarray:
        """Derivatives by the four numbers of a state, shape (n, F, 4, J), in waves per range."""
        return np.einsum("nkt,ftj->nfkj", term_slopes(states), self.coefficients)

    def residual(self, states: np.ndarray, zernikes: np.ndarray) -> np.ndarray:
        """Difference from given coefficients (n, F, J) as a wavefront.

        Returns
        -------
        ndarray, shape (n, F)
            RMS over the unit circle in waves.
        """
        return np.sqrt(((self(states) - zernikes) ** 2).sum(axis=-1))


def fit_quadratic(states: np.ndarray, zernikes: np.ndarray) -> QuadraticModel:
    """Least-squares fit of the model.

    Parameters
    ----------
    states : ndarray, shape (n, 4)
        In units of the range, such as `design_states`.
    zernikes : ndarray, shape (n, F, J)
        Their coefficients in waves.

    Raises
    ------
    ModelError
        If the states do not determine all 15 terms.
    """
    count, fields, modes = zernikes.shape
    terms = quadratic_terms(states)
    fit, _, rank, _ = np.linalg.lstsq(terms, zernikes.reshape(count, -1), rcond=None)
    if rank < TERMS:
        raise ModelError(f"{count} states determine {rank} of the {TERMS} quadratic terms")
    return QuadraticModel(np.moveaxis(fit.reshape(TERMS, fields, modes), 0, 1))


def verify(
    model: QuadraticModel, states: np.ndarray, zernikes: np.ndarray, tolerance: float
) -> np.ndarray:
    """RMS difference from ray tracing, shape (n, F), in waves.

    Raises
    ------
    ModelError
        If it exceeds `tolerance` anywhere; names the state, the field and the RMS.
    """
    residual = model.residual(states, zernikes)
    if not residual.max() <= tolerance:
        state, field = np.unravel_index(residual.argmax(), residual.shape)
        raise ModelError(
            f"quadratic model: {residual.max():.3g} waves RMS from ray tracing in state "
            f"{states[state].tolist()}, field {field} (at most {tolerance:.3g}); "
            "a smaller range of misalignment would do"
        )
    return residual
