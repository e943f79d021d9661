"""Field points of a telescope, the stars that are put on them, and which of these train."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psfdae.configuration.schema import Grid
from psfdae.rng import stream


def square_grid(points: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """A centred square grid of field points.

    Parameters
    ----------
    points : int
        Points P along a side.
    spacing : float
        Distance of neighbours, any unit.

    Returns
    -------
    index : ndarray of int, shape (P², 2)
        Grid index (ix, iy), ix running fastest.
    position : ndarray, shape (P², 2)
        (x, y) in the unit of `spacing`, 0 in the middle of the grid.
    """
    iy, ix = np.divmod(np.arange(points**2), points)
    index = np.stack([ix, iy], axis=1)
    return index, (index - 0.5 * (points - 1)) * spacing


def relative_field(grid: Grid) -> np.ndarray:
    """Field vectors (h_x, h_y) of a grid's points, 1 at the edge on an axis, shape (P², 2)."""
    _, angle_deg = square_grid(grid.points, grid.spacing_deg)
    return angle_deg / grid.edge_deg


def assign_fields(count: int, fields: int, rng: np.random.Generator) -> np.ndarray:
    """Field of every star: a random permutation of k mod `fields`, k = 0 … count − 1."""
    return rng.permutation(np.arange(count) % fields)


def draw_jitter(count: int, jitter_px: int, rng: np.random.Generator) -> np.ndarray:
    """Centring error of every star in whole pixels (row, column), uniform in ±`jitter_px`."""
    return rng.integers(-jitter_px, jitter_px + 1, size=(count, 2))


def draw_phase(count: int, rng: np.random.Generator) -> np.ndarray:
    """Place of the pixel grid of every star (row, column), uniform in ± ½ pixel."""
    return rng.uniform(-0.5, 0.5, size=(count, 2))


def perturb(
    coefficients: np.ndarray,
    fraction: float,
    factors: np.random.Generator,
    jitter_waves: float = 0.0,
    shifts: np.random.Generator | None = None,
) -> np.ndarray:
    """Random aberrations: every coefficient times (1 + fraction · N(0, 1)) + jitter · N(0, 1).

    The paper (section 3.1) gives "variance of different percentage"; `fraction` is read
    as a standard deviation. The jitter also moves terms that vanish, such as focus on the
    optical axis. All draws are independent; Seidel coefficients are those of H = 1.

    Parameters
    ----------
    coefficients : ndarray, shape (n, J)
        Static coefficients of every star in waves.
    fraction : float
        Relative standard deviation, ≥ 0.
    factors, shifts : Generator
        Where the two kinds of draws come from.
    jitter_waves : float
        Standard deviation in waves, ≥ 0.
    """
    perturbed = coefficients * (1.0 + fraction * factors.standard_normal(coefficients.shape))
    if jitter_waves and shifts:
        perturbed = perturbed + jitter_waves * shifts.standard_normal(coefficients.shape)
    return perturbed


@dataclass(frozen=True)
class Split:
    """Star indices of the three parts; `fit` and `validation` make up the training part."""

    fit: np.ndarray
    validation: np.ndarray
    test: np.ndarray

    @property
    def train(self) -> np.ndarray:
        """All training stars, validation included, ascending."""
        return np.sort(np.concatenate([self.fit, self.validation]))


def random_split(count: int, train: int, test: int, validation_fraction: float, seed: int) -> Split:
    """Stars at random, as in the paper: every test star's field was seen in training."""
    order = stream(seed, "split", "random").permutation(count)
    held = round(validation_fraction * train)
    return Split(
        fit=np.sort(order[held:train]),
        validation=np.sort(order[:held]),
        test=np.sort(order[train : train + test]),
    )


def held_out_fields(grid: np.ndarray) -> np.ndarray:
    """Fields never seen in training: (ix + 2·iy) mod 5 = 1, a knight's-move pattern, (F,).

    `grid`, shape (F, 2), holds (ix, iy) of every field.
    """
    return (grid[:, 0] + 2 * grid[:, 1]) % 5 == 1


def held_out_split(
    star_field: np.ndarray, grid: np.ndarray, validation_fraction: float, seed: int
) -> Split:
    """Whole fields held out: the test part is all stars of `held_out_fields`.

    Validation takes whole fields of the rest, too, so that it asks the same
    question as the test.

    Parameters
    ----------
    star_field : ndarray of int, shape (n,)
        Field of every star.
    grid : ndarray of int, shape (F, 2)
        (ix, iy) of every field.
    """
    test_field = held_out_fields(grid)
    seen = stream(seed, "split", "held_out").permutation(np.flatnonzero(~test_field))
    validation_field = seen[: max(1, round(validation_fraction * seen.size))]
    is_test = test_field[star_field]
    is_validation = np.isin(star_field, validation_field)
    return Split(
        fit=np.flatnonzero(~is_test & ~is_validation),
        validation=np.flatnonzero(is_validation),
        test=np.flatnonzero(is_test),
    )
