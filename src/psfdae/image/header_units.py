"""Numbers and units as headers have them, whatever their spelling.

Inputs: texts of header cards, such as "1.5 e-/ADU" and "electron/pixel". Outputs: numbers and units
of astropy.
"""

from __future__ import annotations

import re
import warnings
from contextlib import suppress
from typing import Any

from psfdae.base.types import UnitBase

SPELLINGS = {
    "electron": "e-|e|el|elec|electrons?|photoelectrons?",
    "adu": "adus?|counts?|cts?|cnts?|dns?",
    "ph": "ph|phot|photons?",
    "pix": "px|pix|pixels?",
    "s": "s|secs?|seconds?",
    "arcsec": "arcsecs?|arcseconds?|asec|''|\"",
    "adu/s": "cps",
    "/": "per",
}
"""Words for a unit of astropy, in any case; counts, adu and DN mean the same."""


def parse_unit(text: str) -> UnitBase | None:
    """Return the unit of a text, None if it is not a unit; an empty text is dimensionless."""
    from astropy import units as u

    def replace_word(match: re.Match[str]) -> str:
        units = (n for n, form in SPELLINGS.items() if re.fullmatch(form, match[0], re.IGNORECASE))
        return next(units, match[0])

    # Words are letters, except the e of an exponent as in 1e-20; e- is a word, but not in e-1.
    words = re.sub(r"(?<![\d.])(?:e-(?!\d)|[a-z]+)|''|\"", replace_word, text.strip(), flags=re.I)
    with warnings.catch_warnings(), suppress(ValueError, TypeError):
        warnings.simplefilter("ignore", u.UnitsWarning)  # several slashes
        return u.Unit(words)
    return None


def count_powers(unit: UnitBase) -> dict[str, float]:
    """Return the powers of the units that a unit consists of, by their names, without "per pixel".

    The pixel means a pixel of the image: counts per pixel are counts.
    """
    parts = zip(unit.bases, unit.powers, strict=True)
    return {base.name: float(power) for base, power in parts if base.name != "pix"}


def parse_number(value: object, unit: str) -> float | None:
    """Return the number of a header card in a unit of astropy; None without a number.

    A plain number is in this unit. A number with another unit is converted, also one of the inverse
    unit, such as ADU per electron, and one per pixel. A comma before one, two, or more than three
    digits is a decimal one; before three digits it may be either, and the number is not read.

    Parameters
    ----------
    value : object
        Value of the card.
    unit : str
        Unit of the result, as astropy calls it.
    """
    from astropy import units as u

    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    match = re.fullmatch(r"\s*([-+]?[\d.]+(?:,\d+)?(?:[ed][-+]?\d+)?)\s*(.*)", str(value), re.I)
    if not isinstance(value, str) or match is None or re.search(r",\d{3}(?!\d)", match[1]):
        return None
    unit_of_text: Any = parse_unit(match[2])
    with suppress(ValueError, TypeError, ZeroDivisionError):  # not a number, or of another unit
        number = float(re.sub("[dD]", "e", match[1].replace(",", ".")))
        # "1.5" is without a unit; ADU/e- is the inverse of the gain.
        if unit_of_text == u.dimensionless_unscaled:
            return number
        quantity = number * unit_of_text
        for candidate in (quantity, quantity * u.pix):
            if candidate.unit.is_equivalent(u.Unit(unit)):
                return float(candidate.to_value(unit))
        return float((1.0 / quantity).to_value(unit))
    return None
