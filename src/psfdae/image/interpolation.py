"""Interpolation of bad pixels from the good ones around them.

Inputs: an image (h, w), or stamps of stars (n, s, s), and their bad pixels. Output: a copy in which
the bad pixels have values.
"""

from __future__ import annotations

import numpy as np


def fill_bad(image: np.ndarray, bad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an image with its bad pixels interpolated, and the bad pixels without good neighbours.

    Along rows and columns, a cubic polynomial goes through the two nearest pixels on each side;
    a line through the nearest ones is taken where these are bad, and else the mean of the good
    ones of 5 × 5 pixels, weighted by a Gaussian of σ = 1 px.

    Parameters
    ----------
    image : ndarray, shape (h, w)
        Image, in any unit; it may be NaN where it is bad.
    bad : ndarray of bool, shape (h, w)
        Pixels to replace.

    Returns
    -------
    image : ndarray, shape (h, w)
        A copy; 0 where no good pixel is near.
    remaining : ndarray of bool, shape (h, w)
        Bad pixels without a good one among the 5 × 5 around.
    """
    result, remaining = np.where(bad, 0.0, image), np.zeros(bad.shape, dtype=bool)
    row, column = np.nonzero(bad)
    if not row.size:
        return result, remaining

    def look_up(down: int, across: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the values of pixels at these steps from the bad ones, and which are good."""
        at_row, at_column = row + down, column + across
        is_inside = (at_row >= 0) & (at_row < bad.shape[0])
        is_inside &= (at_column >= 0) & (at_column < bad.shape[1])
        at = np.where(is_inside, at_row, 0), np.where(is_inside, at_column, 0)
        is_good = is_inside & ~bad[at]
        return np.where(is_good, image[at], 0.0), is_good

    # Along columns and along rows: pixels at distances −2, −1, 1, 2 and whether they are good.
    total, count = np.zeros((2, len(row)))
    for axis in ((1, 0), (0, 1)):
        pixels = [look_up(n * axis[0], n * axis[1]) for n in (-2, -1, 1, 2)]
        values, can_use = zip(*pixels, strict=True)
        has_line = can_use[1] & can_use[2]
        has_cubic = has_line & can_use[0] & can_use[3]
        line = 0.5 * (values[1] + values[2])
        # Cubic through −2, −1, 1, 2 at 0: (4 (v₋₁ + v₁) − v₋₂ − v₂) / 6; line: (v₋₁ + v₁) / 2.
        cubic = (4.0 * (values[1] + values[2]) - values[0] - values[3]) / 6.0
        # A cubic has twice the weight of a line, which cuts off peaks.
        part = np.where(has_cubic, 2.0, has_line * 1.0)
        total += part * np.where(has_cubic, cubic, line)
        count += part
    result[row, column] = total / np.maximum(count, 1.0)
    # A pixel without a good pair on either axis gets the Gaussian mean of the good pixels around,
    # Σ w v / Σ w.
    row, column = row[count == 0], column[count == 0]
    mean, weight_sum = np.zeros((2, len(row)))
    steps = range(-2, 3)
    weights = np.exp(-0.5 * np.add.outer(np.square(steps), np.square(steps)))
    for down in steps:
        for across in steps:
            # Sums over the pixels that are down and across by these steps.
            value, is_good = look_up(down, across)
            mean += weights[down + 2, across + 2] * value
            weight_sum += weights[down + 2, across + 2] * is_good
    result[row, column] = mean / np.where(weight_sum > 0, weight_sum, 1.0)
    remaining[row, column] = weight_sum <= 0
    return result, remaining


def fill_bad_stamps(stamps: np.ndarray, bad: np.ndarray) -> np.ndarray:
    """Return stamps (n, s, s) with their bad pixels filled, each from its own pixels."""
    rows = np.flatnonzero(bad.any(axis=(1, 2)))
    if not rows.size:
        return stamps
    # All stamps in one tall image, in which two rows of bad pixels part each from the next one.
    between = ((0, 0), (0, 2), (0, 0))
    side = stamps.shape[-1]
    tall = np.pad(stamps[rows], between).reshape(-1, side)
    tall_bad = np.pad(bad[rows], between, constant_values=True).reshape(-1, side)
    result = np.array(stamps)
    result[rows] = fill_bad(tall, tall_bad)[0].reshape(len(rows), side + 2, side)[:, :side]
    return result
