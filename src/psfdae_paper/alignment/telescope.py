"""Scene 3: a telescope with a misaligned secondary mirror, its states and its wavefronts.

A state is four numbers in units of the range, in the order of
`DEGREES_OF_FREEDOM`. Its data are the stamps at a few fields.
Wavefronts leave out piston and tilts: all fields move together with the secondary, and
a stamp is centred on its own centroid.

Rays are needed for 25 states only. Zernike coefficients are quadratic functions of a
state: 15 fitted terms give the wavefront of any state within the range, and its exact
derivatives, at once.

An aligned telescope and its ring of field points look the same in a mirror through
the axis. Its image is the telescope with the mirrored misalignment: a decentre is a
vector; a tilt is the axial vector of a rotation, whose component along the normal of
the mirror stays while the other turns.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement, product

import numpy as np

from psfdae.base.errors import Error
from psfdae.optics.wavefronts import FIRST_NOLL
from psfdae.sensing.quadratic import quadratic_terms
from psfdae.telescope.aberrations import Prescription
from psfdae.telescope.raytracing import RayTracingError, ZernikeTracer, build_optic
from psfdae.telescope.settings import Telescope
from psfdae_paper.configuration.alignment import Alignment
from psfdae_paper.stars.symmetry import SYMMETRIES, Symmetry

DEGREES_OF_FREEDOM = ("decenter_x", "decenter_y", "tilt_x", "tilt_y")
"""Order of the four numbers of a state of misalignment."""

PAIRS = tuple(combinations_with_replacement(range(4), 2))
"""Pairs of degrees of freedom whose products are terms of the quadratic model, in their order."""


class ModelError(Error, RuntimeError):
    """The quadratic model does not reproduce ray tracing."""


def field_points(radius_deg: float, points: int) -> np.ndarray:
    """Return the centre of the field and points on a circle, the first on the x axis.

    They are field angles (x, y) in radians, shape (1 + points, 2).
    """
    # The circle counter-clockwise from the x axis, after the centre.
    angle = 2.0 * np.pi * np.arange(points) / points
    circle = np.deg2rad(radius_deg) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.zeros((1, 2)), circle])


def grid_states(levels: int) -> np.ndarray:
    """List all combinations of equidistant levels from −1 to 1, shape (levels⁴, 4)."""
    return np.array(list(product(np.linspace(-1.0, 1.0, levels), repeat=4)))


def uniform_states(count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw random states, uniform within the range, shape (count, 4)."""
    return rng.uniform(-1.0, 1.0, size=(count, 4))


def design_states() -> np.ndarray:
    """List the states of a central composite design: centre, axes and corners, shape (25, 4)."""
    return np.concatenate([np.zeros((1, 4)), np.eye(4), -np.eye(4), grid_states(2)])


class StateTracer(ZernikeTracer):
    """Ray trace of states of misalignment at the field points.

    Parameters
    ----------
    telescope : Telescope
        Diameter and wavelength.
    prescription : Prescription
        Surfaces of the telescope.
    alignment : Alignment
        Field points, range of the misalignment and defocus of the CCD.

    Attributes
    ----------
    misalignment_range : ndarray, shape (4,)
        Range of the misalignment in metres, metres, radians, radians: the unit of states.
    """

    def __init__(
        self, telescope: Telescope, prescription: Prescription, alignment: Alignment
    ) -> None:
        super().__init__(
            build_optic(prescription, telescope, alignment.defocus_m),
            telescope.wavelength_m,
            field_points(alignment.field_radius_deg, alignment.field_points),
            alignment.highest_zernike,
        )
        self.misalignment_range = np.asarray(alignment.unit, float)

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """Return the Zernike coefficients (n, F, J) in waves of states (n, 4).

        Raises
        ------
        RayTracingError
            If a state lies outside the range or a field is vignetted; names the state.
        """
        # The range is that for which the model of the wavefront is tested.
        states = np.atleast_2d(np.asarray(states, float))
        # Ends of a grid are rounded: 1e-9 of the range is allowed.
        is_outside = ~(np.abs(states) <= 1.0 + 1e-9)
        if is_outside.any():
            state, axis = np.argwhere(is_outside)[0]
            # The message has the misalignment in the units of a workshop, too.
            value = states[state, axis]
            size = value * self.misalignment_range[axis]
            size_text = f"{size * 1e3:.6g} mm" if axis < 2 else f"{np.rad2deg(size):.6g}°"
            raise RayTracingError(
                f"state {state}: {DEGREES_OF_FREEDOM[axis]} = {value:.6g} of the range "
                f"({size_text}): must be between -1 and 1"
            )
        return super().__call__(states * self.misalignment_range)


@dataclass(frozen=True)
class Mirror:
    """A symmetry of the telescope, as it acts on states, fields and stamps.

    Attributes
    ----------
    symmetry : Symmetry
        Symmetry of a stamp, whose rows run along y.
    state_matrix : ndarray, shape (4, 4)
        Signed permutation of the four numbers of a state.
    fields : ndarray of int, shape (F,)
        The mirrored telescope shows at field k the mirrored stamp of field `fields[k]`.
    """

    symmetry: Symmetry
    state_matrix: np.ndarray
    fields: np.ndarray

    def states(self, states: np.ndarray) -> np.ndarray:
        """Mirror states, shape (n, 4)."""
        return np.asarray(states @ self.state_matrix.T)

    def stamps(self, stamps: np.ndarray) -> np.ndarray:
        """Return the stamps of the mirrored states, shape (n, F, d, d)."""
        return self.symmetry.image(stamps[:, self.fields])


