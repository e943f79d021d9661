"""Names under which catalogues keep positions and identifiers, and the choice among them.

Case does not matter. The origin is the index of the centre of the first pixel:

| program | origin | columns, best first |
|---|---|---|
| SExtractor and the like | 1 | XWIN_IMAGE, XPSF_IMAGE, XMODEL_IMAGE, X_IMAGE, XPEAK_IMAGE |
| photutils | 0 | x_fit, x_centroid, xcentroid, xcenter |
| any | must be stated | x, xpos, x_pos, xpix, x_pix, x_pixel |
| SExtractor, sky | degrees | ALPHAWIN_J2000, ALPHAPSF_J2000, ALPHA_J2000, …_SKY |
| any, sky | degrees, or sexagesimal text | ra, raj2000, _raj2000, ra_icrs, ra_deg, ramean, radeg |

Plain x, y are written with either origin (IRAF and DS9 count from 1, numpy and sep
from 0); a wrong guess would shift every star by a pixel, so there is none. Pixel
columns go before sky columns. Columns of different programs in one catalogue are
not guessed between, either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

Pair = tuple[str, str]


@dataclass(frozen=True)
class Convention:
    """Position columns of one program: `pairs` from best to worst."""

    pairs: tuple[Pair, ...]
    sky: bool
    origin: int | None = None


def _pairs(names: str) -> tuple[Pair, ...]:
    words = names.split()
    return tuple(zip(words[::2], words[1::2], strict=True))


CONVENTIONS = (
    Convention(
        _pairs(
            "XWIN_IMAGE YWIN_IMAGE XPSF_IMAGE YPSF_IMAGE XMODEL_IMAGE YMODEL_IMAGE "
            "X_IMAGE Y_IMAGE XPEAK_IMAGE YPEAK_IMAGE"
        ),
        sky=False,
        origin=1,
    ),
    Convention(
        _pairs("x_fit y_fit x_centroid y_centroid xcentroid ycentroid xcenter ycenter"),
        sky=False,
        origin=0,
    ),
    *(
        Convention((pair,), sky=False)
        for pair in _pairs("x y xpos ypos x_pos y_pos xpix ypix x_pix y_pix x_pixel y_pixel")
    ),
    Convention(
        _pairs(
            "ALPHAWIN_J2000 DELTAWIN_J2000 ALPHAPSF_J2000 DELTAPSF_J2000 ALPHA_J2000 DELTA_J2000 "
            "ALPHAWIN_SKY DELTAWIN_SKY ALPHA_SKY DELTA_SKY"
        ),
        sky=True,
    ),
    *(
        Convention((pair,), sky=True)
        for pair in _pairs(
            "ra dec RAJ2000 DEJ2000 RAJ2000 DECJ2000 _RAJ2000 _DEJ2000 RA_ICRS DE_ICRS "
            "RA_ICRS DEC_ICRS ra_deg dec_deg raMean decMean radeg decdeg radeg dedeg"
        )
    ),
)

ID_COLUMNS = (
    "id",
    "source_id",
    "number",
    "star_id",
    "objid",
    "obj_id",
    "object_id",
    "label",
    "name",
)
"""Columns that identify a star; the first of these that a catalogue has is used."""


class ColumnError(ValueError):
    """The position columns of a catalogue are missing or not the only ones."""


@dataclass(frozen=True)
class PositionColumns:
    """Which two columns hold the positions and how to read them."""

    first: str
    second: str
    sky: bool
    origin: int | None


def accepted() -> str:
    """The accepted pairs of columns in one line, for messages."""
    return " ".join(f"{a},{b}" for c in CONVENTIONS for a, b in c.pairs)


def resolve(names: Sequence[str], wanted: str) -> str | None:
    """The one column of that name, case aside if it is not written exactly so.

    Raises
    ------
    ColumnError
        If several columns differ in nothing but their case.
    """
    return wanted if wanted in names else _in_any_case(names, wanted)


def _in_any_case(names: Sequence[str], wanted: str) -> str | None:
    same = [name for name in names if name.strip().lower() == wanted.lower()]
    if len(same) > 1:
        raise ColumnError(f"columns {' and '.join(same)} differ in their case only; keep one")
    return same[0] if same else None


def choose_positions(names: Sequence[str], columns: Pair | None = None) -> PositionColumns:
    """Find the position columns among the names of a catalogue.

    Parameters
    ----------
    names : sequence of str
        Columns of the catalogue.
    columns : pair of str, optional
        The pair to take, first x or right ascension. Names that are not in
        `CONVENTIONS` are pixels of an origin that must be stated.

    Raises
    ------
    ColumnError
        If there is no pair, or pairs of more than one convention.
    """
    if columns is not None:
        return _named_pair(names, columns)
    found = [
        (convention, pair)
        for convention in CONVENTIONS
        if (pair := _first_pair(names, convention)) is not None
    ]
    found = [f for f in found if not f[0].sky] or found
    if not found:
        raise ColumnError("no position columns")
    if len(found) > 1:
        pairs = " or ".join(f"{a},{b}" for _, (a, b) in found)
        raise ColumnError(f"ambiguous position columns {pairs}; keep one pair or name it")
    convention, (first, second) = found[0]
    return PositionColumns(first, second, convention.sky, convention.origin)


def _first_pair(names: Sequence[str], convention: Convention) -> Pair | None:
    for first, second in convention.pairs:
        a, b = _in_any_case(names, first), _in_any_case(names, second)
        if a is not None and b is not None:
            return a, b
    return None


def _named_pair(names: Sequence[str], columns: Pair) -> PositionColumns:
    resolved = [resolve(names, name) for name in columns]
    for name, column in zip(columns, resolved, strict=True):
        if column is None:
            raise ColumnError(f"no column {name!r}")
    key = tuple(name.lower() for name in columns)
    for convention in CONVENTIONS:
        if any(key == (a.lower(), b.lower()) for a, b in convention.pairs):
            return PositionColumns(*resolved, convention.sky, convention.origin)
    return PositionColumns(*resolved, sky=False, origin=None)
