"""Scene 3: a telescope with a misaligned secondary mirror.

A state is four numbers in units of the range, in the order of
`psfdae.optics.raytracing.DEGREES_OF_FREEDOM`. Its data are the stamps at a few
fields. Wavefronts leave out piston and tilts: all fields move together with the
secondary, and a stamp is centred on its own centroid.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from psfdae.optics.raytracing import ZernikeTracer
from psfdae.stars.alignment_model import QuadraticModel
from psfdae.stars.alignment_stamps import FIRST_NOLL, AlignmentStamps


def field_points(radius_deg: float, points: int) -> np.ndarray:
    """The centre of the field and points on a circle, the first on the x axis.

    Returns
    -------
    ndarray, shape (1 + points, 2)
        Field angles (x, y) in radians.
    """
    angle = 2.0 * np.pi * np.arange(points) / points
    circle = np.deg2rad(radius_deg) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.zeros((1, 2)), circle])


def grid_states(levels: int) -> np.ndarray:
    """All combinations of equidistant levels from −1 to 1, shape (levels⁴, 4)."""
    return np.array(list(product(np.linspace(-1.0, 1.0, levels), repeat=4)))


def uniform_states(count: int, rng: np.random.Generator) -> np.ndarray:
    """Random states, uniform within the range, shape (count, 4)."""
    return rng.uniform(-1.0, 1.0, size=(count, 4))


def zernike_tracer(config: Any) -> ZernikeTracer:
    """Ray tracer of a stage config with `telescope`, `prescription` and `alignment`."""
    alignment = config.alignment
    return ZernikeTracer(
        config.prescription,
        config.telescope,
        alignment.defocus_m,
        field_points(alignment.field_radius_deg, alignment.field_points),
        alignment.unit,
        alignment.highest_zernike,
    )


def traced_zernikes(tracer: ZernikeTracer, states: np.ndarray) -> np.ndarray:
    """Ray-traced coefficients without piston and tilts, shape (n, F, J), in waves.

    The first of the J is that of Noll index 4.

    Raises
    ------
    RayTracingError
        If a state lies outside the range or a field is vignetted.
    """
    return tracer(states)[..., FIRST_NOLL - 1 :]


def state_stamps(stamps: AlignmentStamps, zernikes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stamps of states from their wavefronts at all fields.

    Parameters
    ----------
    stamps : AlignmentStamps
    zernikes : ndarray, shape (n, F, J)
        From `traced_zernikes` or from a `QuadraticModel`, in waves.

    Returns
    -------
    stamps : ndarray, shape (n, F, d, d)
        Each sums to 1.
    energy : ndarray, shape (n, F)
        Fraction of the light inside each stamp.

    Raises
    ------
    EnergyError
        If a stamp holds too little of the light.
    """
    count, fields, modes = zernikes.shape
    images, energy = stamps(zernikes.reshape(-1, modes))
    return images.reshape(count, fields, *images.shape[1:]), energy.reshape(count, fields)


def state_derivatives(
    model: QuadraticModel, stamps: AlignmentStamps, states: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Model stamps of states and their derivatives by the four numbers of a state.

    Any states will do: a fit may pass through some outside the range.

    Parameters
    ----------
    model : QuadraticModel
    stamps : AlignmentStamps
    states : ndarray, shape (n, 4)
        In units of the range.

    Returns
    -------
    stamps : ndarray, shape (n, F, d, d)
        Each sums to 1.
    derivatives : ndarray, shape (n, F, 4, d, d)
        Per unit of the range; each sums to 0.
    """
    zernikes, jacobian = model(states), model.jacobian(states)
    count, fields, modes = zernikes.shape
    images, slopes = stamps.derivatives(zernikes.reshape(-1, modes), jacobian.reshape(-1, 4, modes))
    return (
        images.reshape(count, fields, *images.shape[1:]),
        slopes.reshape(count, fields, *slopes.shape[1:]),
    )
