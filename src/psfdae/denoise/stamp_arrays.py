"""Arguments of `PsfModel.predict`: arrays that users pass, checked and converted to stamps.

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
    """Check the arguments of `PsfModel.predict`; return them as stamps, and the unit of these.

    Parameters
    ----------
    stamps : array, masked array, Quantity or NDData, shape (n, s, s) or (s, s)
        Stamps of the stars, or one stamp; masked pixels are bad.
    side : int
        Side s of the model's stamps, in pixels.
    model_name : str
        Name of the model, for messages.
    numbers : mapping
        Flux, background and noise, in the unit of the stamps, and gain, in electrons per this unit,
        by name: one number, one for each star, or None.
    masks : mapping
        The masks `bad` and `saturated` by name: of the shape of the stamps, or None.
    position : array, shape (n, 2) to (n, 4), or None
        Columns x and y in the image in pixels, magnitude and colour.
    centre : array, shape (n, 2), or None
        Columns x and y from the middle of the stamp, in pixels.

    Raises
    ------
    PredictionError
        If a shape, type or unit is wrong, or a number is out of range.
    """
    # The stamps; a single one has two axes, and becomes a cube of one.
    values, is_masked, sigma, unit = _split_stamps(stamps)
    data = real_numbers("stamps", values, PredictionError)
    is_single = data.ndim == 2
    data = data[None] if is_single else data
    if data.ndim != 3 or data.shape[1:] != (side, side):
        size = "×".join(str(n) for n in data.shape)
        raise PredictionError(
            f"stamps of shape {size}, but the model {model_name!r} takes n×{side}×{side}"
        )
    count, is_finite = len(data), np.isfinite(data)
    # One number for each star. Without a given noise, it is the median σ of a stamp of an NDData.
    if numbers["noise"] is None and sigma is not None:
        numbers = {**numbers, "noise": np.nanmedian(sigma, axis=(-2, -1))}
    star_columns = {}
    for name, value in numbers.items():
        number = np.nan if value is None else value
        if hasattr(value, "to_value"):
            # Convert to the unit of the stamps, counts if they have none; a gain is in electrons
            # per this unit.
            stamp_unit = f"electron / ({unit or 'ct'})" if name == "gain" else unit or "ct"
            try:
                number = value.to_value(stamp_unit)
            except (ValueError, TypeError):
                raise PredictionError(
                    f"{name} in {value.unit}, expected {stamp_unit}, which fits the stamps"
                ) from None
        number = real_numbers(name, number, PredictionError)
        if number.shape not in ((), (count,)):
            raise PredictionError(
                f"{name} of shape {number.shape}, expected one number, "
                f"or one for each of {count} stamps"
            )
        _check_range(name, number)
        star_columns[name] = np.broadcast_to(number.astype(np.float64), (count,))
    # Masks have the shape of the stamps, (s, s) for a single one.
    pixel_masks = {}
    for name, mask in masks.items():
        pixels = np.zeros(data.shape[is_single:], bool) if mask is None else np.asarray(mask, bool)
        pixels = pixels[None] if is_single else pixels
        if pixels.shape != data.shape:
            raise PredictionError(
                f"{name} of shape {pixels.shape}, but stamps of shape {data.shape}"
            )
        pixel_masks[name] = pixels
    # Pixels that are not finite, or masked in the container of the stamps, are also bad.
    bad = pixel_masks["bad"] | ~is_finite
    x, y, magnitude, colour = _check_columns("position", position, count, 4).T
    checked_stamps = Stamps(
        data=data if is_finite.all() else np.where(is_finite, data, 0),
        bad=bad if is_masked is None else bad | is_masked,
        saturated=pixel_masks["saturated"],
        flags=np.zeros(count, dtype=np.uint16),
        id=np.arange(count),
        x=x,
        y=y,
        magnitude=magnitude,
        colour=colour,
        listed=_check_columns("centre", centre, count, 2)[:, ::-1],
        noise_correlation=np.ones(count),
        sky_level=np.full(count, np.nan),
        **star_columns,
    )
    return checked_stamps, unit


def _split_stamps(stamps: Any) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None, str]:
    """Return values, mask, σ and unit of stamps in any container; None or "" for what it lacks."""
    if hasattr(stamps, "uncertainty") and hasattr(stamps, "mask"):  # an NDData
        mask = stamps.mask if stamps.mask is None else np.asarray(stamps.mask, dtype=bool)
        unit = "" if stamps.unit is None else str(stamps.unit)
        return np.asarray(stamps.data), mask, compute_sigma(stamps), unit
    if hasattr(stamps, "fileinfo"):  # an HDU, or a list of them
        raise PredictionError(
            f"stamps: expected an array, found {type(stamps).__name__}; its attribute data is one; "
            "psfdae.Stars.from_image takes images in FITS files"
        )
    if isinstance(stamps, list | tuple):
        stamps = real_numbers("stamps", stamps, PredictionError)
    values, mask, unit = split_array(stamps)
    return values, mask, None, unit


def _check_range(name: str, number: np.ndarray) -> None:
    """Raise PredictionError if a noise is negative, or a gain is not above 0."""
    if name == "noise" and (number < 0).any():
        raise PredictionError("noise: expected numbers of at least 0")
    # The variance of the photon noise is flux / gain.
    if name == "gain" and (number <= 0).any():
        raise PredictionError("gain: expected numbers above 0")


def _check_columns(name: str, values: ArrayLike | None, count: int, max_columns: int) -> np.ndarray:
    """Return 2 to `max_columns` numbers per star as (n, max_columns); NaN where unknown."""
    # All columns are NaN if no values are given.
    values = np.full((count, 2), np.nan) if values is None else values
    numbers = real_numbers(name, values, PredictionError)
    if numbers.shape not in [(count, columns) for columns in range(2, max_columns + 1)]:
        raise PredictionError(
            f"{name} of shape {numbers.shape}, expected ({count}, 2)"
            + f" to ({count}, {max_columns})" * (max_columns > 2)
        )
    # The columns that are missing are NaN.
    missing = np.full((count, max_columns - numbers.shape[1]), np.nan)
    return np.hstack([numbers, missing], dtype=np.float64)
