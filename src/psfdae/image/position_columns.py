"""Columns of star lists that hold positions, by the names that programs give them.

In: the names of a list's columns. Out: the two columns with the positions, whether these are in
pixels or on the sky, and the origin of pixels, the index of the centre of the first one.

The origin is 1 for SExtractor, IRAF, DAOPHOT and DS9, and 0 for photutils and for psfdae's own
results. Plain x, y are written with either: a wrong guess would shift every star by a pixel, so
there is none. Pixel columns go before sky columns. Columns of different programs in one list are
not guessed between, either.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from psfdae.base.errors import Error


class ColumnError(Error, ValueError):
    """The position columns of a list are missing or not the only ones."""


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
        Index of the centre of the first pixel, 0 or 1; None if the names do not say it.
    flags : str, optional
        Column in which the same program flags stars as SExtractor does.
    exact : bool
        True if the case of the letters tells the program.
    """

    first: str
    second: str
    sky: bool = False
    origin: int | None = None
    flags: str | None = None
    exact: bool = False

    @classmethod
    def of_pairs(cls, pairs: str, **meaning: Any) -> tuple[Positions, ...]:
        """Return the position columns that pairs of names are, all with the same meaning.

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
    Positions.of_pairs(
        "XWIN_IMAGE,YWIN_IMAGE XPSF_IMAGE,YPSF_IMAGE XMODEL_IMAGE,YMODEL_IMAGE "
        "X_IMAGE,Y_IMAGE XPEAK_IMAGE,YPEAK_IMAGE",
        origin=1,
        flags="FLAGS",
    ),
    # SourceXtractor++ from version 0.11 on, and the FITS coordinates of AstroImageJ.
    Positions.of_pairs("pixel_centroid_x,pixel_centroid_y", origin=1),
    Positions.of_pairs("X(FITS),Y(FITS)", origin=1),
    # LSST's pipelines.
    Positions.of_pairs(
        "slot_Centroid_x,slot_Centroid_y base_SdssCentroid_x,base_SdssCentroid_y", origin=0
    ),
    # photutils; its xcenter counts from 0, and IRAF's XCENTER from 1.
    Positions.of_pairs("x_fit,y_fit x_centroid,y_centroid xcentroid,ycentroid", origin=0),
    Positions.of_pairs("xcenter,ycenter", origin=0, exact=True),
    Positions.of_pairs("XCENTER,YCENTER", origin=1, exact=True),
    Positions.of_pairs("XCenter,YCenter"),
    # Names that anybody may have given: each pair is a convention of its own.
    *map(
        Positions.of_pairs,
        ("x,y", "xpos,ypos", "x_pos,y_pos", "xpix,ypix", "x_pix,y_pix", "x_pixel,y_pixel"),
    ),
    # SExtractor on the sky, by its own and by photometry's names.
    Positions.of_pairs(
        "ALPHAWIN_J2000,DELTAWIN_J2000 ALPHAPSF_J2000,DELTAPSF_J2000 ALPHA_J2000,DELTA_J2000 "
        "ALPHAWIN_SKY,DELTAWIN_SKY ALPHA_SKY,DELTA_SKY",
        sky=True,
        flags="FLAGS",
    ),
    # Gaia, VizieR, Pan-STARRS, LSST and others; each pair is a convention of its own, too.
    *(
        Positions.of_pairs(pair, sky=True)
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
        In any order and case.

    Raises
    ------
    ColumnError
        If there are none, or those of several programs.
    """
    # Tables of psfdae itself (predict, photometry, train, detect) count from 0. They have
    # further columns of their own, and may have some of other programs.
    tables = ("shift_x shift_y", "x_error y_error flux_model", "snr verdict part", "flux_iso")
    for further_columns in tables:
        if set(names).issuperset(("x", "y", *further_columns.split())):
            return Positions("x", "y", origin=0)
    # The best pair of each program; a column that two programs use counts once.
    choices: list[Positions] = []
    for convention in CONVENTIONS:
        for columns in convention:
            # The case of the names counts only where it tells the program.
            pair = (columns.first, columns.second)
            first, second = (name_in_any_case(names, name) for name in pair)
            if first is None or second is None or (columns.exact and (first, second) != pair):
                continue
            if all(first != choice.first for choice in choices):
                choices.append(replace(columns, first=first, second=second))
            break
    # Pixels go before the sky; what remains must be of one program.
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
    """Return the only one of some names that is the one wanted but for its case, None without.

    Raises
    ------
    ColumnError
        If several are.
    """
    # Blanks around a name, as some text tables have, do not count.
    matches = [name for name in names if name.strip().lower() == name_wanted.lower()]
    if len(matches) > 1:
        raise ColumnError(f"columns {' and '.join(matches)} differ in their case only; keep one")
    return matches[0] if matches else None


def find_identifier(names: Sequence[str]) -> str | None:
    """Return the name of the column that identifies the stars of a list; None without one.

    Of the names that identify stars, it is the first one that the list has. Two columns whose names
    differ by their case only are none.
    """
    known = "id source_id number star_id objid obj_id object_id label name"
    for wanted in known.split():
        matches = [wanted] if wanted in names else [n for n in names if n.strip().lower() == wanted]
        if len(matches) == 1:
            return matches[0]
    return None
