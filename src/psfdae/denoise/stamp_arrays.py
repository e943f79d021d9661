"""Arguments of `PsfModel.predict`: arrays that users pass, checked and made to stamps.

Inputs: arrays with or without mask, quantities and NDData. Outputs: `Stamps`, and the unit of the
pixels.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from psfdae.base.arguments import real_numbers
from psfdae.image.containers import compute_sigma, split_array
from psfdae.image.stamps import Stamps
from psfdae.psf.interface import PredictionError


def make_stamps(
    stamps: Any,
    side: int,
    model_name: str,
    numbers: Mapping[str, Any],
    masks: Mapping[str, ArrayLike | None],
    position: ArrayLike | None,
    centre: ArrayLike | None,
) -> tuple[Stamps, str]:
    """Return the arguments of `PsfModel.predict` as stamps, checked, and their unit.

    Parameters
    ----------
    stamps : array, masked array, Quantity or NDData, shape (n, s, s) or (s, s)
        Stamps of the stars, or one stamp; pixels of a mask are bad.
    side : int
        The side s that the model takes.
    model_name : str
        Name of the model, for messages.
    numbers : mapping
        Flux, background, noise and gain by name: one number, one for each star, or None.
    masks : mapping
        Masks bad and saturated by name: of the shape of the stamps, or None.
    position, centre : array, shape (n, 2), or None
        Columns x, y, magnitude and colour, and x and y from the middle of the stamp; a position
        may have up to four columns.

    Raises
    ------
    PredictionError
        If shapes, types or units do not fit.
    """
    # The stamps; a single one has two axes, and counts as a cube of one.
    values, is_masked, sigma, unit = _unpack(stamps)
    data = real_numbers("stamps", values, PredictionError)
    is_single = data.ndim == 2
    data = data[None] if is_single else data
    if data.ndim != 3 or data.shape[1:] != (side, side):
        size = "×".join(str(n) for n in data.shape)
        raise PredictionError(
            f"stamps of shape {size}, but the model {model_name!r} takes n×{side}×{side}"
        )
    count, is_finite = len(data), np.isfinite(data)
    # One number for each star. The median σ of an NDData's stamp is the noise that is not given.
    if numbers["noise"] is None and sigma is not None:
        numbers = {**numbers, "noise": np.nanmedian(sigma, axis=(-2, -1))}
    star_columns = {}
    for name, value in numbers.items():
        number = np.nan if value is None else value
        if hasattr(value, "to_value"):
            # In the unit of the stamps, counts where they have none; a gain in electrons per that.
            stamp_unit = f"electron / ({unit or 'ct'})" if name == "gain" else unit or "ct"
            try:
                number = value.to_value(stamp_unit)
            except (ValueError, TypeError):
                raise PredictionError(
                    f"{name} in {value.unit}, expected {stamp_unit} as the stamps"
                ) from None
        number = real_numbers(name, number, PredictionError)
        if number.shape not in ((), (count,)):
            raise PredictionError(
                f"{name} of shape {number.shape}, expected one for {count} stamps"
            )
        if name in ("noise", "gain") and (number < 0).any():
            raise PredictionError(f"{name}: expected numbers of at least 0")
        star_columns[name] = np.broadcast_to(number.astype(np.float64), (count,))
    # Masks of the shape of the stamps; of a single one, they may be (s, s).
    pixel_masks = {}
    for name, mask in masks.items():
        array = np.zeros(data.shape[is_single:], bool) if mask is None else np.asarray(mask, bool)
        array = array[None] if is_single else array
        if array.shape != data.shape:
            raise PredictionError(
                f"{name} of shape {array.shape}, but stamps of shape {data.shape}"
            )
        pixel_masks[name] = array
    # Pixels that are not finite, or masked in their container, are bad, too.
    bad = pixel_masks["bad"] | ~is_finite
    x, y, magnitude, colour = _columns("position", position, count, 4).T
    checked_arrays = Stamps(
        data=data if is_finite.all() else np.where(is_finite, data, 0),
        bad=bad if is_masked is None else bad | is_masked,
        saturated=pixel_masks["saturated"],
        flags=np.zeros(count, dtype=np.uint16),
        id=np.arange(count),
        x=x,
        y=y,
        magnitude=magnitude,
        colour=colour,
        listed=_columns("centre", centre, count, 2)[:, ::-1],
        noise_correlation=np.ones(count),
        **star_columns,
    )
    return checked_arrays, unit


def _unpack(stamps: Any) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None, str]:
    """Return numbers, mask, σ and unit of stamps in any container; None, None, "" without them."""
    if hasattr(stamps, "uncertainty") and hasattr(stamps, "mask"):  # an NDData
        mask = stamps.mask if stamps.mask is None else np.asarray(stamps.mask, dtype=bool)
        unit = "" if stamps.unit is None else str(stamps.unit)
        return np.asarray(stamps.data), mask, compute_sigma(stamps), unit
    if hasattr(stamps, "fileinfo"):  # an HDU, or a list of them
        raise PredictionError(
            f"{type(stamps).__name__} in place of stamps: its array is its attribute data; "
            "psfdae.Stars.from_image takes images in FITS files"
        )
    if isinstance(stamps, list | tuple):
        stamps = real_numbers("stamps", stamps, PredictionError)
    values, mask, unit = split_array(stamps)
    return values, mask, None, unit


def _columns(name: str, values: ArrayLike | None, count: int, max_columns: int) -> np.ndarray:
    """Return two numbers per star, or up to `max_columns` (n, max_columns); NaN where unknown."""
    # Two columns of NaN if the values are not given.
    values = np.full((count, 2), np.nan) if values is None else values
    numbers = real_numbers(name, values, PredictionError)
    if numbers.shape not in [(count, columns) for columns in range(2, max_columns + 1)]:
        raise PredictionError(
            f"{name} of shape {numbers.shape}, expected ({count}, 2)"
            + f" to ({count}, {max_columns})" * (max_columns > 2)
        )
    # Columns that are not given are NaN.
    missing = np.full((count, max_columns - numbers.shape[1]), np.nan)
    return np.hstack([numbers, missing], dtype=np.float64)
