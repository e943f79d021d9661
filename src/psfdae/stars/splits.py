"""Parts of a set of stars for training, validation and test, and random centring errors.

Inputs: numbers or field points of stars, and a seed. Outputs: indices of the stars of each part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psfdae.base.rng import stream


def draw_jitter(count: int, jitter_px: int, rng: np.random.Generator) -> np.ndarray:
    """Draw the centring error of every star in whole pixels (row, column), within ±`jitter_px`."""
    return rng.integers(-jitter_px, jitter_px + 1, size=(count, 2))


def draw_phase(count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw the sub-pixel position of every star (row, column), uniform in ± ½ pixel."""
    return rng.uniform(-0.5, 0.5, size=(count, 2))


@dataclass(frozen=True)
class Split:
    """Indices of the stars of three parts; `fit` and `validation` make up the training part."""

    fit: np.ndarray
    validation: np.ndarray
    test: np.ndarray

    @property
    def train(self) -> np.ndarray:
        """All training stars, validation included, ascending."""
        return np.sort(np.concatenate([self.fit, self.validation]))


def random_split(count: int, train: int, test: int, validation_fraction: float, seed: int) -> Split:
    """Split stars at random, as in the paper: training and test have stars of the same fields."""
    # Stars in random order: validation, the rest of the training, then the test.
    order = stream(seed, "split", "random").permutation(count)
    validation_count = round(validation_fraction * train)
    return Split(
        fit=np.sort(order[validation_count:train]),
        validation=np.sort(order[:validation_count]),
        test=np.sort(order[train : train + test]),
    )


def held_out_fields(grid: np.ndarray) -> np.ndarray:
    """Return True for fields that are held out: (ix + 2·iy) mod 5 = 1, a knight's-move pattern.

    Parameters
    ----------
    grid : ndarray of int, shape (F, 2)
        (ix, iy) of every field.

    Returns
    -------
    ndarray of bool, shape (F,)
        True for about a fifth of the fields.
    """
    return np.asarray((grid[:, 0] + 2 * grid[:, 1]) % 5 == 1)


def held_out_split(
    star_field: np.ndarray, grid: np.ndarray, validation_fraction: float, seed: int
) -> Split:
    """Split stars by whole fields: the test part is all stars of `held_out_fields`.

    The validation part is whole fields of the others, so that it measures the same
    generalisation as the test.

    Parameters
    ----------
    star_field : ndarray of int, shape (n,)
        Field of every star.
    grid : ndarray of int, shape (F, 2)
        (ix, iy) of every field.
    validation_fraction : float
        Fraction of the training fields that are for validation, 0 … 1.
    seed : int
        Seed of the random order of the fields, ≥ 0.
    """
    # Fields of the test, and the other ones in random order.
    test_field = held_out_fields(grid)
    training_field = stream(seed, "split", "held_out").permutation(np.flatnonzero(~test_field))
    # At least one field is left for validation; whole fields go to each part.
    validation_count = max(1, round(validation_fraction * training_field.size))
    is_test = test_field[star_field]
    is_validation = np.isin(star_field, training_field[:validation_count])
    return Split(
        fit=np.flatnonzero(~is_test & ~is_validation),
        validation=np.flatnonzero(is_validation),
        test=np.flatnonzero(is_test),
    )