def mirror_symmetries(points: int) -> list[Mirror]:
    """List the symmetries that map `field_points` on themselves, the identity first.

    They are eight, fewer if the number of points on the circle is not a multiple of 4.
    """
    # Any radius will do: symmetries depend on the angles of the points alone.
    fields, mirrors = field_points(45.0, points), []
    for symmetry in SYMMETRIES:
        matrix = symmetry.matrix
        # The mirrored telescope shows at p the stamp that the telescope shows at matrix⁻¹ p.
        distance = np.linalg.norm((fields @ matrix)[:, None] - fields, axis=2)
        if distance.min(axis=1).max() < 1e-9:  # no field point maps between two
            # A decentre moves as a vector, a tilt as an axial vector: with the determinant ±1.
            state_matrix = np.zeros((4, 4))
            state_matrix[:2, :2] = matrix
            state_matrix[2:, 2:] = np.round(np.linalg.det(matrix)) * matrix
            mirrors.append(Mirror(symmetry, state_matrix, distance.argmin(axis=1)))
    return mirrors


@dataclass(frozen=True)
class QuadraticModel:
    """Zernike coefficients at F fields as quadratic functions of a state.

    Attributes
    ----------
    coefficients : ndarray, shape (F, 15, J)
        Coefficients of the terms in waves, for states in units of the range.
    """

    coefficients: np.ndarray

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """Return the Zernike coefficients of states, (n, 4) to (n, F, J), in waves."""
        return np.asarray(np.einsum("nt,ftj->nfj", quadratic_terms(states), self.coefficients))

    def jacobian(self, states: np.ndarray) -> np.ndarray:
        """Return derivatives by the four numbers of a state, (n, F, 4, J), in waves per range."""
        # ∂t_k/∂t_a = 1 for k = a, and ∂(t_a t_b) = t_b ∂t_a + t_a ∂t_b, which is 2 t_a for a = b.
        slopes = np.zeros((len(states), 4, self.coefficients.shape[1]))
        slopes[:, range(4), range(1, 5)] = 1.0
        for term, (a, b) in enumerate(PAIRS, start=5):
            slopes[:, a, term] += states[:, b]
            slopes[:, b, term] += states[:, a]
        return np.asarray(np.einsum("nkt,ftj->nfkj", slopes, self.coefficients))


def fit_quadratic(states: np.ndarray, zernikes: np.ndarray) -> QuadraticModel:
    """Fit the model by least squares to states (n, 4) with coefficients (n, F, J) in waves.

    Raises
    ------
    ModelError
        If the states do not determine all 15 terms.
    """
    # Zernike coefficient j at field f: z_fj(t) = Σ_k terms_k(t) c_fkj, linear in c.
    # All fields and Zernike terms are right-hand sides of the same equations.
    count, fields, modes = zernikes.shape
    terms = quadratic_terms(states)
    fit, _, rank, _ = np.linalg.lstsq(terms, zernikes.reshape(count, -1), rcond=None)
    if rank < len(fit):
        raise ModelError(f"{count} states determine {rank} of the {len(fit)} quadratic terms")
    return QuadraticModel(np.moveaxis(fit.reshape(-1, fields, modes), 0, 1))


def verify(
    model: QuadraticModel, states: np.ndarray, zernikes: np.ndarray, tolerance: float
) -> np.ndarray:
    """Return the RMS difference of a model from coefficients (n, F, J), shape (n, F), in waves.

    Raises
    ------
    ModelError
        If it exceeds `tolerance` anywhere; the message names the state, the field and the RMS.
    """
    # Zernike polynomials are orthonormal: the RMS over the pupil is the norm of the coefficients.
    residual = np.asarray(np.sqrt(((model(states) - zernikes) ** 2).sum(axis=-1)))
    # Written so that NaN fails, too.
    if not residual.max() <= tolerance:
        state, field = np.unravel_index(residual.argmax(), residual.shape)
        raise ModelError(
            f"quadratic model: {residual.max():.3g} waves RMS from ray tracing in state "
            f"{states[state].tolist()}, field {field} (at most {tolerance:.3g}); "
            "choose a smaller range of misalignment"
        )
    return residual


def coma_free_decentre(model: QuadraticModel, tilts: np.ndarray) -> np.ndarray:
    """Solve for decentres that cancel the field-constant coma of tilts, to first order.

    Along this line tilt and decentre leave hardly more than linear astigmatism, whose sign an
    image in focus does not show: in focus, t and −t on it are twins.

    Parameters
    ----------
    model : QuadraticModel
        Model of the wavefront; only its linear terms are used.
    tilts : ndarray, shape (n, 2)
        Tilts in units of the range.

    Returns
    -------
    ndarray, shape (n, 2)
        Decentres in units of the range.
    """
    # Slopes S of both comas, Noll 7 and 8, by the four numbers, mean of the fields:
    # S_d decentre + S_t tilt = 0.
    coma = slice(7 - FIRST_NOLL, 9 - FIRST_NOLL)
    slopes = model.coefficients[:, 1:5, coma].mean(axis=0)
    return -np.linalg.solve(slopes[:2].T, slopes[2:].T @ tilts.T).T


def twin_states(model: QuadraticModel, states: np.ndarray) -> np.ndarray:
    """Return states with the opposite tilt and the same field-constant coma, shape (n, 4).

    In focus both have nearly the same stamps. Parameters after the four are unchanged.
    """
    # From t to −t on the line of tilt and coma-free decentre through the state: the decentre
    # changes by the coma-free decentre of −2 t.
    tilts = states[:, 2:4]
    decentre = states[:, :2] + coma_free_decentre(model, -2.0 * tilts)
    return np.concatenate([decentre, -tilts, states[:, 4:]], axis=1)
