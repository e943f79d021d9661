"""Columns of star lists that hold positions, by the names that programs give them.

Input: the names of a list's columns. Outputs: the two columns with the positions, whether these are
in pixels or on the sky, and the pixel origin, the index of the centre of the first pixel.

The origin is 1 for SExtractor, IRAF, DAOPHOT and DS9, and 0 for photutils and for psfdae's own
results. Plain x, y are written with either: a wrong guess would shift every star by a pixel, so
the origin is not guessed. Pixel columns override sky columns. Columns of different programs in one
list are ambiguous, and an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from psfdae.base.errors import Error


class ColumnError(Error, ValueError):
    """The position columns of a list are missing or ambiguous."""


@dataclass(frozen=True)
class Positions:
    """Two columns with the positions of stars, and how to read them.

    Attributes
    ----------
    first, second : str
        Names of the columns: x and y, or right ascension and declination.
    sky : bool
        True for coordinates on the sky.
    origin : int, optional
        Index of the centre of the first pixel, 0 or 1; None if the names do not show it.
    flags : str, optional
        Column in which the same program flags stars as SExtractor does.
    exact : bool
        True if the case of the letters identifies the program.
    """

    first: str
    second: str
    sky: bool = False
    origin: int | None = None
    flags: str | None = None
    exact: bool = False

    @classmethod
    def from_pairs(cls, pairs: str, **meaning: Any) -> tuple[Positions, ...]:
        """Build the position columns from pairs of names, all with the same meaning.

        Parameters
        ----------
        pairs : str
            Pairs `x,y` of names, with blanks between them.
        **meaning
            Other fields that they share, such as `origin=1`.
        """
        names = [pair.split(",") for pair in pairs.split()]
        return tuple(cls(first, second, **meaning) for first, second in names)


CONVENTIONS: tuple[tuple[Positions, ...], ...] = (
    # SExtractor: windowed centroids, fits of a PSF or a model, isophotal centroids, peaks.
    Positions.from_pairs(
        "XWIN_IMAGE,YWIN_IMAGE XPSF_IMAGE,YPSF_IMAGE XMODEL_IMAGE,YMODEL_IMAGE "
        "X_IMAGE,Y_IMAGE XPEAK_IMAGE,YPEAK_IMAGE",
        origin=1,
        flags="FLAGS",
    ),
    # SourceXtractor++ from version 0.11 on, and the FITS coordinates of AstroImageJ.
    Positions.from_pairs("pixel_centroid_x,pixel_centroid_y", origin=1),
    Positions.from_pairs("X(FITS),Y(FITS)", origin=1),
    # LSST's pipelines.
    Positions.from_pairs(
        "slot_Centroid_x,slot_Centroid_y base_SdssCentroid_x,base_SdssCentroid_y", origin=0
    ),
    # photutils; its xcenter has the origin 0, IRAF's XCENTER the origin 1.
    Positions.from_pairs("x_fit,y_fit x_centroid,y_centroid xcentroid,ycentroid", origin=0),
    Positions.from_pairs("xcenter,ycenter", origin=0, exact=True),
    Positions.from_pairs("XCENTER,YCENTER", origin=1, exact=True),
    Positions.from_pairs("XCenter,YCenter"),
    # Common names of no particular program: each pair is a convention of its own.
    *map(
        Positions.from_pairs,
        ("x,y", "xpos,ypos", "x_pos,y_pos", "xpix,ypix", "x_pix,y_pix", "x_pixel,y_pixel"),
    ),
    # SExtractor on the sky, by its own and by photometry's names.
    Positions.from_pairs(
        "ALPHAWIN_J2000,DELTAWIN_J2000 ALPHAPSF_J2000,DELTAPSF_J2000 ALPHA_J2000,DELTA_J2000 "
        "ALPHAWIN_SKY,DELTAWIN_SKY ALPHA_SKY,DELTA_SKY",
        sky=True,
        flags="FLAGS",
    ),
    # Gaia, VizieR, Pan-STARRS, LSST and others; each pair is a convention of its own, too.
    *(
        Positions.from_pairs(pair, sky=True)
        for pair in (
            *("ra,dec", "RAJ2000,DEJ2000", "RAJ2000,DECJ2000", "_RAJ2000,_DEJ2000"),
            *("RA_ICRS,DE_ICRS", "RA_ICRS,DEC_ICRS", "RA_J2000,DEC_J2000"),
            *("ra_deg,dec_deg", "raMean,decMean", "radeg,decdeg", "radeg,dedeg"),
            *("coord_ra,coord_dec", "world_centroid_alpha,world_centroid_delta"),
        )
    ),
)
"""Position columns of each program, from the best to the worst."""


def choose_positions(names: Sequence[str]) -> Positions:
    """Find the position columns among the names of a list's columns.

    Parameters
    ----------
    names : sequence of str
        Names of all columns, in any order and case.

    Raises
    ------
    ColumnError
        If no columns are found, or columns of several programs.
    """
    # Tables of psfdae itself (predict, photometry, train, detect) count from 0. They have
    # further columns of their own, and may have some of other programs.
    tables = ("shift_x shift_y", "x_error y_error flux_model", "snr verdict part", "flux_iso")
    for further_columns in tables:
        if set(names).issuperset(("x", "y", *further_columns.split())):
            return Positions("x", "y", origin=0)
    # The best pair of each program; a column that two programs use is one choice.
    choices: list[Positions] = []
    for convention in CONVENTIONS:
        for columns in convention:
            # The case of the names matters only where it identifies the program.
            pair = (columns.first, columns.second)
            first, second = (name_in_any_case(names, name) for name in pair)
            if first is None or second is None or (columns.exact and (first, second) != pair):
                continue
            if all(first != choice.first for choice in choices):
                choices.append(replace(columns, first=first, second=second))
            break
    # Pixels override the sky; the remaining columns must be of one program.
    choices = [choice for choice in choices if not choice.sky] or choices
    if not choices:
        raise ColumnError("no position columns")
    if len(choices) > 1:
        pairs = " or ".join(f"{choice.first},{choice.second}" for choice in choices)
        raise ColumnError(f"ambiguous position columns {pairs}; keep one pair")
    return choices[0]


def has_positions(names: Sequence[str]) -> bool:
    """Return whether `choose_positions` finds the position columns among some names."""
    with suppress(ColumnError):
        return bool(choose_positions(names))
    return False


def name_in_any_case(names: Sequence[str], name_wanted: str) -> str | None:
    """Return the name that matches `name_wanted` in any case; None if no name does.

    Raises
    ------
    ColumnError
        If several names match.
    """
    # Blanks around a name, as in some text tables, are ignored.
    matches = [name for name in names if name.strip().lower() == name_wanted.lower()]
    if len(matches) > 1:
        raise ColumnError(f"columns {' and '.join(matches)} differ in their case only; keep one")
    return matches[0] if matches else None


def find_identifier(names: Sequence[str]) -> str | None:
    """Return the name of the column that identifies the stars of a list; None without one.

    It is the first of the usual names that the list has. Two columns whose names differ by their
    case only are ignored.
    """
    usual_names = "id source_id number star_id objid obj_id object_id label name"
    for name in usual_names.split():
        matches = [name] if name in names else [n for n in names if n.strip().lower() == name]
        if len(matches) == 1:
            return matches[0]
    return None
