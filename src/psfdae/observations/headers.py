"""What FITS headers say about an image: gain, saturation, pixel scale, provenance.

Values that are missing, not a number or out of range count as not given; the
extension's header goes before the primary one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

GAIN_KEYS = ("EGAIN", "GAIN")
"""EGAIN first: cameras that write both put a setting without unit into GAIN."""

SATURATION_KEYS = ("SATURATE", "SATLEVEL")

SCALE_KEYS = ("PIXSCALE", "PIXELSCL", "SECPIX", "SECPIX1")
"""Arcseconds per pixel; PIXELSCL is written by POPPY."""

PROVENANCE_KEYS = (
    "OBJECT",
    "TELESCOP",
    "INSTRUME",
    "OBSERVER",
    "FILTER",
    "DATE-OBS",
    "MJD-OBS",
    "EXPTIME",
    "AIRMASS",
)
"""Cards that say where stamps come from, copied to whatever is made of them."""

Card = tuple[str, str | int | float | bool, str]


def positive_number(headers: Sequence[Any], keys: Sequence[str]) -> float | None:
    """First finite positive number under one of the keys.

    Parameters
    ----------
    headers : sequence of astropy Header, in order of precedence
    keys : sequence of str, in order of precedence
    """
    for key in keys:
        for header in headers:
            value = card_value(header, key)
            if isinstance(value, int | float) and not isinstance(value, bool):
                number = float(value)
                if np.isfinite(number) and number > 0:
                    return number
    return None


def card_value(header: Any, key: str) -> Any:
    """Value of a card; None if it is absent or cannot be parsed."""
    try:
        return header.get(key)
    except Exception:  # astropy parses on access, and raises what the damage brings about
        return None


def electrons_per_count(headers: Sequence[Any]) -> float | None:
    """Gain of an image in electrons per count of its pixels; None if unknown.

    Images in electrons (BUNIT) have 1 whatever the camera's gain was; for images
    of a rate, counts per second, the gain of the camera is not that of the pixels.
    """
    for header in headers:
        unit = card_value(header, "BUNIT")
        if isinstance(unit, str) and unit.strip():
            name = unit.strip().lower().replace(" ", "")
            if name in {"electron", "electrons", "e-", "e"}:
                return 1.0
            if name.endswith(("/s", "/sec", "/second", "s-1", "s**-1", "s^-1")):
                return None
            break
    return positive_number(headers, GAIN_KEYS)


def provenance(headers: Sequence[Any]) -> list[Card]:
    """Cards of `PROVENANCE_KEYS` as (key, value, comment), those that can be parsed."""
    cards = []
    for key in PROVENANCE_KEYS:
        for header in headers:
            value = card_value(header, key)
            if isinstance(value, str | int | float | bool) and value != "":
                cards.append((key, value, _comment(header, key)))
                break
    return cards


def _comment(header: Any, key: str) -> str:
    try:
        return str(header.comments[key])
    except Exception:  # as in card_value
        return ""
